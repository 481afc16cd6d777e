"""The Radiance reader, against a writer of all its encodings and against damaged files."""

import itertools
import math

import numpy as np
import pytest

from prt_torch.assets import load_environment, read_hdr
from prt_torch.errors import InputError


def rgbe_pixels(rows, cols, seed=0):
    """Random normalised pixels with runs in them, ``"rows cols 4"``."""
    generator = np.random.default_rng(seed)
    pixels = generator.integers(0, 256, (rows, cols, 4), dtype=np.uint8)
    pixels[..., 0] |= 128
    pixels[:, cols // 3 : 2 * cols // 3] = pixels[:, cols // 3, None]
    return pixels


def decoded(pixels):
    """The formula of the format, pixel by pixel."""
    image = np.zeros((*pixels.shape[:2], 3))
    for row, col in np.ndindex(*pixels.shape[:2]):
        *mantissas, exponent = (int(value) for value in pixels[row, col])
        image[row, col] = [math.ldexp(m, exponent - 136) if exponent else 0.0 for m in mantissas]
    return image


def encode_channel(values):
    """Runs of at least 3 equal bytes, and dumps between them."""
    coded, dump = b"", []
    for value, group in itertools.groupby(values.tolist()):
        count = len(list(group))
        if count < 3:
            dump += [value] * count
            continue
        coded += encode_dump(dump)
        dump = []
        while count:
            run = min(count, 127)
            coded += bytes([128 + run, value])
            count -= run
    return coded + encode_dump(dump)


def encode_dump(values):
    return b"".join(
        bytes([len(values[k : k + 128]), *values[k : k + 128]]) for k in range(0, len(values), 128)
    )


def body_new(pixels):
    start = b"\2\2" + pixels.shape[1].to_bytes(2, "big")
    return b"".join(
        start + b"".join(encode_channel(row[:, channel]) for channel in range(4)) for row in pixels
    )


def body_flat(pixels):
    return pixels.tobytes()


def body_old(pixels):
    """Repeats as pixels of mantissas 1, 1, 1 whose exponents are digits to base 256."""
    coded = b""
    for row in pixels:
        for pixel, group in itertools.groupby(row.tolist()):
            coded += bytes(pixel)
            repeats = len(list(group)) - 1
            while repeats:
                coded += bytes([1, 1, 1, repeats % 256])
                repeats //= 256
    return coded


BODIES = {"new": body_new, "flat": body_flat, "old": body_old}


def hdr_bytes(pixels, body=body_new, header=b"FORMAT=32-bit_rle_rgbe\n", size=None):
    rows, cols = pixels.shape[:2]
    size = b"-Y %d +X %d\n" % (rows, cols) if size is None else size
    return b"#?RADIANCE\n# made by a test\n" + header + b"\n" + size + body(pixels)


def read(folder, data):
    path = folder / "image.hdr"
    path.write_bytes(data)
    return read_hdr(path)


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("cols", [7, 8, 400, 1500])
def test_every_encoding_is_decoded_exactly(tmp_path, body, cols):
    pixels = rgbe_pixels(5, cols)
    image = read(tmp_path, hdr_bytes(pixels, BODIES[body if cols > 7 or body != "new" else "flat"]))
    assert image.dtype == np.float32
    np.testing.assert_array_equal(image, decoded(pixels).astype(np.float32))


def test_known_values(tmp_path):
    pixels = np.array(
        [[[128, 64, 0, 129], [255, 128, 0, 0], [200, 0, 0, 255], [255, 0, 0, 1]]], np.uint8
    )
    image = read(tmp_path, hdr_bytes(pixels, body_flat))
    expected = [[1, 0.5, 0], [0, 0, 0], [200 * 2.0**119, 0, 0], [255 * 2.0**-135, 0, 0]]
    np.testing.assert_array_equal(image[0], np.array(expected, np.float32))


def test_exposures_divide(tmp_path):
    pixels = rgbe_pixels(2, 9)
    plain = read(tmp_path, hdr_bytes(pixels))
    twice = read(tmp_path, hdr_bytes(pixels, header=b"EXPOSURE=4\nGAMMA=1\nEXPOSURE= 0.5\n"))
    np.testing.assert_array_equal(twice, plain / 2)


@pytest.mark.parametrize(
    ("size", "undo"),
    [
        (b"-Y 3 +X 9\n", lambda image: image),
        (b"+Y 3 +X 9\n", lambda image: image[::-1]),
        (b"-Y 3 -X 9\n", lambda image: image[:, ::-1]),
        (b"+Y 3 -X 9\n", lambda image: image[::-1, ::-1]),
        (b"+X 3 -Y 9\n", lambda image: image.transpose(1, 0, 2)),
        (b"-X 3 -Y 9\n", lambda image: image.transpose(1, 0, 2)[:, ::-1]),
        (b"+X 3 +Y 9\n", lambda image: image.transpose(1, 0, 2)[::-1]),
        (b"-X 3 +Y 9\n", lambda image: image.transpose(1, 0, 2)[::-1, ::-1]),
    ],
)
def test_all_eight_pixel_orders(tmp_path, size, undo):
    pixels = rgbe_pixels(3, 9)
    image = read(tmp_path, hdr_bytes(pixels, size=size))
    np.testing.assert_array_equal(image, undo(decoded(pixels)).astype(np.float32))


GOOD = hdr_bytes(rgbe_pixels(4, 40))
START = b"#?RADIANCE\n\n"
BAD = {
    "empty": (b"", "empty"),
    "format": (b"PNG", "does not start with #.RADIANCE"),
    "header": (b"#?RADIANCE\nFORMAT=32", "header does not end"),
    "xyz": (GOOD.replace(b"rle_rgbe", b"rle_xyze"), "FORMAT=32-bit_rle_xyze"),
    "exposure": (GOOD.replace(b"FORMAT=32-bit_rle_rgbe", b"EXPOSURE=0"), "EXPOSURE"),
    "exposure_word": (GOOD.replace(b"FORMAT=32-bit_rle_rgbe", b"EXPOSURE=x"), "EXPOSURE"),
    "no_size": (START + b"4 5\n", "resolution line"),
    "same_axis": (START + b"-Y 4 +Y 5\n" + b"a" * 80, "resolution line"),
    "zero": (START + b"-Y 0 +X 8\n", "size 8 x 0"),
    "negative": (START + b"-Y -4 +X 8\n", "resolution line"),
    "enormous": (START + b"-Y 999999999 +X 999999999\n", "sides of 1 to 65536"),
    "claim": (START + b"-Y 65536 +X 65536\n" + b"\2\2\2\2", "claims 65536 rows .* in 4 bytes"),
    "cut": (GOOD[:-1], "row 3 of 4: truncated"),
    "cut_row": (GOOD[: len(GOOD) * 3 // 4], "row [12] of 4: truncated"),
    "cut_flat": (hdr_bytes(rgbe_pixels(2, 9), body_flat)[:-5], "row 1 of 2: truncated"),
    "width": (GOOD.replace(b"\2\2\0\x28", b"\2\2\0\x27", 1), "row 0 of 4: a width of 39"),
    "overshoot": (START + b"-Y 1 +X 8\n\2\2\0\x08\xff\1" + b"\1" * 90, "row 0 of 1: a run over"),
    "no_run": (START + b"-Y 1 +X 8\n\2\2\0\x08\0\1" + b"\1" * 90, "a run of length 0"),
    "old_run": (START + b"-Y 1 +X 9\n\5\5\5\5\1\1\1\xff" + b"\1" * 90, "row 0 of 1: a run over"),
    "old_first": (START + b"-Y 1 +X 9\n\1\1\1\5" + b"\1" * 90, "nothing to repeat"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_file_is_one_line_that_names_it(tmp_path, name):
    data, pattern = BAD[name]
    path = tmp_path / f"{name}.hdr"
    path.write_bytes(data)
    with pytest.raises(InputError, match=pattern) as caught:
        load_environment(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_damaged_file_raises_anything_else(tmp_path):
    generator = np.random.default_rng(1)
    messages = []
    for _ in range(300):
        data = bytearray(GOOD)
        for _ in range(generator.integers(1, 4)):
            data[generator.integers(len(data))] = generator.integers(256)
        try:
            image = read(tmp_path, bytes(data[: generator.integers(1, 2 * len(data))]))
        except InputError as error:
            messages.append(str(error))
        else:
            assert np.isfinite(image).all()
    assert len(messages) > 100
    assert not any("\n" in message for message in messages)


def test_real_images_have_the_extremes_of_their_table(assets):
    noon = read_hdr(assets / "env" / "ph_noon_grass_1k.hdr")
    assert noon.shape == (512, 1024, 3)
    assert noon.max() == 64256
    assert abs(float(noon.astype(np.float64).mean()) - 3.002) < 1e-3
    cross = read_hdr(assets / "env" / "debevec_galileo_cross.hdr")
    assert cross.shape == (1024, 768, 3)
    assert cross.max() == 1012
