"""Maps over texture coordinates: which texels a place falls on, and how much of each.

A map is an image: row 0 is at the top, where v is 1, u grows to the right, and texel centres are
half a texel from the border. Beyond the border it repeats, or its last texels go on; along u and
along v each as it is said.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class TexelGrid:
    """The texels of a map.

    Attributes:
        rows: Along v.
        cols: Along u.
        periodic: Whether it repeats along the rows' axis (v), and along the columns' (u).

    Raises:
        ValueError: If there is no texel.
    """

    rows: int
    cols: int
    periodic: tuple[bool, bool] = (True, True)

    def __post_init__(self) -> None:
        if min(self.rows, self.cols) < 1:
            raise ValueError(f"expected at least one texel, got {self.rows} x {self.cols}")

    @property
    def num_texels(self) -> int:
        """Rows times columns."""
        return self.rows * self.cols

    def nearest(self, uv: Float[Tensor, "points 2"]) -> Int[Tensor, "points"]:
        """The texel that each place falls in, in row order."""
        row, col = self._continuous(uv.detach())
        rows = self._inside(torch.floor(row + 0.5), 0)
        return rows * self.cols + self._inside(torch.floor(col + 0.5), 1)

    def bilinear(
        self, uv: Float[Tensor, "points 2"]
    ) -> tuple[Int[Tensor, "points 4"], Float[Tensor, "points 4"]]:
        """The four texels that a bilinear lookup mixes, and how much of each; shares sum to 1.

        Shares are differentiable in ``uv``.
        """
        row, col = self._continuous(uv)
        top, left = torch.floor(row.detach()), torch.floor(col.detach())
        down, right = row - top, col - left
        rows = [self._inside(top, 0), self._inside(top + 1, 0)]
        cols = [self._inside(left, 1), self._inside(left + 1, 1)]
        indices = torch.stack([r * self.cols + c for r in rows for c in cols], dim=-1)
        shares = [a * b for a in (1 - down, down) for b in (1 - right, right)]
        return indices, torch.stack(shares, dim=-1)

    def sample(
        self, texels: Float[Tensor, "texels *values"], uv: Float[Tensor, "points 2"]
    ) -> Float[Tensor, "points *values"]:
        """Values of a map at some places, bilinear.

        Raises:
            ValueError: If there are not as many values as texels.
        """
        if len(texels) != self.num_texels:
            raise ValueError(f"expected values of {self.num_texels} texels, got {len(texels)}")
        indices, shares = self.bilinear(uv)
        return torch.einsum("pk,pk...->p...", shares.to(texels), texels[indices])

    def _continuous(self, uv: Tensor) -> tuple[Tensor, Tensor]:
        """Rows and columns with fractions, counted from the centre of the first texel."""
        row = (1.0 - uv[:, 1]) * self.rows - 0.5
        col = uv[:, 0] * self.cols - 0.5
        row = row if self.periodic[0] else row.clamp(0.0, self.rows - 1.0)
        return row, col if self.periodic[1] else col.clamp(0.0, self.cols - 1.0)

    def _inside(self, number: Tensor, axis: int) -> Int[Tensor, "points"]:
        count = (self.rows, self.cols)[axis]
        whole = number.long()
        return whole % count if self.periodic[axis] else whole.clamp(0, count - 1)
