"""A strict reader of Wavefront OBJ: vertices, faces, their groups, normals and texture coordinates.

One point per ``v`` line, whatever texture coordinates and normals the corners name. General
loaders split vertices at texture seams, drop those with NaN and wrap index 0 to the last vertex,
which moves per-vertex data to other vertices; this one does none of it.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from prt_torch.assets.mesh_formats.raw import RawMesh, RawPart, finite_normals, linear_from_srgb
from prt_torch.errors import InputError

# Normals that differ by less are one normal written twice: files keep about six digits.
_SAME_NORMAL = 1e-4


def _numbers(words: list[bytes]) -> tuple[float, ...]:
    return tuple(map(float, words))


def _index(word: bytes, count: int) -> int:
    """Zero-based index; -1 for the invalid 0, and an invalid relative index stays below -1."""
    index = int(word)
    if index > 0:
        return index - 1
    return count + index if -count <= index < 0 else index - 1


def _named(field: list[bytes], what: str, count: int) -> int:
    """Zero-based index of what a corner names; -1 where it names none."""
    if not field or not field[0]:
        return -1
    index = _index(field[0], count)
    if not 0 <= index < count:
        raise ValueError(f"{what} {int(field[0])} does not exist ({count} so far)")
    return index


class _Lines:
    """What the lines of the file say, gathered in file order."""

    def __init__(self) -> None:
        self.vertices: list[tuple[float, ...]] = []
        self.colours: list[tuple[float, ...]] = []
        self.normals: list[tuple[float, ...]] = []
        self.corners: list[int] = []
        self.corner_normals: list[int] = []
        self.uv: list[tuple[float, ...]] = []
        self.corner_uv: list[int] = []
        self.sizes: list[int] = []
        self.groups: dict[bytes, list[tuple[int, str]]] = {b"usemtl": [], b"g": [], b"o": []}

    def add(self, words: list[bytes]) -> None:
        """Take in one line; a ValueError says what is wrong with it."""
        match words[0]:
            case b"v":
                if len(words) < 4:
                    raise ValueError("a vertex needs 3 coordinates")
                self.vertices.append(_numbers(words[1:4]))
                # "v x y z r g b" is the common extension for vertex colours.
                self.colours.append(_numbers(words[4:7]) if len(words) == 7 else (np.nan,) * 3)
            case b"vn":
                if len(words) < 4:
                    raise ValueError("a normal needs 3 components")
                self.normals.append(_numbers(words[1:4]))
            case b"vt":
                if len(words) < 2:
                    raise ValueError("texture coordinates need at least 1 number")
                self.uv.append((*_numbers(words[1:3]), 0.0)[:2])
            case b"f":
                self._add_face(words[1:])
            case b"usemtl" | b"g" | b"o":
                name = b" ".join(words[1:]).decode("utf-8", "replace") or "unnamed"
                self.groups[words[0]].append((len(self.sizes), name))

    def parts(self) -> tuple[RawPart, ...]:
        """Runs of faces of one material; of one group or object where no material is named."""
        starts = next((found for found in self.groups.values() if found), [])
        if starts and starts[0][0] > 0:
            starts = [(0, "unnamed"), *starts]
        ends = [first for first, _ in [*starts[1:], (len(self.sizes), "")]] if starts else []
        first_corners = np.concatenate([[0], np.cumsum(self.sizes, dtype=np.int64)])
        parts = []
        for (first, name), end in zip(starts, ends, strict=True):
            if end == first:
                continue
            used = self.corners[first_corners[first] : first_corners[end]]
            low, high = max(min(used), 0), max(used)
            parts.append(RawPart(name, low, high - low + 1, first, end - first))
        return tuple(parts)

    def _add_face(self, words: list[bytes]) -> None:
        if len(words) < 3:
            raise ValueError(f"a face needs at least 3 corners, this one has {len(words)}")
        for word in words:
            fields = word.split(b"/")
            self.corners.append(_index(fields[0], len(self.vertices)))
            self.corner_uv.append(_named(fields[1:2], "texture coordinate", len(self.uv)))
            self.corner_normals.append(_named(fields[2:3], "normal", len(self.normals)))
        self.sizes.append(len(words))


def _vertex_normals(
    corners: Int64[np.ndarray, "corners"],
    corner_normals: Int64[np.ndarray, "corners"],
    normals: Float64[np.ndarray, "normals 3"],
    num_vertices: int,
) -> tuple[Float64[np.ndarray, "points 3"], int]:
    """One normal per vertex where its corners agree, NaN elsewhere; and how many disagree."""
    named = (corner_normals >= 0) & (corners >= 0) & (corners < num_vertices)
    vertex, normal = corners[named], normals[corner_normals[named]]
    result = np.full((num_vertices, 3), np.nan)
    result[vertex] = normal
    chosen = result[vertex]
    length = np.maximum(np.abs(chosen).max(axis=1, initial=0.0), 1e-300)
    differs = np.abs(chosen - normal).max(axis=1, initial=0.0) > _SAME_NORMAL * length
    split = np.unique(vertex[differs])
    result[split] = np.nan
    return result, len(split)


def _corner_uv(lines: _Lines) -> Float64[np.ndarray, "corners 2"] | None:
    """Texture coordinates of every corner, NaN where it names none."""
    if not lines.uv:
        return None
    # The last row is what corners that name none, -1, refer to.
    return np.array([*lines.uv, (np.nan, np.nan)], np.float64)[np.array(lines.corner_uv, np.int64)]


def read_obj(path: Path, data: bytes) -> RawMesh:
    """Read an OBJ file.

    Relative (negative) indices are resolved. Colours on ``v`` lines are taken as sRGB. A vertex
    whose corners name several different normals gets none (NaN), and is counted.

    Raises:
        InputError: If a line cannot be read; the message names its number.
    """
    lines = _Lines()
    joined = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    for number, line in enumerate(joined.splitlines(), start=1):
        words = line.split()
        if not words:
            continue
        try:
            lines.add(words)
        except ValueError as error:
            raise InputError(f"{path}: line {number}: {error}") from None
    vertices = np.array(lines.vertices, np.float64).reshape(-1, 3)
    colours = np.array(lines.colours, np.float64).reshape(-1, 3)
    corners = np.array(lines.corners, np.int64)
    normals, split = None, 0
    if lines.normals:
        normals, split = _vertex_normals(
            corners,
            np.array(lines.corner_normals, np.int64),
            finite_normals(np.array(lines.normals, np.float64)),
            len(vertices),
        )
    return RawMesh(
        vertices=vertices,
        corners=corners,
        sizes=np.array(lines.sizes, np.int64),
        normals=normals,
        albedo=None if np.isnan(colours).all() else linear_from_srgb(colours),
        first_index=1,
        split_normals=split,
        uv=_corner_uv(lines),
        parts=lines.parts(),
    )
