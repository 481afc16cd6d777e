"""Clusters by the error of their own subspaces.

For each rank from 1 up, turns of {one step of orthogonal iteration of every cluster's vectors;
move each point to the best of the clusters nearest to its own}, until few points move. A step of
orthogonal iteration started from the last turn's vectors never loses what they held, so the error
falls in every turn, at a small part of the price of an eigen-decomposition.

Such turns cannot carry a cluster from where it is of little use to where it is missed. So after
every other turn some clusters are relocated (``cpca_relocation``); what did not pay after two turns
is taken back.

Points are taken in their common principal axes, and only as many of these as matter: what lies
beyond is lost alike in nearly every cluster, so while it is a small part of the error it does not
change the choice between them.

Source:
    Sloan, Hall, Hart, Snyder 2003, section 4.2.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.representations.cpca_choice import Subspaces
from prt_torch.representations.cpca_clusters import count_moves
from prt_torch.representations.cpca_relocation import relocate
from prt_torch.representations.cpca_subspaces import one_thread
from prt_torch.representations.exact_sums import ExactProducts
from prt_torch.representations.points import Points, renumber, total_of
from prt_torch.representations.steady import steady_product

NEAREST = 16
"""Clusters a point may move to in one turn."""

_TURNS_PER_RANK = 6
_LAST_TURNS = 16
_FEW_MOVES = 2e-3  # share of points; below it a turn ends a rank
_IGNORED = 0.05  # share of the error that the axes left out may hold
_FEW_AXES = 64  # fewer save no time


class PrincipalAxes:
    """Points in their common principal axes; in those they have, where these are few already.

    Args:
        data: ``"points d"``, less their mean where the subspaces are affine.
    """

    def __init__(self, data: Float[Tensor, "points d"] | Points):
        self._points = Points.of(data)
        size = self._points.rest[0]
        self._axes: Tensor | None = None
        if size > _FEW_AXES:
            largest = self._points.largest()
            moment = ExactProducts(largest, largest, self._points.total, self._points.processes)
            for _, values in self._points.chunks():
                moment.add(values, values)
            with one_thread():
                energies, axes = torch.linalg.eigh(moment.value())
            energies = energies.flip(0).clamp_min(0.0)
            self._axes = axes.flip(1).to(self._points.like)
            self.energy = float(energies.sum())
            self.beyond = self.energy - energies.cumsum(0)
        else:
            self.energy = self._points.squared_norm()
            self.beyond = torch.zeros(size, dtype=torch.float64)

    def enough(self, error: float, least: int) -> int:
        """How many axes leave out a small part of this error; at least so many."""
        matter = int((self.beyond > _IGNORED * error).sum()) + 1
        return min(max(matter, least, _FEW_AXES), self._points.rest[0])

    def turned(self, vectors: Float[Tensor, "*some d"], count: int) -> Float[Tensor, "*some count"]:
        """Vectors in the first axes."""
        return vectors if self._axes is None else vectors @ self._axes[:, :count]

    def leading(self, count: int) -> Points:
        """The points in the first axes, ``"points count"``."""
        if self._axes is None:
            return self._points
        axes = self._axes[:, :count]
        return self._points.stored(lambda values: steady_product(values, axes), count)


def iterate(
    data: Float[Tensor, "points d"] | Points,
    labels: Int[Tensor, "points"],
    num_clusters: int,
    rank: int,
    affine: bool,
    generator: torch.Generator,
    *,
    doubling: bool = False,
) -> Int[Tensor, "points"]:
    """Move points between clusters, whose vectors grow to ``rank``.

    Args:
        data: The points, less their mean where the subspaces are affine.
        labels: Clusters to begin with.
        num_clusters: How many there are.
        rank: Vectors of each at the end.
        affine: Whether clusters have means.
        generator: Source of randomness.
        doubling: Double the number of vectors in place of adding one: of rank 16, a third of the
            time for 7 % more error.
    """
    whole = Points.of(data)
    axes = PrincipalAxes(whole)
    vectors = whole.like.new_zeros(num_clusters, 0, 0)
    error = axes.energy
    if affine:
        none = whole.like.new_zeros(num_clusters, whole.rest[0], 0)
        error = float(Subspaces(whole, labels, none, True).spread().sum())
    points, size = None, 0
    while size < rank:
        size = min(rank, max(1, 2 * size)) if doubling else size + 1
        count = axes.enough(error, least=size)
        if points is None or points.rest[0] != count:
            points = axes.leading(count)
        vectors = torch.nn.functional.pad(vectors, (0, 0, 0, count - vectors.shape[1]))
        more = size - vectors.shape[2]
        fresh = torch.randn(num_clusters, count, more, generator=generator).to(vectors)
        vectors = torch.cat([vectors, fresh], dim=2)
        turns = _LAST_TURNS if size == rank else _TURNS_PER_RANK
        labels, vectors, within = _take_turns(points, labels, vectors, affine, turns)
        error = within + float(axes.beyond[count - 1])
    if points is None:
        return labels
    labels, old = renumber(labels, num_clusters, points.processes)
    return Subspaces(points, labels, vectors[old], affine, steps=1).reassign(num_clusters)[0]


def _take_turns(
    points: Points,
    labels: Int[Tensor, "points"],
    vectors: Float[Tensor, "clusters d rank"],
    affine: bool,
    turns: int,
) -> tuple[Int[Tensor, "points"], Float[Tensor, "clusters d rank"], float]:
    """Refit, move points and relocate clusters; labels, vectors and error at the end."""
    error, before, relocating = torch.inf, None, True
    for turn in range(turns):
        fit = Subspaces(points, labels, vectors, affine, steps=3 if turn == 0 else 1)
        choice, vectors = fit.choose(NEAREST), fit.vectors
        error = total_of(choice.errors, points.processes)
        moved = count_moves(choice.labels, labels, points.processes)
        few = moved <= _FEW_MOVES * points.total
        labels = choice.labels
        found = None
        if turn % 2 == 1:
            if before is not None and error >= before[2]:
                labels, vectors, error = before
                few, relocating = False, False
            elif relocating and turn + 2 < turns:
                found = relocate(fit, choice, affine)
            before = None
        if found is not None:
            before = labels, vectors, error
            labels, vectors = found
        elif few and before is None:
            break
        del fit, choice, found  # they take as much as all else that belongs to a point
    return labels, vectors, error
