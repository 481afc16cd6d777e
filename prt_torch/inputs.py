"""What a run reads: mesh, materials, lights, loaded and validated before anything is written."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from prt_torch import store
from prt_torch.assets import (
    Environment,
    Mesh,
    concatenate,
    find_environment,
    ground_plane,
    load_mesh,
    procedural_scene,
)
from prt_torch.assets.brdf import brdf
from prt_torch.assets.material import Material, assign_materials, split_borders
from prt_torch.assets.medium import PRESETS
from prt_torch.baking import check_memory
from prt_torch.bases import SRBF, CubeDirections, Haar, LightBasis, SphericalHarmonics
from prt_torch.errors import InputError
from prt_torch.gallery import file_name
from prt_torch.metric import MAX_PRIOR_COEFFS
from prt_torch.settings import LightConfig, PartConfig, RunConfig, SceneConfig


@dataclass(frozen=True)
class Inputs:
    """Everything a run reads, loaded and validated before anything is written."""

    mesh: Mesh
    materials: Mapping[str, Material]
    fit_lights: list[Environment]
    test_lights: list[Environment]
    light_basis: LightBasis

    @property
    def material(self) -> str:
        """What the parts of the scene are made of, in a few words."""
        parts: dict[str, list[str]] = {}
        for part, made_of in self.materials.items():
            parts.setdefault(_words(made_of), []).append(part)
        return "; ".join(
            f"{', '.join(names[:3])}{f' and {len(names) - 3} more' if names[3:] else ''}: {words}"
            for words, names in parts.items()
        )

    def digest(self) -> str:
        """SHA-256 of what the files held: surface, materials of points, and light."""
        mesh, lights = self.mesh, [*self.fit_lights, *self.test_lights]
        surface = (mesh.vertices, mesh.faces, mesh.normals, mesh.albedo)
        found, of_points = assign_materials(mesh, self.materials)
        glossy = [made_of.glossy and made_of.glossy.describe() for made_of in found]
        light = (part for one in lights for part in (one.image, one.rotation))
        return store.digest(*surface, glossy, of_points, *light)


def _words(material: Material) -> str:
    words = ["Lambertian"] if material.lambertian else []
    words += [str(material.glossy.describe()["name"])] if material.glossy else []
    words += ["translucent"] if material.medium else []
    return " + ".join(words) or "black"


def load_inputs(config: RunConfig) -> Inputs:
    """Read everything that a configuration names.

    Raises:
        InputError: If an input is unusable, or the configuration asks for what cannot be.
    """
    mesh, basis = _mesh(config.scene), _light_basis(config)
    materials, light = _materials(config, mesh), config.light
    inputs = Inputs(
        split_borders(mesh, materials),
        materials,
        _lights(light.fit, light),
        _lights(light.test, light),
        basis,
    )
    if config.fit.metric == "light_prior":
        _check_prior(inputs)
    names = [file_name(environment.name) for environment in inputs.test_lights]
    if len(set(names)) != len(names):
        raise InputError(f"light.test: expected different lights, got {', '.join(names)}")
    if config.transfer.exit_basis and not any(made_of.glossy for made_of in materials.values()):
        raise InputError(
            f"transfer.exit_basis: {config.transfer.exit_basis} are of glossy materials, and no "
            "part of the scene has one"
        )
    fine = config.transfer.resolution * config.transfer.supersampling
    check_memory(basis, fine, config.memory_budget)
    return inputs


def _check_prior(inputs: Inputs) -> None:
    """Make sure that there is light to expect, in a basis that is small enough."""
    if not any(light.image.any() for light in inputs.fit_lights):
        raise InputError(
            "light.fit: expected at least one light that is not black for fit.metric=light_prior"
        )
    if inputs.light_basis.num_coeffs > MAX_PRIOR_COEFFS:
        raise InputError(
            f"fit.metric: light_prior takes at most {MAX_PRIOR_COEFFS} light coefficients, "
            f"{inputs.light_basis.name} has {inputs.light_basis.num_coeffs}"
        )


def _mesh(scene: SceneConfig) -> Mesh:
    if scene.mesh is None:
        return procedural_scene()
    mesh = load_mesh(
        scene.mesh,
        up=scene.up,
        transform=scene.transform,
        orientation=scene.orientation,
        albedo=scene.albedo,
    )
    if scene.ground:
        ground = ground_plane(mesh, size=scene.ground_size, resolution=scene.ground_resolution)
        mesh = concatenate([mesh, ground], mesh.name)
    return mesh


def _lights(names: Sequence[str], light: LightConfig) -> list[Environment]:
    return [
        find_environment(
            name,
            layout=light.layout,
            rotation_degrees=light.rotation_degrees,
            exposure=light.exposure,
        )
        for name in names
    ]


def _materials(config: RunConfig, mesh: Mesh) -> dict[str, Material]:
    """The material of each part: the object's for all but the ground, unless named."""
    scene, names = config.material, [part.name for part in mesh.parts]
    unknown = [name for name in scene.parts if name not in names]
    if unknown:
        raise InputError(
            f"material.parts: no part {unknown[0]!r}; expected one of {', '.join(names)}"
        )
    own = _material("material", scene)
    others = {name: _material(f"material.parts.{name}", at) for name, at in scene.parts.items()}
    return {name: others.get(name, Material() if name == "ground" else own) for name in names}


def _material(key: str, wanted: PartConfig) -> Material:
    medium = None
    if wanted.medium is not None:
        if wanted.medium not in PRESETS:
            choices = ", ".join(PRESETS)
            raise InputError(f"{key}.medium: unknown {wanted.medium!r}; expected one of {choices}")
        medium = PRESETS[wanted.medium]
    try:
        glossy = None if wanted.glossy is None else brdf(wanted.glossy)
    except InputError as error:
        raise InputError(f"{key}.glossy: {error}") from error
    return Material(wanted.lambertian, glossy, medium, wanted.millimetres_per_unit)


def _light_basis(config: RunConfig) -> LightBasis:
    transfer = config.transfer
    match transfer.light_basis:
        case "sh":
            return SphericalHarmonics(transfer.order)
        case "cube":
            return CubeDirections(transfer.light_texels)
        case "haar":
            return Haar(transfer.light_texels, transfer.light_texels // transfer.light_segments)
        case "srbf":
            return SRBF(
                transfer.light_centers, transfer.light_kernel, resolution=transfer.light_texels
            )
