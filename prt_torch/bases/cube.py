r"""Cube-map texels as a light basis: the uncompressed, all-frequency reference.

The basis function of texel j is :math:`\chi_j / \Omega_j`, the mean over the texel. So light
coefficients are mean radiances, transfer values are integrals of transfer over texels (solid angle
included), and the Gram matrix is :math:`\operatorname{diag}(1/\Omega_j)`.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases.base import LightBasis, Radiance
from prt_torch.bases.tables import kept_property
from prt_torch.sphere import cubemap_directions, cubemap_index, cubemap_solid_angles


class CubeDirections(LightBasis):
    """Texels of a ``6 x resolution x resolution`` cube map.

    Not closed under rotation: :meth:`rotate` takes the radiance at the turned texel centre
    (nearest), so prefer to turn the environment and project again.

    Args:
        resolution: Texels along an edge of a face, at least 1.
    """

    def __init__(self, resolution: int = 32):
        if resolution < 1:
            raise ValueError(f"expected a cube resolution of at least 1, got {resolution}")
        self.resolution = resolution

    @property
    def num_coeffs(self) -> int:
        """``6 * resolution**2``."""
        return 6 * self.resolution * self.resolution

    @property
    def name(self) -> str:
        """``cube 6xRxR``."""
        return f"cube 6x{self.resolution}x{self.resolution}"

    def project(self, environment: Radiance) -> Float[Tensor, "coeffs rgb"]:
        """Mean radiance of each texel, float64; total flux is kept exactly.

        Source pixels are divided to a sixteenth of a texel and counted into texels. Each texel
        averages its samples, so a constant light stays constant; one factor a colour then restores
        the exact flux, so a sun of one source pixel keeps its energy.
        """
        index_of, light_of, weight_of = [], [], []
        for directions, solid_angles, radiance in environment.sample_blocks(0.1 / self.resolution):
            index_of.append(cubemap_index(directions, self.resolution))
            light_of.append(radiance.to(torch.float64) * solid_angles[:, None])
            weight_of.append(solid_angles)
        index, light, weight = torch.cat(index_of), torch.cat(light_of), torch.cat(weight_of)
        flux = light.new_zeros(self.num_coeffs, 3).index_add(0, index, light)
        covered = weight.new_zeros(self.num_coeffs).index_add(0, index, weight)
        mean = flux / covered.clamp_min(torch.finfo(torch.float64).tiny)[:, None]
        total = (mean * self.solid_angles.to(mean)[:, None]).sum(0)
        kept = torch.where(total > 0, flux.sum(0) / torch.where(total > 0, total, 1.0), 1.0)
        return mean * kept

    @property
    def solid_angles(self) -> Float[Tensor, "coeffs"]:
        """Exact solid angle of each texel [sr], float64."""
        return cubemap_solid_angles(self.resolution, dtype=torch.float64).reshape(-1)

    def project_cube(
        self, values: Float[Tensor, "points texels"], resolution: int
    ) -> Float[Tensor, "points coeffs"]:
        """Sums of finer texels; the finer resolution must be a multiple of this one.

        Raises:
            ValueError: If it is not.
        """
        if resolution % self.resolution:
            raise ValueError(
                f"cube directions at {self.resolution} need a visibility resolution that is a "
                f"multiple of it, got {resolution}"
            )
        factor = resolution // self.resolution
        blocks = values.reshape(-1, 6, self.resolution, factor, self.resolution, factor)
        return blocks.sum(dim=(3, 5)).reshape(values.shape[0], -1)

    def table_bytes(self, resolution: int) -> int:
        """None."""
        return 0

    def gram(self) -> Float[Tensor, "coeffs"]:
        """Diagonal of one over solid angle."""
        return 1.0 / self.solid_angles

    def weigh(self, values: Float[Tensor, "... coeffs"]) -> Float[Tensor, "... coeffs"]:
        """Integrals over texels, each over the square root of its solid angle."""
        return values / self._root_solid_angles.to(values)

    def unweigh(self, values: Float[Tensor, "... coeffs"]) -> Float[Tensor, "... coeffs"]:
        """The inverse of :meth:`weigh`."""
        return values * self._root_solid_angles.to(values)

    def weigh_light(
        self, light: Float[Tensor, "*batch coeffs rgb"]
    ) -> Float[Tensor, "*batch coeffs rgb"]:
        """Mean radiances of texels, each times the square root of its solid angle."""
        return light * self._root_solid_angles.to(light)[:, None]

    @kept_property
    def _root_solid_angles(self) -> Float[Tensor, "coeffs"]:
        return self.solid_angles.sqrt()

    def rotate(
        self, coefficients: Float[Tensor, "*batch coeffs rgb"], rotation: Float[Tensor, "3 3"]
    ) -> Float[Tensor, "*batch coeffs rgb"]:
        """Radiance at the nearest turned texel centre; approximate (see the class)."""
        centres = cubemap_directions(self.resolution, dtype=torch.float64).reshape(-1, 3)
        source = cubemap_index(centres @ rotation.to(centres), self.resolution)
        return coefficients.index_select(-2, source.to(coefficients.device))

    def describe(self) -> dict[str, Any]:
        """``{"name": "cube", "resolution": R}``."""
        return {"name": "cube", "resolution": self.resolution}
