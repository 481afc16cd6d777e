"""Directions that a closed form was asked for and its data do not determine.

A cluster of a few points has no fourth principal vector, and functions that coincide cannot be told
apart by any weights. Constructions then drop directions and lose nothing, but a fit that says so is
honest, and the bytes of those directions are better spent elsewhere. What is dropped can be seen in
the parameters: vectors of zeros, and functions that are combinations of others.
"""

import torch
from jaxtyping import Bool
from torch import Tensor

from prt_torch.representations.base import Representation
from prt_torch.representations.clustered_tensor import ClusteredTensor
from prt_torch.representations.cpca import CPCA
from prt_torch.representations.scattered_srbf import ScatteredSRBF
from prt_torch.representations.scattered_srbf_encoding import RELATIVE_CUTOFF, in_light_basis


@torch.no_grad()
def undetermined(representation: Representation) -> int:
    """How many vectors or functions, of all clusters, hold nothing.

    Other kinds drop none: lobes have a ridge, segments give up what they have no use for, and the
    rest solve nothing.
    """
    match representation:
        case CPCA():
            empty = representation.representatives.flatten(1) == 0
            return int((empty.all(1) & ~_means(representation)).sum())
        case ClusteredTensor():
            return int((representation.cores.flatten(2) == 0).all(2).sum())
        case ScatteredSRBF():
            return _dependent_functions(representation)
        case _:
            return 0


def _means(model: CPCA) -> Bool[Tensor, "vectors"]:
    """Which representatives are means: the first of each cluster, if it has one."""
    lengths = model.ranks + int(model.affine)
    means = torch.zeros(len(model.representatives), dtype=torch.bool, device=lengths.device)
    if model.affine:
        means[lengths.cumsum(0) - lengths] = True
    return means


def _dependent_functions(model: ScatteredSRBF) -> int:
    """Functions less the rank of their matrix, as the solve for weights counts it."""
    basis = model.surface.light_basis
    if basis is None:
        raise ValueError("expected scattered functions with a light basis, got none")
    centers, log_bandwidths = model.centers.double(), model.log_bandwidths.double()
    functions = in_light_basis(basis, centers, log_bandwidths, model.resolution)
    singular = torch.linalg.svdvals(basis.weigh(functions))
    used = singular > RELATIVE_CUTOFF * singular[:, :1]
    return functions.shape[0] * functions.shape[1] - int(used.sum())
