"""Repeat the tables of Tsai and Shih 2006 on a scene, beside the numbers they print.

python eval/tsai2006.py [--mesh=FILE] [--up=y|z] [--clusters=N] [--supersampling=N]
                        [--only=table,lights,segmented]

Table 1: transfer of a Cook-Torrance object on a Lambertian plane, 16 BRDF factors, in 642 radial
basis functions and as clustered tensors. Lights: a scattered light that turns, step by step of
section 6. Segmented: table 2, segmented CPCA of the same scene in Haar wavelets, which bakes again
at ten times the size. Without a mesh, the embedded scene. Environments: eval/environments.py.
"""

import sys
import time
from typing import Any, Literal

import torch
from jaxtyping import Float
from rich.console import Console
from rich.table import Table
from torch import Tensor

from prt_torch import evaluate
from prt_torch.assets import (
    Mesh,
    concatenate,
    find_environment,
    ground_plane,
    load_mesh,
    procedural_scene,
)
from prt_torch.assets.brdf import CookTorrance
from prt_torch.assets.material import Material
from prt_torch.baking import bake
from prt_torch.bases import SRBF, CubeDirections, Haar, LightBasis, SRBFExpansion
from prt_torch.bases.srbf import kernel_inner_products
from prt_torch.bases.srbf_fitting import fit_environment
from prt_torch.command import main
from prt_torch.errors import InputError
from prt_torch.relight import Relighter
from prt_torch.representations import (
    ClusteredTensor,
    DenseTransfer,
    Representation,
    SegmentedCPCA,
)
from prt_torch.sphere import rotation_about_up
from prt_torch.transfer import TransferTensor

COOK = CookTorrance(f0=0.5, roughness=0.4)
ROWS, CENTERS = 16, 642
RANKS = ((8, 48, 24), (16, 48, 24))  # the paper's, and with nothing of the view cut off
PAPER = {  # points, raw and SRBF GB, CTA MB, SRBF and total error %, hours of encoding
    "teapot": ("41k", "15.11", "0.79", "10.37", "1.23", "3.91", "16.1"),
    "buddha": ("52k", "19.12", "1.00", "13.18", "1.41", "3.75", "24.3"),
    "bunny": ("61k", "22.35", "1.17", "15.89", "1.28", "3.64", "29.0"),
}
DENSE_POINTS = 1000


@main
def repeat(arguments: list[str]) -> None:
    """Bake, encode and print the tables that were asked for."""
    path, up, clusters, supersampling = None, "y", 140, 4
    wanted = ["table", "lights"]
    for argument in arguments:
        match argument.partition("="):
            case ("--mesh", "=", name):
                path = name
            case ("--up", "=", ("y" | "z") as axis):
                up = axis
            case ("--clusters", "=", count) if count.isdigit() and int(count):
                clusters = int(count)
            case ("--supersampling", "=", count) if count.isdigit():
                supersampling = int(count)
            case ("--only", "=", names) if set(names.split(",")) <= {*wanted, "segmented"}:
                wanted = names.split(",")
            case _:
                raise InputError(
                    f"{argument}: expected --mesh=FILE, --up=y|z, --clusters=N, "
                    "--supersampling=N or --only=table,lights,segmented"
                )
    console = Console(width=150)
    mesh, materials = scene(path, up)
    basis = SRBF(CENTERS)
    transfer = baked(mesh, materials, basis, supersampling, console)
    models = [
        ClusteredTensor.from_transfer(transfer, num_clusters=clusters, ranks=ranks).eval()
        for ranks in RANKS
    ]
    if "table" in wanted:
        console.print(table_1(transfer, models, mesh))
        for model in models:
            console.print(run_time(transfer, model, mesh))
    if "lights" in wanted:
        console.print(turning_light(models[0], basis))
    if "segmented" in wanted:
        console.print(table_2(transfer, models, mesh, materials, supersampling, console))


def scene(path: str | None, up: Literal["y", "z"]) -> tuple[Mesh, dict[str, Material]]:
    """A glossy object on a Lambertian plane."""
    if path is None:
        mesh = procedural_scene(detail=2)
        return mesh, {mesh.parts[0].name: Material(lambertian=False, glossy=COOK)}
    model = load_mesh(path, up=up)
    mesh = concatenate([model, ground_plane(model)], model.name)
    glossy = Material(lambertian=False, glossy=COOK)
    return mesh, {part.name: glossy for part in model.parts}


def baked(
    mesh: Mesh,
    materials: dict[str, Material],
    basis: LightBasis,
    supersampling: int,
    console: Console,
) -> TransferTensor:
    """The transfer, and a line on what it took."""
    transfer = bake(
        mesh,
        materials=materials,
        light_basis=basis,
        num_rows=ROWS,
        supersampling=supersampling,
        cache=".cache/bakes",
    )
    made = transfer.provenance
    console.print(
        f"{mesh.name}: {mesh.num_points} points, {ROWS} rows, {basis.name}, "
        f"{transfer.num_bytes / 1e9:.2f} GB; rays {made['visibility_seconds']:.0f} s, "
        f"projection {made['projection_seconds']:.0f} s"
    )
    return transfer


def table_1(transfer: TransferTensor, models: list[ClusteredTensor], mesh: Mesh) -> Table:
    """Sizes and errors; sizes in the paper's units of 1024."""
    table = Table(title=f"Table 1: {mesh.name}", title_justify="left")
    for name in ("", "points", "raw GB", "SRBF GB", "CTA MB", "SRBF error %", "total error %"):
        table.add_column(name, justify="right")
    table.add_column("encoding", justify="right")
    raw = transfer.num_points * ROWS * 6 * 32 * 32 * 4 / 2**30
    kernels = transfer.num_points * ROWS * CENTERS * 2 / 2**30
    alone = []
    for model in models:
        squared = float(evaluate.squared_errors(model, transfer).sum())
        alone.append(f"{100 * squared / float(transfer.squared_norm().sum()):.3g} %")
        table.add_row(
            f"ranks {'/'.join(map(str, model.budget['ranks']))}",
            str(transfer.num_points),
            f"{raw:.2f}",
            f"{kernels:.3f}",
            f"{_megabytes(model):.2f}",
            _percent(evaluate.reference_error(0.0, transfer)),
            _percent(evaluate.reference_error(squared, transfer)),
            f"{_seconds(model):.0f} s",
        )
    for name, (points, raw_gb, in_kernels, size, of_kernels, of_all, hours) in PAPER.items():
        row = (points, raw_gb, in_kernels, size, of_kernels, of_all, f"{hours} h")
        table.add_row(f"paper, {name}", *row)
    block = transfer.block(slice(0, min(DENSE_POINTS, transfer.num_points)))
    rounding = evaluate.transfer_error(DenseTransfer.from_transfer(block, bits=16), block)
    table.caption = (
        f"clustered tensors alone: {', '.join(alone)}; 16 bits a coefficient add {rounding:.1e} on "
        f"{block.num_points} points; {torch.get_num_threads()} threads"
    )
    return table


def _megabytes(model: Representation) -> float:
    return sum(tensor.nbytes for tensor in model.packed().values()) / 2**20


def _percent(error: float | None) -> str:
    return "" if error is None else f"{100 * error:.3g}"


def _seconds(model: ClusteredTensor) -> float:
    return sum(model.statistics.seconds.values()) if model.statistics else 0.0


def run_time(transfer: TransferTensor, model: Representation, mesh: Mesh) -> Table:
    """A change of light and of view; how often faces are drawn."""
    table = Table(title="Run time, one light, one view", title_justify="left")
    for name in ("", "ms", "a second", "uncompressed / this"):
        table.add_column(name, justify="right")
    relight = Relighter(model)
    block = transfer.block(slice(0, min(DENSE_POINTS, transfer.num_points)))
    dense = Relighter(DenseTransfer.from_transfer(block))
    basis: Any = transfer.surface.light_basis
    light = basis.project(find_environment("sunset"))[None].float()
    view = mesh.vertices.mean(0, keepdim=True).float() + torch.tensor([[0.0, 0.5, 2.0]])
    with torch.no_grad():
        lit = relight.transferred(light)
        times = evaluate.median_seconds(
            [
                lambda: relight.transferred(light),
                lambda: relight.shade(lit, view),
                lambda: dense.transferred(light),
            ]
        )
    times[2] *= transfer.num_points / block.num_points
    names = ("light change", "view change", f"uncompressed, {block.num_points} points scaled")
    for name, seconds in zip(names, times, strict=True):
        row = (f"{1000 * seconds:.3g}", f"{1 / seconds:.1f}", f"{times[2] / seconds:.1f}")
        table.add_row(name, *row)
    table.caption = (
        f"{torch.get_num_threads()} threads; the paper's frames a second, view / light: "
        "74.67 / 15.83, 51.12 / 13.27, 48.65 / 10.42"
    )
    if isinstance(model, ClusteredTensor):
        drawn = model.coherence(mesh.faces)
        table.caption += (
            f"; a face is drawn {drawn['overdraw']:.3f} times by clusters, "
            f"{drawn['overdraw_merged']:.3f} by {drawn['superclusters']:.0f} superclusters"
        )
    return table


def turning_light(model: ClusteredTensor, basis: SRBF) -> Table:
    """Section 6, step by step, for a light of 162 scattered functions."""
    start = time.perf_counter()
    light = fit_environment(find_environment("sunset"), 162).expansion
    fitted = time.perf_counter() - start
    table = Table(title="A turning light of 162 functions", title_justify="left")
    for name in ("", "ms"):
        table.add_column(name, justify="right")
    turn = rotation_about_up(17.0)
    relight = Relighter(model)
    matrix, colours = interpolation(light, basis), light.coefficients.float()
    coefficients = basis.project(light)[None].float()
    texels = CubeDirections(basis.resolution).project(find_environment("sunset")).float()
    with torch.no_grad():
        times = evaluate.median_seconds(
            [
                lambda: light.rotated(turn),
                lambda: interpolation(light, basis),
                lambda: matrix @ colours,
                lambda: model.light_bases.flatten(0, 1) @ coefficients[0],
                lambda: relight.transferred(coefficients),
                lambda: basis.project_texels(texels),
            ],
            rounds=7,
        )
    names = (
        "turn the centres",
        "interpolation matrix A",
        "A times coefficients",
        "light bases of all clusters",
        "all of the transferred light",
        "or: any light of 6x32x32 texels projected anew",
    )
    for name, seconds in zip(names, times, strict=True):
        table.add_row(name, f"{1000 * seconds:.3g}")
    table.caption = f"fitted once in {fitted:.0f} s; {torch.get_num_threads()} threads"
    return table


def interpolation(light: SRBFExpansion, basis: SRBF) -> Float[Tensor, "coeffs functions"]:
    """Inner products of the functions of a basis and of a light.

    Source:
        Tsai and Shih 2006, equation 13.
    """
    return kernel_inner_products(
        basis.kernel,
        basis.centers.float(),
        basis.bandwidths.float(),
        light.centers.float(),
        light.bandwidths.float(),
    )


def table_2(
    transfer: TransferTensor,
    models: list[ClusteredTensor],
    mesh: Mesh,
    materials: dict[str, Material],
    supersampling: int,
    console: Console,
) -> Table:
    """Clustered tensors beside segmented CPCA of the same scene."""
    table = Table(title=f"Table 2: {mesh.name}", title_justify="left")
    for name in ("", "MB", "error %", "encoding s", "light change ms"):
        table.add_column(name, justify="right")
    for model in models:
        squared = float(evaluate.squared_errors(model, transfer).sum())
        ranks = "/".join(map(str, model.budget["ranks"]))
        _add(table, f"CTA {ranks}", model, evaluate.reference_error(squared, transfer), transfer)
    wavelets = baked(mesh, materials, Haar(32, 16), supersampling, console)
    segmented = SegmentedCPCA.from_transfer(wavelets, rank=12).eval()
    error = evaluate.transfer_error(segmented, wavelets)
    _add(table, "segmented CPCA, 12 vectors", segmented, error, wavelets)
    table.caption = "the paper: 13.18 MB, 3.75 % and 48.41 MB, 3.09 %"
    return table


def _add(
    table: Table,
    name: str,
    model: ClusteredTensor | SegmentedCPCA,
    error: float | None,
    transfer: TransferTensor,
) -> None:
    relight, basis = Relighter(model), transfer.surface.light_basis
    light = relight.project(find_environment("sunset")).float()
    spent = (
        _seconds(model)
        if isinstance(model, ClusteredTensor)
        else sum(one.seconds for one in model.statistics)
    )
    with torch.no_grad():
        (lit,) = evaluate.median_seconds([lambda: relight.transferred(light)])
    row = (f"{_megabytes(model):.2f}", _percent(error), f"{spent:.0f}", f"{1e3 * lit:.3g}")
    table.add_row(f"{name}, {basis.name if basis else ''}", *row)


if __name__ == "__main__":
    sys.exit(repeat(sys.argv[1:]))
