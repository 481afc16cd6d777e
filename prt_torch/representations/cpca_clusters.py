"""Clusters of points by distance to their means: the paper's LBG, known as Lloyd's iterations.

Source:
    Sloan, Hall, Hart, Snyder 2003, section 4.1, "VQ Clustering".
"""

import math
from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.representations.points import Points, cluster_sizes, slices, total_of
from prt_torch.representations.processes import ALONE, Processes
from prt_torch.representations.steady import steady_product

_LLOYD_TURNS = 100
_ROUGH_LLOYD_TURNS = 10
_FEW_MOVES = 5e-4  # share of points; below it the iterations end
_BLOCK_ELEMENTS = 2**18  # of one table of distances, so that it stays in cache


def vector_quantise(
    data: Float[Tensor, "points d"] | Points,
    num_clusters: int,
    generator: torch.Generator,
    rough: bool,
) -> tuple[Int[Tensor, "points"], int]:
    """Lloyd's iterations; no more clusters than distinct points, and none of them empty.

    Args:
        data: The points.
        num_clusters: Clusters at most.
        generator: Source of the seeds.
        rough: From cheaper seeds and not to the end, for clusters that are only a start.

    Returns:
        Cluster of each point, and how many clusters there are.
    """
    points = Points.of(data)
    num_clusters = min(num_clusters, count_distinct(points, most=num_clusters))
    means = _spread_seeds(points, num_clusters, generator, rough)
    labels = points.labels(num_clusters)
    errors = points.like.new_empty(points.num_points)
    for _ in range(_ROUGH_LLOYD_TURNS if rough else _LLOYD_TURNS):
        previous = labels
        labels = _nearest(points, means, previous, errors)
        labels = refill(labels, errors, num_clusters, points.processes)
        if count_moves(labels, previous, points.processes) <= _FEW_MOVES * points.total:
            break
        means = cluster_means(points, labels, num_clusters)
    return labels, num_clusters


def count_distinct(data: Float[Tensor, "points d"] | Points, most: int | None = None) -> int:
    """How many different points there are, told apart by hashes of their bits.

    Points that are equal have equal hashes, however many there are and wherever they lie; of two
    that are not, about one pair in 1e19 has.

    Args:
        data: The points.
        most: Where counting may end; all are counted if not given.
    """
    points = Points.of(data)
    size = math.prod(points.rest)
    drawn = torch.Generator().manual_seed(0)
    keys = torch.randint(-(2**63), 2**63 - 1, (2, size), generator=drawn) | 1
    first, second = keys.to(points.like.device)
    seen = first[:0]
    for _, values in points.chunks():
        for some in values.split(max(1, _BLOCK_ELEMENTS // size)):
            bits = (some.double() + 0.0).view(torch.int64)  # -0 and 0 are equal
            mixed = bits * first  # products and sums of int64 wrap around, in any order alike
            hashes = ((mixed ^ (mixed >> 32)) * second).sum(1)
            seen = torch.unique(torch.cat([seen, hashes]))
            if most is not None and len(seen) >= most:
                break
        if most is not None and len(seen) >= most:
            break
    return len(torch.unique(points.processes.gather(seen[:most])))


def count_moves(
    labels: Int[Tensor, "points"], before: Int[Tensor, "points"], processes: Processes = ALONE
) -> int:
    """Points, of all processes, whose label is another than before."""
    return round(total_of(labels != before, processes))


def cluster_means(
    data: Float[Tensor, "points d"] | Points, labels: Int[Tensor, "points"], num_clusters: int
) -> Float[Tensor, "clusters d"]:
    """Mean of each cluster, summed in float64; zero where a cluster is empty."""
    points = Points.of(data)
    total = points.like.new_zeros(num_clusters, *points.rest, dtype=torch.float64)
    for rows, values in points.chunks():
        total.index_add_(0, labels[rows].long(), values.double())
    total = points.processes.sum(total)
    sizes = cluster_sizes(labels, num_clusters, points.processes).clamp_min(1)
    return (total / sizes[:, None]).to(points.like)


def refill(
    labels: Int[Tensor, "points"],
    errors: Float[Tensor, "points"],
    num_clusters: int,
    processes: Processes = ALONE,
) -> Int[Tensor, "points"]:
    """Give each empty cluster one of the worst points, of all processes."""
    while True:
        sizes = cluster_sizes(labels, num_clusters, processes)
        empty = torch.nonzero(sizes == 0)[:, 0]
        if len(empty) == 0:
            return labels
        lengths = processes.lengths(len(labels))
        first = sum(lengths[: processes.rank])
        labels = labels.clone()
        # A cluster of one point must not lose it, or it would be the next empty one.
        worst = _worst(labels, errors, sizes == 1, len(empty), first, processes)
        for cluster, number in zip(empty.tolist(), worst.tolist(), strict=False):
            if first <= number < first + len(labels):
                labels[number - first] = cluster


def _worst(
    labels: Int[Tensor, "points"],
    errors: Float[Tensor, "points"],
    kept: Tensor,
    count: int,
    first: int,
    processes: Processes,
) -> Int[Tensor, "count"]:
    """Numbers over all processes of points of the largest errors, those of kept clusters last."""

    def leading(values: Tensor, numbers: Tensor) -> tuple[Tensor, Tensor]:
        order = torch.argsort(values, descending=True, stable=True)[:count]
        return values[order], numbers[order]

    values, numbers = errors[:0].double(), labels[:0].long()
    for some in slices(len(labels)):
        own = torch.where(kept[labels[some].long()], -torch.inf, errors[some].double())
        at = torch.arange(some.start, some.stop, device=labels.device) + first
        values, numbers = leading(torch.cat([values, own]), torch.cat([numbers, at]))
    return leading(processes.gather(values), processes.gather(numbers))[1]


def _spread_seeds(
    points: Points, num_clusters: int, generator: torch.Generator, rough: bool
) -> Float[Tensor, "clusters d"]:
    """Points drawn one by one with odds of their squared distance to those drawn before.

    This is k-means++, of each several draws the one that leaves least; roughly, one draw each,
    as trials cost more than all else here.

    Source:
        Arthur, Vassilvitskii 2007, "k-means++", and the greedy variant that they mention.
    """
    trials = 1 if rough else 2 + int(math.log(num_clusters))
    draws = torch.rand(num_clusters, trials, generator=generator, dtype=torch.float64)
    number = torch.randint(points.total, (1,), generator=generator)
    distance = points.like.new_full((points.num_points,), torch.inf)
    squares = torch.empty_like(distance)
    for rows, values in points.chunks():
        squares[rows] = values.square().sum(1)
    # Made once: small tensors made between large ones would keep these from being freed.
    totals = squares.new_zeros(len(list(points.slices())), dtype=torch.float64)
    seeds = points.like.new_empty(num_clusters, *points.rest)
    for step in range(num_clusters):
        seed = points.take(number)
        seeds[step] = seed[0]
        if step == num_clusters - 1:
            break
        for place, (rows, to_seed) in enumerate(_distances(points, squares, seed)):
            own = torch.minimum(distance[rows], to_seed[:, 0], out=distance[rows])
            totals[place] = own.sum(dtype=torch.float64)
        number = _drawn(points, distance, totals, draws[step + 1])
        if trials > 1:
            left = torch.zeros(trials, dtype=torch.float64, device=seed.device)
            for rows, to_each in _distances(points, squares, points.take(number)):
                left += torch.minimum(distance[rows, None], to_each).sum(0, dtype=torch.float64)
            best = points.processes.sum(left).argmin()
            number = number[best][None]
    return seeds


def _distances(
    points: Points, squares: Float[Tensor, "points"], seeds: Float[Tensor, "seeds d"]
) -> Iterator[tuple[slice, Float[Tensor, "some seeds"]]]:
    """Squared distances to some points, by chunks."""
    for rows, values in points.chunks():
        dots = torch.stack([steady_product(values, seed) for seed in seeds], dim=1)
        lengths = squares[rows, None] + seeds.square().sum(1)
        yield rows, lengths.sub_(dots, alpha=2.0).clamp_min_(0.0)


def _drawn(
    points: Points,
    distance: Float[Tensor, "points"],
    totals: Float[Tensor, "chunks"],
    draws: Float[Tensor, "trials"],
) -> Int[Tensor, "trials"]:
    """Numbers over all processes of points drawn by distance."""
    processes = points.processes
    before = processes.gather(totals).cumsum(0)
    start = sum(processes.lengths(len(totals))[: processes.rank])
    numbers = torch.zeros(len(draws), dtype=torch.float64, device=distance.device)
    for place, draw in enumerate(draws.tolist()):
        target = draw * before[-1]
        chunk = int(torch.searchsorted(before, target, right=True).clamp_max(len(before) - 1))
        if start <= chunk < start + len(totals):
            rows = list(points.slices())[chunk - start]
            target = target - (before[chunk - 1] if chunk else 0.0)
            odds = distance[rows].cumsum(0, dtype=torch.float64)
            at = torch.searchsorted(odds, target[None], right=True)
            at = at.clamp_max(len(odds) - 1)
            numbers[place] = points.first + rows.start + int(at)
    return processes.sum(numbers).long()


def _nearest(
    points: Points,
    means: Float[Tensor, "clusters d"],
    like: Int[Tensor, "points"],
    errors: Float[Tensor, "points"],
) -> Int[Tensor, "points"]:
    """The nearest mean of each point; writes the squared distances to ``errors``."""
    offsets, turned, labels = means.square().sum(1), -2.0 * means.mT, torch.empty_like(like)
    step = max(1, min(_BLOCK_ELEMENTS, points.table_elements) // len(means))
    for rows, values in points.chunks():
        for some in slices(len(values), step):
            own = values[some]
            table = steady_product(own, turned).add_(offsets)
            distance, label = table.min(dim=1)
            to = slice(rows.start + some.start, rows.start + some.stop)
            labels[to] = label.to(labels.dtype)
            errors[to] = (distance + own.square().sum(1)).clamp_min(0.0)
    return labels
