"""Bake if needed, fit one or several representations, evaluate, draw and report.

python train/fit.py scene.mesh=bunny.obj representation=cpca representation.rank=8
"""

import sys
from pathlib import Path

from rich.console import Console

from prt_torch.command import main
from prt_torch.config import parse_command_line
from prt_torch.run import execute

CONFIGS = Path(__file__).resolve().parent.parent / "configs"


@main
def fit(arguments: list[str]) -> None:
    """Run every point of the command line's grid."""
    console = Console(width=None if sys.stdout.isatty() else 140)
    for config in parse_command_line(arguments, CONFIGS, default_name="fit", script="train/fit.py"):
        execute(config, console)


if __name__ == "__main__":
    sys.exit(fit(sys.argv[1:]))
