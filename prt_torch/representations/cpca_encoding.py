"""How CPCA finds its clusters and subspaces.

1. Transfer is weighed by the metric, so that errors are plain sums of squares. Where a point has
   more values than ``_MAX_DIMENSIONS``, one near-lossless projection (randomised, by blocks of
   points) makes every later step cheap.
2. Lloyd's iterations (the paper's LBG) give the first clusters: from k-means++ seeds and to their
   end where they are the clusters (static), from cheaper seeds and only roughly where they are a
   start (iterative), which ends as low in half the time.
3. Iterative: for each rank from 0 up, turns of {one step of orthogonal iteration of every
   cluster's vectors; move each point to the best of the clusters nearest to its own}, until few
   points move. A step of orthogonal iteration started from the last turn's vectors never loses
   what they held, so the error falls in every turn, at a small part of the price of an
   eigen-decomposition.
4. The last subspaces come from a full decomposition in float64 of each cluster: by eigenvectors of
   the Gram matrix, or by the singular values of the points themselves where the Gram matrix would
   lose digits (a ratio above ``_STIFF``).

Errors are computed from differences to the cluster's own mean, so they keep their digits when the
error is far below the signal.

Source:
    Sloan, Hall, Hart, Snyder 2003, sections 4.1 and 4.2.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from sklearn.cluster import kmeans_plusplus
from torch import Tensor

from prt_torch.metric import Metric
from prt_torch.representations.grouped import ClusterBlocks, sort_labels
from prt_torch.transfer import TransferTensor

_MAX_DIMENSIONS = 256  # of the projection; 3 further ranks than it loses less than 1e-3 of energy
_NEAREST = 16  # clusters a point may move to in one turn
_LLOYD_TURNS = 100
_ROUGH_LLOYD_TURNS = 10
_TURNS_PER_RANK = 8
_LAST_TURNS = 24
_FEW_LLOYD_MOVES = 5e-4  # share of points; below it Lloyd's iterations end
_FEW_MOVES = 2e-3  # share of points; below it a turn ends a rank
_STIFF = 1e3  # ratio of singular values above which Gram matrices are not trusted
_BLOCK_ELEMENTS = 2**24  # of one table of distances


@dataclass(frozen=True)
class Encoding:
    """Clusters, their representatives and the weights of points.

    Attributes:
        labels: ``"points"`` int64, clusters numbered from the largest to the smallest.
        representatives: ``"clusters rank+1 values"``, the mean first.
        weights: ``"points rank"``.
        condition: Largest over smallest kept singular value, of the worst cluster.
    """

    labels: Int[Tensor, "points"]
    representatives: Float[Tensor, "clusters vectors values"]
    weights: Float[Tensor, "points rank"]
    condition: float


def encode(
    transfer: TransferTensor,
    *,
    num_clusters: int,
    rank: int,
    iterative: bool,
    metric: Metric,
    generator: torch.Generator,
) -> Encoding:
    """Cluster the points of a transfer tensor and fit each cluster's affine subspace."""
    values_per_point = transfer.num_channels * transfer.num_rows * transfer.num_coeffs
    rank = min(rank, values_per_point)
    data, lift = _project(transfer, metric, rank, generator)
    data_mean = data.mean(0, dtype=torch.float64).to(data)
    data = data - data_mean
    rough = iterative and rank > 0
    labels, num_clusters = _vector_quantise(data, num_clusters, generator, rough)
    if rough and num_clusters > 1:
        labels = _iterate(data, labels, num_clusters, rank, generator)
    labels, _ = sort_labels(labels, num_clusters)
    blocks = ClusterBlocks(labels, num_clusters)
    means, vectors, weights, condition = _decompose(data, blocks, rank)
    if lift is not None:
        means = _exact_means(transfer, metric, labels, num_clusters)
        vectors = vectors @ lift.mT.to(vectors)
    else:
        means = means + data_mean.to(means)
    representatives = torch.cat([means[:, None], vectors], dim=1)
    shaped = representatives.unflatten(-1, (-1, transfer.num_coeffs))
    dtype = transfer.values.dtype
    return Encoding(
        labels=labels,
        representatives=metric.unweigh(shaped).flatten(-2).to(dtype),
        weights=weights.to(dtype),
        condition=condition,
    )


def _weighed_blocks(
    transfer: TransferTensor, metric: Metric
) -> Iterator[tuple[slice, Float[Tensor, "points values"]]]:
    for rows, values in transfer.blocks():
        yield rows, metric.weigh(values).flatten(1)


def _project(
    transfer: TransferTensor, metric: Metric, rank: int, generator: torch.Generator
) -> tuple[Float[Tensor, "points d"], Float[Tensor, "values d"] | None]:
    """Points in the space that clustering works in; the orthonormal way back if they were cut."""
    size = transfer.num_channels * transfer.num_rows * transfer.num_coeffs
    dimensions = max(_MAX_DIMENSIONS, 3 * rank)
    if size <= dimensions:
        data = torch.cat([values for _, values in _weighed_blocks(transfer, metric)])
        return data, None
    lift = torch.randn(size, dimensions, generator=generator).to(transfer.values.dtype)
    for _ in range(3):  # orthogonal iteration on the second moment, by blocks of points
        image = torch.zeros_like(lift, dtype=torch.float64)
        for _, values in _weighed_blocks(transfer, metric):
            image += values.mT @ (values @ lift)
        lift = torch.linalg.qr(image)[0].to(lift)
    data = torch.cat([values @ lift for _, values in _weighed_blocks(transfer, metric)])
    return data, lift


def _exact_means(
    transfer: TransferTensor, metric: Metric, labels: Tensor, num_clusters: int
) -> Float[Tensor, "clusters values"]:
    """Cluster means of the unprojected values, float64."""
    size = transfer.num_channels * transfer.num_rows * transfer.num_coeffs
    total = torch.zeros(num_clusters, size, dtype=torch.float64, device=labels.device)
    for rows, values in _weighed_blocks(transfer, metric):
        total.index_add_(0, labels[rows], values.double())
    count = torch.bincount(labels, minlength=num_clusters).clamp_min(1)
    return total / count[:, None]


def _vector_quantise(
    data: Float[Tensor, "points d"], num_clusters: int, generator: torch.Generator, rough: bool
) -> tuple[Int[Tensor, "points"], int]:
    """Lloyd's iterations; no more clusters than distinct points, and none of them empty."""
    host = data.cpu().numpy()
    num_clusters = min(num_clusters, _count_distinct(host))
    if rough:
        means = data[_spread_seeds(data, num_clusters, generator)]
    else:
        seed = int(torch.randint(2**31 - 1, (1,), generator=generator))
        scale = float(np.abs(host).max()) or 1.0  # squared distances of tiny signals underflow
        centres, _ = kmeans_plusplus(host / scale, num_clusters, random_state=seed)
        means = torch.from_numpy(centres * scale).to(data)
    labels = torch.full((len(data),), -1, dtype=torch.int64, device=data.device)
    for _ in range(_ROUGH_LLOYD_TURNS if rough else _LLOYD_TURNS):
        previous = labels
        labels, distances = _nearest(data, means)
        labels = _refill(labels, distances, num_clusters)
        if int((labels != previous).sum()) <= _FEW_LLOYD_MOVES * len(labels):
            break
        means = _cluster_means(data, labels, num_clusters)
    return labels, num_clusters


def _spread_seeds(
    data: Tensor, num_clusters: int, generator: torch.Generator
) -> Int[Tensor, "clusters"]:
    """Points drawn one by one with odds of their squared distance to those drawn before.

    This is k-means++ without its local trials, which cost more than all else here.
    """
    squares = data.square().sum(1)
    draws = torch.rand(num_clusters, generator=generator, dtype=torch.float64).to(data.device)
    seeds = [torch.randint(len(data), (1,), generator=generator).to(data.device)]
    distance = torch.full_like(squares, torch.inf)
    for draw in draws[1:]:
        seed = data[seeds[-1]]
        to_seed = torch.addmv(squares, data, seed[0], alpha=-2.0) + seed.square().sum()
        distance = torch.minimum(distance, to_seed.clamp_min_(0.0))
        odds = distance.cumsum(0, dtype=torch.float64)
        at = torch.searchsorted(odds, (draw * odds[-1])[None], right=True)
        seeds.append(at.clamp_max(len(data) - 1))
    return torch.cat(seeds)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Small factorisations gain nothing from threads, and on a busy machine lose a hundredfold."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _count_distinct(points: np.ndarray) -> int:
    """How many different points there are; told apart by one random combination of their values."""
    mixture = np.random.default_rng(0).standard_normal(points.shape[1])
    return len(np.unique(points.astype(np.float64) @ mixture))


def _cluster_means(data: Tensor, labels: Tensor, num_clusters: int) -> Float[Tensor, "clusters d"]:
    total = torch.zeros(num_clusters, data.shape[1], dtype=torch.float64, device=data.device)
    total.index_add_(0, labels, data.double())
    count = torch.bincount(labels, minlength=num_clusters).clamp_min(1)
    return (total / count[:, None]).to(data)


def _nearest(data: Tensor, means: Tensor) -> tuple[Int[Tensor, "points"], Float[Tensor, "points"]]:
    """The nearest mean of each point, and the squared distance to it."""
    offsets = means.square().sum(1)
    labels, distances = [], []
    for some in data.split(max(1, _BLOCK_ELEMENTS // len(means))):
        distance, label = torch.addmm(offsets, some, means.mT, alpha=-2.0).min(dim=1)
        labels.append(label)
        distances.append((distance + some.square().sum(1)).clamp_min(0.0))
    return torch.cat(labels), torch.cat(distances)


def _refill(labels: Tensor, errors: Tensor, num_clusters: int) -> Int[Tensor, "points"]:
    """Give each empty cluster one of the worst points."""
    empty = torch.nonzero(torch.bincount(labels, minlength=num_clusters) == 0)[:, 0]
    if len(empty) == 0:
        return labels
    labels = labels.clone()
    labels[errors.topk(len(empty)).indices] = empty
    return labels


def _iterate(
    data: Float[Tensor, "points d"],
    labels: Int[Tensor, "points"],
    num_clusters: int,
    rank: int,
    generator: torch.Generator,
) -> Int[Tensor, "points"]:
    """Clusters by the error of their own subspaces, which grow one vector at a time."""
    vectors = data.new_zeros(num_clusters, data.shape[1], 0)
    for size in range(1, rank + 1):
        fresh = torch.randn(num_clusters, data.shape[1], 1, generator=generator).to(data)
        vectors = torch.cat([vectors, fresh], dim=2)
        last = size == rank
        for turn in range(_LAST_TURNS if last else _TURNS_PER_RANK):
            labels, old = sort_labels(labels, num_clusters)
            fit = _Subspaces(data, labels, vectors[old], power_steps=3 if turn == 0 else 1)
            vectors = fit.vectors
            moved = fit.reassign(_NEAREST)
            few = int((moved != labels).sum()) <= _FEW_MOVES * len(labels)
            labels = moved
            if few:
                break
        if last:
            labels, old = sort_labels(labels, num_clusters)
            labels = _Subspaces(data, labels, vectors[old], power_steps=1).reassign(num_clusters)
    return labels


class _Subspaces:
    """Means and vectors of every cluster for given labels, and what a point would lose in each."""

    def __init__(self, data: Tensor, labels: Tensor, vectors: Tensor, power_steps: int):
        self.num_clusters = len(vectors)
        self.blocks = ClusterBlocks(labels, self.num_clusters)
        slots = self.blocks.to_slots(data)
        sizes = self.blocks.sizes().clamp_min(1)
        self.means = (self.blocks.sum(slots) / sizes[:, None]).to(data)
        self.centred = slots - self.means[self.blocks.cluster_of_slot]
        self.centred *= self.blocks.filled[:, None]
        for _ in range(power_steps):
            image = self.blocks.transposed_matmul(
                self.centred, self.blocks.matmul(self.centred, vectors)
            )
            vectors = _orthonormal(image)
        self.vectors = vectors

    def reassign(self, num_candidates: int) -> Int[Tensor, "points"]:
        """The best cluster of each point among those nearest to its own; none is left empty."""
        distances = torch.cdist(self.means, self.means)
        distances.fill_diagonal_(-1.0)  # its own first
        count = min(num_candidates, self.num_clusters)
        nearest = distances.topk(count, largest=False).indices
        best = torch.full_like(self.centred[:, 0], torch.inf)
        label = torch.zeros(len(best), dtype=torch.int64, device=best.device)
        for candidates in nearest.split(_NEAREST, dim=1):
            error, choice = self._errors(candidates).min(dim=1)
            better = error < best
            best = torch.where(better, error, best)
            chosen = candidates[self.blocks.cluster_of_slot].gather(1, choice[:, None])[:, 0]
            label = torch.where(better, chosen, label)
        labels = self.blocks.to_points(label)
        return _refill(labels, self.blocks.to_points(best), self.num_clusters)

    def _errors(self, candidates: Int[Tensor, "clusters c"]) -> Float[Tensor, "slots c"]:
        """Squared error of each point in each candidate cluster of its own cluster.

        With y the point less its own mean, δ the candidate's mean less its own, v the candidate's
        vectors: ``|y-δ|² - Σ (y·v - δ·v)²``.
        """
        shift = self.means[candidates] - self.means[:, None]  # clusters c d
        vectors = self.vectors[candidates].mT  # clusters c rank d
        rows = torch.cat([shift[:, :, None], vectors], dim=2)
        offsets = -(rows * shift[:, :, None]).sum(-1)
        offsets[:, :, 0] *= 0.5
        products = self.blocks.matmul(
            self.centred, rows.flatten(1, 2).mT, offsets=offsets.flatten(1)
        ).unflatten(1, rows.shape[1:3])
        own = self.centred.square().sum(1)
        explained = products[:, :, 1:].square().sum(2)
        return own[:, None] - 2.0 * products[:, :, 0] - explained


def _orthonormal(vectors: Float[Tensor, "clusters d rank"]) -> Float[Tensor, "clusters d rank"]:
    """Orthonormal columns with the same span; zero columns stay harmless unit vectors."""
    scale = vectors.abs().amax((1, 2), keepdim=True)
    with _one_thread():
        return torch.linalg.qr(vectors / torch.where(scale > 0, scale, 1.0))[0]


def _decompose(
    data: Float[Tensor, "points d"], blocks: ClusterBlocks, rank: int
) -> tuple[Tensor, Tensor, Tensor, float]:
    """Means ``"clusters d"``, vectors ``"clusters rank d"``, weights ``"points rank"``, condition.

    All float64. Vectors that a cluster has no use for are zero, with zero weights.
    """
    slots = blocks.to_slots(data.double())
    means = blocks.sum(slots) / blocks.sizes().clamp_min(1)[:, None]
    centred = (slots - means[blocks.cluster_of_slot]) * blocks.filled[:, None]
    vectors, condition = [], 1.0
    for rows in blocks.by_bucket(centred):
        singular, directions = _principal(rows, rank)
        vectors.append(directions)
        condition = max(condition, _worst_ratio(singular))
    joined = torch.cat(vectors)
    weights = blocks.to_points(blocks.matmul(centred, joined.mT))
    return means, joined, weights, condition


def _worst_ratio(singular: Float[Tensor, "clusters rank"]) -> float:
    """Largest over smallest nonzero singular value, of the worst cluster."""
    if singular.shape[1] == 0:
        return 1.0
    smallest = torch.where(singular > 0, singular, torch.inf).amin(1)
    return float((singular[:, 0] / smallest).max().clamp_min(1.0))


def _principal(
    rows: Float[Tensor, "clusters size d"], rank: int
) -> tuple[Float[Tensor, "clusters rank"], Float[Tensor, "clusters rank d"]]:
    """Largest singular values of each cluster's points and their right vectors, padded by zeros.

    Source:
        Sloan et al. 2003, section 4.1, with the misprint mended: the vectors are the rows of V^T,
        and V^T = D^-1 U^T C.
    """
    _, size, dimensions = rows.shape
    kept = min(rank, size, dimensions)
    wide = size < dimensions
    gram = rows @ rows.mT if wide else rows.mT @ rows
    with _one_thread():
        eigenvalues, eigenvectors = torch.linalg.eigh(gram)
    singular = eigenvalues.clamp_min(0.0).sqrt().flip(-1)[:, :kept]
    directions = eigenvectors.flip(-1)[..., :kept].mT
    if wide:
        directions = directions @ rows / torch.where(singular > 0, singular, 1.0)[..., None]
    if kept:
        stiff = singular[:, 0] > _STIFF * singular[:, -1]
        if bool(stiff.any()):
            with _one_thread():
                _, exact, rights = torch.linalg.svd(rows[stiff], full_matrices=False)
            singular[stiff], directions[stiff] = exact[:, :kept], rights[:, :kept]
        limit = singular[:, :1] * max(size, dimensions) * torch.finfo(rows.dtype).eps
        used = singular > limit
        singular, directions = singular * used, directions * used[..., None]
    padding = rank - kept
    singular = torch.nn.functional.pad(singular, (0, padding))
    return singular, torch.nn.functional.pad(directions, (0, 0, 0, padding))
