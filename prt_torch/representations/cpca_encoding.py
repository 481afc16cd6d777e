"""How CPCA finds its clusters and subspaces.

1. Transfer of extreme magnitude is scaled (``magnitude``), and weighed by the metric, so that
   errors are plain sums of squares. Where a point has
   more values than ``MAX_DIMENSIONS``, one near-lossless projection (``cpca_projection``) makes
   every later step cheap.
2. Lloyd's iterations give the first clusters (``cpca_clusters``): from k-means++ seeds and to their
   end where they are the clusters (static), from cheaper seeds and only roughly where they are a
   start (iterative), which ends as low in half the time.
3. Iterative: points move by the error of the clusters' own subspaces (``cpca_iteration``).
4. Adaptive: from there, clusters take unequal ranks (``cpca_adaptive``).
5. The last subspaces come from a full decomposition of each cluster in float64
   (``cpca_subspaces``).

Points are read in chunks where a budget of memory asks for it, and may lie in several processes
(``points``).

Source:
    Sloan, Hall, Hart, Snyder 2003, section 4.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.metric import Metric
from prt_torch.representations.cpca_adaptive import adapt
from prt_torch.representations.cpca_clusters import vector_quantise
from prt_torch.representations.cpca_iteration import iterate
from prt_torch.representations.cpca_projection import Projected, project, weighed_blocks
from prt_torch.representations.cpca_subspaces import Decomposition, decompose
from prt_torch.representations.magnitude import of_ordinary_magnitude
from prt_torch.representations.points import (
    Mapped,
    Points,
    SortedPoints,
    cluster_sizes,
    label_type,
    slices,
)
from prt_torch.representations.processes import ALONE, Processes
from prt_torch.representations.scratch import Memory
from prt_torch.transfer import TransferTensor

Method = Literal["iterative", "static", "adaptive"]

MAX_DIMENSIONS = 256
"""Of the projection; 3 further ranks than it loses less than 1e-3 of energy."""

_LABELS = 8  # of a point, of several kinds, while clusters are looked for
_TABLES = 6  # of the size of all vectors, float64


@dataclass(frozen=True)
class Encoding:
    """Clusters, their representatives and the weights of points.

    Attributes:
        labels: Cluster of each point, clusters numbered from the largest to the smallest.
        ranks: Vectors of each cluster beside its mean.
        representatives: One cluster after the other: its mean if affine, then its vectors.
        weights: One point after the other, each with its cluster's rank.
        affine: Whether clusters have means.
        condition: Largest over smallest kept singular value, of the worst cluster.
    """

    labels: Int[Tensor, "points"]
    ranks: Int[Tensor, "clusters"]
    representatives: Float[Tensor, "vectors values"]
    weights: Float[Tensor, "entries"]
    affine: bool
    condition: float


def encode(
    transfer: TransferTensor,
    *,
    num_clusters: int,
    rank: int,
    method: Method,
    affine: bool,
    metric: Metric,
    generator: torch.Generator,
    memory_budget: int | None = None,
    processes: Processes = ALONE,
) -> Encoding:
    """Cluster the points of a transfer tensor and fit each cluster's subspace.

    Raises:
        InputError: If ``memory_budget`` is too small.
    """
    size = transfer.num_channels * transfer.num_rows * transfer.num_coeffs
    rank = min(rank, size)
    dimensions = max(MAX_DIMENSIONS, 3 * rank)
    memory = _memory(transfer, num_clusters, rank, min(size, dimensions), memory_budget)
    transfer, power = of_ordinary_magnitude(transfer, memory, processes)
    projected = project(transfer, metric, dimensions, generator, memory, processes)
    points = projected.points
    data_mean = _centre(points) if affine else points.like.new_zeros(points.rest)
    rough = method != "static" and rank > 0
    labels, num_clusters = vector_quantise(points, num_clusters, generator, rough)
    if rough and num_clusters > 1:
        labels = iterate(points, labels, num_clusters, rank, affine, generator)
    if method == "adaptive":
        found, ranks = adapt(points, labels, num_clusters, rank, affine, size)
    else:
        found = decompose(points, labels, num_clusters, rank, affine)
        ranks = torch.full_like(found.sizes, rank)
    del labels
    representatives = _representatives(
        transfer, metric, projected, found, ranks, data_mean if affine else None
    )
    if affine:
        representatives[(ranks + 1).cumsum(0) - ranks - 1] /= power
    return Encoding(
        representatives=representatives,
        weights=_weights(points, found, ranks).div_(power),
        labels=found.labels.long(),
        ranks=ranks,
        affine=affine,
        condition=found.condition(ranks),
    )


def _memory(
    transfer: TransferTensor, num_clusters: int, rank: int, dimensions: int, budget: int | None
) -> Memory:
    """The budget, less what labels, weights and tables of all clusters take at their most."""
    itemsize = transfer.values.dtype.itemsize
    size = transfer.num_channels * transfer.num_rows * transfer.num_coeffs
    vectors = num_clusters * (rank + 1)
    labels = _LABELS * label_type(num_clusters).itemsize
    working = transfer.num_points * (labels + itemsize)
    result = transfer.num_points * (rank * itemsize + 8) + vectors * size * itemsize
    tables = vectors * dimensions * 8 * _TABLES
    return Memory(budget, max(working, result) + tables)


def _centre(points: Points) -> Float[Tensor, "d"]:
    """Take the mean off all points."""
    total = points.like.new_zeros(points.rest, dtype=torch.float64)
    for _, values in points.chunks():
        total += values.sum(0, dtype=torch.float64)
    mean = (points.processes.sum(total) / points.total).to(points.like)
    for rows, values in points.chunks():
        points.write(rows, values - mean)
    return mean


def _representatives(
    transfer: TransferTensor,
    metric: Metric,
    projected: Projected,
    found: Decomposition,
    ranks: Int[Tensor, "clusters"],
    data_mean: Float[Tensor, "d"] | None,
) -> Float[Tensor, "vectors values"]:
    """Means before their clusters' vectors, out of the metric, in the transfer's precision."""
    points, affine = projected.points, int(data_mean is not None)
    shape = tuple(transfer.values.shape[1:])
    first = (ranks + affine).cumsum(0) - ranks - affine
    out = points.like.new_empty(int((ranks + affine).sum()), math.prod(shape))

    def write(places: Tensor, weighed: Float[Tensor, "some values"]) -> None:
        out[places] = metric.unweigh(weighed.unflatten(-1, shape)).flatten(1).to(out)

    if data_mean is not None and projected.lift is None:
        write(first, found.means + data_mean.to(found.means))
    elif data_mean is not None:
        for clusters, means in _exact_means(transfer, metric, found, points):
            write(first[clusters], means)
    used = found.used(ranks)
    steps = torch.arange(used.shape[1], device=used.device) + affine
    places, vectors = (first[:, None] + steps)[used], found.vectors[used]
    at_once = points.memory.rows_at_once(8 * len(out[0])) or max(1, len(places))
    for some in slices(len(places), at_once):
        write(places[some], projected.lifted(vectors[some]))
    return out


def _weights(
    points: Points, found: Decomposition, ranks: Int[Tensor, "clusters"]
) -> Float[Tensor, "entries"]:
    """One point after the other, in its own cluster's vectors."""
    used = found.used(ranks)
    own = cluster_sizes(found.labels, len(ranks))
    entries = points.like.new_empty(int((own * ranks).sum()))
    exact = points.with_rows(Mapped(points.rows, Tensor.double, *points.rest))
    centred = SortedPoints(exact, found.labels, len(ranks))
    centred.centre(found.means)
    at = 0
    for chunk in centred:
        blocks = chunk.blocks
        weights = blocks.to_points(blocks.matmul(chunk.slots, found.vectors.mT))
        kept = weights[used[found.labels[chunk.rows].long()]]
        entries[at : at + len(kept)] = kept.to(entries)
        at += len(kept)
    return entries


def _exact_means(
    transfer: TransferTensor, metric: Metric, found: Decomposition, points: Points
) -> Iterator[tuple[slice, Float[Tensor, "clusters values"]]]:
    """Cluster means of the unprojected values, float64, of as many clusters as fit at a time."""
    size = transfer.num_channels * transfer.num_rows * transfer.num_coeffs
    at_once = points.memory.rows_at_once(8 * size) or len(found.sizes)
    for clusters in slices(len(found.sizes), at_once):
        total = found.means.new_zeros(clusters.stop - clusters.start, size)
        for rows, values in weighed_blocks(transfer, metric, points.memory):
            labels = found.labels[rows].long() - clusters.start
            own = torch.nonzero((labels >= 0) & (labels < len(total)))[:, 0]
            total.index_add_(0, labels[own], values[own].double())
        yield clusters, points.processes.sum(total) / found.sizes[clusters, None].clamp_min(1)
