"""Rows that do not fit in memory, kept in a temporary file for as long as they are needed.

The file has no name, so nothing is left of it whatever happens to the process. It lies where
Python's ``tempfile`` puts files (``TMPDIR``), which should be a disk, not memory.
"""

import math
import os
import tempfile

import torch
from jaxtyping import Shaped
from torch import Tensor

from prt_torch.errors import InputError


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
            self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115: lives as long as self
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


def _bytes_of(values: Tensor) -> memoryview:
    return memoryview(values.flatten().view(torch.uint8).numpy())
