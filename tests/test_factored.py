"""Glossy transfer in all frequencies: sums over sub-texels, materials of a scene, caches."""

import functools
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh
from contract import relative

from prt_torch import evaluate
from prt_torch.assets import concatenate, mesh_from_arrays
from prt_torch.assets.brdf import GGX, Lambert, Phong, Sum
from prt_torch.assets.material import Material
from prt_torch.assets.medium import PRESETS
from prt_torch.assets.mesh import Mesh
from prt_torch.baking import bake, factored, project_diffuse, trace_visibility
from prt_torch.baking.factored import FactoredReflection, project_factored
from prt_torch.baking.visibility import VisibilityField
from prt_torch.bases import (
    SRBF,
    BRDFFactors,
    CubeDirections,
    Haar,
    HemisphereMap,
    SphericalHarmonics,
    factor_error,
    haar,
)
from prt_torch.bases.srbf import gaussian
from prt_torch.errors import InputError
from prt_torch.evaluate import dense_radiance
from prt_torch.sphere import (
    cubemap_directions,
    cubemap_index,
    cubemap_solid_angles,
    frame_from_normal,
    rotation_about_up,
)

EYES = torch.tensor([[0.5, 4.0, 1.0], [3.0, 1.0, -2.0]])
PHONG = Phong(specular=0.6, exponent=6.0)
RAYS = {"resolution": 8, "supersampling": 2}


def ball(name: str = "ball", albedo=(0.8, 0.8, 0.8), at=(0.2, 0.0, 0.1)) -> Mesh:
    """42 points; a colour, or as many as there are points."""
    sphere = trimesh.creation.icosphere(subdivisions=1, radius=0.6)
    vertices = torch.tensor(sphere.vertices) + torch.tensor(at, dtype=torch.float64)
    colours = torch.as_tensor(albedo, dtype=torch.float64).expand(len(vertices), 3)
    return mesh_from_arrays(name, vertices, torch.tensor(sphere.faces), albedo=colours)


def ground(albedo=(0.5, 0.5, 0.5), height: float = -0.7) -> Mesh:
    """4 points that face up."""
    corners = [[-2, height, 2], [2, height, 2], [2, height, -2], [-2, height, -2]]
    colours = torch.tensor(albedo, dtype=torch.float64).expand(4, 3)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    vertices = torch.tensor(corners, dtype=torch.float64)
    return mesh_from_arrays("ground", vertices, faces, albedo=colours)


def scene_of(*meshes: Mesh) -> Mesh:
    return concatenate(meshes, "scene")


def coloured(count: int) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)


def random_factors(mapping="parabolic", materials=1, rows=3, **options) -> BRDFFactors:
    """Positive random maps: nothing smooth or symmetric that could hide a wrong texel."""
    hemisphere = HemisphereMap(mapping, 6)
    generator = torch.Generator().manual_seed(2)
    view = torch.rand(rows, 1, hemisphere.num_texels, generator=generator)
    light = torch.rand(materials, rows, hemisphere.num_texels, generator=generator)
    return BRDFFactors(view, light, hemisphere, **options)


@pytest.fixture(scope="module")
def simple() -> tuple[Mesh, VisibilityField]:
    mesh = scene_of(ball(), ground())
    return mesh, trace_visibility(mesh, **RAYS)


@pytest.fixture
def coarse(monkeypatch):
    """Factors that a bake makes have small maps."""
    small = functools.partial(BRDFFactors.from_brdf, resolution=10)
    monkeypatch.setattr(BRDFFactors, "from_brdf", small)
    monkeypatch.setattr(factored, "HemisphereMap", lambda: HemisphereMap(resolution=10))


def by_definition(mesh, visibility, reflection, resolution: int) -> torch.Tensor:
    """Integrals over light texels "points rows texels", point after point, float64."""
    directions = cubemap_directions(visibility.resolution, dtype=torch.float64).reshape(-1, 3)
    solid_angles = cubemap_solid_angles(visibility.resolution, dtype=torch.float64).flatten()
    texel = cubemap_index(directions, resolution)
    total = torch.zeros(mesh.num_points, reflection.factors.num_rows, 6 * resolution**2).double()
    for point in range(mesh.num_points):
        local = directions @ frame_from_normal(mesh.normals[point]).mT
        material, albedo = int(reflection.materials[point]), reflection.lambertian[point].double()
        rows = torch.zeros(len(local), reflection.factors.num_rows, dtype=torch.float64)
        if material >= 0:
            rows += reflection.factors.light(local, material).detach()
        rows[:, : len(albedo)] += albedo * local[:, 2:] / math.pi
        seen = visibility.unpack(slice(point, point + 1))[0] * solid_angles
        total[point].index_add_(1, texel, (rows * seen[:, None]).mT)
    return total


def texels_of(basis: CubeDirections | Haar, values: torch.Tensor) -> torch.Tensor:
    """Integrals over texels from transfer values."""
    if isinstance(basis, CubeDirections):
        return values
    along, edge = basis.resolution // basis.segment, basis.segment
    images = haar.inverse(values.unflatten(-1, (6, along, along, edge, edge)))
    return images.transpose(-3, -2).flatten(-5)


def visible_light(visibility, mesh, basis, light: torch.Tensor) -> torch.Tensor:
    """Radiance times solid angle "points subtexels rgb" that points see of texels' light."""
    directions = cubemap_directions(visibility.resolution, dtype=torch.float64).reshape(-1, 3)
    solid_angles = cubemap_solid_angles(visibility.resolution, dtype=torch.float64).flatten()
    texels = CubeDirections(basis.resolution).num_coeffs
    radiance = texels_of(basis, light.mT)[0].mT
    assert len(radiance) == texels
    of_subtexel = radiance[cubemap_index(directions, basis.resolution)] * solid_angles[:, None]
    return visibility.unpack(slice(0, mesh.num_points))[..., None] * of_subtexel


def local_directions(mesh, visibility) -> torch.Tensor:
    """Sub-texel centres "points subtexels 3" in shading frames."""
    directions = cubemap_directions(visibility.resolution, dtype=torch.float64).reshape(-1, 3)
    return directions @ frame_from_normal(mesh.normals).mT


def local_views(mesh) -> torch.Tensor:
    """Unit directions "views points 3" towards the eyes in shading frames."""
    towards = torch.nn.functional.normalize(EYES[:, None].double() - mesh.vertices, dim=-1)
    return torch.einsum("pij,vpj->vpi", frame_from_normal(mesh.normals), towards)


def some_light(basis: CubeDirections | Haar) -> torch.Tensor:
    """Light coefficients of positive random texels, "1 coeffs rgb"."""
    generator = torch.Generator().manual_seed(3)
    texels = torch.rand(1, 6 * basis.resolution**2, 3, generator=generator, dtype=torch.float64)
    if isinstance(basis, CubeDirections):
        return texels
    along, edge = basis.resolution // basis.segment, basis.segment
    images = texels.mT.unflatten(-1, (6, along, edge, along, edge)).transpose(-3, -2)
    return haar.forward(images).flatten(-5).mT


class TestProjection:
    @pytest.mark.parametrize("mapping", ["parabolic", "orthographic", "concentric", "polar"])
    @pytest.mark.parametrize(
        ("basis", "cosine"),
        [(CubeDirections(4), True), (Haar(8, 4), False), (Haar(4, 4), True), (Haar(16, 2), False)],
        ids=["cube", "segments", "whole_faces", "texel_a_ray"],
    )
    def test_against_the_sum_over_sub_texels(self, simple, mapping, basis, cosine):
        """Two materials, points of none, and coloured Lambertian light in rows of its own."""
        mesh, visibility = simple
        factors = random_factors(mapping, materials=2, rows=4, cosine=cosine, num_constants=3)
        materials = torch.arange(mesh.num_points) % 3 - 1
        lambertian = coloured(mesh.num_points).float()
        lambertian[::5] = 0
        reflection = FactoredReflection(factors, materials, lambertian)
        transfer = project_factored(mesh, visibility, reflection, basis)
        expected = by_definition(mesh, visibility, reflection, basis.resolution)
        assert tuple(transfer.values.shape) == (mesh.num_points, 1, 4, basis.num_coeffs)
        found = texels_of(basis, transfer.dense()[:, 0].double())
        assert relative(found, expected) < 2e-6
        assert float(expected[1].abs().max()) > 0  # there is something to compare

    def test_lambertian_rows_are_diffuse_transfer(self, simple):
        mesh, visibility = simple
        none = torch.full((mesh.num_points,), -1)
        factors = random_factors(num_constants=1)
        reflection = FactoredReflection(factors, none, torch.ones(mesh.num_points, 1))
        for basis in (CubeDirections(8), Haar(8, 4)):
            found = project_factored(mesh, visibility, reflection, basis).dense()
            diffuse = project_diffuse(mesh, visibility, basis).dense()
            assert torch.allclose(found[:, :, :1], diffuse, rtol=1e-6, atol=1e-8)
            assert float(found[:, :, 1:].abs().max()) == 0.0

    def test_points_without_a_normal_have_no_transfer(self):
        plane = ground()
        mesh = mesh_from_arrays(
            "stray", torch.cat([plane.vertices, torch.full((1, 3), 5.0).double()]), plane.faces
        )
        visibility = trace_visibility(mesh, **RAYS)
        reflection = FactoredReflection(
            random_factors(num_constants=1), torch.zeros(5).long(), torch.ones(5, 1)
        )
        values = project_factored(mesh, visibility, reflection, Haar(4, 4)).dense()
        assert float(values[4].abs().max()) == 0.0
        assert float(values[:4].abs().amax((1, 2, 3)).min()) > 0.01

    def test_an_occluder_never_brightens(self, simple):
        """Positive light functions: less visibility is less transfer, texel by texel."""
        mesh, visibility = simple
        alone = ball()
        bare = trace_visibility(alone, **RAYS)
        factors = random_factors()

        def values(mesh, visibility):
            none = torch.zeros(mesh.num_points, 0)
            reflection = FactoredReflection(factors, torch.zeros(mesh.num_points).long(), none)
            return project_factored(mesh, visibility, reflection, CubeDirections(8)).dense()

        darker, lighter = values(mesh, visibility)[:42], values(alone, bare)
        assert float((darker - lighter).max()) <= 1e-7
        assert float((lighter - darker).max()) > 1e-3
        assert float(darker.min()) >= 0.0

    def test_rays_are_a_multiple_of_texels(self, simple):
        mesh, visibility = simple
        reflection = FactoredReflection(
            random_factors(), torch.zeros(46).long(), torch.zeros(46, 0)
        )
        with pytest.raises(InputError, match="a multiple of 32, got 16"):
            project_factored(mesh, visibility, reflection, Haar(32, 16))

    def test_what_does_not_fit_together_is_refused(self):
        points = torch.zeros(2).long()
        with pytest.raises(ValueError, match="expected 1 constants, got 0"):
            FactoredReflection(random_factors(), points, torch.ones(2, 1))
        with pytest.raises(ValueError, match="expected factors of 3 materials, got 1"):
            FactoredReflection(random_factors(), points + 2, torch.ones(2, 0))
        harmonic = BRDFFactors.from_brdf(PHONG, num_terms=2, resolution=6, method="harmonic")
        with pytest.raises(ValueError, match="got harmonics of 6 bands"):
            FactoredReflection(harmonic, points, torch.ones(2, 0))


class TestRadiance:
    @pytest.mark.parametrize("basis", [CubeDirections(8), Haar(8, 4), Haar(8, 8)])
    def test_is_the_integral_with_the_factored_brdf(self, basis):
        """Through bake, views and light coefficients; coloured view functions."""
        mesh, brdf = scene_of(ball()), GGX(f0=(0.9, 0.6, 0.2), roughness=0.4)
        factors = BRDFFactors.from_brdf(brdf, num_terms=6, resolution=10)
        made_of = Material(lambertian=False, glossy=brdf)
        transfer = bake(mesh, materials=made_of, light_basis=basis, factors=factors, **RAYS)
        assert (transfer.num_channels, factors.num_channels) == (1, 3)
        visibility, light = trace_visibility(mesh, **RAYS), some_light(basis)
        towards_light = factors.light(local_directions(mesh, visibility)).detach().double()
        towards_eyes = factors.evaluate(local_views(mesh)).detach().double()
        incident = visible_light(visibility, mesh, basis, light)
        expected = torch.einsum("vpkc,psk,psc->vpc", towards_eyes, towards_light, incident)
        found = dense_radiance(transfer, light, EYES)[0]
        assert relative(found.double(), expected) < 1e-5
        assert torch.equal(dense_radiance(transfer, 2 * light, EYES)[0], 2 * found)

    def test_is_near_the_integral_with_the_material(self, simple):
        """Within the error of the factors, which fine light sees more of than smooth light."""
        (mesh, visibility), basis = simple, Haar(8, 4)
        brdf = GGX(f0=0.6, roughness=0.5)
        factors = BRDFFactors.from_brdf(brdf, num_terms=16, resolution=16, clamp=None)
        made_of = Material(lambertian=False, glossy=brdf)
        transfer = bake(mesh, materials=made_of, light_basis=basis, factors=factors, **RAYS)
        light, views = some_light(basis), local_views(mesh)
        directions = local_directions(mesh, visibility)
        cosine = directions[..., 2:].clamp_min(0)
        reflected = brdf.evaluate(directions, views[:, :, None]) * cosine
        incident = visible_light(visibility, mesh, basis, light)
        expected = torch.einsum("vpsc,psc->vpc", reflected, incident)
        found = dense_radiance(transfer, light, EYES)[0].double()
        facing = views[..., 2] > 0.2
        lost = (found - expected)[facing].norm() / expected[facing].norm()
        assert 0 < float(lost) < factor_error(factors, brdf).relative
        assert float(lost) < 0.05

    def test_lambertian_gloss_under_a_unit_sky_returns_its_albedo(self, coarse):
        colour = (0.6, 0.3, 0.1)
        transfer = bake(
            ground(),
            materials=Material(lambertian=False, glossy=Lambert(colour)),
            light_basis=Haar(16, 16),
            num_rows=2,
            **RAYS,
        )
        assert (transfer.num_channels, transfer.num_rows) == (1, 2)
        sky = torch.zeros(1, 1536, 3)
        sky[:, ::256] = 16.0  # the mean of an orthonormal transform
        radiance = dense_radiance(transfer, sky, EYES)
        assert torch.allclose(radiance, torch.tensor(colour), rtol=5e-3)

    def test_turning_scene_and_light_together_changes_nothing(self):
        """A quarter turn about the pole of the frames takes rays, texels and maps to themselves."""
        turn, basis = rotation_about_up(90.0), Haar(8, 4)
        mesh = scene_of(ball(), ground())
        turned = mesh_from_arrays(
            "turned", mesh.vertices @ turn.mT, mesh.faces, normals=mesh.normals @ turn.mT
        )
        brdf = GGX(f0=0.6, roughness=0.4)
        factors = BRDFFactors.from_brdf(brdf, num_terms=12, resolution=10)
        made_of = Material(lambertian=False, glossy=brdf)
        light = some_light(basis)
        first, second = (
            dense_radiance(
                bake(one, materials=made_of, light_basis=basis, factors=factors, **RAYS), lit, eyes
            )
            for one, lit, eyes in (
                (mesh, light, EYES),
                (turned, basis.rotate(light, turn), EYES @ turn.mT.float()),
            )
        )
        assert relative(first, second) < 1e-4
        assert relative(first, second.flip(2)) > 0.1


class TestMaterials:
    def test_no_constants_without_lambertian_light(self, coarse):
        mesh = scene_of(ball("left"), ball("right", at=(1.6, 0, 0)))
        polished = Material(lambertian=False, glossy=GGX(f0=(0.9, 0.6, 0.2), roughness=0.3))
        matt = Material(lambertian=False, glossy=PHONG)
        transfer = bake(
            mesh,
            materials={"left": polished, "right": matt},
            light_basis=Haar(8, 8),
            **RAYS,
        )
        assert (transfer.num_channels, transfer.num_rows) == (1, 10)
        assert len(transfer.surface.exit_basis.constants()) == 0
        assert 0 < transfer.provenance["factor_error"] < 1
        swapped = bake(
            mesh, materials={"left": matt, "right": polished}, light_basis=Haar(8, 8), **RAYS
        )
        assert relative(transfer.dense(), swapped.dense()) > 0.1

    def test_one_constant_beside_lambertian_parts(self, coarse):
        """Also where albedo is exactly zero in one colour, whose row is then free."""
        mesh = scene_of(ball(), ground((0.7, 0.2, 0.0)))
        polished = Material(lambertian=False, glossy=PHONG)
        transfer = bake(mesh, materials={"ball": polished}, light_basis=Haar(8, 8), **RAYS)
        exits = transfer.surface.exit_basis
        assert (transfer.num_channels, transfer.num_rows, len(exits.constants())) == (1, 10, 1)
        diffuse = bake(mesh, light_basis=Haar(8, 8), **RAYS)
        light = some_light(Haar(8, 8))
        found, expected = dense_radiance(transfer, light, EYES), dense_radiance(diffuse, light)
        assert torch.allclose(found[:, :, 42:], expected[:, :, 42:].expand(-1, 2, -1, -1))
        assert float(found[:, :, 42:, 2].abs().max()) == 0.0

    def test_shared_albedo_is_part_of_the_material(self, coarse):
        """A constant more would be free: bake has none, and its maps hold the colour."""
        colour, basis = (0.5, 0.2, 0.1), Haar(8, 8)
        made_of = Material(glossy=PHONG)
        transfer = bake(ball(albedo=colour), materials=made_of, light_basis=basis, **RAYS)
        both = Sum((Lambert(colour), PHONG))
        factors = BRDFFactors.from_brdf(both, num_terms=10)
        expected = bake(
            ball(),
            materials=Material(lambertian=False, glossy=both),
            light_basis=basis,
            factors=factors,
            **RAYS,
        )
        assert (transfer.num_channels, transfer.num_rows) == (1, 10)
        assert len(transfer.surface.exit_basis.constants()) == 0
        light = some_light(basis)
        radiance = dense_radiance(transfer, light, EYES)
        assert torch.allclose(radiance, dense_radiance(expected, light, EYES))
        assert float((radiance[..., 0] / radiance[..., 2]).mean()) > 1.1

    def test_coloured_points_under_gloss_need_three_constants_and_one_channel(self, coarse):
        """Radiance is that of the gloss and of the coloured Lambertian scene, added."""
        mesh, basis = ball(albedo=coloured(42)), Haar(8, 4)
        transfer = bake(mesh, materials=Material(glossy=PHONG), light_basis=basis, **RAYS)
        exits = transfer.surface.exit_basis
        assert (transfer.num_channels, transfer.num_rows, len(exits.constants())) == (1, 12, 3)
        light = some_light(basis)
        gloss = project_factored(
            mesh,
            trace_visibility(mesh, **RAYS),
            FactoredReflection(
                BRDFFactors.from_brdf([PHONG], num_terms=12, constants=3),
                torch.zeros(42).long(),
                torch.zeros(42, 0),
            ),
            basis,
        )
        expected = dense_radiance(gloss, light, EYES) + dense_radiance(
            bake(mesh, light_basis=basis, **RAYS), light
        )
        assert relative(dense_radiance(transfer, light, EYES), expected) < 1e-5

    @pytest.mark.parametrize(("absorption", "rows"), [((0.2, 0.01, 0.001), 12), ((0.01,) * 3, 10)])
    def test_media_enter_the_constants(self, coarse, absorption, rows):
        """Gloss on one part, a translucent other part: their colour costs rows, no channels."""
        stone = replace(PRESETS["marble"], reduced_scattering=(2.0,) * 3, absorption=absorption)
        mesh, basis = scene_of(ball("shiny"), ball("stone", at=(1.6, 0, 0))), Haar(8, 4)
        inside = Material(lambertian=False, medium=stone, millimetres_per_unit=10.0)
        gloss = Material(lambertian=False, glossy=PHONG)
        transfer, of_stone = (
            bake(mesh, materials={"shiny": other, "stone": inside}, light_basis=basis, **RAYS)
            for other in (gloss, Material(lambertian=False))
        )
        assert (transfer.num_channels, transfer.num_rows) == (1, rows)
        light = some_light(basis)
        found, diffuse = dense_radiance(transfer, light, EYES), dense_radiance(of_stone, light)
        assert relative(found[:, :, 42:], diffuse[:, :, 42:].expand(-1, 2, -1, -1)) < 1e-5
        assert float(diffuse[:, :, 42:].amin((0, 1, 3)).max()) > 0.01
        assert float((found - diffuse)[:, :, :42].amax((0, 1, 3)).median()) > 0.01

    def test_gloss_over_a_coloured_medium_adds_up(self, coarse):
        """One point with all three: Lambertian colour, gloss, translucency."""
        mesh, basis = ball(albedo=coloured(42)), Haar(8, 4)
        factors = BRDFFactors.from_brdf(PHONG, num_terms=12, constants=3)
        medium = {"medium": PRESETS["skin1"], "millimetres_per_unit": 10.0}
        options = {"light_basis": basis, **RAYS}
        light = some_light(basis)

        def radiance(views, **material):
            return dense_radiance(bake(mesh, **material, **options), light, views)

        everything = radiance(EYES, materials=Material(glossy=PHONG, **medium), factors=factors)
        gloss = radiance(EYES, materials=Material(glossy=PHONG), factors=factors)
        inside = radiance(None, materials=Material(lambertian=False, **medium))
        assert relative(everything, gloss + inside) < 1e-5
        assert float(inside.mean()) > 0.01

    def test_what_is_asked_for_in_vain_is_refused(self, coarse):
        glossy = Material(glossy=PHONG)
        plane, matt = ground(), Material(lambertian=False, glossy=PHONG)
        with pytest.raises(InputError, match="max_bounces: glossy materials bounce light in"):
            bake(plane, materials=glossy, light_basis=Haar(8, 8), max_bounces=1)
        with pytest.raises(InputError, match=r"multiple of 32, got 16"):
            bake(plane, light_basis=Haar(32, 16), **RAYS)
        with pytest.raises(InputError, match="num_rows: the materials need at least 3, got 2"):
            bake(ball(albedo=coloured(42)), materials=glossy, light_basis=Haar(8, 8), num_rows=2)
        one, two = random_factors(), random_factors(materials=2, num_constants=1)
        with pytest.raises(ValueError, match="of 1 materials with 0 constants, got 2 with 1"):
            bake(plane, materials=matt, light_basis=Haar(8, 8), factors=two)
        for given in ({}, {"materials": matt, "light_basis": SphericalHarmonics(3)}):
            with pytest.raises(ValueError, match="expected factors only of glossy materials"):
                bake(plane, factors=one, **given)

    def test_diffuse_scenes_factor_nothing(self, monkeypatch):
        monkeypatch.setattr(BRDFFactors, "from_brdf", None)
        transfer = bake(scene_of(ball(), ground()), light_basis=Haar(8, 4), **RAYS)
        assert (transfer.num_channels, transfer.num_rows) == (1, 1)
        assert transfer.surface.exit_basis.describe() == {"name": "diffuse"}


class TestCache:
    def bake(self, cache: Path | None, **options):
        made_of = Material(lambertian=False, glossy=PHONG)
        given = {"factors": random_factors(rows=2), **options}
        mesh = scene_of(ball(), ground())
        return bake(mesh, materials=made_of, light_basis=Haar(8, 4), cache=cache, **RAYS, **given)

    def test_a_killed_projection_resumes(self, tmp_path, monkeypatch):
        expected = self.bake(None).dense()
        monkeypatch.setattr(factored, "_SHARD_BYTES", 10 * 4 * 2 * 384)  # five shards
        project, projected = factored._project_shard, []

        def until_killed(*arguments):
            if len(projected) == 2:
                raise KeyboardInterrupt
            projected.append(arguments[-1])
            return project(*arguments)

        with monkeypatch.context() as patch:
            patch.setattr(factored, "_project_shard", until_killed)
            with pytest.raises(KeyboardInterrupt):
                self.bake(tmp_path)

        def counted(*arguments):
            projected.append(arguments[-1])
            return project(*arguments)

        monkeypatch.setattr(factored, "_project_shard", counted)
        resumed, again = self.bake(tmp_path), self.bake(tmp_path)
        assert [(rows.start, rows.stop) for rows in projected] == [
            (0, 10),
            (10, 20),
            (20, 30),
            (30, 40),
            (40, 46),
        ]
        assert torch.equal(resumed.dense(), expected)
        assert torch.equal(again.dense(), expected)
        assert not resumed.provenance["projection_cached"]
        assert again.provenance["projection_cached"]

    def test_another_material_is_another_bake(self, tmp_path):
        first = self.bake(tmp_path)
        for factors in (
            random_factors(rows=3),
            random_factors("concentric", rows=2),
            random_factors(rows=2, cosine=False),
        ):
            other = self.bake(tmp_path, factors=factors)
            assert other.provenance["visibility_cached"]
            assert not other.provenance["projection_cached"]
            assert not torch.equal(other.dense()[:, :, :2], first.dense())
        assert self.bake(tmp_path).provenance["projection_cached"]

    def test_factors_are_made_once(self, tmp_path, coarse, monkeypatch):
        first = self.bake(tmp_path, factors=None)
        monkeypatch.setattr(BRDFFactors, "from_brdf", None)
        again = self.bake(tmp_path, factors=None)
        assert again.provenance["projection_cached"]
        assert again.provenance["factor_error"] == first.provenance["factor_error"]
        views = (t.surface.exit_basis.tensors()["view_values"] for t in (first, again))
        assert torch.equal(*views)


def test_norms_are_of_the_texels_whatever_the_basis(coarse):
    made_of = Material(lambertian=False, glossy=PHONG)
    texels, wavelets, kernels = (
        bake(ball(), materials=made_of, light_basis=basis, **RAYS)
        for basis in (CubeDirections(8), Haar(8, 4), SRBF(42, resolution=8))
    )
    full = texels.reference_squared_norm
    assert full is not None
    assert kernels.reference_squared_norm is not None
    assert relative(full, texels.squared_norm()) < 1e-6
    assert torch.equal(full, wavelets.reference_squared_norm)
    # What the kernels lose, measured by their sum at the middle of each texel.
    basis = kernels.surface.light_basis
    directions = cubemap_directions(32, dtype=torch.float64).reshape(-1, 3)
    bells = gaussian(directions, basis.centers, basis.bandwidths).float()
    sums = basis_texels(kernels.dense() @ bells.mT)
    wrong = float(texels.squared_norm_of(texels.dense() - sums).sum() / full.sum())
    assert evaluate.reference_error(0.0, kernels) == pytest.approx(wrong, rel=0.1)
    assert wrong > 1e-3


def basis_texels(values: torch.Tensor) -> torch.Tensor:
    """Integrals over texels of a cube of 8 of values at those of 32."""
    solid_angles = cubemap_solid_angles(32).flatten()
    return (
        CubeDirections(8)
        .project_cube((values * solid_angles).flatten(0, 2), 32)
        .view(*values.shape[:3], -1)
    )
