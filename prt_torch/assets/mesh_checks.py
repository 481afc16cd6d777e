"""What is wrong with a mesh: errors for what cannot be baked, counted warnings for the rest."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from prt_torch.assets.mesh_formats import RawMesh
from prt_torch.assets.mesh_geometry import fan_triangles
from prt_torch.errors import InputError

DEFAULT_ALBEDO = (0.8, 0.8, 0.8)
"""Linear albedo of points whose file gives no colour."""

# Far beyond any length in use, and its cube is still a float64.
_MAX_COORDINATE = 1e100

_MESSAGES = {
    "isolated_vertices": "{count} vertices belong to no face; they stay, black, in their place",
    "undefined_normals": "{count} vertices have faces but no normal (zero area or cancelling "
    "faces); they stay, black, in their place",
    "zero_area_faces": "{count} faces have no area; they block no light and weigh in no normal",
    "duplicate_faces": "{count} faces repeat another face; they only cost time",
    "open_boundary": "{count} edges have one face; the surface is open, and its back is black",
    "non_manifold_edges": "{count} edges join more than two faces; normals there are averages",
    "mixed_orientation": "{count} edges join faces that show opposite sides; one of the "
    "two is the wrong way round, and points there are too dark",
    "recomputed_normals": "{count} normals in the file are zero or not finite; computed from faces",
    "split_normals": "{count} vertices have several normals in the file; computed from faces",
    "opposed_normals": "{count} normals in the file point behind their faces; points there may be "
    "black",
    "inward_normals": "{count} faces point inwards, so all points will be black; "
    "set scene.orientation=flip",
    "missing_uv": "{count} faces have no usable texture coordinates, where others have",
    "flipped": "{count} faces pointed inwards and were turned outwards",
}


@dataclass(frozen=True)
class MeshWarning:
    """A defect that a mesh can be baked with, how often it occurs, and what follows from it."""

    name: str
    count: int
    message: str


def counted_warnings(counts: dict[str, int]) -> tuple[MeshWarning, ...]:
    """Warnings of all names that occurred."""
    return tuple(
        MeshWarning(name, count, message.format(count=count))
        for name, message in _MESSAGES.items()
        if (count := counts.get(name, 0))
    )


def checked_faces(
    source: str, raw: RawMesh
) -> tuple[Int64[np.ndarray, "faces 3"], Float64[np.ndarray, "faces 3 2"] | None]:
    """Triangles and their texture coordinates, after numbers and indices were found usable."""
    num_points, base = len(raw.vertices), raw.first_index
    if not num_points:
        raise InputError(f"{source}: has no vertices")
    if not len(raw.sizes):
        raise InputError(f"{source}: has no faces; a point cloud has no surface to bake")
    finite = np.isfinite(raw.vertices).all(axis=1)
    if not finite.all():
        raise InputError(
            f"{source}: {num_points - finite.sum()} of {num_points} vertices are not finite, "
            f"the first is vertex {finite.argmin() + base}"
        )
    if (largest := np.abs(raw.vertices).max()) > _MAX_COORDINATE:
        raise InputError(f"{source}: coordinate {largest:.3g} is beyond {_MAX_COORDINATE:.0e}")
    if (raw.sizes < 3).any():
        first = int((raw.sizes < 3).argmax())
        raise InputError(
            f"{source}: {(raw.sizes < 3).sum()} faces have fewer than 3 corners, "
            f"the first is face {first + base}"
        )
    wrong = (raw.corners < 0) | (raw.corners >= num_points)
    if wrong.any():
        corner = int(wrong.argmax())
        face = int(np.searchsorted(np.cumsum(raw.sizes), corner, side="right"))
        raise InputError(
            f"{source}: {wrong.sum()} vertex indices of faces are out of range, the first is "
            f"{raw.corners[corner] + base} in face {face + base} "
            f"(vertices are {base} to {num_points - 1 + base})"
        )
    corner = fan_triangles(np.arange(len(raw.corners)), raw.sizes)
    return raw.corners[corner], None if raw.uv is None else raw.uv[corner]


def checked_albedo(
    source: str, albedo: Float64[np.ndarray, "points 3"]
) -> Float64[np.ndarray, "points 3"]:
    """Albedo with the default where there is none."""
    albedo = np.where(np.isnan(albedo), DEFAULT_ALBEDO, albedo)
    wrong = ((albedo < 0) | (albedo > 1)).any(axis=1)
    if wrong.any():
        first = int(wrong.argmax())
        raise InputError(
            f"{source}: {wrong.sum()} albedos lie outside 0 to 1, the first is "
            f"{albedo[first].tolist()} at vertex {first} (counting from 0)"
        )
    return albedo


def checked_uv(
    uv: Float64[np.ndarray, "faces 3 2"] | None, counts: dict[str, int]
) -> Float64[np.ndarray, "faces 3 2"] | None:
    """Texture coordinates, NaN at all corners of faces that lack one; None if all faces do."""
    if uv is None:
        return None
    usable = np.isfinite(uv).all(axis=(1, 2), keepdims=True)
    counts["missing_uv"] = int((~usable).sum()) if usable.any() else 0
    return np.where(usable, uv, np.nan) if usable.any() else None
