r"""Subsurface scattering: light enters a translucent object in one place and leaves in another.

Radiosity is a sum over samples p of the surface, and radiance is the same in every direction,

.. math:: B(x) = \sum_p R_d(|x - p|)\, E_p A_p, \qquad L(x) = B(x) / \pi

with the dipole's :math:`R_d` (:mod:`prt_torch.assets.medium`). Transfer of an uncoloured diffuse
surface is :math:`E / \pi`, so the sum maps transfer to transfer, coefficient by coefficient.

*Samples* (:mod:`prt_torch.baking.surface_samples`) are pieces of faces, at most a mean free path
long if there are not too many. Where :math:`R_d` varies over a piece, it is integrated over the
triangle. So no scale loses or makes energy; a medium that is opaque at the scale of the mesh
reflects :math:`R\,E / \pi` of its own point.

*Far samples* are summed by the nodes of an octree (:mod:`prt_torch.baking.octree`), a node standing
for its samples where it is small as seen from the point. Neighbouring points traverse the tree
together: a node has to be small for the least distance of their bounding box. The sum is then a
product of dense matrices, points by nodes and nodes by coefficients.

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

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from prt_torch.assets.medium import Dipole, Medium
from prt_torch.assets.mesh import Mesh
from prt_torch.assets.mesh_geometry import face_geometry
from prt_torch.baking.octree import build_octree, morton_codes
from prt_torch.baking.reflectance_table import ReflectanceTable
from prt_torch.baking.surface_samples import (
    SurfaceSamples,
    TriangleMeans,
    sample_faces,
)
from prt_torch.errors import InputError

_MAX_ACCURACY = 0.05  # nodes stay farther than what is integrated over triangles
_NEAR = 0.1  # squared length of a sample over squared distance from which it is integrated
_MAX_MILLIMETRES = 1e12  # cubes of distances in float32 stay within its range
_GROUP = 32  # points that traverse the octree together
_RUN = 128  # rows of a group that are multiplied at once
_PAIRS_AT_ONCE = 2**17  # of points and rows: what stays in the processor's cache
_TRIANGLES_AT_ONCE = 2**12  # of points and near samples, likewise
_LIST_ELEMENTS = 2**20  # of groups and rows: some 200 MB
_TABLE_ELEMENTS = 2**27  # of the rows' irradiance: 512 MiB in float32


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
    samples = sample_faces(vertices, faces, spacing=1 / float(medium.extinction().max()))
    channels = max(irradiance.shape[1], len(dipole.reduced_albedo))
    radiance = irradiance.new_zeros(mesh.num_points, channels, 1, irradiance.shape[2])
    if not samples.num:
        return radiance
    receivers = samples.vertices.unique()
    receivers = receivers[morton_codes(vertices[receivers]).argsort(stable=True)]
    completion = _full_turns(vertices, faces)[receivers, None, None].to(irradiance.dtype)
    scene = _Scene(samples, dipole.to(irradiance), accuracy)
    columns = max(1, _TABLE_ELEMENTS // (scene.num_rows * irradiance.shape[1]))
    for first in range(0, irradiance.shape[2], columns):
        some = irradiance[:, :, first : first + columns]
        total = scene.gather(vertices[receivers], some[receivers] * completion, scene.table(some))
        radiance[receivers, :, 0, first : first + columns] = total
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


class _Scene:
    """Rows to sum over, namely samples, then nodes of the octree, then one that is nothing."""

    def __init__(self, samples: SurfaceSamples, dipole: Dipole, accuracy: float):
        self._softening = float(dipole.depths.min()) ** 2
        self._samples = samples
        self._accuracy = accuracy
        self._channels = len(dipole.reduced_albedo)
        corners = samples.corners.flatten(0, 1)
        diagonal = corners.amax(dim=0) - corners.amin(dim=0)
        self._reflectance = ReflectanceTable(dipole, float(diagonal.square().sum()))
        self._near_means = TriangleMeans(samples, dipole, self._reflectance)
        self._octree = build_octree(samples.centroids)
        self.num_rows = samples.num + self._octree.num_nodes + 1
        areas = samples.areas[:, None]
        node_centroids = self._octree.sums(samples.centroids * areas) / self._octree.sums(areas)
        # Nothing is in the middle of all.
        self._centroids = torch.cat([samples.centroids, node_centroids, node_centroids[:1]])
        # Neither nodes nor nothing are integrated over a triangle.
        self._squared_lengths = samples.squared_lengths.to(dipole.depths)
        self._near_squared = dipole.depths.new_full((self.num_rows,), -1.0)
        self._near_squared[: samples.num] = samples.squared_lengths / _NEAR - self._softening
        self._areas = samples.areas.to(dipole.depths)
        high = self._octree.highest(samples.corners.amax(dim=1))
        low = -self._octree.highest(-samples.corners.amin(dim=1))
        # The area of a square whose diagonal is the box's.
        self._node_sizes = (high - low).square().sum(dim=-1) / 2

    def table(
        self, irradiance: Float[Tensor, "points channels coeffs"]
    ) -> Float[Tensor, "channels rows coeffs"]:
        """Flux of each row over π: irradiance times area."""
        num, num_nodes = self._samples.num, self._octree.num_nodes
        table = irradiance.new_zeros(irradiance.shape[1], self.num_rows, irradiance.shape[2])
        for channel, values in zip(table, irradiance.unbind(1), strict=True):
            flux = self._samples.fluxes(values)
            channel[:num] = flux
            channel[num : num + num_nodes] = self._octree.sums(flux)
        return table

    def gather(
        self,
        positions: Float64[Tensor, "receivers 3"],
        own: Float[Tensor, "receivers channels coeffs"],
        table: Float[Tensor, "channels rows coeffs"],
    ) -> Float[Tensor, "receivers out_channels coeffs"]:
        """Radiance at points whose own irradiance, made up to a full turn, is ``own``."""
        num = len(positions)
        num_groups = math.ceil(num / _GROUP)
        # The last group is filled up with its last point.
        filled = torch.arange(num_groups * _GROUP, device=positions.device).clamp_max(num - 1)
        grouped = positions[filled].unflatten(0, (num_groups, _GROUP))
        # At 5 percent, a group has some 1000 rows; one list holds the longest of any level.
        most = self._samples.num
        if self._accuracy > 0:
            most = min(most, math.ceil(64 / self._accuracy))
        totals, locals_ = [], []
        for groups in grouped.split(max(1, _LIST_ELEMENTS // most)):
            total, local = self._gather_groups(groups, table)
            totals.append(total)
            locals_.append(local)
        total, local = torch.cat(totals, dim=1)[:, :num], torch.cat(locals_, dim=1)[:, :num]
        for out, of_table, of_medium in _channel_pairs(len(total), len(table), len(local)):
            total[out] += local[of_medium, :, None] * own[:, of_table]
        return total.transpose(0, 1)

    def _gather_groups(
        self,
        grouped: Float64[Tensor, "groups members 3"],
        table: Float[Tensor, "channels rows coeffs"],
    ) -> tuple[
        Float[Tensor, "out_channels receivers coeffs"], Float[Tensor, "medium_channels receivers"]
    ]:
        """The sum over rows, and the weights of the points' own light."""
        group, rows = self._runs(grouped)
        channels = max(len(table), self._channels)
        total = table.new_zeros(channels, *grouped.shape[:2], table.shape[2])
        local = table.new_zeros(self._channels, grouped.shape[0] * _GROUP)
        at_once = max(1, _PAIRS_AT_ONCE // (_GROUP * _RUN))
        for some, row in zip(group.split(at_once), rows.split(at_once), strict=True):
            weights = self._weights(grouped, some, row, local)
            fluxes = [
                channel.index_select(0, row.flatten()).unflatten(0, row.shape) for channel in table
            ]
            pairs = _channel_pairs(channels, len(table), len(weights))
            for out, of_table, of_medium in pairs:
                total[out].index_add_(0, some, torch.bmm(weights[of_medium], fluxes[of_table]))
        return total.flatten(1, 2), local

    def _runs(
        self, grouped: Float64[Tensor, "groups members 3"]
    ) -> tuple[Int64[Tensor, "runs"], Int64[Tensor, "runs rows"]]:
        """Groups, and the rows each sees, in runs of one length that are filled up with nothing."""
        low, high = grouped.amin(dim=1), grouped.amax(dim=1)
        nodes = self._centroids[self._samples.num :]

        def small_enough(group: Tensor, node: Tensor) -> Tensor:
            centroid = nodes[node]
            beside = torch.maximum(low[group] - centroid, centroid - high[group]).clamp_min_(0.0)
            squared = beside.square_().sum(dim=-1)
            return self._node_sizes[node] <= self._accuracy * (squared + self._softening)

        group, row = self._octree.select(len(grouped), small_enough)
        count = torch.bincount(group, minlength=len(grouped))
        num_runs = (count + _RUN - 1) // _RUN
        place = torch.arange(len(group), device=group.device)
        place -= torch.repeat_interleave(count.cumsum(0) - count, count)
        place += torch.repeat_interleave((num_runs.cumsum(0) - num_runs) * _RUN, count)
        group_of_run = torch.repeat_interleave(num_runs)
        rows = row.new_full((len(group_of_run), _RUN), self.num_rows - 1)
        rows.view(-1)[place] = row
        return group_of_run, rows

    def _weights(
        self,
        grouped: Float64[Tensor, "groups members 3"],
        group: Int64[Tensor, "runs"],
        row: Int64[Tensor, "runs rows"],
        local: Float[Tensor, "medium_channels receivers"],
    ) -> list[Float[Tensor, "runs members rows"]]:
        """Reflectance of each pair, by channel; adds up what points weigh themselves."""
        centres = grouped[group].mean(dim=1, keepdim=True)
        points = (grouped[group] - centres).to(local).movedim(2, 0).contiguous()
        centroids = (self._centroids[row] - centres).to(local).movedim(2, 0).contiguous()
        squared = (points[0, :, :, None] - centroids[0, :, None]).square_()
        for axis in (1, 2):
            squared += (points[axis, :, :, None] - centroids[axis, :, None]).square_()
        weights = self._reflectance(squared)
        near = (squared < self._near_squared[row][:, None]).flatten().nonzero()[:, 0]
        member, column = near // _RUN, near % _RUN
        run = member // _GROUP
        sample, receiver = row[run, column], group[run] * _GROUP + member % _GROUP
        close = squared.flatten()[near] < self._squared_lengths[sample]
        positions = grouped.flatten(0, 1)
        for some in (~close).nonzero()[:, 0].split(_TRIANGLES_AT_ONCE):
            means = self._near_means.over_far(positions[receiver[some]], sample[some])
            for channel, values in zip(weights, means, strict=True):
                channel.view(-1)[near[some]] = values
        for some in close.nonzero()[:, 0].split(_TRIANGLES_AT_ONCE):
            means, own = self._near_means.over_close(positions[receiver[some]], sample[some])
            local.index_add_(1, receiver[some], own * self._areas[sample[some]])
            for channel, values in zip(weights, means, strict=True):
                channel.view(-1)[near[some]] = values
        return weights


def _channel_pairs(channels: int, of_table: int, of_medium: int) -> list[tuple[int, int, int]]:
    """Each channel of the result with its channel of irradiance and of the medium."""
    return [(out, min(out, of_table - 1), min(out, of_medium - 1)) for out in range(channels)]
