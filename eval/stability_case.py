"""What a case of the stability suite is: an input, what is required of it, and what was measured.

A case is a function of an element type. It returns numbers beside their limits, never a verdict,
so that a report can show how far from red a green row is. A number that is NaN is beyond any limit.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

DTYPES = (torch.float32, torch.float64)


@dataclass(frozen=True)
class Check:
    """One number and where it must lie.

    Attributes:
        what: What was measured, such as ``relative error``.
        value: What it came to.
        least: Smallest value allowed.
        most: Largest value allowed.
    """

    what: str
    value: float
    least: float = -math.inf
    most: float = math.inf

    @property
    def passed(self) -> bool:
        """Whether the number is finite and within its limits."""
        return math.isfinite(self.value) and self.least <= self.value <= self.most

    @property
    def strain(self) -> float:
        """How much of what is allowed was used: 1 at a limit, infinite beyond it."""
        if not self.passed:
            return math.inf
        if self.least == self.most:
            return 0.0
        if self.least == -math.inf:
            return self.value / self.most if self.most else 0.0
        if self.most == math.inf:
            return self.least / self.value if self.value else 0.0
        return abs(2.0 * self.value - self.least - self.most) / (self.most - self.least)

    @property
    def text(self) -> str:
        """Number and limits in words."""
        digits = 3
        if self.least == self.most:
            limits = f"must be {number_text(self.least)}"
        elif self.least == -math.inf:
            limits = f"at most {number_text(self.most)}"
        elif self.most == math.inf:
            limits = f"at least {number_text(self.least)}"
        else:
            digits = 9  # limits may be close
            limits = f"{number_text(self.least, digits)} to {number_text(self.most, digits)}"
        return f"{self.what} {number_text(self.value, digits)} ({limits})"


@dataclass(frozen=True)
class Outcome:
    """What a case gave in one element type.

    Attributes:
        checks: All must pass.
        condition: Condition number of the problem, where that means something; may be infinite.
        note: What else is worth knowing, such as how fits ended or what a naive form would give.
    """

    checks: tuple[Check, ...]
    condition: float | None = None
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether there is a check, and all pass."""
        return bool(self.checks) and all(check.passed for check in self.checks)


@dataclass(frozen=True)
class Case:
    """A row of the suite.

    Attributes:
        name: What ``--only`` calls it.
        source: Which table asks for it.
        given: The input.
        required: What a sound implementation returns.
        seconds: Time limit for both element types together.
        measure: The function; it takes the element type and, if ``seeded``, how many seeds.
        seeded: Whether it runs over seeds.
    """

    name: str
    source: str
    given: str
    required: str
    seconds: float
    measure: Callable[..., Outcome]
    seeded: bool = False


Measure = Callable[..., Outcome]


class Collection:
    """Cases of one theme, in the order of their definition."""

    def __init__(self, source: str):
        self.source = source
        self.cases: list[Case] = []

    def case(
        self, name: str, *, given: str, required: str, seconds: float = 60.0, seeded: bool = False
    ) -> Callable[[Measure], Measure]:
        """Enter the decorated function as a case."""

        def enter(measure: Measure) -> Measure:
            self.cases.append(Case(name, self.source, given, required, seconds, measure, seeded))
            return measure

        return enter


def at_most(what: str, value: float | Tensor, limit: float) -> Check:
    """A number that must not be larger."""
    return Check(what, _number(value), most=limit)


def at_least(what: str, value: float | Tensor, limit: float) -> Check:
    """A number that must not be smaller."""
    return Check(what, _number(value), least=limit)


def exactly(what: str, value: float | Tensor, expected: float) -> Check:
    """A number that must be this one."""
    return Check(what, _number(value), expected, expected)


def near(what: str, value: float | Tensor, expected: float, relative: float) -> Check:
    """A number that must be this one but for a relative difference."""
    slack = abs(expected) * relative
    return Check(what, _number(value), expected - slack, expected + slack)


def _number(value: float | Tensor) -> float:
    return float(value.detach()) if isinstance(value, Tensor) else float(value)


def rounding(dtype: torch.dtype) -> float:
    """Spacing of numbers of this type at 1."""
    return torch.finfo(dtype).eps


def relative_error(found: Tensor, expected: Tensor) -> float:
    """L2 norm of the difference over that of what was expected, in float64; absolute if zero."""
    expected = expected.detach().double()
    norm = float(torch.linalg.vector_norm(expected)) or 1.0
    return float(torch.linalg.vector_norm(found.detach().double() - expected)) / norm


def not_finite(tensors: Iterable[Tensor]) -> int:
    """How many numbers are NaN or infinite."""
    return sum(int((~torch.isfinite(tensor.detach())).sum()) for tensor in tensors)


def tally(statuses: Counter[str]) -> str:
    """How often each occurred, in words."""
    return ", ".join(f"{status} {count}" for status, count in sorted(statuses.items()))


def number_text(value: float, digits: int = 3) -> str:
    """Whole numbers as they are, others to some digits."""
    if math.isfinite(value) and value == round(value) and abs(value) < 1e6:
        return str(round(value))
    return f"{value:.{digits}g}"
