"""Spherical radial basis functions: kernels, centres, projections, light, the light basis."""

import functools
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import special
from test_factored import RAYS, ball
from tolerances import ROUNDING

from prt_torch.assets.brdf import GGX
from prt_torch.assets.environment import Environment
from prt_torch.assets.material import Material
from prt_torch.baking import bake
from prt_torch.bases import (
    SRBF,
    BRDFFactors,
    CubeDirections,
    SphericalHarmonics,
    SRBFExpansion,
    light_basis,
    sh,
    srbf,
)
from prt_torch.config import load_config
from prt_torch.errors import InputError
from prt_torch.inputs import load_inputs
from prt_torch.sphere import (
    cubemap_directions,
    cubemap_index,
    cubemap_solid_angles,
    rotation_about_up,
)
from prt_torch.transfer import TransferTensor

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
KERNELS = ("gaussian", "abel_poisson")
TURN = torch.linalg.matrix_exp(
    torch.tensor([[0.0, 0.4, -1.0], [-0.4, 0.0, 0.7], [1.0, -0.7, 0.0]], dtype=torch.float64)
)


def number(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


def at_angle(angle: float) -> torch.Tensor:
    return torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)


def random_units(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(points, dim=-1)


@functools.cache
def quadrature(degree: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions and weights that integrate polynomials of this degree over the sphere."""
    z, weights = np.polynomial.legendre.leggauss(degree // 2 + 1)
    steps = degree + 1
    azimuth = 2 * math.pi * np.arange(steps) / steps
    level = np.sqrt(1 - z * z)[:, None]
    parts = [level * np.cos(azimuth), level * np.sin(azimuth), z[:, None] + 0 * azimuth]
    directions = torch.from_numpy(np.stack(parts, axis=-1)).view(-1, 3)
    return directions, torch.from_numpy(weights).repeat_interleave(steps) * (2 * math.pi / steps)


def values_of(kernel: str, *arguments: torch.Tensor) -> torch.Tensor:
    return (srbf.gaussian if kernel == "gaussian" else srbf.abel_poisson)(*arguments)


def products_of(kernel: str, *arguments: torch.Tensor) -> torch.Tensor:
    if kernel == "gaussian":
        return srbf.gaussian_inner_product(*arguments)
    return srbf.abel_poisson_inner_product(*arguments)


def scattered(kernel: str, count: int = 7, seed: int = 0) -> SRBFExpansion:
    """Light of both signs, with lobes wide enough for the quadrature of degree 200."""
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(count, generator=generator, dtype=torch.float64)
    bandwidths = 1 + 60 * share if kernel == "gaussian" else 0.2 + 0.6 * share
    coefficients = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return SRBFExpansion(random_units(count, seed + 1), bandwidths, coefficients, kernel)


@pytest.fixture(scope="module")
def paper() -> SRBF:
    return SRBF()


class TestKernels:
    def test_peak_and_integral(self):
        directions, weights = quadrature(200)
        widths = torch.tensor([0.0, 1e-8, 0.3, 7.0, 162.114], dtype=torch.float64)
        centers = UP.expand(5, 3)
        assert torch.equal(srbf.gaussian(UP[None], centers, widths), torch.ones(1, 5).double())
        found = weights @ srbf.gaussian(directions, centers, widths)
        expected = 2 * math.pi * -torch.expm1(-2 * widths) / widths
        expected[0] = 4 * math.pi
        assert torch.allclose(found, expected, rtol=1e-11, atol=0)
        widths = torch.tensor([0.0, 1e-8, 0.5, 0.8], dtype=torch.float64)
        found = weights @ srbf.abel_poisson(directions, UP.expand(4, 3), widths)
        assert torch.allclose(found, torch.full_like(found, 4 * math.pi), rtol=1e-11, atol=0)

    @pytest.mark.parametrize("kernel", KERNELS)
    def test_inner_products_are_integrals_of_products(self, kernel):
        directions, weights = quadrature(200)
        a, b = scattered(kernel, seed=1), scattered(kernel, 5, seed=4)
        of_a = values_of(kernel, directions, a.centers, a.bandwidths)
        of_b = values_of(kernel, directions, b.centers, b.bandwidths)
        found = products_of(kernel, a.centers, a.bandwidths, b.centers, b.bandwidths)
        assert torch.allclose(found, of_a.mT @ (of_b * weights[:, None]), rtol=1e-11, atol=1e-13)

    def test_the_corrected_equations_27_and_5(self):
        center = at_angle(math.acos(0.3))
        found = srbf.gaussian_inner_product(UP, number(3.0), center, number(7.0))
        assert float(found) == pytest.approx(0.151335289856, rel=1e-11)
        found = srbf.abel_poisson_inner_product(UP, number(0.5), center, number(0.7))
        assert float(found) == pytest.approx(12.6504996652, rel=1e-11)

    @pytest.mark.parametrize(
        ("width_a", "width_b", "angle", "expected"),
        [
            (0.0, 0.0, 0.0, 4 * math.pi),
            (0.0, 0.0, math.pi, 4 * math.pi),
            (1e-8, 1e-8, math.pi, 12.566370363031763),
            (1e6, 1.0, 0.0, 6.2831790240005625e-6),
            (1e6, 1.0, math.pi, 8.5033751351278617e-7),
            (1e6, 1e6, 0.0, 3.1415926535897932e-6),
            (1e6, 1e6, 1e-3, 2.4466751372845875e-6),
            (1e6, 1e6, math.pi, 0.0),
        ],
    )
    def test_extreme_inner_products(self, width_a, width_b, angle, expected):
        center = -UP if angle == math.pi else at_angle(angle)
        for dtype, bound in ((torch.float64, 1e-14), (torch.float32, 1e-4)):
            arguments = (UP, number(width_a), center, number(width_b))
            found = float(srbf.gaussian_inner_product(*(t.to(dtype) for t in arguments)))
            assert abs(found - expected) <= bound * expected

    def test_inner_products_to_the_last_digit(self):
        """Against 40 digits, over bandwidths 1e-8 to 1e6, wherever the exponent is below 30."""
        mp = pytest.importorskip("mpmath")
        compared = 0
        with mp.workdps(40):
            for a in (1e-8, 1e-3, 0.02, 0.3, 5.0, 162.114, 1e4, 1e6):
                for b in (1e-8, 0.05, 40.0, 1e6):
                    for angle in (0.0, 1e-3, 0.05, 1.0, 3.0):
                        x, _, z = (mp.mpf(float(t)) for t in at_angle(angle))
                        of_a, of_b = mp.mpf(a), mp.mpf(b)
                        r = mp.sqrt((of_b * x) ** 2 + (of_a + of_b * z) ** 2)
                        length = of_a + of_b * mp.sqrt(x * x + z * z)
                        if length - r > 30:
                            continue
                        expected = 4 * mp.pi * mp.exp(-of_a - of_b) * mp.sinh(r) / r
                        found = srbf.gaussian_inner_product(
                            UP, number(a), at_angle(angle), number(b)
                        )
                        # Centres are unit vectors to a rounding, which bandwidths multiply.
                        slack = abs(float(length - of_a - of_b)) + 1e-14
                        assert abs(float(found / float(expected)) - 1) <= slack
                        compared += 1
        assert compared > 80

    def test_float32_at_narrow_lobes(self):
        """The dot-product form is off by 0.15, the hyperbolic sine by 0.32 or infinite."""
        angles = torch.linspace(0, 5e-3, 200, dtype=torch.float64)
        tilt = torch.tensor([[0.48, 0.6, 0.64], [0.8, 0.0, -0.6], [-0.36, 0.8, -0.48]])
        center = (tilt.double() @ UP)[None]
        places = torch.stack([at_angle(float(angle)) for angle in angles]) @ tilt.double().mT
        for kernel, width, bound in (("gaussian", 1e6, 1e-4), ("abel_poisson", 0.9999, 3e-3)):
            arguments = (places, center, torch.tensor([width], dtype=torch.float64))
            exact = values_of(kernel, *arguments)
            rounded = values_of(kernel, *(t.float() for t in arguments))
            assert float((rounded - exact).abs().max() / exact.max()) < bound
        widths = torch.full((200,), 1e6, dtype=torch.float64)
        arguments = (places, widths, center, widths[:1])
        exact = srbf.gaussian_inner_product(*arguments)
        rounded = srbf.gaussian_inner_product(*(t.float() for t in arguments))
        assert float((rounded - exact).abs().max() / exact.max()) < 1e-4

    def test_gaussian_legendre_coefficients_against_bessel_functions(self):
        degrees = np.arange(40)
        for width in (1e-8, 1e-3, 0.09, 0.11, 1.0, 162.114, 1e3, 1e4, 1e6):
            scale = (2 * degrees + 1) * math.sqrt(math.pi / (2 * width))
            expected = torch.from_numpy(scale * special.ive(degrees + 0.5, width))
            found = srbf.gaussian_legendre(number(width), 40)
            shown = expected > 1e-280
            assert torch.allclose(found[shown], expected[shown], rtol=1e-10, atol=0)
        assert srbf.gaussian_legendre(number(0.0), 3).tolist() == [1.0, 0.0, 0.0]

    @pytest.mark.parametrize("kernel", KERNELS)
    def test_legendre_series_is_the_kernel(self, kernel):
        width = number(30.0 if kernel == "gaussian" else 0.7)
        of = srbf.gaussian_legendre if kernel == "gaussian" else srbf.abel_poisson_legendre
        cosines = np.linspace(-1, 1, 41)
        series = np.polynomial.legendre.legval(cosines, of(width, 100).numpy())
        places = torch.stack([at_angle(math.acos(cosine)) for cosine in cosines])
        expected = values_of(kernel, places, UP[None], width[None])[:, 0]
        assert np.allclose(series, expected.numpy(), atol=1e-11 * float(expected.max()))

    @pytest.mark.parametrize("kernel", KERNELS)
    def test_gradients(self, kernel):
        a, b = scattered(kernel, 3), scattered(kernel, 2, seed=5)
        of_a = (a.centers.clone().requires_grad_(), a.bandwidths.clone().requires_grad_())
        of_b = (b.centers.clone().requires_grad_(), b.bandwidths.clone().requires_grad_())
        kernels = functools.partial(products_of, kernel)
        assert torch.autograd.gradcheck(kernels, (*of_a, *of_b))
        assert torch.autograd.gradcheck(functools.partial(values_of, kernel), (b.centers, *of_a))
        assert torch.autograd.gradcheck(
            lambda widths: srbf.gaussian_legendre(widths, 5), (of_a[1],)
        )

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    @pytest.mark.parametrize("kernel", KERNELS)
    def test_gradients_are_finite_at_coincident_and_opposite_centers(self, kernel, dtype):
        centers = random_units(4).to(dtype)
        others = torch.stack([centers[0], -centers[1], -centers[2], centers[3]])
        widths = torch.tensor([0.0, 0.0, 0.9, 0.9], dtype=dtype)
        tensors = [centers, widths, others, widths.clone()]
        for tensor in tensors:
            tensor.requires_grad_()
        products_of(kernel, *tensors).sum().backward()
        assert all(torch.isfinite(tensor.grad).all() for tensor in tensors)

    @pytest.mark.parametrize("width", [0.0, 1e-8, 0.04, 0.06, 3.0])
    def test_gradient_where_opposite_lobes_cancel(self, width):
        """At r = 0 the integral is 4π e^{-(a + b)}, which falls as it is, and near it nearly so."""
        for tilt in (0.0, 1e-12):
            one, other = (number(width).requires_grad_() for _ in range(2))
            value = srbf.gaussian_inner_product(UP, one, -at_angle(tilt), other)
            value.backward()
            assert float(value.detach()) == pytest.approx(
                4 * math.pi * math.exp(-2 * width), rel=1e-12
            )
            assert float(one.grad) == pytest.approx(-float(value.detach()), rel=1e-9)

    @pytest.mark.parametrize("kernel", KERNELS)
    def test_leading_axes_and_single_centers(self, kernel):
        a, b = scattered(kernel, 6), scattered(kernel, 4, seed=3)
        arguments = (a.centers, a.bandwidths, b.centers, b.bandwidths)
        whole = products_of(kernel, *arguments)
        split = products_of(
            kernel, a.centers.view(2, 3, 3), a.bandwidths.view(2, 3), *arguments[2:]
        )
        assert torch.equal(split.reshape(6, 4), whole)
        first = products_of(kernel, a.centers[0], a.bandwidths[0], *arguments[2:])
        last = products_of(kernel, *arguments[:2], b.centers[1], b.bandwidths[1])
        both = products_of(kernel, a.centers[0], a.bandwidths[0], b.centers[1], b.bandwidths[1])
        assert torch.equal(first, whole[0])
        assert torch.equal(last, whole[:, 1])
        assert both.shape == ()
        assert torch.equal(both, whole[0, 1])
        values = values_of(kernel, b.centers, a.centers.view(2, 3, 3), a.bandwidths.view(2, 3))
        assert values.shape == (2, 4, 3)


class TestCenters:
    def test_distances_of_642(self):
        centers = srbf.icosahedral_centers(3)
        cosines = (centers @ centers.mT).fill_diagonal_(-1.0)
        nearest = cosines.amax(1).acos()
        assert float(nearest.min()) == pytest.approx(0.138394, abs=1e-6)
        assert float(nearest.mean()) == pytest.approx(0.141308, abs=1e-6)
        edges = cosines[cosines.acos() < 0.17].acos()
        assert len(edges) == 2 * 1920
        assert float(edges.mean()) == pytest.approx(0.150875, abs=1e-6)
        assert float(edges.max()) == pytest.approx(0.164834, abs=1e-6)

    def test_each_set_holds_the_one_before(self):
        for subdivisions, count in enumerate((12, 42, 162, 642, 2562)):
            centers = srbf.icosahedral_centers(subdivisions)
            assert centers.shape == (count, 3)
            assert torch.allclose(centers.norm(dim=1), torch.ones(count).double(), atol=1e-15)
            assert float(centers.sum(0).abs().max()) < 1e-11
            if subdivisions:
                before = srbf.icosahedral_centers(subdivisions - 1)
                assert torch.equal(centers[: len(before)], before)
        with pytest.raises(ValueError, match="expected 0 to 4 subdivisions, got 5"):
            srbf.icosahedral_centers(5)

    def test_default_bandwidths(self):
        assert srbf.default_bandwidth(642) == pytest.approx(162.1139, abs=1e-4)
        assert srbf.default_bandwidth(642, "abel_poisson") == pytest.approx(0.924315, abs=1e-6)
        wider = [srbf.default_bandwidth(count) for count in (12, 42, 162, 642, 2562)]
        assert wider == sorted(wider)
        with pytest.raises(ValueError, match="among 12, 42, 162, 642, 2562, got 100"):
            srbf.default_bandwidth(100)

    @pytest.mark.parametrize(
        ("bandwidth", "collocation", "gram"),
        [
            (162.114, 4.457, 51.32),
            (161.8635, 4.475, 51.70),
            (40.0, 4652, 2.9e7),
            (80.0, 53.5, 5594),
            (300.0, 1.47, 5.46),
        ],
    )
    def test_conditions(self, bandwidth, collocation, gram):
        basis = SRBF(bandwidth=bandwidth)
        assert basis.condition == pytest.approx(gram, rel=0.02)
        values = srbf.gaussian(basis.centers, basis.centers, basis.bandwidths)
        eigenvalues = torch.linalg.eigvalsh(values)
        assert float(eigenvalues[-1] / eigenvalues[0]) == pytest.approx(collocation, rel=2e-3)

    def test_the_paper_read_as_a_variance_is_singular(self):
        """π/40 as a variance: collocation at 1.39e10, and no float64 factor of the Gram matrix."""
        wide = SRBF(bandwidth=12.477)
        values = srbf.gaussian(wide.centers, wide.centers, wide.bandwidths)
        eigenvalues = torch.linalg.eigvalsh(values)
        assert float(eigenvalues[-1] / eigenvalues[0]) == pytest.approx(1.39e10, rel=0.01)
        assert wide.condition > 1e15
        assert torch.linalg.cond(wide.gram()) == pytest.approx(1e8, rel=0.01)


class TestProjections:
    def test_centers_that_coincide_share_alike(self):
        centers, widths = torch.stack([UP, UP, at_angle(0.5)]), torch.full((3,), 20.0).double()
        gram = srbf.gaussian_inner_product(centers, widths, centers, widths)
        function = torch.tensor([[2.0], [0.0], [2.0]], dtype=torch.float64)
        found = srbf.gram_projection(gram, gram @ function)
        expected = torch.tensor([[1.0], [1.0], [2.0]], dtype=torch.float64)
        assert torch.allclose(found.coefficients, expected, atol=1e-12)
        assert found.condition > 1e14
        samples = srbf.gaussian(random_units(50), centers, widths)
        found = srbf.collocation_projection(samples, samples @ function)
        assert torch.allclose(found.coefficients, expected, atol=1e-12)
        assert found.condition > 1e14

    def test_ridge_is_regularised_least_squares(self):
        light = scattered("gaussian", 6)
        kernels = srbf.gaussian(random_units(40, 9), light.centers, light.bandwidths)
        values = torch.randn(40, 2, generator=torch.Generator().manual_seed(2)).double()
        normal, projected = kernels.mT @ kernels, kernels.mT @ values
        for ridge in (0.0, 0.3):
            expected = torch.linalg.solve(normal + ridge * torch.eye(6).double(), projected)
            by_samples = srbf.collocation_projection(kernels, values, ridge)
            by_products = srbf.gram_projection(normal, projected, ridge)
            assert torch.allclose(by_samples.coefficients, expected, atol=1e-10)
            assert torch.allclose(by_products.coefficients, expected, atol=1e-10)
            assert by_samples.condition**2 == pytest.approx(by_products.condition, rel=1e-8)

    def test_nothing_fails(self, without_type_checker):
        zero = torch.zeros(3, 3)
        assert not srbf.gram_projection(zero, torch.ones(3, 1)).coefficients.any()
        assert srbf.collocation_projection(zero, torch.ones(3, 1)).condition == math.inf
        assert srbf.collocation_projection(torch.ones(1, 4), torch.ones(1, 1)).condition == math.inf
        zero[0, 1] = math.nan
        for project in (srbf.gram_projection, srbf.collocation_projection):
            with pytest.raises(ValueError, match="expected finite kernels, got 1 values"):
                project(zero, torch.ones(3, 1))

    @pytest.mark.parametrize(
        ("function", "lowest", "share", "slack"),
        [
            (torch.ones_like, 0.0, 0.01302, 5e-4),
            (lambda z: z, 0.0, 1.11e-4, 3e-6),
            (torch.ones_like, -1.0, 8.4e-5, 1e-6),
            (torch.ones_like, math.cos(math.radians(20)), 0.0666, 6e-3),
        ],
        ids=["hemisphere", "clamped_cosine", "constant", "cap"],
    )
    def test_squared_errors(self, paper, function, lowest, share, slack):
        """Of functions of the height above a slanted axis; rings are integrated in closed form.

        A cap's error is 6.4 to 8.1 %, a hemisphere's 1.26 to 1.61 %, as its axis lies among the
        centres.
        """
        nodes, weights = np.polynomial.legendre.leggauss(300)
        z = torch.from_numpy(lowest + 0.5 * (nodes + 1) * (1 - lowest))
        weighted = torch.from_numpy(weights) * 0.5 * (1 - lowest) * function(z)
        cosines = paper.centers @ random_units(8, seed=0)[7]
        level = paper.bandwidth * ((1 - z * z)[:, None] * (1 - cosines * cosines)).sqrt()
        exponent = paper.bandwidth * (z[:, None] * cosines - 1) + level
        rings = 2 * math.pi * exponent.exp() * torch.special.i0e(level)
        inner_products = (weighted @ rings)[:, None]
        squared = 2 * math.pi * float(weighted @ function(z))
        coefficients = srbf.gram_projection(paper.gram(), inner_products).coefficients
        found = 1 - float((coefficients * inner_products).sum()) / squared
        assert found == pytest.approx(share, abs=slack)
        solved = torch.cholesky_solve(inner_products, torch.linalg.cholesky(paper.gram()))
        assert torch.allclose(coefficients, solved, atol=1e-10)


class TestExpansion:
    @pytest.mark.parametrize("kernel", KERNELS)
    def test_norm_and_turn(self, kernel):
        directions, weights = quadrature(200)
        light = scattered(kernel)
        values = light.evaluate(directions)
        assert torch.allclose(light.squared_norm(), weights @ values.square(), rtol=1e-11)
        turned = light.rotated(TURN)
        assert torch.allclose(turned.evaluate(directions @ TURN.mT), values, atol=1e-11)

    @pytest.mark.parametrize(("kernel", "bound"), [("gaussian", 1e-8), ("abel_poisson", 1e-5)])
    def test_spherical_harmonics_of_it(self, kernel, bound):
        """A lobe's harmonics are those of its centre times its Legendre coefficients."""
        light, order = scattered(kernel), 5
        of = srbf.gaussian_legendre if kernel == "gaussian" else srbf.abel_poisson_legendre
        legendre = of(light.bandwidths, order)
        bands = torch.repeat_interleave(
            torch.arange(order), 2 * torch.arange(order) + 1, output_size=order * order
        )
        per_band = legendre[:, bands] * (4 * math.pi / (2 * bands + 1))
        expected = (sh.evaluate(light.centers, order) * per_band).mT @ light.coefficients
        found = SphericalHarmonics(order).project(light)
        assert torch.allclose(found, expected, atol=bound * float(expected.abs().max()))

    @pytest.mark.parametrize("spacing", [3.0, 0.4, 0.05])
    def test_samples_tile_the_sphere(self, spacing):
        blocks = list(scattered("gaussian").sample_blocks(spacing))
        directions, solid_angles, _ = (torch.cat(parts) for parts in zip(*blocks, strict=True))
        assert float(solid_angles.sum()) == pytest.approx(4 * math.pi, rel=1e-12)
        assert float(solid_angles.min()) > 0
        assert float(solid_angles.max().sqrt()) <= spacing
        assert torch.allclose(directions.norm(dim=1), torch.ones_like(solid_angles), atol=1e-14)

    @pytest.mark.parametrize(("kernel", "width"), [("gaussian", 1e6), ("abel_poisson", 0.9999)])
    def test_lobes_beyond_the_grid_keep_their_energy(self, kernel, width):
        center, color = at_angle(0.7), torch.tensor([[1e6, 1.0, -2.0]], dtype=torch.float64)
        light = SRBFExpansion(center[None], number(width)[None], color, kernel)
        coarse, rows = light._resolved_by(400)
        assert rows == 400
        directions, weights = quadrature(399)
        one = color[0] * (2 * math.pi / width if kernel == "gaussian" else 4 * math.pi)
        assert torch.allclose(weights @ coarse.evaluate(directions), one, rtol=1e-5)
        assert light._resolved_by(400_000)[0].bandwidths.tolist() == [width]

    def test_what_does_not_fit_together_is_refused(self, without_type_checker):
        with pytest.raises(ValueError, match="expected kernel gaussian or abel_poisson, got box"):
            SRBFExpansion(UP[None], torch.ones(1), torch.ones(1, 3), "box")
        with pytest.raises(ValueError, match="expected centres n 3"):
            SRBFExpansion(UP[None], torch.ones(2), torch.ones(2, 3))
        with pytest.raises(ValueError, match="expected a spacing above 0"):
            next(scattered("gaussian").sample_blocks(0.0))


class TestBasis:
    @pytest.mark.parametrize("kernel", KERNELS)
    def test_light_of_its_kernel_is_projected_exactly(self, kernel):
        directions, weights = quadrature(200)
        basis, light = SRBF(42, kernel), scattered(kernel)
        values = values_of(kernel, directions, basis.centers, basis.bandwidths)
        expected = values.mT @ (light.evaluate(directions) * weights[:, None])
        assert torch.allclose(basis.project(light), expected, rtol=0, atol=1e-10)

    def test_light_of_any_kind_is_integrated(self):
        """Of the other kernel by its samples, of an image by its pixels; linear in light."""
        directions, weights = quadrature(200)
        basis, light = SRBF(42), scattered("abel_poisson")
        values = srbf.gaussian(directions, basis.centers, basis.bandwidths)
        expected = values.mT @ (light.evaluate(directions) * weights[:, None])
        assert torch.allclose(
            basis.project(light), expected, atol=1e-5 * float(expected.abs().max())
        )
        image = torch.ones(8, 16, 3, dtype=torch.float64)
        found = basis.project(Environment("constant", image, "latlong"))
        total = 2 * math.pi * (1 - math.exp(-2 * basis.bandwidth)) / basis.bandwidth
        assert torch.allclose(found, torch.full_like(found, total), rtol=1e-3)

    def test_light_by_texels_is_projected_by_one_product(self):
        """The same light as an image of those texels, several at once, in both types."""
        basis = SRBF(162, resolution=8)
        images = torch.rand(2, 6, 8, 8, 3, generator=torch.Generator().manual_seed(2))
        images[1, 2, 3, 4] = 1e4
        found = basis.project_texels(images.flatten(1, 3).double())
        for image, light in zip(images, found, strict=True):
            expected = basis.project(Environment("texels", image, "cube"))
            assert torch.allclose(light, expected, rtol=1e-2, atol=2e-3 * float(expected.max()))
        single = basis.project_texels(images.flatten(1, 3))
        assert torch.allclose(single.double(), found, atol=1e-5 * float(found.max()))

    def test_a_sun_of_one_texel(self):
        """Its energy arrives: inner products are kernels at the sun times radiance and angle."""
        basis, image = SRBF(162), torch.zeros(6, 64, 64, 3)
        image[2, 20, 40] = torch.tensor([1e9, 1e6, 1.0])
        sun = cubemap_directions(64, dtype=torch.float64)[2, 20, 40]
        angle = float(cubemap_solid_angles(64, dtype=torch.float64)[2, 20, 40])
        found = basis.project(Environment("sun", image, "cube"))
        expected = srbf.gaussian(sun[None], basis.centers, basis.bandwidths).mT * angle
        expected = expected * image[2, 20, 40].double()
        assert torch.allclose(found, expected, rtol=0.02, atol=1e-4 * float(expected.max()))

    @pytest.mark.parametrize("kernel", KERNELS)
    def test_functions_in_the_span_come_back(self, kernel):
        """From integrals over texels as coarse as these."""
        coefficients = torch.randn(12, 3, generator=torch.Generator().manual_seed(1)).double()
        for resolution in (4, 16):
            basis = SRBF(12, kernel, resolution=resolution)
            light = SRBFExpansion(basis.centers, basis.bandwidths, coefficients, kernel)
            fine = cubemap_directions(4 * resolution, dtype=torch.float64).view(-1, 3)
            solid_angles = cubemap_solid_angles(4 * resolution, dtype=torch.float64).flatten()
            values = (light.evaluate(fine) * solid_angles[:, None]).mT
            found = basis.project_cube(values, 4 * resolution)
            assert torch.allclose(found, coefficients.mT, atol=1e-10)

    def test_norm_of_a_projection_is_what_it_kept(self):
        """Of a sharp function: its square less that of the error, so reports may subtract."""
        basis = SRBF(162, resolution=16)
        fine = cubemap_directions(64, dtype=torch.float64).view(-1, 3)
        solid_angles = cubemap_solid_angles(64, dtype=torch.float64).flatten()
        function = (fine @ random_units(10).mT > 0).double().mT
        found = basis.project_cube(function * solid_angles, 64)
        kernels = srbf.gaussian(fine, basis.centers, basis.bandwidths)
        errors = (function - found @ kernels.mT).square() @ solid_angles
        squared = function.square() @ solid_angles
        assert torch.allclose(basis.squared_norm(found), squared - errors, rtol=2e-3)
        best = torch.cholesky_solve(
            kernels.mT @ (function * solid_angles).mT, torch.linalg.cholesky(basis.gram())
        ).mT
        least = (function - best @ kernels.mT).square() @ solid_angles
        assert bool((errors < 1.05 * least).all())

    def test_projection_of_texels_is_the_least_squares_solution(self):
        """A second way: the average of each kernel over each texel by brute force."""
        basis = SRBF(42, resolution=8)
        fine = cubemap_directions(64, dtype=torch.float64).view(-1, 3)
        weights = cubemap_solid_angles(64, dtype=torch.float64).flatten()
        texel = cubemap_index(fine, 8)
        weighted = srbf.gaussian(fine, basis.centers, basis.bandwidths) * weights[:, None]
        means = torch.zeros(384, 42, dtype=torch.float64).index_add(0, texel, weighted)
        means /= torch.zeros(384, dtype=torch.float64).index_add(0, texel, weights)[:, None]
        values = torch.rand(5, 384, generator=torch.Generator().manual_seed(0)).double()
        roots = CubeDirections(8).solid_angles.sqrt()[:, None]
        expected = torch.linalg.lstsq(means * roots, values.mT / roots).solution.mT
        found = basis.project_cube(values, 8)
        assert float((found - expected).abs().max() / expected.abs().max()) < 5e-3
        assert torch.allclose(basis.project_cube(values.float(), 8).double(), found, atol=1e-5)
        finer = values.view(5, 6, 8, 1, 8, 1).expand(5, 6, 8, 2, 8, 2).reshape(5, -1) / 4
        assert torch.allclose(basis.project_cube(finer, 16), found, atol=1e-12)
        with pytest.raises(ValueError, match="multiple of it, got 10"):
            basis.project_cube(torch.zeros(1, 600), 10)

    def test_radiance_is_near_that_of_texels(self, paper):
        """Clamped cosines lose 0.011 % of their square, so radiance at most the root of it."""
        generator = torch.Generator().manual_seed(0)
        colors = torch.rand(30, 3, generator=generator, dtype=torch.float64)
        widths = 1 + 300 * torch.rand(30, generator=generator, dtype=torch.float64)
        light = SRBFExpansion(random_units(30), widths, colors)
        directions = cubemap_directions(32, dtype=torch.float64).view(-1, 3)
        solid_angles = cubemap_solid_angles(32, dtype=torch.float64).flatten()
        values = (random_units(20, 5) @ directions.mT).clamp(min=0) * solid_angles / math.pi
        expected = values @ light.evaluate(directions)
        found = paper.project_cube(values, 32) @ paper.project(light)
        squared = CubeDirections(32).squared_norm(values)[:, None] * light.squared_norm()
        errors = (found - expected).abs()
        assert bool((errors < (1.5e-4 * squared).sqrt()).all())
        assert float((errors / expected).max()) < 0.01

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    @pytest.mark.parametrize("kernel", KERNELS)
    def test_weighing(self, kernel, dtype):
        basis = SRBF(162, kernel)
        values = torch.randn(2, 3, 162, generator=torch.Generator().manual_seed(0)).to(dtype)
        light = torch.randn(2, 162, 3, generator=torch.Generator().manual_seed(1)).to(dtype)
        weighed = basis.weigh(values)
        norms = torch.einsum("abi,ij,abj->ab", values.double(), basis.gram(), values.double())
        rounding = 10 * ROUNDING[dtype]
        assert weighed.dtype == dtype
        assert torch.allclose(weighed.double().square().sum(-1), norms, rtol=rounding)
        assert torch.allclose(basis.unweigh(weighed), values, atol=rounding)
        assert torch.allclose(
            weighed @ basis.weigh_light(light), values @ light, atol=100 * rounding
        )
        assert torch.allclose(basis.squared_norm(values), norms, rtol=rounding)
        lit = basis.weigh_light(basis.gram().to(dtype) @ values[0].mT)
        assert torch.allclose(lit.mT, weighed[0], atol=10 * rounding)

    @pytest.mark.parametrize("kernel", KERNELS)
    def test_turning_light_of_the_span(self, kernel):
        """Against the integral of the turned function with each kernel."""
        directions, weights = quadrature(200)
        basis = SRBF(42, kernel)
        coefficients = torch.randn(42, 3, generator=torch.Generator().manual_seed(0)).double()
        light = SRBFExpansion(basis.centers, basis.bandwidths, coefficients, kernel)
        values = values_of(kernel, directions, basis.centers, basis.bandwidths)
        turned = light.evaluate(directions @ TURN)  # at R⁻¹ s
        expected = values.mT @ (turned * weights[:, None])
        found = basis.rotate(basis.project(light), TURN)
        assert torch.allclose(found, expected, atol=1e-9 * float(expected.abs().max()))
        single = basis.rotate(basis.project(light).float()[None], TURN.float())
        assert single.dtype == torch.float32
        assert torch.allclose(single[0].double(), expected, atol=1e-5 * float(expected.abs().max()))
        assert torch.allclose(
            basis.rotate(basis.project(light), torch.eye(3).double()), basis.project(light)
        )

    @pytest.mark.parametrize(("count", "bandwidth"), [(162, 3.0), (42, 1e-6)])
    def test_wide_kernels_do_not_fail(self, count, bandwidth):
        """Their Gram matrix is singular in float64; what they hold is still right."""
        basis = SRBF(count, bandwidth=bandwidth, resolution=8)
        assert basis.condition > 1e9
        eigenvalues = torch.linalg.eigvalsh(basis.gram())
        assert float(eigenvalues[-1] / eigenvalues[0]) == pytest.approx(1e8, rel=1e-2)
        cube = CubeDirections(8)
        values = cube.solid_angles[None] * torch.ones(1, cube.num_coeffs).double()
        light = basis.project(SRBFExpansion(UP[None], number(2.0)[None], torch.ones(1, 3).double()))
        radiance = basis.project_cube(values, 8) @ light
        expected = 2 * math.pi * -math.expm1(-4.0) / 2.0
        assert torch.allclose(radiance, torch.full_like(radiance, expected), rtol=1e-4)
        weighed = basis.weigh(basis.project_cube(values, 8))
        assert float(weighed.square().sum()) == pytest.approx(4 * math.pi, rel=1e-3)

    def test_described_and_made_again(self):
        basis = SRBF(42, "abel_poisson", resolution=8)
        again = light_basis(basis.describe())
        assert isinstance(again, SRBF)
        assert again.describe() == basis.describe()
        assert again.name == "SRBF 42 abel_poisson"
        assert torch.equal(again.gram(), basis.gram())
        assert basis.table_bytes(16) == 42 * (4 * 384 + 16 * 42)
        with pytest.raises(InputError, match="sh, cube, haar or srbf"):
            light_basis({"name": "srbf"})

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ((100,), "among 12, 42, 162, 642, 2562, got 100"),
            ((42, "box"), "expected kernel gaussian or abel_poisson, got box"),
            ((42, "gaussian", 0.0), "expected a bandwidth above 0 and below inf, got 0.0"),
            ((42, "abel_poisson", 1.0), "expected a bandwidth above 0 and below 1.0, got 1.0"),
            ((42, "gaussian", None, 0), "expected a cube resolution of at least 1, got 0"),
        ],
    )
    def test_misuse_is_refused(self, arguments, message, without_type_checker):
        with pytest.raises(ValueError, match=message):
            SRBF(*arguments)


class TestBakes:
    def test_are_fits_of_bakes_in_texels(self):
        """Diffuse, and glossy in BRDF factors: exactly what their texels would be fitted by."""
        mesh, basis, cube = ball(), SRBF(42, resolution=8), CubeDirections(8)
        glossy = Material(lambertian=False, glossy=GGX(f0=0.6, roughness=0.5))
        factors = BRDFFactors.from_brdf(glossy.glossy, num_terms=3, resolution=8)
        for materials, made in ((None, None), (glossy, factors)):
            bake_with = functools.partial(bake, mesh, materials=materials, factors=made, **RAYS)
            found, texels = bake_with(light_basis=basis), bake_with(light_basis=cube)
            assert isinstance(found, TransferTensor)
            assert found.surface.light_basis is basis
            expected = basis.project_cube(texels.dense().flatten(0, 2), 8)
            assert found.dense().shape[:3] == texels.dense().shape[:3]
            largest = float(expected.abs().max())
            assert largest > 0
            assert torch.allclose(found.dense().flatten(0, 2), expected, atol=1e-5 * largest)

    def test_light_and_turned_light(self):
        """Turning the light is turning the scene the other way: a sphere, seen from outside."""
        mesh, basis = ball(), SRBF(162, resolution=8)
        transfer = bake(mesh, light_basis=basis, **RAYS).dense()[:, 0, 0].double()
        light = SRBFExpansion(UP[None], number(8.0)[None], torch.ones(1, 3).double())
        turn = rotation_about_up(90.0)
        direct = transfer @ basis.project(light.rotated(turn))
        by_basis = transfer @ basis.rotate(basis.project(light), turn)
        assert float((direct - by_basis).abs().max() / direct.max()) < 0.02


class TestConfiguration:
    @pytest.mark.parametrize(
        ("overrides", "expected"),
        [
            (["transfer=srbf"], SRBF()),
            (
                ["transfer.light_basis=srbf", "transfer.light_centers=162"],
                SRBF(162, resolution=32),
            ),
            (
                ["transfer=srbf", "transfer.light_kernel=abel_poisson", "transfer.resolution=16"],
                SRBF(642, "abel_poisson", resolution=16),
            ),
            (["transfer=srbf", "transfer.light_resolution=64"], SRBF(resolution=64)),
        ],
    )
    def test_basis(self, overrides: list[str], expected: SRBF):
        config = load_config(CONFIGS, "fit", overrides)
        assert load_inputs(config).light_basis.describe() == expected.describe()

    @pytest.mark.parametrize(
        ("overrides", "field", "limit"),
        [
            (["transfer=srbf", "transfer.light_centers=100"], "light_centers", "2562"),
            (["transfer=srbf", "transfer.light_kernel=box"], "light_kernel", "abel_poisson"),
            (["transfer=srbf", "transfer.light_resolution=48"], "transfer", "128 rays"),
        ],
    )
    def test_refusals(self, overrides: list[str], field: str, limit: str):
        with pytest.raises(InputError, match=limit) as caught:
            load_config(CONFIGS, "fit", overrides)
        assert str(caught.value).startswith("transfer")
        assert field in str(caught.value)
        assert "\n" not in str(caught.value)
