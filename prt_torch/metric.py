"""What an error of transfer is worth.

A metric turns transfer values into a space where plain sums of squares are the errors that count.
Representations are built in that space without knowing which metric it is, and their results are
turned back. The default is the L2 norm over the sphere of light directions, which the light
basis' Gram matrix gives, so fits in different bases answer the same question. A *light prior*
weighs errors by the light that is expected: then the squared norm of a transfer error is its
expected squared radiance error.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases import LightBasis
from prt_torch.sphere import rotation_about_up
from prt_torch.transfer import TransferTensor

_MAX_PRIOR_COEFFS = 2048  # its matrix has the square of it


@dataclass(frozen=True)
class Metric:
    """Squared error as the squared norm of ``difference @ factor``.

    Attributes:
        name: ``l2`` or ``light_prior``.
        factor: ``"coeffs"`` for a diagonal, or ``"coeffs coeffs"``; invertible, float64.
    """

    name: str
    factor: Float[Tensor, "coeffs"] | Float[Tensor, "coeffs coeffs"]

    @classmethod
    def l2(cls, transfer: TransferTensor) -> "Metric":
        """The L2 norm over the sphere of light directions."""
        basis = transfer.surface.light_basis
        if basis is None:
            return cls("l2", torch.ones(transfer.num_coeffs, dtype=torch.float64))
        gram = basis.gram()
        factor = gram.sqrt() if gram.ndim == 1 else torch.linalg.cholesky(gram)
        return cls("l2", factor)

    @classmethod
    def light_prior(
        cls,
        lights: Float[Tensor, "lights coeffs rgb"],
        light_basis: LightBasis,
        *,
        turns: int = 16,
        floor: float = 1e-3,
    ) -> "Metric":
        """Expected squared radiance under these lights, turned about the vertical.

        Args:
            lights: Light coefficients; each is scaled to the same power first.
            light_basis: Their basis.
            turns: Equal steps about +y that each light is taken at.
            floor: Share of the mean power that every direction of light space keeps, so that
                lights unlike these still count. It bounds the condition of the metric.

        Raises:
            ValueError: If there is no light, or the basis has too many coefficients.
        """
        coeffs = light_basis.num_coeffs
        if coeffs > _MAX_PRIOR_COEFFS:
            raise ValueError(
                f"a light prior takes at most {_MAX_PRIOR_COEFFS} light coefficients, got {coeffs}"
            )
        if len(lights) == 0:
            raise ValueError("a light prior needs at least one light")
        moment = torch.zeros(coeffs, coeffs, dtype=torch.float64)
        for turn in range(turns):
            turned = light_basis.rotate(lights.double(), rotation_about_up(360.0 * turn / turns))
            power = turned.square().sum((1, 2), keepdim=True)
            unit = (turned / torch.where(power > 0, power, 1.0).sqrt()).movedim(1, 0).flatten(1)
            moment += unit @ unit.mT
        moment = moment * (coeffs / moment.trace().clamp_min(torch.finfo(torch.float64).tiny))
        moment = moment + floor * torch.eye(coeffs, dtype=torch.float64)
        return cls("light_prior", torch.linalg.cholesky(moment))

    def weigh(self, values: Float[Tensor, "... coeffs"]) -> Float[Tensor, "... coeffs"]:
        """Into the space where errors are sums of squares."""
        factor = self.factor.to(values)
        return values * factor if factor.ndim == 1 else values @ factor

    def unweigh(self, values: Float[Tensor, "... coeffs"]) -> Float[Tensor, "... coeffs"]:
        """Back from it."""
        factor = self.factor.to(values)
        if factor.ndim == 1:
            return values / factor
        return torch.linalg.solve_triangular(factor, values, upper=False, left=False)
