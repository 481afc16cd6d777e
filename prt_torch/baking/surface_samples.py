"""Samples of a surface, and integrals of the dipole over them.

*Samples* are the pieces of faces that are bisected until none is longer than a bound, up to a
number. Where the reflectance varies over a piece, it is not sampled at the piece's centroid but
integrated over the triangle: by three points where it is farther than its own length, else exactly.
The integral over a triangle is a sum over its edges of the disk's closed form, averaged over the
angle that an edge sweeps.

Source:
    Three points: Strang and Fix 1973, An Analysis of the Finite Element Method, table 4.1.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from prt_torch.assets.medium import Dipole
from prt_torch.baking.reflectance_table import ReflectanceTable

_MAX_SAMPLES = 2**16  # unless there are more faces
_PIECES_PER_FACE = 16  # on average: irradiance is linear over a face anyway
_CORNERS_AT_ONCE = 2**14  # some 20 MB
_NODES, _NODE_WEIGHTS = map(torch.from_numpy, np.polynomial.legendre.leggauss(8))
_SPREAD = (torch.ones(3, 3, dtype=torch.float64) + 3 * torch.eye(3, dtype=torch.float64)) / 6


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
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
        """Of samples."""
        return len(self.areas)

    @property
    def centroids(self) -> Float64[Tensor, "samples 3"]:
        """Their middles."""
        return self.corners.mean(dim=1)

    @property
    def squared_lengths(self) -> Float64[Tensor, "samples"]:
        """Of the longest edge."""
        return _squared_edges(self.corners).amax(dim=1)

    def fluxes(self, values: Float[Tensor, "points coeffs"]) -> Float[Tensor, "samples coeffs"]:
        """Values at the centroids, linear over each face, times the samples' areas."""
        shares = (self.barycentric * self.areas[:, None]).to(values.dtype)
        total = values.new_zeros(self.num, values.shape[1])
        for corner in range(3):
            total.addcmul_(values[self.vertices[:, corner]], shares[:, corner, None])
        return total


def _squared_edges(corners: Float64[Tensor, "samples 3 3"]) -> Float64[Tensor, "samples 3"]:
    """From each corner to the next."""
    return (corners.roll(-1, dims=1) - corners).square().sum(dim=-1)


def sample_faces(
    vertices: Float64[Tensor, "points 3"], faces: Int64[Tensor, "faces 3"], spacing: float
) -> SurfaceSamples:
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
    return SurfaceSamples(
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


class TriangleMeans:
    """Mean reflectance over samples that are near a point."""

    def __init__(self, samples: SurfaceSamples, dipole: Dipole, reflectance: ReflectanceTable):
        """Prepare.

        Args:
            samples: The triangles.
            dipole: In the dtype to compute in.
            reflectance: That of the dipole.
        """
        like = dipole.depths
        self._reflectance = reflectance
        # One dipole a channel: the processor's vectors go along distances.
        albedo, transport = dipole.reduced_albedo.split(1), dipole.effective_transport.split(1)
        depths = dipole.depths.split(1, dim=1)
        self._channels = [Dipole(*one) for one in zip(albedo, transport, depths, strict=True)]
        self._corners = samples.corners
        edges = samples.corners.roll(-1, dims=1) - samples.corners
        lengths = edges.norm(dim=-1)
        directions = edges / lengths[..., None]
        normals = samples.normals[:, None].expand_as(directions)
        outwards = torch.linalg.cross(directions, normals)
        # Of each corner's offset: along the edge that follows, out of it, and out of the plane.
        self._axes = torch.stack([directions, outwards, normals], dim=2).to(like)
        self._lengths = lengths.to(like)
        self._areas = samples.areas.to(like)
        self._spread_points = _SPREAD.to(samples.corners) @ samples.corners
        from_corners = samples.corners - samples.centroids[:, None]
        self._own_shares = self._shares_at_corners(from_corners.norm(dim=-1).to(like))

    def over_far(
        self, positions: Float64[Tensor, "pairs 3"], sample: Int64[Tensor, "pairs"]
    ) -> Float[Tensor, "channels pairs"]:
        """By three points of the sample, exact for polynomials of degree 2.

        Within 1 % where a sample is longer than neither its distance nor 10 mean free paths.
        """
        offsets = (self._spread_points[sample] - positions[:, None]).to(self._lengths)
        squared = offsets.square_().sum(dim=-1)
        return torch.stack([values.mean(dim=1) for values in self._reflectance(squared)])

    def over_close(
        self, positions: Float64[Tensor, "pairs 3"], sample: Int64[Tensor, "pairs"]
    ) -> tuple[Float[Tensor, "channels pairs"], Float[Tensor, "channels pairs"]]:
        """By closed forms, at any distance: what holds for the sample's light, and the point's own.

        A sample that has the point as a corner is lit there as the point is; what it sends comes
        from in between, from the mean distance of the light's origin within the sample.
        """
        offsets = (self._corners[sample] - positions[:, None]).to(self._lengths)
        at_corner = (offsets == 0).all(dim=-1)
        means = self._integrate(offsets, at_corner, sample) / self._areas[sample]
        own = means * (self._own_shares[:, sample] * at_corner).sum(dim=-1)
        return means - own, own

    def _shares_at_corners(
        self, distance: Float[Tensor, "samples 3"]
    ) -> Float[Tensor, "channels samples 3"]:
        """Share of a corner's own light, which is that far from the centroid."""
        shares = []
        for channel in self._channels:
            # The centroid is at two thirds of the way to the opposite edge.
            means = [
                channel.mean_distance(1.5 * some)[..., 0] / some
                for some in distance.split(_CORNERS_AT_ONCE)
            ]
            shares.append(1 - torch.cat(means))
        return torch.stack(shares)

    def _integrate(
        self,
        offsets: Float[Tensor, "pairs 3 3"],
        at_corner: Bool[Tensor, "pairs 3"],
        sample: Int64[Tensor, "pairs"],
    ) -> Float[Tensor, "channels pairs"]:
        """Integral of the reflectance over triangles.

        With the foot of the point in the triangle's plane as centre, each edge sweeps an angle; the
        part of the plane between foot and edge is made of slices of disks that reach to the edge.
        Parts of edges that face the foot from outside count negative.
        """
        along, side, height = torch.einsum("pca,pcxa->xpc", offsets, self._axes[sample])
        # Rounded, what is zero at a corner may exceed the depth of light in an opaque medium.
        side = side.masked_fill(at_corner | at_corner.roll(-1, dims=1), 0.0)
        height = height[:, 0].masked_fill(at_corner.any(dim=1), 0.0)[:, None, None]
        reach = side.abs()
        start = torch.atan2(along, reach)
        swept = torch.atan2(along + self._lengths[sample], reach) - start
        middle_angles = (_NODES.to(offsets) + 1) / 2
        radius = reach[..., None] / torch.cos(start[..., None] + swept[..., None] * middle_angles)
        turns = side.sign() * swept / (2 * math.pi)
        integrals = []
        for channel in self._channels:
            slices = channel.disk_reflectance(radius, height)[..., 0]  # pairs, edges, nodes
            mean = slices @ (_NODE_WEIGHTS.to(offsets) / 2)
            integrals.append((mean * turns).sum(dim=1).clamp_min(0.0))
        return torch.stack(integrals)
