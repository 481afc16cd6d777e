"""What every projection of visibility bits shares: blocks of points, memory, cache, provenance."""

import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from prt_torch import store
from prt_torch.assets.mesh import Mesh
from prt_torch.baking.visibility import Progress, VisibilityField, followed
from prt_torch.bases import LightBasis
from prt_torch.errors import InputError
from prt_torch.transfer import Surface, TransferTensor

_BYTES_PER_TEXEL = 16  # bits as bytes and as floats, and weighted cosines, at their peak
_POINTS_AT_ONCE = 32  # their texels stay in the processor's cache


def project_points(
    mesh: Mesh,
    visibility: VisibilityField,
    project: Callable[[slice], dict[str, Tensor]],
    *,
    surface: Surface,
    inputs: Mapping[str, Any],
    points_per_shard: int,
    cache: Path | None,
    progress: Progress | None,
) -> TransferTensor:
    """Project all points of a scene, shard by shard, and say what it came from.

    Args:
        mesh: The scene that ``visibility`` was traced for.
        visibility: Its visibility bits.
        project: Points to ``values`` and, where known, ``reference_squared_norm``.
        surface: What belongs to the values; its light basis is not None.
        inputs: What else the values follow from, in plain JSON.
        points_per_shard: Length of a shard.
        cache: Folder of bakes; None keeps the values in memory.
        progress: Told of points done and points in all.

    Raises:
        ValueError: If mesh and visibility do not belong together.
        InputError: If the cache cannot be written or is damaged.
    """
    if visibility.bits.shape[0] != mesh.num_points:
        raise ValueError(
            f"expected visibility of {mesh.num_points} points, got {visibility.bits.shape[0]}"
        )

    def timed(rows: slice) -> tuple[dict[str, Tensor], dict[str, int | float]]:
        start = time.perf_counter()
        made = project(rows)
        return made, {"seconds": time.perf_counter() - start}

    basis = surface.light_basis
    described = {
        "visibility": store.digest(followed(mesh, visibility.resolution)),
        "light_basis": None if basis is None else basis.describe(),
        **inputs,
    }
    name = f"transfer-{store.digest(described)[:16]}"
    built = store.build_sharded(
        timed,
        rows=mesh.num_points,
        rows_per_shard=points_per_shard,
        inputs=described,
        folder=None if cache is None else Path(cache) / name,
        progress=progress,
    )
    provenance = {
        "inputs": described,
        "rays": visibility.rays,
        "free_points": visibility.free_points,
        "bits_bytes": visibility.bits.shape[1],
        "visibility_seconds": visibility.seconds,
        "projection_seconds": built.counts["seconds"],
        "visibility_cached": visibility.cached,
        "projection_cached": built.cached,
    }
    norms = built.tensors.get("reference_squared_norm")
    reference = None if norms is None else norms[0 : mesh.num_points]
    return TransferTensor(built.tensors["values"], surface, reference, provenance)


def pieces(rows: slice, at_once: int) -> Iterator[slice]:
    """A range of points cut into runs of at most ``at_once``."""
    for first in range(rows.start, rows.stop, at_once):
        yield slice(first, min(first + at_once, rows.stop))


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
