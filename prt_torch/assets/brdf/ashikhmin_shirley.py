"""Ashikhmin and Shirley's anisotropic Phong model."""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.assets.brdf.base import (
    AnalyticBRDF,
    Colour,
    check_colour,
    check_number,
    colour_tensor,
    count_channels,
)
from prt_torch.assets.brdf.microfacet import half_vector, schlick_fresnel

_SERIES_LIMIT = 1e-3  # below it, six terms of log(1 - s) / s are exact to 1e-18


@dataclass(frozen=True)
class AshikhminShirley(AnalyticBRDF):
    r"""Anisotropic half-vector lobe with Fresnel, over a diffuse part that it dims.

    .. math:: f = \frac{\sqrt{(n_u + 1)(n_v + 1)}}{8\pi}
        \frac{(n \cdot h)^{n_u \cos^2\phi + n_v \sin^2\phi}}
        {(h \cdot \omega_i) \max(n \cdot \omega_i, n \cdot \omega_o)} F(h \cdot \omega_i)
        + \frac{28 R_d (1 - R_s)}{23\pi}
        \left(1 - (1 - \tfrac{n \cdot \omega_i}{2})^5\right)
        \left(1 - (1 - \tfrac{n \cdot \omega_o}{2})^5\right)

    The albedo of each part is at most 1.

    Args:
        specular: :math:`R_s`, reflectance at normal incidence, 0 to 1.
        diffuse: :math:`R_d`, 0 to 1.
        exponent_u: :math:`n_u`, along the tangent, at least 0.
        exponent_v: :math:`n_v`, along the bitangent, at least 0.

    Raises:
        ValueError: If a parameter is out of range.

    Source:
        :cite:`ashikhmin2000anisotropic`.
    """

    specular: Colour
    diffuse: Colour
    exponent_u: float
    exponent_v: float
    name: ClassVar[str] = "ashikhmin_shirley"

    def __post_init__(self):
        object.__setattr__(self, "specular", check_colour("specular", self.specular))
        object.__setattr__(self, "diffuse", check_colour("diffuse", self.diffuse))
        object.__setattr__(self, "exponent_u", check_number("exponent_u", self.exponent_u, 0.0))
        object.__setattr__(self, "exponent_v", check_number("exponent_v", self.exponent_v, 0.0))

    def _evaluate_above(
        self, wi: Float[Tensor, "*batch 3"], wo: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch channels"]:
        half, cosine = half_vector(wi, wo)
        x2, y2, _ = half.square().unbind(-1)
        exponent = 0.5 * (self.exponent_u * x2 + self.exponent_v * y2)
        scale = math.sqrt((self.exponent_u + 1.0) * (self.exponent_v + 1.0)) / (8.0 * math.pi)
        larger = torch.maximum(wi[..., 2], wo[..., 2])
        lobe = scale * torch.exp(exponent * _mean_log(half)) / (cosine * larger)
        specular = colour_tensor(self.specular, self.num_channels, wi)
        diffuse = colour_tensor(self.diffuse, self.num_channels, wi) * (1.0 - specular)
        entering = 1.0 - (1.0 - 0.5 * wi[..., 2]) ** 5
        leaving = 1.0 - (1.0 - 0.5 * wo[..., 2]) ** 5
        below = 28.0 / (23.0 * math.pi) * entering * leaving
        return lobe[..., None] * schlick_fresnel(specular, cosine) + below[..., None] * diffuse

    @property
    def num_channels(self) -> int:
        """3 if either colour is not grey."""
        return count_channels(self.specular, self.diffuse)

    @property
    def isotropic(self) -> bool:
        """Whether both exponents are equal."""
        return self.exponent_u == self.exponent_v


def _mean_log(half: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """``log(z²) / (1 - z²)`` of unit vectors, smooth at the normal, where it is -1."""
    s = half[..., :2].square().sum(-1)
    small = s < _SERIES_LIMIT
    series = -(1 + s * (1 / 2 + s * (1 / 3 + s * (1 / 4 + s * (1 / 5 + s * (1 / 6))))))
    away = torch.where(small, torch.ones_like(s), s)
    return torch.where(small, series, 2.0 * half[..., 2].log() / away)
