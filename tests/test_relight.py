"""Relighting and evaluation, against the definition."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from contract import random_transfer, relative

from prt_torch import evaluate
from prt_torch.assets import find_environment
from prt_torch.bases import ExitBasis, SphericalHarmonics
from prt_torch.relight import Relighter
from prt_torch.representations import CPCA, DenseTransfer, ZonalLobes
from prt_torch.sphere import frame_from_normal
from prt_torch.transfer import TransferTensor


class Linear(ExitBasis):
    """1, x, y, z of the local view direction: the smallest basis that depends on the view."""

    num_rows, num_channels = 4, 1
    view_dependent = True

    def constants(self):
        return torch.eye(1, 4, dtype=torch.float64)

    def tensors(self):
        return {}

    def evaluate(self, view):
        return torch.cat([torch.ones_like(view[..., :1]), view], dim=-1)

    def gram(self):
        return torch.diag(torch.tensor([1.0, 1 / 3, 1 / 3, 1 / 3], dtype=torch.float64))

    def describe(self):
        return {"name": "linear"}


def glossy(points: int = 30) -> TransferTensor:
    generator = torch.Generator().manual_seed(0)
    normals = torch.randn(points, 3, generator=generator, dtype=torch.float64)
    frames = frame_from_normal(torch.nn.functional.normalize(normals, dim=1))
    return TransferTensor.from_dense(
        random_transfer(points, rows=4, coeffs=9).dense(),
        exit_basis=Linear(),
        frames=frames,
        positions=torch.randn(points, 3, generator=generator, dtype=torch.float64),
        reflectance=torch.rand(points, 3, generator=generator, dtype=torch.float64),
    )


def test_views_by_the_definition():
    transfer = glossy()
    relight = Relighter(DenseTransfer.from_transfer(transfer))
    light = torch.randn(2, 9, 3, dtype=torch.float64)
    eyes = torch.tensor([[3.0, 1, 0], [0, 5, 2], [-4, 0, 1]], dtype=torch.float64)
    radiance = relight(light, eyes)
    assert radiance.shape == (2, 3, 30, 3)
    surface = transfer.surface
    for batch, view, point in [(0, 0, 0), (1, 2, 17), (0, 1, 29)]:
        towards = eyes[view] - surface.positions[point]
        local = surface.frames[point] @ (towards / towards.norm())
        rows = torch.cat([torch.ones(1), local])
        expected = rows.double() @ transfer.dense()[point, 0] @ light[batch]
        expected = expected * surface.reflectance[point]
        assert torch.allclose(radiance[batch, view, point], expected)


def test_views_as_directions_and_posed_frames():
    transfer = glossy()
    relight = Relighter(DenseTransfer.from_transfer(transfer))
    light = torch.randn(1, 9, 3, dtype=torch.float64)
    eye = torch.tensor([[3.0, 1, 0]], dtype=torch.float64)
    directions = torch.nn.functional.normalize(eye - transfer.surface.positions, dim=-1)[None]
    assert torch.allclose(relight(light, eye), relight(light, directions))
    with pytest.raises(ValueError, match="give views"):
        relight(light)
    with pytest.raises(ValueError, match="posed"):
        relight(light, eye, frames=transfer.surface.frames)


def test_gradients_through_light_views_and_parameters():
    transfer = glossy(points=4)
    model = CPCA.from_transfer(transfer, num_clusters=2, rank=1)
    relight = Relighter(model)
    light = torch.randn(2, 9, 3, dtype=torch.float64, requires_grad=True)
    eyes = torch.tensor([[3.0, 1, 0]], dtype=torch.float64, requires_grad=True)
    names = [name for name, _ in relight.named_parameters()]
    values = [p.detach().clone().requires_grad_() for p in relight.parameters()]

    def call(light, eyes, *parameters):
        state = dict(zip(names, parameters, strict=True))
        return torch.func.functional_call(relight, state, (light, eyes))

    assert torch.autograd.gradcheck(call, (light, eyes, *values))


@pytest.mark.parametrize("shared", [True, False])
def test_reflectance_multiplies_once(shared):
    reflectance = torch.rand(1 if shared else 60, 3, dtype=torch.float64)
    transfer = TransferTensor.from_dense(random_transfer().dense(), reflectance=reflectance)
    light = torch.randn(3, 9, 3, dtype=torch.float64)
    relit = Relighter(DenseTransfer.from_transfer(transfer))(light)
    assert relit.shape == (3, 1, 60, 3)
    expected = torch.einsum("pi,bic->bpc", transfer.dense()[:, 0, 0], light) * reflectance
    assert relative(relit[:, 0], expected) < 1e-13
    assert relative(evaluate.dense_radiance(transfer, light), relit) < 1e-13


def test_many_lights_in_turns_are_the_same():
    transfer = random_transfer()
    model = CPCA.from_transfer(transfer, num_clusters=4, rank=2)
    light = torch.randn(10, 9, 3, dtype=torch.float64)
    assert relative(Relighter(model, max_bytes=5000)(light), Relighter(model)(light)) < 1e-13


def test_environments_go_through_the_light_basis():
    basis = SphericalHarmonics(3)
    transfer = TransferTensor.from_dense(random_transfer().dense(), light_basis=basis)
    relight = Relighter(DenseTransfer.from_transfer(transfer))
    sky, area = find_environment("sky"), find_environment("area_lights")
    both = relight([sky, area])
    assert both.shape == (2, 1, 60, 3)
    assert torch.allclose(both[1:], relight(area))
    assert torch.allclose(both[:1], relight(basis.project(sky)[None]))
    assert torch.allclose(relight(sky.scaled(2.0)), 2 * both[:1])


def test_without_a_light_basis_only_coefficients_will_do():
    relight = Relighter(DenseTransfer.from_transfer(random_transfer()))
    with pytest.raises(ValueError, match="no light basis"):
        relight(find_environment("sky"))


def test_works_under_autocast_and_no_grad():
    transfer = random_transfer(dtype=torch.float32)
    relight = Relighter(CPCA.from_transfer(transfer, num_clusters=4, rank=2))
    light = torch.randn(2, 9, 3)
    expected = relight(light)
    with torch.no_grad():
        assert relative(relight(light), expected) < 1e-5
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert relative(relight(light).float(), expected) < 3e-2


def test_works_compiled(without_type_checker):
    """Traced by Dynamo and AOTAutograd (backend aot_eager: Inductor needs a C++ compiler)."""
    transfer = random_transfer(dtype=torch.float32)
    relight = Relighter(CPCA.from_transfer(transfer, num_clusters=4, rank=2))
    light = torch.randn(2, 9, 3)
    compiled = torch.compile(relight, backend="aot_eager")
    assert relative(compiled(light), relight(light)) < 1e-5
    compiled(light).sum().backward()
    assert torch.isfinite(relight.representation.weights.grad).all()


def test_transfer_error_counts_in_the_norm_of_the_light_basis():
    transfer = random_transfer(rows=2)
    model = CPCA.from_transfer(transfer, num_clusters=4, rank=1)
    difference = (model.dense().detach() - transfer.dense()).numpy()
    expected = (difference**2).sum() / (transfer.dense().numpy() ** 2).sum()
    assert evaluate.transfer_error(model, transfer) == pytest.approx(expected, rel=1e-12)
    exact = DenseTransfer.from_transfer(transfer)
    assert evaluate.transfer_error(exact, transfer) == 0.0


def test_errors_of_black_and_of_nothing_lost_are_zero():
    zero = TransferTensor.from_dense(torch.zeros(10, 4))
    assert evaluate.transfer_error(DenseTransfer.from_transfer(zero), zero) == 0.0
    black = torch.zeros(10, 3)
    assert evaluate.radiance_error(black, black) == 0.0
    assert evaluate.radiance_error(black + 1, black) == np.inf


def test_radiance_error_is_relative_root_mean_square():
    reference = torch.tensor([[3.0, 0, 0], [0, 4, 0]])
    assert evaluate.radiance_error(reference * 1.1, reference) == pytest.approx(0.1, rel=1e-6)
    shifted = reference + torch.tensor([[0.0, 0, 0.5], [0, 0, 0]])
    assert evaluate.radiance_error(shifted, reference) == pytest.approx(0.1, rel=1e-6)


def test_peak_bytes_counts_what_is_held_at_once():
    x = torch.randn(250, 1000)

    def two_at_once():
        a = x + 1
        b = a * 2  # a and b: 2 MB
        del a
        c = b - 1  # b and c
        return c[:10].sum()  # a view holds nothing new

    assert evaluate.peak_bytes(two_at_once) == 2_000_004  # and the sum


@pytest.mark.parametrize(("points", "timed"), [(50, 50), (2500, 2000)])
def test_a_tensor_that_does_not_fit_is_timed_by_some_of_its_points(points, timed):
    transfer = random_transfer(points=points)
    whole, once = evaluate.timed_block(transfer, 2 * transfer.num_bytes)
    assert (whole.num_points, once) == (points, 1.0)
    some, factor = evaluate.timed_block(transfer, 2 * transfer.num_bytes - 2)
    assert (some.num_points, factor) == (timed, points / timed)
    assert torch.equal(some.dense(), transfer.dense()[:timed])


def test_median_seconds_takes_functions_in_turn():
    order = []
    functions = [lambda: order.append("a"), lambda: order.append("b")]
    times = evaluate.median_seconds(functions, rounds=2, warm_up=1)
    assert order == ["a", "b"] * 3
    assert len(times) == 2
    assert all(t >= 0 for t in times)


def test_a_sequence_of_poses_with_views():
    from_harmonics = replace(glossy().surface, light_basis=SphericalHarmonics(3))
    transfer = replace(glossy(), surface=from_harmonics)
    relight = Relighter(ZonalLobes.from_transfer(transfer, num_lobes=3, effort="fast", bits=None))
    generator = torch.Generator().manual_seed(3)
    turn = frame_from_normal(torch.tensor([[0.6, 0.0, 0.8], [0.0, -1.0, 0.0]], dtype=torch.float64))
    rest, positions = transfer.surface.frames, transfer.surface.positions
    assert rest is not None
    assert positions is not None
    frames, where = rest @ turn.mT[:, None], positions @ turn.mT
    light = torch.randn(1, 9, 3, generator=generator, dtype=torch.float64)
    eyes = torch.tensor([[3.0, 1, 0], [0, 5, 2]], dtype=torch.float64)
    sequence = relight(light, eyes, frames, where)
    each = [relight(light, eyes, frames[b], where[b]) for b in range(2)]
    assert torch.equal(sequence, torch.cat(each))
    # Turning surface, light and viewer together changes nothing.
    basis = SphericalHarmonics(3)
    for b in range(2):
        turned = basis.rotate(light, turn[b])
        seen = relight(turned, eyes @ turn[b].mT, frames[b], where[b])
        assert relative(seen, relight(light, eyes)) < 1e-10
    with pytest.raises(ValueError, match="as many poses as lights"):
        relight(light.expand(3, -1, -1), eyes, frames)
