"""Who runs the chains of a sweep: processes of this machine, a Dask cluster, or a Slurm queue.

All of them are a :class:`concurrent.futures.Executor`, which is all that a sweep knows. Dask and
submitit are not dependencies of the package; only this module imports them, where they are asked
for.
"""

import importlib
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from prt_torch.errors import InputError
from prt_torch.sweep.settings import SlurmConfig, SweepConfig

_POLL_SECONDS = 2.0
_LOST = {"KilledWorker", "UncompletedJobError"}  # of Dask and submitit, by name: they may be absent


@contextmanager
def workers(config: SweepConfig, folder: Path) -> Iterator[Executor]:
    """The executor that a sweep asks for; what is running is waited for at the end.

    Args:
        config: Of the sweep.
        folder: Where a queue keeps the logs of its jobs.

    Raises:
        InputError: If a package or a scheduler is missing.
    """
    match config.executor:
        case "here":
            with _Here() as executor:
                yield executor
        case "processes":
            # A fresh interpreter: threads of torch do not survive a fork.
            context = multiprocessing.get_context("spawn")
            executor = ProcessPoolExecutor(count(config), mp_context=context)
            try:
                yield executor
            finally:
                executor.shutdown(cancel_futures=True)
        case "dask":
            distributed = _package("distributed", "dask", "dask[distributed]")
            with _dask_client(distributed, config) as client, client.get_executor() as executor:
                yield executor
        case "slurm":
            submitit = _package("submitit", "slurm", "submitit")
            with _Queue(submitit, config.slurm, folder / "slurm") as executor:
                yield executor


def count(config: SweepConfig) -> int:
    """How many chains run side by side on this machine."""
    return config.workers or len(os.sched_getaffinity(0))


def was_lost(error: Exception) -> bool:
    """Whether a worker ended without an answer: killed, say, or beyond the time of its queue."""
    return isinstance(error, BrokenExecutor) or type(error).__name__ in _LOST


def _package(module: str, executor: str, install: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f"sweep.executor: {executor} needs the package {install}; pip install '{install}'"
        ) from error


def _dask_client(distributed: Any, config: SweepConfig) -> Any:
    if config.dask_address is None:
        return distributed.Client(n_workers=count(config), threads_per_worker=1)
    try:
        return distributed.Client(config.dask_address)
    except (OSError, ValueError) as error:
        raise InputError(
            f"sweep.dask_address: no scheduler answers at {config.dask_address} ({error})"
        ) from error


class _Here(Executor):
    """Does each call at once, in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class _Queue(Executor):
    """One job of a Slurm queue for each call; a thread asks the queue how they are.

    Args:
        submitit: The package.
        config: Of the jobs.
        logs: Their folder, which all machines see.
    """

    def __init__(self, submitit: Any, config: SlurmConfig, logs: Path):
        self._executor = submitit.AutoExecutor(folder=str(logs))
        options: dict[str, Any] = {"timeout_min": config.minutes, "cpus_per_task": config.cpus}
        if config.partition is not None:
            options["slurm_partition"] = config.partition
        self._executor.update_parameters(**options)
        self._waiting: list[tuple[Any, Future[Any]]] = []
        self._lock, self._closed = threading.Lock(), threading.Event()
        self._asking = threading.Thread(target=self._ask, daemon=True)
        self._asking.start()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        job, future = self._executor.submit(fn, *args, **kwargs), Future()
        future.set_running_or_notify_cancel()
        with self._lock:
            self._waiting.append((job, future))
        return future

    def _ask(self) -> None:
        while not (self._closed.is_set() and not self._waiting):
            for job, future in list(self._waiting):
                if job.done():
                    self._settle(job, future)
            time.sleep(_POLL_SECONDS)

    def _settle(self, job: Any, future: Future[Any]) -> None:
        try:
            future.set_result(job.result())
        except Exception as error:
            future.set_exception(error)
        with self._lock:
            self._waiting.remove((job, future))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for the jobs, or cancel them."""
        if cancel_futures:
            for job, _ in list(self._waiting):
                job.cancel()
        self._closed.set()
        if wait:
            self._asking.join()
