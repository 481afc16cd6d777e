"""Matrix products in which what a row gets does not depend on where it is or on how many there are.

Libraries multiply rows by the block and add up what is left over in another order. Clusters are
chosen by comparing what points lose in them, so a point in another chunk, or on another process,
could fall into another cluster. Rows and columns filled up with zeros to whole blocks, in one
layout, are rounded alike wherever they are. The numbers were found by trial, with MKL; with another
library results remain right, but chunks may change choices between near-equal clusters.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

STEADY_ROWS = 16
"""Blocks of rows."""

_STEADY_COLUMNS = 4


def steady_product(
    rows: Float[Tensor, "rows a"], factor: Float[Tensor, "a *b"]
) -> Float[Tensor, "rows *b"]:
    """A product in which what a row gets does not depend on its place or on how many there are.

    So points fall into the same clusters whatever the chunk, or the process, that they are in.

    Args:
        rows: Of points.
        factor: A matrix or a vector.
    """
    filled = filled_up(factor) if factor.ndim == 2 else factor
    beyond = len(rows) % STEADY_ROWS
    whole = len(rows) - beyond
    out = rows.new_empty(len(rows), *filled.shape[1:])
    torch.matmul(rows[:whole], filled, out=out[:whole])
    if beyond:
        out[whole:] = (pad(rows[whole:], (0, 0, 0, STEADY_ROWS - beyond)) @ filled)[:beyond]
    return out if factor.ndim == 1 else out[:, : factor.shape[1]]


def filled_up(matrices: Float[Tensor, "*some a b"]) -> Float[Tensor, "*some a b_or_more"]:
    """Row after row, with columns of zeros up to a number that products are steady with.

    Products with another layout of the same matrix are rounded in another way, and so are those
    with a number of columns that leaves some over.
    """
    beyond = -matrices.shape[-1] % _STEADY_COLUMNS
    if beyond:
        return pad(matrices, (0, beyond))
    # ``contiguous`` would leave the strides of dimensions of size 1 as they are, which count too.
    plain = matrices.stride() == torch.empty(matrices.shape, device="meta").stride()
    return matrices if plain else laid_out(matrices)


def laid_out(matrices: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """A copy, row after row."""
    return matrices.clone(memory_format=torch.contiguous_format)
