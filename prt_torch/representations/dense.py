"""The uncompressed tensor on the contract of every representation: what all others are held to.

On request its values are 16-bit codes with a step for each point and row, as Tsai and Shih 2006
(section 5.1) keep transfer in spherical radial basis functions.
"""

from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from prt_torch.bases import SphericalHarmonics, sh_zxzxz
from prt_torch.metric import Metric
from prt_torch.quantize import dequantize, full_scale, quantize, rounded_up
from prt_torch.representations.base import Representation
from prt_torch.representations.products import matmul_few
from prt_torch.transfer import Surface, TransferTensor

_BITS = 16


class DenseTransfer(Representation):
    """Transfer as it was baked, one matrix product a light.

    Args:
        values: ``"points channels rows coeffs"``.
        surface: Bases, frames and reflectance.
        steps: ``"points channels rows 1"`` where a file holds 16-bit codes; ``values``
            are multiples of them.
    """

    kind: ClassVar[str] = "dense"
    steps: Tensor | None

    def __init__(self, values: Tensor, surface: Surface, steps: Tensor | None = None):
        points, channels, rows, coeffs = values.shape
        super().__init__(surface, (points, channels, rows, coeffs))
        self.values = nn.Parameter(values)
        self.register_buffer("steps", steps)

    @classmethod
    def from_transfer(
        cls,
        transfer: TransferTensor,
        *,
        bits: Literal[16] | None = None,
        metric: Metric | None = None,
        generator: torch.Generator | None = None,
    ) -> "DenseTransfer":
        """The tensor itself; every metric and seed give the same.

        Args:
            transfer: The tensor.
            bits: Of a code in a file; None keeps values as they are.
            metric: Not used: nothing is chosen.
            generator: Not used: nothing is random.

        Raises:
            ValueError: If ``bits`` is neither.
        """
        if bits not in (_BITS, None):
            raise ValueError(f"expected {_BITS} bits or None, got {bits!r}")
        values = transfer.dense().clone()
        if bits is None:
            return cls(values, transfer.surface)
        steps = rounded_up(full_scale(values, bits, dim=-1), values.dtype)
        coded = dequantize(quantize(values, steps, bits), steps, values.dtype)
        return cls(coded, transfer.surface, steps)

    def forward(
        self, light: Float[Tensor, "batch *points coeffs rgb"], frames: Tensor | None = None
    ) -> Float[Tensor, "batch points rows rgb"]:
        """Transfer times light, which is turned into the rest pose where the surface is posed.

        Raises:
            ValueError: If shapes do not fit, or ``frames`` are given of transfer that is not in
                spherical harmonics, or of a surface without frames at rest.
        """
        if frames is None:
            return self._lit(light)
        self._check_light(light)
        basis = self._surface.light_basis
        if not isinstance(basis, SphericalHarmonics):
            raise ValueError("dense transfer can be posed in spherical harmonics only")
        poses = [self._lit(_turned_back(some, turns)) for some, turns in self._poses(light, frames)]
        return torch.cat(poses) if len(poses) > 1 else poses[0]

    def _lit(
        self, light: Float[Tensor, "batch *points coeffs rgb"]
    ) -> Float[Tensor, "batch points rows rgb"]:
        """Radiance in the rest pose."""
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
        """The values, or their codes and steps."""
        if self.steps is None:
            return {"values": self.values.detach().clone()}
        return {"codes": quantize(self.values, self.steps, _BITS), "steps": self.steps}

    @classmethod
    def from_packed(
        cls, packed: dict[str, Tensor], surface: Surface, shape: tuple[int, int, int, int]
    ) -> "DenseTransfer":
        """The inverse of :meth:`packed`."""
        if "values" in packed:
            return cls(packed["values"].view(shape), surface)
        steps = packed["steps"]
        values = dequantize(packed["codes"], steps, steps.dtype)
        return cls(values.view(shape), surface, steps)

    @property
    def budget(self) -> dict[str, Any]:
        """Bits, where values are coded."""
        return {} if self.steps is None else {"bits": _BITS}

    @property
    def condition(self) -> float:
        """1: nothing was solved."""
        return 1.0


def _turned_back(
    light: Float[Tensor, "batch *points coeffs rgb"], turns: Float[Tensor, "points 3 3"]
) -> Float[Tensor, "batch points coeffs rgb"]:
    """Light as each point sees it that has been turned."""
    by_point = light if light.ndim == 4 else light[:, None].expand(-1, len(turns), -1, -1)
    back = turns.mT[None, :, None].to(light)
    return sh_zxzxz.rotate(by_point.mT, back.expand(len(light), -1, 3, -1, -1)).mT
