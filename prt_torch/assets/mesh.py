"""Meshes as baking needs them: validated, with a normal and an albedo at every vertex.

The file's vertices are the points of the transfer, so their number and order are never changed.
What is wrong with a mesh is either an error (it cannot be baked) or a named, counted warning (it
can be, and this is what follows).
"""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64, Int, Int64
from torch import Tensor

from prt_torch.assets.input_file import read_input
from prt_torch.assets.mesh_formats import READERS, RawMesh, finite_normals
from prt_torch.assets.mesh_geometry import (
    connectivity,
    face_geometry,
    fan_triangles,
    normalised,
    placement,
    transform_mesh,
    vertex_normals,
)
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
    "recomputed_normals": "{count} normals in the file are zero or not finite; computed from faces",
    "split_normals": "{count} vertices have several normals in the file; computed from faces",
    "opposed_normals": "{count} normals in the file point behind their faces; points there may be "
    "black",
    "inward_normals": "{count} faces point inwards, so all points will be black; "
    "set scene.orientation=flip",
    "flipped": "{count} faces pointed inwards and were turned outwards",
}


@dataclass(frozen=True)
class Part:
    """A run of faces that belong together, such as one node of a scene or one group of a file.

    Its vertices lie in a run of their own, which runs of other parts may overlap.
    """

    name: str
    first_vertex: int
    num_vertices: int
    first_face: int
    num_faces: int


@dataclass(frozen=True)
class MeshWarning:
    """A defect that a mesh can be baked with, how often it occurs, and what follows from it."""

    name: str
    count: int
    message: str


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh whose vertices are the points of the transfer.

    Made by :func:`load_mesh` and :func:`mesh_from_arrays`, which validate; not meant to be built
    by hand.
    """

    name: str
    vertices: Float64[Tensor, "points 3"]
    """Positions in mesh units, +y up."""
    faces: Int64[Tensor, "faces 3"]
    """Vertices of each triangle, counter-clockwise seen from outside."""
    normals: Float64[Tensor, "points 3"]
    """Unit normals; exactly zero at points that have none, whose transfer is zero."""
    albedo: Float64[Tensor, "points 3"]
    """Diffuse reflectance in linear RGB, 0 to 1."""
    parts: tuple[Part, ...]
    """Parts in file order; one part where the file knows none."""
    warnings: tuple[MeshWarning, ...]
    """Defects found, in the order of this module's table of messages."""

    @property
    def num_points(self) -> int:
        """Number of vertices, isolated ones included."""
        return self.vertices.shape[0]

    @property
    def num_faces(self) -> int:
        """Number of triangles."""
        return self.faces.shape[0]

    @property
    def bounds(self) -> Float64[Tensor, "2 3"]:
        """Lowest and highest corner of the box around all faces, in mesh units."""
        used = self.vertices[self.faces.reshape(-1)]
        return torch.stack([used.amin(dim=0), used.amax(dim=0)])

    @property
    def extent(self) -> float:
        """Length of the diagonal of the bounding box, in mesh units."""
        low, high = self.bounds
        return float((high - low).norm())


def _warnings(counts: dict[str, int]) -> tuple[MeshWarning, ...]:
    """Warnings of all names that occurred."""
    return tuple(
        MeshWarning(name, count, message.format(count=count))
        for name, message in _MESSAGES.items()
        if (count := counts.get(name, 0))
    )


def _checked_faces(source: str, raw: RawMesh) -> Int64[np.ndarray, "faces 3"]:
    """Triangles, after every number and index of the mesh has been found usable."""
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
    return fan_triangles(raw.corners, raw.sizes)


def _checked_albedo(
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


def _choose_normals(
    given: Float64[np.ndarray, "points 3"] | None,
    computed: Float64[np.ndarray, "points 3"],
    used: np.ndarray,
    counts: dict[str, int],
) -> Float64[np.ndarray, "points 3"]:
    """The file's normals where they are usable, computed ones elsewhere, none without a face."""
    if given is None:
        chosen = computed
    else:
        unit = normalised(given)
        usable = (unit != 0).any(axis=1)
        chosen = np.where(usable[:, None], unit, computed)
        # Where the file gives no normal, or several, there is NaN, which is nothing to warn of.
        counts["recomputed_normals"] = int((used & (given == 0).all(axis=1)).sum())
        counts["opposed_normals"] = int((used & ((chosen * computed).sum(axis=1) < 0)).sum())
    counts["isolated_vertices"] = int((~used).sum())
    chosen = np.where(used[:, None], chosen, 0.0)
    counts["undefined_normals"] = int((used & (chosen == 0).all(axis=1)).sum())
    return chosen


def _finish(
    name: str,
    source: str,
    vertices: Float64[np.ndarray, "points 3"],
    faces: Int64[np.ndarray, "faces 3"],
    normals: Float64[np.ndarray, "points 3"] | None,
    albedo: Float64[np.ndarray, "points 3"] | None,
    parts: tuple[Part, ...],
    orientation: Literal["file", "flip", "outward"],
    split_normals: int,
) -> Mesh:
    """Orient the faces, choose normals and albedo, and count what is wrong."""
    defects = connectivity(vertices, faces)
    match orientation:
        case "file":
            flip = False
        case "flip":
            flip = True
        case "outward":
            flip = defects.side < 0
        case _:
            raise InputError(f"scene.orientation={orientation}: expected file, flip or outward")
    if flip:
        faces = faces[:, [0, 2, 1]]
        normals = None if normals is None else -normals
    side = -defects.side if flip else defects.side
    geometry = face_geometry(vertices, faces)
    used = np.bincount(faces.ravel(), minlength=len(vertices)) > 0
    counts = {
        "split_normals": split_normals,
        "zero_area_faces": int((geometry.normals == 0).all(axis=1).sum()),
        "duplicate_faces": defects.duplicate_faces,
        "open_boundary": defects.open_edges,
        "non_manifold_edges": defects.non_manifold_edges,
        "inward_normals": len(faces) if side < 0 else 0,
        "flipped": len(faces) if flip and orientation == "outward" else 0,
    }
    computed = vertex_normals(geometry, faces, len(vertices))
    chosen = _choose_normals(normals, computed, used, counts)
    colour = np.full_like(vertices, np.nan) if albedo is None else albedo
    return Mesh(
        name=name,
        vertices=torch.from_numpy(np.ascontiguousarray(vertices)),
        faces=torch.from_numpy(np.ascontiguousarray(faces)),
        normals=torch.from_numpy(np.ascontiguousarray(chosen)),
        albedo=torch.from_numpy(_checked_albedo(source, colour)),
        parts=parts or (Part(name, 0, len(vertices), 0, len(faces)),),
        warnings=_warnings(counts),
    )


def load_mesh(
    path: str | os.PathLike[str],
    *,
    up: Literal["y", "z"] = "y",
    transform: Sequence[Sequence[float]] | Float[Tensor, "4 4"] | None = None,
    orientation: Literal["file", "flip", "outward"] = "file",
    albedo: tuple[float, float, float] | None = None,
) -> Mesh:
    """Load an OBJ, PLY, STL, OFF, GLB or glTF file, keeping its vertices as they are.

    Polygons become fans of triangles. Normals are the file's where a vertex has exactly one
    usable normal, and angle-weighted averages of its faces elsewhere. Vertex colours become the
    albedo, sRGB-decoded but for glTF, whose colours are linear; a point without one gets
    :data:`DEFAULT_ALBEDO`. STL facets share no points. The parts of a scene are its nodes,
    those of an OBJ file its runs of one material, else of one group or object.

    Args:
        path: The file; its suffix names the format.
        up: The file's axis that becomes the world's +y; ``"z"`` turns the mesh about x.
        transform: Affine matrix applied after ``up``, acting on columns. A mirroring one keeps
            outsides outside.
        orientation: ``"file"`` trusts the winding, ``"flip"`` reverses winding and normals,
            ``"outward"`` does so only where faces enclose the surface from inside.
        albedo: Linear RGB in [0, 1] for all points, instead of the file's colours.

    Raises:
        InputError: If the file is missing, empty, truncated or of another format; has no faces;
            has coordinates that are not finite or indices out of range; claims more than it
            holds; or an argument is out of range.
    """
    read = READERS.get(Path(path).suffix.lower())
    if read is None:
        raise InputError(f"{path}: unknown mesh format, expected one of {', '.join(READERS)}")
    file, data = read_input(path, "mesh")
    raw = read(file, data)
    faces = _checked_faces(str(path), raw)
    given = np.full_like(raw.vertices, np.nan) if raw.normals is None else raw.normals
    matrix = placement(up, transform)
    vertices, normals, faces = transform_mesh(raw.vertices, given, faces, matrix)
    colours = raw.albedo
    if albedo is not None:
        colours = np.broadcast_to(np.asarray(albedo, np.float64), vertices.shape)
    first_face = np.concatenate([[0], np.cumsum(raw.sizes - 2)])
    parts = tuple(
        Part(
            part.name,
            part.first_vertex,
            part.num_vertices,
            first := int(first_face[part.first_polygon]),
            int(first_face[part.first_polygon + part.num_polygons]) - first,
        )
        for part in raw.parts
    )
    return _finish(
        name=file.stem,
        source=str(path) if albedo is None else "scene.albedo",
        vertices=vertices,
        faces=faces,
        normals=None if raw.normals is None else normals,
        albedo=colours,
        parts=parts,
        orientation=orientation,
        split_normals=raw.split_normals,
    )


def _numpy(tensor: Float[Tensor, "points 3"]) -> Float64[np.ndarray, "points 3"]:
    """A copy, so that the mesh does not change with the caller's tensor."""
    return tensor.detach().cpu().double().numpy().copy()


def mesh_from_arrays(
    name: str,
    vertices: Float[Tensor, "points 3"],
    faces: Int[Tensor, "faces 3"],
    *,
    normals: Float[Tensor, "points 3"] | None = None,
    albedo: Float[Tensor, "points 3"] | None = None,
) -> Mesh:
    """A mesh from tensors, with the checks and defaults of :func:`load_mesh`.

    Args:
        name: What messages and reports call it.
        vertices: Positions in mesh units.
        faces: Zero-based vertices of each triangle, counter-clockwise from outside.
        normals: Normals of any length; angle-weighted averages of the faces by default.
        albedo: Linear RGB in [0, 1]; :data:`DEFAULT_ALBEDO` by default.

    Raises:
        InputError: If a number is not finite, or an index or albedo is out of range.
    """
    points = _numpy(vertices)
    corners = faces.detach().cpu().long().reshape(-1).numpy()
    raw = RawMesh(points, corners, np.full(len(corners) // 3, 3))
    return _finish(
        name=name,
        source=name,
        vertices=points,
        faces=_checked_faces(name, raw),
        normals=None if normals is None else finite_normals(_numpy(normals)),
        albedo=None if albedo is None else _numpy(albedo),
        parts=(),
        orientation="file",
        split_normals=0,
    )


def concatenate(meshes: Iterable[Mesh], name: str) -> Mesh:
    """Several meshes as one: points, faces and parts follow each other, warnings add up.

    Raises:
        ValueError: If there is no mesh.
    """
    meshes = tuple(meshes)
    if not meshes:
        raise ValueError("expected at least one mesh")
    parts: list[Part] = []
    faces: list[Tensor] = []
    counts: dict[str, int] = {}
    num_vertices = num_faces = 0
    for mesh in meshes:
        faces.append(mesh.faces + num_vertices)
        parts.extend(
            replace(
                part,
                first_vertex=part.first_vertex + num_vertices,
                first_face=part.first_face + num_faces,
            )
            for part in mesh.parts
        )
        for warning in mesh.warnings:
            counts[warning.name] = counts.get(warning.name, 0) + warning.count
        num_vertices += mesh.num_points
        num_faces += mesh.num_faces
    return Mesh(
        name=name,
        vertices=torch.cat([mesh.vertices for mesh in meshes]),
        faces=torch.cat(faces),
        normals=torch.cat([mesh.normals for mesh in meshes]),
        albedo=torch.cat([mesh.albedo for mesh in meshes]),
        parts=tuple(parts),
        warnings=_warnings(counts),
    )
