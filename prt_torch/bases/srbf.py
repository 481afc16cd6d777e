r"""Spherical radial basis functions: as scattered light, and as a basis that light is expanded in.

A bell around a centre turns by turning its centre, narrows by its bandwidth, and has closed inner
products with others of its kind (:mod:`prt_torch.bases.srbf_kernels`). Two uses follow.

- :class:`SRBFExpansion` is a light: a few bells wherever it is bright.
- :class:`SRBF` is a light basis: bells of one bandwidth on a regular grid. They overlap, so the
  basis is not orthonormal. With b the inner products of a function with the bells and G their Gram
  matrix, its expansion coefficients, best in the L2 sense, are :math:`c = G^{-1} b`. Light enters
  as b, transfer as c, and their dot product is the radiance.

Source:
    Tsai, Shih 2006, sections 3 and 4.
"""

import math
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases.base import LightBasis, Radiance
from prt_torch.bases.cube import CubeDirections
from prt_torch.bases.icosahedron import (
    ICOSAHEDRAL_COUNTS,
    icosahedral_centers,
    smallest_distance,
)
from prt_torch.bases.srbf_kernels import (
    KernelName,
    abel_poisson,
    abel_poisson_inner_product,
    abel_poisson_legendre,
    check_kernel,
    gaussian,
    gaussian_inner_product,
    gaussian_legendre,
    kernel_inner_products,
    kernel_values,
)
from prt_torch.bases.srbf_light import SRBFExpansion
from prt_torch.bases.srbf_projection import Fit, collocation_projection, gram_projection
from prt_torch.bases.tables import kept_property, traced_without_numbers
from prt_torch.sphere import cubemap_directions, cubemap_solid_angles

__all__ = [
    "SRBF",
    "WORST_CONDITION",
    "Fit",
    "KernelName",
    "SRBFExpansion",
    "abel_poisson",
    "abel_poisson_inner_product",
    "abel_poisson_legendre",
    "collocation_projection",
    "default_bandwidth",
    "gaussian",
    "gaussian_inner_product",
    "gaussian_legendre",
    "gram_projection",
    "icosahedral_centers",
]

WORST_CONDITION = 1e8
"""Of a Gram matrix as it is used; its Cholesky factor then has 1e4, bearable in float32."""

_PAPER_DEVIATION = math.pi / 40  # rad, with the 642 centres of 3 subdivisions
_PAPER_SUBDIVISIONS = 3
_TABLE_ELEMENTS = 2**18  # of kernel values at once: they stay in a processor's cache
_SUBSAMPLES = 4  # along a texel's edge, as the paper supersamples


def default_bandwidth(num_centers: int, kernel: KernelName = "gaussian") -> float:
    r"""Bandwidth that suits icosahedral centres of this number.

    Its standard deviation :math:`\sigma` is π/40 at 642 centres, about half their spacing, and in
    proportion to the smallest distance of two centres for others. A Gaussian has
    :math:`\lambda = 1/\sigma^2`, 162.114 at 642. For Abel-Poisson, with the deviation
    :math:`\sigma^2 = 1 - E^2` of the squared kernel and E its mean cosine
    :math:`2\lambda/(1+\lambda^2)`, it is :math:`\sqrt{(1-\sigma)/(1+\sigma)}`, 0.9243 at 642.

    Args:
        num_centers: 12, 42, 162, 642 or 2562.
        kernel: Which kernel.

    Raises:
        ValueError: If there is no such number of centres.

    Source:
        Tsai, Shih 2006, section 4.2, "variance of π/40 radians", read as a standard deviation: as
        a variance the bells would be so wide that their Gram matrix is singular in float64.
    """
    spacing = smallest_distance(_subdivisions(num_centers))
    deviation = _PAPER_DEVIATION * spacing / smallest_distance(_PAPER_SUBDIVISIONS)
    if kernel == "gaussian":
        return deviation**-2
    return math.sqrt((1.0 - deviation) / (1.0 + deviation))


def _subdivisions(num_centers: int) -> int:
    if num_centers not in ICOSAHEDRAL_COUNTS:
        counts = ", ".join(map(str, ICOSAHEDRAL_COUNTS))
        raise ValueError(f"expected a number of centres among {counts}, got {num_centers}")
    return ICOSAHEDRAL_COUNTS.index(num_centers)


def _extremes(matrix: Float[Tensor, "n n"]) -> Float[Tensor, "2"]:
    """Smallest and largest eigenvalue of a symmetric matrix."""
    eigenvalues = torch.linalg.eigvalsh(matrix)
    return torch.stack([eigenvalues[0], eigenvalues[-1]])


def _bounded(matrix: Float[Tensor, "n n"], extremes: Float[Tensor, "2"]) -> Float[Tensor, "n n"]:
    """A symmetric matrix with as much of the identity as bounds its condition."""
    smallest, largest = extremes.unbind()
    ridge = ((largest - WORST_CONDITION * smallest) / (WORST_CONDITION - 1.0)).clamp_min(0.0)
    return matrix + ridge * torch.eye(len(matrix), dtype=matrix.dtype)


class SRBF(LightBasis):
    """Kernels of one bandwidth around icosahedral centres, as a light basis.

    Transfer enters as the expansion that is closest to it in L2 over the texels of a
    ``6 x resolution x resolution`` cube; light as its inner products with the kernels, exact for
    an :class:`SRBFExpansion` of the same kernel.

    Not closed under rotation: :meth:`rotate` is exact for light in the span of the kernels, such as
    a smooth one; of other light it turns the projection to that span. So prefer to turn the
    environment and project again.

    Where kernels are so wide that the condition of their Gram matrix is above 1e8, its eigenvalues
    all get a little more, so that it is just that: projection is then regularised least squares,
    and norms have that much more. ``condition`` tells what it was before. With the default
    bandwidth it is 51, and nothing is added.

    Args:
        num_centers: 12, 42, 162, 642 or 2562.
        kernel: Which kernel.
        bandwidth: Of all kernels; :func:`default_bandwidth` if not given.
        resolution: Texels along an edge of a face of the cube that transfer is projected from.

    Raises:
        ValueError: If an argument is out of range.

    Source:
        Tsai, Shih 2006, section 4.2.
    """

    def __init__(
        self,
        num_centers: int = 642,
        kernel: KernelName = "gaussian",
        bandwidth: float | None = None,
        resolution: int = 32,
    ):
        check_kernel(kernel)
        self.centers = icosahedral_centers(_subdivisions(num_centers))
        self.kernel: KernelName = kernel
        self.bandwidth = default_bandwidth(num_centers, kernel) if bandwidth is None else bandwidth
        most = math.inf if kernel == "gaussian" else 1.0
        if not 0.0 < self.bandwidth < most:
            raise ValueError(f"expected a bandwidth above 0 and below {most}, got {bandwidth}")
        self._cube = CubeDirections(resolution)
        self.resolution = resolution
        self._tables: dict[tuple[torch.dtype, torch.device], tuple[Tensor, Tensor]] = {}

    @property
    def num_coeffs(self) -> int:
        """One a centre."""
        return len(self.centers)

    @property
    def name(self) -> str:
        """``SRBF N kernel``."""
        return f"SRBF {self.num_coeffs} {self.kernel}"

    @property
    def bandwidths(self) -> Float[Tensor, "coeffs"]:
        """The bandwidth, once a centre, float64."""
        return self.centers.new_full((self.num_coeffs,), self.bandwidth)

    @property
    def condition(self) -> float:
        """Condition number of the kernels' own Gram matrix; infinite where it is singular."""
        smallest, largest = self._spectrum.tolist()
        return largest / smallest if smallest > 0.0 else math.inf

    def project(self, environment: Radiance) -> Float[Tensor, "coeffs rgb"]:
        """Inner products with each kernel, float64.

        Source pixels are divided until none is wider than a tenth of a kernel's deviation, which
        leaves a relative error of 1/2400 at most. An :class:`SRBFExpansion` of the same kernel has
        closed inner products, so there is none.
        """
        if isinstance(environment, SRBFExpansion) and environment.kernel == self.kernel:
            light = replace(
                environment,
                centers=environment.centers.double(),
                bandwidths=environment.bandwidths.double(),
                coefficients=environment.coefficients.double(),
            )
            device = light.centers.device
            return light.inner_products(self.centers.to(device), self.bandwidths.to(device))
        deviation = (
            self.bandwidth**-0.5
            if self.kernel == "gaussian"
            else (1.0 - self.bandwidth) / math.sqrt(3.0 * self.bandwidth)
        )
        total = torch.zeros(3, self.num_coeffs, dtype=torch.float64)
        rows = max(1, _TABLE_ELEMENTS // self.num_coeffs)
        for directions, solid_angles, radiance in environment.sample_blocks(0.1 * deviation):
            light = radiance.to(torch.float64) * solid_angles[:, None]
            total = total.to(light.device)
            for some, of_light in zip(directions.split(rows), light.split(rows), strict=True):
                total = total + of_light.mT @ self._evaluate(some)
        return total.mT.contiguous()

    def project_cube(
        self, values: Float[Tensor, "points texels"], resolution: int
    ) -> Float[Tensor, "points coeffs"]:
        """Least-squares coefficients of sums of finer texels: one product with a kept table.

        The expansion whose means over texels are closest to the function's, weighted by solid
        angle, so functions in the span come back. Kernels are averaged over 4 x 4 places of a
        texel. The resolution must be a multiple of this one.

        Raises:
            ValueError: If it is not.
        """
        return self._cube.project_cube(values, resolution) @ self._table(values)[0]

    def project_texels(
        self, radiance: Float[Tensor, "*batch texels rgb"]
    ) -> Float[Tensor, "*batch coeffs rgb"]:
        """Light coefficients of light that is constant over texels of this basis' own cube.

        For light that changes every frame: one product with a kept table, where :meth:`project`
        evaluates every kernel at every pixel. Differentiable.

        Args:
            radiance: Of each texel, ``"6 row col"`` flattened.
        """
        flux = radiance * self._cube.solid_angles.to(radiance)[:, None]
        table, root = self._table(radiance)
        fitted, root = table.mT @ flux, root.to(radiance)
        return root @ (root.mT @ fitted)  # the table is means of kernels over the Gram of means

    def blur(self, values: Float[Tensor, "... coeffs"]) -> Float[Tensor, "..."]:
        """What squared norms lose when functions are replaced by their means over texels.

        The squared norm of the functions less that of the means, float64. So the squared distance
        of a function on texels from its projection is the squared norm of the first, less that of
        the second, plus this.
        """
        _, root = self._table(values)
        means = torch.linalg.vector_norm(values @ root.to(values), dim=-1, dtype=torch.float64)
        return self.squared_norm(values) - means.square()

    def table_bytes(self, resolution: int) -> int:
        """One float32 a texel of this basis' own cube and kernel, and two float64 Gram matrices."""
        return self.num_coeffs * (4 * self._cube.num_coeffs + 2 * 8 * self.num_coeffs)

    def _table(
        self, like: Tensor
    ) -> tuple[Float[Tensor, "texels coeffs"], Float[Tensor, "coeffs coeffs"]]:
        """What :meth:`_made_table` makes, kept for one type and device."""
        key = (like.dtype, like.device)
        if key in self._tables:
            return self._tables[key]
        if traced_without_numbers():
            return self._made_table(like)
        with torch.inference_mode(False):  # so that gradients can pass through it later
            self._tables = {key: self._made_table(like)}
        return self._tables[key]

    def _made_table(
        self, like: Tensor
    ) -> tuple[Float[Tensor, "texels coeffs"], Float[Tensor, "coeffs coeffs"]]:
        """Transposed least-squares inverse of the means M of kernels over texels.

        With solid angles Ω it is M (Mᵀ Ω M)⁻¹. The Gram matrix in place of Mᵀ Ω M would take the
        function for constant over a texel: it blurs, and norms come out 2 % low at 642 centres.

        Returns:
            It, like the argument, and the Cholesky factor of Mᵀ Ω M, float64.
        """
        fine = self.resolution * _SUBSAMPLES
        directions = cubemap_directions(fine, dtype=torch.float64).view(-1, 3)
        solid_angles = cubemap_solid_angles(fine, dtype=torch.float64).view(-1, 1)
        rows = fine * _SUBSAMPLES  # those of one line of texels
        means = []
        for some, weights in zip(directions.split(rows), solid_angles.split(rows), strict=True):
            shape = (_SUBSAMPLES, self.resolution, _SUBSAMPLES, -1)
            sums = (self._evaluate(some) * weights).view(shape).sum(dim=(0, 2))
            means.append(sums / weights.view(shape).sum(dim=(0, 2)))
        table = torch.cat(means)
        normal = table.mT @ (table * self._cube.solid_angles[:, None])
        root = torch.linalg.cholesky(_bounded(normal, _extremes(normal)))
        return torch.cholesky_solve(table.mT, root).mT.to(like).contiguous(), root

    def _evaluate(self, directions: Float[Tensor, "k 3"]) -> Float[Tensor, "k coeffs"]:
        centers, bandwidths = self.centers.to(directions), self.bandwidths.to(directions)
        return kernel_values(self.kernel, directions, centers, bandwidths)

    def gram(self) -> Float[Tensor, "coeffs coeffs"]:
        """Inner products of the kernels in closed form; see the class for very wide ones."""
        return _bounded(self._own_gram, self._spectrum)

    @kept_property
    def _own_gram(self) -> Float[Tensor, "coeffs coeffs"]:
        own = (self.centers, self.bandwidths)
        return kernel_inner_products(self.kernel, *own, *own)

    @kept_property
    def _spectrum(self) -> Float[Tensor, "2"]:
        """Smallest and largest eigenvalue of the Gram matrix of the kernels."""
        return _extremes(self._own_gram)

    @kept_property
    def _root(self) -> Float[Tensor, "coeffs coeffs"]:
        """Lower Cholesky factor of the Gram matrix."""
        return torch.linalg.cholesky(self.gram())

    def weigh(self, values: Float[Tensor, "... coeffs"]) -> Float[Tensor, "... coeffs"]:
        """Values times the Cholesky factor of the Gram matrix."""
        return values @ self._root.to(values)

    def unweigh(self, values: Float[Tensor, "... coeffs"]) -> Float[Tensor, "... coeffs"]:
        """The inverse of :meth:`weigh`, by back substitution."""
        flat = values.reshape(-1, self.num_coeffs)
        root = self._root.to(values)
        solved = torch.linalg.solve_triangular(root, flat, upper=False, left=False)
        return solved.reshape(values.shape)

    def weigh_light(
        self, light: Float[Tensor, "*batch coeffs rgb"]
    ) -> Float[Tensor, "*batch coeffs rgb"]:
        """The inverse of the Cholesky factor times light.

        These are inner products with an orthonormal basis of the span.
        """
        turned = light.mT
        flat = turned.reshape(-1, self.num_coeffs)
        root = self._root.to(light)
        solved = torch.linalg.solve_triangular(root.mT, flat, upper=True, left=False)
        return solved.reshape(turned.shape).mT

    def rotate(
        self, coefficients: Float[Tensor, "*batch coeffs rgb"], rotation: Float[Tensor, "3 3"]
    ) -> Float[Tensor, "*batch coeffs rgb"]:
        """Turn the centres of the light's expansion; exact for light in the span of the kernels."""
        turned = self.centers @ rotation.to(self.centers).mT
        pairs = kernel_inner_products(
            self.kernel, self.centers, self.bandwidths, turned, self.bandwidths
        )
        matrix = torch.cholesky_solve(pairs.mT, self._root).mT
        return matrix.to(coefficients) @ coefficients

    def describe(self) -> dict[str, Any]:
        """``{"name": "srbf", "num_centers", "kernel", "bandwidth", "resolution"}``."""
        return {
            "name": "srbf",
            "num_centers": self.num_coeffs,
            "kernel": self.kernel,
            "bandwidth": self.bandwidth,
            "resolution": self.resolution,
        }
