"""Compressed clustered tensors: the contract, what codes add, and ranks that are not needed."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from contract import Contract, random_transfer

from prt_torch import fitting
from prt_torch.bases import SphericalHarmonics
from prt_torch.metric import Metric
from prt_torch.representations import ClusteredTensor, load, save
from prt_torch.transfer import TransferTensor


class TestCompressedTensor(Contract):
    test_one_or_two_threads_agree = None  # as the fit does, which is tested without codes

    def make(self, transfer):
        # eval(): rounding has no derivative, so gradients are checked of the values as they are.
        model = ClusteredTensor.from_transfer(
            transfer, num_clusters=4, ranks=(2, 5, 3), quantisation_share=0.5
        )
        return model.eval()

    def make_lossless(self, transfer):
        return ClusteredTensor.from_transfer(transfer, num_clusters=3, ranks=(2, 9, 18), bits=None)


def in_harmonics(**options: Any) -> TransferTensor:
    transfer = random_transfer(points=300, rows=4, coeffs=16, dtype=torch.float32, **options)
    surface = replace(transfer.surface, light_basis=SphericalHarmonics(4))
    return replace(transfer, surface=surface)


def prior(transfer: TransferTensor) -> Metric:
    lights = torch.randn(6, 16, 3, generator=torch.Generator().manual_seed(3)).double()
    lights[:, 0] = 5.0
    exit_basis = transfer.surface.exit_basis
    return Metric.light_prior(lights, SphericalHarmonics(4), exit_basis=exit_basis)


def lost(model: ClusteredTensor, transfer: TransferTensor, metric: Metric) -> float:
    difference = model.dense().detach().double() - transfer.dense()
    return float(metric.weigh(difference).square().sum())


@pytest.mark.parametrize("weighed", [False, True])
def test_codes_add_the_share_they_may(weighed: bool):
    transfer = in_harmonics()
    metric = prior(transfer) if weighed else Metric.l2(transfer)
    options = {"num_clusters": 4, "ranks": (4, 8, 3), "metric": metric}
    before = lost(ClusteredTensor.from_transfer(transfer, bits=None, **options), transfer, metric)
    coded = ClusteredTensor.from_transfer(transfer, quantisation_share=0.2, **options)
    assert 0.1 < lost(coded, transfer, metric) / before - 1.0 < 0.25


def test_ranks_that_are_not_needed_cost_little():
    transfer = in_harmonics()
    few, many = (
        ClusteredTensor.from_transfer(
            transfer, num_clusters=5, ranks=ranks, quantisation_share=share
        ).storage()["weight_stream"]
        for ranks, share in (((4, 16, 4), 0.2), ((4, 16, 12), 300.0))
    )
    assert many < 1.2 * few  # three times as many weights


def test_a_prior_is_in_the_file(tmp_path):
    transfer = in_harmonics()
    options = {"num_clusters": 4, "ranks": (4, 8, 3), "quantisation_share": 0.2}
    model = ClusteredTensor.from_transfer(transfer, metric=prior(transfer), **options)
    save(model, tmp_path / "tensor.safetensors")
    assert torch.equal(load(tmp_path / "tensor.safetensors").dense(), model.dense())


def test_training_sees_what_a_file_holds():
    transfer = in_harmonics()
    model = ClusteredTensor.from_transfer(
        transfer, num_clusters=2, ranks=(2, 4, 2), quantisation_share=2.0
    )
    result = fitting.fit(model, transfer, max_steps=1)
    assert result.error_after <= result.error_before
    trained = model.dense().detach()
    assert torch.allclose(trained, model.eval().dense(), atol=1e-5)


@pytest.mark.parametrize("share", [0.0, -1.0, float("nan")])
def test_a_share_is_positive(share: float):
    with pytest.raises(ValueError, match="expected a positive share"):
        ClusteredTensor.from_transfer(random_transfer(), quantisation_share=share)
