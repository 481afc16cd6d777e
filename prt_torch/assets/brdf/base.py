r"""What every reflectance model offers: values, symmetries and a plain description.

A BRDF :math:`f(\omega_i, \omega_o)` [1/sr] is radiance towards :math:`\omega_o` per irradiance
from :math:`\omega_i`, *without* the cosine. Both directions are unit vectors in the shading frame
(z = normal, x = tangent) and point away from the surface (:mod:`prt_torch.conventions`).

The horizon is handled once, here: below it a BRDF is zero, and from it on a cosine under 1e-7
counts as 1e-7, so that models may divide by cosines. Models see only directions that are safe,
which keeps NaN out of gradients; nothing is repaired afterwards.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Colour = float | tuple[float, float, float]
"""One number, or linear red, green and blue."""

_HORIZON = 1e-7  # squares and cubes of it are still normal numbers in float32


class BRDF(ABC):
    """A reflectance model, immutable."""

    name: ClassVar[str]

    def evaluate(
        self, wi: Float[Tensor, "*#batch 3"], wo: Float[Tensor, "*#batch 3"]
    ) -> Float[Tensor, "*batch channels"]:
        """Values without the cosine [1/sr]; zero where either direction is below the horizon.

        On the horizon itself they are the limits from above. Differentiable in both directions;
        gradients are never NaN. Batch shapes broadcast.

        Args:
            wi: Unit vectors towards the light, shading frame.
            wo: Unit vectors towards the viewer, shading frame.

        Returns:
            In the dtype of the directions, with :attr:`num_channels` channels.
        """
        wi, wo = torch.broadcast_tensors(wi, wo)
        above = (wi[..., 2] >= 0) & (wo[..., 2] >= 0)
        values = self._evaluate_above(_raise(wi, above), _raise(wo, above))
        return torch.where(above[..., None], values, torch.zeros_like(values))

    @abstractmethod
    def _evaluate_above(
        self, wi: Float[Tensor, "*batch 3"], wo: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch channels"]:
        """The model's formula, for directions whose z is at least 1e-7."""

    @property
    @abstractmethod
    def num_channels(self) -> int:
        """3 if the values differ between red, green and blue, else 1."""

    @property
    @abstractmethod
    def reciprocal(self) -> bool:
        """Whether f(wi, wo) = f(wo, wi) by construction."""

    @property
    @abstractmethod
    def isotropic(self) -> bool:
        """Whether turning both directions about the normal changes nothing."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Name and parameters as plain JSON; :func:`prt_torch.assets.brdf.brdf` reads it."""


def _raise(
    directions: Float[Tensor, "*batch 3"], above: Bool[Tensor, "*batch"]
) -> Float[Tensor, "*batch 3"]:
    """The directions where ``above``, off the horizon by 1e-7; the normal elsewhere."""
    normal = directions.new_tensor((0.0, 0.0, 1.0))
    safe = torch.where(above[..., None], directions, normal)
    return torch.cat([safe[..., :2], safe[..., 2:].clamp(min=_HORIZON)], dim=-1)


@dataclass(frozen=True)
class AnalyticBRDF(BRDF):
    """A reflectance model that is a formula: its description is its parameters."""

    @property
    def reciprocal(self) -> bool:
        """True: every formula here is symmetric in its directions."""
        return True

    def describe(self) -> dict[str, Any]:
        """``{"name": ...}`` and every parameter, colours as lists."""
        return {"name": self.name} | {
            field.name: _plain(getattr(self, field.name)) for field in fields(self)
        }


def _plain(value: Any) -> Any:
    if isinstance(value, BRDF):
        return value.describe()
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in fields(value)}
    return value


def check_number(field: str, value: object, low: float, high: float = math.inf) -> float:
    """A finite number in ``low .. high``.

    Raises:
        ValueError: Naming the field, the limit and the value.
    """
    limit = f"{low:g} to {high:g}" if high < math.inf else f"at least {low:g}"
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        number = float(value)
        if math.isfinite(number) and low <= number <= high:
            return number
    raise ValueError(f"{field}: expected a number, {limit}, got {value!r}")


def check_colour(field: str, value: object, high: float = 1.0) -> Colour:
    """A number or three, each in ``0 .. high``.

    Raises:
        ValueError: Naming the field, the limit and the value.
    """
    if not isinstance(value, (tuple, list)):
        return check_number(field, value, 0.0, high)
    if len(value) != 3:
        raise ValueError(f"{field}: expected one number or three, got {value!r}")
    red, green, blue = (check_number(field, item, 0.0, high) for item in value)
    return red, green, blue


def count_channels(*colours: Colour) -> int:
    """3 if any of the colours is not grey, else 1."""
    return 3 if any(isinstance(c, tuple) and len(set(c)) > 1 for c in colours) else 1


def colour_tensor(colour: Colour, channels: int, like: Tensor) -> Float[Tensor, "channels"]:
    """A colour with as many channels as the model has."""
    values = colour if isinstance(colour, tuple) else (colour, colour, colour)
    return like.new_tensor(values[:channels])
