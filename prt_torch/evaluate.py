"""What a representation is worth: errors, storage, time and memory. Pure functions."""

import statistics
import time
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from prt_torch.relight import Relighter
from prt_torch.representations import DenseTransfer, Representation
from prt_torch.transfer import Surface, TransferTensor

_BLOCK_BYTES = 2**27
_ERROR_BYTES = 2**25
_TIMED_POINTS = 2000  # of a tensor that does not fit


@torch.no_grad()
def squared_errors(
    representation: Representation, transfer: TransferTensor
) -> Float[Tensor, "points"]:
    """Squared L2 error of each point's transfer over the sphere of light directions, float64."""
    pieces = []
    for rows, values in transfer.blocks(_ERROR_BYTES):
        approximated = representation.dense(torch.arange(rows.start, rows.stop))
        pieces.append(transfer.squared_norm_of(approximated - values))
    return torch.cat(pieces)


def transfer_error(representation: Representation, transfer: TransferTensor) -> float:
    """Squared error over squared norm of the raw tensor in its own basis; 0 for a zero tensor."""
    norm = float(transfer.squared_norm().sum())
    return float(squared_errors(representation, transfer).sum()) / norm if norm > 0 else 0.0


def reference_error(squared_error: float, transfer: TransferTensor) -> float | None:
    """Squared error over squared norm of transfer at the full resolution it was baked at.

    What the light basis cut off counts too, so it compares across bases. The values are the
    orthogonal projection of the full transfer, so its squared error is what the projection lost
    plus what the representation loses. None where the full norm is not known.

    Args:
        squared_error: Sum of :func:`squared_errors` of a representation; 0 for the tensor itself.
        transfer: What it stands for.
    """
    if transfer.reference_squared_norm is None:
        return None
    full = float(transfer.reference_squared_norm.sum())
    lost = full - float(transfer.squared_norm().sum())
    return (max(lost, 0.0) + squared_error) / full if full > 0 else 0.0


@torch.no_grad()
def dense_radiance(
    transfer: TransferTensor,
    light: Float[Tensor, "batch coeffs rgb"],
    views: Float[Tensor, "views 3"] | None = None,
) -> Float[Tensor, "batch views points rgb"]:
    """Radiance of a tensor itself, reflectance included, read by blocks of points.

    Args:
        transfer: The tensor.
        light: Light coefficients.
        views: Where each viewer is, in mesh units; diffuse transfer needs none and gives one view.

    Raises:
        ValueError: If the tensor needs views and none are given.
    """
    pieces = []
    for rows in transfer.ranges(_BLOCK_BYTES):
        block = transfer.block(rows)
        relight = Relighter(DenseTransfer(block.dense(), block.surface))
        pieces.append(relight(light.to(transfer.values.dtype), views))
    return torch.cat(pieces, dim=2)


def seen_from(surface: Surface, views: Float[Tensor, "views 3"]) -> Bool[Tensor, "views points"]:
    """Which points have each viewer above their horizon; the others show nobody their radiance.

    Raises:
        ValueError: If the surface has no frames or positions.
    """
    if surface.frames is None or surface.positions is None:
        raise ValueError("this transfer has no frames and positions to tell where its points face")
    towards = views[:, None] - surface.positions.to(views)
    return (surface.frames[:, 2].to(views) * towards).sum(-1) > 0


def radiance_error(
    radiance: Float[Tensor, "... points rgb"], reference: Float[Tensor, "... points rgb"]
) -> float:
    """Relative root mean square over points, views and colours; 0 where both are black."""
    norm = float(reference.double().square().sum())
    error = float((radiance.double() - reference.double()).square().sum())
    if norm == 0:
        return 0.0 if error == 0 else float("inf")
    return (error / norm) ** 0.5


def median_seconds(
    functions: Sequence[Callable[[], Any]], *, rounds: int = 15, warm_up: int = 3
) -> list[float]:
    """Median time of each function, called in turn so that a drifting machine favours none."""
    times: list[list[float]] = [[] for _ in functions]
    for round_ in range(warm_up + rounds):
        for function, taken in zip(functions, times, strict=True):
            start = time.perf_counter()
            function()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            if round_ >= warm_up:
                taken.append(time.perf_counter() - start)
    return [statistics.median(taken) for taken in times]


def timed_block(transfer: TransferTensor, memory_budget: int) -> tuple[TransferTensor, float]:
    """What stands for an uncompressed tensor where it is timed, and what its times count for.

    Args:
        transfer: The tensor.
        memory_budget: Bytes; where the tensor takes more than half of them, 2,000 points are timed.

    Returns:
        The block, and points of the tensor over its points.
    """
    fits = transfer.num_bytes <= memory_budget // 2
    points = transfer.num_points if fits else min(_TIMED_POINTS, transfer.num_points)
    return transfer.block(slice(0, points)), transfer.num_points / points


def peak_bytes(function: Callable[[], Any]) -> int:
    """Most bytes that tensors made inside ``function`` hold at one time.

    Counts storages, not the private workspaces of kernels.
    """
    meter = _Meter()
    with meter:
        function()
    return meter.peak


class _Meter(TorchDispatchMode):
    """Adds up the storages that operations make and takes off those that are freed."""

    def __init__(self) -> None:
        super().__init__()
        self.held, self.peak = 0, 0
        self._known: set[int] = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        given = {
            leaf.untyped_storage()._cdata
            for leaf in tree_leaves((args, kwargs))
            if isinstance(leaf, Tensor)
        }
        result = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(result):
            if isinstance(leaf, Tensor):
                self._count(leaf.untyped_storage(), given)
        return result

    def _count(self, storage: torch.UntypedStorage, given: set[int]) -> None:
        key = storage._cdata
        if key in given or key in self._known:
            return
        self._known.add(key)
        size = storage.nbytes()
        self.held += size
        self.peak = max(self.peak, self.held)
        weakref.finalize(storage, self._free, key, size)

    def _free(self, key: int, size: int) -> None:
        self._known.discard(key)
        self.held -= size
