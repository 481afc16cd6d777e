"""Clusters given up where they are of little use, and made where they are missed.

One whose points lose least in their next best clusters is given up, and one of high error is cut
in two in its place. Both prices are known only with all other subspaces held still, where giving
up looks dearer than it is: the turns that follow adapt them. So a cut need not gain as much as
giving up costs.

Source:
    Patane, Russo 2001, "The enhanced LBG algorithm", of which this is the idea.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from prt_torch.representations.cpca_choice import Choice, Subspaces
from prt_torch.representations.cpca_clusters import refill
from prt_torch.representations.points import cluster_sums, slices

_CUT_SHARE = 0.25  # of the clusters, those of the highest error, may be cut in two
_LEAST_RETURN = 0.3  # gain of a cut over the cost of the cluster given up for it


def relocate(
    fit: Subspaces, choice: Choice, affine: bool
) -> tuple[Int[Tensor, "points"], Float[Tensor, "clusters d rank"]] | None:
    """Give up clusters of little use and cut others in two in their place, if that promises well.

    Returns:
        New labels and vectors, or nothing.
    """
    count, processes = fit.num_clusters, fit.points.processes
    error = cluster_sums(choice.labels, choice.errors, count, processes)
    parents = error.topk(max(1, int(_CUT_SHARE * count))).indices
    halves, left, vectors = _cut(fit, choice.labels, parents, affine)
    pairs = _pairs(error[parents] - left, choice.next_errors - error, parents, _heirs(fit, choice))
    if not pairs:
        return None
    places, removed = torch.tensor(pairs, device=error.device).T
    gone = torch.zeros(count, dtype=torch.bool, device=error.device)
    gone[removed] = True
    target = torch.full((2 * len(parents) + 1,), -1, device=error.device)
    target[2 * places + 1] = removed
    moved = choice.labels.clone()
    for some in slices(len(moved)):
        own = moved[some].long()
        to = target[halves[some].long()]  # the last, for points of no half, is -1 too
        own = torch.where(gone[own], choice.next_labels[some].long(), own)
        moved[some] = torch.where(to >= 0, to, own).to(moved.dtype)
    changed = fit.vectors.clone()
    changed[parents[places]], changed[removed] = vectors[2 * places], vectors[2 * places + 1]
    return refill(moved, choice.errors, count, processes), changed


def _heirs(fit: Subspaces, choice: Choice) -> Bool[Tensor, "clusters clusters"]:
    """Which clusters have points whose next best is which other."""
    heirs = torch.zeros(fit.num_clusters, fit.num_clusters, dtype=torch.float64)
    heirs = heirs.to(fit.centres.device)
    for some in slices(len(choice.labels)):
        heirs[choice.labels[some].long(), choice.next_labels[some].long()] = 1.0
    return (fit.points.processes.sum(heirs) > 0).cpu()


def _cut(
    fit: Subspaces, labels: Int[Tensor, "points"], parents: Int[Tensor, "parents"], affine: bool
) -> tuple[Int[Tensor, "points"], Float[Tensor, "parents"], Float[Tensor, "halves d rank"]]:
    """Cut clusters across their longest direction and fit both halves.

    Returns:
        Half of each point (two for each parent, one after the other; -1 for all others), what both
        halves together lose, and the halves' vectors.
    """
    place = torch.full((fit.num_clusters,), -1, dtype=labels.dtype, device=labels.device)
    place[parents] = torch.arange(len(parents), device=labels.device).to(labels.dtype)
    # Linear clusters hold all lengths of their first vector alike: only the next is worth a cut.
    column = 0 if affine else min(1, fit.vectors.shape[2] - 1)
    across = fit.vectors[:, :, column]
    halves = torch.full_like(labels, -1)  # there are fewer of them than clusters
    for rows, values in fit.points.chunks():
        own = labels[rows].long()
        taken = torch.nonzero(place[own] >= 0)[:, 0]
        own = own[taken]
        along = ((values[taken] - fit.centres[own]) * across[own]).sum(1)
        halves[rows.start + taken] = 2 * place[own] + (along > 0).to(labels.dtype)
    start = fit.vectors[parents].repeat_interleave(2, dim=0)
    both = Subspaces(fit.points, halves, start, affine, steps=2)
    lost = both.spread() - both.squares().sum(1)
    return halves, lost.view(-1, 2).sum(1), both.vectors


def _pairs(
    gain: Float[Tensor, "parents"],
    cost: Float[Tensor, "clusters"],
    parents: Int[Tensor, "parents"],
    heirs: Bool[Tensor, "clusters clusters"],
) -> list[tuple[int, int]]:
    """Which parent to cut (its place) for which cluster given up: best gain with least cost.

    No cluster given up is heir of another, so that every point has somewhere to go.
    """
    costs, clusters = cost.tolist(), parents.tolist()
    cheap = iter(torch.argsort(cost, stable=True).tolist())
    gone = torch.zeros(len(costs), dtype=torch.bool)
    busy = torch.zeros(len(costs), dtype=torch.bool)
    pairs = []
    for place in torch.argsort(gain, descending=True, stable=True).tolist():
        parent = clusters[place]
        if busy[parent]:
            continue
        removed = next(
            (k for k in cheap if k != parent and not busy[k] and not (heirs[k] & gone).any()), None
        )
        if removed is None or float(gain[place]) <= _LEAST_RETURN * costs[removed]:
            break
        busy |= heirs[removed]
        busy[[removed, parent]] = True
        gone[removed] = True
        pairs.append((place, removed))
    return pairs
