r"""How far a sum of spherical radial basis functions is from texels of light, and which way down.

The squared error over the sphere is linear least squares in the coefficients, so they are
*eliminated*: for any centres and widths the best coefficients are found by a solve, and what is
left is a function of centres and widths alone,

.. math:: F(\xi, \omega) = \min_c\; \|\sqrt\Omega\,(L - \Phi(\xi, \omega)\, c)\|^2
          + \rho \sum_k \|\varphi_k\|^2 |c_k|^2 .

As the coefficients are where the gradient with respect to them is zero, the gradient of F is that
of the error at fixed coefficients: the solve is never differentiated. The second derivatives are
those of Gauss and Newton for the projected error, without the one term that takes the derivative
of the residual's projection (Kaufman's approximation).

Light is the mean radiance of texels and kernels are sampled at their centres. So that a lobe
means the same between texels as at them, its width is at least half the texel's that its centre
is in: a narrower one could match a texel and be nothing beside it.

Source:
    Tsai, Shih 2006, section 5.3; Golub, Pereyra 1973 and Kaufman 1975 for the elimination. The
    paper takes the three sets of parameters in turn instead.
"""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from prt_torch.bases.srbf_kernels import KernelName
from prt_torch.sphere import cubemap_directions, cubemap_solid_angles, frame_from_normal

RIDGE = 1e-8
"""Share of each function's squared norm that is added to the diagonal of the normal equations."""

_LEAST_TEXELS, _WIDEST = 0.5, 10.0  # width of a lobe: in texels, and in radians


@dataclass(frozen=True)
class Projected:
    """The objective at one place: the best coefficients there, and what they leave.

    Attributes:
        centers: Unit vectors.
        log_widths: Logarithm of the width of each function [rad].
        values: Functions at texels, times the root of the texels' solid angles.
        scale: One over the norm of each function's values.
        factor: Cholesky factor of the normal equations of functions scaled to norm one.
        coefficients: The best ones, of light scaled to norm one.
        residual: What they leave of it, at texels as ``values``.
        objective: Squared norm of the residual, and the ridge's part.
    """

    centers: Float[Tensor, "batch n 3"]
    log_widths: Float[Tensor, "batch n"]
    values: Float[Tensor, "batch texels n"]
    scale: Float[Tensor, "batch n"]
    factor: Float[Tensor, "batch n n"]
    coefficients: Float[Tensor, "batch n rgb"]
    residual: Float[Tensor, "batch texels rgb"]
    objective: Float[Tensor, "batch"]

    def pick(self, which: Bool[Tensor, "batch"]) -> "Projected":
        """Some members of the batch."""
        return Projected(*(getattr(self, field.name)[which] for field in fields(self)))

    def replaced(self, better: Bool[Tensor, "batch"], other: "Projected") -> "Projected":
        """Members of another in place of these where ``better``."""

        def chosen(own: Tensor, new: Tensor) -> Tensor:
            return torch.where(better.view(-1, *(1,) * (own.ndim - 1)), new, own)

        names = [field.name for field in fields(self)]
        return Projected(*(chosen(getattr(self, name), getattr(other, name)) for name in names))


class TexelObjective:
    """Squared error over the sphere against texels, coefficients eliminated; for several lights.

    Args:
        radiance: Mean radiance of each texel of cube maps, ``"6 row col"`` flattened.
        kernel: ``gaussian`` or ``abel_poisson``.

    Attributes:
        norms: L2 norm of each light over the sphere; 1 where it is black.

    Raises:
        ValueError: If the texels are not those of a cube map, or are not finite.
    """

    def __init__(self, radiance: Float[Tensor, "batch texels rgb"], kernel: KernelName):
        resolution = round((radiance.shape[1] / 6) ** 0.5)
        if radiance.shape[1] != 6 * resolution**2 or not resolution:
            raise ValueError(f"expected 6 n^2 texels, got {radiance.shape[1]}")
        radiance = radiance.detach().to(torch.float64)
        if not bool(torch.isfinite(radiance).all()):
            raise ValueError("expected finite radiance, got infinity or NaN")
        device = radiance.device
        self.kernel: KernelName = kernel
        self.resolution = resolution
        self.directions = cubemap_directions(resolution, dtype=torch.float64).view(-1, 3).to(device)
        solid_angles = cubemap_solid_angles(resolution, dtype=torch.float64).view(-1, 1)
        self.root_solid_angles = solid_angles.sqrt().to(device)
        # Scaled before it is squared, so that no light is too bright or too dim.
        largest = radiance.abs().amax((1, 2), keepdim=True)
        largest = torch.where(largest > 0, largest, 1.0)
        weighed = radiance / largest * self.root_solid_angles
        norms = weighed.norm(dim=(1, 2), keepdim=True)
        norms = torch.where(norms > 0, norms, 1.0)
        self.target = weighed / norms
        self.norms: Float[Tensor, "batch"] = (norms * largest)[:, 0, 0]

    def pick(self, which: Bool[Tensor, "batch"]) -> "TexelObjective":
        """The objective of some of the lights."""
        some = object.__new__(TexelObjective)
        some.__dict__.update(self.__dict__)
        some.target, some.norms = self.target[which], self.norms[which]
        return some

    def evaluate(
        self, centers: Float[Tensor, "batch n 3"], log_widths: Float[Tensor, "batch n"]
    ) -> Projected:
        """Normalise centres, keep widths in range, and find the best coefficients."""
        centers = torch.nn.functional.normalize(centers, dim=-1)
        least = (_LEAST_TEXELS * texel_widths(centers, self.resolution)).log()
        log_widths = torch.maximum(log_widths, least).clamp_max(torch.tensor(_WIDEST).log().item())
        cosines = self.directions @ centers.mT
        values = profile(cosines, log_widths, self.kernel) * self.root_solid_angles
        gram = values.mT @ values
        scale = gram.diagonal(dim1=1, dim2=2).rsqrt()
        gram = gram * scale[:, :, None] * scale[:, None]
        gram.diagonal(dim1=1, dim2=2).add_(RIDGE)
        factor, _ = torch.linalg.cholesky_ex(gram)
        scaled = torch.cholesky_solve((values.mT @ self.target) * scale[..., None], factor)
        coefficients = scaled * scale[..., None]
        residual = self.target - values @ coefficients
        objective = residual.square().sum((1, 2)) + RIDGE * scaled.square().sum((1, 2))
        return Projected(
            centers, log_widths, values, scale, factor, coefficients, residual, objective
        )

    def gradient(self, at: Projected) -> Float[Tensor, "batch unknowns"]:
        """Half the gradient by tangent steps of centres (all first, all second) and log widths."""
        return self._derivatives(at)[1]

    def normal_equations(
        self, at: Projected
    ) -> tuple[Float[Tensor, "batch unknowns unknowns"], Float[Tensor, "batch unknowns"]]:
        """Half the Gauss-Newton second derivatives (Kaufman's), and half the gradient.

        The products over texels are taken in float32: they only steer.
        """
        derivatives, gradient = self._derivatives(at)
        n = at.centers.shape[1]
        columns = torch.cat([(at.values * at.scale[:, None]).float(), derivatives], dim=2)
        products = (columns.mT @ columns).double()
        along, across = products[:, n:, n:], products[:, :n, n:]
        projected = along - across.mT @ torch.cholesky_solve(across, at.factor)
        weights = at.coefficients.repeat(1, 3, 1)
        return projected * (weights @ weights.mT), gradient

    def _derivatives(self, at: Projected) -> tuple[Tensor, Tensor]:
        """Of the functions at texels, float32, and half the gradient of the objective."""
        frames = frame_from_normal(at.centers)
        cosines = self.directions @ at.centers.mT
        by_cosine, by_width = slopes(cosines, at.log_widths, at.values, self.kernel)
        along = [by_cosine * (self.directions @ frames[:, :, axis].mT) for axis in range(2)]
        derivatives = torch.cat([*along, by_width], dim=2)
        weights = at.coefficients.repeat(1, 3, 1)
        own = (derivatives * at.values.repeat(1, 1, 3)).sum(1)
        gradient = -((derivatives.mT @ at.residual) * weights).sum(-1)
        return derivatives.float(), gradient + RIDGE * own * weights.square().sum(-1)


def texel_widths(directions: Float[Tensor, "*batch 3"], resolution: int) -> Float[Tensor, "*batch"]:
    """Root of the solid angle of a texel of a cube map that would be centred there [rad]."""
    return directions.abs().amax(-1).pow(1.5) * (2.0 / resolution)


def bandwidths_from_widths(
    widths: Float[Tensor, "*batch"], kernel: KernelName
) -> Float[Tensor, "*batch"]:
    r"""Bandwidths whose kernels have these widths [rad].

    A Gaussian's is :math:`1/\sqrt\lambda`, an Abel-Poisson kernel's
    :math:`(1-\lambda)/\sqrt\lambda`: both kernels are functions of distance over width.
    """
    match kernel:
        case "gaussian":
            return widths.pow(-2)
        case "abel_poisson":
            return (2.0 / (widths + (widths.square() + 4.0).sqrt())).square()


def widths_from_bandwidths(
    bandwidths: Float[Tensor, "*batch"], kernel: KernelName
) -> Float[Tensor, "*batch"]:
    """The inverse of :func:`bandwidths_from_widths`."""
    match kernel:
        case "gaussian":
            return bandwidths.rsqrt()
        case "abel_poisson":
            return (1.0 - bandwidths) * bandwidths.rsqrt()


def profile(
    cosines: Float[Tensor, "batch texels n"], log_widths: Float[Tensor, "batch n"], kernel: str
) -> Float[Tensor, "batch texels n"]:
    r"""Kernels scaled to peak 1, as functions of the cosine u and the width w.

    :math:`e^{-(1-u)/w^2}`, and :math:`(1 + 2(1-u)/w^2)^{-3/2}` of Abel and Poisson.
    """
    depth = (1.0 - cosines) * (-2.0 * log_widths).exp()[:, None]
    return torch.exp(-depth) if kernel == "gaussian" else (1.0 + 2.0 * depth).pow(-1.5)


def slopes(
    cosines: Float[Tensor, "batch texels n"],
    log_widths: Float[Tensor, "batch n"],
    values: Float[Tensor, "batch texels n"],
    kernel: KernelName,
) -> tuple[Float[Tensor, "batch texels n"], Float[Tensor, "batch texels n"]]:
    """Derivatives of :func:`profile`, weighed as ``values``, by the cosine and the log width."""
    inverse = (-2.0 * log_widths).exp()[:, None]
    depth = (1.0 - cosines) * inverse
    steepness = values if kernel == "gaussian" else 3.0 * values / (1.0 + 2.0 * depth)
    return steepness * inverse, 2.0 * steepness * depth
