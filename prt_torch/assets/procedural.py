"""Geometry made of formulas: the ground under a mesh, textured surfaces, scenes without a file."""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from prt_torch.assets.mesh import Mesh, concatenate, mesh_from_arrays
from prt_torch.errors import InputError

_KNOT_RADIUS = 1.0
_KNOT_MINOR_RADIUS = 0.45
_TUBE_RADIUS = 0.24
_TURNS_AROUND_AXIS = 2
_TURNS_THROUGH_HOLE = 3


def grid_faces(rows: int, cols: int, *, wrap: bool = False) -> Int64[Tensor, "faces 3"]:
    """Triangles of a grid of points in row order.

    With rows along a and columns along b, faces are counter-clockwise seen from a x b.

    Args:
        rows: Points along a.
        cols: Points along b.
        wrap: Join the last row and column to the first.
    """
    a = torch.arange(rows if wrap else rows - 1)[:, None]
    b = torch.arange(cols if wrap else cols - 1)[None, :]
    next_a, next_b = (a + 1) % rows, (b + 1) % cols
    corner, right = a * cols + b, a * cols + next_b
    below, opposite = next_a * cols + b, next_a * cols + next_b
    first = torch.stack([corner, below, opposite], dim=-1)
    second = torch.stack([corner, opposite, right], dim=-1)
    return torch.stack([first, second], dim=-2).reshape(-1, 3)


def ground_plane(
    mesh: Mesh,
    *,
    albedo: tuple[float, float, float] = (0.5, 0.5, 0.5),
    size: float = 4.0,
    resolution: int = 48,
    offset: float = 1e-4,
) -> Mesh:
    """A horizontal square below a mesh, centred under its bounding box and facing +y.

    Rows are half as far apart at the centre as they would be on a regular grid, and twice as far
    at the border, as shadows are where the mesh is.

    Args:
        mesh: What stands on the ground.
        albedo: Linear RGB in [0, 1].
        size: Length of an edge, in multiples of the larger horizontal extent of the mesh.
        resolution: Points along an edge, at least 2; the plane has its square.
        offset: Gap between the lowest point and the ground, in diagonals of the bounding box, so
            that faces which lie flat on the ground do not coincide with it.

    Raises:
        InputError: If an argument is out of range.
    """
    if resolution < 2:
        raise InputError(f"ground.resolution={resolution}: expected at least 2")
    if not (math.isfinite(size) and size > 0):
        raise InputError(f"ground.size={size}: expected more than 0")
    if not (math.isfinite(offset) and offset >= 0):
        raise InputError(f"ground.offset={offset}: expected at least 0")
    low, high = mesh.bounds
    centre = (low + high) / 2
    width = float((high - low)[[0, 2]].max()) or mesh.extent or 1.0
    regular = torch.linspace(-1.0, 1.0, resolution, dtype=torch.float64)
    # Slope 1/2 at the centre and 2 at the border.
    line = (regular + regular**3) / 2 * (size * width / 2)
    height = low[1] - offset * mesh.extent
    # z changes with the row and x with the column, as z cross x is +y.
    z, x = torch.meshgrid(centre[2] + line, centre[0] + line, indexing="ij")
    vertices = torch.stack([x, height.expand_as(x), z], dim=-1).reshape(-1, 3)
    colour = torch.tensor(albedo, dtype=torch.float64).expand(len(vertices), 3)
    plane = mesh_from_arrays("ground", vertices, grid_faces(resolution, resolution), albedo=colour)
    # Its border is meant to be open.
    return replace(plane, warnings=())


def grid_surface(
    name: str,
    positions: Float64[Tensor, "rows cols 3"],
    *,
    closed: bool = False,
    repeats: tuple[float, float] = (1.0, 1.0),
) -> Mesh:
    """A surface of a grid of points, with texture coordinates along it.

    As an image lies on it: u grows with the column, v falls with the row, and the outside is where
    u is to the right and v is up.

    Args:
        name: What messages and reports call it.
        positions: In row order.
        closed: Whether the last column is joined to the first, without points of its own: texture
            coordinates are those of faces, so their seam splits no point.
        repeats: How often a texture repeats along u and along v.

    Raises:
        InputError: If there are fewer than 2 rows or columns, or a number is not finite.
    """
    rows, cols = positions.shape[:2]
    if min(rows, cols) < 2:
        raise InputError(f"{name}: expected a grid of at least 2 x 2 points, got {rows} x {cols}")
    steps = cols if closed else cols - 1
    faces = grid_faces(rows, steps + 1)
    row, col = faces // (steps + 1), faces % (steps + 1)
    u, v = col / steps * repeats[0], (1.0 - row / (rows - 1)) * repeats[1]
    return mesh_from_arrays(
        name,
        positions.reshape(-1, 3),
        row * cols + col % cols,
        uv=torch.stack([u, v], dim=-1).double(),
    )


def surface_of_revolution(
    name: str,
    profile: Float64[Tensor, "rings 2"],
    columns: int,
    *,
    repeats: tuple[float, float] = (1.0, 1.0),
) -> Mesh:
    """A surface around the y axis, with u around it and v along it.

    Args:
        name: What messages and reports call it.
        profile: Radius and height of each ring, from the top to the bottom.
        columns: Points of a ring, at least 3.
        repeats: How often a texture repeats around and along the surface.

    Raises:
        InputError: If there are too few rings or columns, or a number is not finite.
    """
    if columns < 3:
        raise InputError(f"{name}: expected at least 3 columns, got {columns}")
    angle = torch.arange(columns, dtype=torch.float64) * (2 * math.pi / columns)
    radius, height = profile[:, 0:1], profile[:, 1:2]
    x, z = radius * angle.sin(), radius * angle.cos()
    positions = torch.stack([x, height.expand_as(x), z], dim=-1)
    return grid_surface(name, positions, closed=True, repeats=repeats)


def _knot_albedo(
    along: Float64[Tensor, "points"], around: Float64[Tensor, "points"]
) -> Float64[Tensor, "points 3"]:
    """Bands that change smoothly along and around the tube, between 0.1 and 0.9."""
    warm = torch.tensor([0.85, 0.32, 0.12], dtype=torch.float64)
    cool = torch.tensor([0.12, 0.38, 0.80], dtype=torch.float64)
    light = torch.tensor([0.88, 0.84, 0.72], dtype=torch.float64)
    band = (0.5 + 0.5 * torch.sin(6 * along))[:, None]
    stripe = (0.5 + 0.5 * torch.cos(2 * around + 3 * along))[:, None]
    base = band * warm + (1 - band) * cool
    return base + 0.35 * stripe**2 * (light - base)


def _torus_knot(num_along: int, num_around: int) -> Mesh:
    """A tube around the (2, 3) torus knot, its axis upright.

    The curve winds on a torus, whose normal is perpendicular to it everywhere and closes up after
    one turn, so it carries the tube's cross section without a seam.
    """
    t = torch.arange(num_along, dtype=torch.float64) * (2 * math.pi / num_along)
    axis_angle, minor_angle = _TURNS_AROUND_AXIS * t, _TURNS_THROUGH_HOLE * t
    radial = torch.stack([axis_angle.cos(), torch.zeros_like(t), axis_angle.sin()], dim=-1)
    sideways = torch.stack([-axis_angle.sin(), torch.zeros_like(t), axis_angle.cos()], dim=-1)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    sine, cosine = minor_angle.sin()[:, None], minor_angle.cos()[:, None]
    torus_normal = cosine * radial + sine * up
    distance = _KNOT_RADIUS + _KNOT_MINOR_RADIUS * cosine
    curve = distance * radial + _KNOT_MINOR_RADIUS * sine * up
    minor_tangent = cosine * up - sine * radial
    tangent = (
        _TURNS_AROUND_AXIS * distance * sideways
        + _TURNS_THROUGH_HOLE * _KNOT_MINOR_RADIUS * minor_tangent
    )
    tangent = tangent / tangent.norm(dim=-1, keepdim=True)
    bitangent = torch.linalg.cross(tangent, torus_normal)
    around = torch.arange(num_around, dtype=torch.float64) * (2 * math.pi / num_around)
    # Rows along the tangent and columns turning clockwise about it make faces that point outwards.
    section = (
        around.cos()[:, None] * torus_normal[:, None] - around.sin()[:, None] * bitangent[:, None]
    )
    vertices = curve[:, None] + _TUBE_RADIUS * section
    shape = (num_along, num_around)
    return mesh_from_arrays(
        "torus_knot",
        vertices.reshape(-1, 3),
        grid_faces(num_along, num_around, wrap=True),
        albedo=_knot_albedo(t[:, None].expand(shape).reshape(-1), around.expand(shape).reshape(-1)),
    )


def _knot_on_ground(detail: int) -> Mesh:
    knot = _torus_knot(200 * detail, 24 * detail)
    ground = ground_plane(knot, size=3.0, resolution=48 * detail)
    return concatenate([knot, ground], "torus_knot")


def _vase(detail: int) -> Mesh:
    """A foot, a belly and a neck with a lip; open at the top, textures repeat 8 x 8 times."""
    height = torch.linspace(2.0, 0.0, 96 * detail, dtype=torch.float64)
    belly = 0.34 * torch.exp(-((height - 0.85) / 0.48).square())
    lip = 0.16 * torch.exp(-((height - 2.0) / 0.16).square())
    foot = 0.10 * torch.exp(-(height / 0.12).square())
    profile = torch.stack([0.24 + belly + lip + foot, height], dim=-1)
    vase = surface_of_revolution("vase", profile, 128 * detail, repeats=(8.0, 8.0))
    # Open at the top, as vases are, and at the bottom, where it stands.
    return replace(vase, warnings=())


_SCENES: dict[str, Callable[[int], Mesh]] = {"torus_knot": _knot_on_ground, "vase": _vase}


def procedural_scene(name: str = "torus_knot", *, detail: int = 1) -> Mesh:
    """A scene made of formulas, the same on every machine.

    ``torus_knot`` is a knotted tube with coloured bands over a grey ground: closed, shadowing
    itself, 7,104 points. ``vase`` is a surface of revolution with texture coordinates, 12,288
    points, without a ground.

    Args:
        name: Which scene.
        detail: Points along every edge, as a multiple; at 2 there are four times as many points.

    Raises:
        InputError: If there is no scene of that name, or the detail is below 1.
    """
    if name not in _SCENES:
        raise InputError(f"scene {name!r} is unknown, expected one of {', '.join(_SCENES)}")
    if detail < 1:
        raise InputError(f"detail={detail}: expected at least 1")
    return _SCENES[name](detail)
