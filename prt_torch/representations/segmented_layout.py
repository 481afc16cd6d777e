"""Where the points, vectors and weights of each segment are, and their mixing.

Representatives lie one segment after the other, weights too; within a segment as
:class:`~prt_torch.representations.segmented_encoding.SegmentEncoding` has them.

There are two ways to mix. :class:`Segment` multiplies sorted, padded blocks (``grouped``), segment
by segment: fast to differentiate, and to form the dense tensor. :class:`LitMixture` evaluates: one
list of vectors for each point over all its segments, summed in one pass. Bunny, 10 rows, one light,
one core: 56 ms as one list, 105 ms as one list a segment, 121 ms in blocks.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from prt_torch.representations.cpca_layout import VectorLayout
from prt_torch.representations.grouped import ClusterBlocks, sort_labels
from prt_torch.representations.segmented_encoding import FIRST, RAW


class Segment(nn.Module):
    """Points of one segment, or of some that are asked for, and the mixing of their vectors.

    Args:
        labels: Of every point of the tensor (see ``SegmentEncoding``).
        ranks: Vectors of each cluster.
    """

    points: Tensor
    raw_points: Tensor
    clusters: Tensor
    ranks: Tensor

    def __init__(self, labels: Int[Tensor, "points"], ranks: Int[Tensor, "clusters"]):
        super().__init__()
        self._table("points", torch.nonzero(labels >= FIRST)[:, 0])
        self._table("raw_points", torch.nonzero(labels == RAW)[:, 0])
        self._table("clusters", labels[self.points].long() - FIRST)
        self._table("ranks", ranks)
        self.num_subspace_vectors = int(ranks.sum())
        self.num_vectors = self.num_subspace_vectors + len(self.raw_points)
        self.num_weights = int(ranks[self.clusters].sum())
        self.layout = VectorLayout(self.clusters, ranks, affine=False) if len(ranks) else None
        self.blocks = ClusterBlocks(self.clusters, len(ranks)) if len(ranks) else None

    def _table(self, name: str, places: Tensor) -> None:
        self.register_buffer(name, places, persistent=False)

    def add(
        self,
        out: Float[Tensor, "some width"],
        vectors: Float[Tensor, "vectors width"],
        weights: Float[Tensor, "entries"],
        points: Int[Tensor, "some"] | None = None,
    ) -> None:
        """Add to each point, or each of some, the weighted sum of its vectors, in place.

        Args:
            out: Of all points, or of those asked for.
            vectors: Of this segment.
            weights: Of this segment.
            points: Those asked for, in any order; all if not given.
        """
        subspaces, raw = vectors.tensor_split([self.num_subspace_vectors])
        if points is None:
            out.index_add_(0, self.raw_points, raw.to(out.dtype))  # autocast may leave it short
            out.index_add_(0, self.points, self._mix(subspaces, weights).to(out.dtype))
            return
        places, own = _find(points, self.raw_points)
        out.index_add_(0, places, raw[own])
        places, own = _find(points, self.points)
        out.index_add_(0, places, self._mix(subspaces, weights, own).to(out.dtype))

    def _mix(
        self, vectors: Tensor, weights: Tensor, own: Int[Tensor, "some"] | None = None
    ) -> Float[Tensor, "some width"]:
        if self.layout is None or self.blocks is None or (own is not None and len(own) == 0):
            return weights[:0, None].expand(-1, vectors.shape[1])
        by_cluster = self.layout.by_cluster(vectors)
        if own is None:
            slots = self.blocks.to_slots(self.layout.by_point(weights))
            return self.blocks.to_points(self.blocks.matmul(slots, by_cluster))
        found, clusters = torch.unique(self.clusters[own], return_inverse=True)
        clusters, order = sort_labels(clusters, len(found))
        blocks = ClusterBlocks(clusters, len(found))
        slots = blocks.to_slots(self.layout.by_point(weights, own))
        return blocks.to_points(blocks.matmul(slots, by_cluster[found[order]]))

    def own_vectors(self) -> tuple[Int[Tensor, "points"], Int[Tensor, "entries"]]:
        """How many vectors each of ``points`` mixes, and which ones, one point after the other."""
        if self.layout is None:
            return self.clusters, self.clusters
        return self.ranks[self.clusters], self.layout.own_vectors.long()


def _find(
    points: Int[Tensor, "some"], ascending: Int[Tensor, "known"]
) -> tuple[Int[Tensor, "found"], Int[Tensor, "found"]]:
    """Which of ``points`` are known, and where."""
    if len(ascending) == 0:
        return ascending, ascending
    at = torch.searchsorted(ascending, points).clamp_max(len(ascending) - 1)
    places = torch.nonzero(ascending[at] == points)[:, 0]
    return places, at[places]


class LitMixture(nn.Module):
    """Representatives and weights at rest, arranged for evaluation without gradients.

    Args:
        segments: All segments.
        num_points: Points of the tensor.
        representatives: Of all segments, ``"vectors channels rows coeffs"``.
        weights: Of all segments.
    """

    own_vectors: Tensor
    borders: Tensor
    mixture: Tensor
    raw_points: Tensor
    raw_vectors: Tensor

    def __init__(
        self,
        segments: list[Segment],
        num_points: int,
        representatives: Float[Tensor, "vectors channels rows coeffs"],
        weights: Float[Tensor, "entries"],
    ):
        super().__init__()
        self.shape = tuple(representatives.shape)
        device = weights.device
        counts = torch.zeros(len(segments), num_points, dtype=torch.int64, device=device)
        vectors, raw_vectors, first = [], [], 0
        for place, segment in enumerate(segments):
            counts[place, segment.points], own = segment.own_vectors()
            vectors.append(own + first)
            first += segment.num_vectors
            raw_vectors.append(torch.arange(first - len(segment.raw_points), first, device=device))
        # From one segment after the other to one point after the other.
        points = torch.arange(num_points, device=device).repeat(len(segments))
        order = torch.argsort(points.repeat_interleave(counts.flatten()), stable=True)
        self._table("own_vectors", torch.cat(vectors)[order].int())
        self._table("mixture", weights.detach()[order])
        self._table("borders", nn.functional.pad(counts.sum(0).cumsum(0), (1, 0)).int())
        self._table("raw_points", torch.cat([segment.raw_points for segment in segments]))
        self._table("raw_vectors", torch.cat(raw_vectors))
        self._sparse(segments, representatives.detach())

    def _table(self, name: str, places: Tensor) -> None:
        self.register_buffer(name, places, persistent=False)

    def _sparse(self, segments: list[Segment], representatives: Tensor) -> None:
        """Nonzeros of every row of coefficients, columns counted over all segments."""
        size = representatives.shape[-1]
        columns, values, counts, first = [], [], [], 0
        for place, segment in enumerate(segments):
            some = representatives[first : first + segment.num_vectors].reshape(-1, size)
            first += segment.num_vectors
            used = some != 0
            columns.append((torch.nonzero(used)[:, 1] + place * size).int())
            values.append(some[used])
            counts.append(used.sum(1))
        self._table("columns", torch.cat(columns))
        self._table("values", torch.cat(values))
        ends = torch.cat(counts).cumsum(0)
        self._table("row_borders", nn.functional.pad(ends, (1, 0)).int())

    def forward(
        self, light: Float[Tensor, "batch coeffs rgb"]
    ) -> Float[Tensor, "points rows rgb batch"]:
        """Light the representatives, then mix them for each point."""
        count, channels, rows, _ = self.shape
        width = 3 * len(light)
        lit = _sums(
            self.get_buffer("columns"),
            light.permute(1, 2, 0).reshape(light.shape[1], width),
            self.get_buffer("row_borders"),
            self.get_buffer("values"),
        )
        if channels == 3:  # each colour of light meets its own channel
            lit = lit.view(count, 3, rows, 3, len(light)).diagonal(dim1=1, dim2=3).movedim(-1, 2)
        vectors = lit.reshape(count, rows * width)
        out = _sums(self.own_vectors, vectors, self.borders, self.mixture)
        out.index_add_(0, self.raw_points, vectors.index_select(0, self.raw_vectors))
        return out.view(len(out), rows, 3, len(light))


def _sums(
    indices: Int[Tensor, "entries"],
    table: Float[Tensor, "lines width"],
    borders: Int[Tensor, "ends"],
    weights: Float[Tensor, "entries"],
) -> Float[Tensor, "bags width"]:
    """Weighted sums of lines of a table, one for each run of indices."""
    if len(indices) == 0:
        return table.new_zeros(len(borders) - 1, table.shape[1])
    return nn.functional.embedding_bag(
        indices, table, borders, mode="sum", per_sample_weights=weights, include_last_offset=True
    )
