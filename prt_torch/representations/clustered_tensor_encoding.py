"""How clustered tensor approximation finds its clusters and bases.

1. Transfer is weighed by the metric, so that errors are plain sums of squares, and projected onto
   the axes of view and light that matter (``clustered_tensor_projection``). How many do is
   measured: a small share of the error that the first clusters' bases make may be lost.
2. CPCA's iterations give the first clusters, turns of refitting and moving the final ones
   (``clustered_tensor_search``), in the view basis of most energy.
3. Turns over all three modes improve the bases of these clusters, the shared view basis included
   (``clustered_tensor_fit``).
4. The mode of the points is decomposed exactly, in float64, and bases leave the metric's space.

Points of each material are encoded by themselves (``clustered_tensor_groups``).

Source:
    Tsai, Shih 2006, section 5.2. The projection is ours.
"""

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.metric import Metric
from prt_torch.representations.clustered_tensor_coding import Encoding, Parameters
from prt_torch.representations.clustered_tensor_fit import (
    Bases,
    Decomposition,
    decompose,
    first_bases,
    in_view,
    refit,
    refit_view,
    weights,
)
from prt_torch.representations.clustered_tensor_groups import join, share_out, split
from prt_torch.representations.clustered_tensor_projection import (
    Moments,
    Projection,
    project,
    read_moments,
)
from prt_torch.representations.clustered_tensor_search import (
    Trace,
    find_clusters,
    first_clusters,
)
from prt_torch.representations.grouped import ClusterBlocks
from prt_torch.transfer import TransferTensor

_FIRST_LOSS = 1e-4  # of the energy, that each mode may lose to the projection at first
_LOSS = 1e-3  # of the first clusters' error, that each may lose in the end
_FIRST_STEPS = 3
_STEPS = 3  # of each mode in a turn of the approximation phase


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

    @property
    def energy_kept(self) -> float:
        """Share of the squared norm."""
        return 1.0 - self.squared_error / self.squared_norm if self.squared_norm else 1.0

    @classmethod
    def together(
        cls, groups: Sequence["TensorStatistics"], seconds: dict[str, float]
    ) -> "TensorStatistics":
        """Of all groups; ``seconds`` are those of the whole."""
        norm = sum(one.squared_norm for one in groups)
        lost = sum(one.projection_lost * one.squared_norm for one in groups)
        turns = range(max(len(one.errors) for one in groups))
        moved = itertools.zip_longest(*(one.moved for one in groups), fillvalue=0)
        return cls(
            squared_norm=norm,
            squared_error=sum(one.squared_error for one in groups),
            projection_lost=lost / (norm or 1.0),
            axes=(max(one.axes[0] for one in groups), max(one.axes[1] for one in groups)),
            errors=[sum(one.errors[min(t, len(one.errors) - 1)] for one in groups) for t in turns],
            moved=[sum(counts) for counts in moved],
            seconds=seconds,
        )


@dataclass(frozen=True)
class Ranks:
    """Ranks of the three modes, capped at what exists."""

    view: int
    light: int
    points: int

    @classmethod
    def capped(
        cls, ranks: tuple[int, int, int], transfer: TransferTensor, view_axes: int
    ) -> "Ranks":
        """No mode has more than its size or than the product of the other two.

        Args:
            ranks: Of rows, light coefficients and points, as wanted.
            transfer: What is encoded.
            view_axes: Dimensions of its rows times channels.
        """
        view = min(ranks[0], view_axes)
        points = min(ranks[2], transfer.num_points)
        light = min(ranks[1], transfer.num_coeffs, view * points)
        return cls(view, light, min(points, view * light))


class _Clock:
    """Seconds of phases, one after the other."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def tick(self, phase: str) -> None:
        """The time since the last tick belongs to this phase."""
        now = time.perf_counter()
        self.seconds[phase] = self.seconds.get(phase, 0.0) + now - self._last
        self._last = now


def encode(
    transfer: TransferTensor,
    *,
    num_clusters: int,
    ranks: tuple[int, int, int],
    tolerance: float,
    max_turns: int,
    memory_budget: int,
    metric: Metric,
    generator: torch.Generator,
) -> tuple[Encoding, TensorStatistics]:
    """Cluster the points of a transfer tensor and decompose each cluster; nothing is rounded."""
    clock, groups = _Clock(), split(transfer)
    moments = [read_moments(part, metric) for _, part in groups]
    norms = [of_part.squared_norm * of_part.scale**2 for of_part in moments]
    counts = share_out(num_clusters, norms, [len(points) for points, _ in groups])
    found, statistics = [], []
    for (points, part), of_part, count in zip(groups, moments, counts, strict=True):
        rows = transfer.num_channels * transfer.num_rows
        rank = Ranks.capped(ranks, part, of_part.view_rank if len(groups) > 1 else rows)
        encoding, facts = _encode_group(
            part,
            of_part,
            rank,
            count,
            tolerance=tolerance,
            max_turns=max_turns,
            memory_budget=memory_budget,
            metric=metric,
            generator=generator,
            clock=clock,
        )
        found.append((points, encoding))
        statistics.append(facts)
    joined = join(found)
    clock.tick("weights")
    return joined, TensorStatistics.together(statistics, clock.seconds)


def _encode_group(
    transfer: TransferTensor,
    moments: Moments,
    rank: Ranks,
    num_clusters: int,
    *,
    tolerance: float,
    max_turns: int,
    memory_budget: int,
    metric: Metric,
    generator: torch.Generator,
    clock: _Clock,
) -> tuple[Encoding, TensorStatistics]:
    """All phases for the points of one material."""
    trace = Trace()
    found, labels, bases = _start(
        transfer, metric, moments, rank, num_clusters, memory_budget, generator, clock
    )
    view = torch.eye(found.points.shape[1], rank.view).to(found.points)
    labels, bases = find_clusters(
        found.points[:, : rank.view].contiguous(),
        labels,
        bases,
        trace,
        squared_norm=moments.squared_norm,
        tolerance=tolerance,
        max_turns=max_turns,
    )
    clock.tick("clustering")
    blocks = ClusterBlocks(labels, len(bases.light))
    norm = moments.squared_norm
    view, bases = _approximate(blocks, found.points, view, bases, trace, norm, tolerance, max_turns)
    clock.tick("approximation")
    slots = blocks.to_slots(in_view(found.points, view))
    exact = decompose(blocks, slots, bases.light, rank.points)
    parameters = _unweigh(transfer, metric, moments, found, view, bases, exact)
    clock.tick("weights")
    scale = moments.scale**2
    error = norm - float(exact.weights.square().sum())
    statistics = TensorStatistics(
        squared_norm=norm * scale,
        squared_error=max(error, 0.0) * scale,
        projection_lost=found.lost,
        axes=(found.points.shape[1], found.points.shape[2]),
        errors=[max(norm - held, 0.0) * scale for held in trace.held],
        moved=trace.moved,
        seconds=clock.seconds,
    )
    groups = labels.new_zeros(len(exact.dual))
    return Encoding(labels, groups, parameters, None, exact.condition), statistics


def _start(
    transfer: TransferTensor,
    metric: Metric,
    moments: Moments,
    rank: Ranks,
    num_clusters: int,
    memory_budget: int,
    generator: torch.Generator,
    clock: _Clock,
) -> tuple[Projection, Int[Tensor, "points"], Bases]:
    """Enough axes, first clusters, and where their bases begin."""

    def projected(allowed: float) -> Projection:
        return project(
            transfer,
            metric,
            moments,
            allowed=allowed,
            least=(rank.view, rank.light),
            memory_budget=memory_budget,
        )

    allowed = _FIRST_LOSS * moments.squared_norm
    found = projected(allowed)
    clock.tick("reading")
    points = found.points[:, : rank.view].contiguous()
    labels, clusters = first_clusters(points, num_clusters, rank.points, generator)
    bases = first_bases(
        clusters, rank.view, points.shape[2], rank.light, rank.points, generator, points
    )
    blocks = ClusterBlocks(labels, clusters)
    slots = blocks.to_slots(points)
    bases = refit(blocks, slots, bases, _FIRST_STEPS)
    error = moments.squared_norm - _held(blocks, slots, bases)
    clock.tick("start")
    # Where the error is rounding alone, all axes are kept.
    rounding = torch.finfo(points.dtype).eps * moments.squared_norm
    limit = _LOSS * error if error > rounding else 0.0
    if limit < allowed:
        found = projected(limit)  # the axes are the same and more of them
        more = found.points.shape[2] - bases.light.shape[1]
        bases = Bases(torch.nn.functional.pad(bases.light, (0, 0, 0, more)), bases.dual)
        clock.tick("reading")
    return found, labels, bases


def _held(blocks: ClusterBlocks, slots: Tensor, bases: Bases) -> float:
    """Squared norm of what the bases hold of the tensor."""
    return float(weights(blocks, slots, bases.together()).square().sum(dtype=torch.float64))


def _approximate(
    blocks: ClusterBlocks,
    points: Float[Tensor, "points view_axes light"],
    view: Float[Tensor, "view_axes view"],
    bases: Bases,
    trace: Trace,
    squared_norm: float,
    tolerance: float,
    max_turns: int,
) -> tuple[Float[Tensor, "view_axes view"], Bases]:
    """Turns over all modes until the error settles.

    Source:
        Tsai, Shih 2006, section 5.2.4.
    """
    for turn in range(max_turns):
        if view.shape[0] > view.shape[1]:
            view, bases = refit_view(blocks, points, view, bases)
        slots = blocks.to_slots(in_view(points, view))
        bases = refit(blocks, slots, bases, _STEPS)
        trace.held.append(_held(blocks, slots, bases))
        if turn > 0 and trace.settled(squared_norm, tolerance):
            break
    return view, bases


def _unweigh(
    transfer: TransferTensor,
    metric: Metric,
    moments: Moments,
    found: Projection,
    view: Tensor,
    bases: Bases,
    exact: Decomposition,
) -> Parameters:
    """Bases of the tensor itself, in its own precision.

    The scale of the tensor goes to the weights.
    """
    dtype = transfer.values.dtype
    view_basis = found.view_axes @ view.to(found.view_axes)
    of_rows = replace(metric, light=None)
    shaped = view_basis.unflatten(0, (transfer.num_channels, transfer.num_rows))
    light_bases = (found.light_axes @ bases.light.to(found.light_axes)).mT
    one_row = torch.ones(1, 1, dtype=torch.float64, device=light_bases.device)
    of_light = replace(metric, row_factor=one_row)
    return Parameters(
        view_basis=of_rows.unweigh(shaped).flatten(0, 1)[None].to(dtype),
        light_bases=of_light.unweigh(light_bases[:, :, None])[:, :, 0].contiguous().to(dtype),
        cores=exact.dual.unflatten(2, (view.shape[1], -1)).to(dtype),
        weights=(exact.weights * moments.scale).to(dtype),
    )
