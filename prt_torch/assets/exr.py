"""Reading OpenEXR images, with the size checked before any pixel is allocated."""

import os
from typing import Any

import numpy as np
import OpenEXR
from jaxtyping import Float32

from prt_torch.assets.input_file import read_input
from prt_torch.errors import InputError

_MAX_PIXELS = 1 << 28
# Constant images of 4096 x 2048, in the codecs that compress them most, measured 2,900 at most.
_MAX_PIXELS_PER_BYTE = 1 << 13


def _read_part(path: str, *, header_only: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """Header and channels of the first part, with the library's many errors as one."""
    try:
        with OpenEXR.File(path, separate_channels=True, header_only=header_only) as file:
            header = dict(file.parts[0].header)
            channels = {} if header_only else {n: c.pixels for n, c in file.channels().items()}
    # The library raises these for bad headers, for truncated pixels and for unknown part types.
    except (RuntimeError, ValueError, TypeError, IndexError, KeyError):
        what = "header" if header_only else "pixels"
        raise InputError(
            f"{path}: the {what} of this OpenEXR image cannot be read, it is truncated or damaged"
        ) from None
    return header, channels


def _check_size(path: str, header: dict[str, Any], num_bytes: int) -> None:
    low, high = (np.asarray(corner, np.int64) for corner in header["dataWindow"])
    width, height = (int(side) for side in high - low + 1)
    if width < 1 or height < 1:
        raise InputError(f"{path}: size {width} x {height}, expected at least 1 x 1")
    limit = min(_MAX_PIXELS, num_bytes * _MAX_PIXELS_PER_BYTE)
    if width * height > limit:
        raise InputError(
            f"{path}: claims {width} x {height} pixels, more than the {limit} that an image of "
            f"{num_bytes} bytes may have"
        )
    shown = [np.asarray(corner, np.int64).tolist() for corner in header["displayWindow"]]
    if [low.tolist(), high.tolist()] != shown:
        raise InputError(f"{path}: is cropped (dataWindow is not displayWindow)")


def read_exr(path: str | os.PathLike[str]) -> Float32[np.ndarray, "rows cols 3"]:
    """Channels R, G and B of an OpenEXR image, or Y as grey; top row first.

    Raises:
        InputError: If the file is missing, empty, truncated or no OpenEXR image, claims more
            pixels than it can hold, is cropped, or has neither R, G, B nor Y at full resolution.
    """
    _, data = read_input(path, "environment")
    if data[:4] != b"\x76\x2f\x31\x01":
        raise InputError(f"{path}: does not start as an OpenEXR image does")
    header, _ = _read_part(str(path), header_only=True)
    _check_size(str(path), header, len(data))
    _, channels = _read_part(str(path), header_only=False)
    names = ("R", "G", "B") if all(name in channels for name in "RGB") else ("Y", "Y", "Y")
    if names[0] not in channels:
        raise InputError(
            f"{path}: has channels {', '.join(sorted(channels)) or 'none'}, expected R, G, B or Y"
        )
    planes = [np.asarray(channels[name], np.float32) for name in names]
    if any(plane.ndim != 2 or plane.shape != planes[0].shape for plane in planes):
        raise InputError(f"{path}: channels {', '.join(names)} differ in size")
    return np.ascontiguousarray(np.stack(planes, axis=-1))
