r"""Glossy direct light in all frequencies: visibility bits times light functions of BRDF factors.

Row k of a point's transfer is the integral over each light texel of

.. math:: T_k(s) = V(s)\, F_k(R_p s)

with :math:`F_k` the light function (cosine included) and :math:`R_p` the turn into the shading
frame. Only sub-texels that the point sees are touched. A bilinear lookup is a sum of four texels,
so the sum over the visible sub-texels of a light texel is one weighted sum of map texels, whatever
the number of rows, and no value of F is ever stored.

Source:
    Liu et al. 2004, section 4, equation 10, with a box in place of the printed hat, whose weights
    sum to 0.5625 over one texel; Wang et al. 2004, section 3.3, equation 3.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from prt_torch import store
from prt_torch.assets.brdf import BRDF
from prt_torch.assets.mesh import Mesh
from prt_torch.baking.projection import pieces, project_points
from prt_torch.baking.reflection import EQUAL_AREA, factor_in_harmonics
from prt_torch.baking.visibility import Progress, VisibilityField
from prt_torch.bases import SRBF, BRDFFactors, HemisphereMap, TexelBasis
from prt_torch.errors import InputError
from prt_torch.sphere import cubemap_directions, cubemap_solid_angles, frame_from_normal
from prt_torch.transfer import Surface, TransferTensor

_SHARD_BYTES = 2**26
_POINTS_AT_ONCE = 16
_ALGORITHM = 3  # raise it when the same inputs would give other values
_FACTORING = 3  # likewise of factors


@dataclass(frozen=True)
class FactoredReflection:
    """How the points of a scene reflect, by BRDF factors.

    Attributes:
        factors: Of all glossy materials of the scene, with as many constants as ``lambertian`` has
            colours.
        materials: ``"points"``: which material of ``factors`` each point has; -1 for none.
        lambertian: ``"points colours"``: albedo that enters the constant rows; no colours where
            there is none.

    Raises:
        ValueError: If they do not fit together, or the light side of the factors are harmonics.
    """

    factors: BRDFFactors
    materials: Int[Tensor, "points"]
    lambertian: Float[Tensor, "points colours"]

    def __post_init__(self) -> None:
        factors, colours = self.factors, self.lambertian.shape[1]
        if factors.light_order is not None:
            raise ValueError(
                f"expected light functions in maps, got harmonics of {factors.light_order} bands"
            )
        if colours and colours != factors.num_constants:
            raise ValueError(f"expected {colours} constants, got {factors.num_constants}")
        if int(self.materials.max()) >= factors.num_materials:
            raise ValueError(
                f"expected factors of {int(self.materials.max()) + 1} materials, "
                f"got {factors.num_materials}"
            )

    def digest(self) -> str:
        """SHA-256 of everything that reflected light follows from."""
        factors = self.factors
        maps = (factors.view_values.detach(), factors.light_values.detach())
        described = (factors.describe(), factors.cosine)
        return store.digest(*described, *maps, self.materials, self.lambertian)


def project_factored(
    mesh: Mesh,
    visibility: VisibilityField,
    reflection: FactoredReflection,
    light_basis: TexelBasis,
    *,
    reflectance: Float[Tensor, "points_or_one rgb"] | None = None,
    cache: Path | None = None,
    progress: Progress | None = None,
) -> TransferTensor:
    """Glossy shadowed transfer in BRDF factors, without bounces.

    Args:
        mesh: The scene that ``visibility`` was traced for.
        visibility: Its visibility bits.
        reflection: How its points reflect.
        light_basis: Light by texels, their wavelets, or kernels fitted to them.
        reflectance: Multiplies at the end; ones if not given.
        cache: Folder of bakes; None keeps the values in memory.
        progress: Told of points done and points in all.

    Returns:
        Rows of the factors' view functions. Points without a normal have zero transfer.

    Raises:
        ValueError: If mesh and visibility do not belong together.
        InputError: If the visibility is not a multiple of the light's resolution, or the cache
            cannot be written or is damaged.
    """
    check_resolution(light_basis, visibility.resolution)
    project = functools.partial(
        _project_shard, _Projector(visibility, reflection, light_basis), mesh
    )
    rows = reflection.factors.num_rows
    surface = Surface(
        exit_basis=reflection.factors,
        light_basis=light_basis,
        reflectance=torch.ones(1, 3) if reflectance is None else reflectance,
        frames=frame_from_normal(mesh.normals),
        positions=mesh.vertices,
    )
    return project_points(
        mesh,
        visibility,
        project,
        surface=surface,
        inputs={"factors": reflection.digest(), "algorithm": _ALGORITHM},
        points_per_shard=max(1, _SHARD_BYTES // (4 * rows * light_basis.num_coeffs)),
        cache=cache,
        progress=progress,
    )


def kept_factors(
    brdfs: Sequence[BRDF],
    *,
    num_terms: int,
    constants: Literal[0, 1, 3],
    cache: Path | None,
    light_order: int | None = None,
) -> tuple[BRDFFactors, float]:
    """Factors of materials, made once: a bake and what relights it must share them to the bit.

    Singular vectors may come out with other signs on other numbers of threads.

    Args:
        brdfs: The materials.
        num_terms: Rows.
        constants: How many of them are constants.
        cache: Folder of bakes; None makes them anew.
        light_order: Bands of a light side in harmonics, with equal-area view maps; None for maps
            on both sides.

    Returns:
        The factors, and the relative change of the worst material when its quadrature was last
        doubled; zero for maps, which expect their error themselves.

    Raises:
        InputError: If the cache cannot be written or is damaged.
    """
    options: dict[str, Any] = {"num_terms": num_terms, "constants": constants}
    if light_order is not None:
        options["light_order"] = light_order

    def make(_: slice) -> tuple[dict[str, Tensor], dict[str, int | float]]:
        if light_order is None:
            made, change = BRDFFactors.from_brdf(brdfs, **options), 0.0
        else:
            made, change = factor_in_harmonics(brdfs, **options)
        maps = {"view": made.view_values, "light": made.light_values}
        tensors = {name: values.detach()[None] for name, values in maps.items()}
        quality = torch.tensor([[made.rms, change]], dtype=torch.float64)
        return {**tensors, "quality": quality}, {}

    inputs = {
        "brdfs": [brdf.describe() for brdf in brdfs],
        **options,
        "algorithm": _FACTORING,
    }
    folder = None if cache is None else cache / f"factors-{store.digest(inputs)[:16]}"
    found = store.build_sharded(make, rows=1, rows_per_shard=1, inputs=inputs, folder=folder)
    view, light, quality = (found.tensors[name][0:1][0] for name in ("view", "light", "quality"))
    hemisphere = HemisphereMap() if light_order is None else EQUAL_AREA
    factors = BRDFFactors(view, light, hemisphere, light_order=light_order, num_constants=constants)
    factors.rms = float(quality[0])
    return factors, float(quality[1])


def check_resolution(light_basis: TexelBasis, resolution: int) -> None:
    """Check that rays divide the texels of a light evenly.

    Args:
        light_basis: Light by texels, their wavelets, or kernels fitted to them.
        resolution: Sub-texels along an edge of a face of the visibility cube.

    Raises:
        InputError: If they do not.
    """
    if resolution % light_basis.resolution:
        raise InputError(
            f"{light_basis.name} needs a visibility resolution that is a multiple of "
            f"{light_basis.resolution}, got {resolution}"
        )


def _project_shard(projector: "_Projector", mesh: Mesh, rows: slice) -> dict[str, Tensor]:
    basis, num_rows = projector.light_basis, projector.factors.num_rows
    frames = frame_from_normal(mesh.normals).float()
    values = torch.zeros(rows.stop - rows.start, 1, num_rows, basis.num_coeffs)
    norms = torch.zeros(rows.stop - rows.start, dtype=torch.float64)
    for some in pieces(rows, _POINTS_AT_ONCE):
        by_texel = [
            projector.project(point, seen, frames[point])
            for point, seen in zip(
                range(some.start, some.stop), projector.visibility.unpack(some), strict=True
            )
        ]
        flat = basis.project_cube(torch.cat(by_texel), basis.resolution)
        of_points = flat.view(len(by_texel), num_rows, basis.num_coeffs)
        here = slice(some.start - rows.start, some.stop - rows.start)
        values[here, 0] = of_points
        norms[here] = torch.stack([projector.squared_norm(one) for one in by_texel])
        if isinstance(basis, SRBF):  # so that the norm less that of the values is what they lose
            norms[here] += basis.blur(projector.row_root @ of_points).sum(1)
    return {"values": values, "reference_squared_norm": norms}


class _Projector:
    """Tables that all points share, and the sum for one of them.

    Sub-texels are taken in the order of the light texels that they lie in.
    """

    def __init__(
        self,
        visibility: VisibilityField,
        reflection: FactoredReflection,
        light_basis: TexelBasis,
    ):
        self.visibility, self.reflection, self.light_basis = visibility, reflection, light_basis
        self.factors = reflection.factors
        fine, coarse = visibility.resolution, light_basis.resolution
        places = torch.arange(6 * fine * fine).view(6, coarse, fine // coarse, coarse, -1)
        self.order = places.permute(0, 1, 3, 2, 4).flatten()
        self.per_texel = (fine // coarse) ** 2
        solid_angles = cubemap_solid_angles(fine, dtype=torch.float64).flatten()
        self.solid_angles = solid_angles[self.order].float()
        directions = cubemap_directions(fine).reshape(-1, 3)[self.order]
        self.directions = directions.mT.contiguous()
        padded = self.factors.hemisphere.pad(self.factors.light_values.detach())
        self.maps = [maps.mT.contiguous() for maps in padded]
        line = self.factors.hemisphere.resolution + 1
        self.steps = torch.tensor([0, 1, line, line + 1])
        self.row_root = self.factors.gram_root().mT.float()
        texels = cubemap_solid_angles(coarse, dtype=torch.float64).flatten()
        self.over_root = texels.rsqrt().float()

    def squared_norm(self, by_texel: Float[Tensor, "rows texels"]) -> Float[Tensor, ""]:
        """Over light texels and the hemisphere of views, float64."""
        weighed = (self.row_root @ by_texel).mul_(self.over_root)
        return torch.linalg.vector_norm(weighed, dtype=torch.float64).square()

    @torch.no_grad()
    def project(
        self, point: int, seen: UInt8[Tensor, "subtexels"], frame: Float[Tensor, "3 3"]
    ) -> Float[Tensor, "rows texels"]:
        """Integrals over light texels of one point's rows.

        Args:
            point: Which.
            seen: Its visibility, 1 where it sees the sky.
            frame: Its shading frame.
        """
        seen = seen.index_select(0, self.order)
        # Five times as fast as torch's own.
        visible = torch.from_numpy(np.flatnonzero(seen.view(torch.bool).numpy()))
        ends = seen.view(-1, self.per_texel).sum(1).cumsum(0)
        starts = torch.cat([ends.new_zeros(1), ends[:-1]])
        local = frame @ self.directions.index_select(1, visible)
        weights = self.solid_angles.index_select(0, visible)
        material = int(self.reflection.materials[point])
        texels, albedo = len(ends), self.reflection.lambertian[point]
        if material >= 0:
            rows = self._glossy(material, local, weights, starts).mT
        else:
            rows = torch.zeros(self.factors.num_rows, texels)
        if bool((albedo != 0).any()):
            irradiance = weights * local[2] / math.pi
            number = torch.repeat_interleave(torch.arange(texels), ends - starts)
            summed = torch.zeros(texels).index_add(0, number, irradiance)
            rows[: len(albedo)] += albedo[:, None] * summed
        return rows

    def _glossy(
        self, material: int, local: Tensor, weights: Tensor, starts: Tensor
    ) -> Float[Tensor, "texels rows"]:
        """Sums of light functions over the visible sub-texels of each light texel."""
        if not self.factors.cosine:
            weights = weights * local[2]
        cell, right, lower = self.factors.hemisphere.cells(*local)
        below = weights * lower
        above = weights - below
        beside, across = above * right, below * right
        taps = torch.stack([above - beside, beside, below - across, across], dim=1)
        return torch.nn.functional.embedding_bag(
            (cell[:, None] + self.steps).flatten(),
            self.maps[material],
            starts * len(self.steps),
            mode="sum",
            per_sample_weights=taps.flatten(),
        )
