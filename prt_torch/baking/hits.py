"""What hidden directions hit: one closest-hit ray for each coarse texel that is not all sky.

Visibility bits say which directions of a point are hidden; light that bounces arrives from just
these. Their sub-texels are gathered into coarse texels. A coarse texel weighs exactly what its
hidden sub-texels weigh, so that seen and hidden directions together are the whole hemisphere and
no energy is made or lost, and one ray through one of these sub-texels finds what is there.

Which sub-texel it is follows a fixed low-discrepancy sequence over texels, the same for all
points: nothing is random.
"""

import functools
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int32, Int64
from torch import Tensor

from prt_torch.assets.mesh import Mesh
from prt_torch.assets.mesh_geometry import face_geometry
from prt_torch.baking.projection import pieces
from prt_torch.baking.visibility import Tracer, VisibilityField
from prt_torch.bases import sh
from prt_torch.sphere import cubemap_directions, cubemap_solid_angles

_POINTS_AT_ONCE = 32  # their sub-texels are unpacked together: 12 MiB of cosines at the defaults
_KEPT_BYTES = 2**30
_HORIZON = 1e-6  # cosine below which it is rounding whether visibility traced a direction
_PLASTIC = 1.3247179572447460260  # x³ = x + 1: the golden ratio of two dimensions
_GOLDEN = 1.6180339887498948482


@dataclass(frozen=True)
class Hits:
    """What the hidden directions of a block of points hit, point after point.

    Hits of back faces are left out, since these are black.

    Attributes:
        counts: How many hits each point has.
        moments: World harmonics integrated over the hidden part of each hit's coarse texel.
        faces: The face that is hit.
        weights: Barycentric weights of its corners. Zero at corners whose vertex normal faces
            away, the others sum to one.
        texels: Sub-texel that the ray went through.
        rays: Rays that were traced.
        missed: Rays that hit nothing although their bit says that they must.
    """

    counts: Int64[Tensor, "points"]
    moments: Float32[Tensor, "hits incident"]
    faces: Int32[Tensor, "hits"]
    weights: Float32[Tensor, "hits 3"]
    texels: Int32[Tensor, "hits"]
    rays: int
    missed: int

    @property
    def num_bytes(self) -> int:
        """Memory they take."""
        tensors = (self.counts, self.moments, self.faces, self.weights, self.texels)
        return sum(tensor.nbytes for tensor in tensors)


class HitFinder:
    """Finds the hits of blocks of points, and keeps those that fit in 1 GiB.

    Args:
        mesh: The scene.
        visibility: Its visibility bits.
        resolution: Coarse texels along an edge of a face of the cube. Taken down to the next
            divisor of the sub-texels along an edge.
        order: Bands of the harmonics to integrate.
        points_at_once: Largest block; never more than what is quick.
    """

    def __init__(
        self,
        mesh: Mesh,
        visibility: VisibilityField,
        *,
        resolution: int,
        order: int,
        points_at_once: int = _POINTS_AT_ONCE,
    ):
        self._mesh, self._visibility = mesh, visibility
        self._points_at_once = max(1, min(points_at_once, _POINTS_AT_ONCE))
        fine = visibility.resolution
        self._coarse = max(d for d in range(1, min(resolution, fine) + 1) if fine % d == 0)
        self._subtexels = _by_coarse_texel(fine, self._coarse)
        directions = cubemap_directions(fine, dtype=torch.float64).reshape(-1, 3)
        solid_angles = cubemap_solid_angles(fine, dtype=torch.float64).reshape(-1, 1)
        functions = (sh.evaluate(directions, order) * solid_angles)[self._subtexels]
        self._functions = functions.float()
        self._whole_texels = functions.sum(1).float()
        self._directions = directions.float()
        self._grouped_directions = self._directions[self._subtexels].flatten(0, 1).mT.contiguous()
        self._normals = mesh.normals.float()
        geometry = face_geometry(mesh.vertices.numpy(), mesh.faces.numpy())
        self._face_normals = torch.from_numpy(geometry.normals).float()
        self._sequence = _texel_sequence(self._coarse)
        self._kept: dict[int, Hits] = {}
        self._kept_bytes = 0

    @functools.cached_property
    def _tracer(self) -> Tracer:
        """Built only when there is something to trace."""
        return Tracer(self._mesh, self._visibility.resolution)

    def blocks(self, rows: slice) -> Iterator[slice]:
        """A range of points cut into blocks that :meth:`find` takes."""
        return pieces(rows, self._points_at_once)

    def nothing_hidden(self) -> bool:
        """Whether every point sees the sky in all directions above its horizon."""
        if self._visibility.hides_nothing:
            return True
        everything = slice(0, self._mesh.num_points)
        return not any(bool(self._hidden(block).any()) for block in self.blocks(everything))

    def find(self, block: slice) -> Hits:
        """Hits of a block of points.

        Args:
            block: One of :meth:`blocks`.
        """
        if block.start in self._kept:
            return self._kept[block.start]
        hits = self._traced(block)
        if self._kept_bytes + hits.num_bytes <= _KEPT_BYTES:
            # What is found again costs no ray.
            self._kept[block.start] = Hits(
                hits.counts, hits.moments, hits.faces, hits.weights, hits.texels, 0, 0
            )
            self._kept_bytes += hits.num_bytes
        return hits

    def _traced(self, block: slice) -> Hits:
        hidden = self._hidden(block)
        counts = hidden.view(torch.uint8).sum(-1, dtype=torch.int32)  # faster than of booleans
        point, coarse = counts.nonzero(as_tuple=True)
        count, some = counts[point, coarse], hidden[point, coarse]
        wanted = (self._sequence[coarse] * count).long()
        chosen = (some.cumsum(-1, dtype=torch.int32) <= wanted[:, None]).sum(-1)
        texels = self._subtexels[coarse, chosen]
        moments = self._whole_texels[coarse]
        partly = (count < some.shape[1]).nonzero()[:, 0]
        moments[partly] = torch.einsum(
            "hs,hsi->hi", some[partly].float(), self._functions[coarse[partly]]
        )
        faces, weights = self._closest(point + block.start, texels)
        used, weights = self._lit(faces, weights, texels)
        return Hits(
            counts=torch.bincount(point[used], minlength=block.stop - block.start),
            moments=moments[used],
            faces=faces[used],
            weights=weights[used],
            texels=texels[used].int(),
            rays=len(texels),
            missed=int((faces < 0).sum()),
        )

    def _hidden(self, block: slice) -> Bool[Tensor, "points texels subtexels"]:
        """Sub-texels above the horizon of each point that do not see the sky."""
        by_texel = self._subtexels.flatten().numpy()
        seen = np.take(self._visibility.unpack(block).numpy(), by_texel, axis=1)
        above = self._normals[block] @ self._grouped_directions > _HORIZON
        hidden = above > torch.from_numpy(seen).view(torch.bool)
        return hidden.view(len(hidden), *self._subtexels.shape)

    def _closest(
        self, points: Int64[Tensor, "rays"], texels: Int64[Tensor, "rays"]
    ) -> tuple[Int32[Tensor, "rays"], Float32[Tensor, "rays 3"]]:
        """Closest hits with as many threads as torch uses; Embree releases the GIL."""
        workers = torch.get_num_threads()
        pieces = zip(
            np.array_split(points.numpy(), workers),
            np.array_split(texels.numpy(), workers),
            strict=True,
        )
        tracer = self._tracer
        with ThreadPoolExecutor(workers) as pool:
            found = list(pool.map(lambda piece: tracer.closest(*piece), pieces))
        faces = np.concatenate([faces for faces, _ in found])
        weights = np.concatenate([weights for _, weights in found])
        return torch.from_numpy(faces), torch.from_numpy(weights)

    def _lit(
        self,
        faces: Int32[Tensor, "rays"],
        weights: Float32[Tensor, "rays 3"],
        texels: Int64[Tensor, "rays"],
    ) -> tuple[Bool[Tensor, "rays"], Float32[Tensor, "rays 3"]]:
        """Which rays hit a front, and weights of those corners that face the ray."""
        faces = faces.long()  # -1 indexes the last face, and is sorted out at the end
        directions = self._directions[texels]
        front = (self._face_normals[faces] * directions).sum(-1) < 0
        corner_normals = self._normals[self._mesh.faces[faces]]
        facing = (corner_normals * directions[:, None]).sum(-1) < 0
        weights = weights.clamp_min(0.0) * facing
        total = weights.sum(-1)
        used = (faces >= 0) & front & (total > 0)
        return used, weights / torch.where(used, total, 1.0)[:, None]


def _by_coarse_texel(fine: int, coarse: int) -> Int64[Tensor, "texels subtexels"]:
    """Sub-texels of each coarse texel of a cube."""
    per_edge = fine // coarse
    texels = torch.arange(6 * fine * fine).view(6, coarse, per_edge, coarse, per_edge)
    return texels.transpose(2, 3).reshape(-1, per_edge * per_edge)


def _texel_sequence(resolution: int) -> Float64[Tensor, "texels"]:
    """A number in [0, 1) for each texel, unlike those of its neighbours.

    Source:
        Roberts, "The unreasonable effectiveness of quasirandom sequences", 2018.
    """
    line = torch.arange(resolution, dtype=torch.float64)
    face = torch.arange(6, dtype=torch.float64)[:, None, None] / _GOLDEN
    lattice = face + line[:, None] / _PLASTIC**2 + line / _PLASTIC + 0.5
    return lattice.frac().reshape(-1)
