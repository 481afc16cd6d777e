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

from typing import Any, ClassVar, get_args

import torch
import torch.distributed as distributed
from jaxtyping import Float
from torch import Tensor, nn

from prt_torch.metric import Metric
from prt_torch.representations.base import Representation
from prt_torch.representations.cpca_encoding import Encoding, Method, encode
from prt_torch.representations.cpca_layout import VectorLayout
from prt_torch.representations.cpca_search import Shape, random_encoding, search
from prt_torch.representations.grouped import ClusterBlocks
from prt_torch.representations.processes import Processes
from prt_torch.representations.products import matmul_few
from prt_torch.transfer import Surface, TransferTensor


class CPCA(Representation):
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

    Attributes:
        labels: ``"points"``: cluster of each, clusters numbered from the largest to the smallest.
        ranks: ``"clusters"``: vectors of each beside its mean.
        affine: Whether clusters have means.
    """

    kind: ClassVar[str] = "cpca"
    places: ClassVar[tuple[str, ...]] = ("labels", "ranks")
    labels: Tensor
    ranks: Tensor

    def __init__(self, encoding: Encoding, surface: Surface, shape: tuple[int, int, int, int]):
        super().__init__(surface, shape)
        self.affine = encoding.affine
        self._blocks: ClusterBlocks | None = None
        self._layout: VectorLayout | None = None
        self._condition = encoding.condition
        self.representatives = nn.Parameter(
            encoding.representatives.unflatten(-1, shape[1:]).contiguous()
        )
        self.weights = nn.Parameter(encoding.weights)
        self.register_buffer("labels", encoding.labels)
        self.register_buffer("ranks", encoding.ranks)

    @classmethod
    def from_transfer(
        cls,
        transfer: TransferTensor,
        *,
        num_clusters: int = 128,
        rank: int = 4,
        method: Method = "iterative",
        affine: bool = True,
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
            memory_budget: Bytes that all of this may take at its peak, the result included and what
                was there before left out; as much as it takes if not given. Where it is short,
                points are kept in a temporary file (``TMPDIR``) and read in chunks, which takes
                longer and changes the result by rounding only. Tables for fast evaluation are made
                at the first call, outside of it.
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
        return cls(encoding, transfer.surface, tuple(transfer.values.shape))

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
        encoding = Encoding(
            labels=labels,
            ranks=self.ranks,
            representatives=self.representatives.detach().flatten(1).clone(),
            weights=processes.gather(self.weights.detach()),
            affine=self.affine,
            condition=self.condition,
        )
        surface = processes.gather_surface(self.surface, self.num_points)
        return CPCA(encoding, surface, (len(labels), *self.shape[1:]))

    @property
    def blocks(self) -> ClusterBlocks:
        """Points sorted by cluster; made where first needed, as it takes more than the weights."""
        if self._blocks is None:
            self._blocks = ClusterBlocks(self.labels, len(self.ranks))
        return self._blocks

    @property
    def layout(self) -> VectorLayout:
        """Places of vectors and weights; made where first needed."""
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
        if self._check_light(light):
            return self._forward_local(light)
        lit = self._light_representatives(light)  # vectors, rows * rgb * batch
        wants_grad = lit.requires_grad or self.weights.requires_grad
        mix = self._mix_grouped if torch.is_grad_enabled() and wants_grad else self._mix_gathered
        return mix(lit).view(self.num_points, self.num_rows, 3, -1).permute(3, 0, 1, 2)

    def _mix_grouped(self, vectors: Tensor) -> Float[Tensor, "points values"]:
        """Weighted sums of each point's own vectors, by batched products: fast to differentiate."""
        slots = self.blocks.to_slots(self.layout.by_point(self.weights))
        own = self.layout.by_cluster(vectors)
        if self.affine:
            mixed = self.blocks.matmul(slots, own[:, 1:], offsets=own[:, 0])
        else:
            mixed = self.blocks.matmul(slots, own)
        return self.blocks.to_points(mixed)

    def _mix_gathered(self, vectors: Tensor) -> Float[Tensor, "points values"]:
        """The same in one pass that writes every result once and in place: fast to evaluate.

        The lit vectors of all clusters stay in the processor's cache.
        """
        return nn.functional.embedding_bag(
            self.layout.own_vectors,
            vectors.to(self.weights.dtype),  # autocast, which leaves them short, stops here
            self.layout.own_borders,
            mode="sum",
            per_sample_weights=self.layout.mixture(self.weights),
            include_last_offset=True,
        )

    def _light_representatives(self, light: Tensor) -> Float[Tensor, "vectors values"]:
        vectors, channels, _, coeffs = self.representatives.shape
        if channels == 1:
            columns = light.permute(1, 2, 0).reshape(coeffs, -1)
            lit = matmul_few(self.representatives.view(-1, coeffs), columns)
        else:
            by_channel = self.representatives.transpose(0, 1).reshape(channels, -1, coeffs)
            lit = torch.bmm(by_channel, light.permute(2, 1, 0)).permute(1, 0, 2)
        return lit.reshape(vectors, self.num_rows * 3 * len(light))

    def _forward_local(self, light: Tensor) -> Tensor:
        """Each point's own light meets its cluster's representatives, then its weights."""
        weights = self.layout.by_point(self.weights)
        own = self.layout.by_cluster(self.representatives)
        mixture = self.blocks.to_slots(nn.functional.pad(weights, (int(self.affine), 0), value=1.0))
        by_point = self.blocks.to_slots(light.permute(1, 3, 0, 2))  # slots rgb batch coeffs
        colours = []
        for colour in range(3):
            channel = own[:, :, colour if self.num_channels == 3 else 0]
            matrices = channel.flatten(1, 2).mT  # clusters, coeffs, vectors * rows
            lit = self.blocks.matmul(by_point[:, colour], matrices)
            lit = lit.unflatten(-1, (own.shape[1], self.num_rows))
            colours.append(torch.einsum("sv,sbvr->sbr", mixture, lit))
        radiance = self.blocks.to_points(torch.stack(colours, dim=-1))
        return radiance.permute(1, 0, 2, 3)

    def dense(self, points: Tensor | None = None) -> Float[Tensor, "points channels rows coeffs"]:
        """Mean plus weighted vectors of each point."""
        flat = self.representatives.flatten(1)
        if points is None:
            values = self._mix_grouped(flat)
        else:
            own = self.layout.by_cluster(flat)[self.labels[points]]
            mixture = self.layout.by_point(self.weights, points)
            mixture = nn.functional.pad(mixture, (int(self.affine), 0), value=1.0)
            values = torch.bmm(mixture[:, None], own)[:, 0]
        return values.view(-1, self.num_channels, self.num_rows, self.num_coeffs)

    def packed(self) -> dict[str, Tensor]:
        """Representatives, weights by point, and cluster numbers in the least whole bytes.

        Where all ranks are the same, representatives are ``"clusters vectors channels rows
        coeffs"`` and weights ``"points rank"``: the shapes tell the rank and whether there are
        means. Where they differ, both are flat and ``ranks`` stands beside them.
        """
        representatives, weights = self.representatives.detach(), self.weights.detach()
        labels = _smallest_integers(self.labels, self.num_clusters - 1)
        if self.layout.uniform:
            return {
                "representatives": self.layout.by_cluster(representatives).clone(),
                "weights": self.layout.by_point(weights).clone(),
                "labels": labels,
            }
        return {
            "representatives": representatives.clone(),
            "weights": weights.clone(),
            "labels": labels,
            "ranks": _smallest_integers(self.ranks, self.layout.max_rank),
        }

    @classmethod
    def from_packed(
        cls, packed: dict[str, Tensor], surface: Surface, shape: tuple[int, int, int, int]
    ) -> "CPCA":
        """The inverse of :meth:`packed`."""
        representatives, weights = packed["representatives"], packed["weights"]
        labels = packed["labels"].long()
        if "ranks" in packed:
            ranks = packed["ranks"].long()
            means = len(representatives) - int(ranks.sum())
        else:
            clusters, vectors = representatives.shape[:2]
            rank = weights.shape[1]
            ranks = torch.full((clusters,), rank, device=labels.device)
            means = vectors - rank
            representatives = representatives.flatten(0, 1)
        encoding = Encoding(
            labels=labels,
            ranks=ranks,
            representatives=representatives.flatten(1),
            weights=weights.flatten().clone(),
            affine=means > 0,
            condition=float("nan"),
        )
        return cls(encoding, surface, shape)

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


def _smallest_integers(values: Tensor, largest: int) -> Tensor:
    """In as few bytes as the largest needs."""
    match largest:
        case small if small < 2**8:
            return values.to(torch.uint8)
        case medium if medium < 2**15:
            return values.to(torch.int16)
        case _:
            return values.to(torch.int32)
