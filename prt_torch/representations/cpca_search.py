"""How many clusters, and of what rank, for a limit of error, bytes or time.

One clustering by distance for each number of clusters in a ladder gives, by the spectra of its
clusters, the error at every rank at once. Clusters made for their subspaces lose less, the more
so the higher the rank: a rule of thumb says by how much, and what true encodings are found to lose
corrects it. At most four of these are made.
"""

import itertools
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.errors import InputError
from prt_torch.metric import Metric
from prt_torch.representations.base import Representation
from prt_torch.representations.cpca_clusters import count_distinct, vector_quantise
from prt_torch.representations.cpca_encoding import MAX_DIMENSIONS, Encoding
from prt_torch.representations.cpca_projection import project, weighed_blocks
from prt_torch.representations.cpca_subspaces import one_thread
from prt_torch.representations.grouped import ClusterBlocks, sort_labels
from prt_torch.representations.palette import reflectance_bytes
from prt_torch.transfer import TransferTensor

_MOST_CLUSTERS = 2048
_MOST_RANKS = 24  # of several clusters: more cost more at run time than they are worth
_MOST_POINTS = 2**16  # looked at for the table
_STEPS = 8  # between two numbers of clusters of the table
_ENCODINGS = 4
_MARGIN = 1.02  # by which an estimate must keep the limit
_DOUBT = 2.0  # the same, for the last encoding when none has kept it
_GAIN_RANK = 6.0  # at which clusters made for their subspaces lose half of what others do
_CALLS = 7  # whose median is the time of a shape
_BLOCK_BYTES = 2**24

Model = TypeVar("Model", bound=Representation)


@dataclass(frozen=True, order=True)
class Shape:
    """Clusters, and vectors of each beside its mean."""

    num_clusters: int
    rank: int


def search(
    transfer: TransferTensor,
    *,
    make: Callable[[Shape], Model],
    mock: Callable[[Shape], Model],
    max_error: float | None,
    max_bytes: int | None,
    max_relight_seconds: float | None,
    static: bool,
    metric: Metric,
    generator: torch.Generator,
) -> Model:
    """The best encoding within one limit.

    Args:
        transfer: What is encoded.
        make: A true encoding.
        mock: A model of a shape with random content, to time.
        max_error: Squared error over squared norm in the metric.
        max_bytes: Of storage.
        max_relight_seconds: Of one call for one light.
        static: Whether true encodings keep the clusters of distance alone.
        metric: What errors are worth.
        generator: Source of randomness.

    Raises:
        ValueError: If not exactly one limit is given.
        InputError: If the limit cannot be kept.
    """
    limits = [max_error, max_bytes, max_relight_seconds]
    if sum(limit is not None for limit in limits) != 1:
        raise ValueError(
            "expected exactly one of max_error, max_bytes, max_relight_seconds, got "
            f"{max_error}, {max_bytes}, {max_relight_seconds}"
        )
    if any(limit is not None and not 0 <= limit < math.inf for limit in limits):
        raise InputError(f"expected a finite limit of at least 0, got {limits}")
    attempts = _Attempts(transfer, metric, make)
    table = error_table(transfer, metric, generator)
    if not static:
        table = {
            shape: error / (1.0 + shape.rank / _GAIN_RANK) if shape.num_clusters > 1 else error
            for shape, error in table.items()
        }
    if max_error is not None:
        return _least_bytes(_between(table), attempts, max_error)
    if max_bytes is not None:
        storage = StorageBytes(transfer)
        inside = {s: e for s, e in _between(table).items() if storage(s) <= max_bytes}
        if not inside:
            smallest = storage(Shape(1, 0))
            raise InputError(f"max_bytes {max_bytes}: the smallest encoding takes {smallest}")
        return _least_error(inside, attempts)
    inside = _fast_enough(table, transfer, mock, float(max_relight_seconds or 0.0))
    return _least_error(inside, attempts)


class StorageBytes:
    """Bytes of encodings of equal ranks: weights, representatives, labels, reflectance."""

    def __init__(self, transfer: TransferTensor):
        self._points = transfer.num_points
        self._values = transfer.num_channels * transfer.num_rows * transfer.num_coeffs
        self._itemsize = transfer.values.dtype.itemsize
        self._reflectance = reflectance_bytes(transfer.surface.reflectance)

    def __call__(self, shape: Shape) -> int:
        """Of an encoding of this shape."""
        clusters, rank = shape.num_clusters, shape.rank
        numbers = self._points * rank + clusters * (rank + 1) * self._values
        label = 1 if clusters <= 2**8 else 2 if clusters <= 2**15 else 4
        return numbers * self._itemsize + self._points * label + self._reflectance


def error_table(
    transfer: TransferTensor, metric: Metric, generator: torch.Generator
) -> dict[Shape, float]:
    """Estimated squared error over squared norm of every shape considered.

    Clusters are those of distance alone, so iterative encodings lose less.
    """
    data = project(transfer, metric, MAX_DIMENSIONS, generator).points.dense()
    norm = sum(float(v.double().square().sum()) for _, v in weighed_blocks(transfer, metric))
    lost = max(0.0, norm - float(data.double().square().sum()))  # beyond the projection
    if lost < 1e-6 * norm:
        lost = 0.0  # rounding
    num_points = len(data)
    if num_points > _MOST_POINTS:
        order = torch.randperm(num_points, generator=generator)[:_MOST_POINTS]
        data = data[order.to(data.device)]
    data = data - data.mean(0, dtype=torch.float64).to(data)
    most = min(count_distinct(data), _MOST_CLUSTERS)
    scale = num_points / len(data) / (norm or 1.0)
    table: dict[Shape, float] = {}
    for clusters in {min(2**step, most) for step in range(_MOST_CLUSTERS.bit_length())}:
        labels, made = vector_quantise(data, clusters, generator, rough=True)
        ranks = data.shape[1] if made == 1 else min(data.shape[1], _MOST_RANKS)
        for rank, error in enumerate(_errors_by_rank(data, labels, made, ranks).tolist()):
            table[Shape(made, rank)] = error * scale + (lost / norm if norm else 0.0)
    return table


def _between(table: dict[Shape, float]) -> dict[Shape, float]:
    """The table with further numbers of clusters.

    Straight lines between: errors fall ever slower with more clusters, so this errs on the safe
    side, also where the last clusters hold one point each and the error ends at zero.
    """
    out = dict(table)
    ladder = sorted({shape.num_clusters for shape in table})
    for low, high in itertools.pairwise(ladder):
        for step in range(1, _STEPS):
            clusters = round(low * (high / low) ** (step / _STEPS))
            part = (clusters - low) / (high - low)
            for rank in range(_MOST_RANKS + 1):
                first, last = table.get(Shape(low, rank)), table.get(Shape(high, rank))
                if first is not None and last is not None and low < clusters < high:
                    out[Shape(clusters, rank)] = (1.0 - part) * first + part * last
    return out


def _errors_by_rank(
    data: Tensor, labels: Tensor, num_clusters: int, ranks: int
) -> Float[Tensor, "ranks"]:
    """Squared error of all clusters at rank 0, 1, ... up to ``ranks``, float64.

    Summed from the smallest squared singular values, so that small errors keep their digits.
    """
    labels, _ = sort_labels(labels, num_clusters)
    blocks = ClusterBlocks(labels, num_clusters)
    size = float(data.abs().max()) or 1.0
    slots = blocks.to_slots(data / size)
    means = blocks.sum(slots) / blocks.sizes().clamp_min(1)[:, None]
    slots = (slots - means.to(slots)[blocks.cluster_of_slot]) * blocks.filled[:, None]
    errors = torch.zeros(ranks + 1, dtype=torch.float64, device=data.device)
    for rows in blocks.by_bucket(slots):
        gram = rows @ rows.mT if rows.shape[1] < rows.shape[2] else rows.mT @ rows
        with one_thread():
            squares = torch.linalg.eigvalsh(gram.double()).clamp_min(0.0)
        tails = squares.sum(0).cumsum(0).flip(0)  # from the smallest up: what each rank leaves
        count = min(len(tails), ranks + 1)
        errors[:count] += tails[:count]
    return errors * size**2


class _Attempts(dict[Shape, tuple[Model, float]]):
    """True encodings made so far with their errors."""

    def __init__(self, transfer: TransferTensor, metric: Metric, make: Callable[[Shape], Model]):
        super().__init__()
        self.transfer, self.metric, self.encode = transfer, metric, make

    def __missing__(self, shape: Shape) -> tuple[Model, float]:
        model = self.encode(shape)
        self[shape] = model, relative_error(model, self.transfer, self.metric)
        return self[shape]


@torch.no_grad()
def relative_error(model: Representation, transfer: TransferTensor, metric: Metric) -> float:
    """Squared error over squared norm in the metric; 0 where both are zero."""
    error, norm = 0.0, 0.0
    for rows, values in transfer.blocks(_BLOCK_BYTES):
        points = torch.arange(rows.start, rows.stop, device=values.device)
        difference = metric.weigh(model.dense(points).double() - values.double())
        error += float(difference.square().sum())
        norm += float(metric.weigh(values.double()).square().sum())
    return error / (norm or 1.0)


def _least_error(inside: dict[Shape, float], attempts: _Attempts[Model]) -> Model:
    """The best of the estimate and its neighbours in rank, each with its best cluster number."""
    by_rank: dict[int, Shape] = {}
    for shape in sorted(inside):
        known = by_rank.get(shape.rank)
        if known is None or inside[shape] < inside[known]:
            by_rank[shape.rank] = shape
    ladder = [by_rank[rank] for rank in sorted(by_rank)]
    at = min(range(len(ladder)), key=lambda index: inside[ladder[index]])
    for _ in range(_ENCODINGS):
        around = ladder[max(0, at - 1) : at + 2]
        new = [s for s in (ladder[at], *around) if s not in attempts]
        if not new or len(attempts) == _ENCODINGS:
            break
        attempts[new[0]]
        at = ladder.index(min(attempts, key=lambda shape: attempts[shape][1]))
    return attempts[ladder[at]][0]


def _least_bytes(table: dict[Shape, float], attempts: _Attempts[Model], max_error: float) -> Model:
    """The smallest encoding that keeps the error; each attempt corrects the estimates."""
    storage, ratio = StorageBytes(attempts.transfer), 1.0
    best: Model | None = None
    for turn in range(_ENCODINGS):
        most = math.inf if best is None else sum(best.storage().values())
        doubt = _DOUBT if best is None and turn == _ENCODINGS - 1 else _MARGIN
        options = [
            shape
            for shape, error in table.items()
            if shape not in attempts
            and storage(shape) < most
            and error * (ratio if shape.num_clusters > 1 else 1.0) * doubt <= max_error
            and not any(
                shape.num_clusters <= seen.num_clusters and shape.rank <= seen.rank
                for seen, (_, lost) in attempts.items()
                if lost > max_error
            )
        ]
        if not options and best is not None:
            break
        if options:
            shape = min(options, key=lambda shape: (storage(shape), shape))
        else:
            shape = min(table, key=lambda shape: (table[shape], storage(shape)))
        model, error = attempts[shape]
        if table[shape] > 0 and error > 0 and shape.num_clusters > 1:
            ratio = error / table[shape]
        if error <= max_error:
            best = model
    if best is None:
        least = min(error for _, error in attempts.values())
        raise InputError(f"max_error {max_error:g}: the least error found is {least:.3g}")
    return best


def _fast_enough(
    table: dict[Shape, float],
    transfer: TransferTensor,
    mock: Callable[[Shape], Model],
    max_seconds: float,
) -> dict[Shape, float]:
    """For each number of clusters the largest rank that keeps the time, if any does."""
    storage, inside, fastest = StorageBytes(transfer), {}, math.inf
    for clusters in sorted({shape.num_clusters for shape in table}):
        ranks = [
            shape.rank
            for shape in table
            if shape.num_clusters == clusters
            and (shape.rank == 0 or storage(shape) <= transfer.num_bytes)
        ]
        low, high = 0, max(ranks) + 1  # the first rank not known to be fast, the first not to be
        while low < high:
            middle = (low + high) // 2 if low else min(2, (low + high) // 2)
            seconds = _median_seconds(mock(Shape(clusters, middle)), transfer)
            fastest = min(fastest, seconds)
            low, high = (middle + 1, high) if seconds <= max_seconds else (low, middle)
        if low > 0:
            inside[Shape(clusters, low - 1)] = table[Shape(clusters, low - 1)]
    if not inside:
        raise InputError(
            f"max_relight_seconds {max_seconds:g}: the fastest encoding takes {fastest:.3g}"
        )
    return inside


@torch.no_grad()
def _median_seconds(model: Representation, transfer: TransferTensor) -> float:
    some = transfer.values[0:1]
    light = torch.ones(1, transfer.num_coeffs, 3, dtype=some.dtype, device=some.device)
    seconds = []
    for _ in range(_CALLS + 2):
        start = time.perf_counter()
        float(model(light)[0, 0, 0, 0])  # waits for an accelerator
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[2:])


def random_encoding(transfer: TransferTensor, shape: Shape) -> Encoding:
    """Random content of a shape, where only time matters."""
    generator = torch.Generator().manual_seed(0)
    some = transfer.values[0:1]
    values = some.numel()
    labels = torch.randint(shape.num_clusters, (transfer.num_points,), generator=generator)
    vectors = shape.num_clusters * (shape.rank + 1)
    return Encoding(
        labels=sort_labels(labels, shape.num_clusters)[0].to(some.device),
        ranks=torch.full((shape.num_clusters,), shape.rank, device=some.device),
        representatives=torch.randn(vectors, values, generator=generator).to(some),
        weights=torch.randn(transfer.num_points * shape.rank, generator=generator).to(some),
        affine=True,
        condition=1.0,
    )
