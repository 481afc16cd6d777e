"""Lobes as integer codes: what a file holds.

An axis is two codes of 16 bits on the octahedral map, 7e-5 rad from the direction at most. The
coefficients of a row of a point share one step with its constant and linear terms, so lobes that
are large against each other at one point cost the others nothing.

Source:
    Ours; Sloan, Luna, Snyder 2005 store floating-point textures.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases import zonal
from prt_torch.quantize import dequantize, full_scale, quantize, rounded_up, straight_through
from prt_torch.representations.octahedron import BITS, from_octahedron, to_octahedron


@dataclass(frozen=True)
class Lobes:
    """The numbers of lobes; rows of three channels come one channel after the other.

    Attributes:
        axes: In the world frame of the rest pose, taken by their directions.
        coefficients: The g* of the last bands.
        linear: Spherical harmonics of bands 0 and 1 that are kept beside lobes; of no elements
            where lobes carry them too.
    """

    axes: Float[Tensor, "points rows lobes 3"]
    coefficients: Float[Tensor, "points rows lobes bands"]
    linear: Float[Tensor, "points rows low"]

    def __getitem__(self, points: slice | Tensor, /) -> "Lobes":
        """Those of some points."""
        return Lobes(self.axes[points], self.coefficients[points], self.linear[points])

    @classmethod
    def names(cls) -> list[str]:
        """Of the three parts."""
        return ["axes", "coefficients", "linear"]

    def steps(self) -> Float[Tensor, "points rows"]:
        """The finest steps that clamp nothing, in the type of the coefficients."""
        values = torch.cat([self.coefficients.detach().flatten(2), self.linear.detach()], dim=2)
        scales = full_scale(values, BITS, dim=2)[..., 0]
        return rounded_up(scales, self.coefficients.dtype)

    def rounded(self, steps: Float[Tensor, "points rows"]) -> "Lobes":
        """The same at what codes stand for."""
        of_lobes, of_linear = steps[..., None, None], steps[..., None]
        dtype = self.coefficients.dtype
        return Lobes(
            on_codes(self.axes),
            dequantize(quantize(self.coefficients, of_lobes, BITS), of_lobes, dtype),
            dequantize(quantize(self.linear, of_linear, BITS), of_linear, dtype),
        )

    def straight_through(self, steps: Float[Tensor, "points rows"]) -> "Lobes":
        """The same values, whose gradients pass as if nothing were rounded."""
        units = zonal.unit_axes(self.axes)
        return Lobes(
            axes=units + (on_codes(units) - units).detach(),
            coefficients=straight_through(self.coefficients, steps[..., None, None], BITS),
            linear=straight_through(self.linear, steps[..., None], BITS),
        )


def on_codes(axes: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Unit axes at the nearest codes; +z for a vector of zero."""
    return from_octahedron(to_octahedron(zonal.unit_axes(axes)), axes.dtype)


def pack(lobes: Lobes, steps: Float[Tensor, "points rows"] | None) -> dict[str, Tensor]:
    """What a file holds.

    Either ``axes``, ``coefficients`` and ``linear`` as they are, or ``axis_codes``,
    ``coefficient_codes``, ``linear_codes`` and ``steps``.
    """
    if steps is None:
        return {name: getattr(lobes, name).detach().clone() for name in Lobes.names()}
    return {
        "axis_codes": to_octahedron(zonal.unit_axes(lobes.axes)),
        "coefficient_codes": quantize(lobes.coefficients, steps[..., None, None], BITS),
        "linear_codes": quantize(lobes.linear, steps[..., None], BITS),
        "steps": steps.clone(),
    }


def unpack(packed: dict[str, Tensor]) -> tuple[Lobes, Float[Tensor, "points rows"] | None]:
    """The inverse of :func:`pack`."""
    if "axes" in packed:
        return Lobes(**{name: packed[name] for name in Lobes.names()}), None
    steps = packed["steps"]
    lobes = Lobes(
        axes=from_octahedron(packed["axis_codes"], steps.dtype),
        coefficients=dequantize(packed["coefficient_codes"], steps[..., None, None], steps.dtype),
        linear=dequantize(packed["linear_codes"], steps[..., None], steps.dtype),
    )
    return lobes, steps
