r"""BRDF factors: reflection as a sum of products of view functions and light functions.

.. math:: f(v, s)\, s_z \approx \sum_k G_k(v)\, F_k(s)

Light functions go into the transfer as it is baked, one row each; view functions are the exit basis
that turns the rows into radiance. Both are maps over the hemisphere that are looked up bilinearly
(or spherical harmonics of the light), and parameters of a module, so that they can be refined.
View functions may be coloured: then a scene of coloured materials still has transfer of one
channel.

Source:
    Liu et al. 2004, section 3; Wang et al. 2004, section 3.2; Sloan et al. 2005, equation 14.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor, nn

from prt_torch.bases import sh
from prt_torch.bases.base import ExitBasis
from prt_torch.bases.brdf_factoring import (
    Factors,
    Reflectance,
    Target,
    harmonic_factors,
    singular_factors,
    symmetric_factors,
)
from prt_torch.bases.brdf_moments import bilinear_moments, interpolated_factors
from prt_torch.bases.hemisphere_map import HemisphereMap, Mapping
from prt_torch.sphere import to_horizon

Method = Literal["interpolated", "singular", "symmetric", "harmonic"]

_CLAMP = 3.0
_MOST_TERMS = 64
_LEAST_DEGREE = 95  # of the quadrature of products of two view functions


class BRDFFactors(nn.Module, ExitBasis):
    """View and light maps of one or several materials.

    Parameters are ``view_values`` ``"rows colours texels"`` and ``light_values``
    ``"materials rows lights"``, whose last axis are texels, or harmonics of ``light_order`` bands.

    Args:
        view_values: As above, one colour or three.
        light_values: As above; no materials where only radiance is to be evaluated.
        hemisphere: The map that texels are of.
        cosine: Whether the light functions hold the cosine; if not, :meth:`light` multiplies it.
        light_order: Bands of a light side in harmonics; None for maps.
        num_constants: View functions, the first ones, that are constants: none, 1 in any colour, or
            3 in red, green and blue.

    Attributes:
        rms: Relative root mean square error that the closed form expects of itself: over all pairs
            of directions, weighted by the cosine, for ``interpolated``; of its matrix of texels for
            ``singular`` and ``symmetric``; over texels of the view and all lights for ``harmonic``.
            None if not known.
    """

    def __init__(
        self,
        view_values: Float[Tensor, "rows colours texels"],
        light_values: Float[Tensor, "materials rows lights"],
        hemisphere: HemisphereMap,
        *,
        cosine: bool = True,
        light_order: int | None = None,
        num_constants: int = 0,
    ):
        super().__init__()
        lights = hemisphere.num_texels if light_order is None else light_order**2
        rows, colours, texels = view_values.shape
        if colours not in (1, 3) or texels != hemisphere.num_texels:
            raise ValueError(
                f'expected view values "rows 1-or-3 {hemisphere.num_texels}", '
                f"got {tuple(view_values.shape)}"
            )
        if tuple(light_values.shape[1:]) != (rows, lights):
            raise ValueError(
                f'expected light values "materials {rows} {lights}", '
                f"got {tuple(light_values.shape)}"
            )
        self.hemisphere, self.cosine, self.light_order = hemisphere, cosine, light_order
        self.num_constants = num_constants
        self.view_values = nn.Parameter(view_values.detach().float().contiguous())
        self.light_values = nn.Parameter(light_values.detach().float().contiguous())
        self.rms: float | None = None

    @classmethod
    def from_brdf(
        cls,
        brdf: Reflectance | Sequence[Reflectance],
        *,
        num_terms: int | None = 10,
        max_error: float | None = None,
        method: Method = "interpolated",
        mapping: Mapping = "parabolic",
        resolution: int = 32,
        clamp: float | None = _CLAMP,
        supersampling: int | None = None,
        light_order: int = 6,
        constants: Literal[0, 1, 3] = 0,
    ) -> "BRDFFactors":
        """Factor one material, or several that share their view maps, in closed form.

        Args:
            brdf: What to factor.
            num_terms: Rows, at least 1; of each colour for ``symmetric``.
            max_error: Choose the fewest rows whose relative root mean square error, by the closed
                form's own account, is at most this; ``num_terms`` must then be None.
            method: ``interpolated`` is the optimum for bilinear lookups; ``singular`` is Liu's,
                ``symmetric`` Wang's (without the cosine), ``harmonic`` Sloan's of 2005.
            mapping: Parametrisation of the hemisphere.
            resolution: Texels along an edge of a map.
            clamp: Largest value of the function factored; None for no limit. It is the BRDF times
                the cosine, or the BRDF for ``symmetric``.
            supersampling: Directions along an edge of a texel: 4 for ``singular``, 2 for
                ``interpolated``, which takes one more for lights than for views.
            light_order: Bands of the light side of ``harmonic``.
            constants: How many view functions, the first ones, are constants, so that diffuse light
                can enter the rows exactly: 1 in any colour, or 3 in red, green and blue. The other
                rows are the best beside them; ``interpolated`` and ``harmonic`` only.

        Raises:
            ValueError: If an argument is out of range, or not exactly one of ``num_terms`` and
                ``max_error`` is given, or the error cannot be reached.
        """
        if (num_terms is None) == (max_error is None):
            raise ValueError("expected exactly one of num_terms and max_error (num_terms=None)")
        if constants and method not in ("interpolated", "harmonic"):
            raise ValueError(
                f"expected the method interpolated for constants, or harmonic, got {method!r}"
            )
        if num_terms is not None and not max(1, constants) <= num_terms <= _MOST_TERMS:
            raise ValueError(
                f"expected {max(1, constants)} to {_MOST_TERMS} terms, got {num_terms}"
            )
        if supersampling is not None and supersampling < 1:
            raise ValueError(f"expected a supersampling of at least 1, got {supersampling}")
        if clamp is not None and not clamp > 0:
            raise ValueError(f"expected a clamp above 0, got {clamp}")
        hemisphere = HemisphereMap(mapping, resolution)
        brdfs = list(brdf) if isinstance(brdf, Sequence) else [brdf]
        if not brdfs:
            raise ValueError("expected at least one material, got none")
        target = Target(brdfs, method != "symmetric", math.inf if clamp is None else clamp)
        count = num_terms or _MOST_TERMS
        match method:
            case "interpolated":
                moments = bilinear_moments(target, hemisphere, supersampling=supersampling or 2)
                found = interpolated_factors(moments, hemisphere, count, constants=constants)
            case "singular":
                found = singular_factors(
                    target, hemisphere, count, supersampling=supersampling or 4
                )
            case "symmetric":
                found = symmetric_factors(target, hemisphere, count)
            case "harmonic":
                found = harmonic_factors(
                    target, hemisphere, count, light_order, constants=constants
                )
            case _:
                raise ValueError(f"expected a method of {get_args(Method)}, got {method!r}")
        if max_error is not None:
            found = _enough(found, max_error, max(1, constants))
        order = light_order if method == "harmonic" else None
        return cls.of(
            found, hemisphere, cosine=target.cosine, light_order=order, num_constants=constants
        )

    @classmethod
    def of(cls, found: Factors, hemisphere: HemisphereMap, **options: Any) -> "BRDFFactors":
        """Factors that a decomposition has found, with the error that it expects.

        Args:
            found: Maps, and what they explain.
            hemisphere: The map that texels are of.
            **options: Those of the constructor.
        """
        factors = cls(found.view, found.light, hemisphere, **options)
        factors.rms = _relative_error(found)[-1]
        return factors

    @property
    def num_rows(self) -> int:
        """View functions."""
        return len(self.view_values)

    @property
    def num_channels(self) -> int:
        """3 if view functions are coloured, else 1."""
        return self.view_values.shape[1]

    @property
    def num_materials(self) -> int:
        """Materials that the light functions are of."""
        return len(self.light_values)

    @property
    def view_dependent(self) -> bool:
        """True."""
        return True

    def evaluate(
        self, view: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch rows"] | Float[Tensor, "*batch rows rgb"]:
        """View functions at unit directions in the shading frame; coloured ones have a last axis.

        Views below the horizon are taken to it.
        """
        found = self.hemisphere.lookup(self.view_values.flatten(0, 1).to(view), view)
        if self.num_channels == 1:
            return found
        return found.unflatten(-1, (self.num_rows, 3))

    def light(
        self, directions: Float[Tensor, "*batch 3"], material: int = 0
    ) -> Float[Tensor, "*batch rows"]:
        """Light functions, cosine included, at unit directions; zero below the horizon."""
        own, above = self.light_values[material].to(directions), directions[..., 2:] > 0
        level = to_horizon(directions)
        if self.light_order is None:
            found = self.hemisphere.lookup(own, level)
        else:
            found = sh.evaluate(level, self.light_order) @ own.mT
        found = found if self.cosine else found * level[..., 2:]
        return torch.where(above, found, torch.zeros_like(found))

    def gram(self) -> Float[Tensor, "rows rows"]:
        """Mean over views, and colours, of the products of two view functions, float64."""
        degree = max(_LEAST_DEGREE, 4 * self.hemisphere.resolution)
        views, solid_angles = sh.hemisphere_quadrature(degree)
        values = self.view_values.detach().double().cpu().flatten(0, 1)
        seen = self.hemisphere.lookup(values, views).unflatten(-1, (self.num_rows, -1))
        weights = solid_angles / (2 * math.pi * self.num_channels)
        return torch.einsum("vkc,v,vlc->kl", seen, weights, seen)

    def constants(self) -> Float[Tensor, "colours rows"]:
        """The first rows, as many as are constants."""
        return torch.eye(self.num_constants, self.num_rows, dtype=torch.float64)

    def describe(self) -> dict[str, Any]:
        """What the maps are of; their values are tensors of their own."""
        return {
            "name": "brdf_factors",
            "mapping": self.hemisphere.mapping,
            "resolution": self.hemisphere.resolution,
            "num_rows": self.num_rows,
            "num_channels": self.num_channels,
            "num_constants": self.num_constants,
        }

    def tensors(self) -> dict[str, Tensor]:
        """The view maps; light maps are part of the transfer already."""
        return {"view_values": self.view_values.detach().clone()}


def _enough(found: Factors, max_error: float, least: int) -> Factors:
    """The first rows whose error is low enough."""
    errors = torch.tensor(_relative_error(found))
    reached = torch.nonzero(errors <= max_error)
    if len(reached) == 0:
        raise ValueError(
            f"max_error: {len(errors)} terms at this resolution reach {errors[-1]:.3g}, "
            f"not {max_error:g}"
        )
    rows = max(int(reached[0]) + 1, least)
    return Factors(found.view[:rows], found.light[:, :rows], found.energies[:rows], found.energy)


def _relative_error(found: Factors) -> list[float]:
    """Relative root mean square error of the first rows, for each number of rows."""
    left = (found.energy - found.energies.cumsum(0)).clamp_min(0.0)
    return (left / (found.energy or 1.0)).sqrt().tolist()
