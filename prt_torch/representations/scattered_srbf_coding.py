"""Scattered functions and weights as integer codes: what a file holds.

A centre is two codes of 16 bits (``octahedron``); a bandwidth is one code of its logarithm, so that
it keeps as many digits whether wide or narrow. Weights have a step for each function of a cluster,
so that functions of little use keep their digits beside strong ones.

Source:
    Tsai, Shih 2006, section 7 (16 bits; no steps are stated). Codes of centres and bandwidths are
    ours.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.quantize import (
    dequantize,
    full_scale,
    least_unsigned,
    quantize,
    rounded_up,
    straight_through,
)
from prt_torch.representations.octahedron import BITS, from_octahedron, to_octahedron

_LOG_STEP = 2.0**-11  # of log bandwidths: 2.4e-4 of a bandwidth, from e^-16 to e^16


@dataclass(frozen=True)
class Parameters:
    """The numbers of scattered functions.

    Attributes:
        centers: Of each cluster's functions; of any length but zero.
        log_bandwidths: Logarithms of Gaussian bandwidths.
        weights: Of each point, for its own cluster's functions.
    """

    centers: Float[Tensor, "clusters n 3"]
    log_bandwidths: Float[Tensor, "clusters n"]
    weights: Float[Tensor, "points channels rows n"]

    @classmethod
    def names(cls) -> list[str]:
        """Of the three parts."""
        return ["centers", "log_bandwidths", "weights"]


@dataclass(frozen=True)
class ScatteredEncoding:
    """Clusters with functions.

    Attributes:
        labels: Cluster of each point, numbered from the largest to the smallest.
        parameters: Functions and weights.
        weight_steps: Of the weights' codes, in their type; None where all is kept as it is.
        resolution: Texels along an edge of a face at which functions are sampled.
        condition: Of the worst solve for weights.
    """

    labels: Int[Tensor, "points"]
    parameters: Parameters
    weight_steps: Float[Tensor, "clusters n"] | None
    resolution: int
    condition: float

    def coded(self) -> "ScatteredEncoding":
        """With the finest steps of weights, and all at what codes stand for."""
        weights, clusters = self.parameters.weights, len(self.parameters.centers)
        entries = self.labels[:, None].expand(-1, weights.shape[-1])
        largest = weights.new_zeros(clusters, weights.shape[-1])
        largest.scatter_reduce_(0, entries, weights.detach().abs().amax((1, 2)), "amax")
        steps = rounded_up(full_scale(largest, BITS, dim=()), weights.dtype)
        return replace(self, weight_steps=steps).rounded()

    def rounded(self) -> "ScatteredEncoding":
        """The same at what codes stand for, if there are codes."""
        steps = self._steps_of_points()
        if steps is None:
            return self
        own = self.parameters
        centers, log_bandwidths = rounded_functions(own.centers, own.log_bandwidths)
        weights = dequantize(quantize(own.weights, steps, BITS), steps, own.weights.dtype)
        return replace(self, parameters=Parameters(centers, log_bandwidths, weights))

    def straight_through(self) -> Parameters:
        """The same values as :meth:`rounded`, whose gradients pass as if nothing were rounded."""
        steps = self._steps_of_points()
        if steps is None:
            return self.parameters
        own = self.parameters
        to_code = (_on_codes(own.centers) - own.centers).detach()
        return Parameters(
            centers=own.centers + to_code,
            log_bandwidths=straight_through(own.log_bandwidths, _LOG_STEP, BITS),
            weights=straight_through(own.weights, steps, BITS),
        )

    def _steps_of_points(self) -> Float[Tensor, "points 1 1 n"] | None:
        return None if self.weight_steps is None else self.weight_steps[self.labels][:, None, None]


def rounded_functions(
    centers: Float[Tensor, "clusters n 3"], log_bandwidths: Float[Tensor, "clusters n"]
) -> tuple[Float[Tensor, "clusters n 3"], Float[Tensor, "clusters n"]]:
    """Unit centres and log bandwidths at the nearest codes."""
    codes = quantize(log_bandwidths, _LOG_STEP, BITS)
    return _on_codes(centers), dequantize(codes, _LOG_STEP, log_bandwidths.dtype)


def _on_codes(centers: Float[Tensor, "clusters n 3"]) -> Float[Tensor, "clusters n 3"]:
    return from_octahedron(to_octahedron(centers), centers.dtype)


def pack(encoding: ScatteredEncoding) -> dict[str, Tensor]:
    """What a file holds.

    ``labels`` in the least whole bytes, ``resolution``, and either ``centers``, ``log_bandwidths``
    and ``weights`` as they are, or ``center_codes``, ``bandwidth_codes``, ``weight_codes`` and
    ``weight_steps``.
    """
    own = encoding.parameters
    packed = {
        "labels": least_unsigned(encoding.labels, len(own.centers) - 1),
        "resolution": torch.tensor(encoding.resolution, dtype=torch.int32),
    }
    steps = encoding._steps_of_points()
    if encoding.weight_steps is None or steps is None:
        return packed | {n: getattr(own, n).detach().clone() for n in Parameters.names()}
    return packed | {
        "center_codes": to_octahedron(own.centers),
        "bandwidth_codes": quantize(own.log_bandwidths, _LOG_STEP, BITS),
        "weight_codes": quantize(own.weights, steps, BITS),
        "weight_steps": encoding.weight_steps.clone(),
    }


def unpack(packed: dict[str, Tensor]) -> ScatteredEncoding:
    """The inverse of :func:`pack`."""
    labels, resolution = packed["labels"].to(torch.int32).long(), int(packed["resolution"])
    if "weights" in packed:
        parameters = Parameters(**{name: packed[name] for name in Parameters.names()})
        return ScatteredEncoding(labels, parameters, None, resolution, float("nan"))
    steps = packed["weight_steps"]
    by_point = steps[labels][:, None, None]
    parameters = Parameters(
        centers=from_octahedron(packed["center_codes"], steps.dtype),
        log_bandwidths=dequantize(packed["bandwidth_codes"], _LOG_STEP, steps.dtype),
        weights=dequantize(packed["weight_codes"], by_point, steps.dtype),
    )
    return ScatteredEncoding(labels, parameters, steps, resolution, float("nan"))
