"""Points that algorithms pass over: at once or in chunks from a file, here or on several processes.

An algorithm reads chunk after chunk, keeps what belongs to a point in plain tensors, and adds up
what belongs to a cluster in float64. With enough memory there is one chunk, and this is plain code
on one tensor. What a point gets does not depend on the chunk it is in, so a budget of memory and a
number of processes change sums by rounding of float64 only.
"""

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from prt_torch.representations.exact_sums import ExactClusterProducts
from prt_torch.representations.grouped import ClusterBlocks
from prt_torch.representations.processes import ALONE, Processes
from prt_torch.representations.scratch import Memory, ScratchRows
from prt_torch.representations.steady import STEADY_ROWS, filled_up
from prt_torch.transfer import Rows

SLICE = 2**16
"""Points whose numbers are looked at together where their values are not read."""

_FEW_COLUMNS = 8


class Points:
    """Values of the points of this process, read in chunks.

    Args:
        rows: ``"points *rest"``, a tensor or a file.
        memory: What may be taken.
        processes: Those that have points too.
    """

    def __init__(self, rows: Rows, memory: Memory | None = None, processes: Processes = ALONE):
        self.rows, self.memory, self.processes = rows, memory or Memory(), processes
        self.num_points, self.rest = rows.shape[0], tuple(rows.shape[1:])
        lengths = processes.lengths(self.num_points)
        self.total, self.first = sum(lengths), sum(lengths[: processes.rank])
        self.like = rows[0:0].flatten()
        row_bytes = math.prod(self.rest) * self.like.element_size()
        self._at_once = self.memory.rows_at_once(row_bytes) or max(1, self.num_points)

    @classmethod
    def of(cls, data: "Tensor | Points") -> "Points":
        """Points in memory, of this process alone, unless they are points already."""
        return data if isinstance(data, Points) else cls(data)

    @property
    def in_one_chunk(self) -> bool:
        """Whether all are read together."""
        return self.num_points <= self._at_once

    @property
    def table_elements(self) -> int:
        """Numbers that one table of products may have."""
        nbytes = self.memory.chunk_bytes
        return 2**62 if nbytes is None else max(1, nbytes // self.like.element_size())

    def slices(self) -> Iterator[slice]:
        """Ranges of points that are read together."""
        return slices(self.num_points, self._at_once)

    def chunks(self) -> Iterator[tuple[slice, Float[Tensor, "some *rest"]]]:
        """Ranges of points with their values."""
        for rows in self.slices():
            yield rows, self.rows[rows]

    def dense(self) -> Float[Tensor, "points *rest"]:
        """All of this process's values."""
        return self.rows[0 : self.num_points]

    def largest(self) -> Float[Tensor, "*rest"]:
        """Largest magnitude of each value over the points of all processes."""
        found = self.like.new_zeros(self.rest)
        for _, values in self.chunks():
            found = torch.maximum(found, values.abs().amax(0))
        return self.processes.largest(found)

    def squared_norm(self) -> float:
        """Of all points of all processes."""
        total = self.like.new_zeros((), dtype=torch.float64)
        for _, values in self.chunks():
            total += torch.linalg.vector_norm(values, dtype=torch.float64).square()
        return float(self.processes.sum(total))

    def take(self, numbers: Int[Tensor, "some"]) -> Float[Tensor, "some *rest"]:
        """Values of points by number over all processes; every process must ask for the same."""
        found = self.like.new_zeros(len(numbers), *self.rest, dtype=torch.float64)
        for place, number in enumerate((numbers - self.first).tolist()):
            if 0 <= number < self.num_points:
                found[place] = self.rows[number : number + 1][0]
        return self.processes.sum(found).to(self.like)

    def empty(self, *rest: int) -> "Tensor | ScratchRows":
        """Room for other values of the same points."""
        return self.memory.empty((self.num_points, *rest), self.like)

    def stored(self, function: Callable[[Tensor], Tensor], *rest: int) -> "Points":
        """What a function makes of each chunk's values."""
        room = self.empty(*rest)
        for rows, values in self.chunks():
            room[rows] = function(values)
        return self.with_rows(room)

    def write(self, rows: slice, values: Float[Tensor, "some *rest"]) -> None:
        """Replace some values, which must not be :class:`Mapped`."""
        if not isinstance(self.rows, Tensor | ScratchRows):
            raise ValueError(f"expected points that can be written, got {type(self.rows).__name__}")
        self.rows[rows] = values

    def with_rows(self, rows: Rows) -> "Points":
        """Other values of the same points."""
        return Points(rows, self.memory, self.processes)

    def labels(self, num_clusters: int) -> Int[Tensor, "points"]:
        """Room for a cluster of each point, all -1; in few bytes where there is a budget."""
        dtype = torch.int64 if self.memory.budget is None else label_type(num_clusters)
        return torch.full((self.num_points,), -1, dtype=dtype, device=self.like.device)


class Mapped:
    """Rows that follow from others, made where they are read."""

    def __init__(
        self,
        rows: Rows,
        function: Callable[[Tensor], Tensor],
        *rest: int,
    ):
        self._rows, self._function = rows, function
        self.shape, self.dtype = (rows.shape[0], *rest), rows.dtype

    def __getitem__(self, rows: slice, /) -> Tensor:
        return self._function(self._rows[rows])


@dataclass(frozen=True)
class SortedChunk:
    """A chunk of points sorted by cluster.

    Attributes:
        rows: Which points these are.
        blocks: Where each of them is.
        slots: Their values, less their cluster's mean where one was given.
    """

    rows: slice | Int[Tensor, "some"]
    blocks: ClusterBlocks
    slots: Float[Tensor, "slots *rest"]

    @functools.cached_property
    def largest(self) -> Float[Tensor, "clusters *rest"]:
        """Largest magnitude of each value in each cluster."""
        return self.blocks.largest(self.slots)

    def matmul(
        self, values: Float[Tensor, "slots *rows a"], matrices: Float[Tensor, "clusters a b"]
    ) -> Float[Tensor, "slots *rows b"]:
        """Each slot's rows times its own cluster's matrix, steady (:func:`steady_product`).

        A few columns are multiplied transposed, which is up to five times faster.
        """
        filled, columns = filled_up(matrices), matrices.shape[-1]
        if filled.shape[-1] > _FEW_COLUMNS:
            return self.blocks.matmul(values, filled)[..., :columns]
        turned = self.blocks.by_size(filled).mT
        pairs = zip(self.blocks.buckets, self.blocks.by_bucket(values), strict=True)
        products = [
            torch.bmm(turned[own.clusters], rows.mT).mT.flatten(0, 1) for own, rows in pairs
        ]
        joined = torch.cat(products) if len(products) > 1 else products[0]
        return joined.view(*values.shape[:-1], -1)[..., :columns]


class SortedPoints:
    """Chunks of points sorted by cluster, for products with the clusters' matrices.

    Sorted once where there is one chunk, else again in every pass.

    Args:
        points: The points.
        labels: Their clusters, in any order; -1 for points that are left out.
        num_clusters: How many clusters there are.
    """

    def __init__(self, points: Points, labels: Int[Tensor, "points"], num_clusters: int):
        self.points, self.num_clusters = points, num_clusters
        self._labels, self._means = labels, None
        self._kept: SortedChunk | None = None

    def centre(self, means: Float[Tensor, "clusters *rest"]) -> None:
        """From now on, values are those less their cluster's mean; once."""
        self._means = means
        if self._kept is not None:
            _subtract(self._kept, means)
            self._kept = replace(self._kept)  # which knows nothing of the slots as they were

    def __iter__(self) -> Iterator[SortedChunk]:
        if self._kept is not None:
            yield self._kept
            return
        for rows in self.points.slices():
            chunk = self._sorted(rows)
            if self.points.in_one_chunk:
                self._kept = chunk
            yield chunk

    def _sorted(self, rows: slice) -> SortedChunk:
        labels, values = self._labels[rows].long(), self.points.rows[rows]
        place: slice | Tensor = rows
        if bool((labels < 0).any()):
            taken = torch.nonzero(labels >= 0)[:, 0]
            labels, values, place = labels[taken], values[taken], rows.start + taken
        blocks = ClusterBlocks(labels, self.num_clusters, slots_by=STEADY_ROWS)
        chunk = SortedChunk(place, blocks, values.index_select(0, blocks.point_of_slot))
        if self._means is not None:
            _subtract(chunk, self._means)
        else:
            chunk.slots.index_fill_(0, blocks.padding, 0.0)
        return chunk

    def sum(self, of_chunk: Callable[[SortedChunk], Tensor], *shape: int) -> Tensor:
        """Sum over all chunks of all processes, float64, of results of this shape."""
        total = self.points.like.new_zeros(shape, dtype=torch.float64)
        for chunk in self:
            total += of_chunk(chunk)
        return self.points.processes.sum(total)

    def products(
        self, of_chunk: Callable[[SortedChunk], tuple[Tensor, Tensor]], left: int, right: int
    ) -> Float[Tensor, "clusters left right"]:
        """Sum over each cluster's points of the outer products of two results, float64.

        The same to the bit whatever the chunks and processes, for the reasons given in
        ``exact_sums``: results of float32 are rounded to 20 bits of the largest of their cluster
        and column. Of float64, sums differ by rounding, which is next to nothing.

        Args:
            of_chunk: What makes ``"slots left"`` and ``"slots right"``.
            left: Columns of the first.
            right: Columns of the second.
        """
        once = [(c, *of_chunk(c)) for c in self] if self.points.in_one_chunk else None

        def results() -> Iterator[tuple[SortedChunk, Tensor, Tensor]]:
            yield from once or ((c, *of_chunk(c)) for c in self)

        if self.points.like.dtype == torch.float64:
            total = self.points.like.new_zeros(self.num_clusters, left, right)
            for chunk, first, second in results():
                total += chunk.blocks.transposed_matmul(first, second)
            return self.points.processes.sum(total)
        shape, like = (self.num_clusters, left, right), self.points.like
        sums = ExactClusterProducts(shape, like, self.points.total, self.points.processes)
        for chunk, first, second in results():
            own = chunk.largest if first is chunk.slots else chunk.blocks.largest(first)
            sums.look(own, chunk.blocks.largest(second))
        sums.looked()
        for chunk, first, second in results():
            sums.add(chunk.blocks, first, second)
        return sums.value()


def _subtract(chunk: SortedChunk, means: Float[Tensor, "clusters *rest"]) -> None:
    """Take their cluster's mean off all points, in place."""
    means = chunk.blocks.by_size(means)[:, None]
    for clusters, (own,) in chunk.blocks.runs(chunk.slots):
        own -= means[clusters]
    chunk.slots.index_fill_(0, chunk.blocks.padding, 0.0)


def label_type(num_clusters: int) -> torch.dtype:
    """The smallest type that holds every cluster's number, and -1."""
    match num_clusters:
        case few if few < 2**7:
            return torch.int8
        case some if some < 2**15:
            return torch.int16
        case _:
            return torch.int32


def slices(count: int, step: int = SLICE) -> Iterator[slice]:
    """Ranges of at most ``step``, one after the other."""
    for start in range(0, count, step):
        yield slice(start, min(start + step, count))


def cluster_sizes(
    labels: Int[Tensor, "points"], num_clusters: int, processes: Processes = ALONE
) -> Int[Tensor, "clusters"]:
    """Points of each cluster, of all processes; -1 belongs to none."""
    total = torch.zeros(num_clusters + 1, dtype=torch.float64, device=labels.device)
    for some in slices(len(labels)):
        total += torch.bincount(labels[some].long() + 1, minlength=num_clusters + 1)
    return processes.sum(total)[1:].long()


def cluster_sums(
    labels: Int[Tensor, "points"],
    values: Float[Tensor, "points"],
    num_clusters: int,
    processes: Processes = ALONE,
) -> Float[Tensor, "clusters"]:
    """Sum of a number of each point over its cluster, float64."""
    total = torch.zeros(num_clusters, dtype=torch.float64, device=labels.device)
    for some in slices(len(labels)):
        total.index_add_(0, labels[some].long(), values[some].double())
    return processes.sum(total)


def total_of(values: Shaped[Tensor, "points"], processes: Processes = ALONE) -> float:
    """Sum of a number of each point, in float64."""
    local = values.sum(dtype=torch.float64)
    return float(processes.sum(local))


def renumber(
    labels: Int[Tensor, "points"], num_clusters: int, processes: Processes = ALONE
) -> tuple[Int[Tensor, "points"], Int[Tensor, "clusters"]]:
    """Clusters from the largest to the smallest, over all processes.

    Returns:
        New labels, in the type of the old, and the old number of each new cluster.
    """
    sizes = cluster_sizes(labels, num_clusters, processes)
    old = torch.argsort(sizes, descending=True, stable=True)
    new = torch.empty_like(old)
    new[old] = torch.arange(num_clusters, device=labels.device)
    renumbered = torch.empty_like(labels)
    for some in slices(len(labels)):
        renumbered[some] = new[labels[some].long()].to(labels.dtype)
    return renumbered, old
