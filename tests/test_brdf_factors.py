"""BRDF factors: known spectra, second implementations, optimality, and factors as an exit basis."""

import itertools
import math

import numpy as np
import pytest
import torch

import prt_torch
from prt_torch.assets.brdf import (
    AshikhminShirley,
    BlinnPhong,
    Lambert,
    Phong,
    Sum,
    brdf,
)
from prt_torch.bases import BRDFFactors, HemisphereMap, exit_basis, factor_error, sh
from prt_torch.bases.brdf_error import even_directions
from prt_torch.bases.brdf_factoring import Target, leading_eigenpairs, singular_factors
from prt_torch.bases.brdf_moments import bilinear_moments, interpolated_factors
from prt_torch.bases.brdf_refinement import refine
from prt_torch.representations import DenseTransfer
from prt_torch.sphere import cubemap_directions, cubemap_solid_angles, frame_from_normal
from prt_torch.transfer import TransferTensor

ANISOTROPIC = AshikhminShirley(specular=0.75, diffuse=0.5, exponent_u=10.0, exponent_v=100.0)
GLOSSY = BlinnPhong(specular=0.4, exponent=12.0)
COLOURED = Sum((Lambert((0.6, 0.3, 0.1)), GLOSSY))
TINTED = Sum(
    (
        Lambert((0.2, 0.1, 0.4)),
        BlinnPhong(specular=(0.5, 0.3, 0.1), exponent=12.0),
        Phong(specular=(0.1, 0.2, 0.4), exponent=5.0),
    )
)


def even(count: int, seed: int) -> torch.Tensor:
    return even_directions(count, torch.Generator().manual_seed(seed))


def coloured(factors: BRDFFactors, views: torch.Tensor) -> torch.Tensor:
    """View functions with an axis of colours, even of one."""
    seen = factors.evaluate(views).detach()
    return seen if factors.num_channels == 3 else seen[..., None]


def pairs(factors: BRDFFactors, lights: torch.Tensor, views: torch.Tensor) -> torch.Tensor:
    """Reflection times cosine by pairs of directions: "... colours"."""
    lit = factors.light(lights).detach()
    return torch.einsum("...kc,...k->...c", coloured(factors, views), lit)


class Channel:
    """One colour of a model."""

    num_channels = 1

    def __init__(self, model, channel: int):
        self.model, self.channel = model, channel

    def evaluate(self, wi, wo):
        return self.model.evaluate(wi, wo)[..., self.channel, None]


class Rank:
    """A separable model, which one term gives exactly."""

    num_channels = 1

    def __init__(self, scale: float):
        self.scale = scale

    def evaluate(self, wi, wo):
        return (self.scale * wi[..., 2] * wo[..., 2])[..., None]


# --- the closed forms, against what is known of them ------------------------------------------


def test_singular_factors_are_numpys():
    hemisphere, directions = HemisphereMap("parabolic", 8), HemisphereMap("parabolic", 8).centres()
    centres, used = directions[0][directions[1]], directions[1]
    matrix = GLOSSY.evaluate(centres, centres[:, None])[..., 0] * centres[:, 2]
    left, singular, right = np.linalg.svd(matrix.clamp(max=0.4).numpy())
    best = torch.from_numpy(left[:, :5] * singular[:5] @ right[:5])
    found = singular_factors(Target([GLOSSY], True, 0.4), hemisphere, 5, supersampling=1)
    again = (found.view[:, 0].mT @ found.light[0])[used][:, used]
    assert torch.allclose(again, best, atol=1e-12)
    assert torch.allclose(found.energies, torch.from_numpy(singular[:5] ** 2), rtol=1e-10)
    # The scale is shared by both sides, equation 9.
    norms = (found.view[:, 0][:, used].norm(dim=1), found.light[0][:, used].norm(dim=1))
    assert torch.allclose(*norms)


def test_singular_factors_are_of_means_over_pairs_of_texels():
    hemisphere = HemisphereMap("orthographic", 4)
    found = singular_factors(Target([GLOSSY], True), hemisphere, 16, supersampling=3)
    again = found.view[:, 0].mT @ found.light[0]
    fine, inside = hemisphere.centres(3)
    _, used = hemisphere.centres()
    texel_of = (hemisphere.coordinates(fine) * 4).long().clamp(0, 3) @ torch.tensor([1, 4])
    for view, light in [(5, 6), (5, 10), (1, 9), (4, 4)]:
        assert bool(used[view])
        assert bool(used[light])
        views, lights = fine[inside & (texel_of == view)], fine[inside & (texel_of == light)]
        values = GLOSSY.evaluate(lights, views[:, None])[..., 0] * lights[:, 2]
        assert float(again[view, light]) == pytest.approx(float(values.mean()), rel=1e-10)


def test_eigenpairs_that_power_iteration_misses():
    values, vectors = leading_eigenpairs(torch.diag(torch.tensor([1.0, -1.0, 0.5]).double()), 3)
    assert sorted(values.tolist()) == pytest.approx([-1.0, 0.5, 1.0], abs=1e-12)
    assert torch.allclose(vectors.mT @ vectors, torch.eye(3, dtype=torch.float64))


def test_degenerate_matrices():
    values, _ = leading_eigenpairs(torch.zeros(4, 4, dtype=torch.float64), 3)
    assert values.tolist() == [0.0, 0.0, 0.0]
    for scale, method in itertools.product((0.0, 1.0, 1e-6), ("symmetric", "singular")):
        factors = BRDFFactors.from_brdf(Rank(scale), num_terms=3, method=method, resolution=8)
        assert bool(torch.isfinite(factors.view_values).all())
        terms = factors.view_values[:, 0, :, None] * factors.light_values[0, :, None]
        sizes = terms.abs().amax((1, 2)).tolist()
        assert max(sizes[1:]) <= 1e-12 * sizes[0] + 0.0
        if method == "symmetric":
            assert sizes[1:] == [0.0, 0.0]
            assert not bool(factors.light_values[0, 1:].any())


def spectrum(factors: BRDFFactors) -> torch.Tensor:
    """Eigenvalues from the maps: squared norms of light maps with the sign of the view maps."""
    _, used = factors.hemisphere.centres()
    view, light = (
        factors.view_values[:, 0, used].double(),
        factors.light_values[0][:, used].double(),
    )
    return (view * light).sum(1).detach()


def test_spectra_of_ashikhmin_shirley():
    # Algorithms of Wang et al. 2004: raw, 16 x 16, terms 3 and 4 differ in sign only.
    raw = BRDFFactors.from_brdf(
        ANISOTROPIC,
        num_terms=4,
        method="symmetric",
        mapping="orthographic",
        resolution=16,
        clamp=None,
    )
    third, fourth = sorted(spectrum(raw)[2:].tolist())
    assert (third, fourth) == pytest.approx((-51.7893, 51.7893), abs=6e-5)
    # Cut off at 3, 48 x 48.
    cut = BRDFFactors.from_brdf(
        ANISOTROPIC, num_terms=6, method="symmetric", mapping="orthographic", resolution=48
    )
    expected = [384.24929, -295.37992, 262.68206, -225.00651, -192.10393, 188.46572]
    assert spectrum(cut).tolist() == pytest.approx(expected, rel=1.7e-7)
    assert not cut.cosine


def test_symmetric_rows_of_colours_go_by_magnitude():
    factors = BRDFFactors.from_brdf(TINTED, num_terms=2, method="symmetric", resolution=8)
    assert (factors.num_rows, factors.num_channels) == (6, 3)
    magnitudes = (factors.view_values * factors.light_values[0][:, None]).sum(2).abs().amax(1)
    assert magnitudes.tolist() == sorted(magnitudes.tolist(), reverse=True)
    for channel in range(3):
        own = BRDFFactors.from_brdf(
            Channel(TINTED, channel), num_terms=2, method="symmetric", resolution=8
        )
        lights, views = even(5, 0), even(6, 1)
        of_channel = factors.evaluate(views)[..., channel] @ factors.light(lights).mT
        assert torch.allclose(of_channel, own.evaluate(views) @ own.light(lights).mT, atol=1e-6)


def test_harmonic_factors_by_direct_quadrature():
    model = Phong(specular=0.5, exponent=4.0)
    factors = BRDFFactors.from_brdf(
        model, num_terms=16, method="harmonic", resolution=6, light_order=4, clamp=None
    )
    directions = cubemap_directions(64, dtype=torch.float64).reshape(-1, 3)
    solid_angles = cubemap_solid_angles(64, dtype=torch.float64).flatten()
    above = directions[:, 2] > 0
    directions, solid_angles = directions[above], solid_angles[above]
    weighted = sh.evaluate(directions, 4) * (solid_angles * directions[:, 2])[:, None]
    views, used = factors.hemisphere.centres()
    expected = model.evaluate(directions, views[used][:, None])[..., 0] @ weighted
    found = factors.evaluate(views[used]).double() @ factors.light_values[0].double()
    assert torch.allclose(found, expected, atol=3e-4 * float(expected.abs().max()))
    lights = even(20, 2)
    by_light = expected @ sh.evaluate(lights, 4).mT
    found = (factors.evaluate(views[used]) @ factors.light(lights).mT).detach()
    assert torch.allclose(found, by_light, atol=1e-3 * float(by_light.abs().max()))


# --- the optimum through lookups --------------------------------------------------------------


def test_moments_give_the_error_of_lookups():
    """The objective is the plain sum over its quadrature, and its optimum has no slope."""
    hemisphere, target = HemisphereMap("concentric", 4), Target([TINTED, GLOSSY], False, 0.3)
    moments = bilinear_moments(target, hemisphere, supersampling=2)
    generator = torch.Generator().manual_seed(0)
    view = torch.rand(2, 3, 16, generator=generator, dtype=torch.float64)
    light = torch.rand(2, 2, 16, generator=generator, dtype=torch.float64)
    (views, of_views), (lights, of_lights) = hemisphere.nodes(2), hemisphere.nodes(3)
    mirrored = torch.cdist(views * views.new_tensor([-1.0, -1.0, 1.0]), lights)
    assert float(mirrored.min()) > 0.02
    total = 0.0
    for material, model in enumerate(target.brdfs):
        values = model.evaluate(lights, views[:, None]).clamp(max=0.3).expand(-1, -1, 3)
        seen = hemisphere.lookup(view.flatten(0, 1), views).unflatten(-1, (2, 3))
        mixed = torch.einsum("vkc,sk->vsc", seen, hemisphere.lookup(light[material], lights))
        wrong = ((mixed - values) * lights[:, 2:]).square().sum(2)
        total += float(of_views @ wrong @ of_lights)
    assert float(moments.error(view, light)) == pytest.approx(total, rel=1e-6)
    free = (view.requires_grad_(), light.requires_grad_())
    assert torch.autograd.gradcheck(moments.error, free)


def test_no_step_improves_the_closed_form():
    hemisphere = HemisphereMap("parabolic", 8)
    moments = bilinear_moments(Target([ANISOTROPIC], True, 3.0), hemisphere)
    found = interpolated_factors(moments, hemisphere, 4)
    before = float(moments.error(found.view, found.light))
    free = [found.view.requires_grad_(), found.light.requires_grad_()]
    optimizer = torch.optim.LBFGS(free, max_iter=100, line_search_fn="strong_wolfe")

    def closure():
        optimizer.zero_grad()
        error = moments.error(*free) / moments.energy
        error.backward()
        return error

    optimizer.step(closure)
    after = float(moments.error(*free).detach())
    assert before * (1 - 1e-6) < after <= before
    # Its own account is that of the ridged problem, a little above the truth.
    account = found.energy - float(found.energies.sum())
    assert before <= account <= 1.002 * before


def test_interpolated_is_the_best_on_fresh_pairs():
    make = {
        "interpolated": {},
        "singular": {},
        "harmonic": {"light_order": 5},
    }
    errors = {}
    for method, options in make.items():
        factors = BRDFFactors.from_brdf(
            ANISOTROPIC, num_terms=6, method=method, resolution=12, **options
        )
        measured = factor_error(factors, ANISOTROPIC, clamp=3.0, num_pairs=40_000)
        errors[method] = measured.relative
    assert errors["interpolated"] < 0.99 * min(errors["singular"], errors["harmonic"])
    # Without the cosine the same closed form answers Wang's question.
    wang = BRDFFactors.from_brdf(ANISOTROPIC, num_terms=6, method="symmetric", resolution=12)
    better = refine(wang, ANISOTROPIC)
    before, after = (
        factor_error(f, ANISOTROPIC, clamp=3.0, num_pairs=40_000).relative
        for f in (wang, better.factors)
    )
    assert after < 0.97 * before
    assert after == pytest.approx(better.error_after, rel=0.05)


def test_measured_error_by_a_loop():
    factors = BRDFFactors.from_brdf(COLOURED, num_terms=3, resolution=8)
    error = factor_error(factors, COLOURED, num_pairs=50)
    generator = torch.Generator().manual_seed(0)
    lights, views = (even_directions(50, generator) for _ in range(2))
    wrong, squares, largest = 0.0, 0.0, 0.0
    for light, view in zip(lights, views, strict=True):
        expected = COLOURED.evaluate(light, view) * light[2]
        found = pairs(factors, light, view)
        wrong += float((found - expected).square().mean())
        squares += float(expected.square().mean())
        largest = max(largest, float((found - expected).abs().max()))
    assert error.rms == pytest.approx(math.sqrt(wrong / 50), rel=1e-9)
    assert error.relative == pytest.approx(math.sqrt(wrong / squares), rel=1e-9)
    assert error.largest == pytest.approx(largest, rel=1e-9)
    perfect = factor_error(factors, _Reproduced(factors))
    assert perfect.relative < 1e-6
    assert perfect.albedo < 1e-5
    assert perfect.worst_view < 1e-5


class _Reproduced:
    """The model that factors stand for exactly."""

    num_channels = 3

    def __init__(self, factors: BRDFFactors):
        self.factors = factors

    def evaluate(self, wi, wo):
        return pairs(self.factors, wi, wo) / wi[..., 2:]


@pytest.mark.parametrize("method", ["interpolated", "singular", "symmetric", "harmonic"])
def test_max_error_is_honoured(method):
    options = {"method": method, "resolution": 8, "clamp": 3.0}
    factors = BRDFFactors.from_brdf(GLOSSY, num_terms=None, max_error=0.2, **options)
    assert factors.rms is not None
    assert factors.rms <= 0.2
    fewer = BRDFFactors.from_brdf(GLOSSY, num_terms=factors.num_rows - 1, **options)
    assert fewer.rms is not None
    assert fewer.rms > 0.2
    if method in ("interpolated", "harmonic"):  # others are exact for their texels in the end
        with pytest.raises(ValueError, match=r"max_error: \d+ terms at this resolution reach .*"):
            BRDFFactors.from_brdf(GLOSSY, num_terms=None, max_error=1e-4, **options)


def test_harmonic_account_holds_what_harmonics_lose():
    model = Phong(specular=0.5, exponent=4.0)
    factors = BRDFFactors.from_brdf(
        model, num_terms=16, method="harmonic", resolution=8, light_order=4, clamp=None
    )
    views, used = factors.hemisphere.centres()
    lights, solid_angles = sh.hemisphere_quadrature(63)
    values = model.evaluate(lights, views[used][:, None])[..., 0] * lights[:, 2]
    full = torch.cat([lights, lights * torch.tensor([1.0, 1.0, -1.0])])  # the whole sphere
    series = factors.evaluate(views[used]) @ factors.light_values[0].double()
    wrong = (series @ sh.evaluate(full, 4).mT).detach()
    wrong[:, : len(lights)] -= values
    error = (wrong.square() @ solid_angles.repeat(2)).sum() / (values.square() @ solid_angles).sum()
    assert factors.rms == pytest.approx(math.sqrt(error), rel=1e-4)


# --- colours, materials, constants ------------------------------------------------------------


def check_colours_share_rows(model, resolution: int, max_error: float) -> None:
    """No factoring of each colour alone reaches the error of all together with fewer rows."""
    hemisphere = HemisphereMap("parabolic", resolution)
    whole = bilinear_moments(Target([model], True, 3.0), hemisphere)
    alone = [bilinear_moments(Target([Channel(model, c)], True, 3.0), hemisphere) for c in range(3)]
    assert whole.energy == pytest.approx(sum(m.energy for m in alone), rel=1e-5)
    spectra = [interpolated_factors(m, hemisphere, 40).energies for m in alone]
    together = interpolated_factors(whole, hemisphere, 60)

    def rows_needed(energies: torch.Tensor) -> int:
        left = whole.energy - energies.sort(descending=True).values.cumsum(0)
        return int((left > max_error**2 * whole.energy).sum()) + 1

    apart = rows_needed(torch.cat(spectra))
    assert together.light.shape[:2] == (1, 60)
    assert rows_needed(together.energies) < apart
    explained = torch.cat(spectra).sort(descending=True).values.cumsum(0)
    assert bool((together.energies.cumsum(0) >= explained[:60] * (1 - 1e-6)).all())


def test_colours_share_light_maps():
    check_colours_share_rows(TINTED, 8, 0.1)
    factors = BRDFFactors.from_brdf(TINTED, num_terms=4, resolution=8)
    assert tuple(factors.light_values.shape) == (1, 4, 64)
    assert tuple(factors.evaluate(even(5, 0)).shape) == (5, 4, 3)


def test_colours_of_a_measured_material_share_light_maps(assets):
    path = assets / "brdf" / "rgl_cc_ibiza_sunset_rgb.bsdf"
    check_colours_share_rows(brdf({"name": "rgl", "path": str(path)}), 8, 0.1)


def test_narrow_lobes_do_not_count_at_mirror_directions_alone():
    """Factors whose quadrature met each view's mirror image had 1.2 times the error of nothing."""
    narrow = BlinnPhong(specular=0.05, exponent=2000.0)
    factors = BRDFFactors.from_brdf(narrow, num_terms=8, resolution=8)
    assert factor_error(factors, narrow, clamp=3.0, num_pairs=40_000).relative < 1.0


def test_materials_share_view_maps():
    both = BRDFFactors.from_brdf([GLOSSY, ANISOTROPIC], num_terms=12, resolution=8)
    assert tuple(both.light_values.shape) == (2, 12, 64)
    assert both.num_materials == 2
    one = BRDFFactors.from_brdf(ANISOTROPIC, num_terms=12, resolution=8)
    errors = [
        factor_error(f, ANISOTROPIC, material=m, clamp=3.0, num_pairs=20_000).relative
        for f, m in ((both, 1), (one, 0))
    ]
    assert errors[1] < errors[0] < 1.5 * errors[1]


@pytest.mark.parametrize(
    ("model", "constants"), [(GLOSSY, 1), (COLOURED, 1), (GLOSSY, 3), (TINTED, 3)]
)
def test_constants(model, constants):
    factors = BRDFFactors.from_brdf(model, num_terms=6, constants=constants, resolution=8)
    seen = factors.evaluate(even(30, 0)).detach()
    if constants == 3:
        assert torch.equal(seen[:, :3], torch.eye(3).double().expand(30, 3, 3))
    else:
        assert bool((seen[:, 0] == 1).all())
    assert torch.equal(factors.constants(), torch.eye(constants, 6, dtype=torch.float64))
    # They take part: the other rows alone would be worse, and fewer rows cannot be better.
    free = BRDFFactors.from_brdf(model, num_terms=6, resolution=8)
    assert free.rms is not None
    assert factors.rms is not None
    assert free.rms <= factors.rms * (1 + 1e-6)
    measured = factor_error(factors, model, clamp=3.0, num_pairs=40_000).relative
    assert measured == pytest.approx(factors.rms, rel=0.05)


def test_diffuse_light_enters_exactly():
    factors = BRDFFactors.from_brdf(TINTED, num_terms=5, constants=3, resolution=8)
    generator = torch.Generator().manual_seed(1)
    diffuse = torch.randn(20, 3, 1, 9, generator=generator, dtype=torch.float64)
    values = torch.zeros(20, 1, 5, 9, dtype=torch.float64)
    values[:, 0, :3] = diffuse[:, :, 0]
    light = torch.randn(2, 9, 3, generator=generator, dtype=torch.float64)
    # One channel of rows with light of one colour: the constants give it its colours back.
    light = light[..., :1].expand(-1, -1, 3)
    glossy = DenseTransfer.from_transfer(TransferTensor.from_dense(values, **surface(factors)))
    plain = DenseTransfer.from_transfer(TransferTensor.from_dense(diffuse))
    radiance = prt_torch.Relighter(glossy)(light, eyes())
    assert torch.allclose(radiance, prt_torch.Relighter(plain)(light).expand_as(radiance))


def surface(factors: BRDFFactors) -> dict:
    generator = torch.Generator().manual_seed(2)
    normals = torch.nn.functional.normalize(
        torch.randn(20, 3, generator=generator, dtype=torch.float64), dim=1
    )
    return {
        "exit_basis": factors,
        "frames": frame_from_normal(normals),
        "positions": torch.randn(20, 3, generator=generator, dtype=torch.float64),
    }


def eyes() -> torch.Tensor:
    return torch.tensor([[6.0, 1, 0], [0, 5, -4]], dtype=torch.float64)


# --- refinement -------------------------------------------------------------------------------


def test_refinement_reaches_the_closed_form_from_any_factors():
    given = BRDFFactors.from_brdf(TINTED, num_terms=4, method="singular", resolution=8)
    refined = refine(given, TINTED)
    assert (refined.status, refined.steps) == ("closed_form", 0)
    assert refined.error_after < refined.error_before
    best = BRDFFactors.from_brdf(TINTED, num_terms=4, resolution=8)
    lights, views = even(50, 0), even(50, 1)
    assert torch.allclose(
        pairs(refined.factors, lights, views), pairs(best, lights, views), atol=1e-5
    )
    again = refine(refined.factors, TINTED)
    assert again.error_after <= again.error_before == pytest.approx(refined.error_after, rel=1e-6)


@pytest.mark.parametrize(
    ("model", "options"),
    [
        (ANISOTROPIC, {"num_terms": 4}),
        (TINTED, {"num_terms": 8, "constants": 3}),
        pytest.param(TINTED, {"num_terms": 2, "method": "symmetric"}, marks=pytest.mark.slow),
        pytest.param(
            [GLOSSY, ANISOTROPIC],
            {"num_terms": 4, "constants": 1, "mapping": "polar"},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_nonnegative(model, options):
    given = BRDFFactors.from_brdf(model, resolution=8, **options)
    before = given.view_values.detach().clone()
    refined = refine(given, model, nonnegative=True, max_steps=4)
    found = refined.factors
    assert float(found.view_values.detach().min()) >= 0
    assert float(found.light_values.detach().min()) >= 0
    assert torch.equal(given.view_values, before)
    assert (found.cosine, found.num_constants) == (given.cosine, given.num_constants)
    constant = found.view_values[: found.num_constants]
    assert torch.equal(constant, before[: found.num_constants])
    # Far better than what is left when negative values are cut off; never better than without.
    best = refine(given, model)
    assert best.error_after < refined.error_after < 0.95 * refined.error_before
    again = refine(found, model, nonnegative=True, max_steps=2)
    assert again.error_after <= again.error_before == pytest.approx(refined.error_after, rel=1e-6)


@pytest.mark.parametrize("model", [ANISOTROPIC, pytest.param(TINTED, marks=pytest.mark.slow)])
def test_reciprocal(model):
    given = BRDFFactors.from_brdf(
        model, num_terms=4, method="symmetric", mapping="orthographic", resolution=12
    )
    refined = refine(given, model, reciprocal=True)
    assert refined.status == "converged"
    assert refine(given, model).error_after < refined.error_after < refined.error_before
    lights, views = even(200, 3), even(200, 4)
    found = refined.factors

    forth = pairs(found, lights, views) / lights[:, 2:]
    back = pairs(found, views, lights) / views[:, 2:]
    assert torch.allclose(forth, back, atol=1e-6 * float(forth.abs().max()))
    errors = [factor_error(f, model, clamp=3.0, num_pairs=40_000).relative for f in (given, found)]
    assert errors[1] < errors[0]


def test_refinement_refuses_what_it_cannot_do():
    plain = BRDFFactors.from_brdf(GLOSSY, num_terms=2, resolution=8)
    wang = BRDFFactors.from_brdf(GLOSSY, num_terms=2, method="symmetric", resolution=8)
    sloan = BRDFFactors.from_brdf(GLOSSY, num_terms=2, method="harmonic", resolution=8)
    for factors, model, options, message in [
        (wang, GLOSSY, {"nonnegative": True, "reciprocal": True}, "nonnegative or reciprocal"),
        (plain, GLOSSY, {"reciprocal": True}, "light maps times a sign"),
        (sloan, GLOSSY, {}, "spherical harmonics"),
        (plain, [GLOSSY, GLOSSY], {}, "expected 1 materials, got 2"),
        (plain, COLOURED, {}, "1 channel"),
        (plain, GLOSSY, {"max_steps": -1}, "at least 0 steps, got -1"),
    ]:
        with pytest.raises(ValueError, match=message) as raised:
            refine(factors, model, **options)
        assert "\n" not in str(raised.value)


# --- factors as an exit basis -----------------------------------------------------------------


@pytest.mark.parametrize("model", [GLOSSY, TINTED])
def test_gram_by_quadrature(model):
    factors = BRDFFactors.from_brdf(model, num_terms=4, resolution=8)
    views, solid_angles = HemisphereMap("concentric", 64).nodes(4)
    seen = coloured(factors, views)
    weights = solid_angles / (2 * math.pi * factors.num_channels)
    expected = torch.einsum("vkc,v,vlc->kl", seen, weights, seen)
    assert torch.allclose(factors.gram(), expected, atol=5e-4 * float(expected.abs().max()))
    constant = BRDFFactors.from_brdf(model, num_terms=4, constants=1, resolution=8)
    assert float(constant.gram()[0, 0]) == pytest.approx(1.0, rel=1e-12)


def test_description_makes_the_basis_again():
    factors = BRDFFactors.from_brdf(TINTED, num_terms=5, constants=3, mapping="polar", resolution=8)
    again = exit_basis(factors.describe(), factors.tensors())
    views = even(20, 0)
    assert torch.equal(again.evaluate(views), factors.evaluate(views))
    assert again.describe() == factors.describe()
    assert torch.equal(again.constants(), factors.constants())


@pytest.mark.parametrize("model", [GLOSSY, TINTED])
def test_saved_and_relit(model, tmp_path):
    factors = BRDFFactors.from_brdf(model, num_terms=3, resolution=8)
    generator = torch.Generator().manual_seed(3)
    values = torch.randn(20, 1, 3, 9, generator=generator, dtype=torch.float64)
    light = torch.randn(2, 9, 3, generator=generator, dtype=torch.float64)
    dense = DenseTransfer.from_transfer(TransferTensor.from_dense(values, **surface(factors)))
    prt_torch.save(dense, tmp_path / "dense")
    loaded = prt_torch.load(tmp_path / "dense")
    places = dense.surface
    assert places.positions is not None
    assert places.frames is not None
    views = torch.nn.functional.normalize(eyes()[:, None] - places.positions, dim=-1)
    radiance = prt_torch.Relighter(dense)(light, eyes()).detach()
    basis = loaded.surface.exit_basis
    assert torch.equal(basis.evaluate(views), factors.evaluate(views))
    assert torch.equal(loaded.dense(), dense.dense())
    for batch, view, point in itertools.product(range(2), range(2), (0, 7, 19)):
        seen = coloured(factors, places.frames[point] @ views[view, point])
        for colour in range(3):
            shade = seen[:, colour % seen.shape[1]] @ values[point, 0] @ light[batch, :, colour]
            assert float(radiance[batch, view, point, colour]) == pytest.approx(float(shade))


def test_light_is_zero_below_the_horizon():
    for method in ("interpolated", "symmetric", "harmonic"):
        factors = BRDFFactors.from_brdf(GLOSSY, num_terms=3, method=method, resolution=8)
        lights = even(20, 5)
        assert bool((factors.light(lights).abs().sum(1) > 0).all())
        assert not bool(factors.light(lights * torch.tensor([1.0, 1.0, -1.0])).any())


# --- arguments and state ----------------------------------------------------------------------


@pytest.mark.usefixtures("without_type_checker")
def test_bad_arguments():
    for options, message in [
        ({"num_terms": 0}, "expected 1 to 64 terms, got 0"),
        ({"num_terms": 65}, "expected 1 to 64 terms, got 65"),
        ({"num_terms": 2, "constants": 3}, "expected 3 to 64 terms, got 2"),
        ({"max_error": 0.1}, "exactly one of num_terms and max_error"),
        ({"num_terms": None}, "exactly one of num_terms and max_error"),
        ({"method": "singular", "constants": 1}, "expected the method interpolated for constants"),
        ({"method": "power"}, "expected a method of .*, got 'power'"),
        ({"mapping": "cube"}, "expected a mapping of .*, got 'cube'"),
        ({"resolution": 1}, "expected 2 to 512 texels"),
        ({"supersampling": 0}, "supersampling of at least 1, got 0"),
        ({"clamp": 0.0}, "clamp above 0, got 0"),
        ({"clamp": math.nan}, "clamp above 0, got nan"),
    ]:
        with pytest.raises(ValueError, match=message) as raised:
            BRDFFactors.from_brdf(GLOSSY, **{"resolution": 4, **options})
        assert "\n" not in str(raised.value)
    with pytest.raises(ValueError, match="at least one material, got none"):
        BRDFFactors.from_brdf([])
    with pytest.raises(ValueError, match="one material without the cosine"):
        BRDFFactors.from_brdf([GLOSSY, GLOSSY], method="symmetric", resolution=4)
    values, hemisphere = torch.zeros(2, 1, 16), HemisphereMap("polar", 4)
    with pytest.raises(ValueError, match='view values "rows 1-or-3 16"'):
        BRDFFactors(torch.zeros(2, 2, 16), torch.zeros(1, 2, 16), hemisphere)
    with pytest.raises(ValueError, match='light values "materials 2 16"'):
        BRDFFactors(values, torch.zeros(1, 3, 16), hemisphere)


def test_global_state_is_untouched_and_results_repeat():
    torch.manual_seed(5)
    state = torch.get_rng_state()
    threads, dtype = torch.get_num_threads(), torch.get_default_dtype()
    made = [BRDFFactors.from_brdf(GLOSSY, num_terms=2, resolution=12) for _ in range(2)]
    wang = BRDFFactors.from_brdf(GLOSSY, num_terms=2, method="symmetric", resolution=8)
    refine(wang, GLOSSY, reciprocal=True, max_steps=1)
    refine(wang, GLOSSY, nonnegative=True, max_steps=1)
    factor_error(made[0], GLOSSY, num_pairs=100)
    assert torch.equal(made[0].view_values, made[1].view_values)
    assert torch.equal(torch.get_rng_state(), state)
    assert (torch.get_num_threads(), torch.get_default_dtype()) == (threads, dtype)
    assert torch.is_grad_enabled()
