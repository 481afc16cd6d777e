"""How one light segment's transfer becomes clusters of points with small subspaces.

1. Points that see nothing of the segment are left out before anything else.
2. The rest is weighed by the metric and projected onto the few directions that matter, which only
   clustering works in. How many is measured: they grow until what lies beyond is small against
   the error that a first, cheap clustering makes.
3. Clusters come from iterative CPCA without means (``cpca_clusters``, ``cpca_iteration``).
4. Each cluster's subspace comes from its own unprojected points (``cpca_subspaces``). A cluster
   that would take more room as a subspace than as points keeps its points.

Vectors carry their singular values, so the weights of one vector have a sum of squares of 1 over
the points of its cluster: a change of a vector then costs the same error in every cluster, and one
step for all of them is the best way to quantise.

Source:
    Liu, Sloan, Shum, Snyder 2004, section 5, equation 12. The projection is ours.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.metric import Metric
from prt_torch.representations.cpca_clusters import vector_quantise
from prt_torch.representations.cpca_iteration import Subspaces, iterate
from prt_torch.representations.cpca_subspaces import principal
from prt_torch.representations.grouped import sort_labels
from prt_torch.transfer import TransferTensor

CULLED, RAW, FIRST = 0, 1, 2
"""Labels of a point in a segment: left out, kept as it is, or of cluster ``label - FIRST``."""

_LEAST_DIMENSIONS = 128
_MOST_DIMENSIONS = 512
_BEYOND = 3.5  # energy that the projection may lose, over the first clustering's error within it
_SAMPLES_PER_DIMENSION = 8  # points that the directions are found from
_PROJECTION_STEPS = 2
_FIRST_FIT_STEPS = 3
_FEW_POINTS = (
    256  # of a cluster; above, its subspace is iterated for, which loses 3e-5 of the error
)
_MORE_VECTORS = 16  # than the rank, and
_MORE_STEPS = 4  # steps of that iteration
_STIFF = {torch.float64: 1e3, torch.float32: 1e5}  # as in cpca_subspaces
_WORKING_COPIES = 5  # of one segment's points, beside those that wait


@dataclass(frozen=True)
class SegmentEncoding:
    """Clusters, representatives and weights of one segment.

    Attributes:
        labels: Of every point of the tensor: ``CULLED``, ``RAW``, or cluster plus ``FIRST``,
            clusters numbered from the largest to the smallest.
        ranks: Vectors of each cluster.
        representatives: In the transfer's own coefficients: the vectors of one cluster after the
            other, then the points that are kept as they are, in their order.
        weights: Of one point after the other, each with its cluster's rank; raw points have none.
        squared_norm: Of the segment, in the metric.
        squared_error: Of the encoding, in the metric.
        condition: Largest over smallest singular value, of the worst cluster.
    """

    labels: Int[Tensor, "points"]
    ranks: Int[Tensor, "clusters"]
    representatives: Float[Tensor, "vectors channels rows coeffs"]
    weights: Float[Tensor, "entries"]
    squared_norm: float
    squared_error: float
    condition: float


def segment_metric(metric: Metric, segment: slice, num_coeffs: int) -> Metric:
    """The metric of values that are zero outside a segment, as one over its coefficients alone.

    Exact for each segment. Where a metric ties segments together (a light prior does), the squared
    error of the whole also has the products of two segments' errors, which are not minimised.
    """
    size = segment.stop - segment.start
    if size == num_coeffs or metric.light is None:
        return metric
    alone = torch.zeros(size, 1, num_coeffs, dtype=torch.float64)
    alone[:, 0, segment] = torch.eye(size, dtype=torch.float64)
    one_row = replace(metric, row_factor=torch.ones(1, 1, dtype=torch.float64))
    weighed = one_row.weigh(alone)[:, 0]
    return replace(metric, light=torch.linalg.cholesky(weighed @ weighed.mT))


def nonzero_blocks(
    transfer: TransferTensor, num_segments: int, memory_budget: int
) -> Iterator[tuple[Int[Tensor, "points"], Float[Tensor, "points channels rows coeffs"]]]:
    """Of each segment in turn: the points that are not all zero there, and their values.

    Reads the tensor once for as many segments as fit the budget, at least one.
    """
    size = transfer.num_coeffs // num_segments
    most = transfer.num_points * transfer.num_channels * transfer.num_rows * size
    at_once = max(1, memory_budget // (most * transfer.values.dtype.itemsize) - _WORKING_COPIES)
    for first in range(0, num_segments, at_once):
        count = min(at_once, num_segments - first)
        found: list[list[tuple[Tensor, Tensor]]] = [[] for _ in range(count)]
        for rows, values in transfer.blocks():
            group = values[..., first * size : (first + count) * size].unflatten(-1, (count, size))
            used = (group != 0).any(4).any(2).any(1)
            for place in range(count):
                points = torch.nonzero(used[:, place])[:, 0]
                found[place].append((points + rows.start, group[points, :, :, place]))
        for place in range(count):
            points, values = zip(*found[place], strict=True)
            found[place].clear()
            yield torch.cat(points), torch.cat(values)


def encode_segment(
    points: Int[Tensor, "nonzero"],
    values: Float[Tensor, "nonzero channels rows coeffs"],
    *,
    num_points: int,
    points_per_cluster: int,
    rank: int,
    metric: Metric,
    generator: torch.Generator,
) -> SegmentEncoding:
    """Cluster the points of one segment and fit each cluster's subspace.

    Args:
        points: Which of the tensor's points these are, ascending; none of them is zero.
        values: Their transfer in the segment.
        num_points: Points of the tensor.
        points_per_cluster: Mean size of a cluster; 1 keeps every point as it is.
        rank: Vectors a cluster at most.
        metric: Of the segment (:func:`segment_metric`).
        generator: Source of randomness.

    Source:
        Liu et al. 2004, section 5 "CPCA Encoding" (200 points a cluster, rank 16).
    """
    # Scaled, so that squares of tiny and huge signals stay in range.
    scale = float(values.abs().max()) if len(values) else 1.0
    data = metric.weigh(values / scale).flatten(1)
    num_clusters = max(1, round(len(data) / points_per_cluster))
    if num_clusters < len(data):
        labels = _cluster(data, num_clusters, min(rank, data.shape[1]), generator)
        fits = _subspaces(data, labels, rank)
    else:
        labels, fits = torch.full_like(points, -1), []
    labels, fits = _renumber(labels, fits)
    kept = [fit for fit in fits if fit is not None]
    vectors = [fit.vectors for fit in kept] or [data.new_zeros(0, data.shape[1]).double()]
    shaped = torch.cat(vectors).unflatten(1, tuple(values.shape[1:]))
    everywhere = torch.full((num_points,), CULLED, device=points.device)
    everywhere[points] = torch.where(labels < 0, RAW, labels + FIRST)
    unscaled = (metric.unweigh(shaped) * scale).to(values)
    return SegmentEncoding(
        labels=everywhere,
        ranks=torch.tensor([len(fit.vectors) for fit in kept], dtype=torch.int64),
        representatives=torch.cat([unscaled, values[labels < 0]]),
        weights=_by_point(labels, kept).to(values),
        squared_norm=float(data.square().sum(dtype=torch.float64)) * scale * scale,
        squared_error=sum(fit.squared_error for fit in kept) * scale * scale,
        condition=max((fit.condition for fit in kept), default=1.0),
    )


@dataclass(frozen=True)
class _Fit:
    """A cluster's vectors times their singular values, and its points' weights, float64."""

    vectors: Float[Tensor, "rank values"]
    weights: Float[Tensor, "size rank"]
    squared_error: float
    condition: float


def _cluster(
    data: Float[Tensor, "points values"], num_clusters: int, rank: int, generator: torch.Generator
) -> Int[Tensor, "points"]:
    """Labels of iterative linear CPCA."""
    dimensions = max(_LEAST_DIMENSIONS, 2 * rank)
    while True:
        low = _project(data, dimensions, generator)
        labels, found = vector_quantise(low, num_clusters, generator, rough=True)
        if dimensions >= min(_MOST_DIMENSIONS, data.shape[1]):
            break
        beyond = float((data.square().sum(1) - low.square().sum(1)).double().sum())
        if beyond <= _BEYOND * _first_error(low, labels, found, rank, generator):
            break
        dimensions *= 2
    if found == 1:
        return labels
    return iterate(low, labels, found, rank, False, generator, doubling=True)


def _project(
    data: Float[Tensor, "points values"], dimensions: int, generator: torch.Generator
) -> Float[Tensor, "points dimensions"]:
    """Points in the directions of most energy, found by orthogonal iteration on some of them."""
    if dimensions >= data.shape[1]:
        return data
    some = data[:: max(1, len(data) // (_SAMPLES_PER_DIMENSION * dimensions))]
    directions = torch.randn(data.shape[1], dimensions, generator=generator).to(data)
    for _ in range(_PROJECTION_STEPS):
        directions = torch.linalg.qr(some.mT @ (some @ directions))[0]
    return data @ directions


def _first_error(
    low: Tensor, labels: Tensor, num_clusters: int, rank: int, generator: torch.Generator
) -> float:
    """Squared error of the first clusters' own subspaces."""
    labels, _ = sort_labels(labels, num_clusters)
    start = torch.randn(num_clusters, low.shape[1], rank, generator=generator).to(low)
    fit = Subspaces(low, labels, start, affine=False, steps=_FIRST_FIT_STEPS)
    return float(fit.spread().double().sum() - fit.squares().sum())


def _subspaces(
    data: Float[Tensor, "points values"], labels: Int[Tensor, "points"], rank: int
) -> list[_Fit | None]:
    """Each cluster's subspace; None where its points take less room.

    Source:
        Liu et al. 2004, equation 12: a subspace saves room where r > 1.
    """
    sizes = torch.bincount(labels)
    members = torch.argsort(labels, stable=True).split(sizes.tolist())
    return [_subspace(data[some].double(), rank, _STIFF[data.dtype]) for some in members]


def _subspace(points: Float[Tensor, "size values"], rank: int, stiff_ratio: float) -> _Fit | None:
    size, num_values = points.shape
    few = rank + _MORE_VECTORS
    if size > _FEW_POINTS and num_values > 2 * few:
        directions = _leading(points, few)
        singular, turn = (one[0] for one in principal((points @ directions)[None], rank))
        vectors = turn @ directions.mT
    else:
        singular, vectors = (one[0] for one in principal(points[None], rank, stiff_ratio))
    singular, vectors = singular[singular > 0], vectors[singular > 0]
    none = len(singular) == 0  # values that vanish beside the largest of the segment
    if none or size * num_values < len(singular) * (size + num_values):
        return None
    weights = points @ vectors.mT
    lost = points - weights @ vectors
    return _Fit(
        vectors=vectors * singular[:, None],
        weights=weights / singular,
        squared_error=float(lost.square().sum()),
        condition=float(singular[0] / singular[-1]),
    )


def _leading(points: Float[Tensor, "size values"], count: int) -> Float[Tensor, "values count"]:
    """Orthonormal directions of most energy, by orthogonal iteration from some of the points."""
    directions = points[:: len(points) // count][:count].mT
    for _ in range(_MORE_STEPS):
        directions = torch.linalg.qr(points.mT @ (points @ directions))[0]
    return directions


def _renumber(
    labels: Int[Tensor, "points"], fits: list[_Fit | None]
) -> tuple[Int[Tensor, "points"], list[_Fit | None]]:
    """Clusters that have a subspace from the largest to the smallest; -1 for points kept raw."""
    sizes = [0 if fit is None else len(fit.weights) for fit in fits]
    order = sorted(range(len(fits)), key=lambda cluster: -sizes[cluster])
    order = [cluster for cluster in order if sizes[cluster]]
    new = torch.full((len(fits) + 1,), -1, device=labels.device)
    new[torch.tensor(order, dtype=torch.int64)] = torch.arange(len(order), device=labels.device)
    return new[labels], [fits[cluster] for cluster in order]


def _by_point(labels: Int[Tensor, "points"], fits: list[_Fit]) -> Float[Tensor, "entries"]:
    """Weights of one point after the other."""
    counts = torch.zeros(len(labels), dtype=torch.int64, device=labels.device)
    for cluster, fit in enumerate(fits):
        counts[labels == cluster] = fit.weights.shape[1]
    first = counts.cumsum(0) - counts
    entries = torch.zeros(int(counts.sum()), dtype=torch.float64, device=labels.device)
    for cluster, fit in enumerate(fits):
        places = first[labels == cluster, None] + torch.arange(fit.weights.shape[1])
        entries[places.flatten()] = fit.weights.flatten()
    return entries
