"""A strict reader of glTF 2.0 scenes (.glb, .gltf): triangles and what their points have.

Nodes are concatenated in depth-first order with their transforms applied, each one a part.
Primitives of a node that share positions share points; texture coordinates are each one's own, and
turned, as the format's v runs down. Colours are linear by the standard: COLOR_0 times the
material's baseColorFactor, either alone where the other is missing. Textures, skins, morph targets
and animations are not read: the mesh is taken in its rest pose.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from prt_torch.assets.mesh_formats.gltf_document import Scene, nodes, open_scene, refusals
from prt_torch.assets.mesh_formats.raw import RawMesh, RawPart, finite_normals
from prt_torch.assets.mesh_geometry import transform_mesh, turned_over
from prt_torch.errors import InputError

_TRIANGLES = 4
# Nodes may use one mesh many times: a bound on what a small file can ask for.
_MAX_POINTS = 1 << 26


@dataclass
class Points:
    """Points that several primitives share, and the faces on them."""

    vertices: Float64[np.ndarray, "points 3"]
    normals: Float64[np.ndarray, "points 3"]
    albedo: Float64[np.ndarray, "points 3"]
    faces: list[Int64[np.ndarray, "_ 3"]]
    """Of each primitive."""
    uv: list[Float64[np.ndarray, "_ 3 2"]]
    """Of corners, v up; NaN where there are none."""
    attributes: list[dict[str, int]]
    """Accessors of each primitive."""

    def moved(self, matrix: Float64[np.ndarray, "4 4"]) -> "Points":
        """Under an affine transform, outsides staying outside."""
        vertices, normals, mirrored = transform_mesh(self.vertices, self.normals, matrix)
        moved = replace(self, vertices=vertices, normals=normals)
        return moved.turned_over() if mirrored else moved

    def turned_over(self) -> "Points":
        """With faces in the opposite winding."""
        faces, uv = ([turned_over(each) for each in all_of] for all_of in (self.faces, self.uv))
        return replace(self, faces=faces, uv=uv)


def _corner_uv(
    scene: Scene, attributes: dict[str, int], num_points: int
) -> Float64[np.ndarray, "points 2"]:
    """Texture coordinates of a primitive's points, its v turned up; NaN where it has none."""
    if "TEXCOORD_0" not in attributes:
        return np.full((num_points, 2), np.nan)
    uv = scene.accessor(attributes["TEXCOORD_0"]).astype(np.float64)
    if uv.shape != (num_points, 2):
        raise InputError(
            f"{scene.path}: TEXCOORD_0 of a primitive has {len(uv)} rows of {uv.shape[1]}, "
            f"expected {num_points} of 2"
        )
    return np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)


def _add_primitive(scene: Scene, primitive: dict[str, Any], groups: dict[Any, Points]) -> None:
    """Add a primitive's faces to the points that it names."""
    attributes = primitive["attributes"]
    key = tuple(attributes.get(name) for name in ("POSITION", "NORMAL", "COLOR_0"))
    if key not in groups:
        vertices = scene.accessor(key[0]).astype(np.float64)
        missing = np.full_like(vertices, np.nan)
        normals = missing
        if key[1] is not None:
            normals = finite_normals(scene.accessor(key[1]).astype(np.float64))
        albedo = missing if key[2] is None else scene.accessor(key[2])[:, :3].astype(np.float64)
        if vertices.shape[1] != 3 or not vertices.shape == normals.shape == albedo.shape:
            raise InputError(f"{scene.path}: attributes of a primitive differ in number or type")
        groups[key] = Points(vertices, normals, albedo.copy(), [], [], [])
    points = groups[key]
    if "indices" in primitive:
        indices = scene.accessor(primitive["indices"])
        if indices.dtype.kind == "f" or indices.shape[1] != 1:
            raise InputError(f"{scene.path}: the indices of a primitive are not integers")
        indices = indices[:, 0].astype(np.int64)
    else:
        indices = np.arange(len(points.vertices))
    if len(indices) % 3:
        raise InputError(f"{scene.path}: {len(indices)} indices do not make whole triangles")
    wrong = indices >= len(points.vertices)
    if wrong.any():
        first = int(wrong.argmax())
        raise InputError(
            f"{scene.path}: accessors[{primitive['indices']}]: {wrong.sum()} indices are out of "
            f"range, the first is {indices[first]} at {first}, of {len(points.vertices)} vertices"
        )
    points.attributes.append(attributes)
    points.faces.append(indices.reshape(-1, 3))
    points.uv.append(_corner_uv(scene, attributes, len(points.vertices))[indices].reshape(-1, 3, 2))
    if "material" in primitive:
        material = scene.item("materials", primitive["material"])
        factor = material.get("pbrMetallicRoughness", {}).get("baseColorFactor")
        if factor is not None:
            used = np.unique(indices)
            colour = points.albedo[used]
            colour = np.where(np.isnan(colour), 1.0, colour) if key[2] is None else colour
            points.albedo[used] = colour * np.array(factor[:3], np.float64)


def _node_points(scene: Scene, node: dict[str, Any]) -> list[Points]:
    """Points of a node's triangle primitives; primitives of points and lines have no surface."""
    groups: dict[Any, Points] = {}
    for primitive in scene.item("meshes", node["mesh"])["primitives"]:
        mode = primitive.get("mode", _TRIANGLES)
        if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
            raise InputError(f"{scene.path}: compressed meshes (Draco) are not supported")
        if mode > _TRIANGLES:
            raise InputError(f"{scene.path}: triangle strips and fans are not supported")
        if mode == _TRIANGLES:
            _add_primitive(scene, primitive, groups)
    return list(groups.values())


def meshes(
    scene: Scene,
) -> Iterator[tuple[int, str, Float64[np.ndarray, "4 4"], list[Points]]]:
    """Nodes that have a mesh: index, name, world transform, and points where the file has them."""
    num_points = 0
    for index, node, world in nodes(scene):
        if "mesh" not in node:
            continue
        blocks = _node_points(scene, node)
        num_points += sum(len(points.vertices) for points in blocks)
        if num_points > _MAX_POINTS:
            raise InputError(f"{scene.path}: the scene has more than {_MAX_POINTS} points")
        name = node.get("name") or scene.item("meshes", node["mesh"]).get("name")
        yield index, str(name or f"node{index}"), world, blocks


def assembled(named: Iterable[tuple[str, list[Points]]]) -> RawMesh:
    """The points of all nodes one after the other, each node a part."""
    blocks: list[Points] = []
    parts: list[RawPart] = []
    corners = [np.zeros(0, np.int64)]
    num_vertices = num_faces = 0
    for name, points in named:
        first_vertex, first_face = num_vertices, num_faces
        for block in points:
            blocks.append(block)
            corners.extend(faces.ravel() + num_vertices for faces in block.faces)
            num_vertices += len(block.vertices)
            num_faces += sum(map(len, block.faces))
        counts = num_vertices - first_vertex, first_face, num_faces - first_face
        parts.append(RawPart(name, first_vertex, *counts))
    none = np.zeros((0, 3))
    uv = (corner_uv.reshape(-1, 2) for block in blocks for corner_uv in block.uv)
    return RawMesh(
        vertices=np.concatenate([none, *(block.vertices for block in blocks)]),
        corners=np.concatenate(corners),
        sizes=np.full(num_faces, 3, np.int64),
        normals=np.concatenate([none, *(block.normals for block in blocks)]),
        albedo=np.concatenate([none, *(block.albedo for block in blocks)]),
        uv=np.concatenate([np.zeros((0, 2)), *uv]),
        parts=tuple(parts),
    )


def read_gltf(path: Path, data: bytes) -> RawMesh:
    """Read a glTF scene.

    Raises:
        InputError: If the container is truncated, an accessor, view or buffer claims more than
            there is, an index is out of range, or the scene needs a compression extension.
    """
    with refusals(path):
        return assembled(
            (name, [points.moved(world) for points in blocks])
            for _, name, world, blocks in meshes(open_scene(path, data))
        )
