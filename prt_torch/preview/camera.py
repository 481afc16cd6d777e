"""Where a picture is taken from, and the rays through its pixels."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from prt_torch.assets.mesh import Mesh
from prt_torch.sphere import rotation_about_up


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in world coordinates.

    Attributes:
        eye: Where it stands.
        target: What it looks at; appears in the middle of the picture.
        up: A direction that appears upwards; any length, not along the line of sight.
        vertical_fov_degrees: Angle between the top and the bottom edge of the picture.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    vertical_fov_degrees: float = 35.0

    @classmethod
    def framing(
        cls,
        mesh: Mesh,
        *,
        azimuth_degrees: float = 30.0,
        elevation_degrees: float = 22.0,
        vertical_fov_degrees: float = 35.0,
        aspect: float = 4 / 3,
        margin: float = 1.3,
    ) -> "Camera":
        """A camera that shows a whole mesh but for its ground, and a little of what is round it.

        A part of the name ``ground`` does not count: the object stays large, and the margin shows
        the shadow beside it.

        Args:
            mesh: The scene.
            azimuth_degrees: 0 looks along -z; grows as the camera walks towards +x.
            elevation_degrees: Height of the camera above the horizon, inside (-90, 90).
            vertical_fov_degrees: Angle between the top and the bottom edge of the picture.
            aspect: Width of the picture over its height.
            margin: Half the picture over the largest extent of the object from its middle.

        Raises:
            ValueError: If the elevation is out of range, or the mesh has no faces.
        """
        if not -90 < elevation_degrees < 90:
            raise ValueError(f"expected an elevation inside (-90, 90), got {elevation_degrees}")
        points = _framed_points(mesh)
        azimuth, elevation = np.radians(azimuth_degrees), np.radians(elevation_degrees)
        outward = np.array(
            [
                np.sin(azimuth) * np.cos(elevation),
                np.sin(elevation),
                np.cos(azimuth) * np.cos(elevation),
            ]
        )
        axes = _camera_axes(-outward, np.array([0.0, 1.0, 0.0]))
        seen = points @ axes.T
        middle = (seen.min(0) + seen.max(0)) / 2
        seen = seen - middle
        half_height = np.tan(np.radians(vertical_fov_degrees) / 2) / margin
        reach = np.maximum(np.abs(seen[:, 0]) / aspect, np.abs(seen[:, 1])) / half_height
        # A point at depth z before the middle is inside the frame from this distance on.
        distance = float((reach + seen[:, 2]).max()) or 1.0
        target = middle @ axes
        return cls(
            eye=_triple(target + distance * outward),
            target=_triple(target),
            vertical_fov_degrees=vertical_fov_degrees,
        )

    def around(self, count: int) -> Float[Tensor, "count 3"]:
        """Where this camera and others at equal steps around what it looks at stand."""
        eye, target = torch.tensor(self.eye), torch.tensor(self.target)
        turns = [rotation_about_up(360.0 * turn / count).to(eye) for turn in range(count)]
        return torch.stack([target + turn @ (eye - target) for turn in turns])

    def axes(self) -> Float64[np.ndarray, "3 3"]:
        """Rows: right, up and backwards in world coordinates.

        Raises:
            ValueError: If the eye is at the target, or ``up`` is along the line of sight.
        """
        return _camera_axes(np.subtract(self.target, self.eye), np.asarray(self.up, np.float64))

    def directions(
        self, width: int, height: int, samples: int = 1
    ) -> Float64[np.ndarray, "height width samples 3"]:
        """Unit directions of primary rays, ``samples²`` on a regular grid in each pixel."""
        half_height = np.tan(np.radians(self.vertical_fov_degrees) / 2)
        rows = 1 - (np.arange(height * samples) + 0.5) * (2 / (height * samples))
        cols = (np.arange(width * samples) + 0.5) * (2 / (width * samples)) - 1
        local = np.empty((height, width, samples, samples, 3))
        local[..., 0] = (cols * half_height * width / height).reshape(1, width, 1, samples)
        local[..., 1] = (rows * half_height).reshape(height, 1, samples, 1)
        local[..., 2] = -1.0
        world = (local @ self.axes()).reshape(height, width, samples**2, 3)
        return world / np.linalg.norm(world, axis=-1, keepdims=True)


def _framed_points(mesh: Mesh) -> Float64[np.ndarray, "points 3"]:
    """The points that faces other than the ground's use; isolated vertices have no say."""
    framed = np.ones(mesh.num_faces, bool)
    for part in mesh.parts:
        if part.name == "ground":
            framed[part.first_face : part.first_face + part.num_faces] = False
    faces = mesh.faces[torch.from_numpy(framed if framed.any() else ~framed)]
    if len(faces) == 0:
        raise ValueError(f"{mesh.name}: there are no faces to look at")
    return mesh.vertices[faces.unique()].numpy()


def _camera_axes(
    forward: Float64[np.ndarray, "3"], up: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3 3"]:
    right = np.cross(forward, up)
    length = np.linalg.norm(right)
    if not length > 1e-9 * np.linalg.norm(forward) * np.linalg.norm(up):
        raise ValueError("expected a line of sight of some length that is not along 'up'")
    right = right / length
    forward = forward / np.linalg.norm(forward)
    return np.stack([right, np.cross(right, forward), -forward])


def _triple(vector: Float64[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z


def in_unit_box(
    mesh: Mesh, camera: Camera
) -> tuple[Float32[np.ndarray, "points 3"], Float32[np.ndarray, "3"]]:
    """Vertices and eye about the origin: far from it, float32 would lose their digits."""
    low, high = mesh.bounds.numpy()
    middle, scale = (low + high) / 2, float((high - low).max()) or 1.0
    eye = (np.asarray(camera.eye) - middle) / scale
    unit = (mesh.vertices.numpy() - middle) / scale
    return np.ascontiguousarray(unit, np.float32), eye.astype(np.float32)
