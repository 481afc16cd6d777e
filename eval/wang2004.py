"""Repeat the tables of Wang, Tran, Luebke 2004 on a scene, beside the numbers they print.

python eval/wang2004.py [--mesh=FILE] [--supersampling=N] [--terms=96]

Ashikhmin and Shirley's anisotropic material in 4 terms, symmetric factors of 48x48 orthographic
texels, light of 6x64x64 texels. Visibility is 6x128x128 unless supersampling=4 gives the paper's
6x256x256. Without a mesh, the embedded scene. Times are medians on this machine; bake and encoding
are timed once.
"""

import sys
import time
from dataclasses import replace
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from prt_torch import evaluate
from prt_torch.assets import Mesh, find_environment, load_mesh, procedural_scene
from prt_torch.assets.brdf import AshikhminShirley
from prt_torch.assets.material import Material
from prt_torch.baking import bake
from prt_torch.bases import BRDFFactors, Haar
from prt_torch.command import main
from prt_torch.errors import InputError
from prt_torch.relight import Relighter
from prt_torch.representations import DenseTransfer, WaveletTransfer
from prt_torch.transfer import TransferTensor

BRUSHED = AshikhminShirley(specular=0.75, diffuse=0.5, exponent_u=10.0, exponent_v=100.0)
TERMS = (1, 4)
LIGHT_RESOLUTION = 64
DENSE_POINTS = 1000
PAPER_BYTES = {1: "30 to 100", 4: "84 to 370"}  # MB, bunny to Lucy, ground plane included
PAPER_RATES = {1: "20 / 90", 4: "7.2 / 63"}  # frames a second of the bunny, light / view
PAPER_THRESHOLD = 1024 / 32767


@main
def repeat(arguments: list[str]) -> None:
    """Bake, encode and print both tables."""
    mesh, supersampling, num_terms = procedural_scene(detail=2), 2, 96
    for argument in arguments:
        match argument.partition("="):
            case ("--mesh", "=", path):
                mesh = load_mesh(path)
            case ("--supersampling", "=", count) if count.isdigit():
                supersampling = int(count)
            case ("--terms", "=", count) if count.isdigit():
                num_terms = int(count)
            case _:
                raise InputError(
                    f"{argument}: expected --mesh=FILE, --supersampling=N or --terms=N"
                )
    console = Console(width=140)
    whole = baked(mesh, supersampling)
    made = whole.provenance
    console.print(
        f"{mesh.name}: {mesh.num_points} points, {whole.num_bytes / 1e9:.2f} GB raw at 4 terms; "
        f"rays {made['visibility_seconds']:.0f} s, projection {made['projection_seconds']:.0f} s"
    )
    sizes, rates = table_1(), table_2()
    for terms in TERMS:
        transfer = first_rows(whole, terms)
        start = time.perf_counter()
        model = WaveletTransfer.from_transfer(transfer, num_terms=num_terms).eval()
        seconds = time.perf_counter() - start
        add_sizes(sizes, transfer, model, seconds)
        add_rates(rates, transfer, model, mesh)
    console.print(sizes)
    console.print(rates)


def baked(mesh: Mesh, supersampling: int) -> TransferTensor:
    """Transfer in the paper's factors and light basis."""
    factors = BRDFFactors.from_brdf(
        BRUSHED,
        num_terms=max(TERMS),
        method="symmetric",
        mapping="orthographic",
        resolution=48,
    )
    return bake(
        mesh,
        materials=Material(lambertian=False, glossy=BRUSHED),
        light_basis=Haar(LIGHT_RESOLUTION, LIGHT_RESOLUTION),
        factors=factors,
        resolution=LIGHT_RESOLUTION,
        supersampling=supersampling,
        cache=".cache/bakes",
    )


class _FirstRows:
    """The first rows of a tensor, read where they are asked for."""

    def __init__(self, whole: TransferTensor, rows: int):
        self._values, self._rows = whole.values, rows
        points, channels, _, coeffs = whole.values.shape
        self.shape, self.dtype = (points, channels, rows, coeffs), whole.values.dtype

    def __getitem__(self, points: slice, /) -> Tensor:
        return self._values[points][:, :, : self._rows]


def first_rows(whole: TransferTensor, rows: int) -> TransferTensor:
    """Transfer of the first terms: eigenvectors of fewer terms are the first of more."""
    full: Any = whole.surface.exit_basis
    if rows == full.num_rows:
        return whole
    view, light = full.view_values[:rows], full.light_values[:, :rows]
    basis = BRDFFactors(view, light, full.hemisphere, cosine=full.cosine)
    surface = replace(whole.surface, exit_basis=basis)
    return TransferTensor(_FirstRows(whole, rows), surface, None, whole.provenance)


def table_1() -> Table:
    """Sizes, and the error that the paper shows in pictures only."""
    table = Table(title="Table 1: storage", title_justify="left")
    for name in ("terms", "MB", "paper, MB", "of 6 bytes a coefficient, MB", "kept share"):
        table.add_column(name, justify="right")
    for name in ("of raw %", "transfer error %", "encoded in s"):
        table.add_column(name, justify="right")
    return table


def add_sizes(
    table: Table, transfer: TransferTensor, model: WaveletTransfer, seconds: float
) -> None:
    """One line of :func:`table_1`."""
    stored = sum(model.storage().values())
    kept = int((model.values != 0).any(-1).sum())
    share = kept / (model.num_points * model.num_rows * model.budget["num_terms"])
    error = evaluate.transfer_error(model, transfer)
    table.add_row(
        str(transfer.num_rows),
        f"{stored / 1e6:.1f}",
        PAPER_BYTES[transfer.num_rows],
        f"{6 * kept / 1e6:.1f}",
        f"{share:.3f}",
        f"{100 * stored / transfer.num_bytes:.3f}",
        f"{100 * error:.2f}",
        f"{seconds:.0f}",
    )


def table_2() -> Table:
    """Frames a second when the light changes, and when the view does."""
    table = Table(title="Table 2: frames a second", title_justify="left")
    for name in ("terms", "light change", "view change", "paper, light / view", "uncompressed"):
        table.add_column(name, justify="right")
    table.add_column("radiance error %", justify="right")
    table.add_column("with the paper's light threshold %", justify="right")
    table.caption = (
        f"{torch.get_num_threads()} threads; the paper's bunny stands on a ground plane; radiance "
        f"error against the uncompressed tensor, {DENSE_POINTS} points, the embedded sunset"
    )
    return table


@torch.no_grad()
def add_rates(table: Table, transfer: TransferTensor, model: WaveletTransfer, mesh: Mesh) -> None:
    """One line of :func:`table_2`."""
    block = transfer.block(slice(0, min(DENSE_POINTS, transfer.num_points)))
    scale = transfer.num_points / block.num_points
    relight, dense = Relighter(model), Relighter(DenseTransfer.from_transfer(block))
    basis: Any = transfer.surface.light_basis
    light = basis.project(find_environment("sunset"))[None].float()
    eye = mesh.vertices.mean(0, keepdim=True).float() + torch.tensor([[0.0, 0.5, 2.0]])
    lit = relight.transferred(light)
    by_light, by_view, product = evaluate.median_seconds(
        [
            lambda: relight.transferred(light),
            lambda: relight.shade(lit, eye),
            lambda: dense.transferred(light),
        ]
    )
    expected = dense(light, eye)
    error = evaluate.radiance_error(relight(light, eye)[:, :, : block.num_points], expected)
    model.light_threshold = PAPER_THRESHOLD
    cut = evaluate.radiance_error(relight(light, eye)[:, :, : block.num_points], expected)
    model.light_threshold = 0.0
    table.add_row(
        str(transfer.num_rows),
        f"{1 / by_light:.1f}",
        f"{1 / by_view:.0f}",
        PAPER_RATES[transfer.num_rows],
        f"{1 / (product * scale):.2f}",
        f"{100 * error:.1f}",
        f"{100 * cut:.1f}",
    )


if __name__ == "__main__":
    sys.exit(repeat(sys.argv[1:]))
