"""Sparse transfer: the contract, brute force, a naive loop, files and extremes."""

import itertools

import pytest
import torch
from contract import Contract, random_transfer, relative

from prt_torch.bases import CubeDirections
from prt_torch.bases.haar import Haar
from prt_torch.fitting import fit
from prt_torch.metric import Metric
from prt_torch.quantize import largest_code
from prt_torch.representations import files
from prt_torch.representations.sparse_product import sparse_product
from prt_torch.representations.wavelet import WaveletTransfer
from prt_torch.representations.wavelet_selection import function_norms
from prt_torch.transfer import TransferTensor


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setitem(files.KINDS, WaveletTransfer.kind, WaveletTransfer)


class TestFloat(Contract):
    def make(self, transfer):
        return WaveletTransfer.from_transfer(transfer, num_terms=4, codes="float")

    def make_lossless(self, transfer):
        return WaveletTransfer.from_transfer(transfer, num_terms=transfer.num_coeffs, codes="float")


class TestCoded(Contract):
    """Codes of the default: 16 bits for one channel, 11/11/10 for three."""

    def make(self, transfer):
        return WaveletTransfer.from_transfer(transfer, num_terms=5)

    make_lossless = TestFloat.make_lossless

    def test_gradients(self):
        """Of the light; those of coded values are a clamp's and not finite differences."""
        representation = self.make(random_transfer(points=12, coeffs=4))
        light = torch.randn(2, 4, 3, dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(representation, light)
        plain = WaveletTransfer.from_transfer(
            random_transfer(points=12, coeffs=4), num_terms=5, codes="float"
        )
        for model in (representation, plain):
            model(light.detach()).square().sum().backward()
        assert relative(representation.values.grad, plain.values.grad) < 1e-3


def squared_error(model: WaveletTransfer, transfer: TransferTensor) -> float:
    with torch.no_grad():
        return float((model.dense() - transfer.dense()).double().square().sum())


def normal(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


class TestSelection:
    @pytest.mark.parametrize("channels", [1, 3])
    def test_no_choice_of_as_many_coefficients_is_better(self, channels):
        transfer = random_transfer(points=7, channels=channels, rows=2, coeffs=8)
        values = transfer.dense()
        for num_terms in (1, 3, 7):
            model = WaveletTransfer.from_transfer(transfer, num_terms=num_terms, codes="float")
            lost = (model.dense().detach() - values).square().sum((1, 3))
            energy = values.square().sum(1)  # points rows coeffs
            best = torch.stack(
                [
                    energy.sum(-1) - energy[..., list(kept)].sum(-1)
                    for kept in itertools.combinations(range(8), num_terms)
                ]
            ).amin(0)
            torch.testing.assert_close(lost, best)

    def test_choices_are_nested_and_the_error_falls_to_zero(self):
        transfer = random_transfer(rows=2, coeffs=40)
        errors, kept = [], torch.zeros(60, 2, 40, dtype=torch.bool)
        for num_terms in (1, 2, 5, 10, 20, 39, 40, 1000):
            model = WaveletTransfer.from_transfer(transfer, num_terms=num_terms, codes="float")
            now = model.dense().detach()[:, 0] != 0
            assert bool((now | ~kept).all())
            assert int(now.sum(-1).max()) == min(num_terms, 40)
            kept = now
            errors.append(squared_error(model, transfer))
        assert errors == sorted(errors, reverse=True)
        assert errors[-3] > errors[-2] == errors[-1] == 0.0

    def test_ties_go_to_the_lowest_index(self):
        values = torch.tensor(
            [[1.0, -2, 2, 1, -1, 2, 1], [1, 1, 1, 1, 1, 1, 1], [0, 0, 5, 0, 0, 0, 0]]
        )
        model = WaveletTransfer.from_transfer(
            TransferTensor.from_dense(values), num_terms=4, codes="float"
        )
        expected = torch.tensor(
            [[1.0, -2, 2, 0, 0, 2, 0], [1, 1, 1, 1, 0, 0, 0], [0, 0, 5, 0, 0, 0, 0]]
        )
        assert torch.equal(model.dense().detach()[:, 0, 0], expected)
        assert model.indices[2, 0].tolist() == [2, 0, 0, 0]

    def test_channels_share_their_choice_by_the_sum_of_squares(self):
        values = torch.zeros(1, 3, 1, 3)
        values[0, :, 0] = torch.tensor([[4.0, 0, 3], [0, 3, 3], [0, 3, 0]])  # norms 4, 4.243, 4.243
        model = WaveletTransfer.from_transfer(
            TransferTensor.from_dense(values), num_terms=2, codes="float"
        )
        assert model.indices.tolist() == [[[1, 2]]]
        for scale in (1e-25, 1e25):  # squares would vanish or overflow
            scaled = TransferTensor.from_dense(values * scale)
            model = WaveletTransfer.from_transfer(scaled, num_terms=2, codes="float")
            assert model.indices.tolist() == [[[1, 2]]]

    def test_a_metric_weighs_the_functions(self):
        """Cube directions are orthogonal: the best choice is by value over sqrt(solid angle)."""
        basis = CubeDirections(3)
        transfer = TransferTensor.from_dense(normal(5, 54), light_basis=basis)
        metric = Metric.l2(transfer)
        norms = function_norms(metric, transfer)
        torch.testing.assert_close(
            norms, basis.gram().diagonal().sqrt() if basis.gram().ndim == 2 else basis.gram().sqrt()
        )
        chosen = {}
        for name, given in {"plain": None, "weighed": metric}.items():
            model = WaveletTransfer.from_transfer(
                transfer, num_terms=10, codes="float", metric=given
            )
            lost = metric.weigh(model.dense().detach() - transfer.dense()).square().sum((1, 2, 3))
            chosen[name] = lost
        weighed = metric.weigh(transfer.dense())[:, 0, 0].square().sort(descending=True).values
        torch.testing.assert_close(chosen["weighed"], weighed[:, 10:].sum(-1))
        assert bool((chosen["weighed"] <= chosen["plain"]).all())
        assert float(chosen["plain"].sum()) > float(chosen["weighed"].sum())

    def test_norms_of_functions_that_are_not_orthogonal(self):
        basis = Haar(4, 2)
        transfer = TransferTensor.from_dense(normal(2, 3, 96), light_basis=basis)
        norms = function_norms(Metric.l2(transfer), transfer)
        torch.testing.assert_close(norms, basis.gram().diagonal().sqrt())

    def test_blocks_of_points_make_no_difference(self, monkeypatch):
        transfer = random_transfer(points=30, rows=2, coeffs=20)
        whole = WaveletTransfer.from_transfer(transfer, num_terms=6).packed()
        monkeypatch.setattr(
            "prt_torch.representations.wavelet_selection._BLOCK_BYTES", 7 * 2 * 20 * 8
        )
        for name, tensor in WaveletTransfer.from_transfer(transfer, num_terms=6).packed().items():
            assert torch.equal(tensor, whole[name]), name


class TestProduct:
    def test_naive_loop(self):
        model = WaveletTransfer.from_transfer(
            random_transfer(points=6, channels=3, rows=2, coeffs=12), num_terms=5, codes="float"
        )
        light = normal(2, 12, 3)
        expected = torch.zeros(2, 6, 2, 3, dtype=torch.float64)
        for b, p, r, c in itertools.product(range(2), range(6), range(2), range(3)):
            for index, value in zip(
                model.indices[p, r], model.values.detach()[p, r, :, c], strict=True
            ):
                expected[b, p, r, c] += value * light[b, index, c]
        torch.testing.assert_close(model(light).detach(), expected)
        with torch.no_grad():
            torch.testing.assert_close(model(light), expected)

    def test_first_and_second_derivatives(self, monkeypatch):
        monkeypatch.setattr("prt_torch.representations.sparse_product._TERMS_AT_ONCE", 8)
        indices = torch.randint(5, (7, 3), generator=torch.Generator().manual_seed(0)).int()
        weights, table = (
            normal(7, 3, seed=1).requires_grad_(),
            normal(5, 2, seed=2).requires_grad_(),
        )

        def product(weights, table):
            return sparse_product(indices, weights, table)

        assert torch.autograd.gradcheck(product, (weights, table))
        assert torch.autograd.gradgradcheck(product, (weights, table))

    def test_light_threshold_leaves_out_weak_light(self):
        transfer = random_transfer(coeffs=12)
        model = WaveletTransfer.from_transfer(transfer, num_terms=12, light_threshold=0.1)
        light = torch.zeros(1, 12, 3, dtype=torch.float64)
        light[0, 3] = torch.tensor([10.0, -0.5, 0.5])  # kept: one of its colours is strong
        light[0, 5] = 1.0  # just at the threshold: left out
        light[0, 7] = -1.01
        strong = light.clone()
        strong[0, 5] = 0.0
        thresholded = model(light)
        model.light_threshold = 0.0
        assert torch.equal(thresholded, model(strong))
        assert relative(model(light), thresholded) > 1e-3
        model.light_threshold = 0.1  # by each light's own largest coefficient
        both = model(torch.cat([light, 1e-6 * light]))
        assert torch.equal(both[0], thresholded[0])
        assert relative(both[1], 1e-6 * thresholded[0]) < 1e-12
        assert model.budget == {"num_terms": 12, "codes": "16", "light_threshold": 0.1}
        restored = WaveletTransfer.from_packed(model.packed(), model.surface, model.shape)
        assert torch.equal(restored(light), thresholded)

    def test_frames_are_refused(self):
        model = WaveletTransfer.from_transfer(random_transfer())
        with pytest.raises(ValueError, match="cannot be posed"):
            model(torch.zeros(1, 9, 3, dtype=torch.float64), torch.eye(3).expand(60, 3, 3))


class TestCodes:
    @pytest.mark.parametrize(
        ("codes", "channels", "value_bytes", "bits"),
        [
            ("11/11/10", 3, 4, (11, 11, 10)),
            ("16", 3, 6, (16, 16, 16)),
            ("8", 3, 3, (8, 8, 8)),
            ("float", 3, 12, None),
            ("16", 1, 2, (16,)),
            ("8", 1, 1, (8,)),
            ("float", 1, 4, None),
        ],
    )
    def test_bytes_and_errors(self, codes, channels, value_bytes, bits):
        values = normal(40, channels, 2, 300, dtype=torch.float32)
        values[:, :, 1] *= 1e-4  # a row of its own size keeps its own step
        transfer = TransferTensor.from_dense(values)
        model = WaveletTransfer.from_transfer(transfer, num_terms=16, codes=codes)
        entries = int((model.values != 0).any(-1).sum())
        assert entries >= 40 * 2 * 16 * 0.99
        sizes = model.storage()
        name = {"11/11/10": "words", "float": "values"}.get(codes, "codes")
        assert sizes[name] == entries * value_bytes
        assert sizes["indices"] == entries * 2
        assert sizes["counts"] == 80 * 2  # 300 coefficients do not fit a byte
        exact = WaveletTransfer.from_transfer(transfer, num_terms=16, codes="float").dense()
        error = (model.dense() - exact).detach().abs().amax((0, 3))  # channels rows
        largest = exact.detach().abs().amax((0, 3))
        for channel in range(channels):
            half_step = 0.0 if bits is None else 0.5 / largest_code(bits[channel])
            assert bool((error[channel] <= half_step * largest[channel] * 1.001).all())
            assert bits is None or bool((error[channel] > 0).all())

    def test_zeros_are_dropped_from_the_file(self):
        values = torch.zeros(3, 1, 2, 70000)
        values[0, 0, 0, [5, 69999, 8]] = torch.tensor([1.0, -1.0, 1e-6])  # the last codes to zero
        values[2, 0, 1, 70] = 3.0
        model = WaveletTransfer.from_transfer(TransferTensor.from_dense(values), num_terms=3)
        packed = model.packed()
        assert packed["counts"].tolist() == [[2, 0], [0, 0], [0, 1]]
        assert packed["indices"].tolist() == [5, 69999, 70]
        assert packed["indices"].dtype == torch.int32
        assert packed["codes"][:, 0].tolist() == [32767, -32767, 32767]
        assert model.indices.shape == (3, 2, 2)
        assert model.num_terms == 3

    @pytest.mark.parametrize("scale", [1e-40, 1e-20, 1e20, 1e38])
    def test_scales(self, scale):
        values = normal(20, 30, dtype=torch.float32).clamp(-3, 3)
        with torch.no_grad():
            reference = WaveletTransfer.from_transfer(
                TransferTensor.from_dense(values), num_terms=8
            )
            scaled = WaveletTransfer.from_transfer(
                TransferTensor.from_dense(values * scale), num_terms=8
            )
            ratio = scaled.dense().double() / scale
            assert float((ratio - reference.dense()).abs().max()) < 3e-4

    @pytest.mark.parametrize("codes", ["11/11/10", "16", "float"])
    def test_zero_tensor_one_point_one_coefficient(self, codes, tmp_path):
        for shape in [(4, 3, 2, 6), (1, 3, 1, 6), (5, 3, 1, 1), (1, 3, 1, 1)]:
            for values in (torch.zeros(shape), normal(*shape, dtype=torch.float32)):
                transfer = TransferTensor.from_dense(values)
                model = WaveletTransfer.from_transfer(transfer, codes=codes)
                assert float(relative(model.dense() + 1, values + 1)) < 4e-3
                files.save(model, tmp_path / "one.safetensors")
                light = normal(2, shape[-1], 3, dtype=torch.float32)
                assert torch.equal(files.load(tmp_path / "one.safetensors")(light), model(light))

    @pytest.mark.parametrize(
        ("codes", "optimizer", "rate"), [("16", "lbfgs", None), ("8", "adam", 0.03)]
    )
    def test_a_refined_module_is_what_its_file_holds(self, tmp_path, codes, optimizer, rate):
        basis = Haar(4, 4)
        transfer = TransferTensor.from_dense(normal(30, 96, dtype=torch.float32), light_basis=basis)
        model = WaveletTransfer.from_transfer(transfer, num_terms=20, codes=codes)
        light = normal(2, 96, 3, dtype=torch.float32)
        with torch.no_grad():
            before = model(light)
        result = fit(model, transfer, optimizer=optimizer, learning_rate=rate, max_steps=3)
        assert result.error_after < result.error_before
        with torch.no_grad():
            after = model(light)
        assert not torch.equal(before, after)  # no stale values from before the fit
        files.save(model, tmp_path / "fitted.safetensors")
        loaded = files.load(tmp_path / "fitted.safetensors")
        with torch.no_grad():
            assert torch.equal(loaded(light), after)
        assert torch.equal(loaded.dense(), model.dense())

    def test_evaluation_follows_every_change_of_the_values(self):
        model = WaveletTransfer.from_transfer(random_transfer(dtype=torch.float32), num_terms=4)
        light = normal(1, 9, 3, dtype=torch.float32)
        with torch.no_grad():
            first = model(light)
            model.values.mul_(0.5)
            assert relative(model(light), 0.5 * first) < 1e-3
            model.load_state_dict({**model.state_dict(), "values": torch.zeros_like(model.values)})
            assert float(model(light).abs().max()) == 0.0
            model.values.data = torch.ones_like(model.values)
            assert float(model(light).abs().max()) > 0.0
            assert model.double()(light.double()).dtype == torch.float64

    def test_refusals(self, without_type_checker):
        transfer = random_transfer()
        with pytest.raises(ValueError, match="expected at least 1 term, got 0"):
            WaveletTransfer.from_transfer(transfer, num_terms=0)
        with pytest.raises(ValueError, match="expected codes 11/11/10, 16, 8 or float, got '7'"):
            WaveletTransfer.from_transfer(transfer, codes="7")
        with pytest.raises(ValueError, match="expected three channels for codes 11/11/10, got 1"):
            WaveletTransfer.from_transfer(transfer, codes="11/11/10")
        with pytest.raises(ValueError, match="expected a light threshold"):
            WaveletTransfer.from_transfer(transfer, light_threshold=1.0)


@pytest.mark.slow
def test_works_compiled_and_follows_its_values(without_type_checker):
    """Traced by Dynamo (backend aot_eager: Inductor needs a C++ compiler)."""
    model = WaveletTransfer.from_transfer(random_transfer(dtype=torch.float32), num_terms=4)
    light = normal(2, 9, 3, dtype=torch.float32)
    compiled = torch.compile(model, backend="aot_eager")
    with torch.no_grad():
        assert relative(compiled(light), model(light)) < 1e-5
        model.values.mul_(2.0)
        assert relative(compiled(light), model(light)) < 1e-5
    compiled(light).sum().backward()
    assert float(model.values.grad.abs().sum()) > 0.0
