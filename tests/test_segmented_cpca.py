"""Segmented CPCA: the contract, plain loops as second implementations, the paper's extremes."""

import numpy as np
import pytest
import torch
from contract import Contract, contract_by_dense, random_transfer, relative
from tolerances import ROUNDING

from prt_torch.bases import Haar, SphericalHarmonics
from prt_torch.evaluate import squared_errors
from prt_torch.fitting import fit
from prt_torch.metric import Metric
from prt_torch.representations import DenseTransfer, SegmentedCPCA, segmented_encoding
from prt_torch.representations.segmented_coding import SparseColumns, decode_columns, encode_columns
from prt_torch.representations.segmented_encoding import segment_metric
from prt_torch.transfer import TransferTensor


class TestSegmentedCPCA(Contract):
    def make(self, transfer):
        segments = 2 if transfer.num_coeffs % 2 == 0 else 1
        segments = 3 if transfer.num_coeffs % 3 == 0 else segments
        # eval(): rounding has no derivative, so gradients are checked of the values as they are.
        return SegmentedCPCA.from_transfer(
            transfer, num_segments=segments, points_per_cluster=15, rank=2
        ).eval()

    def make_lossless(self, transfer):
        return SegmentedCPCA.from_transfer(transfer, num_segments=3, points_per_cluster=1)

    def test_lossless_budget_recovers_the_tensor(self):
        """To half a step of 16 bits: values of a segment are integers times its step."""
        transfer = random_transfer(rows=2)
        model = self.make_lossless(transfer)
        values = transfer.dense().unflatten(-1, (3, -1))
        steps = values.abs().amax((0, 1, 2, 4)) / (2**15 - 1)
        lost = (model.dense().detach().unflatten(-1, (3, -1)) - values).abs().amax((0, 1, 2, 4))
        assert bool((lost <= 0.5001 * steps).all())
        assert torch.allclose(model.representative_steps, steps)


def squared_error(model: SegmentedCPCA, transfer: TransferTensor) -> float:
    with torch.no_grad():
        return float((model.dense() - transfer.dense()).double().square().sum())


def shadowed(points: int = 200, rows: int = 1, dtype: torch.dtype = torch.float32):
    """Transfer in six segments of 16 Haar coefficients; a third of the points miss each."""
    basis = Haar(4, 4)
    transfer = random_transfer(points=points, rows=rows, coeffs=96, dtype=dtype)
    values = transfer.dense().clone().unflatten(-1, (6, 16))
    generator = torch.Generator().manual_seed(7)
    values[
        torch.rand(points, 6, generator=generator)[:, None, None, :].expand(-1, 1, rows, -1) < 1 / 3
    ] = 0.0
    return TransferTensor.from_dense(values.flatten(-2), light_basis=basis)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("channels", "rows"), [(1, 1), (1, 3), (3, 2)])
def test_evaluation_at_rest_is_the_contraction_of_dense(dtype, channels, rows):
    """The gathering path, which takes no gradients, with culled, raw and clustered points."""
    transfer = random_transfer(points=200, channels=channels, rows=rows, coeffs=24, dtype=dtype)
    values = transfer.dense().clone()
    values[:50, ..., :8] = 0.0
    values[:, ..., 8:16] *= torch.rand(200, 1, 1, 1, dtype=dtype).round()
    transfer = TransferTensor.from_dense(values)
    model = SegmentedCPCA.from_transfer(transfer, num_segments=3, points_per_cluster=8, rank=5)
    assert set(model.labels.flatten().clamp_max(2).tolist()) == {0, 1, 2}
    light = torch.randn(3, 24, 3, dtype=dtype)
    with torch.no_grad():
        gathered = model(light)
        expected = contract_by_dense(model.dense(), light)
    assert relative(gathered, expected) < ROUNDING[dtype]
    assert relative(model(light), expected) < ROUNDING[dtype]


def test_one_cluster_is_the_singular_value_decomposition():
    """Without a mean: the best subspace through the origin."""
    transfer = random_transfer(points=200, coeffs=32)
    data = transfer.dense().flatten(1)
    for rank in (1, 4, 9):
        model = SegmentedCPCA.from_transfer(
            transfer, points_per_cluster=200, rank=rank, quantisation_share=1e-4
        )
        left = float(torch.linalg.svdvals(data)[rank:].square().sum())
        assert model.statistics[0].cpca_squared_error == pytest.approx(left, rel=1e-9)
        assert squared_error(model, transfer) == pytest.approx(left, rel=2e-4)


def test_large_clusters_are_iterated_for_without_losing_the_fit():
    transfer = random_transfer(points=900, coeffs=128)
    model = SegmentedCPCA.from_transfer(transfer, points_per_cluster=900, rank=6)
    left = float(torch.linalg.svdvals(transfer.dense().flatten(1))[6:].square().sum())
    assert model.statistics[0].cpca_squared_error == pytest.approx(left, rel=1e-3)


def test_segments_are_those_of_the_light_basis_and_errors_those_of_the_metric():
    transfer = shadowed(rows=2)
    model = SegmentedCPCA.from_transfer(transfer, points_per_cluster=40, rank=2)
    assert model.num_segments == 6
    error = float(squared_errors(model, transfer).sum())
    expected = sum(one.cpca_squared_error for one in model.statistics)
    # Quantisation adds a twentieth at most, and not much less: its step is not the finest.
    assert 1.03 * expected < error < 1.055 * expected
    norm = sum(one.squared_norm for one in model.statistics)
    assert norm == pytest.approx(float(transfer.squared_norm().sum()), rel=1e-5)


def test_quantisation_share_trades_bytes_for_error():
    transfer = shadowed()
    sizes, errors = [], []
    for share in (0.01, 1.0):
        model = SegmentedCPCA.from_transfer(
            transfer, points_per_cluster=40, rank=2, quantisation_share=share
        )
        sizes.append(sum(tensor.nbytes for tensor in model.packed().values()))
        errors.append(squared_error(model, transfer))
    assert sizes == sorted(sizes, reverse=True)
    assert errors == sorted(errors)


def test_points_that_see_nothing_cost_nothing():
    transfer = shadowed()
    model = SegmentedCPCA.from_transfer(transfer, points_per_cluster=40, rank=2)
    dark = (transfer.dense() == 0).unflatten(-1, (6, 16)).all(-1)[:, 0, 0]
    assert torch.equal(model.labels.T == 0, dark)
    values = model.dense().detach().unflatten(-1, (6, 16))[:, 0, 0]
    assert bool((values[dark] == 0).all())
    assert model.statistics[5].nonzero_share == pytest.approx(1 - float(dark[:, 5].float().mean()))
    nothing = transfer.dense().clone()
    nothing[17] = 0.0
    model = SegmentedCPCA.from_transfer(
        TransferTensor.from_dense(nothing), num_segments=6, points_per_cluster=40, rank=2
    )
    with torch.no_grad():
        assert bool((model(torch.randn(2, 96, 3))[:, 17] == 0).all())


def test_projection_before_clustering_loses_less_than_a_hundredth(monkeypatch):
    generator = torch.Generator().manual_seed(5)
    groups = torch.randint(6, (900,), generator=generator)
    bases = torch.randn(6, 12, 600, generator=generator)
    mixtures = torch.randn(900, 12, generator=generator) * torch.logspace(0, -1.5, 12)
    data = torch.einsum("pk,pkd->pd", mixtures, bases[groups])
    data += 0.02 * torch.randn(900, 600, generator=generator)
    transfer = TransferTensor.from_dense(data)

    def error() -> float:
        """The least of some seeds, since one may end where no single point can leave."""
        models = [
            SegmentedCPCA.from_transfer(
                transfer,
                points_per_cluster=150,
                rank=8,
                generator=torch.Generator().manual_seed(seed),
            )
            for seed in range(2)
        ]
        return min(model.statistics[0].cpca_squared_error for model in models)

    projected = error()
    monkeypatch.setattr(segmented_encoding, "_LEAST_DIMENSIONS", 600)
    assert projected < 1.01 * error()


def test_small_clusters_keep_their_points():
    """Below n values a subspace takes more room than its points (equation 12)."""
    generator = torch.Generator().manual_seed(3)
    crowd = torch.randn(60, 1, generator=generator) * torch.ones(20)
    crowd = crowd + 1e-3 * torch.randn(60, 20, generator=generator)
    alone = 50 * torch.eye(20)[:3]
    transfer = TransferTensor.from_dense(torch.cat([crowd, alone]))
    model = SegmentedCPCA.from_transfer(transfer, points_per_cluster=15, rank=2)
    assert bool((model.labels[0, -3:] == 1).all())
    dense = model.dense().detach()[-3:, 0, 0]
    assert float((dense - alone).abs().max()) <= 0.51 * float(model.representative_steps[0])
    points = torch.bincount(model.labels[0].long())[2:]
    ranks = model.ranks[: len(points)]
    assert bool((points * 20 >= ranks * (points + 20)).all())


def test_few_points_and_constant_columns():
    for shape in [(1, 8), (1, 2), (5, 2), (3, 8)]:
        transfer = TransferTensor.from_dense(torch.ones(shape))
        model = SegmentedCPCA.from_transfer(transfer, num_segments=2)
        assert relative(model.dense(), transfer.dense()) < 1e-4
    constant = random_transfer(points=100, coeffs=8).dense().clone()
    constant[..., 2:5] = 3.0
    model = SegmentedCPCA.from_transfer(
        TransferTensor.from_dense(constant), num_segments=2, points_per_cluster=20, rank=4
    )
    assert relative(model.dense(), constant) < 1e-3


@pytest.mark.parametrize("scale", [1e-20, 1e20])
def test_scale_changes_nothing_but_the_scale(scale):
    transfer = shadowed()
    scaled = TransferTensor.from_dense(
        transfer.dense() * scale, light_basis=transfer.surface.light_basis
    )
    pair = [
        SegmentedCPCA.from_transfer(one, points_per_cluster=40, rank=2)
        for one in (transfer, scaled)
    ]
    errors = [
        float(squared_errors(m, t).sum()) for m, t in zip(pair, (transfer, scaled), strict=True)
    ]
    assert errors[1] == pytest.approx(errors[0] * scale * scale, rel=0.05)


def test_coding_of_columns_against_a_loop():
    generator = torch.Generator().manual_seed(0)
    codes = torch.randint(-200, 200, (600, 7), generator=generator, dtype=torch.int16)
    codes[torch.rand(600, 7, generator=generator) < 0.7] = 0
    codes[:300, 2] = -128  # a full column of codes that look like the mark
    codes[5, 3], codes[6, 3], codes[7, 3] = 32767, -32767, -127
    codes[:, 4] *= torch.rand(600, generator=generator) < 0.2  # few enough to be listed
    sparse = encode_columns(codes)
    counts, rows, marks, values = [], [], [], []
    for start in range(0, 600, 255):
        for column in codes[start : start + 255].T:
            found = [(row, int(code)) for row, code in enumerate(column) if code]
            counts.append(len(found))
            if len(found) <= 32:
                rows += [row for row, _ in found]
            else:
                bits = np.zeros(256, np.uint8)
                bits[[row for row, _ in found]] = 1
                marks.append(np.packbits(bits).tolist())
            values += [code for _, code in found]
    assert sparse.counts.tolist() == counts
    assert sparse.rows.tolist() == rows
    assert len(rows) > 0
    assert sparse.marks.tolist() == marks
    marked = [code if abs(code) < 128 else -128 for code in values]
    assert sparse.codes.tolist() == marked
    assert sparse.escapes.tolist() == [code for code in values if abs(code) >= 128]
    empty = encode_columns(codes[:0])
    both = [encode_columns(codes[:100]), empty, sparse]
    fields = ("counts", "rows", "marks", "codes", "escapes")
    joined = SparseColumns(*(torch.cat([getattr(one, name) for one in both]) for name in fields))
    assert torch.equal(decode_columns(joined, [100, 0, 600], 7), torch.cat([codes[:100], codes]))


def test_parts_of_a_file_are_what_the_statistics_say():
    model = SegmentedCPCA.from_transfer(shadowed(), points_per_cluster=40, rank=2)
    parts = sum(tensor.nbytes for tensor in model.packed().values())
    assert sum(one.coded_bytes for one in model.statistics) == parts
    assert sum(one.cpca_bytes for one in model.statistics) == 4 * (
        model.representatives.numel() + model.weights.numel()
    )


def test_memory_budget_changes_nothing_but_the_passes():
    transfer = shadowed()
    models = [
        SegmentedCPCA.from_transfer(transfer, points_per_cluster=40, rank=2, memory_budget=budget)
        for budget in (1, 2**30)
    ]
    for name, tensor in models[0].packed().items():
        assert all(torch.equal(tensor, other.packed()[name]) for other in models[1:]), name


def test_a_fit_sees_the_quantisation_and_rests_at_its_codes():
    transfer = random_transfer(points=60, coeffs=12, dtype=torch.float32)
    model = SegmentedCPCA.from_transfer(transfer, num_segments=2, points_per_cluster=30, rank=2)
    with torch.no_grad():  # away from the best, so that there is something to gain
        noise = torch.randn(model.weights.shape, generator=torch.Generator().manual_seed(0))
        model.weights += 0.1 * noise
    result = fit(model.train(), transfer, optimizer="adam", max_steps=10, learning_rate=1e-2)
    assert result.error_after < 0.8 * result.error_before
    in_training = squared_error(model, transfer)
    packed = model.packed()
    model.eval()
    assert squared_error(model, transfer) == pytest.approx(in_training, rel=1e-5)
    loaded = SegmentedCPCA.from_packed(packed, model.surface, model.shape)
    light = torch.randn(2, 12, 3)
    with torch.no_grad():
        assert torch.equal(loaded(light), model(light))
        model.representatives[0] += 1.0  # not at rest any more: no result of before may be used
        assert not torch.equal(loaded(light), model(light))


def test_metric_of_a_segment_is_a_block_of_the_whole():
    basis = SphericalHarmonics(4)
    lights = torch.randn(5, 16, 3, generator=torch.Generator().manual_seed(1))
    metric = Metric.light_prior(lights, basis)
    alone = torch.zeros(3, 1, 16, dtype=torch.float64)
    alone[..., 4:8] = torch.randn(3, 1, 4, dtype=torch.float64)
    local = segment_metric(metric, slice(4, 8), 16)
    expected = metric.weigh(alone).square().sum((1, 2))
    assert torch.allclose(local.weigh(alone[..., 4:8]).square().sum((1, 2)), expected)
    assert torch.allclose(local.unweigh(local.weigh(alone[..., 4:8])), alone[..., 4:8])


def test_gradient_of_light_is_that_of_dense_transfer():
    transfer = shadowed(points=60, dtype=torch.float64)
    model = SegmentedCPCA.from_transfer(transfer, points_per_cluster=20, rank=2)
    light = torch.randn(2, 96, 3, dtype=torch.float64, requires_grad=True)
    (own,) = torch.autograd.grad(model(light).square().sum(), light)
    dense = DenseTransfer(model.dense().detach(), model.surface)
    (expected,) = torch.autograd.grad(dense(light).square().sum(), light)
    assert relative(own, expected) < 1e-12


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_segments": 2}, "divide 9 coeffs, got 2"),
        ({"num_segments": 0}, "divide 9 coeffs, got 0"),
        ({"points_per_cluster": 0}, "at least 1 point a cluster"),
        ({"rank": 0}, "rank of at least 1"),
        ({"bits": 17}, "2..16 bits"),
        ({"quantisation_share": -0.1}, "quantisation share of at least 0"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        SegmentedCPCA.from_transfer(random_transfer(), **options)


def test_posing_is_refused():
    model = SegmentedCPCA.from_transfer(random_transfer(points=20))
    with pytest.raises(ValueError, match="rest pose"):
        model(torch.zeros(1, 9, 3, dtype=torch.float64), torch.eye(3).expand(20, 3, 3))
