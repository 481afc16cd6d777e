"""Compare representations on one bake over grids of their parameters; pick one within a budget.

python train/sweep.py sweep=small sweep.workers=2
"""

import sys
from pathlib import Path

from rich.console import Console

from prt_torch import sweep
from prt_torch.command import main

CONFIGS = Path(__file__).resolve().parent.parent / "configs"


@main
def compare(arguments: list[str]) -> None:
    """Do the sweep of the command line, or the rest of it."""
    console = Console(width=None if sys.stdout.isatty() else 140)
    sweep.execute(sweep.parse_sweep(arguments, CONFIGS, script="train/sweep.py"), console)


if __name__ == "__main__":
    sys.exit(compare(sys.argv[1:]))
