r"""Lobes of neighbouring points in correspondence, so that they can be interpolated.

Fitted one by one, the lobes of two neighbours come in any order, with axes of either sign (the
negated axis with negated odd bands is the same lobe), and sit in minima that may have nothing to do
with each other. What lies half way between such lobes is no transfer at all. The paper samples
lobes point by point instead, or fits all points of a map together.

Here lobes spread along a tree from neighbour to neighbour, over the pairs of points whose transfer
is most alike. A point first tries its parent's axes: it goes downhill from them, held to them by a
spring, and takes where it ends if its own error stays within an *allowance*. Else it keeps its
own lobes, in the order in which they are closest to its parent's as functions. Then points try the
axes of their other neighbours, round after round, and take what makes error and springs to all
neighbours least. So minima become alike over regions as large as the allowance lets them.

Seams stay where transfer changes fast from point to point, such as along cast shadows: there, what
is interpolated is worse than a sample of either end. :class:`EdgeError` tells how often.

Source:
    Sloan, Luna, Snyder 2005, section 4.2 (wrinkle model: correspondence by one optimisation over
    the map) and section 6 (point-sampled lobes). The tree and the allowance are ours.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array, csgraph
from torch import Tensor, nn

from prt_torch.bases import sh, zonal
from prt_torch.representations.zonal_lobes_coding import Lobes
from prt_torch.representations.zonal_lobes_descent import descend
from prt_torch.representations.zonal_lobes_objective import Anchors, LobeObjective

_STEPS = 12  # at most, downhill from a neighbour's axes
_TOLERANCE = 1e-3  # share of the objective that a step must win
_LEAST = 1e-3  # squared norm added to a lobe's, so that lobes without weight do not wander
_CLEARLY = 1e-3  # share of error and springs that a change must win


def interpolate(
    lobes: Lobes, corners: Int[Tensor, "samples corners"], weights: Float[Tensor, "samples corners"]
) -> Lobes:
    """Lobes between points: axes by their directions, coefficients and linear terms as they are.

    Lobes of the same number are taken for each other, so they should be in correspondence. Opposite
    axes of equal weight have no direction between them and give +z.

    Args:
        lobes: Of the points.
        corners: Points that a sample lies between.
        weights: Of the corners, which should sum to one.
    """
    units = zonal.unit_axes(lobes.axes)[corners]  # samples corners rows lobes 3
    shares = weights.to(units)
    return Lobes(
        axes=zonal.unit_axes(torch.einsum("sc,scrni->srni", shares, units)),
        coefficients=torch.einsum("sc,scrnb->srnb", shares, lobes.coefficients[corners]),
        linear=torch.einsum("sc,scrk->srk", shares, lobes.linear[corners]),
    )


def between(
    lobes: Lobes,
    corners: Int[Tensor, "samples corners"],
    weights: Float[Tensor, "samples corners"],
    order: int,
) -> Lobes:
    """Lobes between points: interpolated, but for seams, where the nearest point's are taken.

    A row of a sample is at a seam where its interpolated lobes are farther from the weighted mean
    of what its corners stand for than those of the nearest corner. Linear terms are interpolated.

    Args:
        lobes: As for :func:`interpolate`.
        corners: Likewise.
        weights: Likewise.
        order: Bands of transfer.
    """
    middle = interpolate(lobes, corners, weights)
    nearest = corners.gather(1, weights.argmax(1, keepdim=True))[:, 0]
    sampled = Lobes(lobes.axes[nearest], lobes.coefficients[nearest], middle.linear)
    values = _harmonics(lobes, order)
    wanted = torch.einsum("sc,scrk->srk", weights.to(values), values[corners])
    errors = [(_harmonics(own, order) - wanted).square().sum(-1) for own in (middle, sampled)]
    seam = (errors[1] < errors[0])[..., None, None]
    return Lobes(
        axes=torch.where(seam, zonal.unit_axes(sampled.axes), middle.axes),
        coefficients=torch.where(seam, sampled.coefficients, middle.coefficients),
        linear=middle.linear,
    )


@dataclass(frozen=True)
class EdgeError:
    """Squared errors over squared norms of transfer, sums over all points, or all edges.

    Attributes:
        points: At the points themselves.
        interpolated: Of interpolated lobes half way between two points, against their mean.
        sampled: The same, of lobes of either end with interpolated linear terms.
        better: The same, of each edge by that of the two which is better.
        share: Of edges where interpolated lobes are better.
    """

    points: float
    interpolated: float
    sampled: float
    better: float
    share: float


def edge_error(
    lobes: Lobes, values: Float[Tensor, "points rows coeffs"], edges: Int[Tensor, "edges 2"]
) -> EdgeError:
    """What is lost half way between neighbouring points.

    Args:
        lobes: Of the points.
        values: Their transfer, by spherical harmonics.
        edges: Pairs of points.

    Raises:
        ValueError: If shapes do not fit, or an edge names a point that is not there.

    Source:
        Sloan, Luna, Snyder 2005, section 6, interpolates constant and linear terms and samples
        lobes at points.
    """
    _check(lobes, values, edges)
    exact = values.double()
    between = exact[edges].mean(1)
    halves = torch.full(edges.shape, 0.5, dtype=torch.float64, device=edges.device)
    wide = _wide(lobes)
    middle = interpolate(wide, edges, halves)
    order = sh.order_of(values)
    by_middle = _squared(_harmonics(middle, order) - between)
    ends = [Lobes(wide.axes[end], wide.coefficients[end], middle.linear) for end in edges.unbind(1)]
    by_ends = torch.stack([_squared(_harmonics(end, order) - between) for end in ends]).mean(0)
    wins = by_middle < by_ends
    norm = float(_squared(between).sum())
    return EdgeError(
        points=_share(_squared(_harmonics(wide, order) - exact), float(_squared(exact).sum())),
        interpolated=_share(by_middle, norm),
        sampled=_share(by_ends, norm),
        better=_share(torch.where(wins, by_middle, by_ends), norm),
        share=_share(wins, float(len(edges))),
    )


def corresponding(
    lobes: Lobes,
    values: Float[Tensor, "points rows coeffs"],
    edges: Int[Tensor, "edges 2"],
    *,
    ridge: float = 1e-3,
    allowance: float = 8.0,
    stiffness: float = 1e-2,
    rounds: int = 16,
) -> Lobes:
    """The same transfer by lobes that are in correspondence along edges.

    Args:
        lobes: Fitted to ``values``, point by point.
        values: Transfer by spherical harmonics.
        edges: Pairs of neighbouring points, such as edges of a mesh or neighbouring texels. Points
            of no edge keep their lobes.
        ridge: Of the pull of coefficients to those of neighbours, where transfer leaves them free;
            far above that of a fit, for large lobes of opposite sign meet at no point between.
        allowance: A point's squared error may rise to so many times what it was, or so many times
            the mean of all points, whichever is more; both relative to squared norms. At 1 or
            below, hardly a point leaves its lobes, and they are brought in order only.
        stiffness: Of the springs between corresponding axes, times the lobes' squared norms.
        rounds: Of trying other neighbours' axes; 0 for none.

    Raises:
        ValueError: If shapes do not fit, an edge names a point that is not there, or an option is
            negative.
    """
    _check(lobes, values, edges)
    if allowance < 0 or stiffness < 0 or rounds < 0:
        raise ValueError(
            f"expected an allowance, a stiffness and rounds of at least 0, got {allowance:g}, "
            f"{stiffness:g} and {rounds}"
        )
    matching = _Correspondence(lobes, values, edges, ridge, allowance, stiffness)
    matching.along_the_tree()
    for turn in range(rounds):
        if matching.neighbours(turn) == 0:
            break
    return matching.lobes(lobes)


def _check(lobes: Lobes, values: Tensor, edges: Tensor) -> None:
    if values.shape[:2] != lobes.axes.shape[:2]:
        expected = f"{lobes.axes.shape[0]} {lobes.axes.shape[1]} coeffs"
        raise ValueError(f'expected values "{expected}", got {tuple(values.shape)}')
    if edges.ndim != 2 or edges.shape[1] != 2:
        raise ValueError(f'expected edges "edges 2", got {tuple(edges.shape)}')
    if len(edges) and not 0 <= int(edges.min()) <= int(edges.max()) < len(values):
        raise ValueError(f"expected edges of points 0 to {len(values) - 1}")


def _wide(lobes: Lobes) -> Lobes:
    """In float64, without gradients."""
    return Lobes(*(getattr(lobes, name).detach().double() for name in Lobes.names()))


def _harmonics(lobes: Lobes, order: int) -> Float[Tensor, "points rows coeffs"]:
    """What lobes stand for."""
    filled = nn.functional.pad(lobes.coefficients, (order - lobes.coefficients.shape[-1], 0))
    values = zonal.lobes_to_sh(lobes.axes, filled)
    return torch.cat([lobes.linear, values[..., lobes.linear.shape[-1] :]], dim=-1)


def _squared(values: Float[Tensor, "some rows coeffs"]) -> Float[Tensor, "some"]:
    return values.square().sum((1, 2))


def _share(parts: Tensor, whole: float) -> float:
    return float(parts.sum()) / whole if whole > 0 else 0.0


class _Correspondence:
    """Axes of all functions (each row of each point), of norm one, while they are brought together.

    ``axes`` and ``weights`` are those of the fits, in an order and with signs that change.
    """

    def __init__(
        self,
        lobes: Lobes,
        values: Float[Tensor, "points rows coeffs"],
        edges: Int[Tensor, "edges 2"],
        ridge: float,
        allowance: float,
        stiffness: float,
    ):
        self.values, self.stiffness, self.num_rows = values.detach(), stiffness, values.shape[1]
        functions = self.values.double().flatten(0, 1)
        norms = functions.norm(dim=1)
        self.norms = torch.where(norms > 0, norms, 1.0)
        functions = functions / self.norms[:, None]
        order = sh.order_of(values)
        first_band = max(order - lobes.coefficients.shape[-1], 1)
        self.objective = LobeObjective(functions, first_band, ridge)
        wide = _wide(lobes)
        bands = torch.tensor(self.objective.bands, device=values.device)
        self.scales = (4.0 * math.pi / (2.0 * bands.double() + 1.0)).sqrt()
        own = wide.coefficients[..., wide.coefficients.shape[-1] - len(bands) :]
        self.weights = (own / self.scales).flatten(0, 1).permute(2, 1, 0) / self.norms
        self.axes = zonal.unit_axes(wide.axes).flatten(0, 1).permute(1, 2, 0).contiguous()
        lost = (_harmonics(wide, order) - self.values)[..., first_band**2 :].flatten(0, 1)
        errors = lost.square().sum(1) / self.norms.square()
        self.limits = allowance * errors.maximum(errors.mean())
        rows = torch.arange(self.num_rows, device=edges.device)
        edges = edges[edges[:, 0] != edges[:, 1]]
        pairs = (edges[:, None] * self.num_rows + rows[:, None]).flatten(0, 1)
        self.graph = _Graph(pairs, functions)

    def lobes(self, rest: Lobes) -> Lobes:
        """With the axes and weights found, and the linear terms as they were."""
        split = (-1, self.num_rows)
        axes = self.axes.permute(2, 0, 1).unflatten(0, split)
        found = (self.weights * self.norms).permute(2, 1, 0) * self.scales
        coefficients = found.unflatten(0, split)
        if rest.coefficients.shape[-1] > len(self.scales):  # band 0, which any axes meet alike
            constant = rest.coefficients.detach()[..., :1].double().mean(2, keepdim=True)
            coefficients = torch.cat([constant.expand(*axes.shape[:3], 1), coefficients], dim=-1)
        return Lobes(axes.to(rest.axes), coefficients.to(rest.axes), rest.linear.detach())

    def along_the_tree(self) -> None:
        """Each function goes downhill from its parent's axes, or takes its parent's order."""
        for children, parents in self.graph.levels():
            weights = self.weights[..., parents]
            anchors = Anchors(self.axes[:, :, parents], weights, self._stiffnesses(weights))
            objective = self.objective.pick(children).anchored(anchors)
            found = descend(objective, anchors.axes, max_steps=_STEPS, tolerance=_TOLERANCE).fits
            near = objective.squared_error(found) <= self.limits[children]
            self._take(children[near], found.pick(near).axes, found.pick(near).weights)
            self._match(children[~near], parents[~near])

    def neighbours(self, turn: int) -> None:
        """Half of the functions give in to their springs, or try the axes of one neighbour each."""
        which = self.graph.with_neighbours
        which = which[which % 2 == turn % 2]
        means = (self.axes, self.weights, self._stiffnesses(self.weights))
        anchors = Anchors(*(self.graph.means(values)[..., which] for values in means))
        objective = self.objective.pick(which).anchored(anchors)
        here = objective.evaluate(self.axes[:, :, which])
        now, near = here.objective, objective.squared_error(here) <= self.limits[which]
        self._take(which[near], here.axes[..., near], here.weights[..., near])
        for start in (self.axes[:, :, which], self.axes[:, :, self.graph.neighbour(which, turn)]):
            found = descend(objective, start, max_steps=_STEPS, tolerance=_TOLERANCE).fits
            better = objective.squared_error(found) <= self.limits[which]
            better &= found.objective < (1.0 - _CLEARLY) * now
            now = torch.where(better, found.objective, now)
            self._take(which[better], found.pick(better).axes, found.pick(better).weights)

    def _stiffnesses(
        self, weights: Float[Tensor, "bands lobes some"]
    ) -> Float[Tensor, "lobes some"]:
        """Of springs, for each lobe: a large one that turns does more to what lies between."""
        return self.stiffness * (weights.square().sum(0) + _LEAST)

    def _take(self, which: Tensor, axes: Tensor, weights: Tensor) -> None:
        self.axes[:, :, which], self.weights[..., which] = axes, weights

    def _match(self, which: Int[Tensor, "some"], others: Int[Tensor, "some"]) -> None:
        """The order of others' lobes that makes the differences least, and their signs."""
        axes, weights = self.axes[:, :, which], self.weights[..., which]
        theirs = self.axes[:, :, others]
        cosines = torch.einsum("iaf,jaf->fij", theirs, axes)
        bands = torch.tensor(self.objective.bands, device=axes.device)
        products = zonal.legendre(cosines, self.objective.order)[..., bands]
        alike = torch.einsum(
            "fijb,bif,bjf->fij", products, self.weights[..., others], weights
        ).cpu()
        orders = [linear_sum_assignment(one, maximize=True)[1] for one in alike.numpy()]
        order = torch.from_numpy(np.array(orders, dtype=np.int64).reshape(-1, len(axes)))
        order = order.to(axes.device).mT  # lobes some
        axes = axes.gather(0, order[:, None].expand_as(axes))
        weights = weights.gather(1, order.expand_as(weights))
        signs = torch.where((axes * theirs).sum(1) < 0, -1.0, 1.0)
        odd = (bands % 2 == 1)[:, None, None]
        self._take(which, axes * signs[:, None], torch.where(odd, weights * signs, weights))


class _Graph:
    """Neighbours of functions, and a forest over the pairs that are most alike.

    Args:
        pairs: Of neighbours, in one direction or both; none of a function and itself.
        functions: Their distances are the lengths of pairs.
    """

    def __init__(
        self,
        pairs: Int[Tensor, "pairs 2"],
        functions: Float[Tensor, "functions coeffs"],
    ):
        self.device, self.count = pairs.device, len(functions)
        lengths = (functions[pairs[:, 0]] - functions[pairs[:, 1]]).norm(dim=1) + 1e-9
        ends = torch.cat([pairs, pairs.flip(1)]).unique(dim=0, return_inverse=True)
        self.lengths = torch.zeros(len(ends[0]), dtype=lengths.dtype, device=self.device)
        self.lengths[ends[1]] = lengths.repeat(2)
        self.own, self.other = ends[0].unbind(1)  # sorted by own
        self.degrees = torch.bincount(self.own, minlength=self.count)
        self.first = self.degrees.cumsum(0) - self.degrees
        self.with_neighbours = self.degrees.nonzero()[:, 0]

    def neighbour(self, which: Int[Tensor, "some"], turn: int) -> Int[Tensor, "some"]:
        """One neighbour of each, another one at the next turn."""
        return self.other[self.first[which] + turn % self.degrees[which]]

    def means(self, values: Float[Tensor, "*of functions"]) -> Float[Tensor, "*of functions"]:
        """Means over the neighbours; zero without any."""
        total = torch.zeros_like(values).index_add_(-1, self.own, values[..., self.other])
        return total / self.degrees.clamp_min(1)

    def levels(self) -> list[tuple[Int[Tensor, "some"], Int[Tensor, "some"]]]:
        """Children and their parents, nearest to the roots first; a root for each component.

        Ways to a root go by the least sum of lengths.
        """
        ends = (self.own.cpu().numpy(), self.other.cpu().numpy())
        graph = coo_array((self.lengths.cpu().numpy(), ends), shape=(self.count, self.count))
        graph = graph.tocsr()
        _, labels = csgraph.connected_components(graph, directed=False)
        _, roots = np.unique(labels, return_index=True)
        _, parents, _ = csgraph.dijkstra(
            graph, indices=roots, return_predecessors=True, min_only=True
        )
        tree = torch.from_numpy(parents.astype(np.int64))
        levels = []
        children = (tree >= 0).nonzero()[:, 0]
        reached = tree < 0
        while len(children):
            now = reached[tree[children]]
            some = children[now]
            levels.append((some.to(self.device), tree[some].to(self.device)))
            children = children[~now]
            reached[some] = True
        return levels
