r"""Cosine lobes about the mirror direction (Phong) and about the normal (Blinn-Phong).

Both are the reciprocal forms, without a division by the cosine of the light.
"""

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
from prt_torch.assets.brdf.microfacet import half_vector

_LEAST_BASE = 1e-7  # keeps the derivative of powers below 1 finite


def cosine_power(cosine: Float[Tensor, "*batch"], exponent: float) -> Float[Tensor, "*batch"]:
    """``max(cosine, 0) ** exponent``, zero at and below zero for every exponent."""
    power = cosine.clamp(min=_LEAST_BASE) ** exponent
    return torch.where(cosine > 0, power, torch.zeros_like(power))


@dataclass(frozen=True)
class Phong(AnalyticBRDF):
    r"""Modified Phong lobe, :math:`f = k_s \frac{n + 2}{2\pi} \cos^n \alpha`.

    :math:`\alpha` is the angle between the light and the mirror image of the viewer. The albedo is
    exactly ``specular`` at normal incidence and less at every other angle, where the lobe loses
    what falls below the horizon.

    Args:
        specular: Albedo at normal incidence, 0 to 1.
        exponent: n, at least 0.

    Raises:
        ValueError: If a parameter is out of range.

    Source:
        :cite:`lafortune1994phong`, the specular part; add a :class:`Lambert` for the diffuse one.
    """

    specular: Colour
    exponent: float
    name: ClassVar[str] = "phong"

    def __post_init__(self):
        object.__setattr__(self, "specular", check_colour("specular", self.specular))
        object.__setattr__(self, "exponent", check_number("exponent", self.exponent, 0.0))

    def _evaluate_above(
        self, wi: Float[Tensor, "*batch 3"], wo: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch channels"]:
        both = wi * wo
        lobe = cosine_power(both[..., 2] - both[..., 0] - both[..., 1], self.exponent)
        scale = (self.exponent + 2.0) / (2.0 * math.pi)
        return scale * lobe[..., None] * colour_tensor(self.specular, self.num_channels, wi)

    @property
    def num_channels(self) -> int:
        """3 if the specular colour is not grey."""
        return count_channels(self.specular)

    @property
    def isotropic(self) -> bool:
        """True."""
        return True


@dataclass(frozen=True)
class BlinnPhong(AnalyticBRDF):
    r"""Half-vector cosine lobe, normalised at normal incidence.

    .. math:: f = k_s \frac{(n+2)(n+4)}{8\pi\,(2^{-n/2} + n)} (n \cdot h)^n

    The factor is the exact integral for a viewer on the normal, so the albedo there is
    ``specular``; it is the largest over all viewers, and the albedo falls towards the horizon.

    Args:
        specular: Albedo at normal incidence, 0 to 1.
        exponent: n, at least 0.

    Raises:
        ValueError: If a parameter is out of range.

    Source:
        :cite:`blinn1977models` for the lobe, :cite:`giesen2009normalization` for the factor.
    """

    specular: Colour
    exponent: float
    name: ClassVar[str] = "blinn_phong"

    def __post_init__(self):
        object.__setattr__(self, "specular", check_colour("specular", self.specular))
        object.__setattr__(self, "exponent", check_number("exponent", self.exponent, 0.0))

    def _evaluate_above(
        self, wi: Float[Tensor, "*batch 3"], wo: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch channels"]:
        half, _ = half_vector(wi, wo)
        n = self.exponent
        scale = (n + 2.0) * (n + 4.0) / (8.0 * math.pi * (2.0 ** (-0.5 * n) + n))
        lobe = scale * cosine_power(half[..., 2], n)
        return lobe[..., None] * colour_tensor(self.specular, self.num_channels, wi)

    @property
    def num_channels(self) -> int:
        """3 if the specular colour is not grey."""
        return count_channels(self.specular)

    @property
    def isotropic(self) -> bool:
        """True."""
        return True
