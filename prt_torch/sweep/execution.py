"""A sweep: many representations of one bake, made chain by chain, judged alike, set side by side.

The folder of a sweep holds ``sweep.json`` (what was baked and lit, and from which files), a file
and a record of every point in ``points/`` (:mod:`prt_torch.sweep.chain`), ``times.json``, and the
report. A sweep that was killed goes on where it stopped, and one that ended takes further points:
only what is missing is made.

Chains run side by side, so times to relight are measured at the end, when nothing else runs.
"""

import time
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from prt_torch import store
from prt_torch.account import facts, left_out
from prt_torch.budget import Choice, Limits, Tried, refine
from prt_torch.construction import Problem
from prt_torch.errors import InputError
from prt_torch.gallery import file_name
from prt_torch.inputs import Inputs
from prt_torch.nesting import Chain, chains
from prt_torch.report import summary_table
from prt_torch.report.numbers import bytes_text, error_text, percent_text, seconds_text
from prt_torch.report.tradeoff import write_tradeoff
from prt_torch.run import bake_only
from prt_torch.settings import RunConfig
from prt_torch.sweep.chain import POINTS, Kept, do, job, label, prepare, run_chain
from prt_torch.sweep.measure import Judge
from prt_torch.sweep.pictures import pictures
from prt_torch.sweep.settings import BudgetConfig, SweepRun
from prt_torch.sweep.waterfall import error_stages, explained
from prt_torch.sweep.workers import count, was_lost, workers
from prt_torch.tradeoff import COSTS, ERRORS, fronts
from prt_torch.transfer import TransferTensor

CLAIM, TIMES, REPORT, PAGE = "sweep.json", "times.json", "report.json", "tradeoff.html"
PICTURES = "pictures"
_LOOK_SECONDS = 0.5
_SHOWN_ROWS = 16
_SAVE_SECONDS = 10.0  # between two writings of the times


def execute(config: SweepRun, console: Console | None = None) -> dict[str, Any]:
    """Do a whole sweep, or the rest of one, and return its report.

    Args:
        config: What to do.
        console: Where to tell of it; standard error if not given.

    Raises:
        InputError: If an input is unusable, the folder is in use, holds another sweep or cannot be
            written, or no chain suits the scene.
    """
    console = console or Console(stderr=True)
    bake_only(config.run, console)
    inputs, problem = prepare(config.run)
    folder = sweep_folder(config.run)
    wanted = planned(config)
    with store.locked(folder, what="sweep folder"):
        _claim(folder, config.run, inputs, problem.transfer)
        kept = Kept(folder, problem.transfer.surface)
        failed = _make(config, wanted, folder, kept, console)
        judge = Judge.of_inputs(inputs, problem.transfer)
        report = _gather(config, wanted, kept, judge, inputs, failed)
        if not report["results"]:
            raise InputError(f"sweep.representations: none suits the scene; {failed[0]['why']}")
        if config.budget.given:
            console.print("choosing ...")
            choice = _choose(config.budget, problem, report["results"])
            own = Chain(choice.tried.kind, choice.tried.parameters)
            name = label(own.kind, own.fixed)
            if all(one["name"] != name for one in report["results"]):
                run_chain(problem, own, kept, judge)
                report = _gather(config, [*wanted, own], kept, judge, inputs, failed)
            report["budget"] = {"asked": _asked(config.budget), "name": name, "why": choice.why}
        console.print("drawing ...")
        _write(folder, config, report, kept, inputs, problem)
    console.print(summary_table(report))
    for one in failed:
        console.print(f"left out: {one['what']}: {one['why']}", style="yellow", soft_wrap=True)
    for reason in report.get("budget", {}).get("why", []):
        console.print(Text(reason), soft_wrap=True)
    console.print(f"report: {folder / PAGE}", soft_wrap=True)
    return report


def _choose(budget: BudgetConfig, problem: Problem, results: list[dict[str, Any]]) -> Choice:
    """What to take within the budget, from the points of the sweep and others between them."""
    milliseconds = budget.relight_ms
    limits = Limits(
        budget.bytes, budget.error, None if milliseconds is None else milliseconds / 1000
    )
    tried = [
        Tried(
            one["representation"],
            one["parameters"],
            one["bytes"],
            one["transfer_error"],
            one["light_seconds"],
        )
        for one in results
    ]
    return refine(problem, limits, tried)


def _asked(budget: BudgetConfig) -> str:
    """The limits in words."""
    words = {
        "bytes": bytes_text(budget.bytes),
        "squared transfer error": error_text(budget.error),
        "light to exit rows": f"{budget.relight_ms} ms",
    }
    given = (budget.bytes, budget.error, budget.relight_ms)
    pairs = zip(words.items(), given, strict=True)
    return ", ".join(f"{what} at most {text}" for (what, text), one in pairs if one is not None)


def _write(
    folder: Path,
    config: SweepRun,
    report: dict[str, Any],
    kept: Kept,
    inputs: Inputs,
    problem: Problem,
) -> None:
    """The report as JSON and as a page with pictures."""
    results = report["results"]
    report["fronts"] = {
        cost: {error: fronts(results, cost, error) for error in ERRORS} for cost in COSTS
    }
    stages, what = [], ""
    if config.sweep.waterfall:
        unbeaten = report["fronts"]["bytes"]["mean_radiance_error"]["joint"]
        name = report.get("budget", {}).get("name")
        one = explained(results, [name] if name else unbeaten)
        stages = error_stages(config.run, inputs, problem, one["representation"], one["parameters"])
        what = f"Of {one['name']}."
        report["waterfall"] = {"name": one["name"], "stages": [asdict(one) for one in stages]}
    store.write_json(folder / REPORT, report)
    drawn = pictures(folder / PICTURES, results, kept, inputs, problem.transfer, config.run.preview)
    write_tradeoff(folder / PAGE, report, stages=stages, stages_of=what, pictures=drawn)


def planned(config: SweepRun) -> list[Chain]:
    """The chains of all entries; each point is one of its own where nothing is to be read off.

    Raises:
        InputError: If a point is asked for twice.
    """
    found = [one for kind, grid in config.sweep.grids() for one in chains(kind, grid)]
    if not config.sweep.nested:
        found = [Chain(one.kind, point) for one in found for point in one.points()]
    names = [label(one.kind, point) for one in found for point in one.points()]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"sweep.representations: {twice} is asked for twice")
    return found


def sweep_folder(config: RunConfig) -> Path:
    """Where a sweep's files go: as configured, else ``runs/sweep-SCENE-HASH``."""
    if config.out is not None:
        return Path(config.out)
    scene = Path(config.scene.mesh).stem if config.scene.mesh else "procedural"
    return Path("runs") / f"sweep-{file_name(scene)}-{store.digest(_identity(config))[:8]}"


def _identity(config: RunConfig) -> dict[str, Any]:
    """What the points of a sweep follow from, their own parameters aside."""
    aside = {"out", "cache", "memory_budget", "preview", "representation", "representations"}
    return config.model_dump(mode="json", exclude=aside)


def _claim(folder: Path, config: RunConfig, inputs: Inputs, transfer: TransferTensor) -> None:
    """Make sure that a folder holds nothing, or points of this bake under these lights."""
    claim = {
        "configuration": _identity(config),
        "inputs": transfer.provenance["inputs"],
        "files": inputs.digest(),
    }
    path = folder / CLAIM
    if path.exists() and store.digest(store.read_json(path)) != store.digest(claim):
        raise InputError(f"{folder}: sweep folder holds another sweep; choose another or remove it")
    store.write_json(path, claim)
    store.remove_temporaries(folder / POINTS)


def _make(
    config: SweepRun, wanted: Sequence[Chain], folder: Path, kept: Kept, console: Console
) -> list[dict[str, str]]:
    """Make what is missing, and show it as it comes; chains that do not suit the scene."""
    missing = [
        one for one in wanted if any(kept.record(one.kind, point) is None for point in one.points())
    ]
    side_by_side = config.sweep.executor in ("processes", "dask") and count(config.sweep) > 1
    alone = len(missing) < 2 or not side_by_side
    failed = []
    with workers(config.sweep, folder) as executor, Live(console=console, transient=True) as live:
        futures: dict[Future[str | None], Chain] = {
            executor.submit(do, job(config.run, one, folder, alone=alone)): one for one in missing
        }
        waiting = set(futures)
        while waiting:
            ended, waiting = wait(waiting, _LOOK_SECONDS, FIRST_COMPLETED)
            for future in ended:
                why, chain = _outcome(future), futures[future]
                if why is not None:
                    failed.append({"what": label(chain.kind, chain.points()[0]), "why": why})
            live.update(_progress(wanted, kept))
    return failed


def _outcome(future: Future[str | None]) -> str | None:
    """What was wrong with a chain, or None."""
    try:
        return future.result()
    except Exception as error:
        if not was_lost(error):
            raise
        raise InputError(
            "sweep.workers: a worker was killed, perhaps for want of memory or time; start the "
            "same command again to go on, with fewer workers if need be"
        ) from error


def _progress(wanted: Sequence[Chain], kept: Kept) -> Table:
    """The points that are done, the last ones last."""
    paths = [kept.path(one.kind, point) for one in wanted for point in one.points()]
    records = [path.with_suffix(".json") for path in paths]
    there = sorted((p for p in records if p.exists()), key=lambda path: path.stat().st_mtime)
    table = Table(header_style="bold", box=SIMPLE_HEAD, pad_edge=False)
    table.title = f"{len(there)} of {len(records)} points"
    table.add_column("name", overflow="fold")
    for heading in ("bytes", "transfer error", "radiance error", "made in"):
        table.add_column(heading, justify="right")
    table.add_column("")
    for path in there[-_SHOWN_ROWS:]:
        one = store.read_json(path)
        lights = one["radiance_error"].values()
        table.add_row(
            Text(one["name"]),
            bytes_text(one["bytes"]),
            error_text(one["transfer_error"]),
            percent_text(sum(lights) / len(lights)),
            seconds_text(one["seconds"]),
            "read off a larger one" if one["read_off"] else "fitted",
        )
    return table


def _gather(
    config: SweepRun,
    wanted: Sequence[Chain],
    kept: Kept,
    judge: Judge,
    inputs: Inputs,
    failed: list[dict[str, str]],
) -> dict[str, Any]:
    """The report: every point that is there, with times measured now where they were not."""
    path = kept.folder.parent / TIMES
    times = store.read_json(path) if path.exists() else {}
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    if "dense" not in times:
        times["dense"] = judge.dense_seconds(config.run.memory_budget)
    results, last = [], time.monotonic()
    for chain in wanted:
        for point in chain.points():
            record = kept.record(chain.kind, point)
            if record is None:
                continue
            for device in devices:
                key = f"{kept.path(chain.kind, point).stem} {device}"
                if key not in times:
                    model = kept.model(chain.kind, point)
                    times[key] = judge.seconds(model, device) if model else None
            results.append(_result(record, times, kept.path(chain.kind, point).stem, devices))
            if time.monotonic() - last > _SAVE_SECONDS:
                store.write_json(path, times)
                last = time.monotonic()
    store.write_json(path, times)
    return {
        **facts(inputs, judge.transfer),
        "left_out": left_out(inputs, judge.transfer),
        "failed": failed,
        "results": results,
    }


def _result(
    record: dict[str, Any], times: dict[str, Any], stem: str, devices: Sequence[str]
) -> dict[str, Any]:
    """A point as a result of a report."""
    own = {device: times[f"{stem} {device}"] for device in devices}
    return {
        **record,
        "relight_seconds": own["cpu"]["both"],
        "light_seconds": own["cpu"]["light"],
        "view_seconds": own["cpu"]["view"],
        "dense_seconds": times["dense"]["both"],
        **{f"{device}_seconds": own[device] for device in devices if device != "cpu"},
    }
