"""Runs cases one after the other, each under its time limit, whatever they do.

Cases run in a second process. One that does not end is killed with it, one that takes the
interpreter down takes only that process, and the next case gets a new one. So no row can hold up
the suite, and none can end without a result.
"""

import multiprocessing
import time
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import torch
from stability_case import DTYPES, Case, Outcome


@dataclass(frozen=True)
class Row:
    """A case and what came of it.

    Attributes:
        case: The case.
        outcomes: By element type, such as ``float32``; of those that ended.
        failure: Why there is no outcome; empty where there is one of each type.
        seconds: Time of both together.
    """

    case: Case
    outcomes: dict[str, Outcome]
    failure: str
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether all checks pass in both types, in time."""
        return not self.failure and all(outcome.passed for outcome in self.outcomes.values())

    @property
    def condition(self) -> float | None:
        """Of the problem, the larger one where both types have one."""
        found = [o.condition for o in self.outcomes.values() if o.condition is not None]
        return max(found, default=None)


class Runner:
    """Measures cases in a process of its own.

    Args:
        seeds: For cases that run over seeds.
    """

    def __init__(self, seeds: int):
        self._seeds = seeds
        self._process: Any = None
        self._connection: Connection | None = None

    def __enter__(self) -> "Runner":
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    def rows(self, cases: Iterable[Case]) -> Iterator[Row]:
        """The rows of some cases, each as soon as it is known."""
        for case in cases:
            yield self.run(case)

    def run(self, case: Case) -> Row:
        """Measure a case in all element types; never raises for what the case does."""
        connection = self._start()
        start = time.perf_counter()
        outcomes: dict[str, Outcome] = {}
        failures: list[str] = []
        for dtype in DTYPES:
            left = case.seconds - (time.perf_counter() - start)
            try:
                connection.send((case, dtype, self._seeds))
                if not connection.poll(max(left, 0.0)):
                    raise TimeoutError(f"took more than {case.seconds:g} s")
                answer = connection.recv()
            except (OSError, EOFError) as error:
                what = str(error) if isinstance(error, TimeoutError) else "ended its process"
                failures.append(f"{type_name(dtype)}: {what}")
                self._stop()
                break
            if isinstance(answer, Outcome):
                outcomes[type_name(dtype)] = answer
            else:
                failures.append(f"{type_name(dtype)}: {answer}")
        return Row(case, outcomes, "; ".join(failures), time.perf_counter() - start)

    def _start(self) -> Connection:
        """The connection to a process that is ready; loading takes no time from a case."""
        if self._connection is None:
            context = multiprocessing.get_context("spawn")
            self._connection, theirs = context.Pipe()
            self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
            self._process.start()
            theirs.close()
            self._connection.recv()
        return self._connection

    def _stop(self) -> None:
        if self._connection is not None:
            self._process.kill()
            self._process.join()
            self._connection.close()
            self._connection = None


def type_name(dtype: torch.dtype) -> str:
    """Such as ``float32``."""
    return str(dtype).removeprefix("torch.")


def _serve(connection: Connection) -> None:
    """Measure what is asked for until the other side goes away.

    By one thread: problems are small, and threads that wait for one another on a busy machine make
    them a hundred times as slow.
    """
    torch.set_num_threads(1)
    connection.send("ready")
    while True:
        try:
            case, dtype, seeds = connection.recv()
        except EOFError:
            return
        try:
            connection.send(case.measure(dtype, seeds) if case.seeded else case.measure(dtype))
        except Exception as error:  # whatever it is, the row is red and says so
            place = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{place.filename.rsplit('/', 1)[-1]}:{place.lineno}"
            connection.send(f"raised {type(error).__name__} at {where}: {error}")
