"""Clusters of points by distance to their means: the paper's LBG, known as Lloyd's iterations.

Source:
    Sloan, Hall, Hart, Snyder 2003, section 4.1, "VQ Clustering".
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from sklearn.cluster import kmeans_plusplus
from torch import Tensor

_LLOYD_TURNS = 100
_ROUGH_LLOYD_TURNS = 10
_FEW_MOVES = 5e-4  # share of points; below it the iterations end
_BLOCK_ELEMENTS = 2**22  # of one table of distances


def vector_quantise(
    data: Float[Tensor, "points d"], num_clusters: int, generator: torch.Generator, rough: bool
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
    num_clusters = min(num_clusters, count_distinct(data))
    if rough:
        means = data[_spread_seeds(data, num_clusters, generator)]
    else:
        host = data.cpu().numpy()
        seed = int(torch.randint(2**31 - 1, (1,), generator=generator))
        scale = float(np.abs(host).max()) or 1.0  # squared distances of tiny signals underflow
        centres, _ = kmeans_plusplus(host / scale, num_clusters, random_state=seed)
        means = torch.from_numpy(centres * scale).to(data)
    labels = torch.full((len(data),), -1, dtype=torch.int64, device=data.device)
    for _ in range(_ROUGH_LLOYD_TURNS if rough else _LLOYD_TURNS):
        previous = labels
        labels, distances = _nearest(data, means)
        labels = refill(labels, distances, num_clusters)
        if int((labels != previous).sum()) <= _FEW_MOVES * len(labels):
            break
        means = cluster_means(data, labels, num_clusters)
    return labels, num_clusters


def count_distinct(data: Float[Tensor, "points d"]) -> int:
    """How many different points there are; told apart by one random combination of their values."""
    mixture = torch.from_numpy(np.random.default_rng(0).standard_normal(data.shape[1]))
    return len(torch.unique(data.double() @ mixture.to(data.device)))


def cluster_means(
    data: Float[Tensor, "points d"], labels: Int[Tensor, "points"], num_clusters: int
) -> Float[Tensor, "clusters d"]:
    """Mean of each cluster, summed in float64; zero where a cluster is empty."""
    total = torch.zeros(num_clusters, data.shape[1], dtype=torch.float64, device=data.device)
    total.index_add_(0, labels, data.double())
    count = torch.bincount(labels, minlength=num_clusters).clamp_min(1)
    return (total / count[:, None]).to(data)


def refill(
    labels: Int[Tensor, "points"], errors: Float[Tensor, "points"], num_clusters: int
) -> Int[Tensor, "points"]:
    """Give each empty cluster one of the worst points."""
    while True:
        empty = torch.nonzero(torch.bincount(labels, minlength=num_clusters) == 0)[:, 0]
        if len(empty) == 0:
            return labels
        # A cluster of one point must not lose it, or it would be the next empty one.
        alone = torch.bincount(labels, minlength=num_clusters)[labels] == 1
        worst = torch.where(alone, -torch.inf, errors).topk(len(empty)).indices
        labels = labels.clone()
        labels[worst] = empty


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


def _nearest(data: Tensor, means: Tensor) -> tuple[Int[Tensor, "points"], Float[Tensor, "points"]]:
    """The nearest mean of each point, and the squared distance to it."""
    offsets = means.square().sum(1)
    labels, distances = [], []
    for some in data.split(max(1, _BLOCK_ELEMENTS // len(means))):
        distance, label = torch.addmm(offsets, some, means.mT, alpha=-2.0).min(dim=1)
        labels.append(label)
        distances.append((distance + some.square().sum(1)).clamp_min(0.0))
    return torch.cat(labels), torch.cat(distances)
