r"""Smaller representations read off a larger one: what makes a sweep nested.

A closed form of many vectors holds closed forms of few: principal vectors come by falling singular
value, the largest terms of a wavelet are among its more terms, and a Tucker decomposition in its
own principal axes can be cut in every mode. None of these goes back to the transfer for its points,
so a reading costs a small part of a fit. What is read keeps the clusters of the larger fit, which
were chosen for more vectors than it has: that costs error, the more the further one reads
(docs/sweeps.md has figures), so :mod:`prt_torch.nesting` fits anew where it gets far.

Source:
    Sloan, Hall, Hart, Snyder 2003, section 4.2 (vectors are added to clusters that stay); De
    Lathauwer, De Moor, Vandewalle 2000, "A multilinear singular value decomposition" (cutting
    every mode); Chen, Billings, Luo 1989, "Orthogonal least squares methods" (choosing functions).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from prt_torch.metric import Metric
from prt_torch.representations import CPCA, ClusteredTensor, SegmentedCPCA, WaveletTransfer
from prt_torch.representations.clustered_tensor_coding import Encoding as TensorEncoding
from prt_torch.representations.clustered_tensor_coding import Parameters as TensorParameters
from prt_torch.representations.cpca_encoding import Encoding
from prt_torch.representations.cpca_subspaces import one_thread
from prt_torch.representations.scattered_srbf import ScatteredSRBF
from prt_torch.representations.scattered_srbf_coding import Parameters, ScatteredEncoding
from prt_torch.representations.segmented_encoding import FIRST, RAW, segment_metric
from prt_torch.representations.segmented_quantisation import Encoding as SegmentedEncoding
from prt_torch.representations.segmented_quantisation import quantisation_step
from prt_torch.representations.wavelet import Coding
from prt_torch.representations.wavelet_selection import SparseTerms
from prt_torch.transfer import TransferTensor

_BLOCK_BYTES = 2**25
_CUTOFF = 1e-7  # of singular values, as in the closed form of scattered functions


@torch.no_grad()
def fewer_vectors(model: CPCA, rank: int) -> CPCA:
    """Each cluster's first vectors, the largest ones.

    Args:
        model: As its closed form left it, all clusters of one rank.
        rank: At most that of ``model``.

    Raises:
        ValueError: If ranks differ by cluster, or ``rank`` is larger than theirs.
    """
    if not model.layout.uniform or rank > model.layout.max_rank:
        raise ValueError(f"expected clusters of one rank of at least {rank}, got {model.rank}")
    kept = model.layout.by_cluster(model.representatives)[:, : rank + model.affine]
    weights = model.layout.by_point(model.weights)[:, :rank]
    encoding = Encoding(
        labels=model.labels,
        ranks=torch.full_like(model.ranks, rank),
        representatives=kept.flatten(0, 1).flatten(1),
        weights=weights.flatten(),
        affine=model.affine,
        condition=_condition(_norms(weights, model.labels, model.num_clusters)),
    )
    return CPCA(encoding, model.surface, model.shape)


def _norms(
    weights: Float[Tensor, "points rank"], labels: Int[Tensor, "points"], num_clusters: int
) -> Float[Tensor, "clusters rank"]:
    """Norms of weights over each cluster's points, float64: singular values, for unit vectors."""
    squares = weights.double().square()
    total = squares.new_zeros(num_clusters, weights.shape[1]).index_add_(0, labels, squares)
    return total.sqrt()


def _condition(singular: Float[Tensor, "clusters rank"]) -> float:
    """Largest over smallest nonzero singular value, of the worst cluster."""
    if singular.shape[1] == 0:
        return 1.0
    smallest = torch.where(singular > 0, singular, torch.inf).amin(1)
    return float((singular.amax(1) / smallest).max().clamp_min(1.0))


@torch.no_grad()
def fewer_terms(model: WaveletTransfer, num_terms: int) -> WaveletTransfer:
    """The largest terms of each point and row; steps of codes stay, as the largest term does.

    Args:
        model: As its closed form left it.
        num_terms: At most that of ``model``.

    Raises:
        ValueError: If ``model`` has fewer terms.
    """
    if num_terms > model.num_terms:
        raise ValueError(f"expected at most {model.num_terms} terms, got {num_terms}")
    magnitudes = torch.linalg.vector_norm(model.values, dim=-1)
    largest = magnitudes.topk(min(num_terms, magnitudes.shape[-1]), sorted=False).indices
    kept = torch.zeros_like(magnitudes, dtype=torch.bool).scatter_(-1, largest, True)
    terms = SparseTerms(model.indices, torch.where(kept[..., None], model.values, 0.0))
    return WaveletTransfer(
        terms.without_zeros(),
        Coding(model.codes, model.steps),
        model.surface,
        model.shape,
        num_terms=num_terms,
        light_threshold=model.light_threshold,
    )


@torch.no_grad()
def smaller_tensor(model: ClusteredTensor, ranks: Sequence[int]) -> ClusteredTensor:
    """Clusters' tensors cut in all three modes, each in its own principal axes.

    The view basis that clusters of a group share is cut first, then each cluster's points, then its
    light, every mode in what is left by those before; the points come last once more, so that the
    dual bases are orthonormal.

    Args:
        model: As its closed form left it.
        ranks: Of rows, light coefficients and points; no more of any than ``model`` has is kept.
    """
    view_rank, light_rank, point_rank = _capped(ranks)
    own = TensorParameters(**{name: getattr(model, name) for name in TensorParameters.names()})
    norms = _norms(own.weights, model.labels, model.num_clusters)
    cores = own.cores.double() * norms[:, :, None, None]  # clusters, rank, view, light
    view_basis, turned = [], torch.zeros_like(cores[:, :, :view_rank])
    for group, basis in enumerate(own.view_basis.double()):
        some = model.groups == group
        axes = _principal_axes(cores[some].movedim(2, 0).flatten(1), view_rank)
        view_basis.append(basis @ axes)
        turned[some, :, : axes.shape[1]] = torch.einsum("cpvl,va->cpal", cores[some], axes)
    first = _principal_points(turned, point_rank)
    axes = _principal_axes(first.cores.movedim(3, 1).flatten(2), light_rank)
    light_bases = axes.mT @ own.light_bases.double()
    last = _principal_points(first.cores @ axes[:, None], point_rank)
    unit = own.weights.double() / torch.where(norms > 0, norms, 1.0)[model.labels]
    blocks = model.blocks
    turn = first.turn @ (last.turn * last.singular[:, None])
    weights = blocks.to_points(blocks.matmul(blocks.to_slots(unit), turn))
    dtype = own.cores.dtype
    parameters = TensorParameters(
        view_basis=torch.stack(view_basis).to(dtype),
        light_bases=light_bases.to(dtype),
        cores=last.dual.unflatten(2, (turned.shape[2], -1)).to(dtype),
        weights=weights.to(dtype),
    )
    condition = _condition(last.singular)
    encoding = TensorEncoding(model.labels, model.groups, parameters, None, condition)
    coded = encoding if model.bits is None else encoding.coded()
    return ClusteredTensor(coded, model.surface, model.shape)


@dataclass(frozen=True)
class _Points:
    """The mode of the points in its principal axes: cores are ``turn @ singular * dual``."""

    turn: Float[Tensor, "clusters rank kept"]
    singular: Float[Tensor, "clusters kept"]
    dual: Float[Tensor, "clusters kept view_times_light"]
    cores: Float[Tensor, "clusters kept view light"]


def _principal_points(cores: Float[Tensor, "clusters rank view light"], count: int) -> _Points:
    """The first axes of the points, and the cores along them."""
    with one_thread():
        left, singular, right = torch.linalg.svd(cores.flatten(2), full_matrices=False)
    turn, singular, dual = left[:, :, :count], singular[:, :count], right[:, :count]
    kept = (singular[:, :, None] * dual).unflatten(2, cores.shape[2:])
    return _Points(turn, singular, dual, kept)


def _capped(ranks: Sequence[int]) -> tuple[int, int, int]:
    """No mode has more than the product of the other two: more would hold nothing."""
    view, light, points = ranks
    light = min(light, view * points)
    return view, light, min(points, view * light)


def _principal_axes(
    rows: Float[Tensor, "*clusters size others"], count: int
) -> Float[Tensor, "*clusters size kept"]:
    """Orthonormal axes of most energy of the first dimension."""
    with one_thread():
        axes = torch.linalg.eigh(rows @ rows.mT)[1]
    return axes.flip(-1)[..., :count]


@torch.no_grad()
def fewer_functions(model: ScatteredSRBF, num_functions: int, metric: Metric) -> ScatteredSRBF:
    """Those functions of each cluster that hold most of it, chosen one by one, weights fitted anew.

    The best weights for some of the functions follow from those for all of them, as what all hold
    is a projection of the transfer already.

    Args:
        model: As its closed form left it.
        num_functions: At most those of ``model``.
        metric: That it was fitted in.
    """
    own = Parameters(**{name: getattr(model, name) for name in Parameters.names()})
    light_side = replace(metric, row_factor=torch.ones(1, 1, dtype=torch.float64))
    functions = light_side.weigh(model.functions().double())
    blocks = model.blocks
    flat = blocks.to_slots(own.weights.double().flatten(1, 2))  # slots, rows, n
    moments = sum(blocks.transposed_matmul(row, row) for row in flat.unbind(1))
    chosen = _most_held(functions, torch.as_tensor(moments), num_functions)
    kept = functions.gather(1, chosen[..., None].expand(-1, -1, functions.shape[2]))
    with one_thread():
        solve = functions @ torch.linalg.pinv(kept, rtol=_CUTOFF)  # clusters, n, kept
        singular = torch.linalg.svdvals(kept)
    weights = blocks.to_points(blocks.matmul(flat, solve))
    parameters = Parameters(
        centers=own.centers.gather(1, chosen[..., None].expand(-1, -1, 3)),
        log_bandwidths=own.log_bandwidths.gather(1, chosen),
        weights=weights.unflatten(1, own.weights.shape[1:3]).to(own.weights.dtype),
    )
    used = singular * (singular > _CUTOFF * singular[:, :1])
    encoding = ScatteredEncoding(model.labels, parameters, None, model.resolution, _condition(used))
    coded = encoding if model.bits is None else encoding.coded()
    return ScatteredSRBF(coded, model.surface, model.shape)


def _most_held(
    functions: Float[Tensor, "clusters n values"],
    moments: Float[Tensor, "clusters n n"],
    count: int,
) -> Int[Tensor, "clusters count"]:
    """Functions in the order in which each holds most of what those before it leave."""
    rest = functions.clone()
    norms = rest.square().sum(2)
    cluster = torch.arange(len(rest), device=rest.device)
    free = torch.ones_like(norms, dtype=torch.bool)
    chosen = []
    for _ in range(count):
        along = functions @ rest.mT
        gains = (along * (moments @ along)).sum(1)
        lengths = rest.square().sum(2)
        usable = free & (lengths > 1e-14 * norms)
        gains = torch.where(usable, gains / torch.where(usable, lengths, 1.0), -1.0)
        gains = torch.where(free, gains, -2.0)  # all dependent: any that is left
        best = gains.argmax(1)
        chosen.append(best)
        free[cluster, best] = False
        unit = torch.nn.functional.normalize(rest[cluster, best], dim=1)
        rest = rest - (rest @ unit[:, :, None]) * unit[:, None]
    return torch.stack(chosen, dim=1)


@torch.no_grad()
def fewer_segment_vectors(
    model: SegmentedCPCA, rank: int, transfer: TransferTensor, metric: Metric, share: float
) -> SegmentedCPCA:
    """Each cluster's first vectors in every segment, in codes whose steps suit the larger error.

    Args:
        model: As its closed form left it.
        rank: Vectors of a cluster at most.
        transfer: That it was fitted to; read once, for the error of each segment.
        metric: That it was fitted in.
        share: Of the squared error of a segment that rounding may add.
    """
    fine = _cut_segments(model, rank)
    size = transfer.num_coeffs // model.num_segments
    metrics = [
        segment_metric(metric, slice(start, start + size), transfer.num_coeffs)
        for start in range(0, transfer.num_coeffs, size)
    ]
    errors = _segment_errors(SegmentedCPCA(fine, model.surface, model.shape), transfer, metrics)
    vectors = fine.representatives.split(fine.vectors.tolist())
    steps = [
        quantisation_step(own, local, share * error, fine.bits)
        for own, local, error in zip(vectors, metrics, errors, strict=True)
    ]
    finest = fine.representative_steps
    steps = torch.maximum(torch.tensor(steps).to(finest), finest)
    condition = _segment_condition(fine, metrics)
    coded = replace(fine, representative_steps=steps, condition=condition).rounded()
    return SegmentedCPCA(coded, model.surface, model.shape)


def _cut_segments(model: SegmentedCPCA, rank: int) -> SegmentedEncoding:
    """The first vectors of each cluster and their weights; points that are kept as such stay."""
    vectors = []
    ranks = model.ranks.split(model.clusters.tolist())
    for labels, own in zip(model.labels, ranks, strict=True):
        raw = torch.ones(int((labels == RAW).sum()), dtype=torch.bool, device=own.device)
        vectors.append(torch.cat([_first(own, rank), raw]))
    first = model.clusters.cumsum(0) - model.clusters
    of_points = (model.labels.long() - FIRST + first[:, None])[model.labels >= FIRST]
    return SegmentedEncoding(
        labels=model.labels,
        ranks=model.ranks.clamp_max(rank),
        clusters=model.clusters,
        representatives=model.representatives[torch.cat(vectors)],
        weights=model.weights[_first(model.ranks[of_points], rank)],
        representative_steps=model.representative_steps,
        weight_steps=model.weight_steps,
        bits=model.bits,
        condition=float("nan"),
    )


def _segment_condition(encoding: SegmentedEncoding, metrics: Sequence[Metric]) -> float:
    """Of the worst cluster; vectors are as long as their singular values."""
    worst, ranks = 1.0, encoding.ranks.split(encoding.clusters.tolist())
    vectors = encoding.representatives.split(encoding.vectors.tolist())
    for own, counts, local in zip(vectors, ranks, metrics, strict=True):
        if len(counts) == 0:
            continue
        weighed = local.weigh(own[: int(counts.sum())].double()).flatten(1)
        lengths = torch.linalg.vector_norm(weighed, dim=1).split(counts.tolist())
        kept = torch.nn.utils.rnn.pad_sequence(list(lengths), batch_first=True)
        worst = max(worst, _condition(kept))
    return worst


def _first(counts: Int[Tensor, "runs"], most: int) -> Bool[Tensor, "total"]:
    """Which of runs of so many, one after the other, are among the first of their run."""
    starts = counts.cumsum(0) - counts
    total = torch.arange(int(counts.sum()), device=counts.device)
    return total - starts.repeat_interleave(counts) < most


def _segment_errors(
    model: SegmentedCPCA, transfer: TransferTensor, metrics: Sequence[Metric]
) -> list[float]:
    """Squared error in each segment, in its metric."""
    errors = [0.0] * len(metrics)
    every = torch.arange(transfer.num_points)
    for rows, values in transfer.blocks(_BLOCK_BYTES):
        lost = (model.dense(every[rows]) - values).unflatten(-1, (len(metrics), -1))
        for place, local in enumerate(metrics):
            weighed = local.weigh(lost[..., place, :])
            errors[place] += float(weighed.square().sum(dtype=torch.float64))
    return errors
