r"""Nearly uniform points on the sphere: the corners of an icosahedron whose faces are divided.

Each step puts a point in the middle of every edge, on the sphere, so a face becomes four: 12, 42,
162, 642 and 2562 points, each set holding the one before. Neighbours are 0.138 to 0.165 rad apart
at 642.
"""

import math

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from prt_torch.bases.tables import kept

ICOSAHEDRAL_COUNTS = (12, 42, 162, 642, 2562)
"""Numbers of points after 0 to 4 subdivisions."""


@kept
def icosahedral_centers(subdivisions: int) -> Float64[Tensor, "centers 3"]:
    """Unit vectors to the corners of a subdivided icosahedron, always in the same order.

    Args:
        subdivisions: 0 to 4, for 12, 42, 162, 642 or 2562 points.

    Raises:
        ValueError: If ``subdivisions`` is out of range.

    Source:
        Tsai, Shih 2006, section 4.2.
    """
    if not 0 <= subdivisions < len(ICOSAHEDRAL_COUNTS):
        raise ValueError(
            f"expected 0 to {len(ICOSAHEDRAL_COUNTS) - 1} subdivisions, got {subdivisions}"
        )
    points, faces = _icosahedron()
    for _ in range(subdivisions):
        points, faces = _divided(points, faces)
    return points


@kept
def smallest_distance(subdivisions: int) -> float:
    """Angle between the two closest points of :func:`icosahedral_centers` [rad]."""
    points = icosahedral_centers(subdivisions)
    chords = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
    chords.fill_diagonal_(2.0)
    return 2.0 * math.asin(0.5 * float(chords.min()))


def _icosahedron() -> tuple[Float64[Tensor, "12 3"], Int[Tensor, "20 3"]]:
    """Corners of three golden rectangles; the faces are triples of neighbours."""
    golden = (1.0 + math.sqrt(5.0)) / 2.0
    corners = [
        turned
        for a in (-1.0, 1.0)
        for b in (-golden, golden)
        for turned in ((0.0, a, b), (a, b, 0.0), (b, 0.0, a))
    ]
    points = torch.tensor(corners, dtype=torch.float64)
    near = torch.cdist(points, points) < 2.1  # edges have length 2
    triples = torch.combinations(torch.arange(12), 3)
    sides = near[triples[:, 0], triples[:, 1]] & near[triples[:, 1], triples[:, 2]]
    faces = triples[sides & near[triples[:, 0], triples[:, 2]]]
    return points / points.norm(dim=1, keepdim=True), faces


def _divided(
    points: Float64[Tensor, "points 3"], faces: Int[Tensor, "faces 3"]
) -> tuple[Float64[Tensor, "more_points 3"], Int[Tensor, "more_faces 3"]]:
    """One step: four faces for one, and a point for each edge."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].view(-1, 2).sort(dim=1).values
    edges, number = edges.unique(dim=0, return_inverse=True)
    middles = points[edges].sum(dim=1)
    middles = middles / middles.norm(dim=1, keepdim=True)
    a, b, c = faces.unbind(1)
    ab, bc, ca = (len(points) + number.view(-1, 3)).unbind(1)
    corners = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    return torch.cat([points, middles]), torch.cat([torch.stack(face, 1) for face in corners])
