r"""Thin translucent membranes: one lobe around the normal, of a transparency that may vary.

A membrane reflects light diffusely on the side that it falls on and lets a share α of as much out
on the other,

.. math:: g(s) = \frac{1}{\pi} \begin{cases} s \cdot n & s \cdot n \ge 0 \\
    -\alpha\, s \cdot n & \text{otherwise,} \end{cases}

whose lobe has a closed form. α = 0 is a diffuse surface without shadows, and at α = 1 both sides
look alike.

*Two sides.* The lobe is that of the side that the normal points to, and whoever looks at the back
sees the membrane with its normal turned over: the same α, light and dark exchanged. A picture
therefore turns frames towards the viewer (:func:`towards_viewer`). At α = 1 it makes no difference.

*Energy.* Light leaves on both sides, so a membrane returns ``reflectance * (1 + α)`` of what falls
on one: a reflectance above ``1 / (1 + α)`` makes energy.

Source:
    Sloan, Luna, Snyder 2005, section 4.2, equations 22 and 23 (their bat: order 3).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases import SphericalHarmonics, zonal
from prt_torch.representations.lobe_texture import LobeTexture
from prt_torch.representations.texture_map import TexelGrid
from prt_torch.representations.zonal_lobes import ZonalLobes
from prt_torch.representations.zonal_lobes_coding import Lobes
from prt_torch.transfer import Surface


def thin_membrane(
    transparency: float | Float[Tensor, "points"],
    frames: Float[Tensor, "points 3 3"],
    *,
    order: int = 3,
    reflectance: Float[Tensor, "points_or_one rgb"] | None = None,
    positions: Float[Tensor, "points 3"] | None = None,
) -> ZonalLobes:
    """A membrane of one lobe a point, along the normals of its frames.

    Args:
        transparency: α, 0 to 1, of all points or of each; that of a map by
            :meth:`~prt_torch.representations.texture_map.TexelGrid.sample`.
        frames: Rows tangent, bitangent and normal at rest. Poses turn the membrane by others.
        order: Bands of light.
        reflectance: Linear RGB that multiplies radiance; ones if not given.
        positions: Where the points are, in mesh units.

    Raises:
        ValueError: If a transparency is out of range, or shapes do not fit.
    """
    alpha = torch.as_tensor(transparency, dtype=frames.dtype, device=frames.device)
    if alpha.ndim > 1 or (alpha.ndim == 1 and len(alpha) != len(frames)):
        raise ValueError(
            f"expected one transparency or {len(frames)}, got shape {tuple(alpha.shape)}"
        )
    surface = Surface(
        light_basis=SphericalHarmonics(order),
        reflectance=torch.ones(1, 3) if reflectance is None else reflectance,
        frames=frames,
        positions=positions,
    )
    return _lobes(alpha.expand(len(frames)), frames[:, 2], surface, order)


def membrane_texture(
    transparency: Float[Tensor, "rows cols"],
    *,
    order: int = 3,
    periodic: tuple[bool, bool] = (False, False),
    reflectance: Float[Tensor, "rows cols rgb"] | None = None,
) -> LobeTexture:
    """A membrane as a texture, its transparency interpolated between texels.

    Args:
        transparency: α of the texels of an image, 0 to 1.
        order: Bands of light.
        periodic: Whether the map repeats along v, and along u.
        reflectance: Linear RGB of the texels; ones if not given.

    Raises:
        ValueError: If a transparency is out of range.
    """
    alpha = transparency.reshape(-1)
    colours = torch.ones(1, 3) if reflectance is None else reflectance.reshape(-1, 3)
    surface = Surface(light_basis=SphericalHarmonics(order), reflectance=colours)
    normals = alpha.new_tensor([0.0, 0.0, 1.0]).expand(len(alpha), 3)
    texels = _lobes(alpha, normals, surface, order)
    rows, cols = transparency.shape
    return LobeTexture(texels, TexelGrid(rows, cols, periodic), interpolate=True)


def towards_viewer(
    frames: Float[Tensor, "*batch points 3 3"], views: Float[Tensor, "*#batch points 3"]
) -> Float[Tensor, "*batch points 3 3"]:
    """Frames turned over about their tangents where the viewer is behind them.

    Args:
        frames: Rows tangent, bitangent and normal.
        views: Directions towards the viewer, of any length.
    """
    behind = (frames[..., 2, :] * views).sum(-1) < 0
    over = frames.new_tensor([1.0, -1.0, -1.0])[:, None] * frames
    return torch.where(behind[..., None, None], over, frames)


def _lobes(
    alpha: Float[Tensor, "points"], axes: Float[Tensor, "points 3"], surface: Surface, order: int
) -> ZonalLobes:
    if not bool(((alpha >= 0) & (alpha <= 1)).all()):
        raise ValueError(
            f"expected transparency in 0..1, got {float(alpha.min()):g} to {float(alpha.max()):g}"
        )
    coefficients = zonal.thin_membrane_coefficients(alpha, order)
    lobes = Lobes(axes[:, None, None], coefficients[:, None, None], axes.new_zeros(len(axes), 1, 0))
    return ZonalLobes(lobes, None, surface, (len(alpha), 1, 1, order * order))
