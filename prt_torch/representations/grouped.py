"""Linear algebra on points grouped by cluster.

Points live sorted by cluster and padded: clusters of similar size share a *bucket*, in which every
cluster takes as many *slots* as the largest of them, so a product of each point with its own
cluster's matrix is one batched matrix product a bucket. Going from slots back to points is one
gather, which drops the padding and undoes the sorting at once.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor, nn

_BUCKET_COST = 1500  # slots of padding that are worth one batched product less
_RUN_ELEMENTS = 2**18
_CUTS = 48  # places considered for the border between two buckets


@dataclass(frozen=True)
class Bucket:
    """A run of clusters, by falling size, that are padded to the same number of slots."""

    first_cluster: int
    num_clusters: int
    size: int
    first_slot: int

    @property
    def clusters(self) -> slice:
        """Its clusters, counted from the largest to the smallest."""
        return slice(self.first_cluster, self.first_cluster + self.num_clusters)

    @property
    def slots(self) -> slice:
        """Its slots."""
        return slice(self.first_slot, self.first_slot + self.num_clusters * self.size)


def sort_labels(
    labels: Int[Tensor, "points"], num_clusters: int
) -> tuple[Int[Tensor, "points"], Int[Tensor, "clusters"]]:
    """Renumber clusters from the largest to the smallest.

    Returns:
        New labels, and the old number of each new cluster.
    """
    sizes = torch.bincount(labels, minlength=num_clusters)
    old = torch.argsort(sizes, descending=True, stable=True)
    new = torch.empty_like(old)
    new[old] = torch.arange(num_clusters, device=labels.device)
    return new[labels], old


class ClusterBlocks(nn.Module):
    """Where each point's slot is, and products of slots with per-cluster matrices.

    Args:
        labels: Cluster of each point. Where clusters are numbered from the largest to the smallest
            (:func:`sort_labels`), no matrix is ever copied.
        num_clusters: How many clusters there are; some may be empty.
        slots_by: Clusters have a multiple of this many slots.

    Raises:
        ValueError: If labels are out of range.
    """

    slot_of_point: Tensor
    point_of_slot: Tensor
    cluster_of_slot: Tensor
    filled: Tensor
    _by_size: Tensor | None

    def __init__(self, labels: Int[Tensor, "points"], num_clusters: int, *, slots_by: int = 1):
        super().__init__()
        sizes = torch.bincount(labels, minlength=num_clusters)
        if len(sizes) != num_clusters:
            raise ValueError(f"expected labels below {num_clusters}, got {len(sizes) - 1}")
        self.num_points, self.num_clusters = len(labels), num_clusters
        by_size: Tensor | None = None
        if bool((sizes.diff() > 0).any()):
            labels, by_size = sort_labels(labels, num_clusters)
            sizes = sizes[by_size]
        self.register_buffer("_by_size", by_size, persistent=False)
        self.buckets = _buckets(sizes.tolist(), slots_by)
        self.num_slots = sum(b.num_clusters * b.size for b in self.buckets)
        first_slot = torch.empty(num_clusters, dtype=torch.int64)
        width = torch.empty(num_clusters, dtype=torch.int64)
        for bucket in self.buckets:
            steps = torch.arange(bucket.num_clusters)
            first_slot[bucket.clusters] = bucket.first_slot + steps * bucket.size
            width[bucket.clusters] = bucket.size
        by_cluster = torch.argsort(labels, stable=True)
        first_point = (sizes.cumsum(0) - sizes)[labels[by_cluster]]
        rank = torch.arange(len(labels), device=labels.device) - first_point
        slots = first_slot.to(labels.device)[labels[by_cluster]] + rank
        slot_of_point = torch.empty_like(labels, dtype=torch.int64)
        slot_of_point[by_cluster] = slots
        point_of_slot = labels.new_zeros(self.num_slots, dtype=torch.int64)
        point_of_slot[slots] = by_cluster
        filled = torch.zeros(self.num_slots, dtype=torch.bool, device=labels.device)
        filled[slots] = True
        own = torch.arange(num_clusters) if by_size is None else by_size.cpu()
        cluster_of_slot = torch.repeat_interleave(own, width)
        self.register_buffer("slot_of_point", slot_of_point, persistent=False)
        self.register_buffer("point_of_slot", point_of_slot, persistent=False)
        self.register_buffer("filled", filled, persistent=False)
        self.register_buffer("cluster_of_slot", cluster_of_slot.to(labels.device), persistent=False)

    def to_slots(self, values: Shaped[Tensor, "points *rest"]) -> Shaped[Tensor, "slots *rest"]:
        """Sort values by cluster; padding is zero."""
        shape = (self.num_slots,) + (1,) * (values.ndim - 1)
        return values.index_select(0, self.point_of_slot) * self.filled.view(shape).to(values)

    def to_points(self, values: Shaped[Tensor, "slots *rest"]) -> Shaped[Tensor, "points *rest"]:
        """Back to the order of the points, without the padding."""
        return values.index_select(0, self.slot_of_point)

    @property
    def padding(self) -> Int[Tensor, "some"]:
        """Slots without a point."""
        return torch.nonzero(~self.filled)[:, 0]

    def by_bucket(self, values: Float[Tensor, "slots *rest a"]) -> list[Tensor]:
        """Views ``"clusters rows a"``, one a bucket; rows are slots times ``rest``."""
        per_slot, width = math.prod(values.shape[1:-1]), values.shape[-1]
        return [
            values[b.slots].reshape(b.num_clusters, b.size * per_slot, width) for b in self.buckets
        ]

    def runs(
        self, *values: Shaped[Tensor, "slots ..."], most: int = _RUN_ELEMENTS
    ) -> Iterator[tuple[slice, list[Tensor]]]:
        """A few clusters at a time, with views ``"some size *rest"`` of their slots.

        What is made of them is small enough to stay in cache. Clusters are counted from the largest
        to the smallest: :meth:`by_size` and :meth:`by_number` say which these are.

        Args:
            values: Of the slots.
            most: Elements of a view, if more than one cluster is in it.
        """
        width = max(1, *(math.prod(one.shape[1:]) for one in values))
        for bucket in self.buckets:
            views = [
                one[bucket.slots].unflatten(0, (bucket.num_clusters, bucket.size)) for one in values
            ]
            count = max(1, most // (bucket.size * width))
            for first in range(0, bucket.num_clusters, count):
                last = min(first + count, bucket.num_clusters)
                some = slice(bucket.first_cluster + first, bucket.first_cluster + last)
                yield some, [view[first:last] for view in views]

    def by_size(self, values: Shaped[Tensor, "clusters *rest"]) -> Tensor:
        """Values of the clusters from the largest to the smallest."""
        return values if self._by_size is None else values[self._by_size]

    def by_number(self, values: Shaped[Tensor, "clusters *rest"]) -> Tensor:
        """The inverse of :meth:`by_size`."""
        if self._by_size is None:
            return values
        return torch.empty_like(values).index_copy_(0, self._by_size, values)

    def matmul(
        self,
        slots: Float[Tensor, "slots *rest a"],
        matrices: Float[Tensor, "clusters a b"],
        offsets: Float[Tensor, "clusters b"] | None = None,
    ) -> Float[Tensor, "slots *rest b"]:
        """Each slot's rows times its own cluster's matrix, plus its cluster's offset."""
        matrices = self.by_size(matrices)
        offsets = None if offsets is None else self.by_size(offsets)
        products = [
            torch.bmm(rows, matrices[bucket.clusters])
            if offsets is None
            else torch.baddbmm(offsets[bucket.clusters, None], rows, matrices[bucket.clusters])
            for bucket, rows in zip(self.buckets, self.by_bucket(slots), strict=True)
        ]
        flat = [product.flatten(0, 1) for product in products]
        joined = torch.cat(flat) if len(flat) > 1 else flat[0]
        return joined.view(*slots.shape[:-1], matrices.shape[-1])

    def transposed_matmul(
        self, left: Float[Tensor, "slots a"], right: Float[Tensor, "slots b"]
    ) -> Float[Tensor, "clusters a b"]:
        """Sum over each cluster's slots of the outer products of its rows."""
        pairs = zip(self.by_bucket(left), self.by_bucket(right), strict=True)
        return self.by_number(torch.cat([torch.bmm(a.mT, b) for a, b in pairs]))

    def sum(self, slots: Float[Tensor, "slots a"]) -> Float[Tensor, "clusters a"]:
        """Sum over each cluster's slots, in float64."""
        sums = [rows.double().sum(1) for _, (rows,) in self.runs(slots)]  # 3x faster than dtype=
        return self.by_number(torch.cat(sums))

    def largest(self, slots: Float[Tensor, "slots a"]) -> Float[Tensor, "clusters a"]:
        """Largest magnitude over each cluster's slots."""
        found = [rows.abs().amax(1) for _, (rows,) in self.runs(slots)]
        return self.by_number(torch.cat(found))

    def sizes(self) -> Int[Tensor, "clusters"]:
        """Points a cluster."""
        return torch.bincount(self.cluster_of_slot[self.slot_of_point], minlength=self.num_clusters)


def _buckets(sizes: list[int], slots_by: int) -> list[Bucket]:
    """Cut clusters, sorted by falling size, into buckets of least padding plus bucket cost."""
    sizes = [max(1, -(-size // slots_by)) * slots_by for size in sizes]
    count = len(sizes)
    steps = [place for place in range(1, count) if sizes[place] < sizes[place - 1]]
    some = min(len(steps), _CUTS)
    cuts = [0, *(steps[place * len(steps) // some] for place in range(some)), count]
    best: list[tuple[int, int]] = [(0, 0)]  # cost of the clusters before a cut, cut before it
    for end in range(1, len(cuts)):
        options = [
            (
                best[start][0] + sizes[cuts[start]] * (cuts[end] - cuts[start]) + _BUCKET_COST,
                start,
            )
            for start in range(end)
        ]
        best.append(min(options))
    borders = [len(cuts) - 1]
    while borders[-1] > 0:
        borders.append(best[borders[-1]][1])
    borders.reverse()
    buckets, slot = [], 0
    for start, end in itertools.pairwise(borders):
        first, clusters = cuts[start], cuts[end] - cuts[start]
        buckets.append(Bucket(first, clusters, sizes[first], slot))
        slot += clusters * buckets[-1].size
    return buckets
