"""Measure this library beside its peers and beside the machine's own limits, in one run.

python eval/benchmark.py [--mesh=FILE] [--quick]

Prints tables: rays against Embree's own any-hit rate, CPCA against scikit-learn's k-means and
PCA, and relighting against the uncompressed product and against the floor that memory bandwidth
and arithmetic set; diffuse, and glossy with 24 exit functions. Everything compared is measured in
turn in the same process; times are medians.
"""

import os
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from sklearn.cluster import KMeans
from sklearn.decomposition import PCA
from torch import Tensor

from prt_torch import evaluate
from prt_torch.assets import Mesh, concatenate, ground_plane, load_mesh, procedural_scene
from prt_torch.assets.brdf import AshikhminShirley
from prt_torch.assets.material import Material
from prt_torch.baking import bake
from prt_torch.baking.visibility import Tracer
from prt_torch.bases import SphericalHarmonics
from prt_torch.command import main
from prt_torch.errors import InputError
from prt_torch.metric import Metric
from prt_torch.relight import Relighter
from prt_torch.representations import CPCA, DenseTransfer
from prt_torch.transfer import TransferTensor

CLUSTERS, RANK, GLOSSY_RANK = 256, 4, 8
MOST_CLUSTERS = 2048
BRUSHED = AshikhminShirley(specular=0.7, diffuse=0.0, exponent_u=10.0, exponent_v=60.0)
RESOLUTION, SUPERSAMPLING = 32, 2
LIGHTS = (1, 16, 64)
ORDERS = (6, 10)


@main
def benchmark(arguments: list[str]) -> None:
    """Run all benchmarks."""
    mesh, quick = procedural_scene(detail=2), False
    for argument in arguments:
        match argument.partition("="):
            case ("--mesh", "=", path):
                mesh = load_mesh(path)
                mesh = concatenate([mesh, ground_plane(mesh)], mesh.name)
            case ("--quick", "", ""):
                quick = True
            case _:
                raise InputError(f"{argument}: expected --mesh=FILE or --quick")
    console = Console(width=130)
    rounds = 5 if quick else 15
    bandwidth, rate = machine_limits(rounds)
    console.print(
        f"{mesh.name}: {mesh.num_points} points, {mesh.num_faces} faces; "
        f"{torch.get_num_threads()} threads, {bandwidth / 1e9:.1f} GB/s (copy, read + written), "
        f"{rate / 1e9:.0f} GFLOP/s (float32 matrix product)"
    )
    console.print(bench_rays(mesh, rounds=3 if quick else 5))
    peak = PeakMemory()
    tensors = {order: baked(mesh, order) for order in ORDERS}
    console.print(f"bake at {RESOLUTION}x{SUPERSAMPLING}: peak memory of the process {peak}")
    console.print(bench_encoding(tensors, rounds=1 if quick else 3))
    console.print(bench_relighting(tensors, bandwidth, rate, rounds=rounds))
    glossy = baked(mesh, 5, {mesh.parts[0].name: Material(lambertian=False, glossy=BRUSHED)})
    console.print(bench_glossy_encoding(glossy))
    console.print(bench_glossy_relighting(glossy, bandwidth, rate, rounds=rounds))


def baked(mesh: Mesh, order: int, materials: dict[str, Material] | None = None) -> TransferTensor:
    """Transfer of a scene, from bits traced once."""
    return bake(
        mesh,
        materials=materials,
        light_basis=SphericalHarmonics(order),
        resolution=RESOLUTION,
        supersampling=SUPERSAMPLING,
        cache=".cache/bakes",
    )


class PeakMemory:
    """Peak resident memory of this process since it was made, sampled from /proc."""

    def __init__(self) -> None:
        self.peak = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        while not self._stop.wait(0.02):
            self.peak = max(self.peak, resident_bytes())

    def __str__(self) -> str:
        self._stop.set()
        self._thread.join()
        return f"{max(self.peak, resident_bytes()) / 2**20:.0f} MiB"


def resident_bytes() -> int:
    """Resident memory of this process now; 0 where /proc does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")
    except OSError:
        return 0


def machine_limits(rounds: int) -> tuple[float, float]:
    """Bytes a second of a large copy (read and written), operations a second of a large product."""
    source = torch.randn(2**26)
    target = torch.empty_like(source)
    a = torch.randn(2048, 2048)
    copy_seconds, product_seconds = evaluate.median_seconds(
        [lambda: target.copy_(source), lambda: torch.mm(a, a)], rounds=rounds
    )
    return 2 * source.nbytes / copy_seconds, 2 * 2048**3 / product_seconds


def bench_rays(mesh: Mesh, rounds: int) -> Table:
    """Rays a second of the bake over those of bare Embree calls on the same rays and threads."""
    table = Table(title="Visibility: rays a second", title_justify="left")
    for column in ("texels", "rays", "bake", "bare Embree", "ratio"):
        table.add_column(column, justify="right")
    step = max(1, mesh.num_points // 600)
    rows = range(0, mesh.num_points, step)
    for fine in (64, 128):
        tracer = Tracer(mesh, fine)
        prepared = [tracer.rays(point) for point in rows]
        counts = sum(len(targets) for _, targets in prepared)
        workers = torch.get_num_threads()

        def in_threads(work: Callable[[Any], Any], items: Any, workers: int = workers) -> None:
            with ThreadPoolExecutor(workers) as pool:
                list(pool.map(work, [items[worker::workers] for worker in range(workers)]))

        def bare(pairs: Any, tracer: Tracer = tracer) -> None:
            for origins, targets in pairs:
                tracer.occluded(origins, targets)

        ours, embree = evaluate.median_seconds(
            [partial(in_threads, tracer.trace, rows), partial(in_threads, bare, prepared)],
            rounds=rounds,
            warm_up=1,
        )
        table.add_row(
            f"6x{fine}x{fine}",
            f"{counts / 1e6:.1f} M",
            f"{counts / ours / 1e6:.2f} M/s",
            f"{counts / embree / 1e6:.2f} M/s",
            f"{embree / ours:.2f}",
        )
    return table


def bench_encoding(tensors: dict[int, TransferTensor], rounds: int) -> Table:
    """CPCA, static and iterative, against scikit-learn at the same clusters and rank."""
    table = Table(title=f"CPCA encoding, {CLUSTERS} clusters, rank {RANK}", title_justify="left")
    for column in ("order", "method", "seconds", "of sklearn", "squared error", "of sklearn"):
        table.add_column(column, justify="right")
    for order, transfer in tensors.items():
        data = transfer.dense().flatten(1)
        methods: dict[str, Callable[[], Tensor]] = {
            "sklearn KMeans + PCA": partial(sklearn_cpca, data),
            "static": partial(our_cpca, transfer, "static"),
            "iterative": partial(our_cpca, transfer, "iterative"),
        }
        seconds = evaluate.median_seconds(list(methods.values()), rounds=rounds, warm_up=1)
        norm = data.double().square().sum()
        errors = [
            float((method().double() - data).square().sum() / norm) for method in methods.values()
        ]
        for name, taken, error in zip(methods, seconds, errors, strict=True):
            table.add_row(
                str(order),
                name,
                f"{taken:.2f}",
                f"{taken / seconds[0]:.2f}",
                f"{error:.3e}",
                f"{error / errors[0]:.2f}",
            )
    return table


def our_cpca(transfer: TransferTensor, method: Any) -> Tensor:
    """What CPCA makes of a tensor."""
    model = CPCA.from_transfer(transfer, num_clusters=CLUSTERS, rank=RANK, method=method)
    with torch.no_grad():
        return model.dense().flatten(1)


def sklearn_cpca(data: Tensor, clusters: int = CLUSTERS, rank: int = RANK) -> Tensor:
    """The same by scikit-learn: k-means once, then a PCA of each cluster."""
    points = data.numpy()
    kmeans = KMeans(clusters, n_init=1, random_state=0)  # pyright: ignore[reportArgumentType]
    labels = kmeans.fit_predict(points)
    out = np.empty_like(points)
    for cluster in range(clusters):
        own = points[labels == cluster]
        if len(own) <= rank:
            out[labels == cluster] = own
            continue
        pca = PCA(rank).fit(own)
        out[labels == cluster] = pca.inverse_transform(pca.transform(own))
    return torch.from_numpy(out)


def bench_glossy_encoding(transfer: TransferTensor) -> Table:
    """Iterative CPCA of glossy transfer, and scikit-learn with clusters raised to its error.

    Both minimise, and are compared in, the L2 norm that weighs rows by their Gram matrix.
    """
    size = transfer.num_rows * transfer.num_coeffs
    title = f"Glossy encoding, {transfer.num_points} points x {size} values, rank {GLOSSY_RANK}"
    table = Table(title=title, title_justify="left")
    for column in ("method", "clusters", "seconds", "MiB", "squared error"):
        table.add_column(column, justify="right")
    weighed = Metric.l2(transfer).weigh(transfer.dense()).flatten(1)
    norm = float(weighed.double().square().sum())
    start = time.perf_counter()
    model = CPCA.from_transfer(transfer, num_clusters=CLUSTERS, rank=GLOSSY_RANK)
    taken = time.perf_counter() - start
    goal = evaluate.transfer_error(model, transfer)
    num_bytes = sum(model.storage().values()) / 2**20
    table.add_row("ours", str(CLUSTERS), f"{taken:.1f}", f"{num_bytes:.2f}", f"{goal:.3e}")
    clusters, error = CLUSTERS, float("inf")
    while error > goal and clusters <= MOST_CLUSTERS:
        start = time.perf_counter()
        found = sklearn_cpca(weighed, clusters, GLOSSY_RANK)
        taken = time.perf_counter() - start
        error = float((found.double() - weighed).square().sum()) / norm
        floats = transfer.num_points * GLOSSY_RANK + clusters * (GLOSSY_RANK + 1) * size
        num_bytes = (4 * floats + 2 * transfer.num_points) / 2**20
        cells = (str(clusters), f"{taken:.1f}", f"{num_bytes:.2f}", f"{error:.3e}")
        table.add_row("sklearn KMeans + PCA", *cells)
        clusters *= 2
    return table


def bench_glossy_relighting(
    transfer: TransferTensor, bandwidth: float, rate: float, rounds: int
) -> Table:
    """Exit functions of glossy transfer, and radiance towards one view."""
    size = f"{transfer.num_rows} x {transfer.num_coeffs}"
    title = f"Glossy relighting, {size}, {CLUSTERS} clusters, rank {GLOSSY_RANK}; milliseconds"
    table = Table(title=title, title_justify="left")
    products = ("dense", "CPCA", "faster", "dense, view", "CPCA, view", "faster")
    for column in ("lights", *products, "floor", "bound by", "of floor", "peak"):
        table.add_column(column, justify="right")
    model = CPCA.from_transfer(transfer, num_clusters=CLUSTERS, rank=GLOSSY_RANK)
    dense = DenseTransfer.from_transfer(transfer)
    view = torch.tensor([[3.0, 2.0, 4.0]])
    for lights in LIGHTS[:2]:
        light = torch.randn(lights, transfer.num_coeffs, 3)
        with torch.no_grad():
            seconds = evaluate.median_seconds(
                [
                    partial(dense, light),
                    partial(model, light),
                    partial(Relighter(dense), light, view),
                    partial(Relighter(model), light, view),
                ],
                rounds=rounds,
                warm_up=3,
            )
            peak = evaluate.peak_bytes(partial(model, light))
        floor, bound = relighting_floor(model, lights, bandwidth, rate)
        plain, ours, plain_view, our_view = (taken * 1e3 for taken in seconds)
        table.add_row(
            str(lights),
            f"{plain:.2f}",
            f"{ours:.2f}",
            f"{plain / ours:.2f}x",
            f"{plain_view:.2f}",
            f"{our_view:.2f}",
            f"{plain_view / our_view:.2f}x",
            f"{floor * 1e3:.2f}",
            bound,
            f"{floor * 1e3 / ours:.2f}",
            f"{peak / 2**20:.1f} MiB",
        )
    return table


def bench_relighting(
    tensors: dict[int, TransferTensor], bandwidth: float, rate: float, rounds: int
) -> Table:
    """Relighting against the uncompressed product and against the floor of this machine."""
    title = f"Relighting, {CLUSTERS} clusters, rank {RANK}; times in microseconds"
    table = Table(title=title, title_justify="left")
    products = ("dense", "CPCA", "faster", "dense x albedo", "CPCA x albedo", "faster")
    for column in ("order", "lights", *products, "floor", "bound by", "of floor", "peak"):
        table.add_column(column, justify="right")
    for order, transfer in tensors.items():
        model = CPCA.from_transfer(transfer, num_clusters=CLUSTERS, rank=RANK)
        dense, ours = DenseTransfer.from_transfer(transfer), model
        for lights in LIGHTS:
            light = torch.randn(lights, transfer.num_coeffs, 3)
            with torch.no_grad():
                dense_seconds, our_seconds, dense_all, our_all = evaluate.median_seconds(
                    [
                        partial(dense, light),
                        partial(ours, light),
                        partial(Relighter(dense), light),
                        partial(Relighter(ours), light),
                    ],
                    rounds=4 * rounds,
                    warm_up=5,
                )
                peak = evaluate.peak_bytes(partial(ours, light))
            floor, bound = relighting_floor(model, lights, bandwidth, rate)
            table.add_row(
                str(order),
                str(lights),
                f"{dense_seconds * 1e6:.0f}",
                f"{our_seconds * 1e6:.0f}",
                f"{dense_seconds / our_seconds:.2f}x",
                f"{dense_all * 1e6:.0f}",
                f"{our_all * 1e6:.0f}",
                f"{dense_all / our_all:.2f}x",
                f"{floor * 1e6:.0f}",
                bound,
                f"{floor / our_seconds:.2f}",
                f"{peak / 2**20:.1f} MiB",
            )
    return table


def relighting_floor(model: CPCA, lights: int, bandwidth: float, rate: float) -> tuple[float, str]:
    """The larger of bytes over bandwidth and operations over rate, and which of them it is."""
    columns = 3 * lights * model.num_rows
    vectors = model.num_clusters * (model.rank + 1)
    operations = 2 * columns * (vectors * model.num_coeffs + model.num_points * (model.rank + 1))
    result = 4 * columns * model.num_points
    moved = sum(model.storage().values()) + 12 * lights * model.num_coeffs + result
    by_bytes, by_operations = moved / bandwidth, operations / rate
    return max(by_bytes, by_operations), "memory" if by_bytes > by_operations else "arithmetic"


if __name__ == "__main__":
    start = time.perf_counter()
    status = benchmark(sys.argv[1:])
    print(f"{time.perf_counter() - start:.0f} s in all")
    sys.exit(status)
