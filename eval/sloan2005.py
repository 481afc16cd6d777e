"""What of Sloan, Luna, Snyder 2005 holds here: errors of lobes, and what shading by them costs.

    python eval/sloan2005.py [--mesh=FILE] [--supersampling=2] [--only=lobes,cost]

Without a mesh it runs on the embedded scene. Deformed meshes are in eval/deformation.py, textures
of lobes and parametric models in eval/lobe_textures.py.
"""

import sys
from collections.abc import Callable
from functools import partial

import torch
from jaxtyping import Float
from rich.console import Console
from rich.table import Table
from torch import Tensor

from prt_torch import InputError, Surface, TransferTensor, bake, evaluate, load_mesh
from prt_torch.assets import procedural_scene
from prt_torch.bases import SphericalHarmonics, sh, sh_zxzxz, zonal
from prt_torch.bases.zonal_table import LatLongTable
from prt_torch.command import main
from prt_torch.representations import DenseTransfer, ZonalLobes
from prt_torch.representations.zonal_lobes_coding import Lobes
from prt_torch.sphere import frame_from_normal

ORDER = 6
COST_ORDERS, COST_POINTS, COST_LOBES = (3, 4, 6, 8, 10), 30_000, 4


@main
def repeat(arguments: list[str]) -> None:
    """Print the tables that were asked for."""
    mesh, supersampling, wanted = procedural_scene(), 4, ["lobes", "cost"]
    for argument in arguments:
        match argument.split("=", 1):
            case ["--mesh", path]:
                mesh = load_mesh(path)
            case ["--supersampling", count] if count in {"1", "2", "4"}:
                supersampling = int(count)
            case ["--only", tables] if set(tables.split(",")) <= {"lobes", "cost"}:
                wanted = tables.split(",")
            case _:
                raise InputError(
                    f"{argument}: expected --mesh=FILE, --supersampling=1, 2 or 4, or "
                    "--only=lobes,cost"
                )
    console = Console(width=140)
    if "lobes" in wanted:
        console.print(f"{mesh.name}: {mesh.num_points} points, {mesh.num_faces} faces")
        transfer = bake(
            mesh,
            light_basis=SphericalHarmonics(ORDER),
            supersampling=supersampling,
            cache=".cache/bakes",
        )
        console.print(errors_of_lobes(transfer))
    if "cost" in wanted:
        console.print(cost_of_shading())


def errors_of_lobes(transfer: TransferTensor) -> Table:
    """Figure 3: the optimal linear lobe, and one to six lobes a point."""
    table = Table(title=f"Figure 3: diffuse transfer, order {ORDER}", title_justify="left")
    columns = ("lobes", "RMS error", "paper", "squared", "worst point", "MiB", "largest g*")
    for column in (*columns, "starts a point", "fit s"):
        table.add_column(column, justify="right")
    linear = _linear_lobe_errors(transfer)
    _add(table, transfer, "linear, optimal axis", "", linear, "", "", "", "")
    entries = [(f"{count}", count, "default") for count in range(1, 7)]
    entries.insert(4, ("4, fast", 4, "fast"))
    for name, count, effort in entries:
        model = ZonalLobes.from_transfer(transfer, num_lobes=count, effort=effort)  # pyright: ignore[reportArgumentType]
        found = model.statistics
        _add(
            table,
            transfer,
            name,
            "0.045" if count == 3 else "",
            evaluate.squared_errors(model, transfer),
            f"{sum(model.storage().values()) / 2**20:.2f}",
            f"{found['largest_coefficient']:.1f}",
            f"{found['starts'] / transfer.num_points:.0f}",
            f"{found['seconds']:.1f}",
        )
    return table


def _linear_lobe_errors(transfer: TransferTensor) -> Float[Tensor, "points"]:
    """Squared errors of one lobe along the axis of the linear band, coefficients in closed form."""
    values = transfer.dense()[:, 0, 0].double()
    axes = zonal.optimal_linear_axis(values)[:, None]
    coefficients = zonal.lobe_coefficients(values, axes[:, 0])[:, None]
    return zonal.squared_errors(values, axes, coefficients).sum(-1)


def _add(
    table: Table,
    transfer: TransferTensor,
    name: str,
    paper: str,
    squared: Float[Tensor, "points"],
    *rest: str,
) -> None:
    norms = transfer.squared_norm()
    share = float(squared.sum() / norms.sum())
    worst = float((squared / norms.clamp_min(1e-6 * norms.mean())).max()) ** 0.5
    table.add_row(name, f"{share**0.5:.4f}", paper, f"{share:.2e}", f"{worst:.3f}", *rest)


def cost_of_shading() -> Table:
    """Section 5: posed points shaded exactly, from the table, and by turning harmonics."""
    table = Table(
        title=f"Section 5: {COST_POINTS} posed points, {COST_LOBES} lobes, one light, milliseconds",
        title_justify="left",
    )
    names = ["exact, O(n²N)", "table, O(nN)", "full SH rotation", "unposed SH"]
    for column in ("order", *names, "error of the table", "products a point and colour"):
        table.add_column(column, justify="right")
    for order in COST_ORDERS:
        exact, tabulated, dense, light, frames = _shaders(order)
        calls: list[Callable[[], Tensor]] = [
            partial(exact, light, frames),
            partial(tabulated, light, frames),
            partial(dense, light, frames),
            partial(dense, light),
        ]
        with torch.no_grad():
            seconds = evaluate.median_seconds(calls, rounds=7, warm_up=2)
            lost = evaluate.radiance_error(tabulated(light, frames), exact(light, frames))
        low = min(order * order, 4)
        products = (
            f"{low + COST_LOBES * (order * order - low)}, {low + COST_LOBES * (order - 2)}, "
            f"{order * order} (and {sh_zxzxz.multiplications(order)} to turn)"
        )
        milliseconds = [f"{taken * 1e3:.2f}" for taken in seconds]
        table.add_row(str(order), *milliseconds, f"{lost:.4f}", products)
    return table


def _shaders(
    order: int,
) -> tuple[ZonalLobes, ZonalLobes, DenseTransfer, Float[Tensor, "1 coeffs 3"], Tensor]:
    """The same random lobes, exact, tabulated and dense, with a light and a pose."""
    generator = torch.Generator().manual_seed(0)

    def directions() -> Float[Tensor, "points 3"]:
        drawn = torch.randn(COST_POINTS, 3, generator=generator)
        return torch.nn.functional.normalize(drawn, dim=1)

    lobes = Lobes(
        axes=torch.stack([directions() for _ in range(COST_LOBES)], dim=1)[:, None],
        coefficients=torch.randn(COST_POINTS, 1, COST_LOBES, order - 2, generator=generator),
        linear=torch.randn(COST_POINTS, 1, 4, generator=generator),
    )
    surface = Surface(light_basis=SphericalHarmonics(order), frames=frame_from_normal(directions()))
    shape = (COST_POINTS, 1, 1, order * order)
    exact = ZonalLobes(lobes, None, surface, shape)
    tabulated = ZonalLobes(lobes, None, surface, shape)
    tabulated.table = LatLongTable()
    light = sh.evaluate(directions()[:3], order).mT[None].contiguous()
    dense = DenseTransfer(exact.dense().detach(), surface)
    return exact, tabulated, dense, light, frame_from_normal(directions())


if __name__ == "__main__":
    sys.exit(repeat(sys.argv[1:]))
