"""What all command lines share: a user's mistake is one line and exit status 2."""

import functools
import sys
from collections.abc import Callable

from prt_torch.errors import InputError


def main(command: Callable[[list[str]], None]) -> Callable[[list[str]], int]:
    """Wrap a command so that it returns an exit status and shows no traceback for bad input.

    Status 0 is success, 2 unusable input, 130 an interruption (what was done so far is kept).
    """

    @functools.wraps(command)
    def run(arguments: list[str]) -> int:
        try:
            command(arguments)
        except InputError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print("interrupted; start the same command again to go on", file=sys.stderr)
            return 130
        return 0

    return run
