"""Spherical harmonics against scipy, quadrature and the theory."""

import math

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y
from tolerances import SH_EXACT, SH_ROTATION

from prt_torch.assets import Environment
from prt_torch.bases import CubeDirections, SphericalHarmonics, sh
from prt_torch.sphere import cubemap_directions, cubemap_solid_angles


def random_directions(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    directions = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    directions = directions / directions.norm(dim=1, keepdim=True)
    directions[0], directions[1] = torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 0, -1])
    return directions


def random_rotation(seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    q = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))[0]
    return q * torch.linalg.det(q)


def scipy_harmonics(directions: torch.Tensor, order: int) -> torch.Tensor:
    x, y, z = directions.numpy().T
    polar, azimuth = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    columns = []
    for band in range(order):
        for m in range(-band, band + 1):
            value = sph_harm_y(band, abs(m), polar, azimuth) * (-1.0) ** m
            if m == 0:
                columns.append(value.real)
            else:
                columns.append(math.sqrt(2) * (value.real if m > 0 else value.imag))
    return torch.from_numpy(np.stack(columns, axis=-1))


@pytest.mark.parametrize("order", [1, 2, 6, 33])
def test_agrees_with_scipy(order):
    directions = random_directions(400)
    expected = scipy_harmonics(directions, order)
    for dtype, limit in SH_EXACT.items():
        error = (sh.evaluate(directions.to(dtype), order).double() - expected).abs().max()
        assert float(error) < limit


def test_order_65_is_finite_and_accurate_in_float32():
    directions = random_directions(200)
    error = sh.evaluate(directions.float(), 65).double() - scipy_harmonics(directions, 65)
    assert float(error.abs().max()) < 1.3e-4


def test_signs_and_order_of_band_one():
    values = sh.evaluate(torch.tensor([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0]], dtype=torch.float64), 2)
    c = math.sqrt(3 / (4 * math.pi))
    expected = [[0, 0.8 * c, 0.6 * c], [c, 0, 0]]
    assert torch.allclose(values[:, 1:], torch.tensor(expected, dtype=torch.float64))


@pytest.mark.parametrize("order", [6, 33])
def test_orthonormal(order):
    """Gauss-Legendre in z with twice the nodes, equal steps in azimuth."""
    nodes, weights = np.polynomial.legendre.leggauss(2 * order)
    azimuth = np.arange(4 * order) * (2 * np.pi / (4 * order))
    z, phi = np.meshgrid(nodes, azimuth, indexing="ij")
    r = np.sqrt(1 - z * z)
    directions = torch.from_numpy(np.stack([r * np.cos(phi), r * np.sin(phi), z], -1))
    values = sh.evaluate(directions.reshape(-1, 3), order)
    area = torch.from_numpy(np.repeat(weights, 4 * order) * (2 * np.pi / (4 * order)))
    gram = (values * area[:, None]).mT @ values
    assert float((gram - torch.eye(order * order)).abs().max()) < 1e-12


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rotation_equivariance(dtype):
    directions = random_directions(300).to(dtype)
    for seed in range(5):
        rotation = random_rotation(seed).to(dtype)
        coefficients = torch.nn.functional.normalize(
            torch.randn(36, generator=torch.Generator().manual_seed(seed)).to(dtype), dim=0
        )
        matrix = sh.rotation_matrix(rotation, 6)
        turned = sh.evaluate(directions, 6) @ (matrix @ coefficients)
        direct = sh.evaluate(directions @ rotation, 6) @ coefficients  # f(R⁻¹ s)
        assert float((turned - direct).abs().max()) < SH_ROTATION[dtype]


def test_rotations_compose_and_invert():
    a, b = random_rotation(1), random_rotation(2)
    product = sh.rotation_matrix(a, 5) @ sh.rotation_matrix(b, 5)
    assert torch.allclose(sh.rotation_matrix(a @ b, 5), product, atol=1e-12)
    assert torch.allclose(sh.rotation_matrix(a.mT, 5), sh.rotation_matrix(a, 5).mT, atol=1e-12)


def test_gradients():
    directions = random_directions(4).requires_grad_()
    assert torch.autograd.gradcheck(lambda d: sh.evaluate(d, 4), directions)
    rotation = random_rotation().requires_grad_()
    assert torch.autograd.gradcheck(lambda r: sh.rotation_matrix(r, 3), rotation)


@pytest.mark.parametrize("order", [0, -1, 129])
def test_orders_out_of_range(order):
    with pytest.raises(ValueError, match="order"):
        sh.evaluate(torch.zeros(1, 3), order)


def cosine_lobe(order: int) -> torch.Tensor:
    """Closed form of the clamped cosine about +z, by band."""
    by_band = [math.pi, 2 * math.pi / 3, math.pi / 4, 0, -math.pi / 24, 0, math.pi / 64]
    coefficients = torch.zeros(order * order, dtype=torch.float64)
    for band in range(order):
        scale = math.sqrt((2 * band + 1) / (4 * math.pi))
        coefficients[band * (band + 1)] = by_band[band] * scale
    return coefficients


def test_projection_of_a_cosine_lobe_from_cube_texels():
    resolution, order = 128, 7
    directions = cubemap_directions(resolution, dtype=torch.float64).reshape(-1, 3)
    area = cubemap_solid_angles(resolution, dtype=torch.float64).reshape(-1)
    values = (directions[:, 2].clamp_min(0) * area)[None]
    projected = SphericalHarmonics(order).project_cube(values, resolution)[0]
    assert float((projected - cosine_lobe(order)).abs().max()) < 2e-4


def one_pixel_sun(rows: int, row: int, col: int, radiance: float = 1e6) -> Environment:
    image = torch.zeros(rows, 2 * rows, 3)
    image[row, col] = radiance
    return Environment("sun", image, "latlong")


@pytest.mark.parametrize(("row", "col"), [(0, 3), (20, 0), (31, 63), (63, 100)])
def test_one_pixel_sun_keeps_its_energy_in_every_basis(row, col):
    rows = 64
    environment = one_pixel_sun(rows, row, col)
    step = math.pi / rows
    top, bottom = math.cos(row * step), math.cos((row + 1) * step)
    flux = 1e6 * (top - bottom) * step
    mean = SphericalHarmonics(6).project(environment)[0, 0] * math.sqrt(4 * math.pi)
    assert float(mean) == pytest.approx(flux, rel=1e-6)
    cube = CubeDirections(16)
    texels = cube.project(environment)[:, 0]
    assert float((texels * cube.solid_angles).sum()) == pytest.approx(flux, rel=1e-6)


def test_sun_over_ambient_loses_neither():
    """One pixel of 1e9 over ambient 1: a float32 running sum would lose the ambient."""
    image = torch.ones(64, 128, 3)
    image[10, 20] = 1e9
    sun = one_pixel_sun(64, 10, 20, 1e9 - 1)
    basis = CubeDirections(8)
    with_ambient = basis.project(Environment("both", image, "latlong"))
    alone = basis.project(sun)
    dark = alone[:, 0] == 0
    assert int(dark.sum()) > 370
    assert torch.allclose(with_ambient[dark], torch.ones(()).double(), atol=2e-2)
    mean = SphericalHarmonics(2).project(Environment("both", image, "latlong"))[0, 0]
    only_sun = SphericalHarmonics(2).project(sun)[0, 0]
    assert float(mean - only_sun) == pytest.approx(math.sqrt(4 * math.pi), rel=1e-3)


def test_constant_light_is_constant_in_cube_directions():
    light = Environment("one", torch.ones(50, 100, 3), "latlong")
    assert torch.allclose(CubeDirections(32).project(light), torch.ones(()).double(), atol=1e-12)


def test_turning_the_light_is_rotating_its_coefficients():
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 3, 8, 16, generator=generator)
    image = torch.nn.functional.interpolate(coarse, size=(128, 256), mode="bilinear")[0]
    light = Environment("smooth", image.permute(1, 2, 0), "latlong")
    rotation = random_rotation(7)
    basis = SphericalHarmonics(5)
    turned = basis.rotate(basis.project(light), rotation)
    assert torch.allclose(basis.project(light.rotated(rotation)), turned, atol=1e-12)


def test_projection_is_differentiable_in_the_image():
    image = torch.rand(4, 8, 3, dtype=torch.float64, requires_grad=True)

    def project(image):
        return SphericalHarmonics(2).project(Environment("free", image, "latlong"))

    assert torch.autograd.gradcheck(project, image)
