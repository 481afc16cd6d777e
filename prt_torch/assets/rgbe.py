"""A strict reader of Radiance .hdr images (RGBE), flat and run-length encoded.

The file is untrusted: nothing is allocated from a count in its header alone, and every run is
checked against the row that it fills.
"""

import os
import re

import numpy as np
from jaxtyping import Float32

from prt_torch.assets.input_file import read_input
from prt_torch.errors import InputError

_MAX_HEADER_BYTES = 1 << 16
_MAX_SIDE = 1 << 16
_RESOLUTION = re.compile(rb"([+-])([XY])[ \t]+(\d+)[ \t]+([+-])([XY])[ \t]+(\d+)[ \t]*\r?\n")
# Widths that the new run-length encoding can write in its 15 bits.
_MIN_CODED_WIDTH, _MAX_CODED_WIDTH = 8, 0x7FFF

# value = mantissa * 2^(exponent - 128 - 8), and exponent 0 means black.
_SCALES = np.ldexp(np.float32(1), np.arange(256) - 136).astype(np.float32)
_SCALES[0] = 0.0


def _parse_header(path: str, data: bytes) -> tuple[float, re.Match[bytes]]:
    """Exposure, and the resolution line."""
    if not data.startswith((b"#?RADIANCE", b"#?RGBE")):
        raise InputError(f"{path}: does not start with #?RADIANCE or #?RGBE")
    end = re.search(rb"\n\r?\n", data[:_MAX_HEADER_BYTES])
    if end is None:
        raise InputError(f"{path}: truncated, the header does not end")
    exposure = 1.0
    for line in data[: end.start()].splitlines():
        key, _, value = line.partition(b"=")
        key, value = key.strip(), value.strip()
        if key == b"FORMAT" and value != b"32-bit_rle_rgbe":
            raise InputError(
                f"{path}: FORMAT={value[:40].decode('ascii', 'replace')}: expected 32-bit_rle_rgbe"
            )
        if key == b"EXPOSURE":
            try:
                exposure *= float(value)
            except ValueError:
                exposure = float("nan")
            if not 0.0 < exposure < float("inf"):
                raise InputError(f"{path}: EXPOSURE must be a positive number, got {line[:40]!r}")
    resolution = _RESOLUTION.match(data, end.end())
    if resolution is None or resolution[2] == resolution[5]:
        raise InputError(f"{path}: the resolution line is missing, expected such as -Y 512 +X 1024")
    return exposure, resolution


def _decode_coded_row(data: bytes, position: int, width: int) -> tuple[bytearray, int]:
    """One row in the new encoding, channel after channel; ValueError says what is wrong."""
    row = bytearray()
    for channel in range(1, 5):
        filled = channel * width
        while len(row) < filled:
            if position + 1 >= len(data):
                raise ValueError("truncated")
            length = data[position]
            if length > 128:
                length -= 128
                row += data[position + 1 : position + 2] * length
                position += 2
            else:
                if length == 0 or position + 1 + length > len(data):
                    raise ValueError("truncated" if length else "a run of length 0")
                row += data[position + 1 : position + 1 + length]
                position += 1 + length
        if len(row) > filled:
            raise ValueError(f"a run overshoots the width {width}")
    return row, position


def _decode_old_row(data: bytes, position: int, width: int) -> tuple[bytearray, int]:
    """One row of plain pixels, where mantissas 1, 1, 1 repeat the pixel before."""
    plain = data[position : position + 4 * width]
    if len(plain) == 4 * width:
        pixels = np.frombuffer(plain, np.uint8).reshape(width, 4)
        if not (pixels[:, :3] == 1).all(axis=1).any():
            return bytearray(plain), position + 4 * width
    row = bytearray()
    shift = 0
    while len(row) < 4 * width:
        pixel = data[position : position + 4]
        if len(pixel) < 4:
            raise ValueError("truncated")
        position += 4
        if pixel[:3] == b"\1\1\1":
            repeats = pixel[3] << shift
            shift += 8
            if not row or len(row) + 4 * repeats > 4 * width:
                raise ValueError(f"a run overshoots the width {width} or has nothing to repeat")
            row += row[-4:] * repeats
        else:
            row += pixel
            shift = 0
    return row, position


def _decode(path: str, data: bytes, position: int, height: int, width: int) -> np.ndarray:
    """Mantissas and exponents of all rows, ``"rows cols 4"``."""
    rows = []
    for index in range(height):
        start = data[position : position + 4]
        # The new encoding announces itself in each row by an impossible pixel.
        coded = start[:2] == b"\2\2" and len(start) == 4 and start[2] < 128
        try:
            if coded and _MIN_CODED_WIDTH <= width <= _MAX_CODED_WIDTH:
                if int.from_bytes(start[2:4], "big") != width:
                    raise ValueError(f"a width of {int.from_bytes(start[2:4], 'big')}, not {width}")
                row, position = _decode_coded_row(data, position + 4, width)
                pixels = np.frombuffer(row, np.uint8).reshape(4, width).T
            else:
                row, position = _decode_old_row(data, position, width)
                pixels = np.frombuffer(row, np.uint8).reshape(width, 4)
        except ValueError as error:
            raise InputError(f"{path}: row {index} of {height}: {error}") from None
        rows.append(pixels)
    return np.stack(rows)


def read_hdr(path: str | os.PathLike[str]) -> Float32[np.ndarray, "rows cols 3"]:
    r"""Linear RGB radiance of a Radiance .hdr file, top row first.

    A pixel is :math:`m \cdot 2^{e - 136}` for mantissa bytes m and exponent byte e, and 0 where
    e is 0 (without the half step that Radiance itself adds to m, as most readers do), divided by
    the product of the EXPOSURE lines. All eight pixel orders of the resolution line are read.

    Raises:
        InputError: If the file is missing, empty, truncated (naming the row), of another format
            or has no pixels.

    Source:
        Ward, "Real pixels", Graphics Gems II, 1991; Radiance reference, "Picture file format".
    """
    _, data = read_input(path, "environment")
    exposure, resolution = _parse_header(str(path), data)
    height, width = int(resolution[3]), int(resolution[6])
    if not (0 < height <= _MAX_SIDE and 0 < width <= _MAX_SIDE):
        raise InputError(f"{path}: size {width} x {height}, expected sides of 1 to {_MAX_SIDE}")
    remaining = len(data) - resolution.end()
    # The shortest row there is: repeats of one pixel in the old encoding.
    if height * min(4 * width, 8) > remaining:
        raise InputError(
            f"{path}: truncated, claims {height} rows of {width} pixels in {remaining} bytes"
        )
    coded = _decode(str(path), data, resolution.end(), height, width)
    image = coded[..., :3] * _SCALES[coded[..., 3]][..., None]
    if exposure != 1.0:
        image = (image.astype(np.float64) / exposure).astype(np.float32)
    if resolution[2] == b"X":
        image = image.transpose(1, 0, 2)
    signs = {resolution[2]: resolution[1], resolution[5]: resolution[4]}
    if signs[b"Y"] == b"+":
        image = image[::-1]
    if signs[b"X"] == b"-":
        image = image[:, ::-1]
    return np.ascontiguousarray(image, np.float32)
