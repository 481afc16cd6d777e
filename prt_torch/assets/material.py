"""What surfaces are made of: a Lambertian part, a glossy part, a translucent inside."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

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

    A point that faces of several materials share takes that of the part that is listed first;
    :func:`split_borders` leaves no such points.

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
    found, numbers = _number_parts(mesh, materials)
    for part, number in reversed(list(zip(mesh.parts, numbers, strict=True))):
        faces = mesh.faces[part.first_face : part.first_face + part.num_faces]
        index[faces.reshape(-1)] = number
    return found, index


def split_borders(mesh: Mesh, materials: Material | Mapping[str, Material] | None) -> Mesh:
    """The mesh with a point of its own for each material that meets at a point.

    So a point on a border is shaded for both materials, each seen on its own faces. The first
    keeps the point; copies for the others follow behind all points.

    Args:
        mesh: The scene.
        materials: As for :func:`assign_materials`.

    Raises:
        InputError: If the mesh has no part of that name.

    Source:
        Tsai and Shih 2006, section 5.2.1: one group of transfer for each material.
    """
    if materials is None or isinstance(materials, Material):
        return mesh
    found, numbers = _number_parts(mesh, materials)
    _, kept = assign_materials(mesh, materials)
    of_face = torch.zeros(mesh.num_faces, dtype=torch.int64)
    for part, number in zip(mesh.parts, numbers, strict=True):
        of_face[part.first_face : part.first_face + part.num_faces] = number
    corners = mesh.faces.reshape(-1)
    wanted = of_face.repeat_interleave(3)
    shared = wanted != kept[corners]
    copies, which = torch.unique(corners[shared] * len(found) + wanted[shared], return_inverse=True)
    if len(copies) == 0:
        return mesh
    corners = corners.clone()
    corners[shared] = mesh.num_points + which
    points = torch.cat([torch.arange(mesh.num_points), copies // len(found)])
    return replace(
        mesh,
        vertices=mesh.vertices[points],
        faces=corners.view(-1, 3),
        normals=mesh.normals[points],
        albedo=mesh.albedo[points],
    )


def _number_parts(
    mesh: Mesh, materials: Mapping[str, Material]
) -> tuple[list[Material], list[int]]:
    """All different materials, the Lambertian one first, and the number of each part's."""
    found, names = [Material()], [part.name for part in mesh.parts]
    numbers: dict[str, int] = {}
    for name, material in materials.items():
        if name not in names:
            raise InputError(f"materials: {mesh.name} has no part {name!r}; its parts are {names}")
        if material not in found:
            found.append(material)
        numbers[name] = found.index(material)
    return found, [numbers.get(part.name, 0) for part in mesh.parts]
