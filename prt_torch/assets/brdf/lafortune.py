"""Sums of generalised cosine lobes."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.assets.brdf.base import AnalyticBRDF, check_number
from prt_torch.assets.brdf.phong import cosine_power

_LIMIT = 1e3  # of a coefficient's size


@dataclass(frozen=True)
class LafortuneLobe:
    r"""One lobe, :math:`\max(c_x x_i x_o + c_y y_i y_o + c_z z_i z_o,\, 0)^n`.

    Mirror-like lobes have cx and cy below 0, retro-reflective ones above. The lobe's strength is
    in its coefficients: scaling all three by s multiplies it by :math:`s^n`.

    Args:
        cx: Along the tangent, -1000 to 1000.
        cy: Along the bitangent; equal to ``cx`` for an isotropic lobe.
        cz: Along the normal.
        exponent: n, at least 0.

    Raises:
        ValueError: If a parameter is out of range.
    """

    cx: float
    cy: float
    cz: float
    exponent: float

    def __post_init__(self):
        for field in ("cx", "cy", "cz"):
            number = check_number(field, getattr(self, field), -_LIMIT, _LIMIT)
            object.__setattr__(self, field, number)
        object.__setattr__(self, "exponent", check_number("exponent", self.exponent, 0.0))


@dataclass(frozen=True)
class Lafortune(AnalyticBRDF):
    r"""Generalised cosine lobes.

    The model was made for fitting and does not conserve energy by itself: with
    :math:`C = \max(|c_x|, |c_y|, |c_z|)` a lobe's albedo is at most :math:`2\pi C^n / (n + 2)`,
    which it reaches at normal incidence if C is :math:`c_z`.

    Args:
        lobes: At least one. Mappings of a lobe's parameters become lobes.

    Raises:
        ValueError: If there is no lobe or one of its parameters is out of range.

    Source:
        :cite:`lafortune1997nonlinear`, the reciprocal form, whose matrix is diagonal in the
        shading frame. One set of coefficients serves all colours here, and the diffuse
        part is a :class:`Lambert` beside it.
    """

    lobes: tuple[LafortuneLobe, ...]
    name: ClassVar[str] = "lafortune"

    def __post_init__(self):
        if not isinstance(self.lobes, (tuple, list)) or not self.lobes:
            raise ValueError(f"lobes: expected at least 1 lobe, got {self.lobes!r}")
        lobes = tuple(_lobe(f"lobes[{i}]", lobe) for i, lobe in enumerate(self.lobes))
        object.__setattr__(self, "lobes", lobes)

    def _evaluate_above(
        self, wi: Float[Tensor, "*batch 3"], wo: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch channels"]:
        both = wi * wo
        total = torch.zeros_like(both[..., 0])
        for lobe in self.lobes:
            coefficients = both.new_tensor((lobe.cx, lobe.cy, lobe.cz))
            total = total + cosine_power((both * coefficients).sum(-1), lobe.exponent)
        return total[..., None]

    @property
    def num_channels(self) -> int:
        """One."""
        return 1

    @property
    def isotropic(self) -> bool:
        """Whether cx equals cy in every lobe."""
        return all(lobe.cx == lobe.cy for lobe in self.lobes)


def _lobe(field: str, value: object) -> LafortuneLobe:
    if isinstance(value, LafortuneLobe):
        return value
    wanted = [parameter.name for parameter in fields(LafortuneLobe)]
    if not isinstance(value, Mapping) or set(value) != set(wanted):
        raise ValueError(f"{field}: expected {', '.join(wanted)}, got {value!r}")
    try:
        return LafortuneLobe(**value)
    except ValueError as error:
        raise ValueError(f"{field}.{error}") from None
