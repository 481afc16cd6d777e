r"""Factors of least error through bilinear lookups, over all pairs of directions.

Lookups are linear in the texels, so with the mass matrices :math:`M_{tu} = \int h_t h_u` of the
hat functions of texels and the moments :math:`C_{tu} = \iint h_t(v)\, f(v, s)\, h_u(s)` the error
of view maps G and light maps F is

.. math:: \iint (f - \sum_k G_k F_k)^2 = \iint f^2 - 2 \operatorname{tr}(G^T C F)
          + \operatorname{tr}(G^T M_v G\, F^T M_s F)

whose optimum is one singular value decomposition between Cholesky factors of M. No iteration can
find a better one; constraints need iterations (:mod:`prt_torch.bases.brdf_refinement`).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from prt_torch.bases.brdf_factoring import Factors, Target, fill, leading_triplets
from prt_torch.bases.hemisphere_map import HemisphereMap

_RIDGE = 1e-4  # of a texel's own mass: texels at the rim that hardly any direction uses stay small


@dataclass(frozen=True)
class Moments:
    """All that the error of bilinear factors depends on; see the head of the module.

    Attributes:
        view_mass: ``"texels texels"`` integrals of products of two hats over views.
        light_mass: The same over lights, weighted as errors are.
        moments: ``"colours texels materials texels"`` of the function.
        energy: Its weighted squared norm.
    """

    view_mass: Float[Tensor, "texels texels"]
    light_mass: Float[Tensor, "texels texels"]
    moments: Float[Tensor, "colours texels materials texels"]
    energy: float

    def error(
        self,
        view: Float[Tensor, "rows colours texels"],
        light: Float[Tensor, "materials rows texels"],
    ) -> Float[Tensor, ""]:
        """Weighted squared error of factors; differentiable."""
        view_gram = torch.einsum("kct,tu,lcu->kl", view, self.view_mass, view)
        light_gram = torch.einsum("mkt,tu,mlu->kl", light, self.light_mass, light)
        half = torch.einsum("ctmu,mku->kct", self.moments, light)
        return self.energy - 2 * (view * half).sum() + (view_gram * light_gram).sum()

    def relative(self, error: Float[Tensor, ""]) -> float:
        """Root of an error over the energy: a relative root mean square error."""
        return math.sqrt(max(float(error), 0.0) / (self.energy or 1.0))

    def used(self) -> tuple["Moments", Bool[Tensor, "texels"]]:
        """Of the texels that any direction reaches alone, and which they are."""
        used = self.view_mass.diagonal() > 0
        kept = Moments(
            self.view_mass[used][:, used],
            self.light_mass[used][:, used],
            self.moments[:, used][..., used],
            self.energy,
        )
        return kept, used


def bilinear_moments(
    target: Target, hemisphere: HemisphereMap, *, supersampling: int = 2
) -> Moments:
    """Integrate a model against the hats of all pairs of texels.

    No light of the quadrature is the mirror image of a view. On equal grids every view would meet
    its own, the peak of a narrow lobe would count many times over, and factors of acrylic paint at
    16 texels came out with an error of 1.2 times the function itself; so they have 0.996.

    Args:
        target: What to factor.
        hemisphere: The texels of both sides.
        supersampling: Views along an edge of a texel, and one less than the lights.
    """
    views, solid_angles = hemisphere.nodes(supersampling)
    lights, light_weights = hemisphere.nodes(supersampling + 1)
    light_weights = light_weights * target.weight(lights)
    indices, hats = hemisphere.taps(views)
    light_indices, light_hats = hemisphere.taps(lights)
    single, texels = torch.float32, hemisphere.num_texels
    total = torch.zeros(texels, target.num_colours, len(target.brdfs), texels, dtype=torch.float64)
    by_texel = light_indices.flatten().argsort(stable=True)
    starts = torch.searchsorted(light_indices.flatten()[by_texel], torch.arange(texels))
    weighted_hats = (light_hats * light_weights[:, None]).flatten()[by_texel].to(single)
    energy = 0.0
    for some, values in target.blocks(views.to(single), lights.to(single)):
        squares = values.square().sum((1, 2)).double()
        energy += float(squares @ light_weights @ solid_angles[some])
        lit = torch.nn.functional.embedding_bag(
            by_texel // 4,
            values.flatten(0, 2).mT.contiguous(),
            starts,
            mode="sum",
            per_sample_weights=weighted_hats,
        )
        by_view = lit.mT.double().unflatten(0, values.shape[:3])
        for tap in range(4):
            share = hats[some, tap] * solid_angles[some]
            total.index_add_(0, indices[some, tap], by_view * share[:, None, None, None])
    return Moments(
        _mass(indices, hats, solid_angles, texels),
        _mass(light_indices, light_hats, light_weights, texels),
        total.transpose(0, 1),
        energy,
    )


def interpolated_factors(
    moments: Moments, hemisphere: HemisphereMap, num_terms: int, *, constants: int = 0
) -> Factors:
    """Factors of least error through bilinear lookups, over all pairs of directions.

    Args:
        moments: Of the target.
        hemisphere: Its texels.
        num_terms: Rows in all.
        constants: How many view functions, the first ones, are constants: 1 in any colour, or 3 in
            red, green and blue. The other rows are the best beside them.
    """
    inside, used = moments.used()
    view_root, light_root = ridged_root(inside.view_mass), ridged_root(inside.light_mass)
    between = inside.moments
    if constants == 3:
        between = between.expand(3, -1, -1, -1)
    colours, texels, materials, _ = between.shape
    # The roots stand on the left of one wide matrix each: light texels of all views at once, then
    # view texels of all lights.
    by_light = between.reshape(-1, texels).mT
    white = torch.linalg.solve_triangular(light_root, by_light, upper=False).mT
    by_view = white.reshape(colours, texels, -1).transpose(0, 1).flatten(1)
    white = torch.linalg.solve_triangular(view_root, by_view, upper=False)
    white = white.unflatten(1, (colours, -1)).transpose(0, 1).flatten(0, 1)
    tints = torch.eye(3) if constants == 3 else torch.ones(constants, colours)
    ones = torch.kron(tints.double(), view_root.mT.sum(1))  # constants; views of all colours
    squares = ones.square().sum(1, keepdim=True)
    even = ones @ white / squares  # the light functions that go best with them
    found, singular, rights = leading_triplets(white - ones.mT @ even, num_terms - constants)
    root = singular.sqrt()
    view = (found * root).mT.unflatten(1, (colours, texels))
    view = torch.linalg.solve_triangular(view_root.mT, view.mT, upper=True).mT
    view = torch.cat([tints.to(view)[..., None].expand(-1, -1, texels), view])
    light = torch.cat([even, (rights * root).mT]).unflatten(1, (materials, texels)).transpose(0, 1)
    light = torch.linalg.solve_triangular(light_root.mT, light.mT, upper=True).mT
    scale = colours / moments.moments.shape[0]
    return Factors(
        fill(view, used, hemisphere),
        fill(light, used, hemisphere),
        torch.cat([(squares * even.square()).sum(1), singular.square()]),
        moments.energy * scale,
    )


def _mass(
    indices: Int[Tensor, "nodes 4"],
    hats: Float[Tensor, "nodes 4"],
    weights: Float[Tensor, "nodes"],
    texels: int,
) -> Float[Tensor, "texels texels"]:
    """Weighted sums of the products of the hats of all pairs of texels."""
    pairs = indices[:, :, None] * texels + indices[:, None, :]
    products = hats[:, :, None] * hats[:, None, :] * weights[:, None, None]
    flat = weights.new_zeros(texels * texels).index_add(0, pairs.flatten(), products.flatten())
    return flat.view(texels, texels)


def ridged_root(mass: Float[Tensor, "n n"]) -> Float[Tensor, "n n"]:
    """Lower Cholesky factor of a mass matrix with a small ridge."""
    diagonal = mass.diagonal()
    ridge = _RIDGE * diagonal + _RIDGE**2 * diagonal.mean()
    return torch.linalg.cholesky(mass + torch.diag(ridge))
