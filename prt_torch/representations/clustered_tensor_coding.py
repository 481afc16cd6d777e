"""Bases and weights of clustered tensors as integer codes: what a file holds.

Each number is a code of 16 bits times a step. Steps are those of a column of a view basis, of a
vector of a cluster's light, of a vector of its points, and of its points' weights of that vector,
so that vectors of little energy keep their digits beside strong ones.

Source:
    Tsai, Shih 2006, section 7 (16 bits; no steps are stated).
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
from prt_torch.representations.points import SLICE, slices
from prt_torch.representations.processes import ALONE, Processes
from prt_torch.representations.segmented_quantisation import weight_steps

BITS = 16


@dataclass(frozen=True)
class Parameters:
    """The numbers of a clustered tensor.

    Attributes:
        view_basis: Of each group, shared by its clusters.
        light_bases: One vector a row.
        cores: The dual bases.
        weights: Of every point in its own cluster.
    """

    view_basis: Float[Tensor, "groups rows view"]
    light_bases: Float[Tensor, "clusters light coeffs"]
    cores: Float[Tensor, "clusters rank view light"]
    weights: Float[Tensor, "points rank"]

    @classmethod
    def names(cls) -> list[str]:
        """Of the four parts."""
        return ["view_basis", "light_bases", "cores", "weights"]


@dataclass(frozen=True)
class Steps:
    """Steps of the codes, in the type of the values."""

    view_basis: Float[Tensor, "groups 1 view"]
    light_bases: Float[Tensor, "clusters light 1"]
    cores: Float[Tensor, "clusters rank 1 1"]
    weights: Float[Tensor, "clusters rank"]

    @classmethod
    def at_full_scale(
        cls,
        parameters: Parameters,
        labels: Int[Tensor, "points"],
        processes: Processes = ALONE,
    ) -> "Steps":
        """The finest at which no value is clamped, whatever process it is on."""
        clusters, rank = parameters.cores.shape[:2]
        largest = parameters.weights.new_zeros(clusters, rank)
        for some in slices(len(labels), max(1, SLICE // rank)):
            magnitudes = parameters.weights[some].abs()
            entries = labels[some, None].expand(-1, rank)
            largest.scatter_reduce_(0, entries, magnitudes, "amax")
        every = torch.arange(clusters * rank, device=labels.device)
        flat = weight_steps(processes.largest(largest).flatten(), every, clusters * rank, BITS)
        return cls(
            view_basis=_full_scale(parameters.view_basis, (1,)),
            light_bases=_full_scale(parameters.light_bases, (2,)),
            cores=_full_scale(parameters.cores, (2, 3)),
            weights=flat.view(clusters, rank),
        )

    def by_value(self, labels: Int[Tensor, "points"]) -> dict[str, Tensor]:
        """Steps that broadcast to the parameters of these names."""
        steps = {name: getattr(self, name) for name in Parameters.names()}
        return {**steps, "weights": self.weights[labels]}


def _full_scale(values: Tensor, dims: tuple[int, ...]) -> Tensor:
    return rounded_up(full_scale(values, BITS, dim=dims), values.dtype)


@dataclass(frozen=True)
class Encoding:
    """A clustered tensor.

    Attributes:
        labels: Cluster of each point, clusters numbered from the largest to the smallest.
        groups: Group of each cluster: points of one material, with a view basis of their own.
        parameters: Bases and weights.
        steps: Of their codes; None where they are kept as they are.
        condition: Of the worst cluster.
    """

    labels: Int[Tensor, "points"]
    groups: Int[Tensor, "clusters"]
    parameters: Parameters
    steps: Steps | None
    condition: float

    def coded(self, processes: Processes = ALONE) -> "Encoding":
        """With the finest steps, values at multiples of them; weights are rounded in place.

        Args:
            processes: Those that have points too.
        """
        steps = Steps.at_full_scale(self.parameters, self.labels, processes)
        return replace(self, steps=steps)._rounded(self.parameters.weights)

    def rounded(self) -> "Encoding":
        """The same with values at the multiples of their steps, if there are steps."""
        return self._rounded(torch.empty_like(self.parameters.weights))

    def _rounded(self, weights: Float[Tensor, "points rank"]) -> "Encoding":
        """The same, with room for the weights."""
        steps, own = self.steps, self.parameters
        if steps is None:
            return self
        for some in slices(len(weights), max(1, SLICE // weights.shape[1])):
            weights[some] = _at_multiples(own.weights[some], steps.weights[self.labels[some]])
        values = {
            name: _at_multiples(getattr(own, name), getattr(steps, name))
            for name in Parameters.names()
            if name != "weights"
        }
        return replace(self, parameters=Parameters(**values, weights=weights))

    def straight_through(self) -> Parameters:
        """The same values, whose gradients pass as if nothing were rounded."""
        if self.steps is None:
            return self.parameters
        pairs = self._pairs(self.steps).items()
        values = {name: straight_through(own, step, BITS) for name, (own, step) in pairs}
        return Parameters(**values)

    def _pairs(self, steps: Steps) -> dict[str, tuple[Tensor, Tensor]]:
        """Each parameter with its steps."""
        by_value = steps.by_value(self.labels)
        return {name: (getattr(self.parameters, name), step) for name, step in by_value.items()}


def _at_multiples(values: Tensor, step: Tensor) -> Tensor:
    """The nearest values that codes can have."""
    return dequantize(quantize(values, step, BITS), step, values.dtype)


def pack(encoding: Encoding) -> dict[str, Tensor]:
    """What a file holds.

    ``labels`` in the least whole bytes, ``groups`` likewise if there are several, and of each of
    ``view_basis``, ``light_bases``, ``cores`` and ``weights`` either the values, or ``_codes`` and
    ``_steps``.
    """
    clusters = len(encoding.parameters.cores)
    packed = {"labels": least_unsigned(encoding.labels, clusters - 1)}
    parameters, num_groups = encoding.parameters, len(encoding.parameters.view_basis)
    if num_groups > 1:
        packed["groups"] = least_unsigned(encoding.groups, num_groups - 1)
    if encoding.steps is None:
        return packed | {n: getattr(parameters, n).detach().clone() for n in Parameters.names()}
    steps = encoding.steps.by_value(encoding.labels)
    for name in Parameters.names():
        packed[f"{name}_codes"] = quantize(getattr(parameters, name), steps[name], BITS)
        packed[f"{name}_steps"] = getattr(encoding.steps, name).clone()
    return packed


def unpack(packed: dict[str, Tensor]) -> Encoding:
    """The inverse of :func:`pack`."""
    labels, names = packed["labels"].long(), Parameters.names()
    if "weights" in packed:
        parameters = Parameters(**{name: packed[name].clone() for name in names})
        return Encoding(labels, _groups(packed, parameters), parameters, None, float("nan"))
    steps = Steps(**{name: packed[f"{name}_steps"] for name in names})
    values = {
        name: dequantize(packed[f"{name}_codes"], step, step.dtype)
        for name, step in steps.by_value(labels).items()
    }
    parameters = Parameters(**values)
    return Encoding(labels, _groups(packed, parameters), parameters, steps, float("nan"))


def _groups(packed: dict[str, Tensor], parameters: Parameters) -> Int[Tensor, "clusters"]:
    """Group of each cluster; a file of one group does not tell."""
    if "groups" in packed:
        return packed["groups"].long()
    return packed["labels"].new_zeros(len(parameters.cores), dtype=torch.int64)
