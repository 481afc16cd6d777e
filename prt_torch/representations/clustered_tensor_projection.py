"""Transfer in its principal axes of view and light: one small tensor that all later work is on.

The second moments of the rows and of the light coefficients, summed by blocks, give orthonormal
axes of falling energy. The tensor is then read once more and kept in the first of them, in memory
or in a temporary file; what lies beyond is lost alike whatever the clusters are. Bases found there
are bases of the tensor itself, and so are the weights: products with the axes are exact.

Where the moment of the light does not fit in memory, as of thousands of coefficients, its leading
axes come from random directions instead (``cpca_projection``).

Source:
    Tsai, Shih 2006, equation 14, for the view mode. Axes of the light mode are ours; they save most
    of the time.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.metric import Metric
from prt_torch.representations.cpca_projection import directions
from prt_torch.representations.cpca_subspaces import one_thread
from prt_torch.representations.exact_sums import ExactProducts
from prt_torch.representations.points import Points
from prt_torch.representations.processes import ALONE, Processes
from prt_torch.representations.scratch import Memory
from prt_torch.representations.steady import laid_out, steady_product
from prt_torch.transfer import TransferTensor

_COPIES = 3  # of points that must fit in memory: themselves, in fewer rows, and sorted by cluster
_MOMENT_COPIES = 5  # of a moment: sums, in float64, and what its decomposition takes
_DIRECTIONS = 256  # of the light, where its moment does not fit


@dataclass(frozen=True)
class Axes:
    """Orthonormal axes of one mode, by falling energy, float64.

    Attributes:
        vectors: One a column.
        beyond: Energy of the tensor outside of the first 0, 1, 2... of them.
    """

    vectors: Float[Tensor, "size axes"]
    beyond: Float[Tensor, "axes_and_one"]

    @classmethod
    def of_moment(cls, moment: Float[Tensor, "size size"]) -> "Axes":
        """The axes of a second moment."""
        with one_thread():
            energies, vectors = torch.linalg.eigh(moment)
        energies = energies.clamp_min(0.0)
        beyond = torch.nn.functional.pad(energies.cumsum(0).flip(0), (0, 1))
        return cls(vectors.flip(1), beyond)

    def scaled(self, factor: float) -> "Axes":
        """The axes of a tensor whose energy is this many times as large."""
        return Axes(self.vectors, self.beyond * factor)

    def enough(self, allowed: float, least: int) -> int:
        """How many axes leave out no more than this energy; at least so many."""
        count = max(least, int((self.beyond > allowed).sum()))
        return min(count, self.vectors.shape[1])


@dataclass(frozen=True)
class Moments:
    """Axes of both modes of a weighed tensor that was divided by its scale.

    Attributes:
        view: Of channels times rows.
        light: Of the coefficients.
        scale: Root mean square of the weighed values.
        squared_norm: Of the tensor divided by its scale.
        precision: Type that the values were weighed in.
    """

    view: Axes
    light: Axes
    scale: float
    squared_norm: float
    precision: torch.dtype

    @property
    def view_rank(self) -> int:
        """View axes whose energy is more than rounding."""
        return self.view.enough(torch.finfo(self.precision).eps * self.squared_norm, least=1)


@dataclass(frozen=True)
class Projection:
    """The tensor in its first axes.

    Attributes:
        points: ``"points view light"``, divided by the scale of the moments; this process's own.
        view_axes: Orthonormal columns.
        light_axes: Orthonormal columns.
        lost: Energy beyond the axes, over that of the tensor, as the moments tell; not below.
    """

    points: Points
    view_axes: Float[Tensor, "rows view"]
    light_axes: Float[Tensor, "coeffs light"]
    lost: float


def read_moments(
    transfer: TransferTensor,
    metric: Metric,
    *,
    least_light: int = 1,
    memory: Memory | None = None,
    processes: Processes = ALONE,
    generator: torch.Generator | None = None,
) -> Moments:
    """Second moments of both modes, in a few passes over blocks of points.

    Args:
        transfer: The tensor.
        metric: What weighs it.
        least_light: Axes of the light that are wanted in any case.
        memory: What may be taken.
        processes: Those that have points too.
        generator: Source of random directions, where the moment of the light does not fit.

    Raises:
        ValueError: If a value is NaN or infinite.
    """
    memory = memory or Memory()
    rows, coeffs = transfer.num_channels * transfer.num_rows, transfer.num_coeffs
    total = sum(processes.lengths(transfer.num_points))
    like = _at_least_single(transfer.values[0:0].flatten())
    largest, norm = like.new_zeros(rows, coeffs), like.new_zeros((), dtype=torch.float64)
    for _, weighed in _weighed(transfer, metric, memory):
        largest = torch.maximum(largest, weighed.abs().amax(0))
        norm += torch.linalg.vector_norm(weighed, dtype=torch.float64).square()
    largest, energy = processes.largest(largest), float(processes.sum(norm))
    if not energy < float("inf"):
        raise ValueError("transfer values: some are NaN or infinite")
    scale = (energy / (total * rows * coeffs)) ** 0.5 or 1.0
    of_view, of_light = largest.amax(1), largest.amax(0)
    view = ExactProducts(of_view, of_view, total * coeffs, processes)
    fits = memory.fits(8 * _MOMENT_COPIES * coeffs**2)
    light = ExactProducts(of_light, of_light, total * rows, processes) if fits else None
    for _, weighed in _weighed(transfer, metric, memory):
        across = weighed.movedim(1, 2).flatten(0, 1)
        view.add(across, across)
        if light is not None:
            light.add(weighed.flatten(0, 1), weighed.flatten(0, 1))
    if light is None:
        affordable = (memory.table_bytes or 0) // (coeffs * like.element_size())
        count = min(coeffs, max(2 * least_light, min(_DIRECTIONS, affordable)))
        generator = generator or torch.Generator().manual_seed(0)
        of_light = _leading_axes(transfer, metric, count, energy, memory, processes, generator)
    else:
        of_light = Axes.of_moment(light.value())
    return Moments(
        view=Axes.of_moment(view.value()).scaled(scale**-2),
        light=of_light.scaled(scale**-2),
        scale=scale,
        squared_norm=energy / scale**2,
        precision=like.dtype,
    )


def _leading_axes(
    transfer: TransferTensor,
    metric: Metric,
    count: int,
    energy: float,
    memory: Memory,
    processes: Processes,
    generator: torch.Generator,
) -> Axes:
    """So many axes of the light, by random directions."""
    rows = transfer.num_channels * transfer.num_rows

    def blocks() -> Iterator[tuple[slice, Tensor]]:
        for some, weighed in _weighed(transfer, metric, memory):
            yield slice(some.start * rows, some.stop * rows), weighed.flatten(0, 1)

    like = _at_least_single(transfer.values[0:0].flatten())
    points = Points(memory.empty((transfer.num_points * rows, count), like), memory, processes)
    lift = directions(blocks, transfer.num_coeffs, points, generator)
    largest = points.largest()
    moment = ExactProducts(largest, largest, points.total, processes)
    for _, values in points.chunks():
        moment.add(values, values)
    within = Axes.of_moment(moment.value())
    vectors = lift[0 : transfer.num_coeffs] @ within.vectors.to(like)
    rest = max(0.0, energy - float(within.beyond[0]))
    return Axes(vectors, within.beyond + rest)


def project(
    transfer: TransferTensor,
    metric: Metric,
    moments: Moments,
    *,
    allowed: float,
    least: tuple[int, int],
    most_light: int | None = None,
    memory_budget: int | None = None,
    memory: Memory | None = None,
    processes: Processes = ALONE,
) -> Projection:
    """Keep the axes that matter.

    Args:
        transfer: The tensor; read by blocks.
        metric: Of the moments.
        moments: Of the tensor.
        allowed: Energy that each mode may lose, in the scale of the moments.
        least: Axes of view and light that are kept in any case.
        most_light: Axes of light that are kept at most.
        memory_budget: Bytes of the projected points and what is made of them, if they must be in
            memory. Where ``allowed`` asks for more, fewer light axes are kept, and the result says
            what is lost.
        memory: What may be taken; points that do not fit lie in a temporary file.
        processes: Those that have points too.
    """
    memory = memory or Memory()
    like = _at_least_single(transfer.values[0:0].flatten())
    view = moments.view.enough(allowed, least[0])
    light = moments.light.enough(allowed, least[1])
    if most_light is not None:
        light = min(light, most_light)
    if memory_budget is not None:
        affordable = memory_budget // (_COPIES * transfer.num_points * view * like.element_size())
        light = max(least[1], min(light, affordable))
    view_axes = moments.view.vectors[:, :view]
    light_axes = moments.light.vectors[:, :light]
    by_view, by_light = laid_out(view_axes.to(like)), laid_out(light_axes.to(like))
    points = memory.empty((transfer.num_points, view, light), like)
    for some, weighed in _weighed(transfer, metric, memory):
        count, rows, _ = weighed.shape
        scaled = (weighed / moments.scale).flatten(0, 1)
        lit = steady_product(scaled, by_light).view(count, rows, light)
        across = lit.mT.reshape(-1, rows)
        points[some] = steady_product(across, by_view).view(count, light, view).mT
    beyond = float(moments.view.beyond[view] + moments.light.beyond[light])
    lost = beyond / (moments.squared_norm or 1.0)
    return Projection(Points(points, memory, processes), view_axes, light_axes, lost)


def _weighed(
    transfer: TransferTensor, metric: Metric, memory: Memory
) -> Iterator[tuple[slice, Float[Tensor, "points rows coeffs"]]]:
    """Blocks of points where errors are sums of squares, channels among the rows."""
    for some, values in transfer.blocks(memory.block_bytes):
        yield some, metric.weigh(_at_least_single(values)).flatten(1, 2)


def _at_least_single(values: Tensor) -> Tensor:
    return values.to(torch.promote_types(values.dtype, torch.float32))
