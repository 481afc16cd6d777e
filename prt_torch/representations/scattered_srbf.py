r"""Transfer as scattered spherical radial basis functions, whose places points of a cluster share.

The paper models only light with functions that may stand anywhere: fitted to each point's transfer
they would cost minutes a point, and light would have to meet every point's own functions at run
time. Here a cluster of points shares centres and bandwidths, and a point has weights,

.. math:: T_{p,r}(s) \approx \sum_k w_{p,r,k}\, G(s; \xi_{c(p),k}, \lambda_{c(p),k}),

so one fit serves a cluster and light meets its functions once. In a file a function of a cluster
costs six bytes whatever the resolution of the light, where a vector of a subspace costs as many
numbers as the light has coefficients. In memory it costs as much as that vector: in the light basis
of the transfer, functions become rows of a matrix "functions coeffs" by
:meth:`prt_torch.bases.LightBasis.project_cube`, which is kept while the module is at rest.

Source:
    Tsai, Shih 2006, section 5.3 for the fit; sections 5.1 and 8 name fitting it to transfer as
    future work. Shared centres are ours.
"""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from prt_torch.bases import EnvironmentFit, LightBasis, Radiance, fit_environment
from prt_torch.metric import Metric
from prt_torch.representations.base import CodedRepresentation
from prt_torch.representations.grouped import ClusterBlocks, sort_labels
from prt_torch.representations.products import matmul_few
from prt_torch.representations.scattered_srbf_coding import (
    BITS,
    Parameters,
    ScatteredEncoding,
    pack,
    unpack,
)
from prt_torch.representations.scattered_srbf_encoding import encode, in_light_basis
from prt_torch.transfer import Surface, TransferTensor


class ScatteredSRBF(CodedRepresentation):
    """Gaussians at free places, shared by clusters of points.

    Parameters are ``centers`` ``"clusters n 3"``, taken by their directions, ``log_bandwidths``
    ``"clusters n"``, so that bandwidths are positive, and ``weights``
    ``"points channels rows n"``.

    Args:
        encoding: Clusters, functions and weights.
        surface: Bases, frames and reflectance.
        shape: Points, channels, rows, coeffs.

    Attributes:
        labels: ``"points"``: cluster of each, clusters numbered from the largest to the smallest.
        bits: Of a code; None where parameters are kept as they are.
        resolution: Texels along an edge of a face at which functions are sampled.

    Raises:
        ValueError: If the surface has no light basis.
    """

    kind: ClassVar[str] = "scattered_srbf"
    places: ClassVar[tuple[str, ...]] = ("labels",)
    labels: Tensor
    centers: nn.Parameter
    log_bandwidths: nn.Parameter
    weights: nn.Parameter
    _weight_steps: Tensor | None
    _functions_at_rest: Tensor | None  # no buffer: processes that have not relit lack it

    def __init__(
        self, encoding: ScatteredEncoding, surface: Surface, shape: tuple[int, int, int, int]
    ):
        super().__init__(surface, shape)
        self._basis = _light_basis(surface)
        self.bits: Literal[16] | None = None if encoding.weight_steps is None else BITS
        self.resolution = encoding.resolution
        self._condition = encoding.condition
        self.blocks = ClusterBlocks(encoding.labels, len(encoding.parameters.centers))
        for name in Parameters.names():
            values = getattr(encoding.parameters, name).detach().clone()
            self.register_parameter(name, nn.Parameter(values))
        self.register_buffer("labels", encoding.labels)
        self.register_buffer("_weight_steps", encoding.weight_steps)
        self._rest()

    @staticmethod
    def fit_environment(
        environment: Radiance | Sequence[Radiance], num_functions: int = 162, **options: Any
    ) -> EnvironmentFit:
        """Scattered functions of light: :func:`prt_torch.bases.fit_environment`."""
        return fit_environment(environment, num_functions, **options)

    @classmethod
    def from_transfer(
        cls,
        transfer: TransferTensor,
        *,
        num_clusters: int = 64,
        num_functions: int = 32,
        resolution: int = 16,
        bits: Literal[16] | None = 16,
        memory_budget: int = 4 * 2**30,
        metric: Metric | None = None,
        generator: torch.Generator | None = None,
    ) -> "ScatteredSRBF":
        """Cluster the points by distance, fit each cluster's functions, solve for weights.

        Args:
            transfer: The tensor to stand for, in any light basis; read by blocks, three times.
            num_clusters: At least 1; fewer are made if there are fewer distinct points.
            num_functions: Of a cluster, at least 1. As many as light coefficients lose nothing,
                where the light basis resolves them.
            resolution: Texels along an edge of a face at which functions are sampled; raised to
                a multiple of the light basis' own.
            bits: Of a code; None keeps parameters as they are, for a lossless budget.
            memory_budget: Bytes for the points in their principal axes, and for the fit of
                clusters side by side.
            metric: What errors are worth; the L2 norm over light directions if not given. It
                decides clusters and weights; functions are fitted in L2 over the sphere.
            generator: Source of randomness; seed 0 if not given.

        Raises:
            ValueError: If an option is out of range, or the transfer has no light basis.
            InputError: If the fit of one cluster would take more than ``memory_budget``.
        """
        if num_clusters < 1 or num_functions < 1 or resolution < 2:
            raise ValueError(
                "expected at least 1 cluster, 1 function and 2 texels, got "
                f"{num_clusters}, {num_functions}, {resolution}"
            )
        if bits not in (BITS, None):
            raise ValueError(f"expected 16 bits or None, got {bits!r}")
        basis = _light_basis(transfer.surface)
        own = getattr(basis, "resolution", 1)  # of a basis of texels
        encoding = encode(
            transfer,
            basis,
            num_clusters=num_clusters,
            num_functions=num_functions,
            resolution=own * math.ceil(resolution / own),
            coded=bits is not None,
            memory_budget=memory_budget,
            metric=metric or Metric.l2(transfer),
            generator=generator or torch.Generator().manual_seed(0),
        )
        return cls(encoding, transfer.surface, tuple(transfer.values.shape))

    def _rounded(self) -> dict[str, Tensor]:
        rounded = self._encoding().rounded().parameters
        return {name: getattr(rounded, name) for name in Parameters.names()}

    def _rest(self) -> None:
        super()._rest()
        self._functions_at_rest = None

    def _encoding(self) -> ScatteredEncoding:
        parameters = Parameters(**{name: getattr(self, name) for name in Parameters.names()})
        steps, resolution = self._weight_steps, self.resolution
        return ScatteredEncoding(self.labels, parameters, steps, resolution, self._condition)

    def _values(self) -> tuple[Float[Tensor, "clusters n coeffs"], Tensor]:
        """Functions and weights as a file would hold them, while gradients refine them."""
        encoding, at_rest = self._encoding(), self._at_rest
        rounds = self.training and not at_rest
        values = encoding.straight_through() if rounds else encoding.parameters
        refined = values.centers.requires_grad or values.log_bandwidths.requires_grad
        if not at_rest or (refined and torch.is_grad_enabled()):
            return self._in_light_basis(values), values.weights
        kept, like = self._functions_at_rest, values.weights
        if kept is None or (kept.dtype, kept.device) != (like.dtype, like.device):
            with torch.inference_mode(False):  # so that gradients can pass through them later
                kept = self._in_light_basis(values).detach()
            self._functions_at_rest = kept
        return kept, values.weights

    def _in_light_basis(self, values: Parameters) -> Float[Tensor, "clusters n coeffs"]:
        return in_light_basis(self._basis, values.centers, values.log_bandwidths, self.resolution)

    @property
    def bandwidths(self) -> Float[Tensor, "clusters n"]:
        """Of the Gaussians."""
        return self.log_bandwidths.exp()

    def functions(self) -> Float[Tensor, "clusters n coeffs"]:
        """Every cluster's Gaussians as expansion coefficients of the light basis."""
        return self._values()[0]

    def forward(
        self, light: Float[Tensor, "batch *points coeffs rgb"], frames: Tensor | None = None
    ) -> Float[Tensor, "batch points rows rgb"]:
        """Light each cluster's functions, then mix them for each point.

        Autocast is switched off: weights of functions that overlap cancel, and bfloat16 would lose
        a further digit to that.

        Raises:
            ValueError: If shapes do not fit, or ``frames`` are given.
        """
        if frames is not None:
            raise ValueError("scattered functions are fixed to the rest pose and cannot be posed")
        local = self._check_light(light)
        with torch.autocast(light.device.type, enabled=False):
            return self._relit(light.to(self.weights.dtype), local)

    def _relit(self, light: Tensor, local: bool) -> Float[Tensor, "batch points rows rgb"]:
        """Radiance in the exit basis under distant light, or each point's own."""
        functions, weights = self._values()
        weights = self.blocks.to_slots(weights)  # slots channels rows n
        if local:
            by_point = self.blocks.to_slots(light.permute(1, 3, 0, 2))  # slots rgb batch coeffs
            lit = self.blocks.matmul(by_point, functions.mT)
            mixed = torch.einsum("scbn,scrn->srcb", lit, weights.expand(-1, 3, -1, -1))
        else:
            columns = light.permute(1, 2, 0).flatten(1)  # coeffs, rgb * batch
            lit = matmul_few(functions.flatten(0, 1), columns)
            mixed = self._mixed(weights, lit.view(*functions.shape[:2], 3, -1))
        return self.blocks.to_points(mixed).permute(3, 0, 1, 2)

    def _mixed(
        self,
        weights: Float[Tensor, "slots channels rows n"],
        lit: Float[Tensor, "clusters n rgb batch"],
    ) -> Float[Tensor, "slots rows rgb batch"]:
        """Weighted sums of lit functions; of three channels, each colour has its own."""
        if self.num_channels == 1:
            return self.blocks.matmul(weights[:, 0], lit.flatten(2)).unflatten(-1, (3, -1))
        colours = zip(weights.unbind(1), lit.unbind(2), strict=True)
        return torch.stack([self.blocks.matmul(some, own) for some, own in colours], dim=2)

    def dense(self, points: Tensor | None = None) -> Float[Tensor, "points channels rows coeffs"]:
        """Weighted functions of each point, in the light basis."""
        functions, weights = self._values()
        blocks = self.blocks
        if points is not None:
            labels, old = sort_labels(self.labels[points], len(functions))
            blocks = ClusterBlocks(labels, len(functions))
            functions, weights = functions[old], weights[points]
        return blocks.to_points(blocks.matmul(blocks.to_slots(weights), functions))

    def packed(self) -> dict[str, Tensor]:
        """Codes or parameters, labels, resolution (:func:`scattered_srbf_coding.pack`)."""
        return pack(self._encoding())

    @classmethod
    def from_packed(
        cls, packed: dict[str, Tensor], surface: Surface, shape: tuple[int, int, int, int]
    ) -> "ScatteredSRBF":
        """The inverse of :meth:`packed`."""
        return cls(unpack(packed), surface, shape)

    @property
    def budget(self) -> dict[str, Any]:
        """Clusters, and functions of each."""
        clusters, functions, _ = self.centers.shape
        return {"num_clusters": clusters, "num_functions": functions}

    @property
    def condition(self) -> float:
        """Of the worst cluster's solve for weights, below the cut-off; NaN if loaded."""
        return self._condition


def _light_basis(surface: Surface) -> LightBasis:
    if surface.light_basis is None:
        raise ValueError("expected transfer with a light basis for scattered functions, got none")
    return surface.light_basis
