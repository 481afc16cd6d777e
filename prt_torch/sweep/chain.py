"""One chain of a sweep as a job of its own: what a worker is given, does, and leaves on disk.

A job is plain JSON, so that any machine that sees the folder and the cache of bakes can do it. Each
point leaves a file of the representation and then, as the sign that it is done, a record of what it
is worth; a job that is started again makes only what has no record. Points are read off fitted ones
as their files hold them, so a chain that was stopped ends as if it had not been.
"""

import math
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from prt_torch import store
from prt_torch.construction import Parameters, Problem
from prt_torch.errors import InputError
from prt_torch.inputs import Inputs, load_inputs
from prt_torch.metric import Metric
from prt_torch.nesting import Chain, Made, nested
from prt_torch.representations import Representation, load, save
from prt_torch.representations.cpca_subspaces import one_thread
from prt_torch.run import bake_only, needed
from prt_torch.settings import KINDS, RunConfig
from prt_torch.sweep.measure import Judge
from prt_torch.transfer import Surface, TransferTensor

POINTS = "points"
"""Folder of the points inside that of a sweep."""


class Kept:
    """The points of a sweep on disk.

    Args:
        folder: Of the sweep.
        geometry: Frames and positions, which are in no file.
    """

    def __init__(self, folder: Path, geometry: Surface | None = None):
        self.folder, self._geometry = folder / POINTS, geometry

    def path(self, kind: str, parameters: Parameters) -> Path:
        """File of a point's representation."""
        key = store.digest({"kind": kind, "parameters": parameters})[:16]
        return self.folder / f"{kind}-{key}.safetensors"

    def record(self, kind: str, parameters: Parameters) -> dict[str, Any] | None:
        """What a point is worth; None where it is not done."""
        path = self.path(kind, parameters)
        found = path.with_suffix(".json")
        return store.read_json(found) if found.exists() and path.exists() else None

    def model(self, kind: str, parameters: Parameters) -> Representation | None:
        """The representation of a point that is done."""
        if self.record(kind, parameters) is None:
            return None
        return load(self.path(kind, parameters), geometry=self._geometry)

    def fitted(self, kind: str, parameters: Parameters) -> Representation | None:
        """The representation of a point that is done and was not read off a larger one."""
        record = self.record(kind, parameters)
        return None if record is None or record["read_off"] else self.model(kind, parameters)

    def keep(self, kind: str, made: Made, worth: dict[str, Any]) -> None:
        """Write a point: its representation first, its record last."""
        path = self.path(kind, made.parameters)
        save(made.model, path)
        store.write_json(path.with_suffix(".json"), worth)


def label(kind: str, parameters: Parameters) -> str:
    """What a point is called: as the result of a run with these parameters."""
    return KINDS[kind].model_validate({"name": kind, **parameters}).label  # type: ignore[attr-defined]


def run_chain(problem: Problem, chain: Chain, kept: Kept, judge: Judge) -> int:
    """Make and judge the points of a chain that are not done; how many these were.

    Raises:
        ValueError: If the transfer or a parameter does not suit the kind.
        InputError: If a fit would take more than the memory budget, or a file cannot be written.
    """
    made_here = 0
    for made in nested(
        problem,
        chain,
        done=lambda parameters: kept.record(chain.kind, parameters) is not None,
        fitted=lambda parameters: kept.fitted(chain.kind, parameters),
    ):
        before = kept.record(chain.kind, made.fitted) or {}
        condition = before.get("condition") if math.isnan(made.condition) else made.condition
        own = made.fit_seconds
        kept.keep(
            chain.kind,
            made,
            {
                "name": label(chain.kind, made.parameters),
                "representation": chain.kind,
                "parameters": made.parameters,
                "built": made.model.budget,
                "status": "closed_form",
                "read_off": made.read_off,
                "seconds": made.seconds,
                "fit_seconds": made.seconds + before["fit_seconds"] if own is None else own,
                "condition": None if condition == math.inf else condition,
                **judge.errors(made.model),
            },
        )
        made_here += 1
    return made_here


def prepare(config: RunConfig) -> tuple[Inputs, Problem]:
    """What every job of a sweep starts from; the bake comes from the cache if it is there.

    Raises:
        InputError: If an input is unusable or the cache cannot be written.
    """
    baked = bake_only(config, Console(quiet=True))
    inputs, transfer = needed(config, load_inputs(config), baked)
    metric = _light_prior(config, inputs, transfer)
    return inputs, Problem(transfer, metric, config.seed, config.memory_budget)


def _light_prior(config: RunConfig, inputs: Inputs, transfer: TransferTensor) -> Metric | None:
    if config.fit.metric != "light_prior":
        return None
    lights = torch.stack([inputs.light_basis.project(light) for light in inputs.fit_lights])
    return Metric.light_prior(lights, inputs.light_basis, exit_basis=transfer.surface.exit_basis)


def job(config: RunConfig, chain: Chain, folder: Path, *, alone: bool) -> dict[str, Any]:
    """A chain as what :func:`do` takes, plain JSON.

    Args:
        config: What is baked and lit.
        chain: What is made.
        folder: Of the sweep.
        alone: Whether no other job runs beside it on its machine, so that it may use all threads.
    """
    return {
        "run": config.model_dump(mode="json"),
        "chain": asdict(chain),
        "folder": str(folder),
        "alone": alone,
    }


def do(work: dict[str, Any]) -> str | None:
    """Do a job; what was wrong with it, or None.

    A chain that does not suit the scene is no reason to stop the others.
    """
    given = work["chain"]
    values, shares = tuple(given["values"]), tuple(given["shares"])
    chain = Chain(given["kind"], given["fixed"], given["axis"], values, shares)
    with nullcontext() if work["alone"] else one_thread():
        try:
            inputs, problem = prepare(RunConfig.model_validate(work["run"]))
            kept = Kept(Path(work["folder"]), problem.transfer.surface)
            run_chain(problem, chain, kept, Judge.of_inputs(inputs, problem.transfer))
        except (ValueError, InputError) as error:
            return str(error)
    return None
