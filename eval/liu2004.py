"""Repeat the figures of Liu, Sloan, Shum, Snyder 2004 on a scene, beside the numbers they print.

python eval/liu2004.py [--mesh=FILE] [--supersampling=N] [--material=cook|schlick|diffuse]
                       [--rows=N] [--light=NAME|FILE] [--only=table,lights]

Table 1: segmented CPCA of all-frequency transfer, no ground plane. Lights: a light that turns,
frame by frame, with all 6144 light coefficients and with some of them (figure 6); small embedded
area lights unless one is given. Without a mesh, the embedded scene. Times are medians on this
machine; the encoding is timed once.
"""

import resource
import sys
import time
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from rich.console import Console
from rich.table import Table
from torch import Tensor

from prt_torch import evaluate
from prt_torch.assets import Mesh, find_environment, load_mesh, procedural_scene
from prt_torch.assets.brdf import BRDF, CookTorrance, Schlick
from prt_torch.assets.material import Material
from prt_torch.baking import bake
from prt_torch.bases import Haar, LightBasis
from prt_torch.command import main
from prt_torch.errors import InputError
from prt_torch.relight import Relighter
from prt_torch.representations import DenseTransfer, SegmentedCPCA
from prt_torch.transfer import TransferTensor
from prt_torch.truncation import truncate

MATERIALS: dict[str, BRDF | None] = {
    "cook": CookTorrance(f0=0.5, roughness=0.4),
    "schlick": Schlick(f0=0.8, roughness=0.2, isotropy=0.2),
    "diffuse": None,
}
PAPER = {  # segments seen, clusters, CPCA, wavelet and total size, squared error; in percent
    "glossy": ("56.0", "763", "4.43", "29.5", "1.31", "0.20"),
    "diffuse": ("57.6", "2260", "8.16", "50.0", "4.17", "0.02"),
}
DENSE_POINTS = 2000
FRAMES, STEP_DEGREES = 24, 1.0
KEPT = (200, 800, 2000, 4300)


@main
def repeat(arguments: list[str]) -> None:
    """Bake, encode and print the tables that were asked for."""
    mesh, supersampling, material, rows = procedural_scene(detail=2), 4, "cook", None
    wanted, light = ["table", "lights"], "area_lights"
    for argument in arguments:
        match argument.partition("="):
            case ("--mesh", "=", path):
                mesh = load_mesh(path)
            case ("--supersampling", "=", count) if count.isdigit():
                supersampling = int(count)
            case ("--rows", "=", count) if count.isdigit():
                rows = int(count)
            case ("--material", "=", name) if name in MATERIALS:
                material = name
            case ("--light", "=", name):
                light = name
            case ("--only", "=", names) if set(names.split(",")) <= set(wanted):
                wanted = names.split(",")
            case _:
                raise InputError(
                    f"{argument}: expected --mesh=FILE, --supersampling=N, --rows=N, "
                    f"--material={'|'.join(MATERIALS)}, --light=NAME|FILE or --only=table,lights"
                )
    console = Console(width=140)
    brdf = MATERIALS[material]
    start = time.perf_counter()
    transfer = bake(
        mesh,
        materials=Material(lambertian=brdf is None, glossy=brdf),
        light_basis=Haar(32, 16),
        num_rows=rows,
        supersampling=supersampling,
        cache=".cache/bakes",
    )
    made = transfer.provenance
    console.print(
        f"{mesh.name}, {material}: {mesh.num_points} points, {transfer.num_rows} rows, "
        f"{transfer.num_bytes / 1e9:.2f} GB raw; rays {made['visibility_seconds']:.0f} s, "
        f"projection {made['projection_seconds']:.0f} s, read again or made in "
        f"{time.perf_counter() - start:.0f} s"
    )
    start = time.perf_counter()
    model = SegmentedCPCA.from_transfer(transfer).eval()
    seconds = time.perf_counter() - start
    if "table" in wanted:
        console.print(table_1(transfer, model, seconds, mesh))
        console.print(run_time(transfer, model, mesh))
    if "lights" in wanted:
        console.print(turning_light(transfer, model, mesh, light))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    console.print(f"peak memory of the process {peak:.1f} GiB")


def table_1(transfer: TransferTensor, model: SegmentedCPCA, seconds: float, mesh: Mesh) -> Table:
    """Sizes and error."""
    table = Table(title=f"Table 1: {mesh.name}", title_justify="left")
    for name in ("", "segments seen %", "clusters", "CPCA %", "wavelet %", "total %", "error %"):
        table.add_column(name, justify="right")
    parts = model.statistics
    raw, cpca = sum(one.raw_bytes for one in parts), sum(one.cpca_bytes for one in parts)
    coded = sum(tensor.nbytes for tensor in model.packed().values())
    seen = sum(one.nonzero_share for one in parts) / len(parts)
    error = evaluate.transfer_error(model, transfer)
    before = sum(one.cpca_squared_error for one in parts) / sum(one.squared_norm for one in parts)
    measured = (seen, cpca / raw, coded / cpca, coded / raw, error)
    first, *others = (f"{100 * value:.3g}" for value in measured)
    table.add_row("measured", first, str(sum(one.clusters for one in parts)), *others)
    table.add_row("paper", *PAPER["glossy" if transfer.num_rows > 1 else "diffuse"])
    table.caption = (
        f"encoded in {seconds:.0f} s; error before quantisation {100 * before:.3g} %; "
        f"{coded / 2**20:.1f} MiB; the paper's rows are of its own bunny and bird"
    )
    return table


def run_time(transfer: TransferTensor, model: SegmentedCPCA, mesh: Mesh) -> Table:
    """A change of light and of view, beside the uncompressed product and the memory's rate."""
    table = Table(title="Run time, one light of 6144 coefficients, one view", title_justify="left")
    for name in ("", "ms", "uncompressed / this", "share of reading its bytes"):
        table.add_column(name, justify="right")
    block = transfer.block(slice(0, min(DENSE_POINTS, transfer.num_points)))
    scale = transfer.num_points / block.num_points
    relight, dense = Relighter(model), Relighter(DenseTransfer.from_transfer(block))
    basis: Any = transfer.surface.light_basis
    light = basis.project(find_environment("sunset"))[None].float()
    view = mesh.vertices.mean(0, keepdim=True).float() + torch.tensor([[0.0, 0.5, 2.0]])
    bytes_read = sum(tensor.nbytes for tensor in model.packed().values())
    with torch.no_grad():
        lit = relight.transferred(light)
        whole, by_view, product, reading = evaluate.median_seconds(
            [
                lambda: relight.transferred(light),
                lambda: relight.shade(lit, view),
                lambda: dense.transferred(light),
                reader(bytes_read),
            ]
        )
    product *= scale
    table.add_row("light change", _ms(whole), f"{product / whole:.1f}", f"{reading / whole:.2f}")
    table.add_row("view change", _ms(by_view), f"{product / by_view:.1f}", "")
    table.add_row(f"uncompressed, {block.num_points} points scaled", _ms(product), "1", "")
    table.add_row("reading the compressed bytes", _ms(reading), f"{product / reading:.1f}", "1")
    table.caption = f"{torch.get_num_threads()} threads; the paper: 5.0 to 6.2 frames a second"
    return table


def reader(num_bytes: int) -> Callable[[], Any]:
    """Reads as many bytes as fast as the machine does."""
    values = torch.ones(max(1, num_bytes // 4))
    return lambda: values.sum()


def turning_light(
    transfer: TransferTensor, model: SegmentedCPCA, mesh: Mesh, light_name: str
) -> Table:
    """Relative error of each frame of a turning light, and its largest step between two frames."""
    table = Table(
        title=f"{light_name}, turned by {STEP_DEGREES:g} degrees a frame, {FRAMES} frames",
        title_justify="left",
    )
    for name in ("", "mean error", "worst frame", "largest step", "flicker"):
        table.add_column(name, justify="right")
    basis: Any = transfer.surface.light_basis
    block = transfer.block(slice(0, min(DENSE_POINTS, transfer.num_points)))
    dense = Relighter(DenseTransfer.from_transfer(block))
    eye = mesh.vertices.mean(0, keepdim=True).float() + torch.tensor([[0.0, 0.5, 2.0]])
    lights = moving_lights(basis, light_name)

    def seen(relight: Relighter, light: Tensor) -> Tensor:
        return relight(light[None], eye)[0, 0, : block.num_points]

    with torch.no_grad():
        expected = [seen(dense, light) for light in lights]
        relight = Relighter(model)
        table.add_row(
            "segmented CPCA, all coefficients",
            *_sequence([seen(relight, light) for light in lights], expected),
        )
        for keep in KEPT:
            kept = [_truncated(light, basis, keep) for light in lights]
            frames = [seen(dense, light) for light in kept]
            table.add_row(f"uncompressed, {keep} largest by area", *_sequence(frames, expected))
    table.caption = (
        "relative RMS of radiance against the uncompressed tensor; flicker is the RMS change of "
        "the error image from frame to frame, over that of the picture"
    )
    return table


def moving_lights(basis: LightBasis, name: str) -> list[Float[Tensor, "coeffs rgb"]]:
    """Coefficients of a light at each turn about the vertical."""
    degrees = [STEP_DEGREES * frame for frame in range(FRAMES)]
    return [
        basis.project(find_environment(name, rotation_degrees=turn)).float() for turn in degrees
    ]


def _truncated(
    light: Float[Tensor, "coeffs rgb"], basis: Haar, keep: int
) -> Float[Tensor, "coeffs rgb"]:
    """Light that lost coefficients in wavelets over whole faces, as the paper has it."""
    whole = Haar(basis.resolution, basis.resolution)
    faces = whole.project_cube(basis.radiance(light).mT, basis.resolution).mT
    kept, _ = truncate(faces[None], whole, keep, weights=whole.areas())
    return basis.project_cube(whole.radiance(kept[0]).mT, basis.resolution).mT


def _sequence(frames: list[Tensor], expected: list[Tensor]) -> list[str]:
    """Mean and worst error of the frames, its largest step, and the flicker."""
    errors = torch.tensor(
        [evaluate.radiance_error(one, true) for one, true in zip(frames, expected, strict=True)]
    )
    wrong = torch.stack(frames) - torch.stack(expected)
    change = wrong.diff(dim=0).square().mean() / torch.stack(expected).square().mean()
    values = (errors.mean(), errors.max(), errors.diff().abs().max(), change.sqrt())
    return [f"{float(value):.2e}" for value in values]


def _ms(seconds: float) -> str:
    return f"{1000 * seconds:.3g}"


if __name__ == "__main__":
    sys.exit(repeat(sys.argv[1:]))
