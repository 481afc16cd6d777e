"""Environments: conventions, lookups, exact sampling, crosses, files and procedural lights."""

import math
import struct

import numpy as np
import OpenEXR
import pytest
import torch

from prt_torch import sphere
from prt_torch.assets import (
    NAMED,
    Environment,
    area_lights,
    constant,
    find_environment,
    load_environment,
    sky,
)
from prt_torch.errors import InputError
from prt_torch.sphere import rotation_about_up

AHEAD, RIGHT, UP = ([0.0, 0, -1], [1.0, 0, 0], [0.0, 1, 0])
BEHIND, LEFT, DOWN = ([0.0, 0, 1], [-1.0, 0, 0], [0.0, -1, 0])


def vectors(*rows):
    return torch.tensor(rows, dtype=torch.float64)


def random_directions(count=500, seed=0):
    generator = torch.Generator().manual_seed(seed)
    directions = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return directions / directions.norm(dim=-1, keepdim=True)


def random_image(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def random_rotation(seed=0):
    generator = torch.Generator().manual_seed(seed)
    q, r = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    q = q * r.diagonal().sign()
    return q * torch.linalg.det(q)


def latlong_directions(rows, cols):
    """Pixel centres by the convention: top +y, centre -z, +x at three quarters of the width."""
    polar = (torch.arange(rows, dtype=torch.float64) + 0.5)[:, None] * (math.pi / rows)
    angle = ((torch.arange(cols, dtype=torch.float64) + 0.5) / cols - 0.5) * (2 * math.pi)
    return torch.stack(
        [polar.sin() * angle.sin(), polar.cos().expand(rows, cols), -polar.sin() * angle.cos()], -1
    )


def smooth(directions):
    """A light with no symmetry, positive everywhere."""
    x, y, z = directions.unbind(-1)
    return torch.stack([2 + x + 0.3 * y * z, 2 + y + 0.2 * x, 3 + z - 0.4 * x * y], dim=-1)


def integrate(environment, spacing=10.0, **options):
    """Total radiance, and its first moment."""
    total, moment = torch.zeros(3, dtype=torch.float64), torch.zeros(3, 3, dtype=torch.float64)
    for directions, solid_angles, radiance in environment.sample_blocks(spacing, **options):
        total = total + (solid_angles[:, None] * radiance).sum(dim=0)
        moment = moment + torch.einsum("s,si,sc->ic", solid_angles, directions, radiance)
    return total, moment


def write_exr(path, image, compression=OpenEXR.ZIP_COMPRESSION, channels=None):
    image = np.ascontiguousarray(image)
    header = {"compression": compression, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels or {"RGB": image}) as file:
        file.write(str(path))
    return path


LAYOUTS = {
    "latlong": lambda: Environment("e", random_image(8, 16, 3), "latlong"),
    "odd latlong": lambda: Environment("e", random_image(5, 13, 3), "latlong"),
    "cube": lambda: Environment("e", random_image(6, 4, 4, 3), "cube"),
}


class TestLookup:
    def test_latlong_axes(self):
        image = torch.zeros(64, 128, 3)
        image[32, 64, 0] = image[31, 63, 0] = image[31, 64, 0] = image[32, 63, 0] = 1.0
        image[31:33, 95:97, 1] = 1.0
        image[0, :, 2] = 1.0
        environment = Environment("e", image, "latlong")
        values = environment.radiance(vectors(AHEAD, RIGHT, UP, LEFT, DOWN, BEHIND))
        expected = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0], [0, 0, 0], [0, 0, 0]]
        np.testing.assert_allclose(values, expected, atol=1e-12)

    def test_cube_axes(self):
        image = torch.arange(6.0)[:, None, None, None].expand(6, 3, 3, 3)
        values = Environment("e", image, "cube").radiance(
            vectors(RIGHT, LEFT, UP, DOWN, BEHIND, AHEAD)
        )
        np.testing.assert_array_equal(values[:, 0], np.arange(6))

    @pytest.mark.parametrize("layout", ["latlong", "cube"])
    def test_pixel_centres_are_returned_exactly(self, layout):
        if layout == "latlong":
            image, directions = random_image(9, 20, 3), latlong_directions(9, 20)
        else:
            image = random_image(6, 5, 5, 3)
            directions = sphere.cubemap_directions(5, dtype=torch.float64)
        values = Environment("e", image, layout).radiance(directions * 3.7)
        np.testing.assert_allclose(values, image.double(), atol=1e-12)

    def test_latlong_is_seamless_behind(self):
        """Half way between the last and the first column lies their mean."""
        image = random_image(4, 8, 3)
        angle = 3 * math.pi / 8
        value = Environment("e", image, "latlong").radiance(
            vectors([0.0, math.cos(angle), math.sin(angle)])
        )
        np.testing.assert_allclose(value[0], (image[1, 0] + image[1, -1]).double() / 2, atol=1e-12)

    @pytest.mark.parametrize("layout", ["latlong", "cube"])
    def test_smooth_light_converges_to_second_order(self, layout):
        directions = random_directions()
        errors = []
        for resolution in (32, 64):
            if layout == "latlong":
                image = smooth(latlong_directions(resolution, 2 * resolution))
            else:
                image = smooth(sphere.cubemap_directions(resolution, dtype=torch.float64))
            values = Environment("e", image, layout).radiance(directions)
            errors.append(float((values - smooth(directions)).square().mean().sqrt()))
        assert errors[1] < 2e-3
        assert errors[1] < 0.5 * errors[0]

    def test_gradients(self):
        directions = random_directions(12)
        for image, layout in (
            (random_image(4, 8, 3).double(), "latlong"),
            (random_image(6, 3, 3, 3).double(), "cube"),
        ):
            image.requires_grad_(True)
            assert torch.autograd.gradcheck(
                lambda pixels, layout=layout: Environment("e", pixels, layout).radiance(directions),
                image,
            )
        poles = vectors(UP, DOWN).requires_grad_(True)
        Environment("e", random_image(4, 8, 3), "latlong").radiance(poles).sum().backward()
        assert poles.grad is not None
        assert torch.isfinite(poles.grad).all()

    def test_types_may_be_mixed(self):
        directions = random_directions(20)
        for image in (random_image(4, 8, 3), random_image(4, 8, 3).double()):
            environment = Environment("e", image, "latlong")
            wide, narrow = (
                environment.radiance(directions),
                environment.radiance(directions.float()),
            )
            assert wide.dtype == torch.float64
            assert narrow.dtype == image.dtype
            np.testing.assert_allclose(narrow, wide, atol=1e-4)

    @pytest.mark.usefixtures("without_type_checker")
    @pytest.mark.parametrize(
        ("shape", "layout"),
        [((8, 16), "latlong"), ((8, 16, 4), "latlong"), ((6, 4, 5, 3), "cube"), ((8, 16, 3), "x")],
    )
    def test_shapes_are_checked(self, shape, layout):
        with pytest.raises(ValueError, match="expected"):
            Environment("e", torch.zeros(shape), layout)
        with pytest.raises(ValueError, match="rotation"):
            Environment("e", torch.zeros(4, 8, 3), "latlong", torch.eye(3) * 2)


class TestRotation:
    @pytest.mark.parametrize("name", LAYOUTS)
    def test_a_source_at_d_is_seen_at_rotation_d(self, name):
        environment, directions = LAYOUTS[name](), random_directions()
        first, second = random_rotation(1), random_rotation(2)
        turned = environment.rotated(first).rotated(second)
        np.testing.assert_allclose(
            turned.radiance(directions @ (second @ first).T),
            environment.radiance(directions),
            atol=1e-9,
        )
        assert turned.image is environment.image

    def test_positive_degrees_turn_counter_clockwise_seen_from_above(self):
        """From above, with -z at the top of the page, what is to the right turns ahead."""
        turn = rotation_about_up(90.0)
        np.testing.assert_allclose(turn @ vectors(RIGHT)[0], AHEAD, atol=1e-15)
        np.testing.assert_allclose(turn @ vectors(AHEAD)[0], LEFT, atol=1e-15)
        np.testing.assert_allclose(turn @ vectors(UP)[0], UP, atol=1e-15)
        right = Environment("e", smooth(latlong_directions(64, 128)), "latlong")
        np.testing.assert_allclose(
            right.rotated(turn).radiance(vectors(AHEAD)), right.radiance(vectors(RIGHT)), atol=1e-9
        )

    @pytest.mark.parametrize("name", LAYOUTS)
    def test_samples_turn_with_the_light(self, name):
        environment, rotation = LAYOUTS[name](), random_rotation(3)
        total, moment = integrate(environment)
        turned_total, turned_moment = integrate(environment.rotated(rotation))
        np.testing.assert_allclose(turned_total, total, rtol=1e-12)
        np.testing.assert_allclose(turned_moment, rotation @ moment, atol=1e-12)


class TestSampling:
    @pytest.mark.parametrize("name", LAYOUTS)
    @pytest.mark.parametrize("spacing", [10.0, 0.1, 0.013])
    def test_solid_angles_sum_to_the_sphere_at_any_spacing(self, name, spacing):
        total, count = 0.0, 0
        for directions, solid_angles, _ in LAYOUTS[name]().sample_blocks(spacing):
            assert float((directions.norm(dim=-1) - 1).abs().max()) < 1e-14
            total += float(solid_angles.sum())
            count += len(solid_angles)
            assert float(solid_angles.max()) <= (spacing * spacing) * (1 + 1e-12)
        assert total == pytest.approx(4 * math.pi, abs=1e-12)
        # Pieces are as many as needed, not more: the average one is no smaller than a quarter.
        if spacing < 0.2:
            assert count < 4 * math.pi / (spacing / 2) ** 2 * 2

    @pytest.mark.parametrize("name", LAYOUTS)
    def test_blocks_only_group_the_samples(self, name):
        environment = LAYOUTS[name]()
        whole = list(environment.sample_blocks(0.1))
        parts = list(environment.sample_blocks(0.1, block=300))
        assert len(parts) > 4
        for index in range(3):
            np.testing.assert_allclose(
                torch.cat([part[index] for part in parts]),
                torch.cat([part[index] for part in whole]),
                rtol=1e-12,
                atol=1e-15,
            )

    @pytest.mark.parametrize("name", LAYOUTS)
    @pytest.mark.parametrize("spacing", [10.0, 0.05])
    def test_each_sample_carries_the_pixel_it_lies_in(self, name, spacing):
        environment = LAYOUTS[name]()
        image = environment.image
        for directions, _, radiance in environment.sample_blocks(spacing):
            if environment.layout == "cube":
                index = sphere.cubemap_index(directions, image.shape[1])
            else:
                rows, cols, _ = image.shape
                row = (torch.acos(directions[:, 1]) / math.pi * rows).long()
                angle = torch.atan2(directions[:, 0], -directions[:, 2])
                index = row * cols + ((angle / (2 * math.pi) + 0.5) * cols).long()
            expected = image.reshape(-1, 3)[index].double()
            np.testing.assert_array_equal(radiance, expected)

    @pytest.mark.parametrize("row", [0, 1, 255, 400, 511])
    def test_sun_of_one_pixel_keeps_its_energy(self, row):
        image = torch.zeros(512, 1024, 3)
        image[row, 100] = 1e9
        sun = Environment("sun", image, "latlong")
        edges = row * math.pi / 512, (row + 1) * math.pi / 512
        expected = 1e9 * 2 * math.pi / 1024 * (math.cos(edges[0]) - math.cos(edges[1]))
        for spacing in (1.0, 0.004):
            total, moment = integrate(sun, spacing)
            np.testing.assert_allclose(total, np.full(3, expected), rtol=1e-9)
            # Height is exact as well: a band's mean of y is that of its edges.
            height = (math.cos(edges[0]) + math.cos(edges[1])) / 2
            np.testing.assert_allclose(moment[1], np.full(3, expected * height), rtol=1e-9)

    def test_sun_of_one_texel_keeps_its_energy(self):
        image = torch.ones(6, 64, 64, 3)
        image[3, 10, 20] = 1e9
        exact = sphere.cubemap_solid_angles(64, dtype=torch.float64)
        expected = float((exact * image[..., 0].double()).sum())
        for spacing in (1.0, 0.01):
            total, _ = integrate(Environment("sun", image, "cube"), spacing)
            np.testing.assert_allclose(total, np.full(3, expected), rtol=1e-11)

    @pytest.mark.parametrize("layout", ["latlong", "cube"])
    def test_first_moment_of_a_known_light(self, layout):
        """The integral of s times (s . a) over the sphere is 4 pi / 3 times a."""
        if layout == "latlong":
            image = smooth(latlong_directions(256, 512))
        else:
            image = smooth(sphere.cubemap_directions(128, dtype=torch.float64))
        _, moment = integrate(Environment("e", image, layout))
        expected = 4 * math.pi / 3 * torch.tensor([[1.0, 0.2, 0], [0, 1, 0], [0, 0, 1]])
        np.testing.assert_allclose(moment, expected, atol=2e-3)

    @pytest.mark.parametrize("name", LAYOUTS)
    def test_gradient_of_the_total_is_each_pixel_solid_angle(self, name):
        environment = LAYOUTS[name]()
        image = environment.image.double().requires_grad_(True)
        total, _ = integrate(Environment("e", image, environment.layout), 0.2)
        total.sum().backward()
        assert image.grad is not None
        assert float(image.grad.sum()) == pytest.approx(3 * 4 * math.pi, abs=1e-11)
        assert float(image.grad.min()) > 0
        if environment.layout == "cube":
            exact = sphere.cubemap_solid_angles(4, dtype=torch.float64)
            np.testing.assert_allclose(image.grad[..., 0], exact, atol=1e-14)

    def test_arguments_are_checked(self):
        environment = constant()
        for arguments in ((0.0,), (-1.0,), (math.nan,), (0.1, 0)):
            with pytest.raises(ValueError, match="above 0"):
                next(environment.sample_blocks(*arguments))


def cross_from(function, layout, size=16):
    """A cross drawn by walking over its faces as a viewer inside unfolds them."""
    a = (torch.arange(size, dtype=torch.float64) + 0.5) * (2 / size) - 1
    right, down = a[None, :].expand(size, size), a[:, None].expand(size, size)
    one = torch.ones(size, size, dtype=torch.float64)
    faces = {
        (1, 1): (right, -down, -one),
        (1, 2): (one, -down, right),
        (1, 0): (-one, -down, -right),
        (0, 1): (right, one, -down),
        (2, 1): (right, -one, down),
    }
    if layout == "vertical_cross":
        faces[3, 1] = (right, down, one)
    else:
        faces[1, 3] = (-right, -down, one)
    shape = (4, 3) if layout == "vertical_cross" else (3, 4)
    # The corners hold captions in real files: they must not be read at all.
    image = np.full((shape[0] * size, shape[1] * size, 3), np.nan, np.float32)
    for (row, col), parts in faces.items():
        direction = torch.stack(parts, dim=-1)
        direction = direction / direction.norm(dim=-1, keepdim=True)
        block = (slice(row * size, (row + 1) * size), slice(col * size, (col + 1) * size))
        image[block] = function(direction).numpy()
    return image


class TestCrosses:
    @pytest.mark.parametrize("layout", ["vertical_cross", "horizontal_cross"])
    def test_faces_and_their_axes(self, tmp_path, layout):
        path = write_exr(tmp_path / "cross.exr", cross_from(smooth, layout))
        for option in ("auto", layout):
            environment = load_environment(path, layout=option)
            expected = smooth(sphere.cubemap_directions(16, dtype=torch.float64))
            assert environment.layout == "cube"
            np.testing.assert_allclose(environment.image, expected, rtol=1e-6)

    @pytest.mark.parametrize("layout", ["vertical_cross", "horizontal_cross"])
    def test_unfolded_edges_are_neighbours(self, tmp_path, layout):
        """Pixels side by side in the cross are close on the sphere."""
        image = cross_from(lambda s: s, layout)
        steps = np.concatenate([np.diff(image, axis=axis).reshape(-1, 3) for axis in (0, 1)])
        steps = steps[np.isfinite(steps).all(axis=1)]
        assert np.linalg.norm(steps, axis=1).max() < 2.1 / 16

    @pytest.mark.parametrize("name", ["galileo", "beach", "rnl"])
    def test_real_cross_agrees_with_its_latlong(self, assets, name):
        cross = load_environment(assets / "env" / f"debevec_{name}_cross.hdr")
        latlong = load_environment(assets / "env" / f"debevec_{name}_latlong.hdr")
        assert (cross.layout, latlong.layout) == ("cube", "latlong")
        factor = 2.0 if name == "galileo" else 1.0
        (total, moment), (other, other_moment) = integrate(cross), integrate(latlong)
        np.testing.assert_allclose(total, factor * other, rtol=1e-3)
        # A face turned or mirrored would move the first moment by far more than this.
        np.testing.assert_allclose(moment, factor * other_moment, atol=4e-3 * float(total.max()))
        directions = random_directions(20000)
        logs = [e.radiance(directions).mean(dim=-1).clamp(min=1e-4).log() for e in (cross, latlong)]
        assert float(torch.corrcoef(torch.stack(logs))[0, 1]) > 0.98


class TestLoading:
    def test_exr_latlong_with_name_exposure_and_rotation(self, tmp_path):
        image = smooth(latlong_directions(32, 64)).float()
        path = write_exr(tmp_path / "probe.exr", image.numpy())
        plain = load_environment(path)
        assert (plain.name, plain.layout) == ("probe", "latlong")
        assert torch.equal(plain.image, image)
        turned = load_environment(path, name="x", rotation_degrees=90.0, exposure=-1.0)
        assert turned.name == "x"
        np.testing.assert_allclose(
            turned.radiance(vectors(AHEAD, LEFT)), plain.radiance(vectors(RIGHT, AHEAD)) / 2, 1e-6
        )

    @pytest.mark.parametrize("kind", ["half", "grey", "alpha"])
    def test_exr_channels(self, tmp_path, kind):
        image = np.full((4, 8, 3), 65504, np.float16)
        channels = {
            "half": {"RGB": image},
            "grey": {"Y": np.full((4, 8), 65504, np.float32)},
            "alpha": {"RGBA": np.full((4, 8, 4), 65504, np.float32)},
        }[kind]
        loaded = load_environment(write_exr(tmp_path / "a.exr", image, channels=channels))
        assert loaded.image.dtype == torch.float32
        assert loaded.image.shape == (4, 8, 3)
        assert (loaded.image == 65504).all()

    def test_constant_images_compress_well_and_still_load(self, tmp_path):
        image = np.ones((1024, 2048, 3), np.float16)
        path = write_exr(tmp_path / "white.exr", image, OpenEXR.DWAB_COMPRESSION)
        assert path.stat().st_size < image.nbytes / 4000
        assert float(load_environment(path).image.mean()) == 1.0

    @pytest.mark.parametrize(
        ("shape", "option", "message"),
        [
            ((8, 8), "auto", r"8 x 8 is neither 2:1 .*3:4 .*4:3 .*layout.*angular"),
            ((8, 24), "auto", "24 x 8 is neither 2:1"),
            ((8, 16), "vertical_cross", "layout=vertical_cross needs 3:4, not 16 x 8"),
            ((8, 6), "horizontal_cross", "layout=horizontal_cross needs 4:3"),
        ],
    )
    def test_layouts_are_told_apart_or_refused(self, tmp_path, shape, option, message):
        path = write_exr(tmp_path / "a.exr", np.ones((*shape, 3), np.float32))
        with pytest.raises(InputError, match=message):
            load_environment(path, layout=option)
        assert load_environment(path, layout="latlong").image.shape == (*shape, 3)

    @pytest.mark.usefixtures("without_type_checker")
    def test_unknown_layout(self, tmp_path):
        path = write_exr(tmp_path / "a.exr", np.ones((8, 16, 3), np.float32))
        with pytest.raises(InputError, match="layout=sphere: expected auto"):
            load_environment(path, layout="sphere")

    @pytest.mark.parametrize(
        ("value", "message"),
        [
            (math.nan, "2 radiance values are not finite, the first at .row, col. = .2, 5."),
            (math.inf, "2 radiance values are not finite"),
            (-0.5, "2 radiance values are negative, the first at .row, col. = .2, 5."),
        ],
    )
    def test_bad_radiance_is_counted_and_placed(self, tmp_path, value, message):
        image = np.ones((4, 8, 3), np.float32)
        image[2, 5, 1] = image[3, 0, 0] = value
        with pytest.raises(InputError, match=message):
            load_environment(write_exr(tmp_path / "a.exr", image))

    @pytest.mark.parametrize(
        "option", [{"rotation_degrees": math.inf}, {"exposure": math.nan}, {"exposure": 99.0}]
    )
    def test_bad_options(self, tmp_path, option):
        path = write_exr(tmp_path / "a.exr", np.full((4, 8, 3), 1e10, np.float32))
        with pytest.raises(InputError, match=next(iter(option))):
            load_environment(path, **option)

    def test_missing_empty_and_foreign_files(self, tmp_path):
        (tmp_path / "empty.exr").write_bytes(b"")
        (tmp_path / "text.exr").write_bytes(b"not an image")
        (tmp_path / "a.png").write_bytes(b"x")
        for name, message in (
            ("absent.exr", "no such environment file"),
            ("absent.hdr", "no such environment file"),
            ("empty.exr", "empty"),
            ("text.exr", "does not start as an OpenEXR"),
            ("a.png", "unknown image format, expected one of .hdr, .exr"),
        ):
            with pytest.raises(InputError, match=message) as caught:
                load_environment(tmp_path / name)
            assert str(tmp_path / name) in str(caught.value)

    @pytest.mark.parametrize("part", [0.05, 0.3, 0.6, 0.95])
    def test_truncated_exr(self, tmp_path, part):
        path = write_exr(tmp_path / "a.exr", random_image(64, 128, 3).numpy())
        data = path.read_bytes()
        path.write_bytes(data[: int(part * len(data))])
        with pytest.raises(
            InputError, match=r"a\.exr: the (header|pixels) of this OpenEXR"
        ) as caught:
            load_environment(path)
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize("corner", [(2**16 - 1, 2**15 - 1), (2**31 - 2, 2**31 - 2), (-5, 3)])
    def test_exr_that_claims_too_much_is_refused_before_reading(self, tmp_path, corner):
        path = write_exr(tmp_path / "a.exr", np.ones((4, 8, 3), np.float32))
        data = path.read_bytes()
        box = struct.pack("<4i", 0, 0, 7, 3)
        assert data.count(box) == 2
        path.write_bytes(data.replace(box, struct.pack("<4i", 0, 0, *corner)))
        with pytest.raises(InputError, match=r"claims|at least 1 x 1|header"):
            load_environment(path)

    def test_cropped_exr_and_missing_channels(self, tmp_path):
        path = write_exr(tmp_path / "a.exr", np.ones((4, 8, 3), np.float32))
        data = path.read_bytes()
        box = struct.pack("<4i", 0, 0, 7, 3)
        first = data.index(b"displayWindow")
        path.write_bytes(
            data[:first] + data[first:].replace(box, struct.pack("<4i", 0, 0, 15, 7), 1)
        )
        with pytest.raises(InputError, match="cropped"):
            load_environment(path)
        depth = write_exr(tmp_path / "z.exr", None, channels={"Z": np.ones((4, 8), np.float32)})
        with pytest.raises(InputError, match="has channels Z, expected R, G, B or Y"):
            load_environment(depth)


class TestNamed:
    @pytest.mark.parametrize("name", NAMED)
    def test_each_is_a_repeatable_hdr_light(self, name):
        first, second = find_environment(name), find_environment(name)
        assert torch.equal(first.image, second.image)
        assert first.name == name
        assert torch.isfinite(first.image).all()
        assert float(first.image.min()) > 0

    def test_constant(self):
        total, moment = integrate(constant((1.0, 2.0, 3.0)))
        np.testing.assert_allclose(total, 4 * math.pi * np.array([1, 2, 3]), rtol=1e-12)
        np.testing.assert_allclose(moment, np.zeros((3, 3)), atol=1e-12)

    @pytest.mark.parametrize("rows", [64, 128])
    def test_sun_has_its_irradiance_and_place_at_any_resolution(self, rows):
        light = sky(rows=rows, sun_elevation_degrees=30.0, sun_azimuth_degrees=90.0)
        toward = vectors([math.cos(math.radians(30)), 0.5, 0.0])[0]
        bright = torch.zeros(3, dtype=torch.float64)
        for directions, solid_angles, radiance in light.sample_blocks(10.0):
            sun = directions @ toward > math.cos(math.radians(10))
            around = (directions @ toward > math.cos(math.radians(20))) & ~sun
            level = radiance[around].mean(dim=0)
            excess = (radiance - level) * solid_angles[:, None]
            bright = bright + excess[sun].sum(dim=0)
            peak = directions[radiance.sum(dim=-1).argmax()]
        # The sky's own gradient over ten degrees is the tolerance.
        assert float(bright[0]) == pytest.approx(3.0, rel=0.02)
        assert bright[0] > bright[1] > bright[2]
        assert float(peak @ toward) > math.cos(1.5 * math.pi / rows)
        assert float(light.image.max()) > 100 * float(light.image.median())

    def test_sky_is_blue_above_and_dark_below(self):
        up, down = sky().radiance(vectors(UP, DOWN))
        assert up[2] > 2 * up[0]
        assert down.sum() < 0.5 * up.sum()

    def test_area_lights_are_three_on_a_dim_room(self):
        light = area_lights()
        lit = (light.image.amax(dim=-1) > 0.5).double()
        share = float((lit * sphere_weights(*light.image.shape[:2])).sum() / (4 * math.pi))
        assert 0.05 < share < 0.25
        top = light.radiance(vectors([0.5, 1, 0]))[0]
        warm = light.radiance(vectors([-math.sin(1.047), math.tan(0.611), -0.5]))[0]
        assert top.min() > 4
        assert warm[0] > 5 * warm[2]

    def test_names_win_and_unknown_ones_are_listed(self, tmp_path, monkeypatch):
        path = write_exr(tmp_path / "sky", np.ones((4, 8, 3), np.float32))
        path.rename(tmp_path / "sky.exr")
        monkeypatch.chdir(tmp_path)
        assert find_environment("sky").image.shape == (128, 256, 3)
        assert find_environment("sky.exr").image.shape == (4, 8, 3)
        with pytest.raises(InputError, match="'skyy' is neither a file nor one of sky, sunset"):
            find_environment("skyy")

    def test_named_lights_take_rotation_and_exposure(self):
        plain, other = sky(), find_environment("sky", rotation_degrees=90.0, exposure=1.0)
        np.testing.assert_allclose(
            other.radiance(vectors(AHEAD)), 2 * plain.radiance(vectors(RIGHT)), rtol=1e-9
        )


def sphere_weights(rows, cols):
    edges = torch.cos(torch.linspace(0, math.pi, rows + 1, dtype=torch.float64))
    return ((edges[:-1] - edges[1:]) * (2 * math.pi / cols))[:, None].expand(rows, cols)
