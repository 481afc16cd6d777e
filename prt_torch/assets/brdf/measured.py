"""What measured materials share: a file that is read once, checked, and known by its hash.

A measured material is a table. Two of them are equal if their files hold the same bytes, so the
description is the path and the SHA-256 of the file; reading a description back checks that the
file is still the one described.
"""

import hashlib
import os
from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.assets.brdf.base import BRDF
from prt_torch.assets.input_file import read_input
from prt_torch.errors import InputError

_PAIRS_AT_ONCE = 2**15  # what a block computes stays in cache


@dataclass(frozen=True)
class MeasuredBRDF(BRDF):
    """A reflectance model that is a file of measurements.

    Args:
        path: The file.
        sha256: What the file's hash must be, in hexadecimal; None takes the file as it is.

    Raises:
        InputError: If the file is missing, malformed, or not the one that ``sha256`` names.
        ValueError: If an argument is of another type.
    """

    path: str | os.PathLike[str]
    sha256: str | None = None

    def __post_init__(self):
        if not isinstance(self.path, (str, os.PathLike)):
            raise ValueError(f"path: expected a file, got {self.path!r}")
        if not (self.sha256 is None or isinstance(self.sha256, str)):
            raise ValueError(f"sha256: expected hexadecimal digits, got {self.sha256!r}")
        path, data = read_input(self.path, f"{self.name} BRDF")
        found = hashlib.sha256(data).hexdigest()
        if self.sha256 not in (None, found):
            raise InputError(f"{path}: sha256: expected {self.sha256}, the file has {found}")
        object.__setattr__(self, "path", str(path))
        object.__setattr__(self, "sha256", found)
        tables = self._read(path, data)
        object.__setattr__(self, "_tables", {(torch.float64, torch.device("cpu")): tables})

    @abstractmethod
    def _read(self, path: Path, data: bytes) -> dict[str, Tensor]:
        """Check the file and make the tables of evaluation, float64."""

    @abstractmethod
    def _look_up(
        self, wi: Float[Tensor, "pairs 3"], wo: Float[Tensor, "pairs 3"]
    ) -> Float[Tensor, "pairs rgb"]:
        """Interpolated values, for directions whose z is at least 1e-7."""

    def _evaluate_above(
        self, wi: Float[Tensor, "*batch 3"], wo: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch channels"]:
        blocks = zip(
            wi.reshape(-1, 3).split(_PAIRS_AT_ONCE),
            wo.reshape(-1, 3).split(_PAIRS_AT_ONCE),
            strict=True,
        )
        values = torch.cat([self._look_up(*block) for block in blocks])
        return values.reshape(*wi.shape[:-1], 3)

    def _tables_like(self, like: Tensor) -> dict[str, Tensor]:
        """The tables in the type and on the device of the directions."""
        copies: dict[Any, dict[str, Tensor]] = self.__dict__["_tables"]
        key = (like.dtype, like.device)
        if key not in copies:
            original = next(iter(copies.values()))
            copies[key] = {name: table.to(like) for name, table in original.items()}
        return copies[key]

    @property
    def num_channels(self) -> int:
        """3: linear sRGB."""
        return 3

    def describe(self) -> dict[str, Any]:
        """``{"name": ..., "path": ..., "sha256": ...}``."""
        return {"name": self.name, "path": str(self.path), "sha256": self.sha256}


def check_values(path: Path, field: str, values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Values of a file, all finite and in ``low .. high``, as float64.

    Args:
        path: The file, for the message.
        field: What the values are, for the message.
        values: Of any shape.
        low: Least value.
        high: Greatest value.

    Raises:
        InputError: With the number of values that are not, and the first of them.
    """
    wrong = ~((values >= low) & (values <= high))  # a comparison with NaN is False
    if wrong.any():
        first = np.unravel_index(int(wrong.argmax()), values.shape)
        place = ", ".join(str(int(index)) for index in first)
        raise InputError(
            f"{path}: {field}: {int(wrong.sum())} of {values.size} values are not in "
            f"{low:g} to {high:g}, the first {values[first]:g} at [{place}]"
        )
    return values.astype(np.float64, copy=False)
