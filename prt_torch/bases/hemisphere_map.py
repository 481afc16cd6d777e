r"""Maps of functions on the upper hemisphere: square grids of texels with bilinear lookups.

A lookup is linear in the texels, ``f(d) = sum_t weights_t(d) * texels[indices_t(d)]`` over four
*taps*, which is all that anyone else needs to know of a mapping. Coordinates lie in 0..1, texel
centres at half steps; beyond the outermost centres the outermost texels go on.

* ``parabolic``: :math:`(s_x, s_y) / (1 + s_z)` (Liu et al. 2004);
* ``orthographic``: :math:`(s_x, s_y)` (Wang et al. 2004, equation 7);
* ``concentric``: equal-area disk :math:`(s_x, s_y) / \sqrt{1 + s_z}`, then the disk onto the square
  by concentric rings: every texel has the same solid angle and none is wasted (Shirley, Chiu 1997;
  Sloan et al. 2005, section 4.4);
* ``polar``: azimuth across, which wraps around, and :math:`\sqrt{1 - s_z}` down (Wang et al. 2004,
  equation 8, whose azimuth lacks the division by 2π).

Disks leave the corners of the square without a direction. Directions below the horizon are taken
to the horizon, which views of interpolated frames need.
"""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from prt_torch.sphere import to_horizon

Mapping = Literal["parabolic", "orthographic", "concentric", "polar"]

_MOST_TEXELS = 512  # along an edge; far beyond any use, below any overflow


@dataclass(frozen=True)
class HemisphereMap:
    """A square grid of texels over the upper hemisphere.

    Attributes:
        mapping: How directions become coordinates.
        resolution: Texels along an edge, 2 to 512.

    Raises:
        ValueError: If the mapping is unknown or the resolution out of range.
    """

    mapping: Mapping = "parabolic"
    resolution: int = 32

    def __post_init__(self) -> None:
        if self.mapping not in get_args(Mapping):
            raise ValueError(f"expected a mapping of {get_args(Mapping)}, got {self.mapping!r}")
        if not 2 <= self.resolution <= _MOST_TEXELS:
            raise ValueError(f"expected 2 to {_MOST_TEXELS} texels an edge, got {self.resolution}")

    @property
    def num_texels(self) -> int:
        """``resolution**2``, corners without a direction included."""
        return self.resolution * self.resolution

    def coordinates(self, directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Column and row coordinates in 0..1 of unit directions; finite gradients everywhere."""
        x, y, z = to_horizon(directions).unbind(-1)
        return torch.stack(self._plane(x, y, z), dim=-1) / 2 + 0.5

    def _plane(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Coordinates across and down in -1..1 of directions above the horizon."""
        match self.mapping:
            case "parabolic":
                scale = 1 / (1 + z)
                return x * scale, y * scale
            case "orthographic":
                return x, y
            case "concentric":
                scale = torch.rsqrt(1 + z)
                return _disk_to_square(x * scale, y * scale)
            case "polar":
                return _azimuth(x, y) / math.pi, 2 * _safe_sqrt(1 - z) - 1

    def directions(
        self, coordinates: Float[Tensor, "*batch 2"]
    ) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """The inverse: unit directions, and where there is one (the normal stands elsewhere)."""
        across, down = (2 * coordinates - 1).unbind(-1)
        match self.mapping:
            case "parabolic":
                squared = across * across + down * down
                x, y = 2 * across / (1 + squared), 2 * down / (1 + squared)
            case "orthographic":
                squared = across * across + down * down
                x, y = across, down
            case "concentric":
                u, v = _square_to_disk(across, down)
                squared = u * u + v * v
                x, y = u * (2 - squared).sqrt(), v * (2 - squared).sqrt()
            case "polar":
                root = (down + 1) / 2
                level = root * (2 - root * root).clamp_min(0).sqrt()
                x, y = level * (math.pi * across).cos(), level * (math.pi * across).sin()
                squared = torch.zeros_like(x)
        inside = squared < 1
        zero = torch.zeros_like(x)
        x, y = torch.where(inside, x, zero), torch.where(inside, y, zero)
        z = (1 - x * x - y * y).clamp_min(0).sqrt()
        return torch.stack([x, y, z], dim=-1), inside

    def centres(
        self, supersampling: int = 1
    ) -> tuple[Float[Tensor, "texels 3"], Bool[Tensor, "texels"]]:
        """Directions of texel centres, row by row, float64, and which of them have one.

        Args:
            supersampling: Texels are cut into so many along an edge first.
        """
        count = self.resolution * supersampling
        steps = (torch.arange(count, dtype=torch.float64) + 0.5) / count
        down, across = torch.meshgrid(steps, steps, indexing="ij")
        directions, inside = self.directions(torch.stack([across, down], -1).reshape(-1, 2))
        return directions, inside

    def nodes(
        self, supersampling: int = 2
    ) -> tuple[Float[Tensor, "nodes 3"], Float[Tensor, "nodes"]]:
        """Quadrature over the hemisphere: directions and solid angles [sr] that sum to 2π, float64.

        Sub-texel centres with the area that the mapping gives them.
        """
        directions, inside = self.centres(supersampling)
        directions = directions[inside]
        z = directions[:, 2]
        match self.mapping:
            case "parabolic":
                density = (1 + z) ** 2
            case "orthographic":
                density = 1 / z.clamp_min(1e-3)
            case "concentric":
                density = torch.ones_like(z)
            case "polar":
                density = _safe_sqrt(1 - z)
        return directions, density * (2 * math.pi / density.sum())

    def cells(
        self, x: Float[Tensor, "*batch"], y: Float[Tensor, "*batch"], z: Float[Tensor, "*batch"]
    ) -> tuple[Int[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """Where directions above the horizon lie among the texels of :meth:`pad`.

        Returns:
            The upper left of the four texels that a lookup mixes, and the shares of its right and
            of its lower neighbours, which are 1 and ``resolution + 1`` texels on.
        """
        across, down = self._plane(x, y, z)
        half, last = self.resolution / 2, self.resolution - 1
        across, down = across * half + (half - 0.5), down * half + (half - 0.5)
        if self.mapping == "polar":
            across = across.remainder(self.resolution)
            left = across.floor().clamp_max(last)
        else:
            across = across.clamp(0, last)
            left = across.floor().clamp_max(last - 1)
        down = down.clamp(0, last)
        top = down.floor().clamp_max(last - 1)
        return (top * (self.resolution + 1) + left).long(), across - left, down - top

    def pad(self, texels: Float[Tensor, "*rows texels"]) -> Float[Tensor, "*rows padded"]:
        """Texels with the first column of each line repeated at its end, where azimuths wrap."""
        square = texels.unflatten(-1, (self.resolution, self.resolution))
        return torch.cat([square, square[..., :1]], dim=-1).flatten(-2)

    def taps(
        self, directions: Float[Tensor, "*batch 3"]
    ) -> tuple[Int[Tensor, "*batch 4"], Float[Tensor, "*batch 4"]]:
        """The four texels that a bilinear lookup mixes, and how much of each; weights sum to 1."""
        cell, right, lower = self.cells(*to_horizon(directions).unbind(-1))
        line, column = cell // (self.resolution + 1), cell % (self.resolution + 1)
        columns = torch.stack([column, (column + 1) % self.resolution], -1)
        lines = torch.stack([line, line + 1], -1)
        indices = (lines[..., :, None] * self.resolution + columns[..., None, :]).flatten(-2)
        return indices, _bilinear(right, lower)

    def lookup(
        self, texels: Float[Tensor, "rows texels"], directions: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch rows"]:
        """Bilinear values of several maps; differentiable in texels and directions."""
        cell, right, lower = self.cells(*to_horizon(directions).unbind(-1))
        line = self.resolution + 1
        steps = torch.tensor([0, 1, line, line + 1], device=cell.device)
        weights = _bilinear(right, lower).to(texels)
        indices, padded = cell[..., None] + steps, self.pad(texels).mT
        if torch.is_grad_enabled() and (texels.requires_grad or directions.requires_grad):
            return (padded[indices] * weights[..., None]).sum(-2)
        # The same, without writing what it gathers.
        found = torch.nn.functional.embedding_bag(
            indices.reshape(-1, 4),
            padded.detach().contiguous(),
            mode="sum",
            per_sample_weights=weights.reshape(-1, 4),
        )
        return found.view(*directions.shape[:-1], len(texels))


def _bilinear(
    right: Float[Tensor, "*batch"], lower: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 4"]:
    """Weights of four texels, line by line, by the shares of the right and of the lower ones."""
    shares = torch.stack([1 - right, right], -1)
    heights = torch.stack([1 - lower, lower], -1)
    return (heights[..., :, None] * shares[..., None, :]).flatten(-2)


def _safe_sqrt(values: Tensor) -> Tensor:
    """Square root of what should not be negative, with a zero gradient at zero."""
    positive = values > 0
    return torch.where(positive, torch.where(positive, values, 1.0).sqrt(), 0.0)


def _azimuth(x: Tensor, y: Tensor) -> Tensor:
    """atan2 in -π..π; 0 with a zero gradient at the pole."""
    pole = (x == 0) & (y == 0)
    return torch.atan2(torch.where(pole, 0.0, y), torch.where(pole, 1.0, x))


def _disk_to_square(u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Concentric rings of the unit disk to those of the square -1..1, keeping ratios of areas."""
    radius = _safe_sqrt(u * u + v * v)
    wide = u.abs() >= v.abs()
    major, minor = torch.where(wide, u, v), torch.where(wide, v, u)
    centre = major == 0
    slope = torch.atan(minor / torch.where(centre, 1.0, major).abs()) * (4 / math.pi)
    edge = torch.where(major < 0, -radius, radius)
    other = radius * slope
    return torch.where(wide, edge, other), torch.where(wide, other, edge)


def _square_to_disk(across: Tensor, down: Tensor) -> tuple[Tensor, Tensor]:
    wide = across.abs() >= down.abs()
    edge, other = torch.where(wide, across, down), torch.where(wide, down, across)
    angle = other / torch.where(edge == 0, 1.0, edge) * (math.pi / 4)
    near, far = edge * angle.cos(), edge * angle.sin()
    return torch.where(wide, near, far), torch.where(wide, far, near)
