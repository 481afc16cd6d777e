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

The matrix of Gauss and Newton goes with it, for unknowns that are turns of each lobe towards two
*tangents*. Of what a turn does to the sum of lobes at weights held fast, a band's other weights can
undo the part within the span of its lobes; what is left has the products

.. math:: H_{ia, jb} = \sum_l c_{il} c_{jl}\, \bigl(\partial_a \hat y_l(s_i) \cdot
    \partial_b \hat y_l(s_j) - b_{ia}^T (P_l + \lambda)^{-1} b_{jb}\bigr),
    \quad b_{k, ia} = \hat y_l(s_k) \cdot \partial_a \hat y_l(s_i),

all of them derivatives of Legendre polynomials.

Thousands of fits are evaluated side by side. They are the *last* axis of every tensor, and the few
lobes, bands and equations are loops: a matrix of four rows is too small for a library call.

Source:
    Sloan, Luna, Snyder 2005, equations 17 to 21, with the coefficients eliminated as by Golub and
    Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares problems whose
    variables separate", 1973. The matrix of Gauss and Newton is Kaufman's, "A variable projection
    method for solving separable nonlinear least squares problems", 1975.
"""

import copy
import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from prt_torch.bases import sh
from prt_torch.bases.tables import kept


@dataclass(frozen=True)
class Fits:
    """Places of several fits, and what is known there.

    Attributes:
        axes: Of unit length.
        objective: Squared error plus ridge.
        weights: Of lobes of norm one, of each band that is fitted.
        tangents: Two directions square to each axis and to each other.
        slope: Half the derivatives of the objective by turns towards the tangents [1/rad].
        curvature: H above, half of Gauss and Newton's second derivatives by them.
    """

    axes: Float[Tensor, "lobes 3 fits"]
    objective: Float[Tensor, "fits"]
    weights: Float[Tensor, "bands lobes fits"]
    tangents: Float[Tensor, "lobes 2 3 fits"]
    slope: Float[Tensor, "turns fits"]
    curvature: Float[Tensor, "turns turns fits"]

    def pick(self, which: Bool[Tensor, "fits"] | Int[Tensor, "some"]) -> "Fits":
        """Some of the fits."""
        return Fits(*(getattr(self, field.name)[..., which] for field in fields(self)))

    def replaced(self, where: Bool[Tensor, "fits"], other: "Fits") -> "Fits":
        """With other fits in some places."""
        names = [field.name for field in fields(self)]
        return Fits(*(torch.where(where, getattr(other, n), getattr(self, n)) for n in names))


@dataclass(frozen=True)
class Anchors:
    """Lobes that fits are held to by springs.

    Attributes:
        axes: In the unit ball: unit axes, or means of some.
        weights: That the ridge pulls to, in place of zero.
        stiffness: Of the springs between axes: what the square of a distance adds to the objective.
    """

    axes: Float[Tensor, "lobes 3 fits"]
    weights: Float[Tensor, "bands lobes fits"]
    stiffness: Float[Tensor, "lobes fits"]

    def pick(self, which: Bool[Tensor, "fits"] | Int[Tensor, "some"]) -> "Anchors":
        """Those of some of the fits."""
        return Anchors(*(getattr(self, field.name)[..., which] for field in fields(self)))

    def springs(self, units: Float[Tensor, "lobes 3 fits"]) -> Float[Tensor, "fits"]:
        """What unit axes away from the anchors add."""
        return (self.stiffness * (units - self.axes).square().sum(1)).sum(0)


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
        self._anchors: Anchors | None = None

    def anchored(self, anchors: Anchors) -> "LobeObjective":
        """The same, held to anchors."""
        other = copy.copy(self)
        other._anchors = anchors
        return other

    def pick(self, which: Bool[Tensor, "fits"] | Int[Tensor, "some"]) -> "LobeObjective":
        """For some of the fits, or for some of them several times."""
        picked = copy.copy(self)
        picked._slopes = self._slopes[..., which]
        picked._squared_norm = self._squared_norm[which]
        picked._anchors = None if self._anchors is None else self._anchors.pick(which)
        return picked

    def squared_error(self, fits: Fits) -> Float[Tensor, "fits"]:
        """The objective without ridge and springs."""
        anchors = self._anchors
        if anchors is None:
            return fits.objective - self.ridge * fits.weights.square().sum((0, 1))
        ridge = self.ridge * (fits.weights - anchors.weights).square().sum((0, 1))
        return fits.objective - ridge - anchors.springs(fits.axes)

    def evaluate(self, axes: Float[Tensor, "lobes 3 fits"]) -> Fits:
        """The objective, the best weights and what a step needs, at axes of any length but zero."""
        units = axes / axes.square().sum(1, keepdim=True).sqrt()
        slopes = self._slopes_at(units)  # bands lobes 3 fits
        degrees = torch.tensor(self.bands, device=axes.device).view(-1, 1, 1).to(axes)
        values = (slopes * units).sum(2) / degrees
        cosines = (units[:, None] * units).sum(2)
        grams, derivatives, seconds = _legendre(cosines, self.bands)
        anchors = self._anchors
        wanted = values if anchors is None else values + self.ridge * anchors.weights
        factor = _factor(grams, self.ridge)
        weights = _solve_back(factor, _solve_forward(factor, list(wanted.unbind(1))))
        objective = self._squared_norm - (wanted * weights).sum((0, 1))
        pulls = derivatives * weights[:, None]  # bands others lobes fits
        mutual = (pulls * weights[:, :, None]).sum(0)
        bend = (seconds * weights[:, None] * weights[:, :, None]).sum(0)
        toward = (slopes * weights[:, :, None]).sum(0)
        gradient = (mutual[:, :, None] * units).sum(1) - toward
        tangents = _tangents(units)
        along = (units[:, None, None] * tangents).sum(3)  # others lobes 2 fits
        curvature = _products_of_turns(tangents, along, mutual, bend)
        within = (pulls[:, :, :, None] * along).flatten(2, 3)  # bands others turns fits
        for row in _solve_forward(factor, list(within.unbind(1))):
            for band in row:
                curvature.addcmul_(band[:, None], band, value=-1.0)
        slope = (tangents * gradient[:, None]).sum(2).flatten(0, 1)
        if anchors is not None:
            objective += self.ridge * anchors.weights.square().sum((0, 1)) + anchors.springs(units)
            towards = (tangents * anchors.axes[:, None]).sum(2)  # lobes 2 fits
            slope -= (anchors.stiffness[:, None] * towards).flatten(0, 1)
            stiffness = anchors.stiffness.repeat_interleave(2, 0)
            curvature.diagonal(dim1=0, dim2=1).add_(stiffness.mT)
        return Fits(units, objective, weights, tangents, slope, curvature)

    def _slopes_at(
        self, units: Float[Tensor, "lobes 3 fits"]
    ) -> Float[Tensor, "bands lobes 3 fits"]:
        """Gradients of the products of a lobe of norm one with the target's bands."""
        harmonics = sh.evaluate(units.movedim(1, 2), self.order - 1).movedim(-1, 0).contiguous()
        below = [slice((band - 1) ** 2, band**2) for band in self.bands]
        return torch.stack(
            [(harmonics[own][:, :, None] * self._slopes[own][:, None]).sum(0) for own in below]
        )


@kept
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
) -> tuple[Tensor, Tensor, Tensor]:
    """Legendre polynomials of these bands, first and second derivatives: bands first."""
    polynomials = [torch.ones_like(cosines), cosines]
    derivatives = [torch.zeros_like(cosines), torch.ones_like(cosines)]
    seconds = [torch.zeros_like(cosines), torch.zeros_like(cosines)]
    for band in range(2, bands.stop):
        last, before = polynomials[-1], polynomials[-2]
        polynomials.append(((2 * band - 1) * cosines * last - (band - 1) * before) / band)
        seconds.append(seconds[-2] + (2 * band - 1) * derivatives[-1])
        derivatives.append(derivatives[-2] + (2 * band - 1) * last)
    own = slice(bands.start, bands.stop)
    return torch.stack(polynomials[own]), torch.stack(derivatives[own]), torch.stack(seconds[own])


def _tangents(units: Float[Tensor, "lobes 3 fits"]) -> Float[Tensor, "lobes 2 3 fits"]:
    """Two directions square to each axis, without a singular one.

    Source:
        Duff et al., "Building an orthonormal basis, revisited", 2017.
    """
    x, y, z = units.unbind(1)
    sign = torch.copysign(torch.ones_like(z), z)
    scale = -1.0 / (sign + z)
    both = x * y * scale
    first = torch.stack([1.0 + sign * x.square() * scale, sign * both, -sign * x], dim=1)
    second = torch.stack([both, sign + y.square() * scale, -y], dim=1)
    return torch.stack([first, second], dim=1)


def _products_of_turns(
    tangents: Float[Tensor, "lobes 2 3 fits"],
    along: Float[Tensor, "others lobes 2 fits"],
    mutual: Float[Tensor, "lobes others fits"],
    bend: Float[Tensor, "lobes others fits"],
) -> Float[Tensor, "turns turns fits"]:
    """Products of what turns of lobes do to their sum at weights held fast, added over bands.

    Args:
        tangents: Of the lobes.
        along: Tangents of lobes along the axes of others.
        mutual: Derivatives of Legendre polynomials, times both lobes' weights.
        bend: Second derivatives, so too.
    """
    lobes, fits = len(tangents), tangents.shape[-1]
    products = tangents.new_empty(lobes, 2, lobes, 2, fits)
    for lobe in range(lobes):
        for turn in range(2):
            cosines = (tangents[lobe, turn] * tangents).sum(2)
            bent = (bend[lobe] * along[:, lobe, turn])[:, None]
            products[lobe, turn] = torch.addcmul(cosines * mutual[lobe][:, None], bent, along[lobe])
    return products.flatten(2, 3).flatten(0, 1)


@dataclass(frozen=True)
class _Factor:
    """Cholesky factors of small matrices: entries below the diagonal, and one over it."""

    below: list[list[Tensor]]
    inverse: list[Tensor]


def _factor(grams: Float[Tensor, "bands lobes others fits"], ridge: float) -> _Factor:
    """Of the matrices plus the ridge; pivots that rounding has taken below it are raised to it.

    So lobes that a band has no room for have small weights, and nothing is divided by zero.
    """
    below: list[list[Tensor]] = []
    inverse: list[Tensor] = []
    for row in range(grams.shape[1]):
        entries: list[Tensor] = []
        for column in range(row):
            entry = grams[:, row, column]
            for k in range(column):
                entry = torch.addcmul(entry, entries[k], below[column][k], value=-1.0)
            entries.append(entry * inverse[column])
        pivot = grams[:, row, row] + ridge
        for entry in entries:
            pivot = torch.addcmul(pivot, entry, entry, value=-1.0)
        inverse.append(pivot.clamp_min(ridge).rsqrt())
        below.append(entries)
    return _Factor(below, inverse)


def _solve_forward(factor: _Factor, rows: list[Tensor]) -> list[Tensor]:
    """The factor's inverse times a vector "bands fits", or several "bands several fits", by row."""
    solved: list[Tensor] = []
    for row, entries in enumerate(factor.below):
        value = rows[row]
        shape = (len(value), *(1,) * (value.ndim - 2), value.shape[-1])
        for entry, before in zip(entries, solved, strict=True):
            value = torch.addcmul(value, entry.view(shape), before, value=-1.0)
        solved.append(value * factor.inverse[row].view(shape))
    return solved


def _solve_back(factor: _Factor, rows: list[Tensor]) -> Float[Tensor, "bands lobes fits"]:
    """The transposed factor's inverse times a vector, by row."""
    lobes = len(rows)
    weights = list(rows)
    for row in reversed(range(lobes)):
        value = rows[row]
        for k in range(row + 1, lobes):
            value = torch.addcmul(value, factor.below[k][row], weights[k], value=-1.0)
        weights[row] = value * factor.inverse[row]
    return torch.stack(weights, dim=1)
