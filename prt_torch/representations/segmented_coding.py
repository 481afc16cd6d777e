"""What a file of segmented CPCA holds: codes, sparse where they are zero.

Representatives of transfer in Haar wavelets are mostly small. Rounded to multiples of a step, most
become zero, and a file holds the others only: in blocks of rows, each column says how many
nonzeros it has and in which rows. Few rows are listed, one byte each, so a block has no more rows
than a byte can count; many are marked, one bit for each row of the block. Most codes fit a byte as
well; a code that does not is marked, and stands in a list of its own.

Source:
    Liu, Sloan, Shum, Snyder 2004, section 5 ("sparse column coding in blocks of 256 rows"). Blocks
    of 255 rows, so that a count is a byte too, marks for columns of many nonzeros, and one-byte
    values are ours.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Int8, Int16, UInt8
from torch import Tensor

from prt_torch.quantize import dequantize, least_unsigned, quantize
from prt_torch.representations.segmented_encoding import FIRST
from prt_torch.representations.segmented_quantisation import Encoding

_BLOCK_ROWS = 255
_MARK_BYTES = 32  # of a column; above so many nonzeros it takes less than a list of them
_ESCAPE = -128  # of a byte: the code stands in the list of those that do not fit
_BITS = 16


def pack(encoding: Encoding) -> dict[str, Tensor]:
    """Codes, steps and places of all segments.

    ``labels``: ``"segments points"`` (see ``SegmentEncoding``); ``clusters`` of each segment;
    ``ranks`` of each cluster; ``column_counts``, ``row_numbers``, ``row_marks``, ``codes`` and
    ``escapes``: the representatives (:class:`SparseColumns`), with ``representative_steps``;
    ``weight_codes`` with ``weight_steps``.
    """
    codes = quantize(encoding.representatives, encoding.vector_steps, encoding.bits).flatten(1)
    sparse = [encode_columns(some) for some in codes.split(encoding.vectors.tolist())]
    most = int(encoding.clusters.max())
    return {
        "labels": least_unsigned(encoding.labels, most + FIRST - 1),
        "clusters": encoding.clusters.int(),
        "ranks": least_unsigned(encoding.ranks, int(encoding.ranks.max()) if most else 0),
        "column_counts": torch.cat([one.counts for one in sparse]),
        "row_numbers": torch.cat([one.rows for one in sparse]),
        "row_marks": torch.cat([one.marks for one in sparse]),
        "codes": torch.cat([one.codes for one in sparse]),
        "escapes": torch.cat([one.escapes for one in sparse]),
        "representative_steps": encoding.representative_steps.clone(),
        "weight_codes": quantize(encoding.weights, encoding.entry_steps, encoding.bits),
        "weight_steps": encoding.weight_steps.clone(),
    }


def unpack(packed: dict[str, Tensor], channels: int, rows: int, coeffs: int) -> Encoding:
    """The inverse of :func:`pack` for transfer of a shape; ``coeffs`` are those of a segment."""
    steps = packed["weight_steps"]
    shape = (channels, rows, coeffs)
    empty = Encoding(
        labels=packed["labels"].int(),
        ranks=packed["ranks"].long(),
        clusters=packed["clusters"].long(),
        representatives=steps.new_zeros(0, *shape),
        weights=steps.new_zeros(0),
        representative_steps=packed["representative_steps"],
        weight_steps=steps,
        bits=_BITS,
        condition=float("nan"),
    )
    sparse = SparseColumns(
        *(
            packed[name]
            for name in (
                "column_counts",
                "row_numbers",
                "row_marks",
                "codes",
                "escapes",
            )
        )
    )
    codes = decode_columns(sparse, empty.vectors.tolist(), channels * rows * coeffs)
    vectors = codes.unflatten(1, shape)
    return replace(
        empty,
        representatives=dequantize(vectors, empty.vector_steps, steps.dtype),
        weights=dequantize(packed["weight_codes"], empty.entry_steps, steps.dtype),
    )


@dataclass(frozen=True)
class SparseColumns:
    """Nonzero codes of matrices, one segment after the other, blocks of rows within.

    Attributes:
        counts: Nonzeros of each column of each block.
        rows: Row in its block of each nonzero, column by column, of columns with few.
        marks: A bit for each row, most significant first, of columns with many.
        codes: The nonzeros, or a mark where they do not fit a byte.
        escapes: Those that do not, in order.
    """

    counts: UInt8[Tensor, "columns"]
    rows: UInt8[Tensor, "listed"]
    marks: UInt8[Tensor, "marked 32"]
    codes: Int8[Tensor, "nonzeros"]
    escapes: Int16[Tensor, "escapes"]


def encode_columns(codes: Int16[Tensor, "vectors values"]) -> SparseColumns:
    """Nonzeros of one segment's codes."""
    blocks = -(-len(codes) // _BLOCK_ROWS)
    filled = torch.nn.functional.pad(codes, (0, 0, 0, blocks * _BLOCK_ROWS - len(codes)))
    columns = (
        filled.view(blocks, _BLOCK_ROWS, codes.shape[1]).transpose(1, 2).reshape(-1, _BLOCK_ROWS)
    )
    used = columns != 0
    values = columns[used]
    fits = (values > _ESCAPE) & (values < -_ESCAPE)
    counts = used.sum(1)
    many = counts > _MARK_BYTES
    return SparseColumns(
        counts=counts.to(torch.uint8),
        rows=torch.nonzero(used[~many])[:, 1].to(torch.uint8),
        marks=_mark(used[many]),
        codes=torch.where(fits, values, _ESCAPE).to(torch.int8),
        escapes=values[~fits],
    )


def decode_columns(
    sparse: SparseColumns, vectors: list[int], num_values: int
) -> Int16[Tensor, "vectors values"]:
    """The inverse of :func:`encode_columns` for segments one after the other.

    Args:
        sparse: Their columns.
        vectors: Rows of each segment.
        num_values: Columns of all of them.
    """
    values = sparse.codes.to(torch.int16)
    values[sparse.codes == _ESCAPE] = sparse.escapes
    counts = sparse.counts.long()
    many = counts > _MARK_BYTES
    used = torch.zeros(len(counts), _BLOCK_ROWS, dtype=torch.bool, device=values.device)
    used[many] = _unmark(sparse.marks)
    few = torch.nonzero(~many)[:, 0]
    used[few.repeat_interleave(counts[few]), sparse.rows.long()] = True
    columns = torch.zeros(used.shape, dtype=torch.int16, device=values.device)
    columns[used] = values
    blocks = [-(-count // _BLOCK_ROWS) for count in vectors]
    by_block = columns.view(sum(blocks), num_values, _BLOCK_ROWS).transpose(1, 2)
    filled = zip(by_block.split(blocks), vectors, strict=True)
    return torch.cat(
        [some.reshape(len(some) * _BLOCK_ROWS, num_values)[:count] for some, count in filled]
    )


def _mark(used: Bool[Tensor, "columns rows"]) -> UInt8[Tensor, "columns 32"]:
    """A bit for each row."""
    padded = torch.nn.functional.pad(used, (0, 8 * _MARK_BYTES - _BLOCK_ROWS))
    return (padded.unflatten(1, (_MARK_BYTES, 8)) * _bits(used)).sum(2).to(torch.uint8)


def _unmark(marks: UInt8[Tensor, "columns 32"]) -> Bool[Tensor, "columns rows"]:
    """The inverse of :func:`_mark`."""
    used = (marks[:, :, None] & _bits(marks)) != 0
    return used.flatten(1)[:, :_BLOCK_ROWS]


def _bits(like: Tensor) -> UInt8[Tensor, "8"]:
    return torch.tensor([128, 64, 32, 16, 8, 4, 2, 1], dtype=torch.uint8, device=like.device)
