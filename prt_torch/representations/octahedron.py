"""Directions as two codes of 16 bits: the sphere unfolded over an octahedron.

Codes are spread evenly over the sphere: 7e-5 rad at most lie between a direction and its code.

Source:
    Meyer, Süßmuth, Sußner, Stamminger, Greiner 2010, "On Floating-Point Normal Vectors".
"""

import torch
from jaxtyping import Float, Int, Int16
from torch import Tensor

from prt_torch.quantize import quantize

BITS = 16


def to_octahedron(
    directions: Float[Tensor, "*batch 3"], bits: Int[Tensor, "..."] | int = BITS
) -> Int16[Tensor, "*batch 2"]:
    """Directions, of any length but zero, on the unfolded octahedron, at the nearest codes.

    Where two codes stand for one direction, along the edges of the lower half, signs of zeros tell
    them apart, so that codes of decoded codes are the same codes.

    Args:
        directions: The directions.
        bits: Of each of the two codes, 2 to 16; may differ by direction.
    """
    directions = directions.detach().double()
    x, y, z = (directions / directions.abs().sum(-1, keepdim=True)).unbind(-1)
    below = z < 0
    folded_x, folded_y = torch.copysign(1.0 - y.abs(), x), torch.copysign(1.0 - x.abs(), y)
    flat = torch.stack([torch.where(below, folded_x, x), torch.where(below, folded_y, y)], dim=-1)
    return quantize(flat, 1.0 / _largest(bits, flat), BITS)


def from_octahedron(
    codes: Int[Tensor, "*batch 2"], dtype: torch.dtype, bits: Int[Tensor, "..."] | int = BITS
) -> Float[Tensor, "*batch 3"]:
    """The unit vectors that codes of so many bits stand for."""
    x, y = (codes.double() / _largest(bits, codes)).unbind(-1)
    z = 1.0 - x.abs() - y.abs()
    below = z < 0
    unfolded_x, unfolded_y = torch.copysign(1.0 - y.abs(), x), torch.copysign(1.0 - x.abs(), y)
    x, y = torch.where(below, unfolded_x, x), torch.where(below, unfolded_y, y)
    return torch.nn.functional.normalize(torch.stack([x, y, z], dim=-1), dim=-1).to(dtype)


def _largest(bits: Int[Tensor, "..."] | int, like: Tensor) -> Float[Tensor, "... 1"]:
    """The code of 1."""
    widths = torch.as_tensor(bits, device=like.device)
    return torch.exp2(widths.double() - 1.0)[..., None] - 1.0
