"""Runs that are killed at any moment, started again, and end as if nothing had happened."""

import inspect
import json
import os
import random
import runpy
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
import trimesh

from prt_torch import InputError, TransferTensor, fit, load, run, store
from prt_torch.baking import direct, visibility
from prt_torch.representations import CPCA

ROOT = Path(__file__).resolve().parent.parent
FIT, BAKE = ROOT / "train" / "fit.py", ROOT / "train" / "bake.py"
POINTS_PER_SHARD = 100
MOMENTS = [2, pytest.param(10, marks=pytest.mark.slow)]


def disturb(representation):
    """A closed form that is optimal leaves a fit nothing to do: start away from it."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in representation.parameters():
            noise = torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype)
            parameter.mul_(1 + 0.3 * noise)
    return representation


LAUNCHER = f"""
import runpy, sys
import torch
from prt_torch import fitting, run
from prt_torch.baking import direct, visibility

{inspect.getsource(disturb)}

visibility._BITS_PER_SHARD = {POINTS_PER_SHARD} * 6 * 64**2
direct._POINTS_PER_SHARD = {POINTS_PER_SHARD}
announced, script = sys.argv[1:3]
work = getattr(run, announced)

def announce(*arguments, **options):
    print("started", flush=True)
    return work(*arguments, **options)

def fit(representation, *arguments, **options):
    return fitting.fit(disturb(representation), *arguments, **options)

run.fit = fit
setattr(run, announced, announce)
sys.argv = sys.argv[2:]
runpy.run_path(script, run_name="__main__")
"""
"""Runs a script with small shards, so that much can be half done, and says when the work begins."""

SOME_SECONDS = (
    "scene.mesh=ball.obj",
    "scene.ground_resolution=16",
    "transfer.resolution=16",
    "transfer.supersampling=4",
    "representation.num_clusters=24",
    "preview.width=32",
    "preview.height=24",
    "preview.opengl=false",
    "light.fit=[constant]",
    "light.test=[sky]",
    "out=out",
    "cache=cache",
)
FITS = {"lbfgs": "fit.max_steps=25", "adam": "fit=adam"}


def make_ball(folder: Path, subdivisions: int) -> None:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    lines = [f"v {x!r} {y + 1.3!r} {z!r}" for x, y, z in ball.vertices.tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in ball.faces.tolist()]
    (folder / "ball.obj").write_text("\n".join(lines) + "\n")


def start(folder: Path, announced: str, script: Path, given: tuple[str, ...]) -> subprocess.Popen:
    """A process that has begun its work."""
    process = subprocess.Popen(
        [sys.executable, "-c", LAUNCHER, announced, str(script), *given],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    shown = ""
    while not shown.endswith("started\n"):
        line = process.stdout.readline()
        assert line, shown
        shown += line
    return process


def finish(process: subprocess.Popen) -> None:
    shown, _ = process.communicate(timeout=600)
    assert process.returncode == 0, shown


def kill_and_resume(
    folder: Path,
    announced: str,
    script: Path,
    given: tuple[str, ...],
    *,
    seconds: float,
    moments: int,
    seed: int,
) -> None:
    """Kill at random moments of work that takes some seconds, then let it end.

    One moment is in each equal part of most of the work. Each process lives for the time from one
    to the next, so all of them together have done no more than is done at the last moment.
    """
    generator = random.Random(seed)
    parts = [(part + generator.random()) / moments for part in range(moments)]
    at = [(0.02 + 0.83 * part) * seconds for part in parts]
    endings = []
    for before, after in zip([0.0, *at], at, strict=False):
        process = start(folder, announced, script, given)
        time.sleep(after - before)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        endings.append(process.returncode)
    # On a machine that was busy when the time was taken, the last ones may end before they die.
    assert endings[0] == -signal.SIGKILL, (endings, at)
    finish(start(folder, announced, script, given))


TIMES = {"seconds", "fit_seconds", "saved_seconds", "relight_seconds", "dense_seconds", "cached"}


def without_times(value: Any) -> Any:
    """JSON without what a clock says, and without the hashes of files that hold it."""
    match value:
        case dict():
            inner = {key: entry for key, entry in value.items() if key not in TIMES}
            return {key: without_times(entry) for key, entry in inner.items()}
        case list():
            return [without_times(entry) for entry in value]
        case _:
            return value


def contents(folder: Path) -> dict[str, Any]:
    """What must not depend on kills: all files, but for the times in some of them."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        of_run = path.name == "manifest.json" and (path.parent / "config.yaml").exists()
        if of_run or path.name == "report.html":
            found[name] = None
        elif path.suffix == ".json":
            found[name] = without_times(json.loads(path.read_text()))
        elif path.is_file():
            found[name] = path.read_bytes()
    return found


def check_same(folder: Path, reference: Path) -> None:
    """Same files, same bytes; above all, nothing that a killed process left."""
    ours, theirs = contents(folder), contents(reference)
    assert ours.keys() == theirs.keys()
    assert not [name for name in theirs if ".writing-" in name or "checkpoint" in name]
    assert [name for name in ours if ours[name] != theirs[name]] == []


@dataclass
class Uninterrupted:
    """A whole run that nothing disturbed, and how long its parts took."""

    folder: Path
    given: tuple[str, ...]
    bake_seconds: float
    fit_seconds: float


def run_whole(folder: Path, optimizer: str) -> Uninterrupted:
    folder.mkdir()
    make_ball(folder, 3)
    given = (*SOME_SECONDS, FITS[optimizer])
    finish(start(folder, "_bake", FIT, given))
    report = json.loads((folder / "out/report.json").read_text())
    (result,) = report["results"]
    assert result["status"] == "max_steps"
    return Uninterrupted(folder, given, report["bake"]["seconds"], result["fit_seconds"])


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> Uninterrupted:
    return run_whole(tmp_path_factory.mktemp("uninterrupted") / "run", "lbfgs")


class TestKilledProcesses:
    @pytest.mark.parametrize("moments", MOMENTS)
    def test_bake(self, tmp_path, uninterrupted, moments):
        make_ball(tmp_path, 3)
        kill_and_resume(
            tmp_path,
            "_bake",
            BAKE,
            uninterrupted.given,
            seconds=uninterrupted.bake_seconds,
            moments=moments,
            seed=1,
        )
        assert {path.name for path in tmp_path.iterdir()} == {"ball.obj", "cache"}
        shards = list((tmp_path / "cache").glob("*/shard-*.safetensors"))
        assert len(shards) >= 2 * (898 // POINTS_PER_SHARD)
        check_same(tmp_path / "cache", uninterrupted.folder / "cache")

    @pytest.mark.parametrize("moments", MOMENTS)
    def test_fit(self, tmp_path, uninterrupted, moments):
        self.check_fit(tmp_path, uninterrupted, moments)

    @pytest.mark.slow
    def test_fit_by_adam(self, tmp_path):
        (tmp_path / "killed").mkdir()
        self.check_fit(tmp_path / "killed", run_whole(tmp_path / "whole", "adam"), 10)

    def check_fit(self, folder: Path, whole: Uninterrupted, moments: int) -> None:
        make_ball(folder, 3)
        shutil.copytree(whole.folder / "cache", folder / "cache")
        kill_and_resume(
            folder,
            "_fit_all",
            FIT,
            whole.given,
            seconds=whole.fit_seconds,
            moments=moments,
            seed=3,
        )
        check_same(folder / "cache", whole.folder / "cache")
        check_same(folder / "out", whole.folder / "out")


TINY = (
    *(given for given in SOME_SECONDS if not given.startswith("transfer.")),
    "scene.ground_resolution=10",
    "transfer.resolution=4",
    "transfer.supersampling=2",
    "transfer.order=3",
    "representations=[{name:cpca,num_clusters:6,rank:2},{name:cpca,num_clusters:6,rank:3}]",
    "fit.max_steps=3",
)


@dataclass
class States:
    """Copies of a run's folder as they were just before each of its files got its name."""

    whole: Path
    folders: list[Path]
    names: list[str]


@pytest.fixture(scope="module")
def states(tmp_path_factory) -> States:
    """A run in this process, photographed whenever it was about to change what is on disk."""
    folder = tmp_path_factory.mktemp("states")
    whole = folder / "whole"
    whole.mkdir()
    make_ball(whole, 1)
    taken = States(whole, [], [])
    replace, unlink = Path.replace, Path.unlink

    def photograph(name: str) -> None:
        copy = folder / f"{len(taken.folders):03d}"
        shutil.copytree(whole, copy)
        for whole_file in copy.rglob(".writing-*"):
            data = whole_file.read_bytes()
            os.remove(whole_file)  # noqa: PTH107 - Path.unlink is being watched
            whole_file.with_name(f".writing-1-{name}").write_bytes(data[: len(data) // 2])
        taken.folders.append(copy)
        taken.names.append(name)

    def watched_replace(path: Path, target: Path) -> Path:
        photograph(target.name)
        return replace(path, target)

    def watched_unlink(path: Path, missing_ok: bool = False) -> None:
        if path.exists():
            photograph(f"-{path.name}")
        unlink(path, missing_ok=missing_ok)

    with pytest.MonkeyPatch.context() as patch:
        much_to_do(patch)
        patch.chdir(whole)
        patch.setattr(Path, "replace", watched_replace)
        patch.setattr(Path, "unlink", watched_unlink)
        assert fit_here() == 0
    return taken


def much_to_do(patch: pytest.MonkeyPatch) -> None:
    """Small shards, and fits that take all their steps, as in the processes above."""
    patch.setattr(run, "fit", lambda representation, *a, **k: fit(disturb(representation), *a, **k))
    patch.setattr(visibility, "_BITS_PER_SHARD", 60 * 6 * 8**2)
    patch.setattr(direct, "_POINTS_PER_SHARD", 60)


def fit_here() -> int:
    """In this process, with one thread: everything is small."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return runpy.run_path(str(FIT))["fit"](list(TINY))
    finally:
        torch.set_num_threads(threads)


class TestEveryStateOnDisk:
    """A kill leaves what was written before it and half of what was being written."""

    def check(self, states: States, monkeypatch, indices: Iterable[int]) -> None:
        much_to_do(monkeypatch)
        for index in indices:
            folder = states.folders[index]
            monkeypatch.chdir(folder)
            assert fit_here() == 0, states.names[index]
            check_same(folder, states.whole)

    def test_all_kinds_are_there(self, states):
        for name in ("shard-000001.safetensors", "cpca-6x2.checkpoint", "-cpca-6x3.checkpoint"):
            assert name in states.names
        assert states.names[-1] == "manifest.json"
        assert states.names.count("cpca-6x3.checkpoint") == 3
        assert any(folder.rglob(".writing-*") for folder in states.folders)
        for path in states.whole.rglob("out/results/*.safetensors"):
            load(path)

    def test_some_are_gone_on_from(self, states, monkeypatch):
        some = [
            states.names.index("shard-000001.safetensors"),
            states.names.index("cpca-6x2.checkpoint") + 2,
            states.names.index("cpca-6x2.safetensors.sha256"),
            states.names.index("-cpca-6x3.checkpoint"),
            len(states.names) - 1,
        ]
        self.check(states, monkeypatch, some)

    @pytest.mark.slow
    def test_each_is_gone_on_from(self, states, monkeypatch):
        self.check(states, monkeypatch, range(len(states.folders)))


STEPS = 8
OPTIMIZERS = ["lbfgs", "adam"]


def fit_some_steps(checkpoint: Path | None, optimizer: str, stop_after: int | None = None):
    """A fit whose process dies right after it has written the checkpoint of some step."""

    class Killed(BaseException):
        pass

    def progress(done: int, _: int) -> None:
        if done == stop_after:
            raise Killed

    generator = torch.Generator().manual_seed(5)
    values = torch.randn(70, 12, generator=generator) @ torch.randn(12, 12, generator=generator)
    transfer = TransferTensor.from_dense(values)
    start = disturb(CPCA.from_transfer(transfer, num_clusters=4, rank=3))
    options = {"optimizer": optimizer, "max_steps": STEPS, "tolerance": 0.0}
    try:
        return fit(start, transfer, checkpoint=checkpoint, progress=progress, **options)
    except Killed:
        return None


class TestCheckpoints:
    @pytest.mark.parametrize("optimizer", OPTIMIZERS)
    @pytest.mark.parametrize("every", [1, 3])
    def test_fit_that_dies_over_and_over_ends_the_same(self, tmp_path, optimizer, every):
        whole = fit_some_steps(None, optimizer)
        assert whole.steps == STEPS
        assert whole.error_after < whole.error_before
        path = tmp_path / "checkpoint"
        for stop in range(every, STEPS, every):
            assert fit_some_steps(path, optimizer, stop) is None
        resumed = fit_some_steps(path, optimizer)
        assert resumed.history == whole.history
        assert (resumed.status, resumed.steps) == (whole.status, whole.steps)
        assert resumed.error_before == whole.error_before
        assert resumed.error_after == whole.error_after
        for name, tensor in whole.representation.packed().items():
            assert torch.equal(resumed.representation.packed()[name], tensor), name

    @pytest.mark.parametrize("optimizer", OPTIMIZERS)
    def test_any_flipped_bit_is_detected(self, tmp_path, optimizer):
        path = tmp_path / "checkpoint"
        fit_some_steps(path, optimizer, 2)
        data = path.read_bytes()
        generator = random.Random(0)
        for position in [0, len(data) - 1, *(generator.randrange(len(data)) for _ in range(40))]:
            damaged = bytearray(data)
            damaged[position] ^= 1
            path.write_bytes(damaged)
            with pytest.raises(InputError, match="checkpoint: ") as caught:
                fit_some_steps(path, optimizer)
            assert "\n" not in str(caught.value)

    def test_cut_short(self, tmp_path):
        path = tmp_path / "checkpoint"
        fit_some_steps(path, "lbfgs", 2)
        for keep in (0, 5, 100, -1):
            path.write_bytes(path.read_bytes()[:keep])
            with pytest.raises(InputError, match="checkpoint: "):
                fit_some_steps(path, "lbfgs")

    def test_of_another_fit(self, tmp_path):
        path = tmp_path / "checkpoint"
        fit_some_steps(path, "lbfgs", 2)
        with pytest.raises(InputError, match="checkpoint of another fit"):
            fit_some_steps(path, "adam")
        transfer = TransferTensor.from_dense(torch.rand(30, 4))
        with pytest.raises(InputError, match="checkpoint of another fit"):
            fit(CPCA.from_transfer(transfer, num_clusters=2, rank=1), transfer, checkpoint=path)

    def test_tensors_that_are_no_checkpoint(self, tmp_path):
        path = tmp_path / "checkpoint"
        for metadata in (None, [1], {"steps": 3}):
            store.write_tensors(path, {"parameter.weights": torch.zeros(3)}, metadata)
            with pytest.raises(InputError, match="the checkpoint is damaged"):
                fit_some_steps(path, "lbfgs")
