r"""CPCA as integer codes: one step for everything, and no more bits than numbers have to say.

An error counts in the metric, in which a cluster's vectors are orthonormal and weights are
coordinates. At few bits what rounding adds is the same, :math:`\Delta^2 / 12` a number, however
large the number, so one step for all weights of all clusters spends bits where they gain most. An
error of a vector is multiplied by its weights, over all points of its cluster, so a vector of
singular value S has the step :math:`\Delta / S`, and a mean of n points :math:`\Delta / \sqrt n`:
points and vectors are then treated alike. A component of deviation s takes about
:math:`\log_2(s / \Delta) + 2` bits, and one that holds less than its codes would cost is left out:
ranks adapt by themselves, and many vectors in coarse codes beat few in fine ones.

Codes are compressed to about their entropy (:func:`prt_torch.quantize.compress`), components of
like deviation side by side. Neighbouring points lie near each other in most meshes, which the coder
finds out by itself, most of all in the labels.

Source:
    Ours; the allocation is that of transform coding (Gersho, Gray 1992, "Vector quantization and
    signal compression", section 8.3), the one step that of uniform quantisation at equal slope.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int, Int16
from torch import Tensor

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
from prt_torch.representations.cpca_encoding import Encoding
from prt_torch.representations.cpca_layout import entry_vectors
from prt_torch.representations.points import cluster_sizes
from prt_torch.representations.processes import ALONE, Processes
from prt_torch.transfer import Surface

_LEVELS = 4  # of an octave: finer ones would gain nothing
_VECTOR_BITS, _WEIGHT_BITS = 15, 16  # at most: float32 tells such codes apart in any metric
_TINY = torch.finfo(torch.float64).tiny
_WORTH = 2.0  # times the squared noise of a component's codes: what these cost, noise included


@dataclass(frozen=True)
class Coding:
    """What turns codes into values.

    Attributes:
        step: Of all weights, float64.
        levels: Of each vector: its step is 2^(-level / 4), in the metric.
        metric: In which vectors are coded.
    """

    step: Float[Tensor, ""]
    levels: Int16[Tensor, "vectors"]
    metric: Metric

    @property
    def vector_steps(self) -> Float[Tensor, "vectors 1 1 1"]:
        """Of each mean and vector."""
        return torch.exp2(-self.levels.double() / _LEVELS)[:, None, None, None]

    def vector_codes(
        self, vectors: Float[Tensor, "vectors channels rows coeffs"]
    ) -> Int[Tensor, "vectors values"]:
        """Codes of means and vectors."""
        weighed = self.metric.weigh(vectors.detach().double())
        return quantize(weighed, self.vector_steps, _VECTOR_BITS + 2).flatten(1)

    def vectors_at(
        self, codes: Int[Tensor, "vectors channels rows coeffs"], dtype: torch.dtype
    ) -> Float[Tensor, "vectors channels rows coeffs"]:
        """What codes of means and vectors stand for."""
        values = dequantize(codes, self.vector_steps, torch.float64)
        return self.metric.unweigh(values).to(dtype).contiguous()

    def weight_codes(self, weights: Float[Tensor, "entries"]) -> Int16[Tensor, "entries"]:
        """Codes of weights."""
        return quantize(weights, self.step, _WEIGHT_BITS)

    def rounded(
        self,
        vectors: Float[Tensor, "vectors channels rows coeffs"],
        weights: Float[Tensor, "entries"],
    ) -> tuple[Float[Tensor, "vectors channels rows coeffs"], Float[Tensor, "entries"]]:
        """Both at what their codes stand for."""
        codes = self.vector_codes(vectors).view(vectors.shape)
        at_codes = dequantize(self.weight_codes(weights), self.step, weights.dtype)
        return self.vectors_at(codes, vectors.dtype), at_codes

    def straight_through(
        self,
        vectors: Float[Tensor, "vectors channels rows coeffs"],
        weights: Float[Tensor, "entries"],
    ) -> tuple[Float[Tensor, "vectors channels rows coeffs"], Float[Tensor, "entries"]]:
        """The same values, whose gradients pass as if nothing were rounded."""
        weighed = self.metric.weigh(vectors.double())
        coded = straight_through(weighed, self.vector_steps, _VECTOR_BITS + 2)
        passed = straight_through(weights, self.step, _WEIGHT_BITS)
        return self.metric.unweigh(coded).to(vectors.dtype).contiguous(), passed


def coded(
    encoding: Encoding,
    shape: tuple[int, int, int],
    squared_error: float,
    *,
    share: float,
    metric: Metric,
    processes: Processes = ALONE,
) -> tuple[Encoding, Coding]:
    """An encoding without the components that are not worth their codes, and steps for the rest.

    Args:
        encoding: As its closed form left it: vectors orthonormal in the metric.
        shape: Channels, rows and coefficients of a vector.
        squared_error: Of the encoding in the metric, over the points of all processes.
        share: Of that, which codes may add: about as much as they do where most codes are not
            zero, less where they are.
        metric: What errors are worth.
        processes: Those that have points too.
    """
    owners = entry_vectors(encoding.labels, encoding.ranks, encoding.affine)
    squares = torch.zeros(len(encoding.representatives) + 1, dtype=torch.float64).to(owners.device)
    squares.index_add_(0, owners, encoding.weights.double().square())
    squares[-1] = len(encoding.weights)
    squares = processes.sum(squares)
    numbers = encoding.representatives.numel() + float(squares[-1])
    wanted = (12.0 * share * squared_error / max(numbers, 1.0)) ** 0.5
    largest = torch.zeros(1, dtype=torch.float64, device=owners.device)
    largest[0] = encoding.weights.abs().max() if len(encoding.weights) else 0.0
    largest = processes.largest(largest)
    # Weights that are all zero need no step, and must not make those of the means coarse.
    step = torch.where(largest > 0, full_scale(largest, _WEIGHT_BITS), _TINY).clamp_min(wanted)[0]
    sizes = cluster_sizes(encoding.labels, len(encoding.ranks), processes)
    runs = encoding.ranks + int(encoding.affine)
    counts = sizes.repeat_interleave(runs).double()
    means = _means(runs, encoding.affine)
    amplified = torch.where(means, counts, squares[:-1])
    noise = (counts + encoding.representatives.shape[1]) * step.square() / 12.0
    kept = means | (squares[:-1] > _WORTH * noise)
    weighed = metric.weigh(encoding.representatives.double().unflatten(1, shape))
    finest = full_scale(weighed, _VECTOR_BITS, dim=(1, 2, 3)).flatten()
    steps = torch.maximum(finest, step / amplified.sqrt())[kept]
    clusters = torch.arange(len(runs), device=owners.device).repeat_interleave(runs)
    ranks = torch.zeros_like(encoding.ranks).index_add_(0, clusters, (kept & ~means).long())
    levels = torch.floor(-_LEVELS * torch.log2(steps)).to(torch.int16)
    cut = replace(
        encoding,
        ranks=ranks,
        representatives=encoding.representatives[kept],
        weights=encoding.weights[kept[owners]],
    )
    return cut, Coding(step, levels, metric)


def pack(
    encoding: Encoding, coding: Coding | None, shape: tuple[int, int, int]
) -> dict[str, Tensor]:
    """What a file holds.

    Numbers as they are: ``labels`` in the least whole bytes, ``representatives`` and ``weights``.
    Where all ranks are the same, representatives are ``"clusters vectors channels rows coeffs"``
    and weights ``"points rank"``: the shapes tell the rank and whether there are means. Where they
    differ, both are flat and ``ranks`` stands beside them.

    Codes: ``step`` and ``levels`` (:class:`Coding`), ``ranks``; ``label_stream``,
    ``vector_stream`` and ``weight_stream``, compressed; and ``light_factor``, the lower triangle of
    a light prior, row by row.

    Args:
        encoding: All numbers.
        coding: Steps of codes; None for numbers as they are.
        shape: Channels, rows and coefficients of a vector.
    """
    vectors = encoding.representatives.unflatten(1, shape)
    ranks = least_unsigned(encoding.ranks, int(encoding.ranks.max()))
    if coding is None:
        labels = least_unsigned(encoding.labels, len(ranks) - 1)
        plain = {"representatives": vectors, "weights": encoding.weights, "labels": labels}
        if int(encoding.ranks.min()) != int(encoding.ranks.max()):
            return {**plain, "ranks": ranks}
        plain["representatives"] = vectors.unflatten(0, (len(ranks), -1))
        plain["weights"] = encoding.weights.view(len(labels), int(encoding.ranks.max()))
        return plain
    by_spread = _by_spread(encoding.labels, encoding.ranks, encoding.affine, coding.levels)
    return {
        "step": coding.step.clone(),
        "levels": coding.levels.clone(),
        "ranks": ranks,
        "label_stream": compress(encoding.labels, signed=False),
        "vector_stream": compress(coding.vector_codes(vectors)[by_spread].mT, signed=True),
        "weight_stream": compress(
            coding.weight_codes(encoding.weights)[_entries(encoding, by_spread)], signed=True
        ),
        **coding.metric.to_file(),
    }


def unpack(
    packed: dict[str, Tensor], surface: Surface, shape: tuple[int, int, int, int]
) -> tuple[Encoding, Coding | None]:
    """The inverse of :func:`pack`."""
    if "weights" in packed:
        return _unpacked_numbers(packed), None
    points, *own_shape = shape
    ranks, levels = packed["ranks"].long(), packed["levels"]
    affine = len(levels) > int(ranks.sum())
    labels = decompress(packed["label_stream"], points, signed=False)
    values = own_shape[0] * own_shape[1] * own_shape[2]
    codes = decompress(packed["vector_stream"], len(levels) * values, signed=True)
    by_spread = _by_spread(labels, ranks, affine, levels)
    vector_codes = torch.empty_like(codes).view(len(levels), values)
    vector_codes[by_spread] = codes.view(values, len(levels)).mT
    metric = Metric.from_file(packed, surface.light_basis, surface.exit_basis)
    coding = Coding(packed["step"], levels, metric)
    dtype = surface.reflectance.dtype
    vectors = coding.vectors_at(vector_codes.view(-1, *own_shape), dtype).flatten(1)
    empty = Encoding(labels, ranks, vectors, vectors.new_zeros(0), affine, float("nan"))
    weight_codes = decompress(packed["weight_stream"], int(ranks[labels].sum()), signed=True)
    weights = torch.empty(len(weight_codes), dtype=dtype, device=levels.device)
    weights[_entries(empty, by_spread)] = dequantize(weight_codes, coding.step, dtype)
    return replace(empty, weights=weights), coding


def _unpacked_numbers(packed: dict[str, Tensor]) -> Encoding:
    """The inverse of :func:`pack` for numbers as they are."""
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
    return Encoding(
        labels=labels,
        ranks=ranks,
        representatives=representatives.flatten(1),
        weights=weights.flatten().clone(),
        affine=means > 0,
        condition=float("nan"),
    )


def _means(runs: Int[Tensor, "clusters"], affine: bool) -> Bool[Tensor, "vectors"]:
    """Which of the clusters' vectors are their means."""
    means = torch.zeros(int(runs.sum()), dtype=torch.bool, device=runs.device)
    if affine:
        means[runs.cumsum(0) - runs] = True
    return means


def _by_spread(
    labels: Int[Tensor, "points"],
    ranks: Int[Tensor, "clusters"],
    affine: bool,
    levels: Int16[Tensor, "vectors"],
) -> Int[Tensor, "vectors"]:
    """Vectors in falling order of the deviation of their weights, in whole levels.

    Whole numbers only, so that every machine finds the same order.
    """
    sizes = cluster_sizes(labels, len(ranks)).repeat_interleave(ranks + int(affine))
    of_sizes = (0.5 * _LEVELS * torch.log2(sizes.double().clamp_min(1.0))).round().long()
    return torch.argsort(levels.long() - of_sizes, descending=True, stable=True)


def _entries(encoding: Encoding, by_spread: Int[Tensor, "vectors"]) -> Int[Tensor, "entries"]:
    """Weights in the order of their vectors, points in theirs within."""
    places = torch.empty_like(by_spread)
    places[by_spread] = torch.arange(len(by_spread), device=by_spread.device)
    owners = entry_vectors(encoding.labels, encoding.ranks, encoding.affine)
    return torch.argsort(places[owners], stable=True)
