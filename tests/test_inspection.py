"""What a scene needs, and that leaving out the rest changes nothing beyond the stated error."""

import math
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import ConvexHull

from prt_torch.assets import concatenate, ground_plane, load_mesh, mesh_from_arrays
from prt_torch.assets.brdf import Lambert, Phong, Sum
from prt_torch.assets.mesh import Mesh
from prt_torch.baking import bake, diffuse_reflection, interreflect, project_diffuse
from prt_torch.baking.inspection import (
    Finding,
    Occlusion,
    bounce_finding,
    colour_finding,
    factor_finding,
    inspect_occlusion,
    visibility_finding,
)
from prt_torch.baking.visibility import Tracer, proven_free, trace_visibility
from prt_torch.bases import BRDFFactors, CubeDirections, Haar, SphericalHarmonics
from prt_torch.inspection import inspect, leave_out
from prt_torch.transfer import TransferTensor
from prt_torch.truncation import band_losses, fewer_bands, one_channel, shared_colour

RAYS: dict[str, Any] = {"resolution": 8, "supersampling": 2}
SIZES = [1e-12, 1.0, 1e10]


def mesh_of(vertices, faces, normals=None) -> Mesh:
    return mesh_from_arrays(
        "test",
        torch.tensor(np.asarray(vertices, np.float64)),
        torch.tensor(np.asarray(faces, np.int64)),
        normals=None if normals is None else torch.tensor(np.asarray(normals, np.float64)),
    )


def ball(subdivisions=2, radius=1.0, at=(0.0, 0.0, 0.0)) -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return mesh_of(sphere.vertices + np.asarray(at), sphere.faces)


def dented() -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=3)
    vertices = np.array(sphere.vertices)
    vertices[vertices[:, 1].argmax()] *= 0.98
    return mesh_of(vertices, sphere.faces)


def two_balls() -> Mesh:
    return concatenate([ball(2), ball(2, at=(3.0, 0.0, 0.0))], "two")


def on_ground() -> Mesh:
    sphere = ball(2)
    return concatenate([sphere, ground_plane(sphere, resolution=8)], "on ground")


def bowl(subdivisions=2) -> Mesh:
    """The inside of a half sphere: every point sees half the sky, cosine weighted."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    below = (sphere.vertices[sphere.faces][..., 1] <= 1e-9).all(axis=1)
    return mesh_of(sphere.vertices, sphere.faces[below][:, ::-1].copy(), normals=-sphere.vertices)


def same_bits(mesh: Mesh) -> None:
    default = trace_visibility(mesh, **RAYS)
    forced = trace_visibility(mesh, trace_all=True, **RAYS)
    assert torch.equal(default.bits[0 : mesh.num_points], forced.bits[0 : mesh.num_points])


def test_a_convex_sphere_costs_no_ray_no_bits_no_bounces_one_channel(tmp_path):
    mesh = ball()
    field = trace_visibility(mesh, cache=tmp_path, **RAYS)
    assert field.rays == 0
    assert field.hides_nothing
    assert field.free_points == mesh.num_points
    assert list(tmp_path.iterdir()) == []
    occlusion = inspect_occlusion(mesh)
    assert (occlusion.rays, occlusion.decided_by) == (0, "proof")
    assert (occlusion.hidden, occlusion.hidden_at_most) == (0.0, 0.0)
    transfer = bake(mesh, max_bounces=3, **RAYS)
    made = transfer.provenance
    assert made["rays"] == 0
    assert made["bounces"]["skipped"]
    assert made["bounces"]["rays"] == 0
    assert (transfer.num_channels, transfer.num_rows) == (1, 1)


@pytest.mark.parametrize("basis", [SphericalHarmonics(4), CubeDirections(4)])
def test_forced_on_is_the_same_transfer_to_the_bit(basis):
    mesh = ball()
    forced = trace_visibility(mesh, trace_all=True, **RAYS)
    assert forced.rays > 0
    assert not forced.hides_nothing
    default = bake(mesh, light_basis=basis, **RAYS)
    assert torch.equal(default.dense(), project_diffuse(mesh, forced, basis).dense())


def test_bounces_of_traced_and_of_proven_bits_are_both_skipped():
    mesh = ball(2)
    light = torch.rand(mesh.num_points, 1, 1, 4, generator=torch.Generator().manual_seed(0))
    for trace_all in (False, True):
        field = trace_visibility(mesh, trace_all=trace_all, **RAYS)
        reflection = diffuse_reflection(mesh.num_points)
        done = interreflect(mesh, field, reflection, light, torch.ones(1, 3), max_bounces=2)
        assert done.skipped


@pytest.mark.parametrize("scene", [dented, two_balls, on_ground, bowl])
def test_what_is_not_convex_is_not_taken_for_it(scene):
    mesh = scene()
    field = trace_visibility(mesh, **RAYS)
    assert not field.hides_nothing
    assert field.rays > 0
    assert inspect_occlusion(mesh).hits > 0
    same_bits(mesh)


def test_of_two_balls_the_halves_that_face_away_are_free():
    """The other ball is the same one moved, so it rises above a tangent plane if it lies ahead."""
    mesh = two_balls()
    first = torch.arange(mesh.num_points) < mesh.num_points // 2
    ahead = torch.where(first, mesh.normals[:, 0], -mesh.normals[:, 0])
    assert torch.equal(proven_free(mesh), ahead < 1e-9)


def test_all_but_a_vertex_that_was_pushed_in_are_free():
    mesh = dented()
    pushed = (mesh.vertices.norm(dim=1) < 0.99).nonzero()
    assert torch.equal((~proven_free(mesh)).nonzero(), pushed)


def test_proof_against_support_by_the_hull():
    """A bumpy ball: free where no vertex of its convex hull lies above the tangent plane."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    bumps = 1 + 0.02 * np.random.default_rng(0).standard_normal(len(sphere.vertices))
    mesh = mesh_of(sphere.vertices * bumps[:, None], sphere.faces)
    vertices, normals = mesh.vertices.numpy(), mesh.normals.numpy()
    hull = vertices[ConvexHull(vertices).vertices]
    above = (hull @ normals.T).max(0) - (vertices * normals).sum(1)
    expected = above <= 1e-9
    assert 20 < expected.sum() < len(expected) / 2
    assert np.array_equal(proven_free(mesh).numpy(), expected)
    same_bits(mesh)


def half_ball() -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=3)
    upper = (sphere.vertices[sphere.faces][..., 1] >= -1e-9).all(axis=1)
    return mesh_of(sphere.vertices, sphere.faces[upper])


def cube() -> Mesh:
    """Its vertices are shared by faces at right angles, and most lie inside flat sides."""
    box = trimesh.creation.box().subdivide().subdivide()
    return mesh_of(box.vertices, box.faces)


def flat() -> Mesh:
    return ground_plane(ball(1), resolution=6)


def needle() -> Mesh:
    return mesh_of([[0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0]], [[0, 1, 2]])


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("shape", [half_ball, cube, flat, needle, ball])
def test_convex_shapes_of_any_size_open_or_flat(shape, size):
    mesh = shape()
    scaled = mesh_of(mesh.vertices.numpy() * size, mesh.faces.numpy())
    assert trace_visibility(scaled, **RAYS).hides_nothing
    same_bits(scaled)


@pytest.mark.parametrize("size", SIZES)
def test_the_proof_does_not_depend_on_size(size):
    mesh = dented()
    scaled = mesh_of(mesh.vertices.numpy() * size, mesh.faces.numpy())
    assert torch.equal(proven_free(scaled), proven_free(mesh))
    assert bool((~proven_free(scaled)).any())


def test_duplicates_and_faces_without_area_change_nothing():
    mesh = ball(2)
    vertices = np.concatenate([mesh.vertices.numpy(), mesh.vertices[:1].numpy()])
    faces = mesh.faces.numpy()
    moved_to_copy = np.where(faces[:3] == 0, len(vertices) - 1, faces[:3])
    extra = [[5, 5, 9], [7, 7, 7], *faces[:4].tolist(), *moved_to_copy.tolist()]
    crowded = mesh_of(vertices, np.concatenate([faces, np.asarray(extra)]))
    assert trace_visibility(crowded, **RAYS).hides_nothing
    same_bits(crowded)


@pytest.mark.parametrize("at", [[0.1, 0.2, 0.0], [1e7, -1e7, 3e6]])
def test_vertices_without_a_face_neither_hide_nor_shrink_the_scene(at):
    for mesh in (ball(2), two_balls()):
        vertices = np.concatenate([mesh.vertices.numpy(), [at]])
        more = mesh_of(vertices, mesh.faces.numpy())
        plain, field = trace_visibility(mesh, **RAYS), trace_visibility(more, **RAYS)
        count = mesh.num_points
        assert torch.equal(field.bits[0:count], plain.bits[0:count])
        assert not bool(field.bits[count : count + 1].any())
        assert field.free_points == plain.free_points
        assert field.hides_nothing == plain.hides_nothing


def test_normals_of_a_file_may_look_into_the_object():
    mesh = ball(2)
    tilted = mesh.normals.clone()
    tilted[0] = torch.nn.functional.normalize(torch.linalg.cross(tilted[0], tilted[7]), dim=0)
    other = mesh_of(mesh.vertices, mesh.faces, normals=tilted)
    assert proven_free(other).tolist() == [False] + [True] * (mesh.num_points - 1)
    same_bits(other)


def test_caches_of_both_kinds_are_shared(tmp_path):
    mesh = two_balls()
    default = trace_visibility(mesh, cache=tmp_path, **RAYS)
    forced = trace_visibility(mesh, cache=tmp_path, trace_all=True, **RAYS)
    assert not default.cached
    assert forced.cached
    fresh = trace_visibility(mesh, trace_all=True, **RAYS)
    assert fresh.rays > default.rays
    assert torch.equal(forced.bits[0 : mesh.num_points], fresh.bits[0 : mesh.num_points])


def test_free_points_of_a_real_mesh_are_free_in_traced_bits(assets):
    mesh = load_mesh(assets / "meshes" / "suzanne.obj")
    free = (proven_free(mesh) & (mesh.normals != 0).any(1)).nonzero()[:, 0].tolist()
    assert len(free) == 28
    tracer = Tracer(mesh, 128)
    for point in free:
        bits, rays = tracer.trace(range(point, point + 1))
        assert rays > 40000
        assert np.array_equal(bits[0], tracer.horizon.of_point(point))


def test_test_rays_find_the_hidden_share_of_a_bowl():
    occlusion = inspect_occlusion(bowl(4))
    assert occlusion.free == 0
    assert occlusion.decided_by == "sample"
    # Four standard deviations of independent rays, and what facets leave of the sphere.
    assert occlusion.hidden == pytest.approx(0.5, abs=4 * 0.5 / math.sqrt(4096) + 5e-3)
    assert occlusion.hidden < occlusion.hidden_at_most < occlusion.hidden + 0.02
    assert occlusion == inspect_occlusion(bowl(4))
    assert occlusion.hits != inspect_occlusion(bowl(4), seed=1).hits


def test_inside_a_closed_sphere_all_is_hidden():
    mesh = ball(2)
    inside = mesh_of(mesh.vertices, mesh.faces.flip(1))
    occlusion = inspect_occlusion(inside, rays=512)
    assert occlusion.hits == occlusion.rays
    assert occlusion.hidden_at_most == 1.0
    with pytest.raises(ValueError, match="expected a reflectance below 1"):
        occlusion.bounces(1.0)


def test_rays_that_all_miss_prove_nothing():
    """The chance that n rays miss a hidden share h is (1 - h)^n: 5 % at the limit."""
    occlusion = Occlusion(points=100, free=0, rays=200, hits=0)
    assert occlusion.decided_by == "sample"
    assert (1 - occlusion.hidden_at_most) ** 200 == pytest.approx(0.05, rel=1e-9)
    half_free = Occlusion(points=100, free=50, rays=200, hits=0)
    assert half_free.hidden_at_most == pytest.approx(occlusion.hidden_at_most / 2)


@pytest.mark.parametrize("error", [1e-1, 1e-3, 1e-6])
def test_bounces_are_the_fewest_of_a_geometric_series(error):
    occlusion = Occlusion(points=1, free=0, rays=1000, hits=500)
    needed = occlusion.bounces(0.8, error)
    series = 0.4 ** torch.arange(200, dtype=torch.float64)
    missing = [float(series[k + 1 :].sum() / series.sum()) ** 2 for k in range(60)]
    assert needed == next(k for k, lost in enumerate(missing) if lost <= error)
    assert occlusion.bounces(0.0, error) == 0


def test_findings_are_entries_of_a_report():
    for mesh, unit in ((ball(2), "saved_bytes"), (two_balls(), "saved_seconds")):
        occlusion, field = inspect_occlusion(mesh), trace_visibility(mesh, **RAYS)
        found = visibility_finding(occlusion, field)
        assert found.left_out
        assert found.decided_by == "proof"
        assert set(found.entry()) == {"what", "why", unit}
        assert found.entry()[unit] > 0
        assert not visibility_finding(occlusion, field, traced_all=True).left_out
    whole = visibility_finding(inspect_occlusion(ball(2)), field)
    assert whole.saved_bytes == 162 * 192
    assert whole.entry()["what"] == "162 of 162 points to be traced"
    none = bounce_finding(inspect_occlusion(ball(2)), 0.8, 6)
    assert (none.needed, none.left_out, none.decided_by) == (0, True, "proof")
    some = bounce_finding(inspect_occlusion(bowl(4)), 0.8, 6)
    assert (some.needed, some.left_out, some.decided_by) == (3, False, "sample")
    assert bounce_finding(inspect_occlusion(bowl(4)), 0.8, 2).needed is None


def test_colours_of_a_material_that_are_proportional():
    red = (0.8, 0.2, 0.1)
    alone = colour_finding(Lambert(red))
    assert alone.needed == 1
    assert alone.error < 1e-12
    assert colour_finding(Lambert(0.5)).error == 0.0
    mixed = colour_finding(Sum((Lambert(red), Phong(0.5, 20.0))))
    assert mixed.needed == 3
    assert 1e-3 < mixed.error < 0.5


def test_factors_by_their_own_account():
    """As many as a search that factors anew for each number of them."""
    material = Phong(0.5, 8.0)
    many = BRDFFactors.from_brdf(material, num_terms=12, resolution=8)
    for count in (3, 5, 8):
        few = BRDFFactors.from_brdf(material, num_terms=count, resolution=8)
        error = (few.rms or 0.0) ** 2
        found = factor_finding(many, error=1.05 * error)
        assert found.needed == count
        assert found.error == pytest.approx(error, rel=0.05)
    none = factor_finding(many, error=1e-12)
    assert none.needed is None
    assert none.error == pytest.approx((many.rms or 0.0) ** 2)
    with pytest.raises(ValueError, match="expected factors that know their error"):
        factor_finding(BRDFFactors(many.view_values, many.light_values, many.hemisphere))


def coloured(noise: float = 0.0) -> TransferTensor:
    """Three channels of one function, and of others where there is noise."""
    generator = torch.Generator().manual_seed(0)
    one = torch.randn(40, 1, 1, 16, generator=generator)
    colours = torch.rand(40, 3, 1, 1, generator=generator)
    values = one * colours + noise * torch.randn(40, 3, 1, 16, generator=generator)
    return TransferTensor.from_dense(values, light_basis=SphericalHarmonics(4))


@pytest.mark.parametrize("noise", [0.0, 0.02, 1.0])
def test_one_channel_loses_what_it_says(noise):
    transfer = coloured(noise)
    shared = shared_colour(transfer)
    fewer = one_channel(transfer, shared)
    back = fewer.dense() * fewer.surface.reflectance[:, :, None, None]
    squared = (transfer.dense() - back).square().sum() / transfer.dense().square().sum()
    assert shared.lost == pytest.approx(float(squared), rel=1e-3, abs=1e-6)
    assert float(fewer.squared_norm().sum()) == pytest.approx(
        float(transfer.squared_norm().sum()) * (1 - shared.lost), rel=1e-5
    )
    assert bool((shared.colours >= 0).all())


def test_points_without_transfer_have_no_colour():
    transfer = TransferTensor.from_dense(torch.zeros(5, 3, 1, 16))
    shared = shared_colour(transfer)
    assert shared.lost == 0.0
    assert not bool(shared.colours.any())
    assert not bool(one_channel(transfer, shared).dense().any())


def test_energy_of_an_unoccluded_lobe_by_band():
    """pi, 2pi/3, pi/4, 0, -pi/24, 0, pi/64 squared, times (2l + 1) / 4pi."""
    transfer = bake(ball(2), light_basis=SphericalHarmonics(7), resolution=32, supersampling=2)
    lobe = torch.tensor([1, 2 / 3, 1 / 4, 0, -1 / 24, 0, 1 / 64], dtype=torch.float64)
    energy = lobe.square() * (2 * torch.arange(7) + 1)
    expected = 1 - torch.cat([torch.zeros(1), energy.cumsum(0)]) / energy.sum()
    assert torch.allclose(band_losses(transfer), expected, atol=2e-5)


def test_fewer_bands_are_the_first_ones():
    transfer = coloured(0.5)
    fewer = fewer_bands(transfer, 3)
    assert torch.equal(fewer.dense(), transfer.dense()[..., :9])
    assert torch.equal(fewer.values[3:7], transfer.values[3:7][..., :9])
    rest = transfer.dense()[..., 9:].square().sum() / transfer.dense().square().sum()
    assert float(band_losses(transfer)[3]) == pytest.approx(float(rest), rel=1e-5)
    for order in (0, 5):
        with pytest.raises(ValueError, match=r"expected an order in 1\.\.4"):
            fewer_bands(transfer, order)
    with pytest.raises(ValueError, match="expected transfer in spherical harmonics"):
        band_losses(TransferTensor.from_dense(torch.ones(3, 4)))


def smooth() -> TransferTensor:
    """Nearly proportional colours, and nearly nothing in the last two bands."""
    values = coloured(0.005).dense().clone()
    values[..., 4:] *= 0.01
    return TransferTensor.from_dense(values, light_basis=SphericalHarmonics(4))


def test_leaving_out_keeps_the_error_in_all_and_forcing_keeps_the_transfer():
    transfer = smooth()
    fewer, findings = leave_out(transfer)
    assert (fewer.num_channels, fewer.num_coeffs) == (1, 4)
    assert [found.left_out for found in findings] == [True, True]
    back = torch.zeros_like(transfer.dense())
    back[..., :4] = fewer.dense() * fewer.surface.reflectance[:, :, None, None]
    squared = (transfer.dense() - back).square().sum() / transfer.dense().square().sum()
    assert 0 < float(squared) <= 1e-3
    assert float(squared) == pytest.approx(sum(found.error for found in findings), rel=1e-2)
    saved = sum(found.entry()["saved_bytes"] for found in findings)
    assert saved == transfer.num_bytes - fewer.num_bytes
    kept, forced = leave_out(transfer, force=("bands", "channels"))
    assert kept is transfer
    assert [found.left_out for found in forced] == [False, False]
    exact, nothing = leave_out(transfer, error=0.0)
    assert exact is transfer
    assert not any(found.left_out for found in nothing)


@pytest.mark.usefixtures("without_type_checker")
def test_what_leave_out_refuses():
    with pytest.raises(ValueError, match="expected some of"):
        leave_out(smooth(), force=("colour",))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="expected an error of at least 0"):
        leave_out(smooth(), error=-1.0)


def named(findings: list[Finding]) -> dict[str, Finding]:
    return {found.what: found for found in findings}


def test_vectors_are_counted_by_points_held_back():
    generator = torch.Generator().manual_seed(0)
    weights, vectors = torch.randn(60, 3, generator=generator), torch.randn(3, 50)
    exact = TransferTensor.from_dense(torch.randn(50, generator=generator) + weights @ vectors)
    assert named(inspect(exact))["vectors for all points"].needed == 3
    # Thirty random points span thirty dimensions of others by chance only.
    noise = TransferTensor.from_dense(torch.randn(60, 500, generator=generator))
    assert named(inspect(noise))["vectors for all points"].needed is None


def test_a_convex_sphere_needs_little_of_light_and_one_lobe():
    transfer = bake(ball(2), light_basis=SphericalHarmonics(6), **RAYS)
    light = torch.zeros(2, 36, 3)
    light[:, :4] = torch.rand(2, 4, 3, generator=torch.Generator().manual_seed(0))
    found = named(inspect(transfer, lights=light))
    assert found["zonal lobes"].needed == 1
    assert found["bands of light under the lights given"].needed == 2
    # Bands 0, 1, 2 and 4 hold all, and the last of them 0.6 %.
    assert found["bands of light"].needed == 5
    assert found["bands of light"].saved_bytes == (transfer.num_bytes * 11) // 36


def test_wavelets_and_segments_of_constant_light():
    basis = Haar(8, 4)
    values = torch.zeros(10, basis.num_coeffs)
    values[:, 0] = 1.0  # means of two segments, and nothing of 22 others
    values[:, 16] = 2.0
    found = named(inspect(TransferTensor.from_dense(values, light_basis=basis)))
    assert found["wavelet terms of a row"].needed == 2
    pairs = found["pairs of a point and a segment of the light"]
    assert (pairs.needed, pairs.available) == (20, 240)
    assert "22 of 24" in pairs.why


def test_rows_that_depend_on_each_other():
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(20, 2, 9, generator=generator)
    mixed = torch.randn(5, 2, generator=generator) @ values
    assert named(inspect(TransferTensor.from_dense(mixed)))["combinations of exit rows"].needed == 2


def test_transfer_that_is_all_black_needs_nothing():
    black = TransferTensor.from_dense(torch.zeros(8, 36), light_basis=SphericalHarmonics(6))
    for found in inspect(black, lights=torch.zeros(1, 36, 3)):
        assert found.needed in (0, 1)
        assert found.error == 0.0
    fewer, _ = leave_out(black)
    assert fewer.num_coeffs == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"error": 0.0}, "expected an error in"),
        ({"points": 1}, "expected at least 2 points"),
        ({"lights": torch.zeros(1, 9, 3)}, "expected lights"),
    ],
)
def test_what_inspect_refuses(options, message):
    with pytest.raises(ValueError, match=message):
        inspect(coloured(), **options)


def test_at_least_one_ray():
    with pytest.raises(ValueError, match="expected at least 1 ray"):
        inspect_occlusion(ball(1), rays=0)
