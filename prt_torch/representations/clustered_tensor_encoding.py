"""How clustered tensor approximation finds its clusters and bases.

1. Transfer is weighed by the metric, so that errors are plain sums of squares, and projected onto
   the axes of view and light that matter (``clustered_tensor_projection``). How many do is
   measured: a small share of the error that the first clusters' bases make may be lost.
2. CPCA's iterations give the first clusters, turns of refitting and moving the final ones
   (``clustered_tensor_search``), in the view basis of most energy.
3. Turns over all three modes improve the bases of these clusters, the shared view basis included
   (``clustered_tensor_fit``).
4. The mode of the points is decomposed exactly, in float64, and bases leave the metric's space.

Points of each material are encoded by themselves (``clustered_tensor_groups``). Points are read in
chunks where a budget of memory asks for it, and may lie in several processes (``points``).

Source:
    Tsai, Shih 2006, section 5.2. The projection is ours.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.metric import Metric
from prt_torch.representations.clustered_tensor_coding import Encoding, Parameters
from prt_torch.representations.clustered_tensor_fit import (
    Bases,
    Decomposition,
    decompose,
    exact_weights,
    first_bases,
    held,
    in_view,
    refit,
    refit_view,
)
from prt_torch.representations.clustered_tensor_groups import join, share_out, split
from prt_torch.representations.clustered_tensor_projection import (
    Moments,
    Projection,
    project,
    read_moments,
)
from prt_torch.representations.clustered_tensor_search import (
    START_DIMENSIONS,
    Trace,
    find_clusters,
    first_clusters,
)
from prt_torch.representations.clustered_tensor_statistics import Clock, TensorStatistics
from prt_torch.representations.magnitude import of_ordinary_magnitude
from prt_torch.representations.points import Mapped, Points, SortedPoints, label_type, slices
from prt_torch.representations.processes import ALONE, Processes
from prt_torch.representations.scratch import Memory
from prt_torch.transfer import TransferTensor

_FIRST_LOSS = 1e-4  # of the energy, that each mode may lose to the projection at first
_LOSS = 1e-3  # of the first clusters' error, that each may lose in the end
_FIRST_STEPS = 3
_STEPS = 3  # of each mode in a turn of the approximation phase
_LABELS = 6  # of a point, of several kinds, while clusters are looked for
_TABLES = 5  # as large as the columns that weights are products with, in float64
_START_TABLES = 6  # as large as the vectors of the first clusters


@dataclass(frozen=True)
class Ranks:
    """Ranks of the three modes, capped at what exists."""

    view: int
    light: int
    points: int

    @classmethod
    def capped(
        cls, ranks: Sequence[int], num_points: int, view_axes: int, num_coeffs: int
    ) -> "Ranks":
        """No mode has more than its size or than the product of the other two.

        Args:
            ranks: Of rows, light coefficients and points, as wanted.
            num_points: Of all processes.
            view_axes: Dimensions of the rows times channels.
            num_coeffs: Of the light.
        """
        view = min(ranks[0], view_axes)
        points = min(ranks[2], num_points)
        light = min(ranks[1], num_coeffs, view * points)
        return cls(view, light, min(points, view * light))


@dataclass(frozen=True)
class Options:
    """What a fit is told, shared by all groups.

    Attributes:
        tolerance: Share of the error that a turn must gain.
        max_turns: Of each phase.
        memory_budget: Bytes of all there is at the peak.
        metric: What errors are worth.
        generator: Source of randomness.
        processes: Those that have points too.

    Raises:
        ValueError: If the tolerance or the number of turns is out of range.
    """

    tolerance: float
    max_turns: int
    memory_budget: int
    metric: Metric
    generator: torch.Generator
    processes: Processes = ALONE

    def __post_init__(self) -> None:
        if not 0.0 <= self.tolerance < 1.0:
            raise ValueError(f"expected a tolerance in 0..1, got {self.tolerance}")
        if self.max_turns < 1:
            raise ValueError(f"expected at least 1 turn, got {self.max_turns}")


def encode(
    transfer: TransferTensor,
    *,
    num_clusters: int,
    ranks: Sequence[int],
    options: Options,
) -> tuple[Encoding, TensorStatistics]:
    """Cluster the points of a transfer tensor and decompose each cluster; nothing is rounded.

    Raises:
        ValueError: If a number of clusters or a rank is below 1, or there are not three ranks.
        InputError: If the memory budget is too small, or there are fewer clusters than materials.
    """
    if num_clusters < 1:
        raise ValueError(f"expected at least 1 cluster, got {num_clusters}")
    if len(ranks) != 3 or min(ranks) < 1:
        raise ValueError(f"expected three ranks of at least 1, got {tuple(ranks)}")
    clock, processes = Clock(), options.processes
    memory = Memory(options.memory_budget)
    transfer, power = of_ordinary_magnitude(transfer, memory, processes)
    groups = split(transfer, processes)
    rows, coeffs = transfer.num_channels * transfer.num_rows, transfer.num_coeffs
    moments = [
        read_moments(
            part,
            options.metric,
            least_light=min(ranks[1], coeffs),
            memory=memory,
            processes=processes,
            generator=options.generator,
        )
        for _, part in groups
    ]
    norms = [of_part.squared_norm * of_part.scale**2 for of_part in moments]
    sizes = [sum(processes.lengths(len(points))) for points, _ in groups]
    counts = share_out(num_clusters, norms, sizes)
    found, statistics = [], []
    for place, (points, part) in enumerate(groups):
        view_axes = moments[place].view_rank if len(groups) > 1 else rows
        rank = Ranks.capped(ranks, sizes[place], view_axes, coeffs)
        group = _Group(part, moments[place], rank, counts[place], options, clock)
        encoding, facts = group.encode()
        found.append((points, encoding))
        statistics.append(facts)
    joined = join(found, processes)
    joined.parameters.weights.div_(power)
    clock.tick("weights")
    return joined, TensorStatistics.together(statistics, clock.seconds, power)


@dataclass(frozen=True)
class _Group:
    """The points of one material, and what is wanted of them."""

    transfer: TransferTensor
    moments: Moments
    rank: Ranks
    num_clusters: int
    options: Options
    clock: Clock

    def encode(self) -> tuple[Encoding, TensorStatistics]:
        """All phases."""
        trace, rank, options, norm = Trace(), self.rank, self.options, self.moments.squared_norm
        found, labels, bases = self._start()
        points = found.points
        first_views = points.stored(lambda values: values[:, : rank.view], *self._seen(points))
        labels, bases = find_clusters(
            first_views,
            labels,
            bases,
            trace,
            squared_norm=norm,
            tolerance=options.tolerance,
            max_turns=options.max_turns,
        )
        del first_views
        self.clock.tick("clustering")
        view, bases = self._approximate(points, labels, bases, trace)
        self.clock.tick("approximation")
        seen = self._in_view(points, view)
        exact = decompose(seen, labels, bases.light, rank.points)
        parameters = self._parameters(found, seen, labels, view, bases, exact)
        self.clock.tick("weights")
        scale = self.moments.scale**2
        statistics = TensorStatistics(
            squared_norm=norm * scale,
            squared_error=max(norm - exact.squared_norm, 0.0) * scale,
            projection_lost=found.lost,
            axes=(points.rest[0], points.rest[1]),
            errors=[max(norm - one, 0.0) * scale for one in trace.held],
            moved=trace.moved,
            seconds=self.clock.seconds,
        )
        groups = torch.zeros(len(exact.dual), dtype=torch.int64, device=labels.device)
        return Encoding(labels.long(), groups, parameters, None, exact.condition), statistics

    def _seen(self, points: Points) -> tuple[int, int]:
        """Shape of a point in a view basis."""
        return self.rank.view, points.rest[1]

    def _in_view(self, points: Points, view: Float[Tensor, "view_axes view"]) -> Points:
        """Points in a view basis, made where they are read."""
        shape = self._seen(points)
        return points.with_rows(Mapped(points.rows, lambda values: in_view(values, view), *shape))

    def _start(self) -> tuple[Projection, Int[Tensor, "points"], Bases]:
        """Enough axes, first clusters, and where their bases begin."""
        rank, norm, generator = self.rank, self.moments.squared_norm, self.options.generator
        allowed = _FIRST_LOSS * norm
        found = self._projected(allowed)
        points = found.points
        self.clock.tick("reading")
        seen = points.stored(lambda values: values[:, : rank.view], *self._seen(points))
        labels, clusters = first_clusters(seen, self.num_clusters, rank.points, generator)
        axes = points.rest[1]
        bases = first_bases(
            clusters, rank.view, axes, rank.light, rank.points, generator, points.like
        )
        members = SortedPoints(seen, labels, clusters)
        bases = refit(members, bases, _FIRST_STEPS)
        error = norm - held(members, bases)
        self.clock.tick("start")
        # Where the error is rounding alone, all axes are kept.
        rounding = torch.finfo(points.like.dtype).eps * norm
        limit = _LOSS * error if error > rounding else 0.0
        if limit < allowed:
            del seen, members, points, found
            found = self._projected(limit)  # the axes are the same and more of them
            more = found.points.rest[1] - axes
            bases = Bases(torch.nn.functional.pad(bases.light, (0, 0, 0, more)), bases.dual)
            self.clock.tick("reading")
        return found, labels, bases

    def _projected(self, allowed: float) -> Projection:
        """The tensor in as many axes as lose no more than allowed, and as tables fit in memory."""
        rank, options = self.rank, self.options
        wanted = self.moments.light.enough(allowed, rank.light)
        light = max(rank.light, min(wanted, self._affordable_light()))
        return project(
            self.transfer,
            options.metric,
            self.moments,
            allowed=allowed,
            least=(rank.view, rank.light),
            most_light=light,
            memory=self._memory(light),
            processes=options.processes,
        )

    def _memory(self, light_axes: int) -> Memory:
        """The budget, less what labels, weights and tables take at their most."""
        rank, itemsize = self.rank, torch.empty(0, dtype=self.moments.precision).element_size()
        num_points, clusters = self.transfer.num_points, self.num_clusters
        labels = num_points * _LABELS * label_type(clusters).itemsize
        bases = clusters * rank.light * self.transfer.num_coeffs * itemsize
        result = num_points * (rank.points * itemsize + 8) + bases
        return Memory(
            self.options.memory_budget,
            max(labels + num_points * itemsize, result)
            + light_axes * self._table_bytes
            + clusters * START_DIMENSIONS * (rank.points + 1) * 8 * _START_TABLES,
        )

    @property
    def _table_bytes(self) -> int:
        """Of all clusters' tables, for each axis of the light."""
        return self.num_clusters * self.rank.view * self.rank.points * 8 * _TABLES

    def _affordable_light(self) -> int:
        """Axes of the light whose tables take no more than a third of what is free."""
        budget = self.options.memory_budget
        free = budget - self._memory(0).reserved
        return free // 3 // self._table_bytes

    def _approximate(
        self, points: Points, labels: Int[Tensor, "points"], bases: Bases, trace: Trace
    ) -> tuple[Float[Tensor, "view_axes view"], Bases]:
        """Turns over all modes until the error settles.

        Source:
            Tsai, Shih 2006, section 5.2.4.
        """
        options, clusters = self.options, len(bases.light)
        view = torch.eye(points.rest[0], self.rank.view).to(points.like)
        for turn in range(options.max_turns):
            if view.shape[0] > view.shape[1]:
                view, bases = refit_view(SortedPoints(points, labels, clusters), view, bases)
            members = SortedPoints(self._in_view(points, view), labels, clusters)
            bases = refit(members, bases, _STEPS)
            trace.held.append(held(members, bases))
            if turn > 0 and trace.settled(self.moments.squared_norm, options.tolerance):
                break
        return view, bases

    def _parameters(
        self,
        found: Projection,
        seen: Points,
        labels: Int[Tensor, "points"],
        view: Float[Tensor, "view_axes view"],
        bases: Bases,
        exact: Decomposition,
    ) -> Parameters:
        """Bases of the tensor itself, in its own precision.

        The scale of the tensor goes to the weights.
        """
        transfer, metric = self.transfer, self.options.metric
        like = transfer.values[0:0].flatten()
        of_rows = replace(metric, light=None)
        view_basis = (found.view_axes @ view.to(found.view_axes)).unflatten(
            0, (transfer.num_channels, transfer.num_rows)
        )
        clusters, _, rank_light = bases.light.shape
        light_bases = like.new_empty(clusters, rank_light, transfer.num_coeffs)
        one_row = torch.ones(1, 1, dtype=torch.float64, device=view_basis.device)
        of_light = replace(metric, row_factor=one_row)
        at_once = seen.memory.rows_at_once(8 * rank_light * transfer.num_coeffs) or clusters
        for some in slices(clusters, at_once):
            own = (found.light_axes @ bases.light[some].to(found.light_axes)).mT
            light_bases[some] = of_light.unweigh(own[:, :, None])[:, :, 0].to(like)
        weights = like.new_empty(seen.num_points, exact.dual.shape[1])
        members = SortedPoints(seen, labels, clusters)
        for rows, own in exact_weights(members, bases.light, exact.dual):
            weights[rows] = (own * self.moments.scale).to(like)
        return Parameters(
            view_basis=of_rows.unweigh(view_basis).flatten(0, 1)[None].to(like),
            light_bases=light_bases,
            cores=exact.dual.unflatten(2, (view.shape[1], -1)).to(like),
            weights=weights,
        )
