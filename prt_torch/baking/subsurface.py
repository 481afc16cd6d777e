r"""Subsurface scattering: light enters a translucent object in one place and leaves in another.

Radiosity is a sum over samples p of the surface, and radiance is the same in every direction,

.. math:: B(x) = \sum_p R_d(|x - p|)\, E_p A_p, \qquad L(x) = B(x) / \pi

with the dipole's :math:`R_d` (:mod:`prt_torch.assets.medium`). Transfer of an uncoloured diffuse
surface is :math:`E / \pi`, so the sum maps transfer to transfer, coefficient by coefficient.

*Samples* are the pieces of faces that are bisected until none is longer than a mean free path, up
to a number. Where :math:`R_d` varies over a piece, it is not sampled at the piece's centroid but
integrated over the triangle, exactly: the integral over a triangle is a sum over its edges of the
disk's closed form, averaged over the angle that an edge sweeps. So no scale loses or makes energy;
a medium that is opaque at the scale of the mesh reflects :math:`R\,E / \pi` of its own point.

*Far samples* are summed by the nodes of an octree, a node standing for its samples where it is
small as seen from the point.

*Fresnel* transmission is that of the closed form: irradiance enters whole, and the boundary acts
through the dipole's A alone, so that uniform light E on a half-space leaves as B = R E. Jensen and
Buhler multiply the irradiance by the transmittance of each light direction and the radiosity by
:math:`F_t(x, \omega) / F_{dr}` of the view direction: light at grazing angles would count less and
the radiance would fall off towards the silhouette, which needs a light direction before projection
and an exit basis with rows.

The model takes the surface around a point for flat and the object for thick. It knows straight
distances only, so light crosses gaps, and both sides of a sheet thinner than a mean free path
scatter like half-spaces of their own: such a sheet may return up to twice what it got.

Source:
    Jensen and Buhler 2002, sections 2 to 4; Sloan, Hall, Hart, Snyder 2003, section 3.1. They bound
    a node by its area over its squared distance; we bound it by the square that its box could
    hold, so that a stray bit of a node is never seen from within, and add the depth of the source
    to the distance, as the reflectance does.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor
from torch.nn import functional

from prt_torch.assets.medium import Dipole, Medium
from prt_torch.assets.mesh import Mesh
from prt_torch.assets.mesh_geometry import face_geometry
from prt_torch.errors import InputError

_MAX_SAMPLES = 2**16  # unless there are more faces
_PIECES_PER_FACE = 16  # on average: irradiance is linear over a face anyway
_MAX_ACCURACY = 0.05  # nodes stay farther than what is integrated over triangles
_NEAR = 0.1  # squared length of a sample over squared distance from which it is integrated
_MAX_MILLIMETRES = 1e12  # distances in float32 stay far from their limit
_LEAF = 4  # samples that are not divided further
_LEVELS = 16  # of the octree
_PAIRS_AT_ONCE = 2**20  # of points and nodes: some 200 MB
_TRIANGLES_AT_ONCE = 2**14  # of points and near samples: some 100 MB
_TABLE_ELEMENTS = 2**27  # of the samples' irradiance: 512 MiB in float32
_NODES, _NODE_WEIGHTS = map(torch.from_numpy, np.polynomial.legendre.leggauss(8))


@torch.no_grad()
def scatter(
    mesh: Mesh,
    irradiance: Float[Tensor, "points channels coeffs"],
    medium: Medium,
    *,
    millimetres_per_unit: float,
    accuracy: float = 0.05,
    points: Bool[Tensor, "points"] | None = None,
) -> Float[Tensor, "points out_channels 1 coeffs"]:
    """Radiance that leaves a translucent object, per unit of each light coefficient.

    Args:
        mesh: The scene.
        irradiance: Irradiance over π: diffuse transfer without albedo, direct or interreflected,
            of 1 or 3 channels.
        medium: What the object is made of.
        millimetres_per_unit: Size of a mesh unit, 1e-9 to 1e9.
        accuracy: Area of a node over its squared distance up to which it stands for its samples,
            0 to 0.05; smaller is more exact and slower. 0 sums over every sample.
        points: The vertices that belong to the object: it consists of the faces all of whose
            corners do. All by default.

    Returns:
        For the constant exit function. One channel where the medium is grey and the irradiance has
        one, else 3. Zero at points outside the object, and at those of no face with an area.

    Raises:
        ValueError: If shapes do not fit.
        InputError: If ``millimetres_per_unit`` or ``accuracy`` is out of range.
    """
    _check(mesh, irradiance, millimetres_per_unit, accuracy, points)
    dipole = medium.dipole()
    vertices = (mesh.vertices - mesh.vertices.mean(dim=0)) * millimetres_per_unit
    vertices = vertices.to(irradiance.device)
    faces = mesh.faces.to(irradiance.device)
    if points is not None:
        faces = faces[points.to(faces.device)[faces].all(dim=1)]
    spacing = 1 / float(medium.extinction().max())
    samples = _sample_faces(vertices, faces, spacing)
    table_channels = irradiance.shape[1]
    channels = max(table_channels, len(dipole.reduced_albedo))
    radiance = irradiance.new_zeros(mesh.num_points, channels, 1, irradiance.shape[2])
    if not samples.num:
        return radiance
    receivers = samples.vertices.unique()
    # Neighbours in space share nodes, and nodes share the processor's cache.
    receivers = receivers[_morton_codes(vertices[receivers]).argsort()]
    completion = _full_turns(vertices, faces)[:, None, None].to(irradiance.dtype)
    octree = _build_octree(samples) if accuracy > 0 else None
    columns = max(1, _TABLE_ELEMENTS // (samples.num * table_channels))
    for first in range(0, irradiance.shape[2], columns):
        some = irradiance[:, :, first : first + columns]
        table = samples.interpolate(some)
        if octree is None:
            scene = _Direct(samples, table)
        else:
            scene = _Hierarchical(samples, table, octree, accuracy)
        for block in receivers.split(scene.receivers_at_once):
            own = some[block] * completion[block]
            total = scene.gather(vertices[block], own, dipole, channels)
            radiance[block, :, 0, first : first + columns] = total
    return radiance


def _check(
    mesh: Mesh,
    irradiance: Tensor,
    millimetres_per_unit: float,
    accuracy: float,
    points: Tensor | None,
) -> None:
    if irradiance.ndim != 3 or irradiance.shape[0] != mesh.num_points:
        raise ValueError(
            f"expected irradiance of {mesh.num_points} points, channels and coefficients, "
            f"got shape {tuple(irradiance.shape)}"
        )
    if irradiance.shape[1] not in (1, 3):
        raise ValueError(f"expected irradiance of 1 or 3 channels, got {irradiance.shape[1]}")
    if points is not None and (points.dtype != torch.bool or points.shape != (mesh.num_points,)):
        raise ValueError(
            f"expected one bool for each of {mesh.num_points} points, "
            f"got {points.dtype} of shape {tuple(points.shape)}"
        )
    if not 1e-9 <= millimetres_per_unit <= 1e9:
        raise InputError(f"millimetres_per_unit={millimetres_per_unit}: expected 1e-9 to 1e9")
    if not 0 <= accuracy <= _MAX_ACCURACY:
        raise InputError(f"accuracy={accuracy}: expected 0 to {_MAX_ACCURACY}")
    if mesh.extent * millimetres_per_unit > _MAX_MILLIMETRES:
        raise InputError(
            f"millimetres_per_unit={millimetres_per_unit}: {mesh.name} would be "
            f"{mesh.extent * millimetres_per_unit:.3g} mm long, "
            f"expected at most {_MAX_MILLIMETRES:.0e}"
        )


def _full_turns(
    vertices: Float64[Tensor, "points 3"], faces: Int64[Tensor, "faces 3"]
) -> Float64[Tensor, "points"]:
    """A full turn over the angle that faces have around each vertex; zero where they have none.

    It makes up for what lacks around corners and borders, where it is the point's own light that
    returns: the dark rim of an opaque medium is a mean free path wide, not as wide as a face.
    """
    angles = face_geometry(vertices.cpu().numpy(), faces.cpu().numpy()).angles
    places, place = vertices.unique(dim=0, return_inverse=True)  # seams have several vertices
    around = vertices.new_zeros(len(places))
    around.index_add_(0, place[faces.flatten()], torch.from_numpy(angles).to(vertices).flatten())
    around = around[place]
    return torch.where(around > 0, 2 * math.pi / around.clamp_min(1e-30), 0.0)


@dataclass(frozen=True, eq=False)
class _Samples:
    """Pieces of faces, all lengths in millimetres."""

    corners: Float64[Tensor, "samples 3 3"]
    vertices: Int64[Tensor, "samples 3"]
    """Of the face that a sample is part of."""
    barycentric: Float64[Tensor, "samples 3"]
    """Where the centroid is in that face."""
    areas: Float64[Tensor, "samples"]
    normals: Float64[Tensor, "samples 3"]

    @property
    def num(self) -> int:
        return len(self.areas)

    @property
    def centroids(self) -> Float64[Tensor, "samples 3"]:
        return self.corners.mean(dim=1)

    @property
    def squared_lengths(self) -> Float64[Tensor, "samples"]:
        """Of the longest edge."""
        return _squared_edges(self.corners).amax(dim=1)

    def interpolate(
        self, values: Float[Tensor, "points channels coeffs"]
    ) -> Float[Tensor, "channels samples coeffs"]:
        """Values at the centroids, linear over each face."""
        shares = self.barycentric.to(values.dtype)
        by_channel = values.transpose(0, 1)
        table = values.new_zeros(values.shape[1], self.num, values.shape[2])
        for corner in range(3):
            table += by_channel[:, self.vertices[:, corner]] * shares[:, corner, None]
        return table


def _squared_edges(corners: Float64[Tensor, "samples 3 3"]) -> Float64[Tensor, "samples 3"]:
    """From each corner to the next."""
    return (corners.roll(-1, dims=1) - corners).square().sum(dim=-1)


def _sample_faces(
    vertices: Float64[Tensor, "points 3"], faces: Int64[Tensor, "faces 3"], spacing: float
) -> _Samples:
    """Bisect faces at their longest edges, the longest first, until none exceeds the spacing.

    Bisection turns slivers into compact pieces. Areas are kept; faces without one are dropped.
    """
    corners = vertices[faces]
    barycentric = torch.eye(3, dtype=vertices.dtype, device=vertices.device).repeat(
        len(faces), 1, 1
    )
    owners = torch.arange(len(faces), device=faces.device)
    bound = max(len(faces), min(_PIECES_PER_FACE * len(faces), _MAX_SAMPLES))
    while 0 < len(owners) < bound:
        edges = _squared_edges(corners)
        longest = edges.amax(dim=1)
        divided = longest > max(spacing**2, float(longest.max()) / 4)
        order = longest.masked_fill(~divided, 0.0).argsort(descending=True, stable=True)
        chosen = order[: min(int(divided.sum()), bound - len(owners))]
        if not len(chosen):
            break
        kept = torch.ones_like(divided)
        kept[chosen] = False
        # Turned so that the longest edge goes from corner 0 to corner 1.
        turn = (edges[chosen].argmax(dim=1, keepdim=True) + torch.arange(3, device=kept.device)) % 3
        pieces = [
            torch.cat([whole[kept], *_bisect(whole[chosen[:, None], turn])])
            for whole in (corners, barycentric)
        ]
        corners, barycentric = pieces
        owners = torch.cat([owners[kept], owners[chosen], owners[chosen]])
    cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_areas = cross.norm(dim=-1)
    solid = double_areas > 0
    return _Samples(
        corners=corners[solid],
        vertices=faces[owners[solid]],
        barycentric=barycentric[solid].mean(dim=1),
        areas=double_areas[solid] / 2,
        normals=cross[solid] / double_areas[solid, None],
    )


def _bisect(corners: Tensor) -> tuple[Tensor, Tensor]:
    """Both halves of triangles cut from the middle of edge 0-1 to corner 2."""
    a, b, c = corners.unbind(1)
    middle = (a + b) / 2
    return torch.stack([a, middle, c], dim=1), torch.stack([middle, b, c], dim=1)


def _integrate_triangles(
    dipole: Dipole,
    offsets: Float64[Tensor, "pairs 3 3"],
    normals: Float64[Tensor, "pairs 3"],
) -> Float64[Tensor, "pairs channels"]:
    """Integral of the reflectance over triangles.

    With the foot of the point in the triangle's plane as centre, each edge sweeps an angle; the
    part of the plane between foot and edge is made of slices of disks that reach to the edge. Parts
    of edges that face the foot from outside count negative.

    Args:
        dipole: In float64.
        offsets: The triangle's corners from the point.
        normals: Of the triangles.
    """
    following = offsets.roll(-1, dims=1)
    edges = following - offsets
    lengths = edges.norm(dim=-1)
    height = (offsets[:, 0] * normals).sum(dim=-1)
    side = (torch.linalg.cross(offsets, following) * normals[:, None]).sum(dim=-1) / lengths
    along = (offsets * edges).sum(dim=-1) / lengths
    reach = side.abs()
    start = torch.atan2(along, reach)
    swept = torch.atan2(along + lengths, reach) - start
    middle_angles = (_NODES.to(offsets) + 1) / 2
    radius = reach[..., None] / torch.cos(start[..., None] + swept[..., None] * middle_angles)
    slices = dipole.disk_reflectance(radius, height[:, None, None])  # pairs, edges, nodes, channels
    mean = torch.einsum("penc,n->pec", slices, _NODE_WEIGHTS.to(offsets) / 2)
    return (mean * (side.sign() * swept / (2 * math.pi))[..., None]).sum(dim=1).clamp_min(0.0)


def _near_weights(
    samples: _Samples,
    dipole: Dipole,
    positions: Float64[Tensor, "pairs 3"],
    chosen: Int64[Tensor, "pairs"],
) -> tuple[Float64[Tensor, "pairs channels"], Float64[Tensor, "pairs channels"]]:
    """What near samples weigh at the sample, and at the point itself.

    A sample that has the point as a corner is lit there as the point is; what it sends comes from
    in between, from the mean distance of the light's origin within the sample.
    """
    offsets = samples.corners[chosen] - positions[:, None]
    weights = _integrate_triangles(dipole, offsets, samples.normals[chosen])
    touching = (offsets == 0).all(dim=-1).any(dim=-1)
    distance = offsets[touching].mean(dim=1).norm(dim=-1)
    # From a corner, the centroid is at two thirds of the way to the opposite edge.
    share = dipole.mean_distance(1.5 * distance) / distance[:, None]
    own = torch.zeros_like(weights)
    own[touching] = weights[touching] * (1 - share)
    return weights - own, own


class _Direct:
    """The sum over every sample: the ground truth, and quickest for few samples."""

    def __init__(self, samples: _Samples, table: Float[Tensor, "channels samples coeffs"]):
        self._samples = samples
        self._table = table
        self.receivers_at_once = max(1, _PAIRS_AT_ONCE // samples.num)

    def gather(
        self,
        positions: Float64[Tensor, "receivers 3"],
        own: Float[Tensor, "receivers channels coeffs"],
        dipole: Dipole,
        channels: int,
    ) -> Float[Tensor, "receivers out_channels coeffs"]:
        """Radiance at points whose own irradiance, made up to a full turn, is ``own``."""
        samples = self._samples
        squared = (positions[:, None] - samples.centroids).square().sum(dim=-1)
        weights = dipole.reflectance(squared.sqrt()) * samples.areas[:, None]
        near = _is_near(samples.squared_lengths, squared, dipole)
        local = weights.new_zeros(len(positions), weights.shape[-1])
        receiver, sample = near.nonzero(as_tuple=True)
        rows = zip(
            receiver.split(_TRIANGLES_AT_ONCE), sample.split(_TRIANGLES_AT_ONCE), strict=True
        )
        for some, chosen in rows:
            away, own_share = _near_weights(samples, dipole, positions[some], chosen)
            weights[some, chosen] = away
            local.index_add_(0, some, own_share)
        total = own.new_zeros(len(positions), channels, own.shape[-1])
        for out, of_table, of_weights in _channel_pairs(channels, own.shape[1], weights.shape[-1]):
            total[:, out] = weights[..., of_weights].to(own.dtype) @ self._table[of_table]
            total[:, out] += local[:, of_weights, None].to(own.dtype) * own[:, of_table]
        return total


class _Hierarchical:
    """The sum over the nodes of an octree where they are small as seen from the point."""

    def __init__(
        self,
        samples: _Samples,
        table: Float[Tensor, "channels samples coeffs"],
        octree: "_Octree",
        accuracy: float,
    ):
        self._samples = samples
        self._table = table
        self._octree = octree
        self._accuracy = accuracy
        areas = samples.areas[:, None]
        self._centroids = octree.sums(samples.centroids * areas) / octree.sums(areas)
        high = octree.highest(samples.corners.amax(dim=1))
        low = -octree.highest(-samples.corners.amin(dim=1))
        # The area of a square whose diagonal is the box's.
        self._sizes = (high - low).square().sum(dim=-1) / 2
        weighted = (octree.sums(channel * areas.to(table.dtype)) for channel in table)
        self._node_table = torch.stack(list(weighted))
        # A level has some 4 pi / accuracy nodes that are neither small enough nor in a small one.
        pairs_per_receiver = min(samples.num, math.ceil(16 / accuracy))
        self.receivers_at_once = max(1, _PAIRS_AT_ONCE // pairs_per_receiver)

    def gather(
        self,
        positions: Float64[Tensor, "receivers 3"],
        own: Float[Tensor, "receivers channels coeffs"],
        dipole: Dipole,
        channels: int,
    ) -> Float[Tensor, "receivers out_channels coeffs"]:
        """Radiance at points whose own irradiance, made up to a full turn, is ``own``."""
        octree = self._octree
        total = own.new_zeros(len(positions), channels, own.shape[-1])
        softening = float(dipole.depths.min()) ** 2
        receiver = torch.arange(len(positions), device=positions.device)
        node = torch.zeros_like(receiver)
        while len(node):
            squared = (positions[receiver] - self._centroids[node]).square_().sum(dim=-1)
            whole = self._sizes[node] <= self._accuracy * (squared + softening)
            weights = dipole.to(own).reflectance(squared[whole].to(own.dtype).sqrt_())
            _accumulate(total, self._node_table, receiver[whole], node[whole], weights)
            receiver, node = receiver[~whole], node[~whole]
            is_leaf = octree.num_children[node] == 0
            leaf = node[is_leaf]
            runs = octree.first_sample[leaf], octree.num_samples[leaf]
            samples = _expand(receiver[is_leaf], *runs)
            self._add_samples(total, own, dipole, positions, *samples)
            inner = node[~is_leaf]
            children = octree.first_child[inner], octree.num_children[inner]
            receiver, node = _expand(receiver[~is_leaf], *children)
        return total

    def _add_samples(
        self,
        total: Float[Tensor, "receivers out_channels coeffs"],
        own: Float[Tensor, "receivers channels coeffs"],
        dipole: Dipole,
        positions: Float64[Tensor, "receivers 3"],
        receiver: Int64[Tensor, "pairs"],
        chosen: Int64[Tensor, "pairs"],
    ) -> None:
        samples = self._samples
        sample = self._octree.order[chosen]
        squared = (positions[receiver] - samples.centroids[sample]).square_().sum(dim=-1)
        weights = dipole.reflectance(squared.sqrt()) * samples.areas[sample, None]
        near = _is_near(samples.squared_lengths[sample], squared, dipole).nonzero()[:, 0]
        for some in near.split(_TRIANGLES_AT_ONCE):
            away, local = _near_weights(samples, dipole, positions[receiver[some]], sample[some])
            weights[some] = away
            # A point's own light is a table with one row a point.
            table = own.transpose(0, 1)
            _accumulate(total, table, receiver[some], receiver[some], local.to(own.dtype))
        _accumulate(total, self._table, receiver, sample, weights.to(own.dtype))


def _is_near(squared_lengths: Tensor, squared: Tensor, dipole: Dipole) -> Tensor:
    """Whether the reflectance varies over a sample, seen from a squared distance."""
    return squared_lengths > _NEAR * (squared + float(dipole.depths.min()) ** 2)


def _channel_pairs(channels: int, of_table: int, of_weights: int) -> list[tuple[int, int, int]]:
    """Each channel of the result with its channel of irradiance and of the medium."""
    return [(out, min(out, of_table - 1), min(out, of_weights - 1)) for out in range(channels)]


def _accumulate(
    total: Float[Tensor, "receivers out_channels coeffs"],
    table: Float[Tensor, "channels rows coeffs"],
    receiver: Int64[Tensor, "pairs"],
    row: Int64[Tensor, "pairs"],
    weights: Float[Tensor, "pairs medium_channels"],
) -> None:
    """Add weighted rows to their receivers, which are in ascending order."""
    if not len(row):
        return
    borders = torch.arange(len(total) + 1, device=receiver.device)
    borders = torch.searchsorted(receiver, borders)
    for out, of_table, of_weights in _channel_pairs(
        total.shape[1], table.shape[0], weights.shape[1]
    ):
        total[:, out] += functional.embedding_bag(
            row,
            table[of_table],
            borders,
            mode="sum",
            per_sample_weights=weights[:, of_weights].contiguous(),
            include_last_offset=True,
        )


def _expand(
    receiver: Int64[Tensor, "nodes"], first: Int64[Tensor, "nodes"], count: Int64[Tensor, "nodes"]
) -> tuple[Int64[Tensor, "pairs"], Int64[Tensor, "pairs"]]:
    """Each receiver with each number of its run ``first .. first + count - 1``."""
    skipped = torch.repeat_interleave(count.cumsum(0) - count - first, count)
    steps = torch.arange(len(skipped), device=first.device)
    return torch.repeat_interleave(receiver, count), steps - skipped


def _morton_codes(positions: Float64[Tensor, "points 3"]) -> Int64[Tensor, "points"]:
    """Cells of 2^16 along each axis of the bounding cube, numbered along the octree's curve."""
    low = positions.amin(dim=0)
    extent = float((positions - low).max()) or 1.0
    cells = ((positions - low) * (2**_LEVELS / extent)).long().clamp(0, 2**_LEVELS - 1)
    codes = torch.zeros_like(cells[:, 0])
    for bit in range(_LEVELS):
        for axis in range(3):
            codes |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return codes


@dataclass(frozen=True, eq=False)
class _Octree:
    """Nodes in order of their levels, the root first; children of a node follow each other."""

    order: Int64[Tensor, "samples"]
    """Samples along the curve, where a node's are a run."""
    leaf_of: Int64[Tensor, "samples"]
    """By place on the curve."""
    levels: list[slice]
    parent: Int64[Tensor, "nodes"]
    first_child: Int64[Tensor, "nodes"]
    num_children: Int64[Tensor, "nodes"]
    first_sample: Int64[Tensor, "nodes"]
    num_samples: Int64[Tensor, "nodes"]

    def sums(self, values: Float[Tensor, "samples columns"]) -> Float[Tensor, "nodes columns"]:
        """Sums over the samples of each node."""
        sums = values.new_zeros(len(self.parent), values.shape[1])
        sums.index_add_(0, self.leaf_of, values[self.order])
        for level in reversed(self.levels[1:]):
            sums.index_add_(0, self.parent[level], sums[level].clone())
        return sums

    def highest(
        self, values: Float64[Tensor, "samples columns"]
    ) -> Float64[Tensor, "nodes columns"]:
        """Largest values among the samples of each node."""
        highest = values.new_full((len(self.parent), values.shape[1]), -math.inf)
        _raise_to(highest, self.leaf_of, values[self.order])
        for level in reversed(self.levels[1:]):
            _raise_to(highest, self.parent[level], highest[level].clone())
        return highest


def _raise_to(highest: Tensor, rows: Int64[Tensor, "values"], values: Tensor) -> None:
    """Replace elements by larger ones."""
    highest.scatter_reduce_(0, rows[:, None].expand_as(values), values, "amax")


def _build_octree(samples: _Samples) -> _Octree:
    """Divide nodes of more than a few samples, along the curve, level by level."""
    codes, order = _morton_codes(samples.centroids).sort(stable=True)
    leaf_of = torch.zeros_like(order)
    first_sample, num_samples, parent, levels = [], [], [], []
    first_node = 0
    inside = torch.arange(len(codes), device=codes.device)  # nodes that are still to be divided
    for level in range(_LEVELS + 1):
        prefix = codes[inside] >> (3 * (_LEVELS - level))
        node, count = torch.unique_consecutive(prefix, return_inverse=True, return_counts=True)[1:]
        start = inside[count.cumsum(0) - count]
        first_sample.append(start)
        num_samples.append(count)
        parent.append(leaf_of[start])
        leaf_of[inside] = node + first_node
        levels.append(slice(first_node, first_node + len(count)))
        first_node += len(count)
        inside = inside[count[node] > _LEAF]
        if not len(inside):
            break
    parents = torch.cat(parent)
    # Children follow in the order of their parents, so a node's begin where its predecessors' end.
    num_children = torch.bincount(parents[1:], minlength=first_node)
    return _Octree(
        order=order,
        leaf_of=leaf_of,
        levels=levels,
        parent=parents,
        first_child=num_children.cumsum(0) - num_children + 1,
        num_children=num_children,
        first_sample=torch.cat(first_sample),
        num_samples=torch.cat(num_samples),
    )
