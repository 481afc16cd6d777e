"""Clusters by the error of their own subspaces.

For each rank from 1 up, turns of {one step of orthogonal iteration of every cluster's vectors;
move each point to the best of the clusters nearest to its own}, until few points move. A step of
orthogonal iteration started from the last turn's vectors never loses what they held, so the error
falls in every turn, at a small part of the price of an eigen-decomposition.

Such turns cannot carry a cluster from where it is of little use to where it is missed. So after
every other turn some clusters are relocated: one whose points lose least in their next best
clusters is given up, and one of high error is cut in two in its place. Both prices are known only
with all other subspaces held still, where giving up looks dearer than it is: the turns that follow
adapt them. So a cut need not gain as much as giving up costs; what did not pay after two turns is
taken back.

Points are taken in their common principal axes, and only as many of these as matter: what lies
beyond is lost alike in nearly every cluster, so while it is a small part of the error it does not
change the choice between them.

Errors are computed from differences to the cluster's own mean, so they keep their digits when the
error is far below the signal.

Source:
    Sloan, Hall, Hart, Snyder 2003, section 4.2; relocation after Patane, Russo 2001, "The enhanced
    LBG algorithm".
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from prt_torch.representations.cpca_clusters import refill
from prt_torch.representations.cpca_subspaces import one_thread
from prt_torch.representations.grouped import ClusterBlocks, sort_labels
from prt_torch.representations.orthonormal import orthonormal

NEAREST = 16
"""Clusters a point may move to in one turn."""

_TURNS_PER_RANK = 6
_LAST_TURNS = 16
_FEW_MOVES = 2e-3  # share of points; below it a turn ends a rank
_CUT_SHARE = 0.25  # of the clusters, those of the highest error, may be cut in two
_LEAST_RETURN = 0.3  # gain of a cut over the cost of the cluster given up for it
_IGNORED = 0.05  # share of the error that the axes left out may hold
_FEW_AXES = 64  # fewer save no time
_CHUNK_ELEMENTS = 2**21  # of one table of products; larger ones cost more for their memory


class PrincipalAxes:
    """Points in their common principal axes.

    Args:
        data: ``"points d"``, less their mean where the subspaces are affine.
    """

    def __init__(self, data: Float[Tensor, "points d"]):
        scale = float(data.abs().max()) or 1.0
        scaled = data / scale
        moment = (scaled.mT @ scaled).double()
        with one_thread():
            energies, axes = torch.linalg.eigh(moment)
        energies = energies.flip(0).clamp_min(0.0) * scale**2
        self.axes = axes.flip(1).to(data)
        self.points = data @ self.axes
        self.energy = float(energies.sum())
        self.beyond = self.energy - energies.cumsum(0)

    def enough(self, error: float, least: int) -> int:
        """How many axes leave out a small part of this error; at least so many."""
        matter = int((self.beyond > _IGNORED * error).sum()) + 1
        return min(max(matter, least, _FEW_AXES), self.axes.shape[1])

    def leading(self, count: int) -> Float[Tensor, "points count"]:
        """The points in the first axes."""
        return self.points[:, :count].contiguous()


def iterate(
    data: Float[Tensor, "points d"],
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
    axes = PrincipalAxes(data)
    vectors = data.new_zeros(num_clusters, 0, 0)
    points, error = axes.points, axes.energy
    if affine:
        labels, _ = sort_labels(labels, num_clusters)
        seen = Subspaces(points, labels, data.new_zeros(num_clusters, data.shape[1], 0), True)
        error = float(seen.spread().double().sum())
    size = 0
    while size < rank:
        size = min(rank, max(1, 2 * size)) if doubling else size + 1
        count = axes.enough(error, least=size)
        points = axes.leading(count)
        vectors = torch.nn.functional.pad(vectors, (0, 0, 0, count - vectors.shape[1]))
        more = size - vectors.shape[2]
        fresh = torch.randn(num_clusters, count, more, generator=generator).to(data)
        vectors = torch.cat([vectors, fresh], dim=2)
        turns = _LAST_TURNS if size == rank else _TURNS_PER_RANK
        labels, vectors, within = _take_turns(points, labels, vectors, affine, turns)
        error = within + float(axes.beyond[count - 1])
    labels, old = sort_labels(labels, num_clusters)
    return Subspaces(points, labels, vectors[old], affine, steps=1).reassign(num_clusters)[0]


def _take_turns(
    points: Float[Tensor, "points d"],
    labels: Int[Tensor, "points"],
    vectors: Float[Tensor, "clusters d rank"],
    affine: bool,
    turns: int,
) -> tuple[Int[Tensor, "points"], Float[Tensor, "clusters d rank"], float]:
    """Refit, move points and relocate clusters; labels, vectors and error at the end."""
    error, before, relocating = torch.inf, None, True
    for turn in range(turns):
        labels, old = sort_labels(labels, len(vectors))
        fit = Subspaces(points, labels, vectors[old], affine, steps=3 if turn == 0 else 1)
        vectors = fit.vectors
        choice = fit.choose(NEAREST)
        error = float(choice.errors.double().sum())
        few = int((choice.labels != labels).sum()) <= _FEW_MOVES * len(labels)
        labels = choice.labels
        if turn % 2 == 1:
            if before is not None and error >= before[2]:
                labels, vectors, error = before
                before, relocating = None, False
                continue
            before = None
            if relocating and turn + 2 < turns:
                found = _relocate(points, fit, choice, affine)
                if found is not None:
                    before = labels, vectors, error
                    labels, vectors = found
                    continue
        if few and before is None:
            break
    return labels, vectors, error


@dataclass(frozen=True)
class Choice:
    """Where each point loses least, and where next.

    Attributes:
        labels: Its best cluster.
        errors: What it loses there.
        next_labels: The best other cluster known: where it would go if its best were given up.
        next_errors: What it would lose there.
    """

    labels: Int[Tensor, "points"]
    errors: Float[Tensor, "points"]
    next_labels: Int[Tensor, "points"]
    next_errors: Float[Tensor, "points"]


class Subspaces:
    """Means and vectors of every cluster for given labels, and what a point would lose in each.

    Args:
        points: The points.
        labels: Their clusters, numbered from the largest to the smallest.
        vectors: Where the orthogonal iteration starts, ``"clusters d rank"``.
        affine: Whether clusters have means, or their subspaces go through the origin.
        steps: Steps of orthogonal iteration.
    """

    def __init__(
        self,
        points: Float[Tensor, "points d"],
        labels: Int[Tensor, "points"],
        vectors: Float[Tensor, "clusters d rank"],
        affine: bool,
        steps: int = 0,
    ):
        self.num_clusters = len(vectors)
        self.blocks = ClusterBlocks(labels, self.num_clusters)
        self.centred = points.index_select(0, self.blocks.point_of_slot)
        filled = self.blocks.filled.to(points)[:, None]
        sizes = self.blocks.sizes().clamp_min(1)
        self.centres = self.blocks.transposed_matmul(filled, self.centred)[:, 0] / sizes[:, None]
        self.means = self.centres if affine else torch.zeros_like(self.centres)
        if affine:
            views = self.blocks.by_bucket(self.centred)
            for bucket, rows in zip(self.blocks.buckets, views, strict=True):
                rows -= self.centres[bucket.clusters, None]
        self.centred[~self.blocks.filled] = 0.0
        for _ in range(steps):
            products = self.blocks.matmul(self.centred, vectors)
            vectors = orthonormal(self.blocks.transposed_matmul(self.centred, products))
        self.vectors = vectors

    def spread(self) -> Float[Tensor, "slots"]:
        """Squared distance of each slot's point to its cluster's mean."""
        return torch.linalg.vector_norm(self.centred, dim=1).square()

    def squares(self) -> Float[Tensor, "clusters rank"]:
        """Squared singular values as the vectors see them, falling; turns the vectors to fit."""
        scale = float(self.centred.abs().max()) or 1.0
        products = self.blocks.matmul(self.centred / scale, self.vectors)
        inner = self.blocks.transposed_matmul(products, products).double()
        with one_thread():
            values, turn = torch.linalg.eigh(inner)
        self.vectors = self.vectors @ turn.flip(2).to(self.vectors)
        return values.flip(1).clamp_min(0.0) * scale**2

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
        own = torch.empty_like(self.centred[:, 0])
        other = torch.empty_like(own)
        rival = torch.empty_like(self.blocks.point_of_slot)
        for clusters, slots in self._chunks(count):
            losses = self._losses(clusters, slots, nearest[clusters])
            if price is not None:
                losses += price[nearest[clusters]][:, None]
            own[slots] = losses[..., 0].flatten()
            least, place = losses[..., 1:].min(dim=2)
            other[slots] = least.flatten()
            rival[slots] = nearest[clusters].gather(1, place + 1).flatten()
        spread, home = self.spread(), self.blocks.cluster_of_slot
        leaves = other < own
        labels = self.blocks.to_points(torch.where(leaves, rival, home))
        errors = self.blocks.to_points(torch.minimum(own, other) + spread)
        return Choice(
            labels=refill(labels, errors, self.num_clusters),
            errors=errors,
            next_labels=self.blocks.to_points(torch.where(leaves, home, rival)),
            next_errors=self.blocks.to_points(torch.maximum(own, other) + spread),
        )

    def _chunks(self, count: int) -> Iterator[tuple[slice, slice]]:
        """Runs of clusters and their slots whose tables of products and of vectors stay small."""
        columns = count * (self.vectors.shape[2] + 1)
        for bucket in self.blocks.buckets:
            elements = columns * max(bucket.size, self.vectors.shape[1])
            step = max(1, _CHUNK_ELEMENTS // elements)
            for start in range(0, bucket.num_clusters, step):
                stop = min(start + step, bucket.num_clusters)
                first = bucket.first_slot
                yield (
                    slice(bucket.first_cluster + start, bucket.first_cluster + stop),
                    slice(first + start * bucket.size, first + stop * bucket.size),
                )

    def _losses(
        self, clusters: slice, slots: slice, candidates: Int[Tensor, "clusters c"]
    ) -> Float[Tensor, "clusters size c"]:
        """Squared error of each point in each candidate cluster, less its own spread.

        With y the point less its own mean, δ the candidate's mean less its own, v the candidate's
        vectors: ``|y-δ|² - Σ (y·v - δ·v)² = |y|² - 2 y·δ + |δ|² - Σ (y·v - δ·v)²``.
        """
        shift = (self.means[candidates] - self.means[clusters, None]).mT  # clusters d c
        vectors = self.vectors[candidates].permute(0, 2, 3, 1)  # clusters d rank c
        rows = self.centred[slots].view(len(candidates), -1, self.centred.shape[1])
        offsets = -(vectors * shift[:, :, None]).sum(1).flatten(1)
        explained = torch.baddbmm(offsets[:, None], rows, vectors.flatten(2))
        explained = explained.unflatten(2, vectors.shape[2:]).square_().sum(2)
        lengths = shift.square().sum(1)[:, None]
        return torch.baddbmm(lengths, rows, shift, alpha=-2.0).sub_(explained)


def _relocate(
    points: Float[Tensor, "points d"], fit: Subspaces, choice: Choice, affine: bool
) -> tuple[Int[Tensor, "points"], Float[Tensor, "clusters d rank"]] | None:
    """Give up clusters of little use and cut others in two in their place, if that promises well.

    Returns:
        New labels and vectors, or nothing.
    """
    count = fit.num_clusters
    labels, errors = choice.labels, choice.errors.double()
    error = errors.new_zeros(count).index_add_(0, labels, errors)
    cost = errors.new_zeros(count).index_add_(0, labels, choice.next_errors.double() - errors)
    parents = error.topk(max(1, int(_CUT_SHARE * count))).indices
    is_parent = torch.isin(labels, parents)
    members = torch.nonzero(is_parent)[:, 0]
    halves, left, vectors = _cut(points[members], labels[members], fit, parents, affine)
    gain = error[parents] - left
    heirs = torch.zeros(count, count, dtype=torch.bool, device=labels.device)
    heirs[labels, choice.next_labels] = True
    pairs = _pairs(gain, cost, parents, heirs)
    if not pairs:
        return None
    places, removed = torch.tensor(pairs, device=labels.device).T
    gone = torch.zeros(count, dtype=torch.bool, device=labels.device)
    gone[removed] = True
    moved = torch.where(gone[labels], choice.next_labels, labels)
    target = torch.full((2 * len(parents),), -1, dtype=labels.dtype, device=labels.device)
    target[2 * places + 1] = removed
    to = target[halves]
    moved[members[to >= 0]] = to[to >= 0]
    changed = fit.vectors.clone()
    changed[parents[places]], changed[removed] = vectors[2 * places], vectors[2 * places + 1]
    return refill(moved, choice.errors, count), changed


def _cut(
    points: Float[Tensor, "members d"],
    labels: Int[Tensor, "members"],
    fit: Subspaces,
    parents: Int[Tensor, "parents"],
    affine: bool,
) -> tuple[Int[Tensor, "members"], Float[Tensor, "parents"], Float[Tensor, "halves d rank"]]:
    """Cut clusters across their longest direction and fit both halves.

    Returns:
        Half of each point (two for each parent, one after the other), what both halves together
        lose, and the halves' vectors.
    """
    place = torch.zeros(fit.num_clusters, dtype=labels.dtype, device=labels.device)
    place[parents] = torch.arange(len(parents), device=labels.device)
    # Linear clusters hold all lengths of their first vector alike: only the next is worth a cut.
    column = 0 if affine else min(1, fit.vectors.shape[2] - 1)
    offsets = points - fit.centres[labels]
    along = (offsets * fit.vectors[:, :, column][labels]).sum(1)
    halves = 2 * place[labels] + (along > 0)
    ordered, old = sort_labels(halves, 2 * len(parents))
    start = fit.vectors[parents[old // 2]]
    both = Subspaces(points, ordered, start, affine, steps=2)
    lost = both.blocks.sum(both.spread()[:, None])[:, 0] - both.squares().sum(1)
    left = lost.new_zeros(len(parents)).index_add_(0, old // 2, lost)
    vectors = torch.empty_like(both.vectors)
    vectors[old] = both.vectors
    return halves, left, vectors


def _pairs(
    gain: Float[Tensor, "parents"],
    cost: Float[Tensor, "clusters"],
    parents: Int[Tensor, "parents"],
    heirs: Bool[Tensor, "clusters clusters"],
) -> list[tuple[int, int]]:
    """Which parent to cut (its place) for which cluster given up: best gain with least cost.

    No cluster given up is heir of another, so that every point has somewhere to go.
    """
    heirs = heirs.cpu()
    costs, clusters = cost.tolist(), parents.tolist()
    cheap = iter(torch.argsort(cost, stable=True).tolist())
    gone = torch.zeros(len(costs), dtype=torch.bool)
    busy = torch.zeros(len(costs), dtype=torch.bool)
    pairs = []
    for place in torch.argsort(gain, descending=True, stable=True).tolist():
        parent = clusters[place]
        if busy[parent]:
            continue
        removed = next(
            (k for k in cheap if k != parent and not busy[k] and not (heirs[k] & gone).any()), None
        )
        if removed is None or float(gain[place]) <= _LEAST_RETURN * costs[removed]:
            break
        busy |= heirs[removed]
        busy[[removed, parent]] = True
        gone[removed] = True
        pairs.append((place, removed))
    return pairs
