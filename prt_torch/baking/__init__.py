"""From a scene to its transfer tensor."""

from pathlib import Path

from prt_torch.assets.mesh import Mesh
from prt_torch.baking.direct import check_memory, project_diffuse
from prt_torch.baking.visibility import Progress, VisibilityField, trace_visibility
from prt_torch.bases import LightBasis, SphericalHarmonics
from prt_torch.transfer import TransferTensor

__all__ = [
    "Progress",
    "VisibilityField",
    "bake",
    "check_memory",
    "project_diffuse",
    "trace_visibility",
]


def bake(
    mesh: Mesh,
    *,
    light_basis: LightBasis | None = None,
    resolution: int = 32,
    supersampling: int = 4,
    cache: Path | str | None = None,
    memory_budget: int = 4 * 2**30,
) -> TransferTensor:
    """Bake the diffuse, shadowed transfer tensor of a scene.

    Args:
        mesh: The scene.
        light_basis: What to expand the light in; spherical harmonics of order 6 if not given.
        resolution: Texels along an edge of a face of the visibility cube.
        supersampling: Rays along an edge of a texel.
        cache: Folder that keeps bakes by the hash of their inputs; a killed bake resumes from it.
            Without one, bits and values stay in memory.
        memory_budget: Bytes that one block of the computation may take.

    Raises:
        InputError: If the cache cannot be written or is damaged.
    """
    folder = None if cache is None else Path(cache)
    visibility = trace_visibility(
        mesh, resolution=resolution, supersampling=supersampling, cache=folder
    )
    return project_diffuse(
        mesh,
        visibility,
        light_basis or SphericalHarmonics(6),
        cache=folder,
        memory_budget=memory_budget,
    )
