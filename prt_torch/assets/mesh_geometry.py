"""Normals, transforms and defects of triangle meshes, in float64.

Connectivity is judged by position: vertices that a file splits at a seam, or STL's three points
per facet, count as one where they coincide exactly. The mesh itself is never welded.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64, Int64, Shaped
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor

from prt_torch.errors import InputError

# Sine of a corner below which a triangle's direction is rounding: its edges carry 53 bits.
_FLAT = 1e-14
# A closed surface has an exact signed volume; an open one must be clearly bulged to have a side.
_SIDED_CLOSED = 1e-9
_SIDED_OPEN = 1e-2


def fan_triangles(
    corners: Int64[np.ndarray, "corners"], sizes: Int64[np.ndarray, "polygons"]
) -> Int64[np.ndarray, "faces 3"]:
    """Triangles of polygons, all from the first corner; polygons should be convex."""
    per_polygon = sizes - 2
    polygon = np.repeat(np.arange(len(sizes)), per_polygon)
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(per_polygon) - per_polygon, per_polygon)
    first = (np.cumsum(sizes) - sizes)[polygon]
    return np.stack([corners[first], corners[first + step + 1], corners[first + step + 2]], axis=1)


def transform_mesh(
    vertices: Float64[np.ndarray, "points 3"],
    normals: Float64[np.ndarray, "points 3"] | None,
    matrix: Float64[np.ndarray, "4 4"],
) -> tuple[Float64[np.ndarray, "points 3"], Float64[np.ndarray, "points 3"] | None, bool]:
    """Apply an affine transform to vertices and normals, which come out unnormalised.

    The last result says whether it mirrors: then faces are to be turned over (:func:`turned_over`)
    so that sides stay sides. Normals turn with the cofactor matrix, and point to the same side.
    """
    linear = matrix[:3, :3]
    a, b, c = linear
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])
    mirrored = bool(np.linalg.det(linear) < 0)
    moved = vertices @ linear.T + matrix[:3, 3]
    turned = None if normals is None else normals @ (-cofactors if mirrored else cofactors).T
    return moved, turned, mirrored


def turned_over(
    corners: Shaped[np.ndarray, "faces 3 *rest"],
) -> Shaped[np.ndarray, "faces 3 *rest"]:
    """What belongs to the corners of faces, in the opposite winding."""
    return corners[:, [0, 2, 1]]


def placement(
    up: Literal["y", "z"], transform: Sequence[Sequence[float]] | Float[Tensor, "4 4"] | None
) -> Float64[np.ndarray, "4 4"]:
    """The matrix that takes a file's coordinates to the world's.

    Args:
        up: The file's axis that becomes the world's +y.
        transform: Affine matrix applied after that, acting on columns.

    Raises:
        InputError: If the transform is not affine, not finite or singular.
    """
    match up:
        case "y":
            upright = np.eye(4)
        case "z":
            upright = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)
        case _:
            raise InputError(f"scene.up={up}: expected y or z")
    if transform is None:
        return upright
    try:
        matrix = np.asarray(transform, np.float64)
    except (TypeError, ValueError):
        raise InputError("scene.transform: expected 4 rows of 4 numbers") from None
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError("scene.transform: expected 4 rows of 4 finite numbers")
    if not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise InputError("scene.transform: the last row must be 0 0 0 1 (no perspective)")
    if np.linalg.matrix_rank(matrix[:3, :3]) < 3:
        raise InputError("scene.transform: is singular, it flattens the mesh")
    return matrix @ upright


@dataclass(frozen=True)
class FaceGeometry:
    """Unit normals and corner angles of faces, both zero for faces without area."""

    normals: Float64[np.ndarray, "faces 3"]
    angles: Float64[np.ndarray, "faces 3"]


def face_geometry(
    vertices: Float64[np.ndarray, "points 3"], faces: Int64[np.ndarray, "faces 3"]
) -> FaceGeometry:
    """Unit normals and corner angles [rad] of triangles of any size.

    Each triangle's edges are divided by their largest component first, so that no product under-
    or overflows.
    """
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    edges = np.stack([b - a, c - b, a - c], axis=1)
    largest = np.abs(edges).max(axis=(1, 2), initial=0.0)
    edges = edges / np.where(largest > 0, largest, 1.0)[:, None, None]
    cross = np.cross(edges[:, 0], -edges[:, 2])
    double_area = np.sqrt(np.einsum("fi,fi->f", cross, cross))
    flat = double_area <= _FLAT
    normals = np.where(flat[:, None], 0.0, cross / np.where(flat, 1.0, double_area)[:, None])
    # The angle at a corner is between the edge that leaves it and the reverse of the one before.
    dots = -np.einsum("fci,fci->fc", edges, np.roll(edges, 1, axis=1))
    angles = np.where(flat[:, None], 0.0, np.arctan2(double_area[:, None], dots))
    return FaceGeometry(normals, angles)


def vertex_normals(
    geometry: FaceGeometry, faces: Int64[np.ndarray, "faces 3"], num_points: int
) -> Float64[np.ndarray, "points 3"]:
    """Angle-weighted unit normals; zero where faces cancel or there are none.

    Source:
        Thürmer and Wüthrich, "Computing vertex normals from polygonal facets", 1998.
    """
    total = np.zeros((num_points, 3))
    corners = faces.ravel()
    for axis in range(3):
        weighted = (geometry.angles * geometry.normals[:, axis, None]).ravel()
        total[:, axis] = np.bincount(corners, weights=weighted, minlength=num_points)
    return normalised(total, smallest=1e-12)


def normalised(
    vectors: Float64[np.ndarray, "points 3"], *, smallest: float = 0.0
) -> Float64[np.ndarray, "points 3"]:
    """Unit vectors; zero where a vector is not finite or not longer than ``smallest``."""
    vectors = np.where(np.isfinite(vectors).all(axis=1, keepdims=True), vectors, 0.0)
    largest = np.abs(vectors).max(axis=1)
    usable = largest > smallest
    scaled = vectors / np.where(usable, largest, 1.0)[:, None]
    length = np.linalg.norm(scaled, axis=1)
    return np.where(usable[:, None], scaled / np.where(usable, length, 1.0)[:, None], 0.0)


@dataclass(frozen=True)
class Connectivity:
    """How faces hang together, by position."""

    duplicate_faces: int
    """Faces beyond the first on the same three positions."""
    open_edges: int
    """Edges of exactly one face."""
    non_manifold_edges: int
    """Edges of more than two faces."""
    twisted_edges: int
    """Edges of two faces that show opposite sides, as both run along it the same way."""
    side: int
    """+1 where faces point outwards, -1 inwards, 0 where the surface has no clear outside."""


def _distinct_rows(
    rows: Int64[np.ndarray, "rows width"],
) -> tuple[Int64[np.ndarray, "distinct width"], Int64[np.ndarray, "distinct"]]:
    """Distinct rows, and how often each occurs."""
    if not len(rows):
        return rows, np.zeros(0, np.int64)
    ordered = rows[np.lexsort(rows.T[::-1])]
    starts = np.flatnonzero(np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1)))
    return ordered[starts], np.diff(np.append(starts, len(rows)))


def _twisted(directed: Int64[np.ndarray, "edges 2"]) -> int:
    """Number of edges that two faces run along the same way, and none the other way."""
    forward = directed[:, :1] < directed[:, 1:]
    runs, per_run = _distinct_rows(np.hstack([np.sort(directed, axis=1), forward]))
    # The two directions of an edge are neighbours.
    paired = np.append(False, (runs[1:, :2] == runs[:-1, :2]).all(axis=1))
    one_way = ~(paired | np.append(paired[1:], False))
    return int((one_way & (per_run == 2)).sum())


def welded(
    vertices: Float64[np.ndarray, "points width"],
) -> Int64[np.ndarray, "points"]:
    """A number for each row that it shares with all rows exactly like it."""
    order = np.lexsort(vertices.T)
    ordered = vertices[order]
    changes = np.append(False, (ordered[1:] != ordered[:-1]).any(axis=1))
    numbers = np.empty(len(vertices), np.int64)
    numbers[order] = np.cumsum(changes)
    return numbers


def _side(
    vertices: Float64[np.ndarray, "points 3"],
    faces: Int64[np.ndarray, "faces 3"],
    component: Int64[np.ndarray, "faces"],
    open_components: Int64[np.ndarray, "open"],
) -> int:
    """Sign of the volume that the faces enclose, where they clearly enclose one.

    The volume of each connected component is taken about its own centroid (divergence theorem)
    and compared with its area^1.5, so that a ground plane, which encloses nothing, adds nothing.
    """
    num_components = int(component.max()) + 1
    corners = vertices[faces]
    weight = np.maximum(np.bincount(component, minlength=num_components), 1)
    middle = corners.mean(axis=1)
    centroid = np.stack(
        [np.bincount(component, middle[:, axis], num_components) / weight for axis in range(3)],
        axis=1,
    )
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    local = middle - centroid[component]
    volume = np.bincount(component, np.einsum("fi,fi->f", local, cross) / 6, num_components)
    area = np.bincount(component, np.linalg.norm(cross, axis=1) / 2, num_components)
    threshold = np.full(num_components, _SIDED_CLOSED)
    threshold[open_components] = _SIDED_OPEN
    sided = np.abs(volume) > threshold * area**1.5
    return int(np.sign(volume[sided].sum()))


def connectivity(
    vertices: Float64[np.ndarray, "points 3"], faces: Int64[np.ndarray, "faces 3"]
) -> Connectivity:
    """Count the defects that change what a bake means, and find the side that faces show."""
    corners = welded(vertices)[faces]
    directed = corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    directed = directed[directed[:, 0] != directed[:, 1]]
    edges, per_edge = _distinct_rows(np.sort(directed, axis=1))
    _, per_face = _distinct_rows(np.sort(corners, axis=1))
    links = sparse.coo_matrix(
        (np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(vertices), len(vertices))
    )
    labels = csgraph.connected_components(links, directed=False)[1].astype(np.int64)
    # The volume is judged in a unit box about the mesh, where nothing under- or overflows.
    centre = vertices.mean(axis=0)
    scale = np.abs(vertices - centre).max()
    unit = (vertices - centre) / (scale if scale > 0 else 1.0)
    return Connectivity(
        duplicate_faces=int((per_face - 1).sum()),
        open_edges=int((per_edge == 1).sum()),
        non_manifold_edges=int((per_edge > 2).sum()),
        twisted_edges=_twisted(directed),
        side=_side(unit, faces, labels[corners[:, 0]], np.unique(labels[edges[per_edge == 1, 0]])),
    )
