"""Clustered tensor approximation: the contract, tensorly, the paper's identities and extremes."""

import itertools

import numpy as np
import pytest
import torch
from contract import Contract, random_transfer, relative
from torch import Tensor

from prt_torch.bases import SphericalHarmonics
from prt_torch.evaluate import squared_errors
from prt_torch.fitting import fit
from prt_torch.metric import Metric
from prt_torch.representations import ClusteredTensor, clustered_tensor_encoding
from prt_torch.representations.clustered_tensor_coding import Encoding, Parameters, Steps, pack
from prt_torch.representations.clustered_tensor_fit import decompose, exact_weights, in_view
from prt_torch.representations.clustered_tensor_projection import project, read_moments
from prt_torch.representations.points import Points, SortedPoints
from prt_torch.transfer import Surface, TransferTensor


class TestClusteredTensor(Contract):
    def make(self, transfer):
        # eval(): rounding has no derivative, so gradients are checked of the values as they are.
        return ClusteredTensor.from_transfer(transfer, num_clusters=4, ranks=(2, 5, 3)).eval()

    def make_lossless(self, transfer):
        return ClusteredTensor.from_transfer(transfer, num_clusters=3, ranks=(2, 9, 18), bits=None)


def normal(*shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def low_rank(points: int, rows: int, coeffs: int, ranks: tuple[int, int, int], seed: int) -> Tensor:
    """A tensor of Tucker ranks (points, rows, coeffs)."""
    core = normal(*ranks, seed=seed)
    left, middle, right = (
        normal(size, rank, seed=seed + place + 1)
        for place, (size, rank) in enumerate(zip((points, rows, coeffs), ranks, strict=True))
    )
    return torch.einsum("abc,pa,rb,ic->pri", core, left, middle, right)


def in_groups(points: int = 240, rows: int = 6, coeffs: int = 20) -> TransferTensor:
    """Noisy low-rank groups of points."""
    groups = [low_rank(points // 4, rows, coeffs, (3, 3, 4), seed=10 * g) for g in range(4)]
    values = torch.cat(groups) + 0.3 * normal(points, rows, coeffs, seed=99)
    return TransferTensor.from_dense(values)


def squared_error(model: ClusteredTensor, transfer: TransferTensor) -> float:
    with torch.no_grad():
        return float((model.dense() - transfer.dense()).square().sum())


def projector(columns: Tensor) -> Tensor:
    basis = torch.linalg.qr(columns)[0]
    return basis @ basis.mT


def test_one_cluster_is_the_tucker_decomposition_of_tensorly():
    tensorly = pytest.importorskip("tensorly.decomposition", reason="tensorly is not installed")
    values = low_rank(80, 7, 25, (5, 4, 6), seed=1) + 1.0 * normal(80, 7, 25, seed=2)
    rank = [5, 4, 6]
    core, factors = tensorly.tucker(values.numpy(), rank=rank, n_iter_max=500, tol=1e-15)
    approximated = np.einsum("abc,pa,rb,ic->pri", core, *factors)
    expected = float(np.square(approximated - values.numpy()).sum())
    transfer = TransferTensor.from_dense(values)
    model = ClusteredTensor.from_transfer(
        transfer, num_clusters=1, ranks=(4, 6, 5), bits=None, tolerance=0.0, max_turns=200
    )
    assert squared_error(model, transfer) <= expected * (1 + 1e-6)
    ours = (model.weights, model.view_basis[0], model.light_bases[0].mT)
    for mine, theirs in zip(ours, factors, strict=True):
        difference = projector(mine.detach()) - projector(torch.from_numpy(theirs.copy()))
        assert float(difference.abs().max()) < 1e-5


def test_dual_basis_weights_and_error_are_as_the_paper_has_them():
    """V V^T = I, W = U S, and the error is |T|² - |W|² (equations 16 and 17)."""
    transfer = in_groups()
    model = ClusteredTensor.from_transfer(transfer, num_clusters=4, ranks=(3, 6, 5), bits=None)
    dual, weights = model.cores.detach().flatten(2), model.weights.detach()
    assert relative(dual @ dual.mT, torch.eye(5, dtype=torch.float64).expand(4, -1, -1)) < 1e-9
    for cluster in range(4):
        own = weights[model.labels == cluster]
        inner = own.mT @ own
        assert float((inner - inner.diagonal().diag()).abs().max()) < 1e-9 * float(inner.max())
        values = transfer.dense()[:, 0][model.labels == cluster]
        projected = torch.einsum(
            "ra,pri,li->pal", model.view_basis[0], values, model.light_bases[cluster]
        ).flatten(1)
        assert relative(projected.detach() @ dual[cluster].mT, own) < 1e-9
    identity = float(transfer.dense().square().sum() - weights.square().sum())
    assert squared_error(model, transfer) == pytest.approx(identity, rel=1e-9)
    assert model.statistics is not None
    assert model.statistics.squared_error == pytest.approx(identity, rel=1e-9)
    singular = torch.stack([weights[model.labels == c].square().sum(0).sqrt() for c in range(4)])
    assert model.condition == pytest.approx(float((singular[:, 0] / singular[:, -1]).max()))


def test_error_never_rises_over_turns():
    for seed in range(2):
        transfer = random_transfer(points=200, rows=5, coeffs=12, seed=seed)
        found = ClusteredTensor.from_transfer(
            transfer, num_clusters=24, ranks=(3, 3, 2), tolerance=0.0, max_turns=12
        ).statistics
        assert found is not None
        assert len(found.errors) > 6
        assert sum(found.moved) > 0
        for before, after in itertools.pairwise(found.errors):
            assert after <= before * (1 + 1e-12)
        assert found.squared_error <= found.errors[-1] * (1 + 1e-12)


def test_a_union_of_low_rank_clusters_is_recovered():
    groups = [low_rank(40, 5, 18, (3, 5, 4), seed=100 * g) for g in range(4)]
    order = torch.randperm(160, generator=torch.Generator().manual_seed(3))
    transfer = TransferTensor.from_dense(torch.cat(groups)[order])
    model = ClusteredTensor.from_transfer(transfer, num_clusters=4, ranks=(5, 4, 3), bits=None)
    assert relative(model.dense(), transfer.dense()) < 1e-9
    truth = torch.arange(4).repeat_interleave(40)[order]
    pairs = torch.stack([truth, model.labels]).unique(dim=1)
    assert pairs.shape[1] == 4


def test_larger_ranks_lose_less():
    transfer = in_groups()
    ranks = [(1, 2, 1), (2, 4, 3), (3, 6, 5), (6, 20, 12)]
    errors = [
        squared_error(ClusteredTensor.from_transfer(transfer, num_clusters=4, ranks=r), transfer)
        for r in ranks
    ]
    assert errors == sorted(errors, reverse=True)


def test_errors_are_those_of_the_metric():
    """A tensor that only differs in the space of its bases has the same error there."""
    basis = SphericalHarmonics(3)
    factor = torch.linalg.cholesky(torch.eye(9) * 0.1 + (lambda a: a @ a.mT)(normal(9, 9)).float())
    metric = Metric("given", factor.double())
    values = random_transfer(points=120, rows=1, coeffs=9).dense()
    options = {"num_clusters": 3, "ranks": (1, 4, 3), "bits": None}
    plain = ClusteredTensor.from_transfer(TransferTensor.from_dense(values), **options)
    unweighed = TransferTensor(metric.unweigh(values), Surface(light_basis=basis))
    weighed = ClusteredTensor.from_transfer(unweighed, metric=metric, **options)
    assert torch.equal(weighed.labels, plain.labels)
    assert relative(metric.weigh(weighed.dense()), plain.dense()) < 1e-8
    lost = float(metric.weigh(weighed.dense().detach() - unweighed.dense()).square().sum())
    assert weighed.statistics is not None
    assert weighed.statistics.squared_error == pytest.approx(lost, rel=1e-6)


class TestExtremes:
    def test_few_distinct_members(self):
        """15 members with 3 distinct values and rank 6: rank 3, the rest zero."""
        distinct = normal(3, 1, 4, 10)
        values = torch.cat([distinct.repeat(5, 1, 1, 1), 100 + normal(40, 1, 4, 10, seed=5)])
        points, labels = values[:, 0], torch.tensor([1] * 15 + [0] * 40)
        light = torch.eye(10, dtype=torch.float64).expand(2, -1, -1)
        found = decompose(Points(points), labels, light, 6)
        members = SortedPoints(Points(points), labels, 2)
        (_, weights), *_ = exact_weights(members, light, found.dual)
        assert int((found.singular[1] > 0).sum()) == 3
        assert float(found.dual[1, 3:].abs().max()) == float(weights[:15, 3:].abs().max()) == 0
        kept = found.dual[1, :3]
        assert relative(kept @ kept.mT, torch.eye(3, dtype=torch.float64)) < 1e-12
        transfer = TransferTensor.from_dense(distinct.repeat(5, 1, 1, 1))
        model = ClusteredTensor.from_transfer(transfer, num_clusters=1, ranks=(4, 10, 6), bits=None)
        assert model.budget["ranks"][2] == 3
        assert relative(model.dense(), transfer.dense()) < 1e-9

    @pytest.mark.parametrize("points", [1, 2, 9])
    def test_more_clusters_than_points(self, points):
        transfer = random_transfer(points=points, rows=3, coeffs=8)
        model = ClusteredTensor.from_transfer(transfer, ranks=(3, 8, 24), bits=None)
        assert model.num_clusters == points
        assert model.cores.shape[1] == 1
        assert relative(model.dense(), transfer.dense()) < 1e-9

    @pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-12, 1e12, 1e30])
    def test_any_scale(self, scale):
        values = random_transfer(points=90, rows=3, coeffs=8, dtype=torch.float32).dense()
        options = {"num_clusters": 4, "ranks": (2, 3, 2)}
        model = ClusteredTensor.from_transfer(TransferTensor.from_dense(values * scale), **options)
        plain = ClusteredTensor.from_transfer(TransferTensor.from_dense(values), **options)
        expected = plain.dense().detach() * scale
        assert bool(torch.isfinite(model.dense()).all())
        assert relative(model.dense(), expected) < 1e-3 or scale == 0.0

    def test_empty_clusters_begin_anew(self):
        """Half of the points are one and the same, so seeds fall together."""
        values = in_groups().dense().clone()
        values[::2] = values[0]
        transfer = TransferTensor.from_dense(values)
        model = ClusteredTensor.from_transfer(transfer, num_clusters=60, ranks=(2, 3, 2))
        assert int(torch.bincount(model.labels, minlength=model.num_clusters).min()) > 0
        assert bool(torch.isfinite(model.dense()).all())

    def test_nothing_is_lost_by_the_projection_that_is_not_told(self):
        transfer = in_groups()
        metric = Metric.l2(transfer)
        moments = read_moments(transfer, metric)
        found = project(
            transfer,
            metric,
            moments,
            allowed=0.01 * moments.squared_norm,
            least=(1, 1),
            memory_budget=2**30,
        )
        kept = found.points.squared_norm() / moments.squared_norm
        assert 0.9 < kept < 1.0
        assert 1 - kept <= found.lost * (1 + 1e-9)

    def test_not_finite(self):
        values = torch.ones(4, 1, 1, 3)
        values[2] = float("nan")
        with pytest.raises(ValueError, match="NaN or infinite"):
            ClusteredTensor.from_transfer(TransferTensor(values))

    def test_options_out_of_range(self, without_type_checker):
        transfer = random_transfer()
        wrong = [
            {"num_clusters": 0},
            {"ranks": (1, 1)},
            {"ranks": (1, 0, 1)},
            {"bits": 8},
            {"tolerance": 1.0},
            {"max_turns": 0},
        ]
        for options in wrong:
            with pytest.raises(ValueError, match="expected"):
                ClusteredTensor.from_transfer(transfer, **options)
        model = ClusteredTensor.from_transfer(transfer, num_clusters=2)
        with pytest.raises(ValueError, match="cannot be posed"):
            model(torch.zeros(1, 9, 3), torch.eye(3).expand(60, 3, 3))


@pytest.mark.parametrize(
    ("points", "clusters", "mebibytes"),
    [(41260, 110, 10.367), (52210, 140, 13.180), (61030, 170, 15.891)],
)
def test_bytes_are_those_of_the_paper(points, clusters, mebibytes):
    """Table 1, whose 16-bit labels are of one byte here; steps add less than 1 %."""
    labels = torch.arange(points) % clusters
    labels = labels.sort().values
    parameters = Parameters(
        view_basis=torch.ones(1, 16, 8),
        light_bases=torch.ones(clusters, 48, 642),
        cores=torch.ones(clusters, 24, 8, 48),
        weights=torch.ones(points, 24),
    )
    groups = torch.zeros(clusters, dtype=torch.long)
    encoding = Encoding(labels, groups, parameters, Steps.at_full_scale(parameters, labels), 1.0)
    sizes = {name: tensor.nbytes for name, tensor in pack(encoding).items()}
    steps = sum(size for name, size in sizes.items() if name.endswith("_steps"))
    codes = sum(sizes.values()) - steps
    formula = clusters * (642 * 48 + 24 * 8 * 48) + 16 * 8 + points * (24 + 1)
    assert codes + points == 2 * formula
    assert 2 * formula / 2**20 == pytest.approx(mebibytes, abs=5e-4)
    assert steps < 0.01 * codes


def test_codes_add_less_than_a_hundredth_of_the_error():
    transfer = in_groups()
    errors = [
        squared_error(
            ClusteredTensor.from_transfer(transfer, num_clusters=4, ranks=(6, 20, 30), bits=bits),
            transfer,
        )
        for bits in (16, None)
    ]
    assert errors[0] != errors[1]
    assert errors[0] == pytest.approx(errors[1], rel=1e-2)


def test_a_fit_improves_and_what_is_written_is_what_it_found(tmp_path):
    transfer = random_transfer(points=120, rows=3, coeffs=9, dtype=torch.float32)
    model = ClusteredTensor.from_transfer(transfer, num_clusters=6, ranks=(2, 3, 2), max_turns=1)
    before = float(squared_errors(model, transfer).sum())
    result = fit(model, transfer, max_steps=3)
    assert result.error_after < result.error_before
    assert float(squared_errors(model, transfer).sum()) < before
    trained = model.dense().detach()
    assert torch.equal(model.eval().dense(), trained)
    loaded = ClusteredTensor.from_packed(model.packed(), model.surface, model.shape)
    assert torch.equal(loaded.dense(), trained)


def test_more_axes_are_read_where_the_error_asks_for_them(monkeypatch):
    """Half of the energy leaves the ranks alone; the error of the first fit asks for more."""
    transfer = in_groups()
    options = {"num_clusters": 4, "ranks": (3, 4, 3), "bits": None}
    found = []
    for share in (0.5, 0.0):
        monkeypatch.setattr(clustered_tensor_encoding, "_FIRST_LOSS", share)
        found.append(ClusteredTensor.from_transfer(transfer, **options).statistics)
    assert found[1].axes == (6, 20)
    assert found[0].axes[1] > 10
    assert found[0].projection_lost * found[0].squared_norm < 2e-3 * found[0].squared_error
    assert found[0].squared_error == pytest.approx(found[1].squared_error, rel=0.05)


def test_view_axes_are_points_in_a_basis():
    points, view = normal(5, 4, 7), normal(4, 2)
    assert relative(in_view(points, view)[3], view.mT @ points[3]) < 1e-14
