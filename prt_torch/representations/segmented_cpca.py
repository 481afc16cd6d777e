r"""Segmented CPCA: the lights of each part of the sky have their own clusters of points.

Under all-frequency light a point's transfer is thousands of numbers, and points that are alike
under one part of the sky are not under another. So the light's coefficients are cut into segments,
and each segment is clustered by itself, with subspaces through the origin:

.. math:: T_p = \sum_s \sum_i w_{p,s}^i\, (M_s^i L_s)

Points that see nothing of a segment are left out of it. Light meets the representatives of a
segment once; a point then adds up its weighted results over all segments.

Representatives in Haar wavelets are quantised and sparse in a file (``segmented_coding``).

Source:
    Liu, Sloan, Shum, Snyder 2004, sections 5 and 6.
"""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from prt_torch.metric import Metric
from prt_torch.quantize import straight_through
from prt_torch.representations.base import CodedRepresentation
from prt_torch.representations.cpca_subspaces import one_thread
from prt_torch.representations.segmented_coding import pack, unpack
from prt_torch.representations.segmented_encoding import (
    CULLED,
    RAW,
    SegmentEncoding,
    encode_segment,
    nonzero_blocks,
    segment_metric,
)
from prt_torch.representations.segmented_layout import LitMixture, Segment
from prt_torch.representations.segmented_quantisation import Encoding, join, quantise_segment
from prt_torch.transfer import Surface, TransferTensor

_BLOCK_BYTES = 2**26  # of dense transfer, where each point has its own light


@dataclass(frozen=True)
class SegmentStatistics:
    """What the encoding of one segment did.

    Attributes:
        nonzero_share: Share of the points that see anything of the segment.
        clusters: Clusters that have a subspace.
        raw_points: Points kept as they are.
        raw_bytes: Of the segment in the tensor, zeros included.
        cpca_bytes: Of its representatives and weights in the tensor's type.
        coded_bytes: Of what a file holds of it.
        squared_norm: Of its transfer, in the metric.
        cpca_squared_error: Of its CPCA, in the metric; quantisation comes on top.
        seconds: Time to encode it, reading aside.

    Source:
        Liu et al. 2004, table 1.
    """

    nonzero_share: float
    clusters: int
    raw_points: int
    raw_bytes: int
    cpca_bytes: int
    coded_bytes: int
    squared_norm: float
    cpca_squared_error: float
    seconds: float


class SegmentedCPCA(CodedRepresentation):
    """Clustered subspaces of each segment of the light.

    Parameters are ``representatives`` and ``weights`` of an :class:`Encoding`. Where they are at
    rest, evaluation is fastest.

    Args:
        encoding: Clusters, representatives, weights and their steps.
        surface: Bases, frames and reflectance.
        shape: Points, channels, rows, coeffs.

    Attributes:
        statistics: Of each segment, where the module comes from :meth:`from_transfer`; else empty.
    """

    kind: ClassVar[str] = "segmented_cpca"
    places: ClassVar[tuple[str, ...]] = ("labels", "ranks", "clusters")
    labels: Tensor
    ranks: Tensor
    clusters: Tensor
    representative_steps: Tensor
    weight_steps: Tensor

    def __init__(self, encoding: Encoding, surface: Surface, shape: tuple[int, int, int, int]):
        super().__init__(surface, shape)
        self.bits, self._condition = encoding.bits, encoding.condition
        self.statistics: list[SegmentStatistics] = []
        self.num_segments = len(encoding.labels)
        for name in ("labels", "ranks", "clusters", "representative_steps", "weight_steps"):
            self.register_buffer(name, getattr(encoding, name))
        ranks = encoding.ranks.split(encoding.clusters.tolist())
        self.segments = [Segment(*one) for one in zip(encoding.labels, ranks, strict=True)]
        self._of_segments = nn.ModuleList(self.segments)  # so that they move with the module
        self.representatives = nn.Parameter(encoding.representatives)
        self.weights = nn.Parameter(encoding.weights)
        self._rest()

    @classmethod
    def from_transfer(
        cls,
        transfer: TransferTensor,
        *,
        points_per_cluster: int = 200,
        rank: int = 16,
        num_segments: int | None = None,
        bits: int = 16,
        quantisation_share: float = 0.05,
        memory_budget: int = 4 * 2**30,
        metric: Metric | None = None,
        generator: torch.Generator | None = None,
    ) -> "SegmentedCPCA":
        """Cluster the points of each segment, fit each cluster's subspace, and quantise.

        Args:
            transfer: The tensor to stand for; read by blocks, a few times over.
            points_per_cluster: Mean size of a cluster of points that see anything of the segment.
                1 keeps every point, at the finest step that ``bits`` allow.
            rank: Vectors a cluster at most.
            num_segments: Equal runs that the coefficients are cut into; those of the light basis
                if it has any (:class:`prt_torch.bases.Haar`), else 1.
            bits: Of a code with its sign, 2 to 16.
            quantisation_share: Squared error that quantising representatives may add, over the
                squared error of a segment's CPCA.
            memory_budget: Bytes for the points of segments that are read at once.
            metric: What errors are worth; the L2 norm over light directions if not given.
            generator: Source of randomness; seed 0 if not given.

        Raises:
            ValueError: If an option is out of range or the segments do not divide the coefficients.

        Source:
            Liu et al. 2004, section 5. Projections before clustering, and a step chosen by its
            error, are ours.
        """
        basis = transfer.surface.light_basis
        count = getattr(basis, "num_segments", 1) if num_segments is None else num_segments
        _check(transfer, count, points_per_cluster, rank, bits, quantisation_share)
        metric = metric or Metric.l2(transfer)
        generator = generator or torch.Generator().manual_seed(0)
        size = transfer.num_coeffs // count
        seeds = torch.randint(2**31 - 1, (count,), generator=generator).tolist()

        def encode(
            place: int, points: Tensor, values: Tensor
        ) -> tuple[Encoding, SegmentStatistics]:
            start = time.perf_counter()
            own = slice(place * size, (place + 1) * size)
            local = segment_metric(metric, own, transfer.num_coeffs)
            encoding = encode_segment(
                points,
                values,
                num_points=transfer.num_points,
                points_per_cluster=points_per_cluster,
                rank=rank,
                metric=local,
                generator=torch.Generator().manual_seed(seeds[place]),
            )
            coding = quantise_segment(encoding, local, quantisation_share, bits)
            seconds = time.perf_counter() - start
            return coding, _statistics(encoding, coding, transfer, count, seconds)

        blocks = nonzero_blocks(transfer, count, memory_budget)
        codings, statistics = zip(*_side_by_side(encode, blocks), strict=True)
        found = cls(join(list(codings)), transfer.surface, tuple(transfer.values.shape))
        found.statistics = list(statistics)
        return found

    def _rounded(self) -> dict[str, Tensor]:
        rounded = self._encoding().rounded()
        return {"representatives": rounded.representatives, "weights": rounded.weights}

    def _rest(self) -> None:
        """As for all coded representations; and forget how the parameters were lit."""
        super()._rest()
        self._lit_mixture: tuple[LitMixture, ...] = ()

    def _encoding(self) -> Encoding:
        return Encoding(
            labels=self.labels,
            ranks=self.ranks,
            clusters=self.clusters,
            representatives=self.representatives.detach(),
            weights=self.weights.detach(),
            representative_steps=self.representative_steps,
            weight_steps=self.weight_steps,
            bits=self.bits,
            condition=self._condition,
        )

    def forward(
        self, light: Float[Tensor, "batch *points coeffs rgb"], frames: Tensor | None = None
    ) -> Float[Tensor, "batch points rows rgb"]:
        """Light the representatives of each segment, then add them up for each point.

        Raises:
            ValueError: If shapes do not fit, or ``frames`` are given: transfer by directions of
                the world is fixed to the rest pose.
        """
        if frames is not None:
            raise ValueError(
                "segmented CPCA stores transfer in the rest pose and cannot be posed by frames"
            )
        if self._check_light(light):
            return self._forward_local(light)
        parameters = self.representatives.requires_grad or self.weights.requires_grad
        wants_grad = torch.is_grad_enabled() and (parameters or light.requires_grad)
        if not wants_grad and self._at_rest:
            radiance = self._mixture()(light)
        else:
            radiance = self._forward_by_segment(light)
        return radiance.permute(3, 0, 1, 2)

    def _mixture(self) -> LitMixture:
        kept, like = self._lit_mixture, self.weights
        if not kept or (kept[0].mixture.dtype, kept[0].mixture.device) != (like.dtype, like.device):
            made = LitMixture(self.segments, self.num_points, self.representatives, self.weights)
            # In a tuple, not part of the module: processes that have not relit lack it.
            self._lit_mixture = kept = (made,)
        return kept[0]

    def _forward_by_segment(self, light: Tensor) -> Float[Tensor, "points rows rgb batch"]:
        width = self.num_rows * 3 * len(light)
        out = light.new_zeros(self.num_points, width)
        lights = light.unflatten(1, (self.num_segments, -1)).unbind(1)
        for (segment, vectors, weights), own in zip(self._parts(), lights, strict=True):
            equation = "vcri,bic->vrcb" if self.num_channels == 3 else "vzri,bic->vrcb"
            segment.add(out, torch.einsum(equation, vectors, own).flatten(1), weights)
        return out.view(self.num_points, self.num_rows, 3, -1)

    def _forward_local(self, light: Tensor) -> Tensor:
        """Each point's own light meets its own transfer, formed for some points at a time.

        Cheaper than lighting the vectors of a point's clusters, of which it has many more than
        rows.
        """
        equation = "pcri,bpic->bprc" if self.num_channels == 3 else "pzri,bpic->bprc"
        point_bytes = self.num_channels * self.num_rows * self.num_coeffs * light.element_size()
        points = torch.arange(self.num_points, device=light.device)
        pieces = [
            torch.einsum(equation, self.dense(some), light[:, some])
            for some in points.split(max(1, _BLOCK_BYTES // point_bytes))
        ]
        return torch.cat(pieces, dim=1)

    def dense(self, points: Tensor | None = None) -> Float[Tensor, "points channels rows coeffs"]:
        """Weighted vectors of each point, segment beside segment."""
        count = self.num_points if points is None else len(points)
        width = self.num_channels * self.num_rows * self.num_coeffs // self.num_segments
        pieces = []
        for segment, vectors, weights in self._parts():
            out = vectors.new_zeros(count, width)
            segment.add(out, vectors.flatten(1), weights, points)
            pieces.append(out.view(count, self.num_channels, self.num_rows, -1))
        return torch.cat(pieces, dim=-1)

    def _parts(self) -> list[tuple[Segment, Tensor, Tensor]]:
        """Each segment with its representatives and weights."""
        representatives, weights = self.representatives, self.weights
        if self.training and not self._at_rest:
            encoding = self._encoding()
            representatives = straight_through(representatives, encoding.vector_steps, self.bits)
            weights = straight_through(weights, encoding.entry_steps, self.bits)
        vectors = [segment.num_vectors for segment in self.segments]
        entries = [segment.num_weights for segment in self.segments]
        each = zip(representatives.split(vectors), weights.split(entries), strict=True)
        return [(segment, *own) for segment, own in zip(self.segments, each, strict=True)]

    def packed(self) -> dict[str, Tensor]:
        """Codes, steps and places (:func:`prt_torch.representations.segmented_coding.pack`)."""
        return pack(self._encoding())

    @classmethod
    def from_packed(
        cls, packed: dict[str, Tensor], surface: Surface, shape: tuple[int, int, int, int]
    ) -> "SegmentedCPCA":
        """The inverse of :meth:`packed`."""
        _, channels, rows, coeffs = shape
        encoding = unpack(packed, channels, rows, coeffs // len(packed["labels"]))
        return cls(encoding, surface, shape)

    @property
    def budget(self) -> dict[str, Any]:
        """Segments, clusters of all, their mean size and highest rank, and points kept as such."""
        sizes = sum(len(segment.points) for segment in self.segments)
        clusters = len(self.ranks)
        return {
            "num_segments": self.num_segments,
            "clusters": clusters,
            "points_per_cluster": round(sizes / clusters) if clusters else 0,
            "rank": int(self.ranks.max()) if clusters else 0,
            "raw": int((self.labels == RAW).sum()),
        }

    @property
    def culled_share(self) -> float:
        """Share of the points, over all segments, that see nothing of the segment."""
        return float((self.labels == CULLED).double().mean())

    @property
    def condition(self) -> float:
        """Largest over smallest kept singular value, of the worst cluster; NaN if loaded."""
        return self._condition


def _side_by_side(
    encode: Callable[[int, Tensor, Tensor], tuple[Encoding, SegmentStatistics]],
    blocks: Iterable[tuple[Tensor, Tensor]],
) -> Iterator[tuple[Encoding, SegmentStatistics]]:
    """Encode segments in order, as many at a time as torch uses threads, each with one of them.

    Most steps are too small for threads of their own; results do not depend on their number.
    """
    workers = torch.get_num_threads()
    waiting: deque[Future[tuple[Encoding, SegmentStatistics]]] = deque()
    with one_thread(), ThreadPoolExecutor(workers) as pool:
        for place, (points, values) in enumerate(blocks):
            waiting.append(pool.submit(encode, place, points, values))
            if len(waiting) >= workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _check(
    transfer: TransferTensor,
    num_segments: int,
    points_per_cluster: int,
    rank: int,
    bits: int,
    quantisation_share: float,
) -> None:
    """Whether the options of :meth:`SegmentedCPCA.from_transfer` are in range."""
    if num_segments < 1 or transfer.num_coeffs % num_segments:
        raise ValueError(
            f"expected segments that divide {transfer.num_coeffs} coeffs, got {num_segments}"
        )
    if points_per_cluster < 1:
        raise ValueError(f"expected at least 1 point a cluster, got {points_per_cluster}")
    if rank < 1:
        raise ValueError(f"expected a rank of at least 1, got {rank}")
    if not 2 <= bits <= 16:
        raise ValueError(f"expected 2..16 bits a code, got {bits}")
    if not 0 <= quantisation_share < float("inf"):
        raise ValueError(f"expected a quantisation share of at least 0, got {quantisation_share}")


def _statistics(
    encoding: SegmentEncoding,
    coding: Encoding,
    transfer: TransferTensor,
    num_segments: int,
    seconds: float,
) -> SegmentStatistics:
    itemsize = transfer.values.dtype.itemsize
    vectors, points = encoding.representatives, transfer.num_points
    values = transfer.num_channels * transfer.num_rows * transfer.num_coeffs // num_segments
    return SegmentStatistics(
        nonzero_share=int((encoding.labels != CULLED).sum()) / points,
        clusters=len(encoding.ranks),
        raw_points=int((encoding.labels == RAW).sum()),
        raw_bytes=points * values * itemsize,
        cpca_bytes=(vectors.numel() + encoding.weights.numel()) * itemsize,
        coded_bytes=sum(part.nbytes for part in pack(coding).values()),
        squared_norm=encoding.squared_norm,
        cpca_squared_error=encoding.squared_error,
        seconds=seconds,
    )
