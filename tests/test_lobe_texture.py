"""Textures of lobes: lookups, frames, files, membranes and wrinkles."""

import copy
import functools
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from contract import relative

from prt_torch.assets.patches import PATCH_FRAME, bumps, texel_centres
from prt_torch.assets.procedural import surface_of_revolution
from prt_torch.assets.tangents import tangent_frames
from prt_torch.baking import bake_patch, groove_transfer
from prt_torch.bases import HemisphericalHarmonics, SphericalHarmonics, sh, zonal
from prt_torch.errors import InputError
from prt_torch.relight import Relighter
from prt_torch.representations import (
    LobeTexture,
    TexelGrid,
    WrinkleMap,
    ZonalLobes,
    membrane_texture,
    thin_membrane,
    towards_viewer,
    wrinkle_texture,
)
from prt_torch.representations.lobe_map_fit import fit_map, interpolated_least_squares
from prt_torch.representations.lobe_texture import in_frame
from prt_torch.sphere import frame_from_normal
from prt_torch.transfer import TransferTensor

ORDER, SHAPE = 4, (3, 5)


def directions(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    vectors = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return vectors / vectors.norm(dim=-1, keepdim=True)


def lights(count: int = 2, order: int = ORDER) -> torch.Tensor:
    generator = torch.Generator().manual_seed(7)
    return torch.randn(count, order**2, 3, generator=generator, dtype=torch.float64)


def smooth_transfer(rows: int = 1, channels: int = 1, **surface: Any) -> TransferTensor:
    """Of a 3 x 5 map, float64."""
    generator = torch.Generator().manual_seed(3)
    shape = (15, channels, rows, ORDER**2)
    values = torch.randn(*shape, generator=generator, dtype=torch.float64)
    if rows > 1:
        surface |= {"exit_basis": HemisphericalHarmonics(rows)}
    light_basis = SphericalHarmonics(ORDER)
    return TransferTensor.from_dense(values, light_basis=light_basis, **surface)


@functools.cache
def texture(rows: int = 1, channels: int = 1, lobes: int = 4) -> LobeTexture:
    transfer = smooth_transfer(rows, channels, frames=frame_from_normal(directions(15)))
    return LobeTexture.from_transfer(transfer, SHAPE, num_lobes=lobes, bits=None, effort="fast")


def centres() -> torch.Tensor:
    return texel_centres(*SHAPE).reshape(-1, 2)


def test_lookups_at_centres_between_them_and_across_borders():
    grid = TexelGrid(3, 5, (True, False))
    values = torch.arange(15, dtype=torch.float64)
    uv = centres()
    assert torch.equal(grid.nearest(uv), torch.arange(15))
    assert torch.allclose(grid.sample(values, uv), values)
    # Row 0 is at the top; up from it is the last row, and left of column 0 column 0 goes on.
    places = [[0.1, 1.0], [0.0, 5 / 6], [1.7, 0.5], [0.2, -1.0 + 0.5]]
    places = torch.tensor(places, dtype=torch.float64)
    expected = torch.tensor([(0 + 10) / 2, 0.0, 9.0, (5 + 6) / 2], dtype=torch.float64)
    assert torch.allclose(grid.sample(values, places), expected)
    assert grid.nearest(places[[1, 2]]).tolist() == [0, 9]
    shifted = TexelGrid(3, 5).sample(values, uv + torch.tensor([2.0, -3.0]))
    assert torch.allclose(shifted, values, atol=1e-9)
    with pytest.raises(ValueError, match="values of 15 texels, got 4"):
        grid.sample(values[:4], uv)
    smooth = (uv[:4] + 0.03).requires_grad_()  # slopes jump at the centres
    assert torch.autograd.gradcheck(lambda at: grid.sample(values, at), smooth)


@pytest.mark.parametrize(("rows", "channels", "lobes"), [(1, 1, 5), (1, 3, 2), (3, 1, 4)])
def test_on_the_patch_itself_it_is_the_lobes_of_the_patch(rows, channels, lobes):
    """At texel centres and in the patch's own frame, it is what fits the transfer in the world."""
    micro = frame_from_normal(directions(15))
    transfer = smooth_transfer(rows, channels, frames=micro)
    made = texture(rows, channels, lobes)
    frames = PATCH_FRAME.expand(15, 3, 3)
    lit = made(lights(), centres(), frames)
    model = made.on(centres(), frames)
    assert relative(lit, model(lights())) < 1e-12
    assert relative(model.dense(), in_world(made)) < 1e-12
    if rows > 1:
        assert model.surface.frames is not None
        assert torch.allclose(model.surface.frames, micro, atol=1e-9)
    # Five lobes meet all bands of order 4 but the ridge, so the transfer itself comes back.
    if lobes == 5:
        assert relative(model.dense(), transfer.dense()) < 0.1


def in_world(made: LobeTexture) -> torch.Tensor:
    """The texels' transfer turned back to the world of the patch."""
    turn = sh.rotation_matrix(PATCH_FRAME.mT.contiguous(), ORDER)
    return made.texels.dense() @ turn.mT


def test_transfer_in_a_frame_is_the_same_function():
    patch_frames = frame_from_normal(directions(15))
    transfer = smooth_transfer(2, frames=patch_frames)
    local = in_frame(transfer, PATCH_FRAME)
    seen = directions(9, seed=4)
    before = transfer.dense() @ sh.evaluate(seen, ORDER).mT
    after = local.dense() @ sh.evaluate(seen @ PATCH_FRAME.mT, ORDER).mT
    assert torch.allclose(after, before, atol=1e-12)
    assert local.surface.frames is not None
    assert torch.allclose(local.surface.frames @ PATCH_FRAME, patch_frames)


@pytest.mark.parametrize("rows", [1, 3])
def test_on_a_turned_surface_it_is_the_transfer_turned(rows):
    made = texture(rows)
    frames = frame_from_normal(directions(15, seed=2))
    lit = made(lights(), centres(), frames)
    local = torch.einsum("pij,bjc->bpic", sh.rotation_matrix(frames, ORDER), lights())
    expected = torch.einsum("pri,bpic->bprc", made.texels.dense()[:, 0], local)
    assert relative(lit, expected) < 1e-12


def test_mirrored_frames_mirror_the_patch():
    """Transfer at the mirror image of a light, through a frame whose tangent is turned round."""
    made = texture()
    mirror = torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64))
    seen = directions(64)
    values = sh.evaluate(seen, ORDER)
    light = torch.linalg.pinv(values)  # one light a direction: its values there are a unit
    reflected = torch.linalg.pinv(sh.evaluate(seen @ mirror, ORDER))
    frames = torch.eye(3, dtype=torch.float64).expand(15, 3, 3)
    plain = made(light.mT[..., None].expand(-1, -1, 3), centres(), frames)
    other = made(reflected.mT[..., None].expand(-1, -1, 3), centres(), mirror @ frames)
    assert relative(other, plain) < 1e-10


def test_constant_and_linear_terms_are_interpolated_and_lobes_are_not():
    made = texture()
    grid, at = made.grid, torch.tensor([[0.23, 0.4], [0.97, 0.99]], dtype=torch.float64)
    looked_up = made.lobes(at)
    assert torch.equal(looked_up.axes, made.texels.axes[grid.nearest(at)])
    assert torch.allclose(looked_up.linear, grid.sample(made.texels.linear, at))
    both = LobeTexture(made.texels, grid, interpolate=True).lobes(at)
    assert torch.allclose(both.coefficients, grid.sample(made.texels.coefficients, at))


def test_a_model_on_points_is_posed_and_seen_as_any_other():
    made = copy.deepcopy(texture(3))
    made.texels.reflectance.copy_(torch.tensor([[0.5, 0.25, 1.0]]))
    uv = torch.rand(6, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    rest, posed = (frame_from_normal(directions(6, seed=s)) for s in (5, 6))
    model = made.on(uv, rest, positions=directions(6, seed=8))
    light, views = lights(), torch.tensor([[0.0, 3.0, 1.0]], dtype=torch.float64)
    there = Relighter(made.on(uv, posed, positions=directions(6, seed=8)))(light, views)
    moved = Relighter(model)(light, views, made.shading_frames(uv, posed))
    assert relative(moved, there) < 1e-10
    rows = made(light, uv, posed)
    local = made.shading_frames(uv, posed)
    seen = torch.nn.functional.normalize(views - directions(6, seed=8), dim=-1)
    exits = HemisphericalHarmonics(3).evaluate((local @ seen[..., None])[..., 0])
    expected = torch.einsum("bprc,pr->bpc", rows, exits) * made.reflectance(uv)
    assert relative(there[:, 0], expected) < 1e-10


def test_gradients_of_light_frames_places_and_parameters():
    made = texture(2, lobes=3)
    uv = torch.tensor([[0.31, 0.62], [0.77, 0.15]], dtype=torch.float64)
    frames = frame_from_normal(directions(2, seed=3))
    inputs = [lights(1), uv, frames, *made.parameters()]
    inputs = [value.detach().clone().requires_grad_() for value in inputs]

    def relit(light, uv, frames, *parameters):
        state = dict(zip(dict(made.named_parameters()), parameters, strict=True))
        return torch.func.functional_call(made, state, (light, uv, frames))

    assert torch.autograd.gradcheck(relit, inputs, fast_mode=True)


def test_a_light_is_found_through_a_textured_surface():
    made = texture()
    tube = surface_of_revolution("tube", torch.tensor([[1.0, 1.0], [1.5, 0.0]]).double(), 12)
    frames = tangent_frames(tube)
    generator = torch.Generator().manual_seed(6)
    uv = torch.rand(tube.num_points, 2, generator=generator, dtype=torch.float64)
    wanted = lights(1)
    seen = made(wanted, uv, frames).detach()
    light = torch.zeros_like(wanted).requires_grad_()
    solver = torch.optim.LBFGS([light], max_iter=30, line_search_fn="strong_wolfe")

    def missed():
        solver.zero_grad()
        error = (made(light, uv, frames) - seen).square().sum()
        error.backward()
        return error

    solver.step(missed)
    assert relative(light, wanted) < 0.1


@pytest.mark.parametrize("rows", [1, 3])
def test_files_keep_every_bit_and_tell_damage(tmp_path, rows):
    path = tmp_path / "bumps.safetensors"
    transfer = smooth_transfer(rows, frames=frame_from_normal(directions(15)))
    made = LobeTexture.from_transfer(transfer, SHAPE, periodic=(True, False), effort="fast")
    made.save(path)
    again = LobeTexture.load(path)
    uv, frames = centres()[:7] + 0.05, frame_from_normal(directions(7))
    assert torch.equal(again(lights(), uv, frames), made(lights(), uv, frames))
    assert torch.equal(again.shading_frames(uv, frames), made.shading_frames(uv, frames))
    assert again.grid == made.grid
    held = sum(made.storage().values())
    assert held <= path.stat().st_size < held + 2000
    data = bytearray(path.read_bytes())
    data[-3] ^= 1
    path.write_bytes(data)
    with pytest.raises(InputError, match="it is damaged"):
        LobeTexture.load(path)
    with pytest.raises(InputError, match="no such file"):
        LobeTexture.load(tmp_path / "none")


def test_wrong_shapes_are_refused(without_type_checker):
    made = texture()
    with pytest.raises(ValueError, match="expected 8 texels, got 15"):
        LobeTexture(made.texels, TexelGrid(2, 4))
    with pytest.raises(ValueError, match='frames "points 3 3"'):
        made(lights(), centres(), PATCH_FRAME[None])
    lobes = texture(2).texels
    bare = replace(lobes.surface, frames=None)
    packed = ZonalLobes.from_packed(lobes.packed(), bare, lobes.shape)
    with pytest.raises(ValueError, match="expected micro frames"):
        LobeTexture(packed, TexelGrid(*SHAPE))


def test_a_baked_patch_on_a_rotated_plane_is_the_patch_baked_there():
    patch = bumps(4)
    transfer = bake_patch(patch, resolution=16, supersampling=1)
    made = LobeTexture.from_transfer(transfer, (4, 4), num_lobes=4)
    uv = texel_centres(4, 4).reshape(-1, 2)
    rotation = frame_from_normal(directions(1, seed=9))[0]
    frames = (PATCH_FRAME @ rotation.mT).expand(16, 3, 3)
    dense = transfer.dense()[:, 0, 0].double() @ sh.rotation_matrix(rotation, 6).mT
    assert relative(made.on(uv, frames).dense()[:, 0, 0], dense) < 0.02


def quadrature(light: torch.Tensor, normal: torch.Tensor, alpha: float) -> torch.Tensor:
    """Integral of the membrane's function times light of order 3, over both half-spheres."""
    local, weights = sh.hemisphere_quadrature(8)
    frame = frame_from_normal(normal)
    total = torch.zeros(3, dtype=torch.float64)
    for side, share in ((1.0, 1.0), (-1.0, alpha)):
        radiance = sh.evaluate(side * local @ frame, 3) @ light
        total += share / math.pi * (weights * local[:, 2]) @ radiance
    return total


def test_a_membrane_is_its_integral_and_at_the_back_exchanges_its_sides():
    normals, alphas = directions(3), torch.tensor([0.0, 0.4, 1.0], dtype=torch.float64)
    light, frames = lights(1, 3), frame_from_normal(directions(3))
    front = thin_membrane(alphas, frames)(light)[0, :, 0]
    expected = [quadrature(light[0], n, float(a)) for n, a in zip(normals, alphas, strict=True)]
    assert torch.allclose(front, torch.stack(expected), atol=1e-12)
    behind = towards_viewer(frames, -normals)
    assert torch.allclose(behind[:, 2], -normals)
    assert torch.allclose(torch.linalg.det(behind), torch.ones(3).double())
    assert torch.equal(towards_viewer(frames, normals), frames)
    back = thin_membrane(alphas, frames)(light, behind)[0, :, 0]
    over = [quadrature(light[0], -n, float(a)) for n, a in zip(normals, alphas, strict=True)]
    assert torch.allclose(back, torch.stack(over), atol=1e-12)
    assert torch.allclose(front[2], back[2], atol=1e-12)
    # An opaque one is a diffuse surface that sees everything.
    cosine = zonal.clamped_cosine_coefficients(3)[None] / math.pi
    diffuse = zonal.zonal_to_sh(cosine, normals[:1])
    assert torch.allclose(front[0], (diffuse @ light[0])[0], atol=1e-12)


def test_a_membrane_by_a_map_is_one_by_points():
    alpha = torch.rand(4, 6, generator=torch.Generator().manual_seed(2)).double()
    made = membrane_texture(alpha)
    uv = torch.rand(9, 2, generator=torch.Generator().manual_seed(3)).double()
    frames = frame_from_normal(directions(9))
    by_points = thin_membrane(made.grid.sample(alpha.flatten(), uv), frames)
    assert torch.allclose(made(lights(1, 3), uv, frames), by_points(lights(1, 3)), atol=1e-12)
    with pytest.raises(ValueError, match=r"transparency in 0\.\.1"):
        membrane_texture(alpha + 0.5)


def test_a_membrane_has_one_transparency_or_one_a_point(without_type_checker):
    with pytest.raises(ValueError, match="one transparency or 9"):
        thin_membrane(torch.zeros(6), frame_from_normal(directions(9)))


def test_bilinear_maps_come_back_by_least_squares():
    grid = TexelGrid(4, 5, (False, False))
    texels = torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    uv = texel_centres(17, 19).reshape(-1, 2)
    assert torch.allclose(
        interpolated_least_squares(grid.sample(texels, uv), uv, grid), texels, atol=1e-6
    )


def test_lobes_that_are_interpolated_come_back_from_near_them():
    grid = TexelGrid(3, 3, (False, False))
    generator = torch.Generator().manual_seed(5)
    axes = torch.eye(3).double() + 0.2 * torch.randn(9, 3, 3, generator=generator).double()
    axes = zonal.unit_axes(axes)
    weights = 0.5 + torch.rand(9, 3, 2, generator=generator).double()
    uv = texel_centres(12, 12).reshape(-1, 2)
    filled = torch.nn.functional.pad(grid.sample(weights, uv), (2, 0))
    signals = zonal.lobes_to_sh(grid.sample(axes, uv), filled)
    signals = torch.cat([torch.ones(144, 4).double(), signals[:, 4:]], 1)
    start = axes + 0.05 * torch.randn(9, 3, 3, generator=generator).double()
    fit = fit_map(signals, uv, grid, start, 0.9 * weights, max_steps=200)
    assert fit.error < 1e-3 < 0.02 < fit.start_error
    assert relative(fit.lobes.axes[:, 0], axes) < 0.02


def test_wrinkles_fitted_together_can_be_interpolated():
    wrinkles = WrinkleMap(0.5, (6, 6))
    made, fit = wrinkle_texture(wrinkles, order=4, max_steps=40)
    assert fit.error < min(0.12, fit.start_error)
    across, depth = (place[::3] for place in wrinkles.places(4))
    signals = groove_transfer(across, depth, 4)
    texels = TransferTensor.from_dense(groove_transfer(*wrinkles.places(1), 4))
    alone = ZonalLobes.from_transfer(texels, num_lobes=3, bits=None, effort="fast")
    apart = LobeTexture(alone, wrinkles.grid, interpolate=True)
    frames = torch.eye(3, dtype=torch.float64).expand(len(across), 3, 3)
    uv, light = wrinkles.uv(across, depth), lights(4)
    exact = torch.einsum("pi,bic->bpc", signals, light)
    together = relative(made.double()(light, uv, frames)[:, :, 0], exact)
    assert together < 0.15
    assert together < 0.5 * relative(apart(light, uv, frames)[:, :, 0], exact)
    # No depth is the plane, which sees everything, wherever it is.
    flat = made(light, wrinkles.uv(across[:5], torch.zeros(5).double()), frames[:5])
    cosine = zonal.clamped_cosine_coefficients(4)[None] / math.pi
    plane = zonal.zonal_to_sh(cosine, torch.tensor([[0.0, 0.0, 1.0]]).double()) @ light
    assert relative(flat[:, :, 0], plane.expand(-1, 5, -1)) < 0.05


def test_wrinkle_maps_are_checked():
    with pytest.raises(ValueError, match="a depth above 0"):
        WrinkleMap(0.0)
    with pytest.raises(ValueError, match="at least 3 bands"):
        wrinkle_texture(WrinkleMap(), order=2)
    with pytest.raises(ValueError, match="depths of at least 0"):
        groove_transfer(torch.zeros(1), torch.tensor([-0.1]), 3)
