"""Which representation, and with which parameters, for a budget of bytes, error or time.

1. *Coarse*: each family's parameters are swept on a coarse nested grid
   (:mod:`prt_torch.nesting`).
2. *Refine*: in the families that may still win, lines through the best are followed: where a value
   of a parameter keeps the limits and the next does not, one between them is fitted, a few times
   over; codes may also become finer or coarser than any tried. A family whose best is far above
   that of another is left as it is.
3. *Pick*: the least error among all that keep the limits; where the error is limited, the fewest
   bytes.

Everything that was tried is kept, with the reasons of the choice. Times are medians on this machine
with the threads in use, so a limit of time picks for this machine.
"""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from prt_torch import evaluate
from prt_torch.bases import SphericalHarmonics
from prt_torch.construction import SHARE, Parameters, Problem, closed_form
from prt_torch.errors import InputError
from prt_torch.nesting import chains, nested
from prt_torch.relight import Relighter
from prt_torch.representations import Representation
from prt_torch.transfer import TransferTensor

Grids = Mapping[str, Mapping[str, Sequence[Any]]]
"""Values of each parameter, by kind."""

_NEAR_SHARE = 1.15  # shares within this factor hardly differ in bytes
_HOPEFUL = 3.0  # families whose best is within this factor of the best of all are refined
_ROUNDS = 4
_NEIGHBOURS = 2  # values of a parameter on each side of the best whose lines are followed
_TIMED_ROUNDS, _WARM_UP = 5, 2


@dataclass(frozen=True)
class Limits:
    """What a representation is to keep; at least one is given.

    Attributes:
        bytes: Of storage in all.
        error: Squared error over squared norm of the transfer.
        relight_seconds: Median time from one light to exit rows, on this machine.
    """

    bytes: int | None = None
    error: float | None = None
    relight_seconds: float | None = None

    def __post_init__(self) -> None:
        if not self.given:
            raise ValueError("expected a limit of bytes, error or relight_seconds, got none")

    @property
    def given(self) -> dict[str, float]:
        """The limits that there are, by name."""
        named = {name: getattr(self, name) for name in ("bytes", "error", "relight_seconds")}
        return {name: value for name, value in named.items() if value is not None}


@dataclass(frozen=True)
class Tried:
    """A candidate.

    Attributes:
        kind: Of representation.
        parameters: Of its closed form.
        bytes: Of storage in all.
        error: Squared error over squared norm of the transfer.
        relight_seconds: As for the limits; NaN where time does not matter.
    """

    kind: str
    parameters: Parameters
    bytes: int
    error: float
    relight_seconds: float

    def keeps(self, limits: Limits) -> bool:
        """Whether it keeps all limits."""
        return all(getattr(self, name) <= most for name, most in limits.given.items())

    def price(self, limits: Limits) -> tuple[float, float]:
        """What is to be least: the error, or where it is limited, the bytes."""
        size = float(self.bytes)
        return (size, self.error) if limits.error is not None else (self.error, size)


@dataclass(frozen=True)
class Choice:
    """What was picked.

    Attributes:
        tried: The candidate.
        model: The representation.
        why: Reasons, in words.
        all_tried: All candidates.
    """

    tried: Tried
    model: Representation
    why: list[str]
    all_tried: list[Tried] = field(repr=False)


def choose(problem: Problem, limits: Limits, *, grids: Grids | None = None) -> Choice:
    """The representation to take within limits.

    Args:
        problem: What to fit, and how.
        limits: To be kept.
        grids: What is tried first; :func:`coarse_grids` if not given.

    Raises:
        InputError: If nothing keeps the limits.
    """
    timed = limits.relight_seconds is not None
    tried = coarse(problem, grids or coarse_grids(problem.transfer), timed=timed)
    return refine(problem, limits, tried)


def coarse_grids(transfer: TransferTensor) -> dict[str, dict[str, list[Any]]]:
    """Values that are tried first: factors of four of clusters, of about 1.5 of what they hold.

    Args:
        transfer: Decides which families suit it, and how large parameters get.
    """
    points, coeffs = transfer.num_points, transfer.num_coeffs
    size = transfer.num_channels * transfer.num_rows * coeffs
    clusters = [count for count in (2, 8, 32, 128, 512) if 4 * count <= points] or [1]
    ranks = [rank for rank in (1, 2, 3, 4, 6, 8, 12, 16, 24) if rank <= size]
    rows = transfer.num_rows * transfer.num_channels
    terms = [count for count in (2, 4, 6, 9, 13, 20, 30, 45, 68, 100, 150) if count <= coeffs]
    grids: dict[str, dict[str, list[Any]]] = {
        "cpca": {"num_clusters": clusters, "rank": ranks, SHARE: [None, 1, 4]},
        "segmented_cpca": {"points_per_cluster": [25, 100, 400], "rank": ranks},
        "wavelet": {"num_terms": terms or [1]},
    }
    tensors = [[min(rows, rank), min(coeffs, 2 * rank), rank] for rank in ranks]
    codes = {SHARE: [None, 1]}
    grids["clustered_tensor"] = {"num_clusters": clusters, "ranks": tensors, **codes}
    if isinstance(transfer.surface.light_basis, SphericalHarmonics):
        grids["zonal_lobes"] = {"num_lobes": [1, 2, 4], "effort": ["fast"], **codes}
    return grids


def coarse(problem: Problem, grids: Grids, *, timed: bool = False) -> list[Tried]:
    """Every point of the grids, nested.

    Args:
        problem: What to fit, and how.
        grids: Of each kind.
        timed: Whether to measure times.
    """
    return [
        _measured(problem, chain.kind, made.parameters, made.model, timed)
        for kind, grid in grids.items()
        for chain in chains(kind, grid)
        for made in nested(problem, chain)
    ]


def _measured(
    problem: Problem, kind: str, parameters: Parameters, model: Representation, timed: bool
) -> Tried:
    transfer = problem.transfer
    return Tried(
        kind=kind,
        parameters=parameters,
        bytes=sum(model.storage().values()),
        error=evaluate.transfer_error(model, transfer),
        relight_seconds=_seconds(model, transfer) if timed else math.nan,
    )


@torch.no_grad()
def _seconds(model: Representation, transfer: TransferTensor) -> float:
    """Median time from one light to exit rows."""
    relighter = Relighter(model).eval()
    light = torch.ones(1, transfer.num_coeffs, 3).to(transfer.values[0:1])
    calls = [lambda: relighter.transferred(light)]
    return evaluate.median_seconds(calls, rounds=_TIMED_ROUNDS, warm_up=_WARM_UP)[0]


def refine(problem: Problem, limits: Limits, tried: Sequence[Tried]) -> Choice:
    """Follow lines through what is best so far to where the limits are met, and pick.

    Args:
        problem: What to fit, and how.
        limits: To be kept.
        tried: What is known already, such as the points of a sweep.

    Raises:
        InputError: If nothing keeps the limits.
    """
    every, timed, skipped = list(tried), limits.relight_seconds is not None, {}
    known = {_key(one.kind, one.parameters) for one in every}
    for _ in range(_ROUNDS):
        best = _best_of_kinds(every, limits)
        if not best:
            break
        least = min(one.price(limits)[0] for one in best.values())
        wanted: list[tuple[str, Parameters]] = []
        for kind, one in best.items():
            if one.price(limits)[0] > _HOPEFUL * least:
                skipped[kind] = one
                continue
            skipped.pop(kind, None)
            own = [other for other in every if other.kind == kind]
            proposed = [*_between(own, one, limits), *_beyond(own, one, limits)]
            wanted += [(kind, given) for given in proposed]
        fresh = [(kind, given) for kind, given in wanted if _key(kind, given) not in known]
        if not fresh:
            break
        for kind, given in fresh:
            if _key(kind, given) not in known:
                model = closed_form(problem, kind, given)
                every.append(_measured(problem, kind, given, model, timed))
                known.add(_key(kind, given))
    return _picked(problem, limits, every, len(tried), skipped)


def _picked(
    problem: Problem, limits: Limits, every: list[Tried], first: int, skipped: dict[str, Tried]
) -> Choice:
    """The best of all, as a fit of its own, and why."""
    timed = limits.relight_seconds is not None
    ordered = sorted((one for one in every if one.keeps(limits)), key=lambda one: one.price(limits))
    for one in ordered:
        # What was read off a larger fit is fitted for itself; that may only take more time.
        model = closed_form(problem, one.kind, one.parameters)
        own = _measured(problem, one.kind, one.parameters, model, timed)
        if own.keeps(limits):
            why = _reasons(own, ordered, every, limits, first, skipped)
            return Choice(own, model, why, every)
    raise InputError(f"budget: {_nearest(every, limits)}")


def _best_of_kinds(tried: Iterable[Tried], limits: Limits) -> dict[str, Tried]:
    """Of each kind the best that keeps the limits."""
    best: dict[str, Tried] = {}
    for one in tried:
        if one.keeps(limits) and (
            one.kind not in best or one.price(limits) < best[one.kind].price(limits)
        ):
            best[one.kind] = one
    return best


def _between(tried: Sequence[Tried], best: Tried, limits: Limits) -> list[Parameters]:
    """Parameters between one that keeps the limits and a next that does not, on lines near by.

    Sizes alone are followed: candidates whose other parameters are not the best's are not on its
    lines.
    """
    tried = [one for one in tried if _choices(one) == _choices(best)]
    tuned = [
        name
        for name, value in best.parameters.items()
        if any(one.parameters[name] != value for one in tried)
    ]
    proposed = []
    for name in tuned:
        others = [other for other in tuned if other != name]
        lines: dict[str, list[Tried]] = {}
        for one in tried:
            if all(_near(one, best, other, tried) for other in others):
                lines.setdefault(_key("", {k: one.parameters[k] for k in others}), []).append(one)
        for line in lines.values():
            line.sort(key=lambda one: _size(one.parameters[name]))
            for low, high in itertools.pairwise(line):
                middle = _middle(name, low.parameters[name], high.parameters[name])
                if low.keeps(limits) != high.keeps(limits) and middle is not None:
                    proposed.append({**low.parameters, name: middle})
    # Between ranks that were tried, lines of their own begin.
    for name in tuned if len(tuned) > 1 else []:
        for value in _values_near(best, name, tried, 1):
            middle = _middle(name, *sorted((value, best.parameters[name]), key=_size))
            if middle is not None:
                proposed.append({**best.parameters, name: middle})
    return proposed


def _beyond(tried: Sequence[Tried], best: Tried, limits: Limits) -> list[Parameters]:
    """The best in codes finer than it was tried in; in coarser ones where bytes are to fall."""
    others, share = _but_share(best)
    shares = [own for rest, own in map(_but_share, tried) if rest == others and own is not None]
    finer = limits.error is None
    if share is None or share != (min(shares) if finer else max(shares)):
        return []
    return [{**others, SHARE: share / 2.0 if finer else share * 2.0}]


def _but_share(one: Tried) -> tuple[Parameters, float | None]:
    """Its parameters, the share of codes apart."""
    others = {name: value for name, value in one.parameters.items() if name != SHARE}
    return others, one.parameters.get(SHARE)


def _values_near(best: Tried, name: str, tried: Sequence[Tried], count: int) -> list[Any]:
    """Values of a parameter that were tried, so many on each side of the best's."""
    values = {str(one.parameters[name]): one.parameters[name] for one in tried}
    ordered = sorted(values.values(), key=_size)
    at = ordered.index(best.parameters[name])
    return ordered[max(0, at - count) : at + count + 1]


def _near(one: Tried, best: Tried, name: str, tried: Sequence[Tried]) -> bool:
    return one.parameters[name] in _values_near(best, name, tried, _NEIGHBOURS)


def _choices(one: Tried) -> Parameters:
    """Its parameters; of a size, only that there is one."""
    return {k: "a size" if _is_size(k, value) else value for k, value in one.parameters.items()}


def _is_size(name: str, value: Any) -> bool:
    """Whether there are others between two: whole numbers, lists of them, and shares."""
    if name == SHARE:
        return value is not None
    parts = value if isinstance(value, list | tuple) else [value]
    return all(type(part) is int for part in parts)


def _size(value: Any) -> float:
    return math.prod(value) if isinstance(value, list | tuple) else float(value)


def _middle(name: str, low: Any, high: Any) -> Any:
    """Between two values, None where there is nothing between."""
    if name == SHARE:
        middle = float(f"{math.sqrt(low * high):.3g}")
        return middle if high > _NEAR_SHARE * low > 0.0 else None
    if isinstance(low, list | tuple):
        middle = [round((a + b) / 2) for a, b in zip(low, high, strict=True)]
        return None if middle in (list(low), list(high)) else middle
    middle = round(math.sqrt(low * high))
    if middle in (low, high):
        middle = (low + high) // 2
    return None if middle in (low, high) else middle


def _key(kind: str, parameters: Parameters) -> str:
    return f"{kind} {sorted((name, str(value)) for name, value in parameters.items())}"


def _reasons(
    own: Tried,
    ordered: Sequence[Tried],
    every: Sequence[Tried],
    limits: Limits,
    first: int,
    skipped: Mapping[str, Tried],
) -> list[str]:
    """Why it was picked, in words."""
    wanted, superlative = ("bytes", "fewest") if limits.error is not None else ("error", "least")
    reasons = [
        f"{own.kind} with {_words(own.parameters)}: {own.bytes:,} bytes, squared error "
        f"{own.error:.3e}, the {superlative} {wanted} of {len(ordered)} that keep the limits, "
        f"of {len(every)} tried ({first} on the grid, {len(every) - first} between)"
    ]
    for kind, other in _best_of_kinds(every, limits).items():
        if kind == own.kind:
            continue
        ratio = other.price(limits)[0] / max(own.price(limits)[0], 1e-300)
        far = ", too far to be refined" if kind in skipped else ""
        reasons.append(
            f"{kind} has {ratio:.2f} times the {wanted} at its best "
            f"({_words(other.parameters)}){far}"
        )
    kinds = dict.fromkeys(one.kind for one in every)
    missing = [kind for kind in kinds if kind not in _best_of_kinds(every, limits)]
    if missing:
        reasons.append(f"{', '.join(missing)}: nothing tried keeps the limits")
    return reasons


def _words(parameters: Parameters) -> str:
    return ", ".join(f"{name}={value}" for name, value in parameters.items())


def _nearest(every: Sequence[Tried], limits: Limits) -> str:
    """Why nothing keeps the limits."""
    given = limits.given
    least = {name: min((getattr(one, name) for one in every), default=math.inf) for name in given}
    beyond = {name: value for name, value in least.items() if value > given[name]}
    if not beyond:
        return f"nothing keeps all of {_words(dict(given))} at once"
    name, value = next(iter(beyond.items()))
    return f"nothing has {name} of at most {given[name]:g}; the least of all tried is {value:g}"
