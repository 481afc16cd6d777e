"""A strict reader of OFF and COFF: counts are believed only as far as the lines go."""

from pathlib import Path

import numpy as np

from prt_torch.assets.mesh_formats.raw import RawMesh, linear_from_srgb
from prt_torch.errors import InputError


def _header(path: Path, lines: list[list[bytes]]) -> tuple[bool, int, int, list[list[bytes]]]:
    """Whether vertices have colours, the two counts, and the lines after them."""
    keyword = lines[0][0] if lines else b""
    if keyword not in (b"OFF", b"COFF"):
        raise InputError(f"{path}: starts with {keyword[:20]!r}, expected OFF or COFF")
    # The counts may follow the keyword on its line or on the next one.
    rest = [lines[0][1:], *lines[1:]] if len(lines[0]) > 1 else lines[1:]
    try:
        num_vertices, num_faces = (int(word) for word in rest[0][:2])
    except (IndexError, ValueError):
        raise InputError(f"{path}: expected the numbers of vertices and faces") from None
    rest = rest[1:]
    if num_vertices < 0 or num_faces < 0 or num_vertices + num_faces > len(rest):
        raise InputError(
            f"{path}: claims {num_vertices} vertices and {num_faces} faces, "
            f"but only {len(rest)} lines follow"
        )
    return keyword == b"COFF", num_vertices, num_faces, rest


def read_off(path: Path, data: bytes) -> RawMesh:
    """Read an OFF or COFF file; COFF colours (0 to 255 or 0 to 1) are taken as sRGB.

    Raises:
        InputError: If the file ends early or a line cannot be read.
    """
    lines = [words for line in data.splitlines() if (words := line.split(b"#")[0].split())]
    coloured, num_vertices, num_faces, lines = _header(path, lines)
    width = 6 if coloured else 3
    rows: list[list[float]] = []
    corners: list[int] = []
    sizes: list[int] = []
    try:
        for words in lines[:num_vertices]:
            if len(words) < width:
                raise ValueError(f"expected {width} numbers, found {len(words)}")
            rows.append([float(word) for word in words[:width]])
        for words in lines[num_vertices : num_vertices + num_faces]:
            size = int(words[0])
            if not 0 <= size < len(words):
                raise ValueError(f"claims {size} corners, {len(words) - 1} numbers follow")
            corners.extend([int(word) for word in words[1 : size + 1]])
            sizes.append(size)
    except ValueError as error:
        where = f"face {len(sizes)}" if len(rows) == num_vertices else f"vertex {len(rows)}"
        raise InputError(f"{path}: {where}: {error}") from None
    table = np.array(rows, np.float64).reshape(-1, width)
    albedo = None
    if coloured:
        # Writers use either bytes or fractions, and nothing in the file says which.
        encoded = table[:, 3:] / (255.0 if table[:, 3:].max(initial=0.0) > 1.0 else 1.0)
        albedo = linear_from_srgb(encoded)
    return RawMesh(
        vertices=np.ascontiguousarray(table[:, :3]),
        corners=np.array(corners, np.int64),
        sizes=np.array(sizes, np.int64),
        albedo=albedo,
    )
