"""Tables over the sphere that lobes look up: known errors, seams, poles, gradients."""

import math

import pytest
import torch
from tolerances import ROUNDING
from torch.autograd import gradcheck

from prt_torch.bases import sh
from prt_torch.bases.zonal_table import LatLongTable, band_table, harmonics_table

DOUBLE = torch.float64
UP = torch.tensor([0.0, 0.0, 1.0], dtype=DOUBLE)
BANDS = [slice(band * band, (band + 1) ** 2) for band in range(6)]


def randn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def directions(count: int, seed: int = 0) -> torch.Tensor:
    return torch.nn.functional.normalize(randn(count, 3, seed=seed), dim=-1)


def at(polar: float, azimuth: float) -> torch.Tensor:
    level = [math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth)]
    return torch.tensor([*level, math.cos(polar)], dtype=DOUBLE)


def errors_of(table: LatLongTable, where: torch.Tensor, order: int = 6) -> torch.Tensor:
    return table.lookup(harmonics_table(order, table), where) - sh.evaluate(where, order)


def relative_by_band(errors: torch.Tensor) -> list[float]:
    """Root mean square over directions and functions of a band, over that of the functions."""
    scale = math.sqrt(4 * math.pi)
    return [float(errors[:, own].square().mean().sqrt()) * scale for own in BANDS]


def test_error_of_each_band():
    """The known figures of a 32 x 64 table, within their spread over lights."""
    errors = errors_of(LatLongTable(), directions(40_000))
    expected = [0.0, 0.0016, 0.0046, 0.0090, 0.0150, 0.0222]
    assert relative_by_band(errors) == pytest.approx(expected, rel=0.07, abs=1e-12)


def centre_sampled(where: torch.Tensor, light: torch.Tensor) -> torch.Tensor:
    """The usual texture of 32 x 64 texel centres: wrapped around, but constant about the poles."""
    polar = (torch.arange(32, dtype=DOUBLE) + 0.5) * (math.pi / 32)
    azimuth = (torch.arange(66, dtype=DOUBLE) - 0.5) * (2 * math.pi / 64)
    level = torch.stack([azimuth.cos(), azimuth.sin()], -1) * polar.sin()[:, None, None]
    grid = torch.cat([level, polar.cos()[:, None, None].expand(-1, 66, -1)], -1)
    image = (sh.evaluate(grid, 6) @ light).permute(2, 0, 1)[None]
    across = torch.atan2(where[:, 1], where[:, 0]).remainder(2 * math.pi) / math.pi * 32 + 1
    down = torch.acos(where[:, 2]) / math.pi * 32
    places = torch.stack([across / 33 - 1, down / 16 - 1], -1)[None, None]
    found = torch.nn.functional.grid_sample(
        image, places, padding_mode="border", align_corners=False
    )
    return found[0, :, 0].mT


def test_largest_error_beside_that_of_texel_centres():
    """Any light of the highest band: at most .14 of its root mean square, theirs .40."""
    where = torch.cat([directions(40_000), at(0.02, 0.7)[None], -at(0.02, 0.7)[None]])
    band = torch.zeros(36, 11, dtype=DOUBLE)
    band[25:] = torch.eye(11, dtype=DOUBLE)
    exact = sh.evaluate(where, 6)[:, 25:]
    ours = errors_of(LatLongTable(), where)[:, 25:]
    theirs = centre_sampled(where, band) - exact
    # The worst light of unit norm for one direction has the root mean square 1 / sqrt(4 pi).
    worst = [float(e.norm(dim=1).max()) * math.sqrt(4 * math.pi) for e in (ours, theirs)]
    assert worst[0] < 0.14
    assert worst[1] > 0.30


def test_error_falls_with_the_square_of_the_step():
    where = directions(10_000)
    coarse, fine = (errors_of(LatLongTable(8 * k + 1, 16 * k), where) for k in (4, 8))
    ratios = [
        b / a for a, b in zip(relative_by_band(fine), relative_by_band(coarse), strict=True) if a
    ]
    assert ratios[1:] == pytest.approx([4.0] * 5, rel=0.02)


@pytest.mark.parametrize("size", [(2, 3), (3, 4), (7, 5), (32, 64)])
def test_vertices_come_back(size):
    table = LatLongTable(*size)
    vertices = table.directions().flatten(0, 1)
    values = randn(table.num_vertices, 2)
    values[: table.cols] = values[0]  # one direction, one value
    values[-table.cols :] = values[-1]
    assert torch.allclose(table.lookup(values, vertices), values, atol=1e-12)
    assert torch.allclose(vertices.norm(dim=-1), torch.ones(len(vertices), dtype=DOUBLE))
    assert torch.equal(table.directions()[0], UP.expand(table.cols, 3))
    assert torch.equal(table.directions()[-1], -UP.expand(table.cols, 3))


def test_a_middle_of_a_cell_is_the_mean_of_its_corners():
    table = LatLongTable(5, 8)
    values = randn(5, 8, 3)
    found = table.lookup(values.flatten(0, 1), at(1.5 * math.pi / 4, -0.5 * math.pi / 4))
    assert torch.allclose(found, values[1:3][:, [7, 0]].mean((0, 1)), atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
@pytest.mark.parametrize("size", [(2, 3), (5, 7), (32, 64)])
def test_continuous_across_seam_and_poles(size, dtype):
    table = LatLongTable(*size)
    smooth = harmonics_table(4, table)
    step, reach = 1e-4, 4 * max(size) * 1e-4
    for polar in (0.4, 1.2, 2.9):
        pairs = torch.stack([at(polar, math.pi - step), at(polar, math.pi + step)]).to(dtype)
        first, second = table.lookup(smooth.to(dtype), pairs)
        assert float((first - second).abs().max()) < reach
    for sign in (1.0, -1.0):
        azimuths = torch.arange(12) * (2 * math.pi / 12)
        around = sign * torch.stack([at(step, float(azimuth)) for azimuth in azimuths])
        found = table.lookup(smooth.to(dtype), around.to(dtype))
        pole = sh.evaluate(sign * UP, 4)
        assert float((found - pole).abs().max()) < reach
        assert torch.allclose(
            table.lookup(smooth.to(dtype), (sign * UP).to(dtype)).double(),
            pole,
            atol=ROUNDING[dtype],
        )


def test_bands_of_light_are_sums_of_harmonics():
    table, light = LatLongTable(6, 9), randn(2, 3, 16)
    found = band_table(light, table)
    assert found.shape == (54, 2, 3, 4)
    functions = sh.evaluate(table.directions().flatten(0, 1), 4)
    for band, own in enumerate(BANDS[:4]):
        expected = torch.einsum("vm,qcm->vqc", functions[:, own], light[..., own])
        assert torch.allclose(found[..., band], expected, atol=1e-12)
    # Looking up harmonics first and meeting the light then is the same, both being linear.
    where = directions(50)
    harmonics = table.lookup(harmonics_table(4, table), where)
    together = table.lookup(found.flatten(1), where).unflatten(1, (2, 3, 4)).sum(-1)
    assert torch.allclose(together, torch.einsum("dm,qcm->dqc", harmonics, light), atol=1e-12)


def test_types_and_shapes():
    table = LatLongTable(4, 6)
    single = band_table(randn(9).float(), table)
    assert (single.shape, single.dtype) == ((24, 3), torch.float32)
    found = table.lookup(single, directions(10).view(5, 2, 3))
    assert (found.shape, found.dtype) == ((5, 2, 3), torch.float32)
    assert table.lookup(single, directions(1)[:0]).shape == (0, 3)


def test_what_is_not_a_number_harms_nothing_else():
    table = LatLongTable(4, 6)
    where = directions(3)
    where[1, 0] = math.nan
    found = table.lookup(band_table(randn(9), table), where)
    assert torch.isfinite(found).all(-1).tolist() == [True, False, True]


@pytest.mark.parametrize("size", [(1, 4), (4, 2), (5000, 4), (4, 5000)])
def test_sizes_out_of_range(size):
    with pytest.raises(ValueError, match="expected 2 to 4096 rows and 3 to 4096 cols"):
        LatLongTable(*size)


def test_values_of_another_size():
    with pytest.raises(ValueError, match="expected values of 24 vertices, got 25"):
        LatLongTable(4, 6).lookup(randn(25, 2), directions(2))


def test_gradients():
    table = LatLongTable(4, 5)
    where, light = directions(6, seed=3).requires_grad_(), randn(2, 9).requires_grad_()

    def lit(light: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
        unit = where / where.norm(dim=-1, keepdim=True)
        return table.lookup(band_table(light, table).flatten(1), unit)

    assert gradcheck(lit, (light, where))


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
def test_gradients_at_and_beside_the_poles_are_finite(dtype):
    tiny = [1e-30, 1e-20, 1e-10, 1e-3, 0.0]
    beside = [[s * x, y, z] for x in tiny for y in (0.0, -1e-21) for z in (1, -1) for s in (1, -1)]
    where = torch.tensor(beside, dtype=dtype, requires_grad=True)
    table = LatLongTable()
    values = harmonics_table(6, table).to(dtype)
    slopes = torch.autograd.grad(table.lookup(values, where).square().sum(), where)[0]
    assert torch.isfinite(slopes).all()
    assert float(slopes.abs().max()) < 1e3
