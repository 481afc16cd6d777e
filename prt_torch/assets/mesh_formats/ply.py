"""A strict reader of PLY: ASCII, little-endian and big-endian.

Every count in the header is checked against the bytes that follow before anything is allocated,
and a file that ends early is an error (general loaders return the faces read so far).
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64

from prt_torch.assets.mesh_formats.raw import RawMesh, finite_normals, linear_from_srgb
from prt_torch.errors import InputError

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS: dict[str, Literal["=", "<", ">"]] = {
    "ascii": "=",
    "binary_little_endian": "<",
    "binary_big_endian": ">",
}
_UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
_MAX_HEADER_BYTES = 1 << 16


@dataclass(frozen=True)
class _Property:
    name: str
    dtype: np.dtype
    count_dtype: np.dtype | None
    """Type of the count in front of a list; None for a single value."""


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...]

    def row_dtype(self, lengths: dict[str, int]) -> np.dtype:
        """Layout of one row whose lists have the given lengths."""
        fields: list[tuple] = []
        for item in self.properties:
            if item.count_dtype is None:
                fields.append((item.name, item.dtype))
            else:
                fields.append((f"count {item.name}", item.count_dtype))
                fields.append((item.name, item.dtype, (lengths[item.name],)))
        return np.dtype(fields)


_Column = tuple[np.ndarray, np.ndarray]
"""Values of one property, and how many belong to each row."""


def _parse_header(path: Path, data: bytes) -> tuple[str, list[_Element], int]:
    """Format, elements, and where the body starts."""
    end = re.search(rb"\nend_header[ \t]*\r?\n", data[:_MAX_HEADER_BYTES])
    if not data.startswith(b"ply") or end is None:
        raise InputError(f"{path}: not a PLY file, or its header is cut off")
    order: Literal["=", "<", ">"] | None = None
    elements: list[_Element] = []
    for line in data[: end.start()].decode("ascii", "replace").splitlines()[1:]:
        try:
            match line.split():
                case ["format", name, _]:
                    order = _ORDERS[name]
                case ["element", name, count]:
                    elements.append(_Element(name, int(count), ()))
                case ["property", *words] if order:
                    last = elements[-1]
                    properties = (*last.properties, _parse_property(words, order))
                    elements[-1] = _Element(last.name, last.count, properties)
        except (KeyError, ValueError, IndexError, TypeError):
            raise InputError(f"{path}: header line not understood: {line[:80]!r}") from None
    if order is None:
        raise InputError(f"{path}: the header names no format")
    for element in elements:
        names = [item.name for item in element.properties]
        if element.count < 0 or len(set(names)) != len(names):
            raise InputError(f"{path}: element {element.name!r} has a bad count or property")
    return order, elements, end.end()


def _parse_property(words: list[str], order: Literal["=", "<", ">"]) -> _Property:
    """One property line; KeyError or ValueError where it is not understood."""
    if words[0] == "list":
        _, count_type, value_type, name = words
        count_dtype = np.dtype(_TYPES[count_type]).newbyteorder(order)
        if count_dtype.kind == "f":
            raise ValueError("a count is not a fraction")
        return _Property(name, np.dtype(_TYPES[value_type]).newbyteorder(order), count_dtype)
    value_type, name = words
    return _Property(name, np.dtype(_TYPES[value_type]).newbyteorder(order), None)


def _truncated(path: Path, element: _Element, row: int) -> InputError:
    return InputError(
        f"{path}: claims {element.count} of element {element.name!r}, "
        f"but the file ends within number {row}"
    )


def _uniform_rows(
    body: np.ndarray, position: int, element: _Element, dtype: np.dtype, counts: dict[str, int]
) -> dict[str, _Column] | None:
    """All rows at once where every list has the length that it has in the first row."""
    end = position + element.count * dtype.itemsize
    if end > body.nbytes:
        return None
    rows = body.view(np.uint8)[position:end].view(dtype)
    columns = {}
    for item in element.properties:
        length = counts.get(item.name, 1)
        if item.count_dtype is not None and (rows[f"count {item.name}"] != length).any():
            return None
        columns[item.name] = (rows[item.name].reshape(-1), np.full(element.count, length))
    return columns


def _walk_rows(
    path: Path, body: np.ndarray, position: int, element: _Element
) -> tuple[dict[str, _Column], int]:
    """Row by row, for lists of mixed length; and where the next element starts."""
    content = body.view(np.uint8)
    values: dict[str, list] = {item.name: [] for item in element.properties}
    lengths: dict[str, list[int]] = {item.name: [] for item in element.properties}
    for row in range(element.count):
        for item in element.properties:
            length = 1
            if item.count_dtype is not None:
                end = position + item.count_dtype.itemsize
                if end > len(content):
                    raise _truncated(path, element, row)
                count = content[position:end].view(item.count_dtype)[0]
                if not 0 <= count <= len(content) or count != int(count):
                    raise InputError(f"{path}: {element.name} {row}: {count} is not a length")
                length = int(count)
                position = end
            end = position + length * item.dtype.itemsize
            if end > len(content):
                raise _truncated(path, element, row)
            values[item.name].extend(content[position:end].view(item.dtype).tolist())
            lengths[item.name].append(length)
            position = end
    columns = {name: (np.array(values[name]), np.array(lengths[name])) for name in values}
    return columns, position


def _read_element(
    path: Path, body: np.ndarray, position: int, element: _Element
) -> tuple[dict[str, _Column], int]:
    """Columns of one element, and where the next one starts."""
    if element.count == 0 or not element.properties:
        empty = np.zeros(0, np.int64)
        return {item.name: (empty, empty) for item in element.properties}, position
    shortest = element.row_dtype({item.name: 0 for item in element.properties}).itemsize
    if position + element.count * shortest > body.nbytes:
        raise _truncated(path, element, (body.nbytes - position) // max(shortest, 1))
    first = _Element(element.name, 1, element.properties)
    columns, _ = _walk_rows(path, body, position, first)
    counts = {
        item.name: int(columns[item.name][1][0])
        for item in element.properties
        if item.count_dtype is not None
    }
    dtype = element.row_dtype(counts)
    uniform = _uniform_rows(body, position, element, dtype, counts)
    if uniform is not None:
        return uniform, position + element.count * dtype.itemsize
    return _walk_rows(path, body, position, element)


def _ascii_as_doubles(
    path: Path, data: bytes, elements: list[_Element]
) -> tuple[np.ndarray, list[_Element]]:
    """An ASCII body as the binary body of doubles that it stands for."""
    words = data.split()
    try:
        body = np.fromiter(map(float, words), np.float64, len(words))
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    double = np.dtype(np.float64)
    widened = [
        _Element(
            element.name,
            element.count,
            tuple(
                _Property(item.name, double, double if item.count_dtype is not None else None)
                for item in element.properties
            ),
        )
        for element in elements
    ]
    return body, widened


def _columns(
    columns: dict[str, _Column], names: tuple[str, ...]
) -> Float64[np.ndarray, "points width"] | None:
    """Scalar properties side by side, or None where one is missing."""
    if not all(name in columns for name in names):
        return None
    return np.stack([columns[name][0].astype(np.float64) for name in names], axis=1)


def _uv(columns: dict[str, _Column]) -> Float64[np.ndarray, "points 2"] | None:
    """Texture coordinates by any of the names in use."""
    found = (_columns(columns, names) for names in _UV_NAMES)
    return next((uv for uv in found if uv is not None), None)


def _albedo(
    columns: dict[str, _Column], element: _Element
) -> Float64[np.ndarray, "points 3"] | None:
    """Linear vertex colours; integers are fractions of their type's maximum."""
    names = ("red", "green", "blue")
    colour = _columns(columns, names)
    if colour is None:
        return None
    dtype = next(item.dtype for item in element.properties if item.name == "red")
    return linear_from_srgb(colour / (1.0 if dtype.kind == "f" else np.iinfo(dtype).max))


def _whole(path: Path, indices: np.ndarray) -> Int64[np.ndarray, "corners"]:
    """Indices as integers: ASCII bodies and odd writers hold them as floating-point numbers."""
    if indices.dtype.kind == "f":
        wrong = ~(np.isfinite(indices) & (indices == np.rint(indices)))
        if wrong.any():
            raise InputError(f"{path}: {indices[wrong][0]} is not a vertex index")
    return indices.astype(np.int64)


def _at_corners(
    uv: Float64[np.ndarray, "points 2"] | None, corners: Int64[np.ndarray, "corners"]
) -> Float64[np.ndarray, "corners 2"] | None:
    """What vertices have, at the corners of faces; NaN at corners out of range, refused later."""
    if uv is None:
        return None
    inside = (corners >= 0) & (corners < len(uv))
    # The last row stands for vertices that there are not.
    return np.append(uv, [[np.nan, np.nan]], axis=0)[np.where(inside, corners, -1)]


def read_ply(path: Path, data: bytes) -> RawMesh:
    """Read a PLY file; vertex colours (red, green, blue) are taken as sRGB.

    Texture coordinates are those of vertices (s and t, or u and v), v up.

    Raises:
        InputError: If the header is not understood or the file ends early.
    """
    order, elements, start = _parse_header(path, data)
    if order == "=":
        body, layouts = _ascii_as_doubles(path, data[start:], elements)
    else:
        body, layouts = np.frombuffer(data[start:], np.uint8), elements
    vertices = normals = albedo = uv = None
    corners: Int64[np.ndarray, "corners"] = np.zeros(0, np.int64)
    sizes: Int64[np.ndarray, "polygons"] = np.zeros(0, np.int64)
    position = 0
    for element, layout in zip(elements, layouts, strict=True):
        columns, position = _read_element(path, body, position, layout)
        if element.name == "vertex":
            vertices = _columns(columns, ("x", "y", "z"))
            normals = _columns(columns, ("nx", "ny", "nz"))
            albedo = _albedo(columns, element)
            uv = _uv(columns)
        elif element.name == "face":
            name = next((n for n in ("vertex_indices", "vertex_index") if n in columns), None)
            if name is None:
                raise InputError(f"{path}: element 'face' has no list vertex_indices")
            corners, sizes = _whole(path, columns[name][0]), columns[name][1].astype(np.int64)
    if vertices is None:
        raise InputError(f"{path}: element 'vertex' with x, y and z is missing")
    return RawMesh(
        vertices=vertices,
        corners=corners,
        sizes=sizes,
        normals=normals if normals is None else finite_normals(normals),
        albedo=albedo,
        uv=_at_corners(uv, corners),
    )
