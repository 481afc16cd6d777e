"""Bake a scene's transfer into the cache, where fits find it.

python train/bake.py scene.mesh=bunny.obj transfer.order=10
"""

import sys
from pathlib import Path

from rich.console import Console

from prt_torch.command import main
from prt_torch.config import parse_command_line
from prt_torch.run import bake_only

CONFIGS = Path(__file__).resolve().parent.parent / "configs"


@main
def bake(arguments: list[str]) -> None:
    """Bake every point of the command line's grid."""
    console = Console(width=None if sys.stdout.isatty() else 140)
    for config in parse_command_line(
        arguments, CONFIGS, default_name="fit", script="train/bake.py"
    ):
        bake_only(config, console)


if __name__ == "__main__":
    sys.exit(bake(sys.argv[1:]))
