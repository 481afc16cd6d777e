"""A strict reader of tensor files, the container of the RGL material database.

Little-endian: the magic ``tensor_file`` and a zero byte; version (two bytes, 1 and 0); the number
of fields; then for each its name, number of axes, type, offset of the data from the start of the
file, and size along each axis. Nothing is allocated before its place in the file is checked, and
arrays are views of the bytes that were read.
"""

import math
import struct
from pathlib import Path

import numpy as np

from prt_torch.errors import InputError

_MAGIC = b"tensor_file\0"
_HEADER = struct.Struct("<12sBBI")
_FIELD = struct.Struct("<HBQ")
_TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f2", "f4", "f8")  # from 1


def read_tensor_file(path: Path, data: bytes) -> dict[str, np.ndarray]:
    """All fields of a tensor file by name.

    Args:
        path: The file, for messages.
        data: Its content.

    Raises:
        InputError: If it is not a tensor file, of another version, or claims what it does not hold.
    """
    if len(data) < _HEADER.size:
        raise InputError(f"{path}: truncated, {len(data)} bytes are less than a tensor file header")
    magic, major, minor, count = _HEADER.unpack_from(data)
    if magic != _MAGIC:
        raise InputError(f"{path}: not a tensor file, it begins with {data[:12]!r}")
    if (major, minor) != (1, 0):
        raise InputError(f"{path}: version: expected 1.0, got {major}.{minor}")
    fields: dict[str, np.ndarray] = {}
    position = _HEADER.size
    for number in range(count):
        what = f"{path}: field {number + 1} of {count}"
        name, position = _read_name(what, data, position)
        if name in fields:
            raise InputError(f"{what}: the name {name!r} occurs twice")
        fields[name], position = _read_field(f"{path}: {name}", data, position)
    return fields


def _take(what: str, data: bytes, position: int, size: int) -> bytes:
    if position + size > len(data):
        raise InputError(f"{what}: truncated, its description ends beyond {len(data)} bytes")
    return data[position : position + size]


def _read_name(what: str, data: bytes, position: int) -> tuple[str, int]:
    length = int.from_bytes(_take(what, data, position, 2), "little")
    name = _take(what, data, position + 2, length)
    if not (name.isascii() and name.decode("ascii", "replace").isprintable() and name):
        raise InputError(f"{what}: name: expected printable ASCII, got {name[:32]!r}")
    return name.decode("ascii"), position + 2 + length


def _read_field(what: str, data: bytes, position: int) -> tuple[np.ndarray, int]:
    axes, kind, offset = _FIELD.unpack(_take(what, data, position, _FIELD.size))
    position += _FIELD.size
    if not 1 <= kind <= len(_TYPES):
        raise InputError(f"{what}: type: expected 1 to {len(_TYPES)}, got {kind}")
    if axes > 8:
        raise InputError(f"{what}: axes: expected at most 8, got {axes}")
    shape = struct.unpack(f"<{axes}Q", _take(what, data, position, 8 * axes))
    dtype = np.dtype("<" + _TYPES[kind - 1])
    size = math.prod(shape)
    if 0 in shape:
        raise InputError(f"{what}: shape: expected at least 1 along each axis, got {list(shape)}")
    if offset + size * dtype.itemsize > len(data):
        raise InputError(
            f"{what}: claims {size} values of {dtype.itemsize} bytes at byte {offset}, "
            f"the file has {len(data)} bytes"
        )
    return np.frombuffer(data, dtype, size, offset).reshape(shape), position + 8 * axes
