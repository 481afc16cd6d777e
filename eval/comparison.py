"""All representations beside each other on one mesh, diffuse and glossy: the README's results.

python eval/comparison.py [--out=FOLDER] [KEY=VALUE ...]
python eval/comparison.py scene.mesh=bunny.obj transfer.supersampling=2

Two sweeps of closed forms, nested where a kind allows it, on bakes that are cached; further
arguments go to both. A comparison that was killed goes on where it stopped. FOLDER (by default
``runs/comparison``) gets a sweep each with its page, ``comparison.md`` with what each family does
within three budgets of bytes, and ``comparison.png``.
"""

import io
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console

from prt_torch import store, sweep
from prt_torch.command import main
from prt_torch.errors import InputError
from prt_torch.report.numbers import bytes_text, percent_text, seconds_text
from prt_torch.report.plots import LIGHT
from prt_torch.tradeoff import Result, error_of, front, within

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
ERROR = "mean_radiance_error"
_COSTS = {"bytes": "bytes", "light_seconds": "seconds for a change of light"}
_MARKERS = "os^DvPX"


@dataclass(frozen=True)
class Part:
    """One of the two sweeps.

    Attributes:
        name: What it is called.
        keys: That make it.
        shares: Budgets, as shares of the uncompressed tensor's bytes.
    """

    name: str
    keys: tuple[str, ...]
    shares: tuple[float, ...]


PARTS = (
    Part("diffuse", ("sweep=comparison",), (1 / 32, 1 / 8, 1 / 4)),
    Part(
        "glossy",
        ("sweep=comparison_glossy", "material=glossy", "transfer=sh_factors", "transfer.order=5"),
        (1 / 128, 1 / 32, 1 / 8),
    ),
)


@main
def compare(arguments: list[str]) -> None:
    """Do both sweeps, or the rest of them, and write what they say."""
    out, keys = Path("runs/comparison"), []
    for argument in arguments:
        if argument.startswith("--out="):
            out = Path(argument.partition("=")[2])
        elif argument.startswith("-"):
            raise InputError(f"{argument}: expected --out=FOLDER or KEY=VALUE")
        else:
            keys.append(argument)
    console = Console(width=140)
    reports = []
    for part in PARTS:
        chosen = [*part.keys, *keys, f"out={out / part.name}"]
        start = time.perf_counter()
        run = sweep.parse_sweep(chosen, CONFIGS, script="eval/comparison.py")
        reports.append(sweep.execute(run, console))
        console.print(f"{part.name}: {seconds_text(time.perf_counter() - start)}")
    tables = [_table(part, report) for part, report in zip(PARTS, reports, strict=True)]
    store.write_bytes(out / "comparison.md", "\n".join(tables).encode())
    store.write_bytes(out / "comparison.png", _plots(reports))
    console.print("\n".join(tables), soft_wrap=True, highlight=False)


def _table(part: Part, report: dict[str, Any]) -> str:
    """Each family's least radiance error within each budget, in Markdown."""
    scene, raw = report["scene"], report["raw_bytes"]
    budgets = [share * raw for share in part.shares]
    heads = [f"in {bytes_text(int(limit))}" for limit in budgets]
    lines = [
        f"{part.name.capitalize()}: {scene['points']:,} points, {scene['rows']} rows, "
        f"{report['light']['coeffs']} light coefficients, uncompressed {bytes_text(raw)}\n",
        f"| representation | {' | '.join(heads)} | change of light | fit |",
        f"| --- |{' --- |' * (len(heads) + 2)}",
    ]
    for family, own in _families(report["results"]).items():
        found = [within(own, {"bytes": limit}, _error) for limit in budgets]
        largest = next((one for one in reversed(found) if one), None)
        if largest is None:
            continue
        cells = [
            f"{percent_text(error_of(one, ERROR))} ({_size(one)})" if one else "" for one in found
        ]
        times = f"{seconds_text(largest['light_seconds'])} | {seconds_text(largest['fit_seconds'])}"
        lines.append(f"| {family} | {' | '.join(cells)} | {times} |")
    return "\n".join(lines) + "\n"


def _families(results: Sequence[Result]) -> dict[str, list[Result]]:
    """Results by kind, those in compressed codes apart."""
    found: dict[str, list[Result]] = {}
    for one in results:
        coded = one["parameters"].get("quantisation_share") is not None
        name = f"{one['representation']}{', compressed' if coded else ''}"
        found.setdefault(name, []).append(one)
    return found


def _error(result: Result) -> float:
    return error_of(result, ERROR) or 0.0


def _size(result: Result) -> str:
    """What is left of a name without that of its kind."""
    name = str(result["name"]).removeprefix(str(result["representation"]))
    return name.partition(" coded")[0].strip()


def _plots(reports: Sequence[dict[str, Any]]) -> bytes:
    """Radiance error against bytes and against the time of a change of light, as PNG."""
    figure = Figure(figsize=(12, 4.6 * len(reports)), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    rows = figure.subplots(len(reports), len(_COSTS))
    for part, report, row in zip(PARTS, reports, rows, strict=True):
        for cost, axes in zip(_COSTS, row, strict=True):
            _draw(axes, report["results"], cost)
            axes.set_title(f"{part.name}: radiance error under held-out lights", loc="left")
            axes.set_xlabel(_COSTS[cost])
    rows[0][0].legend(frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _draw(axes: Axes, results: Sequence[Result], cost: str) -> None:
    """The fronts of all families."""
    kinds = list(dict.fromkeys(str(one["representation"]) for one in results))
    for family, own in _families(results).items():
        points = [(float(one[cost]), _error(one)) for one in own]
        place = kinds.index(str(own[0]["representation"]))
        axes.loglog(
            *zip(*(points[kept] for kept in front(points)), strict=True),
            color=LIGHT.families[place],
            marker=_MARKERS[place],
            linestyle="--" if family not in kinds else "-",
            label=family,
        )
    axes.grid(color=LIGHT.grid)


if __name__ == "__main__":
    sys.exit(compare(sys.argv[1:]))
