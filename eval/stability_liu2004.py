"""Extremes of Liu et al. 2004: grazing reflection, suns in wavelets, small clusters."""

import math

import torch
from stability_case import (
    Collection,
    Outcome,
    at_least,
    at_most,
    exactly,
    near,
    not_finite,
    relative_error,
    rounding,
)
from stability_problems import cube_light, generator, light_of

from prt_torch import evaluate
from prt_torch.assets.brdf import CookTorrance
from prt_torch.assets.brdf.microfacet import beckmann_distribution
from prt_torch.bases import BRDFFactors, Haar, HemisphereMap
from prt_torch.bases.brdf_factoring import Target
from prt_torch.quantize import dequantize, full_scale, quantize
from prt_torch.representations import SegmentedCPCA
from prt_torch.sphere import cubemap_directions
from prt_torch.transfer import TransferTensor
from prt_torch.truncation import truncate

CASES = Collection("Liu 2004")
_MATERIAL = CookTorrance(f0=0.5, roughness=0.4)
_AS_PRINTED = 4.0  # F D G / (pi cos cos) without the 1/4 of half vectors makes energy


@CASES.case(
    "view-at-90-degrees",
    given="Cook-Torrance, m = 0.4, F0 = 0.5, seen exactly from the side, lit from the normal",
    required="0.0153952, a quarter of it in our units; a guard by epsilon gives 0",
)
def view_at_90_degrees(dtype: torch.dtype) -> Outcome:
    """The limit from above the horizon, and the horizon itself."""
    light = torch.tensor([[0.0, 0.0, 1.0]], dtype=dtype)
    views = [[1.0, 0.0, height] for height in (1e-3, 1e-6, 1e-12, 0.0)]
    views = torch.nn.functional.normalize(torch.tensor(views, dtype=dtype), dim=-1)
    found = (_AS_PRINTED * _MATERIAL.evaluate(light, views)[:, 0]).tolist()
    return Outcome(
        (
            near("printed units, 1e-6 above the horizon", found[1], 0.0153952, 1e-4),
            near("1e-12 above the horizon", found[2], 0.0153952, 1e-5),
            near("at the horizon", found[3], 0.0153952, 1e-5),
        )
    )


@CASES.case(
    "mirror-pair-at-the-horizon",
    given="light and view mirror each other at 89.9999 degrees",
    required="1.13986e6, clamped to 3; factors finite",
)
def mirror_pair(dtype: torch.dtype) -> Outcome:
    """The value, what is factored, and factors of the whole material with and without a clamp."""
    angle = math.radians(89.9999)
    light = torch.tensor([[math.sin(angle), 0.0, math.cos(angle)]], dtype=dtype)
    view = light * light.new_tensor((-1.0, 1.0, 1.0))
    value = _MATERIAL.evaluate(light, view) * light[:, 2:]
    clamped = Target([_MATERIAL], cosine=True, clamp=3.0).values(view, light)
    options = {"num_terms": 10, "method": "singular", "resolution": 16, "supersampling": 2}
    factors = [
        BRDFFactors.from_brdf(_MATERIAL, clamp=clamp, **options).to(dtype) for clamp in (3.0, None)
    ]
    return Outcome(
        (
            # The cosine of such an angle has few digits in float32.
            near("printed units, times cosine", _AS_PRINTED * float(value), 1.13986e6, 2e-3),
            exactly("clamped", float(clamped), 3.0),
            exactly("numbers of factors not finite", _not_finite(factors), 0),
            at_most("relative error of 10 clamped terms", factors[0].rms or math.nan, 1.0),
        ),
        note=f"relative error of 10 terms without a clamp {factors[1].rms:.2g}",
    )


@CASES.case(
    "unclamped-matrix",
    given="the same material on the 32 x 32 map without a clamp",
    required="largest value 672 on the grid; 8 singular values within 0.03 % of the first",
)
def unclamped_matrix(dtype: torch.dtype) -> Outcome:
    """Known values of a matrix whose leading singular values nearly coincide."""
    directions, used = HemisphereMap("parabolic", 32).centres()
    directions = directions[used].to(dtype)
    values = _AS_PRINTED * Target([_MATERIAL], cosine=True).values(directions, directions)
    singular = torch.linalg.svdvals(values[:, 0, 0].double())
    close = int((singular > (1.0 - 3.5e-4) * singular[0]).sum())
    return Outcome(
        (
            near("largest value", values.max(), 672.0, 2e-3),
            exactly("singular values within 0.03 % of the first", close, 8),
        ),
        condition=float(singular[0] / singular[-1]),
    )


@CASES.case(
    "roughness-1e-3",
    given="Beckmann's distribution of roughness 1e-3, n.h from 1 down to 1e-200",
    required="1e6 at 1, 1.34353e-81 at 0.9999, 0 from 1e-8 down; logarithms give NaN",
)
def roughness(dtype: torch.dtype) -> Outcome:
    """The distribution, and the model at directions that oppose each other at the horizon."""
    heights = torch.tensor([1.0, 0.9999, 1e-8, 1e-30, torch.finfo(dtype).tiny], dtype=torch.float64)
    half = torch.stack([(1 - heights.square()).sqrt(), 0 * heights, heights], dim=-1).to(dtype)
    found = (math.pi * beckmann_distribution(half, 1e-3).double()).tolist()
    expected = 1.34353e-81 if dtype == torch.float64 else 0.0
    model = CookTorrance(f0=0.5, roughness=1e-3)
    level = torch.tensor([[1.0, 0.0, 0.0]], dtype=dtype)
    raised = [level + level.new_tensor((0.0, 0.0, height)) for height in (1e-3, 1e-8, 1e-30)]
    opposed = [model.evaluate(wi, wi * wi.new_tensor((-1.0, 1.0, 1.0))) for wi in raised]
    crossed = [model.evaluate(wi, wi[:, [1, 0, 2]]) for wi in raised]
    return Outcome(
        (
            near("at 1", found[0], 1e6, 1e-5),
            near("at 0.9999", found[1], expected, 1e-5),
            exactly("largest from 1e-8 down", max(found[2:]), 0.0),
            exactly("values not finite", not_finite([*opposed, *crossed]), 0),
        )
    )


@CASES.case(
    "sun-in-wavelets",
    given="a sun of 1e6 in one texel of 64 over ambient 1, in Haar wavelets of whole faces",
    required="24 coefficients, the largest 499999; 16 bits keep the ambient only by bands",
    seconds=120.0,
)
def sun_in_wavelets(dtype: torch.dtype) -> Outcome:
    """Exact zeros, truncation, codes of one step and of a step for each band."""
    basis = Haar(64, 64)
    light = basis.project(cube_light(64, 1.0, 1e6, dtype))[:, :1]
    used = light[:, 0] != 0
    kept, lost = truncate(light.to(dtype).expand(-1, 3)[None], basis, 24)
    ambient = basis.segments(light[:, 0])[0, 0]  # of a face without the sun
    step = full_scale(light, 16)
    one_step = quantize(light, step, 16)
    dropped = torch.where(one_step.abs() < 1024, 0, one_step)
    by_band = light[used].abs().log2().round()
    again = light.clone()
    for band in by_band.unique():
        own = used.clone()
        own[used.clone()] = (by_band == band)[:, 0]
        again[own] = dequantize(*_coded(light[own]), torch.float64)
    return Outcome(
        (
            exactly("coefficients other than zero", int(used.sum()), 24),
            near("largest", light.abs().max(), 499999.5, 1e-9),
            near("ambient of a face", ambient, 64.0, 1e-12),
            exactly("code of the ambient at one step", one_step[0], 4),
            exactly("the same below 1024 dropped", dropped[0], 0),
            at_most("relative error of the ambient by bands", abs(float(again[0]) / 64 - 1), 1e-4),
            at_most("share of light lost by keeping 24", lost.max(), 0.0),
            exactly("kept numbers not finite", not_finite([kept]), 0),
        ),
        note=f"in float16 the largest is {float(light.abs().max().half())}",
    )


def _coded(values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    step = full_scale(values, 16)
    return quantize(values, step, 16), step


@CASES.case(
    "sun-relit-in-wavelets",
    given="the same light on points that see the sun and points that do not",
    required="points in shadow are lit by the ambient to the digits of their type",
)
def sun_relit(dtype: torch.dtype) -> Outcome:
    """Transfer by texels in wavelets, uncompressed and by segments."""
    basis = Haar(16, 16)
    environment = cube_light(16, 1.0, 1e6, dtype)
    light = basis.project(environment).to(dtype)[None]
    directions = cubemap_directions(16, dtype=torch.float64).view(-1, 3)
    sun = directions[int(environment.image[..., 0].argmax())]
    normals = torch.nn.functional.normalize(
        torch.randn(40, 3, generator=generator(), dtype=torch.float64), dim=-1
    )
    cosines = (normals @ directions.mT).clamp_min(0.0)
    texels = cosines * (4.0 / 1536)
    texels[:, int(environment.image[..., 0].argmax())] *= (normals @ sun > 0.3).double()
    transfer = TransferTensor.from_dense(
        basis.project_cube(texels, 16).to(dtype), light_basis=basis
    )
    dark = normals @ sun <= 0.3
    expected = texels.sum(1)[dark]
    lit = evaluate.dense_radiance(transfer, light)[0, 0, :, 0].double()[dark]
    model = SegmentedCPCA.from_transfer(transfer, points_per_cluster=8, rank=8).eval()
    coded = model(light).detach()[0, :, 0, 0].double()[dark]
    # The sun's largest coefficient is 4e5 times the radiance that it must cancel out of.
    return Outcome(
        (
            at_least("points in shadow", int(dark.sum()), 10),
            at_most("error uncompressed", relative_error(lit, expected), 1e6 * rounding(dtype)),
        ),
        note=f"relative error by segments of 16-bit codes {relative_error(coded, expected):.2g}",
    )


@CASES.case(
    "clusters-smaller-than-the-rank",
    given="5 points a cluster at rank 16; clusters whose points take less room than a subspace",
    required="rank min(n, size), points kept raw where a subspace saves no room",
)
def small_clusters(dtype: torch.dtype) -> Outcome:
    """Random points, which nothing compresses, and points on a line, which anything does."""
    noise = torch.randn(25, 48, generator=generator()).to(dtype)
    # Scaled by 1024, all numbers are exact in both types.
    line = 2.0 ** (torch.arange(25.0) % 7)[:, None] * torch.arange(-31.0, 17.0).clamp_min(-16.0)
    models = []
    for values in (noise, line.to(dtype)):
        transfer = TransferTensor.from_dense(values)
        model = SegmentedCPCA.from_transfer(transfer, points_per_cluster=5, rank=16).eval()
        models.append((model, evaluate.transfer_error(model, transfer)))
    (raw, raw_error), (low, low_error) = models
    return Outcome(
        (
            exactly("random points kept raw", raw.statistics[0].raw_points, 25),
            at_most("their squared error", raw_error, 1e-8),
            exactly("points of a line kept raw", low.statistics[0].raw_points, 0),
            exactly("largest rank of a line", low.ranks.max(), 1),
            at_most("their squared error", low_error, 1e-7),
        ),
        condition=raw.condition,
    )


@CASES.case(
    "zero-segments-and-points",
    given="a segment of the light that no point sees, and points that see nothing",
    required="culled; their transfer is exactly 0",
)
def zero_segments(dtype: torch.dtype) -> Outcome:
    """Half of the segments and a quarter of the points are zero."""
    values = torch.randn(40, 64, generator=generator()).to(dtype)
    values[:, 32:] = 0.0
    values[30:] = 0.0
    transfer = TransferTensor.from_dense(values)
    model = SegmentedCPCA.from_transfer(
        transfer, points_per_cluster=10, rank=4, num_segments=4
    ).eval()
    dense, lit = model.dense().detach(), model(light_of(transfer)).detach()
    return Outcome(
        (
            exactly("largest transfer of zero segments", dense[..., 32:].abs().max(), 0.0),
            exactly("largest transfer of zero points", dense[30:].abs().max(), 0.0),
            exactly("largest radiance of zero points", lit[:, 30:].abs().max(), 0.0),
            near("share culled", model.culled_share, 1.0 - 30 * 2 / (40 * 4), 1e-12),
            exactly("numbers not finite", not_finite([dense, lit]), 0),
        )
    )


def _not_finite(factors: list[BRDFFactors]) -> int:
    return not_finite(tensor.detach() for one in factors for tensor in one.parameters())
