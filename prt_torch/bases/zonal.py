r"""Zonal harmonics: functions that are symmetric around an axis, and sums of them around several.

A function of the polar angle alone has one coefficient a band, :math:`g = \sum_l g_l y_{l0}`.
Turned so that its axis is s*, its spherical-harmonic coefficients are a product,

.. math:: \hat g_{lm} = g^*_l\, y_{lm}(s^*), \qquad g^*_l = \sqrt{4\pi / (2l + 1)}\; g_l,

and its value in direction s is :math:`\sum_l \tfrac{2l+1}{4\pi} g^*_l P_l(s \cdot s^*)`. A *lobe*
is such an axis with its coefficients g*, one a band. Turning a sum of lobes turns its axes and
leaves its coefficients, where turning spherical harmonics takes a matrix a band.

Bands do not meet: at fixed axes the coefficients of band l that fit a function best solve a linear
system with the Gram matrix :math:`\tfrac{2l+1}{4\pi} P_l(s_i \cdot s_j)` of the axes.

Axes are taken by their direction, whatever their length, so gradients are tangential (the paper's
substitution of :math:`s/|s|`); a zero vector stands for +z, with zero gradient. No axis is
singular: everything is a polynomial in x, y and z.

Source:
    Sloan, Luna, Snyder 2005, sections 3.1, 3.3, 4.1 and 4.2.
"""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases import sh

LEAST_RIDGE = 1e-12
"""Smallest ridge of :func:`fit_coefficients` with which float64 solves coincident axes."""

_SPARE_NODES = 64  # quadrature nodes a piece of a profile has beside those its polynomials need


def unit_axes(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Directions of vectors of any length, and +z where a vector is zero.

    Vectors of 1e-30 or 1e30 neither vanish nor overflow. The gradient at zero is zero.
    """
    largest = vectors.detach().abs().amax(dim=-1, keepdim=True)
    vanishes = largest < torch.finfo(vectors.dtype).tiny
    scaled = vectors / torch.where(vanishes, 1.0, largest)
    up = vectors.new_tensor([0.0, 0.0, 1.0])
    safe = torch.where(vanishes, up, scaled)
    return safe / torch.linalg.vector_norm(safe, dim=-1, keepdim=True)


def _over_bands(by_band: Float[Tensor, "*batch order"]) -> Float[Tensor, "*batch coeffs"]:
    """Each band's value, repeated for its 2l + 1 harmonics."""
    columns = by_band.split(1, dim=-1)
    repeated = [c.expand(*c.shape[:-1], 2 * band + 1) for band, c in enumerate(columns)]
    return torch.cat(repeated, dim=-1)


def _band_sums(values: Float[Tensor, "*batch coeffs"]) -> Float[Tensor, "*batch order"]:
    """Sums over the 2l + 1 harmonics of each band."""
    widths = [2 * band + 1 for band in range(sh.order_of(values))]
    return torch.stack([part.sum(dim=-1) for part in values.split(widths, dim=-1)], dim=-1)


def _degrees(order: int, like: Tensor) -> Float[Tensor, "order"]:
    """2l + 1 of each band."""
    return 2.0 * torch.arange(order, dtype=like.dtype, device=like.device) + 1.0


def legendre(cosines: Float[Tensor, "*batch"], order: int) -> Float[Tensor, "*batch order"]:
    """Legendre polynomials P_0 to P_(order - 1).

    Args:
        cosines: Arguments in [-1, 1].
        order: Number of bands, at least 1.

    Raises:
        ValueError: If ``order`` is below 1.
    """
    if order < 1:
        raise ValueError(f"expected at least one band, got {order}")
    polynomials = [torch.ones_like(cosines), cosines]
    for band in range(1, order - 1):
        rising = (2 * band + 1) * cosines * polynomials[band] - band * polynomials[band - 1]
        polynomials.append(rising / (band + 1))
    return torch.stack(polynomials[:order], dim=-1)


def lobes_to_sh(
    axes: Float[Tensor, "*batch lobes 3"], coefficients: Float[Tensor, "*batch lobes order"]
) -> Float[Tensor, "*batch coeffs"]:
    r"""Spherical-harmonic coefficients of a sum of lobes.

    .. math:: t_{lm} = \sum_i g^*_{il}\, y_{lm}(s_i)

    Args:
        axes: Directions of the lobes, of any length.
        coefficients: g* of each lobe and band.

    Returns:
        ``order**2`` coefficients.

    Source:
        Sloan, Luna, Snyder 2005, equations 7 and 11. Equations 8 to 13 write the same sum with a
        row vector y that should be a column.
    """
    functions = sh.evaluate(unit_axes(axes), coefficients.shape[-1])
    return (functions * _over_bands(coefficients)).sum(dim=-2)


def lobe_coefficients(
    harmonics: Float[Tensor, "*batch coeffs"], axes: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch order"]:
    r"""g* of the one lobe around a given axis that is closest in L2.

    .. math:: g^*_l = \frac{4\pi}{2l + 1} \sum_m y_{lm}(s)\, t_{lm}

    Args:
        harmonics: Spherical-harmonic coefficients t of what to fit.
        axes: Direction of the lobe, of any length.

    Raises:
        ValueError: If the number of coefficients is not a square.

    Source:
        Sloan, Luna, Snyder 2005, equation 18, with its denominator in closed form.
    """
    order = sh.order_of(harmonics)
    products = sh.evaluate(unit_axes(axes), order) * harmonics
    return _band_sums(products) * (4.0 * math.pi / _degrees(order, products))


def fit_coefficients(
    harmonics: Float[Tensor, "*batch coeffs"],
    axes: Float[Tensor, "*batch lobes 3"],
    ridge: float = 1e-8,
) -> Float[Tensor, "*batch lobes order"]:
    r"""g* of several lobes around given axes that are together closest in L2.

    In each band the solution of

    .. math:: (P_l(s_i \cdot s_j) + \rho\, \delta_{ij})\, g^*_{jl}
        = \frac{4\pi}{2l + 1} \sum_m y_{lm}(s_i)\, t_{lm},

    which adds ρ times the squared norms of the lobes, each by itself, to the squared error. So
    lobes whose axes coincide share evenly, and large lobes of opposite sign do not pay. Towards
    zero it becomes the solution of least norm. Solved in float64.

    Args:
        harmonics: Spherical-harmonic coefficients t of what to fit.
        axes: Directions of the lobes, of any length; any number of them may coincide.
        ridge: ρ, relative to a lobe's squared norm; at least :data:`LEAST_RIDGE`. Gradients grow
            as its inverse where axes coincide.

    Returns:
        Coefficients in the dtype of ``harmonics``.

    Raises:
        ValueError: If the ridge is too small or the number of coefficients is not a square.

    Source:
        Sloan, Luna, Snyder 2005, section 4.1, which leaves the linear solution at frozen axes to
        an optimiser and has no ridge.
    """
    if not ridge >= LEAST_RIDGE:
        raise ValueError(f"expected a ridge of at least {LEAST_RIDGE:g}, got {ridge:g}")
    directions = unit_axes(axes.to(torch.float64))
    target = harmonics.to(torch.float64)[..., None, :].expand(*axes.shape[:-1], -1)
    wanted = lobe_coefficients(target, directions)
    gram = legendre(directions @ directions.mT, wanted.shape[-1]).movedim(-1, -3)
    damping = ridge * torch.eye(axes.shape[-2], dtype=gram.dtype, device=gram.device)
    root = torch.linalg.cholesky(gram + damping)
    solution = torch.cholesky_solve(wanted.mT[..., None], root)[..., 0].mT
    return solution.to(harmonics.dtype)


def convolution_coefficients(zonal: Float[Tensor, "*batch order"]) -> Float[Tensor, "*batch order"]:
    r"""The g* of a lobe, :math:`\sqrt{4\pi/(2l+1)}\, g_l`, from coefficients of :math:`y_{l0}`.

    Multiplying each band of a function by them convolves it with the lobe.

    Source:
        Sloan, Luna, Snyder 2005, equations 3 and 4.
    """
    return zonal * (4.0 * math.pi / _degrees(zonal.shape[-1], zonal)).sqrt()


def zonal_to_sh(
    zonal: Float[Tensor, "*batch order"], axes: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch coeffs"]:
    """Spherical-harmonic coefficients of a zonal function turned from +z to an axis.

    Args:
        zonal: Coefficients of the y_l0 around +z.
        axes: Where +z goes, of any length.

    Source:
        Sloan, Luna, Snyder 2005, equations 5 and 6.
    """
    coefficients = convolution_coefficients(zonal)
    return lobes_to_sh(axes[..., None, :], coefficients[..., None, :])


def optimal_linear_axis(harmonics: Float[Tensor, "*batch coeffs"]) -> Float[Tensor, "*batch 3"]:
    """Unit axis around which the linear band is symmetric; +z where that band is zero.

    Args:
        harmonics: Spherical-harmonic coefficients of at least two bands.

    Raises:
        ValueError: If the number of coefficients is not a square, or there is one band only.

    Source:
        Sloan, Luna, Snyder 2005, section 3.3. Its minus signs belong to the Condon-Shortley phase,
        which we do not have.
    """
    if sh.order_of(harmonics) < 2:
        raise ValueError(f"expected at least 4 coefficients, got {harmonics.shape[-1]}")
    return unit_axes(harmonics[..., [3, 1, 2]])


def evaluate_lobes(
    axes: Float[Tensor, "*batch lobes 3"],
    coefficients: Float[Tensor, "*batch lobes order"],
    directions: Float[Tensor, "*batch directions 3"],
) -> Float[Tensor, "*batch directions"]:
    r"""Values of a sum of lobes, :math:`\sum_{il} \tfrac{2l+1}{4\pi} g^*_{il} P_l(s \cdot s_i)`.

    Args:
        axes: Directions of the lobes, of any length.
        coefficients: g* of each lobe and band.
        directions: Unit vectors; not normalised here.
    """
    order = coefficients.shape[-1]
    scaled = coefficients * (_degrees(order, coefficients) / (4.0 * math.pi))
    polynomials = legendre(directions @ unit_axes(axes).mT, order)
    return (polynomials * scaled[..., None, :, :]).sum(dim=(-2, -1))


def band_energies(harmonics: Float[Tensor, "*batch coeffs"]) -> Float[Tensor, "*batch order"]:
    """Squared L2 norm of each band; rotations leave it as it is.

    Raises:
        ValueError: If the number of coefficients is not a square.
    """
    return _band_sums(harmonics.square())


def squared_errors(
    harmonics: Float[Tensor, "*batch coeffs"],
    axes: Float[Tensor, "*batch lobes 3"],
    coefficients: Float[Tensor, "*batch lobes order"],
) -> Float[Tensor, "*batch order"]:
    """Squared L2 distance of a sum of lobes from a function, band by band.

    Raises:
        ValueError: If the number of coefficients is not that of the lobes' bands.

    Source:
        Sloan, Luna, Snyder 2005, equation 17, which is their sum.
    """
    order = coefficients.shape[-1]
    if harmonics.shape[-1] != order * order:
        raise ValueError(f"expected {order * order} coefficients, got {harmonics.shape[-1]}")
    return band_energies(harmonics - lobes_to_sh(axes, coefficients))


def zonal_coefficients(
    profile: Callable[[Float[Tensor, "angles"]], Float[Tensor, "angles"]],
    order: int,
    breaks: Sequence[float] = (),
) -> Float[Tensor, "order"]:
    r"""Coefficients of the y_l0 of a function of the polar angle, float64.

    .. math:: g_l = \sqrt{\pi (2l + 1)} \int_0^\pi f(\theta)\, P_l(\cos\theta) \sin\theta\, d\theta

    by Gauss-Legendre quadrature in θ, exact to rounding where the function is smooth.

    Args:
        profile: Values at polar angles [rad], float64.
        order: Number of bands, at least 1.
        breaks: Angles [rad] inside (0, π), rising, where the function or its slope jumps.

    Raises:
        ValueError: If the breaks do not rise inside (0, π), or ``order`` is below 1.
    """
    limits = (0.0, *breaks, math.pi)
    if any(not low < high for low, high in itertools.pairwise(limits)):
        raise ValueError(f"expected rising angles between 0 and pi, got {tuple(breaks)}")
    nodes, weights = (
        torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(_SPARE_NODES + order)
    )
    total = torch.zeros(order, dtype=torch.float64)
    for low, high in itertools.pairwise(limits):
        half = 0.5 * (high - low)
        angles = low + half * (nodes + 1.0)
        areas = half * weights * angles.sin()
        total = total + (areas * profile(angles)) @ legendre(angles.cos(), order)
    return total * (math.pi * _degrees(order, total)).sqrt()


def thin_membrane_coefficients(
    transparency: Float[Tensor, "*batch"], order: int
) -> Float[Tensor, "*batch order"]:
    r"""g* of a translucent membrane: a clamped cosine, and an attenuated one on its other side.

    Of :math:`g(z) = z/\pi` above the horizon and :math:`-\alpha z/\pi` below it, so the dot product
    with light is radiance at a reflectance of 1. A lobe around the surface normal.

    Args:
        transparency: α, 0 to 1; 0 is an opaque diffuse surface.
        order: Number of bands, at least 1.

    Source:
        Sloan, Luna, Snyder 2005, equation 23: correct as printed, and divided by π already.
    """
    even, odd = (bands.to(transparency) for bands in _clamped_cosine(order))
    return even * (1.0 + transparency[..., None]) + odd * (1.0 - transparency[..., None])


def clamped_cosine_coefficients(order: int) -> Float[Tensor, "order"]:
    r"""Coefficients of the y_l0 of :math:`\max(\cos\theta, 0)`, float64.

    Not divided by π: as g* they are π, 2π/3, π/4, 0, -π/24, 0, π/64 and so on.
    """
    even, odd = _clamped_cosine(order)
    return (even + odd) * math.pi / (4.0 * math.pi / _degrees(order, even)).sqrt()


def _clamped_cosine(order: int) -> tuple[Float[Tensor, "order"], Float[Tensor, "order"]]:
    """g* of the even and of the odd bands of max(cos, 0) / π, zero elsewhere; float64."""
    even, odd = torch.zeros(order, dtype=torch.float64), torch.zeros(order, dtype=torch.float64)
    odd[1:2] = 2.0 / 3.0
    ratio = 1.0  # l! / (2^l (l/2)!^2), without factorials that overflow
    for band in range(0, order, 2):
        even[band] = -2.0 * (-1.0) ** (band // 2) * ratio / ((band + 2) * (band - 1))
        ratio *= (band + 1) / (band + 2)
    return even, odd
