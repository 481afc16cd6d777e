"""Transfer of ordinary magnitude: squares of its values neither vanish nor overflow.

Fits compare squared errors. In float32 squares of values below 1e-22 lose digits and those above
1e19 are infinite, though the values themselves are as good as any. Times a power of two nothing is
rounded, so a fit of the product, divided again at the end, is the fit.
"""

import math

import torch

from prt_torch.representations.points import Mapped
from prt_torch.representations.processes import ALONE, Processes
from prt_torch.representations.scratch import Memory
from prt_torch.transfer import TransferTensor

_ORDINARY = 32  # powers of two by which the largest value may differ from 1


def of_ordinary_magnitude(
    transfer: TransferTensor, memory: Memory | None = None, processes: Processes = ALONE
) -> tuple[TransferTensor, float]:
    """The transfer times a power of two, and that power: 1 unless the values ask for another.

    Args:
        transfer: Read once.
        memory: What may be taken.
        processes: Those that have points too.
    """
    values = transfer.values
    largest = values[0:0].new_zeros(())
    for _, some in transfer.blocks((memory or Memory()).block_bytes):
        torch.maximum(largest, some.abs().amax(), out=largest)
    size = float(processes.largest(largest))
    exponent = math.frexp(size)[1] if math.isfinite(size) else 0
    if abs(exponent) <= _ORDINARY:
        return transfer, 1.0
    most = math.frexp(torch.finfo(values.dtype).max)[1] - 2
    power = math.ldexp(1.0, min(max(-exponent, -most), most))
    scaled = Mapped(values, lambda some: some * power, *values.shape[1:])
    return TransferTensor(scaled, transfer.surface), power
