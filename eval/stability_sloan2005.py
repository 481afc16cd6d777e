"""Extremes of Sloan, Luna, Snyder 2005: lobes that coincide, axes at poles, meshes of any size."""

import math

import scipy.special
import torch
from stability_case import (
    Collection,
    Outcome,
    at_least,
    at_most,
    exactly,
    not_finite,
    rounding,
)
from stability_problems import ball_on_ground, generator, transfer_of
from torch import Tensor

from prt_torch import evaluate
from prt_torch.assets import mesh_from_arrays
from prt_torch.baking import bake, trace_visibility
from prt_torch.bases import SphericalHarmonics, sh, zonal
from prt_torch.bases.zonal_table import LatLongTable, band_table
from prt_torch.errors import InputError
from prt_torch.representations import ZonalLobes

CASES = Collection("Sloan 2005")
_RIDGE = 1e-7


def _units(count: int, seed: int, dtype: torch.dtype) -> Tensor:
    vectors = torch.randn(count, 3, generator=generator(seed), dtype=torch.float64)
    return torch.nn.functional.normalize(vectors, dim=-1).to(dtype)


@CASES.case(
    "exploding-lobes",
    given="random signals of 36 coefficients and norm 1, five lobes each, many starts",
    required="a ridge or cap, reported; without one coefficients reach 1.4e5",
    seconds=300.0,
    seeded=True,
)
def exploding_lobes(dtype: torch.dtype, seeds: int) -> Outcome:
    """One signal a seed, all fitted side by side."""
    signals = torch.cat([torch.randn(1, 36, generator=generator(seed)) for seed in range(seeds)])
    signals = torch.nn.functional.normalize(signals.double(), dim=-1).to(dtype)
    transfer = transfer_of(signals)
    model = ZonalLobes.from_transfer(transfer, num_lobes=5, ridge=_RIDGE, bits=None)
    errors = evaluate.squared_errors(model, transfer)
    told = model.statistics["largest_coefficient"]
    # Weights of lobes of norm one are at most norm / root of the ridge; g* is 3.55 times as much.
    bound = math.sqrt(4 * math.pi / _RIDGE)
    return Outcome(
        (
            at_most("largest coefficient", told, bound),
            exactly(
                "difference to what is told",
                told - float(model.coefficients.detach().abs().max()),
                0,
            ),
            at_most("largest squared error", errors.max(), 1.0),
            at_most("condition", model.condition, 1.01 * 5 / _RIDGE),
            exactly("numbers not finite", not_finite(p.detach() for p in model.parameters()), 0),
        ),
        condition=model.condition,
        note=f"mean relative error {float(errors.sqrt().mean()):.3g}, "
        f"unfinished {model.statistics['unfinished']:g} of {seeds}",
    )


@CASES.case(
    "signals-with-nothing-to-fit",
    given="zero, constant, linear and axial signals, four lobes",
    required="error 0, coefficients 0 where there is nothing, finite axes, unused lobes zero",
)
def nothing_to_fit(dtype: torch.dtype) -> Outcome:
    """An axial signal is one lobe, so three of four are spare."""
    signals = torch.zeros(6, 36, dtype=torch.float64)
    signals[1, 0] = 2.0
    signals[2, 1:4] = torch.tensor([0.3, -0.2, 0.9])
    axes = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.36, 0.48, 0.8]]).double()
    lobe = torch.tensor([3.0, 2.0, 0.8, 0.3, -0.2, 0.1], dtype=torch.float64).expand(3, 1, 6)
    signals[3:] = zonal.lobes_to_sh(axes[:, None], lobe)
    transfer = transfer_of(signals.to(dtype))
    checks = []
    for lobes in (1, 4):
        model = ZonalLobes.from_transfer(transfer, num_lobes=lobes, bits=None)
        errors = evaluate.squared_errors(model, transfer)
        where = f", {lobes} lobe{'s' if lobes > 1 else ''}"
        spare = model.coefficients.detach()[:3, 0, :, max(0, 2 - model.first_band) :]
        checks += [
            exactly("error of zero" + where, errors[0], 0.0),
            # The ridge takes its share of every lobe.
            at_most("largest squared error" + where, errors.max(), 1e-10 * 13.0),
            exactly("spare coefficients" + where, spare.abs().max(), 0.0),
            at_most(
                "axes off unit length" + where,
                (model.axes.detach().double().norm(dim=-1) - 1.0).abs().max(),
                4 * rounding(dtype),
            ),
        ]
    return Outcome(tuple(checks), condition=model.condition)


@CASES.case(
    "axes-at-the-poles",
    given="lobes along +z and -z, and axes of length 0, 1e-30 and 1e30",
    required="no division by the sine of an angle; finite values and gradients",
)
def axes_at_the_poles(dtype: torch.dtype) -> Outcome:
    """Harmonics of lobes, their fit, and gradients of both."""
    lengths = [1.0, -1.0, 0.0, 1e-30, -1e30]
    axes = torch.tensor([[[0.0, 0.0, one]] for one in lengths], dtype=dtype).requires_grad_()
    lobe = torch.linspace(2.0, 0.5, 6, dtype=dtype).expand(5, 1, 6)
    harmonics = zonal.lobes_to_sh(axes, lobe)
    fitted = zonal.fit_coefficients(harmonics, axes)
    slopes = torch.autograd.grad((harmonics.square().sum() + fitted.square().sum()), axes)
    turned = torch.tensor([1.0, -1.0, 1.0, 1.0, -1.0], dtype=dtype)
    signs = torch.ones(5, 36, dtype=dtype)
    for band in range(1, 6, 2):
        signs[:, band * band : (band + 1) ** 2] = turned[:, None]
    off = (harmonics.detach() * signs - harmonics.detach()[:1]).abs().max()
    return Outcome(
        (
            at_most("difference to +z, odd bands negated below", off, 8 * rounding(dtype)),
            at_most("coefficients fitted again", (fitted - lobe).abs().max(), 1e-7),
            exactly("values and gradients not finite", not_finite([harmonics, *slopes]), 0),
        )
    )


@CASES.case(
    "harmonics-of-high-order",
    given="spherical harmonics of order 6, 33 and 65",
    required="float32 within 7.9e-7, 3.6e-5, 1.3e-4 (its directions differ, twice is allowed); "
    "naive factorials overflow at m = 29 and l + m = 35",
)
def harmonics_of_high_order(dtype: torch.dtype) -> Outcome:
    """Float32 against float64 of the same directions, float64 against scipy."""
    directions = _units(2000, 0, dtype)
    exact = directions.double()
    polar = torch.atan2(exact[:, :2].norm(dim=-1), exact[:, 2]).numpy()
    azimuth = torch.atan2(exact[:, 1], exact[:, 0]).numpy()
    checks = []
    for order, limit in ((6, 7.9e-7), (33, 3.6e-5), (65, 1.3e-4)):
        found = sh.evaluate(directions, order)
        if dtype == torch.float32:
            worst = (found.double() - sh.evaluate(exact, order)).abs().max()
        else:
            band, limit = order - 1, 1e-11
            theirs = [_real_harmonic(band, m, polar, azimuth) for m in range(-band, band + 1)]
            worst = (found[:, band * band :] - torch.stack(theirs, dim=-1)).abs().max()
        checks.append(at_most(f"largest error at order {order}", worst, 2 * limit))
        checks.append(exactly(f"not finite at order {order}", not_finite([found]), 0))
    return Outcome(tuple(checks))


def _real_harmonic(band: int, m: int, polar: object, azimuth: object) -> Tensor:
    """Without the Condon-Shortley phase, from scipy's complex harmonics."""
    complex_values = scipy.special.sph_harm_y(band, abs(m), polar, azimuth)
    part = complex_values.real if m >= 0 else complex_values.imag
    return torch.from_numpy(part * ((-1.0) ** m * (math.sqrt(2.0) if m else 1.0)))


@CASES.case(
    "light-table",
    given="the 64 x 32 table of a light's bands, order 6",
    required="relative RMS by band 0, .0016, .0046, .0090, .0150, .0222; max/rms .14 of centre "
    "sampling's .40",
)
def light_table(dtype: torch.dtype) -> Outcome:
    """Random light looked up in random directions, against its harmonics."""
    table = LatLongTable(32, 64)
    light = torch.randn(64, 36, generator=generator()).to(dtype)
    directions = _units(4000, 1, dtype)
    looked_up = table.lookup(band_table(light, table).flatten(1), directions)
    looked_up = looked_up.unflatten(1, (64, 6)).double()
    functions = sh.evaluate(directions.double(), 6)
    checks = []
    for band, expected in enumerate((0.0, 0.0016, 0.0046, 0.0090, 0.0150, 0.0222)):
        own = slice(band * band, (band + 1) ** 2)
        exact = functions[:, own] @ light[:, own].double().mT
        wrong = looked_up[:, :, band] - exact
        relative = wrong.square().mean().sqrt() / exact.square().mean().sqrt()
        limit = max(1.15 * expected, 8 * rounding(dtype))
        checks.append(at_most(f"relative RMS of band {band}", relative, limit))
    poles = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=dtype)
    exact = sh.evaluate(poles.double(), 6) @ light.double().mT
    at_poles = table.lookup(band_table(light, table).flatten(1), poles)
    off = (at_poles.unflatten(1, (64, 6)).double().sum(-1) - exact).abs().max()
    checks.append(at_most("error at the poles", off, 200 * rounding(dtype)))
    return Outcome(tuple(checks))


@CASES.case(
    "meshes-of-any-size",
    given="the same mesh with edges from 2^-100 to 2^100 (float32) or 2^-300 to 2^300 (float64), "
    "and faces without area",
    required="normals exact to 1e-7; squares of edges are denormal below 3.3e-10 in float32; "
    "faces without area have weight 0",
)
def meshes_of_any_size(dtype: torch.dtype) -> Outcome:
    """Normals against those of the plain mesh."""
    plain = ball_on_ground(1.0, dtype).normals
    reach = 100 if dtype == torch.float32 else 300
    worst = max(  # powers of two, so that vertices are rounded alike
        float((ball_on_ground(2.0**one, dtype).normals - plain).abs().max())
        for one in (-reach, -40, -33, 33, reach)
    )
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], dtype=dtype)
    flat = mesh_from_arrays("flat", corners, torch.tensor([[0, 1, 2], [0, 1, 3], [1, 1, 2]]))
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    counted = {warning.name: warning.count for warning in flat.warnings}
    return Outcome(
        (
            at_most("largest difference of a normal", worst, 1e-7),
            at_most("normals beside faces without area", (flat.normals[:3] - up).abs().max(), 0.0),
            exactly("faces without area named", counted.get("zero_area_faces", 0), 2),
            exactly("points without a normal named", counted.get("undefined_normals", 0), 1),
            exactly("numbers not finite", not_finite([flat.normals]), 0),
        )
    )


@CASES.case(
    "duplicate-vertices",
    given="a mesh of which every vertex is there twice",
    required="identical rows of transfer",
)
def duplicate_vertices(dtype: torch.dtype) -> Outcome:
    """The second copies have no face of their own, but the normals of the first."""
    mesh = ball_on_ground(1.0, dtype)
    twice = mesh_from_arrays(
        "twice",
        mesh.vertices.repeat(2, 1),
        torch.cat([mesh.faces, mesh.faces + mesh.num_points]),
        normals=mesh.normals.repeat(2, 1),
    )
    values = bake(twice, light_basis=SphericalHarmonics(4), resolution=8, supersampling=2).dense()
    first, second = values.split(mesh.num_points)
    return Outcome(
        (
            exactly("largest difference of rows", (first - second).abs().max(), 0.0),
            at_least("largest transfer", values.abs().max(), 0.1),
            exactly("numbers not finite", not_finite([values]), 0),
        )
    )


@CASES.case(
    "scenes-scaled-by-powers-of-two",
    given="the same scene at 2^-20 to 2^20 of its size",
    required="visibility bits identical; offsets of rays relative to the bounding box",
)
def scaled_scenes(dtype: torch.dtype) -> Outcome:
    """All bits of all points."""

    def bits(scale: float) -> Tensor:
        mesh = ball_on_ground(scale, dtype)
        field = trace_visibility(mesh, resolution=8, supersampling=2)
        return field.unpack(slice(0, mesh.num_points))

    plain = bits(1.0)
    different = sum(int((bits(2.0**one) != plain).sum()) for one in (-20, -7, 5, 20))
    return Outcome(
        (
            exactly("different bits", different, 0),
            at_least("share of rays that are free", plain.float().mean(), 0.1),
        )
    )


@CASES.case(
    "numbers-that-are-none",
    given="NaN and infinite vertices, NaN transfer, normals and axes of any length",
    required="rejected by name and place; lengths normalised",
)
def numbers_that_are_none(dtype: torch.dtype) -> Outcome:
    """Messages name the vertex; normals come out as unit vectors."""
    corners = torch.tensor([[0.0, 0, 0], [0, 0, 1], [1, 0, 0]], dtype=dtype)
    faces = torch.tensor([[0, 1, 2]])
    named = 0
    for bad in (math.nan, math.inf, -math.inf):
        wrong = corners.clone()
        wrong[1, 2] = bad
        try:
            mesh_from_arrays("scene", wrong, faces)
        except InputError as error:
            named += "vertex 1" in str(error) and "\n" not in str(error)
        try:
            transfer_of(wrong[1:2, 2:].expand(1, 36))
        except ValueError as error:
            named += "NaN or infinite" in str(error)
    lengths = torch.tensor([[0.0, 1e-3, 0], [0, 40.0, 0], [0, 1e10, 0]], dtype=dtype)
    mesh = mesh_from_arrays("scene", corners, faces, normals=lengths)
    return Outcome(
        (
            exactly("messages that name what is wrong", named, 6),
            at_most("normals off unit length", (mesh.normals.norm(dim=1) - 1).abs().max(), 1e-15),
        )
    )
