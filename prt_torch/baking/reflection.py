r"""Reflection: how a point turns incident light into exit radiance, in its shading frame.

A material's light-side functions are projected once onto spherical harmonics over the upper
hemisphere. For each function of the exit basis k

.. math:: \beta_k(s) = \sum_i M_{ki}\, y_i(s) \approx
          \Bigl[\operatorname{project}_v\, f(s, v)\, s_z\Bigr]_k

so that exit radiance is ``M @ J`` with :math:`J_i = \int_H L(s)\, y_i(s)\, ds`. Both projections
are least-squares optimal over the hemisphere, hence :math:`M = A^{-1} B A^{-1}` of the paper.

The Lambertian part needs no fit (its light side is linear, its view side constant), and its
albedo may differ from point to point, so it is kept apart.

Source:
    Sloan, Hall, Hart, Snyder 2003, section 3.1 and equation 1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch import store
from prt_torch.assets.brdf import BRDF, lobe_quadrature
from prt_torch.bases import Diffuse, ExitBasis, HemisphericalHarmonics, sh

_COSINE = math.sqrt(4.0 * math.pi / 3.0)  # s_z over y_10
_FIRST_NODES, _MOST_NODES, _MOST_NODES_ANISOTROPIC = 8, 64, 16
_LIGHT_NODES = 3  # radial nodes of a lobe for each node of the polar angle of views
_PAIRS_AT_ONCE = 2**23
RESOLVED = 0.03
"""Relative change on doubling the quadrature below which a material counts as resolved.

Convergence is faster than any power: where the last doubling changed a matrix by this much, the
next one was measured to change it by less than 1e-3.
"""


@dataclass(frozen=True)
class Reflection:
    """Reflection of every point of a scene.

    Attributes:
        exit_basis: What the rows mean.
        order: Bands of incident harmonics.
        matrices: ``"materials channels rows incident"`` float64, of the glossy parts.
        materials: ``"points"``: which of them each point has.
        lambertian: ``"points own_channels"``: albedo of the Lambertian part that is not kept apart
            as reflectance; one row where all points share it.
        unresolved: Relative change of the worst material when its quadrature was last doubled;
            above :data:`RESOLVED` its lobe is too sharp for it.
    """

    exit_basis: ExitBasis
    order: int
    matrices: Float[Tensor, "materials channels rows incident"]
    materials: Int[Tensor, "points"]
    lambertian: Float[Tensor, "points_or_one own_channels"]
    unresolved: float = 0.0

    @property
    def num_channels(self) -> int:
        """1 where its colour factors out, else 3."""
        return max(self.matrices.shape[1], self.lambertian.shape[1])

    def digest(self) -> str:
        """SHA-256 of everything that reflected light follows from."""
        parts = (self.matrices, self.materials, self.lambertian)
        return store.digest(self.exit_basis.describe(), self.order, *parts)

    def reflect(
        self, rows: slice, incident: Float[Tensor, "points channels incident coeffs"]
    ) -> Float[Tensor, "points out_channels rows coeffs"]:
        """Exit radiance of some points.

        Args:
            rows: Which points.
            incident: Inner products of incident radiance with the harmonics over the upper
                hemisphere, in the shading frame, a column for each coefficient of distant light.
        """
        exit_radiance = self.matrices[self.materials[rows]].to(incident) @ incident
        shared = len(self.lambertian) == 1
        albedo = (self.lambertian if shared else self.lambertian[rows]).to(incident)
        if bool((albedo != 0).any()):
            constant = float(self.exit_basis.constants()[0, 0])
            irradiance = incident[:, :, 2] * (_COSINE / math.pi * constant)
            lambertian = albedo[:, :, None] * irradiance
            channels = max(exit_radiance.shape[1], lambertian.shape[1])
            exit_radiance = exit_radiance.expand(-1, channels, -1, -1).clone()
            exit_radiance[:, :, 0] += lambertian
        return exit_radiance


def diffuse_reflection(num_points: int) -> Reflection:
    """Lambertian points whose albedo is kept apart as reflectance."""
    return Reflection(
        exit_basis=Diffuse(),
        order=2,
        matrices=torch.zeros(1, 1, 1, 4, dtype=torch.float64),
        materials=torch.zeros(num_points, dtype=torch.int64),
        lambertian=torch.ones(1, 1, dtype=torch.float64),
    )


def glossy_reflection(
    brdfs: Sequence[BRDF | None],
    materials: Int[Tensor, "points"],
    lambertian: Float[Tensor, "points_or_one channels"],
    *,
    num_rows: int,
    order: int,
) -> Reflection:
    """Reflection by analytic materials, exit radiance in hemispherical harmonics.

    Args:
        brdfs: The glossy part of each material; None for a material that has none.
        materials: Which of them each point has.
        lambertian: Albedo of the Lambertian part of each point.
        num_rows: Functions of the exit basis.
        order: Bands of the light side of the materials.
    """
    exit_basis = HemisphericalHarmonics(num_rows)
    projected, unresolved = [], 0.0
    for brdf in brdfs:
        if brdf is None:
            projected.append(torch.zeros(1, num_rows, order * order, dtype=torch.float64))
            continue
        matrix, change = project_brdf(brdf, exit_basis, order)
        projected.append(matrix)
        unresolved = max(unresolved, change)
    channels = max(matrix.shape[0] for matrix in projected)
    matrices = torch.stack([matrix.expand(channels, -1, -1) for matrix in projected])
    return Reflection(exit_basis, order, matrices, materials, lambertian.double(), unresolved)


def project_brdf(
    brdf: BRDF, exit_basis: HemisphericalHarmonics, order: int
) -> tuple[Float[Tensor, "channels rows incident"], float]:
    """The matrix A⁻¹ B A⁻¹ of a material, and the relative change at the last doubling of nodes.

    Quadrature nodes are doubled until the matrix changes by less than :data:`RESOLVED`, or there
    are so many that the material counts as too sharp for spherical harmonics of this order.

    Args:
        brdf: The material.
        exit_basis: What exit radiance is expanded in.
        order: Bands of the light side.
    """
    most = _MOST_NODES if brdf.isotropic else _MOST_NODES_ANISOTROPIC
    nodes, change = _FIRST_NODES, math.inf
    matrix = _matrix(brdf, exit_basis, order, nodes)
    # Coefficients of nearly dependent functions mean little; what counts is the function.
    views = exit_basis.gram_root().mT
    lights = torch.linalg.cholesky(sh.hemisphere_gram(order))
    while change > RESOLVED and nodes < most:
        nodes *= 2
        coarser, matrix = matrix, _matrix(brdf, exit_basis, order, nodes)
        scale = float((views @ matrix @ lights).norm()) or 1.0
        change = float((views @ (matrix - coarser) @ lights).norm()) / scale
    return matrix, change


def _matrix(
    brdf: BRDF, exit_basis: HemisphericalHarmonics, order: int, nodes: int
) -> Float[Tensor, "channels rows incident"]:
    view, view_weights = sh.hemisphere_quadrature(2 * nodes - 1)
    project_view = sh.hemisphere_projection(exit_basis.evaluate(view), view_weights)
    if not brdf.isotropic:
        return torch.einsum("kv,vci->cki", project_view, _light_side(brdf, view, order, nodes))
    steps = 2 * nodes
    profile = _light_side(brdf, view.unflatten(0, (nodes, steps))[:, 0], order, nodes)
    # Turning the view of an isotropic material about the normal turns its light side with it.
    angles = torch.arange(steps, dtype=torch.float64) * (2.0 * math.pi / steps)
    zero, one = torch.zeros_like(angles), torch.ones_like(angles)
    rows = [angles.cos(), -angles.sin(), zero, angles.sin(), angles.cos(), zero, zero, zero, one]
    turns = sh.rotation_matrix(torch.stack(rows, -1).unflatten(-1, (3, 3)), order)
    by_azimuth = torch.einsum("kza,aij->kzij", project_view.unflatten(1, (nodes, steps)), turns)
    return torch.einsum("kzij,zcj->cki", by_azimuth, profile)


def _light_side(
    brdf: BRDF, views: Float[Tensor, "views 3"], order: int, nodes: int
) -> Float[Tensor, "views channels incident"]:
    """Harmonic coefficients over the hemisphere of BRDF times cosine, for each view.

    Inner products come from nodes that follow the lobe of each view, however narrow it is.
    """
    resolution = _LIGHT_NODES * nodes
    at_once = max(1, _PAIRS_AT_ONCE // (resolution * resolution * order * order))
    pieces = []
    for some in views.split(at_once):
        lights, solid_angles = lobe_quadrature(some, resolution)
        values = brdf.evaluate(lights, some[:, None]) * (solid_angles * lights[..., 2])[..., None]
        pieces.append(torch.einsum("vsc,vsi->vci", values, sh.evaluate(lights, order)))
    return torch.cat(pieces) @ sh.hemisphere_inverse(order)
