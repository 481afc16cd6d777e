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
from prt_torch.assets.mesh_checks import (
    MeshWarning,
    checked_albedo,
    checked_faces,
    checked_uv,
    counted_warnings,
)
from prt_torch.assets.mesh_formats import READERS, RawMesh, finite_normals
from prt_torch.assets.mesh_geometry import (
    connectivity,
    face_geometry,
    normalised,
    placement,
    transform_mesh,
    turned_over,
    vertex_normals,
)
from prt_torch.errors import InputError


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
    """Defects found, in a fixed order."""
    uv: Float64[Tensor, "faces 3 2"] | None = None
    """Texture coordinates of face corners, so that a seam splits no point; u to the right and v up,
    (0, 0) at the bottom left of an image. NaN at faces that have none; None where no face has."""

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


def _parts(
    name: str, raw: RawMesh, num_faces: int, offsets: Int64[np.ndarray, "ends"]
) -> tuple[Part, ...]:
    """Parts of the file by triangles, ``offsets[k]`` being the first of polygon k."""
    if not raw.parts:
        return (Part(name, 0, len(raw.vertices), 0, num_faces),)
    return tuple(
        Part(
            part.name,
            part.first_vertex,
            part.num_vertices,
            first := int(offsets[part.first_polygon]),
            int(offsets[part.first_polygon + part.num_polygons]) - first,
        )
        for part in raw.parts
    )


def _flips(orientation: Literal["file", "flip", "outward"], side: int) -> bool:
    """Whether faces are to be turned over."""
    match orientation:
        case "file":
            return False
        case "flip":
            return True
        case "outward":
            return side < 0
    raise InputError(f"scene.orientation={orientation}: expected file, flip or outward")


def _turned_over(
    faces: Int64[np.ndarray, "faces 3"], uv: Float64[np.ndarray, "faces 3 2"] | None
) -> tuple[Int64[np.ndarray, "faces 3"], Float64[np.ndarray, "faces 3 2"] | None]:
    return turned_over(faces), None if uv is None else turned_over(uv)


def mesh_from_raw(
    name: str,
    source: str,
    raw: RawMesh,
    *,
    matrix: Float64[np.ndarray, "4 4"] | None = None,
    orientation: Literal["file", "flip", "outward"] = "file",
    albedo: tuple[float, float, float] | None = None,
) -> Mesh:
    """Check what a reader returned, place it, orient its faces, choose normals and albedo.

    Args:
        name: What reports call the mesh.
        source: What messages call it.
        raw: As read.
        matrix: Affine transform of all vertices.
        orientation: As in :func:`load_mesh`.
        albedo: Of all points, instead of the file's colours.

    Raises:
        InputError: As :func:`load_mesh`.
    """
    faces, uv = checked_faces(source, raw)
    vertices, normals = raw.vertices, raw.normals
    if matrix is not None:
        vertices, normals, mirrored = transform_mesh(vertices, normals, matrix)
        faces, uv = _turned_over(faces, uv) if mirrored else (faces, uv)
    defects = connectivity(vertices, faces)
    flip = _flips(orientation, defects.side)
    if flip:
        faces, uv = _turned_over(faces, uv)
        normals = None if normals is None else -normals
    geometry = face_geometry(vertices, faces)
    used = np.bincount(faces.ravel(), minlength=len(vertices)) > 0
    counts = {
        "split_normals": raw.split_normals,
        "zero_area_faces": int((geometry.normals == 0).all(axis=1).sum()),
        "duplicate_faces": defects.duplicate_faces,
        "open_boundary": defects.open_edges,
        "non_manifold_edges": defects.non_manifold_edges,
        "mixed_orientation": defects.twisted_edges,
        "inward_normals": len(faces) if (-defects.side if flip else defects.side) < 0 else 0,
        "flipped": len(faces) if flip and orientation == "outward" else 0,
    }
    computed = vertex_normals(geometry, faces, len(vertices))
    chosen = _choose_normals(normals, computed, used, counts)
    uv = checked_uv(uv, counts)
    colours = np.full_like(vertices, np.nan) if raw.albedo is None else raw.albedo
    if albedo is not None:
        source = "scene.albedo"
        colours = np.broadcast_to(np.asarray(albedo, np.float64), vertices.shape)
    return Mesh(
        name=name,
        vertices=torch.from_numpy(np.ascontiguousarray(vertices)),
        faces=torch.from_numpy(np.ascontiguousarray(faces)),
        normals=torch.from_numpy(np.ascontiguousarray(chosen)),
        albedo=torch.from_numpy(checked_albedo(source, colours)),
        parts=_parts(name, raw, len(faces), np.append(0, np.cumsum(raw.sizes - 2))),
        warnings=counted_warnings(counts),
        uv=None if uv is None else torch.from_numpy(np.ascontiguousarray(uv)),
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
    albedo, sRGB-decoded but for glTF, whose colours are linear; a point without one gets 0.8.
    Texture coordinates are kept at corners of faces, v up (glTF's are turned). STL facets share no
    points. The parts of a scene are its nodes, those of an OBJ file its runs of one material, else
    of one group or object.

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
    return mesh_from_raw(
        file.stem,
        str(path),
        read(file, data),
        matrix=placement(up, transform),
        orientation=orientation,
        albedo=albedo,
    )


def _numpy(tensor: Float[Tensor, "*shape"]) -> Float64[np.ndarray, "*shape"]:
    """A copy, so that the mesh does not change with the caller's tensor."""
    return tensor.detach().cpu().double().numpy().copy()


def mesh_from_arrays(
    name: str,
    vertices: Float[Tensor, "points 3"],
    faces: Int[Tensor, "faces 3"],
    *,
    normals: Float[Tensor, "points 3"] | None = None,
    albedo: Float[Tensor, "points 3"] | None = None,
    uv: Float[Tensor, "faces 3 2"] | None = None,
) -> Mesh:
    """A mesh from tensors, with the checks and defaults of :func:`load_mesh`.

    Args:
        name: What messages and reports call it.
        vertices: Positions in mesh units.
        faces: Zero-based vertices of each triangle, counter-clockwise from outside.
        normals: Normals of any length; angle-weighted averages of the faces by default.
        albedo: Linear RGB in [0, 1]; :data:`~prt_torch.assets.DEFAULT_ALBEDO` if not given.
        uv: Texture coordinates of face corners, v up; NaN at faces that have none.

    Raises:
        InputError: If a number is not finite, or an index or albedo is out of range.
        ValueError: If texture coordinates do not fit the faces.
    """
    if uv is not None and uv.shape != (len(faces), 3, 2):
        raise ValueError(f"expected uv of shape {(len(faces), 3, 2)}, got {tuple(uv.shape)}")
    corners = faces.detach().cpu().long().reshape(-1).numpy()
    raw = RawMesh(
        vertices=_numpy(vertices),
        corners=corners,
        sizes=np.full(len(corners) // 3, 3),
        normals=None if normals is None else finite_normals(_numpy(normals)),
        albedo=None if albedo is None else _numpy(albedo),
        uv=None if uv is None else _numpy(uv).reshape(-1, 2),
    )
    return mesh_from_raw(name, name, raw)


def concatenate(meshes: Iterable[Mesh], name: str) -> Mesh:
    """Several meshes as one: points, faces and parts follow each other, warnings add up.

    Faces of meshes without texture coordinates have NaN for them where others have some.

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
        warnings=counted_warnings(counts),
        uv=_joined_uv(meshes),
    )


def _joined_uv(meshes: tuple[Mesh, ...]) -> Float64[Tensor, "faces 3 2"] | None:
    """Texture coordinates one after the other; None where no mesh has any."""
    if all(mesh.uv is None for mesh in meshes):
        return None
    none = [mesh.vertices.new_full((mesh.num_faces, 3, 2), torch.nan) for mesh in meshes]
    return torch.cat(
        [
            missing if mesh.uv is None else mesh.uv
            for mesh, missing in zip(meshes, none, strict=True)
        ]
    )
