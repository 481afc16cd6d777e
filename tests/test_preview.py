"""Pictures show what geometry says, in the place and with the values it says."""

import logging
import math
import struct

import numpy as np
import OpenEXR
import pytest
import torch

from prt_torch import preview
from prt_torch.assets import Mesh, concatenate, constant, mesh_from_arrays
from prt_torch.errors import InputError
from prt_torch.preview import Camera, trace

RED = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
GREEN = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
BLUE = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
ALONG_Z = Camera(eye=(0.0, 0.0, 4.0), target=(0.0, 0.0, 0.0), vertical_fov_degrees=40.0)


def triangle(offset=(0.0, 0.0, 0.0), scale: float = 1.0) -> Mesh:
    """Vertices at +x, +y and -x of a camera that looks along -z."""
    vertices = torch.tensor([[1.0, -0.5, 0.0], [0.0, 1.0, 0.0], [-1.0, -0.5, 0.0]])
    vertices = vertices.double() * scale + torch.tensor(offset, dtype=torch.float64)
    return mesh_from_arrays("triangle", vertices, torch.tensor([[0, 1, 2]]))


def ball(radius: float = 1.0, rows: int = 48) -> Mesh:
    polar = torch.linspace(0, math.pi, rows + 1, dtype=torch.float64)
    azimuth = torch.arange(2 * rows, dtype=torch.float64) * (math.pi / rows)
    grid = torch.stack(
        [
            polar.sin()[:, None] * azimuth.sin(),
            polar.cos()[:, None].expand(-1, 2 * rows),
            polar.sin()[:, None] * azimuth.cos(),
        ],
        dim=-1,
    )
    index = torch.arange((rows + 1) * 2 * rows).reshape(rows + 1, 2 * rows)
    corners = (index[:-1], index[1:], index[1:].roll(-1, 1), index[:-1].roll(-1, 1))
    a, b, c, d = (corner.reshape(-1) for corner in corners)
    faces = torch.cat([torch.stack([a, b, c], -1), torch.stack([a, c, d], -1)])
    return mesh_from_arrays("ball", radius * grid.reshape(-1, 3), faces)


def ground(size: float) -> Mesh:
    vertices = torch.tensor([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]]).double() * size
    vertices[:, 1] = -1.001
    return mesh_from_arrays("ground", vertices, torch.tensor([[0, 1, 2], [0, 2, 3]]))


def test_picture_is_neither_mirrored_nor_upside_down():
    hits = trace(triangle(), ALONG_Z, 64, 64, samples=2)
    image = hits.shade(torch.stack([RED, GREEN, BLUE]))
    row, col = np.unravel_index(image.reshape(-1, 3).argmax(0), (64, 64))
    assert col[0] > 44 > 20 > col[2], "red at +x is right, blue at -x is left"
    assert row[1] < 20 < 36 < row[0], "green at +y is above"


def test_centre_ray_hits_where_geometry_says():
    # The ray through the middle of an odd picture meets (0, 0, 0): weights 1/3 each.
    hits = trace(triangle(), ALONG_Z, 31, 31, samples=1)
    assert hits.face[15, 15, 0] == 0
    np.testing.assert_allclose(hits.weights[15, 15, 0], [1 / 3] * 3, atol=1e-6)
    assert hits.face[0, 0, 0] == -1
    assert not hits.weights[0, 0, 0].any()
    np.testing.assert_allclose(hits.directions[15, 15, 0], [0, 0, -1], atol=1e-7)


@pytest.mark.parametrize(
    ("offset", "scale"),
    [((0.0, 0.0, 0.0), 1.0), ((1e6 + 0.03, -2e6 + 0.01, 5e5), 0.77), ((0.0, 0.0, 0.0), 1e-6)],
)
def test_interpolation_is_exact_for_linear_functions(offset, scale):
    mesh = triangle(offset, scale)
    x, y, z = offset
    camera = Camera((x + scale, y + scale, z + 4 * scale), (x, y, z), vertical_fov_degrees=40.0)
    hits = trace(mesh, camera, 40, 30, samples=1)
    local = (mesh.vertices - torch.tensor(offset, dtype=torch.float64)) / scale
    image = hits.shade(torch.stack([local[:, 0], local[:, 1], torch.ones(3).double()], -1))
    seen = hits.face[..., 0] >= 0
    assert 100 < seen.sum() < 1000
    # Where the ray meets the plane z = 0, in units of the triangle.
    rays = camera.directions(40, 30)[:, :, 0]
    eye = np.array([1.0, 1.0, 4.0])
    meets = eye - rays * (eye[2] / rays[..., 2:])
    np.testing.assert_allclose(image[seen], [*meets[seen] * [1, 1, 0] + [0, 0, 1]], atol=5e-6)


def test_sphere_covers_the_disc_that_perspective_gives():
    distance, fov, size = 4.0, 40.0, 200
    hits = trace(ball(), ALONG_Z, size + 60, size, samples=2)
    half = math.tan(math.radians(fov) / 2)
    radius = math.tan(math.asin(1 / distance)) / half * size / 2
    area = math.pi * radius**2
    # The polyhedron lies inside the sphere: a little less, never more.
    assert 0.99 * area < hits.coverage.sum() < area * 1.0005
    rows, cols = np.nonzero(hits.coverage > 0)
    assert abs(rows.mean() - (size - 1) / 2) < 0.5
    assert abs(cols.mean() - (size + 59) / 2) < 0.5
    assert np.ptp(rows) == np.ptp(cols)


def test_samples_average_linear_radiance_and_background_fills_the_rest():
    mesh = triangle()
    hits = trace(mesh, ALONG_Z, 24, 24, samples=4)
    white = torch.full((3, 3), 5.0, dtype=torch.float64)
    image = hits.shade(white, constant(radiance=1.0))
    expected = 5 * hits.coverage + (1 - hits.coverage)
    np.testing.assert_allclose(image, np.repeat(expected[..., None], 3, -1), rtol=1e-6)
    assert ((hits.coverage > 0) & (hits.coverage < 1)).any()
    assert image.dtype == np.float32


def test_blocks_of_rays_agree_with_one_block(monkeypatch):
    whole = trace(ball(rows=12), ALONG_Z, 33, 21)
    monkeypatch.setattr("prt_torch.preview.rays._RAYS_PER_BLOCK", 100)
    pieces = trace(ball(rows=12), ALONG_Z, 33, 21)
    np.testing.assert_array_equal(whole.face, pieces.face)
    np.testing.assert_array_equal(whole.weights, pieces.weights)


@pytest.mark.parametrize("azimuth", [0.0, 30.0, 200.0])
def test_framing_holds_the_object_whole_and_large_whatever_the_ground(azimuth):
    alone = Camera.framing(ball(), azimuth_degrees=azimuth)
    scene = concatenate([ball(), ground(30.0)], "scene")
    assert Camera.framing(scene, azimuth_degrees=azimuth) == alone
    coverage = trace(ball(), alone, 80, 60).coverage
    edge = [coverage[0], coverage[-1], coverage[:, 0], coverage[:, -1]]
    assert max(side.max() for side in edge) == 0
    assert coverage.mean() > 0.25
    # The ground beside it is in the picture too.
    assert trace(scene, alone, 80, 60).coverage[-1].min() == 1


def test_framing_follows_azimuth_and_elevation():
    camera = Camera.framing(ball(), azimuth_degrees=90.0, elevation_degrees=0.0)
    assert camera.eye[0] > 2
    np.testing.assert_allclose(camera.eye[1:], 0, atol=1e-9)
    np.testing.assert_allclose(camera.target, 0, atol=1e-9)
    np.testing.assert_allclose(camera.axes() @ [0, 0, -1], [1, 0, 0], atol=1e-12)


def test_cameras_without_a_frame_are_refused():
    with pytest.raises(ValueError, match="elevation"):
        Camera.framing(ball(), elevation_degrees=90.0)
    with pytest.raises(ValueError, match="up"):
        Camera((0.0, 1.0, 0.0), (0.0, 0.0, 0.0)).axes()
    with pytest.raises(ValueError, match="line of sight"):
        Camera((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)).axes()
    with pytest.raises(ValueError, match="at least 1"):
        trace(ball(), ALONG_Z, 0, 10)


def test_exr_is_read_back_bit_exact(tmp_path):
    image = np.random.default_rng(0).lognormal(0, 4, (17, 23, 3)).astype(np.float32)
    image[0, 0] = [0, 65504 * 4, 1e-40]
    for name, pixels in (("a.exr", image), ("b.exr", image[::-1, ::2])):
        preview.write_exr(tmp_path / name, pixels)
        read = OpenEXR.File(str(tmp_path / name)).channels()["RGB"].pixels
        np.testing.assert_array_equal(read, pixels)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.exr", "b.exr"]


def test_files_that_cannot_be_written_are_one_clear_error(tmp_path):
    (tmp_path / "file").write_text("kept")
    for write in (
        lambda path: preview.write_png(path, np.zeros((2, 2, 3)), 1.0),
        lambda path: preview.write_exr(path, np.zeros((2, 2, 3))),
    ):
        with pytest.raises(InputError, match="cannot be written"):
            write(tmp_path / "file" / "picture")


def test_png_has_the_size_and_the_values_given(tmp_path):
    image = np.zeros((5, 9, 3), np.float32)
    image[1, 2] = [0.5, 1.0, 9.0]
    preview.write_png(tmp_path / "a.png", image, exposure=1.0)
    data = (tmp_path / "a.png").read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    assert struct.unpack(">II", data[16:24]) == (9, 5)
    # sRGB of 0.5 is 188 by the standard's table.
    assert preview.tone_map(image, 1.0)[1, 2].tolist() == [188, 255, 255]


def test_tone_map_is_monotone_and_total():
    ramp = np.concatenate([np.linspace(0, 1.5, 20000), [1e30, np.inf]])
    shown = preview.tone_map(np.repeat(ramp[:, None], 3, -1), 1.0)[:, 0].astype(int)
    assert (np.diff(shown) >= 0).all()
    assert (shown[0], shown[-1]) == (0, 255)
    assert len(np.unique(shown)) == 256
    strange = preview.tone_map(np.array([[np.nan, -1.0, 0.25]]), 2.0)
    assert strange.tolist() == [[0, 0, 188]]


def test_exposure_undoes_the_scale_of_the_light_and_ignores_the_black_background():
    image = np.random.default_rng(1).random((20, 20, 3)).astype(np.float32)
    exposure = preview.automatic_exposure(image)
    assert preview.automatic_exposure(1e4 * image) == pytest.approx(exposure / 1e4, rel=1e-5)
    padded = np.concatenate([image, np.zeros((400, 20, 3))])
    assert preview.automatic_exposure(padded) == pytest.approx(exposure)
    assert preview.automatic_exposure(np.zeros((3, 3, 3))) == 1.0


def test_error_colours_rise_in_lightness_and_saturate():
    colours = preview.error_colours(np.linspace(0, 1, 64), 1.0)
    lightness = colours @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) > 0).all()
    beyond = preview.error_colours(np.array([1.0, 7.0, np.nan]), 1.0)
    assert (beyond == beyond[0]).all()


def test_error_map_scales_to_what_is_seen_and_leaves_the_background_grey():
    mesh = triangle()
    hits = trace(mesh, ALONG_Z, 32, 32)
    image, limit = hits.error_map(torch.tensor([0.2, 0.2, 0.2]))
    assert limit == pytest.approx(0.2)
    brightest = (preview.error_colours(np.array([1.0]), 1.0)[0] * 255 + 0.5).astype(int)
    assert np.abs(image[hits.coverage == 1].astype(int) - brightest).max() <= 1
    assert (image[hits.coverage == 0] == 128).all()
    _, zero_limit = hits.error_map(torch.zeros(3))
    assert zero_limit == 1.0


def test_difference_image_shows_only_where_pictures_differ():
    first = np.random.default_rng(2).random((8, 8, 3))
    second = first.copy()
    second[3, 4] += [0.3, 0.0, -0.3]
    image, limit = preview.difference_image(first, second)
    assert limit == pytest.approx(0.2)
    differs = (image != image[0, 0]).any(-1)
    assert np.argwhere(differs).tolist() == [[3, 4]]
    assert preview.difference_image(second, first, limit)[0].tolist() == image.tolist()


def test_opengl_and_ray_casting_show_the_same_picture(caplog):
    mesh = concatenate([ball(rows=24), ground(3.0)], "scene")
    light = torch.tensor([0.5, 0.8, 0.3], dtype=torch.float64)
    lit = (mesh.normals @ light).clamp(min=0) + 0.1
    radiance = lit[:, None] * torch.tensor([1.0, 0.7, 0.4], dtype=torch.float64)
    camera = Camera.framing(mesh)
    background = constant(radiance=0.2)
    with caplog.at_level(logging.WARNING):
        fast = preview.render_opengl(
            mesh, radiance, camera, 160, 120, background, exposure=0.9
        )  # fmt: skip
    if fast is None:
        pytest.skip(caplog.messages[-1])
    hits = trace(mesh, camera, 160, 120, samples=4)
    exact = preview.tone_map(hits.shade(radiance, background), 0.9)
    assert fast.shape == exact.shape
    assert fast.dtype == np.uint8
    assert np.abs(fast.astype(int) - exact).mean() < 1.0

    ones = torch.ones_like(radiance)
    silhouette = preview.render_opengl(mesh, ones, camera, 160, 120, exposure=1.0)
    assert silhouette is not None
    seen = silhouette[..., 0] > 127
    assert (seen != (hits.coverage > 0.5)).mean() < 0.002


def test_opengl_that_cannot_start_is_one_logged_line(monkeypatch, caplog):
    def broken(*_):
        raise OSError("no EGL\nlibrary")

    monkeypatch.setattr("prt_torch.preview.opengl._render_premultiplied", broken)
    with caplog.at_level(logging.WARNING):
        assert (
            preview.render_opengl(triangle(), torch.ones(3, 3), ALONG_Z, 4, 4, exposure=1.0) is None
        )
    assert caplog.messages == ["OpenGL preview left out: no EGL library"]
