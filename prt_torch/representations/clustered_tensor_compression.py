r"""Clustered tensors as few bits as they are worth: one step, seen through the decomposition.

As for CPCA (:mod:`prt_torch.representations.cpca_coding`), weights are coordinates in which errors
of transfer add up, and have one step :math:`\Delta`. An error of a cluster's dual vector counts as
often as its weights say, so its step is :math:`\Delta` over the norm of these; an error of a light
vector counts as the energy that the cores have along it. What is worth less than a step becomes
zero and costs next to nothing, so ranks may be given generously. The view basis, which all
clusters of a group share, is kept as it is.

Source:
    Ours; Tsai, Shih 2006, section 7, keep 16 bits of everything.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Int16
from torch import Tensor

from prt_torch.bases import Diffuse, LightBasis
from prt_torch.metric import Metric
from prt_torch.quantize import (
    compress,
    decompress,
    dequantize,
    full_scale,
    least_unsigned,
    quantize,
    straight_through,
)
from prt_torch.representations.clustered_tensor_coding import Encoding, Parameters
from prt_torch.representations.points import cluster_sizes
from prt_torch.representations.processes import ALONE, Processes

_LEVELS = 4  # of an octave
_VECTOR_BITS, _WEIGHT_BITS = 15, 16  # at most: float32 tells such codes apart in any metric


@dataclass(frozen=True)
class TensorCoding:
    """What turns codes into values.

    Attributes:
        step: Of all weights, float64.
        core_levels: Of each dual vector: its step is 2^(-level / 4).
        light_levels: Likewise of each light vector, in the metric.
        metric: In which light vectors are coded; its light side only.
    """

    step: Float[Tensor, ""]
    core_levels: Int16[Tensor, "clusters rank"]
    light_levels: Int16[Tensor, "clusters light"]
    metric: Metric

    def codes(self, own: Parameters) -> dict[str, Int[Tensor, "..."]]:
        """Codes of ``light_bases``, ``cores`` and ``weights``."""
        bits = _VECTOR_BITS + 2
        weighed = self.metric.weigh(own.light_bases.detach().double())
        return {
            "light_bases": quantize(weighed, _steps(self.light_levels)[..., None], bits),
            "cores": quantize(own.cores, _steps(self.core_levels)[..., None, None], bits),
            "weights": quantize(own.weights, self.step, _WEIGHT_BITS),
        }

    def values(self, codes: dict[str, Tensor], view_basis: Tensor) -> Parameters:
        """What codes stand for, beside a view basis, whose type they take."""
        steps = _steps(self.light_levels)[..., None]
        light = dequantize(codes["light_bases"].contiguous(), steps, torch.float64)
        cores, dtype = _steps(self.core_levels)[..., None, None], view_basis.dtype
        return Parameters(
            view_basis=view_basis,
            light_bases=self.metric.unweigh(light).to(dtype).contiguous(),
            cores=dequantize(codes["cores"], cores, dtype),
            weights=dequantize(codes["weights"], self.step, dtype),
        )

    def rounded(self, own: Parameters) -> Parameters:
        """The same at what codes stand for."""
        return self.values(self.codes(own), own.view_basis)

    def straight_through(self, own: Parameters) -> Parameters:
        """The same values, whose gradients pass as if nothing were rounded."""
        bits = _VECTOR_BITS + 2
        weighed = self.metric.weigh(own.light_bases.double())
        light = straight_through(weighed, _steps(self.light_levels)[..., None], bits)
        cores = _steps(self.core_levels)[..., None, None]
        return Parameters(
            view_basis=own.view_basis,
            light_bases=self.metric.unweigh(light).to(own.light_bases.dtype).contiguous(),
            cores=straight_through(own.cores, cores, bits),
            weights=straight_through(own.weights, self.step, _WEIGHT_BITS),
        )


def coding_for(
    encoding: Encoding,
    squared_error: float,
    *,
    share: float,
    metric: Metric,
    processes: Processes = ALONE,
) -> TensorCoding:
    """The steps at which codes add a share of the squared error.

    Args:
        encoding: As its closed form left it: bases orthonormal in the metric.
        squared_error: Of the encoding in the metric, over the points of all processes.
        share: Of that, which codes may add.
        metric: What errors are worth.
        processes: Those that have points too.
    """
    own, clusters = encoding.parameters, len(encoding.parameters.cores)
    totals = own.weights.new_zeros(clusters + 1, own.weights.shape[1], dtype=torch.float64)
    totals.index_add_(0, encoding.labels, own.weights.double().square())
    totals[-1] = len(own.weights)
    totals = processes.sum(totals)
    numbers = own.cores.numel() + own.light_bases.numel() + float(totals[-1].sum())
    wanted = (12.0 * share * squared_error / numbers) ** 0.5
    largest = own.weights.abs().max().double().reshape(1)
    step = full_scale(processes.largest(largest), _WEIGHT_BITS).clamp_min(wanted)
    squares = totals[:-1]
    along_light = torch.einsum("cr,cral->cl", squares, own.cores.double().square())
    light_side = Metric(metric.name, metric.light)
    light = light_side.weigh(own.light_bases.double())
    return TensorCoding(
        step,
        _levels(own.cores.flatten(2), step / squares.sqrt()),
        _levels(light, step / along_light.sqrt()),
        light_side,
    )


def pack(encoding: Encoding, coding: TensorCoding) -> dict[str, Tensor]:
    """What a file holds.

    ``step``; ``view_basis`` as it is; ``shape``, the clusters and the ranks of points and light;
    ``label_stream``, ``level_stream``, ``light_stream``, ``core_stream`` and ``weight_stream``,
    compressed; ``groups`` if there are several; ``light_factor`` of a prior.
    """
    own, labels = encoding.parameters, encoding.labels
    codes = coding.codes(own)
    by_spread = _by_spread(labels, coding.core_levels)
    by_energy = coding.light_levels.flatten().long().argsort(descending=True, stable=True)
    levels = torch.cat([coding.core_levels, coding.light_levels], dim=1).mT
    shape = (*own.cores.shape[:2], own.cores.shape[3])
    packed = {
        "step": coding.step.clone(),
        "view_basis": own.view_basis.detach().clone(),
        "shape": torch.tensor(shape, dtype=torch.int32, device=labels.device),
        "label_stream": compress(labels, signed=False),
        "level_stream": compress(levels, signed=True),
        "light_stream": compress(codes["light_bases"].flatten(0, 1)[by_energy].mT, signed=True),
        "core_stream": compress(codes["cores"].flatten(2).flatten(0, 1)[by_spread].mT, signed=True),
        "weight_stream": compress(
            codes["weights"].flatten()[_entries(labels, by_spread, shape[1])], signed=True
        ),
        **coding.metric.to_file(),
    }
    groups = len(own.view_basis)
    return packed | ({"groups": least_unsigned(encoding.groups, groups - 1)} if groups > 1 else {})


def unpack(
    packed: dict[str, Tensor], points: int, coeffs: int, light_basis: LightBasis | None
) -> tuple[Encoding, TensorCoding]:
    """The inverse of :func:`pack` for transfer of so many points and light coefficients."""
    (clusters, rank, light), view_basis = packed["shape"].tolist(), packed["view_basis"]
    view = view_basis.shape[2]
    labels = decompress(packed["label_stream"], points, signed=False)
    levels = decompress(packed["level_stream"], clusters * (rank + light), signed=True)
    levels = levels.view(rank + light, clusters).mT.to(torch.int16).contiguous()
    metric = Metric.from_file(packed, light_basis, Diffuse())
    coding = TensorCoding(
        packed["step"], levels[:, :rank].contiguous(), levels[:, rank:].contiguous(), metric
    )
    by_spread = _by_spread(labels, coding.core_levels)
    by_energy = coding.light_levels.flatten().long().argsort(descending=True, stable=True)
    bases = _table(packed["light_stream"], coeffs, by_energy)
    cores = _table(packed["core_stream"], view * light, by_spread)
    flat = decompress(packed["weight_stream"], points * rank, signed=True)
    weights = torch.empty_like(flat)
    weights[_entries(labels, by_spread, rank)] = flat
    codes = {
        "light_bases": bases.view(clusters, light, coeffs),
        "cores": cores.view(clusters, rank, view, light),
        "weights": weights.view(points, rank),
    }
    groups = packed["groups"].long() if "groups" in packed else labels.new_zeros(clusters)
    parameters = coding.values(codes, view_basis)
    return Encoding(labels, groups, parameters, None, float("nan")), coding


def _steps(levels: Int16[Tensor, "clusters vectors"]) -> Float[Tensor, "clusters vectors"]:
    return torch.exp2(-levels.double() / _LEVELS)


def _levels(
    vectors: Float[Tensor, "clusters vectors values"], steps: Float[Tensor, "clusters vectors"]
) -> Int16[Tensor, "clusters vectors"]:
    """Of the steps wanted, but no finer than 15 bits, and no coarser than zeroes a vector."""
    finest = full_scale(vectors, _VECTOR_BITS, dim=2)[..., 0]
    kept = torch.minimum(torch.maximum(steps, finest), finest * 2.0 ** (_VECTOR_BITS + 2))
    return torch.floor(-_LEVELS * torch.log2(kept)).to(torch.int16)


def _table(stream: Tensor, columns: int, order: Int[Tensor, "rows"]) -> Int[Tensor, "rows columns"]:
    """Rows in their own order, from columns of rows in another."""
    codes = decompress(stream, len(order) * columns, signed=True)
    table = torch.empty_like(codes).view(len(order), columns)
    table[order] = codes.view(columns, len(order)).mT
    return table


def _by_spread(
    labels: Int[Tensor, "points"], levels: Int16[Tensor, "clusters rank"]
) -> Int[Tensor, "vectors"]:
    """Vectors in falling order of the deviation of their weights, in whole levels."""
    sizes = cluster_sizes(labels, len(levels)).double().clamp_min(1.0)
    of_sizes = (0.5 * _LEVELS * torch.log2(sizes)).round().long()
    return (levels.long() - of_sizes[:, None]).flatten().argsort(descending=True, stable=True)


def _entries(
    labels: Int[Tensor, "points"], by_spread: Int[Tensor, "vectors"], rank: int
) -> Int[Tensor, "entries"]:
    """Weights in the order of their vectors, points in theirs within."""
    places = torch.empty_like(by_spread)
    places[by_spread] = torch.arange(len(by_spread), device=by_spread.device)
    owners = labels[:, None] * rank + torch.arange(rank, device=labels.device)
    return places[owners.flatten()].argsort(stable=True)
