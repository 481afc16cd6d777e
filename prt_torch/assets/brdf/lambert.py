"""Ideal diffuse reflection."""

import math
from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from prt_torch.assets.brdf.base import (
    AnalyticBRDF,
    Colour,
    check_colour,
    colour_tensor,
    count_channels,
)


@dataclass(frozen=True)
class Lambert(AnalyticBRDF):
    """The constant albedo / π.

    Args:
        albedo: Share of the irradiance that is reflected, 0 to 1.

    Raises:
        ValueError: If a parameter is out of range.
    """

    albedo: Colour
    name: ClassVar[str] = "lambert"

    def __post_init__(self):
        object.__setattr__(self, "albedo", check_colour("albedo", self.albedo))

    def _evaluate_above(
        self, wi: Float[Tensor, "*batch 3"], wo: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch channels"]:
        value = colour_tensor(self.albedo, self.num_channels, wi) / math.pi
        return value + 0.0 * (wi + wo)[..., :1]  # gradients exist and are zero

    @property
    def num_channels(self) -> int:
        """3 if the albedo is not grey."""
        return count_channels(self.albedo)

    @property
    def isotropic(self) -> bool:
        """True."""
        return True
