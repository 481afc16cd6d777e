"""The exact subspaces of given clusters: means, principal vectors and singular values, in float64.

Each cluster is decomposed by the eigenvectors of its Gram matrix, or by the singular values of the
points themselves where the Gram matrix would lose digits. Where a cluster's points do not fit in
memory, or lie in several processes, they are replaced by the triangular factor of their QR
decomposition as they are read: fewer rows with the same singular values and right vectors.

Source:
    Sloan, Hall, Hart, Snyder 2003, section 4.1, "Per-Cluster PCA". Demmel, Grigori, Hoemmen,
    Langou 2012, "Communication-optimal parallel and sequential QR", for the factors.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from prt_torch.representations.points import Points, cluster_sizes, renumber

# Ratio of singular values above which Gram matrices (in float64) are not trusted. Points given in
# float32 hold no digits below 1e-7 of the largest, so less is asked of theirs.
_STIFF = {torch.float64: 1e3, torch.float32: 1e5}


@contextmanager
def one_thread() -> Iterator[None]:
    """Small factorisations gain nothing from threads, and on a busy machine lose a hundredfold."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@dataclass(frozen=True)
class Decomposition:
    """What every cluster holds, all float64.

    Vectors that a cluster has no use for are zero.

    Attributes:
        labels: Cluster of each point, clusters numbered from the largest to the smallest.
        sizes: Points of each cluster, of all processes.
        means: Zero where the subspaces go through the origin.
        vectors: Orthonormal, by falling singular value.
        singular: Singular values of each cluster's points less its mean.
        spread: Sum of the squares of each cluster's points less its mean.
    """

    labels: Int[Tensor, "points"]
    sizes: Int[Tensor, "clusters"]
    means: Float[Tensor, "clusters d"]
    vectors: Float[Tensor, "clusters rank d"]
    singular: Float[Tensor, "clusters rank"]
    spread: Float[Tensor, "clusters"]

    def used(self, ranks: Int[Tensor, "clusters"]) -> Bool[Tensor, "clusters rank"]:
        """Which vectors are among the first ``ranks`` of their cluster."""
        return torch.arange(self.singular.shape[1], device=ranks.device) < ranks[:, None]

    def error(self, ranks: Int[Tensor, "clusters"]) -> float:
        """Squared error with these ranks: spread less the squared singular values."""
        kept = (self.singular.square() * self.used(ranks)).sum(1)
        return float((self.spread - kept).clamp_min(0.0).sum())

    def condition(self, ranks: Int[Tensor, "clusters"]) -> float:
        """Largest over smallest nonzero singular value kept, of the worst cluster."""
        singular = self.singular * self.used(ranks)
        if singular.shape[1] == 0:
            return 1.0
        smallest = torch.where(singular > 0, singular, torch.inf).amin(1)
        return float((singular[:, 0] / smallest).max().clamp_min(1.0))


def decompose(
    data: Float[Tensor, "points d"] | Points,
    labels: Int[Tensor, "points"],
    num_clusters: int,
    rank: int,
    affine: bool,
) -> Decomposition:
    """Fit each cluster's subspace of a rank."""
    points = Points.of(data)
    labels, _ = renumber(labels, num_clusters, points.processes)
    sizes = cluster_sizes(labels, num_clusters, points.processes)
    means = points.like.new_zeros(num_clusters, points.rest[0], dtype=torch.float64)
    if affine:
        for rows, values in points.chunks():
            means.index_add_(0, labels[rows].long(), values.double())
        means = points.processes.sum(means) / sizes.clamp_min(1)[:, None]
    singular = means.new_zeros(num_clusters, rank)
    vectors = means.new_zeros(num_clusters, rank, points.rest[0])
    spread = means.new_zeros(num_clusters)

    def less_mean(members: Tensor, cluster: int) -> Tensor:
        return members.double() - means[cluster]

    for cluster, members in condensed(points, labels, sizes, less_mean, points.rest[0]):
        values, directions = principal(members[None], rank, _STIFF[points.like.dtype])
        singular[cluster], vectors[cluster] = values[0], directions[0]
        spread[cluster] = torch.linalg.vector_norm(members).square()
    return Decomposition(labels, sizes, means, vectors, singular, spread)


def condensed(
    points: Points,
    labels: Int[Tensor, "points"],
    sizes: Int[Tensor, "clusters"],
    prepared: Callable[[Tensor, int], Float[Tensor, "some d"]],
    width: int,
) -> Iterator[tuple[int, Float[Tensor, "rows d"]]]:
    """Rows of each cluster's points, or fewer of the same singular values and right vectors.

    Args:
        points: Read once if memory allows, else once for each group of clusters that fits.
        labels: Cluster of each point.
        sizes: Of each cluster, over all processes.
        prepared: Rows in float64 of some points' values and their cluster.
        width: Of a row.

    Yields:
        Every cluster's number with its rows.
    """
    most, processes = 2 * width, points.processes
    rows_of = [min(size, (1 + processes.count) * most) for size in sizes.tolist()]
    for group in _groups(rows_of, points.table_elements // (4 * width)):
        edges = torch.arange(group.start, group.stop + 1, device=labels.device)
        parts: list[list[Tensor]] = [[] for _ in group]
        for rows, values in points.chunks():
            own = labels[rows].long()
            order = torch.argsort(own, stable=True)
            borders = torch.searchsorted(own[order], edges).tolist()
            for place, cluster in enumerate(group):
                members = order[borders[place] : borders[place + 1]]
                if len(members):
                    parts[place].append(prepared(values[members], cluster))
                    if sum(map(len, parts[place])) > most and not points.in_one_chunk:
                        parts[place] = [_triangular(torch.cat(parts[place]))]
        none = points.like.new_zeros(0, width, dtype=torch.float64)
        local = [torch.cat(part) if part else none for part in parts]
        if processes.count > 1:
            local = _from_all(local, most, points)
        yield from zip(group, local, strict=True)


def _groups(rows_of: list[int], limit: int) -> Iterator[range]:
    """Runs of clusters with no more rows in all; of one cluster if that alone has more."""
    start, total = 0, 0
    for cluster, rows in enumerate(rows_of):
        if cluster > start and total + rows > limit:
            yield range(start, cluster)
            start, total = cluster, 0
        total += rows
    yield range(start, len(rows_of))


def _from_all(local: list[Tensor], most: int, points: Points) -> list[Tensor]:
    """Rows of each cluster from all processes, in order of rank."""
    local = [_triangular(rows) if len(rows) > most else rows for rows in local]
    counts = torch.tensor([[len(rows) for rows in local]], device=points.like.device)
    every = points.processes.gather(counts)
    together = points.processes.gather(torch.cat(local)).split(every.flatten().tolist())
    return [torch.cat(together[place :: len(local)]) for place in range(len(local))]


def _triangular(rows: Float[Tensor, "rows d"]) -> Float[Tensor, "d d"]:
    """Fewer rows with the same singular values and right vectors."""
    with one_thread():
        return torch.linalg.qr(rows, mode="r")[1]


def principal(
    rows: Float[Tensor, "clusters size d"], rank: int, stiff_ratio: float = 1e3
) -> tuple[Float[Tensor, "clusters rank"], Float[Tensor, "clusters rank d"]]:
    """Largest singular values of each cluster's points and their right vectors, padded by zeros.

    Args:
        rows: Points of each cluster, float64; rows of zeros do not matter.
        rank: How many.
        stiff_ratio: Where the largest is above this many times the last, singular values are
            computed from the points themselves.

    Source:
        Sloan et al. 2003, section 4.1, with the misprint mended: the vectors are the rows of V^T,
        and V^T = D^-1 U^T C.
    """
    _, size, dimensions = rows.shape
    kept = min(rank, size, dimensions)
    wide = size < dimensions
    # Scaled, so that squares of tiny signals do not underflow.
    scale = rows.abs().amax((1, 2), keepdim=True)
    rows = rows / torch.where(scale > 0, scale, 1.0)
    gram = rows @ rows.mT if wide else rows.mT @ rows
    with one_thread():
        eigenvalues, eigenvectors = torch.linalg.eigh(gram)
    singular = eigenvalues.clamp_min(0.0).sqrt().flip(-1)[:, :kept]
    directions = eigenvectors.flip(-1)[..., :kept].mT
    if wide:
        directions = directions @ rows / torch.where(singular > 0, singular, 1.0)[..., None]
    if kept:
        stiff = singular[:, 0] > stiff_ratio * singular[:, -1]
        if bool(stiff.any()):
            exact, rights = _exact(rows[stiff])
            singular[stiff], directions[stiff] = exact[:, :kept], rights[:, :kept]
        limit = singular[:, :1] * max(size, dimensions) * torch.finfo(rows.dtype).eps
        used = singular > limit
        singular, directions = singular * used, directions * used[..., None]
    padding = rank - kept
    singular = torch.nn.functional.pad(singular * scale[:, 0], (0, padding))
    return singular, torch.nn.functional.pad(directions, (0, 0, 0, padding))


def _exact(
    rows: Float[Tensor, "clusters size d"],
) -> tuple[Float[Tensor, "clusters least"], Float[Tensor, "clusters least d"]]:
    """Singular values and right vectors of the points themselves.

    LAPACK's own right vectors can leave the span of equal points by tens of roundings; products
    of its left vectors with the points do not.
    """
    with one_thread():
        left, singular, _ = torch.linalg.svd(rows, full_matrices=False)
        rights = torch.linalg.qr((left.mT @ rows).mT)[0].mT
    return singular, rights
