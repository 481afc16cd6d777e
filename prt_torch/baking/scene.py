"""From a scene to its transfer tensor: rays, direct light, bounces, light through translucency.

Only what the scene has is computed. A Lambertian scene has one row and its albedo stays a factor;
glossy points make it matrices, towards hemispherical harmonics or a few BRDF factors where light is
in spherical harmonics, towards BRDF factors where light is in all frequencies; channels become
three only where colour cannot factor out; bounces are skipped where nothing hides anything; media
cost nothing where there are none.
"""

import functools
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from prt_torch.assets.brdf import BRDF, Lambert, Sum
from prt_torch.assets.material import Material, assign_materials
from prt_torch.assets.mesh import Mesh
from prt_torch.baking.direct import project_diffuse, shared_reflectance
from prt_torch.baking.factored import (
    FactoredReflection,
    check_resolution,
    kept_factors,
    project_factored,
)
from prt_torch.baking.glossy import project_glossy
from prt_torch.baking.interreflection import Bounces, interreflect
from prt_torch.baking.reflection import (
    Reflection,
    diffuse_reflection,
    factored_reflection,
    glossy_reflection,
)
from prt_torch.baking.subsurface import scatter
from prt_torch.baking.visibility import Progress, VisibilityField, trace_visibility
from prt_torch.bases import (
    BRDFFactors,
    Diffuse,
    HemisphericalHarmonics,
    LightBasis,
    SphericalHarmonics,
    TexelBasis,
)
from prt_torch.errors import InputError
from prt_torch.transfer import TransferTensor, add, colour_channels

Stages = Callable[[str], Progress]
"""Given the name of a stage, whom to tell of its progress."""

_HARMONICS, _FACTORS = 24, 10  # rows of glossy scenes unless said
_MORE_LIGHT_BANDS = 1  # of a material's light side than of its view side: costs little, gains much
_LEAST_LIGHT_BANDS = 2  # of the light side of factors: a Lambertian side is linear

ExitFunctions = Literal["harmonics", "factors"]
"""What exit radiance of glossy scenes is expanded in."""


def bake(
    mesh: Mesh,
    *,
    materials: Material | Mapping[str, Material] | None = None,
    light_basis: LightBasis | None = None,
    exit_basis: ExitFunctions | None = None,
    num_rows: int | None = None,
    factors: BRDFFactors | None = None,
    max_bounces: int = 0,
    tolerance: float = 1e-3,
    resolution: int = 32,
    supersampling: int = 4,
    trace_all: bool = False,
    cache: Path | str | None = None,
    memory_budget: int = 4 * 2**30,
    stages: Stages | None = None,
) -> TransferTensor:
    """Bake the transfer tensor of a scene.

    Args:
        mesh: The scene.
        materials: One for all points, or some by name of a part of the mesh, the rest being
            Lambertian with the mesh's albedo; all are if not given. Points that parts of different
            materials share have one of them unless :func:`~prt_torch.assets.material.split_borders`
            came before.
        light_basis: What to expand the light in; spherical harmonics of order 6 if not given.
        exit_basis: What glossy exit radiance is expanded in: hemispherical ``harmonics`` (only if
            light is in spherical harmonics, and then unless said) or BRDF ``factors``.
        num_rows: Exit functions of a scene with glossy materials: 24 hemispherical harmonics, or
            10 BRDF factors (12 where Lambertian colours differ between glossy points, or a medium
            is coloured), unless given.
        factors: BRDF factors of the glossy materials, in the order of ``materials``, in place of
            those that are made; their light side is in harmonics if light is. Their first view
            functions must be constants where any part has a Lambertian or a translucent side: one,
            or three where their colours differ (one, for bounces of spherical harmonics).
        max_bounces: Most bounces between points; 0 for direct light only.
        tolerance: A bounce that adds less than this share of the exit radiance is the last.
        resolution: Texels along an edge of a face of the visibility cube.
        supersampling: Rays along an edge of a texel.
        trace_all: Trace points that are proven to see all above their horizon, too.
        cache: Folder that keeps bakes by the hash of their inputs; a killed bake resumes from it.
            Without one, bits and values stay in memory.
        memory_budget: Bytes that one block of the computation may take.
        stages: Told of the progress of each stage.

    Returns:
        Diffuse transfer of one row, or rows of an exit basis where any part is glossy. Its surface
        says which material each point has where there are several, Lambertian ones being one.

    Raises:
        InputError: If the cache cannot be written or is damaged, a part is unknown, bounces are
            asked for of glossy materials whose light is not in spherical harmonics or of coloured
            factors, the rays are not a multiple of the light's texels, the exit basis does not
            apply, or there are too few rows.
        ValueError: If ``factors`` do not fit the scene, or it needs none.
    """
    basis = light_basis or SphericalHarmonics(6)
    found, index = assign_materials(mesh, materials)
    if isinstance(basis, TexelBasis):
        check_resolution(basis, resolution * supersampling)
    folder = None if cache is None else Path(cache)
    reflectance = _reflectance(mesh, found, index)
    if _factored(found, basis, exit_basis, factors):
        if any(material.medium for material in found):  # one reflectance for all terms
            reflectance = torch.ones(1, 3)
        parts = _Parts(mesh, found, index, reflectance)
        reflection = parts.reflection(basis, num_rows, factors, folder, bounces=max_bounces > 0)
    elif any(material.glossy for material in found):
        reflection = _glossy(mesh, found, index, num_rows or _HARMONICS)
    else:
        reflection = diffuse_reflection(mesh.num_points)
    tell = stages or (lambda _: lambda done, total: None)
    visibility = trace_visibility(
        mesh,
        resolution=resolution,
        supersampling=supersampling,
        trace_all=trace_all,
        cache=folder,
        progress=tell("trace visibility"),
    )
    scene = _Scene(mesh, visibility, basis, reflection, reflectance, folder, memory_budget, tell)
    direct = scene.direct()
    terms, facts = [direct], {**direct.provenance, **_quality(reflection)}
    if max_bounces > 0:
        bounces = scene.bounces(direct, max_bounces, tolerance)
        facts["bounces"] = {f.name: getattr(bounces, f.name) for f in fields(bounces)}
        gathered = facts["bounces"].pop("gathered")
        facts["bounces"]["ended"] = bool(bounces.added) and bounces.added[-1] < tolerance
        if not bounces.skipped:
            terms.append(TransferTensor(gathered, direct.surface))
    for number, material in enumerate(found):
        if material.medium is not None:
            start = time.perf_counter()
            terms.append(scene.subsurface(material, index == number))
            taken = time.perf_counter() - start
            facts["subsurface_seconds"] = facts.get("subsurface_seconds", 0.0) + taken
    total = add(terms)
    if bool((index != index[:1]).any()):
        total = replace(total, surface=replace(total.surface, materials=index))
    return replace(total, provenance=facts)


@dataclass(frozen=True)
class _Scene:
    """Everything that the stages of a bake share."""

    mesh: Mesh
    visibility: VisibilityField
    basis: LightBasis
    reflection: Reflection | FactoredReflection
    reflectance: Float[Tensor, "points_or_one rgb"]
    cache: Path | None
    memory_budget: int
    tell: Stages

    def direct(self) -> TransferTensor:
        """Light that comes straight from the environment."""
        shared: dict[str, Any] = {
            "reflectance": self.reflectance,
            "cache": self.cache,
            "progress": self.tell("project transfer"),
        }
        if isinstance(self.reflection, FactoredReflection):
            return project_factored(
                self.mesh,
                self.visibility,
                self.reflection,
                self.basis,  # pyright: ignore[reportArgumentType]
                **shared,
            )
        if not isinstance(self.reflection.exit_basis, Diffuse):
            return project_glossy(
                self.mesh,
                self.visibility,
                self.reflection,
                self.basis,  # pyright: ignore[reportArgumentType]
                memory_budget=self.memory_budget,
                **shared,
            )
        surface = replace(self.irradiance.surface, reflectance=self.reflectance)
        return replace(self.irradiance, surface=surface)

    @functools.cached_property
    def irradiance(self) -> TransferTensor:
        """Direct light of points whose albedo is one."""
        transfer = project_diffuse(
            self.mesh,
            self.visibility,
            self.basis,
            cache=self.cache,
            memory_budget=self.memory_budget,
            progress=self.tell("project diffuse transfer"),
        )
        return replace(transfer, surface=replace(transfer.surface, reflectance=torch.ones(1, 3)))

    def bounces(self, direct: TransferTensor, max_bounces: int, tolerance: float) -> Bounces:
        """Light that other points of the scene have reflected before."""
        return interreflect(
            self.mesh,
            self.visibility,
            self.reflection,  # pyright: ignore[reportArgumentType]
            direct.dense() * colour_channels(self.reflectance)[:, :, None, None],
            self.reflectance,
            max_bounces=max_bounces,
            tolerance=tolerance,
            inputs={"direct": direct.provenance["inputs"]},
            cache=self.cache,
            progress=self.tell("gather bounces"),
        )

    def subsurface(self, material: Material, points: Bool[Tensor, "points"]) -> TransferTensor:
        """Light that has been inside a translucent object."""
        values = scatter(
            self.mesh,
            self.irradiance.dense()[:, :, 0],
            material.medium,  # pyright: ignore[reportArgumentType]
            millimetres_per_unit=material.millimetres_per_unit,
            points=points,
        )
        return TransferTensor(values, self.irradiance.surface)


def _quality(reflection: Reflection | FactoredReflection) -> dict[str, Any]:
    """What a report says of how well materials are represented."""
    if isinstance(reflection, FactoredReflection):
        return {"unresolved": 0.0, "factor_error": reflection.factors.rms}
    quality: dict[str, Any] = {"unresolved": reflection.unresolved}
    if isinstance(reflection.exit_basis, BRDFFactors):
        quality["factor_error"] = reflection.exit_basis.rms
    return quality


def _reflectance(
    mesh: Mesh, materials: list[Material], index: Tensor
) -> Float[Tensor, "points_or_one rgb"]:
    """The reflectance that stays a factor.

    Albedo is a factor of its own where a point is Lambertian and nothing else. Where it is glossy
    too, albedo enters the rows.
    """
    diffuse, glossy = _sides(materials, index)
    albedo = mesh.albedo.to(torch.float32)
    none = ~(diffuse | glossy)[:, None]
    return shared_reflectance(torch.where((diffuse & ~glossy)[:, None], albedo, (~none).to(albedo)))


def _sides(materials: list[Material], index: Tensor) -> tuple[Tensor, Tensor]:
    """Which points have a Lambertian side, and which a glossy one."""
    diffuse = torch.tensor([material.lambertian for material in materials])[index]
    glossy = torch.tensor([material.glossy is not None for material in materials])[index]
    return diffuse, glossy


def _glossy(mesh: Mesh, materials: list[Material], index: Tensor, num_rows: int) -> Reflection:
    """Reflection towards hemispherical harmonics."""
    diffuse, glossy = _sides(materials, index)
    albedo = mesh.albedo.to(torch.float32)
    both = (diffuse & glossy)[:, None]
    lambertian = colour_channels(torch.where(both, albedo, diffuse[:, None].to(albedo)))
    return glossy_reflection(
        [material.glossy for material in materials],
        index,
        lambertian,
        num_rows=num_rows,
        order=HemisphericalHarmonics(num_rows).order + _MORE_LIGHT_BANDS,
    )


def _factored(
    materials: list[Material],
    basis: LightBasis,
    exit_basis: ExitFunctions | None,
    factors: BRDFFactors | None,
) -> bool:
    """Whether exit radiance is expanded in BRDF factors; checks that what was asked for applies."""
    harmonic = isinstance(basis, SphericalHarmonics)
    glossy = any(material.glossy for material in materials)
    if exit_basis == "harmonics" and not harmonic:
        raise InputError(
            f"exit_basis: harmonics need light in spherical harmonics, not {basis.name}"
        )
    if exit_basis == "factors" and not glossy:
        raise InputError("exit_basis: factors are of glossy materials, and the scene has none")
    if factors is not None and (not glossy or exit_basis == "harmonics"):
        raise ValueError("expected factors only of glossy materials whose exit basis they are")
    if factors is not None and harmonic and factors.light_order is None:
        raise ValueError(
            "expected factors only of glossy materials without spherical harmonics, or with a "
            "light side in them (method='harmonic')"
        )
    return glossy and (not harmonic or exit_basis == "factors" or factors is not None)


@dataclass(frozen=True)
class _Parts:
    """What reflection by BRDF factors is made from."""

    mesh: Mesh
    materials: list[Material]
    index: Tensor
    reflectance: Float[Tensor, "points_or_one rgb"]

    def reflection(
        self,
        basis: LightBasis,
        num_rows: int | None,
        factors: BRDFFactors | None,
        cache: Path | None,
        *,
        bounces: bool,
    ) -> Reflection | FactoredReflection:
        """Reflection of light in this basis by the factors given, or by some that are made."""
        harmonic = isinstance(basis, SphericalHarmonics)
        if bounces and not harmonic:
            raise InputError(
                "max_bounces: glossy materials bounce light in spherical harmonics, "
                f"not {basis.name}"
            )
        brdfs, own, lambertian, constants = self.sides(coloured=not bounces)
        if bounces and any(brdf.num_channels == 3 for brdf in brdfs):
            raise InputError(
                "max_bounces: BRDF factors of coloured materials bounce no light; "
                "hemispherical harmonics do"
            )
        order = max(basis.order, _LEAST_LIGHT_BANDS) if harmonic else None
        unresolved = 0.0
        if factors is None:
            num_rows = _FACTORS + max(0, constants - 1) if num_rows is None else num_rows
            if num_rows < max(1, constants):
                raise InputError(
                    f"num_rows: the materials need at least {max(1, constants)}, got {num_rows}"
                )
            factors, unresolved = kept_factors(
                brdfs, num_terms=num_rows, constants=constants, cache=cache, light_order=order
            )
        elif (factors.num_materials, factors.num_constants) != (len(brdfs), constants):
            raise ValueError(
                f"expected factors of {len(brdfs)} materials with {constants} constants, got "
                f"{factors.num_materials} with {factors.num_constants}"
            )
        if harmonic:
            return factored_reflection(factors, own, lambertian, unresolved=unresolved)
        return FactoredReflection(factors, own, lambertian)

    def sides(self, *, coloured: bool) -> tuple[list[BRDF], Tensor, Tensor, Any]:
        """The materials to factor, that of each point, Lambertian albedo, number of constants.

        Where the Lambertian side of a glossy material has one albedo, it is factored with the rest,
        so its colour costs no channels. Neither does that of a medium, whose light enters the
        constants. If view functions may not be ``coloured``, only grey sides are, and other colours
        make channels.
        """
        diffuse, _ = _sides(self.materials, self.index)
        brdfs, numbers = [], torch.full((len(self.materials),), -1)
        for number, material in enumerate(self.materials):
            if material.glossy is None:
                continue
            numbers[number] = len(brdfs)
            albedo = self.mesh.albedo[self.index == number]
            alike = len(albedo) > 0 and bool((albedo == albedo[0]).all())
            if material.lambertian and alike and (coloured or len(albedo[0].unique()) == 1):
                brdfs.append(Sum((Lambert(tuple(albedo[0].tolist())), material.glossy)))
                diffuse = diffuse & (self.index != number)
            else:
                brdfs.append(material.glossy)
        albedo = self.mesh.albedo.to(torch.float32) * diffuse[:, None]
        # Where the reflectance that stays a factor is zero, anything may stand beside it: no colour
        share = albedo / torch.where(self.reflectance > 0, self.reflectance, 1.0)
        share = torch.where(self.reflectance > 0, share, diffuse[:, None].to(share))
        lambertian = colour_channels(share)
        media = [material.medium for material in self.materials if material.medium]
        if not media and not bool(lambertian.any()):
            return brdfs, numbers[self.index], lambertian[:, :0], 0
        if not coloured:
            return brdfs, numbers[self.index], lambertian, 1
        if not all(medium.is_grey() for medium in media):
            lambertian = lambertian.expand(-1, 3)
        return brdfs, numbers[self.index], lambertian, lambertian.shape[1]
