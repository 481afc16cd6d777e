r"""Radiance of lobes: the light's bands at each axis, times the lobes' coefficients.

.. math:: r = \sum_i \sum_l \hat e_l(s_i)\, g^*_{il}, \qquad
          \hat e_l(s) = \sum_m y_{lm}(s)\, e_{lm}

Harmonics at the axes are exact, or looked up (:mod:`prt_torch.bases.zonal_table`): a table of
:math:`\hat e` for light that all points share, of :math:`y` for light that each has for itself.
Constant and linear terms that are kept beside lobes are dot products. A turn of a point turns its
axes and its linear term, and nothing else.

Source:
    Sloan, Luna, Snyder 2005, equations 10, 13, 24 and 25.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases import sh, zonal
from prt_torch.bases.zonal_table import LatLongTable, band_table, harmonics_table
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
    lobes: Lobes,
    light: Float[Tensor, "batch *points coeffs rgb"],
    num_channels: int,
    table: LatLongTable | None = None,
) -> Float[Tensor, "batch points rows rgb"]:
    """Radiance in the exit basis, before reflectance.

    Args:
        lobes: In the directions of the light; rows of three channels come one channel after the
            other.
        light: Light coefficients ``"batch coeffs rgb"``, or ``"batch points coeffs rgb"`` where
            each point has its own light.
        num_channels: 1, or 3 where each colour has lobes of its own.
        table: Look up light that all points share, or harmonics where each has its own, in a table
            of this size, made anew for each call; exact if not given.
    """
    local = light.ndim == 4
    coloured = _by_channel(light if local else light[:, None], num_channels)
    bands = None
    if table is not None and not local:
        first_band = sh.order_of(coloured) - lobes.coefficients.shape[-1]
        bands = band_table(coloured[:, :, 0], table)[..., first_band:]
    points, rows, num_lobes, _ = lobes.axes.shape
    step = max(1, _BLOCK_BYTES // (len(coloured) * rows * num_lobes * light.element_size()))
    pieces = []
    for first in range(0, points, step):
        own = lobes[first : first + step]
        lit = coloured[:, :, first : first + step] if local else coloured
        low = _low_bands(own, lit)
        if table is None:
            harmonics = sh.evaluate(zonal.unit_axes(own.axes), sh.order_of(lit))
            pieces.append(low + _high_bands(own, harmonics, lit))
        elif bands is None:
            functions = harmonics_table(sh.order_of(lit), table).to(lit)
            harmonics = table.lookup(functions, zonal.unit_axes(own.axes))
            pieces.append(low + _high_bands(own, harmonics, lit))
        else:
            pieces.append(low + _looked_up(own, bands, table))
    total = torch.cat(pieces, dim=1) if len(pieces) > 1 else pieces[0]
    by_colour = total.unflatten(0, (len(light), -1)).permute(0, 2, 4, 1, 3)
    return by_colour.flatten(3)


def _by_channel(
    light: Float[Tensor, "batch points_or_one coeffs rgb"], num_channels: int
) -> Float[Tensor, "lights channels points_or_one coeffs"]:
    """One light for each colour where channels are shared, else one colour a channel."""
    colours = light.permute(0, 3, 1, 2)  # batch rgb points coeffs
    return colours.flatten(0, 1)[:, None] if num_channels == 1 else colours


def _low_bands(
    lobes: Lobes, light: Float[Tensor, "lights channels points_or_one coeffs"]
) -> Float[Tensor, "lights points channels rows"]:
    """Constant and linear terms that are kept beside lobes; zero where there are none."""
    low = lobes.linear.shape[-1]
    linear = lobes.linear.unflatten(1, (light.shape[1], -1))
    return _met(linear[:, :, :, None], light[..., :low])[..., 0]


def _high_bands(
    lobes: Lobes,
    harmonics: Float[Tensor, "points all_rows lobes coeffs"],
    light: Float[Tensor, "lights channels points_or_one coeffs"],
) -> Float[Tensor, "lights points channels rows"]:
    """Bands of the lobes, from the harmonics at their axes."""
    split = (light.shape[1], -1)
    by_channel = harmonics.unflatten(1, split)
    weights = lobes.coefficients.unflatten(1, split)
    order = sh.order_of(light)
    total = light.new_zeros(len(light), len(weights), *weights.shape[1:3])
    for index, band in enumerate(range(order - weights.shape[-1], order)):
        own = slice(band * band, (band + 1) ** 2)
        at_axes = _met(by_channel[..., own], light[..., own])
        total = total + torch.einsum("qpcrn,pcrn->qpcr", at_axes, weights[..., index])
    return total


def _looked_up(
    lobes: Lobes, bands: Float[Tensor, "vertices lights channels bands"], table: LatLongTable
) -> Float[Tensor, "lights points channels rows"]:
    """Bands of the lobes, from a table of the light."""
    split = (bands.shape[2], -1)
    axes, weights = lobes.axes.unflatten(1, split), lobes.coefficients.unflatten(1, split)
    found = []
    for channel in range(bands.shape[2]):
        own = bands[:, :, channel].to(axes)
        at_axes = table.lookup(own.flatten(1), zonal.unit_axes(axes[:, channel]))
        at_axes = at_axes.unflatten(-1, own.shape[1:])  # points rows lobes lights bands
        found.append(torch.einsum("prnql,prnl->qpr", at_axes, weights[:, channel]))
    return torch.stack(found, dim=2)


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
