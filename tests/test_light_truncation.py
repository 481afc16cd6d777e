"""Truncated light: which coefficients stay, and the energy that goes with the others."""

import itertools

import pytest
import torch
from contract import random_transfer

from prt_torch.bases import CubeDirections, Haar, LightBasis, SphericalHarmonics
from prt_torch.transfer import TransferTensor
from prt_torch.truncation import transfer_weights, truncate

BASES = [SphericalHarmonics(3), CubeDirections(2), Haar(4, 2)]
EVERY_BASIS = pytest.mark.parametrize("basis", BASES, ids=lambda basis: basis.name)


def random_light(basis: LightBasis, batch: int = 2, dtype=torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(batch, basis.num_coeffs, 3, generator=generator, dtype=dtype)


@EVERY_BASIS
@pytest.mark.parametrize("more", [0, 1, 10**6])
def test_all_of_them_are_the_light_itself(basis: LightBasis, more: int):
    light = random_light(basis)
    truncated, lost = truncate(light, basis, basis.num_coeffs + more)
    assert torch.equal(truncated, light)
    assert lost.tolist() == [0.0, 0.0]


@EVERY_BASIS
def test_none_of_them_is_black(basis: LightBasis):
    truncated, lost = truncate(random_light(basis), basis, 0)
    assert not truncated.any()
    assert lost.tolist() == [1.0, 1.0]


@EVERY_BASIS
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_largest_stay_as_they_are(basis: LightBasis, dtype: torch.dtype):
    """Colours together, each light on its own, none below one that is dropped."""
    light = random_light(basis, dtype=dtype)
    truncated, lost = truncate(light, basis, 7)
    assert (truncated.dtype, lost.dtype) == (dtype, torch.float64)
    for before, after in zip(light, truncated, strict=True):
        kept = (after != 0).any(1)
        assert int(kept.sum()) == 7
        assert torch.equal(after[kept], before[kept])
        magnitude = before.double().square().sum(1)
        assert float(magnitude[kept].min()) >= float(magnitude[~kept].max())
    assert not torch.equal(truncated[0] != 0, truncated[1] != 0)


@pytest.mark.parametrize("basis", BASES[:2], ids=lambda basis: basis.name)
def test_more_coefficients_lose_less(basis: LightBasis):
    """In bases whose functions are orthogonal over the sphere."""
    light = random_light(basis)
    losses = torch.stack([truncate(light, basis, keep)[1] for keep in range(basis.num_coeffs + 1)])
    assert (losses.diff(dim=0) < 0).all()


def test_magnitude_is_optimal_in_texels():
    """No other choice of three leaves less in texels of equal weights, and Parseval says what."""
    basis = Haar(2, 2)
    light = random_light(basis, batch=1)
    truncated, _ = truncate(light, basis, 3)
    error = float((light - truncated).square().sum())
    texels = texels_of(basis, light - truncated)
    assert float(texels.square().sum()) == pytest.approx(error, rel=1e-12)
    energy = light[0].square().sum(1)
    choices = torch.tensor(list(itertools.combinations(range(24), 3)))
    others = energy.sum() - energy[choices].sum(1)
    assert error == pytest.approx(float(others.min()), rel=1e-12)


def texels_of(basis: Haar, light: torch.Tensor) -> torch.Tensor:
    """Texel radiances, found by solving for them rather than by the inverse transform."""
    texels = torch.eye(basis.num_coeffs, dtype=torch.float64)
    return torch.linalg.solve(basis.project_cube(texels, basis.resolution).mT, light)


@pytest.mark.parametrize("keep", [1, 5, 40])
def test_lost_is_energy_over_the_sphere(keep: int):
    """Radiances of texels, squared, times solid angles."""
    basis = Haar(4, 2)
    light = random_light(basis)
    truncated, lost = truncate(light, basis, keep)
    solid_angles = CubeDirections(4).solid_angles[:, None]
    energy = [
        (texels_of(basis, some).square() * solid_angles).sum((1, 2))
        for some in (light - truncated, light)
    ]
    assert torch.allclose(lost, energy[0] / energy[1], rtol=1e-12)


def test_sun_in_one_texel():
    """Nineteen coefficients hold a lone sun; five more the ambient of the other faces."""
    basis = Haar(64, 64)
    texels = torch.zeros(1, basis.num_coeffs, dtype=torch.float64)
    texels[0, 12345] = 1e6
    for ambient, enough in [(0.0, 19), (1.0, 24)]:
        light = basis.project_cube(texels + ambient, 64)[:, :, None].expand(-1, -1, 3)
        assert truncate(light, basis, enough)[1].tolist() == [0.0]
        assert truncate(light, basis, enough)[0].equal(light)
        assert truncate(light, basis, enough - 1)[1] > 0


def test_weights_change_the_choice():
    """Equal magnitudes: the widest function is kept by area, any one by a weight on it."""
    basis = Haar(8, 8)
    light = torch.ones(1, basis.num_coeffs, 3)
    by_area, _ = truncate(light, basis, 24, weights=basis.areas())
    widest = torch.zeros(6, 8, 8)
    widest[:, :2, :2] = 1.0  # of each face the mean, and the details of the coarsest level
    assert torch.equal(by_area[0, :, 0], widest.flatten())
    weights = torch.zeros(basis.num_coeffs)
    weights[77] = 1e-9
    only, lost = truncate(light, basis, 1, weights=weights)
    assert only.nonzero()[:, 1].tolist() == [77] * 3
    assert 0 < float(lost) < 1


def test_transfer_weights_are_root_mean_squares():
    transfer = random_transfer(points=50)
    values = transfer.dense().double()
    expected = values.permute(3, 0, 1, 2).flatten(1).square().mean(1).sqrt()
    assert torch.allclose(transfer_weights(transfer), expected, rtol=1e-12)


def test_transfer_weights_keep_the_light_that_surfaces_see():
    """Light from below is dropped first where all points face up."""
    basis = CubeDirections(4)
    values = torch.rand(30, 6, 16, generator=torch.Generator().manual_seed(1))
    values[:, 3] = 0.0  # -y
    transfer = TransferTensor.from_dense(values.flatten(1), light_basis=basis)
    light = torch.ones(1, 96, 3)
    light[:, 48:64] = 100.0
    truncated, lost = truncate(light, basis, 80, weights=transfer_weights(transfer))
    assert not truncated[:, 48:64].any()
    assert torch.equal(transfer.dense()[:, 0, 0] @ truncated, transfer.dense()[:, 0, 0] @ light)
    assert float(lost) > 0.99


@EVERY_BASIS
def test_black_light_loses_nothing(basis: LightBasis):
    truncated, lost = truncate(torch.zeros(1, basis.num_coeffs, 3), basis, 2)
    assert not truncated.any()
    assert lost.tolist() == [0.0]


def test_ties_keep_the_first():
    light = torch.ones(1, 9, 3)
    truncated, _ = truncate(light, SphericalHarmonics(3), 4)
    assert truncated[0, :, 0].tolist() == [1.0] * 4 + [0.0] * 5


def test_gradients_flow_through_what_is_kept():
    basis = Haar(2, 2)
    light = random_light(basis, batch=1).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: truncate(x, basis, 5), light, fast_mode=True)
    truncated, _ = truncate(light, basis, 5)
    truncated.sum().backward()
    assert torch.equal(light.grad != 0, truncated != 0)


def test_refusals(without_type_checker):
    basis = SphericalHarmonics(3)
    light = random_light(basis)
    with pytest.raises(ValueError, match="at least 0"):
        truncate(light, basis, -1)
    with pytest.raises(ValueError, match="expected 16 light coefficients, got 9"):
        truncate(light, SphericalHarmonics(4), 3)
    with pytest.raises(ValueError, match="expected 9 weights"):
        truncate(light, basis, 3, weights=torch.ones(8))
