r"""Glossy direct light: visibility bits to matrices from light to exit radiance.

With light in spherical harmonics the incident radiance of a point has the inner products

.. math:: T_{ij} = \int V(s)\, y_i(s)\, y_j(s)\, ds = \sum_k G_{ijk} \int V(s)\, y_k(s)\, ds

because products of harmonics are harmonics. So all that is needed of the bits is their projection
onto the few harmonics of order ``n_i + n_j - 1``; no material and no pair of functions is ever
summed over texels. Turned into the shading frame, T meets the material's matrix:
``M_p = A⁻¹ B A⁻¹ R_p T_p``.

The same T of as many bands as the material has says how much of the transfer no light of fewer
bands can meet: rows :math:`V \beta_k` have the inner products :math:`\beta T \beta^T`.

Source:
    Sloan, Hall, Hart, Snyder 2003, section 3.1 and equation 1; Sloan, Luna, Snyder 2005, equation
    15, for rows of BRDF factors.
"""

from pathlib import Path

import torch
from torch import Tensor

from prt_torch.assets.mesh import Mesh
from prt_torch.baking.projection import check_memory, pieces, project_points
from prt_torch.baking.reflection import Reflection
from prt_torch.baking.visibility import Progress, VisibilityField
from prt_torch.bases import SphericalHarmonics, sh
from prt_torch.sphere import cubemap_solid_angles, frame_from_normal
from prt_torch.transfer import Surface, TransferTensor

_POINTS_PER_SHARD = 1024
_ALGORITHM = 2  # raise it when the same inputs would give other values


def project_glossy(
    mesh: Mesh,
    visibility: VisibilityField,
    reflection: Reflection,
    light_basis: SphericalHarmonics,
    *,
    reflectance: Tensor | None = None,
    cache: Path | None = None,
    memory_budget: int = 4 * 2**30,
    progress: Progress | None = None,
) -> TransferTensor:
    """Glossy shadowed transfer, without bounces.

    Args:
        mesh: The scene that ``visibility`` was traced for.
        visibility: Its visibility bits.
        reflection: How its points reflect.
        light_basis: What to expand the light in.
        reflectance: ``"points_or_one rgb"`` that multiplies at the end; ones if not given.
        cache: Folder of bakes; None keeps the values in memory.
        memory_budget: Bytes that one block of the computation may take.
        progress: Told of points done and points in all.

    Returns:
        Rows of the reflection's exit basis. Points without a normal have zero transfer. Norms of
        reference are those of visibility times the material in all of its bands.

    Raises:
        ValueError: If mesh and visibility do not belong together.
        InputError: If the memory budget is too small, or the cache cannot be written or is damaged.
    """
    wide = max(reflection.order, light_basis.order)
    seen_basis = SphericalHarmonics(reflection.order + wide - 1)
    at_once = check_memory(seen_basis, visibility.resolution, memory_budget)
    solid_angles = cubemap_solid_angles(visibility.resolution).reshape(-1)
    products = sh.product_matrix(reflection.order, wide).flatten(0, 1).mT
    gram = reflection.exit_basis.gram()
    frames = frame_from_normal(mesh.normals)

    def project(rows: slice) -> dict[str, Tensor]:
        projected = []
        for some in pieces(rows, at_once):
            seen = visibility.unpack(some).float() * solid_angles
            projected.append(seen_basis.project_cube(seen, visibility.resolution))
        incident = torch.cat(projected).double() @ products
        incident = incident.unflatten(1, (reflection.order**2, wide**2))
        to_local = sh.rotation_matrix(frames[rows], reflection.order)
        local = (to_local @ incident)[:, None]
        values = reflection.reflect(rows, local[..., : light_basis.num_coeffs])
        own = local[..., : reflection.order**2] @ to_local.mT[:, None]
        met = reflection.reflect(rows, reflection.reflect(rows, own).mT)
        norms = torch.einsum("kl,pclk->p", gram, met).clamp_min(0.0)
        return {"values": values.float(), "reference_squared_norm": norms}

    surface = Surface(
        exit_basis=reflection.exit_basis,
        light_basis=light_basis,
        reflectance=torch.ones(1, 3) if reflectance is None else reflectance,
        frames=frames,
        positions=mesh.vertices,
    )
    return project_points(
        mesh,
        visibility,
        project,
        surface=surface,
        inputs={"reflection": reflection.digest(), "algorithm": _ALGORITHM},
        points_per_shard=_POINTS_PER_SHARD,
        cache=cache,
        progress=progress,
    )
