r"""Direct light: visibility bits times cosine, projected into a light basis.

For a diffuse point with normal n and visibility V the transfer function is
:math:`T(s) = V(s)\,(n \cdot s) / \pi`; its reflectance is kept apart. The integral is a sum over
cube sub-texels with exact solid angles, streamed by blocks of points under a memory budget.

Source:
    Sloan, Hall, Hart, Snyder 2003, section 3.1 (with visibility as the only transport).
"""

import math
import time
from pathlib import Path

import torch
from torch import Tensor

from prt_torch import store
from prt_torch.assets.mesh import Mesh
from prt_torch.baking.visibility import Progress, VisibilityField
from prt_torch.bases import Diffuse, LightBasis
from prt_torch.errors import InputError
from prt_torch.sphere import cubemap_directions, cubemap_solid_angles, frame_from_normal
from prt_torch.transfer import Surface, TransferTensor

_BYTES_PER_TEXEL = 16  # bits as bytes and as floats, and weighted cosines, at their peak
_POINTS_AT_ONCE = 32  # their texels stay in the processor's cache
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
    if visibility.bits.shape[0] != mesh.num_points:
        raise ValueError(
            f"expected visibility of {mesh.num_points} points, got {visibility.bits.shape[0]}"
        )
    resolution = visibility.resolution
    at_once = check_memory(light_basis, resolution, memory_budget)
    solid_angles = cubemap_solid_angles(resolution, dtype=torch.float64).reshape(-1)
    directions = cubemap_directions(resolution, dtype=torch.float64).reshape(-1, 3)
    weighted_directions = (directions * (solid_angles / math.pi)[:, None]).mT.float().contiguous()
    per_solid_angle = (1.0 / solid_angles).float()
    normals = mesh.normals.to(torch.float32)

    def project(rows: slice) -> tuple[dict[str, Tensor], dict[str, int | float]]:
        start = time.perf_counter()
        values, squared_norms = [], []
        for first in range(rows.start, rows.stop, at_once):
            some = slice(first, min(first + at_once, rows.stop))
            transfer = normals[some] @ weighted_directions
            transfer *= visibility.unpack(some).float()
            values.append(light_basis.project_cube(transfer, resolution))
            squared_norms.append(transfer.square_() @ per_solid_angle)
        made = {
            "values": torch.cat(values)[:, None, None, :],
            "reference_squared_norm": torch.cat(squared_norms).double(),
        }
        return made, {"seconds": time.perf_counter() - start}

    inputs = {
        "visibility": store.digest(mesh.vertices, mesh.faces, resolution),
        "normals": store.digest(mesh.normals),
        "light_basis": light_basis.describe(),
        "material": "diffuse",
        "algorithm": _ALGORITHM,
    }
    built = store.build_sharded(
        project,
        rows=mesh.num_points,
        rows_per_shard=_POINTS_PER_SHARD,
        inputs=inputs,
        folder=None if cache is None else Path(cache) / f"transfer-{store.digest(inputs)[:16]}",
        progress=progress,
    )
    surface = Surface(
        exit_basis=Diffuse(),
        light_basis=light_basis,
        reflectance=shared_reflectance(mesh.albedo.to(torch.float32)),
        frames=frame_from_normal(mesh.normals),
        positions=mesh.vertices,
    )
    squared_norm = built.tensors["reference_squared_norm"]
    provenance = {
        "inputs": inputs,
        "rays": visibility.rays,
        "visibility_seconds": visibility.seconds,
        "projection_seconds": built.counts["seconds"],
        "visibility_cached": visibility.cached,
        "projection_cached": built.cached,
    }
    return TransferTensor(
        built.tensors["values"], surface, squared_norm[0 : mesh.num_points], provenance
    )


def check_memory(light_basis: LightBasis, resolution: int, memory_budget: int) -> int:
    """How many points can be projected at once within a memory budget.

    Args:
        light_basis: What to project into.
        resolution: Sub-texels along an edge of a face of the visibility cube.
        memory_budget: Bytes.

    Raises:
        InputError: If not even one.
    """
    table_bytes = light_basis.table_bytes(resolution)
    per_point = _BYTES_PER_TEXEL * 6 * resolution * resolution
    if table_bytes + per_point > memory_budget:
        raise InputError(
            f"memory_budget: {light_basis.name} at {resolution} texels an edge needs at least "
            f"{table_bytes + per_point} bytes, got {memory_budget}"
        )
    return min((memory_budget - table_bytes) // per_point, _POINTS_AT_ONCE)


def shared_reflectance(albedo: Tensor) -> Tensor:
    """``"points rgb"``, or ``"1 rgb"`` where every point has the same: the rest is left out."""
    return albedo[:1] if bool((albedo == albedo[:1]).all()) else albedo
