"""What every mesh reader returns: the file's own vertices and polygons, not yet checked."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64


@dataclass(frozen=True)
class RawPart:
    """A run of vertices and polygons that belong together, such as one node of a scene."""

    name: str
    first_vertex: int
    num_vertices: int
    first_polygon: int
    num_polygons: int


@dataclass(frozen=True)
class RawMesh:
    """Vertices and polygons as the file has them, in the file's order.

    Indices are zero-based but not yet checked against the number of vertices.
    """

    vertices: Float64[np.ndarray, "points 3"]
    """Positions in mesh units, possibly not finite."""
    corners: Int64[np.ndarray, "corners"]
    """Vertex of every polygon corner, polygon after polygon."""
    sizes: Int64[np.ndarray, "polygons"]
    """Number of corners of each polygon."""
    normals: Float64[np.ndarray, "points 3"] | None = None
    """Normals from the file, of any length; NaN where it gives none, zero where unusable."""
    albedo: Float64[np.ndarray, "points 3"] | None = None
    """Linear vertex colours; NaN where the file gives none."""
    uv: Float64[np.ndarray, "corners 2"] | None = None
    """Texture coordinates of every polygon corner, v up; not finite where there are none."""
    parts: tuple[RawPart, ...] = ()
    """Parts of the file, or none where it knows no parts."""
    first_index: int = 0
    """How the format counts vertices and faces, for messages: OBJ counts from 1."""
    split_normals: int = 0
    """Vertices whose corners name several different normals (these rows are NaN)."""


def finite_normals(normals: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, "points 3"]:
    """Normals with zero for those that are not finite: NaN is left to mean that there is none."""
    return np.where(np.isfinite(normals).all(axis=1, keepdims=True), normals, 0.0)


def linear_from_srgb(encoded: Float[np.ndarray, "*shape"]) -> Float64[np.ndarray, "*shape"]:
    """Linear light from sRGB-encoded values in [0, 1] (IEC 61966-2-1)."""
    encoded = np.asarray(encoded, np.float64)
    curve = ((np.maximum(encoded, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, encoded / 12.92, curve)
