"""CPCA: the contract, scikit-learn as a second implementation, and the paper's extremes."""

import numpy as np
import pytest
import torch
from contract import Contract, random_transfer, relative
from sklearn.decomposition import PCA

from prt_torch.representations import CPCA
from prt_torch.representations.cpca_subspaces import principal
from prt_torch.representations.grouped import ClusterBlocks, sort_labels
from prt_torch.transfer import TransferTensor


class TestCPCA(Contract):
    def make(self, transfer):
        return CPCA.from_transfer(transfer, num_clusters=5, rank=2)

    def make_lossless(self, transfer):
        size = transfer.num_channels * transfer.num_rows * transfer.num_coeffs
        return CPCA.from_transfer(transfer, num_clusters=3, rank=size)


def squared_error(model: CPCA, transfer: TransferTensor) -> float:
    with torch.no_grad():
        return float((model.dense() - transfer.dense()).square().sum())


def test_one_cluster_is_pca():
    transfer = random_transfer(points=200, coeffs=16)
    data = transfer.dense().flatten(1).numpy()
    for rank in (0, 1, 4, 9):
        model = CPCA.from_transfer(transfer, num_clusters=1, rank=rank)
        if rank == 0:
            expected = ((data - data.mean(0)) ** 2).sum()
        else:
            pca = PCA(rank).fit(data)
            expected = ((pca.inverse_transform(pca.transform(data)) - data) ** 2).sum()
        assert squared_error(model, transfer) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("method", ["static", "iterative"])
def test_each_cluster_holds_its_best_affine_subspace(method):
    """Error of a cluster = sum|x-x0|² - sum of its largest squared singular values (4.1)."""
    transfer = random_transfer(points=300, coeffs=12)
    model = CPCA.from_transfer(transfer, num_clusters=6, rank=3, method=method)
    data = transfer.dense().flatten(1)
    lost = (model.dense().detach().flatten(1) - data).square().sum(1)
    for cluster in range(model.num_clusters):
        members = data[model.labels == cluster]
        singular = np.linalg.svd((members - members.mean(0)).numpy(), compute_uv=False)
        own = float(lost[model.labels == cluster].sum())
        assert own == pytest.approx((singular[3:] ** 2).sum(), rel=1e-9, abs=1e-12)


def test_iterative_beats_static_beats_vector_quantisation():
    transfer = random_transfer(points=2000, coeffs=25, seed=3)
    errors = [
        squared_error(CPCA.from_transfer(transfer, num_clusters=8, rank=r, method=m), transfer)
        for r, m in [(0, "static"), (2, "static"), (2, "iterative")]
    ]
    assert errors[0] > errors[1] > errors[2]


def test_error_falls_with_rank_and_with_clusters():
    transfer = random_transfer(points=600, coeffs=25, seed=4)
    by_rank = [
        squared_error(CPCA.from_transfer(transfer, num_clusters=8, rank=r), transfer)
        for r in range(5)
    ]
    by_clusters = [
        squared_error(CPCA.from_transfer(transfer, num_clusters=k, rank=2), transfer)
        for k in (1, 4, 16, 64)
    ]
    assert by_rank == sorted(by_rank, reverse=True)
    assert by_clusters == sorted(by_clusters, reverse=True)


def test_evaluating_and_differentiating_forward_agree():
    """The gathering path without gradients against the grouped one with them."""
    for dtype, limit in [(torch.float32, 2e-6), (torch.float64, 1e-14)]:
        transfer = random_transfer(points=500, rows=2, coeffs=16, dtype=dtype)
        model = CPCA.from_transfer(transfer, num_clusters=7, rank=3)
        light = torch.randn(3, 16, 3, dtype=dtype)
        with torch.no_grad():
            gathered = model(light)
        assert model(light).requires_grad
        assert relative(gathered, model(light)) < limit


def test_more_clusters_than_distinct_points():
    generator = torch.Generator().manual_seed(0)
    distinct = torch.randn(3, 20, generator=generator)
    data = distinct[torch.randint(3, (100,), generator=generator)]
    transfer = TransferTensor.from_dense(data)
    model = CPCA.from_transfer(transfer, num_clusters=8, rank=2)
    assert model.num_clusters == 3
    assert squared_error(model, transfer) < 1e-10
    assert float(model.weights.detach().abs().max()) < 1e-6


def test_rank_above_what_a_cluster_holds_gives_zero_vectors():
    transfer = random_transfer(points=10, coeffs=9)
    model = CPCA.from_transfer(transfer, num_clusters=4, rank=9)
    assert relative(model.dense(), transfer.dense()) < 1e-12
    assert model.rank == 9
    assert torch.isfinite(model.representatives).all()


def test_one_point_and_one_value():
    for shape in [(1, 9), (1, 1), (5, 1)]:
        transfer = TransferTensor.from_dense(torch.ones(shape))
        model = CPCA.from_transfer(transfer, num_clusters=4, rank=2)
        assert relative(model.dense(), transfer.dense()) == 0.0


@pytest.mark.parametrize("scale", [1e-18, 1e-6, 1e6, 1e15])
def test_scale_changes_nothing_but_the_scale(scale):
    transfer = random_transfer(points=200, coeffs=9, dtype=torch.float32)
    scaled = TransferTensor.from_dense(transfer.dense() * scale)
    model = CPCA.from_transfer(transfer, num_clusters=6, rank=2)
    again = CPCA.from_transfer(scaled, num_clusters=6, rank=2)
    error = squared_error(model, transfer) / float(transfer.dense().square().sum())
    difference = again.dense().detach().double() - scaled.dense().double()
    again_error = float(difference.square().sum() / scaled.dense().double().square().sum())
    assert again_error == pytest.approx(error, rel=0.05)


@pytest.mark.parametrize("condition", [1e2, 1e5, 1e8, 1e11, 1e14])
def test_singular_values_of_stiff_clusters(condition):
    """Against float64 QR and SVD; a Gram matrix alone loses all below 1e-8 of the largest."""
    generator = torch.Generator().manual_seed(1)
    left = torch.linalg.qr(torch.randn(40, 12, generator=generator, dtype=torch.float64))[0]
    right = torch.linalg.qr(torch.randn(12, 12, generator=generator, dtype=torch.float64))[0]
    values = torch.logspace(0, -np.log10(condition), 12, dtype=torch.float64)
    rows = left @ torch.diag(values) @ right.mT
    singular, vectors = principal(rows[None], 12)
    trusted = values > 1e-13  # of what float64 can hold of the matrix itself
    error = (singular[0] - values).abs() / values
    limit = 1e-9 if condition <= 1e5 else 1e-16 * condition * 50
    assert float(error[trusted].max()) < max(limit, 1e-9)
    kept = vectors[0][singular[0] > 0]
    assert relative(kept @ kept.mT, torch.eye(len(kept), dtype=torch.float64)) < 1e-9


def test_principal_vectors_hold_equal_points_to_rounding():
    """LAPACK's right singular vectors lose up to 32 roundings of these points."""
    worst = 0.0
    for seed in range(80):
        generator = torch.Generator().manual_seed(seed)
        distinct = torch.randn(2, 36, generator=generator, dtype=torch.float64)
        others = torch.randn(36, 4, generator=generator, dtype=torch.float64)
        axes = torch.linalg.qr(torch.cat([distinct.mT, others], dim=1))[0]
        rows = (distinct @ axes)[torch.arange(9) % 2]
        vectors = principal(rows[None], 6)[1][0]
        worst = max(worst, relative(rows @ vectors.mT @ vectors, rows))
    assert worst < 8 * torch.finfo(torch.float64).eps


def test_grouped_products_are_those_of_a_loop():
    generator = torch.Generator().manual_seed(2)
    labels = torch.randint(7, (90,), generator=generator)
    labels[labels == 6] = 0  # one cluster left empty
    labels, _ = sort_labels(labels, 7)
    blocks = ClusterBlocks(labels, 7)
    points = torch.randn(90, 4, generator=generator, dtype=torch.float64)
    matrices = torch.randn(7, 4, 5, generator=generator, dtype=torch.float64)
    offsets = torch.randn(7, 5, generator=generator, dtype=torch.float64)
    slots = blocks.to_slots(points)
    assert torch.equal(blocks.to_points(slots), points)
    product = blocks.to_points(blocks.matmul(slots, matrices, offsets=offsets))
    looped = torch.stack(
        [p @ matrices[k] + offsets[k] for p, k in zip(points, labels, strict=True)]
    )
    assert relative(product, looped) < 1e-14
    moments = blocks.transposed_matmul(slots, slots)
    for cluster in range(7):
        own = points[labels == cluster]
        assert torch.allclose(moments[cluster], own.mT @ own, rtol=1e-13, atol=1e-14)


def test_wide_points_are_projected_without_losing_the_fit():
    """More values than the projection keeps: the same error as without it, within 1 %."""
    generator = torch.Generator().manual_seed(5)
    data = torch.randn(500, 20, generator=generator) @ torch.randn(20, 700, generator=generator)
    data += 0.01 * torch.randn(500, 700, generator=generator)
    transfer = TransferTensor.from_dense(data)
    model = CPCA.from_transfer(transfer, num_clusters=1, rank=20)
    singular = np.linalg.svd((data - data.mean(0)).double().numpy(), compute_uv=False)
    assert squared_error(model, transfer) == pytest.approx((singular[20:] ** 2).sum(), rel=0.01)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_clusters": 0}, "at least 1 cluster"),
        ({"num_clusters": -3}, "at least 1 cluster"),
        ({"rank": -1}, "rank of at least 0"),
        ({"method": "magic"}, "iterative, static or adaptive"),
    ],
)
def test_bad_budgets(options, message, without_type_checker):
    with pytest.raises(ValueError, match=message):
        CPCA.from_transfer(random_transfer(), **options)
