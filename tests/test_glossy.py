"""Glossy transfer: reflection matrices, matrices of points, materials of a scene, sums."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from contract import relative
from smooth_light import smooth_light

from prt_torch.assets import concatenate, mesh_from_arrays
from prt_torch.assets.brdf import GGX, AshikhminShirley, Lambert, Phong, Sum, directional_albedo
from prt_torch.assets.material import Material, assign_materials, split_borders
from prt_torch.assets.medium import PRESETS
from prt_torch.assets.mesh import Part
from prt_torch.baking import (
    RESOLVED,
    bake,
    diffuse_reflection,
    glossy_reflection,
    interreflect,
    project_brdf,
    project_diffuse,
    project_glossy,
    trace_visibility,
)
from prt_torch.baking.reflection import factor_in_harmonics, factored_reflection
from prt_torch.bases import BRDFFactors, HemisphericalHarmonics, SphericalHarmonics, sh
from prt_torch.config import load_config
from prt_torch.errors import InputError
from prt_torch.evaluate import dense_radiance, seen_from
from prt_torch.representations import ZonalLobes
from prt_torch.run import bake_only, execute
from prt_torch.sphere import cubemap_directions, cubemap_solid_angles, frame_from_normal
from prt_torch.transfer import TransferTensor, add

EXIT = HemisphericalHarmonics(24)
PHONG = Phong(specular=1.0, exponent=8.0)


def bumpy(points: int = 9, colours: bool = False, name: str = "bumps"):
    """A small height field with shadows on itself."""
    line = torch.linspace(-1, 1, points, dtype=torch.float64)
    x, z = torch.meshgrid(line, line, indexing="ij")
    y = 0.4 * torch.sin(3 * x) * torch.cos(4 * z)
    vertices = torch.stack([x, y, z], dim=-1).reshape(-1, 3)
    corner = (torch.arange(points - 1)[:, None] * points + torch.arange(points - 1)).reshape(-1)
    faces = torch.cat(
        [
            torch.stack([corner, corner + 1, corner + points + 1], 1),
            torch.stack([corner, corner + points + 1, corner + points], 1),
        ]
    )
    albedo = torch.full((len(vertices), 3), 0.5, dtype=torch.float64)
    if colours:
        albedo[:, 0] = 0.9
    return mesh_from_arrays(name, vertices, faces, albedo=albedo)


def turned_up(mesh):
    assert bool((mesh.normals[:, 1] > 0).all())
    return mesh


@pytest.fixture(scope="module")
def scene():
    mesh = turned_up(bumpy())
    return mesh, trace_visibility(mesh, resolution=16, supersampling=1)


def test_lambert_by_fit_is_the_lambertian_part():
    matrix, change = project_brdf(Lambert(1.0), EXIT, 5)
    assert change < RESOLVED
    light = torch.nn.functional.normalize(
        torch.tensor([[0.3, -0.2, 0.8], [0.9, 0.1, 0.2]], dtype=torch.float64), dim=-1
    )
    constant = math.sqrt(1 / (4 * math.pi))
    beta = matrix[0] @ sh.evaluate(light, 5).mT
    assert torch.allclose(beta[0], light[:, 2] / math.pi / constant, atol=1e-9)
    assert float(beta[1:].abs().max()) < 1e-8


def test_matrix_is_the_double_projection_of_the_material():
    """A⁻¹ B A⁻¹ with B summed over plain product nodes; Phong is smooth enough for them."""
    nodes, weights = sh.hemisphere_quadrature(95)
    values = PHONG.evaluate(nodes[:, None], nodes[None])[..., 0] * nodes[:, None, 2]
    functions = sh.evaluate(nodes, 5)
    weighted = functions * weights[:, None]
    b = weighted.mT @ values.mT @ weighted  # rows view, columns light
    inverse = torch.linalg.inv(sh.hemisphere_gram(5))
    found, _ = project_brdf(PHONG, HemisphericalHarmonics(25), 5)
    gram = sh.hemisphere_gram(5)
    # Compared as functions: coefficients of nearly dependent harmonics may differ.
    assert relative(gram @ found[0] @ gram, gram @ inverse @ b @ inverse @ gram) < 2e-4


@pytest.mark.parametrize(
    "brdf",
    [GGX(f0=0.05, roughness=0.3), GGX(f0=1.0, roughness=0.01), PHONG],
    ids=["dielectric", "polished", "phong"],
)
def test_uniform_light_gives_the_directional_albedo(brdf):
    matrix, change = project_brdf(brdf, HemisphericalHarmonics(36), 6)
    assert change < RESOLVED
    views, weights = sh.hemisphere_quadrature(12)
    uniform = sh.hemisphere_gram(6)[:, 0] * math.sqrt(4 * math.pi)  # inner products of 1
    found = HemisphericalHarmonics(36).evaluate(views) @ matrix[0] @ uniform
    expected = directional_albedo(brdf, views, resolution=48)[:, 0]
    lost = ((found - expected) ** 2) @ weights / ((expected**2) @ weights)
    assert math.sqrt(float(lost)) < 0.03


def test_turning_an_anisotropic_material_turns_its_matrix():
    along = AshikhminShirley(specular=0.5, diffuse=0.1, exponent_u=20.0, exponent_v=2.0)
    across = AshikhminShirley(specular=0.5, diffuse=0.1, exponent_u=2.0, exponent_v=20.0)
    basis = HemisphericalHarmonics(16)
    first, second = (project_brdf(one, basis, 4)[0][0] for one in (along, across))
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    turn = sh.rotation_matrix(quarter, 4)
    assert relative(turn @ first @ turn.mT, second) < 1e-3
    assert relative(first, second) > 0.05


def test_sums_of_materials_are_sums_of_matrices():
    parts = (Lambert(0.3), PHONG)
    both = project_brdf(Sum(parts), EXIT, 5)[0]
    apart = sum(project_brdf(part, EXIT, 5)[0] for part in parts)
    assert relative(both, apart) < 2e-3


def test_points_against_a_sum_over_texels(scene):
    """M_p = ∫ V(s) β(R_p s) y(s)ᵀ ds, summed naively, one point at a time."""
    mesh, visibility = scene
    index = torch.arange(mesh.num_points) % 2
    reflection = glossy_reflection(
        [PHONG, GGX(f0=0.5, roughness=0.4)], index, torch.zeros(1, 1), num_rows=24, order=5
    )
    transfer = project_glossy(mesh, visibility, reflection, SphericalHarmonics(4))
    directions = cubemap_directions(16, dtype=torch.float64).reshape(-1, 3)
    solid_angles = cubemap_solid_angles(16, dtype=torch.float64).reshape(-1)
    for point in range(0, mesh.num_points, 7):
        seen = visibility.unpack(slice(point, point + 1))[0].double() * solid_angles
        local = directions @ transfer.surface.frames[point].double().mT
        beta = reflection.matrices[index[point], 0] @ sh.evaluate(local, 5).mT
        expected = (beta * seen) @ sh.evaluate(directions, 4)
        assert relative(transfer.values[point : point + 1][0, 0].double(), expected) < 2e-4


def test_lambertian_rows_are_diffuse_transfer(scene):
    mesh, visibility = scene
    nothing = torch.zeros(mesh.num_points, dtype=torch.int64)
    reflection = glossy_reflection([None], nothing, torch.ones(1, 1), num_rows=24, order=5)
    rows = project_glossy(mesh, visibility, reflection, SphericalHarmonics(5)).dense()
    diffuse = project_diffuse(mesh, visibility, SphericalHarmonics(5)).dense()
    constant = math.sqrt(1 / (4 * math.pi))
    assert torch.allclose(rows[:, :, :1] * constant, diffuse, atol=2e-6)
    assert float(rows[:, :, 1:].abs().max()) == 0.0
    incident = torch.randn(mesh.num_points, 1, 4, 3, dtype=torch.float64)
    plain = diffuse_reflection(mesh.num_points).reflect(slice(0, mesh.num_points), incident)
    slope = math.sqrt(4 * math.pi / 3) / math.pi
    assert torch.allclose(plain[:, :, 0], incident[:, :, 2] * slope)


@pytest.mark.parametrize(
    ("lambertian", "glossy", "colours", "channels", "factored"),
    [
        (True, None, True, 1, True),
        (False, PHONG, True, 1, True),
        (True, PHONG, False, 1, False),
        (True, PHONG, True, 3, False),
        (False, GGX(f0=(0.9, 0.6, 0.2), roughness=0.3), False, 3, True),
    ],
)
def test_channels_are_three_only_where_colour_does_not_factor_out(
    lambertian, glossy, colours, channels, factored
):
    mesh = bumpy(4, colours)
    transfer = bake(
        mesh,
        materials=Material(lambertian=lambertian, glossy=glossy),
        light_basis=SphericalHarmonics(3),
        num_rows=9,
        resolution=8,
        supersampling=1,
    )
    assert transfer.num_channels == channels
    assert transfer.num_rows == (9 if glossy else 1)
    reflectance = mesh.albedo[:1].float() if factored and lambertian else torch.ones(1, 3)
    assert torch.allclose(transfer.surface.reflectance, reflectance)


def test_radiance_is_linear_in_the_albedo_of_mixed_materials():
    """Coloured albedo under gloss: each channel as a grey scene of that albedo has it."""
    light = torch.randn(1, 9, 3, generator=torch.Generator().manual_seed(0))
    common = {"light_basis": SphericalHarmonics(3), "num_rows": 9, "resolution": 8}
    made_of = Material(glossy=PHONG)
    eyes = torch.tensor([[0.5, 4.0, 1.0]])
    coloured, grey = (
        dense_radiance(bake(bumpy(4, c), materials=made_of, supersampling=1, **common), light, eyes)
        for c in (True, False)
    )
    assert torch.allclose(coloured[..., 1:], grey[..., 1:], atol=1e-6)
    assert float((coloured[..., 0] - grey[..., 0]).abs().max()) > 1e-3


def test_materials_by_part():
    scene = concatenate([bumpy(4, name="lid"), bumpy(5, name="box"), bumpy(3, name="lid")], "all")
    shiny = Material(glossy=PHONG)
    materials, index = assign_materials(scene, {"lid": shiny})
    assert [materials[i] for i in index.tolist()] == [shiny] * 16 + [Material()] * 25 + [shiny] * 9
    folded = replace(bumpy(3), parts=(Part("left", 0, 9, 0, 3), Part("right", 0, 9, 3, 5)))
    own = set(folded.faces[3:].reshape(-1).tolist()) - set(folded.faces[:3].reshape(-1).tolist())
    index = assign_materials(folded, {"right": shiny})[1]
    assert set(torch.nonzero(index)[:, 0].tolist()) == own  # shared points belong to the first
    with pytest.raises(InputError, match="no part 'door'"):
        assign_materials(scene, {"door": shiny})
    assert assign_materials(scene, None)[0] == [Material()]


def test_points_on_a_border_are_shaded_for_both_materials():
    shiny = Material(glossy=PHONG)
    folded = replace(bumpy(3), parts=(Part("left", 0, 9, 0, 3), Part("right", 0, 9, 3, 5)))
    split = split_borders(folded, {"right": shiny})
    index = assign_materials(split, {"right": shiny})[1]
    left, right = split.faces[:3].reshape(-1), split.faces[3:].reshape(-1)
    assert not index[left].any()
    assert index[right].all()
    shared = set(folded.faces[:3].reshape(-1).tolist()) & set(folded.faces[3:].reshape(-1).tolist())
    assert split.num_points == folded.num_points + len(shared)
    assert torch.equal(split.vertices[split.faces], folded.vertices[folded.faces])
    assert torch.equal(split.normals[split.faces], folded.normals[folded.faces])
    # Each side shines as it does where all of the mesh is made of its material.
    common = {"resolution": 8, "supersampling": 1}
    light = smooth_light((3.0, 2.5, 2.0), 0.1, 6)[0][None].float()
    eyes = torch.tensor([[0.5, 4.0, 1.0]])
    mixed = dense_radiance(bake(split, materials={"right": shiny}, **common), light, eyes)
    alone = dense_radiance(bake(folded, materials=shiny, **common), light, eyes)
    matt = dense_radiance(bake(folded, **common), light)
    assert torch.allclose(mixed[:, :, right], alone[:, :, folded.faces[3:].reshape(-1)], atol=2e-5)
    assert torch.allclose(mixed[:, :, left], matt[:, :, folded.faces[:3].reshape(-1)], atol=2e-5)


def test_a_mesh_without_borders_stays_as_it_is():
    apart = concatenate([bumpy(4, name="lid"), bumpy(5, name="box")], "all")
    assert split_borders(apart, {"lid": Material(glossy=PHONG)}) is apart
    folded = replace(bumpy(3), parts=(Part("left", 0, 9, 0, 3), Part("right", 0, 9, 3, 5)))
    same = {"left": Material(glossy=PHONG), "right": Material(glossy=PHONG)}
    assert split_borders(folded, same) is folded


def test_subsurface_and_gloss_add_up():
    mesh = bumpy(5)
    common = {"light_basis": SphericalHarmonics(3), "num_rows": 9, "resolution": 8}
    medium = {"medium": PRESETS["marble"], "millimetres_per_unit": 10.0}
    eyes = torch.tensor([[0.5, 4.0, 1.0]])
    light = torch.randn(2, 9, 3, generator=torch.Generator().manual_seed(0))
    both, gloss, inside = (
        dense_radiance(bake(mesh, materials=material, supersampling=1, **common), light, eyes)
        for material in (
            Material(lambertian=False, glossy=PHONG, **medium),
            Material(lambertian=False, glossy=PHONG),
            Material(lambertian=False, **medium),
        )
    )
    assert torch.allclose(both, gloss + inside, atol=1e-5)
    assert float(inside.abs().max()) > 0.01


def test_adding_transfers():
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(6, 1, 9, 4, generator=generator)
    constant = torch.randn(6, 3, 1, 4, generator=generator)
    red = torch.tensor([[0.9, 0.2, 0.1]])
    glossy = TransferTensor.from_dense(rows, exit_basis=HemisphericalHarmonics(9), reflectance=red)
    diffuse = TransferTensor.from_dense(constant)
    total = add([diffuse, glossy])
    assert tuple(total.values.shape) == (6, 3, 9, 4)
    expected = rows * red[0][:, None, None]
    expected[:, :, 0] += constant[:, :, 0] * math.sqrt(4 * math.pi)
    assert torch.allclose(total.dense(), expected, atol=1e-6)
    assert torch.equal(total.block(slice(2, 5)).dense(), total.dense()[2:5])
    assert add([glossy]) is glossy
    shared = add([glossy, glossy])
    assert torch.equal(shared.surface.reflectance, red)
    assert torch.allclose(shared.dense(), 2 * rows)
    with pytest.raises(ValueError, match="same points"):
        add([glossy, TransferTensor.from_dense(torch.zeros(5, 4))])
    four = TransferTensor.from_dense(rows[:, :, :4], exit_basis=HemisphericalHarmonics(4))
    with pytest.raises(ValueError, match="one exit basis"):
        add([glossy, four])


def test_seen_from():
    transfer = bake(bumpy(3), light_basis=SphericalHarmonics(2), resolution=4, supersampling=1)
    above, below = torch.tensor([[0.0, 9, 0]]), torch.tensor([[0.0, -9, 0]])
    assert bool(seen_from(transfer.surface, above).all())
    assert not bool(seen_from(transfer.surface, below).any())


# --- rows of BRDF factors, under light in harmonics --------------------------------------------

METAL = GGX(f0=0.9, roughness=0.5)
COMMON: dict[str, Any] = {
    "light_basis": SphericalHarmonics(4),
    "resolution": 16,
    "supersampling": 1,
}


def harmonic(brdf, num_terms: int, **options: Any) -> BRDFFactors:
    options = {"resolution": 8, "light_order": 4, "clamp": None, **options}
    return BRDFFactors.from_brdf(
        brdf, method="harmonic", mapping="concentric", num_terms=num_terms, **options
    )


@pytest.mark.parametrize("constants", [0, 1])
def test_unshadowed_light_is_reflected_exactly(constants):
    """All rows that there are: what is left is the light side, and A⁻¹ makes that exact."""
    factors = harmonic(PHONG, 17, constants=constants)
    reflection = factored_reflection(factors, torch.zeros(1, dtype=torch.int64), torch.zeros(1, 1))
    views, used = factors.hemisphere.centres()
    light = torch.randn(16, 1, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    incident = (sh.hemisphere_gram(4) @ light)[None, None]
    found = factors.evaluate(views[used]).detach() @ reflection.reflect(slice(0, 1), incident)[0, 0]
    nodes, weights = sh.hemisphere_quadrature(63)
    values = PHONG.evaluate(nodes, views[used][:, None])[..., 0] * nodes[:, 2] * weights
    assert relative(found, values @ (sh.evaluate(nodes, 4) @ light)) < 1e-4


def test_factors_by_nodes_that_follow_lobes():
    """A second implementation where lobes are wide; where they are sharp, albedo tells."""
    found, change = factor_in_harmonics(
        [PHONG, Lambert(0.3)], num_terms=6, constants=1, light_order=4
    )
    plain = harmonic([PHONG, Lambert(0.3)], 6, constants=1, resolution=32)
    views, _ = sh.hemisphere_quadrature(7)
    for material in range(2):
        a, b = (f.evaluate(views) @ f.light_values[material].double() for f in (found, plain))
        assert relative(a.detach(), b.detach()) < 2e-3
    assert found.rms == pytest.approx(plain.rms, rel=1e-3)
    assert change < RESOLVED
    sharp = GGX(f0=1.0, roughness=0.05)
    found, change = factor_in_harmonics([sharp], num_terms=16, constants=0, light_order=4)
    assert change < RESOLVED
    mean = found.evaluate(views) @ found.light_values[0, :, 0].double() * math.sqrt(4 * math.pi)
    albedo = directional_albedo(sharp, views, resolution=48)[:, 0]
    assert relative(mean.detach(), albedo) < 0.02


def test_constants_beside_harmonics():
    factors = harmonic([PHONG, Lambert(0.5)], 4, constants=1)
    views, used = factors.hemisphere.centres()
    seen = factors.evaluate(views[used]).detach()
    assert bool((seen[:, 0] == 1).all())
    assert torch.allclose(seen[:, 1:].mean(0), torch.zeros(3).double(), atol=1e-7)
    # A Lambertian material is its constant and nothing else: cos / pi has one linear term.
    lambertian = factors.light_values[1].detach().double()
    assert float(lambertian[1:].abs().max()) < 1e-6
    cosine = sh.hemisphere_gram(4)[:, 2] * math.sqrt(4 * math.pi / 3) / math.pi * 0.5
    assert torch.allclose(lambertian[0], cosine, atol=1e-6)
    tinted = harmonic(GGX(f0=(0.9, 0.6, 0.2), roughness=0.5), 5, constants=3)
    assert torch.equal(tinted.evaluate(views)[:, :3], torch.eye(3).double().expand(64, 3, 3))
    free = harmonic(PHONG, 3)
    assert free.rms is not None
    assert free.rms <= (harmonic(PHONG, 3, constants=1).rms or 0.0)


def brute_force(mesh, visibility, brdf, light, eyes, points) -> torch.Tensor:
    """BRDF times cosine times visibility times light, summed over texels: "views points"."""
    directions = cubemap_directions(16, dtype=torch.float64).reshape(-1, 3)
    solid_angles = cubemap_solid_angles(16, dtype=torch.float64).reshape(-1)
    frames = frame_from_normal(mesh.normals)
    radiance = sh.evaluate(directions, sh.order_of(light)) @ light
    seen = []
    for point in points:
        shown = visibility.unpack(slice(point, point + 1))[0].double() * solid_angles
        wi = directions @ frames[point].mT
        wo = torch.nn.functional.normalize(eyes - mesh.vertices[point], dim=-1)
        values = brdf.evaluate(wi, (wo @ frames[point].mT)[:, None])[..., 0]
        seen.append((values * wi[:, 2].clamp_min(0)) @ (shown * radiance))
    return torch.stack(seen, dim=1)


def test_glossy_rows_and_their_lobes(scene):
    """Against brute force: the fewer rows the worse, and lobes add little to it."""
    mesh, visibility = scene
    eyes = torch.tensor([[0.5, 4.0, 1.0], [-2.0, 3.0, 2.0]], dtype=torch.float64)
    light = smooth_light((3.0, 2.5, 2.0), 0.1, 4)[0].double()[:, 0]
    points = list(range(0, mesh.num_points, 4))
    expected = brute_force(mesh, visibility, METAL, light, eyes, points)
    towards = torch.nn.functional.normalize(eyes[:, None] - mesh.vertices[points], dim=-1)
    facing = (towards * mesh.normals[points]).sum(-1) > 0.05
    coloured = light.float()[None, :, None].expand(-1, -1, 3)
    errors = []
    for rows in (3, 10):
        transfer = bake(
            mesh, materials=Material(False, METAL), exit_basis="factors", num_rows=rows, **COMMON
        )
        assert transfer.values.shape == (mesh.num_points, 1, rows, 16)
        found = dense_radiance(transfer, coloured, eyes.float())[0, :, points, 0]
        errors.append(relative(found[facing].double(), expected[facing]))
        model = ZonalLobes.from_transfer(transfer, num_lobes=3, effort="fast")
        lit = dense_radiance(
            TransferTensor(model.dense().detach(), transfer.surface), coloured, eyes.float()
        )[0, :, points, 0]
        assert relative(lit[facing], found[facing]) < 0.02
    assert errors[1] < 0.035
    assert 2 * errors[1] < errors[0] < 0.1


@pytest.mark.parametrize("exit_basis", ["harmonics", "factors"])
def test_reference_norms_are_sums_over_texels(scene, exit_basis):
    """Squared norms of visibility times material, of which the light basis holds a part."""
    mesh, visibility = scene
    albedo = torch.full((mesh.num_points, 1), 0.4)
    nothing = torch.zeros(mesh.num_points, dtype=torch.int64)
    if exit_basis == "harmonics":
        reflection = glossy_reflection([PHONG], nothing, albedo, num_rows=9, order=4)
    else:
        reflection = factored_reflection(harmonic(PHONG, 5, constants=1), nothing, albedo)
    gram, constant = reflection.exit_basis.gram(), reflection.exit_basis.constants()[0]
    directions = cubemap_directions(16, dtype=torch.float64).reshape(-1, 3)
    solid_angles = cubemap_solid_angles(16, dtype=torch.float64).reshape(-1)
    for order in (2, 6):
        transfer = project_glossy(mesh, visibility, reflection, SphericalHarmonics(order))
        norms = transfer.reference_squared_norm
        assert norms is not None
        for point in (0, 40, 77):
            seen = visibility.unpack(slice(point, point + 1))[0].double() * solid_angles
            local = directions @ transfer.surface.frames[point].double().mT
            beta = reflection.matrices[0, 0] @ sh.evaluate(local, 4).mT
            beta = beta + constant[:, None] * (0.4 / math.pi * local[:, 2])
            expected = float(((gram @ beta) * beta).sum(0) @ seen)
            assert float(norms[point]) == pytest.approx(expected, rel=1e-4)
        held = transfer.squared_norm()
        assert bool((held < norms * 1.01).all())
        assert float(held.sum() / norms.sum()) < (0.9 if order == 2 else 1.0)


def test_lambertian_parts_enter_the_constant(scene):
    mesh, visibility = scene
    none = torch.full((mesh.num_points,), -1)
    reflection = factored_reflection(harmonic(PHONG, 4, constants=1), none, torch.ones(1, 1))
    rows = project_glossy(mesh, visibility, reflection, SphericalHarmonics(4)).dense()
    diffuse = project_diffuse(mesh, visibility, SphericalHarmonics(4)).dense()
    assert torch.allclose(rows[:, :, :1], diffuse, atol=2e-6)
    assert float(rows[:, :, 1:].abs().max()) == 0.0
    with pytest.raises(ValueError, match="expected factors with constants"):
        factored_reflection(harmonic(PHONG, 4), none, torch.ones(1, 1))
    with pytest.raises(ValueError, match="expected light functions in harmonics"):
        factored_reflection(BRDFFactors.from_brdf(PHONG, resolution=4), none, torch.zeros(1, 1))


def test_coloured_grounds_beside_glossy_objects():
    """Colours enter three constants for direct light, channels for light that bounces."""
    lid, box = bumpy(5, colours=True, name="lid"), bumpy(5, name="box")
    # Two albedos on the glossy part: its Lambertian side cannot be factored with the rest.
    lid.albedo[0] = torch.tensor([0.2, 0.3, 0.4], dtype=lid.albedo.dtype)
    mesh = concatenate([lid, box], "all")
    light = smooth_light((3.0, 2.5, 2.0), 0.1, 4)[0][None].float()
    eyes = torch.tensor([[0.5, 4.0, 1.0]])
    made_of = {"lid": Material(glossy=PHONG)}
    common = {**COMMON, "resolution": 8, "materials": made_of}
    expected = dense_radiance(bake(mesh, num_rows=16, **common), light, eyes)
    direct = bake(mesh, exit_basis="factors", num_rows=12, **common)
    assert (direct.num_channels, direct.surface.exit_basis.num_channels) == (1, 3)
    found = dense_radiance(direct, light, eyes)
    assert torch.allclose(found[:, :, 25:], expected[:, :, 25:], atol=1e-4)
    assert relative(found, expected) < 0.02
    bounced = bake(mesh, exit_basis="factors", num_rows=10, max_bounces=2, **common)
    assert (bounced.num_channels, bounced.surface.exit_basis.num_channels) == (3, 1)
    expected = dense_radiance(bake(mesh, num_rows=16, max_bounces=2, **common), light, eyes)
    assert relative(dense_radiance(bounced, light, eyes), expected) < 0.02


def test_bounces_of_the_constant_are_diffuse_bounces(scene):
    mesh, visibility = scene
    none = torch.full((mesh.num_points,), -1)
    factors = harmonic(PHONG, 3, constants=1)
    reflection = factored_reflection(factors, none, torch.ones(1, 1))
    sent = torch.rand(mesh.num_points, 1, 1, 2, generator=torch.Generator().manual_seed(0))
    grey, options = torch.full((1, 3), 0.6), {"max_bounces": 2, "resolution": 8}
    plain = diffuse_reflection(mesh.num_points)
    expected = interreflect(mesh, visibility, plain, sent, grey, **options).gathered
    rows = torch.cat([sent, torch.zeros(mesh.num_points, 1, 2, 2)], dim=2)
    found = interreflect(mesh, visibility, reflection, rows, grey, **options).gathered
    assert torch.allclose(found[:, :, :1], expected, atol=1e-5)
    assert float(expected.abs().max()) > 0.01


def test_exit_bases_that_do_not_apply():
    mesh, gold = bumpy(3), GGX(f0=(0.9, 0.6, 0.2), roughness=0.5)
    small: dict[str, Any] = {"resolution": 4, "supersampling": 1}
    with pytest.raises(InputError, match="exit_basis: factors are of glossy materials"):
        bake(mesh, exit_basis="factors", **small)
    with pytest.raises(InputError, match="max_bounces: BRDF factors of coloured materials"):
        bake(mesh, materials=Material(glossy=gold), exit_basis="factors", max_bounces=1, **small)
    with pytest.raises(ValueError, match="expected factors of 1 materials with 0 constants"):
        bake(mesh, materials=Material(False, PHONG), factors=harmonic([PHONG, METAL], 3), **small)


def test_a_whole_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    vertices, faces = bumpy(4).vertices.tolist(), (bumpy(4).faces + 1).tolist()
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces]
    Path("bumps.obj").write_text("\n".join([*lines, ""]))
    overrides = [
        "scene.mesh=bumps.obj",
        "scene.ground_resolution=4",
        "material.glossy={name: ggx, f0: 0.5, roughness: 0.4}",
        "transfer=sh_factors",
        "transfer.rows=4",
        "transfer.resolution=8",
        "transfer.supersampling=1",
        "representation=zonal_lobes",
        "representation.num_lobes=3",
        "representation.effort=fast",
        "fit=none",
        "light.test=[sky]",
        "preview.width=16",
        "preview.height=16",
        "preview.opengl=false",
        "cache=cache",
        "out=out",
    ]
    configs = Path(__file__).resolve().parent.parent / "configs"
    report = execute(load_config(configs, "fit", overrides))
    assert report["scene"]["rows"] == 4
    assert 0 < report["bake"]["factor_error"] < 1
    (result,) = report["results"]
    assert result["transfer_error"] < 0.01
    assert result["transfer_error"] < result["reference_error"] < 0.2
    again = bake_only(load_config(configs, "fit", overrides))
    assert again.provenance["projection_cached"]
    with pytest.raises(InputError, match=r"^transfer.exit_basis: factors are of glossy materials"):
        execute(load_config(configs, "fit", [*overrides, "material.glossy=null", "out=other"]))
    assert not Path("other").exists()
