"""Reflectance in a file: a few colours and which of them each point has, where that is less.

Most scenes have a colour or two an object, so three numbers a point would be most of a small file.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.quantize import compress, decompress

_SAME_SIZE = {2: torch.int16, 4: torch.int32, 8: torch.int64}
_ALL, _COLOURS, _CHOICES = "reflectance", "colours", "colour_of_point"


def packed_reflectance(reflectance: Float[Tensor, "points_or_one rgb"]) -> dict[str, Tensor]:
    """What a file holds of it.

    Args:
        reflectance: Linear RGB, of points or of all.

    Returns:
        ``reflectance`` as it is, or ``colours``, ``"colours rgb"``, and which of them each point
        has as a stream (:func:`prt_torch.quantize.compress`), whichever is smaller.
    """
    reflectance = reflectance.detach().contiguous()
    if len(reflectance) == 1:
        return {_ALL: reflectance}
    bits = reflectance.view(_SAME_SIZE[reflectance.itemsize])  # zeros have signs
    different, choices = bits.unique(dim=0, return_inverse=True)
    colours = different.view(reflectance.dtype)
    if colours.nbytes >= reflectance.nbytes:
        return {_ALL: reflectance}
    stream = compress(choices, signed=False)
    if colours.nbytes + stream.nbytes >= reflectance.nbytes:
        return {_ALL: reflectance}
    return {_COLOURS: colours, _CHOICES: stream}


def reflectance_bytes(reflectance: Float[Tensor, "points_or_one rgb"]) -> int:
    """Bytes of :func:`packed_reflectance`."""
    return sum(tensor.nbytes for tensor in packed_reflectance(reflectance).values())


def take_reflectance(
    packed: dict[str, Tensor], num_points: int
) -> Float[Tensor, "points_or_one rgb"]:
    """The inverse of :func:`packed_reflectance`, to the bit.

    Args:
        packed: Tensors of a file; those of the reflectance are taken out.
        num_points: How many points the file has.

    Raises:
        ValueError: If the stream is damaged.
    """
    if _ALL in packed:
        return packed.pop(_ALL)
    colours = packed.pop(_COLOURS)
    return colours[decompress(packed.pop(_CHOICES), num_points, signed=False)]
