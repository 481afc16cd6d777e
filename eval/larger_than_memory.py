"""Peak memory, time and error of fits from shards under a budget.

    python eval/larger_than_memory.py KIND POINTSxROWSxCOEFFS BUDGET [FOLDER]

KIND is one of those below, BUDGET a share of the tensor's bytes or 0 for no limit. The tensor is
synthetic: 24 groups of points, each with twelve directions of falling strength, and noise. It is
kept in FOLDER (by default in the temporary folder) and used again.
"""

import multiprocessing
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from prt_torch import evaluate, store
from prt_torch.bases import Diffuse, Rowwise
from prt_torch.command import main
from prt_torch.errors import InputError
from prt_torch.representations import CPCA, ClusteredTensor
from prt_torch.transfer import Surface, TransferTensor

KINDS: dict[str, tuple[type[CPCA | ClusteredTensor], dict[str, Any]]] = {
    "cpca-16x2": (CPCA, {"num_clusters": 16, "rank": 2}),
    "cpca-64x4": (CPCA, {"num_clusters": 64, "rank": 4}),
    "cpca-8x4": (CPCA, {"num_clusters": 8, "rank": 4}),
    "tensor-16x1,8,2": (ClusteredTensor, {"num_clusters": 16, "ranks": (1, 8, 2)}),
    "tensor-32x8,12,8": (ClusteredTensor, {"num_clusters": 32, "ranks": (8, 12, 8)}),
    "tensor-4x4,12,8": (ClusteredTensor, {"num_clusters": 4, "ranks": (4, 12, 8)}),
}
GROUPS, DIRECTIONS, NOISE = 24, 12, 0.02
SHARD = 2**22  # values of a shard


def make(folder: Path, points: int, rows: int, coeffs: int) -> None:
    """The tensor's shards, if they are not there."""
    size, drawn = rows * coeffs, torch.Generator().manual_seed(1)
    falling = torch.exp(-6.0 * torch.arange(size) / size)
    centres = torch.randn(GROUPS, size, generator=drawn) * falling
    directions = 0.3 * torch.randn(GROUPS, DIRECTIONS, size, generator=drawn) * falling

    def block(some: slice) -> tuple[dict[str, torch.Tensor], dict[str, int | float]]:
        own, count = torch.Generator().manual_seed(some.start), some.stop - some.start
        group = torch.randint(GROUPS, (count,), generator=own)
        strength = torch.exp(-torch.arange(DIRECTIONS) / 4.0)
        weights = strength * torch.randn(count, DIRECTIONS, generator=own)
        values = NOISE * torch.randn(count, size, generator=own) + centres[group]
        for number in range(GROUPS):
            values[group == number] += weights[group == number] @ directions[number]
        return {"values": values.view(count, 1, rows, coeffs)}, {}

    per_shard = max(1, SHARD // size)
    store.build_sharded(block, rows=points, rows_per_shard=per_shard, inputs={}, folder=folder)


def kilobytes(name: str) -> int:
    """Of this process, as Linux counts them."""
    status = Path("/proc/self/status").read_text()
    return int(re.findall(rf"{name}:\s+(\d+)", status)[0])


@main
def measure(arguments: list[str]) -> None:
    """One fit."""
    match arguments:
        case [kind, shape, share, *folders] if kind in KINDS and re.fullmatch(
            r"\d+x\d+x\d+", shape
        ):
            points, rows, coeffs = (int(one) for one in shape.split("x"))
        case _:
            raise InputError(
                f"expected {' or '.join(KINDS)}, POINTSxROWSxCOEFFS, BUDGET and FOLDER"
            )
    folder = Path((folders or [f"{tempfile.gettempdir()}/larger-than-memory-{shape}"])[0])
    maker = multiprocessing.Process(target=make, args=(folder, points, rows, coeffs))
    maker.start()  # elsewhere, as memory that was used once is not counted again
    maker.join()
    surface = Surface(exit_basis=Rowwise(rows) if rows > 1 else Diffuse())
    transfer = TransferTensor(store.ShardedTensor(folder, "values"), surface)
    family, options = KINDS[kind]
    small = TransferTensor.from_dense(torch.randn(300, rows, min(coeffs, 40)))
    family.from_transfer(small, **options)  # what libraries load at first
    tensor = points * rows * coeffs * 4
    budget = int(float(share) * tensor)
    limit: dict[str, Any] = {"memory_budget": budget} if budget else {}
    Path("/proc/self/clear_refs").write_text("5")
    before, started = kilobytes("VmRSS"), time.process_time()
    model = family.from_transfer(transfer, **options, **limit)
    seconds, peak = time.process_time() - started, 1024 * (kilobytes("VmHWM") - before)
    error = evaluate.transfer_error(model, transfer)
    print(f"{kind} {shape}: tensor {tensor / 1e6:.0f} MB, budget {budget / 1e6:.1f}, peak", end=" ")
    print(f"{peak / 1e6:.1f}, {seconds:.1f} s of one core, squared error {error:.8e}")


if __name__ == "__main__":
    sys.exit(measure(sys.argv[1:]))
