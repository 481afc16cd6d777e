"""What surfaces are made of: a Lambertian part, a glossy part, a translucent inside."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from prt_torch.assets.brdf import BRDF
from prt_torch.assets.medium import Medium
from prt_torch.assets.mesh import Mesh
from prt_torch.errors import InputError


@dataclass(frozen=True)
class Material:
    """The sum of up to three ways in which a point returns light.

    Attributes:
        lambertian: Whether it reflects diffusely, with the albedo that the mesh has at each point.
        glossy: A reflectance model in the shading frame; None for none.
        medium: A translucent inside; None for an opaque object.
        millimetres_per_unit: Size of a mesh unit, which a medium needs.
    """

    lambertian: bool = True
    glossy: BRDF | None = None
    medium: Medium | None = None
    millimetres_per_unit: float = 1.0


def assign_materials(
    mesh: Mesh, materials: Material | Mapping[str, Material] | None
) -> tuple[list[Material], Int[Tensor, "points"]]:
    """The materials of a scene, and which of them each point has.

    A point that faces of several parts share takes the material of the part that is listed first.

    Args:
        mesh: The scene.
        materials: One for all points; or some by name of a part of the mesh, the others being
            Lambertian; or None, all being Lambertian.

    Raises:
        InputError: If the mesh has no part of that name.
    """
    index = torch.zeros(mesh.num_points, dtype=torch.int64)
    if materials is None or isinstance(materials, Material):
        return [materials or Material()], index
    found, names = [Material()], [part.name for part in mesh.parts]
    numbers: dict[str, int] = {}
    for name, material in materials.items():
        if name not in names:
            raise InputError(f"materials: {mesh.name} has no part {name!r}; its parts are {names}")
        if material not in found:
            found.append(material)
        numbers[name] = found.index(material)
    for part in reversed(mesh.parts):  # a point that parts share belongs to the first of them
        faces = mesh.faces[part.first_face : part.first_face + part.num_faces]
        index[faces.reshape(-1)] = numbers.get(part.name, 0)
    return found, index
