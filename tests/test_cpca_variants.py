"""CPCA without means, with unequal ranks, moved points, and ranks chosen by a limit."""

import itertools
from typing import ClassVar

import numpy as np
import pytest
import torch
from contract import Contract, random_transfer, relative
from sklearn.decomposition import PCA, TruncatedSVD

from prt_torch.errors import InputError
from prt_torch.fitting import fit
from prt_torch.metric import Metric
from prt_torch.report.outcome import parameters_text
from prt_torch.representations import CPCA, load, save
from prt_torch.representations.cpca_adaptive import share_out
from prt_torch.representations.cpca_encoding import Encoding
from prt_torch.representations.cpca_relabel import ClusterErrors, with_labels
from prt_torch.representations.cpca_search import (
    Shape,
    StorageBytes,
    error_table,
    relative_error,
)
from prt_torch.transfer import TransferTensor


def smooth_transfer(points=1200, coeffs=30, *, dtype=torch.float64, seed=0) -> TransferTensor:
    """Points on a curved sheet of four dimensions, bent more in some places than in others."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    at = torch.rand(points, 4, generator=generator, dtype=torch.float64) ** 2
    waves = torch.sin(3.0 * at @ normal(4, 60) + normal(60)).clamp_min(0.0)
    decay = torch.arange(1, 61, dtype=torch.float64)[:, None] ** -0.8
    return TransferTensor.from_dense((waves @ (decay * normal(60, coeffs))).to(dtype))


def groups_of_several_dimensions(seed: int) -> TransferTensor:
    """Slightly bent groups of 1 to 6 dimensions with a little noise."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    groups = [
        normal(25) + torch.tanh(0.4 * normal(250, dimension) @ normal(dimension, 25))
        for dimension in range(1, 7)
    ]
    return TransferTensor.from_dense(torch.cat(groups) + 0.01 * normal(1500, 25))


def ragged(transfer: TransferTensor, num_clusters=6, **options) -> CPCA:
    """Every cluster cut to another rank, down to 0."""
    model = CPCA.from_transfer(transfer, num_clusters=num_clusters, rank=4, **options)
    ranks = torch.arange(model.num_clusters) * 3 % 5
    used = torch.arange(4) < ranks[:, None]
    own = model.layout.by_cluster(model.representatives.detach()).flatten(2)
    kept = torch.cat([torch.ones(len(ranks), int(model.affine)).bool(), used], dim=1)
    weights = model.layout.by_point(model.weights.detach())[used[model.labels]]
    cut = Encoding(model.labels, ranks, own[kept], weights, model.affine, model.condition)
    return CPCA(cut, model.surface, model.shape)


def error_of(model: CPCA, transfer: TransferTensor) -> float:
    return relative_error(model, transfer, Metric.l2(transfer))


def num_bytes(model: CPCA) -> int:
    return sum(model.storage().values())


class _Variant(Contract):
    options: ClassVar[dict]

    def make(self, transfer):
        return CPCA.from_transfer(transfer, num_clusters=5, rank=2, **self.options)

    def make_lossless(self, transfer):
        size = transfer.num_channels * transfer.num_rows * transfer.num_coeffs
        return CPCA.from_transfer(transfer, num_clusters=3, rank=size, **self.options)


class TestStatic(_Variant):
    options: ClassVar[dict] = {"method": "static"}


class TestAdaptive(_Variant):
    options: ClassVar[dict] = {"method": "adaptive"}


class TestLinear(_Variant):
    options: ClassVar[dict] = {"affine": False}


class TestAdaptiveLinear(_Variant):
    options: ClassVar[dict] = {"method": "adaptive", "affine": False}


class TestRagged(_Variant):
    options: ClassVar[dict] = {}

    def make(self, transfer):
        return ragged(transfer)


class TestRaggedLinear(_Variant):
    options: ClassVar[dict] = {"affine": False}

    def make(self, transfer):
        return ragged(transfer, affine=False)


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))]
)
def test_errors_fall_from_method_to_method_at_equal_storage(seed):
    transfer = groups_of_several_dimensions(seed)
    models = [
        CPCA.from_transfer(transfer, num_clusters=12, rank=3, method=method)
        for method in ("static", "iterative", "adaptive")
    ]
    assert num_bytes(models[0]) == num_bytes(models[1]) >= num_bytes(models[2])
    static, iterative, adaptive = (error_of(model, transfer) for model in models)
    assert static > iterative > 1.5 * adaptive


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_vectors_beat_more_clusters_without_any_at_equal_storage(seed):
    transfer = groups_of_several_dimensions(seed)
    model = CPCA.from_transfer(transfer, num_clusters=12, rank=5, method="static")
    label_bytes, value_bytes = 2, 8
    spare = num_bytes(model) - label_bytes * transfer.num_points - 12  # 12 of reflectance
    quantised = CPCA.from_transfer(transfer, num_clusters=spare // (value_bytes * 25), rank=0)
    assert 0.95 * num_bytes(model) < num_bytes(quantised) <= num_bytes(model)
    assert error_of(quantised, transfer) > 1.5 * error_of(model, transfer)


@pytest.mark.parametrize("affine", [True, False])
@pytest.mark.parametrize(
    ("clusters", "rank"),
    [
        (1, 2),
        (7, 1),
        (16, 0),
        *(pytest.param(*size, marks=pytest.mark.slow) for size in [(7, 4), (40, 2)]),
    ],
)
def test_adaptive_is_never_larger_nor_worse(affine, clusters, rank):
    rank = rank if affine else max(rank, 1)
    for dtype in (torch.float32, torch.float64):
        transfer = smooth_transfer(points=500, dtype=dtype, seed=4)
        equal, unequal = (
            CPCA.from_transfer(
                transfer, num_clusters=clusters, rank=rank, method=method, affine=affine
            )
            for method in ("iterative", "adaptive")
        )
        assert num_bytes(unequal) <= num_bytes(equal)
        assert error_of(unequal, transfer) <= error_of(equal, transfer) * (1 + 1e-6)
        assert unequal.layout.num_weights == int(unequal.ranks[unequal.labels].sum())


def every_share(squares, sizes, numbers, budget):
    """Least error over all ways to choose ranks, one by one."""
    best, total = np.inf, float(squares.sum())
    for ranks in itertools.product(range(squares.shape[1] + 1), repeat=len(squares)):
        cost = sum(
            rank * (size + numbers) for rank, size in zip(ranks, sizes.tolist(), strict=True)
        )
        if cost <= budget:
            kept = sum(float(row[:rank].sum()) for row, rank in zip(squares, ranks, strict=True))
            best = min(best, total - kept)
    return best


@pytest.mark.parametrize("seed", range(6))
def test_shares_against_every_choice_of_ranks(seed):
    """Exact where all vectors cost the same, else within the one vector that did not fit."""
    generator = torch.Generator().manual_seed(seed)
    squares = torch.rand(4, 4, generator=generator, dtype=torch.float64).sort(1, True).values
    for sizes, exact in [(torch.full((4,), 9), True), (torch.tensor([20, 12, 5, 2]), False)]:
        for budget in (0, 13, 40, 90, 150, 1000):
            ranks = share_out(squares, sizes, 5, budget).ranks
            assert int((ranks * (sizes + 5)).sum()) <= budget
            used = torch.arange(4) < ranks[:, None]
            error = float((squares * ~used).sum())
            least = every_share(squares, sizes, 5, budget)
            if exact:
                assert error == pytest.approx(least, abs=1e-12)
            else:
                assert least - 1e-12 <= error <= least + float(squares.max())


def test_adaptive_keeps_clusters_flat_where_the_data_is_flat():
    """A line, a plane and a 6-dimensional blob: ranks go where the dimensions are."""
    generator = torch.Generator().manual_seed(3)
    blobs, offsets = [], 100.0 * torch.eye(20, dtype=torch.float64)[:3]
    for offset, dimension in zip(offsets, (1, 2, 6), strict=True):
        spread = torch.randn(100, dimension, generator=generator, dtype=torch.float64)
        axes = torch.randn(dimension, 20, generator=generator, dtype=torch.float64)
        blobs.append(offset + spread @ axes)
    transfer = TransferTensor.from_dense(torch.cat(blobs))
    model = CPCA.from_transfer(transfer, num_clusters=3, rank=4, method="adaptive")
    by_blob = [int(model.ranks[model.labels[100 * blob]]) for blob in range(3)]
    assert by_blob[0] < by_blob[2]
    assert by_blob[1] < by_blob[2] == 6
    assert error_of(model, transfer) < 1e-20
    assert error_of(CPCA.from_transfer(transfer, num_clusters=3, rank=4), transfer) > 1e-6


def test_one_linear_cluster_is_the_uncentred_decomposition():
    transfer = random_transfer(points=200, coeffs=16)
    data = transfer.dense().flatten(1).numpy()
    for rank in (1, 4, 9):
        model = CPCA.from_transfer(transfer, num_clusters=1, rank=rank, affine=False)
        other = TruncatedSVD(rank, algorithm="arpack", random_state=0)
        expected = other.inverse_transform(other.fit_transform(data))
        assert relative(model.dense().flatten(1), torch.from_numpy(expected)) < 1e-9


def test_linear_clusters_are_lines_through_the_origin():
    generator = torch.Generator().manual_seed(0)
    lines = torch.randn(4, 12, generator=generator, dtype=torch.float64)
    lengths = torch.rand(300, 1, generator=generator, dtype=torch.float64) + 0.1
    which = torch.randint(4, (300,), generator=generator)
    transfer = TransferTensor.from_dense(lengths * lines[which])
    model = CPCA.from_transfer(transfer, num_clusters=4, rank=1, affine=False)
    assert error_of(model, transfer) < 1e-24
    doubled = TransferTensor.from_dense(-2.0 * transfer.dense())
    again = CPCA.from_transfer(doubled, num_clusters=4, rank=1, affine=False)
    assert relative(again.dense(), -2.0 * model.dense()) < 1e-12


@pytest.mark.parametrize("method", ["static", "adaptive"])
def test_clusters_by_scikit_learn(method):
    """Each cluster's subspace is scikit-learn's of its points at its own rank."""
    transfer = smooth_transfer(points=400)
    model = CPCA.from_transfer(transfer, num_clusters=5, rank=3, method=method)
    data, dense = transfer.dense().flatten(1), model.dense().detach().flatten(1)
    for cluster, rank in enumerate(model.ranks.tolist()):
        own = model.labels == cluster
        if rank == 0:
            expected = data[own].mean(0).expand(int(own.sum()), -1)
        else:
            pca = PCA(rank).fit(data[own].numpy())
            projected = pca.inverse_transform(pca.transform(data[own].numpy()))
            expected = torch.from_numpy(projected)
        assert relative(dense[own], expected) < 1e-9


def stiff_points() -> torch.Tensor:
    """Singular values from 1 down to 1e-9."""
    generator = torch.Generator().manual_seed(1)
    left = torch.randn(80, 10, generator=generator, dtype=torch.float64)
    right = torch.randn(10, 10, generator=generator, dtype=torch.float64)
    values = torch.logspace(0, -9, 10, dtype=torch.float64)
    return torch.linalg.qr(left)[0] @ torch.diag(values) @ torch.linalg.qr(right)[0]


EXTREMES = {
    "zero": torch.zeros(30, 9),
    "identical": torch.full((30, 9), 0.7),
    "one point": torch.arange(9.0)[None],
    "one value": torch.arange(30.0)[:, None],
    "two points, many times": torch.eye(9)[:2].repeat(20, 1),
    "constant columns": torch.cat([torch.ones(30, 5), torch.arange(30.0)[:, None]], dim=1),
    "stiff": stiff_points(),
    "zero but one": torch.nn.functional.one_hot(torch.tensor([3] + 29 * [0]), 4).float() * 1e3,
}
VARIANTS = [
    {"method": method, "affine": affine}
    for method in ("static", "iterative", "adaptive")
    for affine in (True, False)
]


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: f"{v['method']}-{v['affine']}")
@pytest.mark.parametrize("name", EXTREMES)
def test_extremes(name, variant):
    transfer = TransferTensor.from_dense(EXTREMES[name])
    size = transfer.num_coeffs
    for clusters, rank in [(1, 1), (4, 2), (12, size), (200, 3)]:
        model = CPCA.from_transfer(transfer, num_clusters=clusters, rank=rank, **variant)
        assert all(torch.isfinite(p).all() for p in model.parameters())
        assert int(torch.bincount(model.labels, minlength=model.num_clusters).min()) > 0
        error = error_of(model, transfer)
        assert 0.0 <= error <= 1.0
        if name in ("zero", "identical", "one point") or rank >= size:
            assert error < 1e-12


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: f"{v['method']}-{v['affine']}")
def test_scale_changes_nothing_but_the_scale(variant):
    transfer = random_transfer(points=150, coeffs=9, dtype=torch.float32)
    errors = []
    for scale in (1.0, 1e-6, 1e6):
        scaled = TransferTensor.from_dense(transfer.dense() * scale)
        model = CPCA.from_transfer(scaled, num_clusters=6, rank=2, **variant)
        errors.append(error_of(model, scaled))
    assert errors[1:] == pytest.approx(2 * errors[:1], rel=0.05)


@pytest.mark.parametrize("affine", [True, False])
def test_small_singular_values_survive(affine):
    """At rank 9 of 10 only the last value of 1e-9 is lost: no squares of the data."""
    transfer = TransferTensor.from_dense(stiff_points())
    for method in ("static", "adaptive"):
        model = CPCA.from_transfer(transfer, num_clusters=1, rank=9, affine=affine, method=method)
        lost = (model.dense().detach() - transfer.dense()).norm()
        assert 2e-10 < float(lost) < 1.1e-9


def test_evaluating_and_differentiating_agree_with_unequal_ranks():
    transfer = smooth_transfer(points=400)
    for affine in (True, False):
        model = ragged(transfer, affine=affine)
        light = torch.randn(3, transfer.num_coeffs, 3, dtype=torch.float64)
        with torch.no_grad():
            gathered = model(light)
        assert relative(gathered, model(light)) < 1e-13
        points = torch.tensor([399, 0, 7, 7])
        assert relative(model.dense(points), model.dense()[points]) < 1e-14


def test_refinement_of_unequal_ranks_helps_and_is_never_worse():
    transfer = smooth_transfer(points=300)
    lights = torch.randn(3, transfer.num_coeffs, 3, dtype=torch.float64)
    weighed = Metric("light_prior", torch.diag(lights.square().sum((0, 2)).sqrt()))
    model = ragged(transfer)
    result = fit(model, transfer, metric=weighed, max_steps=3)
    assert result.error_after < 0.999 * result.error_before
    best = ragged(transfer)
    assert fit(best, transfer, max_steps=2).error_after <= fit(best, transfer).error_before


def test_ranks_take_one_byte_a_cluster_and_budgets_say_what_was_made(tmp_path):
    transfer = smooth_transfer(points=300)
    model = ragged(transfer)
    assert model.packed()["ranks"].dtype == torch.uint8
    low, high = int(model.ranks.min()), int(model.ranks.max())
    assert model.budget == {
        "num_clusters": 6,
        "rank": round(len(model.weights) / 300, 2),
        "adaptive": f"{low} to {high}",
    }
    linear = CPCA.from_transfer(transfer, num_clusters=3, rank=1, affine=False)
    assert parameters_text(linear.budget) == "num_clusters 3, rank 1, linear True"
    for one in (model, linear):
        save(one, tmp_path / "model")
        loaded = load(tmp_path / "model")
        assert loaded.budget == one.budget
        assert loaded.affine == one.affine


def disturbed(model: CPCA) -> CPCA:
    """Vectors mixed until they nearly depend on each other, as a refinement may leave them."""
    generator = torch.Generator().manual_seed(9)
    with torch.no_grad():
        starts = (model.ranks + int(model.affine)).cumsum(0) - model.ranks
        for start, rank in zip(starts.tolist(), model.ranks.tolist(), strict=True):
            own = model.representatives[start : start + rank]
            mixture = torch.eye(rank, dtype=own.dtype)
            mixture += 1e4 * torch.rand(rank, 1, generator=generator, dtype=own.dtype)
            own.copy_(torch.einsum("ij,jcrn->icrn", mixture, own.clone()))
    return model


@pytest.mark.parametrize("affine", [True, False])
@pytest.mark.parametrize("stiff", [False, True])
def test_errors_in_other_clusters_are_those_of_least_squares(affine, stiff):
    transfer = smooth_transfer(points=120)
    model = ragged(transfer, affine=affine)
    model = disturbed(model) if stiff else model
    generator = torch.Generator().manual_seed(0)
    points = torch.randint(120, (200,), generator=generator)
    clusters = torch.randint(model.num_clusters, (200,), generator=generator)
    found = ClusterErrors(model, transfer)(points, clusters)
    own = model.layout.by_cluster(model.representatives.detach()).flatten(2).numpy()
    data = transfer.dense().flatten(1).numpy()
    for point, cluster, error in zip(points.tolist(), clusters.tolist(), found, strict=True):
        rank = int(model.ranks[cluster])
        mean = own[cluster, 0] if affine else 0.0
        vectors = own[cluster, int(affine) : int(affine) + rank]
        target = data[point] - mean
        weights = np.linalg.lstsq(vectors.T, target, rcond=None)[0]
        expected = ((weights @ vectors - target) ** 2).sum()
        assert float(error) == pytest.approx(expected, rel=1e-6, abs=1e-18)


def test_same_labels_change_nothing_and_others_do_as_foretold():
    transfer = smooth_transfer(points=200)
    for affine in (True, False):
        model = ragged(transfer, affine=affine)
        same = with_labels(model, transfer, model.labels)
        assert torch.equal(same.labels, model.labels)
        assert relative(same.dense(), model.dense()) < 1e-12
        labels = (model.labels + torch.arange(200) % 2) % model.num_clusters
        moved = with_labels(disturbed(model), transfer, labels)
        foretold = ClusterErrors(model, transfer)(torch.arange(200), labels)
        lost = (moved.dense().detach() - transfer.dense()).square().sum((1, 2, 3))
        assert torch.allclose(lost, foretold, rtol=1e-6, atol=1e-12 * float(foretold.max()))


def test_clusters_without_points_are_left_out():
    transfer = smooth_transfer(points=100)
    model = ragged(transfer)
    alone = with_labels(model, transfer, torch.full((100,), 4))
    assert alone.num_clusters == 1
    assert int(alone.ranks[0]) == int(model.ranks[4])
    assert num_bytes(alone) < num_bytes(model)


def test_labels_and_points_out_of_range_are_refused():
    transfer = smooth_transfer(points=20)
    model = CPCA.from_transfer(transfer, num_clusters=3, rank=1)
    with pytest.raises(ValueError, match="clusters from 0 to 2"):
        ClusterErrors(model, transfer)(torch.tensor([0]), torch.tensor([3]))
    with pytest.raises(ValueError, match="points from 0 to 19"):
        ClusterErrors(model, transfer)(torch.tensor([20]), torch.tensor([0]))
    with pytest.raises(ValueError, match="20 labels"):
        with_labels(model, transfer, torch.zeros(19, dtype=torch.int64))


def test_the_table_of_one_cluster_is_pca_and_others_are_near_static_encodings():
    transfer = smooth_transfer(points=600)
    table = error_table(transfer, Metric.l2(transfer), torch.Generator().manual_seed(0))
    for rank in (0, 1, 5, 20):
        exact = error_of(CPCA.from_transfer(transfer, num_clusters=1, rank=rank), transfer)
        assert table[Shape(1, rank)] == pytest.approx(exact, rel=1e-6)
        static = CPCA.from_transfer(transfer, num_clusters=16, rank=rank, method="static")
        assert 0.4 < table[Shape(16, rank)] / error_of(static, transfer) < 2.5
        assert StorageBytes(transfer)(Shape(16, rank)) == num_bytes(static)


@pytest.mark.parametrize("method", ["static", "iterative", "adaptive"])
def test_the_least_error_within_bytes(method):
    transfer = smooth_transfer(points=600, dtype=torch.float32)
    limit = transfer.num_bytes // 4
    found = CPCA.within(transfer, max_bytes=limit, method=method)
    assert num_bytes(found) <= limit
    tried = 0
    for clusters, rank in [(1, 6), (4, 5), (16, 3), (48, 1), (128, 0)]:
        other = CPCA.from_transfer(transfer, num_clusters=clusters, rank=rank, method=method)
        if num_bytes(other) <= limit:
            tried += 1
            assert error_of(found, transfer) <= 1.1 * error_of(other, transfer)
    assert tried == 5


@pytest.mark.parametrize(
    "max_error", [0.3, 1e-2, *(pytest.param(e, marks=pytest.mark.slow) for e in (1e-3, 1e-8))]
)
def test_the_fewest_bytes_within_an_error(max_error):
    transfer = smooth_transfer(points=600)
    found = CPCA.within(transfer, max_error=max_error)
    assert error_of(found, transfer) <= max_error
    for clusters, rank in itertools.product((1, 4, 16, 64), (0, 1, 2, 4, 8)):
        if StorageBytes(transfer)(Shape(clusters, rank)) < 0.8 * num_bytes(found):
            other = CPCA.from_transfer(transfer, num_clusters=clusters, rank=rank)
            assert error_of(other, transfer) > max_error


def test_encodings_of_a_search_are_few(monkeypatch):
    transfer, made, build = smooth_transfer(points=300), [], CPCA.from_transfer

    def counted(*args, **options):
        made.append(options)
        return build(*args, **options)

    monkeypatch.setattr(CPCA, "from_transfer", counted)
    for limit in ({"max_error": 1e-3}, {"max_bytes": 30_000}):
        made.clear()
        CPCA.within(transfer, **limit)
        assert 1 <= len(made) <= 4


def test_the_least_error_within_a_time():
    transfer = smooth_transfer(points=300)
    rich = CPCA.within(transfer, max_relight_seconds=60.0)
    assert num_bytes(rich) <= 1.01 * transfer.num_bytes
    assert error_of(rich, transfer) < 1e-3
    with pytest.raises(InputError, match="max_relight_seconds 0: the fastest"):
        CPCA.within(transfer, max_relight_seconds=0.0)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({}, "exactly one of"),
        ({"max_bytes": 10**6, "max_error": 0.1}, "exactly one of"),
        ({"max_bytes": 10}, "max_bytes 10: the smallest encoding takes"),
        ({"max_error": 0.0}, "max_error 0: the least error found is"),
        ({"max_error": -1.0}, "at least 0"),
        ({"max_error": float("nan")}, "at least 0"),
    ],
)
def test_limits_that_cannot_be_kept(limits, message):
    with pytest.raises(ValueError, match=message) as raised:
        CPCA.within(smooth_transfer(points=50), **limits)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("values", [torch.zeros(20, 9), torch.ones(1, 4)])
def test_searches_of_trivial_transfer(values):
    transfer = TransferTensor.from_dense(values)
    for limit in ({"max_error": 0.0}, {"max_bytes": 10**4}, {"max_relight_seconds": 60.0}):
        assert error_of(CPCA.within(transfer, **limit), transfer) == 0.0


def test_linear_clusters_without_any_vector_are_zero():
    transfer = TransferTensor.from_dense(torch.zeros(12, 4))
    model = ragged(transfer, affine=False)
    assert model.rank == 0
    assert len(model.representatives) == 0
    with torch.no_grad():
        assert torch.equal(model(torch.ones(2, 4, 3)), torch.zeros(2, 12, 1, 3))
    assert torch.equal(model.dense(), transfer.dense())


def test_linear_needs_a_vector():
    with pytest.raises(ValueError, match="rank of at least 1"):
        CPCA.from_transfer(random_transfer(), rank=0, affine=False)
