"""Run stiff and extreme inputs through the library, and say in numbers what came of each.

python eval/stability.py [--only=NAME,...] [--seeds=100] [--out=FOLDER]

Every row is a named case: an input, what is required, what float32 and float64 gave, the condition
number where it means something, the time, pass or RED. A row that takes longer than its limit is
red. Writes stability.md, stability.json and stability.html (default folder: runs/stability). Exit
status 1 if a row is red, 2 if an argument is wrong. docs/stability.md says what each row asks.
"""

import sys
from pathlib import Path

import stability_extremes
import stability_fits
import stability_light_fits
import stability_liu2004
import stability_sloan2003
import stability_sloan2005
import stability_tsai2006
import stability_wang2004
from rich.console import Console
from stability_case import Case
from stability_output import line, write
from stability_runner import Runner

from prt_torch.command import main
from prt_torch.errors import InputError

THEMES = (
    stability_sloan2003,
    stability_liu2004,
    stability_wang2004,
    stability_tsai2006,
    stability_sloan2005,
    stability_extremes,
    stability_fits,
    stability_light_fits,
)


def all_cases() -> dict[str, Case]:
    """Every row by its name."""
    return {case.name: case for theme in THEMES for case in theme.CASES.cases}


@main
def run(arguments: list[str]) -> None:
    """Run the cases that were asked for."""
    known = all_cases()
    wanted, seeds, out = list(known), 100, Path("runs/stability")
    for argument in arguments:
        match argument.partition("="):
            case ("--only", "=", names) if set(names.split(",")) <= set(known):
                wanted = names.split(",")
            case ("--only", "=", _):
                raise InputError(f"{argument}: unknown case; expected some of {', '.join(known)}")
            case ("--seeds", "=", count) if count.isdigit() and int(count) > 0:
                seeds = int(count)
            case ("--out", "=", folder) if folder:
                out = Path(folder)
            case _:
                raise InputError(
                    f"{argument}: expected --only=NAME,..., --seeds=NUMBER or --out=FOLDER"
                )
    console = Console(width=None if sys.stdout.isatty() else 160)
    rows = []
    with Runner(seeds) as runner:
        for row in runner.rows(known[name] for name in wanted):
            console.print(line(row, heading=not rows))
            rows.append(row)
    write(out, rows, seeds=seeds)
    red = [row.case.name for row in rows if not row.passed]
    console.print(f"{len(rows)} cases, {len(red)} red{': ' if red else ''}{', '.join(red)}")
    console.print(f"report: {out / 'stability.html'}", soft_wrap=True)
    if red:
        sys.exit(1)


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
