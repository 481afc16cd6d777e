"""A strict reader of glTF 2.0 scenes (.glb, .gltf): triangles, normals and vertex colours.

Nodes are concatenated in depth-first order with their transforms applied, each one a part.
Primitives of a node that share positions share points. Colours are linear by the standard:
COLOR_0 times the material's baseColorFactor, either alone where the other is missing. Textures,
skins, morph targets and animations are not read: the mesh is taken in its rest pose.
"""

import base64
import binascii
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float64, Int64

from prt_torch.assets.input_file import read_input
from prt_torch.assets.mesh_formats.raw import RawMesh, RawPart, finite_normals
from prt_torch.assets.mesh_geometry import transform_mesh
from prt_torch.errors import InputError

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TRIANGLES = 4
# Nodes may use one mesh many times: a bound on what a small file can ask for.
_MAX_POINTS = 1 << 26
_HARMLESS_EXTENSIONS = ("KHR_materials_", "KHR_texture_", "KHR_mesh_quantization", "KHR_lights_")


@dataclass(frozen=True)
class _Scene:
    """The JSON of a scene and the bytes of its buffers."""

    path: Path
    document: dict[str, Any]
    buffers: list[bytes]

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """One entry of a top-level list; a negative index does not count from the end."""
        entries = self.document.get(kind, [])
        if not isinstance(index, int) or not 0 <= index < len(entries):
            raise InputError(
                f"{self.path}: refers to {kind}[{index}], of which there are {len(entries)}"
            )
        return entries[index]

    def accessor(self, index: Any) -> np.ndarray:
        """Values of an accessor, ``"count width"``, normalised integers as fractions."""
        accessor = self.item("accessors", index)
        if "sparse" in accessor or "bufferView" not in accessor:
            raise InputError(f"{self.path}: accessors[{index}] is sparse, which is not supported")
        view = self.item("bufferViews", accessor["bufferView"])
        self.item("buffers", view["buffer"])
        content = self.buffers[view["buffer"]]
        dtype = np.dtype(_COMPONENTS[accessor["componentType"]])
        width = _WIDTHS[accessor["type"]]
        count, start = accessor["count"], accessor.get("byteOffset", 0)
        row = dtype.itemsize * width
        stride = view.get("byteStride", row)
        base, length = view.get("byteOffset", 0), view["byteLength"]
        if min(count, start, base, length) < 0 or stride < row:
            raise InputError(f"{self.path}: accessors[{index}] has a negative size or stride")
        used = start + (count - 1) * stride + row if count else 0
        if used > length or base + length > len(content):
            raise InputError(
                f"{self.path}: accessors[{index}] claims {count} items, {used} bytes, of a view "
                f"of {length} bytes in a buffer of {len(content)}"
            )
        values = np.ndarray((count, width), dtype, content, base + start, (stride, dtype.itemsize))
        if accessor.get("normalized", False):
            return np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values


def _split_glb(path: Path, data: bytes) -> tuple[bytes, bytes | None]:
    """The JSON and the binary chunk of a GLB container."""
    length = int.from_bytes(data[8:12], "little")
    if len(data) < 20 or length > len(data):
        raise InputError(f"{path}: truncated, claims {length} bytes but has {len(data)}")
    if (version := int.from_bytes(data[4:8], "little")) != 2:
        raise InputError(f"{path}: glTF version {version}, expected 2")
    chunks: dict[bytes, bytes] = {}
    position = 12
    while position + 8 <= length:
        size = int.from_bytes(data[position : position + 4], "little")
        kind = data[position + 4 : position + 8]
        position += 8
        if position + size > length:
            raise InputError(f"{path}: truncated, chunk {kind!r} claims {size} bytes")
        chunks.setdefault(kind, data[position : position + size])
        position += size
    return chunks.get(b"JSON", b""), chunks.get(b"BIN\0")


def _read_buffer(path: Path, index: int, buffer: dict[str, Any], binary: bytes | None) -> bytes:
    """Bytes of a buffer: the GLB's own chunk, base64 in the JSON, or a file beside the scene."""
    uri = buffer.get("uri")
    if uri is None:
        if index != 0 or binary is None:
            raise InputError(f"{path}: buffers[{index}] has no content")
        content = binary
    elif uri.startswith("data:"):
        content = base64.b64decode(uri.partition(",")[2], validate=True)
    else:
        relative = PurePosixPath(unquote(uri))
        # A scene from elsewhere has no business outside its own folder.
        if relative.is_absolute() or ".." in relative.parts or ":" in uri:
            raise InputError(f"{path}: buffers[{index}] lies outside the scene's folder")
        _, content = read_input(path.parent / relative, "glTF buffer")
    if buffer["byteLength"] > len(content):
        raise InputError(
            f"{path}: buffers[{index}] claims {buffer['byteLength']} bytes but has {len(content)}"
        )
    return content


def _open(path: Path, data: bytes) -> _Scene:
    """Parse the document and fetch its buffers."""
    text, binary = _split_glb(path, data) if data[:4] == b"glTF" else (data, None)
    document = json.loads(text)
    for extension in document.get("extensionsRequired", []):
        if not extension.startswith(_HARMLESS_EXTENSIONS):
            raise InputError(f"{path}: needs the glTF extension {extension}, not supported")
    buffers = [
        _read_buffer(path, index, buffer, binary)
        for index, buffer in enumerate(document.get("buffers", []))
    ]
    return _Scene(path, document, buffers)


def _local_transform(node: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    """A node's matrix, or its translation, rotation (a quaternion x, y, z, w) and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    quaternion = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    # Writers round it, and a length other than 1 would be a scale.
    x, y, z, w = quaternion / max(np.linalg.norm(quaternion), np.finfo(np.float64).tiny)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _nodes(scene: _Scene) -> Iterator[tuple[int, dict[str, Any], Float64[np.ndarray, "4 4"]]]:
    """Nodes of the default scene, depth first, with their world transforms."""
    if scene.document.get("scenes"):
        roots = scene.item("scenes", scene.document.get("scene", 0)).get("nodes", [])
    else:
        nodes = scene.document.get("nodes", [])
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [index for index in range(len(nodes)) if index not in children]
    seen: set[int] = set()
    stack = [(index, np.eye(4)) for index in reversed(roots)]
    while stack:
        index, parent = stack.pop()
        node = scene.item("nodes", index)
        if index in seen:
            raise InputError(f"{scene.path}: nodes[{index}] has two parents or is its own ancestor")
        seen.add(index)
        world = parent @ _local_transform(node)
        yield index, node, world
        stack.extend((child, world) for child in reversed(node.get("children", [])))


@dataclass
class _Points:
    """Points that several primitives share, and the faces on them."""

    vertices: Float64[np.ndarray, "points 3"]
    normals: Float64[np.ndarray, "points 3"]
    albedo: Float64[np.ndarray, "points 3"]
    faces: list[Int64[np.ndarray, "faces 3"]]


def _add_primitive(scene: _Scene, primitive: dict[str, Any], groups: dict[Any, _Points]) -> None:
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
        groups[key] = _Points(vertices, normals, albedo.copy(), [])
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
    points.faces.append(indices.reshape(-1, 3))
    if "material" in primitive:
        material = scene.item("materials", primitive["material"])
        factor = material.get("pbrMetallicRoughness", {}).get("baseColorFactor")
        if factor is not None:
            used = np.unique(indices)
            colour = points.albedo[used]
            colour = np.where(np.isnan(colour), 1.0, colour) if key[2] is None else colour
            points.albedo[used] = colour * np.array(factor[:3], np.float64)


def _node_points(scene: _Scene, node: dict[str, Any]) -> list[_Points]:
    """Points of a node's triangle primitives; primitives of points and lines have no surface."""
    groups: dict[Any, _Points] = {}
    for primitive in scene.item("meshes", node["mesh"])["primitives"]:
        mode = primitive.get("mode", _TRIANGLES)
        if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
            raise InputError(f"{scene.path}: compressed meshes (Draco) are not supported")
        if mode > _TRIANGLES:
            raise InputError(f"{scene.path}: triangle strips and fans are not supported")
        if mode == _TRIANGLES:
            _add_primitive(scene, primitive, groups)
    return list(groups.values())


def _assemble(scene: _Scene) -> RawMesh:
    """All nodes, transformed and concatenated."""
    blocks: list[_Points] = []
    parts: list[RawPart] = []
    num_vertices = num_faces = 0
    for index, node, world in _nodes(scene):
        if "mesh" not in node:
            continue
        first_vertex, first_face = num_vertices, num_faces
        for points in _node_points(scene, node):
            faces = np.concatenate(points.faces)
            vertices, normals, faces = transform_mesh(points.vertices, points.normals, faces, world)
            blocks.append(_Points(vertices, normals, points.albedo, [faces + num_vertices]))
            num_vertices += len(vertices)
            num_faces += len(faces)
            if num_vertices > _MAX_POINTS:
                raise InputError(f"{scene.path}: the scene has more than {_MAX_POINTS} points")
        name = node.get("name") or scene.item("meshes", node["mesh"]).get("name")
        parts.append(
            RawPart(
                name=str(name or f"node{index}"),
                first_vertex=first_vertex,
                num_vertices=num_vertices - first_vertex,
                first_polygon=first_face,
                num_polygons=num_faces - first_face,
            )
        )
    none = np.zeros((0, 3))
    return RawMesh(
        vertices=np.concatenate([none, *(block.vertices for block in blocks)]),
        corners=np.concatenate(
            [np.zeros(0, np.int64), *(face.ravel() for block in blocks for face in block.faces)]
        ),
        sizes=np.full(num_faces, 3, np.int64),
        normals=np.concatenate([none, *(block.normals for block in blocks)]),
        albedo=np.concatenate([none, *(block.albedo for block in blocks)]),
        parts=tuple(parts),
    )


def read_gltf(path: Path, data: bytes) -> RawMesh:
    """Read a glTF scene.

    Raises:
        InputError: If the container is truncated, an accessor, view or buffer claims more than
            there is, an index is out of range, or the scene needs a compression extension.
    """
    try:
        return _assemble(_open(path, data))
    except InputError:
        raise
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: the JSON cannot be read ({error})") from None
    except binascii.Error:
        raise InputError(f"{path}: the base64 of a buffer cannot be read") from None
    # The document may have any shape: a missing or mistyped field shows up as one of these.
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, RecursionError) as error:
        raise InputError(f"{path}: not a valid glTF document ({type(error).__name__})") from None
