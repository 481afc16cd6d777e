"""What every representation must keep, checked against its own dense tensor.

A test class inherits :class:`Contract`, says how to make the representation, and gets all checks.
"""

from abc import ABC, abstractmethod
from pathlib import Path

import pytest
import torch
from tolerances import ROUNDING
from torch import Tensor

from prt_torch.representations import Representation, load, save
from prt_torch.transfer import TransferTensor


def random_transfer(
    points: int = 60,
    channels: int = 1,
    rows: int = 1,
    coeffs: int = 9,
    *,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
) -> TransferTensor:
    """A few smooth groups of points with a little noise: what transfer looks like."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    size = channels * rows * coeffs
    groups = normal(5, size)[torch.randint(5, (points,), generator=generator)]
    values = groups + 0.4 * normal(points, 3) @ normal(3, size) + 0.01 * normal(points, size)
    reflectance = torch.rand(points, 3, generator=generator, dtype=torch.float64)
    return TransferTensor.from_dense(
        values.view(points, channels, rows, coeffs).to(dtype), reflectance=reflectance.to(dtype)
    )


def contract_by_dense(dense: Tensor, light: Tensor) -> Tensor:
    """Radiance by the definition, one light and one colour at a time."""
    out = []
    for one in light:
        colours = []
        for colour in range(3):
            channel = dense[:, colour if dense.shape[1] == 3 else 0]
            coefficients = one[..., colour]
            each = coefficients if one.ndim == 3 else coefficients.expand(len(channel), -1)
            colours.append(torch.einsum("pri,pi->pr", channel, each))
        out.append(torch.stack(colours, dim=-1))
    return torch.stack(out)


def relative(a: Tensor, b: Tensor) -> float:
    """Largest difference over the largest value."""
    return float((a - b).detach().abs().max() / b.detach().abs().max().clamp_min(1e-300))


class Contract(ABC):
    """Inherit, define the two methods, and every check below runs."""

    @abstractmethod
    def make(self, transfer: TransferTensor) -> Representation:
        """A representation at a budget that loses something."""

    @abstractmethod
    def make_lossless(self, transfer: TransferTensor) -> Representation:
        """A representation at a budget that loses nothing."""

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    @pytest.mark.parametrize(("channels", "rows"), [(1, 1), (1, 3), (3, 1), (3, 2)])
    @pytest.mark.parametrize("local", [False, True])
    def test_forward_is_the_contraction_of_dense(self, dtype, channels, rows, local):
        transfer = random_transfer(channels=channels, rows=rows, dtype=dtype)
        representation = self.make(transfer)
        points = (transfer.num_points,) if local else ()
        generator = torch.Generator().manual_seed(1)
        light = torch.randn(4, *points, transfer.num_coeffs, 3, generator=generator, dtype=dtype)
        expected = contract_by_dense(representation.dense(), light)
        assert representation(light).shape == (4, transfer.num_points, rows, 3)
        assert relative(representation(light), expected) < ROUNDING[dtype]

    def test_batched_is_looped(self):
        transfer = random_transfer()
        representation = self.make(transfer)
        light = torch.randn(5, transfer.num_coeffs, 3, dtype=torch.float64)
        looped = torch.cat([representation(one[None]) for one in light])
        assert relative(representation(light), looped) < ROUNDING[torch.float64]

    def test_some_points_of_dense(self):
        representation = self.make(random_transfer())
        points = torch.tensor([3, 3, 59, 0, 17])
        some = representation.dense(points)
        assert relative(some, representation.dense()[points]) < ROUNDING[torch.float64]

    def test_lossless_budget_recovers_the_tensor(self):
        transfer = random_transfer(rows=2)
        representation = self.make_lossless(transfer)
        assert relative(representation.dense(), transfer.dense()) < ROUNDING[torch.float64]

    def test_gradients(self):
        transfer = random_transfer(points=12, coeffs=4)
        representation = self.make(transfer)
        light = torch.randn(2, 4, 3, dtype=torch.float64, requires_grad=True)
        names = [name for name, _ in representation.named_parameters()]
        values = [p.detach().clone().requires_grad_() for p in representation.parameters()]

        def relit(light, *parameters):
            state = dict(zip(names, parameters, strict=True))
            return torch.func.functional_call(representation, state, (light,))

        assert torch.autograd.gradcheck(relit, (light, *values))

    def test_gradients_are_finite_for_a_zero_tensor(self):
        transfer = TransferTensor.from_dense(torch.zeros(20, 9))
        representation = self.make(transfer)
        light = torch.ones(1, 9, 3, requires_grad=True)
        representation(light).square().sum().backward()
        assert torch.isfinite(light.grad).all()
        assert all(torch.isfinite(p.grad).all() for p in representation.parameters())
        assert float(representation.dense().detach().abs().max()) == 0.0

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_save_and_load_are_exact_and_bytes_are_counted(self, tmp_path: Path, dtype):
        transfer = random_transfer(dtype=dtype)
        representation = self.make(transfer)
        path = tmp_path / "fitted.safetensors"
        save(representation, path)
        loaded = load(path)
        assert type(loaded) is type(representation)
        for name, tensor in representation.packed().items():
            assert torch.equal(loaded.packed()[name], tensor), name
            assert loaded.packed()[name].dtype == tensor.dtype
        assert torch.equal(loaded.reflectance, representation.reflectance)
        light = torch.randn(2, transfer.num_coeffs, 3, dtype=dtype)
        assert torch.equal(loaded(light), representation(light))
        header = int.from_bytes(path.read_bytes()[:8], "little")
        assert sum(representation.storage().values()) == path.stat().st_size - 8 - header

    def test_wrong_light_is_refused(self, without_type_checker):
        representation = self.make(random_transfer())
        for shape in [(9, 3), (1, 8, 3), (1, 9, 1), (1, 59, 9, 3)]:
            with pytest.raises(ValueError, match="expected light"):
                representation(torch.zeros(shape, dtype=torch.float64))

    def test_same_seed_gives_the_same_bits_and_global_state_is_untouched(self):
        transfer = random_transfer(dtype=torch.float32)
        before = torch.get_rng_state(), torch.get_num_threads(), torch.is_grad_enabled()
        first = self.make(transfer)
        after = torch.get_rng_state(), torch.get_num_threads(), torch.is_grad_enabled()
        second = self.make(transfer)
        assert torch.equal(before[0], after[0])
        assert before[1:] == after[1:]
        for name, tensor in first.packed().items():
            assert torch.equal(tensor, second.packed()[name]), name

    def test_one_or_two_threads_agree(self):
        transfer = random_transfer(points=400, coeffs=25, dtype=torch.float32)
        threads = torch.get_num_threads()
        tensors = []
        try:
            for count in (1, 2):
                torch.set_num_threads(count)
                tensors.append(self.make(transfer).dense().detach())
        finally:
            torch.set_num_threads(threads)
        assert relative(tensors[0], tensors[1]) < 1e-5
