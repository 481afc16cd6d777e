r"""Tables over the sphere: what lobes look up instead of evaluating spherical harmonics.

A lobe of axis s meets light e in band l by the number

.. math:: \hat e_l(s) = \sum_m y_{lm}(s)\, e_{lm},

a function of s alone for light that all points share. Tabulated once for a light it costs a lobe
one lookup and a dot product of n numbers, in place of n² harmonics and their sums. Light that
differs from point to point looks up the harmonics y(s) themselves.

Tables are latitude-longitude grids sampled at their *vertices*: the first and the last row are the
poles, whose columns are all one direction, and columns wrap around. So bilinear lookups are
continuous everywhere, and exact at the poles. A grid of texel centres would need lookups across the
poles, or be constant around each: at 32 x 64 and six bands its largest error is then three times
as large.

Source:
    Sloan, Luna, Snyder 2005, section 5, equations 24 and 25, whose tables are 32 x 64.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import embedding_bag

from prt_torch.bases import sh
from prt_torch.bases.tables import kept

_MOST_CELLS = 4096  # along an edge; far beyond any use, below any overflow


@dataclass(frozen=True)
class LatLongTable:
    """A latitude-longitude grid of vertices.

    Rows go from +z to -z, poles included; columns go from +x over +y all the way around, without a
    second copy of the first.

    Attributes:
        rows: At least 2.
        cols: At least 3.

    Raises:
        ValueError: If either is out of range.
    """

    rows: int = 32
    cols: int = 64

    def __post_init__(self) -> None:
        if not 2 <= self.rows <= _MOST_CELLS or not 3 <= self.cols <= _MOST_CELLS:
            raise ValueError(
                f"expected 2 to {_MOST_CELLS} rows and 3 to {_MOST_CELLS} cols, "
                f"got {self.rows} and {self.cols}"
            )

    @property
    def num_vertices(self) -> int:
        """Rows times cols."""
        return self.rows * self.cols

    def directions(self) -> Float[Tensor, "rows cols 3"]:
        """Unit vectors to the vertices, float64; those of a pole's row are equal to the bit."""
        polar = torch.linspace(0.0, math.pi, self.rows, dtype=torch.float64)
        azimuth = torch.arange(self.cols, dtype=torch.float64) * (2.0 * math.pi / self.cols)
        radius, z = polar.sin(), polar.cos()
        radius[[0, -1]] = 0.0
        level = torch.stack([azimuth.cos(), azimuth.sin()], dim=-1)
        around = radius[:, None, None] * level
        return torch.cat([around, z[:, None, None].expand(-1, self.cols, -1)], dim=-1)

    def taps(
        self, directions: Float[Tensor, "*batch 3"]
    ) -> tuple[Int[Tensor, "*batch 4"], Float[Tensor, "*batch 4"]]:
        """The four vertices that a bilinear lookup mixes, and how much of each; shares sum to 1.

        Shares are differentiable in directions inside cells, with finite gradients everywhere,
        though at the poles, where azimuths have no meaning, these mean nothing.

        Args:
            directions: Unit vectors.
        """
        # Arc tangents are ten times as fast where numbers lie side by side.
        x, y, z = directions.movedim(-1, 0).contiguous().unbind(0)
        squared = x * x + y * y
        pole = (squared < torch.finfo(squared.dtype).tiny).to(squared)
        radius = (squared + pole).sqrt() - pole
        down = torch.atan2(radius, z) * ((self.rows - 1) / math.pi)
        across = torch.atan2(y, x + pole) * (self.cols / (2.0 * math.pi))
        left = across.detach().floor()
        top = down.detach().floor().clamp_max(self.rows - 2)
        right, lower = across - left, down - top
        # Limits are on integers: what is not a number stays inside the table.
        upper = top.long().clamp(0, self.rows - 2) * self.cols
        column = left.long() % self.cols
        after = (column + 1) % self.cols
        upper_left, upper_right = upper + column, upper + after
        corners = [upper_left, upper_right, upper_left + self.cols, upper_right + self.cols]
        beside, above = 1.0 - right, 1.0 - lower
        shares = [beside * above, right * above, beside * lower, right * lower]
        return torch.stack(corners, dim=-1), torch.stack(shares, dim=-1)

    def lookup(
        self, values: Float[Tensor, "vertices features"], directions: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch features"]:
        """Bilinear values in any directions.

        Args:
            values: At the vertices, row by row: any number of functions, which share the search.
            directions: Unit vectors.

        Returns:
            In the dtype of ``values``; differentiable in both arguments (:meth:`taps`).

        Raises:
            ValueError: If there are not as many values as vertices.
        """
        if len(values) != self.num_vertices:
            raise ValueError(f"expected values of {self.num_vertices} vertices, got {len(values)}")
        vertices, shares = self.taps(directions)
        found = embedding_bag(
            vertices.reshape(-1, 4),
            values,
            mode="sum",
            per_sample_weights=shares.to(values).reshape(-1, 4),
        )
        return found.view(*directions.shape[:-1], values.shape[1])


def harmonics_table(order: int, table: LatLongTable) -> Float[Tensor, "vertices coeffs"]:
    """Spherical harmonics y(s) at the vertices, float64, for light that varies over the surface.

    Args:
        order: Number of bands.
        table: The grid.

    Raises:
        ValueError: If ``order`` is out of range.

    Source:
        Sloan, Luna, Snyder 2005, section 5.
    """
    return _harmonics(order, table).clone()


def band_table(
    light: Float[Tensor, "*batch coeffs"], table: LatLongTable
) -> Float[Tensor, "vertices *batch order"]:
    r"""The light of each band, :math:`\hat e_l(s) = \sum_m y_{lm}(s)\, e_{lm}`, at the vertices.

    Differentiable in the light.

    Args:
        light: Spherical-harmonic coefficients of any number of lights.
        table: The grid.

    Returns:
        In the dtype of ``light``; flatten all axes but the first to look them up at once.

    Raises:
        ValueError: If the number of coefficients is not a square.

    Source:
        Sloan, Luna, Snyder 2005, equation 24.
    """
    order = sh.order_of(light)
    functions = _harmonics(order, table).to(light)
    flat = light.reshape(-1, light.shape[-1])
    bands = [slice(band * band, (band + 1) ** 2) for band in range(order)]
    lit = torch.stack([functions[:, own] @ flat[:, own].mT for own in bands], dim=-1)
    return lit.view(table.num_vertices, *light.shape[:-1], order)


@kept
def _harmonics(order: int, table: LatLongTable) -> Float[Tensor, "vertices coeffs"]:
    """As :func:`harmonics_table`; kept, since a table is made anew whenever the light changes."""
    return sh.evaluate(table.directions().flatten(0, 1), order)
