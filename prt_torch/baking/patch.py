"""Transfer of a patch that repeats: a tile with copies of itself round it.

Shadows, bounces and light through translucency cross the border of a tile, so it is baked with
copies round it, and only its own texels are kept. Where light comes straight from the environment
the copies only occlude, and no ray is traced from them. Bounces and subsurface scattering need the
transfer of the copies too: then all of them are baked, which takes as many times as long.

One ring of copies, 3 x 3 tiles, is enough for relief that is low against the tile. Beyond the
last copy nothing stands in the way, so too much light comes in at grazing angles. Against 9 x 9
tiles that is 0.05 % of the bumps of :mod:`prt_torch.assets.patches`, whose relief is an eighth of
their tile, and 0.03 % of the weave (root of the mean square over that of the transfer); the tile
alone is off by 19 % and 16 %. With three bounces it is 0.04 %, and 0.3 % of a translucent waffle,
against 7 x 7 tiles.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from prt_torch.assets.material import Material
from prt_torch.assets.mesh import Mesh, concatenate
from prt_torch.assets.patches import Patch
from prt_torch.baking.scene import bake
from prt_torch.transfer import TransferTensor


def bake_patch(
    patch: Patch,
    *,
    copies: int = 1,
    materials: Material | Mapping[str, Material] | None = None,
    max_bounces: int = 0,
    **options: Any,
) -> TransferTensor:
    """Bake the texels of a periodic patch.

    Args:
        patch: The tile.
        copies: Rings of copies round it; 1 makes 3 x 3 tiles, 0 bakes the tile alone.
        materials: As in :func:`~prt_torch.baking.scene.bake`, by parts of the patch's mesh.
        max_bounces: Likewise.
        options: All others of :func:`~prt_torch.baking.scene.bake`.

    Returns:
        Transfer of the texels in row order, acting on light in the world of the patch.

    Raises:
        InputError: As :func:`~prt_torch.baking.scene.bake`.
        ValueError: If ``copies`` is negative.
    """
    if copies < 0:
        raise ValueError(f"expected at least 0 rings of copies, got {copies}")
    whole = _tiled(patch.mesh, copies)
    if max_bounces == 0 and not _translucent(materials):
        # A point without a normal costs no ray, and only occludes.
        others = torch.arange(whole.num_points) >= patch.mesh.num_points
        whole = replace(whole, normals=whole.normals.masked_fill(others[:, None], 0.0))
    transfer = bake(whole, materials=materials, max_bounces=max_bounces, **options)
    return _picked(transfer, patch.texels.reshape(-1))


def _tiled(tile: Mesh, copies: int) -> Mesh:
    """The tile first, then its copies."""
    reach = range(-copies, copies + 1)
    moves = sorted(((x, z) for z in reach for x in reach), key=lambda move: move != (0, 0))
    tiles = [
        replace(tile, vertices=tile.vertices + tile.vertices.new_tensor([x, 0, z]))
        for x, z in moves
    ]
    return concatenate(tiles, tile.name)


def _translucent(materials: Material | Mapping[str, Material] | None) -> bool:
    match materials:
        case None:
            return False
        case Material():
            return materials.medium is not None
        case _:
            return any(material.medium is not None for material in materials.values())


def _picked(transfer: TransferTensor, points: torch.Tensor) -> TransferTensor:
    """Some points of a transfer, in memory."""
    surface, first = transfer.surface, slice(0, int(points.max()) + 1)
    of_points = {
        name: values[points]
        for name in ("frames", "positions", "materials")
        if (values := getattr(surface, name)) is not None
    }
    if len(surface.reflectance) > 1:
        of_points["reflectance"] = surface.reflectance[points]
    norms = transfer.reference_squared_norm
    return replace(
        transfer,
        values=transfer.values[first][points],
        surface=replace(surface, **of_points),
        reference_squared_norm=None if norms is None else norms[points],
    )
