"""Extreme lights, scenes and budgets: the inputs that every task shares."""

import math

import torch
from stability_case import (
    Check,
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
from stability_problems import (
    cube_light,
    every_representation,
    generator,
    light_of,
    transfer_of,
)
from torch import Tensor

from prt_torch import evaluate
from prt_torch.assets import constant, mesh_from_arrays
from prt_torch.baking import bake
from prt_torch.bases import SRBF, CubeDirections, Haar, LightBasis, SphericalHarmonics
from prt_torch.bases.zonal import clamped_cosine_coefficients, zonal_to_sh
from prt_torch.errors import InputError
from prt_torch.relight import Relighter
from prt_torch.representations import CPCA, ClusteredTensor, ScatteredSRBF, SegmentedCPCA
from prt_torch.transfer import TransferTensor

CASES = Collection("every task")


def _bases() -> list[LightBasis]:
    return [SphericalHarmonics(6), CubeDirections(8), Haar(8, 8), SRBF(42, resolution=8)]


def _points(seed: int, dtype: torch.dtype) -> Tensor:
    """A few smooth groups of points, 36 coefficients each."""
    source = generator(seed)
    groups = torch.randn(3, 36, generator=source)[torch.randint(3, (24,), generator=source)]
    return (groups + 0.2 * torch.randn(24, 36, generator=source)).to(dtype)


@CASES.case(
    "sun-of-1e9-over-ambient-1",
    given="one texel of 1e9 over ambient 1, in every light basis",
    required="the ambient survives; a plain float32 running sum loses 99.8 % of it",
    seconds=60.0,
)
def sun_over_ambient(dtype: torch.dtype) -> Outcome:
    """Light with the sun, less light of the sun alone, is light of the ambient."""
    lights = [
        cube_light(16, ambient, sun, dtype) for ambient, sun in ((1.0, 1e9), (0.0, 1e9), (1.0, 0.0))
    ]
    checks = []
    for basis in _bases():
        both, sun, ambient = (basis.project(light) for light in lights)
        error = relative_error(both - sun, ambient)
        checks.append(at_most(f"relative error of the ambient, {basis.name}", error, 1e-6))
        checks.append(at_least("sun over ambient", sun.norm() / ambient.norm(), 1e5))
    running = torch.tensor(1e9)
    for _ in range(1535):
        running = running + 1.0
    kept = (float(running) - 1e9) / 1535
    return Outcome(tuple(checks), note=f"a float32 running sum keeps {kept:.1%} of the ambient")


@CASES.case(
    "black-environment",
    given="an environment that is black, in every light basis and representation",
    required="radiance exactly 0, nothing divided by it",
    seconds=60.0,
)
def black_environment(dtype: torch.dtype) -> Outcome:
    """Coefficients, radiance, errors of radiance, and a fit of scattered functions."""
    black = constant(0.0)
    coefficients = [basis.project(black) for basis in _bases()]
    models = every_representation(_points(0, dtype))
    lit = [Relighter(model)(torch.zeros(1, 36, 3, dtype=dtype)).detach() for model, _ in models]
    fitted = ScatteredSRBF.fit_environment(black, 8, resolution=8)
    error = evaluate.radiance_error(lit[0], lit[0])
    return Outcome(
        (
            exactly("largest coefficient", max(float(c.abs().max()) for c in coefficients), 0),
            exactly("largest radiance", max(float(one.abs().max()) for one in lit), 0),
            exactly("relative error of radiance", error, 0),
            exactly("squared error of scattered functions", fitted.squared_error[0], 0),
            exactly("largest of their colours", fitted.expansion.coefficients.abs().max(), 0),
            exactly("numbers not finite", not_finite([*coefficients, *lit]), 0),
        ),
        condition=fitted.condition[0],
        note=f"fit {fitted.status[0]}",
    )


def _scaled(dtype: torch.dtype, factor: float, limit: float) -> list[Check]:
    """How much relative errors of each representation differ at another scale of transfer."""
    checks, bad = [], 0
    plain = every_representation(_points(0, dtype))
    scaled = every_representation(_points(0, dtype) * factor)
    for (one, of_one), (other, of_other) in zip(plain, scaled, strict=True):
        expected = relative_error(one.dense(), of_one.dense())
        unscaled = of_other.dense().double() / factor
        found = relative_error(other.dense().double() / factor, unscaled)
        change = abs(found - expected)
        checks.append(at_most(f"change of relative error at {factor:g}, {one.kind}", change, limit))
        lit = other(light_of(of_other)).detach()
        bad += not_finite([lit, *(p.detach() for p in other.parameters())])
    return [*checks, exactly(f"numbers not finite at {factor:g}", bad, 0)]


@CASES.case(
    "denormal-transfer",
    given="transfer of 1e-40 (float32) or 1e-309 (float64) in every representation",
    required="finite; errors those of plain transfer but for the digits that denormals lack",
)
def denormal_transfer(dtype: torch.dtype) -> Outcome:
    """Such numbers have 16 bits in float32, 48 in float64."""
    return Outcome(tuple(_scaled(dtype, 1e-40 if dtype == torch.float32 else 1e-309, 0.01)))


@CASES.case(
    "least-denormals",
    given="transfer of 1e-44 (float32) or 1e-322 (float64): a few of the least numbers there are",
    required="finite; never worse than nothing",
)
def least_denormals(dtype: torch.dtype) -> Outcome:
    """One number is one or two bits."""
    factor = 1e-44 if dtype == torch.float32 else 1e-322
    checks, bad = [], 0
    for model, transfer in every_representation(_points(0, dtype) * factor):
        scale = float(transfer.dense().abs().max())
        dense = transfer.dense().double() / scale
        error = relative_error(model.dense().double() / scale, dense)
        checks.append(at_most(f"relative error, {model.kind}", error, 1.01))
        bad += not_finite([model(light_of(transfer)), *model.parameters()])
    return Outcome((*checks, exactly("numbers not finite", bad, 0)))


@CASES.case(
    "transfer-of-65504",
    given="transfer of 65504 / 4, 1e15 and 1e-18 in every representation",
    required="finite; errors those of plain transfer",
)
def transfer_of_65504(dtype: torch.dtype) -> Outcome:
    """Scale changes nothing but the scale; the largest value of the first is that of float16."""
    # Searches may take another turn where rounding differs.
    checks = [_scaled(dtype, factor, 0.01) for factor in (65504.0 / 4, 1e15, 1e-18)]
    return Outcome(tuple(check for some in checks for check in some))


@CASES.case(
    "lights-of-any-brightness",
    given="light of 1e-41, 65504 and 1e30 on plain transfer, in every representation",
    required="radiance finite and proportional to the light",
)
def lights_of_any_brightness(dtype: torch.dtype) -> Outcome:
    """Against the same light at its own brightness."""
    checks = []
    models = every_representation(_points(0, dtype))
    for factor, limit in ((1e-41, 1e-2), (65504.0, 0.0), (1e30, 0.0)):
        worst, bad = 0.0, 0
        for model, transfer in models:
            light = light_of(transfer)
            expected = model(light).detach().double() * factor
            found = model(light * factor).detach()
            worst = max(worst, relative_error(found.double() / factor, expected / factor))
            bad += not_finite([found])
        checks.append(
            at_most(f"relative error at {factor:g}", worst, max(limit, 256 * rounding(dtype)))
        )
        checks.append(exactly(f"numbers not finite at {factor:g}", bad, 0))
    return Outcome(tuple(checks))


@CASES.case(
    "one-vertex",
    given="a mesh of one vertex, with a face without area and with none; transfer of one point",
    required="a face without area is named and its point black; no face is an error of one line",
)
def one_vertex(dtype: torch.dtype) -> Outcome:
    """A bake of nothing, and every representation of one point."""
    vertex = torch.zeros(1, 3, dtype=dtype)
    mesh = mesh_from_arrays("one", vertex, torch.zeros(1, 3, dtype=torch.int64))
    transfer = bake(mesh, light_basis=SphericalHarmonics(4), resolution=8, supersampling=2)
    try:
        mesh_from_arrays("one", vertex, torch.zeros(0, 3, dtype=torch.int64))
        told = 0
    except InputError as error:
        told = int("no faces" in str(error) and "\n" not in str(error))
    models = every_representation(_points(0, dtype)[:1])
    errors = [evaluate.transfer_error(model, own) for model, own in models]
    bad = sum(not_finite(p.detach() for p in model.parameters()) for model, _ in models)
    named = {warning.name for warning in mesh.warnings}
    return Outcome(
        (
            exactly("warning of a face without area", int("zero_area_faces" in named), 1),
            exactly("largest transfer of the point", transfer.dense().abs().max(), 0),
            exactly("error of one line for no face", told, 1),
            at_most("squared error of one point by CPCA", errors[1], rounding(dtype) ** 2),
            at_most("largest of any", max(errors), 1.0),
            exactly("numbers not finite", bad, 0),
        )
    )


@CASES.case(
    "one-triangle",
    given="a mesh of one triangle",
    required="transfer is the clamped cosine over pi in each band, at all three points",
)
def one_triangle(dtype: torch.dtype) -> Outcome:
    """Closed form, and every representation of the three points."""
    corners = torch.tensor([[0.0, 0, 0], [0, 0, 1], [1, 0, 0]], dtype=dtype)
    mesh = mesh_from_arrays("one", corners, torch.tensor([[0, 1, 2]]))
    transfer = bake(mesh, light_basis=SphericalHarmonics(6))
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    expected = zonal_to_sh(clamped_cosine_coefficients(6) / math.pi, up)
    found = transfer.dense()[:, 0, 0].to(dtype)
    models = every_representation(found)
    errors = [evaluate.transfer_error(model, own) for model, own in models]
    bad = sum(not_finite(p.detach() for p in model.parameters()) for model, _ in models)
    return Outcome(
        (
            at_most("largest error of a coefficient", (found - expected).abs().max(), 2e-4),
            at_most("difference of the points", (found - found[:1]).abs().max(), 1e-6),
            at_most("squared error of three points by CPCA", errors[1], 1e-10),
            at_most("largest of any", max(errors), 1.0),
            exactly("numbers not finite", bad, 0),
        )
    )


@CASES.case(
    "rank-above-what-there-is",
    given="20 points of 9 values, ranks of 40 and 1000",
    required="capped; nothing lost, nothing not finite",
)
def rank_above(dtype: torch.dtype) -> Outcome:
    """Wide and tall tensors."""
    checks = []
    for shape in ((20, 9), (9, 20)):
        values = torch.randn(*shape, generator=generator()).to(dtype)
        transfer = TransferTensor.from_dense(values)
        worst, bad = 0.0, 0
        for rank in (40, 1000):
            models = [
                CPCA.from_transfer(transfer, num_clusters=2, rank=rank, method=method)
                for method in ("static", "iterative", "adaptive")
            ]
            full = (rank, rank, rank)
            for model in (
                *models,
                ClusteredTensor.from_transfer(transfer, num_clusters=2, ranks=full, bits=None),
            ):
                worst = max(worst, evaluate.transfer_error(model, transfer))
                bad += not_finite(p.detach() for p in model.parameters())
        size = f"{shape[0]} x {shape[1]}"
        checks.append(at_most(f"squared error of {size}", worst, (32 * rounding(dtype)) ** 2))
        checks.append(exactly(f"numbers not finite, {size}", bad, 0))
    return Outcome(tuple(checks))


@CASES.case(
    "more-clusters-than-distinct-points",
    given="15 and 100 points of which 3 are distinct, 9 clusters",
    required="3 clusters, none empty, error 0",
    seconds=240.0,
    seeded=True,
)
def more_clusters(dtype: torch.dtype, seeds: int) -> Outcome:
    """CPCA over all seeds; slower representations over a tenth of them."""
    made = {"CPCA": 0, "clustered tensor": 0}
    worst, smallest, bad = 0.0, 100, 0
    for seed in range(seeds):
        distinct = torch.randn(3, 36, generator=generator(seed)).to(dtype)
        for count in (15, 100):
            transfer = TransferTensor.from_dense(distinct[torch.arange(count) % 3])
            models: dict[str, CPCA | ClusteredTensor] = {
                "CPCA": CPCA.from_transfer(transfer, num_clusters=9, rank=2)
            }
            if seed % 10 == 0:
                models["clustered tensor"] = ClusteredTensor.from_transfer(
                    transfer, num_clusters=9, ranks=(1, 12, 6), bits=None
                )
            for name, model in models.items():
                made[name] = max(made[name], model.num_clusters)
                smallest = min(smallest, int(torch.bincount(model.labels).min()))
                worst = max(worst, evaluate.transfer_error(model, transfer))
                bad += not_finite(p.detach() for p in model.parameters())
    return Outcome(
        (
            *(exactly(f"most clusters, {name}", count, 3) for name, count in made.items()),
            at_least("points of the smallest cluster", smallest, 1),
            at_most("squared error", worst, (16 * rounding(dtype)) ** 2),
            exactly("numbers not finite", bad, 0),
        )
    )


@CASES.case(
    "scale-of-segments",
    given="segments of the light whose transfer differs by 1e12",
    required="each at its own scale: the small ones are kept as well as the large",
)
def scale_of_segments(dtype: torch.dtype) -> Outcome:
    """Error of each segment by itself."""
    values = torch.cat([_points(0, dtype), _points(1, dtype) * 1e-12], dim=1)
    transfer = TransferTensor.from_dense(values)
    model = SegmentedCPCA.from_transfer(transfer, points_per_cluster=8, rank=6, num_segments=2)
    plain = SegmentedCPCA.from_transfer(
        transfer_of(_points(1, dtype)), points_per_cluster=8, rank=6, num_segments=1
    )
    dense = model.eval().dense().detach()[:, 0, 0]
    expected = relative_error(plain.eval().dense().detach()[:, 0, 0], _points(1, dtype))
    lost = relative_error(dense[:, 36:], values[:, 36:])
    return Outcome(
        (
            near("relative error of the small segment over that alone", lost / expected, 1.0, 0.25),
            exactly("numbers not finite", not_finite([dense]), 0),
        ),
        condition=model.condition,
    )
