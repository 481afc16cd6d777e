"""Orthonormal columns of many small sets of vectors at once: what orthogonal iterations step on."""

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.representations.cpca_subspaces import one_thread


def orthonormal(vectors: Float[Tensor, "*batch d count"]) -> Float[Tensor, "*batch d least"]:
    """Orthonormal columns with the same span, completed by others where that has fewer.

    There are no more of them than dimensions. Zero columns become harmless unit vectors.
    """
    scale = vectors.abs().amax((-2, -1), keepdim=True)
    with one_thread():
        return torch.linalg.qr(vectors / torch.where(scale > 0, scale, 1.0))[0]
