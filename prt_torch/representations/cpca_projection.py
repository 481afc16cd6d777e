"""One near-lossless projection of all points, found by reading them a few times.

Orthogonal iteration on the second moment of the values, from random directions: the directions of
most energy, without ever forming the moment. Directions are handled in tiles of rows, so that they
may lie in a file where they do not fit in memory.

Source:
    Halko, Martinsson, Tropp 2011, "Finding structure with randomness", algorithm 4.4.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.metric import Metric
from prt_torch.representations.exact_sums import ExactProducts
from prt_torch.representations.points import Points, slices
from prt_torch.representations.processes import ALONE, Processes
from prt_torch.representations.scratch import Memory, ScratchRows
from prt_torch.representations.steady import steady_product
from prt_torch.representations.whitening import whitening
from prt_torch.transfer import TransferTensor

_STEPS = 2  # the third lowered what is lost by 4 % on glossy transfer, from 4e-5 of the energy
_TILE = 1024  # rows of the directions
_ROWS = 64  # of values that are multiplied together at least, where memory allows
_JOINED_SHARE = 4  # of a chunk
Blocks = Callable[[], Iterator[tuple[slice, Tensor]]]
"""Reads ranges of rows with their values, ``"some values"``, from the first to the last."""


@dataclass(frozen=True)
class Projected:
    """Points in the space that clustering works in.

    Attributes:
        points: ``"points d"``.
        lift: ``"values d"``, orthonormal columns: the way back; None if nothing was cut.
    """

    points: Points
    lift: Tensor | ScratchRows | None

    def lifted(self, vectors: Float[Tensor, "some d"]) -> Float[Tensor, "some values"]:
        """Vectors among the values, in their type."""
        if self.lift is None:
            return vectors
        out = vectors.new_empty(len(vectors), self.lift.shape[0])
        for rows in _tiles(self.lift):
            out[:, rows] = vectors @ self.lift[rows].to(vectors).mT
        return out


def weighed_blocks(
    transfer: TransferTensor, metric: Metric, memory: Memory | None = None
) -> Iterator[tuple[slice, Float[Tensor, "points values"]]]:
    """Blocks of points where errors are sums of squares."""
    for rows, values in transfer.blocks((memory or Memory()).block_bytes):
        yield rows, metric.weigh(values).flatten(1)


def project(
    transfer: TransferTensor,
    metric: Metric,
    dimensions: int,
    generator: torch.Generator,
    memory: Memory | None = None,
    processes: Processes = ALONE,
) -> Projected:
    """Points in at most so many dimensions.

    Args:
        transfer: Read once where it has no more values a point, else six times or more.
        metric: What weighs it.
        dimensions: At most.
        generator: Source of the first directions.
        memory: What may be taken.
        processes: Those that have points too.
    """
    memory = memory or Memory()
    size = transfer.num_channels * transfer.num_rows * transfer.num_coeffs
    like = transfer.values[0:0].flatten()
    found = memory.empty((transfer.num_points, min(size, dimensions)), like)
    points = Points(found, memory, processes)
    if size <= dimensions:
        for rows, values in weighed_blocks(transfer, metric, memory):
            found[rows] = values
        return Projected(points, None)

    lift = directions(lambda: weighed_blocks(transfer, metric, memory), size, points, generator)
    return Projected(points, lift)


def directions(
    blocks: Blocks, size: int, points: Points, generator: torch.Generator
) -> Tensor | ScratchRows:
    """Orthonormal directions of most energy, ``"size d"``, the strongest first.

    Args:
        blocks: The rows.
        size: Values of a row.
        points: Are overwritten by the rows in these directions, ``"rows d"``.
        generator: Source of the first directions.
    """
    memory, width = points.memory, points.rest[0]
    lift = memory.empty((size, width), points.like)
    for rows in _tiles(lift):
        first = torch.randn(rows.stop - rows.start, width, generator=generator)
        lift[rows] = first.to(points.like)
    largest = points.like.new_zeros(size)
    for _, values in blocks():
        torch.maximum(largest, values.abs().amax(0), out=largest)
    largest = points.processes.largest(largest)
    images = memory.empty((size, width), points.like.double())
    for _ in range(_STEPS):
        _products(blocks, lift, points)
        _images(blocks, largest, points, images)
        _orthonormalise(images, lift)
    _products(blocks, lift, points)
    return lift


def _tiles(rows: Tensor | ScratchRows) -> Iterator[slice]:
    return slices(rows.shape[0], _TILE)


def _columns(
    blocks: Blocks, some: slice, points: Points
) -> Iterator[tuple[slice, Float[Tensor, "rows some"]]]:
    """Some columns of the values, of enough rows at a time where only few can be read together."""
    chunk_bytes = points.memory.chunk_bytes
    row_bytes = (some.stop - some.start) * points.like.itemsize
    rows_of_share = _ROWS if chunk_bytes is None else chunk_bytes // (_JOINED_SHARE * row_bytes)
    first, held, enough = 0, [], min(_ROWS, rows_of_share)
    for rows, values in blocks():
        own = values[:, some]
        held.append(own if len(own) >= enough else own.clone())  # all other columns may go
        if rows.stop - first >= enough:
            yield slice(first, rows.stop), _joined(held)
            first, held = rows.stop, []
    if held:
        yield slice(first, first + sum(map(len, held))), _joined(held)


def _joined(parts: list[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def _products(blocks: Blocks, lift: Tensor | ScratchRows, points: Points) -> None:
    """Write the rows' products with the directions to the points."""
    size, width = lift.shape
    table_bytes = points.memory.table_bytes
    tile_bytes = points.like.itemsize * width * _TILE
    tiles = size if table_bytes is None else table_bytes // (2 * tile_bytes)
    for some in slices(size, max(1, tiles) * _TILE):
        held = lift[some]
        for block, values in _columns(blocks, some, points):
            total = points.rows[block] if some.start else values.new_zeros(len(values), width)
            for tile in _tiles(held):
                total += steady_product(values[:, tile], held[tile])
            points.write(block, total)


def _images(
    blocks: Blocks,
    largest: Float[Tensor, "values"],
    points: Points,
    images: Tensor | ScratchRows,
) -> None:
    """Write the rows' transposed products with the points, summed over all, float64."""
    size, width = images.shape
    table_bytes, right = points.memory.table_bytes, points.largest()
    at_once = size if table_bytes is None else max(1, table_bytes // (8 * width))
    for some in slices(size, at_once):
        total = ExactProducts(largest[some], right, points.total, points.processes)
        for block, values in _columns(blocks, some, points):
            total.add(values, points.rows[block])
        images[some] = total.value()


def _orthonormalise(images: Tensor | ScratchRows, out: Tensor | ScratchRows) -> None:
    """Orthonormal columns of the same span, the strongest first; twice, which makes it exact."""
    for _ in range(2):
        gram = sum((images[rows].mT @ images[rows] for rows in _tiles(images)), torch.zeros(()))
        turn = whitening(gram.double()).flip(1)
        for rows in _tiles(images):
            images[rows] = images[rows] @ turn
    for rows in _tiles(images):
        out[rows] = images[rows].to(out.dtype)
