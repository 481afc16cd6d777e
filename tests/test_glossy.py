"""Glossy transfer: reflection matrices, matrices of points, materials of a scene, sums."""

import math
from dataclasses import replace

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
    project_brdf,
    project_diffuse,
    project_glossy,
    trace_visibility,
)
from prt_torch.bases import HemisphericalHarmonics, SphericalHarmonics, sh
from prt_torch.errors import InputError
from prt_torch.evaluate import dense_radiance, seen_from
from prt_torch.sphere import cubemap_directions, cubemap_solid_angles
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
