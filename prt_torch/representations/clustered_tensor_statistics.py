"""What a fit of clustered tensors did, and how long its phases took."""

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class TensorStatistics:
    """What an encoding did; squared errors in the metric.

    Of several groups, turns are counted side by side, a group that is done staying where it is.

    Attributes:
        squared_norm: Of the transfer.
        squared_error: Of the approximation, rounding to codes aside.
        projection_lost: Share of the squared norm that lies beyond the axes of light and view that
            were kept, part of the squared error.
        axes: Of view and light that the work was done in, in the group of most.
        errors: After each turn: of the clustering phase, then of the approximation phase.
        moved: Points that moved in each turn of the clustering phase.
        seconds: Of the phases: ``reading``, ``start``, ``clustering``, ``approximation``,
            ``weights``.
    """

    squared_norm: float
    squared_error: float
    projection_lost: float
    axes: tuple[int, int]
    errors: list[float]
    moved: list[int]
    seconds: dict[str, float]

    @classmethod
    def together(
        cls, groups: Sequence["TensorStatistics"], seconds: dict[str, float], power: float
    ) -> "TensorStatistics":
        """Of all groups; ``seconds`` are those of the whole, errors in ``power`` times its unit."""
        norm = sum(one.squared_norm for one in groups)
        lost = sum(one.projection_lost * one.squared_norm for one in groups)
        turns = range(max(len(one.errors) for one in groups))
        moved = itertools.zip_longest(*(one.moved for one in groups), fillvalue=0)
        return cls(
            squared_norm=norm / power / power,
            squared_error=sum(one.squared_error for one in groups) / power / power,
            projection_lost=lost / (norm or 1.0),
            axes=(max(one.axes[0] for one in groups), max(one.axes[1] for one in groups)),
            errors=[
                sum(one.errors[min(t, len(one.errors) - 1)] for one in groups) / power / power
                for t in turns
            ],
            moved=[sum(counts) for counts in moved],
            seconds=seconds,
        )


class Clock:
    """Seconds of phases, one after the other."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def tick(self, phase: str) -> None:
        """The time since the last tick belongs to this phase."""
        now = time.perf_counter()
        self.seconds[phase] = self.seconds.get(phase, 0.0) + now - self._last
        self._last = now
