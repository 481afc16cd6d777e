"""Clusters that take as many vectors as they need, within the storage of equal ranks.

Vector i of cluster k lowers the squared error by its squared singular value, and takes one weight
for each of the cluster's points and, itself, as many numbers as a point has values. Vectors are
added in order of gain over cost over all clusters until the storage of equal ranks is reached.
The paper's rule counts the weights only, which prices the vectors of small clusters too low.

In between, points move to the cluster where error plus the price of their weights is least. The
price of a weight is what the last vector bought gained for each number it took: without it, points
would crowd into the clusters of high rank, and ranks would have to fall to keep the storage.

Source:
    Sloan, Hall, Hart, Snyder 2003, section 4.3, with the two differences above.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.representations.cpca_choice import Subspaces
from prt_torch.representations.cpca_iteration import NEAREST, PrincipalAxes
from prt_torch.representations.cpca_subspaces import Decomposition, decompose
from prt_torch.representations.points import Points, renumber
from prt_torch.representations.steady import laid_out

_LARGEST_RANK = 3  # times the mean rank
_TURNS = 16
_PATIENCE = 3  # turns without a gain before they end
_GAIN = 1e-3  # share of the error that counts as a gain


@dataclass(frozen=True)
class Shares:
    """Ranks of clusters, and what one number more would gain.

    Attributes:
        ranks: Vectors of each cluster.
        price: Gain a number of the last vector that was bought.
    """

    ranks: Int[Tensor, "clusters"]
    price: float


def share_out(
    squares: Float[Tensor, "clusters rank"],
    sizes: Int[Tensor, "clusters"],
    vector_numbers: int,
    budget: int,
) -> Shares:
    """Buy vectors in order of gain over cost until none fits.

    Args:
        squares: What each vector gains, falling along each cluster.
        sizes: Points of each cluster: the weights a vector of it needs.
        vector_numbers: Numbers in a vector.
        budget: Numbers in all, of vectors and weights.
    """
    width = squares.shape[1]
    cost = sizes + vector_numbers
    rate = (squares / cost[:, None]).flatten()
    order = torch.argsort(rate, descending=True, stable=True)
    order = order[rate[order] > 0]
    owners = (order // max(width, 1)).tolist()
    costs, rates = cost.tolist(), rate[order].tolist()
    ranks, price = [0] * len(squares), 0.0
    full = [False] * len(squares)  # a later vector of a cluster is of no use without the earlier
    for owner, gain in zip(owners, rates, strict=True):
        if full[owner]:
            continue
        if costs[owner] > budget:
            full[owner] = True
            continue
        budget -= costs[owner]
        ranks[owner] += 1
        price = gain
    return Shares(torch.tensor(ranks, device=sizes.device), price)


def adapt(
    points: Points,
    labels: Int[Tensor, "points"],
    num_clusters: int,
    rank: int,
    affine: bool,
    vector_numbers: int,
) -> tuple[Decomposition, Int[Tensor, "clusters"]]:
    """Clusters and ranks from those of equal rank; never worse than these, nor larger.

    Args:
        points: The points.
        labels: Clusters made for equal ranks.
        num_clusters: How many.
        rank: The equal rank, whose storage is the budget.
        affine: Whether clusters have means.
        vector_numbers: Numbers in a vector as it is stored.

    Returns:
        The clusters' subspaces, and how many of their vectors to keep.
    """
    largest = min(_LARGEST_RANK * rank, points.rest[0], points.total)
    # Unequal ranks are stored too, in one byte or two a cluster.
    width = 1 if largest < 2**8 else 2
    extra = -(-width * num_clusters // points.like.element_size())
    budget = rank * (points.total + num_clusters * vector_numbers) - extra
    equal = decompose(points, labels, num_clusters, max(largest, rank), affine)
    ranks = torch.full_like(equal.sizes, rank)
    options = [(equal.error(ranks), equal, ranks)]

    def offer(found: Decomposition) -> None:
        shares = share_out(found.singular.square(), found.sizes, vector_numbers, budget)
        options.append((found.error(shares.ranks), found, shares.ranks))

    if num_clusters > 1 and largest > 0:
        offer(equal)
        moved = _move(points, equal, largest, affine, vector_numbers, budget)
        offer(decompose(points, moved, num_clusters, largest, affine))
    _, best, ranks = min(options, key=lambda option: option[0])
    return best, ranks


def _move(
    points: Points,
    start: Decomposition,
    largest: int,
    affine: bool,
    vector_numbers: int,
    budget: int,
) -> Int[Tensor, "points"]:
    """Turns of refitting, sharing out and moving points; the best labels seen."""
    axes = PrincipalAxes(points)
    shares = share_out(start.singular.square(), start.sizes, vector_numbers, budget)
    count = axes.enough(start.error(shares.ranks), least=largest)
    some, labels = axes.leading(count), start.labels
    vectors = axes.turned(start.vectors[:, :largest].to(points.like), count).mT
    num_clusters, best, best_labels, idle = len(vectors), torch.inf, labels, 0
    for _ in range(_TURNS):
        labels, old = renumber(labels, num_clusters, points.processes)
        fit = Subspaces(some, labels, vectors[old], affine, steps=1)
        squares = fit.squares()
        vectors = fit.vectors
        shares = share_out(squares, fit.sizes, vector_numbers, budget)
        used = torch.arange(largest, device=labels.device) < shares.ranks[:, None]
        error = float(fit.spread().sum() - (squares * used).sum())
        idle = 0 if error < (1.0 - _GAIN) * best else idle + 1
        if error < best:
            best, best_labels = error, labels
        if idle == _PATIENCE:
            break
        kept = (vectors * used[:, None].to(vectors))[:, :, : int(shares.ranks.max())]
        fit.vectors = laid_out(kept)
        labels, _ = fit.reassign(NEAREST, price=(shares.price * shares.ranks).to(vectors))
    return best_labels
