"""From linear radiance to what is looked at: exposure, display curve, error colours, files."""

import io
from pathlib import Path

import matplotlib
import numpy as np
import OpenEXR
from jaxtyping import Float, Float32, UInt8
from PIL import Image

from prt_torch import store

ERROR_COLORMAP = "viridis"
"""The matplotlib colour map of error pictures: perceptually ordered, dark is no error."""

_KEY_PERCENTILE, _KEY_VALUE = 97.0, 0.8
_LIMIT_PERCENTILE = 99.0
_REC709_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def automatic_exposure(image: Float[np.ndarray, "*batch 3"]) -> float:
    """The factor that brings a high percentile of the luminance to a bright, unclipped value.

    Black pixels do not count, so a picture without a background is exposed for its mesh.
    """
    luminance = np.asarray(image, np.float64) @ _REC709_LUMINANCE
    lit = luminance[np.isfinite(luminance) & (luminance > 0)]
    key = float(np.percentile(lit, _KEY_PERCENTILE)) if lit.size else 0.0
    exposure = _KEY_VALUE / key if key > 0 else 1.0
    return exposure if np.isfinite(exposure) else 1.0


def tone_map(
    image: Float[np.ndarray, "*batch 3"], exposure: float
) -> UInt8[np.ndarray, "*batch 3"]:
    """8-bit sRGB of linear radiance times ``exposure``; clipped above 1, NaN is black."""
    linear = np.nan_to_num(np.asarray(image, np.float64) * exposure, nan=0.0).clip(0.0, 1.0)
    toe = 12.92 * linear
    curve = 1.055 * linear ** (1 / 2.4) - 0.055
    return to_bytes(np.where(linear <= 0.0031308, toe, curve))


def error_colours(
    values: Float[np.ndarray, "*batch"], limit: float
) -> Float32[np.ndarray, "*batch 3"]:
    """Display colours of errors from 0 to ``limit``; what is above, or NaN, gets the brightest."""
    share = np.nan_to_num(np.asarray(values, np.float64) / limit, nan=1.0).clip(0.0, 1.0)
    return matplotlib.colormaps[ERROR_COLORMAP](share)[..., :3].astype(np.float32)


def difference_image(
    image: Float[np.ndarray, "height width rgb"],
    reference: Float[np.ndarray, "height width rgb"],
    limit: float | None = None,
) -> tuple[UInt8[np.ndarray, "height width rgb"], float]:
    """Colours of the absolute difference of two linear pictures, averaged over RGB, and the scale.

    Args:
        image: One picture.
        reference: The other, of the same shape.
        limit: Difference of the brightest colour [radiance]; a high percentile if None.
    """
    difference = np.abs(np.asarray(image, np.float64) - reference).mean(-1)
    if limit is None:
        limit = automatic_limit(difference)
    return to_bytes(error_colours(difference, limit)), limit


def automatic_limit(values: Float[np.ndarray, "*batch"]) -> float:
    """A high percentile of what is not zero, or 1 where nothing is."""
    positive = values[np.isfinite(values) & (values > 0)]
    return float(np.percentile(positive, _LIMIT_PERCENTILE)) if positive.size else 1.0


def to_bytes(colours: Float[np.ndarray, "*batch"]) -> UInt8[np.ndarray, "*batch"]:
    """Display values in 0 to 1 as bytes, rounded and clipped."""
    return (np.clip(colours, 0.0, 1.0) * 255 + 0.5).astype(np.uint8)


def encode_png(pixels: UInt8[np.ndarray, "height width 3"]) -> bytes:
    """A PNG file of 8-bit sRGB pixels."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels, np.uint8)).save(
        buffer, format="PNG", optimize=True
    )
    return buffer.getvalue()


def write_png(path: Path, image: Float[np.ndarray, "height width 3"], exposure: float) -> None:
    """Write linear radiance as a tone-mapped PNG, atomically.

    Raises:
        InputError: If the file cannot be written.
    """
    store.write_bytes(path, encode_png(tone_map(image, exposure)))


def write_exr(path: Path, image: Float[np.ndarray, "height width 3"]) -> None:
    """Write linear radiance as a float32 OpenEXR file, atomically and without loss.

    Raises:
        InputError: If the file cannot be written.
    """
    # Anything but a contiguous float32 array would be written wrong, and silently so.
    pixels = np.ascontiguousarray(image, np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with store.replacing(path) as temporary, OpenEXR.File(header, {"RGB": pixels}) as file:
        file.write(str(temporary))
