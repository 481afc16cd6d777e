"""The exact subspaces of given clusters: means, principal vectors and singular values, in float64.

Each cluster is decomposed by the eigenvectors of its Gram matrix, or by the singular values of the
points themselves where the Gram matrix would lose digits.

Source:
    Sloan, Hall, Hart, Snyder 2003, section 4.1, "Per-Cluster PCA".
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from prt_torch.representations.grouped import ClusterBlocks, sort_labels

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

    Vectors that a cluster has no use for are zero, with zero weights.

    Attributes:
        labels: Cluster of each point, clusters numbered from the largest to the smallest.
        means: Zero where the subspaces go through the origin.
        vectors: Orthonormal, by falling singular value.
        singular: Singular values of each cluster's points less its mean.
        weights: Each point in its own cluster's vectors.
        spread: Sum of the squares of each cluster's points less its mean.
    """

    labels: Int[Tensor, "points"]
    means: Float[Tensor, "clusters d"]
    vectors: Float[Tensor, "clusters rank d"]
    singular: Float[Tensor, "clusters rank"]
    weights: Float[Tensor, "points rank"]
    spread: Float[Tensor, "clusters"]

    @property
    def sizes(self) -> Int[Tensor, "clusters"]:
        """Points a cluster."""
        return torch.bincount(self.labels, minlength=len(self.means))

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
    data: Float[Tensor, "points d"],
    labels: Int[Tensor, "points"],
    num_clusters: int,
    rank: int,
    affine: bool,
) -> Decomposition:
    """Fit each cluster's subspace of a rank."""
    labels, _ = sort_labels(labels, num_clusters)
    blocks = ClusterBlocks(labels, num_clusters)
    centred = blocks.to_slots(data.double())
    means = centred.new_zeros(num_clusters, data.shape[1])
    if affine:
        means = blocks.sum(centred) / blocks.sizes().clamp_min(1)[:, None]
        centred -= means[blocks.cluster_of_slot]
        centred *= blocks.filled[:, None]
    singular, vectors, spread = [], [], []
    for rows in blocks.by_bucket(centred):
        values, directions = principal(rows, rank, _STIFF[data.dtype])
        singular.append(values)
        vectors.append(directions)
        spread.append(torch.linalg.vector_norm(rows, dim=(1, 2)).square())
    joined = torch.cat(vectors)
    return Decomposition(
        labels=labels,
        means=means,
        vectors=joined,
        singular=torch.cat(singular),
        weights=blocks.to_points(blocks.matmul(centred, joined.mT)),
        spread=torch.cat(spread),
    )


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
            with one_thread():
                _, exact, rights = torch.linalg.svd(rows[stiff], full_matrices=False)
            singular[stiff], directions[stiff] = exact[:, :kept], rights[:, :kept]
        limit = singular[:, :1] * max(size, dimensions) * torch.finfo(rows.dtype).eps
        used = singular > limit
        singular, directions = singular * used, directions * used[..., None]
    padding = rank - kept
    singular = torch.nn.functional.pad(singular * scale[:, 0], (0, padding))
    return singular, torch.nn.functional.pad(directions, (0, 0, 0, padding))
