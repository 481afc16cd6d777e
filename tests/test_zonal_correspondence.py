"""Lobes of neighbours in correspondence: known answers, interpolation, extremes."""

import itertools
import math

import pytest
import torch

from prt_torch.bases import sh, zonal
from prt_torch.representations.zonal_lobes_coding import Lobes
from prt_torch.representations.zonal_lobes_correspondence import (
    between,
    corresponding,
    edge_error,
    interpolate,
)
from prt_torch.sphere import frame_from_normal

ORDER = 6


def unit(*shape: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    vectors = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    return vectors / vectors.norm(dim=-1, keepdim=True)


def grid(side: int) -> torch.Tensor:
    """Edges of neighbouring texels."""
    numbers = torch.arange(side * side).view(side, side)
    across = torch.stack([numbers[:, :-1], numbers[:, 1:]], dim=-1).flatten(0, 1)
    down = torch.stack([numbers[:-1], numbers[1:]], dim=-1).flatten(0, 1)
    return torch.cat([across, down])


def about(axis: torch.Tensor, angles: torch.Tensor) -> torch.Tensor:
    """Rotations about an axis, "points 3 3"."""
    x, y, z = axis.tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(angles[:, None, None] * cross)


def turning_lobes(side: int = 6, rows: int = 1, lobes: int = 3) -> Lobes:
    """One function of each row, turned smoothly from texel to texel."""
    angles = 0.12 * torch.arange(side * side, dtype=torch.float64).remainder(side)
    turns = about(unit(1, seed=5)[0], angles)
    axes = torch.einsum("pij,rnj->prni", turns, unit(rows, lobes))
    generator = torch.Generator().manual_seed(1)
    weights = torch.rand(rows, lobes, ORDER - 2, generator=generator, dtype=torch.float64) + 0.5
    linear = torch.randn(side * side, rows, 4, generator=generator, dtype=torch.float64)
    return Lobes(axes, weights.expand(side * side, -1, -1, -1).clone(), linear)


def harmonics(lobes: Lobes) -> torch.Tensor:
    padded = torch.nn.functional.pad(lobes.coefficients, (2, 0))
    return torch.cat([lobes.linear, zonal.lobes_to_sh(lobes.axes, padded)[..., 4:]], dim=-1)


def shuffled(lobes: Lobes, seed: int = 2) -> Lobes:
    """The same functions, lobes of each point in another order and some of them negated."""
    generator = torch.Generator().manual_seed(seed)
    points, rows, count = lobes.axes.shape[:3]
    order = torch.rand(points, rows, count, generator=generator).argsort(dim=2)[..., None]
    signs = torch.where(torch.rand(points, rows, count, generator=generator) < 0.5, -1.0, 1.0)
    odd = torch.tensor([band % 2 == 1 for band in range(2, ORDER)])
    axes = lobes.axes.gather(2, order.expand_as(lobes.axes)) * signs[..., None]
    weights = lobes.coefficients.gather(2, order.expand_as(lobes.coefficients))
    return Lobes(axes, torch.where(odd, weights * signs[..., None], weights), lobes.linear)


@pytest.mark.parametrize("rows", [1, 2])
def test_shuffled_and_negated_lobes_are_matched_back(rows):
    lobes, edges = turning_lobes(rows=rows), grid(6)
    mixed = shuffled(lobes)
    values = harmonics(lobes)
    assert torch.allclose(harmonics(mixed), values, atol=1e-12)
    matched = corresponding(mixed, values, edges, allowance=0.0)
    assert torch.allclose(harmonics(matched), values, atol=1e-9)
    one, other = matched.axes[edges].unbind(1)
    # neighbours are at most 0.12 rad apart, different lobes farther
    assert float((one * other).sum(-1).min()) > math.cos(0.13)
    weights = matched.coefficients
    assert torch.allclose(weights.abs(), weights[:1].abs().expand_as(weights), atol=1e-9)


def test_smoothly_turning_transfer_is_interpolated():
    lobes, edges = turning_lobes(), grid(6)
    mixed, values = shuffled(lobes), harmonics(lobes)
    before = edge_error(mixed, values, edges)
    after = edge_error(corresponding(mixed, values, edges), values, edges)
    assert before.interpolated > 0.1
    assert after.interpolated < 1e-3
    assert after.interpolated < 0.1 * after.sampled
    assert after.points < 1e-3
    assert after.share > 0.6  # rows of equal texels gain nothing
    assert after.better <= min(after.interpolated, after.sampled)


def test_an_allowance_buys_correspondence():
    """Every other point sits in another fit of nearly the same function, two lobes for one."""
    lobes, edges = turning_lobes(lobes=3), grid(6)
    values = harmonics(lobes)
    axes = lobes.axes.clone()
    axes[1::2] = unit(1, 3, seed=8)
    solved = zonal.fit_coefficients(values, axes, 1e-7)[..., 2:]
    mixed = Lobes(axes, solved, lobes.linear)
    before = edge_error(mixed, values, edges)
    strict = edge_error(corresponding(mixed, values, edges, allowance=0.0), values, edges)
    free = edge_error(corresponding(mixed, values, edges), values, edges)
    assert free.interpolated < 0.1 * strict.interpolated < 0.2 * before.interpolated + 1.0
    assert free.points < 8.0 * before.points


def test_no_point_loses_more_than_its_allowance():
    generator = torch.Generator().manual_seed(3)
    lobes, edges = turning_lobes(), grid(6)
    noise = torch.randn(36, 1, ORDER**2, generator=generator, dtype=torch.float64)
    values = harmonics(lobes) + 0.3 * noise

    def relative(fitted: Lobes) -> torch.Tensor:
        """Squared error over squared norm of each point, of the bands of lobes."""
        lost = (harmonics(fitted) - values)[..., 4:].square().sum((1, 2))
        return lost / values.square().sum((1, 2))

    before = relative(lobes)
    for allowance in (1.0, 2.0):
        after = relative(corresponding(lobes, values, edges, allowance=allowance, ridge=1e-4))
        worst = (before.maximum(before.mean()) * allowance).maximum(before)
        assert bool((after <= worst * (1 + 1e-6) + 1e-9).all())


def test_isolated_points_zero_lobes_and_no_edges():
    lobes = turning_lobes(side=4)
    zero = [torch.zeros_like(part) for part in (lobes.coefficients, lobes.linear)]
    nothing = Lobes(lobes.axes, zero[0], zero[1])
    values = torch.zeros(16, 1, ORDER**2, dtype=torch.float64)
    found = corresponding(nothing, values, grid(4))
    assert float(found.coefficients.abs().max()) == 0.0
    assert bool(torch.isfinite(found.axes).all())
    assert edge_error(nothing, values, grid(4)).interpolated == 0.0
    values = harmonics(lobes)
    some = torch.tensor([[0, 1], [1, 2], [2, 2]])
    alone = corresponding(lobes, values, some)
    assert torch.allclose(harmonics(alone)[3:], values[3:], atol=1e-5)
    none = corresponding(lobes, values, some[:0])
    assert torch.allclose(harmonics(none), values, atol=1e-5)
    assert edge_error(lobes, values, some[:0]).share == 0.0


def test_two_lobes_carry_all_bands():
    axes = unit(1, 1, 2).expand(9, -1, -1, -1)
    generator = torch.Generator().manual_seed(1)
    weights = torch.rand(1, 1, 2, ORDER, generator=generator, dtype=torch.float64) + 0.5
    lobes = Lobes(axes, weights.expand(9, -1, -1, -1), torch.zeros(9, 1, 0, dtype=torch.float64))
    values = zonal.lobes_to_sh(lobes.axes, lobes.coefficients)
    found = corresponding(lobes, values, grid(3), allowance=0.0)
    assert torch.allclose(zonal.lobes_to_sh(found.axes, found.coefficients), values, atol=1e-5)


def test_interpolation_at_corners_and_its_gradients():
    lobes = turning_lobes(side=3)
    corners = torch.tensor([[0, 1], [4, 7], [8, 8]])
    ends = interpolate(lobes, corners, torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]]))
    for part in Lobes.names():
        assert torch.allclose(getattr(ends, part), getattr(lobes, part)[[0, 7, 8]])
    middle = interpolate(lobes, corners, torch.full((3, 2), 0.5))
    assert torch.allclose(middle.axes.norm(dim=-1), torch.ones(3, 1, 3, dtype=torch.float64))
    turned = frame_from_normal(unit(1, seed=4)[0])
    whole = Lobes(lobes.axes @ turned.mT, lobes.coefficients, lobes.linear)
    again = interpolate(whole, corners, torch.full((3, 2), 0.5))
    assert torch.allclose(again.axes, middle.axes @ turned.mT)

    def between(weights, *parts):
        found = interpolate(Lobes(*parts), corners, weights)
        return found.axes, found.coefficients, found.linear

    parts = [getattr(lobes, name).clone().requires_grad_() for name in Lobes.names()]
    weights = torch.rand(3, 2, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(between, (weights, *parts))


def test_order_of_edges_does_not_matter():
    lobes, edges = shuffled(turning_lobes()), grid(6)
    values = harmonics(lobes)
    twice = torch.cat([edges.flip(0), edges.flip(1)])
    one, other = (corresponding(lobes, values, given) for given in (edges, twice))
    for name in Lobes.names():
        assert torch.allclose(getattr(one, name), getattr(other, name), atol=1e-12)


def test_wrong_arguments_are_refused(without_type_checker):
    lobes = turning_lobes(side=2)
    values = harmonics(lobes)
    edges = grid(2)
    with pytest.raises(ValueError, match="expected values"):
        corresponding(lobes, values[:2], edges)
    for wrong in (edges + 2, edges - 1):
        with pytest.raises(ValueError, match="edges of points 0 to 3"):
            edge_error(lobes, values, wrong)
    with pytest.raises(ValueError, match='expected edges "edges 2"'):
        edge_error(lobes, values, edges[0])
    for name in ("allowance", "stiffness", "rounds"):
        with pytest.raises(ValueError, match="at least 0"):
            corresponding(lobes, values, edges, **{name: -1})


def test_the_best_order_of_four_lobes_against_all_orders():
    """Two points without anything in common: the order is that of the least difference."""
    axes = unit(2, 1, 4, seed=6)
    generator = torch.Generator().manual_seed(6)
    weights = torch.randn(2, 1, 4, ORDER - 2, generator=generator, dtype=torch.float64)
    linear = torch.zeros(2, 1, 4, dtype=torch.float64)
    lobes = Lobes(axes, weights, linear)
    values = harmonics(lobes)
    values = values / values.square().sum(-1, keepdim=True).sqrt()
    scaled = Lobes(axes, zonal.fit_coefficients(values, axes, 1e-12)[..., 2:], linear)
    found = corresponding(scaled, values, torch.tensor([[0, 1]]), allowance=0.0, rounds=0)

    def each(lobes: Lobes) -> torch.Tensor:
        """Harmonics of every lobe by itself, "points lobes coeffs"."""
        padded = torch.nn.functional.pad(lobes.coefficients, (2, 0))
        return zonal.lobes_to_sh(lobes.axes[..., None, :], padded[..., None, :])[:, 0]

    first, second = each(found)
    least = min(
        float((first - second[list(order)]).square().sum())
        for order in itertools.permutations(range(4))
    )
    assert float((first - second).square().sum()) == pytest.approx(least, rel=1e-6)
    assert sh.order_of(values) == ORDER


def test_between_points_lobes_are_interpolated_but_for_seams():
    smooth = turning_lobes()
    corners = grid(6)
    weights = torch.tensor([0.7, 0.3], dtype=torch.float64).expand(len(corners), 2)
    mixed = interpolate(smooth, corners, weights)
    found = between(smooth, corners, weights, ORDER)
    assert torch.allclose(found.axes, mixed.axes)
    assert torch.allclose(found.coefficients, mixed.coefficients)
    torn = shuffled(smooth)
    nearest = corners[:, 0]
    found = between(torn, corners, weights, ORDER)
    wanted = 0.7 * harmonics(torn)[nearest] + 0.3 * harmonics(torn)[corners[:, 1]]
    errors = [
        (harmonics(own) - wanted).square().sum(-1)
        for own in (found, interpolate(torn, corners, weights), torn[nearest])
    ]
    high = torch.where(errors[1] < errors[2], errors[1], errors[2])
    assert bool((errors[0] <= high + 1e-12).all())
    sampled = (found.coefficients == torn.coefficients[nearest]).all(-1).all(-1)
    assert float(sampled.double().mean()) > 0.5
    assert torch.allclose(found.linear, mixed.linear)
