"""Fits of tensors larger than a budget of memory, and of points shared out over two processes.

All is done in one process of its own, as memory is counted by the process; it forks into two for
the fits that share points.
"""

import errno
import json
import multiprocessing
import os
import re
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as distributed
from contract import random_transfer, relative
from two_processes import leave

from prt_torch import store
from prt_torch.construction import Problem, closed_form
from prt_torch.errors import InputError
from prt_torch.evaluate import transfer_error
from prt_torch.representations import CPCA, ClusteredTensor
from prt_torch.representations.cpca_clusters import count_distinct
from prt_torch.representations.scratch import ScratchRows
from prt_torch.transfer import TransferTensor

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
POINTS, COEFFS, SHARD = 100_000, 100, 1_000
BUDGET = POINTS * COEFFS * 4 // 5
FITS: dict[str, tuple[type[CPCA | ClusteredTensor], dict[str, Any]]] = {
    "cpca": (CPCA, {"num_clusters": 6, "rank": 2}),
    "adaptive": (CPCA, {"num_clusters": 8, "rank": 2, "method": "adaptive"}),
    "linear": (CPCA, {"num_clusters": 4, "rank": 2, "method": "static", "affine": False}),
    "coded": (CPCA, {"num_clusters": 6, "rank": 3, "quantisation_share": 4.0}),
    "clustered_tensor": (ClusteredTensor, {"num_clusters": 4, "ranks": (2, 6, 3)}),
    "coded_tensor": (
        ClusteredTensor,
        {"num_clusters": 4, "ranks": (2, 6, 3), "quantisation_share": 1.0},
    ),
}
FEW_PASSES: dict[str, tuple[type[CPCA | ClusteredTensor], dict[str, Any]]] = {
    "cpca": (CPCA, {"num_clusters": 1, "rank": 3}),
    "clustered_tensor": (ClusteredTensor, {"num_clusters": 1, "ranks": (1, 6, 3), "max_turns": 1}),
}
TYPES = [("cpca", torch.float64), *((kind, torch.float32) for kind in FITS)]


def peak_above_start(folder: Path, kind: str) -> dict[str, float]:
    """Bytes of a fit from shards within a fifth of their size, and how far it is from that of one.

    All shards are alike, so the points of one of them have the same clusters and subspaces.
    """

    def block(_: slice):
        return {"values": random_transfer(SHARD, coeffs=COEFFS, dtype=torch.float32).dense()}, {}

    if not folder.exists():
        store.build_sharded(block, rows=POINTS, rows_per_shard=SHARD, inputs={}, folder=folder)
    transfer = TransferTensor(store.ShardedTensor(folder, "values"))
    family, options = FEW_PASSES[kind]
    alone = family.from_transfer(transfer.block(slice(0, SHARD)), **options)
    CLEAR.write_text("5")
    before = kilobytes("VmRSS")
    model = family.from_transfer(transfer, memory_budget=BUDGET, **options)
    peak = 1024 * (kilobytes("VmHWM") - before)
    last = torch.arange(POINTS - SHARD, POINTS)
    return {"peak": peak, "dense": relative(model.dense(last), alone.dense())}


def kilobytes(name: str) -> int:
    """Of this process."""
    (line,) = (one for one in STATUS.read_text().splitlines() if one.startswith(name))
    return int(line.split()[1])


def share(rank: int, folder: Path) -> None:
    """One of two processes; it ends here."""
    group_store = distributed.FileStore(str(folder / "group"), 2)
    distributed.init_process_group("gloo", store=group_store, rank=rank, world_size=2)
    group, found = distributed.group.WORLD, {}
    for kind, dtype in TYPES:
        family, options = FITS[kind]
        whole = random_transfer(300, rows=4, coeffs=20, dtype=dtype)
        own = whole.block(slice(0, 110) if rank == 0 else slice(110, 300))
        model = family.from_transfer(own, process_group=group, **options).gathered(group)
        alone = family.from_transfer(whole, **options)
        found[f"{kind} {dtype}"] = {
            "dense": relative(model.dense(), alone.dense()),
            "errors": [transfer_error(model, whole), transfer_error(alone, whole)],
            "reflectance": torch.equal(model.surface.reflectance, alone.surface.reflectance),
        }
    leave(folder, rank, found)


def measure(folder: Path) -> None:
    """All that needs a process of its own."""
    torch.set_num_threads(1)
    if CLEAR.exists():
        peaks = {kind: peak_above_start(folder / "shards", kind) for kind in FEW_PASSES}
        (folder / "peaks.json").write_text(json.dumps(peaks))
    if distributed.is_available() and distributed.is_gloo_available():
        for rank in (0, 1):
            if os.fork() == 0:
                share(rank, folder)
        os.wait()
        os.wait()


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sharded")
    process = multiprocessing.get_context("spawn").Process(target=measure, args=(folder,))
    process.start()
    process.join(timeout=240)
    if process.is_alive():
        process.kill()
    assert process.exitcode == 0
    return folder


@pytest.mark.parametrize("kind", FEW_PASSES)
def test_peak_stays_below_a_fifth_of_the_tensor(measured, kind):
    if not (measured / "peaks.json").exists():
        pytest.skip("/proc/self/clear_refs, which peaks are measured by, is missing")
    found = json.loads((measured / "peaks.json").read_text())[kind]
    assert 0 < found["peak"] < BUDGET
    assert found["dense"] < 1e-4  # sums of a hundred times as many are rounded elsewhere


@pytest.mark.parametrize(("kind", "dtype"), TYPES)
def test_two_processes_make_the_fit_of_one(measured, kind, dtype):
    if not (measured / "1.json").exists():
        pytest.skip("torch.distributed has no gloo here")
    for rank in (0, 1):
        found = json.loads((measured / f"{rank}.json").read_text())[f"{kind} {dtype}"]
        assert found["dense"] < 1e-5
        assert found["errors"][0] == pytest.approx(found["errors"][1], rel=1e-5)
        assert found["reflectance"]


@pytest.mark.parametrize("kind", FITS)
def test_chunks_change_nothing(kind):
    """Of a few hundred points each."""
    family, options = FITS[kind]
    transfer = random_transfer(900, rows=3, coeffs=20, dtype=torch.float32)
    free = family.from_transfer(transfer, **options)
    budget = least_budget(kind, transfer) + 2 * 2**20
    tight = family.from_transfer(transfer, memory_budget=budget, **options)
    assert torch.equal(tight.labels, free.labels)
    assert relative(tight.dense(), free.dense()) < 1e-5


@pytest.mark.parametrize("kind", FITS)
def test_a_budget_that_cannot_be_kept(kind):
    transfer = random_transfer(100)
    with pytest.raises(InputError, match=r"memory_budget: this fit needs at least \d+ bytes"):
        FITS[kind][0].from_transfer(transfer, memory_budget=1000, **FITS[kind][1])


def least_budget(kind: str, transfer: TransferTensor) -> int:
    """What a refusal says that is needed."""
    family, options = FITS[kind]
    with pytest.raises(InputError) as refusal:
        family.from_transfer(transfer, memory_budget=1, **options)
    (found,) = re.findall(r"at least (\d+) bytes", str(refusal.value))
    return int(found)


@pytest.mark.parametrize("kind", ["cpca", "clustered_tensor"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_magnitude_does_not_matter(kind, dtype):
    """Powers of two round nothing, so far from 1 that squares vanish or overflow."""
    family, options = FITS[kind]
    bits: dict[str, Any] = {"bits": None} if family is ClusteredTensor else {}
    transfer = random_transfer(60, coeffs=9, dtype=dtype)
    plain = family.from_transfer(transfer, **options, **bits).dense()
    most = 100 if dtype == torch.float32 else 900
    for power in (2.0**-most, 2.0**most):
        scaled = TransferTensor.from_dense(transfer.dense() * power)
        found = family.from_transfer(scaled, **options, **bits).dense()
        assert relative(found / power, plain) < 1e-5


def test_equal_points_are_one_wherever_they_lie():
    distinct = torch.randn(3, 37, generator=torch.Generator().manual_seed(0))
    distinct[2, 5] = distinct[1, 5] = 0.0
    for count in (7, 15, 100, 1001):
        data = distinct[torch.arange(count) % 3]
        data[::6, 5] = -data[::6, 5] * (data[::6, 5] == 0) + data[::6, 5]  # -0 is 0
        assert count_distinct(data) == 3
    near = distinct[:1].repeat(3, 1)
    near[1, 0] = torch.nextafter(near[0, 0], torch.tensor(9.0))
    near[2] = -near[0]
    assert count_distinct(near) == 3
    assert count_distinct(distinct.double(), most=2) == 2


def test_scratch_rows_are_those_written():
    rows = ScratchRows((5, 2, 3), torch.zeros(1, dtype=torch.float64))
    values = torch.arange(18, dtype=torch.float64).view(3, 2, 3)
    rows[1:4] = values
    assert torch.equal(rows[0:5], torch.cat([torch.zeros(1, 2, 3), values, torch.zeros(1, 2, 3)]))
    with pytest.raises(ValueError, match="expected 2 rows"):
        rows[0:2] = values


def test_no_room_for_scratch_rows(monkeypatch):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    rows = ScratchRows((5, 2), torch.zeros(1))
    with pytest.raises(InputError, match=r"memory_budget: .* 40 bytes .*No space left"):
        rows[0:5] = torch.zeros(5, 2)


def test_a_run_keeps_its_memory_budget_with_the_same_result(monkeypatch):
    transfer = random_transfer(3000, coeffs=300, dtype=torch.float32)
    parameters = {"num_clusters": 2, "rank": 1}
    asked, real = [], CPCA.from_transfer

    def spied(*args: Any, **options: Any) -> CPCA:
        asked.append(options.get("memory_budget"))
        return real(*args, **options)

    monkeypatch.setattr(CPCA, "from_transfer", spied)
    much, little = 8 * transfer.num_bytes, 8 * transfer.num_bytes - 1
    models = [
        closed_form(Problem(transfer, memory_budget=budget), "cpca", parameters)
        for budget in (much, little)
    ]
    assert asked == [None, little]
    assert all(
        torch.equal(a, b) for a, b in zip(*(m.packed().values() for m in models), strict=True)
    )
