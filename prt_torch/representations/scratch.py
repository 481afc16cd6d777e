"""A budget of memory, and rows that do not fit in it, kept in a temporary file.

The file has no name, so nothing is left of it whatever happens to the process. It lies where
Python's ``tempfile`` puts files (``TMPDIR``), which should be a disk, not memory.
"""

import math
import os
import tempfile
from dataclasses import dataclass

import torch
from jaxtyping import Shaped
from torch import Tensor

from prt_torch.errors import InputError
from prt_torch.representations.steady import STEADY_ROWS

# Shares of the memory that is free. Together they leave a third of it: what is freed between other
# things is not given back to the system.
_CHUNK_SHARE = 40  # 16 copies of a chunk may be alive at once
_BLOCK_SHARE = 32  # reading takes a block three times over
_TABLE_SHARE = 12
_RESIDENT_SHARE = 12  # of one set of values of all points, which is kept in a file if it is larger

_BLOCK_BYTES = 2**26  # of values that are read together at most
_LEAST_CHUNK = 2**15  # bytes; smaller ones would take hours
_OWN = 4 * 2**20  # bytes that libraries take for themselves


class ScratchRows:
    """Rows on disk, read and written by slices; what was not written is zero.

    Args:
        shape: Of the whole.
        like: Type and device of the elements.

    Raises:
        InputError: If there is no room for them.
    """

    def __init__(self, shape: tuple[int, ...], like: Tensor):
        self.shape, self.dtype, self._device = shape, like.dtype, like.device
        self._row_bytes = math.prod(shape[1:]) * like.element_size()
        try:
            # It lives as long as this object.
            self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
            os.truncate(self._file.fileno(), shape[0] * self._row_bytes)
        except OSError as error:
            raise self._no_room(error) from error

    def __getitem__(self, rows: slice, /) -> Shaped[Tensor, "some *rest"]:
        start, stop, _ = rows.indices(self.shape[0])
        out = torch.empty((stop - start, *self.shape[1:]), dtype=self.dtype)
        view, at = _bytes_of(out), start * self._row_bytes
        while len(view):
            count = os.preadv(self._file.fileno(), [view], at)
            if count == 0:
                raise InputError("memory_budget: the temporary file of the fit was cut short")
            view, at = view[count:], at + count
        return out.to(self._device)

    def __setitem__(self, rows: slice, values: Shaped[Tensor, "some *rest"]) -> None:
        start, stop, _ = rows.indices(self.shape[0])
        if values.shape != (stop - start, *self.shape[1:]):
            raise ValueError(f"expected {stop - start} rows, got shape {tuple(values.shape)}")
        view = _bytes_of(values.detach().to("cpu", self.dtype).contiguous())
        at = start * self._row_bytes
        try:
            while len(view):
                count = os.pwrite(self._file.fileno(), view, at)
                view, at = view[count:], at + count
        except OSError as error:
            raise self._no_room(error) from error

    def __del__(self) -> None:
        if hasattr(self, "_file"):
            self._file.close()

    def _no_room(self, error: OSError) -> InputError:
        return InputError(
            f"memory_budget: {tempfile.gettempdir()}: a temporary file of "
            f"{self.shape[0] * self._row_bytes} bytes is needed beside memory ({error.strerror}); "
            "set TMPDIR to a folder with room"
        )


@dataclass(frozen=True)
class Memory:
    """What a fit may take at its peak, beside what was there before.

    Attributes:
        budget: Bytes; None for as much as there is.
        reserved: Bytes of it that are spoken for: labels, weights, sums.
    """

    budget: int | None = None
    reserved: int = 0

    def __post_init__(self) -> None:
        least = self.reserved + _OWN + _CHUNK_SHARE * _LEAST_CHUNK
        if self.budget is not None and self.budget < least:
            raise InputError(
                f"memory_budget: this fit needs at least {least} bytes, got {self.budget}"
            )

    @property
    def chunk_bytes(self) -> int | None:
        """Bytes of points that are worked on together; None for all of them."""
        return None if self.budget is None else self._free // _CHUNK_SHARE

    @property
    def block_bytes(self) -> int:
        """Bytes of values that are read together; reading takes them three times over."""
        return (
            _BLOCK_BYTES if self.budget is None else min(_BLOCK_BYTES, self._free // _BLOCK_SHARE)
        )

    @property
    def table_bytes(self) -> int | None:
        """Bytes that one large table may take."""
        return None if self.budget is None else self._free // _TABLE_SHARE

    @property
    def _free(self) -> int:
        return (self.budget or 0) - self.reserved - _OWN

    def fits(self, nbytes: int) -> bool:
        """Whether something of this size may be in memory for a while."""
        return self.budget is None or nbytes <= self._free // 2

    def rows_at_once(self, row_bytes: int) -> int | None:
        """Rows of a chunk: a whole number of steady blocks, unless these are too large."""
        if self.chunk_bytes is None:
            return None
        rows = self.chunk_bytes // row_bytes
        return max(1, rows if rows < STEADY_ROWS else rows // STEADY_ROWS * STEADY_ROWS)

    def empty(self, shape: tuple[int, ...], like: Tensor) -> Tensor | ScratchRows:
        """Room for rows, in memory if they are a small part of what is free."""
        nbytes = math.prod(shape) * like.element_size()
        if self.budget is None or nbytes <= self._free // _RESIDENT_SHARE:
            return like.new_empty(shape)
        return ScratchRows(shape, like)


def _bytes_of(values: Tensor) -> memoryview:
    return values.flatten().view(torch.uint8).numpy().data
