"""Which parts of the sky each point sees: rays traced once into bits.

One bit a ray, point times cube sub-texel. Every transfer in every basis is a projection of these
bits, so a new material or light basis costs no ray.

Rays are Embree any-hit queries from each point, lifted off its surface along the normal, towards
all sub-texel centres above its horizon. The scene is centred and scaled to a unit box first:
Embree computes in float32 and a mesh far from the origin would lose its digits. Rays start a
fixed share of the box above the surface; shares from 1e-7 to 1e-5 give the same bits.

What can be known without rays costs none. From a point with no face above its tangent plane
nothing is hidden (:func:`proven_free`), and its bits follow from its normal. Where that holds of
all points, as on anything convex, no bit is kept either: :class:`HorizonBits` makes them where they
are read.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Float64, Int64, UInt8
from torch import Tensor

from prt_torch import store
from prt_torch.assets.mesh import Mesh
from prt_torch.sphere import cubemap_directions
from prt_torch.transfer import Rows

Progress = Callable[[int, int], None]
"""Told of points done and points in all."""

_RAY_OFFSET = 4e-6  # of the unit box, along the normal
_ALGORITHM = 1  # raise it when the same inputs would give other bits, so that caches are not reused
_FREE = -1  # embreex marks a ray that hits nothing with -1, and with 0 one that is occluded
_BITS_PER_SHARD = 2**26
_REACH = 2e-6  # of the unit box, above a tangent plane: half the lift of the rays
_LOOKED_ALONG = 4  # texels along an edge of the cube of directions in which vertices are outermost
_PAIRS_ALONG = 512  # of points and of vertices, whose products stay in the processor's cache


@dataclass(frozen=True)
class VisibilityField:
    """Visibility bits of every point of a scene.

    Attributes:
        bits: ``"points bytes"`` uint8, eight texels a byte, most significant first, texels in
            ``"6 row col"`` order; 1 where the sky is seen, 0 where it is hidden or below the
            horizon of the point.
        resolution: Sub-texels along an edge of a cube face.
        rays: How many rays were traced for it.
        seconds: How long that took.
        cached: Whether nothing was traced: it was read from a cache, or follows from the normals.
        free_points: Points that were proven to see all above their horizon, and cost no ray.
    """

    bits: Rows
    resolution: int
    rays: int
    seconds: float
    cached: bool
    free_points: int = 0

    @property
    def hides_nothing(self) -> bool:
        """Whether all points are proven to see all above their horizon, so that no bit is kept."""
        return isinstance(self.bits, HorizonBits)

    def unpack(self, rows: slice) -> UInt8[Tensor, "points texels"]:
        """Bits of some points, one a byte."""
        return torch.from_numpy(np.unpackbits(self.bits[rows].numpy(), axis=1))


class HorizonBits:
    """Bits of points that see all above their horizon, made from normals where they are read.

    Args:
        normals: Unit normals; points whose normal is zero see nothing.
        resolution: Sub-texels along an edge of a cube face.
    """

    dtype = torch.uint8

    def __init__(self, normals: Float[Tensor, "points 3"], resolution: int):
        directions = cubemap_directions(resolution).reshape(-1, 3).numpy()
        self._by_axis = np.ascontiguousarray(directions.T)
        self._normals = normals.numpy().astype(np.float32)
        self.shape = (len(normals), directions.shape[0] // 8)

    def __getitem__(self, rows: slice, /) -> UInt8[Tensor, "points bytes"]:
        points = range(*rows.indices(self.shape[0]))
        bits = np.empty((len(points), self.shape[1]), np.uint8)
        for row, point in enumerate(points):
            bits[row] = self.of_point(point)
        return torch.from_numpy(bits)

    def of_point(self, point: int) -> UInt8[np.ndarray, "bytes"]:
        """Bits of one point."""
        return np.packbits(self.above(point))

    def above(self, point: int) -> Bool[np.ndarray, "texels"]:
        """Texels above the horizon of a point."""
        # Point by point: a product with many normals rounds otherwise, and bits must not differ.
        return self._normals[point] @ self._by_axis > 0


def proven_free(mesh: Mesh) -> Bool[Tensor, "points"]:
    r"""Which points are proven to see all above their horizon, without a ray.

    No ray from a point p with normal n meets a face if all of them stay below the plane that the
    ray starts above:

    .. math:: \max_v\, n \cdot (v - p) \le \epsilon

    over vertices v of faces, with half the lift of the rays as :math:`\epsilon`. So it is at every
    point of a convex object, open or closed, if normals are within the cones of the faces beside
    them. The other way round, a vertex above the plane by more is seen from the point or hidden by
    something that is, unless it is in the horizon's last 1e-6: the test decides points exactly.
    Vertices without a face, and the mesh's scale, do not matter.

    Nearly all points that are not free fail at one of the few vertices that are outermost along
    some direction; only those left meet all vertices. At a convex object that is all of them, at
    some 2 ns a pair: a hundredth of what tracing 40,000 points takes, a sixth at a million.

    Args:
        mesh: The scene.

    Returns:
        True also at points without a normal, which see nothing and cost no ray anyway.
    """
    points, _ = _in_unit_box(mesh)
    corners = points[mesh.faces.reshape(-1).unique()]
    reach = (points * mesh.normals).sum(1) + _REACH
    left = torch.arange(mesh.num_points)
    for vertices in (_outermost(corners), corners):
        left = torch.cat(
            [_highest(some, vertices, mesh.normals, reach) for some in left.split(_PAIRS_ALONG)]
        )
    free = torch.zeros(mesh.num_points, dtype=torch.bool)
    free[left] = True
    return free


def _highest(
    points: Int64[Tensor, "some"],
    vertices: Float64[Tensor, "vertices 3"],
    normals: Float64[Tensor, "points 3"],
    reach: Float64[Tensor, "points"],
) -> Int64[Tensor, "fewer"]:
    """Those of some points that no vertex is farther along the normal of than ``reach``."""
    for block in vertices.split(_PAIRS_ALONG):
        if not len(points):
            break
        points = points[(normals[points] @ block.mT).amax(1) <= reach[points]]
    return points


def _outermost(vertices: Float64[Tensor, "vertices 3"]) -> Float64[Tensor, "some 3"]:
    """The vertices farthest along some of all directions."""
    directions = cubemap_directions(_LOOKED_ALONG, dtype=torch.float64).reshape(-1, 3)
    found = [(vertices @ direction).argmax() for direction in directions]
    return vertices[torch.stack(found).unique()]


def _in_unit_box(mesh: Mesh) -> tuple[Float64[Tensor, "points 3"], bool]:
    """Points in the centred box of the faces, whose longest edge is 1.

    And whether points without a face lie outside it.
    """
    low, high = mesh.bounds
    outside = bool(((mesh.vertices < low) | (mesh.vertices > high)).any())
    scale = float((high - low).max()) or 1.0
    return (mesh.vertices - (low + high) / 2) / scale, outside


class Tracer:
    """Embree over one scene: rays from its points towards the texels of a cube map.

    Args:
        mesh: The scene.
        resolution: Texels along an edge of a face.
    """

    def __init__(self, mesh: Mesh, resolution: int):
        unit, _ = _in_unit_box(mesh)
        self._scene = EmbreeScene()
        TriangleMesh(
            self._scene, unit.numpy().astype(np.float32), mesh.faces.numpy().astype(np.int32)
        )
        self._origins = (unit + _RAY_OFFSET * mesh.normals).numpy().astype(np.float32)
        directions = cubemap_directions(resolution).reshape(-1, 3).numpy()
        self._directions = np.ascontiguousarray(directions)
        self.horizon = HorizonBits(mesh.normals, resolution)
        # Embree builds its hierarchy on the first query, not safely from two threads.
        self.occluded(self._origins[:1], self._directions[:1])

    def rays(self, point: int) -> tuple[np.ndarray, np.ndarray]:
        """Origins and directions of the rays of one point, ``"rays 3"`` each."""
        above = np.flatnonzero(self.horizon.above(point))
        targets = self._directions[above]
        return np.tile(self._origins[point], (len(above), 1)), targets

    def occluded(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Bare Embree any-hit queries: 0 where a ray hits something, -1 where it is free."""
        return self._scene.run(origins, directions, query="OCCLUDED")

    def closest(self, points: np.ndarray, texels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bare Embree closest-hit queries, each from a point through a texel.

        Returns:
            ``"rays"`` faces, -1 where a ray hits nothing, and ``"rays 3"`` barycentric weights of
            their corners.
        """
        found = self._scene.run(
            self._origins[points], self._directions[texels], query="INTERSECT", output=1
        )
        u, v = found["u"], found["v"]  # of the second and the third corner
        return found["primID"], np.stack([1 - u - v, u, v], axis=-1)

    def hidden(
        self, points: Int64[np.ndarray, "rays"], directions: Float[np.ndarray, "rays 3"]
    ) -> Bool[np.ndarray, "rays"]:
        """Whether something hides the sky, along one direction from each point."""
        towards = np.ascontiguousarray(directions, np.float32)
        return self.occluded(self._origins[points], towards) != _FREE

    def trace(
        self, points: range, free: Bool[np.ndarray, "all_points"] | None = None
    ) -> tuple[UInt8[np.ndarray, "points bytes"], int]:
        """Packed bits of some points, and how many rays that took.

        Args:
            points: Which.
            free: Which of all points of the scene see all above their horizon, and cost no ray;
                none if not given.
        """
        num_texels = len(self._directions)
        bits = np.zeros((len(points), self.horizon.shape[1]), np.uint8)
        targets = np.empty((num_texels, 3), np.float32)
        origins = np.empty((num_texels, 3), np.float32)
        rays = 0
        for row, point in enumerate(points):
            if free is not None and free[point]:
                bits[row] = self.horizon.of_point(point)
                continue
            above = np.flatnonzero(self.horizon.above(point))
            count = len(above)
            if count == 0:
                continue
            np.take(self._directions, above, axis=0, out=targets[:count], mode="clip")
            for axis in range(3):
                origins[:count, axis] = self._origins[point, axis]
            seen = np.zeros(num_texels, bool)
            seen[above] = self.occluded(origins[:count], targets[:count]) == _FREE
            bits[row] = np.packbits(seen)
            rays += count
        return bits, rays


def trace_visibility(
    mesh: Mesh,
    *,
    resolution: int = 32,
    supersampling: int = 4,
    trace_all: bool = False,
    cache: Path | None = None,
    progress: Progress | None = None,
) -> VisibilityField:
    """Trace the visibility of every point of a scene.

    Points that are proven to see all above their horizon cost no ray; where all are, nothing is
    kept, in memory or in a cache. Threads are as many as torch uses; the bits do not depend on
    their number.

    Args:
        mesh: The scene. Points without a normal see nothing and cost no ray.
        resolution: Texels along an edge of a cube face.
        supersampling: Rays along an edge of a texel.
        trace_all: Trace points that are proven free, too. The bits are the same.
        cache: Folder of bakes. Bits are kept there by the hash of geometry and resolution, and a
            killed trace resumes. Without it they stay in memory: 12 KiB a point at the defaults.
        progress: Told of points done and points in all.

    Raises:
        ValueError: If resolution times supersampling is not a positive even number.
        InputError: If the cache cannot be written or is damaged.
    """
    fine = resolution * supersampling
    if min(resolution, supersampling) < 1 or fine % 2:
        raise ValueError(f"expected resolution times supersampling to be even, got {fine}")
    start = time.perf_counter()
    free = torch.zeros(mesh.num_points, dtype=torch.bool) if trace_all else proven_free(mesh)
    proof_seconds = time.perf_counter() - start
    free_points = int((free & (mesh.normals != 0).any(1)).sum())
    if bool(free.all()):
        bits = HorizonBits(mesh.normals, fine)
        if progress:
            progress(mesh.num_points, mesh.num_points)
        return VisibilityField(bits, fine, 0, proof_seconds, True, free_points)
    tracer: list[Tracer] = []

    def trace(rows: slice) -> tuple[dict[str, Tensor], dict[str, int | float]]:
        start = time.perf_counter()
        if not tracer:  # built only when there is something to trace
            tracer.append(Tracer(mesh, fine))
        bits, rays = _trace_in_threads(tracer[0], rows, free.numpy())
        return {"bits": bits}, {"rays": rays, "seconds": time.perf_counter() - start}

    inputs = followed(mesh, fine)
    built = store.build_sharded(
        trace,
        rows=mesh.num_points,
        rows_per_shard=max(1, min(4096, _BITS_PER_SHARD // (6 * fine * fine))),
        inputs=inputs,
        folder=None if cache is None else Path(cache) / f"visibility-{store.digest(inputs)[:16]}",
        progress=progress,
    )
    return VisibilityField(
        built.tensors["bits"],
        fine,
        int(built.counts["rays"]),
        built.counts["seconds"] + proof_seconds,
        built.cached,
        free_points,
    )


def followed(mesh: Mesh, resolution: int) -> dict[str, str | int | float]:
    """What visibility bits follow from, and so all that is made of them.

    Args:
        mesh: The scene.
        resolution: Sub-texels along an edge of a cube face.
    """
    inputs = {
        "vertices": store.digest(mesh.vertices),
        "faces": store.digest(mesh.faces),
        "normals": store.digest(mesh.normals),
        "texels_per_edge": resolution,
        "ray_offset": _RAY_OFFSET,
        "algorithm": _ALGORITHM,
    }
    # Of all points, in bits kept before this was added.
    return {**inputs, "box": "of faces"} if _in_unit_box(mesh)[1] else inputs


def _trace_in_threads(
    tracer: Tracer, rows: slice, free: Bool[np.ndarray, "all_points"]
) -> tuple[Tensor, int]:
    """Trace a block of points with as many threads as torch uses; Embree releases the GIL."""
    workers = torch.get_num_threads()
    points = range(rows.start, rows.stop)
    # Interleaved pieces, so that a thread with dark points does not end long before the others.
    pieces = [points[worker::workers] for worker in range(workers) if points[worker::workers]]
    bits = np.empty((len(points), tracer.horizon.shape[1]), np.uint8)
    with ThreadPoolExecutor(workers) as pool:
        results = list(pool.map(lambda piece: tracer.trace(piece, free), pieces))
    for worker, (piece_bits, _) in enumerate(results):
        bits[worker::workers] = piece_bits
    return torch.from_numpy(bits), sum(rays for _, rays in results)
