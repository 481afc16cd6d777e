"""Stiff fits of light over many seeds: suns of 1e9, extreme brightness, functions that coincide."""

from collections import Counter

import torch
from stability_case import Collection, Outcome, at_most, exactly, not_finite, tally
from stability_problems import generator
from torch import Tensor

from prt_torch.bases import CubeDirections, zonal
from prt_torch.bases.srbf_fitting import fit_texels
from prt_torch.bases.srbf_light import SRBFExpansion
from prt_torch.sphere import cubemap_directions

CASES = Collection("stiff fits of light")
_TEXELS = 6 * 8 * 8


def _lights(seeds: int) -> Tensor:
    """Random ambient light of mean 1 and a sun of 1e9 in one texel."""
    lights = []
    for seed in range(seeds):
        source = generator(seed)
        light = 2.0 * torch.rand(_TEXELS, 3, generator=source).double()
        light[int(torch.randint(_TEXELS, (1,), generator=source))] = 1e9
        lights.append(light)
    return torch.stack(lights)


@CASES.case(
    "scattered-functions-under-a-sun",
    given="one texel of 1e9 over ambient of mean 1, 6 scattered functions",
    required="the sun is met as far as half a texel's width allows; errors as told",
    seconds=60.0,
    seeded=True,
)
def sun_fits(dtype: torch.dtype, seeds: int) -> Outcome:
    """All lights side by side, and the error measured anew from the functions."""
    lights = _lights(seeds)
    result = fit_texels(lights.to(dtype), 6, rounds=2)
    difference, worst = _differences(result.squared_error, result.expansions, lights)
    condition = max(result.condition)
    bad = sum(
        not_finite([one.centers, one.bandwidths, one.coefficients]) for one in result.expansions
    )
    return Outcome(
        (
            at_most("largest squared error", worst, 0.1),
            at_most("difference of the error told and measured", difference, 1e-6),
            at_most("condition", condition, 1e10),
            exactly("numbers not finite", bad, 0),
        ),
        condition=condition,
        note=tally(Counter(result.status)),
    )


def _differences(
    told: tuple[float, ...], expansions: tuple[SRBFExpansion, ...], lights: Tensor
) -> tuple[float, float]:
    """Largest difference of squared errors told from measured ones, and the largest of these."""
    cube = CubeDirections(8)
    directions = cubemap_directions(8, dtype=torch.float64).view(-1, 3)
    weights = cube.solid_angles.double()[:, None]
    difference = worst = 0.0
    for error, expansion, light in zip(told, expansions, lights, strict=True):
        scale = float(light.abs().max()) or 1.0
        left = (expansion.evaluate(directions).double() - light) / scale
        norm = float(((light / scale).square() * weights).sum()) or 1.0
        measured = float((left.square() * weights).sum()) / norm
        difference, worst = max(difference, abs(measured - error)), max(worst, measured)
    return difference, worst


@CASES.case(
    "scattered-functions-of-any-brightness",
    given="black, denormal, 65504 and 1e30 lights side by side with plain ones",
    required="each as if it were alone; a black one is error 0",
    seconds=60.0,
)
def brightness_fits(dtype: torch.dtype) -> Outcome:
    """The same light at five brightnesses."""
    light = 2.0 * torch.rand(1, _TEXELS, 3, generator=generator()).double()
    factors = (1.0, 0.0, 1e-38, 65504.0, 1e30)
    lights = torch.cat([light * factor for factor in factors]).to(dtype)
    result = fit_texels(lights, 6, rounds=1, max_steps=4)
    errors = result.squared_error
    others = max(abs(errors[which] - errors[0]) for which in (2, 3, 4))
    bad = sum(not_finite([one.coefficients, one.centers]) for one in result.expansions)
    return Outcome(
        (
            exactly("squared error of black", errors[1], 0),
            at_most("difference of the others' errors", others, 1e-4),
            exactly("numbers not finite", bad, 0),
        ),
        condition=max(result.condition),
        note=tally(Counter(result.status)),
    )


@CASES.case(
    "scattered-functions-that-coincide",
    given="fits that start from centres 1e-1 to 1e-12 rad apart, in pairs",
    required="no LinAlgError, coefficients finite; never worse than the start",
    seconds=60.0,
    seeded=True,
)
def coincident_functions(dtype: torch.dtype, seeds: int) -> Outcome:
    """Four pairs of functions on smooth light."""
    worse, bad, condition = 0.0, 0, 0.0
    statuses: Counter[str] = Counter()
    directions = cubemap_directions(8, dtype=torch.float64).view(-1, 3)
    for seed in range(seeds):
        source = generator(seed)
        mixture = torch.randn(3, 3, generator=source).double()
        light = (1.0 + (directions @ mixture).square())[None].to(dtype)
        centers = zonal.unit_axes(torch.randn(4, 3, generator=source).double())
        apart = 10.0 ** -(1.0 + 11.0 * seed / max(seeds - 1, 1))
        pairs = torch.cat([centers, zonal.unit_axes(centers + apart * centers.roll(1, 1))])
        start = SRBFExpansion(pairs, torch.full((8,), 4.0).double(), torch.zeros(8, 3).double())
        before = fit_texels(light, start=start, rounds=0, max_steps=0)
        after = fit_texels(light, start=start, rounds=1, max_steps=3)
        worse = max(worse, after.squared_error[0] - before.squared_error[0])
        condition = max(condition, before.condition[0], after.condition[0])
        statuses.update(after.status)
        for one in (before.expansion, after.expansion):
            bad += not_finite([one.centers, one.bandwidths, one.coefficients])
    return Outcome(
        (
            at_most("rise of the squared error", worse, 1e-12),
            at_most("condition, ridge included", condition, 1e10),
            exactly("numbers not finite", bad, 0),
        ),
        condition=condition,
        note=tally(statuses),
    )
