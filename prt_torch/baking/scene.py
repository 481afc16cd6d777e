"""From a scene to its transfer tensor: rays, direct light, bounces, light through translucency.

Only what the scene has is computed. A Lambertian scene has one row and its albedo stays a factor;
glossy points make it matrices; channels become three only where colour cannot factor out; bounces
are skipped where nothing hides anything; media cost nothing where there are none.
"""

import functools
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from prt_torch.assets.material import Material, assign_materials
from prt_torch.assets.mesh import Mesh
from prt_torch.baking.direct import project_diffuse, shared_reflectance
from prt_torch.baking.glossy import project_glossy
from prt_torch.baking.interreflection import Bounces, interreflect
from prt_torch.baking.reflection import Reflection, diffuse_reflection, glossy_reflection
from prt_torch.baking.subsurface import scatter
from prt_torch.baking.visibility import Progress, VisibilityField, trace_visibility
from prt_torch.bases import HemisphericalHarmonics, LightBasis, SphericalHarmonics
from prt_torch.errors import InputError
from prt_torch.transfer import TransferTensor, add, colour_channels

Stages = Callable[[str], Progress]
"""Given the name of a stage, whom to tell of its progress."""

_MORE_LIGHT_BANDS = 1  # of a material's light side than of its view side: costs little, gains much


def bake(
    mesh: Mesh,
    *,
    materials: Material | Mapping[str, Material] | None = None,
    light_basis: LightBasis | None = None,
    num_rows: int = 24,
    max_bounces: int = 0,
    tolerance: float = 1e-3,
    resolution: int = 32,
    supersampling: int = 4,
    cache: Path | str | None = None,
    memory_budget: int = 4 * 2**30,
    stages: Stages | None = None,
) -> TransferTensor:
    """Bake the transfer tensor of a scene.

    Args:
        mesh: The scene.
        materials: One for all points, or some by name of a part of the mesh, the rest being
            Lambertian with the mesh's albedo; all are if not given.
        light_basis: What to expand the light in; spherical harmonics of order 6 if not given.
            Glossy materials need spherical harmonics.
        num_rows: Exit functions of a scene with glossy materials.
        max_bounces: Most bounces between points; 0 for direct light only.
        tolerance: A bounce that adds less than this share of the exit radiance is the last.
        resolution: Texels along an edge of a face of the visibility cube.
        supersampling: Rays along an edge of a texel.
        cache: Folder that keeps bakes by the hash of their inputs; a killed bake resumes from it.
            Without one, bits and values stay in memory.
        memory_budget: Bytes that one block of the computation may take.
        stages: Told of the progress of each stage.

    Returns:
        Diffuse transfer of one row, or rows in hemispherical harmonics where any part is glossy.

    Raises:
        InputError: If the cache cannot be written or is damaged, a part is unknown, or a glossy
            material meets a light basis other than spherical harmonics.
    """
    basis = light_basis or SphericalHarmonics(6)
    found, index = assign_materials(mesh, materials)
    glossy = any(material.glossy for material in found)
    if glossy and not isinstance(basis, SphericalHarmonics):
        raise InputError(f"glossy materials need light in spherical harmonics, got {basis.name}")
    tell = stages or (lambda _: lambda done, total: None)
    folder = None if cache is None else Path(cache)
    visibility = trace_visibility(
        mesh,
        resolution=resolution,
        supersampling=supersampling,
        cache=folder,
        progress=tell("trace visibility"),
    )
    reflection, reflectance = _reflection(mesh, found, index, num_rows if glossy else 1)
    scene = _Scene(mesh, visibility, basis, reflection, reflectance, folder, memory_budget, tell)
    direct = scene.direct()
    terms, facts = [direct], {**direct.provenance, "unresolved": reflection.unresolved}
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
    return replace(add(terms), provenance=facts)


@dataclass(frozen=True)
class _Scene:
    """Everything that the stages of a bake share."""

    mesh: Mesh
    visibility: VisibilityField
    basis: LightBasis
    reflection: Reflection
    reflectance: Float[Tensor, "points_or_one rgb"]
    cache: Path | None
    memory_budget: int
    tell: Stages

    def direct(self) -> TransferTensor:
        """Light that comes straight from the environment."""
        if not isinstance(self.reflection.exit_basis, HemisphericalHarmonics):
            surface = replace(self.irradiance.surface, reflectance=self.reflectance)
            return replace(self.irradiance, surface=surface)
        return project_glossy(
            self.mesh,
            self.visibility,
            self.reflection,
            self.basis,  # pyright: ignore[reportArgumentType]
            reflectance=self.reflectance,
            cache=self.cache,
            memory_budget=self.memory_budget,
            progress=self.tell("project transfer"),
        )

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
            self.reflection,
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


def _reflection(
    mesh: Mesh, materials: list[Material], index: Tensor, num_rows: int
) -> tuple[Reflection, Tensor]:
    """How points reflect, and the reflectance that stays a factor.

    Albedo is a factor of its own where a point is Lambertian and nothing else. Where it is glossy
    too, albedo enters the matrices, as one channel if it is grey there.
    """
    diffuse = torch.tensor([material.lambertian for material in materials])[index]
    glossy = torch.tensor([material.glossy is not None for material in materials])[index]
    albedo = mesh.albedo.to(torch.float32)
    both, none = (diffuse & glossy)[:, None], ~(diffuse | glossy)[:, None]
    factor = torch.where((diffuse & ~glossy)[:, None], albedo, (~none).to(albedo))
    if not bool(glossy.any()):
        return diffuse_reflection(mesh.num_points), shared_reflectance(factor)
    lambertian = colour_channels(torch.where(both, albedo, diffuse[:, None].to(albedo)))
    reflection = glossy_reflection(
        [material.glossy for material in materials],
        index,
        lambertian,
        num_rows=num_rows,
        order=HemisphericalHarmonics(num_rows).order + _MORE_LIGHT_BANDS,
    )
    return reflection, shared_reflectance(factor)
