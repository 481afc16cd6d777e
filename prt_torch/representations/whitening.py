"""Orthonormal columns found from their products with each other, for columns too long to be held.

The columns' Gram matrix is a sum over rows, so it can be had from chunks and from several
processes. Columns are scaled to one length first, which keeps the digits of weak ones beside strong
ones, where a Gram matrix as it is would lose what is below 1e-8 of the largest.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.representations.cpca_subspaces import one_thread


def whitening(gram: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch n n"]:
    """A matrix T for which ``T^T G T`` is the identity.

    So ``columns @ T`` are orthonormal, the strongest last; in front are zeros where G has no more.

    Args:
        gram: Products of the columns with each other, float64.
    """
    lengths = gram.diagonal(dim1=-2, dim2=-1).clamp_min(0.0).sqrt()
    scale = torch.where(lengths > 0, 1.0 / lengths, 0.0)
    with one_thread():
        values, turn = torch.linalg.eigh(scale[..., None] * gram * scale[..., None, :])
    resolution = torch.finfo(values.dtype).eps * values.shape[-1] * values[..., -1:]
    kept = values > resolution
    roots = kept / torch.where(kept, values, 1.0).sqrt()
    return scale[..., None] * turn * roots[..., None, :]
