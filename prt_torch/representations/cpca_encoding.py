"""How CPCA finds its clusters and subspaces.

1. Transfer is weighed by the metric, so that errors are plain sums of squares. Where a point has
   more values than ``_MAX_DIMENSIONS``, one near-lossless projection (randomised, by blocks of
   points) makes every later step cheap.
2. Lloyd's iterations give the first clusters (``cpca_clusters``): from k-means++ seeds and to their
   end where they are the clusters (static), from cheaper seeds and only roughly where they are a
   start (iterative), which ends as low in half the time.
3. Iterative: points move by the error of the clusters' own subspaces (``cpca_iteration``).
4. Adaptive: from there, clusters take unequal ranks (``cpca_adaptive``).
5. The last subspaces come from a full decomposition of each cluster in float64
   (``cpca_subspaces``).

Source:
    Sloan, Hall, Hart, Snyder 2003, section 4.
"""

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
from prt_torch.representations.cpca_subspaces import Decomposition, decompose
from prt_torch.transfer import TransferTensor

Method = Literal["iterative", "static", "adaptive"]

_MAX_DIMENSIONS = 256  # of the projection; 3 further ranks than it loses less than 1e-3 of energy


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
) -> Encoding:
    """Cluster the points of a transfer tensor and fit each cluster's subspace."""
    size = transfer.num_channels * transfer.num_rows * transfer.num_coeffs
    rank = min(rank, size)
    data, lift = project(transfer, metric, rank, generator)
    data_mean = data.mean(0, dtype=torch.float64).to(data) * affine
    data = data - data_mean
    rough = method != "static" and rank > 0
    labels, num_clusters = vector_quantise(data, num_clusters, generator, rough)
    if rough and num_clusters > 1:
        labels = iterate(data, labels, num_clusters, rank, affine, generator)
    if method == "adaptive":
        found, ranks = adapt(data, labels, num_clusters, rank, affine, size)
    else:
        found = decompose(data, labels, num_clusters, rank, affine)
        ranks = torch.full_like(found.sizes, rank)
    vectors = found.vectors[found.used(ranks)]
    means = found.means + data_mean.to(found.means)
    if lift is not None:
        vectors = vectors @ lift.mT.to(vectors)
        if affine:
            means = _exact_means(transfer, metric, found.labels, num_clusters)
    return _pack(transfer, metric, found, ranks, means if affine else None, vectors)


def _pack(
    transfer: TransferTensor,
    metric: Metric,
    found: Decomposition,
    ranks: Int[Tensor, "clusters"],
    means: Float[Tensor, "clusters values"] | None,
    vectors: Float[Tensor, "vectors values"],
) -> Encoding:
    """Means before their clusters' vectors, out of the metric, in the transfer's precision."""
    together = vectors
    if means is not None:
        together = vectors.new_empty(len(means) + len(vectors), vectors.shape[1])
        is_mean = torch.zeros(len(together), dtype=torch.bool, device=vectors.device)
        is_mean[(ranks + 1).cumsum(0) - ranks - 1] = True
        together[is_mean], together[~is_mean] = means, vectors
    shaped = together.unflatten(-1, tuple(transfer.values.shape[1:]))
    dtype = transfer.values.dtype
    return Encoding(
        labels=found.labels,
        ranks=ranks,
        representatives=metric.unweigh(shaped).flatten(1).to(dtype),
        weights=found.weights[found.used(ranks)[found.labels]].to(dtype),
        affine=means is not None,
        condition=found.condition(ranks),
    )


def weighed_blocks(
    transfer: TransferTensor, metric: Metric
) -> Iterator[tuple[slice, Float[Tensor, "points values"]]]:
    """Blocks of points where errors are sums of squares."""
    for rows, values in transfer.blocks():
        yield rows, metric.weigh(values).flatten(1)


def project(
    transfer: TransferTensor, metric: Metric, rank: int, generator: torch.Generator
) -> tuple[Float[Tensor, "points d"], Float[Tensor, "values d"] | None]:
    """Points in the space that clustering works in; the orthonormal way back if they were cut."""
    size = transfer.num_channels * transfer.num_rows * transfer.num_coeffs
    dimensions = max(_MAX_DIMENSIONS, 3 * rank)
    if size <= dimensions:
        data = torch.cat([values for _, values in weighed_blocks(transfer, metric)])
        return data, None
    lift = torch.randn(size, dimensions, generator=generator).to(transfer.values[0:1])
    for _ in range(3):  # orthogonal iteration on the second moment, by blocks of points
        image = torch.zeros_like(lift, dtype=torch.float64)
        for _, values in weighed_blocks(transfer, metric):
            image += values.mT @ (values @ lift)
        lift = torch.linalg.qr(image)[0].to(lift)
    data = torch.cat([values @ lift for _, values in weighed_blocks(transfer, metric)])
    return data, lift


def _exact_means(
    transfer: TransferTensor, metric: Metric, labels: Tensor, num_clusters: int
) -> Float[Tensor, "clusters values"]:
    """Cluster means of the unprojected values, float64."""
    size = transfer.num_channels * transfer.num_rows * transfer.num_coeffs
    total = torch.zeros(num_clusters, size, dtype=torch.float64, device=labels.device)
    for rows, values in weighed_blocks(transfer, metric):
        total.index_add_(0, labels[rows], values.double())
    count = torch.bincount(labels, minlength=num_clusters).clamp_min(1)
    return total / count[:, None]
