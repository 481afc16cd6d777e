"""Chains of closed forms of falling size, of which few are fitted and the others are read off.

A *chain* holds everything still but one parameter, such as CPCA's rank: its points go from the
largest value to the smallest. The first is fitted; those not much smaller are read off it
(:mod:`prt_torch.reductions`); the first beyond its reach is fitted anew and serves those
after it. Fits of falling size add up to few of the largest: a chain of 20 points costs less than
three of them. How far a fit reaches is a compromise, of each kind, between that and what reading
loses (docs/sweeps.md). Kinds and options that cannot be read off are fitted one by one.

Compressed codes are made of numbers, and a fit of numbers serves all codes. So the points of a
chain may also differ by their codes: each is read off the fit of its numbers, or of more of them,
and then compressed.

What is fitted and what is read follows from the chain and the size of a point's transfer alone, so
a chain that was stopped goes on as if it had not been.
"""

import itertools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from prt_torch.construction import SHARE, Parameters, Problem, before_codes, closed_form, in_codes
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
        of_size: Whether the axis counts dimensions of a point's transfer. What is left of them
            then must not grow by more than ``reach`` either: clusters that were chosen for nearly
            all dimensions lose ten times the error at a few less.
    """

    axis: str
    reach: float
    read: Callable[[Any, Parameters, Problem], Representation]
    unless: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    of_size: bool = False

    def reaches(self, wanted: Parameters, fitted: Parameters, size: int | None = None) -> bool:
        """Whether a point can be read off, and is near enough below, what was fitted.

        Args:
            wanted: Parameters of the point.
            fitted: Of the fit.
            size: Numbers of a point's transfer, if they are known.
        """
        if any(wanted.get(name) in ruled for name, ruled in self.unless.items()):
            return False
        pairs = list(zip(_sizes(wanted[self.axis]), _sizes(fitted[self.axis]), strict=True))
        if self.of_size and size is not None:
            pairs += [(size - large, size - small) for small, large in pairs if small < large]
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
    "cpca": Nesting("rank", 1.6, _read_cpca, {"method": ["adaptive"]}, of_size=True),
    "clustered_tensor": Nesting("ranks", 3.0, _read_tensor),
    "scattered_srbf": Nesting("num_functions", 3.0, _read_functions),
    "segmented_cpca": Nesting("rank", 2.0, _read_segments),
    "wavelet": Nesting("num_terms", float("inf"), _read_terms),
}
"""Kinds whose closed forms can be read off larger ones."""


@dataclass(frozen=True)
class Chain:
    """Points of one kind that share all parameters but one, and the codes that they are put in.

    Attributes:
        kind: Of :data:`prt_torch.representations.files.KINDS`.
        fixed: What all points share.
        axis: The parameter that differs; None where there is one value of all.
        values: Of the axis, the largest first.
        shares: Values of ``quantisation_share``, None first; of no elements where it does not
            differ.
    """

    kind: str
    fixed: Parameters
    axis: str | None = None
    values: tuple[Any, ...] = ()
    shares: tuple[float | None, ...] = ()

    def points(self) -> list[Parameters]:
        """Parameters of every point, in the order they are made."""
        axes = [] if self.axis is None else [{self.axis: value} for value in self.values]
        codes = [{SHARE: share} for share in self.shares]
        pairs = itertools.product(axes or [{}], codes or [{}])
        return [{**self.fixed, **along, **share} for along, share in pairs]

    def plan(self, size: int | None = None) -> list[tuple[Parameters, Parameters]]:
        """Every point with the fit that it is read off; its own, if that is fitted for it.

        Args:
            size: Numbers of a point's transfer, if they are known.
        """
        nesting, planned, fitted = NESTINGS.get(self.kind), [], None
        for wanted in self.points():
            numbers = before_codes(self.kind, wanted)
            if fitted is None or not (
                numbers == fitted
                or (nesting is not None and nesting.reaches(numbers, fitted, size))
            ):
                fitted = numbers
            planned.append((wanted, fitted))
        return planned

    def read_off(self, wanted: Parameters, fitted: Parameters) -> Parameters | None:
        """The fit whose numbers a point has some of; None where it has all of them."""
        smaller = self.axis is not None and wanted[self.axis] != fitted[self.axis]
        return fitted if smaller else None


def chains(kind: str, grid: Mapping[str, Sequence[Any]]) -> list[Chain]:
    """The chains that cover a grid.

    Args:
        kind: Of a representation.
        grid: The values of each parameter; their product is swept.
    """
    nesting = NESTINGS.get(kind)
    axis = nesting.axis if nesting and nesting.axis in grid else None
    values = sorted(grid[axis], key=_sizes, reverse=True) if axis else []
    codes = _codes(kind, grid.get(SHARE, []))
    others = [name for name in grid if name != axis and not (any(codes) and name == SHARE)]
    return [
        Chain(kind, dict(zip(others, choice, strict=True)), axis, tuple(values), shares)
        for choice in itertools.product(*(grid[name] for name in others))
        for shares in codes
    ]


def _codes(kind: str, shares: Sequence[float | None]) -> list[tuple[float | None, ...]]:
    """Shares whose points are made of the same numbers; one empty group if codes do not differ."""
    numbers = before_codes(kind, {SHARE: 1.0})
    if not shares or numbers[SHARE] is not None:
        return [()]
    coded = tuple(sorted(share for share in shares if share is not None))
    plain = (None,) if None in shares else ()
    if numbers == {SHARE: None}:  # what is not compressed keeps these numbers
        return [plain + coded]
    return [group for group in (plain, coded) if group]


@dataclass(frozen=True)
class Made:
    """A point of a chain.

    Attributes:
        parameters: Of the point.
        model: The representation.
        fitted: Parameters of the fit that it was read off; its own where it was fitted itself.
        read_off: The same; None where it has all numbers of that fit.
        seconds: That it took, with the fit if that was made for it.
        fit_seconds: As if the fit had been made for it alone; None where the fit was kept from
            before.
        condition: Which a file does not keep; NaN where the fit was kept from before.
    """

    parameters: Parameters
    model: Representation
    fitted: Parameters
    read_off: Parameters | None
    seconds: float
    fit_seconds: float | None
    condition: float


@dataclass(frozen=True)
class _Fit:
    """What points are read off."""

    parameters: Parameters
    model: Representation
    seconds: float | None


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
    fit: _Fit | None = None
    transfer = problem.transfer
    size = transfer.num_channels * transfer.num_rows * transfer.num_coeffs
    for wanted, source in chain.plan(size):
        if done(wanted):
            continue
        start = time.perf_counter()
        if fit is None or fit.parameters != source:
            fit = _fit(problem, chain.kind, source, fitted)
        begun = time.perf_counter()
        read_off = chain.read_off(wanted, source)
        model = fit.model
        if read_off is not None:
            model = NESTINGS[chain.kind].read(model, wanted, problem)
        if before_codes(chain.kind, wanted) != wanted:
            model = in_codes(problem, model, wanted)
        ended = time.perf_counter()
        own = None if fit.seconds is None else fit.seconds + ended - begun
        yield Made(wanted, model, source, read_off, ended - start, own, model.condition)
        if wanted == source:  # as it was kept, so that a chain that was stopped reads the same
            fit = _Fit(source, fitted(source) or model, fit.seconds)


def _fit(
    problem: Problem,
    kind: str,
    parameters: Parameters,
    fitted: Callable[[Parameters], Representation | None],
) -> _Fit:
    kept = fitted(parameters)
    if kept is not None:
        return _Fit(parameters, kept, None)
    start = time.perf_counter()
    model = closed_form(problem, kind, parameters)
    return _Fit(parameters, model, time.perf_counter() - start)
