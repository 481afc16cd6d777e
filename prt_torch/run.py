"""One run from its configuration to its folder: bake, fit, evaluate, draw, report.

The folder holds ``config.yaml`` (resolved), ``results/`` (fitted modules), ``pictures/``,
``report.html``, ``report.json`` and, written last, ``manifest.json`` with the size and SHA-256 of
each. A run that was killed goes on where it stopped when it is started again.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from prt_torch import store
from prt_torch.account import PICTURES, write_report
from prt_torch.assets import Mesh
from prt_torch.baking import RESOLVED, bake
from prt_torch.construction import Problem, closed_form
from prt_torch.errors import InputError
from prt_torch.fitting import construction_status, fit
from prt_torch.gallery import file_name
from prt_torch.inputs import Inputs, load_inputs
from prt_torch.inspection import leave_out
from prt_torch.metric import Metric
from prt_torch.report import solves_table, summary_table
from prt_torch.representations import (
    CPCA,
    Representation,
    load,
    save,
)
from prt_torch.representations.cpca_relabel import reclassified
from prt_torch.settings import (
    CPCAConfig,
    RepresentationConfig,
    RunConfig,
)
from prt_torch.solves import Fitted, solves
from prt_torch.transfer import TransferTensor

CONFIG, RESULTS = "config.yaml", "results"


def execute(config: RunConfig, console: Console | None = None) -> dict[str, Any]:
    """Do a whole run and return its report.

    Args:
        config: What to do.
        console: Where to tell of it; standard error if not given.

    Raises:
        InputError: If an input is unusable, or the run folder is in use, belongs to another run or
            cannot be written.
    """
    console = console or Console(stderr=True)
    inputs = _load(config)
    _warn(inputs.mesh, console)
    out = run_folder(config)
    with store.locked(out, what="output folder"):
        _check_folder(out, config, inputs)
        inputs, transfer = needed(config, inputs, _bake(config, inputs, console))
        store.write_bytes(out / CONFIG, _claim(config, inputs).encode())
        metric = _metric(config, inputs, transfer)
        fitted = _fit_all(out, config, inputs, transfer, metric, console)
        solved = solves(transfer, metric, fitted)
        console.print("evaluating and drawing ...")
        report = write_report(
            out,
            inputs,
            transfer,
            fitted,
            solved=solved,
            preview=config.preview,
            memory_budget=config.memory_budget,
        )
        _write_manifest(out, transfer)
    console.print(summary_table(report))
    console.print(solves_table(report))
    for warning in filter(None, (solve.warning for solve in solved)):
        console.print(f"warning: {warning}", style="yellow", soft_wrap=True)
    console.print(f"report: {out / 'report.html'}", soft_wrap=True)
    return report


def bake_only(config: RunConfig, console: Console | None = None) -> TransferTensor:
    """Bake what a run needs, into the cache, and say what it took.

    Raises:
        InputError: If an input is unusable or the cache cannot be written.
    """
    console = console or Console(stderr=True)
    inputs = _load(config)
    _warn(inputs.mesh, console)
    transfer = _bake(config, inputs, console)
    made = transfer.provenance
    rate = made["rays"] / made["visibility_seconds"] / 1e6 if made["visibility_seconds"] else 0.0
    console.print(
        f"{transfer.num_points} points, {inputs.light_basis.name}, "
        f"{transfer.num_bytes / 2**20:.1f} MiB; {made['rays'] / 1e6:.1f} M rays at {rate:.1f} M/s"
        f"{' (cached)' if made['visibility_cached'] else ''}, projected in "
        f"{made['projection_seconds']:.1f} s{' (cached)' if made['projection_cached'] else ''}",
        soft_wrap=True,
    )
    return transfer


def _warn(mesh: Mesh, console: Console) -> None:
    for warning in mesh.warnings:
        console.print(f"warning: {warning.name}: {warning.message}", style="yellow", soft_wrap=True)


def run_folder(config: RunConfig) -> Path:
    """Where a run's files go: as configured, else ``runs/SCENE-HASH``."""
    if config.out is not None:
        return Path(config.out)
    scene = Path(config.scene.mesh).stem if config.scene.mesh else "procedural"
    return Path("runs") / f"{file_name(scene)}-{store.digest(_identity(config))[:8]}"


def _identity(config: RunConfig) -> dict[str, Any]:
    """What the results of a run follow from."""
    return config.model_dump(mode="json", exclude={"out", "cache", "memory_budget"})


def _load(config: RunConfig) -> Inputs:
    results = [wanted.label for wanted in config.fitted]
    if len(set(results)) != len(results):
        raise InputError(f"representations: expected different ones, got {', '.join(results)}")
    return load_inputs(config)


def _claim(config: RunConfig, inputs: Inputs) -> str:
    """What the results of a run follow from: its configuration, and what the files held."""
    mesh, lights = inputs.mesh, [*inputs.fit_lights, *inputs.test_lights]
    surface = (mesh.vertices, mesh.faces, mesh.normals, mesh.albedo)
    light = (part for one in lights for part in (one.image, one.rotation))
    hashed = store.digest(*surface, *light)
    return f"# inputs {hashed}\n{OmegaConf.to_yaml(OmegaConf.create(_identity(config)))}"


def _check_folder(out: Path, config: RunConfig, inputs: Inputs) -> None:
    """Make sure that a run folder holds nothing, or this run; remove what a killed one left."""
    path = out / CONFIG
    if path.exists() and path.read_bytes() != _claim(config, inputs).encode():
        raise InputError(f"{out}: output folder holds another run; choose another or remove it")
    for folder in (out / RESULTS, out / PICTURES):
        store.remove_temporaries(folder)


def _bake(config: RunConfig, inputs: Inputs, console: Console) -> TransferTensor:
    with _progress(console) as progress:

        def stage(what: str) -> Callable[[int, int], None]:
            task = progress.add_task(what, visible=False)  # until it begins
            return lambda done, total: progress.update(
                task, completed=done, total=total, visible=True
            )

        transfer = bake(
            inputs.mesh,
            materials=inputs.materials,
            light_basis=inputs.light_basis,
            exit_basis=config.transfer.exit_basis,
            num_rows=config.transfer.rows,
            max_bounces=config.transfer.max_bounces,
            tolerance=config.transfer.tolerance,
            resolution=config.transfer.resolution,
            supersampling=config.transfer.supersampling,
            trace_all="rays" in config.transfer.keep,
            cache=config.cache,
            memory_budget=config.memory_budget,
            stages=stage,
        )
    if transfer.provenance["unresolved"] > RESOLVED:
        console.print(
            "warning: sharp_material: the lobe of a material is too narrow for its quadrature, "
            f"which still changes by {transfer.provenance['unresolved']:.1e}",
            style="yellow",
            soft_wrap=True,
        )
    return transfer


def needed(
    config: RunConfig, inputs: Inputs, transfer: TransferTensor
) -> tuple[Inputs, TransferTensor]:
    """Both without what the scene does not need; the transfer's provenance says what that was."""
    transfer, findings = leave_out(
        transfer,
        error=config.transfer.needless,
        force=[part for part in config.transfer.keep if part != "rays"],
    )
    entries = [found.entry() for found in findings if found.left_out]
    transfer = replace(transfer, provenance={**transfer.provenance, "left_out": entries})
    if transfer.surface.light_basis is not None:  # lights are projected to what transfer has
        inputs = replace(inputs, light_basis=transfer.surface.light_basis)
    return inputs, transfer


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
    )


def _metric(config: RunConfig, inputs: Inputs, transfer: TransferTensor) -> Metric:
    """What errors are worth."""
    if config.fit.metric == "l2":
        return Metric.l2(transfer)
    lights = torch.stack([inputs.light_basis.project(light) for light in inputs.fit_lights])
    exit_basis = transfer.surface.exit_basis
    return Metric.light_prior(lights, inputs.light_basis, exit_basis=exit_basis)


def _fit_all(
    out: Path,
    config: RunConfig,
    inputs: Inputs,
    transfer: TransferTensor,
    metric: Metric,
    console: Console,
) -> list[Fitted]:
    fitted = []
    with _progress(console) as progress:
        for wanted in config.fitted:
            name = wanted.label
            task = progress.add_task(f"fit {name}", total=config.fit.max_steps or 1)
            fitted.append(
                _fit_one(
                    out / RESULTS / f"{file_name(name)}.safetensors",
                    name,
                    wanted,
                    config,
                    inputs,
                    transfer,
                    metric,
                    lambda done, total, task=task: progress.update(task, completed=done),
                )
            )
            progress.update(task, completed=config.fit.max_steps or 1)
    return fitted


def _closed_form(
    wanted: RepresentationConfig,
    config: RunConfig,
    inputs: Inputs,
    transfer: TransferTensor,
    metric: Metric,
) -> Representation:
    """A representation as its paper constructs it.

    Raises:
        InputError: If the transfer does not suit it.
    """
    try:
        if isinstance(wanted, CPCAConfig):
            return _clustered(wanted, config, inputs, transfer, metric)
        problem = Problem(transfer, metric, config.seed, config.memory_budget)
        return closed_form(problem, wanted.name, wanted.model_dump(exclude={"name"}))
    except ValueError as error:  # the parameters are valid, but what was baked decides the rest
        raise InputError(f"representation {wanted.label}: {error}") from error


def _clustered(
    wanted: CPCAConfig, config: RunConfig, inputs: Inputs, transfer: TransferTensor, metric: Metric
) -> CPCA:
    common: dict[str, Any] = {
        "method": wanted.method,
        "metric": metric,
        "generator": torch.Generator().manual_seed(config.seed),
    }
    if wanted.limits:
        model = CPCA.within(transfer, **wanted.limits, **common)
    else:
        model = CPCA.from_transfer(
            transfer,
            num_clusters=wanted.num_clusters,
            rank=wanted.rank,
            affine=wanted.affine,
            **common,
        )
    if wanted.reclassify:
        faces, budget = inputs.mesh.faces, wanted.reclassify
        model = reclassified(model, transfer, faces, budget=budget, metric=metric)
    share = wanted.quantisation_share
    return model.coded(transfer, share=share, metric=metric) if share else model


def _fit_one(
    path: Path,
    name: str,
    wanted: RepresentationConfig,
    config: RunConfig,
    inputs: Inputs,
    transfer: TransferTensor,
    metric: Metric,
    progress: Any,
) -> Fitted:
    """Fit, or take what an earlier start of this run has finished."""
    record = path.with_suffix(".json")
    checkpoint = path.with_suffix(".checkpoint")
    if record.exists() and path.exists():
        checkpoint.unlink(missing_ok=True)
        model = load(path, geometry=transfer.surface)
        return Fitted(name, model, **store.read_json(record))
    start = time.perf_counter()
    representation = _closed_form(wanted, config, inputs, transfer, metric)
    construction = construction_status(representation)
    result = fit(
        representation,
        transfer,
        optimizer=config.fit.optimizer,
        max_steps=config.fit.max_steps,
        metric=metric,
        checkpoint=checkpoint,
        progress=progress,
    )
    outcome = {
        "status": result.status,
        "seconds": time.perf_counter() - start,
        "condition": result.condition,
        "construction": construction,
    }
    if result.status == "interrupted":
        raise KeyboardInterrupt  # the checkpoint stays; starting again goes on from it
    save(representation, path)
    store.write_json(record, outcome)
    checkpoint.unlink(missing_ok=True)
    return Fitted(name, representation, **outcome)


def _write_manifest(out: Path, transfer: TransferTensor) -> None:
    """Sizes and hashes of all files of the run, and what it was made from."""
    written = [out / CONFIG, out / "report.html", out / "report.json"]
    files = sorted([*written, *(out / RESULTS).iterdir(), *(out / PICTURES).iterdir()])
    listed = {
        str(path.relative_to(out)): {
            "bytes": path.stat().st_size,
            "sha256": store.file_sha256(path),
        }
        for path in files
    }
    content = {"inputs": transfer.provenance["inputs"], "files": listed}
    store.write_json(out / store.MANIFEST, content)
