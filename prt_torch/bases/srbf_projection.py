"""Least squares for expansions in functions that overlap, by their inner products or by samples.

Functions that coincide, or nearly so, make the system singular. Both projections then return the
solution of least norm and say what the condition was: they never fail.

Source:
    Tsai, Shih 2006, section 3 (ordinary and regularised least squares).
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor


class Fit(NamedTuple):
    """Coefficients that fit a function, and how much the system multiplied errors."""

    coefficients: Tensor
    condition: float
    """Largest over smallest eigenvalue or singular value; infinite where one is zero or less."""


def gram_projection(
    gram: Float[Tensor, "n n"], inner_products: Float[Tensor, "n columns"], ridge: float = 0.0
) -> Fit:
    """The function closest in L2: the least-squares solution c of (G + ridge) c = b.

    Of all solutions the one of least norm, so kernels that coincide share a coefficient evenly
    and nothing fails. Eigenvalues that are rounding errors count as zero. Linear and differentiable
    in the inner products, not in the Gram matrix.

    Args:
        gram: Inner products of the kernels.
        inner_products: Of the functions with the kernels.
        ridge: Weight of the squared coefficients beside the squared L2 error; 0 is ordinary least
            squares.

    Raises:
        ValueError: If the Gram matrix is not finite.

    Source:
        Tsai, Shih 2006, section 3 (ordinary and regularised least squares).
    """
    _check_finite(gram)
    values, vectors = torch.linalg.eigh(gram.detach())
    kept = values > values[-1] * len(values) * torch.finfo(values.dtype).eps
    inverse = torch.where(kept, 1.0 / torch.where(kept, values + ridge, 1.0), 0.0)
    coefficients = vectors @ (inverse[:, None] * (vectors.mT @ inner_products))
    return Fit(coefficients, _condition(values[-1], values[0]))


def collocation_projection(
    kernels: Float[Tensor, "samples n"],
    values: Float[Tensor, "samples columns"],
    ridge: float = 0.0,
) -> Fit:
    """The expansion closest to sampled values: least squares over the samples, of least norm.

    As many samples as kernels interpolate. Linear and differentiable in the values, not in the
    kernels.

    Args:
        kernels: Each kernel at each sample.
        values: Of the functions at the samples.
        ridge: Weight of the squared coefficients beside the sum of squared errors.

    Raises:
        ValueError: If a kernel is not finite.
    """
    _check_finite(kernels)
    left, singular, right = torch.linalg.svd(kernels.detach(), full_matrices=False)
    kept = singular > singular[0] * max(kernels.shape) * torch.finfo(singular.dtype).eps
    damped = torch.where(kept, singular + ridge / torch.where(kept, singular, 1.0), 1.0)
    inverse = torch.where(kept, 1.0 / damped, 0.0)
    coefficients = right.mT @ (inverse[:, None] * (left.mT @ values))
    smallest = singular[-1] if kernels.shape[0] >= kernels.shape[1] else singular.new_zeros(())
    return Fit(coefficients, _condition(singular[0], smallest))


def _check_finite(matrix: Tensor) -> None:
    count = int((~torch.isfinite(matrix)).sum())
    if count:
        raise ValueError(f"expected finite kernels, got {count} values that are not")


def _condition(largest: Tensor, smallest: Tensor) -> float:
    return float(largest / smallest) if float(smallest) > 0 else math.inf
