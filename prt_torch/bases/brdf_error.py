"""How far BRDF factors are from their material, on directions they were not made from."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases import sh
from prt_torch.bases.brdf_factoring import Reflectance
from prt_torch.bases.brdf_factors import BRDFFactors

_VIEWS = 64
_LIGHT_DEGREE = 95  # of the quadrature over lights
_PAIRS = 2**14  # at once


@dataclass(frozen=True)
class FactorError:
    """Errors of factors, all of the product with the cosine of the light [1/sr].

    Attributes:
        rms: Root mean square over pairs of directions drawn evenly from both hemispheres, and
            over colours.
        relative: The same over that of the material.
        largest: Largest difference of a pair.
        albedo: Largest difference of the directional albedo [1] of a view.
        worst_view: Largest relative root mean square error of a view.
    """

    rms: float
    relative: float
    largest: float
    albedo: float
    worst_view: float


@torch.no_grad()
def factor_error(
    factors: BRDFFactors,
    brdf: Reflectance,
    *,
    material: int = 0,
    clamp: float = math.inf,
    num_pairs: int = 80_000,
    generator: torch.Generator | None = None,
) -> FactorError:
    """Measure factors against their material.

    Args:
        factors: What to measure.
        brdf: The material it stands for.
        material: Which of the materials of ``factors`` it is.
        clamp: Value that the BRDF, or its product with the cosine where the factors hold it, is
            cut off at, as for the factors.
        num_pairs: Random pairs of directions.
        generator: Source of randomness; seed 0 if not given.

    Source:
        Wang et al. 2004, section 4.3 (80,000 random pairs, weighted by the cosine).
    """
    generator = generator or torch.Generator().manual_seed(0)
    wrong_squares, squares, largest = 0.0, 0.0, 0.0
    lights, views = (even_directions(num_pairs, generator) for _ in range(2))
    for light, view in zip(lights.split(_PAIRS), views.split(_PAIRS), strict=True):
        expected = _product(factors, brdf, light, view, clamp)
        difference = _approximation(factors, light, view, material) - expected
        squares += float(expected.square().mean(-1).sum())
        wrong_squares += float(difference.square().mean(-1).sum())
        largest = max(largest, float(difference.abs().max()))
    views = even_directions(_VIEWS, generator)[:, None]
    lights, solid_angles = sh.hemisphere_quadrature(_LIGHT_DEGREE)
    of_view = _product(factors, brdf, lights, views, clamp)
    wrong = _approximation(factors, lights, views, material) - of_view
    norms = (of_view.square() * solid_angles[:, None]).sum((1, 2))
    errors = (wrong.square() * solid_angles[:, None]).sum((1, 2))
    return FactorError(
        rms=math.sqrt(wrong_squares / num_pairs),
        relative=math.sqrt(wrong_squares / (squares or 1.0)),
        largest=largest,
        albedo=float((wrong * solid_angles[:, None]).sum(1).abs().max()),
        worst_view=float((errors / norms.clamp_min(torch.finfo(norms.dtype).tiny)).sqrt().max()),
    )


def even_directions(count: int, generator: torch.Generator) -> Float[Tensor, "count 3"]:
    """Directions drawn evenly from the upper hemisphere, float64."""
    height = torch.rand(count, generator=generator, dtype=torch.float64)
    azimuth = torch.rand(count, generator=generator, dtype=torch.float64) * (2 * math.pi)
    level = (1 - height * height).sqrt()
    return torch.stack([level * azimuth.cos(), level * azimuth.sin(), height], dim=-1)


def _product(
    factors: BRDFFactors, brdf: Reflectance, lights: Tensor, views: Tensor, clamp: float
) -> Float[Tensor, "*batch colours"]:
    values, cosine = brdf.evaluate(lights, views), lights[..., 2:]
    if factors.cosine:
        return (values * cosine).clamp(max=clamp)
    return values.clamp(max=clamp) * cosine


def _approximation(
    factors: BRDFFactors, lights: Tensor, views: Tensor, material: int
) -> Float[Tensor, "*batch colours"]:
    seen = factors.evaluate(views)
    seen = seen[..., None] if factors.num_channels == 1 else seen
    return torch.einsum("...kc,...k->...c", seen, factors.light(lights, material))
