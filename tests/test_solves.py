"""Condition and ending of every solve of a run, and warnings of those that are stiff."""

import json
import math

import pytest
import torch
from contract import random_transfer

from prt_torch.bases import SRBF, HemisphericalHarmonics, SphericalHarmonics, sh
from prt_torch.bases.base import ExitBasis
from prt_torch.metric import Metric
from prt_torch.representations import CPCA
from prt_torch.solves import STIFF, Fitted, Solve, solves
from prt_torch.transfer import TransferTensor


class Twice(HemisphericalHarmonics):
    """The first function once more."""

    def gram(self):
        functions = [0, *range(self.num_rows - 1)]
        return super().gram()[functions][:, functions]


def glossy(exit_basis: ExitBasis) -> TransferTensor:
    values = random_transfer(rows=exit_basis.num_rows, coeffs=12).dense()
    basis = SRBF(12, resolution=2)
    return TransferTensor.from_dense(values, light_basis=basis, exit_basis=exit_basis)


def test_shared_solves_are_those_of_the_bases_and_the_metric():
    transfer = glossy(HemisphericalHarmonics(24))
    basis = transfer.surface.light_basis
    exits, light = solves(transfer, Metric.l2(transfer), [])
    # Order 5 without the function that the others replace best, as HemisphericalHarmonics has it.
    kept = HemisphericalHarmonics(24).indices
    eigenvalues = torch.linalg.eigvalsh(sh.hemisphere_gram(5)[kept][:, kept])
    assert exits.condition == pytest.approx(float(eigenvalues[-1] / eigenvalues[0]), rel=1e-6)
    assert exits.digits_lost == pytest.approx(math.log10(3.2e3), abs=0.01)
    assert light.condition == pytest.approx(float(torch.linalg.cond(basis.gram())), rel=1e-9)
    assert (exits.status, light.status) == ("solved", "solved")
    assert exits.warning is light.warning is None
    diffuse = TransferTensor.from_dense(torch.ones(5, 9), light_basis=SphericalHarmonics(3))
    assert solves(diffuse, Metric.l2(diffuse), []) == []


def test_a_light_prior_has_the_square_of_its_factors_condition():
    transfer = TransferTensor.from_dense(torch.ones(5, 9), light_basis=SphericalHarmonics(3))
    one_light = torch.zeros(1, 9, 3)
    one_light[:, 0] = 1.0  # all of the power in one coefficient of nine, and a floor of 1e-3
    (prior,) = solves(transfer, Metric.light_prior(one_light, SphericalHarmonics(3)), [])
    assert prior.condition == pytest.approx((9 + 1e-3) / 1e-3)
    flat = TransferTensor.from_dense(torch.ones(5, 1), light_basis=SphericalHarmonics(1))
    (one,) = solves(flat, Metric.light_prior(one_light[:, :1], SphericalHarmonics(1)), [])
    assert one.condition == 1.0


def test_singular_bases_are_told_as_such():
    wide = SRBF(42, bandwidth=1e-3, resolution=2)
    transfer = TransferTensor.from_dense(torch.ones(5, 42), light_basis=wide)
    (light,) = solves(transfer, Metric.l2(transfer), [])
    assert light.status == "regularised"
    assert light.condition == math.inf
    assert light.digits_lost == light.digits == pytest.approx(15.65, abs=0.01)
    assert "stiff: light basis" in light.warning
    exits = solves(glossy(Twice(4)), Metric.l2(glossy(Twice(4))), [])[0]
    assert exits.status == "regularised"
    assert exits.condition > 1e15
    assert exits.warning


def test_construction_and_refinement_of_each_result():
    transfer = random_transfer()
    model = CPCA.from_transfer(transfer, num_clusters=3, rank=2).to(torch.float32)
    fitted = [
        Fitted("a", model, "converged", 1.0, 2e3, "rank_deficient"),
        Fitted("b", model, "closed_form", 1.0, math.nan),
    ]
    found = solves(transfer, Metric.l2(transfer), fitted)
    assert [(one.what, one.status) for one in found] == [
        ("a: closed form", "rank_deficient"),
        ("a: refinement", "converged"),
        ("b: closed form", "closed_form"),
    ]
    assert found[1].dtype == torch.float32
    assert [one.entry()["digits_lost"] for one in found] == [
        pytest.approx(3.30, abs=0.01),
        None,
        None,
    ]


@pytest.mark.parametrize(
    ("condition", "dtype", "lost"),
    [
        (0.99 * STIFF, torch.float64, None),
        (STIFF, torch.float64, "8.0 of the 15.7 digits of float64"),
        (1e12, torch.float32, "6.9 of the 6.9 digits of float32"),
        (math.inf, torch.float64, "15.7 of the 15.7 digits of float64"),
        (math.nan, torch.float64, None),
    ],
)
def test_stiff_solves_are_warned_of_with_the_digits_they_cost(condition, dtype, lost):
    solve = Solve("light prior", "solved", condition, dtype)
    assert (solve.warning is None) == (lost is None)
    assert lost is None or lost in solve.warning
    entry = json.loads(json.dumps(solve.entry(), allow_nan=False))
    assert entry["warning"] == solve.warning
    assert (entry["condition"] is None) == (not math.isfinite(condition))
