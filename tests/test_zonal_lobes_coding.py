"""Compressed lobes: the contract, what codes add, and lobes that nearly coincide."""

import math
from dataclasses import replace

import pytest
import torch
from contract import Contract, random_transfer

from prt_torch.bases import SphericalHarmonics
from prt_torch.metric import Metric
from prt_torch.representations import ZonalLobes, load, save
from prt_torch.representations.zonal_lobes_coding import Lobes
from prt_torch.representations.zonal_lobes_compression import coded
from prt_torch.transfer import TransferTensor


def in_harmonics(transfer: TransferTensor) -> TransferTensor:
    basis = SphericalHarmonics(math.isqrt(transfer.num_coeffs))
    return replace(transfer, surface=replace(transfer.surface, light_basis=basis))


def prior(order: int) -> Metric:
    generator = torch.Generator().manual_seed(3)
    lights = torch.randn(6, order**2, 3, generator=generator, dtype=torch.float64)
    lights[:, 0] = 5.0
    return Metric.light_prior(lights, SphericalHarmonics(order))


class TestCompressedLobes(Contract):
    test_one_or_two_threads_agree = None  # as the fit does, which is tested without codes

    def make(self, transfer):
        # eval(): rounding has no derivative, so gradients are checked of the values as they are.
        model = ZonalLobes.from_transfer(
            in_harmonics(transfer), num_lobes=2, effort="fast", quantisation_share=0.5
        )
        return model.eval()

    def make_lossless(self, transfer):
        return ZonalLobes.from_transfer(
            in_harmonics(transfer), num_lobes=5, bits=None, ridge=1e-12, effort="fast"
        )

    def test_lossless_budget_recovers_the_tensor(self):
        """Not this coding's: tested of the lobes themselves."""


def weighed_error(lobes: ZonalLobes, transfer: TransferTensor, metric: Metric) -> float:
    lost = lobes.dense().detach().double() - transfer.dense()
    return float(metric.weigh(lost).square().sum())


@pytest.mark.parametrize("lobes", [2, 3])
@pytest.mark.parametrize("weighed", [False, True])
def test_codes_add_no_more_than_a_few_times_their_share(lobes: int, weighed: bool):
    """Turned axes add what their bits on the average allow; numbers are fitted around them."""
    transfer = in_harmonics(random_transfer(points=400, coeffs=25))
    metric = prior(5) if weighed else Metric.l2(transfer)
    fit = {"num_lobes": lobes, "effort": "fast", "metric": metric}
    fine, coarse = (
        weighed_error(
            ZonalLobes.from_transfer(transfer, quantisation_share=share, **fit), transfer, metric
        )
        for share in (1e-6, 1.0)
    )
    assert 1.3 < coarse / fine < 3.0


def test_a_prior_is_in_the_file_and_numbers_are_fitted_in_it(tmp_path):
    transfer, metric = in_harmonics(random_transfer(points=100, rows=2, coeffs=16)), prior(4)
    options = {"num_lobes": 3, "effort": "fast", "quantisation_share": 0.01}
    plain = ZonalLobes.from_transfer(transfer, **options)
    model = ZonalLobes.from_transfer(transfer, metric=metric, **options)
    assert weighed_error(model, transfer, metric) < 0.99 * weighed_error(plain, transfer, metric)
    save(model, tmp_path / "lobes.safetensors")
    assert torch.equal(load(tmp_path / "lobes.safetensors").dense(), model.dense())


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3])
def test_lobes_that_nearly_coincide_cost_no_more_bits_and_lose_nothing(angle: float):
    """A lobe beside a twin says nothing new: its coordinates are codes of zero."""
    generator = torch.Generator().manual_seed(0)
    axes = torch.randn(200, 1, 1, 3, generator=generator, dtype=torch.float64)
    axes = torch.nn.functional.normalize(axes, dim=-1)
    twin = axes + angle * torch.randn(200, 1, 1, 3, generator=generator, dtype=torch.float64)
    flat = torch.ones(200, 1, 2, 4, dtype=torch.float64)
    pair = Lobes(torch.cat([axes, twin], dim=2), flat, flat[:, :, 0, :0])
    transfer = random_transfer(points=200, coeffs=16)
    metric = Metric.l2(in_harmonics(transfer))
    single = Lobes(axes, flat[:, :, :1], flat[:, :, 0, :0])
    options = {"share": 0.1, "metric": metric, "order": 4}
    values = transfer.dense()[:, 0]
    both, coding = coded(pair, values, **options)
    codes = coding.codes(both)[1]
    alone = coded(single, values, **options)[1].codes(coded(single, values, **options)[0])[1]
    assert both.coefficients.isfinite().all()
    if angle < 1e-3:  # in the same code of an axis
        assert int((codes[..., 4:] != 0).sum()) == 0
        assert (codes[..., :4] - alone).abs().max() <= 2  # steps differ with the count of numbers


@pytest.mark.parametrize("share", [0.0, -1.0, float("nan")])
def test_a_share_is_positive(share: float):
    with pytest.raises(ValueError, match="expected a positive share"):
        ZonalLobes.from_transfer(
            in_harmonics(random_transfer()), num_lobes=1, quantisation_share=share
        )
