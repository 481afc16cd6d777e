r"""Clustered principal component analysis: a small subspace for each cluster of points.

A point's transfer, seen as one vector, is its cluster's mean plus a few weighted vectors,

.. math:: x_p \approx x_0 + \sum_i w_p^i\, x_i

The mean and the vectors are the cluster's *representatives*. Light meets the representatives once
a cluster; a point then costs ``rank + 1`` weighted sums of the results, whatever the order of the
light. Clusters may have different ranks; *linear* ones have no mean. Vector quantisation is
rank 0, and principal component analysis is one cluster.

Source:
    Sloan, Hall, Hart, Snyder 2003, sections 3.3, 4 and 6.
"""

from dataclasses import replace
from typing import Any, ClassVar, get_args

import torch
import torch.distributed as distributed
from jaxtyping import Float
from torch import Tensor, nn

from prt_torch.metric import Metric
from prt_torch.representations.base import CodedRepresentation
from prt_torch.representations.cpca_coding import Coding, coded, pack, unpack
from prt_torch.representations.cpca_encoding import Encoding, Method, encode
from prt_torch.representations.cpca_layout import VectorLayout
from prt_torch.representations.cpca_search import Shape, random_encoding, search
from prt_torch.representations.cpca_shading import (
    lit,
    local_radiance,
    mix_gathered,
    mix_grouped,
)
from prt_torch.representations.grouped import ClusterBlocks
from prt_torch.representations.processes import Processes
from prt_torch.transfer import Surface, TransferTensor

_TABLE_BYTES = 64  # a point, of tables for evaluation, and four a weight


class CPCA(CodedRepresentation):
    """Clustered subspaces of transfer.

    Parameters are ``representatives`` ``"vectors channels rows coeffs"``, one cluster after the
    other, its mean first if ``affine``; and ``weights`` ``"entries"``, one point after the other,
    each with its cluster's rank. The vectors come orthonormal (in the metric) from the closed form
    and are free afterwards: any invertible mixture of them with the inverse mixture of the weights
    is the same transfer, so a constraint would only slow a fit.

    Args:
        encoding: Clusters, representatives and weights.
        surface: Bases, frames and reflectance.
        shape: Points, channels, rows, coeffs.
        coding: Steps of codes; None where parameters are kept as they are.

    Attributes:
        labels: ``"points"``: cluster of each, clusters numbered from the largest to the smallest.
        ranks: ``"clusters"``: vectors of each beside its mean.
        affine: Whether clusters have means.
    """

    kind: ClassVar[str] = "cpca"
    places: ClassVar[tuple[str, ...]] = ("labels", "ranks")
    labels: Tensor
    ranks: Tensor
    _step: Tensor | None
    _levels: Tensor | None

    def __init__(
        self,
        encoding: Encoding,
        surface: Surface,
        shape: tuple[int, int, int, int],
        coding: Coding | None = None,
    ):
        super().__init__(surface, shape)
        self.affine = encoding.affine
        self._blocks: ClusterBlocks | None = None
        self._layout: VectorLayout | None = None
        self._condition = encoding.condition
        self._metric = None if coding is None else coding.metric
        values = encoding.representatives.unflatten(-1, shape[1:]).contiguous(), encoding.weights
        values = values if coding is None else coding.rounded(*values)
        self.representatives, self.weights = (nn.Parameter(one) for one in values)
        self.register_buffer("labels", encoding.labels)
        self.register_buffer("ranks", encoding.ranks)
        self.register_buffer("_step", None if coding is None else coding.step)
        self.register_buffer("_levels", None if coding is None else coding.levels)
        self._rest()

    @classmethod
    def from_transfer(
        cls,
        transfer: TransferTensor,
        *,
        num_clusters: int = 128,
        rank: int = 4,
        method: Method = "iterative",
        affine: bool = True,
        quantisation_share: float | None = None,
        memory_budget: int | None = None,
        process_group: distributed.ProcessGroup | None = None,
        metric: Metric | None = None,
        generator: torch.Generator | None = None,
    ) -> "CPCA":
        """Cluster the points and fit each cluster's subspace.

        Args:
            transfer: The tensor to stand for; read by blocks. With a ``process_group``, the points
                of this process.
            num_clusters: At least 1; fewer are made if there are fewer distinct points.
            rank: Vectors a cluster beside its mean, at least 0 (vector quantisation). Limited to
                the number of values of a point.
            method: ``static`` clusters by distance to the mean, then fits; ``iterative`` clusters
                by the error of the fit itself, adding vectors one by one; ``adaptive`` goes on
                from there with unequal ranks, within the bytes of equal ones.
            affine: Whether clusters have means. Without, subspaces go through the origin, and
                the rank must be at least 1.
            quantisation_share: Keep codes instead of numbers, which may add this share of the
                squared error (:meth:`coded`).
            memory_budget: Bytes that all of this may take at its peak, the result included and what
                was there before left out; as much as it takes if not given. Where it is short,
                points are kept in a temporary file (``TMPDIR``) and read in chunks, which takes
                longer and changes the result by rounding only. Tables for fast evaluation, where
                they do not fit, are made at the first call, outside of it.
            process_group: Processes that share the work, each with points of its own, in order of
                rank; every process makes this call with the same options. The result has all
                clusters and this process's points (:meth:`gathered` makes one of all), and the
                clusters are those of one process with all points, to rounding.
            metric: What errors are worth; the L2 norm over light directions if not given.
            generator: Source of randomness; seed 0 if not given.

        Raises:
            ValueError: If ``num_clusters`` or ``rank`` is too small, or the method is unknown.
            InputError: If ``memory_budget`` is less than the fit needs in any case: about what
                labels and weights take, and six tables of all vectors.

        Source:
            Sloan et al. 2003, sections 4.1 (static), 4.2 (iterative), 4.3 (adaptive). We reassign
            a point among the clusters nearest to its own and close with a pass over all clusters.
        """
        if num_clusters < 1:
            raise ValueError(f"expected at least 1 cluster, got {num_clusters}")
        least = 0 if affine else 1
        if rank < least:
            raise ValueError(f"expected a rank of at least {least}, got {rank}")
        if method not in get_args(Method):
            raise ValueError(f"expected method iterative, static or adaptive, got {method!r}")
        encoding = encode(
            transfer,
            num_clusters=num_clusters,
            rank=rank,
            method=method,
            affine=affine,
            metric=metric or Metric.l2(transfer),
            generator=generator or torch.Generator().manual_seed(0),
            memory_budget=memory_budget,
            processes=Processes(process_group),
        )
        model = cls(encoding, transfer.surface, tuple(transfer.values.shape))
        table_bytes = transfer.num_points * _TABLE_BYTES + 4 * len(encoding.weights)
        if memory_budget is None or table_bytes <= memory_budget // 16:
            model._make_tables()
        if quantisation_share is None:
            return model
        return model.coded(
            transfer, share=quantisation_share, metric=metric, process_group=process_group
        )

    @torch.no_grad()
    def coded(
        self,
        transfer: TransferTensor,
        *,
        share: float,
        metric: Metric | None = None,
        process_group: distributed.ProcessGroup | None = None,
    ) -> "CPCA":
        """The same in codes, without the vectors that are not worth theirs.

        Args:
            transfer: What it stands for; read once. With a ``process_group``, the points of this
                process.
            share: Of the squared error, which codes may add; down to what 15 bits do. At equal
                bytes, many vectors at a share of 4 to 8 have the least error.
            metric: The one it was made in; the L2 norm over light directions if not given.
            process_group: As in :meth:`from_transfer`.

        Raises:
            ValueError: If the share is not positive.
        """
        if not share > 0.0:
            raise ValueError(f"expected a positive share, got {share}")
        metric, processes = metric or Metric.l2(transfer), Processes(process_group)
        encoding, coding = coded(
            self._encoding(),
            self.shape[1:],
            self._squared_error(transfer, metric, processes),
            share=share,
            metric=metric.in_float32(),
            processes=processes,
        )
        found = CPCA(encoding, self.surface, self.shape, coding)
        return found if self._blocks is None else found._make_tables()

    @classmethod
    def within(
        cls,
        transfer: TransferTensor,
        *,
        max_error: float | None = None,
        max_bytes: int | None = None,
        max_relight_seconds: float | None = None,
        method: Method = "iterative",
        metric: Metric | None = None,
        generator: torch.Generator | None = None,
    ) -> "CPCA":
        """Choose clusters and rank by a limit; exactly one must be given.

        Args:
            transfer: The tensor to stand for.
            max_error: Squared error over squared norm, in the metric. The fewest bytes are found
                that keep it, by at most four encodings.
            max_bytes: Of :meth:`storage` in all. The least error is found that keeps it.
            max_relight_seconds: Median time of :meth:`forward` for one light on this machine, with
                the threads in use. The least error is found that keeps it.
            method: As in :meth:`from_transfer`.
            metric: What errors are worth; the L2 norm over light directions if not given.
            generator: Source of randomness; seed 0 if not given.

        Raises:
            ValueError: If not exactly one limit is given.
            InputError: If the limit cannot be kept.
        """
        metric = metric or Metric.l2(transfer)
        generator = generator or torch.Generator().manual_seed(0)
        surface, size = transfer.surface, tuple(transfer.values.shape)

        def make(shape: Shape) -> "CPCA":
            return cls.from_transfer(
                transfer,
                num_clusters=shape.num_clusters,
                rank=shape.rank,
                method=method,
                metric=metric,
                generator=torch.Generator().manual_seed(seed),
            )

        seed = int(torch.randint(2**31 - 1, (1,), generator=generator))
        return search(
            transfer,
            make=make,
            mock=lambda shape: cls(random_encoding(transfer, shape), surface, size),
            max_error=max_error,
            max_bytes=max_bytes,
            max_relight_seconds=max_relight_seconds,
            static=method == "static",
            metric=metric,
            generator=generator,
        )

    def gathered(self, process_group: distributed.ProcessGroup | None) -> "CPCA":
        """One model of all processes' points, on every process, from what each has fitted.

        Args:
            process_group: The one that :meth:`from_transfer` was given; points are in order of
                rank.
        """
        processes = Processes(process_group)
        labels = processes.gather(self.labels)
        encoding = replace(
            self._encoding(), labels=labels, weights=processes.gather(self.weights.detach())
        )
        surface = processes.gather_surface(self.surface, self.num_points)
        found = CPCA(encoding, surface, (len(labels), *self.shape[1:]), self._coding())
        return found._make_tables()

    def _encoding(self) -> Encoding:
        return Encoding(
            labels=self.labels,
            ranks=self.ranks,
            representatives=self.representatives.detach().flatten(1).clone(),
            weights=self.weights.detach().clone(),
            affine=self.affine,
            condition=self.condition,
        )

    def _coding(self) -> Coding | None:
        if self._metric is None or self._step is None or self._levels is None:
            return None
        return Coding(self._step, self._levels, self._metric)

    def _values(self) -> tuple[Tensor, Tensor]:
        """Representatives and weights as a file would hold them, while gradients refine them."""
        own, coding = (self.representatives, self.weights), self._coding()
        if coding is None or not self.training or self._at_rest:
            return own
        return coding.straight_through(*own)

    def _rounded(self) -> dict[str, Tensor]:
        own, coding = (self.representatives, self.weights), self._coding()
        values = own if coding is None else coding.rounded(*own)
        return dict(zip(("representatives", "weights"), values, strict=True))

    def _make_tables(self) -> "CPCA":
        """Those of evaluation at once: a compiler cannot trace how they are made."""
        self._blocks, self._layout = self.blocks, self.layout
        return self

    @property
    def blocks(self) -> ClusterBlocks:
        """Points sorted by cluster; made where first needed if memory was short."""
        if self._blocks is None:
            self._blocks = ClusterBlocks(self.labels, len(self.ranks))
        return self._blocks

    @property
    def layout(self) -> VectorLayout:
        """Places of vectors and weights; made where first needed if memory was short."""
        if self._layout is None:
            self._layout = VectorLayout(self.labels, self.ranks, self.affine)
        return self._layout

    @property
    def num_clusters(self) -> int:
        """Clusters made."""
        return len(self.ranks)

    @property
    def rank(self) -> int | float:
        """Weights of a point: a whole number where all are the same, else the mean over points."""
        if self.layout.uniform:
            return self.layout.max_rank
        return len(self.weights) / self.num_points

    def forward(
        self, light: Float[Tensor, "batch *points coeffs rgb"], frames: Tensor | None = None
    ) -> Float[Tensor, "batch points rows rgb"]:
        """Light the representatives, then mix them for each point.

        Raises:
            ValueError: If shapes do not fit, or ``frames`` are given: transfer by spherical
                coefficients is fixed to the rest pose.
        """
        if frames is not None:
            raise ValueError("CPCA stores transfer in the rest pose and cannot be posed by frames")
        representatives, weights = self._values()
        if self._check_light(light):
            return local_radiance(self.layout, self.blocks, representatives, weights, light)
        vectors = lit(representatives, light)
        if torch.is_grad_enabled() and (vectors.requires_grad or weights.requires_grad):
            mixed = mix_grouped(self.layout, self.blocks, vectors, weights)
        else:
            mixed = mix_gathered(self.layout, vectors, weights)
        return mixed.view(self.num_points, self.num_rows, 3, -1).permute(3, 0, 1, 2)

    def dense(self, points: Tensor | None = None) -> Float[Tensor, "points channels rows coeffs"]:
        """Mean plus weighted vectors of each point."""
        representatives, weights = self._values()
        flat = representatives.flatten(1)
        if points is None:
            values = mix_grouped(self.layout, self.blocks, flat, weights)
        else:
            own = self.layout.by_cluster(flat)[self.labels[points]]
            mixture = self.layout.by_point(weights, points)
            mixture = nn.functional.pad(mixture, (int(self.affine), 0), value=1.0)
            values = torch.bmm(mixture[:, None], own)[:, 0]
        return values.view(-1, self.num_channels, self.num_rows, self.num_coeffs)

    def packed(self) -> dict[str, Tensor]:
        """Numbers, or compressed codes (:func:`prt_torch.representations.cpca_coding.pack`)."""
        return pack(self._encoding(), self._coding(), self.shape[1:])

    @classmethod
    def from_packed(
        cls, packed: dict[str, Tensor], surface: Surface, shape: tuple[int, int, int, int]
    ) -> "CPCA":
        """The inverse of :meth:`packed`."""
        encoding, coding = unpack(packed, surface, shape)
        return cls(encoding, surface, shape, coding)._make_tables()

    @property
    def budget(self) -> dict[str, Any]:
        """Clusters and rank; ``adaptive`` and ``linear`` only where they hold.

        Of unequal ranks, ``rank`` is the mean over points to two digits, and ``adaptive`` their
        range, such as ``"0 to 12"``.
        """
        budget: dict[str, Any] = {"num_clusters": self.num_clusters, "rank": self.rank}
        if not self.layout.uniform:
            budget["rank"] = round(self.rank, 2)
            budget["adaptive"] = f"{int(self.ranks.min())} to {self.layout.max_rank}"
        if not self.affine:
            budget["linear"] = True
        return budget

    @property
    def condition(self) -> float:
        """Largest over smallest kept singular value, of the worst cluster; NaN if loaded."""
        return self._condition
