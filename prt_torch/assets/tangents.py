r"""Frames of a surface along its texture coordinates.

A texture of transfer is given in a tangent frame: tangent along u, bitangent along v, normal. On a
triangle the position is linear in (u, v), so its tangent solves

.. math:: \partial_u x = \frac{e_1\, \delta v_2 - e_2\, \delta v_1}
    {\delta u_1\, \delta v_2 - \delta u_2\, \delta v_1},

and a point takes the average over its faces, weighted by their areas in the texture and made
perpendicular to its normal. Where a face wears its texture mirrored, the frame is left-handed:
what is mirrored is the whole patch, light and all, and lobes can be mirrored as they can be turned.

Everything is differentiable in the positions of the points, so poses have gradients.

Source:
    Sloan, Luna, Snyder 2005, section 5, step 1, leaves the frame to the skinning hardware.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.assets.mesh import Mesh
from prt_torch.errors import InputError
from prt_torch.sphere import frame_from_normal

_LEAST_TANGENT = 1e-6  # sine of its angle to the normal from which a tangent tells a direction


def tangent_frames(
    mesh: Mesh, positions: Float[Tensor, "*batch points 3"] | None = None
) -> Float[Tensor, "*batch points 3 3"]:
    """Tangent, bitangent and normal of each point, along its texture coordinates.

    Normals are averages over faces, weighted by area, in every pose alike. A point whose faces
    have no texture coordinates, or whose tangents cancel, gets any tangent.

    Args:
        mesh: Faces and their texture coordinates.
        positions: Of the points, in mesh units, in one or several poses; those of the mesh if not
            given.

    Returns:
        Orthogonal matrices, left-handed where the texture is mirrored, in the dtype of
        ``positions``.

    Raises:
        InputError: If the mesh has no texture coordinates.
        ValueError: If there are not as many positions as points.
    """
    uv = _checked_uv(mesh)
    where = mesh.vertices if positions is None else positions
    if where.shape[-2:] != (mesh.num_points, 3):
        raise ValueError(f'expected positions "{mesh.num_points} 3", got {tuple(where.shape)}')
    faces = mesh.faces.to(where.device)
    corners = where[..., faces, :]
    first, second = (corners[..., i, :] - corners[..., 0, :] for i in (1, 2))
    # Faces without texture coordinates have NaN: they say nothing of the tangent.
    changes = torch.nan_to_num((uv[:, 1:] - uv[:, :1]).to(where))
    (u1, v1), (u2, v2) = changes[:, 0].unbind(-1), changes[:, 1].unbind(-1)
    area = u1 * v2 - u2 * v1
    along_u = (first * v2[:, None] - second * v1[:, None]) * area.sign()[:, None]
    tangents = _gathered(along_u, faces, where)
    normals = _gathered(torch.linalg.cross(first, second), faces, where)
    areas = area.new_zeros(mesh.num_points).index_add(
        0, faces.reshape(-1), area.repeat_interleave(3)
    )
    return orthonormal_frames(tangents, normals, mirrored=areas < 0)


def frames_on_faces(
    mesh: Mesh,
    frames: Float[Tensor, "*batch points 3 3"],
    faces: Int[Tensor, "samples"],
    weights: Float[Tensor, "samples 3"],
) -> tuple[Float[Tensor, "samples 2"], Float[Tensor, "*batch samples 3 3"]]:
    """Texture coordinates and frames of places on faces, such as those that primary rays hit.

    Args:
        mesh: Faces and their texture coordinates.
        frames: Of the points, in one or several poses, as :func:`tangent_frames` gives them.
        faces: On which face each place is.
        weights: Barycentric weights of its corners.

    Raises:
        InputError: If the mesh has no texture coordinates.
    """
    uv = _checked_uv(mesh).to(frames)
    weights = weights.to(frames)
    corners = mesh.faces.to(frames.device)[faces]
    at_corners = frames[..., corners, :, :]
    mixed = torch.einsum("sk,...skij->...sij", weights, at_corners)
    mirrored = torch.linalg.det(at_corners[..., 0, :, :].detach()) < 0
    turned = orthonormal_frames(mixed[..., 0, :], mixed[..., 2, :], mirrored=mirrored)
    return torch.einsum("sk,skj->sj", weights, uv[faces]), turned


def orthonormal_frames(
    tangents: Float[Tensor, "*batch 3"],
    normals: Float[Tensor, "*batch 3"],
    *,
    mirrored: Tensor,
) -> Float[Tensor, "*batch 3 3"]:
    """Frames whose normal is as given and whose tangent is as near as it can be.

    Args:
        tangents: Of any length; where they are zero or along the normal, any tangent is taken.
        normals: Of any length; +y is taken for zero.
        mirrored: Which frames are left-handed, with the bitangent on the other side.
    """
    up = normals.new_tensor([0.0, 1.0, 0.0])
    normals = _unit(normals, up)
    across = tangents - (tangents * normals).sum(-1, keepdim=True) * normals
    length = torch.linalg.vector_norm(tangents.detach(), dim=-1, keepdim=True)
    short = torch.linalg.vector_norm(across.detach(), dim=-1, keepdim=True)
    across = torch.where(short > _LEAST_TANGENT * length, across, 0.0)
    unit = _unit(across, frame_from_normal(normals)[..., 0, :])
    bitangents = torch.linalg.cross(normals, unit)
    bitangents = torch.where(mirrored[..., None], -bitangents, bitangents)
    return torch.stack([unit, bitangents, normals], dim=-2)


def _checked_uv(mesh: Mesh) -> Float[Tensor, "faces 3 2"]:
    if mesh.uv is None:
        raise InputError(f"{mesh.name}: has no texture coordinates (uv), which a texture needs")
    return mesh.uv


def _gathered(
    of_faces: Float[Tensor, "*batch faces 3"], faces: Tensor, like: Float[Tensor, "*batch points 3"]
) -> Float[Tensor, "*batch points 3"]:
    """Sums over the faces of each point."""
    repeated = of_faces.repeat_interleave(3, dim=-2)
    return torch.zeros_like(like).index_add(-2, faces.reshape(-1), repeated)


def _unit(
    vectors: Float[Tensor, "*batch 3"], otherwise: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Vectors of length one; another where there is none, without a gradient that is no number."""
    largest = vectors.detach().abs().amax(dim=-1, keepdim=True)
    vanishes = largest < torch.finfo(vectors.dtype).tiny
    scaled = torch.where(vanishes, otherwise, vectors / torch.where(vanishes, 1.0, largest))
    return scaled / torch.linalg.vector_norm(scaled, dim=-1, keepdim=True)
