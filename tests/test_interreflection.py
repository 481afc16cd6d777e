"""Interreflection against closed forms, and against itself in other words."""

import math

import numpy as np
import pytest
import torch
import trimesh

from prt_torch.assets import mesh_from_arrays
from prt_torch.assets.mesh import Mesh
from prt_torch.baking import project_diffuse, trace_visibility
from prt_torch.baking.hits import HitFinder
from prt_torch.baking.interreflection import Bounces, interreflect
from prt_torch.baking.reflection import Reflection, diffuse_reflection
from prt_torch.bases import HemisphericalHarmonics, SphericalHarmonics, sh
from prt_torch.sphere import cubemap_directions, cubemap_solid_angles, frame_from_normal

UNIT_SKY = math.sqrt(4 * math.pi)  # coefficient of y_00 of radiance 1
RAYS = {"resolution": 8, "supersampling": 2}


def mesh_of(vertices, faces, normals=None) -> Mesh:
    return mesh_from_arrays(
        "test",
        torch.tensor(np.asarray(vertices, np.float64)),
        torch.tensor(np.asarray(faces, np.int64)),
        normals=None if normals is None else torch.tensor(np.asarray(normals, np.float64)),
    )


def inward_sphere(subdivisions: int, *, half: bool = False) -> Mesh:
    """The inside of a unit sphere, or of its lower half."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    faces = ball.faces[:, ::-1]
    if half:
        faces = faces[(ball.vertices[faces][..., 1] <= 1e-9).all(axis=1)]
    used, place = np.unique(faces, return_inverse=True)
    corners = ball.vertices[used]
    return mesh_of(corners, place.reshape(-1, 3), -corners)


def tangle() -> Mesh:
    """A ball that floats in a bowl: everything sees something of everything."""
    bowl = inward_sphere(2, half=True)
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.35)
    vertices = np.concatenate([bowl.vertices.numpy(), ball.vertices - [0.1, 0.3, 0.05]])
    faces = np.concatenate([bowl.faces.numpy(), ball.faces + bowl.num_points])
    return mesh_of(vertices, faces)


def lambert_in_harmonics(num_points: int, rows: int) -> Reflection:
    """A white Lambertian surface by the matrix of its BRDF: a cosine lobe in, a constant out."""
    basis = HemisphericalHarmonics(rows)
    matrices = torch.zeros(1, 1, rows, 9, dtype=torch.float64)
    constant = float(sh.evaluate(torch.tensor([0.0, 0.0, 1.0]).double(), 1)[0])
    matrices[0, 0, int((basis.indices == 0).nonzero()), 2] = (
        math.sqrt(4 * math.pi / 3) / math.pi / constant
    )
    materials = torch.zeros(num_points, dtype=torch.int64)
    return Reflection(basis, 3, matrices, materials, torch.zeros(1, 1).double())


def grey(albedo: float) -> torch.Tensor:
    return torch.full((1, 3), albedo)


def random_exit(points: int, *shape: int) -> torch.Tensor:
    return torch.rand(points, *shape, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def scene():
    mesh = tangle()
    return mesh, trace_visibility(mesh, **RAYS)


def bounce(scene, exit_radiance, reflectance, reflection=None, **options) -> Bounces:
    mesh, visibility = scene
    options = {"max_bounces": 3, "tolerance": 0.0, "resolution": 8, **options}
    reflection = reflection or diffuse_reflection(mesh.num_points)
    return interreflect(mesh, visibility, reflection, exit_radiance, reflectance, **options)


def test_emission_in_a_closed_sphere_is_a_geometric_series():
    mesh = inward_sphere(2)
    closed = mesh, trace_visibility(mesh, resolution=16, supersampling=2)
    emission = torch.full((mesh.num_points, 1, 1, 1), 0.5)
    done = bounce(closed, emission, grey(0.5), max_bounces=40, tolerance=1e-5, resolution=16)
    radiance = emission + 0.5 * done.gathered
    assert float((radiance - 1).abs().max()) < 1e-3
    # With emission 1/2, radiance after it is 1/4, 1/8, ... and the sum so far 1 - 1/4, 1 - 1/8, ...
    expected = [2.0**-n / (1 - 2.0**-n) for n in range(2, 10)]
    assert done.added[:8] == pytest.approx(expected, rel=2e-3)
    assert done.missed == 0
    assert done.rays > 0
    assert not done.skipped
    assert len(done.added) < 40
    assert done.added[-1] < 1e-5 <= done.added[-2]


@pytest.mark.parametrize(("albedo", "order"), [(0.5, 6), (0.9, 1)])
def test_bowl_under_a_unit_sky(albedo, order):
    """rho / (2 - rho) everywhere; a bowl of facets is a little shallower than a round one."""
    mesh = inward_sphere(3, half=True)
    visibility = trace_visibility(mesh, resolution=16, supersampling=2)
    transfer = project_diffuse(mesh, visibility, SphericalHarmonics(order)).dense()
    options = {"max_bounces": 40, "tolerance": 1e-3, "resolution": 16}
    done = bounce((mesh, visibility), albedo * transfer, grey(albedo), **options)
    radiance = albedo * (transfer + done.gathered)[:, 0, 0, 0] * UNIT_SKY
    assert float((radiance - albedo / (2 - albedo)).abs().max()) < 1e-2
    assert done.missed <= 1e-4 * done.rays


def test_white_furnace():
    """Under a unit sky, white surfaces are 1 and never more, however light gets there."""
    mesh = tangle()
    visibility = trace_visibility(mesh, resolution=16, supersampling=2)
    transfer = project_diffuse(mesh, visibility, SphericalHarmonics(1)).dense()
    before = transfer
    for bounces in (1, 3, 60):
        done = bounce(
            (mesh, visibility),
            transfer,
            grey(1.0),
            max_bounces=bounces,
            tolerance=1e-6,
            resolution=16,
        )
        radiance = transfer + done.gathered
        assert float((before - radiance).max()) <= 1e-6
        assert float(radiance.max()) * UNIT_SKY < 1 + 1e-3
        before = radiance
    assert done.missed <= 1e-4 * done.rays
    # The ball's facets shut light in behind them at its own vertices, nowhere else is any lost.
    assert float((before * UNIT_SKY).median()) > 1 - 2e-3


def test_no_bounce_adds_energy(scene):
    """The largest radiance a bounce makes is at most the largest it had."""
    exit_radiance = random_exit(scene[0].num_points, 1, 1, 5)
    gathered, largest = torch.zeros_like(exit_radiance), exit_radiance.amax((0, 1, 2))
    for bounces in range(1, 6):
        more = bounce(scene, exit_radiance, grey(1.0), max_bounces=bounces).gathered
        now = (more - gathered).amax((0, 1, 2))
        assert bool((now <= largest * (1 + 2e-3)).all())
        gathered, largest = more, now


def turned_harmonics(frame: torch.Tensor, order: int) -> torch.Tensor:
    """The matrix from harmonics of s to harmonics of frame @ s, by least squares."""
    directions = torch.randn(200, 3, generator=torch.Generator().manual_seed(2)).double()
    directions = directions / directions.norm(dim=-1, keepdim=True)
    world = sh.evaluate(directions, order)
    return torch.linalg.lstsq(world, sh.evaluate(directions @ frame.mT, order)).solution.mT


def test_one_bounce_against_a_loop_over_hits(scene):
    """A second implementation: plain sums in float64, radiance by the exit basis itself."""
    mesh, visibility = scene
    rows, order = 4, 3
    basis = HemisphericalHarmonics(rows)
    generator = torch.Generator().manual_seed(1)
    matrices = torch.randn(1, 1, rows, order * order, generator=generator).double()
    materials = torch.zeros(mesh.num_points, dtype=torch.int64)
    reflection = Reflection(basis, order, matrices, materials, torch.zeros(1, 1).double())
    exit_radiance = torch.randn(mesh.num_points, 1, rows, 2, generator=generator)
    gathered = bounce(scene, exit_radiance, grey(1.0), reflection, max_bounces=1).gathered
    finder = HitFinder(mesh, visibility, resolution=8, order=order)
    frames = frame_from_normal(mesh.normals)
    directions = cubemap_directions(visibility.resolution, dtype=torch.float64).reshape(-1, 3)
    block = next(iter(finder.blocks(slice(0, 5))))
    hits = finder.find(block)
    owner = torch.repeat_interleave(torch.arange(5), hits.counts)
    totals = torch.zeros(5, order * order, 2, dtype=torch.float64)
    for hit, point in enumerate(owner.tolist()):
        away = -directions[int(hits.texels[hit])]
        for corner, weight in zip(
            mesh.faces[int(hits.faces[hit])].tolist(), hits.weights[hit].tolist(), strict=True
        ):
            radiance = basis.evaluate(frames[corner] @ away) @ exit_radiance[corner, 0].double()
            totals[point] += weight * hits.moments[hit].double()[:, None] * radiance
    for point in range(5):
        expected = matrices[0, 0] @ turned_harmonics(frames[point], order) @ totals[point]
        assert float(expected.abs().max()) > 0.01
        assert torch.allclose(gathered[point, 0].double(), expected, atol=1e-5)


@pytest.mark.parametrize("resolution", [4, 8, 16])
def test_hidden_and_seen_directions_are_the_whole_hemisphere(resolution):
    """Moments of all hits and of the visible sub-texels add up to those of the hemisphere."""
    mesh = inward_sphere(2, half=True)
    visibility = trace_visibility(mesh, **RAYS)
    finder = HitFinder(mesh, visibility, resolution=resolution, order=3)
    hits = finder.find(next(iter(finder.blocks(slice(0, 20)))))
    owner = torch.repeat_interleave(torch.arange(20), hits.counts)
    hidden = torch.zeros(20, 9, dtype=torch.float64).index_add(0, owner, hits.moments.double())
    directions = cubemap_directions(16, dtype=torch.float64).reshape(-1, 3)
    weighed = sh.evaluate(directions, 3) * cubemap_solid_angles(16).double().reshape(-1, 1)
    seen = visibility.unpack(slice(0, 20)).double() @ weighed
    whole = (mesh.normals[:20] @ directions.mT > 0).double() @ weighed
    assert float((hidden - (whole - seen)).abs().max()) < 1e-5
    assert float(hidden.abs().max()) > 1
    # One ray a texel, through one of its hidden sub-texels.
    texels = hits.texels.long()
    assert not visibility.unpack(slice(0, 20))[owner, texels].any()
    per_edge = 16 // resolution
    row, column = texels % 256 // 16 // per_edge, texels % 16 // per_edge
    coarse = (texels // 256 * resolution + row) * resolution + column
    assert len(torch.unique(torch.stack([owner, coarse]), dim=1)[0]) == len(texels)


def test_interpolated_radiance_is_what_the_hit_sees(scene):
    """Exit radiance that is linear in position is found exactly where the rays end."""
    mesh, visibility = scene
    finder = HitFinder(mesh, visibility, resolution=8, order=2)
    hits = finder.find(next(iter(finder.blocks(slice(0, 30)))))
    owner = torch.repeat_interleave(torch.arange(30), hits.counts)
    corners = mesh.vertices[mesh.faces[hits.faces.long()]]
    place = (hits.weights[:, :, None] * corners).sum(1)
    directions = cubemap_directions(16, dtype=torch.float64).reshape(-1, 3)[hits.texels.long()]
    along = place - mesh.vertices[owner]
    off = along - (along * directions).sum(-1, keepdim=True) * directions
    whole = (hits.weights > 0).all(-1)
    assert float(whole.double().mean()) > 0.5  # grazing rays leave corners out
    assert float(off[whole].norm(dim=-1).max()) < 1e-4
    assert bool((hits.weights.sum(-1) - 1).abs().max() < 1e-5)


def test_back_faces_are_black():
    """Two squares face up, one above the other: the lower sees the back of the upper."""
    square = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    up = mesh_of(np.concatenate([square, square + [0, 0.5, 0]]), np.concatenate([faces, faces + 4]))
    face_to_face = mesh_of(up.vertices, np.concatenate([faces, faces[:, ::-1] + 4]))
    light = torch.ones(8, 1, 1, 1)
    made = {}
    for name, mesh in (("up", up), ("face to face", face_to_face)):
        made[name] = bounce((mesh, trace_visibility(mesh, **RAYS)), light, grey(1.0), max_bounces=1)
    assert float(made["up"].gathered.abs().max()) == 0.0
    assert made["up"].rays > 0
    assert not made["up"].skipped
    assert float(made["face to face"].gathered.min()) > 0.1


def test_convex_scenes_are_skipped():
    ball = trimesh.creation.icosphere(subdivisions=2)
    mesh = mesh_of(ball.vertices, ball.faces)
    done = bounce((mesh, trace_visibility(mesh, **RAYS)), random_exit(162, 1, 1, 4), grey(0.5))
    assert done.skipped
    assert done.rays == 0
    assert done.added == []
    assert done.gathered.shape == (162, 1, 1, 4)
    assert float(done.gathered.abs().max()) == 0.0


def test_linear_in_exit_radiance(scene):
    a = random_exit(scene[0].num_points, 1, 1, 3)
    b = a.flip(0).square()
    mixed = bounce(scene, 2 * a - 0.5 * b, grey(0.7)).gathered
    apart = 2 * bounce(scene, a, grey(0.7)).gathered - 0.5 * bounce(scene, b, grey(0.7)).gathered
    assert torch.allclose(mixed, apart, atol=1e-6)
    one_by_one = [bounce(scene, a[..., i : i + 1], grey(0.7)).gathered for i in range(3)]
    assert torch.allclose(
        torch.cat(one_by_one, -1), bounce(scene, a, grey(0.7)).gathered, atol=1e-6
    )


def test_colour_makes_three_channels_and_grey_does_not(scene):
    points = scene[0].num_points
    initial = random_exit(points, 1, 1, 4)
    albedo = random_exit(points, 3) * 0.9
    coloured = bounce(scene, initial, albedo).gathered
    assert coloured.shape == (points, 3, 1, 4)
    for channel in range(3):
        alone = bounce(scene, initial, albedo[:, channel : channel + 1].expand(-1, 3)).gathered
        assert alone.shape == (points, 1, 1, 4)
        assert torch.allclose(coloured[:, channel : channel + 1], alone, atol=1e-6)
    assert float((coloured[:, 0] - coloured[:, 1]).abs().max()) > 1e-3
    three = bounce(scene, initial.expand(-1, 3, -1, -1), grey(0.5)).gathered
    assert three.shape == (points, 3, 1, 4)


@pytest.mark.parametrize("rows", [4, 8, 24])
def test_lambert_in_hemispherical_harmonics_is_diffuse(scene, rows):
    points = scene[0].num_points
    initial = random_exit(points, 1, 1, 4)
    albedo = random_exit(points, 3) * 0.9
    diffuse = bounce(scene, initial, albedo)
    reflection = lambert_in_harmonics(points, rows)
    of_constant = int((reflection.exit_basis.indices == 0).nonzero())
    in_rows = torch.zeros(points, 1, rows, 4)
    in_rows[:, :, of_constant] = initial[:, :, 0] * UNIT_SKY
    glossy = bounce(scene, in_rows, albedo, reflection)
    assert torch.allclose(
        glossy.gathered[:, :, of_constant], diffuse.gathered[:, :, 0] * UNIT_SKY, atol=1e-5
    )
    others = torch.arange(rows) != of_constant
    assert float(glossy.gathered[:, :, others].abs().max()) < 1e-6
    assert glossy.added == pytest.approx(diffuse.added, rel=1e-4)


def test_permuted_vertices_give_permuted_light(scene):
    mesh, _ = scene
    initial, albedo = random_exit(mesh.num_points, 1, 1, 3), random_exit(mesh.num_points, 3)
    order = torch.randperm(mesh.num_points, generator=torch.Generator().manual_seed(0))
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order))
    shuffled = mesh_of(mesh.vertices[order], place[mesh.faces], mesh.normals[order])
    a = bounce(scene, initial, albedo).gathered[order]
    shuffled_scene = shuffled, trace_visibility(shuffled, **RAYS)
    b = bounce(shuffled_scene, initial[order], albedo[order]).gathered
    assert torch.allclose(a, b, atol=1e-6)


def test_one_or_two_threads(scene):
    initial = random_exit(scene[0].num_points, 1, 1, 3)
    threads = torch.get_num_threads()
    made = []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            made.append(bounce(scene, initial, grey(0.8)).gathered)
    finally:
        torch.set_num_threads(threads)
    assert torch.allclose(made[0], made[1], atol=1e-6)
    assert torch.allclose(made[0], made[2], atol=1e-6)


def test_hits_that_are_not_kept_are_found_again(scene, monkeypatch):
    initial = random_exit(scene[0].num_points, 1, 1, 3)
    kept = bounce(scene, initial, grey(0.8))
    monkeypatch.setattr("prt_torch.baking.hits._KEPT_BYTES", 0)
    again = bounce(scene, initial, grey(0.8))
    assert torch.equal(kept.gathered, again.gathered)
    assert again.rays == 3 * kept.rays


def test_cache_is_used_and_resumes_within_a_bounce(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("prt_torch.baking.interreflection._POINTS_PER_SHARD", 50)
    initial = random_exit(scene[0].num_points, 1, 1, 3)
    plain = bounce(scene, initial, grey(0.8))
    shards = -(-scene[0].num_points // 50)
    told = []

    def stop_in_the_second_bounce(done: int, of: int) -> None:
        told.append(done)
        if len(told) == shards + 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        bounce(scene, initial, grey(0.8), cache=tmp_path, progress=stop_in_the_second_bounce)
    resumed = bounce(scene, initial, grey(0.8), cache=tmp_path)
    assert torch.equal(resumed.gathered, plain.gathered)
    assert not resumed.cached
    again = bounce(scene, initial, grey(0.8), cache=tmp_path)
    assert again.cached
    assert again.added == plain.added
    assert torch.equal(again.gathered, plain.gathered)
    for changed in (
        bounce(scene, initial, grey(0.7), cache=tmp_path),
        bounce(scene, initial + 1, grey(0.8), cache=tmp_path),
        bounce(scene, initial, grey(0.8), cache=tmp_path, resolution=4),
    ):
        assert not changed.cached
        assert not torch.equal(changed.gathered, plain.gathered)


def test_named_inputs_stand_for_exit_radiance_in_the_cache(scene, tmp_path):
    initial = random_exit(scene[0].num_points, 1, 1, 2)
    first = bounce(scene, initial, grey(0.8), cache=tmp_path, inputs={"transfer": "a"})
    assert bounce(scene, initial, grey(0.8), cache=tmp_path, inputs={"transfer": "a"}).cached
    other = bounce(scene, initial, grey(0.8), cache=tmp_path, inputs={"transfer": "b"})
    assert not other.cached
    assert torch.equal(first.gathered, other.gathered)


def test_black_scenes_and_no_bounces(scene):
    initial = random_exit(scene[0].num_points, 1, 1, 2)
    none = bounce(scene, initial, grey(0.8), max_bounces=0)
    assert none.added == []
    assert float(none.gathered.abs().max()) == 0.0
    assert not none.skipped
    black = bounce(scene, initial, grey(0.0), tolerance=1e-3)
    assert black.added == [0.0]
    assert float(black.gathered.max()) > 0  # before reflectance
    dark = bounce(scene, torch.zeros_like(initial), grey(0.8), tolerance=1e-3)
    assert dark.added == [0.0]
    assert torch.equal(dark.gathered, torch.zeros_like(initial))


def test_a_point_without_a_normal_neither_sends_nor_receives():
    bowl = inward_sphere(2, half=True)
    alone = mesh_of(np.concatenate([[[0.0, 0.0, 0.0]], bowl.vertices]), bowl.faces + 1)
    assert float(alone.normals[0].norm()) == 0.0
    light = torch.ones(alone.num_points, 1, 1, 1)
    done = bounce((alone, trace_visibility(alone, **RAYS)), light, grey(0.5))
    assert float(done.gathered[0].abs().max()) == 0.0
    assert bool(torch.isfinite(done.gathered).all())
    assert float(done.gathered[1:].min()) > 0.1


def test_what_does_not_fit_is_refused(scene):
    points = scene[0].num_points
    fitting = random_exit(points, 1, 1, 2)
    for wrong, match in (
        ({"exit_radiance": fitting[1:]}, f"exit radiance of {points} points"),
        ({"exit_radiance": random_exit(points, 1, 2, 2)}, "exit radiance of 1 rows"),
        ({"reflectance": torch.ones(2, 3)}, f"reflectance of 1 or {points} points"),
        ({"reflection": diffuse_reflection(3)}, f"reflection of {points} points"),
        ({"max_bounces": -1}, "at least 0 bounces"),
    ):
        arguments = {"exit_radiance": fitting, "reflectance": grey(0.5), **wrong}
        with pytest.raises(ValueError, match=match):
            bounce(scene, **arguments)
