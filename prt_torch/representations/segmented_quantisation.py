"""Segments' representatives and weights as multiples of steps.

The step of a segment's representatives is the largest at which quantisation adds a stated share to
the squared error of its CPCA. Each cluster's weights have the finest step that their bits allow.

Source:
    Liu, Sloan, Shum, Snyder 2004, section 5 (16-bit values and weights; no step is stated).
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.metric import Metric
from prt_torch.quantize import dequantize, full_scale, quantize
from prt_torch.representations.segmented_encoding import FIRST, RAW, SegmentEncoding

_SEARCH_STEPS = 12
_CLOSE = 0.95  # share of the error allowed that is worth no further search


@dataclass(frozen=True)
class Encoding:
    """Segments one after the other, with the steps of their codes.

    Attributes:
        labels: Of each point in each segment (see ``SegmentEncoding``).
        ranks: Vectors of each cluster.
        clusters: How many each segment has.
        representatives: ``"vectors channels rows coeffs"``, of the coefficients of a segment.
        weights: One segment after the other, one point after the other within.
        representative_steps: Of each segment, float64.
        weight_steps: Of each cluster, in the type of the values.
        bits: Of a code, with its sign.
        condition: Of the worst cluster.
    """

    labels: Int[Tensor, "segments points"]
    ranks: Int[Tensor, "clusters"]
    clusters: Int[Tensor, "segments"]
    representatives: Float[Tensor, "vectors channels rows coeffs"]
    weights: Float[Tensor, "entries"]
    representative_steps: Float[Tensor, "segments"]
    weight_steps: Float[Tensor, "clusters"]
    bits: int
    condition: float

    @property
    def vectors(self) -> Int[Tensor, "segments"]:
        """How many representatives each segment has."""
        places = torch.arange(len(self.clusters), device=self.ranks.device)
        owner = places.repeat_interleave(self.clusters)
        own = torch.zeros_like(places).index_add_(0, owner, self.ranks)
        return own + (self.labels == RAW).sum(1)

    @property
    def vector_steps(self) -> Float[Tensor, "vectors 1 1 1"]:
        """Step of each representative."""
        return self.representative_steps.repeat_interleave(self.vectors)[:, None, None, None]

    @property
    def clusters_of_entries(self) -> Int[Tensor, "entries"]:
        """Which cluster each weight belongs to."""
        first = self.clusters.cumsum(0) - self.clusters
        own = (self.labels.long() - FIRST + first[:, None])[self.labels >= FIRST]
        return own.repeat_interleave(self.ranks[own])

    @property
    def entry_steps(self) -> Float[Tensor, "entries"]:
        """Step of each weight."""
        return self.weight_steps[self.clusters_of_entries]

    def rounded(self) -> "Encoding":
        """The same with values at the multiples of their steps."""
        vectors, entries = self.vector_steps, self.entry_steps
        codes = quantize(self.representatives, vectors, self.bits)
        weights = quantize(self.weights, entries, self.bits)
        return replace(
            self,
            representatives=dequantize(codes, vectors, self.representatives.dtype),
            weights=dequantize(weights, entries, self.weights.dtype),
        )


def quantise_segment(
    encoding: SegmentEncoding, metric: Metric, share: float, bits: int
) -> Encoding:
    """One segment with the steps that add at most a share of its squared error.

    Args:
        encoding: The segment.
        metric: Of the segment.
        share: Of its squared error.
        bits: Of a code, with its sign.
    """
    unquantised = Encoding(
        labels=encoding.labels[None],
        ranks=encoding.ranks,
        clusters=torch.tensor([len(encoding.ranks)], device=encoding.ranks.device),
        representatives=encoding.representatives,
        weights=encoding.weights,
        representative_steps=torch.zeros(1, dtype=torch.float64, device=encoding.ranks.device),
        weight_steps=encoding.weights.new_ones(len(encoding.ranks)),
        bits=bits,
        condition=encoding.condition,
    )
    allowed = share * encoding.squared_error
    step = quantisation_step(encoding.representatives, metric, allowed, bits)
    return replace(
        unquantised,
        representative_steps=torch.full_like(unquantised.representative_steps, step),
        weight_steps=weight_steps(
            encoding.weights, unquantised.clusters_of_entries, len(encoding.ranks), bits
        ),
    ).rounded()


def join(segments: list[Encoding]) -> Encoding:
    """Segments one after the other."""

    def together(name: str) -> Tensor:
        return torch.cat([getattr(segment, name) for segment in segments])

    return Encoding(
        labels=together("labels"),
        ranks=together("ranks"),
        clusters=together("clusters"),
        representatives=together("representatives"),
        weights=together("weights"),
        representative_steps=together("representative_steps"),
        weight_steps=together("weight_steps"),
        bits=segments[0].bits,
        condition=max(segment.condition for segment in segments),
    )


def quantisation_step(
    representatives: Float[Tensor, "vectors channels rows coeffs"],
    metric: Metric,
    allowed_error: float,
    bits: int,
) -> float:
    """The largest step that adds no more than a squared error in the metric.

    At least the one that ``bits`` allow for the largest value. Vectors must be scaled so that
    their squared error is that of the points (:mod:`segmented_encoding` says how).
    """
    finest = float(full_scale(representatives, bits))
    if representatives.numel() == 0 or allowed_error == 0.0:
        return finest
    # Scaled, so that squares of tiny and huge signals stay in range.
    scale = float(representatives.abs().max()) or 1.0
    values, allowed = representatives / scale, allowed_error / scale / scale
    best = least = finest / scale
    # Uniform rounding loses step²/12 a value; zeroed values lose less than that.
    step = max(least, (12.0 * allowed / values.numel()) ** 0.5)
    for _ in range(_SEARCH_STEPS):
        rounded = dequantize(quantize(values, step, bits), step, values.dtype)
        error = float(metric.weigh(rounded - values).square().sum(dtype=torch.float64))
        best = max(best, step) if error <= allowed else best
        if _CLOSE * allowed <= error <= allowed or error == 0.0:
            break
        nearer = max(least, step * (0.99 * allowed / error) ** 0.5)
        if nearer == step:
            break
        step = nearer
    return best * scale


def weight_steps(
    weights: Float[Tensor, "entries"],
    clusters: Int[Tensor, "entries"],
    num_clusters: int,
    bits: int,
) -> Float[Tensor, "clusters"]:
    """The least step of each cluster at which none of its weights is clamped, in their type."""
    largest = weights.new_zeros(num_clusters).scatter_reduce(0, clusters, weights.abs(), "amax")
    # Rounded up: a step rounded down would clamp the largest weight.
    return full_scale(largest[:, None], bits, dim=1)[:, 0].to(weights).mul(1 + 1e-6)
