"""Exit bases: how radiance leaves a point."""

import math
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.bases import sh
from prt_torch.bases.base import ExitBasis
from prt_torch.bases.tables import kept
from prt_torch.sphere import to_horizon

_MAX_HEMISPHERICAL = 64  # order 8: condition 3.5e9, still within float64


class Diffuse(ExitBasis):
    """The constant: radiance is the same in every direction."""

    @property
    def num_rows(self) -> int:
        """One."""
        return 1

    @property
    def num_channels(self) -> int:
        """One."""
        return 1

    @property
    def view_dependent(self) -> bool:
        """False."""
        return False

    def evaluate(self, view: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch rows"]:
        """Ones."""
        return view.new_ones(*view.shape[:-1], 1)

    def constants(self) -> Float[Tensor, "colours rows"]:
        """One."""
        return torch.ones(1, 1, dtype=torch.float64)

    def gram(self) -> Float[Tensor, "rows rows"]:
        """One."""
        return torch.ones(1, 1, dtype=torch.float64)

    def describe(self) -> dict[str, Any]:
        """``{"name": "diffuse"}``."""
        return {"name": "diffuse"}

    def tensors(self) -> dict[str, Tensor]:
        """None."""
        return {}


class HemisphericalHarmonics(ExitBasis):
    """Spherical harmonics restricted to the upper hemisphere, where they are not orthogonal.

    The order is the least that has enough functions. Where it has too many, those go that the
    others replace best, one by one: at order 5 this is y_(1,0), which the other 24 replace with a
    squared error of 1.48e-5, and the condition of the rest falls from 1.5e5 to 3.2e3.

    Views below the horizon, which interpolated frames can give at silhouettes, are taken to the
    horizon: outside its hemisphere a least-squares fit means nothing and can be large.

    Args:
        num_rows: How many functions, 1 to 64.

    Raises:
        ValueError: If ``num_rows`` is out of range.

    Source:
        Sloan et al. 2003, section 6.1 and appendix 9.1.
    """

    def __init__(self, num_rows: int = 24):
        if not 1 <= num_rows <= _MAX_HEMISPHERICAL:
            raise ValueError(f"expected 1 to {_MAX_HEMISPHERICAL} rows, got {num_rows}")
        self.order = math.isqrt(num_rows - 1) + 1
        self.indices = _best_functions(self.order, num_rows)

    @property
    def num_rows(self) -> int:
        """As given."""
        return len(self.indices)

    @property
    def num_channels(self) -> int:
        """One."""
        return 1

    @property
    def view_dependent(self) -> bool:
        """True, but for the constant alone."""
        return self.num_rows > 1

    def evaluate(self, view: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch rows"]:
        """The harmonics at the views, each taken to the horizon if below it."""
        return sh.evaluate(to_horizon(view), self.order)[..., self.indices.to(view.device)]

    def constants(self) -> Float[Tensor, "colours rows"]:
        """The first function, which is the constant y_(0,0), over its value."""
        rows = torch.zeros(1, self.num_rows, dtype=torch.float64)
        rows[0, 0] = math.sqrt(4.0 * math.pi)
        return rows

    def gram(self) -> Float[Tensor, "rows rows"]:
        """The hemispherical Gram matrix over 2π."""
        whole = sh.hemisphere_gram(self.order) / (2.0 * math.pi)
        return whole[self.indices][:, self.indices]

    def describe(self) -> dict[str, Any]:
        """``{"name": "hemispherical", "num_rows": n}``."""
        return {"name": "hemispherical", "num_rows": self.num_rows}

    def tensors(self) -> dict[str, Tensor]:
        """None."""
        return {}


@kept
def _best_functions(order: int, num_rows: int) -> Int[Tensor, "rows"]:
    """Indices of the harmonics that are left when the best replaced ones are dropped.

    Function k is a combination of the others with a squared error of 1 / (A⁻¹)_kk.
    """
    gram = sh.hemisphere_gram(order)
    kept = torch.arange(order * order)
    while len(kept) > num_rows:
        losses = 1.0 / torch.linalg.inv(gram[kept][:, kept]).diagonal()
        kept = kept[torch.arange(len(kept)) != losses[1:].argmin() + 1]  # the constant stays
    return kept


class Rowwise(ExitBasis):
    """Rows whose view functions are not known: those of a tensor given without an exit basis.

    Relight such a tensor through its representation, which returns rows.

    Args:
        num_rows: As given.
    """

    def __init__(self, num_rows: int):
        self._num_rows = num_rows

    @property
    def num_rows(self) -> int:
        """As given."""
        return self._num_rows

    @property
    def num_channels(self) -> int:
        """One."""
        return 1

    @property
    def view_dependent(self) -> bool:
        """True: rows are not radiance yet."""
        return True

    def constants(self) -> Float[Tensor, "colours rows"]:
        """None: the functions are not known."""
        return torch.zeros(0, self._num_rows, dtype=torch.float64)

    def gram(self) -> Float[Tensor, "rows rows"]:
        """The identity: rows count alike."""
        return torch.eye(self._num_rows, dtype=torch.float64)

    def evaluate(self, view: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch rows"]:
        """Raises ValueError: the functions are not known."""
        raise ValueError(
            "rows of a tensor made without an exit basis have no view functions; call the "
            "representation itself, which returns rows"
        )

    def describe(self) -> dict[str, Any]:
        """``{"name": "rows", "num_rows": n}``."""
        return {"name": "rows", "num_rows": self._num_rows}

    def tensors(self) -> dict[str, Tensor]:
        """None."""
        return {}
