"""The linear solves of a run: how stiff each is, how it ended, and what that costs.

A condition number says how much errors of the data may grow, so its decimal logarithm is how many
digits of the type that is computed in may be lost. A solve is *stiff* from 1e8 on, where half of
those of float64 are at stake. Two kinds of condition stand side by side: of Gram matrices, which is
the square of that of their functions, and of closed forms, which is a ratio of singular values.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases import SRBF
from prt_torch.bases.srbf import WORST_CONDITION
from prt_torch.metric import Metric
from prt_torch.representations import Representation
from prt_torch.transfer import TransferTensor

STIFF = 1e8
"""Condition from which on a solve is warned of."""


@dataclass(frozen=True)
class Fitted:
    """One result: a representation and how it came about.

    Attributes:
        name: Unique in a run.
        representation: At its best state.
        status: How its fit ended (:class:`~prt_torch.fitting.FitResult`).
        seconds: Time of construction and refinement.
        condition: Of its construction.
        construction: ``closed_form`` or ``rank_deficient``.
    """

    name: str
    representation: Representation
    status: str
    seconds: float
    condition: float
    construction: str = "closed_form"


@dataclass(frozen=True)
class Solve:
    """One solve.

    Attributes:
        what: Such as ``cpca 128x4: closed form``.
        status: ``solved``, ``regularised`` (nearly singular, so something was added that bounds
            its condition) or how a fit ended.
        condition: Infinite where singular, NaN where not known.
        dtype: What it was computed in.
    """

    what: str
    status: str
    condition: float
    dtype: torch.dtype = torch.float64

    @property
    def digits(self) -> float:
        """Decimal digits of its type."""
        return -math.log10(torch.finfo(self.dtype).eps)

    @property
    def digits_lost(self) -> float:
        """How many of them the condition may cost; NaN where it is not known."""
        if math.isnan(self.condition):
            return math.nan
        return min(math.log10(max(self.condition, 1.0)), self.digits)

    @property
    def warning(self) -> str | None:
        """What a stiff solve costs, in a line; None for others."""
        if not self.condition >= STIFF:
            return None
        return (
            f"stiff: {self.what}: condition {self.condition:.1e} may cost {self.digits_lost:.1f} "
            f"of the {self.digits:.1f} digits of {str(self.dtype).removeprefix('torch.')}"
        )

    def entry(self) -> dict[str, Any]:
        """For report.json, which has neither infinity nor NaN: both are null."""
        known = {"condition": self.condition, "digits_lost": self.digits_lost}
        return {
            "what": self.what,
            "status": self.status,
            **{name: value if math.isfinite(value) else None for name, value in known.items()},
            "dtype": str(self.dtype).removeprefix("torch."),
            "warning": self.warning,
        }


def solves(transfer: TransferTensor, metric: Metric, fitted: Sequence[Fitted]) -> list[Solve]:
    """Every solve of a run, those that all results share first.

    Args:
        transfer: What was fitted.
        metric: What errors were worth.
        fitted: The results.
    """
    exit_basis, light_basis = transfer.surface.exit_basis, transfer.surface.light_basis
    found = []
    if exit_basis.num_rows > 1:
        gram = exit_basis.gram()
        singular = int(torch.linalg.cholesky_ex(gram).info) > 0
        found.append(Solve("exit basis: Gram matrix", _ended(singular), _condition(gram)))
    if isinstance(light_basis, SRBF):
        bounded = light_basis.condition > WORST_CONDITION
        found.append(Solve("light basis: projection", _ended(bounded), light_basis.condition))
    if isinstance(metric.light, Tensor):
        found.append(Solve("light prior", "solved", _condition(metric.light @ metric.light.mT)))
    for one in fitted:
        found.append(Solve(f"{one.name}: closed form", one.construction, one.condition))
        if one.status != one.construction:
            dtype = next(one.representation.parameters()).dtype
            found.append(Solve(f"{one.name}: refinement", one.status, math.nan, dtype))
    return found


def _ended(regularised: bool) -> str:
    return "regularised" if regularised else "solved"


def _condition(gram: Float[Tensor, "n n"]) -> float:
    """Largest over smallest eigenvalue; infinite where rounding leaves none above zero."""
    ascending = torch.linalg.eigvalsh(gram).tolist()
    smallest, largest = ascending[0], ascending[-1]
    return largest / smallest if smallest > 0.0 else math.inf
