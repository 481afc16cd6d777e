r"""Refinement of BRDF factors against the error of their bilinear lookups, constraints included.

Lookups are linear in the texels, so the error over all pairs of directions is a polynomial of the
maps (:class:`~prt_torch.bases.brdf_moments.Moments`), exact for its quadrature and differentiable.

* Without a constraint its least value is a closed form, which no step improves but for its ridge,
  whose loss was measured as 2e-7 of the error and less: the maps are replaced by it.
* *Nonnegative* maps are squares of free numbers. Products of non-negative maps cannot cancel, so
  reflection is never negative and maps can be stored without a sign. The start is the closed form
  cut off at zero and a few multiplicative turns, each of which lowers the error.
* *Reciprocal* factors have the same map on both sides, with a sign on the view side, so
  :math:`\hat f(v, s) = \hat f(s, v)` exactly. Wang's eigenvectors are so, but the best for texel
  centres only.

L-BFGS minimises the constrained ones. There the maps are expressed by a root of the mass matrices,
where a step changes the function by as much in any direction: this took a third of the iterations.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from prt_torch.bases.brdf_factoring import Reflectance, Target, fill
from prt_torch.bases.brdf_factors import BRDFFactors
from prt_torch.bases.brdf_moments import (
    Moments,
    bilinear_moments,
    interpolated_factors,
    ridged_root,
)

RefinementStatus = Literal["closed_form", "converged", "max_steps", "nonfinite"]
Maps = tuple[Tensor, Tensor]
"""View maps ``"rows colours texels"`` and light maps ``"materials rows texels"``, float64."""

_ITERATIONS = 10  # of L-BFGS in a step
_TOLERANCE = 1e-5  # a step that lowers the squared error by less than this share of it is the last
_TURNS = 20  # of the multiplicative start; later ones gain less than L-BFGS does in their time
_FLOOR = 0.1  # of the mean of its map: a square that starts at zero could not leave it


@dataclass(frozen=True)
class Refinement:
    """How a refinement went.

    Attributes:
        factors: New ones; those given are left as they were.
        status: ``closed_form`` (no constraint, no steps needed), ``converged`` (a step gained less
            than 1e-5 of the squared error), ``max_steps``, or ``nonfinite`` (the error became NaN
            or infinite; the best maps before that were kept).
        error_before: Relative root mean square error over all pairs of directions, weighted by the
            cosine, by quadrature, of the factors given; for ``nonnegative`` of their positive part.
        error_after: The same at the end, never larger.
        steps: Taken, of ten iterations each.
    """

    factors: BRDFFactors
    status: RefinementStatus
    error_before: float
    error_after: float
    steps: int


def refine(
    factors: BRDFFactors,
    brdf: Reflectance | Sequence[Reflectance],
    *,
    nonnegative: bool = False,
    reciprocal: bool = False,
    clamp: float | None = 3.0,
    max_steps: int = 20,
    supersampling: int = 2,
) -> Refinement:
    """Lower the error of factors, keeping their map, rows, colours, constants and cosine.

    Constant view functions stay what they are; their light functions are refined.

    Args:
        factors: Where to start.
        brdf: The material, or materials, that they stand for.
        nonnegative: Keep all values at least 0.
        reciprocal: Keep the view maps the light maps times a sign, as ``method="symmetric"`` has
            them.
        clamp: Largest value of the function, as in :meth:`BRDFFactors.from_brdf`.
        max_steps: Steps of ten L-BFGS iterations at most; 0 stops at the start.
        supersampling: Views along an edge of a texel, and one less than the lights.

    Raises:
        ValueError: If an option is out of range, the light side is in harmonics, materials or
            colours do not fit the factors, or ``reciprocal`` meets factors that are not.

    Source:
        Wang et al. 2004, section 3.2 (reciprocal factors); Lee, Seung 2001 (multiplicative turns),
        here with mass matrices. Neither paper refines for what lookups make between texels.
    """
    brdfs = list(brdf) if isinstance(brdf, Sequence) else [brdf]
    _check(factors, brdfs, nonnegative and reciprocal, max_steps)
    hemisphere, constants = factors.hemisphere, factors.num_constants
    target = Target(brdfs, factors.cosine, math.inf if clamp is None else clamp)
    whole = bilinear_moments(target, hemisphere, supersampling=supersampling)
    moments, used = _in_colours(whole, factors.num_channels).used()
    given = _doubles(factors, used)
    if reciprocal:
        signs = _signs(*given)
        raw, expand = _shared(moments, given[1], signs)
        ended, status, steps = _descend([raw], expand, moments, max_steps)
    else:
        found = interpolated_factors(whole, hemisphere, factors.num_rows, constants=constants)
        ended, status, steps = (found.view[..., used], found.light[..., used]), "closed_form", 0
        if nonnegative:
            given, ended = _positive(given), _turns(moments, _positive(ended), constants)
            free, expand = _squares(*ended, constants)
            ended, status, steps = _descend(free, expand, moments, max_steps)
    before, after = moments.error(*given), moments.error(*(_rounded(maps) for maps in ended))
    if not float(after) < float(before):
        ended, after = given, before
    refined = BRDFFactors(
        fill(ended[0], used, hemisphere),
        fill(ended[1], used, hemisphere),
        hemisphere,
        cosine=factors.cosine,
        num_constants=constants,
    )
    refined = refined.to(factors.view_values.device)
    refined.rms = moments.relative(after)
    return Refinement(refined, status, moments.relative(before), refined.rms, steps)


def _check(factors: BRDFFactors, brdfs: Sequence[Reflectance], both: bool, max_steps: int) -> None:
    """Refuse what cannot be refined."""
    if both:
        raise ValueError("expected nonnegative or reciprocal, got both")
    if max_steps < 0:
        raise ValueError(f"expected at least 0 steps, got {max_steps}")
    if factors.light_order is not None:
        raise ValueError("expected factors with light maps, got spherical harmonics of the light")
    if len(brdfs) != factors.num_materials:
        raise ValueError(f"expected {factors.num_materials} materials, got {len(brdfs)}")
    colours = max(brdf.num_channels for brdf in brdfs)
    if colours > factors.num_channels:
        raise ValueError(f"expected materials of 1 channel, as the factors have, got {colours}")


def _in_colours(moments: Moments, colours: int) -> Moments:
    """A grey model's moments in as many colours as the factors have."""
    copies = colours // len(moments.moments)
    wide = moments.moments.expand(colours, -1, -1, -1)
    return Moments(moments.view_mass, moments.light_mass, wide, moments.energy * copies)


def _doubles(factors: BRDFFactors, used: Bool[Tensor, "texels"]) -> Maps:
    maps = factors.view_values, factors.light_values
    view, light = (values.detach().double().cpu()[..., used] for values in maps)
    return view, light


def _rounded(values: Tensor) -> Tensor:
    """As the factors will store them."""
    return values.float().double()


def _signs(view: Tensor, light: Tensor) -> Float[Tensor, "rows colours"]:
    """1, -1 or 0, by which the light maps give the view maps."""
    signs = torch.einsum("kct,kt->kc", view, light[0]).sign()
    if len(light) != 1 or bool((view != signs[..., None] * light[0][:, None]).any()):
        raise ValueError(
            "expected one material and view maps that are light maps times a sign, "
            "as the method symmetric makes them"
        )
    return signs


def _shared(
    moments: Moments, light: Tensor, signs: Float[Tensor, "rows colours"]
) -> tuple[Tensor, Callable[[], Maps]]:
    """One set of maps for both sides, as free numbers and back."""
    masses = [mass / mass.trace() for mass in (moments.view_mass, moments.light_mass)]
    root = ridged_root(masses[0] + masses[1])
    free = (light[0] @ root).requires_grad_()

    def expand() -> Maps:
        maps = torch.linalg.solve_triangular(root, free, upper=False, left=False)
        return signs[..., None] * maps[:, None], maps[None]

    return free, expand


def _positive(maps: Maps) -> Maps:
    """What is negative is zero."""
    view, light = maps
    return view.clamp_min(0.0), light.clamp_min(0.0)


def _turns(moments: Moments, maps: Maps, constants: int) -> Maps:
    """Multiplicative turns; neither they nor the squares after them leave a zero."""
    view, light = (torch.maximum(m, _FLOOR * m.mean(-1, keepdim=True)) for m in maps)
    view[:constants] = maps[0][:constants]
    tiny = torch.finfo(view.dtype).tiny
    positive = moments.moments.clamp_min(0.0)  # a measured model can be slightly negative
    for _ in range(_TURNS):
        gram = torch.einsum("mkt,tu,mlu->kl", light, moments.light_mass, light)
        wanted = torch.einsum("ctmu,mku->kct", positive, light)
        turned = (
            view * wanted / (torch.einsum("kl,lct->kct", gram, view) @ moments.view_mass + tiny)
        )
        view = torch.cat([view[:constants], turned[constants:]])
        gram = torch.einsum("kct,tu,lcu->kl", view, moments.view_mass, view)
        wanted = torch.einsum("ctmu,kct->mku", positive, view)
        light = (
            light * wanted / (torch.einsum("kl,mlu->mku", gram, light) @ moments.light_mass + tiny)
        )
    return view, light


def _squares(
    view: Tensor, light: Tensor, constants: int
) -> tuple[list[Tensor], Callable[[], Maps]]:
    """Non-negative maps as squares of free numbers and back; constants stay."""
    fixed = view[:constants]
    free = [view[constants:].sqrt().requires_grad_(), light.sqrt().requires_grad_()]

    def expand() -> Maps:
        return torch.cat([fixed, free[0].square()]), free[1].square()

    return free, expand


def _descend(
    free: list[Tensor], expand: Callable[[], Maps], moments: Moments, max_steps: int
) -> tuple[Maps, RefinementStatus, int]:
    """L-BFGS from where ``free`` is; the best maps seen."""
    optimizer = torch.optim.LBFGS(
        free,
        max_iter=_ITERATIONS,
        history_size=2 * _ITERATIONS,
        tolerance_grad=0.0,
        tolerance_change=0.0,
        line_search_fn="strong_wolfe",
    )

    def closure() -> float:
        optimizer.zero_grad()
        with torch.enable_grad():
            error = moments.error(*expand()) / (moments.energy or 1.0)
            error.backward()
        return float(error.detach())

    def measured() -> tuple[Maps, float]:
        with torch.no_grad():
            maps = expand()
            return maps, float(moments.error(*maps))

    best, least = measured()
    for step in range(max_steps):
        optimizer.step(closure)
        maps, error = measured()
        if not math.isfinite(error):
            return best, "nonfinite", step + 1
        gained = least - error
        if gained > 0:
            best, least = maps, error
        if gained < _TOLERANCE * error:
            return best, "converged", step + 1
    return best, "max_steps", max_steps
