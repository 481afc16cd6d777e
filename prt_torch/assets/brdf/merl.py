r"""Materials of the MERL database, ``.binary``: isotropic tables over half and difference angles.

90 bins of :math:`\theta_h` whose width grows with the angle (equal in its square root), 90 bins of
1 degree of :math:`\theta_d` and 180 of :math:`\phi_d` over half a turn, as the two directions may
be exchanged; three channels with a scale each. Values are taken to hold at the middles of bins and
are interpolated between them, where the database's own reader takes the value of the bin. So both
agree at the middles, and the material has no steps and has gradients. Negative values mark bins
that were not measured, for the most part beyond the horizon: they weigh nothing, and where all
eight bins around a pair are such, the value is zero.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.assets.brdf.angles import half_difference, trilinear
from prt_torch.assets.brdf.measured import MeasuredBRDF, check_values
from prt_torch.errors import InputError

_BINS = (90, 90, 180)
_SCALES = (1.0 / 1500.0, 1.15 / 1500.0, 1.66 / 1500.0)
_BYTES = 12 + 8 * 3 * math.prod(_BINS)
_LEAST_WEIGHT = 1e-6  # below this share of measured bins a value fades to zero, without a step


@dataclass(frozen=True)
class MERL(MeasuredBRDF):
    """A material of the MERL database.

    Args:
        path: The ``.binary`` file.
        sha256: What the file's hash must be; None takes the file as it is.

    Raises:
        InputError: If the file is missing, malformed, or not the one that ``sha256`` names.

    Source:
        :cite:`matusik2003data`; layout and scales as in the database's ``BRDFRead.cpp``, which does
        not interpolate.
    """

    name: ClassVar[str] = "merl"

    def _read(self, path: Path, data: bytes) -> dict[str, Tensor]:
        if len(data) < 12:
            raise InputError(f"{path}: truncated, {len(data)} bytes are less than a MERL header")
        bins = tuple(np.frombuffer(data, "<i4", 3).tolist())
        if bins != _BINS:
            raise InputError(f"{path}: dimensions: expected {_BINS}, got {bins}")
        if len(data) != _BYTES:
            raise InputError(f"{path}: expected {_BYTES} bytes, got {len(data)}")
        raw = np.frombuffer(data, "<f8", offset=12).reshape(3, *_BINS)
        values = check_values(path, "values", raw, -1e9, 1e9)
        measured = np.all(values >= 0.0, axis=0)
        if not measured.any():
            raise InputError(f"{path}: values: all {measured.size} bins are marked as not measured")
        object.__setattr__(self, "_invalid_bins", int((~measured).sum()))
        table = np.zeros((*_BINS[:2], _BINS[2] + 2, 4))
        inner = table[:, :, 1:-1]
        for channel, scale in enumerate(_SCALES):
            np.multiply(values[channel], scale, where=measured, out=inner[..., channel])
        inner[..., 3] = measured
        # Half a turn on, the first bin follows the last.
        table[:, :, 0], table[:, :, -1] = table[:, :, -2], table[:, :, 1]
        return {"table": torch.from_numpy(table)}

    def _look_up(
        self, wi: Float[Tensor, "pairs 3"], wo: Float[Tensor, "pairs 3"]
    ) -> Float[Tensor, "pairs rgb"]:
        half, difference, turn = half_difference(wi, wo)
        quarter = 0.5 * math.pi
        found = trilinear(
            self._tables_like(wi)["table"],
            (half / quarter).sqrt() * _BINS[0] - 0.5,
            difference * (_BINS[1] / quarter) - 0.5,
            turn.remainder(math.pi) * (_BINS[2] / math.pi) + 0.5,
        )
        return found[..., :3] / found[..., 3:].clamp(min=_LEAST_WEIGHT)

    @property
    def num_invalid_bins(self) -> int:
        """Bins that the file marks as not measured, of 1,458,000."""
        return self.__dict__["_invalid_bins"]

    @property
    def isotropic(self) -> bool:
        """True: the azimuth of the half vector is not in the table."""
        return True

    @property
    def reciprocal(self) -> bool:
        """True: half a turn of the difference angle is the same bin."""
        return True
