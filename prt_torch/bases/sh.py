r"""Real spherical harmonics: evaluation, rotation, projection over the sphere and the hemisphere.

Orthonormal, without the Condon-Shortley phase, index ``l * (l + 1) + m``
(:mod:`prt_torch.conventions`). Functions are evaluated as polynomials in x, y, z,

.. math:: y_{lm}(s) = \hat P_{lm}(z) \cdot
    \begin{cases} \Re (x + iy)^m & m \ge 0 \\ \Im (x + iy)^{|m|} & m < 0 \end{cases}

where :math:`\hat P_{lm}` is the normalised associated Legendre function without its factor
:math:`(1-z^2)^{m/2}`, so nothing divides by a sine, the poles are ordinary points and gradients
exist everywhere. The fully normalised recurrence never overflows: order 33 has a largest absolute
error near 4e-5 in float32 and 1e-12 in float64.

Rotations are exact quadratures. Products of two functions of degree below ``order`` are integrated
without error by Gauss-Legendre nodes in z times equal steps in azimuth, so
:math:`D_l = \int y_l(s)\, y_l(R^{-1}s)^T ds` needs no recurrence and no Euler angles, has no
singular rotation, and is differentiable in R.
"""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases.base import LightBasis, Radiance
from prt_torch.bases.tables import kept
from prt_torch.conventions import sh_index
from prt_torch.sphere import cubemap_directions

MAX_ORDER = 128

PROJECTION_CUTOFF = 1e-3
"""Smallest norm, over the largest, that a hemispherical projection divides by."""

_TABLE_ELEMENTS = 2**23  # of one table of function values: 64 MiB in float64
_TEXEL_RUN = 2048  # summed in the type of the values before the sum goes on in float64


def _check_order(order: int) -> None:
    if not 1 <= order <= MAX_ORDER:
        raise ValueError(f"expected a spherical-harmonic order in 1..{MAX_ORDER}, got {order}")


def evaluate(directions: Float[Tensor, "*batch 3"], order: int) -> Float[Tensor, "*batch coeffs"]:
    """Spherical harmonics of all bands below ``order``.

    Args:
        directions: Unit vectors. Not normalised here; off the sphere the polynomials continue.
        order: Number of bands, 1 to 128.

    Returns:
        ``order**2`` values a direction, in the dtype of ``directions``.

    Raises:
        ValueError: If ``order`` is out of range.
    """
    _check_order(order)
    x, y, z = directions.unbind(-1)
    functions: list[Tensor] = [z] * (order * order)
    cosine, sine = torch.ones_like(z), torch.zeros_like(z)
    diagonal = math.sqrt(1.0 / (4.0 * math.pi))
    for m in range(order):
        if m > 0:
            cosine, sine = x * cosine - y * sine, x * sine + y * cosine
            diagonal *= math.sqrt((2 * m + 1) / (2 * m))
        scale = diagonal * (math.sqrt(2.0) if m else 1.0)
        previous, current = torch.zeros_like(z), torch.full_like(z, scale)
        for band in range(m, order):
            functions[sh_index(band, m)] = current * cosine
            if m > 0:
                functions[sh_index(band, -m)] = current * sine
            step, back = _legendre_step(band + 1, m)
            previous, current = current, step * (z * current - back * previous)
    return torch.stack(functions, dim=-1)


def order_of(coefficients: Float[Tensor, "*batch coeffs"]) -> int:
    """Number of bands that coefficients have.

    Raises:
        ValueError: If their number is not a square.
    """
    count = coefficients.shape[-1]
    order = math.isqrt(count)
    if order < 1 or order * order != count:
        raise ValueError(f"expected a square number of coefficients, got {count}")
    return order


def _legendre_step(band: int, m: int) -> tuple[float, float]:
    """Factors of P(band) = step * (z P(band-1) - back * P(band-2)), fully normalised."""
    step = math.sqrt((4.0 * band * band - 1.0) / (band * band - m * m))
    back = math.sqrt(((band - 1.0) ** 2 - m * m) / (4.0 * (band - 1.0) ** 2 - 1.0))
    return step, back


@kept
def _product_quadrature(order: int) -> tuple[Tensor, Tensor]:
    """Directions and weights that integrate products of two functions of degree < order exactly."""
    nodes, node_weights = np.polynomial.legendre.leggauss(order)
    steps = 2 * order - 1
    z = torch.from_numpy(nodes)[:, None].expand(order, steps)
    azimuth = torch.arange(steps, dtype=torch.float64) * (2.0 * math.pi / steps)
    radius = torch.sqrt((1.0 - z) * (1.0 + z))
    directions = torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], dim=-1)
    weights = torch.from_numpy(node_weights)[:, None].expand(order, steps) * (2 * math.pi / steps)
    return directions.reshape(-1, 3), weights.reshape(-1)


def rotation_matrix(
    rotation: Float[Tensor, "*batch 3 3"], order: int
) -> Float[Tensor, "*batch coeffs coeffs"]:
    """Matrices D such that ``D @ c`` are the coefficients of f(R⁻¹ s).

    Exact for any rotation, batched, and differentiable in ``rotation``.

    Args:
        rotation: Rotation matrices; not checked for orthogonality.
        order: Number of bands.

    Returns:
        Block-diagonal orthogonal matrices in the dtype of ``rotation``.

    Raises:
        ValueError: If ``order`` is out of range.
    """
    _check_order(order)
    directions, weights = (t.to(rotation) for t in _product_quadrature(order))
    weighted = evaluate(directions, order) * weights[:, None]
    turned = evaluate(directions @ rotation, order)  # rows are R⁻¹ s
    matrix = rotation.new_zeros(*rotation.shape[:-2], order * order, order * order)
    for band in range(order):
        block = slice(band * band, (band + 1) * (band + 1))
        matrix[..., block, block] = weighted[:, block].mT @ turned[..., block]
    return matrix


def hemisphere_quadrature(
    degree: int,
) -> tuple[Float[Tensor, "nodes 3"], Float[Tensor, "nodes"]]:
    """Directions and weights that integrate polynomials over the upper hemisphere exactly.

    Gauss-Legendre nodes in z on [0, 1] times equal steps in azimuth, float64; weights sum to 2π.

    Args:
        degree: Highest degree, in x, y and z together, that is exact; at least 0.
    """
    nodes, node_weights = np.polynomial.legendre.leggauss(degree // 2 + 1)
    steps = degree + 1
    z = torch.from_numpy(nodes)[:, None].expand(-1, steps) * 0.5 + 0.5
    azimuth = torch.arange(steps, dtype=torch.float64) * (2.0 * math.pi / steps)
    radius = torch.sqrt((1.0 - z) * (1.0 + z))
    directions = torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], dim=-1)
    weights = torch.from_numpy(node_weights)[:, None].expand(-1, steps) * (math.pi / steps)
    return directions.reshape(-1, 3), weights.reshape(-1)


def hemisphere_gram(order: int) -> Float[Tensor, "coeffs coeffs"]:
    r"""Inner products of spherical harmonics over the upper hemisphere.

    .. math:: A_{ik} = \int_{z \ge 0} y_i(s)\, y_k(s)\, ds

    Near-singular from order 5 on (condition 1.5e5, 3.5e9 at order 8): factor it in float64, or
    better use :func:`hemisphere_projection`, which never forms it.

    Args:
        order: Number of bands, at least 1.

    Returns:
        Symmetric positive definite matrix [sr-normalised, float64].

    Raises:
        ValueError: If ``order`` is out of range.

    Source:
        Sloan et al. 2003, appendix 9.1.
    """
    _check_order(order)
    directions, weights = hemisphere_quadrature(2 * order - 2)
    functions = evaluate(directions, order)
    return functions.mT @ (functions * weights[:, None])


def hemisphere_projection(
    functions: Float[Tensor, "nodes rows"], weights: Float[Tensor, "nodes"]
) -> Float[Tensor, "rows nodes"]:
    """The least-squares optimal projection onto functions that are not orthogonal.

    The matrix P for which ``P @ f`` are the coefficients c that minimise the weighted sum of
    ``(f - functions @ c)²``: A⁻¹ b of the paper in the limit of many nodes, without forming A.
    Combinations of the functions whose norm is below ``PROJECTION_CUTOFF`` of the largest are
    taken as zero, since they would multiply noise by the inverse of it. All functions of up to
    order 5 are above it.

    Args:
        functions: Values of the functions at quadrature nodes, float64.
        weights: Quadrature weights, positive.

    Source:
        Sloan et al. 2003, appendix 9.1.
    """
    scale = weights.sqrt()[:, None]
    left, singular, right = torch.linalg.svd(functions * scale, full_matrices=False)
    kept = singular > PROJECTION_CUTOFF * singular[0]
    inverse = torch.where(kept, 1.0 / torch.where(kept, singular, 1.0), 0.0)
    return (right.mT * inverse) @ (left * scale).mT


def hemisphere_inverse(order: int) -> Float[Tensor, "coeffs coeffs"]:
    """A⁻¹ for exact inner products over the hemisphere, float64.

    Cut off as :func:`hemisphere_projection` is: to order 5 it is the inverse of
    :func:`hemisphere_gram`; beyond, combinations too weak to divide by are taken as zero.

    Raises:
        ValueError: If ``order`` is out of range.

    Source:
        Sloan et al. 2003, appendix 9.1.
    """
    eigenvalues, vectors = torch.linalg.eigh(hemisphere_gram(order))
    kept = eigenvalues > PROJECTION_CUTOFF**2 * eigenvalues[-1]
    return (vectors[:, kept] / eigenvalues[kept]) @ vectors[:, kept].mT


def product_matrix(order_a: int, order_b: int) -> Float[Tensor, "a b c"]:
    r"""Coefficients of products of harmonics: :math:`y_a y_b = \sum_c G_{abc}\, y_c`, float64.

    Exact; ``c`` counts order ``order_a + order_b - 1``.

    Raises:
        ValueError: If an order is out of range.
    """
    order_c = order_a + order_b - 1
    directions, weights = _product_quadrature(order_c)
    functions = evaluate(directions, order_c)
    a, b = functions[:, : order_a**2], functions[:, : order_b**2]
    pairs = (a[:, :, None] * b[:, None, :]).flatten(1)
    return (pairs.mT @ (functions * weights[:, None])).unflatten(0, (order_a**2, order_b**2))


class SphericalHarmonics(LightBasis):
    """The real spherical harmonics of all bands below ``order`` as a light basis.

    Orthonormal, closed under rotation.

    Args:
        order: Number of bands; ``order**2`` coefficients.
    """

    def __init__(self, order: int):
        _check_order(order)
        self.order = order
        self._cube_tables: dict[tuple[int, torch.dtype, torch.device], Tensor] = {}

    @property
    def num_coeffs(self) -> int:
        """``order**2``."""
        return self.order * self.order

    @property
    def name(self) -> str:
        """``SH order n``."""
        return f"SH order {self.order}"

    def project(self, environment: Radiance) -> Float[Tensor, "coeffs rgb"]:
        """Inner products with each harmonic, float64.

        Source pixels are divided until none is wider than a tenth of the shortest wavelength over
        2π, which leaves a relative error of at most 1/2400 in the highest band and none in the
        mean.
        """
        total = torch.zeros(self.num_coeffs, 3, dtype=torch.float64)
        rows = max(1, _TABLE_ELEMENTS // self.num_coeffs)
        for directions, solid_angles, radiance in environment.sample_blocks(0.1 / self.order):
            light = radiance.to(torch.float64) * solid_angles[:, None]
            for some, of_light in zip(directions.split(rows), light.split(rows), strict=True):
                total = total.to(light.device) + evaluate(some, self.order).mT @ of_light
        return total

    def project_cube(
        self, values: Float[Tensor, "points texels"], resolution: int
    ) -> Float[Tensor, "points coeffs"]:
        """Quadrature over texel centres, ``values @ y(s)``, summed in float64 by runs of texels."""
        table = self._cube_table(resolution, values)
        total = values.new_zeros(values.shape[0], self.num_coeffs, dtype=torch.float64)
        runs = zip(values.split(_TEXEL_RUN, dim=1), table.split(_TEXEL_RUN), strict=True)
        for some_values, some_functions in runs:
            total += some_values @ some_functions
        return total.to(values.dtype)

    def table_bytes(self, resolution: int) -> int:
        """One float32 a texel and function."""
        return 4 * 6 * resolution * resolution * self.num_coeffs

    def _cube_table(self, resolution: int, like: Tensor) -> Float[Tensor, "texels coeffs"]:
        key = (resolution, like.dtype, like.device)
        if key in self._cube_tables:
            return self._cube_tables[key]
        if torch.compiler.is_compiling():  # what is traced holds no numbers to keep
            return self._made_cube_table(resolution, like)
        with torch.inference_mode(False):  # so that gradients can pass through it later
            self._cube_tables = {key: self._made_cube_table(resolution, like)}
        return self._cube_tables[key]

    def _made_cube_table(self, resolution: int, like: Tensor) -> Float[Tensor, "texels coeffs"]:
        directions = cubemap_directions(resolution, dtype=torch.float64).reshape(-1, 3)
        rows = max(1, _TABLE_ELEMENTS // self.num_coeffs)
        pieces = [evaluate(some, self.order).to(like) for some in directions.split(rows)]
        return torch.cat(pieces)

    def gram(self) -> Float[Tensor, "coeffs"]:
        """Ones: the basis is orthonormal."""
        return torch.ones(self.num_coeffs, dtype=torch.float64)

    def weigh(self, values: Float[Tensor, "... coeffs"]) -> Float[Tensor, "... coeffs"]:
        """Itself: the basis is orthonormal."""
        return values

    def unweigh(self, values: Float[Tensor, "... coeffs"]) -> Float[Tensor, "... coeffs"]:
        """Itself."""
        return values

    def weigh_light(
        self, light: Float[Tensor, "*batch coeffs rgb"]
    ) -> Float[Tensor, "*batch coeffs rgb"]:
        """Itself."""
        return light

    def rotate(
        self, coefficients: Float[Tensor, "*batch coeffs rgb"], rotation: Float[Tensor, "3 3"]
    ) -> Float[Tensor, "*batch coeffs rgb"]:
        """Exact rotation by :func:`rotation_matrix`."""
        return rotation_matrix(rotation.to(coefficients), self.order) @ coefficients

    def describe(self) -> dict[str, Any]:
        """``{"name": "sh", "order": n}``."""
        return {"name": "sh", "order": self.order}
