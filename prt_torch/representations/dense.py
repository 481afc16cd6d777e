"""The uncompressed tensor on the contract of every representation: what all others are held to."""

from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from prt_torch.metric import Metric
from prt_torch.representations.base import Representation
from prt_torch.representations.products import matmul_few
from prt_torch.transfer import Surface, TransferTensor


class DenseTransfer(Representation):
    """Transfer as it was baked, one matrix product a light.

    Args:
        values: ``"points channels rows coeffs"``.
        surface: Bases, frames and reflectance.
    """

    kind: ClassVar[str] = "dense"

    def __init__(self, values: Tensor, surface: Surface):
        points, channels, rows, coeffs = values.shape
        super().__init__(surface, (points, channels, rows, coeffs))
        self.values = nn.Parameter(values)

    @classmethod
    def from_transfer(
        cls,
        transfer: TransferTensor,
        *,
        metric: Metric | None = None,
        generator: torch.Generator | None = None,
    ) -> "DenseTransfer":
        """The tensor itself; every metric and seed give the same."""
        return cls(transfer.dense().clone(), transfer.surface)

    def forward(
        self, light: Float[Tensor, "batch *points coeffs rgb"], frames: Tensor | None = None
    ) -> Float[Tensor, "batch points rows rgb"]:
        """Transfer times light.

        Raises:
            ValueError: If shapes do not fit, or ``frames`` are given.
        """
        if frames is not None:
            raise ValueError("dense transfer is fixed to the rest pose and cannot be posed")
        if self._check_light(light):
            equation = "pcri,bpic->bprc" if self.num_channels == 3 else "pzri,bpic->bprc"
            return torch.einsum(equation, self.values, light)
        if self.num_channels == 3:
            return torch.einsum("pcri,bic->bprc", self.values, light)
        matrix = self.values.view(-1, self.num_coeffs)
        lit = matmul_few(matrix, light.permute(1, 2, 0).reshape(self.num_coeffs, -1))
        return lit.view(self.num_points, self.num_rows, 3, -1).permute(3, 0, 1, 2)

    def dense(self, points: Tensor | None = None) -> Float[Tensor, "points channels rows coeffs"]:
        """The values."""
        return self.values if points is None else self.values[points]

    def packed(self) -> dict[str, Tensor]:
        """The values."""
        return {"values": self.values.detach().clone()}

    @classmethod
    def from_packed(
        cls, packed: dict[str, Tensor], surface: Surface, shape: tuple[int, int, int, int]
    ) -> "DenseTransfer":
        """The inverse of :meth:`packed`."""
        return cls(packed["values"].view(shape), surface)

    @property
    def budget(self) -> dict[str, Any]:
        """Nothing to choose."""
        return {}

    @property
    def condition(self) -> float:
        """1: nothing was solved."""
        return 1.0
