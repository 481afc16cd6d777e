"""Patches: one tile of a surface that repeats, made of formulas or of a map of heights.

A patch covers one period, a unit square: u along +x, v along -z, and up is +y, so its tangent,
bitangent and normal are the rows of :data:`PATCH_FRAME`. It has a point for each texel of a map,
and the map is an image: row 0 at the top, where v is 1, and texel centres half a texel from the
border. The tile goes from the first texel centre to that of the next tile, so it has a row and a
column of points more than the map, and repeats without a seam in its normals.

What is between the points may be no function of u and v: walls may lean over, and a slab has an
underside. Only a texel's own point has to be given.

Source:
    Sloan, Luna, Snyder 2005, section 6: patches from meshes (waffle, bumps) and from images taken
    as heights (weave).
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from prt_torch.assets.mesh import Mesh, concatenate, mesh_from_arrays
from prt_torch.assets.procedural import grid_faces
from prt_torch.errors import InputError

PATCH_FRAME = torch.tensor(
    [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64
)
"""Tangent (u), bitangent (v) and normal of a patch, in world coordinates."""

_THREAD = 0.8  # width of a thread, as a share of its lane
_UNDERSIDE = 8  # cells along an edge: what falls on it from below varies slowly


@dataclass(frozen=True, eq=False)
class Patch:
    """One tile of a periodic surface.

    Attributes:
        mesh: The tile; moved by 1 along x or z it continues itself.
        texels: The point of the mesh that each texel of a map stands for.
    """

    mesh: Mesh
    texels: Int64[Tensor, "rows cols"]


def texel_centres(rows: int, cols: int) -> Float64[Tensor, "rows cols 2"]:
    """Texture coordinates (u, v) of the centres of texels; row 0 is at the top, v near 1."""
    v = 1.0 - (torch.arange(rows, dtype=torch.float64) + 0.5) / rows
    u = (torch.arange(cols, dtype=torch.float64) + 0.5) / cols
    return torch.stack(torch.broadcast_tensors(u, v[:, None]), dim=-1)


def _continued(values: Float[Tensor, "rows cols 3"], before: int) -> Tensor:
    """Positions with ``before`` rows and columns ahead of the tile and one more behind it."""
    rows, cols = values.shape[:2]
    row = torch.arange(-before, rows + 1 + before)
    col = torch.arange(-before, cols + 1 + before)
    continued = values[row % rows][:, col % cols].clone()
    continued[..., 2] += torch.div(row, rows, rounding_mode="floor")[:, None]
    continued[..., 0] += torch.div(col, cols, rounding_mode="floor")
    return continued


def grid_patch(
    name: str,
    positions: Float[Tensor, "rows cols 3"],
    *,
    albedo: Float[Tensor, "rows cols 3"] | None = None,
) -> Patch:
    """A patch from the points of its texels, which may lie anywhere.

    Args:
        name: What messages and reports call it.
        positions: Of the texels of an image, row 0 at v near 1, in units of the tile's edge.
            Their x grows with the column and their z with the row on the whole; they go on with
            the same points moved by 1.
        albedo: Linear RGB in [0, 1]; that of a mesh by default.

    Raises:
        InputError: If the map is smaller than 2 x 2, a number is not finite, or an albedo is out
            of range.
    """
    rows, cols = positions.shape[:2]
    if min(rows, cols) < 2:
        raise InputError(f"{name}: expected a patch of at least 2 x 2 texels, got {rows} x {cols}")
    points = positions.detach().double()
    # With its neighbours round it, normals at the border are those inside a periodic surface.
    padded = _continued(points, 1)
    whole = mesh_from_arrays(name, padded.reshape(-1, 3), grid_faces(rows + 3, cols + 3))
    normals = whole.normals.view(rows + 3, cols + 3, 3)[1:-1, 1:-1]
    wrapped = torch.arange(rows + 1) % rows, torch.arange(cols + 1) % cols
    colours = None if albedo is None else albedo.double()[wrapped[0]][:, wrapped[1]]
    mesh = mesh_from_arrays(
        name,
        _continued(points, 0).reshape(-1, 3),
        grid_faces(rows + 1, cols + 1),
        normals=normals.reshape(-1, 3),
        albedo=None if colours is None else colours.reshape(-1, 3),
    )
    texels = torch.arange((rows + 1) * (cols + 1)).view(rows + 1, cols + 1)[:-1, :-1]
    # Its border is meant to be open.
    return Patch(replace(mesh, warnings=()), texels)


def height_field(
    heights: Float[Tensor, "rows cols"],
    *,
    name: str = "height_field",
    albedo: Float[Tensor, "rows cols 3"] | None = None,
) -> Patch:
    """A patch from a periodic map of heights.

    Args:
        heights: Of the texels of an image, row 0 at v near 1, in units of the tile's edge.
        name: What messages and reports call it.
        albedo: Linear RGB in [0, 1]; that of a mesh by default.

    Raises:
        InputError: As :func:`grid_patch`.
    """
    uv = texel_centres(*heights.shape)
    points = torch.stack([uv[..., 0], heights.detach().double().cpu(), -uv[..., 1]], dim=-1)
    return grid_patch(name, points, albedo=albedo)


def bumps(resolution: int = 32, *, height: float = 0.12, count: int = 2) -> Patch:
    """Round bumps on a plane, ``count`` along an edge, every second row shifted by half.

    Args:
        resolution: Texels along an edge.
        height: Of a bump, in edges of the tile.
        count: Along an edge; even, so that the shifted rows repeat.

    Raises:
        InputError: If ``count`` is not even and positive, or the resolution is below 2.
    """
    if count < 2 or count % 2:
        raise InputError(f"bumps.count={count}: expected an even number of at least 2")
    u, v = texel_centres(resolution, resolution).unbind(-1)
    row = torch.floor(v * count)
    across = torch.remainder(u * count + 0.5 * torch.remainder(row, 2.0), 1.0) - 0.5
    along = v * count - row - 0.5
    # A smooth profile with a rim, 0.45 of the spacing in radius.
    inside = (1.0 - (across.square() + along.square()) / 0.45**2).clamp_min(0.0)
    return height_field(height * inside.sqrt() * (2.0 - inside.sqrt()), name="bumps")


def weave(resolution: int = 64, *, height: float = 0.08, count: int = 4) -> Patch:
    """A plain weave: threads along u and along v that cross over and under each other.

    Args:
        resolution: Texels along an edge.
        height: Between the lowest and the highest point of a thread's middle, in edges of the tile.
        count: Threads of each kind along an edge; even, so that over and under repeat.

    Raises:
        InputError: If ``count`` is not even and positive, or the resolution is below 2.
    """
    if count < 2 or count % 2:
        raise InputError(f"weave.count={count}: expected an even number of at least 2")
    uv = texel_centres(resolution, resolution) * count
    lane = torch.floor(uv)
    off = 2.0 * (uv - lane) - 1.0  # from the middle of a thread, -1 to 1
    inside = off.abs() < _THREAD
    section = 0.8 * (1.0 - (off / _THREAD).square()).clamp_min(0.0).sqrt()
    # A thread along u lies in a lane of v, and is over (1) where the other is under (-1).
    wave = torch.cos(math.pi * (uv - 0.5)) * (1.0 - 2.0 * torch.remainder(lane.flip(-1), 2.0))
    middles = torch.stack([wave[..., 0], -wave[..., 1]], dim=-1)
    threads = torch.where(inside.flip(-1), middles + section.flip(-1), -1.0)
    tops = threads.amax(dim=-1)
    return height_field(0.5 * height * tops, name="weave")


def waffle(
    resolution: int = 48,
    *,
    count: int = 2,
    thickness: float = 0.04,
    height: float = 0.16,
    wall: float = 0.22,
) -> Patch:
    """A slab with a lattice of walls on a thin bottom: parts ``top`` and ``underside``.

    Args:
        resolution: Texels along an edge.
        count: Cells along an edge.
        thickness: Of the bottom, in edges of the tile; the top of the bottom is at height 0.
        height: Of the walls above the bottom.
        wall: Thickness of a wall, as a share of a cell.

    Raises:
        InputError: If a number is out of range.
    """
    if count < 1 or not (thickness > 0 and height > 0 and 0 < wall < 1):
        raise InputError(
            f"waffle: expected count >= 1, thickness > 0, height > 0 and wall in (0, 1), got "
            f"{count}, {thickness}, {height}, {wall}"
        )
    distance = (torch.remainder(texel_centres(resolution, resolution) * count, 1.0) - 0.5).abs()
    edge = (1.0 - wall) / 2  # from the middle of a cell to the foot of its wall
    slope = ((distance.amax(-1) - edge) / (wall / 4)).clamp(0.0, 1.0)
    top = height_field(height * slope.square() * (3.0 - 2.0 * slope), name="top")
    line = torch.linspace(0.0, 1.0, _UNDERSIDE + 1, dtype=torch.float64)
    z, x = torch.meshgrid(line - 1.0, line, indexing="ij")
    below = torch.stack([x, torch.full_like(x, -thickness), z], dim=-1) + 0.5 / resolution
    below[..., 1] = -thickness
    faces = grid_faces(_UNDERSIDE + 1, _UNDERSIDE + 1)[:, [0, 2, 1]]
    underside = replace(mesh_from_arrays("underside", below.reshape(-1, 3), faces), warnings=())
    return Patch(concatenate([top.mesh, underside], "waffle"), top.texels)
