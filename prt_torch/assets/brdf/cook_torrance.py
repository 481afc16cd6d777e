"""Microfacets of Beckmann's distribution in V-shaped cavities."""

from dataclasses import dataclass
from typing import ClassVar, Literal

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
from prt_torch.assets.brdf.microfacet import (
    beckmann_distribution,
    dielectric_fresnel,
    half_vector,
    schlick_fresnel,
)


@dataclass(frozen=True)
class CookTorrance(AnalyticBRDF):
    r"""Cook and Torrance's specular reflection.

    .. math:: f = \frac{F\, D\, G}{4 (n \cdot \omega_i)(n \cdot \omega_o)}, \qquad
        G = \min\left(1, \frac{2 (n \cdot h)(n \cdot \omega_o)}{\omega_o \cdot h},
        \frac{2 (n \cdot h)(n \cdot \omega_i)}{\omega_i \cdot h}\right)

    D is normalised, :math:`\int D\,(n \cdot h)\,dh = 1`, and holds the only 1/π. The albedo is at
    most 1 for every parameter.

    Args:
        f0: Reflectance of a facet at normal incidence, 0 to 1; below 1 if ``fresnel="exact"``.
        roughness: m of Beckmann's distribution, 1e-4 to 10.
        fresnel: ``schlick``'s approximation, or ``exact`` for a dielectric.

    Raises:
        ValueError: If a parameter is out of range.

    Source:
        :cite:`cook1982reflectance`. As printed there, F D G / (π cos cos) with a D that lacks
        1/π, it is four times this and makes energy; the 1/4 follows from the measure of half
        vectors (:cite:`walter2007microfacet`, equation 20).
    """

    f0: Colour
    roughness: float
    fresnel: Literal["schlick", "exact"] = "schlick"
    name: ClassVar[str] = "cook_torrance"

    def __post_init__(self):
        object.__setattr__(self, "f0", check_colour("f0", self.f0))
        object.__setattr__(self, "roughness", check_number("roughness", self.roughness, 1e-4, 10.0))
        if self.fresnel not in ("schlick", "exact"):
            raise ValueError(f"fresnel: expected schlick or exact, got {self.fresnel!r}")
        highest = max(self.f0) if isinstance(self.f0, tuple) else self.f0
        if self.fresnel == "exact" and highest >= 1.0:
            raise ValueError(f"f0: expected less than 1 for fresnel=exact, got {self.f0!r}")

    def _evaluate_above(
        self, wi: Float[Tensor, "*batch 3"], wo: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch channels"]:
        half, cosine = half_vector(wi, wo)
        lower, upper = torch.minimum(wi[..., 2], wo[..., 2]), torch.maximum(wi[..., 2], wo[..., 2])
        # G / (4 ci co) with one cosine cancelled, so that nothing is lost near the horizon.
        geometry = torch.minimum(0.25 / (lower * upper), 0.5 * half[..., 2] / (upper * cosine))
        shape = beckmann_distribution(half, self.roughness) * geometry
        f0 = colour_tensor(self.f0, self.num_channels, wi)
        match self.fresnel:
            case "schlick":
                return shape[..., None] * schlick_fresnel(f0, cosine)
            case "exact":
                return shape[..., None] * dielectric_fresnel(f0, cosine)

    @property
    def num_channels(self) -> int:
        """3 if f0 is not grey."""
        return count_channels(self.f0)

    @property
    def isotropic(self) -> bool:
        """True."""
        return True
