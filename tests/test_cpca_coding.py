"""CPCA in codes: the contract, what codes add, what they leave out, and what a file holds."""

import pytest
import torch
from contract import Contract, random_transfer

from prt_torch import fitting
from prt_torch.bases import SphericalHarmonics
from prt_torch.metric import Metric
from prt_torch.representations import CPCA, load, save
from prt_torch.transfer import TransferTensor


class TestCodedCPCA(Contract):
    def make(self, transfer):
        # eval(): rounding has no derivative, so gradients are checked of the values as they are.
        model = CPCA.from_transfer(transfer, num_clusters=5, rank=2, quantisation_share=0.5)
        return model.eval()

    def make_lossless(self, transfer):
        size = transfer.num_channels * transfer.num_rows * transfer.num_coeffs
        return CPCA.from_transfer(transfer, num_clusters=3, rank=size)


def in_harmonics(points: int = 500, order: int = 4, seed: int = 0) -> TransferTensor:
    """Random transfer for light in spherical harmonics."""
    transfer = random_transfer(points=points, coeffs=order**2, dtype=torch.float32, seed=seed)
    return TransferTensor.from_dense(transfer.dense(), light_basis=SphericalHarmonics(order))


def prior(order: int = 4) -> Metric:
    """Lights of much ambience, a few times as bright from above."""
    generator = torch.Generator().manual_seed(3)
    scale = torch.exp2(-torch.arange(order**2, dtype=torch.float64).sqrt().floor())
    lights = torch.randn(6, order**2, 3, generator=generator, dtype=torch.float64)
    return Metric.light_prior(lights * scale[:, None], SphericalHarmonics(order))


def squared_error(model: CPCA, transfer: TransferTensor, metric: Metric) -> float:
    lost = model.dense().detach().double() - transfer.dense()
    return float(metric.weigh(lost).square().sum())


def stored(model: CPCA) -> int:
    return sum(model.storage().values())


@pytest.mark.parametrize("weighed", [False, True])
@pytest.mark.parametrize("share", [0.05, 0.5])
def test_codes_add_the_share_they_may(share: float, weighed: bool):
    transfer = in_harmonics()
    metric = prior() if weighed else Metric.l2(transfer)
    model = CPCA.from_transfer(transfer, num_clusters=6, rank=3, metric=metric)
    before = squared_error(model, transfer, metric)
    added = squared_error(model.coded(transfer, share=share, metric=metric), transfer, metric)
    assert 0.7 * share < added / before - 1.0 < 1.1 * share


def test_codes_of_few_bits_take_a_fraction_of_the_bytes():
    transfer = in_harmonics(points=4000)
    model = CPCA.from_transfer(transfer, num_clusters=8, rank=6)
    coded = model.coded(transfer, share=4.0)
    assert stored(coded) < 0.2 * stored(model)  # below half of 16-bit codes


def test_vectors_that_hold_less_than_their_codes_cost_are_left_out():
    transfer = in_harmonics()
    model = CPCA.from_transfer(transfer, num_clusters=4, rank=8)
    assert model.ranks.tolist() == [8] * 4
    coarse = model.coded(transfer, share=100.0)  # the transfer is three vectors and 1 % of noise
    assert 3 <= int(coarse.ranks.max()) <= 5
    assert coarse.num_clusters == 4
    assert len(coarse.weights) == int(coarse.ranks[coarse.labels].sum())


def test_the_metric_of_a_prior_is_in_the_file(tmp_path):
    transfer, metric = in_harmonics(), prior()
    options = {"num_clusters": 6, "rank": 3, "quantisation_share": 0.5}
    model = CPCA.from_transfer(transfer, metric=metric, **options)
    save(model, tmp_path / "coded.safetensors")
    loaded = load(tmp_path / "coded.safetensors")
    assert torch.equal(loaded.dense(), model.dense())
    for name, tensor in model.packed().items():
        assert torch.equal(tensor, loaded.packed()[name]), name


@pytest.mark.parametrize("scale", [1e-100, 1.0, 1e100])
def test_steps_follow_the_size_of_the_values(scale: float):
    values = random_transfer(points=300).dense() * scale
    transfer = TransferTensor.from_dense(values)
    model = CPCA.from_transfer(transfer, num_clusters=4, rank=3)
    coded = model.coded(transfer, share=1.0)

    def lost(one: CPCA) -> float:
        return float(((one.dense().detach() - values) / scale).square().sum())

    assert 1.7 < lost(coded) / lost(model) < 2.1


@pytest.mark.parametrize("affine", [False, True])
def test_without_anything_to_say_there_are_no_vectors(affine: bool):
    """Points that are all the same are their mean; zero transfer is nothing."""
    for values in (torch.zeros(20, 9), torch.ones(20, 1) * torch.arange(9.0)):
        transfer = TransferTensor.from_dense(values[:, None, None] if values.ndim == 2 else values)
        model = CPCA.from_transfer(
            transfer, num_clusters=2, rank=2, affine=affine, quantisation_share=1.0
        )
        assert int(model.ranks.max()) <= (0 if affine else 1)
        largest = float(transfer.dense().abs().max())
        assert torch.allclose(model.dense(), transfer.dense(), atol=1e-4 * largest + 1e-30)
        assert model(torch.ones(1, 9, 3)).isfinite().all()


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_means_that_are_exact_stay_as_fine_as_their_codes(scale: float):
    """As many clusters as different points: no weight says anything, and means say all."""
    few = scale * torch.randn(5, 9, generator=torch.Generator().manual_seed(1))
    transfer = TransferTensor.from_dense(few.repeat(12, 1))
    model = CPCA.from_transfer(transfer, num_clusters=5, rank=2)
    assert float(model.weights.detach().abs().max()) == 0.0
    coded = model.coded(transfer, share=1.0)
    assert torch.allclose(coded.dense(), transfer.dense(), rtol=0, atol=2e-4 * scale)


def test_training_sees_what_a_file_holds():
    transfer = in_harmonics()
    model = CPCA.from_transfer(transfer, num_clusters=6, rank=3, quantisation_share=4.0)
    result = fitting.fit(model, transfer, max_steps=3)
    assert result.error_after <= result.error_before
    trained = model.dense().detach()
    at_rest = model.eval().dense().detach()
    assert torch.allclose(trained, at_rest, atol=1e-6)
    assert torch.equal(
        at_rest, CPCA.from_packed(model.packed(), model.surface, model.shape).dense()
    )


@pytest.mark.parametrize("share", [0.0, -1.0, float("nan")])
def test_a_share_is_positive(share: float):
    with pytest.raises(ValueError, match="expected a positive share"):
        CPCA.from_transfer(random_transfer(), num_clusters=2, rank=1, quantisation_share=share)
