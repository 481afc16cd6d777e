"""What an error of transfer is worth.

A metric turns transfer values into a space where plain sums of squares are the errors that count.
Representations are built in that space without knowing which metric it is, and their results are
turned back. The default is the L2 norm over the sphere of light directions, averaged over the
hemisphere of views, which the Gram matrices of the two bases give, so fits in different bases
answer the same question. A *light prior* weighs errors by the light that is expected: then the
squared norm of a transfer error is its expected squared radiance error.
"""

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases import Diffuse, ExitBasis, LightBasis, SphericalHarmonics
from prt_torch.sphere import rotation_about_up
from prt_torch.transfer import TransferTensor

MAX_PRIOR_COEFFS = 2048
"""Most light coefficients of a light prior, whose matrix has the square of them."""


@dataclass(frozen=True)
class Metric:
    """Squared error as the squared norm of a difference that was weighed on its two sides.

    Attributes:
        name: ``l2`` or ``light_prior``.
        light: What weighs the light side: a basis whose functions have their L2 norm over the
            sphere; a factor ``"coeffs coeffs"``, lower triangular, float64, that multiplies from
            the right; or None where coefficients count as they are.
        row_factor: ``"rows rows"`` lower triangular, float64: Cholesky factor of the exit basis'
            Gram matrix, whose transpose multiplies from the left.
    """

    name: str
    light: LightBasis | Float[Tensor, "coeffs coeffs"] | None = None
    row_factor: Float[Tensor, "rows rows"] = field(
        default_factory=lambda: torch.ones(1, 1, dtype=torch.float64)
    )

    @classmethod
    def l2(cls, transfer: TransferTensor) -> "Metric":
        """The L2 norm over the sphere of light directions, averaged over views."""
        row_factor = transfer.surface.exit_basis.gram_root()
        return cls("l2", transfer.surface.light_basis, row_factor)

    @classmethod
    def light_prior(
        cls,
        lights: Float[Tensor, "lights coeffs rgb"],
        light_basis: LightBasis,
        *,
        exit_basis: ExitBasis | None = None,
        turns: int = 16,
        shrinkage: float = 0.5,
        floor: float = 1e-3,
    ) -> "Metric":
        """Expected squared radiance under these lights, turned about the vertical.

        Args:
            lights: Light coefficients; each is scaled to the same power first.
            light_basis: Their basis.
            exit_basis: The basis of the transfer's rows; diffuse if not given.
            turns: Equal steps about +y that each light is taken at.
            shrinkage: Share of the expectation that is taken as if lights of the same power in each
                band pointed anywhere, 0 to 1. A few lights say little about how one coefficient
                goes with another: held-out lights lose less, and point lights far less, than where
                these few are believed (docs/radiance_metric.md). Coefficients of other bases than
                harmonics keep their own power.
            floor: Share of the mean power that every direction of light space keeps, so that
                lights unlike these still count. It bounds the condition of the metric.

        Raises:
            ValueError: If there is no light or all are black, or the basis has too many
                coefficients.
        """
        coeffs = light_basis.num_coeffs
        if coeffs > MAX_PRIOR_COEFFS:
            raise ValueError(
                f"a light prior takes at most {MAX_PRIOR_COEFFS} light coefficients, got {coeffs}"
            )
        if len(lights) == 0:
            raise ValueError("a light prior needs at least one light")
        if not 0.0 <= shrinkage <= 1.0:
            raise ValueError(f"expected a shrinkage in 0..1, got {shrinkage}")
        moment = torch.zeros(coeffs, coeffs, dtype=torch.float64)
        for turn in range(turns):
            turned = light_basis.rotate(lights.double(), rotation_about_up(360.0 * turn / turns))
            power = turned.square().sum((1, 2), keepdim=True)
            unit = (turned / torch.where(power > 0, power, 1.0).sqrt()).movedim(1, 0).flatten(1)
            moment += unit @ unit.mT
        if not moment.trace() > 0:
            raise ValueError("expected a light that is not black, got nothing but zeros")
        moment = moment * (coeffs / moment.trace())
        moment = torch.lerp(moment, _uncorrelated(moment, light_basis), shrinkage)
        moment = moment + floor * torch.eye(coeffs, dtype=torch.float64)
        rows = (exit_basis or Diffuse()).gram_root()
        return cls("light_prior", torch.linalg.cholesky(moment), rows)

    def to_file(self) -> dict[str, Tensor]:
        """What a file must hold to have the light side of :meth:`in_float32` back.

        ``light_factor``: the lower triangle of a prior's factor, row by row; else nothing.
        """
        match self.light:
            case None | LightBasis():
                return {}
            case factor:
                rows, columns = torch.tril_indices(len(factor), len(factor))
                return {"light_factor": factor[rows, columns].float()}

    @classmethod
    def from_file(
        cls, packed: dict[str, Tensor], light_basis: LightBasis | None, exit_basis: ExitBasis
    ) -> "Metric":
        """The inverse of :meth:`to_file`."""
        if "light_factor" not in packed:
            return cls("l2", light_basis, exit_basis.gram_root())
        values = packed["light_factor"].double()
        size = math.isqrt(2 * len(values))
        factor = values.new_zeros(size, size)
        rows, columns = torch.tril_indices(size, size)
        factor[rows, columns] = values
        return cls("light_prior", factor, exit_basis.gram_root())

    def in_float32(self) -> "Metric":
        """The same as a file gives a prior back: in its precision, and row by row."""
        match self.light:
            case None | LightBasis():
                return self
            case factor:
                return replace(self, light=factor.float().double().contiguous())

    def weigh(self, values: Float[Tensor, "... rows coeffs"]) -> Float[Tensor, "... rows coeffs"]:
        """Into the space where errors are sums of squares; may be ``values`` itself."""
        if len(self.row_factor) > 1:
            values = self.row_factor.mT.to(values) @ values
        match self.light:
            case None:
                return values
            case LightBasis():
                return self.light.weigh(values)
            case factor:
                return values @ factor.to(values)

    def unweigh(self, values: Float[Tensor, "... rows coeffs"]) -> Float[Tensor, "... rows coeffs"]:
        """Back from it."""
        if len(self.row_factor) > 1:
            upper = self.row_factor.mT.to(values)
            values = torch.linalg.solve_triangular(upper, values, upper=True)
        match self.light:
            case None:
                return values
            case LightBasis():
                return self.light.unweigh(values)
            case factor:
                factor = factor.to(values)
                return torch.linalg.solve_triangular(factor, values, upper=False, left=False)


def _uncorrelated(
    moment: Float[Tensor, "coeffs coeffs"], light_basis: LightBasis
) -> Float[Tensor, "coeffs coeffs"]:
    """The moment without cross terms, each harmonic with the mean power of its band."""
    powers = moment.diagonal()
    if isinstance(light_basis, SphericalHarmonics):
        bands = powers.split([2 * band + 1 for band in range(light_basis.order)])
        powers = torch.cat([one.mean().expand_as(one) for one in bands])
    return torch.diag(powers)
