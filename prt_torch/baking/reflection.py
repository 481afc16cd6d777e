r"""Reflection: how a point turns incident light into exit radiance, in its shading frame.

A material's light-side functions are projected once onto spherical harmonics over the upper
hemisphere. For each function of the exit basis k

.. math:: \beta_k(s) = \sum_i M_{ki}\, y_i(s) \approx
          \Bigl[\operatorname{project}_v\, f(s, v)\, s_z\Bigr]_k

so that exit radiance is ``M @ J`` with :math:`J_i = \int_H L(s)\, y_i(s)\, ds`. Both projections
are least-squares optimal over the hemisphere, hence :math:`M = A^{-1} B A^{-1}` of the paper.

Where the exit basis are BRDF factors, their light functions are such :math:`\beta_k` already: their
inner products with the harmonics are known, and A⁻¹ makes the least-squares fit of them.

The Lambertian part needs no fit (its light side is linear, its view side constant), and its
albedo may differ from point to point, so it is kept apart.

Source:
    Sloan, Hall, Hart, Snyder 2003, section 3.1 and equation 1; Sloan, Luna, Snyder 2005, section
    3.2 and equation 15.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch import store
from prt_torch.assets.brdf import BRDF, lobe_quadrature
from prt_torch.bases import (
    BRDFFactors,
    Diffuse,
    ExitBasis,
    HemisphereMap,
    HemisphericalHarmonics,
    sh,
)
from prt_torch.bases.brdf_factoring import decomposed

_COSINE = math.sqrt(4.0 * math.pi / 3.0)  # s_z over y_10
_FIRST_NODES, _MOST_NODES, _MOST_NODES_ANISOTROPIC = 8, 64, 16
_LIGHT_NODES = 3  # radial nodes of a lobe for each node of the polar angle of views
_PAIRS_AT_ONCE = 2**23
EQUAL_AREA = HemisphereMap("concentric")
"""View maps of factors whose light side is in harmonics: 32 x 32, as the paper has it."""

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
        """Of transfer: 1 where its colour factors out or is in the exit functions, else 3."""
        return max(self.matrices.shape[1], 1 if self._own_tints else self.lambertian.shape[1])

    @property
    def _own_tints(self) -> bool:
        """Whether each colour has a constant exit function of its own."""
        return len(self.exit_basis.constants()) == 3

    def digest(self) -> str:
        """SHA-256 of everything that reflected light follows from."""
        parts = (self.matrices, self.materials, self.lambertian)
        functions = self.exit_basis.tensors().values()
        return store.digest(self.exit_basis.describe(), self.order, *parts, *functions)

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
            irradiance = incident[:, :, 2] * (_COSINE / math.pi)
            constants = self.exit_basis.constants().to(incident)
            if self._own_tints:
                tinted = albedo.expand(-1, 3) @ constants
                return exit_radiance + tinted[:, None, :, None] * irradiance[:, :, None]
            lambertian = albedo[:, :, None] * (irradiance * constants[0, 0])
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


def factored_reflection(
    factors: BRDFFactors,
    materials: Int[Tensor, "points"],
    lambertian: Float[Tensor, "points_or_one own_channels"],
    *,
    unresolved: float = 0.0,
) -> Reflection:
    r"""Reflection towards BRDF factors: transfer :math:`M' = \Sigma V^T T` of few rows.

    T is rectangular: from the bands of the light basis to those of the factors' light side. The
    material acts on the least-squares fit to incident light over the upper hemisphere (A⁻¹), so
    that where nothing is shadowed, light of no more bands than the factors' is reflected exactly.

    Args:
        factors: Of all glossy materials, their light side in harmonics.
        materials: Which of them each point has; -1 for none.
        lambertian: Albedo of the Lambertian part of each point, one colour or three; it enters the
            constant rows, and needs none where there are none.
        unresolved: As :attr:`Reflection.unresolved`.

    Raises:
        ValueError: If the factors' light side are maps, or they have no constants for a Lambertian
            part.

    Source:
        Sloan, Luna, Snyder 2005, equation 15, which leaves open how T treats the hemisphere.
    """
    if factors.light_order is None:
        raise ValueError("expected light functions in harmonics (method='harmonic'), got maps")
    if bool((lambertian != 0).any()) and not factors.num_constants:
        raise ValueError("expected factors with constants for a Lambertian part, got none")
    light_sides = factors.light_values.detach().double().cpu()
    own = light_sides @ sh.hemisphere_inverse(factors.light_order)
    none = torch.zeros_like(own[:1])  # the last, where -1 points to
    return Reflection(
        factors,
        factors.light_order,
        torch.cat([own, none])[:, None],
        materials,
        lambertian.double(),
        unresolved,
    )


def factor_in_harmonics(
    brdfs: Sequence[BRDF], *, num_terms: int, constants: int, light_order: int
) -> tuple[BRDFFactors, float]:
    """Factors of materials that share equal-area view maps, their light side in harmonics.

    As :meth:`BRDFFactors.from_brdf` makes them, with nodes that follow the lobe of each view.

    Args:
        brdfs: The materials.
        num_terms: Rows in all.
        constants: How many of them are constants.
        light_order: Bands of the light side.

    Returns:
        The factors, and the relative change of the worst material at the last doubling of nodes.
    """
    views, used = EQUAL_AREA.centres()
    whiten = sh.hemisphere_inverse(light_order) @ torch.linalg.cholesky(
        sh.hemisphere_gram(light_order)
    )
    colours = max(brdf.num_channels for brdf in brdfs)
    projected, energy, worst = [], 0.0, 0.0
    for brdf in brdfs:
        most = _MOST_NODES if brdf.isotropic else _MOST_NODES_ANISOTROPIC
        nodes, change = _FIRST_NODES, math.inf
        own, squares = _at_views(brdf, views[used], light_order, nodes)
        while change > RESOLVED and nodes < most:
            nodes *= 2
            coarser = own
            own, squares = _at_views(brdf, views[used], light_order, nodes)
            change = float(((own - coarser) @ whiten).norm()) / (float((own @ whiten).norm()) or 1)
        projected.append(own.expand(-1, colours, -1))
        energy += float(squares.sum()) * colours / brdf.num_channels
        worst = max(worst, change)
    found = decomposed(
        torch.stack(projected, dim=2), energy, EQUAL_AREA, num_terms, constants=constants
    )
    options = {"light_order": light_order, "num_constants": constants}
    return BRDFFactors.of(found, EQUAL_AREA, **options), worst


def _at_views(
    brdf: BRDF, views: Float[Tensor, "views 3"], order: int, nodes: int
) -> tuple[Float[Tensor, "views channels incident"], Float[Tensor, "views"]]:
    """As :func:`_inner_products`; isotropic materials are summed once for each polar angle."""
    if not brdf.isotropic:
        return _inner_products(brdf, views, order, nodes)
    z, ring = torch.unique(views[:, 2].round(decimals=9), return_inverse=True)
    profile = torch.stack([(1 - z * z).clamp_min(0).sqrt(), torch.zeros_like(z), z], dim=-1)
    products, squares = _inner_products(brdf, profile, order, nodes)
    turns = _turns(torch.atan2(views[:, 1], views[:, 0]), order)
    return torch.einsum("vij,vcj->vci", turns, products[ring]), squares[ring]


def _turns(angles: Float[Tensor, "angles"], order: int) -> Float[Tensor, "angles i j"]:
    """Matrices that turn harmonics about the normal."""
    zero, one = torch.zeros_like(angles), torch.ones_like(angles)
    rows = [angles.cos(), -angles.sin(), zero, angles.sin(), angles.cos(), zero, zero, zero, one]
    return sh.rotation_matrix(torch.stack(rows, -1).unflatten(-1, (3, 3)), order)


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
    turns = _turns(angles, order)
    by_azimuth = torch.einsum("kza,aij->kzij", project_view.unflatten(1, (nodes, steps)), turns)
    return torch.einsum("kzij,zcj->cki", by_azimuth, profile)


def _light_side(
    brdf: BRDF, views: Float[Tensor, "views 3"], order: int, nodes: int
) -> Float[Tensor, "views channels incident"]:
    """Harmonic coefficients over the hemisphere of BRDF times cosine, for each view."""
    return _inner_products(brdf, views, order, nodes)[0] @ sh.hemisphere_inverse(order)


def _inner_products(
    brdf: BRDF, views: Float[Tensor, "views 3"], order: int, nodes: int
) -> tuple[Float[Tensor, "views channels incident"], Float[Tensor, "views"]]:
    """Of BRDF times cosine with the harmonics over the hemisphere, and its squared norm.

    Sums are over nodes that follow the lobe of each view, however narrow it is.
    """
    resolution = _LIGHT_NODES * nodes
    at_once = max(1, _PAIRS_AT_ONCE // (resolution * resolution * order * order))
    products, squares = [], []
    for some in views.split(at_once):
        lights, solid_angles = lobe_quadrature(some, resolution)
        values = brdf.evaluate(lights, some[:, None]) * lights[..., 2:]
        weighed = values * solid_angles[..., None]
        products.append(torch.einsum("vsc,vsi->vci", weighed, sh.evaluate(lights, order)))
        squares.append((values * weighed).sum((1, 2)))
    return torch.cat(products), torch.cat(squares)
