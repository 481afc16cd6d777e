"""What one pays for which error: fronts, results of equal cost, and where an error comes from.

A result is *beaten* by another that costs no more and errs no more, and less in one of the two;
those that nothing beats are the front. A front of all families together says which family to take
at which cost; one of each says what its own parameters are worth.

A *waterfall* switches the approximations on one after the other. Each changes the error of those
before it by a signed difference, which depends on the order, as errors are not independent: one may
hide in another, and a rank takes back what clusters alone would lose. Beside it stands what each
does alone.

Everything here is a function of numbers; nothing is read or drawn.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

COSTS = {
    "bytes": "storage",
    "light_seconds": "change of light",
    "view_seconds": "change of view",
    "relight_seconds": "change of light and view",
    "fit_seconds": "time to fit",
    "peak_bytes": "peak memory",
}
"""Keys of a result that are paid, and what they are called."""

ERRORS = {
    "transfer_error": "squared transfer error",
    "reference_error": "squared error against full resolution",
    "mean_radiance_error": "relative radiance error",
}
"""Errors of a result, and what they are called."""

_GRID_BITS = 48  # of the largest error of a waterfall, in which all are whole numbers

Result = Mapping[str, Any]
"""An entry of ``results`` of a report."""


def error_of(result: Result, error: str) -> float | None:
    """An error of a result by its key in :data:`ERRORS`; None where it is not known."""
    if error != "mean_radiance_error":
        value = result.get(error)
        return None if value is None else float(value)
    by_light = list(result.get("radiance_error", {}).values())
    return sum(by_light) / len(by_light) if by_light else None


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Which points nothing beats, by rising cost; of equal ones the first.

    Args:
        points: Cost and error of each.
    """
    order = sorted(range(len(points)), key=lambda place: (*points[place], place))
    kept: list[int] = []
    for place in order:
        if not kept or points[place][1] < points[kept[-1]][1]:
            kept.append(place)
    return kept


def fronts(results: Sequence[Result], cost: str, error: str) -> dict[str, list[str]]:
    """Names of the results that nothing beats: of all (``joint``) and of each family.

    Args:
        results: Of a report; those without the cost or the error are left out.
        cost: A key of :data:`COSTS`.
        error: A key of :data:`ERRORS`.
    """
    known = [
        (one, (float(one[cost]), lost))
        for one in results
        if one.get(cost) is not None and (lost := error_of(one, error)) is not None
    ]
    families = dict.fromkeys(str(one["representation"]) for one, _ in known)
    chosen = {"joint": known}
    chosen |= {
        name: [pair for pair in known if pair[0]["representation"] == name] for name in families
    }
    return {
        name: [str(some[place][0]["name"]) for place in front([at for _, at in some])]
        for name, some in chosen.items()
    }


def within(
    results: Sequence[Result], limits: Mapping[str, float], least: Callable[[Result], float]
) -> Result | None:
    """The result that is least in something among those that keep all limits, or None.

    Args:
        results: Of a report.
        limits: The most that keys of :data:`COSTS` or :data:`ERRORS` may be.
        least: What is wanted small.
    """

    def keeps(one: Result) -> bool:
        values = {key: error_of(one, key) if key in ERRORS else one.get(key) for key in limits}
        return all(value is not None and value <= limits[key] for key, value in values.items())

    return min((one for one in results if keeps(one)), key=least, default=None)


def at_equal(results: Sequence[Result], key: str, error: str) -> tuple[float, list[Result]]:
    """Of each family the result that is best at one cost, or cheapest at one error.

    The level is the lowest that all families can keep, so that none is missing and none is given
    more than it needs.

    Args:
        results: Of a report.
        key: A cost that all may take, or ``error`` itself.
        error: What is to be small; where ``key`` is the error, bytes are.

    Returns:
        The level, and a result of each family.
    """

    def value(one: Result) -> float:
        found = error_of(one, key) if key in ERRORS else one.get(key)
        return math.inf if found is None else float(found)

    def wanted(one: Result) -> float:
        found = one.get("bytes") if key == error else error_of(one, error)
        return math.inf if found is None else float(found)

    families = dict.fromkeys(str(one["representation"]) for one in results)
    of_family = {name: [r for r in results if r["representation"] == name] for name in families}
    level = max((min(map(value, some)) for some in of_family.values()), default=math.inf)
    best = (within(some, {key: level}, wanted) for some in of_family.values())
    return level, [one for one in best if one is not None]


@dataclass(frozen=True)
class Stage:
    """One approximation of a waterfall.

    Attributes:
        name: What is approximated.
        error: Squared relative error with this stage and all before it.
        difference: From the error without it; may be negative.
        alone: Squared relative error with this stage and no other; None where it cannot be alone.
    """

    name: str
    error: float
    difference: float
    alone: float | None


def waterfall(
    truth: Float[Tensor, "..."],
    together: Mapping[str, Float[Tensor, "..."]],
    alone: Mapping[str, Float[Tensor, "..."]],
) -> list[Stage]:
    """What each approximation adds to the squared relative error.

    Errors are rounded to multiples of a power of two, 2**-48 of the largest, so that in float64 the
    differences add up to the last error exactly, in any order.

    Args:
        truth: Without approximations; radiance, say.
        together: The same with one more approximation in each, in order, by name.
        alone: The same with that approximation only, where there is one.

    Raises:
        ValueError: If there is no stage.
    """
    if not together:
        raise ValueError("expected at least one stage, got none")
    norm = float(truth.double().square().sum()) or 1.0

    def lost(values: Tensor) -> float:
        return float((values.double() - truth.double()).square().sum()) / norm

    errors = [lost(values) for values in together.values()]
    largest = max(errors)
    unit = math.ldexp(1.0, math.frexp(largest)[1] - _GRID_BITS) if largest > 0 else 1.0
    errors = [round(error / unit) * unit for error in errors]
    before = [0.0, *errors[:-1]]
    return [
        Stage(name, now, now - then, lost(alone[name]) if name in alone else None)
        for name, now, then in zip(together, errors, before, strict=True)
    ]
