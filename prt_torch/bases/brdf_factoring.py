r"""Factoring a reflectance model into sums of products of a view map and a light map.

Four closed forms, each the optimum of its own question:

* :func:`singular_factors`: best sum for the texels themselves, each the mean of a model over a pair
  of texels (Liu et al. 2004, section 3);
* :func:`symmetric_factors`: the same for a reciprocal model without cosine, by eigenvectors with
  signs (Wang et al. 2004, section 3.2);
* :func:`harmonic_factors`: light side in spherical harmonics (Sloan et al. 2005, equation 14);
* :func:`~prt_torch.bases.brdf_moments.interpolated_factors`: best sum for the functions that
  bilinear lookups of the maps make, over all pairs of directions.

Several materials share their view maps and colours share their light maps: columns of the matrix
are pairs of material and light, rows pairs of view and colour. By Eckart and Young no factoring of
each colour alone needs fewer rows of transfer in all.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from prt_torch.bases import sh
from prt_torch.bases.hemisphere_map import HemisphereMap

_PAIRS_AT_ONCE = 2**17  # their temporaries stay in the processor's cache
_MORE_VECTORS = 16  # of the randomised decomposition than terms wanted


@runtime_checkable
class Reflectance(Protocol):
    """A reflectance model: see :class:`prt_torch.assets.brdf.BRDF`."""

    @property
    def num_channels(self) -> int:
        """1 or 3."""
        ...

    def evaluate(
        self, wi: Float[Tensor, "*#batch 3"], wo: Float[Tensor, "*#batch 3"], /
    ) -> Float[Tensor, "*batch channels"]:
        """Values without the cosine [1/sr]."""
        ...


@dataclass(frozen=True)
class Target:
    """What is factored: a model, with or without the cosine of the light, cut off above.

    Attributes:
        brdfs: The model of each material.
        cosine: Whether the cosine of the light is part of the function.
        clamp: Largest value of the function; infinity for none.
    """

    brdfs: Sequence[Reflectance]
    cosine: bool
    clamp: float = math.inf

    @property
    def num_colours(self) -> int:
        """3 if any model is coloured, else 1."""
        return max(brdf.num_channels for brdf in self.brdfs)

    def values(
        self, views: Float[Tensor, "views 3"], lights: Float[Tensor, "lights 3"]
    ) -> Float[Tensor, "views colours materials lights"]:
        """The function for all pairs of directions."""
        found = []
        for brdf in self.brdfs:
            values = brdf.evaluate(lights, views[:, None]).movedim(-1, 1)
            values = values * lights[:, 2] if self.cosine else values
            found.append(values.clamp(max=self.clamp).expand(-1, self.num_colours, -1))
        return torch.stack(found, dim=2)

    def weight(self, lights: Float[Tensor, "lights 3"]) -> Float[Tensor, "lights"]:
        """What squared errors towards each light count: those of the product with the cosine."""
        return torch.ones_like(lights[:, 2]) if self.cosine else lights[:, 2].square()

    def blocks(
        self, views: Float[Tensor, "views 3"], lights: Float[Tensor, "lights 3"]
    ) -> Iterator[tuple[slice, Float[Tensor, "some colours materials lights"]]]:
        """Values by runs of views."""
        step = max(1, _PAIRS_AT_ONCE // len(lights))
        for start in range(0, len(views), step):
            some = slice(start, min(start + step, len(views)))
            yield some, self.values(views[some], lights)


@dataclass(frozen=True)
class Factors:
    """View and light side of a sum of products.

    Attributes:
        view: ``"rows colours texels"``.
        light: ``"materials rows texels"``, or harmonics in place of texels.
        energies: Squared norm that each further row explains, largest first.
        energy: Squared norm of the whole function; with ``energies`` it gives the error of any
            number of rows.
    """

    view: Float[Tensor, "rows colours texels"]
    light: Float[Tensor, "materials rows lights"]
    energies: Float[Tensor, "rows"]
    energy: float


def singular_factors(
    target: Target, hemisphere: HemisphereMap, num_terms: int, *, supersampling: int = 4
) -> Factors:
    """Truncated singular value decomposition of texel means.

    Args:
        target: What to factor; Liu et al. include the cosine and clamp at 3.
        hemisphere: The texels of both sides.
        num_terms: Rows; fewer where the matrix has fewer.
        supersampling: Directions along an edge of a texel; means are over all their pairs.

    Source:
        Liu et al. 2004, section 3, equations 8 and 9. Texels whose centre has no direction are
        left out, and directions of a texel outside the hemisphere are.
    """
    directions, inside = hemisphere.centres(supersampling)
    _, used = hemisphere.centres()
    texel_of = _texels(hemisphere, supersampling)
    kept = inside & used[texel_of]
    directions, texel_of = directions[kept], texel_of[kept]
    count = torch.bincount(texel_of, minlength=hemisphere.num_texels).double()
    colours, materials, texels = target.num_colours, len(target.brdfs), hemisphere.num_texels
    total = torch.zeros(texels, colours, materials, texels, dtype=torch.float64)
    for some, values in target.blocks(directions, directions):
        by_light = values.new_zeros(*values.shape[:-1], texels).index_add(-1, texel_of, values)
        total.index_add_(0, texel_of[some], by_light)
    mean = total[used][..., used] / (count[used][:, None, None, None] * count[used])
    left, singular, right = leading_triplets(
        mean.permute(1, 0, 2, 3).flatten(2).flatten(0, 1), num_terms
    )
    root = singular.sqrt()
    view = (left * root).mT.unflatten(1, (colours, -1))
    light = (right * root).mT.unflatten(1, (materials, -1)).transpose(0, 1)
    return Factors(
        fill(view, used, hemisphere),
        fill(light, used, hemisphere),
        singular.square(),
        float(mean.square().sum()),
    )


def symmetric_factors(target: Target, hemisphere: HemisphereMap, num_terms: int) -> Factors:
    r"""Eigenvectors of the matrix of texel centres: :math:`f \approx \sum_k \lambda_k q_k q_k`.

    Light map :math:`\sqrt{|\lambda|}\, q`, view map the same with the sign of λ. Colours are
    factored each alone, and their rows go by magnitude. What little a measured model lacks in
    reciprocity is averaged away.

    Args:
        target: One material; Wang et al. leave the cosine out.
        hemisphere: The texels of both sides.
        num_terms: Rows a colour.

    Raises:
        ValueError: If there are several materials or the target has the cosine in it, which is
            not symmetric.

    Source:
        Wang et al. 2004, section 3.2. The printed power iteration fails where eigenvalues differ
        only in sign, so a full decomposition is taken; the singular values are the magnitudes of
        the eigenvalues, not their squares as printed.
    """
    if target.cosine or len(target.brdfs) != 1:
        raise ValueError("expected one material without the cosine, which alone is symmetric")
    directions, used = hemisphere.centres()
    directions = directions[used]
    matrix = torch.cat([values for _, values in target.blocks(directions, directions)])[:, :, 0]
    views, lights, energies = [], [], []
    for colour in range(target.num_colours):
        eigenvalues, vectors = leading_eigenpairs(matrix[:, colour], num_terms)
        maps = fill((vectors * eigenvalues.abs().sqrt()).mT, used, hemisphere)
        view = maps.new_zeros(len(maps), target.num_colours, hemisphere.num_texels)
        view[:, colour] = maps * eigenvalues.sign()[:, None]
        views.append(view)
        lights.append(maps)
        energies.append(eigenvalues.square())
    energy, order = torch.cat(energies).sort(descending=True, stable=True)
    view, light = torch.cat(views)[order], torch.cat(lights)[order]
    return Factors(view, light[None], energy, float(matrix.square().sum()))


def leading_eigenpairs(
    matrix: Float[Tensor, "n n"], count: int
) -> tuple[Float[Tensor, "terms"], Float[Tensor, "n terms"]]:
    """Eigenvalues of largest magnitude of a symmetric matrix, and their vectors.

    Where the matrix has fewer than ``count`` that are not round-off, the rest are exactly zero.
    """
    eigenvalues, vectors = torch.linalg.eigh((matrix + matrix.mT) / 2)
    order = eigenvalues.abs().argsort(descending=True, stable=True)[:count]
    found = eigenvalues[order]
    limit = found[:1].abs() * len(matrix) * torch.finfo(matrix.dtype).eps
    return torch.where(found.abs() > limit, found, 0.0), vectors[:, order]


def harmonic_factors(
    target: Target,
    hemisphere: HemisphereMap,
    num_terms: int,
    order: int,
    *,
    constants: int = 0,
) -> Factors:
    """Singular value decomposition of views by spherical harmonics of the light.

    Args:
        target: Materials, with the cosine.
        hemisphere: The texels of the view side; the lights of its quadrature serve the integral.
        num_terms: Rows in all.
        order: Bands of the light side.
        constants: How many view functions, the first ones, are constants: 1 in any colour, or 3 in
            red, green and blue. The other rows are the best beside them.

    Raises:
        ValueError: If the target lacks the cosine.

    Source:
        Sloan et al. 2005, equation 14, where V stands for its transpose.
    """
    if not target.cosine:
        raise ValueError("expected a target with the cosine of the light")
    views, used = hemisphere.centres()
    lights, solid_angles = sh.hemisphere_quadrature(4 * max(order, hemisphere.resolution) - 1)
    weighted = sh.evaluate(lights, order) * solid_angles[:, None]
    projected, energy = [], 0.0
    for _, values in target.blocks(views[used], lights):
        projected.append(values @ weighted)
        energy += float((values.square() @ solid_angles).sum())  # what no harmonic holds included
    return decomposed(torch.cat(projected), energy, hemisphere, num_terms, constants=constants)


def decomposed(
    projected: Float[Tensor, "views colours materials harmonics"],
    energy: float,
    hemisphere: HemisphereMap,
    num_terms: int,
    *,
    constants: int = 0,
) -> Factors:
    """The best factors of light projected onto harmonics for each view.

    Args:
        projected: Inner products over the upper hemisphere of BRDF times cosine with the harmonics,
            for the texel centres that have a direction.
        energy: Squared norm of what was projected, over texels and lights.
        hemisphere: The texels of the view side.
        num_terms: Rows in all.
        constants: As for :func:`harmonic_factors`. The rows beside them are free of the mean over
            views, which is the constants' own.

    Returns:
        Light functions as inner products with the harmonics over the upper hemisphere.

    Source:
        Sloan et al. 2005, equation 14. Constants are ours.
    """
    between = projected.transpose(0, 1)
    scale = 1.0
    if constants == 3:
        scale = 3.0 / len(between)
        between = between.expand(3, -1, -1, -1)
    colours, texels, materials, _ = between.shape
    matrix = between.flatten(2).flatten(0, 1)
    tints = torch.eye(3) if constants == 3 else torch.ones(constants, colours)
    tints = tints.double()
    ones = torch.kron(tints, torch.ones(texels, dtype=torch.float64))  # constants; views of colours
    squares = ones.square().sum(1, keepdim=True)
    even = ones @ matrix / squares  # the light functions that go best with them
    left, singular, right = leading_triplets(matrix - ones.mT @ even, num_terms - constants)
    view = torch.cat(
        [tints[..., None].expand(-1, -1, texels), left.mT.unflatten(1, (colours, texels))]
    )
    light = torch.cat([even, (right * singular).mT]).unflatten(1, (materials, -1)).transpose(0, 1)
    energies = torch.cat([(squares * even.square()).sum(1), singular.square()])
    _, used = hemisphere.centres()
    return Factors(fill(view, used, hemisphere), light, energies, energy * scale)


def fill(
    values: Float[Tensor, "*rows used"],
    used: Bool[Tensor, "texels"],
    hemisphere: HemisphereMap,
) -> Float[Tensor, "*rows texels"]:
    """Texels without a value of their own take that of the nearest one that has."""
    places = torch.arange(hemisphere.num_texels)
    grid = torch.stack([places // hemisphere.resolution, places % hemisphere.resolution], -1)
    own = torch.cumsum(used, 0) - 1
    if bool((~used).any()):
        distances = torch.cdist(grid[~used].double(), grid[used].double())
        own[~used] = distances.argmin(1)
    return values[..., own]


def _texels(hemisphere: HemisphereMap, supersampling: int) -> Tensor:
    """The texel that each sub-texel lies in."""
    steps = torch.arange(hemisphere.resolution * supersampling) // supersampling
    return (steps[:, None] * hemisphere.resolution + steps).flatten()


def leading_triplets(
    matrix: Float[Tensor, "a b"], count: int
) -> tuple[Float[Tensor, "a terms"], Float[Tensor, "terms"], Float[Tensor, "b terms"]]:
    """Leading singular triplets; a randomised decomposition where it saves time.

    Its generator is its own, so the same matrix gives the same factors.
    """
    count = min(count, *matrix.shape)
    if min(matrix.shape) <= 4 * (count + _MORE_VECTORS):
        left, singular, right = torch.linalg.svd(matrix, full_matrices=False)
        return left[:, :count], singular[:count], right[:count].mT
    generator = torch.Generator().manual_seed(0)
    width = count + _MORE_VECTORS
    basis = torch.randn(matrix.shape[1], width, generator=generator, dtype=matrix.dtype)
    for _ in range(6):
        basis = torch.linalg.qr(matrix.mT @ (matrix @ basis))[0]
    left, triangle = torch.linalg.qr(matrix @ basis)
    turned, singular, right = torch.linalg.svd(triangle)
    return (left @ turned)[:, :count], singular[:count], (basis @ right.mT)[:, :count]
