"""Where CPCA keeps the vectors of a cluster and the weights of a point.

Both lie flat, one cluster after the other and one point after the other, so clusters of different
rank waste nothing. Where all ranks are the same, tables by cluster and by point are views of
them; where ranks differ, such a table is padded with zeros to the largest rank.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn


class VectorLayout(nn.Module):
    """Places of vectors and weights.

    Args:
        labels: Cluster of each point.
        ranks: Vectors of each cluster beside its mean.
        affine: Whether each cluster has a mean, which stands before its vectors.
    """

    own_vectors: Tensor
    own_borders: Tensor
    first_weight: Tensor

    def __init__(self, labels: Int[Tensor, "points"], ranks: Int[Tensor, "clusters"], affine: bool):
        super().__init__()
        self.affine, self.num_clusters, self.max_rank = affine, len(ranks), int(ranks.max())
        self.uniform = int(ranks.min()) == self.max_rank
        self.num_vectors = int(ranks.sum()) + affine * len(ranks)
        self.num_weights = int(ranks[labels].sum())
        first_vector = _starts(ranks + affine)
        own = (ranks + affine)[labels]
        self._table("own_vectors", _runs(first_vector[labels], own).int())
        self._table("own_borders", nn.functional.pad(own.cumsum(0), (1, 0)).int())
        first_weight = _starts(ranks[labels])
        self._table("first_weight", first_weight)
        if not self.uniform:
            self._pad_tables(labels, ranks, first_vector, first_weight)

    def _pad_tables(
        self, labels: Tensor, ranks: Tensor, first_vector: Tensor, first_weight: Tensor
    ) -> None:
        """Places of the padded tables in the flat ones; one past the end means zero."""
        steps = torch.arange(self.max_rank, device=labels.device)
        used = steps < ranks[:, None]
        vectors = torch.where(used, first_vector[:, None] + self.affine + steps, self.num_vectors)
        if self.affine:
            vectors = torch.cat([first_vector[:, None], vectors], dim=1)
        self._table("padded_vectors", vectors)
        weights = torch.where(used[labels], first_weight[:, None] + steps, self.num_weights)
        self._table("padded_weights", weights)
        if self.affine:
            own_ranks = ranks[labels]
            mixed = _runs(first_weight - 1, own_ranks + 1)  # the place before the first: the mean
            mixed[_starts(own_ranks + 1)] = self.num_weights
            self._table("mixture_weights", mixed)

    def _table(self, name: str, places: Tensor) -> None:
        self.register_buffer(name, places, persistent=False)

    def by_cluster(
        self, vectors: Float[Tensor, "vectors *rest"]
    ) -> Float[Tensor, "clusters most *rest"]:
        """The mean, if affine, and the vectors of each cluster; zeros where it has no more."""
        if self.uniform:
            return vectors.unflatten(0, (self.num_clusters, self.max_rank + self.affine))
        places = self.get_buffer("padded_vectors")
        padded = torch.cat([vectors, vectors.new_zeros(1, *vectors.shape[1:])])
        return padded.index_select(0, places.flatten()).unflatten(0, places.shape)

    def by_point(
        self, weights: Float[Tensor, "entries"], points: Tensor | None = None
    ) -> Float[Tensor, "points rank"]:
        """The weights of each point, or of some; zeros where it has no more."""
        if self.uniform:
            table = weights.view(len(self.first_weight), self.max_rank)
            return table if points is None else table[points]
        places = self.get_buffer("padded_weights")
        places = places if points is None else places[points]
        padded = torch.cat([weights, weights.new_zeros(1)])
        return padded.index_select(0, places.flatten()).view(places.shape)

    def mixture(self, weights: Float[Tensor, "entries"]) -> Float[Tensor, "places"]:
        """What each of ``own_vectors`` counts for its point: 1 for means, its weight for others."""
        if not self.affine:
            return weights
        if self.uniform:
            return nn.functional.pad(self.by_point(weights), (1, 0), value=1.0).flatten()
        ones = torch.cat([weights, weights.new_ones(1)])
        return ones.index_select(0, self.get_buffer("mixture_weights"))


def entry_vectors(
    labels: Int[Tensor, "points"], ranks: Int[Tensor, "clusters"], affine: bool
) -> Int[Tensor, "entries"]:
    """The vector that each weight belongs to."""
    first = _starts(ranks + int(affine)) + int(affine)
    return _runs(first[labels], ranks[labels])


def _starts(counts: Int[Tensor, "runs"]) -> Int[Tensor, "runs"]:
    """Where each run starts when they lie one after the other."""
    return counts.cumsum(0) - counts


def _runs(first: Int[Tensor, "runs"], counts: Int[Tensor, "runs"]) -> Int[Tensor, "total"]:
    """``first, first + 1, ...``, ``count`` numbers of each run, one run after the other."""
    offsets = torch.repeat_interleave(first - _starts(counts), counts)
    return offsets + torch.arange(len(offsets), device=counts.device)
