"""Which parts of the sky each point sees: rays traced once into bits.

One bit a ray, point times cube sub-texel. Every transfer in every basis is a projection of these
bits, so a new material or light basis costs no ray.

Rays are Embree any-hit queries from each point, lifted off its surface along the normal, towards
all sub-texel centres above its horizon. The scene is centred and scaled to a unit box first:
Embree computes in float32 and a mesh far from the origin would lose its digits. Rays start a
fixed share of the box above the surface; shares from 1e-7 to 1e-5 give the same bits.
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
from jaxtyping import UInt8
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
        cached: Whether it was read from a cache instead.
    """

    bits: Rows
    resolution: int
    rays: int
    seconds: float
    cached: bool

    def unpack(self, rows: slice) -> UInt8[Tensor, "points texels"]:
        """Bits of some points, one a byte."""
        return torch.from_numpy(np.unpackbits(self.bits[rows].numpy(), axis=1))


class Tracer:
    """Embree over one scene: rays from its points towards the texels of a cube map.

    Args:
        mesh: The scene.
        resolution: Texels along an edge of a face.
    """

    def __init__(self, mesh: Mesh, resolution: int):
        low, high = mesh.vertices.amin(0), mesh.vertices.amax(0)
        scale = float((high - low).max()) or 1.0
        unit = (mesh.vertices - (low + high) / 2) / scale
        self._scene = EmbreeScene()
        TriangleMesh(
            self._scene, unit.numpy().astype(np.float32), mesh.faces.numpy().astype(np.int32)
        )
        self._origins = (unit + _RAY_OFFSET * mesh.normals).numpy().astype(np.float32)
        self._normals = mesh.normals.numpy().astype(np.float32)
        directions = cubemap_directions(resolution).reshape(-1, 3).numpy()
        self._directions = np.ascontiguousarray(directions)
        self._by_axis = np.ascontiguousarray(directions.T)
        self.num_bytes = len(directions) // 8
        # Embree builds its hierarchy on the first query, not safely from two threads.
        self.occluded(self._origins[:1], self._directions[:1])

    def rays(self, point: int) -> tuple[np.ndarray, np.ndarray]:
        """Origins and directions of the rays of one point, ``"rays 3"`` each."""
        above = self._above(point)
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

    def trace(self, points: range) -> tuple[np.ndarray, int]:
        """Packed bits of some points, and how many rays that took."""
        num_texels = len(self._directions)
        bits = np.zeros((len(points), self.num_bytes), np.uint8)
        targets = np.empty((num_texels, 3), np.float32)
        origins = np.empty((num_texels, 3), np.float32)
        rays = 0
        for row, point in enumerate(points):
            above = self._above(point)
            count = len(above)
            if count == 0:
                continue
            np.take(self._directions, above, axis=0, out=targets[:count], mode="clip")
            for axis in range(3):
                origins[:count, axis] = self._origins[point, axis]
            free = np.zeros(num_texels, bool)
            free[above] = self.occluded(origins[:count], targets[:count]) == _FREE
            bits[row] = np.packbits(free)
            rays += count
        return bits, rays

    def _above(self, point: int) -> np.ndarray:
        """Texels above the horizon of a point."""
        return np.flatnonzero(self._normals[point] @ self._by_axis > 0)


def trace_visibility(
    mesh: Mesh,
    *,
    resolution: int = 32,
    supersampling: int = 4,
    cache: Path | None = None,
    progress: Progress | None = None,
) -> VisibilityField:
    """Trace the visibility of every point of a scene.

    Threads are as many as torch uses; the bits do not depend on their number.

    Args:
        mesh: The scene. Points without a normal see nothing and cost no ray.
        resolution: Texels along an edge of a cube face.
        supersampling: Rays along an edge of a texel.
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
    texels = 6 * fine * fine
    tracer: list[Tracer] = []

    def trace(rows: slice) -> tuple[dict[str, Tensor], dict[str, int | float]]:
        start = time.perf_counter()
        if not tracer:  # built only when there is something to trace
            tracer.append(Tracer(mesh, fine))
        bits, rays = _trace_in_threads(tracer[0], rows)
        return {"bits": bits}, {"rays": rays, "seconds": time.perf_counter() - start}

    inputs = {
        "vertices": store.digest(mesh.vertices),
        "faces": store.digest(mesh.faces),
        "normals": store.digest(mesh.normals),
        "texels_per_edge": fine,
        "ray_offset": _RAY_OFFSET,
        "algorithm": _ALGORITHM,
    }
    built = store.build_sharded(
        trace,
        rows=mesh.num_points,
        rows_per_shard=max(1, min(4096, _BITS_PER_SHARD // texels)),
        inputs=inputs,
        folder=None if cache is None else Path(cache) / f"visibility-{store.digest(inputs)[:16]}",
        progress=progress,
    )
    return VisibilityField(
        built.tensors["bits"],
        fine,
        int(built.counts["rays"]),
        built.counts["seconds"],
        built.cached,
    )


def _trace_in_threads(tracer: Tracer, rows: slice) -> tuple[Tensor, int]:
    """Trace a block of points with as many threads as torch uses; Embree releases the GIL."""
    workers = torch.get_num_threads()
    points = range(rows.start, rows.stop)
    # Interleaved pieces, so that a thread with dark points does not end long before the others.
    pieces = [points[worker::workers] for worker in range(workers) if points[worker::workers]]
    bits = np.empty((len(points), tracer.num_bytes), np.uint8)
    with ThreadPoolExecutor(workers) as pool:
        results = list(pool.map(tracer.trace, pieces))
    for worker, (piece_bits, _) in enumerate(results):
        bits[worker::workers] = piece_bits
    return torch.from_numpy(bits), sum(rays for _, rays in results)
