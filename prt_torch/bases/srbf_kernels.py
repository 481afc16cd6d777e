r"""Spherical radial basis functions: bell-shaped functions of the distance to a centre.

Two kernels, each with one bandwidth :math:`\lambda` a centre :math:`\xi`,

.. math:: G(\eta) = e^{-\lambda |\eta - \xi|^2 / 2}, \qquad
          A(\eta) = \frac{1 - \lambda^2}{\bigl((1-\lambda)^2 + \lambda|\eta - \xi|^2\bigr)^{3/2}},

the Gaussian with peak 1 and the Abel-Poisson kernel with integral :math:`4\pi`. The product of two,
integrated over the whole sphere, has a closed form, so a function made of them needs no quadrature.

All is written in squared distances that are sums of squared differences of coordinates. A dot
product would do as well on paper, but one minus it keeps no digit of a small distance: at a
bandwidth of 1e6 it is off by 0.15 in float32. Nothing overflows, however large the bandwidth:
exponentials only ever shrink. Centres and directions are unit vectors; this is not checked.

Source:
    Tsai, Shih 2006, section 3, equations 1 to 6.
"""

import math
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

KernelName = Literal["gaussian", "abel_poisson"]

_FOUR_PI = 4.0 * math.pi
_SERIES_BELOW = 0.01  # of r², where five terms of sinh(r)/r are exact to a rounding
_SERIES = tuple(1.0 / math.factorial(2 * k + 1) for k in range(5))
_MORE_DEGREES = 64  # beyond the last wanted, where the recurrence of ratios starts
_WIDEST_SPECTRUM = 2048  # still more of them for narrow lobes, whose ratios converge slowly


def gaussian(
    directions: Float[Tensor, "*#batch k 3"],
    centers: Float[Tensor, "*#batch n 3"],
    bandwidths: Float[Tensor, "*#batch n"],
) -> Float[Tensor, "*batch k n"]:
    r"""Gaussian kernels :math:`e^{-\lambda|\eta-\xi|^2/2}`, 1 at their centres.

    Differentiable everywhere; leading axes broadcast.

    Args:
        directions: Where, unit vectors.
        centers: Unit vectors.
        bandwidths: Not negative; the standard deviation is about ``1 / sqrt(bandwidth)`` [rad].

    Source:
        Tsai, Shih 2006, equation 4.
    """
    squared = _squared_distances(directions, centers)
    return torch.exp(squared * (-0.5 * bandwidths[..., None, :]))


def abel_poisson(
    directions: Float[Tensor, "*#batch k 3"],
    centers: Float[Tensor, "*#batch n 3"],
    bandwidths: Float[Tensor, "*#batch n"],
) -> Float[Tensor, "*batch k n"]:
    r"""Abel-Poisson kernels, whose integral over the sphere is 4π for any bandwidth.

    Differentiable everywhere; leading axes broadcast.

    Args:
        directions: Where, unit vectors.
        centers: Unit vectors.
        bandwidths: From 0 (the constant 1) to below 1 (a spike).

    Source:
        Tsai, Shih 2006, equation 3, whose exponent is 3/2 on this sphere only.
    """
    squared = _squared_distances(directions, centers)
    return _poisson(squared, (1.0 - bandwidths)[..., None, :])


def gaussian_inner_product(
    centers_a: Float[Tensor, "*#batch a 3"] | Float[Tensor, "3"],
    bandwidths_a: Float[Tensor, "*#batch a"] | Float[Tensor, ""],
    centers_b: Float[Tensor, "*#batch b 3"] | Float[Tensor, "3"],
    bandwidths_b: Float[Tensor, "*#batch b"] | Float[Tensor, ""],
) -> Float[Tensor, "..."]:
    r"""Integrals over the sphere of all products of a Gaussian a with a Gaussian b.

    With :math:`d = |\xi_a - \xi_b|` and
    :math:`r = |\lambda_a \xi_a + \lambda_b \xi_b|
    = \sqrt{(\lambda_a - \lambda_b)^2 + \lambda_a \lambda_b |\xi_a + \xi_b|^2}`,

    .. math:: 2\pi\, e^{-\delta}\, \frac{1 - e^{-2r}}{r}, \qquad
              \delta = \frac{\lambda_a \lambda_b d^2}{\lambda_a + \lambda_b + r}.

    Relative error below 1e-14 in float64 for bandwidths from 0 to 1e6, as long as δ is below 30.
    Differentiable everywhere: near r = 0, where the formula's derivative is a difference of large
    numbers, the same function is taken as a power series of r².

    Args:
        centers_a: Unit vectors. A single one, ``"3"``, has no axis in the result.
        bandwidths_a: Not negative.
        centers_b: As ``centers_a``; leading axes broadcast.
        bandwidths_b: As ``bandwidths_a``.

    Returns:
        ``"*batch a b"`` [sr].

    Source:
        Tsai, Shih 2006, equation 6; the hyperbolic sine of the printed form (equation 27, which
        also lacks a factor) overflows from r = 711 on, in float32 from 89 on.
    """
    a, of_a = _rows(centers_a, bandwidths_a)
    b, of_b = _rows(centers_b, bandwidths_b)
    squared, squared_r = _squared_distances(a, b), _squared_distances(a * of_a, -b * of_b)
    of_b = of_b.mT
    total, product = of_a + of_b, of_a * of_b
    small = squared_r < _SERIES_BELOW
    r = torch.where(small, 1.0, squared_r).sqrt()
    # The sum is above r, so it is not zero where this is used.
    exponent = product * squared / torch.where(small, 1.0, total + r)
    far = (0.5 * _FOUR_PI) * torch.exp(-exponent) * (-torch.expm1(-2.0 * r)) / r
    near = _FOUR_PI * torch.exp(-total) * _sinh_ratio(torch.where(small, squared_r, 0.0))
    return _without_single(torch.where(small, near, far), centers_a, centers_b)


def abel_poisson_inner_product(
    centers_a: Float[Tensor, "*#batch a 3"] | Float[Tensor, "3"],
    bandwidths_a: Float[Tensor, "*#batch a"] | Float[Tensor, ""],
    centers_b: Float[Tensor, "*#batch b 3"] | Float[Tensor, "3"],
    bandwidths_b: Float[Tensor, "*#batch b"] | Float[Tensor, ""],
) -> Float[Tensor, "..."]:
    r"""Integrals over the sphere of all products of an Abel-Poisson kernel a with another b.

    It is :math:`4\pi` times the Abel-Poisson kernel of bandwidth :math:`\lambda_a \lambda_b` at
    the distance of their centres. Differentiable everywhere.

    Args:
        centers_a: Unit vectors. A single one, ``"3"``, has no axis in the result.
        bandwidths_a: From 0 to below 1.
        centers_b: As ``centers_a``; leading axes broadcast.
        bandwidths_b: As ``bandwidths_a``.

    Returns:
        ``"*batch a b"`` [sr].

    Source:
        Tsai, Shih 2006, equation 5, where the factor 4π is missing.
    """
    a, of_a = _rows(centers_a, bandwidths_a)
    b, of_b = _rows(centers_b, bandwidths_b)
    gap = (1.0 - of_a) + of_a * (1.0 - of_b.mT)  # 1 - λa λb, with all its digits
    products = _FOUR_PI * _poisson(_squared_distances(a, b), gap)
    return _without_single(products, centers_a, centers_b)


def gaussian_legendre(
    bandwidths: Float[Tensor, "*batch"], degrees: int
) -> Float[Tensor, "*batch degree"]:
    r"""Legendre coefficients of Gaussian kernels: :math:`G(t) = \sum_l a_l P_l(t)`, t the cosine.

    .. math:: a_l = (2l+1) \sqrt{\tfrac{\pi}{2\lambda}}\, e^{-\lambda} I_{l+1/2}(\lambda)

    The integral over the sphere is :math:`4\pi a_0 = 2\pi(1 - e^{-2\lambda})/\lambda`. Ratios of
    neighbours come from a recurrence downwards, which is stable, so no Bessel function can
    overflow or underflow on the way.

    Args:
        bandwidths: Not negative.
        degrees: How many, from l = 0.

    Returns:
        In the dtype of ``bandwidths``; computed in float64.
    """
    width = bandwidths.to(torch.float64)
    # An error of the first ratio shrinks as exp(-start² / λ).
    spectrum = int(5.0 * float(width.detach().max().clamp(min=0.0)) ** 0.5)
    start = degrees + _MORE_DEGREES + min(_WIDEST_SPECTRUM, spectrum)
    # A close upper bound of the ratio (Amos 1974, equation 16).
    ratio = width / (start + ((start + 1.0) ** 2 + width.square()).sqrt())
    ratios = []
    for degree in range(start - 1, 0, -1):
        ratio = width / (2 * degree + 1 + width * ratio)
        if degree < degrees:
            ratios.append(ratio)
    small = width.square() < _SERIES_BELOW
    near = torch.exp(-width) * _sinh_ratio(torch.where(small, width, 0.0).square())
    far = -0.5 * torch.expm1(-2.0 * width) / torch.where(small, 1.0, width)
    terms = [torch.where(small, near, far), *reversed(ratios)]
    counts = torch.arange(1, 2 * degrees, 2, device=width.device)
    products = torch.stack(terms[:degrees], dim=-1).cumprod(dim=-1)
    return (counts * products).to(bandwidths.dtype)


def abel_poisson_legendre(
    bandwidths: Float[Tensor, "*batch"], degrees: int
) -> Float[Tensor, "*batch degree"]:
    r"""Legendre coefficients of Abel-Poisson kernels, :math:`(2l+1) \lambda^l`.

    Args:
        bandwidths: From 0 to below 1.
        degrees: How many, from l = 0.
    """
    degree = torch.arange(degrees, device=bandwidths.device)
    return (2 * degree + 1) * bandwidths[..., None] ** degree


def kernel_values(
    kernel: KernelName,
    directions: Float[Tensor, "*#batch k 3"],
    centers: Float[Tensor, "*#batch n 3"],
    bandwidths: Float[Tensor, "*#batch n"],
) -> Float[Tensor, "*batch k n"]:
    """:func:`gaussian` or :func:`abel_poisson`, by name.

    Raises:
        ValueError: If there is no such kernel.
    """
    check_kernel(kernel)
    of = gaussian if kernel == "gaussian" else abel_poisson
    return of(directions, centers, bandwidths)


def kernel_inner_products(
    kernel: KernelName,
    centers_a: Float[Tensor, "*#batch a 3"],
    bandwidths_a: Float[Tensor, "*#batch a"],
    centers_b: Float[Tensor, "*#batch b 3"],
    bandwidths_b: Float[Tensor, "*#batch b"],
) -> Float[Tensor, "*batch a b"]:
    """:func:`gaussian_inner_product` or :func:`abel_poisson_inner_product`, by name.

    Raises:
        ValueError: If there is no such kernel.
    """
    check_kernel(kernel)
    of = gaussian_inner_product if kernel == "gaussian" else abel_poisson_inner_product
    return of(centers_a, bandwidths_a, centers_b, bandwidths_b)


def check_kernel(kernel: str) -> None:
    """Check the name of a kernel.

    Raises:
        ValueError: If there is none of that name.
    """
    if kernel not in get_args(KernelName):
        raise ValueError(f"expected kernel {' or '.join(get_args(KernelName))}, got {kernel}")


def _sinh_ratio(squared_r: Tensor) -> Tensor:
    """The function sinh(r) / r of r², for small r²."""
    series = torch.full_like(squared_r, _SERIES[-1])
    for coefficient in reversed(_SERIES[:-1]):
        series = series * squared_r + coefficient
    return series


def _poisson(squared: Tensor, gap: Tensor) -> Tensor:
    """The Abel-Poisson kernel of bandwidth 1 - gap at squared distances."""
    base = gap.square() + (1.0 - gap) * squared
    return gap * (2.0 - gap) / (base * base.sqrt())


def _squared_distances(a: Tensor, b: Tensor) -> Tensor:
    """Of "*batch a 3" and "*batch b 3", one coordinate at a time: no axis of three is stored."""
    planes = [a[..., :, None, axis] - b[..., None, :, axis] for axis in range(3)]
    return planes[0].square() + planes[1].square() + planes[2].square()


def _rows(centers: Tensor, bandwidths: Tensor) -> tuple[Tensor, Tensor]:
    """Centres "*batch n 3" and bandwidths "*batch n 1", also of a single one."""
    if centers.ndim == 1:
        return centers[None], bandwidths[..., None, None]
    return centers, bandwidths[..., None]


def _without_single(products: Tensor, centers_a: Tensor, centers_b: Tensor) -> Tensor:
    """Take off the axes of single centres."""
    if centers_b.ndim == 1:
        products = products.squeeze(-1)
    if centers_a.ndim == 1:
        products = products.squeeze(-1 if centers_b.ndim == 1 else -2)
    return products
