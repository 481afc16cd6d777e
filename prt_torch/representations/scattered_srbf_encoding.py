"""How scattered functions of clusters are found.

1. Transfer is read by blocks and kept in the principal axes of view and light that matter
   (:mod:`prt_torch.representations.clustered_tensor_projection`); points are clustered there.
2. A few principal vectors of each cluster, by their size, become functions of direction at texels,
   and the cluster's functions are fitted to them side by side, as colours of one light.
3. Functions are rounded to what a file holds; then weights are the least-squares ones, of the
   transfer itself, so that they make up for the rounding.

Source:
    Tsai, Shih 2006, section 5.3 for step 2; the rest is ours.
"""

from contextlib import nullcontext
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from prt_torch.bases import LightBasis
from prt_torch.bases.srbf_fitting import Descent, seeds
from prt_torch.bases.srbf_kernels import gaussian
from prt_torch.bases.srbf_objective import TexelObjective, bandwidths_from_widths
from prt_torch.errors import InputError
from prt_torch.metric import Metric
from prt_torch.representations.clustered_tensor_projection import (
    Projection,
    project,
    read_moments,
)
from prt_torch.representations.cpca_clusters import vector_quantise
from prt_torch.representations.cpca_subspaces import one_thread, principal
from prt_torch.representations.grouped import sort_labels
from prt_torch.representations.scattered_srbf_coding import (
    Parameters,
    ScatteredEncoding,
    rounded_functions,
)
from prt_torch.sphere import cubemap_directions, cubemap_solid_angles
from prt_torch.transfer import TransferTensor

_SUBSPACE = 8  # vectors of a cluster's transfer that its functions are fitted to
_PROJECTION_LOSS = 1e-4  # of the energy, that each mode may lose to the projection
_ROUNDS, _ROUND_STEPS, _LAST_STEPS, _TOLERANCE = 3, 3, 8, 1e-3
_MOVED = 0.25  # share of functions that a relocation moves
_RELATIVE_CUTOFF = 1e-7  # of singular values, in the solve for weights
_CLUSTERS_AT_ONCE = 16
_FIT_COPIES = 24  # of a cluster's functions at texels, that a step of its fit makes
_SEED_BYTES = 40  # of a pair of texels of the map that seeds are taken from
_TABLE_COPIES = 4  # of the texels that are expanded at once
_SAMPLED_VALUES = 2**22  # of functions at texels at once
_SMALL = 2**14  # values of a cluster's functions at texels
_BLOCK_BYTES = 2**26  # of transfer that is solved for at once


def encode(
    transfer: TransferTensor,
    basis: LightBasis,
    *,
    num_clusters: int,
    num_functions: int,
    resolution: int,
    coded: bool,
    memory_budget: int,
    metric: Metric,
    generator: torch.Generator,
) -> ScatteredEncoding:
    """Clusters, functions and weights; ``coded`` as a file of codes holds them.

    Raises:
        InputError: If the fit of one cluster would take more than ``memory_budget``.
    """
    clusters_at_once = _affordable(num_functions, resolution, memory_budget)
    moments = read_moments(transfer, metric)
    found = project(
        transfer,
        metric,
        moments,
        allowed=_PROJECTION_LOSS * moments.squared_norm,
        least=(1, min(_SUBSPACE, transfer.num_coeffs)),
        memory_budget=memory_budget,
    )
    labels, made = vector_quantise(found.points.flatten(1), num_clusters, generator, rough=False)
    labels, _ = sort_labels(labels, made)
    subspaces = _subspaces(found, labels, made, metric, basis, resolution, memory_budget)
    # Threads that wait for one another cost more than a small fit.
    small = subspaces.shape[1] * num_functions < _SMALL
    with one_thread() if small else nullcontext():
        fitted = [_fit(some, num_functions) for some in subspaces.split(clusters_at_once)]
    dtype = torch.promote_types(transfer.values.dtype, torch.float32)
    centers, log_bandwidths = (torch.cat(parts).to(dtype) for parts in zip(*fitted, strict=True))
    if coded:
        centers, log_bandwidths = rounded_functions(centers, log_bandwidths)
    functions = in_light_basis(basis, centers.double(), log_bandwidths.double(), resolution)
    weights, condition = _solve(functions, transfer, labels, metric, dtype)
    parameters = Parameters(centers, log_bandwidths, weights)
    encoding = ScatteredEncoding(labels, parameters, None, resolution, condition)
    return encoding.coded() if coded else encoding


def _affordable(num_functions: int, resolution: int, memory_budget: int) -> int:
    """How many clusters may be fitted side by side.

    Raises:
        InputError: If not even one.
    """
    texels = 6 * resolution**2
    seed_texels = texels // 4 if resolution % 2 == 0 else texels
    one = _FIT_COPIES * texels * num_functions * 8
    needed = max(one, _SEED_BYTES * seed_texels**2)
    if needed > memory_budget:
        raise InputError(
            f"memory_budget: expected at least {needed} bytes for {num_functions} functions at a "
            f"resolution of {resolution}, got {memory_budget}"
        )
    return min(_CLUSTERS_AT_ONCE, memory_budget // one)


def in_light_basis(
    basis: LightBasis,
    centers: Float[Tensor, "clusters n 3"],
    log_bandwidths: Float[Tensor, "clusters n"],
    resolution: int,
) -> Float[Tensor, "clusters n coeffs"]:
    """Gaussians as expansion coefficients of a light basis, sampled at texels; differentiable.

    Args:
        basis: The light basis.
        centers: Of any length but zero.
        log_bandwidths: Logarithms of their bandwidths.
        resolution: Texels along an edge of a face.
    """
    directions = cubemap_directions(resolution, dtype=torch.float64).view(-1, 3).to(centers)
    solid_angles = cubemap_solid_angles(resolution, dtype=torch.float64).flatten().to(centers)
    centers = nn.functional.normalize(centers, dim=-1)
    at_once = max(1, _SAMPLED_VALUES // (centers.shape[1] * len(directions)))
    pieces = []
    for some, logarithms in zip(centers.split(at_once), log_bandwidths.split(at_once), strict=True):
        values = gaussian(directions, some, logarithms.exp()).mT * solid_angles
        pieces.append(basis.project_cube(values.flatten(0, 1), resolution).to(centers))
    return torch.cat(pieces).unflatten(0, centers.shape[:2])


def _subspaces(
    found: Projection,
    labels: Int[Tensor, "points"],
    num_clusters: int,
    metric: Metric,
    basis: LightBasis,
    resolution: int,
    memory_budget: int,
) -> Float[Tensor, "clusters texels vectors"]:
    """Functions of direction that span most of each cluster's transfer, by their size."""
    vectors = []
    for cluster in range(num_clusters):
        rows = found.points[labels == cluster].flatten(0, 1).double()
        singular, directions = principal(rows[None], min(_SUBSPACE, rows.shape[1]))
        vectors.append(singular[0, :, None] * directions[0])
    weighed = torch.stack(vectors) @ found.light_axes.mT
    of_light = _of_light(metric)
    coefficients = of_light.unweigh(weighed)
    at_texels = _at_texels(coefficients.flatten(0, 1), basis, resolution, memory_budget)
    return at_texels.unflatten(0, weighed.shape[:2]).mT


def _at_texels(
    coefficients: Float[Tensor, "functions coeffs"],
    basis: LightBasis,
    resolution: int,
    memory_budget: int,
) -> Float[Tensor, "functions texels"]:
    """Values at the centres of texels.

    A weighed function times the weighed expansion of a texel is the function's value there.
    """
    weighed, texels = basis.weigh(coefficients), 6 * resolution**2
    at_once = max(1, min(texels, memory_budget // (_TABLE_COPIES * 8 * texels)))
    pieces = []
    for some in torch.arange(texels, device=weighed.device).split(at_once):
        single = weighed.new_zeros(len(some), texels)
        single[torch.arange(len(some), device=some.device), some] = 1.0
        pieces.append(weighed @ basis.weigh(basis.project_cube(single, resolution)).mT)
    return torch.cat(pieces, dim=1)


def _of_light(metric: Metric) -> Metric:
    """Its light side: rows of transfer are solved one by one."""
    return replace(metric, row_factor=torch.ones(1, 1, dtype=torch.float64))


def _fit(subspaces: Tensor, num_functions: int) -> tuple[Tensor, Tensor]:
    """Centres and log bandwidths of several clusters' functions."""
    objective = TexelObjective(subspaces, "gaussian")
    descent = Descent(objective, *seeds(objective, num_functions))
    for _ in range(_ROUNDS):
        descent.run(_ROUND_STEPS, _TOLERANCE)
        descent.move(max(1, int(_MOVED * num_functions)))
    descent.run(_LAST_STEPS, _TOLERANCE)
    best = descent.best
    return best.centers, bandwidths_from_widths(best.log_widths.exp(), "gaussian").log()


def _solve(
    functions: Float[Tensor, "clusters n coeffs"],
    transfer: TransferTensor,
    labels: Int[Tensor, "points"],
    metric: Metric,
    dtype: torch.dtype,
) -> tuple[Float[Tensor, "points channels rows n"], float]:
    """Weights of least error, the shortest ones where functions are dependent; and the condition.

    The condition is that of the worst cluster, below the cut-off.
    """
    of_light = _of_light(metric)
    with one_thread():
        left, singular, right = torch.linalg.svd(of_light.weigh(functions), full_matrices=False)
    used = singular > _RELATIVE_CUTOFF * singular[:, :1]
    reciprocal = torch.where(used, 1.0 / torch.where(used, singular, 1.0), 0.0)
    solve = (right.mT * reciprocal[:, None]) @ left.mT  # clusters coeffs n
    shape = (*transfer.values.shape[:3], functions.shape[1])
    weights = torch.empty(shape, dtype=dtype, device=functions.device)
    for rows, values in transfer.blocks(_BLOCK_BYTES):
        weighed, own = of_light.weigh(values.double()), labels[rows]
        block = weights[rows]
        for cluster in own.unique().tolist():
            some = own == cluster
            block[some] = (weighed[some] @ solve[cluster]).to(dtype)
    least = torch.where(used, singular, torch.inf).amin(1)
    return weights, float((singular[:, 0] / least).max())
