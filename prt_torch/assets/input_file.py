"""Reading a file that a user named: every way in which that fails is one clear line."""

import os
from pathlib import Path

from prt_torch.errors import InputError


def read_input(path: str | os.PathLike[str], what: str) -> tuple[Path, bytes]:
    """The whole content of a file.

    Args:
        path: The file, as the user wrote it; messages repeat it like that.
        what: What the file should be, for messages ("mesh", "environment").

    Returns:
        The path and the bytes, of which there is at least one.

    Raises:
        InputError: If the file is missing, a folder, empty or not readable.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected a {what} file")
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such {what} file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    if not data:
        raise InputError(f"{path}: the {what} file is empty (0 bytes)")
    return path, data
