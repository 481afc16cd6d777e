"""Analytic materials: reciprocity, energy, closed forms, limits; Mitsuba as a second opinion."""

import json
import math

import numpy as np
import pytest
import torch
from directions import directions, random_directions

from prt_torch.assets.brdf import (
    BRDF,
    GGX,
    NAMES,
    AshikhminShirley,
    BlinnPhong,
    CookTorrance,
    Lafortune,
    LafortuneLobe,
    Lambert,
    Phong,
    Schlick,
    Sum,
    brdf,
    directional_albedo,
    lobe_quadrature,
)
from prt_torch.assets.brdf.microfacet import (
    beckmann_distribution,
    dielectric_fresnel,
    ggx_distribution,
    ggx_masking,
    half_vector,
)
from prt_torch.errors import InputError

MODELS = [
    Lambert((0.8, 0.5, 0.2)),
    Phong(0.9, 20.0),
    Phong(0.9, 0.5),
    BlinnPhong(0.9, 30.0),
    CookTorrance((0.9, 0.6, 0.3), 0.3),
    CookTorrance(0.04, 0.2, fresnel="exact"),
    Schlick(0.8, 0.2, 0.2),
    Schlick(0.8, 0.3),
    AshikhminShirley(0.3, (0.5, 0.4, 0.3), 10.0, 100.0),
    AshikhminShirley(0.3, 0.5, 50.0, 50.0),
    Lafortune((LafortuneLobe(-0.9, -0.8, 0.9, 12.0), LafortuneLobe(0.5, 0.5, 0.7, 3.0))),
    Lafortune((LafortuneLobe(-0.9, -0.9, 0.9, 12.0),)),
    GGX(0.9, 0.3),
    GGX((0.9, 0.6, 0.3), (0.1, 0.5)),
    Sum((Lambert((0.3, 0.2, 0.1)), GGX(0.04, 0.2))),
]
SHARP = [
    Phong(1.0, 1e6),
    BlinnPhong(1.0, 1e6),
    CookTorrance(1.0, 1e-3),
    CookTorrance(0.04, 1e-3, fresnel="exact"),
    Schlick(1.0, 1e-6, 1e-3),
    AshikhminShirley(1.0, 0.0, 1e6, 0.0),
    Lafortune((LafortuneLobe(-1.0, -1.0, 1.0, 1e6),)),
    GGX(1.0, 1e-3),
    GGX(1.0, (1e-3, 1.0)),
]
COSINES = [1.0, 0.95, 0.7, 0.3, 0.1, 0.03, 0.01, 1e-3]


def label(model) -> str:
    return json.dumps(model.describe()).translate(str.maketrans("", "", '"{} '))[:60]


def turned(vectors: torch.Tensor, angle: float) -> torch.Tensor:
    x, y, z = vectors.unbind(-1)
    c, s = math.cos(angle), math.sin(angle)
    return torch.stack([c * x - s * y, s * x + c * y, z], dim=-1)


def hemisphere_integral(integrand, panels: int = 40) -> torch.Tensor:
    """Over the upper hemisphere: Gauss-Legendre panels in z that shrink to both ends."""
    nodes, weights = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(12))
    halves = 0.5 * 2.0 ** -torch.arange(panels, dtype=torch.float64)
    edges = torch.cat([torch.zeros(1), halves.flip(0), (1 - halves)[1:], torch.ones(1)]).double()
    z = edges[:-1, None] + edges.diff()[:, None] * 0.5 * (nodes + 1)
    z_weights = (edges.diff()[:, None] * 0.5 * weights).flatten()
    azimuth = torch.arange(256, dtype=torch.float64) * (2 * math.pi / 256)
    grid = directions(z.flatten()[:, None].expand(-1, 256), azimuth)
    return (integrand(grid) * z_weights[:, None]).sum() * (2 * math.pi / 256)


@pytest.mark.parametrize("model", MODELS, ids=label)
def test_reciprocity(model):
    wi, wo = random_directions(4000, 0), random_directions(4000, 1)
    forward, backward = model.evaluate(wi, wo), model.evaluate(wo, wi)
    assert model.reciprocal
    assert forward.max() > 0
    assert ((forward - backward).abs() <= 1e-6 * forward.abs()).all()


def test_a_sum_is_reciprocal_and_isotropic_only_if_its_parts_are():
    class Forward(BRDF):
        """Twice as bright one way as the other, and darker in the -x half."""

        name = "forward"
        num_channels, reciprocal, isotropic = 1, False, False

        def _evaluate_above(self, wi, wo):
            return (0.1 * (1 + (wi[..., 2] > wo[..., 2]) + (wi[..., 0] > 0)))[..., None]

        def describe(self):
            return {"name": "forward"}

    both = Sum((Lambert(0.5), Forward()))
    assert not both.reciprocal
    assert not both.isotropic
    assert Sum((Lambert(0.5), GGX(0.5, 0.3))).isotropic
    assert not Sum((Lambert(0.5), GGX(0.5, (0.3, 0.2)))).isotropic


@pytest.mark.parametrize("model", MODELS, ids=label)
def test_turning_about_the_normal(model):
    wi, wo = random_directions(500, 2), random_directions(500, 3)
    values, rotated = (model.evaluate(turned(wi, a), turned(wo, a)) for a in (0.0, 0.6))
    changed = ((values - rotated).abs() > 1e-9 * values.abs()).any()
    assert changed != model.isotropic
    half_turn = model.evaluate(turned(wi, math.pi), turned(wo, math.pi))
    assert torch.allclose(half_turn, values, rtol=1e-9)


@pytest.mark.parametrize(
    ("model", "swapped"),
    [
        (GGX(0.7, (0.1, 0.4)), GGX(0.7, (0.4, 0.1))),
        (AshikhminShirley(0.3, 0.5, 10, 90), AshikhminShirley(0.3, 0.5, 90, 10)),
        (
            Lafortune((LafortuneLobe(-0.9, -0.5, 0.9, 12.0),)),
            Lafortune((LafortuneLobe(-0.5, -0.9, 0.9, 12.0),)),
        ),
    ],
    ids=label,
)
def test_swapping_the_axes_is_a_quarter_turn(model, swapped):
    wi, wo = random_directions(500, 4), random_directions(500, 5)
    quarter = swapped.evaluate(turned(wi, math.pi / 2), turned(wo, math.pi / 2))
    assert torch.allclose(quarter, model.evaluate(wi, wo), rtol=1e-9, atol=1e-30)


def test_highlights_are_long_along_the_rough_axis():
    # Half vectors tilted along x against along y, viewer on the normal.
    wo, along, across = directions(1.0), directions(0.9, 0.0), directions(0.9, math.pi / 2)
    for rough_along_x in (
        GGX(1.0, (0.5, 0.1)),
        AshikhminShirley(0.5, 0.0, 10, 100),
    ):
        ratio = rough_along_x.evaluate(along, wo) / rough_along_x.evaluate(across, wo)
        assert ratio > 2
    # Scratches along the tangent spread light across it.
    scratched = Schlick(1.0, 0.1, 0.2)
    ratio = scratched.evaluate(across, wo) / scratched.evaluate(along, wo)
    assert ratio.item() == pytest.approx(1 / 0.2, rel=1e-6)  # A runs from sqrt(p) to 1/sqrt(p)


def test_values_computed_by_hand():
    # wi at 60 degrees in the xz plane, wo on the normal: n.h = o.h = cos 30.
    wi, wo = directions(0.5, 0.0), directions(1.0)
    c2, s2 = 0.75, 0.25
    fresnel = 0.4 + 0.6 * (1 - math.sqrt(c2)) ** 5
    beckmann = math.exp(-(s2 / c2) / 0.09) / (math.pi * 0.09 * c2**2)
    ggx = 0.09 / (math.pi * (s2 + 0.09 * c2) ** 2)
    slant = math.sqrt(0.25 + 0.09 * 0.75)
    expected = {
        Phong(0.4, 3.0): 0.4 * 5 / (2 * math.pi) * 0.125,
        CookTorrance(0.4, 0.3): fresnel * beckmann * 1.0 / (4 * 0.5),  # G = min(1, 2, 1)
        GGX(0.4, 0.3): fresnel * ggx / (2 * (0.5 + slant)),
        Schlick(0.4, 0.3): fresnel * (0.5 / 0.65) * 0.3 / (1 - 0.7 * c2) ** 2 / (4 * math.pi * 0.5),
        AshikhminShirley(0.4, 0.0, 8, 3): fresnel * 6 * c2**4 / (8 * math.pi) / math.sqrt(c2),
        AshikhminShirley(0.0, 0.6, 8, 3): 6
        * c2**4
        / (8 * math.pi)
        / math.sqrt(c2)
        * (1 - math.sqrt(c2)) ** 5
        + 28 * 0.6 / (23 * math.pi) * (1 - 0.75**5) * (1 - 0.5**5),
        Lafortune((LafortuneLobe(-1.0, -1.0, 0.8, 2.0),)): 0.16,
    }
    for model, value in expected.items():
        assert model.evaluate(wi, wo).item() == pytest.approx(value, rel=1e-12), model


@pytest.mark.parametrize("model", [GGX(0.5, 0.2), GGX((0.1, 0.2, 0.3), 0.2), *MODELS], ids=label)
def test_channels_and_batches(model):
    wi, wo = random_directions(6, 6), random_directions(4, 7)
    table = model.evaluate(wi[:, None], wo)
    assert table.shape == (6, 4, model.num_channels)
    assert torch.equal(table[2, 3], model.evaluate(wi[2], wo[3]))
    single = model.evaluate(wi[:, None].float(), wo.float())
    assert single.dtype == torch.float32
    assert torch.allclose(single.double(), table, rtol=2e-4, atol=1e-6)


def test_a_colour_is_three_single_models():
    wi, wo = random_directions(50, 8), random_directions(50, 9)
    colour = GGX((0.9, 0.5, 0.1), 0.3).evaluate(wi, wo)
    for channel, f0 in enumerate((0.9, 0.5, 0.1)):
        assert torch.equal(colour[:, channel], GGX(f0, 0.3).evaluate(wi, wo)[:, 0])
    assert GGX((0.5, 0.5, 0.5), 0.3).num_channels == 1


# Energy


def test_lobe_quadrature_covers_the_hemisphere():
    lights, solid_angles = lobe_quadrature(directions(COSINES))
    assert torch.allclose(lights.norm(dim=-1), torch.ones_like(solid_angles), atol=1e-9)
    assert lights[..., 2].min() > -1e-9
    assert (solid_angles >= 0).all()
    total = solid_angles.sum(-1)
    assert torch.allclose(total, torch.full_like(total, 2 * math.pi), rtol=1e-6)
    centre = (solid_angles[..., None] * lights).sum(1)
    assert torch.allclose(centre, centre.new_tensor((0.0, 0.0, math.pi)).expand(8, 3), atol=1e-6)


def test_albedo_of_lambert_is_exact():
    albedo = directional_albedo(Lambert((0.8, 0.5, 0.2)), directions(COSINES))
    assert torch.allclose(albedo, albedo.new_tensor((0.8, 0.5, 0.2)).expand(8, 3), rtol=1e-11)


def test_albedo_of_phong():
    for exponent in (0.0, 1.0, 7.5, 100.0, 1e5):
        normal = directional_albedo(Phong(0.7, exponent), directions([1.0]))
        assert normal.item() == pytest.approx(0.7, rel=1e-6)
        normal = directional_albedo(BlinnPhong(0.7, exponent), directions([1.0]))
        assert normal.item() == pytest.approx(0.7, rel=1e-6)
    # A narrow lobe well above the horizon: the mean of the cosine about the mirror direction.
    tilted = directional_albedo(Phong(1.0, 1e5), directions([0.6]))
    assert tilted.item() == pytest.approx(0.6, rel=1e-6)


def test_albedo_of_ggx_in_closed_form():
    # At roughness 1 the viewer on the normal sees the integral of 2 pi z / (2 pi (1 + z)).
    assert directional_albedo(GGX(1.0, 1.0), directions([1.0])).item() == pytest.approx(
        1 - math.log(2), rel=1e-12
    )


@pytest.mark.parametrize(
    "model",
    [GGX(0.6, (0.2, 0.6)), AshikhminShirley(0.2, 0.7, 5, 20), CookTorrance(0.9, 0.5)],
    ids=label,
)
def test_albedo_against_a_plain_quadrature(model):
    for cosine in (0.9, 0.4):
        wo = directions(cosine)
        plain = hemisphere_integral(lambda wi, wo=wo: model.evaluate(wi, wo)[..., 0] * wi[..., 2])
        # The kinks of V-shaped cavities cost digits in both.
        assert directional_albedo(model, wo).item() == pytest.approx(plain.item(), rel=3e-4)


@pytest.mark.parametrize(
    "make",
    [
        lambda r: Phong(1.0, 2 / r**2 - 2 * r),
        lambda r: BlinnPhong(1.0, 2 / r**2 - 2 * r),
        lambda r: CookTorrance(1.0, r),
        lambda r: CookTorrance(0.5, r, fresnel="exact"),
        lambda r: GGX(1.0, r),
        lambda r: GGX(1.0, (r, min(10 * r, 1.0))),
        lambda r: AshikhminShirley(1.0, 0.0, 2 / r**2 - 2 * r, 2 / r**2 - 2 * r),
        lambda r: AshikhminShirley(0.0, 1.0, 0.0, 2 / r**2 - 2 * r),
        lambda r: AshikhminShirley(0.05, 1.0, 2 / r**2 - 2 * r, 10.0),
    ],
)
def test_no_energy_is_made(make):
    for roughness in (1e-3, 1e-2, 0.1, 0.4, 1.0):
        albedo = directional_albedo(make(roughness), directions(COSINES), resolution=64)
        assert albedo.max() <= 1 + 1e-3
        assert albedo.min() > 0


def test_schlick_keeps_its_documented_bound_and_no_better():
    viewers = directions(COSINES)
    cosine = viewers[:, 2]
    for roughness in (1e-6, 1e-3, 0.1, 1.0):
        albedo = directional_albedo(Schlick(1.0, roughness), viewers, resolution=64)[:, 0]
        seen = 0.5 * (cosine + torch.sqrt(cosine**2 + roughness * (1 - cosine**2)))
        bound = seen / (roughness + (1 - roughness) * cosine)
        assert (albedo <= bound * (1 + 1e-6)).all()
        scratched = directional_albedo(Schlick(1.0, roughness, 0.2), viewers, resolution=64)[:, 0]
        assert (scratched <= bound / math.sqrt(0.2)).all()
    assert directional_albedo(Schlick(1.0, 1e-3), directions([1e-3])).item() > 8


def test_lafortune_keeps_its_documented_bound():
    for c, exponent in ((0.9, 12.0), (1.2, 3.0)):
        bound = 2 * math.pi * c**exponent / (exponent + 2)
        lobe = LafortuneLobe(-c, -0.5 * c, c, exponent)
        albedo = directional_albedo(Lafortune((lobe,)), directions(COSINES))
        assert (albedo <= bound * (1 + 1e-6)).all()
        assert albedo[0].item() == pytest.approx(bound, rel=1e-9)


def test_a_normalised_lafortune_lobe_is_phong():
    n = 15.0
    c = ((n + 2) / (2 * math.pi)) ** (1 / n)
    wi, wo = random_directions(200, 10), random_directions(200, 11)
    lobe = Lafortune((LafortuneLobe(-c, -c, c, n),)).evaluate(wi, wo)
    assert torch.allclose(lobe, Phong(1.0, n).evaluate(wi, wo), rtol=1e-10, atol=1e-30)


@pytest.mark.parametrize("roughness", [0.01, 0.1, 0.5, 1.0, 2.0])
def test_distributions_are_normalised(roughness):
    def total(distribution, *parameters):
        return hemisphere_integral(lambda h: distribution(h, *parameters) * h[..., 2]).item()

    assert total(ggx_distribution, roughness, roughness) == pytest.approx(1, rel=1e-9)
    assert total(ggx_distribution, roughness, 0.5 * roughness) == pytest.approx(1, rel=1e-9)
    assert total(beckmann_distribution, roughness) == pytest.approx(1, rel=1e-9)


@pytest.mark.parametrize("roughness", [(0.3, 0.3), (0.1, 0.4), (1.0, 1.0)])
def test_weak_white_furnace(roughness):
    """Masking alone conserves: visible facets fill the view, and all of them reflect."""
    for cosine in (1.0, 0.8, 0.3, 0.05):
        wo = directions(cosine)
        visible = hemisphere_integral(
            lambda h, wo=wo: (h * wo).sum(-1).clamp(min=0) * ggx_distribution(h, *roughness)
        )
        total = (ggx_masking(wo, *roughness) * visible / wo[2]).item()
        assert total == pytest.approx(1.0, rel=2e-3)  # the kink of the clamp


# Limits


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("model", MODELS + SHARP, ids=label)
def test_limits_are_finite(model, dtype):
    flat, up, tiny = directions(0.0), directions(1.0), directions(1e-30)
    slanted, grazing = directions(0.6), directions(1e-3)
    mirror = torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)
    pairs = [
        (flat, -flat),
        (flat, flat),
        (tiny, tiny * mirror),
        (tiny, tiny),
        (tiny, up),
        (-up, up),
        (up, up),
        (slanted, slanted),
        (slanted, slanted * mirror),
        (slanted, -slanted),
        (grazing, grazing * mirror),
        (grazing, grazing),
        (grazing, turned(grazing, 1.5)),
        (grazing, up),
        (torch.zeros(3, dtype=torch.float64), up),
    ]
    wi, wo = (torch.stack(side).to(dtype).requires_grad_() for side in zip(*pairs, strict=True))
    values = model.evaluate(wi, wo)
    assert values.isfinite().all()
    assert (values >= 0).all()
    hidden = (wi[:, 2] < 0) | (wo[:, 2] < 0)
    assert (values[hidden] == 0).all()
    assert torch.allclose(values[:2], values[2:4])  # the horizon is the limit from above
    for gradient in torch.autograd.grad(values.sum(), (wi, wo)):
        assert gradient.isfinite().all()
        assert (gradient[hidden] == 0).all()


@pytest.mark.parametrize("model", MODELS, ids=label)
def test_gradients(model):
    wi, wo = random_directions(6, 12), random_directions(6, 13)
    # Opposite and equal to the viewer's mirror image too, where lobes peak.
    wi = torch.cat([wi, wo[:2] * wo.new_tensor((-1.0, -1.0, 1.0))]).requires_grad_()
    wo = torch.cat([wo, wo[:2]]).requires_grad_()
    if isinstance(model, (CookTorrance, AshikhminShirley, Schlick)):
        wi, wo = (side[:6].detach().requires_grad_() for side in (wi, wo))  # no kinks, no scratch
    assert torch.autograd.gradcheck(model.evaluate, (wi, wo))


@pytest.mark.parametrize(
    "model", [m for m in SHARP if not isinstance(m, (Schlick, GGX))], ids=label
)
def test_a_sharp_lobe_peaks_at_the_mirror_direction(model):
    wo = directions(0.8)
    mirror = wo * wo.new_tensor((-1.0, -1.0, 1.0))
    beside = turned(mirror, 1e-3)
    assert model.evaluate(mirror, wo)[..., 0] > model.evaluate(beside, wo)[..., 0]


def test_exact_fresnel_has_its_f0_and_total_reflection_at_the_horizon():
    f0 = torch.tensor([0.0, 0.04, 0.5, 0.9], dtype=torch.float64)
    values = dielectric_fresnel(f0, torch.tensor([1.0, 1e-7], dtype=torch.float64))
    assert torch.allclose(values[0], f0, atol=1e-12)
    assert torch.allclose(values[1, 1:], torch.ones(3, dtype=torch.float64), atol=1e-5)
    assert values[1, 0] == 0


# Descriptions


@pytest.mark.parametrize("model", MODELS, ids=label)
def test_descriptions_are_json_and_come_back(model):
    assert brdf(json.loads(json.dumps(model.describe()))) == model
    assert model.describe()["name"] in NAMES


def test_every_name_is_tested():
    assert {model.describe()["name"] for model in MODELS} == set(NAMES)


@pytest.mark.parametrize(
    ("description", "message"),
    [
        ({"name": "blinn", "exponent": 3}, "brdf.name: expected one of lambert, phong, .*'blinn'"),
        ({"albedo": 0.5}, "brdf.name: expected one of .* got None"),
        ("ggx", "brdf: expected a name and parameters, got 'ggx'"),
        ({"name": "lambert"}, "brdf.albedo: missing; lambert needs it"),
        (
            {"name": "ggx", "f0": 0.5, "alpha": 1},
            "brdf.alpha: unknown parameter of ggx; choose from f0, roughness",
        ),
        ({"name": "lambert", "albedo": 1.5}, r"brdf.albedo: expected a number, 0 to 1, got 1.5"),
        ({"name": "lambert", "albedo": [0.5, 0.5]}, "brdf.albedo: expected one number or three"),
        ({"name": "lambert", "albedo": True}, "brdf.albedo: expected a number, 0 to 1, got True"),
        ({"name": "lambert", "albedo": "red"}, "brdf.albedo: expected a number, 0 to 1, got 'red'"),
        ({"name": "phong", "specular": 0.5, "exponent": float("nan")}, "brdf.exponent: .* got nan"),
        ({"name": "ggx", "f0": 0.5, "roughness": 0}, "brdf.roughness: .* 0.0001 to 10, got 0"),
        ({"name": "ggx", "f0": 0.5, "roughness": [1, 1, 1]}, "brdf.roughness: .* one number or"),
        ({"name": "schlick", "f0": 0.5, "roughness": 2}, "brdf.roughness: .* 1e-06 to 1, got 2"),
        (
            {"name": "cook_torrance", "f0": 0.5, "roughness": 0.1, "fresnel": "none"},
            "brdf.fresnel: expected schlick or exact, got 'none'",
        ),
        (
            {"name": "cook_torrance", "f0": 1.0, "roughness": 0.1, "fresnel": "exact"},
            "brdf.f0: expected less than 1 for fresnel=exact, got 1.0",
        ),
        ({"name": "lafortune", "lobes": []}, r"brdf.lobes: expected at least 1 lobe, got \[\]"),
        ({"name": "lafortune", "lobes": [{"cx": 1}]}, r"brdf.lobes\[0\]: expected cx, cy, cz, exp"),
        (
            {"name": "lafortune", "lobes": [{"cx": 1, "cy": 1, "cz": 1, "exponent": -1}]},
            r"brdf.lobes\[0\].exponent: expected a number, at least 0, got -1",
        ),
        ({"name": "sum", "parts": []}, r"brdf.parts: expected at least 1 BRDF, got \(\)"),
        ({"name": "sum", "parts": 3}, r"brdf.parts: expected at least 1 BRDF, got 3"),
        (
            {"name": "sum", "parts": [{"name": "lambert", "albedo": 0.1}, {"name": "ggx"}]},
            r"brdf.parts\[1\].f0: missing; ggx needs it",
        ),
    ],
)
def test_bad_descriptions_get_one_line(description, message, without_type_checker):
    with pytest.raises(InputError, match=message) as caught:
        brdf(description)
    assert "\n" not in str(caught.value)


def test_bad_resolution():
    with pytest.raises(ValueError, match="resolution: expected at least 8, got 4"):
        directional_albedo(Lambert(0.5), directions([0.5]), resolution=4)


# A second implementation


@pytest.fixture(scope="module")
def mi():
    module = pytest.importorskip("mitsuba", reason="mitsuba is not installed (pip '.[check]')")
    module.set_variant("scalar_rgb")
    return module


def mitsuba_values(mi, plugin: dict, wi: torch.Tensor, wo: torch.Tensor) -> torch.Tensor:
    """Red channel of f, without the cosine that Mitsuba includes."""
    model = mi.load_dict(plugin)
    values = []
    for light, viewer in zip(wi.tolist(), wo.tolist(), strict=True):
        interaction = mi.SurfaceInteraction3f()
        interaction.wi = mi.Vector3f(*viewer)  # Mitsuba's wi points to the viewer
        value = model.eval(mi.BSDFContext(), interaction, mi.Vector3f(*light))
        values.append(value[0] / light[2])
    return torch.tensor(values, dtype=torch.float64)


def test_lambert_agrees_with_mitsuba(mi):
    wi, wo = random_directions(20, 14), random_directions(20, 15)
    plugin = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.6, 0.6]}}
    theirs = mitsuba_values(mi, plugin, wi, wo)
    assert torch.allclose(Lambert(0.6).evaluate(wi, wo)[:, 0], theirs, rtol=1e-4)


@pytest.mark.parametrize("roughness", [(0.1, 0.1), (0.5, 0.5), (0.15, 0.4)])
def test_ggx_agrees_with_mitsuba(mi, roughness):
    """Mitsuba masks both directions independently; the ratio of the two maskings is known."""
    wi, wo = random_directions(200, 16), random_directions(200, 17)
    wi, wo = (side[(wi[:, 2] > 0.05) & (wo[:, 2] > 0.05)] for side in (wi, wo))
    x, y = roughness
    plugin = {"type": "roughconductor", "material": "none", "distribution": "ggx"}
    theirs = mitsuba_values(mi, plugin | {"alpha_u": x, "alpha_v": y}, wi, wo)
    light, viewer = ggx_masking(wi, x, y), ggx_masking(wo, x, y)
    correlated = 1 / (1 / light + 1 / viewer - 1)
    ours = GGX(1.0, roughness).evaluate(wi, wo)[:, 0] * light * viewer / correlated
    # Mitsuba cuts off directions that see the back of the facet: none above a plane's half vector.
    assert torch.allclose(ours, theirs, rtol=1e-3)


@pytest.mark.parametrize("roughness", [0.1, 0.4, 1.0])
def test_beckmann_and_cook_torrance_agree_with_mitsuba(mi, roughness):
    wi, wo = random_directions(100, 18), random_directions(100, 19)
    half, cosine = half_vector(wi, wo)
    kind = mi.MicrofacetType.Beckmann
    distribution = mi.MicrofacetDistribution(kind, roughness, sample_visible=False)
    theirs = [distribution.eval(mi.Vector3f(*h)) for h in half.tolist()]
    theirs = torch.tensor(theirs, dtype=torch.float64)
    ours = beckmann_distribution(half, roughness)
    assert torch.allclose(ours, theirs, rtol=1e-3, atol=1e-6)
    fresnel = torch.tensor([mi.fresnel(c, 1.5)[0] for c in cosine.tolist()], dtype=torch.float64)
    geometry = 2 * half[:, 2] * torch.minimum(wi[:, 2], wo[:, 2]) / cosine
    factor = geometry.clamp(max=1) / (4 * wi[:, 2] * wo[:, 2])
    value = CookTorrance(0.04, roughness, fresnel="exact").evaluate(wi, wo)[:, 0]
    assert torch.allclose(value, fresnel * factor * ours, rtol=1e-4)
