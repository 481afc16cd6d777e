"""Gather the reports of several runs into one page and one table.

python eval/report.py RUN... [--out=FOLDER]
"""

import sys
from pathlib import Path
from typing import Any

from rich.console import Console

from prt_torch import store
from prt_torch.command import main
from prt_torch.errors import InputError
from prt_torch.report import gather, summary_table, write_html

USAGE = "usage: python eval/report.py RUN... [--out=FOLDER]   (default FOLDER: runs/report)"


@main
def report(arguments: list[str]) -> None:
    """Write ``report.json`` and ``report.html`` of all runs side by side."""
    if not arguments or "-h" in arguments or "--help" in arguments:
        print(USAGE)
        return
    out, runs = Path("runs/report"), []
    for argument in arguments:
        if argument.startswith("--out="):
            out = Path(argument.partition("=")[2])
        elif argument.startswith("-"):
            raise InputError(f"{argument}: unknown option; {USAGE}")
        else:
            runs.append(Path(argument))
    if not runs or len({run.resolve() for run in runs}) < len(runs):
        raise InputError(f"expected one or more different run folders, got {len(runs)}; {USAGE}")
    if out.resolve() in {run.resolve() for run in runs}:
        raise InputError(f"--out={out}: is one of the runs, whose own report would be lost")
    reports = [_read(run / "report.json") for run in runs]
    gathered = gather(reports, names=[str(run) for run in runs])
    with store.locked(out, what="output folder"):
        store.write_json(out / "report.json", gathered)
        write_html(out / "report.html", gathered, [])
    console = Console(width=None if sys.stdout.isatty() else 140)
    console.print(summary_table(gathered))
    console.print(f"report: {out / 'report.html'}", soft_wrap=True)


def _read(path: Path) -> dict[str, Any]:
    """The report of a run.

    Raises:
        InputError: If it is missing or is not one.
    """
    content = store.read_json(path)
    parts = ("scene", "light", "bake", "raw_bytes", "left_out", "results")
    if not isinstance(content, dict) or any(part not in content for part in parts):
        raise InputError(f"{path}: not the report of a run; expected the keys {', '.join(parts)}")
    return content


if __name__ == "__main__":
    sys.exit(report(sys.argv[1:]))
