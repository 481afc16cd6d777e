"""Microfacets of the GGX (Trowbridge-Reitz) distribution with Smith masking."""

from dataclasses import dataclass
from typing import ClassVar

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
    ggx_distribution,
    ggx_slant,
    half_vector,
    schlick_fresnel,
)


@dataclass(frozen=True)
class GGX(AnalyticBRDF):
    r"""GGX with height-correlated Smith masking and shadowing, single scattering.

    .. math:: f = \frac{F\, D\, G_2}{4 (n \cdot \omega_i)(n \cdot \omega_o)}, \qquad
        G_2 = \frac{1}{1 + \Lambda(\omega_i) + \Lambda(\omega_o)}

    The albedo is at most 1; what several bounces between facets would return is lost: with f0 = 1
    at normal incidence 1.2 % at roughness 0.1, 69 % (1 - ln 2 remains) at roughness 1.

    Args:
        f0: Reflectance of a facet at normal incidence, 0 to 1.
        roughness: :math:`\alpha` (not its square root), 1e-4 to 10; or two numbers,
            :math:`\alpha_x` along the tangent and :math:`\alpha_y` along the bitangent.

    Raises:
        ValueError: If a parameter is out of range.

    Source:
        :cite:`walter2007microfacet`, equations 20 and 33 (D); :cite:`heitz2014masking`, equation
        99 (G₂); :cite:`schlick1994inexpensive` (F).
    """

    f0: Colour
    roughness: float | tuple[float, float]
    name: ClassVar[str] = "ggx"

    def __post_init__(self):
        object.__setattr__(self, "f0", check_colour("f0", self.f0))
        object.__setattr__(self, "roughness", _check_roughness(self.roughness))

    @property
    def roughness_x(self) -> float:
        """Along the tangent."""
        return self.roughness[0] if isinstance(self.roughness, tuple) else self.roughness

    @property
    def roughness_y(self) -> float:
        """Along the bitangent."""
        return self.roughness[1] if isinstance(self.roughness, tuple) else self.roughness

    def _evaluate_above(
        self, wi: Float[Tensor, "*batch 3"], wo: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch channels"]:
        half, cosine = half_vector(wi, wo)
        x, y = self.roughness_x, self.roughness_y
        # G2 / (4 ci co) in one fraction: 1 + Λ = (1 + s / c) / 2 for either direction.
        sides = wi[..., 2] * ggx_slant(wo, x, y) + wo[..., 2] * ggx_slant(wi, x, y)
        shape = ggx_distribution(half, x, y) / (2.0 * sides)
        f0 = colour_tensor(self.f0, self.num_channels, wi)
        return shape[..., None] * schlick_fresnel(f0, cosine)

    @property
    def num_channels(self) -> int:
        """3 if f0 is not grey."""
        return count_channels(self.f0)

    @property
    def isotropic(self) -> bool:
        """Whether both roughnesses are equal."""
        return self.roughness_x == self.roughness_y


def _check_roughness(value: object) -> float | tuple[float, float]:
    if not isinstance(value, (tuple, list)):
        return check_number("roughness", value, 1e-4, 10.0)
    if len(value) != 2:
        raise ValueError(f"roughness: expected one number or two, got {value!r}")
    along, across = (check_number("roughness", item, 1e-4, 10.0) for item in value)
    return along, across
