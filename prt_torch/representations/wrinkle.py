"""Wrinkles: a texture of lobes over the place across a groove and the groove's depth.

A wrinkle has no baked patch: where it runs over a surface and how deep it is may change from frame
to frame. So the map's coordinates are the place across the groove and its depth, and each place of
the surface looks up what it is there. All lobes of the map are fitted together
(:mod:`prt_torch.representations.lobe_map_fit`) to a groove's transfer in closed form
(:mod:`prt_torch.baking.groove`), and everything is interpolated.

Three lobes begin along the axis of the linear band and to both sides of it, across the groove, at
one angle for the whole map: the one of a few that a short descent makes most of. The angle of least
error before any descent is the smallest, where lobes all but coincide and stay so.

Source:
    Sloan, Luna, Snyder 2005, section 4.2, where each texel has an angle of its own.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from prt_torch.baking.groove import groove_transfer
from prt_torch.bases import SphericalHarmonics, zonal
from prt_torch.representations.lobe_map_fit import LINEAR_BANDS, MapFit, fit_map
from prt_torch.representations.lobe_texture import LobeTexture
from prt_torch.representations.texture_map import TexelGrid
from prt_torch.representations.zonal_lobes import ZonalLobes
from prt_torch.transfer import Surface

_ANGLES = (25.0, 40.0, 60.0)  # between the middle lobe and the others, in degrees
_SHORT = 40  # steps by which angles are compared
_DENSER = 2  # places of the simulation to a texel, along each axis


@dataclass(frozen=True)
class WrinkleMap:
    """Where places across a groove and depths lie on a map.

    The first and the last texel are at the rims of the groove, and at no depth and the greatest:
    beyond, the last texels go on.

    Attributes:
        max_depth: In widths of the groove.
        shape: Texels along the depth and across the groove, at least 2.

    Raises:
        ValueError: If the depth is not positive, or there are too few texels.
    """

    max_depth: float = 0.5
    shape: tuple[int, int] = (32, 32)

    def __post_init__(self) -> None:
        if not (self.max_depth > 0 and math.isfinite(self.max_depth)) or min(self.shape) < 2:
            raise ValueError(
                f"expected a depth above 0 and at least 2 x 2 texels, got {self.max_depth} and "
                f"{self.shape}"
            )

    @property
    def grid(self) -> TexelGrid:
        """The texels, which do not repeat."""
        return TexelGrid(*self.shape, (False, False))

    def uv(
        self, across: Float[Tensor, "points"], depth: Float[Tensor, "points"]
    ) -> Float[Tensor, "points 2"]:
        """Texture coordinates, differentiable.

        Args:
            across: From the middle of the groove to a rim at 0.5, along the tangent, in widths.
            depth: Of the groove, in widths.
        """
        rows, cols = self.shape
        col = (across + 0.5) * (cols - 1)
        row = depth / self.max_depth * (rows - 1)
        return torch.stack([(col + 0.5) / cols, 1.0 - (row + 0.5) / rows], dim=-1)

    def places(self, per_texel: int) -> tuple[Float64[Tensor, "places"], Float64[Tensor, "places"]]:
        """Places across and depths of a regular grid, so many steps from texel to texel."""
        rows, cols = (per_texel * (count - 1) + 1 for count in self.shape)
        depth = torch.linspace(0.0, self.max_depth, rows, dtype=torch.float64)
        across = torch.linspace(-0.5, 0.5, cols, dtype=torch.float64)
        return across.repeat(rows), depth.repeat_interleave(cols)


def wrinkle_texture(
    wrinkles: WrinkleMap, *, order: int = 6, max_steps: int = 300
) -> tuple[LobeTexture, MapFit]:
    """Simulate a groove at all its depths and fit three corresponding lobes over the map.

    Args:
        wrinkles: The map.
        order: Bands of light, at least 3.
        max_steps: Of the descent.

    Returns:
        The texture, whose tangent is across the groove, and how well it fits between its texels
        as well as at them.

    Raises:
        ValueError: If the order is below 3.
    """
    if order <= LINEAR_BANDS:
        raise ValueError(f"expected at least 3 bands for lobes of a wrinkle, got {order}")
    across, depth = wrinkles.places(_DENSER)
    signals, uv = groove_transfer(across, depth, order), wrinkles.uv(across, depth)
    texels = groove_transfer(*wrinkles.places(1), order)
    tried = []
    for angle in _ANGLES:
        start = _symmetric(texels, math.radians(angle))
        tried.append(fit_map(signals, uv, wrinkles.grid, *start, max_steps=_SHORT))
    lobes = min(tried, key=lambda fit: fit.error).lobes
    begun = lobes.axes[:, 0], lobes.coefficients[:, 0]
    found = fit_map(signals, uv, wrinkles.grid, *begun, max_steps=max_steps)
    surface = Surface(light_basis=SphericalHarmonics(order))
    model = ZonalLobes(found.lobes, None, surface, (len(texels), 1, 1, order**2))
    return LobeTexture(model.float(), wrinkles.grid, interpolate=True), found


def _symmetric(
    signals: Float64[Tensor, "texels coeffs"], angle: float
) -> tuple[Float64[Tensor, "texels 3 3"], Float64[Tensor, "texels 3 bands"]]:
    """A lobe along the linear band, two beside it across the groove, and their coefficients."""
    middle = zonal.optimal_linear_axis(signals)
    along = middle.new_tensor([0.0, 1.0, 0.0]).expand_as(middle)
    side = math.sin(angle) * torch.linalg.cross(along, middle)
    axes = torch.stack(
        [middle, math.cos(angle) * middle + side, math.cos(angle) * middle - side], 1
    )
    return axes, zonal.fit_coefficients(signals, axes, 1e-6)[..., LINEAR_BANDS:]
