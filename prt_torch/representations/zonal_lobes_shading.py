r"""Radiance of lobes: the light's bands at each axis, times the lobes' coefficients.

.. math:: r = \sum_i \sum_l \hat e_l(s_i)\, g^*_{il}, \qquad
          \hat e_l(s) = \sum_m y_{lm}(s)\, e_{lm}

The harmonics at the axes are exact. Constant and linear terms that are kept beside lobes are dot
products. A turn of a point turns its axes and its linear term, and nothing else.

Source:
    Sloan, Luna, Snyder 2005, equations 10, 13, 24 and 25.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases import sh, zonal
from prt_torch.representations.zonal_lobes_coding import Lobes

_BLOCK_BYTES = 2**25  # of light at lobes, of points that are relit at once


def turned(lobes: Lobes, turns: Float[Tensor, "points 3 3"]) -> Lobes:
    """Lobes after rotations of the world, one for each point.

    Source:
        Sloan, Luna, Snyder 2005, equation 10.
    """
    axes = torch.einsum("pij,prnj->prni", turns, zonal.unit_axes(lobes.axes))
    return Lobes(axes, lobes.coefficients, _turned_linear(lobes.linear, turns))


def radiance(
    lobes: Lobes, light: Float[Tensor, "batch *points coeffs rgb"], num_channels: int
) -> Float[Tensor, "batch points rows rgb"]:
    """Radiance in the exit basis, before reflectance.

    Args:
        lobes: In the directions of the light; rows of three channels come one channel after the
            other.
        light: Light coefficients ``"batch coeffs rgb"``, or ``"batch points coeffs rgb"`` where
            each point has its own light.
        num_channels: 1, or 3 where each colour has lobes of its own.
    """
    local = light.ndim == 4
    coloured = _by_channel(light if local else light[:, None], num_channels)
    points, rows, num_lobes, _ = lobes.axes.shape
    step = max(1, _BLOCK_BYTES // (len(coloured) * rows * num_lobes * light.element_size()))
    pieces = []
    for first in range(0, points, step):
        some = slice(first, first + step)
        lit = coloured[:, :, some] if local else coloured
        pieces.append(_relit(lobes[some], lit))
    total = torch.cat(pieces, dim=1) if len(pieces) > 1 else pieces[0]
    by_colour = total.unflatten(0, (len(light), -1)).permute(0, 2, 4, 1, 3)
    return by_colour.flatten(3)


def _by_channel(
    light: Float[Tensor, "batch points_or_one coeffs rgb"], num_channels: int
) -> Float[Tensor, "lights channels points_or_one coeffs"]:
    """One light for each colour where channels are shared, else one colour a channel."""
    colours = light.permute(0, 3, 1, 2)  # batch rgb points coeffs
    return colours.flatten(0, 1)[:, None] if num_channels == 1 else colours


def _relit(
    lobes: Lobes, light: Float[Tensor, "lights channels points_or_one coeffs"]
) -> Float[Tensor, "lights points channels rows"]:
    """Radiance of some points."""
    channels = light.shape[1]
    split = (channels, lobes.axes.shape[1] // channels)
    order = sh.order_of(light)
    low = lobes.linear.shape[-1]
    total = _met(lobes.linear.unflatten(1, split)[:, :, :, None], light[..., :low])[..., 0]
    harmonics = sh.evaluate(zonal.unit_axes(lobes.axes), order).unflatten(1, split)
    weights = lobes.coefficients.unflatten(1, split)
    first_band = order - weights.shape[-1]
    for index, band in enumerate(range(first_band, order)):
        own = slice(band * band, (band + 1) ** 2)
        at_axes = _met(harmonics[..., own], light[..., own])
        total = total + torch.einsum("qpcrn,pcrn->qpcr", at_axes, weights[..., index])
    return total


def _turned_linear(
    linear: Float[Tensor, "points rows low"], turns: Float[Tensor, "points 3 3"]
) -> Float[Tensor, "points rows low"]:
    """Constant and linear terms after a turn; linear ones are a vector, in the order y, z, x."""
    if linear.shape[-1] < 4:
        return linear
    constant, y, z, x = linear.unbind(-1)
    x, y, z = torch.einsum("pij,prj->ipr", turns, torch.stack([x, y, z], dim=-1))
    return torch.stack([constant, y, z, x], dim=-1)


def _met(
    functions: Float[Tensor, "points channels rows lobes some"],
    light: Float[Tensor, "lights channels points_or_one some"],
) -> Float[Tensor, "lights points channels rows lobes"]:
    """Light at each of the functions, of each point its own light or the same."""
    if light.shape[2] == 1:
        return torch.einsum("pcrnm,qcm->qpcrn", functions, light[:, :, 0])
    return torch.einsum("pcrnm,qcpm->qpcrn", functions, light)
