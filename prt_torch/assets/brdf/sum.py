"""Several models on one surface."""

from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from prt_torch.assets.brdf.base import BRDF, AnalyticBRDF


@dataclass(frozen=True)
class Sum(AnalyticBRDF):
    """The sum of its parts, such as a diffuse and a glossy one.

    Nothing keeps the sum of the albedos below 1.

    Args:
        parts: At least one model.

    Raises:
        ValueError: If there is no part, or something that is not a BRDF.
    """

    parts: tuple[BRDF, ...]
    name: ClassVar[str] = "sum"

    def __post_init__(self):
        if not isinstance(self.parts, (tuple, list)) or not self.parts:
            raise ValueError(f"parts: expected at least 1 BRDF, got {self.parts!r}")
        for i, part in enumerate(self.parts):
            if not isinstance(part, BRDF):
                raise ValueError(f"parts[{i}]: expected a BRDF, got {part!r}")
        object.__setattr__(self, "parts", tuple(self.parts))

    def _evaluate_above(
        self, wi: Float[Tensor, "*batch 3"], wo: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch channels"]:
        total = wi.new_zeros(*wi.shape[:-1], self.num_channels)
        for part in self.parts:
            total = total + part.evaluate(wi, wo)
        return total

    @property
    def num_channels(self) -> int:
        """3 if any part has 3."""
        return max(part.num_channels for part in self.parts)

    @property
    def reciprocal(self) -> bool:
        """Whether every part is: measured ones are only nearly so."""
        return all(part.reciprocal for part in self.parts)

    @property
    def isotropic(self) -> bool:
        """Whether every part is."""
        return all(part.isotropic for part in self.parts)
