r"""Clustered tensor approximation: transfer as points by view by light, reduced in each mode.

Transfer of a glossy scene is a matrix for each point, rows of the exit basis by coefficients of the
light. Points are clustered, and each cluster's tensor is reduced in all three modes by its own
Tucker decomposition; the basis of the view is shared by all clusters of one material:

.. math:: T_p \approx U_{view} \Big( \sum_j w_{p,j}\, V_{c,j} \Big) U_{light,c}^T

Light meets each cluster's light basis once, then its cores; a point costs as many weighted sums of
small vectors as its rank. The work grows with coeffs x light rank a cluster, not with
coeffs x rows x rank as for CPCA.

Source:
    Tsai, Shih 2006, sections 5.2 and 6.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal

import torch
import torch.distributed as distributed
from jaxtyping import Float, Int
from torch import Tensor, nn

from prt_torch.metric import Metric
from prt_torch.representations.base import CodedRepresentation
from prt_torch.representations.clustered_tensor_coding import (
    BITS,
    Encoding,
    Parameters,
    Steps,
    pack,
    unpack,
)
from prt_torch.representations.clustered_tensor_compression import TensorCoding, coding_for
from prt_torch.representations.clustered_tensor_compression import pack as compressed
from prt_torch.representations.clustered_tensor_compression import unpack as decompressed
from prt_torch.representations.clustered_tensor_encoding import Options, encode
from prt_torch.representations.clustered_tensor_statistics import TensorStatistics
from prt_torch.representations.coherence import draws, registers
from prt_torch.representations.grouped import ClusterBlocks, sort_labels
from prt_torch.representations.processes import Processes
from prt_torch.representations.products import matmul_few
from prt_torch.transfer import Surface, TransferTensor

_TABLE_BYTES = 32  # a point, of tables for evaluation


class ClusteredTensor(CodedRepresentation):
    """Clusters of points with a Tucker decomposition each.

    Parameters are ``view_basis`` ``"groups channels*rows view"``, ``light_bases``
    ``"clusters light coeffs"``, ``cores`` ``"clusters rank view light"`` and ``weights``
    ``"points rank"``. Where transfer has three channels, view mode means channels times rows,
    channel slowest. Clusters of one material are a *group*, with a view basis of its own; a group
    of less rank than others has zeros in its place. From the closed form, bases are orthonormal in
    the metric; they are free afterwards, since mixtures of them with the inverse mixtures beside
    are the same transfer.

    Args:
        encoding: Clusters, bases and weights.
        surface: Bases, frames and reflectance.
        shape: Points, channels, rows, coeffs.
        coding: In place of the steps of ``encoding``, where numbers are compressed.

    Attributes:
        labels: ``"points"``: cluster of each, clusters numbered from the largest to the smallest.
        groups: ``"clusters"``: group of each.
        bits: Of a code; None where parameters are kept as they are.
        statistics: Where the module comes from :meth:`from_transfer`; else None.
    """

    kind: ClassVar[str] = "clustered_tensor"
    places: ClassVar[tuple[str, ...]] = ("labels", "groups")
    labels: Tensor
    groups: Tensor
    view_basis: nn.Parameter
    light_bases: nn.Parameter
    cores: nn.Parameter
    weights: nn.Parameter
    _step: Tensor | None
    _core_levels: Tensor | None
    _light_levels: Tensor | None

    def __init__(
        self,
        encoding: Encoding,
        surface: Surface,
        shape: tuple[int, int, int, int],
        coding: TensorCoding | None = None,
    ):
        super().__init__(surface, shape)
        self.bits: Literal[16] | None = None if encoding.steps is None else BITS
        self.statistics: TensorStatistics | None = None
        self._condition = encoding.condition
        self._blocks: ClusterBlocks | None = None
        self.register_buffer("labels", encoding.labels)
        self.register_buffer("groups", encoding.groups)
        self._metric = None if coding is None else coding.metric
        self.register_buffer("_step", None if coding is None else coding.step)
        self.register_buffer("_core_levels", None if coding is None else coding.core_levels)
        self.register_buffer("_light_levels", None if coding is None else coding.light_levels)
        own = encoding.parameters if coding is None else coding.rounded(encoding.parameters)
        for name in Parameters.names():
            values = getattr(own, name).detach().contiguous()
            self.register_parameter(name, nn.Parameter(values))
            steps = None if encoding.steps is None else getattr(encoding.steps, name)
            self.register_buffer(f"_{name}_steps", steps)
        self._rest()

    @classmethod
    def from_transfer(
        cls,
        transfer: TransferTensor,
        *,
        num_clusters: int = 140,
        ranks: Sequence[int] = (16, 48, 24),
        bits: Literal[16] | None = 16,
        quantisation_share: float | None = None,
        tolerance: float = 1e-4,
        max_turns: int = 40,
        memory_budget: int = 4 * 2**30,
        process_group: distributed.ProcessGroup | None = None,
        metric: Metric | None = None,
        generator: torch.Generator | None = None,
    ) -> "ClusteredTensor":
        """Cluster the points by the error of their decompositions, and decompose each cluster.

        Points of different materials (``transfer.surface.materials``) share no cluster.

        Args:
            transfer: The tensor to stand for; read by blocks, three or four times over. With a
                ``process_group``, the points of this process.
            num_clusters: At least 1 of each material; fewer are made if there are fewer distinct
                points. They are shared out to materials by squared norm.
            ranks: Of rows (times channels), light coefficients and points of a cluster, at least 1
                each; capped at what there is. The paper's 8 of 16 rows lose a fifth of a
                Cook-Torrance object's energy and save a sixth of the bytes (docs/tsai2006.md).
            bits: Of a code; None keeps parameters as they are, for a lossless budget.
            quantisation_share: Compress, in place of ``bits``, to codes that may add this share of
                the squared error (:mod:`prt_torch.representations.clustered_tensor_compression`);
                at equal bytes, large ranks at a share of 2 to 8 have the least error.
            tolerance: A turn that lowers the squared error by less than this share of it ends a
                phase.
            max_turns: Of each of the two phases.
            memory_budget: Bytes that all of this may take at its peak, the result included and what
                was there before left out. Where it is short, points are kept in a temporary file
                (``TMPDIR``) and read in chunks, which takes longer and changes the result by
                rounding only; where even tables of all clusters are large beside it, fewer light
                axes are kept than the error asks for, and ``statistics.projection_lost`` says what
                that costs. Tables for fast evaluation, where they do not fit, are made at the first
                call, outside of it.
            process_group: Processes that share the work, each with points of its own, in order of
                rank; every process makes this call with the same options. The result has all
                clusters and this process's points (:meth:`gathered` makes one of all), and the
                clusters are those of one process with all points, to rounding.
            metric: What errors are worth; the L2 norm over light directions if not given.
            generator: Source of randomness; seed 0 if not given.

        Raises:
            ValueError: If an option is out of range.
            InputError: If there are fewer clusters than materials, or ``memory_budget`` is less
                than the fit needs in any case: what labels, weights and tables of all clusters
                take.

        Source:
            Tsai, Shih 2006, section 5.2. Clusters begin as those of linear CPCA where the paper has
            ELBG's; a point tries the clusters nearest to its own, and all of them at the end; bases
            start from those of the turn before; all of it works in the principal axes of view and
            light that matter.
        """
        if bits not in (BITS, None):
            raise ValueError(f"expected 16 bits or None, got {bits!r}")
        if quantisation_share is not None and not quantisation_share > 0.0:
            raise ValueError(f"expected a positive share, got {quantisation_share}")
        processes = Processes(process_group)
        options = Options(
            tolerance=tolerance,
            max_turns=max_turns,
            memory_budget=memory_budget,
            metric=metric or Metric.l2(transfer),
            generator=generator or torch.Generator().manual_seed(0),
            processes=processes,
        )
        encoding, statistics = encode(
            transfer, num_clusters=num_clusters, ranks=ranks, options=options
        )
        if bits is not None and quantisation_share is None:
            encoding = encoding.coded(processes)
        found = cls(encoding, transfer.surface, tuple(transfer.values.shape))
        found.statistics = statistics
        if len(found.labels) * _TABLE_BYTES <= memory_budget // 16:
            found._blocks = found.blocks  # which no compiler can trace
        if quantisation_share is None:
            return found
        error = statistics.squared_error
        return found._compressed(error, quantisation_share, options.metric, processes)

    @torch.no_grad()
    def coded(
        self,
        transfer: TransferTensor,
        *,
        share: float,
        metric: Metric | None = None,
        process_group: distributed.ProcessGroup | None = None,
    ) -> "ClusteredTensor":
        """The same in compressed codes.

        Args:
            transfer: What it stands for; read once. With a ``process_group``, the points of this
                process.
            share: Of the squared error, which codes may add; down to what 15 bits do.
            metric: The one it was made in; the L2 norm over light directions if not given.
            process_group: As in :meth:`from_transfer`.

        Raises:
            ValueError: If the share is not positive.
        """
        if not share > 0.0:
            raise ValueError(f"expected a positive share, got {share}")
        metric, processes = metric or Metric.l2(transfer), Processes(process_group)
        error = self._squared_error(transfer, metric, processes)
        return self._compressed(error, share, metric, processes)

    @torch.no_grad()
    def _compressed(
        self, error: float, share: float, metric: Metric, processes: Processes
    ) -> "ClusteredTensor":
        """In codes that may add a share of a squared error over the points of all processes."""
        encoding = replace(self._encoding(), steps=None)
        coding = coding_for(
            encoding, error, share=share, metric=metric.in_float32(), processes=processes
        )
        found = ClusteredTensor(encoding, self.surface, self.shape, coding)
        found.statistics, found._blocks = self.statistics, self._blocks
        return found

    def _rounded(self) -> dict[str, Tensor]:
        encoding, coding = self._encoding(), self._coding()
        if coding is not None:
            rounded = coding.rounded(encoding.parameters)
        else:
            rounded = encoding.rounded().parameters
        return {name: getattr(rounded, name) for name in Parameters.names()}

    def _encoding(self) -> Encoding:
        parameters = Parameters(**{name: getattr(self, name) for name in Parameters.names()})
        steps = None
        if self.bits is not None:
            steps = Steps(**{n: getattr(self, f"_{n}_steps") for n in Parameters.names()})
        return Encoding(self.labels, self.groups, parameters, steps, self._condition)

    def _values(self) -> Parameters:
        """Parameters as a file would hold them, while gradients refine them."""
        encoding, coding = self._encoding(), self._coding()
        if not self.training or self._at_rest:
            return encoding.parameters
        if coding is not None:
            return coding.straight_through(encoding.parameters)
        return encoding.straight_through()

    def _coding(self) -> TensorCoding | None:
        step, cores, lights = self._step, self._core_levels, self._light_levels
        if self._metric is None or step is None or cores is None or lights is None:
            return None
        return TensorCoding(step, cores, lights, self._metric)

    def gathered(self, process_group: distributed.ProcessGroup | None) -> "ClusteredTensor":
        """One model of all processes' points, on every process, from what each has fitted.

        Args:
            process_group: The one that :meth:`from_transfer` was given; points are in order of
                rank.
        """
        processes, own = Processes(process_group), self._encoding()
        values = {name: getattr(own.parameters, name).detach() for name in Parameters.names()}
        values = {name: one.clone() for name, one in values.items() if name != "weights"}
        weights = processes.gather(self.weights.detach())
        encoding = replace(
            own,
            labels=processes.gather(self.labels),
            parameters=Parameters(**values, weights=weights),
        )
        surface = processes.gather_surface(self.surface, self.num_points)
        found = ClusteredTensor(encoding, surface, (len(weights), *self.shape[1:]), self._coding())
        found.statistics = self.statistics
        found._blocks = found.blocks
        return found

    @property
    def blocks(self) -> ClusterBlocks:
        """Points sorted by cluster; made where first needed, as it takes more than the labels."""
        if self._blocks is None:
            self._blocks = ClusterBlocks(self.labels, self.num_clusters)
        return self._blocks

    @property
    def num_clusters(self) -> int:
        """Clusters made."""
        return len(self.cores)

    def forward(
        self, light: Float[Tensor, "batch *points coeffs rgb"], frames: Tensor | None = None
    ) -> Float[Tensor, "batch points rows rgb"]:
        """Light each cluster's basis, then its cores, then mix these for each point.

        Raises:
            ValueError: If shapes do not fit, or ``frames`` are given: transfer by directions of
                the world is fixed to the rest pose.

        Source:
            Tsai, Shih 2006, section 6, steps 2 and 3, equation 23.
        """
        if frames is not None:
            raise ValueError(
                "clustered tensors store transfer in the rest pose and cannot be posed by frames"
            )
        if self._check_light(light):
            return self._forward_local(light)
        values = self._values()
        columns = light.permute(1, 2, 0).flatten(1)  # coeffs, rgb * batch
        lit = matmul_few(values.light_bases.flatten(0, 1), columns)
        lit = lit.view(self.num_clusters, 1, -1, columns.shape[1])
        lit = values.cores @ lit  # clusters, rank, view, rgb * batch
        views = self._views(values, slice(None))
        rows = self._rows(lit.unflatten(-1, (3, -1)), views)
        mixed = self.blocks.matmul(self.blocks.to_slots(values.weights), rows.flatten(2))
        radiance = self.blocks.to_points(mixed).view(self.num_points, self.num_rows, 3, len(light))
        return radiance.permute(3, 0, 1, 2)

    def _views(
        self, values: Parameters, clusters: Tensor | slice
    ) -> Float[Tensor, "some_or_one channels_times_rows view"]:
        """View basis of each of the clusters; only one where all share it, for larger products."""
        basis = values.view_basis
        return basis if len(basis) == 1 else basis[self.groups[clusters]]

    def _rows(
        self,
        lit: Float[Tensor, "some *rest view rgb batch"],
        views: Float[Tensor, "some_or_one channels_times_rows view"],
    ) -> Float[Tensor, "some *rest rows rgb batch"]:
        """Out of each one's view basis; of three channels, each colour in its own."""
        if self.num_channels == 1:
            return torch.einsum("sra,s...acb->s...rcb", views, lit)
        by_channel = views.unflatten(1, (3, self.num_rows))
        return torch.einsum("scra,s...acb->s...rcb", by_channel, lit)

    def _forward_local(self, light: Tensor) -> Float[Tensor, "batch points rows rgb"]:
        """Each point's own light meets its cluster's light basis, then its own core."""
        values = self._values()
        by_point = self.blocks.to_slots(light.permute(1, 3, 0, 2))  # slots rgb batch coeffs
        lit = self.blocks.matmul(by_point, values.light_bases.mT)
        core = self._cores_of_slots(self.blocks, self.blocks.to_slots(values.weights), values.cores)
        lit = torch.einsum("sal,scbl->sacb", core, lit)
        views = self._views(values, self.blocks.cluster_of_slot)
        return self.blocks.to_points(self._rows(lit, views)).permute(3, 0, 1, 2)

    @staticmethod
    def _cores_of_slots(
        blocks: ClusterBlocks, weights: Float[Tensor, "slots rank"], cores: Tensor
    ) -> Float[Tensor, "slots view light"]:
        return blocks.matmul(weights, cores.flatten(2)).unflatten(1, cores.shape[2:])

    def dense(self, points: Tensor | None = None) -> Float[Tensor, "points channels rows coeffs"]:
        """Weighted cores of each point between the two bases."""
        values = self._values()
        blocks, weights = self.blocks, values.weights
        cores, light_bases = values.cores, values.light_bases
        if points is not None:
            labels, old = sort_labels(self.labels[points], self.num_clusters)
            blocks, weights = ClusterBlocks(labels, self.num_clusters), weights[points]
            cores, light_bases = cores[old], light_bases[old]
        core = self._cores_of_slots(blocks, blocks.to_slots(weights), cores)
        by_view = blocks.to_points(blocks.matmul(core, light_bases))
        labels = self.labels if points is None else self.labels[points]
        by_row = self._views(values, labels).squeeze(0) @ by_view
        return by_row.unflatten(1, (self.num_channels, self.num_rows))

    def packed(self) -> dict[str, Tensor]:
        """As :func:`clustered_tensor_compression.pack` or :func:`clustered_tensor_coding.pack`."""
        coding = self._coding()
        return pack(self._encoding()) if coding is None else compressed(self._encoding(), coding)

    @classmethod
    def from_packed(
        cls, packed: dict[str, Tensor], surface: Surface, shape: tuple[int, int, int, int]
    ) -> "ClusteredTensor":
        """The inverse of :meth:`packed`."""
        if "weight_stream" in packed:
            encoding, coding = decompressed(packed, shape[0], shape[3], surface.light_basis)
        else:
            encoding, coding = unpack(packed), None
        found = cls(encoding, surface, shape, coding)
        found._blocks = found.blocks
        return found

    def coherence(self, faces: Int[Tensor, "faces 3"]) -> dict[str, float]:
        """How often a face is drawn (:func:`prt_torch.representations.coherence.draws`).

        A cluster's lit cores are vectors of as many numbers a colour as its view basis has columns.
        """
        vectors = torch.full_like(self.groups, self.cores.shape[1])
        return draws(self.labels, faces, registers(vectors, self.cores.shape[2]))

    @property
    def budget(self) -> dict[str, Any]:
        """Clusters, and ranks of rows, light coefficients and points."""
        _, rank, view, light = self.cores.shape
        return {"num_clusters": self.num_clusters, "ranks": [view, light, rank]}

    @property
    def condition(self) -> float:
        """Largest over smallest kept singular value, of the worst cluster; NaN if loaded."""
        return self._condition
