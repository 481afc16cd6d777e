"""Directions on the sphere, cube texels with exact solid angles, and local frames.

Everything is computed in float64 and cast at the end. Conventions are stated in
:mod:`prt_torch.conventions`.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.conventions import CUBE_FACES


def _texel_centres(resolution: int) -> Float[Tensor, "n"]:
    """Texel centres in (-1, 1)."""
    if resolution < 1:
        raise ValueError(f"expected a cube resolution of at least 1, got {resolution}")
    return (torch.arange(resolution, dtype=torch.float64) + 0.5) * (2.0 / resolution) - 1.0


def cubemap_directions(
    resolution: int, *, dtype: torch.dtype = torch.float32
) -> Float[Tensor, "6 row col 3"]:
    """Unit directions through the centres of cube-map texels.

    Args:
        resolution: Texels along an edge of a face, at least 1.
        dtype: Floating-point type of the result; computed in float64.

    Raises:
        ValueError: If ``resolution < 1``.
    """
    u = _texel_centres(resolution)
    faces = CUBE_FACES[:, None, None]
    directions = faces[..., 0, :] + u[:, None] * faces[..., 1, :]
    directions = directions + u[:, None, None] * faces[..., 2, :]
    return (directions / directions.norm(dim=-1, keepdim=True)).to(dtype)


def cubemap_solid_angles(
    resolution: int, *, dtype: torch.dtype = torch.float32
) -> Float[Tensor, "6 row col"]:
    r"""Exact solid angles of cube-map texels [sr]; they sum to 4π.

    .. math:: d\omega = \Delta^2 \operatorname{atan2}\bigl(xy, \sqrt{1 + x^2 + y^2}\bigr)

    over the corners of a texel.

    Raises:
        ValueError: If ``resolution < 1``.
    """
    if resolution < 1:
        raise ValueError(f"expected a cube resolution of at least 1, got {resolution}")
    edge = torch.linspace(-1.0, 1.0, resolution + 1, dtype=torch.float64)
    x, y = edge[None, :], edge[:, None]
    corner = torch.atan2(x * y, torch.sqrt(1.0 + x * x + y * y))
    face = corner.diff(dim=0).diff(dim=1)
    return face.expand(6, resolution, resolution).to(dtype).contiguous()


def cubemap_index(directions: Float[Tensor, "*batch 3"], resolution: int) -> Int[Tensor, "*batch"]:
    """Flat index (``"6 row col"`` order) of the texel that each direction falls in."""
    magnitude = directions.abs()
    axis = magnitude.argmax(dim=-1)
    major = directions.gather(-1, axis[..., None])[..., 0]
    face = 2 * axis + (major < 0)
    axes = CUBE_FACES.to(directions)[face]
    scaled = directions / major.abs()[..., None]
    u = (scaled * axes[..., 1, :]).sum(-1)
    v = (scaled * axes[..., 2, :]).sum(-1)
    col = ((u + 1) * (resolution / 2)).long().clamp(0, resolution - 1)
    row = ((v + 1) * (resolution / 2)).long().clamp(0, resolution - 1)
    return (face * resolution + row) * resolution + col


def frame_from_normal(normal: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    r"""Rotation matrices (rows tangent, bitangent, normal) from unit normals.

    With :math:`n = (x, y, z)` the tangent is
    :math:`(1 - x^2/(1+y),\; -x,\; -xz/(1+y))` and the bitangent :math:`n \times t`. It is smooth
    everywhere but at :math:`n = (0, -1, 0)`, where the tangent is defined as +x, and so near to it
    (3e-10 in float32, 1e-77 in float64) that slopes would overflow. Below the equator
    :math:`1/(1+y)` is evaluated as :math:`(1-y)/(x^2+z^2)`, which loses no digits.

    Gradients are finite everywhere, the pole included.

    Source:
        Wang, Tran, Luebke 2004, section 3.3 (the same frame, written without cancellation).
    """
    x, y, z = normal.unbind(-1)
    equatorial = x * x + z * z
    # Slopes divide by the square of this, which must not underflow.
    pole = (y < 0) & (equatorial < math.sqrt(torch.finfo(normal.dtype).tiny))
    below = (1 - y) / torch.where(pole | (y >= 0), torch.ones_like(equatorial), equatorial)
    above = 1 / (1 + torch.where(y < 0, torch.zeros_like(y), y))
    scale = torch.where(y < 0, below, above)
    tangent = torch.stack([1 - x * x * scale, -x, -x * z * scale], dim=-1)
    bitangent = torch.linalg.cross(normal, tangent)
    return torch.stack([tangent, bitangent, normal], dim=-2)


def to_horizon(directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Unit directions below the horizon z = 0 are taken to it; the others stay as they are.

    Straight down goes to +x. Gradients are finite everywhere.
    """
    x, y, z = directions.unbind(-1)
    below = z < 0
    squared = x * x + y * y
    straight_down = below & (squared == 0)
    length = torch.where(below & ~straight_down, squared, 1.0).sqrt()
    level = [torch.where(straight_down, 1.0, x / length), y / length, torch.zeros_like(z)]
    return torch.where(below[..., None], torch.stack(level, -1), directions)


def rotation_about_up(degrees: float) -> Float[Tensor, "3 3"]:
    """Rotation about +y, counter-clockwise seen from above: +x turns towards -z. Float64."""
    angle = math.radians(degrees)
    sine, cosine = math.sin(angle), math.cos(angle)
    return torch.tensor(
        [[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]], dtype=torch.float64
    )
