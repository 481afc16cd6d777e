"""Refinement: never worse, honest endings, bit-identical resumption."""

import math

import pytest
import torch
from contract import random_transfer

from prt_torch.bases import CubeDirections, SphericalHarmonics
from prt_torch.errors import InputError
from prt_torch.fitting import fit
from prt_torch.metric import Metric
from prt_torch.representations import (
    CPCA,
    ClusteredTensor,
    DenseTransfer,
    ScatteredSRBF,
    undetermined,
)
from prt_torch.transfer import TransferTensor


def disturbed(transfer: TransferTensor, amount: float = 0.2) -> CPCA:
    """A fit that has something left to gain."""
    model = CPCA.from_transfer(transfer, num_clusters=5, rank=2)
    generator = torch.Generator().manual_seed(9)
    with torch.no_grad():
        noise = torch.randn(model.representatives.shape, generator=generator)
        model.representatives += amount * noise.to(model.representatives)
    return model


def measured(model, transfer) -> float:
    difference = model.dense().detach() - transfer.dense()
    return float(difference.square().sum() / transfer.dense().square().sum())


@pytest.mark.parametrize(("optimizer", "steps"), [("lbfgs", 40), ("adam", 100)])
def test_gains_and_reports_what_it_returns(optimizer, steps):
    transfer = random_transfer(points=200)
    model = disturbed(transfer)
    before = measured(model, transfer)
    result = fit(model, transfer, optimizer=optimizer, max_steps=steps)
    assert result.representation is model
    assert result.error_before == pytest.approx(before, rel=1e-10)
    assert result.error_after == pytest.approx(measured(model, transfer), rel=1e-10)
    assert result.error_after < 0.9 * before
    assert len(result.history) == result.steps


def test_lbfgs_finds_the_closed_form_again():
    """For fixed clusters the closed form is the optimum, so a disturbed fit must return to it."""
    transfer = random_transfer(points=200)
    best = measured(CPCA.from_transfer(transfer, num_clusters=5, rank=2), transfer)
    result = fit(disturbed(transfer, 0.05), transfer, max_steps=200)
    assert result.status == "converged"
    assert result.error_after == pytest.approx(best, rel=1e-3)


def test_closed_form_is_never_made_worse():
    transfer = random_transfer(points=200)
    for optimizer in ("lbfgs", "adam"):
        model = CPCA.from_transfer(transfer, num_clusters=5, rank=2)
        before = measured(model, transfer)
        result = fit(model, transfer, optimizer=optimizer, max_steps=8, learning_rate=10.0)
        assert measured(model, transfer) <= before * (1 + 1e-12)
        assert result.status in ("converged", "stagnated", "max_steps", "nonfinite")


def test_no_steps_only_measures():
    transfer = random_transfer()
    model = disturbed(transfer)
    state = {name: p.detach().clone() for name, p in model.named_parameters()}
    result = fit(model, transfer, max_steps=0)
    assert result.status == "closed_form"
    assert all(torch.equal(p, state[name]) for name, p in model.named_parameters())


def test_exploding_steps_end_nonfinite_and_keep_the_best():
    transfer = random_transfer(dtype=torch.float32)
    model = disturbed(transfer)
    before = measured(model, transfer)
    result = fit(model, transfer, optimizer="adam", max_steps=50, learning_rate=1e30)
    assert result.status == "nonfinite"
    assert measured(model, transfer) <= before * (1 + 1e-6)
    assert all(torch.isfinite(p).all() for p in model.parameters())


@pytest.mark.parametrize("steps", [0, 3])
def test_nonfinite_from_the_start_stays_as_given(steps):
    """Squares of float32 beyond 1e19 overflow."""
    transfer = TransferTensor.from_dense(torch.full((5, 4), 1e25))
    model = DenseTransfer.from_transfer(transfer)
    with torch.no_grad():
        model.values.neg_()
    result = fit(model, transfer, max_steps=steps)
    assert (result.status, result.steps, result.error_after) == ("nonfinite", 0, math.inf)
    assert torch.equal(model.dense(), -transfer.dense())


@pytest.mark.parametrize("optimizer", ["lbfgs", "adam"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_resumption_is_bit_identical(tmp_path, optimizer, dtype):
    transfer = random_transfer(points=150, dtype=dtype)
    whole = disturbed(transfer)
    fit(whole, transfer, optimizer=optimizer, max_steps=6, tolerance=0.0)
    path = tmp_path / "fit.checkpoint"
    for steps in (2, 4, 6):
        model = disturbed(transfer)
        result = fit(
            model, transfer, optimizer=optimizer, max_steps=steps, tolerance=0.0, checkpoint=path
        )
    assert result.steps == 6
    for a, b in zip(whole.parameters(), model.parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_finished_fit_is_not_continued(tmp_path):
    transfer = random_transfer(points=100)
    path = tmp_path / "fit.checkpoint"
    first = fit(disturbed(transfer), transfer, max_steps=300, checkpoint=path)
    assert first.status == "converged"
    again = fit(disturbed(transfer), transfer, max_steps=300, checkpoint=path)
    assert (again.steps, again.error_after) == (first.steps, first.error_after)


def test_a_checkpoint_of_other_clusters_is_refused(tmp_path):
    transfer = random_transfer(points=100)
    path = tmp_path / "fit.checkpoint"
    own, other = (
        CPCA.from_transfer(
            transfer, num_clusters=5, rank=2, generator=torch.Generator().manual_seed(seed)
        )
        for seed in (0, 1)
    )
    assert not torch.equal(own.labels, other.labels)
    fit(own, transfer, max_steps=1, checkpoint=path)
    before = measured(other, transfer)
    with pytest.raises(InputError, match=r"fit\.checkpoint: is the checkpoint of another fit"):
        fit(other, transfer, max_steps=2, checkpoint=path)
    assert measured(other, transfer) == before


def test_damaged_checkpoint(tmp_path):
    path = tmp_path / "fit.checkpoint"
    path.write_bytes(b"not a checkpoint")
    transfer = random_transfer()
    with pytest.raises(InputError, match=r"fit\.checkpoint"):
        fit(disturbed(transfer), transfer, checkpoint=path)


def test_interruption_keeps_the_best():
    transfer = random_transfer(points=200)

    def interrupt(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    model = disturbed(transfer)
    before = measured(model, transfer)
    result = fit(model, transfer, max_steps=50, progress=interrupt)
    assert (result.status, result.steps) == ("interrupted", 2)
    assert measured(model, transfer) < before


def test_wrong_arguments(without_type_checker):
    transfer = random_transfer()
    model = CPCA.from_transfer(transfer, num_clusters=2, rank=1)
    with pytest.raises(ValueError, match="shape"):
        fit(model, random_transfer(points=10))
    with pytest.raises(ValueError, match="lbfgs or adam"):
        fit(model, transfer, optimizer="sgd")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="at least 0"):
        fit(model, transfer, max_steps=-1)


def test_l2_metric_of_cube_directions_is_the_integral_over_the_sphere():
    basis = CubeDirections(4)
    values = torch.rand(3, 1, 1, 96, dtype=torch.float64)
    transfer = TransferTensor.from_dense(values, light_basis=basis)
    weighed = Metric.l2(transfer).weigh(values).square().sum(-1)
    density = values / basis.solid_angles
    assert torch.allclose(weighed, (density.square() * basis.solid_angles).sum(-1))
    assert torch.allclose(Metric.l2(transfer).unweigh(Metric.l2(transfer).weigh(values)), values)


def test_light_prior_is_expected_squared_radiance_error():
    """Squared norm of an error = mean over lights and turns of its squared radiance, plus floor."""
    basis = SphericalHarmonics(3)
    lights = torch.randn(2, 9, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    metric = Metric.light_prior(lights, basis, turns=5, shrinkage=0.0, floor=0.01)
    error = torch.randn(9, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    total, power = 0.0, 0.0
    for light in lights:
        unit = light / light.norm()
        for turn in range(5):
            c, s = math.cos(2 * math.pi * turn / 5), math.sin(2 * math.pi * turn / 5)
            rotation = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
            turned = basis.rotate(unit, rotation)
            total += float((error @ turned).square().sum())
            power += float(turned.square().sum())
    expected = total * 9 / power + 0.01 * float(error.square().sum())
    assert float(metric.weigh(error[None]).square().sum()) == pytest.approx(expected, rel=1e-10)
    assert torch.allclose(metric.unweigh(metric.weigh(error[None])), error[None])


def test_a_light_prior_that_is_shrunk_whole_knows_the_power_of_bands_only():
    basis = SphericalHarmonics(3)
    lights = torch.randn(2, 9, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    metric = Metric.light_prior(lights, basis, shrinkage=1.0, floor=0.0)
    units = lights / lights.norm(dim=(1, 2), keepdim=True)
    for band in range(3):
        own = slice(band**2, (band + 1) ** 2)
        power = float(units[:, own].square().sum()) / len(lights) * 9 / (2 * band + 1)
        weighed = metric.weigh(torch.eye(9, dtype=torch.float64)[:, None])[own, 0]
        assert torch.allclose(weighed @ weighed.mT, power * torch.eye(2 * band + 1).double())
    with pytest.raises(ValueError, match="expected a shrinkage"):
        Metric.light_prior(lights, basis, shrinkage=1.5)
    with pytest.raises(ValueError, match="not black"):
        Metric.light_prior(torch.zeros_like(lights), basis)


def test_fitting_for_a_light_prior_lowers_radiance_errors_under_it():
    transfer = TransferTensor.from_dense(
        random_transfer(points=400, coeffs=36, seed=2).dense(),
        light_basis=SphericalHarmonics(6),
    )
    light = torch.zeros(1, 36, 3, dtype=torch.float64)
    light[0, :9] = torch.randn(9, 3, generator=torch.Generator().manual_seed(3)).double()
    prior = Metric.light_prior(light, SphericalHarmonics(6))
    exact = DenseTransfer.from_transfer(transfer)(light)
    with torch.no_grad():
        errors = [
            float(
                (
                    CPCA.from_transfer(transfer, num_clusters=4, rank=1, metric=m)(light) - exact
                ).norm()
            )
            for m in (None, prior)
        ]
    assert errors[1] < 0.9 * errors[0]


@pytest.mark.parametrize(
    ("kind", "plenty", "enough"),
    [  # three different points have two directions beside their mean
        (CPCA, {"num_clusters": 1, "rank": 3}, {"num_clusters": 1, "rank": 2}),
        (
            ClusteredTensor,
            {"num_clusters": 2, "ranks": (1, 9, 2)},
            {"num_clusters": 1, "ranks": (1, 9, 3)},
        ),
        (
            ScatteredSRBF,
            {"num_clusters": 1, "num_functions": 11},
            {"num_clusters": 1, "num_functions": 5},
        ),
    ],
)
def test_directions_that_the_data_do_not_determine_are_told(kind, plenty, enough):
    points = torch.randn(3, 9, generator=torch.Generator().manual_seed(0))
    transfer = TransferTensor.from_dense(
        points[torch.arange(30) % 3], light_basis=SphericalHarmonics(3)
    )
    options = {"transfer": transfer, "max_steps": 0}
    model = kind.from_transfer(transfer, **plenty)
    assert fit(model, **options).status == "rank_deficient"
    assert fit(kind.from_transfer(transfer, **enough), **options).status == "closed_form"
    assert fit(model, transfer, max_steps=1).status != "rank_deficient"
    zero = TransferTensor.from_dense(torch.zeros(30, 9), light_basis=SphericalHarmonics(3))
    if kind is not ScatteredSRBF:
        assert undetermined(kind.from_transfer(zero, **enough)) > 0
