"""Exit bases: how radiance leaves a point."""

from typing import Any

from jaxtyping import Float
from torch import Tensor

from prt_torch.bases.base import ExitBasis


class Diffuse(ExitBasis):
    """The constant: radiance is the same in every direction."""

    @property
    def num_rows(self) -> int:
        """One."""
        return 1

    @property
    def view_dependent(self) -> bool:
        """False."""
        return False

    def evaluate(self, view: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch rows"]:
        """Ones."""
        return view.new_ones(*view.shape[:-1], 1)

    def describe(self) -> dict[str, Any]:
        """``{"name": "diffuse"}``."""
        return {"name": "diffuse"}


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
    def view_dependent(self) -> bool:
        """True: rows are not radiance yet."""
        return True

    def evaluate(self, view: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch rows"]:
        """Raises ValueError: the functions are not known."""
        raise ValueError(
            "rows of a tensor made without an exit basis have no view functions; call the "
            "representation itself, which returns rows"
        )

    def describe(self) -> dict[str, Any]:
        """``{"name": "rows", "num_rows": n}``."""
        return {"name": "rows", "num_rows": self._num_rows}
