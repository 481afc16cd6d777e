"""A strict reader of STL, binary and ASCII.

STL has no shared vertices: the three corners of each facet are its points, in file order, and
nothing is welded. Facet normals in the file are ignored, as winding says the same.
"""

from pathlib import Path

import numpy as np

from prt_torch.assets.mesh_formats.raw import RawMesh
from prt_torch.errors import InputError

_HEADER_BYTES = 84
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def _ascii_corners(path: Path, data: bytes) -> np.ndarray:
    """Coordinates of the ``vertex`` lines."""
    rows = []
    for number, line in enumerate(data.splitlines(), start=1):
        words = line.split()
        if not words or words[0] != b"vertex":
            continue
        try:
            x, y, z = (float(word) for word in words[1:])
        except ValueError:
            raise InputError(f"{path}: line {number}: a vertex needs 3 numbers") from None
        rows.append((x, y, z))
    if b"endsolid" not in data[-1024:]:
        raise InputError(f"{path}: truncated, endsolid is missing after {len(rows)} vertices")
    if len(rows) % 3:
        raise InputError(f"{path}: {len(rows)} vertices do not make whole triangles")
    return np.array(rows, np.float64).reshape(-1, 3)


def _binary_corners(path: Path, data: bytes) -> np.ndarray:
    """Coordinates of the facets' corners."""
    if len(data) < _HEADER_BYTES:
        raise InputError(f"{path}: truncated, {len(data)} bytes are less than an STL header")
    count = int.from_bytes(data[80:_HEADER_BYTES], "little")
    needed = _HEADER_BYTES + count * _FACET.itemsize
    if needed != len(data):
        raise InputError(
            f"{path}: claims {count} triangles, which take {needed} bytes, but has {len(data)}"
        )
    facets = np.frombuffer(data, _FACET, count, _HEADER_BYTES)
    return facets["corners"].astype(np.float64).reshape(-1, 3)


def read_stl(path: Path, data: bytes) -> RawMesh:
    """Read an STL file: three points per facet, in file order.

    Raises:
        InputError: If the file is truncated or claims more facets than it holds.
    """
    # Binary files may start with "solid" too, so a length that fits exactly decides first.
    count = int.from_bytes(data[80:_HEADER_BYTES], "little")
    fits = len(data) == _HEADER_BYTES + count * _FACET.itemsize
    if not fits and data.lstrip()[:5] == b"solid" and b"\0" not in data[:_HEADER_BYTES]:
        vertices = _ascii_corners(path, data)
    else:
        vertices = _binary_corners(path, data)
    return RawMesh(
        vertices=vertices,
        corners=np.arange(len(vertices), dtype=np.int64),
        sizes=np.full(len(vertices) // 3, 3, np.int64),
    )
