"""The exact picture: primary rays by Embree, interpolated over faces, without OpenGL."""

from dataclasses import dataclass

import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Float32, Int32, UInt8
from torch import Tensor

from prt_torch.assets.environment import Environment
from prt_torch.assets.mesh import Mesh
from prt_torch.preview.camera import Camera, in_unit_box
from prt_torch.preview.images import automatic_limit, error_colours, to_bytes

_RAYS_PER_BLOCK = 2**20
_ERROR_BACKGROUND = 0.5  # grey is no colour of the error map, so the background reads as no data


@dataclass(frozen=True)
class PrimaryHits:
    """What the primary rays of one picture hit.

    Attributes:
        face: Face that each ray hits first, -1 where it leaves the scene.
        weights: Barycentric weights of the corners of that face, zero where there is none.
        directions: Unit directions of the rays.
        corners: Vertices of every face of the mesh.
    """

    face: Int32[np.ndarray, "height width samples"]
    weights: Float32[np.ndarray, "height width samples 3"]
    directions: Float32[np.ndarray, "height width samples 3"]
    corners: Int32[np.ndarray, "faces 3"]

    @property
    def coverage(self) -> Float32[np.ndarray, "height width"]:
        """Share of each pixel's rays that hit the mesh."""
        return (self.face >= 0).mean(-1, dtype=np.float32)

    def shade(
        self, radiance: Float[Tensor, "points rgb"], background: Environment | None = None
    ) -> Float32[np.ndarray, "height width rgb"]:
        """A picture: radiance interpolated over faces, averaged over each pixel, all linear.

        Args:
            radiance: Outgoing linear radiance of each vertex towards the camera.
            background: What is seen beside the mesh; black if None.
        """
        hit = self.face >= 0
        values = radiance.detach().to("cpu", torch.float32).numpy()
        samples = np.zeros((*self.face.shape, values.shape[1]), np.float32)
        corner_values = values[self.corners[self.face[hit]]]
        samples[hit] = np.einsum("nc,ncr->nr", self.weights[hit], corner_values)
        if background is not None and not hit.all():
            directions = torch.from_numpy(self.directions[~hit]).double()
            samples[~hit] = background.radiance(directions).detach().float().cpu().numpy()
        return samples.mean(axis=2, dtype=np.float32)

    def error_map(
        self, errors: Float[Tensor, "points"], limit: float | None = None
    ) -> tuple[UInt8[np.ndarray, "height width 3"], float]:
        """The mesh coloured by an error of each vertex, on grey, and the scale of the colours.

        Args:
            errors: Error of each vertex, not negative, in any unit.
            limit: Error of the brightest colour; a high percentile of what is seen if None.
        """
        covered = self.coverage[..., None]
        values = self.shade(errors[:, None])[..., 0]
        values = np.divide(values, covered[..., 0], out=values, where=covered[..., 0] > 0)
        if limit is None:
            limit = automatic_limit(values[covered[..., 0] > 0])
        colours = error_colours(values, limit) * covered + _ERROR_BACKGROUND * (1 - covered)
        return to_bytes(colours), limit


def trace(mesh: Mesh, camera: Camera, width: int, height: int, samples: int = 2) -> PrimaryHits:
    """Trace the primary rays of a picture, once for any number of lights.

    Args:
        mesh: The scene; faces are seen from both sides.
        camera: Where from.
        width: Pixels in a row, at least 1.
        height: Rows, at least 1.
        samples: Rays along an edge of a pixel, at least 1; a pixel averages their square.

    Raises:
        ValueError: If a count is below 1, or the mesh has no faces.
    """
    if min(width, height, samples) < 1 or len(mesh.faces) == 0:
        raise ValueError(
            f"expected faces, and width, height and samples of at least 1, got {len(mesh.faces)} "
            f"faces and {width}, {height}, {samples}"
        )
    vertices, eye = in_unit_box(mesh, camera)
    corners = np.ascontiguousarray(mesh.faces.numpy(), np.int32)
    scene = EmbreeScene()
    TriangleMesh(scene, vertices, corners)
    directions = camera.directions(width, height, samples).astype(np.float32)
    rays = directions.reshape(-1, 3)
    face = np.empty(len(rays), np.int32)
    weights = np.zeros((len(rays), 3), np.float32)
    for start in range(0, len(rays), _RAYS_PER_BLOCK):
        block = slice(start, start + _RAYS_PER_BLOCK)
        origins = np.tile(eye, (len(rays[block]), 1))
        found = scene.run(origins, np.ascontiguousarray(rays[block]), query="INTERSECT", output=1)
        face[block] = found["primID"]
        u, v = found["u"], found["v"]  # of the second and the third corner
        weights[block] = np.stack([1 - u - v, u, v], axis=-1)
    weights[face < 0] = 0
    shape = directions.shape[:3]
    return PrimaryHits(face.reshape(shape), weights.reshape(*shape, 3), directions, corners)
