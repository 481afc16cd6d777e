"""Files that are whole or absent: atomic writes, sharded tensors, locks, digests.

The only module that writes results. Every file goes to a temporary name in its own folder, is
fsynced and renamed; a manifest with sizes and SHA-256 is written after what it lists, and reading
takes only what a manifest lists and its hash confirms. A run killed at any moment therefore leaves
complete files, a manifest that speaks of them, and at most one temporary file, which the next run
that locks the folder removes.
"""

import fcntl
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as encode_tensors
from torch import Tensor

from prt_torch.errors import InputError

_TEMPORARY = ".writing-"
MANIFEST = "manifest.json"


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path``; on success it is fsynced and renamed over ``path``.

    Raises:
        InputError: If the folder cannot be written or the disk is full; ``path`` is unharmed.
    """
    path = Path(path)
    temporary = path.with_name(f"{_TEMPORARY}{os.getpid()}-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_bytes(path: Path, data: bytes) -> None:
    """Write a whole file atomically."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically; NaN and infinity are refused, as JSON has neither."""
    write_bytes(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> Any:
    """Read JSON.

    Raises:
        InputError: If the file is missing or is not JSON.
    """
    try:
        return json.loads(Path(path).read_text())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise InputError(f"{path}: not a JSON file ({error})") from error


def write_tensors(
    path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Write named tensors as one safetensors file; returns its ``bytes`` and ``sha256``."""
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    header = {"metadata": json.dumps(metadata)} if metadata is not None else None
    data = encode_tensors(contiguous, header)
    write_bytes(path, data)
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def read_tensors(path: Path, sha256: str | None = None) -> tuple[dict[str, Tensor], Any]:
    """Read a safetensors file: tensors and metadata.

    Args:
        path: The file.
        sha256: Expected hash of the whole file, if known.

    Raises:
        InputError: If the file is missing, malformed, or its hash differs.
    """
    path = Path(path)
    if sha256 is not None and file_sha256(path) != sha256:
        raise InputError(f"{path}: SHA-256 differs from the one recorded; the file is damaged")
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = json.loads((file.metadata() or {}).get("metadata", "null"))
            # Cloned: tensors in the file's memory are not aligned, and sums over them may differ
            # in the last bit from the same sums over aligned ones.
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable safetensors file ({error})") from error
    return tensors, metadata


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes.

    Raises:
        InputError: If the file cannot be read.
    """
    try:
        with Path(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def digest(*parts: Any) -> str:
    """SHA-256 of tensors, arrays and JSON-like values, by content, shape and type."""
    total = hashlib.sha256()
    for part in parts:
        if isinstance(part, Tensor):
            part = part.detach().cpu().numpy()
        if isinstance(part, np.ndarray):
            total.update(f"{part.dtype.str}{part.shape}".encode())
            total.update(np.ascontiguousarray(part).tobytes())
        else:
            total.update(json.dumps(part, sort_keys=True).encode())
        total.update(b"\0")
    return total.hexdigest()


@contextmanager
def locked(folder: Path, *, what: str = "folder", wait: bool = False) -> Iterator[Path]:
    """Hold ``folder`` for this process alone, making it if need be.

    The lock is on the folder itself, so no lock file is left, and the kernel drops it when the
    process ends, however it ends. Temporary files of a killed writer are removed, those in
    subfolders by :func:`remove_temporaries`.

    Args:
        folder: The folder.
        what: What to call it in an error.
        wait: Wait for another holder instead of raising.

    A folder made here in which nothing was written is removed again.

    Raises:
        InputError: If another process holds the folder, or it cannot be made or written.
    """
    folder = Path(folder)
    descriptor, made = _open_locked(folder, what, wait)
    try:
        if not os.access(folder, os.W_OK):
            raise InputError(f"{folder}: {what} is not writable")
        remove_temporaries(folder)
        yield folder
    finally:
        if made:
            with suppress(OSError):  # not empty: something was written and stays
                folder.rmdir()
        os.close(descriptor)


def _open_locked(folder: Path, what: str, wait: bool) -> tuple[int, bool]:
    """A descriptor of the locked folder, and whether the folder was made here."""
    while True:
        try:
            made = not folder.exists()
            folder.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(folder, os.O_RDONLY)
        except OSError as error:
            raise InputError(f"{folder}: {what} cannot be made ({error.strerror})") from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            if os.path.samestat(os.fstat(descriptor), folder.stat()):
                return descriptor, made
        except BlockingIOError as error:
            os.close(descriptor)
            raise InputError(f"{folder}: {what} is in use by another run") from error
        except FileNotFoundError:
            pass
        except OSError as error:
            os.close(descriptor)
            raise InputError(f"{folder}: {what} cannot be locked ({error.strerror})") from error
        os.close(descriptor)  # the holder before removed the folder: what is locked is not there


def remove_temporaries(folder: Path) -> None:
    """Remove what killed writers left in a folder that is locked, or lies in a locked one."""
    for stray in folder.glob(f"{_TEMPORARY}*"):
        stray.unlink(missing_ok=True)


class ShardedTensor:
    """One named tensor of a sharded folder: blocks of its first dimension, a file a block.

    Blocks are read lazily and verified against the manifest the first time they are read. Slicing
    the first dimension reads only the blocks it touches.

    Args:
        folder: Where ``manifest.json`` and the shards lie.
        name: Which of the tensors in the shards.

    Raises:
        InputError: If there is no complete manifest, or what it lists is not there.
    """

    def __init__(self, folder: Path, name: str):
        self.folder, self.name = Path(folder), name
        manifest = read_json(self.folder / MANIFEST)
        if not manifest.get("complete"):
            raise InputError(f"{self.folder}: not complete; run the bake again to resume it")
        self.shape: tuple[int, ...] = (manifest["rows"], *manifest["tensors"][name]["shape"])
        self.dtype: torch.dtype = getattr(torch, manifest["tensors"][name]["dtype"])
        self._rows_per_shard = manifest["rows_per_shard"]
        self._shards = manifest["shards"]
        self._verified: set[str] = set()
        for shard, entry in self._shards.items():
            path = self.folder / shard
            if not path.is_file() or path.stat().st_size != entry["bytes"]:
                raise InputError(f"{path}: missing, or not the {entry['bytes']} bytes recorded")

    def __getitem__(self, rows: slice, /) -> Tensor:
        """Rows ``start:stop`` as one tensor."""
        start, stop, step = rows.indices(self.shape[0])
        if step != 1:
            raise ValueError(f"expected a slice with step 1, got {step}")
        size = self._rows_per_shard
        pieces = [
            self._read(shard, max(start - shard * size, 0), min(stop - shard * size, size))
            for shard in range(start // size, -(-stop // size))
        ]
        if not pieces:
            return torch.empty((0, *self.shape[1:]), dtype=self.dtype)
        return pieces[0] if len(pieces) == 1 else torch.cat(pieces)

    def _read(self, shard: int, start: int, stop: int) -> Tensor:
        file_name = shard_name(shard)
        path = self.folder / file_name
        if file_name not in self._verified:
            if file_sha256(path) != self._shards[file_name]["sha256"]:
                raise InputError(f"{path}: SHA-256 differs from the manifest; delete the folder")
            self._verified.add(file_name)
        with safe_open(str(path), framework="pt") as file:
            return file.get_slice(self.name)[start:stop]


def shard_name(shard: int) -> str:
    """File name of a shard."""
    return f"shard-{shard:06d}.safetensors"


@dataclass(frozen=True)
class Sharded:
    """What :func:`build_sharded` made.

    Attributes:
        tensors: Name to values, on disk or in memory.
        counts: Sums over all blocks of what was counted while making them.
        cached: Whether all of it was there already.
    """

    tensors: Mapping[str, ShardedTensor | Tensor]
    counts: dict[str, int | float]
    cached: bool


def build_sharded(
    make: Callable[[slice], tuple[dict[str, Tensor], dict[str, int | float]]],
    *,
    rows: int,
    rows_per_shard: int,
    inputs: Mapping[str, Any],
    folder: Path | None,
    progress: Callable[[int, int], None] | None = None,
) -> Sharded:
    """Make named tensors block by block, in a folder or in memory.

    In a folder, blocks that are there are not made again, so a killed build resumes and a finished
    one costs nothing. A second process that wants the same folder waits for the first.

    Args:
        make: Rows to tensors with that many rows, and what to count.
        rows: Length of the first dimension.
        rows_per_shard: Length of a block.
        inputs: What the content follows from, in plain JSON; written beside it.
        folder: Where to keep it; None keeps it in memory.
        progress: Told of rows done and rows in all.
    """
    blocks = [slice(at, min(at + rows_per_shard, rows)) for at in range(0, rows, rows_per_shard)]
    if folder is None:
        made = []
        for block in blocks:
            made.append(make(block))
            if progress:
                progress(block.stop, rows)
        tensors = {name: torch.cat([t[name] for t, _ in made]) for name in made[0][0]}
        return Sharded(tensors, _sum_counts([counts for _, counts in made]), cached=False)
    with locked(folder, what="bake", wait=True):
        manifest = _earlier_manifest(folder, rows, rows_per_shard, inputs)
        cached = manifest["complete"]
        for index, block in enumerate(blocks):
            name = shard_name(index)
            if name not in manifest["shards"]:
                tensors, counts = make(block)
                entry = write_tensors(folder / name, tensors)
                manifest["shards"][name] = {**entry, "counts": counts}
                manifest["tensors"] = {
                    key: {"shape": list(t.shape[1:]), "dtype": str(t.dtype).removeprefix("torch.")}
                    for key, t in tensors.items()
                }
                manifest["complete"] = len(manifest["shards"]) == len(blocks)
                write_json(folder / MANIFEST, manifest)
            if progress:
                progress(block.stop, rows)
    sharded = {name: ShardedTensor(folder, name) for name in manifest["tensors"]}
    counts = _sum_counts([entry["counts"] for entry in manifest["shards"].values()])
    return Sharded(sharded, counts, cached)


def _sum_counts(counts: list[dict[str, int | float]]) -> dict[str, int | float]:
    return {name: sum(some[name] for some in counts) for name in counts[0]}


def _earlier_manifest(
    folder: Path, rows: int, rows_per_shard: int, inputs: Mapping[str, Any]
) -> dict[str, Any]:
    """The manifest of an earlier run with the shards that are whole, or a fresh one."""
    fresh = {"inputs": dict(inputs), "rows": rows, "rows_per_shard": rows_per_shard}
    fresh |= {"tensors": {}, "shards": {}, "complete": False}
    if not (folder / MANIFEST).exists():
        return fresh
    earlier = read_json(folder / MANIFEST)
    if any(earlier.get(key) != fresh[key] for key in ("inputs", "rows", "rows_per_shard")):
        return fresh
    whole = {
        name: entry
        for name, entry in earlier["shards"].items()
        if (folder / name).is_file() and (folder / name).stat().st_size == entry["bytes"]
    }
    return {
        **earlier,
        "shards": whole,
        "complete": earlier["complete"] and len(whole) == len(earlier["shards"]),
    }
