"""Refinement by gradients: any representation, against its transfer tensor, in any metric.

Knows only the contract of :class:`~prt_torch.representations.Representation`. Starts from the
closed form, keeps the best state it has seen, never returns something worse than it was given,
resumes from a checkpoint bit-identically, and says how it ended.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from prt_torch import store
from prt_torch.errors import InputError
from prt_torch.metric import Metric
from prt_torch.representations import Representation, undetermined
from prt_torch.transfer import TransferTensor

Status = Literal[
    "closed_form",
    "rank_deficient",
    "converged",
    "max_steps",
    "stagnated",
    "nonfinite",
    "interrupted",
]

_BLOCK_BYTES = 2**26
_PATIENCE = 5  # steps without a better state before a fit counts as stagnated


@dataclass(frozen=True)
class FitResult:
    """How a fit went.

    Attributes:
        representation: The one that was given, at its best state.
        status: ``converged`` (steps gain less than the tolerance), ``max_steps``, ``stagnated``
            (several steps in a row found nothing better), ``nonfinite`` (the loss became NaN or
            infinite and the best state before was kept, the given one if it was so from the start),
            ``interrupted``, or, where no steps were asked for, ``closed_form`` or
            ``rank_deficient`` (:func:`construction_status`).
        error_before: Squared error over squared norm in the metric, as given.
        error_after: The same at the end; never larger.
        steps: Steps taken, those before a resumption included.
        seconds: Time of this call.
        condition: Of the construction (:attr:`Representation.condition`).
        history: Error after each step.
    """

    representation: Representation
    status: Status
    error_before: float
    error_after: float
    steps: int
    seconds: float
    condition: float
    history: list[float] = field(default_factory=list)


def fit(
    representation: Representation,
    transfer: TransferTensor,
    *,
    optimizer: Literal["lbfgs", "adam"] = "lbfgs",
    max_steps: int = 20,
    learning_rate: float | None = None,
    tolerance: float = 1e-6,
    metric: Metric | None = None,
    checkpoint: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> FitResult:
    """Refine a representation in place.

    Args:
        representation: Starts the fit; ends it at the best state seen.
        transfer: What it should stand for; read by blocks of points.
        optimizer: ``lbfgs`` (strong Wolfe line search, four iterations a step) or ``adam``.
        max_steps: Steps at most; 0 only measures.
        learning_rate: First step length of L-BFGS (default 1) or rate of Adam (default 1e-3 times
            the median magnitude of each parameter).
        tolerance: A step that lowers the error by less than this share of it ends the fit.
        metric: What errors are worth; the L2 norm over light directions if not given.
        checkpoint: File to resume from if it exists, and to write after every step.
        progress: Told of steps done and steps in all.

    Raises:
        ValueError: If shapes differ or an option is out of range.
        InputError: If the checkpoint is damaged, belongs to another fit, or cannot be written.
    """
    if representation.shape != tuple(transfer.values.shape):
        raise ValueError(
            f"expected a representation of shape {tuple(transfer.values.shape)}, "
            f"got {representation.shape}"
        )
    if max_steps < 0:
        raise ValueError(f"expected at least 0 steps, got {max_steps}")
    start = time.perf_counter()
    run = _Run(representation, transfer, metric or Metric.l2(transfer))
    run.make_optimizer(optimizer, learning_rate)
    if checkpoint is not None and checkpoint.exists():
        run.resume(checkpoint)
    else:
        run.begin()
    interrupted = False
    try:
        while run.ended is None and run.steps < max_steps:
            run.step(tolerance)
            if checkpoint is not None:
                run.write(checkpoint)
            if progress:
                progress(run.steps, max_steps)
    except KeyboardInterrupt:
        interrupted = True
    run.restore_best()
    status: Status = run.ended or (
        "max_steps" if max_steps else construction_status(representation)
    )
    return FitResult(
        representation=representation,
        status="interrupted" if interrupted else status,
        error_before=run.history[0],
        error_after=run.best_error,
        steps=run.steps,
        seconds=time.perf_counter() - start,
        condition=representation.condition,
        history=run.history[1:],
    )


def construction_status(representation: Representation) -> Status:
    """``closed_form``, or ``rank_deficient`` where its data leave directions undetermined.

    Nothing is lost by those; they take bytes for nothing.
    """
    return "rank_deficient" if undetermined(representation) else "closed_form"


class _Run:
    """The state of one fit."""

    def __init__(self, representation: Representation, transfer: TransferTensor, metric: Metric):
        self.representation, self.transfer, self.metric = representation, transfer, metric
        self.parameters = dict(representation.named_parameters())
        squares = [metric.weigh(values.double()).square().sum() for _, values in transfer.blocks()]
        self.norm = float(sum(squares)) or 1.0
        self.steps = 0
        self.ended: Status | None = None
        self.history: list[float] = []
        self.best_error = math.inf
        self.best: dict[str, Tensor] = {}

    def make_optimizer(self, name: str, learning_rate: float | None) -> None:
        match name:
            case "lbfgs":
                self.optimizer: torch.optim.Optimizer = torch.optim.LBFGS(
                    list(self.parameters.values()),
                    lr=1.0 if learning_rate is None else learning_rate,
                    max_iter=4,
                    history_size=10,
                    line_search_fn="strong_wolfe",
                    tolerance_grad=0.0,
                    tolerance_change=0.0,
                )
            case "adam":
                rate = 1e-3 if learning_rate is None else learning_rate
                groups = [
                    {"params": [p], "lr": rate * (1.0 if learning_rate else _typical_size(p))}
                    for p in self.parameters.values()
                ]
                self.optimizer = torch.optim.Adam(groups)
            case _:
                raise ValueError(f"expected optimizer lbfgs or adam, got {name!r}")

    def begin(self) -> None:
        """Measure what was given."""
        with torch.no_grad():
            error = float(self._loss(backward=False))
        self._keep(error)
        self.history = [error]
        if not math.isfinite(error):
            self.ended = "nonfinite"

    def step(self, tolerance: float) -> None:
        """One optimiser step; sets ``ended`` if it was the last."""
        before = self.best_error
        with torch.enable_grad():
            self.optimizer.step(self._closure)
        with torch.no_grad():
            error = float(self._loss(backward=False))
        self.steps += 1
        self.history.append(error)
        if not math.isfinite(error):
            self.ended = "nonfinite"
            return
        if error < self.best_error:
            self._keep(error)
        recent = self.history[-_PATIENCE:]
        if 0 <= before - error <= tolerance * before:
            self.ended = "converged"
        elif len(recent) == _PATIENCE and min(recent) > self.best_error:
            self.ended = "stagnated"

    def restore_best(self) -> None:
        with torch.no_grad():
            for name, parameter in self.parameters.items():
                parameter.copy_(self.best[name])
                parameter.grad = None

    def _keep(self, error: float) -> None:
        self.best_error = error
        self.best = {name: p.detach().clone() for name, p in self.parameters.items()}

    def _closure(self) -> float:
        self.optimizer.zero_grad()
        return float(self._loss(backward=True))

    def _loss(self, *, backward: bool) -> Tensor:
        """Squared error over squared norm; gradients are summed block by block."""
        total = torch.zeros((), dtype=torch.float64)
        for rows, values in self.transfer.blocks(_BLOCK_BYTES):
            whole = rows.stop - rows.start == self.transfer.num_points
            points = None if whole else torch.arange(rows.start, rows.stop)
            difference = self.metric.weigh(self.representation.dense(points) - values)
            loss = difference.square().sum(-1).sum(dtype=torch.float64) / self.norm
            if backward:
                loss.backward()
            total += loss.detach().cpu()
        return total

    def _kind(self) -> list[Any]:
        """What a checkpoint must have been made with: optimiser, shapes, and the same places.

        Numbers of other clusters would be given to the wrong points.
        """
        shapes = [[name, list(p.shape)] for name, p in sorted(self.parameters.items())]
        places = [self.representation.get_buffer(name) for name in self.representation.places]
        return [type(self.optimizer).__name__, shapes, store.digest(*places)]

    def write(self, path: Path) -> None:
        """Everything that the next step depends on."""
        tensors = {f"parameter.{name}": p for name, p in self.parameters.items()}
        tensors |= {f"best.{name}": value for name, value in self.best.items()}
        optimizer = _flatten(self.optimizer.state_dict(), tensors, "optimizer")
        header = {"kind": self._kind(), "steps": self.steps, "history": self.history}
        header |= {"ended": self.ended, "best_error": self.best_error, "optimizer": optimizer}
        store.write_tensors(path, tensors, {**header, "digest": _digest(header, tensors)})

    def resume(self, path: Path) -> None:
        """Continue from :meth:`write`.

        Raises:
            InputError: If the checkpoint is damaged or of another fit.
        """
        tensors, header = store.read_tensors(path)
        if not isinstance(header, dict) or header.pop("digest", None) != _digest(header, tensors):
            raise InputError(f"{path}: the checkpoint is damaged; remove it to fit from the start")
        if header["kind"] != self._kind():
            raise InputError(f"{path}: is the checkpoint of another fit; remove or rename it")
        with torch.no_grad():
            for name, parameter in self.parameters.items():
                parameter.copy_(tensors[f"parameter.{name}"])
                self.best[name] = tensors[f"best.{name}"].to(parameter)
        self.optimizer.load_state_dict(_unflatten(header["optimizer"], tensors))
        self.steps, self.history = header["steps"], header["history"]
        self.best_error, self.ended = header["best_error"], header["ended"]


def _digest(header: dict[str, Any], tensors: dict[str, Tensor]) -> str:
    """SHA-256 of a checkpoint's content."""
    return store.digest(header, *(part for item in sorted(tensors.items()) for part in item))


def _typical_size(parameter: Tensor) -> float:
    """Median magnitude, or the root mean square where more than half of the values are zero."""
    values = parameter.detach().double()
    return float(values.abs().median()) or float(values.square().mean().sqrt()) or 1.0


def _flatten(value: Any, tensors: dict[str, Tensor], path: str) -> Any:
    """JSON for a nested optimiser state; tensors are put into ``tensors`` and named in the JSON."""
    match value:
        case Tensor():
            tensors[path] = value
            return {"tensor": path}
        case dict():
            items = [[key, _flatten(v, tensors, f"{path}.{key}")] for key, v in value.items()]
            return {"dict": items}
        case list() | tuple():
            items = [_flatten(v, tensors, f"{path}.{i}") for i, v in enumerate(value)]
            return {type(value).__name__: items}
        case _:
            return value


def _unflatten(value: Any, tensors: dict[str, Tensor]) -> Any:
    """The inverse of :func:`_flatten`."""
    match value:
        case {"tensor": name}:
            return tensors[name]
        case {"dict": items}:
            return {key: _unflatten(v, tensors) for key, v in items}
        case {"list": items}:
            return [_unflatten(v, tensors) for v in items]
        case {"tuple": items}:
            return tuple(_unflatten(v, tensors) for v in items)
        case _:
            return value
