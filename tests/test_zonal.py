"""Zonal lobes and rotations of harmonics point by point: known answers, other ways, extremes."""

import math

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from prt_torch.bases import sh, sh_zxzxz, zonal

DOUBLE = torch.float64
EXACT = 1e-12
"""Largest absolute difference of two ways to compute values near one in float64."""

CLAMPED_COSINE = [math.pi, 2 * math.pi / 3, math.pi / 4, 0, -math.pi / 24, 0, math.pi / 64, 0]
"""The g* of max(cos, 0)."""


def randn(*shape: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)


def worst(a: torch.Tensor, b: torch.Tensor) -> float:
    assert a.shape == b.shape
    return float((a.double() - b.double()).abs().max())


def turns(vectors: torch.Tensor) -> torch.Tensor:
    """Rotations around vectors by their lengths [rad]."""
    x, y, z = vectors.unbind(-1)
    o = torch.zeros_like(x)
    skew = torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))
    return torch.matrix_exp(skew)


def awkward_turns() -> torch.Tensor:
    """At and beside the turns where z stays or is reversed, and any others."""
    vectors = [[0, 0, 0], [0, 0, 2.0], [0, 1e-160, 0], [1e-9, 2e-9, 0], [1e-5, 0, 1.1]]
    vectors += [[math.pi, 0, 0], [0, math.pi - 1e-8, 0], [math.pi / 2, 0, 0]]
    exact = torch.stack([torch.diag(torch.tensor(d, dtype=DOUBLE)) for d in FLIPS])
    return torch.cat([exact, turns(torch.tensor(vectors, dtype=DOUBLE)), turns(randn(8, 3))])


FLIPS = [[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]


@pytest.mark.parametrize("axis", [[0.0, 0, 1], [0, 0, -1], [0.48, -0.6, 0.64], [0, 3e-30, 0]])
def test_a_clamped_cosine_turned_to_an_axis(axis):
    """Against its projection, by a quadrature that is laid out around the axis."""
    unit = zonal.unit_axes(torch.tensor(axis, dtype=DOUBLE))
    upper, weights = sh.hemisphere_quadrature(20)
    frame = torch.linalg.qr(torch.stack([unit, *torch.eye(3, dtype=DOUBLE)], -1))[0]
    frame = frame * torch.sign(frame[:, 0] @ unit)
    directions = upper[:, [2, 0, 1]] @ frame.mT
    expected = sh.evaluate(directions, 8).mT @ (weights * upper[:, 2])
    star = torch.tensor(CLAMPED_COSINE, dtype=DOUBLE)
    lobe = zonal.lobes_to_sh(torch.tensor([axis], dtype=DOUBLE), star[None])
    assert worst(lobe, expected) < EXACT
    plain = zonal.clamped_cosine_coefficients(8)
    assert worst(zonal.convolution_coefficients(plain), star) < EXACT
    assert worst(zonal.zonal_to_sh(plain, torch.tensor(axis, dtype=DOUBLE)), expected) < EXACT


def test_zonal_coefficients_are_those_at_m_zero():
    """Of functions whose coefficients are known, jumps included."""
    cosine = zonal.zonal_coefficients(lambda a: a.cos().clamp(min=0), 40, [math.pi / 2])
    assert worst(cosine, zonal.clamped_cosine_coefficients(40)) < EXACT
    harmonic = zonal.zonal_coefficients(
        lambda a: sh.evaluate(torch.stack([a.sin(), 0 * a, a.cos()], -1), 6)[:, 20], 6
    )
    assert worst(harmonic, torch.eye(6, dtype=DOUBLE)[4]) < EXACT
    edge = 0.3
    cap = zonal.zonal_coefficients(lambda a: (a < edge).double(), 2, [edge])
    constant = 2 * math.pi * (1 - math.cos(edge)) * math.sqrt(1 / (4 * math.pi))
    linear = math.pi * math.sin(edge) ** 2 * math.sqrt(3 / (4 * math.pi))
    assert worst(cap, torch.tensor([constant, linear], dtype=DOUBLE)) < EXACT
    with pytest.raises(ValueError, match="rising angles"):
        zonal.zonal_coefficients(torch.cos, 3, [2.0, 1.0])


@pytest.mark.parametrize("transparency", [0.0, 0.3, 1.0])
def test_thin_membrane(transparency):
    """Equation 23 against quadrature of equation 22, divided by pi; and its printed digits."""

    def profile(angles):
        z = angles.cos()
        return torch.where(z >= 0, z, -transparency * z) / math.pi

    plain = zonal.zonal_coefficients(profile, 9, [math.pi / 2])
    star = zonal.thin_membrane_coefficients(torch.tensor(transparency, dtype=DOUBLE), 9)
    assert worst(star, zonal.convolution_coefficients(plain)) < EXACT
    sum_, difference = 1 + transparency, 1 - transparency
    digits = [sum_, 2 / 3 * difference, sum_ / 4, 0, -sum_ / 24, 0, sum_ / 64, 0, -sum_ / 128]
    assert worst(star, torch.tensor(digits, dtype=DOUBLE)) < EXACT
    several = zonal.thin_membrane_coefficients(torch.full((2, 3), transparency), 9)
    assert several.shape == (2, 3, 9)
    assert several.dtype == torch.float32


def test_lobes_are_evaluated_as_their_harmonics_are():
    axes, coefficients = randn(5, 3, 3), randn(5, 3, 7, seed=2)
    axes[0, 0], axes[0, 1], axes[1] = 0, torch.tensor([0.0, 0, -1]), axes[1, 0]
    directions = zonal.unit_axes(randn(5, 12, 3, seed=3))
    harmonics = zonal.lobes_to_sh(axes, coefficients)
    values = (sh.evaluate(directions, 7) @ harmonics[..., None])[..., 0]
    assert worst(zonal.evaluate_lobes(axes, coefficients, directions), values) < 1e-11
    alone = torch.stack([zonal.lobes_to_sh(a, c) for a, c in zip(axes, coefficients, strict=True)])
    assert worst(alone, harmonics) == 0
    one = zonal.lobes_to_sh(axes[..., :1, :], coefficients[..., :1, :])
    rest = zonal.lobes_to_sh(axes[..., 1:, :], coefficients[..., 1:, :])
    assert worst(one + rest, harmonics) < EXACT


def test_negating_axis_and_odd_bands_changes_nothing():
    axes, coefficients = randn(9, 2, 3), randn(9, 2, 6, seed=2)
    signs = torch.tensor([1.0, -1, 1, -1, 1, -1], dtype=DOUBLE)
    turned = zonal.lobes_to_sh(-axes, coefficients * signs)
    assert worst(turned, zonal.lobes_to_sh(axes, coefficients)) < EXACT


def test_length_of_axes_does_not_matter_and_zero_is_up():
    coefficients = torch.ones(1, 6)
    axis = torch.tensor([[0.6, 0.0, -0.8]])
    for scale in (1e-30, 1e-6, 1e6, 1e30):
        scaled = zonal.lobes_to_sh(axis * scale, coefficients)
        assert worst(scaled, zonal.lobes_to_sh(axis, coefficients)) < 1e-6
    up = zonal.lobes_to_sh(torch.tensor([[0.0, 0, 1]]), coefficients)
    assert worst(zonal.lobes_to_sh(torch.zeros(1, 3), coefficients), up) == 0
    denormal = zonal.unit_axes(torch.tensor([1e-44, 0.0, 0.0]))
    assert bool(torch.isfinite(denormal).all())


@pytest.mark.parametrize(("order", "limit"), [(6, 1e-6), (33, 4e-5), (65, 1.4e-4)])
def test_lobes_in_float32(order, limit):
    axes = zonal.unit_axes(randn(100, 3)).float()
    axes[0], axes[1] = torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 0, -1])
    star = torch.ones(100, 1, order)
    exact = zonal.lobes_to_sh(axes[:, None].double(), star.double())
    assert worst(zonal.lobes_to_sh(axes[:, None], star), exact) < limit
    peaks = zonal.evaluate_lobes(axes[:, None], star, axes[:, None])
    assert float((peaks / (order**2 / (4 * math.pi)) - 1).abs().max()) < 1e-7 * order**2


def test_turned_lobes_are_turned_harmonics():
    axes, coefficients, rotation = randn(4, 3, 3), randn(4, 3, 6, seed=2), turns(randn(3, seed=3))
    harmonics = zonal.lobes_to_sh(axes, coefficients)
    turned = zonal.lobes_to_sh(axes @ rotation.mT, coefficients)
    assert worst(turned, harmonics @ sh.rotation_matrix(rotation, 6).mT) < EXACT
    energies = zonal.band_energies(harmonics)
    assert worst(zonal.band_energies(turned), energies) < 1e-11
    assert worst(energies.sum(-1), harmonics.square().sum(-1)) < 1e-11


def test_one_lobe_is_the_least_squares_solution():
    harmonics, axes = randn(5, 36), randn(5, 3, seed=2)
    axes[0], axes[1] = torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 0, -1])
    star = zonal.lobe_coefficients(harmonics, axes)
    fitted = zonal.fit_coefficients(harmonics, axes[:, None], zonal.LEAST_RIDGE)
    assert worst(fitted[:, 0], star) < 1e-10
    base = zonal.squared_errors(harmonics, axes[:, None], star[:, None])
    for step in (1e-3, -1e-3):
        other = zonal.squared_errors(harmonics, axes[:, None], star[:, None] + step)
        assert bool((other > base).all())
    known = zonal.lobes_to_sh(axes[:, None], randn(5, 1, 6, seed=3))
    assert worst(zonal.lobe_coefficients(known, axes), randn(5, 1, 6, seed=3)[:, 0]) < EXACT


@pytest.mark.parametrize("lobes", [1, 3, 5, 8])
def test_several_lobes_against_a_loop_of_dense_least_squares(lobes):
    """The least-norm solution band by band, with more lobes than harmonics and equal axes too."""
    harmonics, axes = randn(4, 25), randn(4, lobes, 3, seed=2)
    axes[3] = axes[3, :1]
    fitted = zonal.fit_coefficients(harmonics, axes, 1e-10)
    for point in range(4):
        functions = sh.evaluate(zonal.unit_axes(axes[point]), 5)
        for band in range(5):
            block = slice(band**2, (band + 1) ** 2)
            inverse = torch.linalg.pinv(functions[:, block].mT, rtol=1e-6)
            expected = inverse @ harmonics[point, block]
            assert worst(fitted[point, :, band], expected) < 1e-5 * (1 + expected.abs().max())
    single = zonal.fit_coefficients(harmonics.float(), axes.float(), 1e-6)
    assert single.dtype == torch.float32
    assert bool(torch.isfinite(single).all())


def test_ridge_bounds_coefficients_of_lobes_that_nearly_coincide():
    harmonics = randn(36)
    axes = torch.tensor([[0.0, 0.6, 0.8], [1e-6, 0.6, 0.8]], dtype=DOUBLE)
    largest = [float(zonal.fit_coefficients(harmonics, axes, r).abs().max()) for r in RIDGES]
    assert largest[0] > 1e4
    assert largest[2] < 10
    assert largest == sorted(largest, reverse=True)
    with pytest.raises(ValueError, match="ridge of at least"):
        zonal.fit_coefficients(harmonics, axes, 0.0)


RIDGES = [1e-12, 1e-8, 1e-3]


def test_ridge_is_relative_to_the_squared_norms_of_lobes():
    """The fit is where squared error + ridge * squared norms, summed lobe by lobe, has no slope."""
    harmonics, axes, ridge = randn(2, 25), randn(2, 3, 3, seed=2), 0.3
    fitted = zonal.fit_coefficients(harmonics, axes, ridge).requires_grad_()
    norms = zonal.lobes_to_sh(axes[..., None, :], fitted[..., None, :]).square().sum()
    (zonal.squared_errors(harmonics, axes, fitted).sum() + ridge * norms).backward()
    assert fitted.grad is not None
    assert float(fitted.grad.abs().max()) < EXACT


def test_extreme_signals():
    axes = randn(1, 4, 3)
    nothing = zonal.fit_coefficients(torch.zeros(1, 36, dtype=DOUBLE), axes)
    assert float(nothing.abs().max()) == 0
    assert zonal.optimal_linear_axis(torch.zeros(36)).tolist() == [0, 0, 1]
    constant = 2.0 * torch.eye(36, dtype=DOUBLE)[:1]
    fitted = zonal.fit_coefficients(constant, axes, zonal.LEAST_RIDGE)
    assert float(zonal.squared_errors(constant, axes, fitted).sum()) < 1e-20
    assert float(fitted[..., 1:].abs().max()) == 0
    axial = zonal.lobes_to_sh(axes[:, :1], randn(1, 1, 6, seed=2))
    fitted = zonal.fit_coefficients(axial, axes, zonal.LEAST_RIDGE)
    assert float(zonal.squared_errors(axial, axes, fitted).sum()) < 1e-20
    shared = zonal.fit_coefficients(axial, axes[:, :1].expand(1, 4, 3), zonal.LEAST_RIDGE)
    assert worst(shared.sum(1), randn(1, 1, 6, seed=2)[0]) < 1e-3
    assert worst(shared, shared[:, :1].expand(1, 4, 6)) < 1e-3


def test_optimal_linear_axis():
    """The linear band is a lobe around it; the rest of random signals is met by chance alone."""
    harmonics = randn(4000, 36)
    axes = zonal.optimal_linear_axis(harmonics)
    star = zonal.lobe_coefficients(harmonics, axes)
    errors = zonal.squared_errors(harmonics, axes[:, None], star[:, None])
    assert float(errors[:, :2].max()) < 1e-24
    assert bool((star[:, 1] > 0).all())
    share = errors.sum(-1) / zonal.band_energies(harmonics).sum(-1)
    deviation = (float(share.mean()) - 28 / 36) / float(share.std() / math.sqrt(4000))
    assert abs(deviation) < 4
    with pytest.raises(ValueError, match="at least 4 coefficients"):
        zonal.optimal_linear_axis(torch.zeros(1))


def test_wrong_numbers_of_coefficients_are_refused():
    with pytest.raises(ValueError, match="square number of coefficients, got 8"):
        zonal.band_energies(torch.zeros(8))
    with pytest.raises(ValueError, match="expected 9 coefficients, got 16"):
        zonal.squared_errors(torch.zeros(16), torch.zeros(2, 3), torch.zeros(2, 3))
    with pytest.raises(ValueError, match="at least one band"):
        zonal.legendre(torch.zeros(2), 0)


def test_gradients():
    axes = randn(2, 3, 3).requires_grad_()
    coefficients = randn(2, 3, 4, seed=2).requires_grad_()
    harmonics = randn(2, 16, seed=3).requires_grad_()
    directions = zonal.unit_axes(randn(2, 2, 3, seed=4)).requires_grad_()
    together = axes.detach()[:, :1].repeat(1, 3, 1).requires_grad_()
    poles = torch.tensor([[[0.0, 0, 1], [0, 0, -1]]] * 2, dtype=DOUBLE, requires_grad=True)
    assert gradcheck(zonal.lobes_to_sh, (axes, coefficients))
    assert gradcheck(zonal.lobes_to_sh, (poles, coefficients[:, :2]))
    assert gradcheck(zonal.evaluate_lobes, (axes, coefficients, directions))
    assert gradcheck(zonal.lobe_coefficients, (harmonics, axes[:, 0]))
    assert gradcheck(zonal.lobe_coefficients, (harmonics, poles[:, 1]))
    assert gradcheck(zonal.optimal_linear_axis, (harmonics,))
    assert gradcheck(zonal.squared_errors, (harmonics, axes, coefficients))
    assert gradcheck(lambda h, a: zonal.fit_coefficients(h, a, 1e-2), (harmonics, axes))
    assert gradcheck(lambda h, a: zonal.fit_coefficients(h, a, 1e-2), (harmonics, together))
    transparency = torch.tensor([0.0, 0.4], dtype=DOUBLE, requires_grad=True)
    assert gradcheck(lambda t: zonal.thin_membrane_coefficients(t, 5), (transparency,))


def test_gradients_at_zero_vectors_and_equal_axes_are_finite():
    axes = torch.zeros(1, 4, 3, dtype=torch.float32)
    axes[0, 2] = 1.0
    axes.requires_grad_()
    fitted = zonal.fit_coefficients(torch.ones(1, 36), axes)
    zonal.lobes_to_sh(axes, fitted).square().sum().backward()
    assert axes.grad is not None
    assert bool(torch.isfinite(axes.grad).all())
    assert float(axes.grad[0, [0, 1, 3]].abs().max()) == 0


@pytest.mark.parametrize("order", [1, 2, 6, 17])
def test_rotation_point_by_point(order):
    rotations = awkward_turns()
    harmonics = torch.nn.functional.normalize(randn(len(rotations), order**2), dim=-1)
    expected = (sh.rotation_matrix(rotations, order) @ harmonics[..., None])[..., 0]
    assert worst(sh_zxzxz.rotate(harmonics, rotations), expected) < EXACT
    assert worst(sh_zxzxz.rotate(harmonics.float(), rotations.float()), expected) < 2e-6
    assert sh_zxzxz.rotate(harmonics.float(), rotations).dtype == torch.float32


def test_rotations_broadcast_and_compose():
    first, second, harmonics = turns(randn(3, 3)), turns(randn(3, 3, seed=2)), randn(2, 1, 25)
    many = sh_zxzxz.rotate(harmonics, first)
    assert many.shape == (2, 3, 25)
    assert worst(many[1, 2], sh_zxzxz.rotate(harmonics[1, 0], first[2])) < EXACT
    twice = sh_zxzxz.rotate(many, second)
    assert worst(twice, sh_zxzxz.rotate(harmonics, second @ first)) < 1e-11
    assert sh_zxzxz.rotate(torch.zeros(0, 9), torch.zeros(0, 3, 3)).shape == (0, 9)
    with pytest.raises(ValueError, match="square number"):
        sh_zxzxz.rotate(torch.zeros(8), torch.eye(3))


def test_multiplications_are_those_of_the_paper():
    counts = [sh_zxzxz.multiplications(order) for order in range(3, 10)]
    assert counts == [53, 121, 217, 345, 509, 713, 961]
    with pytest.raises(ValueError, match="two bands"):
        sh_zxzxz.multiplications(1)


def test_quarter_turn_is_sparse():
    """All that the pattern leaves out is zero, and nothing that it keeps."""
    quarter = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=DOUBLE)
    whole = sh.rotation_matrix(quarter, 17)
    for band, share in {2: 0.2800, 5: 0.2562, 16: 0.2507}.items():
        block = whole[band**2 : (band + 1) ** 2, band**2 : (band + 1) ** 2]
        pattern = sh_zxzxz.quarter_turn_pattern(band)
        assert float(block[~pattern].abs().max()) < EXACT
        assert float(block[pattern].abs().min()) > 1e-6
        assert round(float(pattern.double().mean()), 4) == share
    (rows, columns), values = sh_zxzxz.quarter_turn(17)
    dense = torch.zeros_like(whole)
    dense[rows, columns] = values
    assert worst(dense, whole) < EXACT


@pytest.mark.parametrize("vector", [[0.0, 0, 0], [0, 0, 1.2], [math.pi, 0, 0], [0.3, -0.8, 0.5]])
def test_gradients_of_rotation_have_no_singular_turn(vector):
    harmonics = randn(1, 16).requires_grad_()
    start = turns(torch.tensor([vector], dtype=DOUBLE))
    step = torch.zeros(1, 3, dtype=DOUBLE, requires_grad=True)

    def turned(functions, small):
        return sh_zxzxz.rotate(functions, start @ turns(small))

    assert gradcheck(turned, (harmonics, step))
    assert gradgradcheck(turned, (harmonics, step))
