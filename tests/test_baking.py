"""Visibility and diffuse transfer against closed forms."""

import math

import numpy as np
import pytest
import torch
import trimesh

from prt_torch.assets import concatenate, mesh_from_arrays
from prt_torch.assets.mesh import Mesh
from prt_torch.baking import bake, project_diffuse, trace_visibility
from prt_torch.bases import CubeDirections, SphericalHarmonics, sh
from prt_torch.errors import InputError
from prt_torch.evaluate import dense_radiance

UNIT_SKY = math.sqrt(4 * math.pi)  # coefficient of y_00 of radiance 1


def mesh_of(vertices, faces, normals=None) -> Mesh:
    return mesh_from_arrays(
        "test",
        torch.tensor(np.asarray(vertices, np.float64)),
        torch.tensor(np.asarray(faces, np.int64)),
        normals=None if normals is None else torch.tensor(np.asarray(normals, np.float64)),
    )


def quad(corners) -> tuple[list, list]:
    return list(corners), [[0, 1, 2], [0, 2, 3]]


def sky_share(mesh: Mesh, points, **options) -> torch.Tensor:
    """Cosine-weighted share of the sky that points see: radiance of a white surface."""
    transfer = bake(mesh, light_basis=SphericalHarmonics(2), **options)
    light = torch.zeros(1, 4, 3)
    light[0, 0] = UNIT_SKY
    return dense_radiance(transfer, light)[0, 0, points, 0] / 0.8  # the default albedo


def ring_point(vertices: list, faces: list, at, normal_towards) -> int:
    """Add a tiny triangle with its first vertex at ``at``; returns that vertex."""
    first = len(vertices)
    normal = np.asarray(normal_towards, float)
    side = np.cross(normal, [0.3, 0.5, 0.8])
    other = np.cross(normal, side)
    at = np.asarray(at, float)
    vertices += [at, at + 1e-6 * side, at + 1e-6 * other]
    faces.append([first, first + 1, first + 2])
    return first


def test_unoccluded_lobe_by_band():
    """pi, 2pi/3, pi/4, 0, -pi/24, 0, pi/64 over pi, turned to each normal."""
    vertices, faces = [], []
    tilts = [[0, 1, 0], [1, 0, 0], [0, 0, -1], [0.3, 0.5, -0.8], [0, -1, 0]]
    for index, tilt in enumerate(tilts):
        tilt = np.asarray(tilt, float) / np.linalg.norm(tilt)
        ring_point(vertices, faces, [10.0 * index, 0, 0], tilt)
    mesh = mesh_of(vertices, faces)
    transfer = bake(mesh, light_basis=SphericalHarmonics(7))
    values = transfer.dense()[::3, 0, 0]
    lobe = [1, 2 / 3, 1 / 4, 0, -1 / 24, 0, 1 / 64]
    functions = sh.evaluate(mesh.normals[::3], 7)
    band = torch.tensor([b for b in range(7) for _ in range(2 * b + 1)])
    expected = functions * torch.tensor(lobe, dtype=torch.float64)[band]
    assert float((values - expected).abs().max()) < 5e-4


@pytest.mark.parametrize("degrees", [30, 60, 90, 120])
def test_tilted_wall_on_an_infinite_plane(degrees):
    """(1 + cos beta) / 2 of the sky."""
    vertices, faces = quad([[-1e4, 0, 1e4], [1e4, 0, 1e4], [1e4, 0, -1e4], [-1e4, 0, -1e4]])
    beta = math.radians(degrees)
    at = ring_point(vertices, faces, [0, 1, 0], [math.sin(beta), math.cos(beta), 0])
    share = sky_share(mesh_of(vertices, faces), [at])
    assert float(share) == pytest.approx((1 + math.cos(beta)) / 2, abs=2e-3)


def test_sphere_touching_a_plane():
    """V(r) = 1 - (1 + (r/R)^2)^(-3/2) at distance r from where they touch."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    vertices, faces = (ball.vertices + [0, 1, 0]).tolist(), ball.faces.tolist()
    distances = [0.3, 0.7, 1.0, 2.0, 4.0]
    points = [ring_point(vertices, faces, [r, 0, 0], [0, 1, 0]) for r in distances]
    share = sky_share(mesh_of(vertices, faces), points)
    expected = [1 - (1 + r * r) ** -1.5 for r in distances]
    assert share.tolist() == pytest.approx(expected, abs=4e-3)


def test_hemispherical_bowl_sees_half_the_sky_everywhere():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    below = (ball.vertices[ball.faces][..., 1] <= 1e-9).all(axis=1)
    faces = ball.faces[below][:, ::-1].copy()  # facing inwards
    mesh = mesh_of(ball.vertices, faces, normals=-ball.vertices)
    deep = np.flatnonzero(ball.vertices[:, 1] < -0.2)[::50]
    assert sky_share(mesh, deep).tolist() == pytest.approx(
        [0.5] * len(deep), abs=8e-3
    )  # facets see .0066 more


def tiny_scene() -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.6)
    vertices, faces = quad([[-2, -0.7, 2], [2, -0.7, 2], [2, -0.7, -2], [-2, -0.7, -2]])
    return concatenate(
        [mesh_of(ball.vertices + [0.2, 0, 0.1], ball.faces), mesh_of(vertices, faces)], "tiny"
    )


def small(mesh: Mesh, **options):
    return bake(mesh, resolution=8, supersampling=2, **options)


def moved(mesh: Mesh, scale: float, offset) -> Mesh:
    vertices = mesh.vertices.numpy() * scale + np.asarray(offset, float)
    return mesh_of(vertices, mesh.faces.numpy(), normals=mesh.normals.numpy())


@pytest.mark.parametrize("exponent", [-20, -3, 5, 20])
def test_visibility_is_the_same_at_any_power_of_two_in_size(exponent):
    mesh = tiny_scene()
    plain = trace_visibility(mesh, resolution=8, supersampling=2)
    scaled = trace_visibility(moved(mesh, 2.0**exponent, [0, 0, 0]), resolution=8, supersampling=2)
    assert torch.equal(plain.bits[0:200], scaled.bits[0:200])


def test_far_from_the_origin():
    mesh = tiny_scene()
    far = moved(mesh, 1.0, [1e6, -3e6, 2e6])
    difference = small(mesh).dense() - small(far).dense()
    assert float(difference.square().mean().sqrt()) < 1e-4


def test_permuted_vertices_give_permuted_bits():
    mesh = tiny_scene()
    order = torch.randperm(mesh.num_points, generator=torch.Generator().manual_seed(0))
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order))
    shuffled = mesh_of(
        mesh.vertices[order].numpy(), place[mesh.faces].numpy(), normals=mesh.normals[order].numpy()
    )
    a = trace_visibility(mesh, resolution=8, supersampling=2)
    b = trace_visibility(shuffled, resolution=8, supersampling=2)
    assert torch.equal(a.bits[0 : mesh.num_points][order], b.bits[0 : mesh.num_points])
    assert torch.allclose(small(mesh).dense()[order], small(shuffled).dense(), atol=1e-6)


def test_one_or_two_threads_give_the_same_bits():
    mesh = tiny_scene()
    threads = torch.get_num_threads()
    bits, values = [], []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            field = trace_visibility(mesh, resolution=8, supersampling=2)
            bits.append(field.bits[0 : mesh.num_points])
            values.append(project_diffuse(mesh, field, SphericalHarmonics(4)).dense())
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(bits[0], bits[1])
    assert torch.equal(bits[0], bits[2])
    assert torch.allclose(values[0], values[1], atol=1e-6)


def test_turning_scene_and_light_together_changes_nothing():
    mesh = tiny_scene()
    angle = 0.7
    c, s = math.cos(angle), math.sin(angle)
    rotation = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    turned = mesh_of(
        mesh.vertices.numpy() @ rotation.T,
        mesh.faces.numpy(),
        normals=mesh.normals.numpy() @ rotation.T,
    )
    basis = SphericalHarmonics(4)
    light = torch.randn(1, 16, 3, generator=torch.Generator().manual_seed(0)).double()
    light_turned = basis.rotate(light, torch.from_numpy(rotation))
    options = {"light_basis": basis, "resolution": 32, "supersampling": 2}
    a = dense_radiance(bake(mesh, **options), light.float())
    b = dense_radiance(bake(turned, **options), light_turned.float())
    # The texel grid does not turn with the scene: shadow borders fall between other rays.
    assert float((a - b).square().mean().sqrt() / a.square().mean().sqrt()) < 1e-2


def test_an_occluder_never_brightens():
    mesh = tiny_scene()
    alone = mesh_of(mesh.vertices[:162].numpy(), mesh.faces[:320].numpy())
    basis = CubeDirections(8)
    with_ground = small(mesh, light_basis=basis).dense()[:162]
    without = small(alone, light_basis=basis).dense()[:162]
    assert float((with_ground - without).max()) <= 1e-7
    assert float((without - with_ground).max()) > 1e-4


def test_dropping_the_reference_norm_is_what_the_projection_loses():
    """Full norm - squared norm in the basis = squared distance, by a direct sum over texels."""
    mesh = tiny_scene()
    field = trace_visibility(mesh, resolution=8, supersampling=2)
    transfer = project_diffuse(mesh, field, CubeDirections(8))
    fine = project_diffuse(mesh, field, CubeDirections(16))
    assert torch.allclose(fine.reference_squared_norm, fine.squared_norm(), rtol=1e-5)
    blocks = fine.dense().view(-1, 6, 8, 2, 8, 2)
    area = CubeDirections(16).solid_angles.view(6, 8, 2, 8, 2).float()
    mean = transfer.dense().view(-1, 6, 8, 1, 8, 1) / area.sum((2, 4), keepdim=True)
    distance = ((blocks / area - mean).square() * area).sum((1, 2, 3, 4, 5))
    lost = transfer.reference_squared_norm - transfer.squared_norm()
    assert torch.allclose(lost.float(), distance, rtol=2e-3, atol=1e-6)


def test_points_without_a_normal_see_nothing():
    vertices, faces = quad([[0, 0, 1], [1, 0, 1], [1, 0, 0], [0, 0, 0]])
    mesh = mesh_of([*vertices, [5.0, 5.0, 5.0]], faces)
    transfer = small(mesh)
    assert float(transfer.dense()[4].abs().max()) == 0.0
    assert float(transfer.dense()[:4].abs().max()) > 0.1


def test_one_triangle_and_albedo():
    mesh = mesh_of([[0, 0, 0], [0, 0, 1], [1, 0, 0]], [[0, 1, 2]])
    light = torch.zeros(1, 36, 3)
    light[0, 0] = UNIT_SKY
    radiance = dense_radiance(bake(mesh), light)
    assert radiance.flatten().tolist() == pytest.approx([0.8] * 9, abs=1e-4)


def test_cache_gives_the_same_values_and_is_used(tmp_path):
    mesh = tiny_scene()
    memory = small(mesh)
    first = small(mesh, cache=tmp_path)
    again = small(mesh, cache=tmp_path)
    assert torch.equal(memory.dense(), first.dense())
    assert torch.equal(first.dense(), again.dense())
    assert again.provenance["visibility_cached"]
    assert again.provenance["projection_cached"]
    other = small(mesh, cache=tmp_path, light_basis=SphericalHarmonics(3))
    assert other.provenance["visibility_cached"]
    assert not other.provenance["projection_cached"]


def test_what_is_made_of_older_bits_is_not_used(tmp_path, monkeypatch):
    small(tiny_scene(), cache=tmp_path)
    monkeypatch.setattr("prt_torch.baking.visibility._ALGORITHM", -1)
    again = small(tiny_scene(), cache=tmp_path)
    assert not again.provenance["visibility_cached"]
    assert not again.provenance["projection_cached"]


def test_memory_budget_is_kept_or_refused():
    mesh = tiny_scene()
    tight = small(mesh, memory_budget=16 * 6 * 16 * 16 * 2 + 4 * 6 * 16 * 16 * 36)
    assert torch.allclose(tight.dense(), small(mesh).dense(), atol=1e-6)
    with pytest.raises(InputError, match="memory_budget"):
        small(mesh, memory_budget=1000)


def test_mesh_and_visibility_must_belong_together():
    mesh = tiny_scene()
    field = trace_visibility(mesh, resolution=4, supersampling=1)
    other = mesh_of([[0, 0, 0], [0, 0, 1], [1, 0, 0]], [[0, 1, 2]])
    with pytest.raises(ValueError, match="expected visibility of 3 points"):
        project_diffuse(other, field, SphericalHarmonics(2))
