"""Harmonics over the hemisphere: every claim of Sloan et al. 2003, appendix 9, by its digits."""

import math

import pytest
import torch
from scipy import integrate

from prt_torch.bases import Diffuse, HemisphericalHarmonics, Rowwise, exit_basis, sh
from prt_torch.conventions import sh_index

GRAM = sh.hemisphere_gram(5)


def odd_in_z(order: int) -> torch.Tensor:
    """Which harmonics change sign with z: those with l + m odd."""
    pairs = [(band, m) for band in range(order) for m in range(-band, band + 1)]
    return torch.tensor([(band + m) % 2 == 1 for band, m in pairs])


def test_gram_against_numerical_integration():
    def product(azimuth: float, z: float, i: int, k: int) -> float:
        radius = math.sqrt(1 - z * z)
        direction = torch.tensor(
            [radius * math.cos(azimuth), radius * math.sin(azimuth), z], dtype=torch.float64
        )
        functions = sh.evaluate(direction, 3)
        return float(functions[i] * functions[k])

    for i, k in [(0, 0), (0, 2), (2, 6), (1, 5), (4, 4), (3, 8), (1, 3)]:
        expected, _ = integrate.dblquad(product, 0, 1, 0, 2 * math.pi, args=(i, k))
        assert float(GRAM[i, k]) == pytest.approx(expected, abs=1e-8)


def test_singular_values():
    singular = torch.linalg.svdvals(GRAM)
    assert float(singular[0]) == pytest.approx(0.99999340790, abs=2e-11)
    assert singular[-3:-1].tolist() == pytest.approx([3.0961974e-4] * 2, rel=1e-7)
    assert float(singular[-1]) == pytest.approx(6.5921141e-6, rel=1e-7)


@pytest.mark.parametrize(
    ("order", "condition"),
    [
        (2, 13.93),
        (3, 254.0),
        (4, 5875.0),
        (5, 1.517e5),
        (6, 4.159e6),
        (7, 1.185e8),
        (8, 3.465e9),
        (9, 1.033e11),
        (10, 3.123e12),
    ],
)
def test_condition_by_order(order, condition):
    # The matrix itself has rounding of 1e-16 times its condition: 3 digits are left at order 10.
    tolerance = 1e-3 if order < 10 else 1e-2
    found = float(torch.linalg.cond(sh.hemisphere_gram(order)))
    assert found == pytest.approx(condition, rel=tolerance)


def test_best_function_to_drop():
    losses = 1.0 / torch.linalg.inv(GRAM).diagonal()
    smallest = losses.argsort()[:4].tolist()
    assert smallest == [sh_index(1, 0), sh_index(0, 0), sh_index(2, 0), sh_index(3, 0)]
    expected = [1.4768431e-5, 2.61493e-5, 2.69165e-5, 1.2207031e-4]
    assert losses[smallest].tolist() == pytest.approx(expected, rel=2e-6)
    basis = HemisphericalHarmonics(24)
    assert sh_index(1, 0) not in basis.indices
    assert float(torch.linalg.cond(basis.gram())) == pytest.approx(3228.8, rel=1e-4)


def test_the_dropped_function_is_replaced_by_the_printed_combination():
    basis = HemisphericalHarmonics(24)
    views, weights = sh.hemisphere_quadrature(16)
    project = sh.hemisphere_projection(basis.evaluate(views), weights)
    coefficients = project @ sh.evaluate(views, 5)[:, sh_index(1, 0)]
    by_index = dict(zip(basis.indices.tolist(), coefficients.tolist(), strict=True))
    printed = {(0, 0): 0.751428, (2, 0): 0.740369, (3, 0): -0.346509, (4, 0): 0.085129}
    for (band, m), value in printed.items():
        assert by_index[sh_index(band, m)] == pytest.approx(value, abs=2e-6)


def unit_signal_errors(matrix: torch.Tensor) -> tuple[float, float]:
    """Largest and mean singular value: worst and mean squared error of unit signals."""
    singular = torch.linalg.svdvals(matrix)
    return float(singular.max()), float(singular.mean())


def test_zero_hemisphere_projection():
    rest = GRAM - torch.eye(25, dtype=torch.float64)
    worst, mean = unit_signal_errors(rest.mT @ GRAM @ rest)
    assert worst == pytest.approx(0.125, abs=1e-8)
    assert mean == pytest.approx(0.04020691, abs=1e-8)
    assert math.sqrt(worst) == pytest.approx(0.353553, abs=1e-6)
    assert math.sqrt(mean) == pytest.approx(0.200517, abs=1e-6)


def reflection_errors(order: int, odd: bool, signals: int = 25) -> tuple[int, float, float]:
    """How many functions reflection keeps, and its errors over signals of order 5."""
    gram = sh.hemisphere_gram(order)
    kept = odd_in_z(order) if odd else ~odd_in_z(order)
    project = 2.0 * kept.double()[:, None] * gram
    rest = project - torch.eye(order * order, dtype=torch.float64)
    block = (rest.mT @ gram @ rest)[:signals, :signals]
    return int(kept.sum()), *unit_signal_errors(block)


def test_odd_reflection():
    count, worst, mean = reflection_errors(8, odd=True)
    assert count == 28
    assert (worst, mean) == pytest.approx((0.14526885, 0.04437778), abs=1e-8)


@pytest.mark.parametrize(
    ("order", "functions", "worst", "mean"),
    [(7, 28, 0.02200546, 0.00357788), (8, 36, 0.00759, 0.00158), (5, 15, 0.19295395, 0.03041382)],
)
def test_even_reflection(order, functions, worst, mean):
    count, found_worst, found_mean = reflection_errors(order, odd=False)
    assert count == functions
    digits = 5e-6 if order == 8 else 1e-8
    assert (found_worst, found_mean) == pytest.approx((worst, mean), abs=digits)


def least_squares_residual(kept: torch.Tensor) -> torch.Tensor:
    """Quadratic form of what order-5 signals lose when projected onto some of the functions."""
    inner = GRAM[kept][:, kept]
    across = GRAM[kept]
    return GRAM - across.mT @ torch.linalg.solve(inner, across)


def test_even_reflection_of_order_5_is_least_squares_onto_the_even_functions():
    even = torch.nonzero(~odd_in_z(5))[:, 0]
    worst, mean = unit_signal_errors(least_squares_residual(even))
    assert (worst, mean) == pytest.approx((0.19295395, 0.03041382), abs=1e-7)


def test_sixteen_rows_by_least_squares_and_by_zero_hemisphere():
    """The paper's figure 7 holds on average only: the worst signal loses more with 16 rows."""
    worst, mean = unit_signal_errors(least_squares_residual(torch.arange(16)))
    assert (mean, worst) == pytest.approx((0.05752, 0.5), abs=5e-6)
    cut = torch.diag((torch.arange(25) < 16).double())
    rest = cut @ GRAM - torch.eye(25, dtype=torch.float64)
    worst, mean = unit_signal_errors(rest.mT @ GRAM @ rest)
    assert (mean, worst) == pytest.approx((0.15762, 0.5), abs=5e-6)


def test_projection_recovers_every_function_of_the_space():
    basis = HemisphericalHarmonics(25)
    views, weights = sh.hemisphere_quadrature(12)
    functions = basis.evaluate(views)
    coefficients = torch.randn(25, 3, dtype=torch.float64, generator=torch.manual_seed(0))
    project = sh.hemisphere_projection(functions, weights)
    assert torch.allclose(project @ functions @ coefficients, coefficients, atol=1e-10)


@pytest.mark.parametrize("order", [5, 8, 10, 12])
def test_projection_stays_bounded_where_the_gram_matrix_is_singular_to_rounding(order):
    """Weak combinations are dropped: noise grows by a thousand at most, smooth functions stay."""
    views, weights = sh.hemisphere_quadrature(4 * order)
    functions = sh.evaluate(views, order)
    project = sh.hemisphere_projection(functions, weights)
    noise = torch.linalg.matrix_norm(project / weights.sqrt(), ord=2)
    assert float(noise) < 1.01 / sh.PROJECTION_CUTOFF
    smooth = torch.exp(views[:, 2] - views[:, 0])
    lost = (functions @ (project @ smooth) - smooth).square() @ weights / (smooth**2 @ weights)
    assert float(lost) < 1e-5


def test_inverse_is_exact_to_order_5_and_bounded_beyond():
    for order in (1, 3, 5):
        product = sh.hemisphere_inverse(order) @ sh.hemisphere_gram(order)
        assert torch.allclose(product, torch.eye(order**2, dtype=torch.float64), atol=1e-9)
    for order in (6, 8, 12):
        assert float(torch.linalg.matrix_norm(sh.hemisphere_inverse(order), ord=2)) < 1.01e6


@pytest.mark.parametrize("num_rows", [1, 2, 4, 9, 15, 16, 24, 25, 36, 64])
def test_any_number_of_rows(num_rows):
    basis = HemisphericalHarmonics(num_rows)
    assert basis.num_rows == num_rows == len(basis.indices.unique())
    assert basis.order**2 >= num_rows > (basis.order - 1) ** 2
    assert int(basis.indices[0]) == 0
    assert basis.view_dependent == (num_rows > 1)
    again = exit_basis(basis.describe(), basis.tensors())
    view = torch.nn.functional.normalize(torch.tensor([[0.3, -0.2, 0.6]]), dim=-1)
    assert torch.equal(again.evaluate(view), basis.evaluate(view))
    views, weights = sh.hemisphere_quadrature(2 * basis.order - 2)
    functions = basis.evaluate(views)
    gram = functions.mT @ (functions * weights[:, None]) / (2 * math.pi)
    assert torch.allclose(gram, basis.gram(), atol=1e-12)


@pytest.mark.parametrize("num_rows", [0, -1, 65])
def test_rows_out_of_range(num_rows):
    with pytest.raises(ValueError, match="1 to 64 rows"):
        HemisphericalHarmonics(num_rows)


def test_views_below_the_horizon_are_taken_to_it():
    basis = HemisphericalHarmonics(24)
    level = torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64)
    below = torch.nn.functional.normalize(level - torch.tensor([0.0, 0.0, 0.7]), dim=-1)
    assert torch.allclose(basis.evaluate(below), basis.evaluate(level))
    straight_down = torch.tensor([0.0, 0.0, -1.0], requires_grad=True)
    basis.evaluate(straight_down).sum().backward()
    assert torch.isfinite(straight_down.grad).all()
    generic = torch.tensor([0.48, 0.6, 0.64], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(basis.evaluate, generic)


def test_norms_are_means_over_views():
    assert Diffuse().gram().tolist() == [[1.0]]
    assert torch.equal(Rowwise(3).gram(), torch.eye(3, dtype=torch.float64))
    constant = 1.0 / math.sqrt(4 * math.pi)
    assert float(HemisphericalHarmonics(24).gram()[0, 0]) == pytest.approx(constant**2)


def test_products_of_harmonics():
    directions = torch.nn.functional.normalize(
        torch.randn(20, 3, dtype=torch.float64, generator=torch.manual_seed(1)), dim=-1
    )
    products = sh.product_matrix(4, 3)
    assert products.shape == (16, 9, 36)
    expected = sh.evaluate(directions, 4)[:, :, None] * sh.evaluate(directions, 3)[:, None]
    found = torch.einsum("abc,nc->nab", products, sh.evaluate(directions, 6))
    assert torch.allclose(found, expected, atol=1e-12)
