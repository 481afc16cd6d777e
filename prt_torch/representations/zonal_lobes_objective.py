r"""How far zonal lobes about given axes are from functions, at the coefficients best for them.

With the axes :math:`s_i` of N lobes given, the coefficients of a band l that are closest to its
spherical harmonics :math:`t_l` solve N equations, and those of other bands have no part in them.
So only axes are left to be sought. A lobe scaled to norm one is
:math:`\hat y_l(s) = \sqrt{4\pi / (2l+1)}\; y_l(s)`; with weights c of such lobes

.. math:: E = \sum_l \min_{c_l} \Bigl|t_l - \sum_i c_{il}\, \hat y_l(s_i)\Bigr|^2
    + \lambda |c_l|^2 = \sum_l |t_l|^2 - \beta_l \cdot (P_l + \lambda)^{-1} \beta_l,

where :math:`\beta_{il} = \hat y_l(s_i) \cdot t_l` and the matrix :math:`P_l(s_i \cdot s_j)` is that
of Legendre polynomials, by the addition theorem. The *ridge* :math:`\lambda` keeps two lobes that
run into each other from growing without bound against each other: strictly, it asks a growth of
:math:`|c|^2` to win as much of the squared error, over λ.

Gradients need no derivatives of harmonics either: :math:`r^l y_l(s)` is a harmonic polynomial, so
its gradient is made of harmonics of the band below, and the function itself is s times its
gradient over l.

Thousands of fits are evaluated side by side. They are the *last* axis of every tensor, and the few
lobes, bands and equations are loops: a matrix of four rows is too small for a library call.
"""

import functools
import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from prt_torch.bases import sh


@dataclass(frozen=True)
class Fits:
    """Places of several fits, and what is known there.

    Attributes:
        axes: Of any length but zero.
        objective: Squared error plus ridge.
        gradient: Of the objective with respect to ``axes``.
        weights: Of lobes of norm one, of each band that is fitted.
    """

    axes: Float[Tensor, "lobes 3 fits"]
    objective: Float[Tensor, "fits"]
    gradient: Float[Tensor, "lobes 3 fits"]
    weights: Float[Tensor, "bands lobes fits"]

    def pick(self, which: Bool[Tensor, "fits"] | Int[Tensor, "some"]) -> "Fits":
        """Some of the fits."""
        return Fits(*(getattr(self, field.name)[..., which] for field in fields(self)))

    def replaced(self, where: Bool[Tensor, "fits"], other: "Fits") -> "Fits":
        """With other fits in some places."""
        names = [field.name for field in fields(self)]
        return Fits(*(torch.where(where, getattr(other, n), getattr(self, n)) for n in names))


class LobeObjective:
    """Squared errors of fits to functions given by spherical harmonics.

    Args:
        targets: Functions, one a fit; all bands from 0 on.
        first_band: The first that lobes are for, at least 1. Band 0 is met exactly by any lobe.
        ridge: On squared weights of lobes of norm one; not below a few roundings.
    """

    def __init__(self, targets: Float[Tensor, "fits coeffs"], first_band: int, ridge: float):
        self.order = math.isqrt(targets.shape[1])
        self.bands = range(first_band, self.order)
        self.ridge = max(ridge, 32.0 * torch.finfo(targets.dtype).eps)
        self._slopes = _slopes(targets, self.order)
        self._squared_norm = targets[:, first_band**2 :].square().sum(1)

    def pick(self, which: Bool[Tensor, "fits"] | Int[Tensor, "some"]) -> "LobeObjective":
        """For some of the fits, or for some of them several times."""
        picked = object.__new__(LobeObjective)
        picked.order, picked.bands, picked.ridge = self.order, self.bands, self.ridge
        picked._slopes = self._slopes[..., which]
        picked._squared_norm = self._squared_norm[which]
        return picked

    def evaluate(self, axes: Float[Tensor, "lobes 3 fits"]) -> Fits:
        """The objective, its gradient and the best weights at axes of any length but zero."""
        lengths = axes.square().sum(1, keepdim=True).sqrt()
        units = axes / lengths
        slopes = self._slopes_at(units)  # bands lobes 3 fits
        degrees = torch.tensor(self.bands, device=axes.device).view(-1, 1, 1).to(axes)
        values = (slopes * units).sum(2) / degrees
        cosines = (units[:, None] * units).sum(2)
        grams, derivatives = _legendre(cosines, self.bands)
        weights = _solve(grams, values, self.ridge)
        objective = self._squared_norm - (values * weights).sum((0, 1))
        pulls = derivatives * weights[:, None]  # bands lobes others fits
        toward = (slopes * weights[:, :, None]).sum(0)
        mutual = (pulls * weights[:, :, None]).sum(0)
        gradient = -2.0 * (toward - (mutual[:, :, None] * units).sum(1))
        along = (gradient * units).sum(1, keepdim=True)
        return Fits(axes, objective, (gradient - along * units) / lengths, weights)

    def _slopes_at(
        self, units: Float[Tensor, "lobes 3 fits"]
    ) -> Float[Tensor, "bands lobes 3 fits"]:
        """Gradients of the products of a lobe of norm one with the target's bands."""
        harmonics = sh.evaluate(units.movedim(1, 2), self.order - 1).movedim(-1, 0).contiguous()
        below = [slice((band - 1) ** 2, band**2) for band in self.bands]
        return torch.stack(
            [(harmonics[own][:, :, None] * self._slopes[own][:, None]).sum(0) for own in below]
        )


@functools.lru_cache(maxsize=8)
def _slope_matrices(order: int) -> Float[Tensor, "below 3 coeffs"]:
    """Gradients of lobes' products: harmonics of the band below, from those of the target."""
    products = sh.product_matrix(max(order - 1, 1), 2)[:, [3, 1, 2]]  # below, x y z, coeffs
    slopes = torch.zeros_like(products)
    for band in range(1, order):
        below, own = slice((band - 1) ** 2, band**2), slice(band**2, (band + 1) ** 2)
        scale = (2 * band + 1) * math.sqrt(4 * math.pi / (2 * band + 1))
        slopes[below, :, own] = scale * math.sqrt(4 * math.pi / 3) * products[below, :, own]
    return slopes


def _slopes(targets: Tensor, order: int) -> Float[Tensor, "below 3 fits"]:
    matrices = _slope_matrices(order).to(targets)
    return (matrices[..., : order * order].flatten(0, 1) @ targets.mT).unflatten(0, (-1, 3))


def _legendre(
    cosines: Float[Tensor, "lobes others fits"], bands: range
) -> tuple[Float[Tensor, "bands lobes others fits"], Float[Tensor, "bands lobes others fits"]]:
    """Legendre polynomials of these bands, and their derivatives."""
    polynomials = [torch.ones_like(cosines), cosines]
    derivatives = [torch.zeros_like(cosines), torch.ones_like(cosines)]
    for band in range(2, bands.stop):
        last, before = polynomials[-1], polynomials[-2]
        polynomials.append(((2 * band - 1) * cosines * last - (band - 1) * before) / band)
        derivatives.append(derivatives[-2] + (2 * band - 1) * last)
    own = slice(bands.start, bands.stop)
    return torch.stack(polynomials[own]), torch.stack(derivatives[own])


def _solve(
    grams: Float[Tensor, "bands lobes others fits"],
    values: Float[Tensor, "bands lobes fits"],
    ridge: float,
) -> Float[Tensor, "bands lobes fits"]:
    """Weights by Cholesky factors; pivots that rounding has taken below the ridge are raised to it.

    So lobes that a band has no room for have small weights, and nothing is divided by zero.
    """
    lobes = values.shape[1]
    factor: list[list[Tensor]] = []
    inverse: list[Tensor] = []
    forward: list[Tensor] = []
    for row in range(lobes):
        entries: list[Tensor] = []
        for column in range(row):
            entry = grams[:, row, column]
            for k in range(column):
                entry = torch.addcmul(entry, entries[k], factor[column][k], value=-1.0)
            entries.append(entry * inverse[column])
        pivot = grams[:, row, row] + ridge
        value = values[:, row]
        for k in range(row):
            pivot = torch.addcmul(pivot, entries[k], entries[k], value=-1.0)
            value = torch.addcmul(value, entries[k], forward[k], value=-1.0)
        inverse.append(pivot.clamp_min(ridge).rsqrt())
        forward.append(value * inverse[row])
        factor.append(entries)
    weights: list[Tensor] = [forward[0]] * lobes
    for row in reversed(range(lobes)):
        value = forward[row]
        for k in range(row + 1, lobes):
            value = torch.addcmul(value, factor[k][row], weights[k], value=-1.0)
        weights[row] = value * inverse[row]
    return torch.stack(weights, dim=1)
