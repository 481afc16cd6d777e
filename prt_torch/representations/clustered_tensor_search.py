"""Clusters of points by the error of the clusters' own tensor decompositions.

Turns of {improve the bases of every cluster; move each point to the best of the clusters nearest
to its own} until few points move, then a look at all clusters, and on from there if that helped.
Points move only where they lose less, and bases never lose what they held, so the error never
rises. An empty cluster begins anew from one of the worst points.

Source:
    Tsai, Shih 2006, sections 5.2.2 and 5.2.3. The paper tries every cluster in every turn, from
    clusters by distances to means.
"""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.representations.clustered_tensor_fit import Bases, refit, weights
from prt_torch.representations.cpca_clusters import count_moves, refill, vector_quantise
from prt_torch.representations.cpca_iteration import iterate
from prt_torch.representations.orthonormal import orthonormal
from prt_torch.representations.points import (
    Points,
    SortedChunk,
    SortedPoints,
    cluster_sizes,
    renumber,
)

NEAREST = 8
"""Clusters a point may move to in one turn, its own included."""

START_DIMENSIONS = 256
"""Of the points that the first clusters are made of."""

_FIRST_STEPS = 3  # of the turn that has only a start
_STEPS = 2
_FEW_MOVES = 2e-3  # share of points; below it turns end
_LOOKS = 2  # at all clusters, at most
_ROUNDING = 4.0  # units of rounding by which another cluster must be better


@dataclass
class Trace:
    """What the iterations did.

    Attributes:
        held: Squared norm of what the bases hold after each turn of both phases, in the scale of
            the projection.
        moved: Points that moved in each turn of the clustering phase.
    """

    held: list[float] = field(default_factory=list)
    moved: list[int] = field(default_factory=list)

    def settled(self, squared_norm: float, tolerance: float) -> bool:
        """Whether the last turn lowered the error by no more than this share of it."""
        if len(self.held) < 2:
            return False
        before, after = self.held[-2:]
        return after - before <= tolerance * (squared_norm - before)


def first_clusters(
    points: Points,
    num_clusters: int,
    rank: int,
    generator: torch.Generator,
) -> tuple[Int[Tensor, "points"], int]:
    """Clusters of linear CPCA of a rank, on the points' leading values.

    These know nothing of ranks of view and light, but of all else: on glossy transfer they left a
    handful of turns to do, and a lower error than dozens of turns from Lloyd's clusters.

    Args:
        points: In view and light, ``"points view light"``.
        num_clusters: Clusters at most.
        rank: Of their subspaces.
        generator: Source of randomness.

    Returns:
        Cluster of each point, numbered from the largest to the smallest, and how many there are:
        no more than distinct points.

    Source:
        Tsai, Shih 2006, section 5.2.2, has ELBG's clusters, by distances to means.
    """
    view, light = points.rest
    leading = min(light, max(1, START_DIMENSIONS // view))
    data = points.stored(lambda values: values[:, :, :leading].flatten(1), view * leading)
    labels, num_clusters = vector_quantise(data, num_clusters, generator, rough=True)
    if num_clusters > 1:
        rank = min(rank, view * leading)
        labels = iterate(data, labels, num_clusters, rank, False, generator, doubling=True)
    return renumber(labels, num_clusters, points.processes)[0], num_clusters


def find_clusters(
    points: Points,
    labels: Int[Tensor, "points"],
    bases: Bases,
    trace: Trace,
    *,
    squared_norm: float,
    tolerance: float,
    max_turns: int,
) -> tuple[Int[Tensor, "points"], Bases]:
    """Move points between clusters until few of them do.

    Args:
        points: In the view basis that all clusters share, ``"points view light"``.
        labels: Clusters to begin with, none empty.
        bases: Of every cluster, to begin with.
        trace: Is told of every turn.
        squared_norm: Of the tensor, what its points have in no axis here included.
        tolerance: A turn that lowers the error by a smaller share is the last before all clusters
            are looked at.
        max_turns: At most.

    Returns:
        Labels, clusters numbered from the largest to the smallest, and their bases.
    """
    num_clusters, processes = len(bases.light), points.processes
    few, looks = _FEW_MOVES * points.total, 0 if num_clusters > NEAREST else _LOOKS
    for turn in range(max_turns):
        grouped = _Grouped(points, labels, bases)
        grouped.refit(_FIRST_STEPS if turn == 0 else _STEPS)
        labels, held = grouped.move(NEAREST)
        trace.held.append(held)
        moved = count_moves(labels, grouped.labels, processes)
        still = moved <= few or trace.settled(squared_norm, tolerance)
        if (still or turn == max_turns - 1) and looks < _LOOKS:
            labels, trace.held[-1] = grouped.move(num_clusters)
            moved = count_moves(labels, grouped.labels, processes)
            looks += 1
            still = moved <= few or trace.settled(squared_norm, tolerance)
        bases = grouped.restarted(labels)
        trace.moved.append(moved)
        if still:
            break
    labels, old = renumber(labels, num_clusters, processes)
    return labels, bases.of(old)


class _Grouped:
    """Points by cluster, with the clusters' bases.

    Args:
        points: In the view basis.
        labels: Their clusters.
        bases: Of every cluster.
    """

    def __init__(self, points: Points, labels: Int[Tensor, "points"], bases: Bases):
        self.points, self.labels, self.bases = points, labels, bases
        self.num_clusters = len(bases.light)
        self.members = SortedPoints(points, labels, self.num_clusters)
        self._emptied: list[int] = []

    def refit(self, steps: int) -> None:
        """Improve the bases."""
        self.bases = refit(self.members, self.bases, steps)

    def move(self, count: int) -> tuple[Int[Tensor, "points"], float]:
        """The best cluster of each point among those nearest to its own; none is left empty.

        Args:
            count: How many clusters are near.

        Returns:
            New labels, and the squared norm of what the bases hold with them.
        """
        nearest = self._nearest(min(count, self.num_clusters))
        columns, processes = self.bases.together(), self.points.processes
        labels = torch.empty_like(self.labels)
        errors = self.points.like.new_empty(len(labels))
        held = errors.new_zeros((), dtype=torch.float64)
        for chunk in self.members:
            best, to = _best(chunk, nearest, columns)
            squares = torch.linalg.vector_norm(chunk.slots, dim=(1, 2)).square()
            errors[chunk.rows] = chunk.blocks.to_points(squares - best).clamp_min(0.0)
            labels[chunk.rows] = chunk.blocks.to_points(to).to(labels.dtype)
            held += best.sum(dtype=torch.float64)
        sizes = cluster_sizes(labels, self.num_clusters, processes)
        self._emptied = torch.nonzero(sizes == 0)[:, 0].tolist()
        labels = refill(labels, errors, self.num_clusters, processes)
        return labels, float(processes.sum(held))

    def _nearest(self, count: int) -> Int[Tensor, "clusters count"]:
        """Clusters by the distance of their means, each itself first."""

        def sums(chunk: SortedChunk) -> Tensor:
            return chunk.blocks.sum(chunk.slots.flatten(1))

        shape = (self.num_clusters, math.prod(self.points.rest))
        sizes = cluster_sizes(self.labels, self.num_clusters, self.points.processes)
        centres = self.members.sum(sums, *shape) / sizes.clamp_min(1)[:, None]
        distances = torch.cdist(centres, centres)
        distances.fill_diagonal_(-1.0)
        return distances.topk(count, largest=False).indices

    def restarted(self, labels: Int[Tensor, "points"]) -> Bases:
        """The bases, those of clusters that had lost all their points led by their new one."""
        emptied = self._emptied
        if not emptied:
            return self.bases
        own = self.points.take(self._first_members(labels, emptied))  # some, view, light
        light, dual = self.bases.light.clone(), self.bases.dual.clone()
        rights = torch.linalg.svd(own, full_matrices=False)[2].mT
        led = orthonormal(torch.cat([rights, light[emptied]], dim=2))
        light[emptied] = led[:, :, : light.shape[2]]
        core = (own @ light[emptied]).flatten(1)[:, None]
        led = orthonormal(torch.cat([core, dual[emptied]], dim=1).mT).mT
        dual[emptied] = led[:, : dual.shape[1]]
        return Bases(light, dual)

    def _first_members(
        self, labels: Int[Tensor, "points"], clusters: list[int]
    ) -> Int[Tensor, "some"]:
        """The first point of each cluster, by number over all processes."""
        first = torch.full((len(clusters),), -1, device=labels.device)
        for place, cluster in enumerate(clusters):
            own = torch.nonzero(labels == cluster)[:1, 0]
            if len(own):
                first[place] = self.points.total - self.points.first - own[0]
        return self.points.total - self.points.processes.largest(first)


def _best(
    chunk: SortedChunk,
    nearest: Int[Tensor, "clusters count"],
    columns: Float[Tensor, "clusters values rank"],
) -> tuple[Float[Tensor, "slots"], Int[Tensor, "slots"]]:
    """What each slot's point keeps at best in the columns of clusters near its own, and which."""
    home = chunk.blocks.cluster_of_slot
    best, labels = weights(chunk, columns).square().sum(1), home
    better = 1.0 + _ROUNDING * torch.finfo(best.dtype).eps
    for clusters in nearest.unbind(1)[1:]:
        held = weights(chunk, columns[clusters]).square().sum(1)
        moves = held > better * best
        best = torch.where(moves, held, best)
        labels = torch.where(moves, clusters[home], labels)
    return best, labels
