r"""Deformed meshes: bending and twisting, and how the frame of each point turns.

Transfer that turns with the surface is posed by the frames of its points. Where the vertices of a
mesh move, the normal at a point is that of its moved faces. Within the tangent plane the surface
stretches, shears and turns; the part that turns is the rotation closest to it, the polar factor of
the linear map from rest tangents to moved ones. Of two dimensions that needs no decomposition: of

.. math:: J = \begin{pmatrix} a & b \\ c & d \end{pmatrix}

it is the rotation by the angle of :math:`(a + d,\; c - b)`. The map itself is the least-squares fit
to the edges around the point. So a rotation of the whole mesh turns all frames exactly, whatever
else the mesh may be, and nothing divides by an angle.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from prt_torch.assets.mesh import Mesh
from prt_torch.assets.mesh_geometry import welded
from prt_torch.errors import InputError
from prt_torch.sphere import frame_from_normal

Direction = tuple[float, float, float] | Float[Tensor, "3"]
"""Of any length but zero, in world coordinates."""

# Sines below which a triangle's direction is rounding, as for meshes at rest.
_FLAT = 1e-14
# Mean normals shorter than this are of faces that cancel.
_SMALLEST_NORMAL = 1e-12
# Share of the edges' second moment that keeps the tangent map of collinear edges determined. It
# takes nothing from rigid motions: a multiple of the identity turns nothing.
_RIDGE = 1e-10


def bend(
    vertices: Float[Tensor, "points 3"],
    angle: float | Float[Tensor, "*poses"],
    *,
    along: Direction = (0.0, 1.0, 0.0),
    toward: Direction = (1.0, 0.0, 0.0),
) -> Float[Tensor, "*poses points 3"]:
    r"""Bend a mesh: the line through its middle becomes an arc of a circle of the same length.

    The lowest points along the line stay where they are; cross sections stay flat. At a fraction
    t of the extent L the line has turned by :math:`\theta = t \cdot` angle and passes through
    :math:`L \, (\sin\theta,\; 1 - \cos\theta) /` angle, evaluated so that angle 0 gives the
    vertices back exactly. A mesh wider to the inside than L / angle folds over itself.

    Args:
        vertices: At rest.
        angle: Between both ends [rad], of any sign; one or several.
        along: The line, from the end that stays.
        toward: Where the other end bends to; what it has along the line does not count.

    Raises:
        ValueError: If a direction is zero, or both are parallel.
    """
    axis, side = _orthonormal(along, toward, vertices)
    height, extent, middle = _along(vertices, axis)
    theta = _angles(angle, vertices) * (height / torch.where(extent > 0, extent, 1.0))
    # sin(theta) / theta and (1 - cos(theta)) / theta, as sinc takes multiples of pi.
    half = theta / 2
    half_sinc = torch.sinc(half / math.pi)
    arc_along, arc_aside = torch.sinc(theta / math.pi), half.sin() * half_sinc
    width = (vertices - middle) @ side
    along_moved = height * (arc_along - 1) - width * theta.sin()
    aside_moved = height * arc_aside - 2 * width * half.sin() ** 2
    return vertices + along_moved[..., None] * axis + aside_moved[..., None] * side


def twist(
    vertices: Float[Tensor, "points 3"],
    angle: float | Float[Tensor, "*poses"],
    *,
    along: Direction = (0.0, 1.0, 0.0),
) -> Float[Tensor, "*poses points 3"]:
    """Twist a mesh about the line through its middle; the lowest points along it stay.

    Angle 0 gives the vertices back exactly.

    Args:
        vertices: At rest.
        angle: Between both ends [rad], counter-clockwise seen against the line; one or several.
        along: The line, from the end that stays.

    Raises:
        ValueError: If the direction is zero.
    """
    axis = _unit(torch.as_tensor(along).to(vertices))
    height, extent, middle = _along(vertices, axis)
    theta = _angles(angle, vertices) * (height / torch.where(extent > 0, extent, 1.0))
    aside = vertices - middle
    aside = aside - (aside @ axis)[:, None] * axis
    across = torch.linalg.cross(axis.expand_as(aside), aside)
    closer = 2 * (theta / 2).sin()[..., None] ** 2
    return vertices + theta.sin()[..., None] * across - closer * aside


def deformed_frames(
    mesh: Mesh,
    vertices: Float[Tensor, "*poses points 3"],
    frames: Float[Tensor, "points 3 3"] | None = None,
) -> Float[Tensor, "*poses points 3 3"]:
    """Shading frames of the deformed surface that correspond to those at rest.

    Each frame turns as its surface does: the angle-weighted normal of the faces around the point
    goes to that of the moved faces, tangents by the closest rotation in the tangent plane.
    A normal of the file that differs from that of the faces keeps its place beside it. Points that
    coincide at rest, with their normals, turn together, so a seam of texture coordinates stays
    closed. Points without a surface around them, at rest or after, keep their frame.

    Args:
        mesh: At rest.
        vertices: Where its points move to.
        frames: At rest, rows tangent, bitangent and normal; those of the mesh's normals if not
            given.

    Returns:
        Rotated frames, in the type of ``vertices``; at rest the frames that were given.
        Differentiable in the vertices.

    Raises:
        ValueError: If the shapes do not fit the mesh.
    """
    if vertices.shape[-2:] != mesh.vertices.shape:
        expected = tuple(mesh.vertices.shape)
        raise ValueError(f"expected vertices of shape (..., {expected}), got {vertices.shape}")
    if frames is None:
        frames = frame_from_normal(mesh.normals)
    ring = _Rings.of(mesh, vertices.device)
    turns = _turns(ring, mesh.vertices.to(vertices.device), vertices.double())
    return (frames.to(turns) @ turns.mT).to(vertices.dtype)


def deformed(mesh: Mesh, vertices: Float[Tensor, "points 3"]) -> Mesh:
    """A mesh whose points have moved, as for baking it anew.

    Normals are the last rows of :func:`deformed_frames`; all else, warnings included, stays.

    Raises:
        InputError: If a position is not finite.
        ValueError: If the shapes do not fit.
    """
    positions = vertices.detach().cpu().double()
    finite = torch.isfinite(positions).all(dim=-1)
    if not finite.all():
        raise InputError(
            f"{mesh.name}: {int((~finite).sum())} of {mesh.num_points} deformed vertices are not "
            f"finite, the first is vertex {int((~finite).nonzero()[0])}"
        )
    return replace(mesh, vertices=positions, normals=deformed_frames(mesh, positions)[:, 2])


@dataclass(frozen=True)
class _Rings:
    """The faces around each point; points that coincide have one ring."""

    faces: Int64[Tensor, "faces 3"]
    ring_of_corner: Int64[Tensor, "corners"]
    ring_of_point: Int64[Tensor, "points"]
    count: int

    @classmethod
    def of(cls, mesh: Mesh, device: torch.device) -> "_Rings":
        """By positions and normals at rest."""
        # Adding zero makes -0 and 0 one number.
        rows = torch.cat([mesh.vertices, mesh.normals], dim=1) + 0.0
        points = torch.from_numpy(welded(rows.cpu().numpy())).to(device)
        faces = mesh.faces.to(device)
        return cls(faces, points[faces].reshape(-1), points, int(points.max()) + 1)

    def sum(
        self, values: Float64[Tensor, "*poses faces 3 width"]
    ) -> Float64[Tensor, "*poses rings width"]:
        """Of what the corners of faces have, over each ring."""
        values = values.flatten(-3, -2)
        total = values.new_zeros(*values.shape[:-2], self.count, values.shape[-1])
        return total.index_add(-2, self.ring_of_corner, values)


def _turns(
    ring: _Rings,
    rest: Float64[Tensor, "points 3"],
    moved: Float64[Tensor, "*poses points 3"],
) -> Float64[Tensor, "*poses points 3 3"]:
    """World rotation of the surface around each point; the identity where there is none."""
    rest_edges, moved_edges = (_edges(vertices, ring.faces) for vertices in (rest, moved))
    rest_normal, rest_found = _normals(ring, rest_edges)
    moved_normal, moved_found = _normals(ring, moved_edges)
    rest_tangents = frame_from_normal(rest_normal)[..., :2, :]
    moved_frame = frame_from_normal(moved_normal)
    second = _second_moments(ring, rest_edges, rest_tangents, rest_edges, rest_tangents)
    cross = _second_moments(ring, moved_edges, moved_frame[..., :2, :], rest_edges, rest_tangents)
    a, b, c, d = _tangent_map(cross, second).flatten(-2).unbind(-1)
    cosine, sine = a + d, c - b
    length_squared = cosine**2 + sine**2
    found = rest_found & moved_found & (length_squared > torch.finfo(torch.float64).tiny)
    length = torch.where(found, length_squared, 1.0).sqrt()
    cosine, sine = torch.where(found, cosine / length, 1.0), sine / length
    tangent, bitangent, normal = moved_frame.unbind(-2)
    turned = torch.stack(
        [
            cosine[..., None] * tangent + sine[..., None] * bitangent,
            cosine[..., None] * bitangent - sine[..., None] * tangent,
            normal,
        ],
        dim=-2,
    )
    turns = turned.mT @ torch.cat([rest_tangents, rest_normal[:, None]], dim=-2)
    identity = torch.eye(3, dtype=turns.dtype, device=turns.device)
    return torch.where(found[..., None, None], turns, identity)[..., ring.ring_of_point, :, :]


def _edges(
    vertices: Float64[Tensor, "*poses points 3"], faces: Int64[Tensor, "faces 3"]
) -> Float64[Tensor, "*poses faces 3 3"]:
    """From each corner of each face to the next, the longest of a pose having about length 1.

    The scale matters for nothing but under- and overflow, so it is no part of gradients.
    """
    corners = vertices[..., faces, :]
    edges = corners.roll(-1, dims=-2) - corners
    largest = edges.detach().abs().amax(dim=(-3, -2, -1), keepdim=True)
    return edges / torch.where(largest > 0, largest, 1.0)


def _normals(
    ring: _Rings, edges: Float64[Tensor, "*poses faces 3 3"]
) -> tuple[Float64[Tensor, "*poses rings 3"], Bool[Tensor, "*poses rings"]]:
    """Angle-weighted unit normals, +z where faces cancel or there are none; and where they are.

    Source:
        Thürmer and Wüthrich, "Computing vertex normals from polygonal facets", 1998.
    """
    largest = edges.detach().abs().amax(dim=(-2, -1), keepdim=True)
    edges = edges / torch.where(largest > 0, largest, 1.0)
    before = -edges.roll(1, dims=-2)
    cross = torch.linalg.cross(edges[..., 0, :], before[..., 0, :])
    flat = (cross.detach().square().sum(-1, keepdim=True).sqrt()) <= _FLAT
    up = torch.tensor([0.0, 0.0, 1.0], dtype=cross.dtype, device=cross.device)
    cross = torch.where(flat, up, cross)
    double_area = cross.square().sum(-1, keepdim=True).sqrt()
    dots = (edges * before).sum(-1)
    angles = torch.where(flat, 0.0, torch.atan2(double_area, dots))
    weighted = angles[..., None] * (cross / double_area)[..., None, :]
    total = ring.sum(weighted)
    length = total.detach().norm(dim=-1, keepdim=True)
    found = length > _SMALLEST_NORMAL
    total = torch.where(found, total, up)
    return total / total.square().sum(-1, keepdim=True).sqrt(), found[..., 0]


def _second_moments(
    ring: _Rings,
    edges: Float64[Tensor, "*poses faces 3 3"],
    tangents: Float64[Tensor, "*poses rings 2 3"],
    other_edges: Float64[Tensor, "faces 3 3"],
    other_tangents: Float64[Tensor, "rings 2 3"],
) -> Float64[Tensor, "*poses rings 2 2"]:
    """Sums of products of edges in tangent coordinates, over both edges at each corner."""
    products = (edges[..., :, None] * other_edges[..., None, :]).flatten(-2)
    # An edge lies at both corners that it joins.
    total = ring.sum(products + products.roll(1, dims=-2)).unflatten(-1, (3, 3))
    return tangents @ total @ other_tangents.mT


def _tangent_map(
    cross: Float64[Tensor, "*poses rings 2 2"], second: Float64[Tensor, "rings 2 2"]
) -> Float64[Tensor, "*poses rings 2 2"]:
    """The least-squares map of tangents, times a positive number."""
    a, b, c, d = second.flatten(-2).unbind(-1)
    adjugate = torch.stack([d, -b, -c, a], dim=-1).unflatten(-1, (2, 2))
    ridge = _RIDGE * (a + d)
    identity = torch.eye(2, dtype=second.dtype, device=second.device)
    return cross @ (adjugate + ridge[:, None, None] * identity)


def _along(
    vertices: Float[Tensor, "points 3"], axis: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "points"], Float[Tensor, ""], Float[Tensor, "3"]]:
    """Height above the lowest point along a line, the extent, and the middle of the box."""
    height = vertices @ axis
    low = height.amin()
    middle = (vertices.amin(dim=0) + vertices.amax(dim=0)) / 2
    return height - low, height.amax() - low, middle


def _angles(
    angle: float | Float[Tensor, "*poses"], like: Float[Tensor, "points 3"]
) -> Float[Tensor, "*poses 1"]:
    return torch.as_tensor(angle, dtype=like.dtype, device=like.device)[..., None]


def _unit(direction: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    length = direction.norm()
    if not (torch.isfinite(length) and length > 0):
        raise ValueError(f"expected a direction of some length, got {direction.tolist()}")
    return direction / length


def _orthonormal(
    along: Direction, toward: Direction, like: Float[Tensor, "points 3"]
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Both directions at length 1, the second perpendicular to the first."""
    axis, side = (_unit(torch.as_tensor(direction).to(like)) for direction in (along, toward))
    side = side - (side @ axis) * axis
    if not side.norm() > 1e-6:
        raise ValueError(f"expected to bend away from the line, got {toward} along {along}")
    return axis, _unit(side)
