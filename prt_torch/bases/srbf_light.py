"""Light made of scattered spherical radial basis functions: a few bells wherever it is bright."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases.srbf_kernels import (
    KernelName,
    check_kernel,
    gaussian_legendre,
    kernel_inner_products,
    kernel_values,
)

_TABLE_ELEMENTS = 2**18  # of kernel values at once: they stay in a processor's cache
_MOST_ROWS = 2048  # of the grid that an expansion is sampled on, unless finer is asked for


@dataclass(frozen=True, eq=False)
class SRBFExpansion:
    r"""A light made of scattered kernels: :math:`L(s) = \sum_k c_k G(s; \xi_k, \lambda_k)`.

    It is a :class:`prt_torch.bases.Radiance`, so any light basis can project it; :class:`SRBF` of
    the same kernel does so exactly. Coefficients may be negative.

    Attributes:
        centers: Unit vectors in the world.
        bandwidths: One each, as the kernel wants them.
        coefficients: Linear RGB.
        kernel: Which kernel.

    Raises:
        ValueError: If the tensors do not fit together, or there is no such kernel.
    """

    centers: Float[Tensor, "n 3"]
    bandwidths: Float[Tensor, "n"]
    coefficients: Float[Tensor, "n rgb"]
    kernel: KernelName = "gaussian"

    def __post_init__(self) -> None:
        check_kernel(self.kernel)
        number = len(self.bandwidths)
        shapes = [tuple(t.shape) for t in (self.centers, self.bandwidths, self.coefficients)]
        if shapes != [(number, 3), (number,), (number, 3)]:
            raise ValueError(f"expected centres n 3, bandwidths n, coefficients n 3, got {shapes}")

    def evaluate(self, directions: Float[Tensor, "k 3"]) -> Float[Tensor, "k rgb"]:
        """Radiance from unit directions, differentiable in everything."""
        values = kernel_values(self.kernel, directions, self.centers, self.bandwidths)
        return values @ self.coefficients

    def rotated(self, rotation: Float[Tensor, "3 3"]) -> "SRBFExpansion":
        """The light turned by ``rotation``, exactly: only its centres move."""
        return replace(self, centers=self.centers @ rotation.to(self.centers).mT)

    def inner_products(
        self, centers: Float[Tensor, "m 3"], bandwidths: Float[Tensor, "m"]
    ) -> Float[Tensor, "m rgb"]:
        """Integrals over the sphere of this light times other kernels of its kind."""
        pairs = kernel_inner_products(
            self.kernel, centers, bandwidths, self.centers, self.bandwidths
        )
        return pairs @ self.coefficients

    def squared_norm(self) -> Float[Tensor, "rgb"]:
        """Squared L2 norm over the sphere, of each colour."""
        return (self.coefficients * self.inner_products(self.centers, self.bandwidths)).sum(0)

    def sample_blocks(self, max_spacing: float) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Directions, solid angles [sr] and radiance on a lat-long grid, float64.

        Rows are equal steps of the polar angle with Fejér's weights, so integrals of the light
        times smooth functions are exact to 1e-5 (Gaussians 1e-8) at any spacing. Lobes too narrow
        for 2048 rows (Gaussians above 64,516, Abel-Poisson above 0.994) are widened to what these
        resolve and keep their energy, unless ``max_spacing`` asks for more rows.

        Args:
            max_spacing: Largest width of a piece [rad], more than 0.

        Raises:
            ValueError: If it is not.
        """
        if not max_spacing > 0:
            raise ValueError(f"expected a spacing above 0, got {max_spacing}")
        asked = math.ceil(math.pi / max_spacing)
        light, needed = self._resolved_by(max(asked, _MOST_ROWS))
        rows = max(asked, needed)
        theta = (torch.arange(rows, dtype=torch.float64) + 0.5) * (math.pi / rows)
        weights = _fejer_weights(rows) * (math.pi / rows)  # of one of 2 rows steps in azimuth
        azimuth = (torch.arange(2 * rows, dtype=torch.float64) + 0.5) * (math.pi / rows)
        circle = torch.stack([azimuth.sin(), torch.zeros_like(azimuth), -azimuth.cos()], dim=-1)
        up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        at_once = max(1, _TABLE_ELEMENTS // max(1, len(self.bandwidths)))
        rows_at_once = max(1, at_once // len(azimuth))
        for some in torch.arange(rows).split(rows_at_once):
            sine, cosine = theta[some].sin(), theta[some].cos()
            directions = sine[:, None, None] * circle + cosine[:, None, None] * up
            directions = directions.reshape(-1, 3).to(self.centers.device)
            radiance = torch.cat([light.evaluate(few) for few in directions.split(at_once)])
            solid_angles = weights[some].repeat_interleave(len(azimuth)).to(radiance)
            yield directions, solid_angles, radiance

    def _resolved_by(self, rows: int) -> tuple["SRBFExpansion", int]:
        """This light in float64, no lobe narrower than ``rows`` resolve; rows that it needs.

        A Gaussian's Legendre coefficients fall as exp(-l² / 2λ), those of Abel-Poisson as λˡ.
        """
        centers, coefficients = self.centers.double(), self.coefficients.double()
        given = self.bandwidths.double()
        if self.kernel == "gaussian":
            most = ((rows - 16) / 8.0) ** 2
            bandwidths = given.clamp(max=most)
            energy = gaussian_legendre(torch.stack([given, bandwidths]), 1)[..., 0]
            coefficients = coefficients * (energy[0] / energy[1])[:, None]
            finest = bandwidths.detach().sqrt()
        else:
            bandwidths = given.clamp(max=1.0 - 12.0 / (rows - 16))
            finest = 1.5 / (1.0 - bandwidths.detach())
        needed = 16 + (math.ceil(8.0 * float(finest.max())) if len(finest) else 0)
        light = SRBFExpansion(centers, bandwidths, coefficients, self.kernel)
        return light, min(needed, rows)


def _fejer_weights(rows: int) -> Float[Tensor, "rows"]:
    """Weights of ``rows`` equal steps of the polar angle, midpoints; positive, their sum is 2.

    Exact for polynomials in its cosine of degree below ``rows`` (Fejér's first rule).
    """
    k = np.arange(1, rows // 2 + 1)
    series = np.zeros(2 * rows)
    series[0] = 1.0
    series[2 * k] = -2.0 / (4.0 * k * k - 1.0)
    shift = np.exp(1j * np.pi / (2 * rows) * np.arange(2 * rows))
    cosines = np.fft.ifft(series * shift) * (2 * rows)
    return torch.from_numpy(np.ascontiguousarray(cosines.real[:rows])) * (2.0 / rows)
