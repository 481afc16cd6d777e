"""The document of a glTF 2.0 scene: its JSON, its buffers, accessors and nodes, all checked.

What the readers of meshes (:mod:`gltf`) and of skins and animations build on.
"""

import base64
import binascii
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float64

from prt_torch.assets.input_file import read_input
from prt_torch.errors import InputError

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_HARMLESS_EXTENSIONS = ("KHR_materials_", "KHR_texture_", "KHR_mesh_quantization", "KHR_lights_")


@dataclass(frozen=True)
class Scene:
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


def open_scene(path: Path, data: bytes) -> Scene:
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
    return Scene(path, document, buffers)


def composed(
    translation: Float64[np.ndarray, "*batch 3"],
    rotation: Float64[np.ndarray, "*batch 4"],
    scale: Float64[np.ndarray, "*batch 3"],
) -> Float64[np.ndarray, "*batch 4 4"]:
    """Matrices that scale, then rotate by a quaternion (x, y, z, w), then move."""
    # Writers round quaternions, and a length other than 1 would be a scale.
    length = np.linalg.norm(rotation, axis=-1, keepdims=True)
    x, y, z, w = np.moveaxis(rotation / np.maximum(length, np.finfo(np.float64).tiny), -1, 0)
    matrix = np.zeros((*rotation.shape[:-1], 4, 4))
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    matrix[..., :3, :3] = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    matrix[..., :3, :3] *= scale[..., None, :]
    matrix[..., :3, 3] = translation
    matrix[..., 3, 3] = 1.0
    return matrix


REST = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}
"""What a node has that says nothing else."""


def local_transform(node: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    """A node's matrix, or its translation, rotation (a quaternion x, y, z, w) and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    return composed(*(np.array(node.get(name, rest), np.float64) for name, rest in REST.items()))


def nodes(scene: Scene) -> Iterator[tuple[int, dict[str, Any], Float64[np.ndarray, "4 4"]]]:
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
        world = parent @ local_transform(node)
        yield index, node, world
        stack.extend((child, world) for child in reversed(node.get("children", [])))


@contextmanager
def refusals(path: Path) -> Iterator[None]:
    """Turns whatever a malformed document raises into one line.

    Raises:
        InputError: Where the document has not the shape that the standard gives it.
    """
    try:
        yield
    except InputError:
        raise
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: the JSON cannot be read ({error})") from None
    except binascii.Error:
        raise InputError(f"{path}: the base64 of a buffer cannot be read") from None
    # The document may have any shape: a missing or mistyped field shows up as one of these.
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, RecursionError) as error:
        raise InputError(f"{path}: not a valid glTF document ({type(error).__name__})") from None
