r"""Direct light: visibility bits times cosine, projected into a light basis.

For a diffuse point with normal n and visibility V the transfer function is
:math:`T(s) = V(s)\,(n \cdot s) / \pi`; its reflectance is kept apart. The integral is a sum over
cube sub-texels with exact solid angles, streamed by blocks of points under a memory budget.

Source:
    Sloan, Hall, Hart, Snyder 2003, section 3.1 (with visibility as the only transport).
"""

import math
from pathlib import Path

import torch
from torch import Tensor

from prt_torch.assets.mesh import Mesh
from prt_torch.baking.projection import check_memory, pieces, project_points
from prt_torch.baking.visibility import Progress, VisibilityField
from prt_torch.bases import Diffuse, LightBasis
from prt_torch.sphere import cubemap_directions, cubemap_solid_angles, frame_from_normal
from prt_torch.transfer import Surface, TransferTensor

_POINTS_PER_SHARD = 4096
_ALGORITHM = 1  # raise it when the same inputs would give other values


def project_diffuse(
    mesh: Mesh,
    visibility: VisibilityField,
    light_basis: LightBasis,
    *,
    cache: Path | None = None,
    memory_budget: int = 4 * 2**30,
    progress: Progress | None = None,
) -> TransferTensor:
    """Diffuse shadowed transfer, without bounces.

    Args:
        mesh: The scene that ``visibility`` was traced for.
        visibility: Its visibility bits.
        light_basis: What to expand the light in.
        cache: Folder of bakes; None keeps the values in memory.
        memory_budget: Bytes that one block of the computation may take.
        progress: Told of points done and points in all.

    Returns:
        One channel, one row. Points without a normal have zero transfer.

    Raises:
        ValueError: If mesh and visibility do not belong together.
        InputError: If the memory budget is too small, or the cache cannot be written or is damaged.
    """
    resolution = visibility.resolution
    at_once = check_memory(light_basis, resolution, memory_budget)
    solid_angles = cubemap_solid_angles(resolution, dtype=torch.float64).reshape(-1)
    directions = cubemap_directions(resolution, dtype=torch.float64).reshape(-1, 3)
    weighted_directions = (directions * (solid_angles / math.pi)[:, None]).mT.float().contiguous()
    per_solid_angle = (1.0 / solid_angles).float()
    normals = mesh.normals.to(torch.float32)

    def project(rows: slice) -> dict[str, Tensor]:
        values, squared_norms = [], []
        for some in pieces(rows, at_once):
            transfer = normals[some] @ weighted_directions
            transfer *= visibility.unpack(some).float()
            values.append(light_basis.project_cube(transfer, resolution))
            squared_norms.append(transfer.square_() @ per_solid_angle)
        return {
            "values": torch.cat(values)[:, None, None, :],
            "reference_squared_norm": torch.cat(squared_norms).double(),
        }

    surface = Surface(
        exit_basis=Diffuse(),
        light_basis=light_basis,
        reflectance=shared_reflectance(mesh.albedo.to(torch.float32)),
        frames=frame_from_normal(mesh.normals),
        positions=mesh.vertices,
    )
    return project_points(
        mesh,
        visibility,
        project,
        surface=surface,
        inputs={"material": "diffuse", "algorithm": _ALGORITHM},
        points_per_shard=_POINTS_PER_SHARD,
        cache=cache,
        progress=progress,
    )


def shared_reflectance(albedo: Tensor) -> Tensor:
    """``"points rgb"``, or ``"1 rgb"`` where every point has the same: the rest is left out."""
    return albedo[:1] if bool((albedo == albedo[:1]).all()) else albedo
