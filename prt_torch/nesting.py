"""Chains of closed forms of falling size, of which few are fitted and the others are read off.

A *chain* holds everything still but one parameter, such as CPCA's rank: its points go from the
largest value to the smallest. The first is fitted; those not much smaller are read off it
(:mod:`prt_torch.reductions`); the first beyond its reach is fitted anew and serves those
after it. Fits of falling size add up to few of the largest: a chain of 20 points costs less than
three of them. How far a fit reaches is a compromise, of each kind, between that and what reading
loses (docs/sweeps.md). Kinds and options that cannot be read off are fitted one by one.

What is fitted and what is read follows from the chain alone, so a chain that was stopped goes on as
if it had not been.
"""

import itertools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from prt_torch.construction import Parameters, Problem, closed_form
from prt_torch.reductions import (
    fewer_functions,
    fewer_segment_vectors,
    fewer_terms,
    fewer_vectors,
    smaller_tensor,
)
from prt_torch.representations import (
    CPCA,
    ClusteredTensor,
    Representation,
    ScatteredSRBF,
    SegmentedCPCA,
    WaveletTransfer,
)


@dataclass(frozen=True)
class Nesting:
    """How small representations of a kind are read off a larger one.

    Attributes:
        axis: The parameter that falls along a chain.
        reach: How many times smaller than what was fitted a point may be.
        read: Makes the point of these parameters from the fitted one.
        unless: Values of other parameters that rule it out.
        without: Parameters that rule it out where they are given.
    """

    axis: str
    reach: float
    read: Callable[[Any, Parameters, Problem], Representation]
    unless: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    without: Sequence[str] = ()

    def applies(self, parameters: Parameters) -> bool:
        """Whether representations with these parameters can be read off."""
        given = any(parameters.get(name) is not None for name in self.without)
        return not given and not any(
            parameters.get(name) in ruled for name, ruled in self.unless.items()
        )

    def within_reach(self, smaller: Any, fitted: Any) -> bool:
        """Whether a value of the axis is near enough below a fitted one."""
        pairs = list(zip(_sizes(smaller), _sizes(fitted), strict=True))
        return all(small <= large <= self.reach * small for small, large in pairs)


def _sizes(value: Any) -> list[int]:
    return list(value) if isinstance(value, list | tuple) else [value]


def _read_cpca(model: CPCA, wanted: Parameters, problem: Problem) -> Representation:
    return fewer_vectors(model, min(wanted["rank"], model.layout.max_rank))


def _read_terms(model: WaveletTransfer, wanted: Parameters, problem: Problem) -> Representation:
    return fewer_terms(model, min(wanted["num_terms"], model.num_terms))


def _read_tensor(model: ClusteredTensor, wanted: Parameters, problem: Problem) -> Representation:
    return smaller_tensor(model, wanted["ranks"])


def _read_functions(model: ScatteredSRBF, wanted: Parameters, problem: Problem) -> Representation:
    return fewer_functions(model, wanted["num_functions"], problem.known_metric)


def _read_segments(model: SegmentedCPCA, wanted: Parameters, problem: Problem) -> Representation:
    share = wanted.get("quantisation_share", 0.05)
    rank, metric = wanted["rank"], problem.known_metric
    return fewer_segment_vectors(model, rank, problem.transfer, metric, share)


NESTINGS: dict[str, Nesting] = {
    "cpca": Nesting("rank", 1.6, _read_cpca, {"method": ["adaptive"]}, ("quantisation_share",)),
    "clustered_tensor": Nesting("ranks", 3.0, _read_tensor, without=("quantisation_share",)),
    "scattered_srbf": Nesting("num_functions", 3.0, _read_functions),
    "segmented_cpca": Nesting("rank", 2.0, _read_segments),
    "wavelet": Nesting("num_terms", float("inf"), _read_terms),
}
"""Kinds whose closed forms can be read off larger ones."""


@dataclass(frozen=True)
class Chain:
    """Points of one kind that share all parameters but one.

    Attributes:
        kind: Of :data:`prt_torch.representations.files.KINDS`.
        fixed: What all points share.
        axis: The parameter that differs; None where there is one point.
        values: Of the axis, the largest first.
    """

    kind: str
    fixed: Parameters
    axis: str | None = None
    values: tuple[Any, ...] = ()

    def points(self) -> list[Parameters]:
        """Parameters of every point, in the order they are made."""
        if self.axis is None:
            return [dict(self.fixed)]
        return [{**self.fixed, self.axis: value} for value in self.values]

    def plan(self) -> list[tuple[Parameters, Parameters | None]]:
        """Every point with the fitted one it is read off; None where it is fitted itself."""
        nesting, planned, fitted = NESTINGS.get(self.kind), [], None
        for wanted in self.points():
            near = (
                nesting is not None
                and fitted is not None
                and nesting.applies(wanted)
                and nesting.within_reach(wanted[nesting.axis], fitted[nesting.axis])
            )
            planned.append((wanted, fitted if near else None))
            fitted = fitted if near else wanted
        return planned


def chains(kind: str, grid: Mapping[str, Sequence[Any]]) -> list[Chain]:
    """The chains that cover a grid.

    Args:
        kind: Of a representation.
        grid: The values of each parameter; their product is swept.
    """
    nesting = NESTINGS.get(kind)
    axis = nesting.axis if nesting and nesting.axis in grid else None
    others = [name for name in grid if name != axis]
    found = []
    for choice in itertools.product(*(grid[name] for name in others)):
        fixed = dict(zip(others, choice, strict=True))
        if axis is None:
            found.append(Chain(kind, fixed))
            continue
        values = sorted(grid[axis], key=_sizes, reverse=True)
        found.append(Chain(kind, fixed, axis, tuple(values)))
    return found


@dataclass(frozen=True)
class Made:
    """A point of a chain.

    Attributes:
        parameters: Of the point.
        model: The representation.
        read_off: Parameters of the fitted point it was read off; None where it was fitted.
        seconds: To make it, the fit that it was read off aside.
        condition: Of the fit, which a file does not keep.
    """

    parameters: Parameters
    model: Representation
    read_off: Parameters | None
    seconds: float
    condition: float


def nested(
    problem: Problem,
    chain: Chain,
    *,
    done: Callable[[Parameters], bool] = lambda _: False,
    fitted: Callable[[Parameters], Representation | None] = lambda _: None,
) -> Iterator[Made]:
    """Make the points of a chain, the largest first.

    Args:
        problem: What to fit, and how.
        chain: Of one kind.
        done: Whether a point is there already, and is left out.
        fitted: The fitted point of these parameters as it was kept, which others are read off; None
            where it was not kept.

    Raises:
        ValueError: If the transfer or a parameter does not suit the kind.
        InputError: If a fit would take more than the memory budget.
    """
    source: tuple[Parameters, Representation] | None = None
    for wanted, read_off in chain.plan():
        if done(wanted):
            continue
        if read_off is not None and (source is None or source[0] != read_off):
            source = read_off, fitted(read_off) or closed_form(problem, chain.kind, read_off)
        start = time.perf_counter()
        if read_off is None or source is None:
            model = closed_form(problem, chain.kind, wanted)
        else:
            model = NESTINGS[chain.kind].read(source[1], wanted, problem)
        seconds = time.perf_counter() - start
        yield Made(wanted, model, read_off, seconds, model.condition)
        if read_off is None:  # as it was kept, so that a chain that was stopped reads the same
            source = wanted, fitted(wanted) or model
