"""What a representation is worth: errors, storage, time and memory. Pure functions."""

import statistics
import time
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from prt_torch.representations import Representation
from prt_torch.transfer import TransferTensor

_BLOCK_BYTES = 2**27


def squared_errors(
    representation: Representation, transfer: TransferTensor
) -> Float[Tensor, "points"]:
    """Squared L2 error of each point's transfer over the sphere of light directions, float64."""
    pieces = []
    with torch.no_grad():
        for rows, values in transfer.blocks(_BLOCK_BYTES):
            points = torch.arange(rows.start, rows.stop)
            difference = representation.dense(points).double() - values
            pieces.append(transfer.squared_norm_of(difference))
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


def dense_radiance(
    transfer: TransferTensor, light: Float[Tensor, "batch coeffs rgb"]
) -> Float[Tensor, "batch points rgb"]:
    """Radiance of a diffuse tensor itself, reflectance included, read by blocks of points.

    Raises:
        ValueError: If the tensor has several rows, which need views.
    """
    if transfer.num_rows != 1:
        raise ValueError(f"expected diffuse transfer, got {transfer.num_rows} rows")
    equation = "pci,bic->bpc" if transfer.num_channels == 3 else "pzi,bic->bpc"
    pieces = [
        torch.einsum(equation, values[:, :, 0], light.to(values))
        for _, values in transfer.blocks(_BLOCK_BYTES)
    ]
    return torch.cat(pieces, dim=1) * transfer.surface.reflectance.to(light)


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
