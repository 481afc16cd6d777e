"""Clusters of points by the error of the clusters' own tensor decompositions.

Turns of {improve the bases of every cluster; move each point to the best of the clusters nearest
to its own} until few points move, then a look at all clusters, and on from there if that helped.
Points move only where they lose less, and bases never lose what they held, so the error never
rises. An empty cluster begins anew from one of the worst points.

Source:
    Tsai, Shih 2006, sections 5.2.2 and 5.2.3. The paper tries every cluster in every turn, from
    clusters by distances to means.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.representations.clustered_tensor_fit import Bases, refit, weights
from prt_torch.representations.cpca_clusters import refill, vector_quantise
from prt_torch.representations.cpca_iteration import iterate
from prt_torch.representations.grouped import ClusterBlocks, sort_labels
from prt_torch.representations.orthonormal import orthonormal

NEAREST = 8
"""Clusters a point may move to in one turn, its own included."""

_FIRST_STEPS = 3  # of the turn that has only a start
_STEPS = 2
_FEW_MOVES = 2e-3  # share of points; below it turns end
_LOOKS = 2  # at all clusters, at most
_START_DIMENSIONS = 256
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
    points: Float[Tensor, "points view light"],
    num_clusters: int,
    rank: int,
    generator: torch.Generator,
) -> tuple[Int[Tensor, "points"], int]:
    """Clusters of linear CPCA of a rank, on the points' leading values.

    These know nothing of ranks of view and light, but of all else: on glossy transfer they left a
    handful of turns to do, and a lower error than dozens of turns from Lloyd's clusters.

    Returns:
        Cluster of each point, numbered from the largest to the smallest, and how many there are:
        no more than distinct points.

    Source:
        Tsai, Shih 2006, section 5.2.2, has ELBG's clusters, by distances to means.
    """
    leading = max(1, _START_DIMENSIONS // points.shape[1])
    data = points[:, :, :leading].flatten(1)
    labels, num_clusters = vector_quantise(data, num_clusters, generator, rough=True)
    if num_clusters > 1:
        rank = min(rank, data.shape[1])
        labels = iterate(data, labels, num_clusters, rank, False, generator, doubling=True)
    return sort_labels(labels, num_clusters)[0], num_clusters


def find_clusters(
    points: Float[Tensor, "points view light"],
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
        points: In the view basis that all clusters share.
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
    num_clusters = len(bases.light)
    few, looks = _FEW_MOVES * len(points), 0 if num_clusters > NEAREST else _LOOKS
    for turn in range(max_turns):
        labels, old = sort_labels(labels, num_clusters)
        grouped = _Grouped(points, labels, bases.of(old))
        grouped.refit(_FIRST_STEPS if turn == 0 else _STEPS)
        labels, held = grouped.move(NEAREST)
        trace.held.append(held)
        moved = int((labels != grouped.labels).sum())
        still = moved <= few or trace.settled(squared_norm, tolerance)
        if (still or turn == max_turns - 1) and looks < _LOOKS:
            labels, trace.held[-1] = grouped.move(num_clusters)
            moved = int((labels != grouped.labels).sum())
            looks += 1
            still = moved <= few or trace.settled(squared_norm, tolerance)
        bases = grouped.restarted(labels)
        trace.moved.append(moved)
        if still:
            break
    labels, old = sort_labels(labels, num_clusters)
    return labels, bases.of(old)


class _Grouped:
    """Points sorted by cluster, with the clusters' bases.

    Args:
        points: In the view basis.
        labels: Clusters numbered from the largest to the smallest.
        bases: Of every cluster.
    """

    def __init__(self, points: Tensor, labels: Tensor, bases: Bases):
        self.points, self.labels, self.bases = points, labels, bases
        self.num_clusters = len(bases.light)
        self.blocks = ClusterBlocks(labels, self.num_clusters)
        self.slots = self.blocks.to_slots(points)
        self._emptied = labels[:0]

    def refit(self, steps: int) -> None:
        """Improve the bases."""
        self.bases = refit(self.blocks, self.slots, self.bases, steps)

    def _held(self, columns: Float[Tensor, "clusters values rank"]) -> Float[Tensor, "slots"]:
        """Squared norm of what each slot's point keeps in the columns of its place."""
        return weights(self.blocks, self.slots, columns).square().sum(1)

    def move(self, count: int) -> tuple[Int[Tensor, "points"], float]:
        """The best cluster of each point among those nearest to its own; none is left empty.

        Args:
            count: How many clusters are near.

        Returns:
            New labels, and the squared norm of what the bases hold with them.
        """
        nearest = self._nearest(min(count, self.num_clusters))
        home = self.blocks.cluster_of_slot
        columns = self.bases.together()
        best, labels = self._held(columns), home
        better = 1.0 + _ROUNDING * torch.finfo(best.dtype).eps
        for clusters in nearest.unbind(1)[1:]:
            held = self._held(columns[clusters])
            moves = held > better * best
            best, labels = (
                torch.where(moves, held, best),
                torch.where(moves, clusters[home], labels),
            )
        squares = torch.linalg.vector_norm(self.slots, dim=(1, 2)).square()
        errors = self.blocks.to_points(squares - best).clamp_min(0.0)
        labels = self.blocks.to_points(labels)
        sizes = torch.bincount(labels, minlength=self.num_clusters)
        self._emptied = torch.nonzero(sizes == 0)[:, 0]
        held = float(best.sum(dtype=torch.float64))
        return refill(labels, errors, self.num_clusters), held

    def _nearest(self, count: int) -> Int[Tensor, "clusters count"]:
        """Clusters by the distance of their means, each itself first."""
        filled = self.blocks.filled.to(self.slots)[:, None]
        sums = self.blocks.transposed_matmul(filled, self.slots.flatten(1))[:, 0]
        centres = sums / self.blocks.sizes().clamp_min(1)[:, None]
        distances = torch.cdist(centres, centres)
        distances.fill_diagonal_(-1.0)
        return distances.topk(count, largest=False).indices

    def restarted(self, labels: Int[Tensor, "points"]) -> Bases:
        """The bases, those of clusters that had lost all their points led by their new one."""
        emptied = self._emptied
        if len(emptied) == 0:
            return self.bases
        places = torch.searchsorted(labels.sort().values, emptied)
        own = self.points[labels.argsort(stable=True)[places]]  # some, view, light
        light, dual = self.bases.light.clone(), self.bases.dual.clone()
        rights = torch.linalg.svd(own, full_matrices=False)[2].mT
        led = orthonormal(torch.cat([rights, light[emptied]], dim=2))
        light[emptied] = led[:, :, : light.shape[2]]
        core = (own @ light[emptied]).flatten(1)[:, None]
        led = orthonormal(torch.cat([core, dual[emptied]], dim=1).mT).mT
        dual[emptied] = led[:, : dual.shape[1]]
        return Bases(light, dual)
