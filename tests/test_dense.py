"""The uncompressed tensor, whole and in 16 bits, and its projection into other light bases."""

import pytest
import torch
from contract import Contract, random_transfer, relative

from prt_torch.bases import CubeDirections, SphericalHarmonics
from prt_torch.evaluate import reference_error, transfer_error
from prt_torch.representations import DenseTransfer
from prt_torch.sphere import cubemap_directions, cubemap_solid_angles
from prt_torch.transfer import TransferTensor, project


class TestDense(Contract):
    def make(self, transfer):
        return DenseTransfer.from_transfer(transfer)

    make_lossless = make


class TestCoded(Contract):
    def make(self, transfer):
        return DenseTransfer.from_transfer(transfer, bits=16)

    def make_lossless(self, transfer):
        return DenseTransfer.from_transfer(transfer)


def test_16_bits_keep_rows_of_very_different_size():
    values = random_transfer(points=40, rows=2, coeffs=50, dtype=torch.float32).dense()
    values[3, 0, 1] *= 1e-30
    values[5] *= 1e20
    values[7] = 0.0
    model = DenseTransfer.from_transfer(TransferTensor.from_dense(values), bits=16)
    largest = values.abs().amax(-1, keepdim=True)
    off = (model.dense() - values).detach().abs()
    assert bool((off <= 0.51 / 32767 * largest).all())
    assert model.storage()["codes"] == 2 * values.numel()
    assert model.storage()["steps"] == 4 * values.numel() // 50
    with pytest.raises(ValueError, match="16 bits or None"):
        DenseTransfer.from_transfer(TransferTensor.from_dense(values), bits=8)  # pyright: ignore


def test_projection_of_texels_is_the_bake_in_the_other_basis():
    cube, harmonics = CubeDirections(16), SphericalHarmonics(4)
    directions = cubemap_directions(16, dtype=torch.float64).reshape(-1, 3)
    solid_angles = cubemap_solid_angles(16, dtype=torch.float64).flatten()
    axes = torch.nn.functional.normalize(torch.randn(30, 3, dtype=torch.float64), dim=1)
    lobes = (axes @ directions.mT).clamp_min(0) * solid_angles
    texels = TransferTensor.from_dense(lobes, light_basis=cube)
    projected = project(texels, harmonics)
    expected = harmonics.project_cube(lobes, 16)
    assert relative(projected.dense()[:, 0, 0], expected) < 1e-14
    assert relative(projected.values[4:9], projected.dense()[4:9]) < 1e-14
    # What a clamped cosine loses beyond band 3: the rest of its squared norm (2π/3).
    lost = reference_error(0.0, projected)
    bands = (torch.pi / 4, torch.pi / 3, 5 * torch.pi / 64)
    assert lost == pytest.approx(1 - sum(bands) / (2 * torch.pi / 3), abs=2e-3)
    assert transfer_error(DenseTransfer.from_transfer(projected, bits=16), projected) < 1e-8
    with pytest.raises(ValueError, match="cube directions, got SH order 4"):
        project(projected, cube)
