"""Patches, baked as if they went on for ever; grooves in closed form; frames along textures."""

import math
from dataclasses import replace

import pytest
import torch
from contract import relative

from prt_torch.assets import mesh_from_arrays, procedural_scene
from prt_torch.assets.material import Material
from prt_torch.assets.medium import Medium
from prt_torch.assets.patches import (
    PATCH_FRAME,
    Patch,
    bumps,
    grid_patch,
    height_field,
    texel_centres,
    waffle,
    weave,
)
from prt_torch.assets.procedural import grid_surface, surface_of_revolution
from prt_torch.assets.tangents import frames_on_faces, tangent_frames
from prt_torch.baking import bake, bake_patch, groove_transfer
from prt_torch.baking.groove import groove_horizons, groove_profile
from prt_torch.bases import SphericalHarmonics, sh
from prt_torch.errors import InputError

COARSE = {"resolution": 16, "supersampling": 1, "light_basis": SphericalHarmonics(3)}


def texel_points(patch: Patch) -> torch.Tensor:
    return patch.mesh.vertices[patch.texels]


@pytest.mark.parametrize("patch", [bumps(8), weave(8), waffle(8), height_field(torch.zeros(3, 5))])
def test_texels_lie_under_their_centres_and_the_tile_covers_one_period(patch):
    rows, cols = patch.texels.shape
    uv, points = texel_centres(rows, cols), texel_points(patch)
    assert torch.allclose(points[..., 0], uv[..., 0])
    assert torch.allclose(points[..., 2], -uv[..., 1])
    assert patch.mesh.warnings == ()
    low, high = patch.mesh.bounds
    assert torch.allclose((high - low)[[0, 2]], torch.ones(2, dtype=torch.float64))
    assert float(patch.mesh.normals[patch.texels][..., 1].min()) > 0


def test_normals_do_not_know_the_border():
    """A periodic height shifted by texels is the same patch, normals included."""
    heights = 0.1 * torch.rand(6, 7, generator=torch.Generator().manual_seed(0))
    here, there = (height_field(h) for h in (heights, heights.roll((2, 3), (0, 1))))
    normals = here.mesh.normals[here.texels].roll((2, 3), (0, 1))
    assert torch.allclose(there.mesh.normals[there.texels], normals, atol=1e-12)
    # Points behind the border have those of the texels that they repeat.
    grid = there.mesh.normals.view(7, 8, 3)
    assert torch.allclose(grid[-1], grid[0], atol=1e-12)
    assert torch.allclose(grid[:, -1], grid[:, 0], atol=1e-12)


def test_a_periodic_bake_does_not_know_the_border():
    heights = 0.25 * torch.rand(6, 6, generator=torch.Generator().manual_seed(1))
    here = bake_patch(height_field(heights), **COARSE).dense()
    there = bake_patch(height_field(heights.roll((2, 3), (0, 1))), **COARSE).dense()
    rolled = here.unflatten(0, (6, 6)).roll((2, 3), (0, 1)).flatten(0, 1)
    assert relative(there, rolled) < 0.01
    alone = bake_patch(height_field(heights), copies=0, **COARSE).dense()
    assert relative(alone, here) > 0.05


def test_one_ring_of_copies_is_enough_for_low_relief():
    patch = bumps(8)
    one, three = (bake_patch(patch, copies=copies, **COARSE).dense() for copies in (1, 3))
    assert relative(one, three) < 3e-3


def test_a_flat_patch_sees_the_whole_sky():
    patch = height_field(torch.zeros(3, 4))
    transfer = bake_patch(patch, **COARSE)
    flat = bake(patch.mesh, **COARSE).dense()[patch.texels.flatten()]
    assert torch.equal(transfer.dense(), flat)
    assert transfer.num_points == 12


def test_direct_light_is_that_of_a_bake_of_all_copies():
    """Copies that only occlude cost nothing and change nothing."""
    patch = bumps(6)
    direct = bake_patch(patch, **COARSE)
    bounced = bake_patch(patch, max_bounces=1, **COARSE)
    assert float(bounced.dense()[..., 0].min()) > 0
    assert bool((bounced.dense()[..., 0] >= direct.dense()[..., 0] - 1e-6).all())
    assert relative(bounced.dense(), direct.dense()) > 0.01
    black = replace(patch.mesh, albedo=torch.zeros_like(patch.mesh.albedo))
    again = bake_patch(Patch(black, patch.texels), max_bounces=1, **COARSE)
    assert torch.equal(again.dense(), direct.dense())


def test_a_waffle_is_lit_through_its_bottom():
    """Under light from below, the thin bottom is brighter than the walls; a thick one is dark."""
    material = Material(
        lambertian=False,
        medium=Medium((1.0, 1.0, 1.0), (0.1, 0.1, 0.1)),
        millimetres_per_unit=10.0,
    )
    below = -sh.evaluate(torch.tensor([0.0, 1.0, 0.0]), 2)
    below[0] = -below[0]

    def lit(patch: Patch) -> torch.Tensor:
        options = {**COARSE, "light_basis": SphericalHarmonics(2)}
        return bake_patch(patch, materials=material, **options).dense()[:, 0, 0] @ below

    thin, thick = waffle(8, count=1), waffle(8, count=1, thickness=0.4)
    heights = texel_points(thin)[..., 1].flatten()
    radiance = lit(thin)
    assert float(radiance[heights == 0].mean()) > 1.5 * float(radiance[heights > 0.1].mean())
    assert float(radiance[heights == 0].mean()) > 3 * float(lit(thick)[heights == 0].mean())


def test_a_patch_may_lean_over():
    """Points are any function of u and v: a wave that leans hides its own foot from the sky."""
    uv = texel_centres(4, 16)
    phase = 2 * math.pi * uv[..., 0]
    upright = torch.stack([uv[..., 0], 0.15 * phase.sin(), -uv[..., 1]], dim=-1)
    leaning = upright.clone()
    leaning[..., 0] += 0.25 * phase.sin()
    patch = grid_patch("wave", leaning)
    assert float(patch.mesh.normals[:, 1].min()) < 0
    sky = [bake_patch(p, **COARSE).dense()[..., 0].min() for p in (patch, grid_patch("w", upright))]
    assert float(sky[0]) < 0.3 * float(sky[1])


def test_wrong_patches_are_refused():
    for make, message in (
        (lambda: bumps(8, count=3), "bumps.count=3: expected an even number"),
        (lambda: weave(8, count=0), "weave.count=0: expected an even number"),
        (lambda: waffle(8, wall=1.0), "wall in"),
        (lambda: height_field(torch.zeros(1, 4)), "at least 2 x 2 texels, got 1 x 4"),
        (lambda: height_field(torch.tensor([[0.0, math.nan], [0, 0]])), "not finite"),
    ):
        with pytest.raises(InputError, match=message):
            make()
    with pytest.raises(ValueError, match="at least 0 rings"):
        bake_patch(bumps(8), copies=-1)


def test_horizons_of_a_groove():
    """Level where nothing stands above; at the bottom, the slopes that meet the rims."""
    across = torch.tensor([-0.5, 0.0, 0.5, 2.0], dtype=torch.float64)
    depth = torch.tensor([0.6, 0.6, 0.0, 0.6], dtype=torch.float64)
    right, left = groove_horizons(across, depth).unbind(-1)
    x = torch.linspace(1e-3, 0.5, 100_001, dtype=torch.float64)
    steepest = ((groove_profile(x, torch.tensor(0.6))[0] + 0.6) / x).max().atan()
    assert torch.allclose(right[[0, 2, 3]], torch.zeros(3, dtype=torch.float64), atol=1e-9)
    assert float(right[1]) == pytest.approx(float(steepest), abs=1e-5)
    assert float(right[1] + left[1]) == pytest.approx(math.pi, abs=1e-12)


def test_a_groove_in_closed_form_is_a_bake_of_it():
    across = torch.cat(
        [torch.tensor([-3.0, -1.0]).double(), torch.linspace(-0.5, 0.5, 49, dtype=torch.float64)]
    )
    across = torch.cat([across, -across[:2].flip(0)])
    along = torch.tensor([-60.0, -8, -1, 0, 1, 8, 60]).double()
    z, x = torch.meshgrid(along, across, indexing="ij")
    mesh = grid_surface(
        "groove", torch.stack([x, groove_profile(x, torch.tensor(0.6))[0], z], dim=-1)
    )
    # Only the middle line is looked at; the others are there to occlude.
    middle = torch.arange(7 * 53).view(7, 53)[3]
    seen = torch.zeros(7 * 53, dtype=torch.bool).index_fill(0, middle, True)
    mesh = replace(mesh, normals=mesh.normals * seen[:, None])
    baked = bake(mesh, supersampling=2).dense()[middle, 0, 0].double()
    local = baked @ sh.rotation_matrix(PATCH_FRAME, 6).mT
    closed = groove_transfer(across, torch.full_like(across, 0.6), 6)
    inside = slice(6, -6)  # normals of the mesh are averages where the slope bends at the rim
    assert relative(local[inside], closed[inside]) < 0.01
    assert relative(local[:2], closed[:2]) < 1e-3
    # Mirrored across, what is odd in x changes its sign.
    sign = torch.ones(36, dtype=torch.float64)
    for band in range(6):
        for m in range(-band, band + 1):
            mirrored = m != 0 and (m % 2 == 0) == (m < 0)
            sign[band * (band + 1) + m] = -1.0 if mirrored else 1.0
    assert torch.allclose(closed.flip(0) * sign, closed, atol=1e-9)


def test_frames_of_a_cylinder_and_of_its_mirror_image():
    height = torch.linspace(3.0, 1.0, 9, dtype=torch.float64)
    profile = torch.stack([torch.ones_like(height), height], dim=-1)
    cylinder = surface_of_revolution("cylinder", profile, 48)
    x, _, z = cylinder.vertices.unbind(-1)
    none = torch.zeros_like(x)
    exact = torch.stack(
        [
            torch.stack([z, none, -x], -1),
            torch.stack([none, none + 1, none], -1),
            torch.stack([x, none, z], -1),
        ],
        dim=1,
    )
    inner = slice(48, -48)  # rings whose points have faces on both sides
    assert torch.allclose(tangent_frames(cylinder)[inner], exact[inner], atol=1e-12)
    assert cylinder.uv is not None
    mirrored = replace(cylinder, uv=cylinder.uv * torch.tensor([-1.0, 1.0]).double())
    flipped = exact * torch.tensor([-1.0, 1.0, 1.0]).double()[:, None]
    assert torch.allclose(tangent_frames(mirrored)[inner], flipped[inner], atol=1e-12)
    poses = torch.stack([cylinder.vertices, cylinder.vertices @ PATCH_FRAME])
    both = tangent_frames(cylinder, poses)
    posed = torch.stack([exact, exact @ PATCH_FRAME])
    assert torch.allclose(both[:, inner], posed[:, inner], atol=1e-12)
    faces, weights = torch.arange(200, 220), torch.full((20, 3), 1 / 3, dtype=torch.float64)
    uv, frames = frames_on_faces(mirrored, both, faces, weights)
    assert torch.allclose(uv, mirrored.uv[200:220].mean(1))  # pyright: ignore[reportOptionalSubscript]
    assert torch.allclose(frames @ frames.mT, torch.eye(3).double().expand(2, 20, 3, 3), atol=1e-12)
    middles = cylinder.vertices[cylinder.faces[200:220]].mean(1) * torch.tensor([1.0, 0.0, 1.0])
    middles = middles / middles.norm(dim=-1, keepdim=True)
    assert torch.allclose(frames[0, :, 2], middles, atol=1e-3)


def test_frames_have_gradients_even_where_there_is_no_tangent():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1], [5, 5, 5]]).double()
    faces = torch.tensor([[0, 1, 2], [1, 3, 2]])
    uv = torch.tensor([[[0.0, 0], [1, 0], [0, 1]], [[math.nan, math.nan]] * 3]).double()
    mesh = mesh_from_arrays("two", points, faces, uv=uv)
    frames = tangent_frames(mesh)
    assert torch.allclose(torch.linalg.det(frames), torch.ones(5).double())

    def skewed(moved):
        return tangent_frames(mesh, moved)[:3]

    start = points + 0.1 * torch.randn(5, 3, generator=torch.Generator().manual_seed(0)).double()
    assert torch.autograd.gradcheck(skewed, (start.requires_grad_(),))
    same = points.clone().requires_grad_()
    tangent_frames(mesh, same).square().sum().backward()
    assert same.grad is not None
    assert bool(torch.isfinite(same.grad).all())


def test_frames_need_texture_coordinates():
    knot = procedural_scene()
    with pytest.raises(InputError, match="torus_knot: has no texture coordinates"):
        tangent_frames(knot)
    vase = procedural_scene("vase")
    with pytest.raises(ValueError, match="expected positions"):
        tangent_frames(vase, vase.vertices[:5])
