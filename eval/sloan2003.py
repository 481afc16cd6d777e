"""Repeat the figures of Sloan, Hall, Hart, Snyder 2003 on a scene, beside the numbers they print.

python eval/sloan2003.py [--mesh=FILE] [--supersampling=N] [--only=3,5,6,8,10]

Errors are squared errors over squared norms; the paper prints sums of squares of its own scenes
(a bird of 48,668 points and a Buddha), so what compares is the ratio between methods. The object
stands on a ground plane. Times are medians on this machine, encodings are timed once.
"""

import sys
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from prt_torch import evaluate
from prt_torch.assets import (
    Mesh,
    concatenate,
    find_environment,
    ground_plane,
    load_mesh,
    procedural_scene,
)
from prt_torch.assets.brdf import AshikhminShirley
from prt_torch.assets.material import Material
from prt_torch.baking import bake
from prt_torch.bases import SphericalHarmonics
from prt_torch.command import main
from prt_torch.errors import InputError
from prt_torch.relight import Relighter
from prt_torch.representations import CPCA, DenseTransfer
from prt_torch.representations.cpca_relabel import coherence, reclassified
from prt_torch.transfer import TransferTensor

CLUSTERS = 256
ANISOTROPIC = Material(
    lambertian=False,
    glossy=AshikhminShirley(specular=0.7, diffuse=0.0, exponent_u=10.0, exponent_v=60.0),
)
FIGURES = ("3", "5", "6", "8", "10")


@main
def repeat(arguments: list[str]) -> None:
    """Print the tables that were asked for."""
    mesh, supersampling, wanted = procedural_scene(detail=2), 2, list(FIGURES)
    for argument in arguments:
        match argument.partition("="):
            case ("--mesh", "=", path):
                mesh = load_mesh(path)
                mesh = concatenate([mesh, ground_plane(mesh)], mesh.name)
            case ("--supersampling", "=", count) if count.isdigit():
                supersampling = int(count)
            case ("--only", "=", figures) if set(figures.split(",")) <= set(FIGURES):
                wanted = figures.split(",")
            case _:
                raise InputError(
                    f"{argument}: expected --mesh=FILE, --supersampling=N or --only=3,5,6,8,10"
                )
    console = Console(width=140)
    console.print(f"{mesh.name}: {mesh.num_points} points, {mesh.num_faces} faces")
    baked = partial(bake, mesh, supersampling=supersampling, cache=".cache/bakes")
    if "3" in wanted:
        console.print(figure_3(baked(light_basis=SphericalHarmonics(5))))
    if "6" in wanted:
        console.print(figure_6(baked(light_basis=SphericalHarmonics(10))))
    if {"5", "8", "10"} & set(wanted):
        glossy = {mesh.parts[0].name: ANISOTROPIC}
        light = SphericalHarmonics(5)
        transfer = baked(materials=glossy, light_basis=light)
        if "10" in wanted:
            console.print(figures_10_and_11(transfer))
        if "5" in wanted:
            console.print(figure_5(transfer, mesh))
        if "8" in wanted:
            rows = {n: baked(materials=glossy, light_basis=light, num_rows=n) for n in (16, 25)}
            rows[64] = baked(materials=glossy, light_basis=light, num_rows=64)
            console.print(figure_8(rows, mesh))


def figure_3(transfer: TransferTensor) -> Table:
    """Diffuse transfer, 256 clusters of rank 3, beside VQ and PCA of as many bytes."""
    table = _table(f"Figures 3 and 4: diffuse, {transfer.num_coeffs} values a point")
    cpca = partial(CPCA.from_transfer, transfer, num_clusters=CLUSTERS, rank=3)
    floats = transfer.num_points * 3 + CLUSTERS * 4 * transfer.num_coeffs
    clusters = floats // transfer.num_coeffs
    rank = max(1, (floats - transfer.num_coeffs) // (transfer.num_points + transfer.num_coeffs))
    entries = [
        (f"VQ, {clusters} clusters", "", _static(transfer, clusters, 0)),
        (f"PCA, rank {rank}", "", _static(transfer, 1, rank)),
        ("static 256x3", "17.7", partial(cpca, method="static")),
        ("iterative 256x3", "4.28", partial(cpca, method="iterative")),
        ("adaptive 256x3", "2.54", partial(cpca, method="adaptive")),
    ]
    _fill(table, transfer, entries, relative_to="static 256x3")
    return table


def figure_6(transfer: TransferTensor) -> Table:
    """Diffuse transfer for light of order 10, 64 clusters."""
    table = _table(f"Figure 6: diffuse, {transfer.num_coeffs} values a point")
    cpca = partial(CPCA.from_transfer, transfer, num_clusters=64)
    entries = [
        ("static 64x1", "15.293", partial(cpca, rank=1, method="static")),
        ("iterative 64x1", "8.83", partial(cpca, rank=1)),
        ("iterative 64x2", "2.23", partial(cpca, rank=2)),
        ("iterative 64x4", "0.432", partial(cpca, rank=4)),
    ]
    _fill(table, transfer, entries, relative_to="static 64x1")
    return table


def figures_10_and_11(transfer: TransferTensor) -> Table:
    """Anisotropic glossy transfer: PCA, VQ and CPCA at the paper's sizes, and ranks 2 to 12."""
    size = transfer.num_rows * transfer.num_coeffs
    table = _table(f"Figures 10 and 11: anisotropic glossy, {size} values a point (bird, Buddha)")
    cpca = partial(CPCA.from_transfer, transfer, num_clusters=CLUSTERS)
    entries = [
        ("PCA, rank 20", "101304, -", _static(transfer, 1, 20)),
        ("VQ, 1792 clusters", "14799, -", _static(transfer, 1792, 0)),
        ("static 256x8", "", partial(cpca, rank=8, method="static")),
        ("iterative 256x2", "9511, 40354", partial(cpca, rank=2)),
        ("iterative 256x4", "2353, 21078", partial(cpca, rank=4)),
        ("iterative 256x8", "294.4, 8524", partial(cpca, rank=8)),
        ("iterative 256x12", "66.75, 4413", partial(cpca, rank=12)),
        ("adaptive 256x8", "", partial(cpca, rank=8, method="adaptive")),
    ]
    _fill(table, transfer, entries, relative_to="iterative 256x8")
    return table


def figure_5(transfer: TransferTensor, mesh: Mesh) -> Table:
    """Overdraw before and after reclassification, and by superclusters."""
    table = Table(title="Figure 5: overdraw, 256 clusters, rank 8", title_justify="left")
    for column in ("clusters", "overdraw", "paper", "superclusters", "overdraw by them", "paper"):
        table.add_column(column, justify="right")
    table.add_column("error", justify="right")
    table.add_column("seconds", justify="right")
    model = CPCA.from_transfer(transfer, num_clusters=CLUSTERS, rank=8)
    for budget, alone, together in ((0.0, "2.03", ""), (0.05, "", ""), (0.1, "1.79", "1.60")):
        start = time.perf_counter()
        moved = model
        if budget:
            moved = reclassified(model, transfer, mesh.faces, budget=budget)
        drawn = coherence(moved, mesh.faces)
        taken = time.perf_counter() - start
        table.add_row(
            f"error budget {budget:.0%}" if budget else "as fitted",
            f"{drawn['overdraw']:.3f}",
            alone,
            str(drawn["superclusters"]),
            f"{drawn['overdraw_merged']:.3f}",
            together,
            f"{evaluate.transfer_error(moved, transfer):.3e}",
            f"{taken:.1f}",
        )
    return table


def figure_8(tensors: dict[int, TransferTensor], mesh: Mesh) -> Table:
    """Rows of exit functions: what 16 and 25 lose of 64, and what relighting them costs.

    Zero-hemisphere coefficients are the Gram matrix times the least-squares ones.
    """
    table = Table(title="Figures 7 and 8: rows of glossy transfer", title_justify="left")
    for column in ("rows", "radiance error", "zero-hemisphere", "dense ms", "CPCA 256x8 ms"):
        table.add_column(column, justify="right")
    reference, positions = tensors[64], mesh.vertices.float()
    light = torch.stack([SphericalHarmonics(5).project(find_environment("sunset"))]).float()
    directions = torch.randn(8, 3, generator=torch.Generator().manual_seed(0))
    reach = float((positions - positions.mean(0)).norm(dim=1).max())
    views = positions.mean(0) + 3 * reach * torch.nn.functional.normalize(directions, dim=1)
    seen = evaluate.seen_from(reference.surface, views)[..., None].float()
    truth = evaluate.dense_radiance(reference, light, views)[0] * seen
    for count in (16, 25):
        transfer = tensors[count]
        gram = transfer.surface.exit_basis.gram() * (2 * torch.pi)
        zero = TransferTensor(gram.float() @ transfer.dense(), transfer.surface)
        errors = [
            evaluate.radiance_error(evaluate.dense_radiance(one, light, views)[0] * seen, truth)
            for one in (transfer, zero)
        ]
        dense = Relighter(DenseTransfer.from_transfer(transfer))
        model = Relighter(CPCA.from_transfer(transfer, num_clusters=CLUSTERS, rank=8))
        with torch.no_grad():
            seconds = evaluate.median_seconds(
                [partial(dense, light, views[:1]), partial(model, light, views[:1])]
            )
        times = [f"{taken * 1e3:.2f}" for taken in seconds]
        table.add_row(str(count), f"{errors[0]:.4f}", f"{errors[1]:.4f}", *times)
    return table


def _static(transfer: TransferTensor, clusters: int, rank: int) -> Callable[[], CPCA]:
    return partial(CPCA.from_transfer, transfer, num_clusters=clusters, rank=rank, method="static")


def _table(title: str) -> Table:
    table = Table(title=title, title_justify="left")
    for column in ("method", "squared error", "ratio", "paper", "MiB", "encode s", "relight ms"):
        table.add_column(column, justify="right")
    return table


def _fill(
    table: Table,
    transfer: TransferTensor,
    entries: Iterable[tuple[str, str, Callable[[], CPCA]]],
    *,
    relative_to: str,
) -> None:
    """One row a method: error, its ratio to one of them, bytes and times."""
    light = torch.randn(1, transfer.num_coeffs, 3, generator=torch.Generator().manual_seed(0))
    made: dict[str, tuple[CPCA, float, float, str]] = {}
    for name, paper, encode in entries:
        start = time.perf_counter()
        model = encode()
        taken = time.perf_counter() - start
        made[name] = (model, evaluate.transfer_error(model, transfer), taken, paper)
    calls: list[Callable[[], Any]] = [partial(model, light) for model, *_ in made.values()]
    with torch.no_grad():
        dense = DenseTransfer.from_transfer(transfer)
        *seconds, dense_seconds = evaluate.median_seconds([*calls, partial(dense, light)])
    reference = made[relative_to][1]
    for (name, (model, error, taken, paper)), relit in zip(made.items(), seconds, strict=True):
        table.add_row(
            name,
            f"{error:.3e}",
            f"{error / reference:.3f}",
            paper,
            f"{sum(model.storage().values()) / 2**20:.2f}",
            f"{taken:.1f}",
            f"{relit * 1e3:.2f}",
        )
    raw = f"{transfer.num_bytes / 2**20:.1f}"
    table.add_row("uncompressed", "0", "0", "0", raw, "", f"{dense_seconds * 1e3:.2f}")


if __name__ == "__main__":
    sys.exit(repeat(sys.argv[1:]))
