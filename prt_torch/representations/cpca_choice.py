"""What each point would lose in each cluster: subspaces of clusters as they stand, and a choice.

A step of orthogonal iteration started from vectors that are known never loses what they held, at a
small part of the price of an eigen-decomposition. Errors are computed from differences to the
cluster's own mean, so they keep their digits when the error is far below the signal.

Source:
    Sloan, Hall, Hart, Snyder 2003, section 4.2.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.representations.cpca_clusters import refill
from prt_torch.representations.cpca_subspaces import one_thread
from prt_torch.representations.orthonormal import orthonormal
from prt_torch.representations.points import (
    Points,
    SortedChunk,
    SortedPoints,
    cluster_sizes,
    slices,
)
from prt_torch.representations.steady import laid_out

_CHUNK_ELEMENTS = 2**21  # of one table of products; larger ones cost more for their memory


@dataclass(frozen=True)
class Choice:
    """Where each point loses least, and where next.

    Attributes:
        labels: Its best cluster.
        errors: What it loses there.
        next_labels: The best other cluster known: where it would go if its best were given up.
        next_errors: What the points of each cluster would lose there in all, float64.
    """

    labels: Int[Tensor, "points"]
    errors: Float[Tensor, "points"]
    next_labels: Int[Tensor, "points"]
    next_errors: Float[Tensor, "clusters"]


class Subspaces:
    """Means and vectors of every cluster for given labels, and what a point would lose in each.

    Sums over points are those of float64, whatever type the points have.

    Args:
        points: The points.
        labels: Their clusters; -1 for points that are left out.
        vectors: Where the orthogonal iteration starts, ``"clusters d rank"``.
        affine: Whether clusters have means, or their subspaces go through the origin.
        steps: Steps of orthogonal iteration.
    """

    def __init__(
        self,
        points: Float[Tensor, "points d"] | Points,
        labels: Int[Tensor, "points"],
        vectors: Float[Tensor, "clusters d rank"],
        affine: bool,
        steps: int = 0,
    ):
        self.points, self.labels = Points.of(points), labels
        self.num_clusters = len(vectors)
        self._sorted = SortedPoints(self.points, labels, self.num_clusters)
        shape = (self.num_clusters, *self.points.rest)
        sums = self._sorted.sum(lambda chunk: chunk.blocks.sum(chunk.slots), *shape)
        self.sizes = cluster_sizes(labels, self.num_clusters, self.points.processes)
        self.centres = (sums / self.sizes.clamp_min(1)[:, None]).to(vectors)
        self.means = self.centres if affine else torch.zeros_like(self.centres)
        if affine:
            self._sorted.centre(self.centres)
        self.vectors = laid_out(vectors)
        for _ in range(steps):
            products = self._sorted.products(self._projected, *vectors.shape[1:])
            stepped = orthonormal(products)
            self.vectors = laid_out(stepped.to(vectors))

    def _projected(self, chunk: SortedChunk) -> tuple[Tensor, Tensor]:
        """Each slot's point, and what its cluster's vectors see of it."""
        return chunk.slots, chunk.matmul(chunk.slots, self.vectors)

    def spread(self) -> Float[Tensor, "clusters"]:
        """Sum of squared distances of each cluster's points to its mean, float64."""

        def own(chunk: SortedChunk) -> Tensor:
            return chunk.blocks.sum(_lengths(chunk.slots)[:, None])[:, 0]

        return self._sorted.sum(own, self.num_clusters)

    def squares(self) -> Float[Tensor, "clusters rank"]:
        """Squared singular values as the vectors see them, falling; turns the vectors to fit."""

        def inner(chunk: SortedChunk) -> tuple[Tensor, Tensor]:
            _, products = self._projected(chunk)
            return products, products

        rank = self.vectors.shape[2]
        moments = self._sorted.products(inner, rank, rank)
        with one_thread():
            values, turn = torch.linalg.eigh(moments)
        self.vectors = laid_out(self.vectors @ turn.flip(2).to(self.vectors))
        return values.flip(1).clamp_min(0.0)

    def reassign(
        self, num_candidates: int, price: Float[Tensor, "clusters"] | None = None
    ) -> tuple[Int[Tensor, "points"], Float[Tensor, "points"]]:
        """The best cluster of each point among those nearest to its own; none is left empty.

        Args:
            num_candidates: How many clusters are near.
            price: What a point pays beside its error for being in each cluster.

        Returns:
            New labels, and what each point loses there.
        """
        choice = self.choose(num_candidates, price)
        return choice.labels, choice.errors

    def choose(self, num_candidates: int, price: Float[Tensor, "clusters"] | None = None) -> Choice:
        """The better of each point's own cluster and the best other one near it; none left empty.

        There must be at least two clusters; arguments are those of :meth:`reassign`.
        """
        distances = torch.cdist(self.centres, self.centres)
        distances.fill_diagonal_(-1.0)  # its own first
        count = min(num_candidates, self.num_clusters)
        nearest = distances.topk(count, largest=False).indices
        # The last again and again: products are steady with whole fours (``steady_product``).
        nearest = torch.cat([nearest, nearest[:, -1:].expand(-1, -count % 4)], dim=1)
        labels, next_labels = torch.empty_like(self.labels), torch.empty_like(self.labels)
        errors = self.points.like.new_empty(len(labels))
        next_errors = errors.new_zeros(self.num_clusters, dtype=torch.float64)
        for chunk in self._sorted:
            own, other, rival = self._compared(chunk, nearest, price)
            blocks, rows = chunk.blocks, chunk.rows
            spread, home = _lengths(chunk.slots), blocks.cluster_of_slot
            leaves = other < own
            best = torch.where(leaves, rival, home)
            labels[rows] = blocks.to_points(best).to(labels.dtype)
            next_labels[rows] = blocks.to_points(torch.where(leaves, home, rival)).to(labels.dtype)
            errors[rows] = blocks.to_points(torch.minimum(own, other) + spread)
            elsewhere = (torch.maximum(own, other) + spread).double() * blocks.filled
            next_errors.index_add_(0, best, elsewhere)
        processes = self.points.processes
        labels = refill(labels, errors, self.num_clusters, processes)
        return Choice(labels, errors, next_labels, processes.sum(next_errors))

    def _compared(
        self,
        chunk: SortedChunk,
        nearest: Int[Tensor, "clusters count"],
        price: Float[Tensor, "clusters"] | None,
    ) -> tuple[Float[Tensor, "slots"], Float[Tensor, "slots"], Int[Tensor, "slots"]]:
        """What each slot's point loses in its own cluster and in the best other, and which it is.

        Less its own spread.
        """
        own = torch.empty_like(chunk.slots[:, 0])
        other = torch.empty_like(own)
        rival = torch.empty_like(chunk.blocks.point_of_slot)
        nearest = chunk.blocks.by_size(nearest)
        for clusters, slots in self._runs(chunk, nearest.shape[1]):
            candidates = nearest[clusters]
            rows = chunk.slots[slots].unflatten(0, (len(candidates), -1))
            losses = self._losses(rows, candidates)
            if price is not None:
                losses += price[candidates][:, :, None]
            own[slots] = losses[:, 0].flatten()
            least, place = losses[:, 1:].min(dim=1)
            other[slots] = least.flatten()
            rival[slots] = candidates.gather(1, place + 1).flatten()
        return own, other, rival

    def _runs(self, chunk: SortedChunk, count: int) -> Iterator[tuple[slice, slice]]:
        """Runs of clusters, by falling size, and their slots whose tables stay small."""
        columns = count * (self.vectors.shape[2] + 1)
        limit = min(_CHUNK_ELEMENTS, self.points.table_elements)
        for bucket in chunk.blocks.buckets:
            elements = columns * max(bucket.size, self.vectors.shape[1])
            for some in slices(bucket.num_clusters, max(1, limit // elements)):
                first = bucket.first_cluster + some.start
                run = slice(first, first + some.stop - some.start)
                start = bucket.first_slot + some.start * bucket.size
                stop = bucket.first_slot + some.stop * bucket.size
                yield run, slice(start, stop)

    def _losses(
        self,
        rows: Float[Tensor, "clusters size d"],
        candidates: Int[Tensor, "clusters c"],
    ) -> Float[Tensor, "clusters c size"]:
        """Squared error of each point in each candidate cluster, its own first, less its spread.

        With y the point less its own mean, δ the candidate's mean less its own, v the candidate's
        vectors: ``|y-δ|² - Σ (y·v - δ·v)² = |y|² - 2 y·δ + |δ|² - Σ (y·v - δ·v)²``.
        """
        # Points go last: products and minima run along them, in three quarters of the time.
        shift = self.means[candidates] - self.means[candidates[:, :1]]  # clusters c d
        vectors = self.vectors.mT[candidates]  # clusters c rank d
        offsets = -(vectors @ shift[..., None]).flatten(1, 2)
        explained = torch.baddbmm(offsets, vectors.flatten(1, 2), rows.mT).square_()
        explained = explained.unflatten(1, vectors.shape[1:3]).sum(2)
        lengths = shift.square().sum(2)[..., None]
        return torch.baddbmm(lengths, shift, rows.mT, alpha=-2.0).sub_(explained)


def _lengths(slots: Float[Tensor, "slots d"]) -> Float[Tensor, "slots"]:
    """Squared norm of each."""
    return torch.linalg.vector_norm(slots, dim=1).square()
