"""Measured materials: closed forms, Mitsuba as a second opinion, real files, broken files."""

import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from directions import directions, random_directions

from prt_torch.assets.brdf import (
    GGX,
    MEASURED_NAMES,
    MERL,
    RGL,
    Cornell,
    Lambert,
    Sum,
    brdf,
    directional_albedo,
)
from prt_torch.assets.brdf.angles import half_difference
from prt_torch.assets.brdf.cornell import interpolate, read_samples
from prt_torch.assets.brdf.spectrum import (
    daylight,
    observer,
    reflectance_to_xyz,
    xyz_to_srgb,
)
from prt_torch.assets.brdf.tensor_file import read_tensor_file
from prt_torch.errors import InputError

RGL_FILES = ["cc_ibiza_sunset", "colodur_napoli_4f", "paper_white"]
TYPE_CODES = {"u1": 1, "f4": 10, "f8": 11}


def write_tensor_file(path: Path, fields: dict[str, np.ndarray]) -> Path:
    header = b"tensor_file\0\x01\x00" + struct.pack("<I", len(fields))
    start = len(header) + sum(13 + len(name) + 8 * a.ndim for name, a in fields.items())
    body = bytes(-start % 8)
    for name, a in fields.items():
        code = TYPE_CODES[a.dtype.str[1:]]
        header += struct.pack("<H", len(name)) + name.encode()
        header += struct.pack("<HBQ", a.ndim, code, start + len(body))
        header += struct.pack(f"<{a.ndim}Q", *a.shape)
        body += a.tobytes() + bytes(-a.nbytes % 8)
    path.write_bytes(header + body)
    return path


def rgl_fields(turns: int = 1, seed: int = 0, span: float = 0.0) -> dict[str, np.ndarray]:
    """A small material of random tables; nothing in it is symmetric by chance."""
    numbers = np.random.default_rng(seed)

    def table(*shape, low=0.1):
        return numbers.uniform(low, 1.0, shape).astype("<f4")

    return {
        "description": np.frombuffer(b"random", "u1"),
        "phi_i": np.linspace(-math.pi, -math.pi + span, turns).astype("<f4"),
        "theta_i": np.array([0.0, 0.5, 1.0, math.pi / 2], "<f4"),
        "ndf": table(*((9, 7) if turns > 1 else (2, 7))),
        "sigma": np.repeat(table(1, 6), 5, 0) if turns == 1 else table(5, 6),
        "vndf": table(turns, 4, 6, 5),
        "luminance": table(turns, 4, 4, 4),
        "rgb": table(turns, 4, 3, 4, 4, low=-0.1),
        "jacobian": np.array([1], "u1"),
    }


@pytest.fixture(scope="module")
def rgl_file(tmp_path_factory) -> Path:
    return write_tensor_file(tmp_path_factory.mktemp("rgl") / "random_rgb.bsdf", rgl_fields())


def write_cornell(path: Path, rows: np.ndarray, wavelengths=(450, 550, 650)) -> Path:
    lines = ["# made by a test", str(len(wavelengths)), " ".join(map(str, wavelengths)), "# data"]
    lines += [" ".join(f"{value:.9g}" for value in row) for row in rows]
    path.write_text("\n".join(lines) + "\n")
    return path


def cornell_rows(count: int, reflectance, seed: int = 5) -> np.ndarray:
    """Samples at random pairs, with the same reflectance at three wavelengths."""
    numbers = np.random.default_rng(seed)
    cosines = numbers.uniform(0.1, 1.0, (count, 2))
    turns = numbers.uniform(-math.pi, math.pi, (count, 2))
    wi, wo = (directions(cosines[:, side], torch.from_numpy(turns[:, side])) for side in (0, 1))
    values = reflectance(wi, wo).expand(count, 3).numpy()
    polar = np.arccos(cosines)
    return np.column_stack([polar[:, 0], turns[:, 0], polar[:, 1], turns[:, 1], values])


MERL_SCALES = np.array([1.0, 1.15, 1.66]) / 1500.0


def merl_model(half, difference, turn) -> np.ndarray:
    """Smooth, channels first: a lobe, and a term whose sign a wrong azimuth would flip."""
    lobe = np.exp(-((half / 0.3) ** 2)) * (1 + difference)
    sided = np.sin(half) * np.sin(difference) * np.sin(2 * turn)
    channels = [0.2 + lobe, 0.3 + 0.5 * lobe, 0.4 + 0.2 * sided]
    return np.stack(np.broadcast_arrays(*channels, sided)[:3])


@pytest.fixture(scope="module")
def merl_file(tmp_path_factory) -> Path:
    half = ((np.arange(90) + 0.5) / 90) ** 2 * (math.pi / 2)
    difference = (np.arange(90) + 0.5) * (math.pi / 180)
    turn = (np.arange(180) + 0.5) * (math.pi / 180)
    h, d, t = np.ix_(half, difference, turn)
    values = merl_model(h, d, t)
    lowest = np.cos(h) * np.cos(d) - np.sin(h) * np.sin(d) * np.abs(np.cos(t))
    values[:, lowest < 0] = -1.0  # a direction below the horizon
    path = tmp_path_factory.mktemp("merl") / "model.binary"
    raw = np.where(values < 0, values, values / MERL_SCALES[:, None, None, None])
    path.write_bytes(np.array([90, 90, 180], "<i4").tobytes() + raw.astype("<f8").tobytes())
    return path


@pytest.fixture(scope="module")
def merl(merl_file) -> MERL:
    return MERL(merl_file)


@pytest.fixture(scope="module")
def cornell(tmp_path_factory) -> Cornell:
    rows = cornell_rows(200, lambda wi, wo: GGX(0.5, 0.4).evaluate(wi, wo) + 0.1)
    return Cornell(str(write_cornell(tmp_path_factory.mktemp("cornell") / "ggx.brdf", rows)))


@pytest.fixture(params=MEASURED_NAMES)
def model(request, rgl_file, merl, cornell):
    return {"rgl": RGL(rgl_file), "merl": merl, "cornell": cornell}[request.param]


# ---------------------------------------------------------------- all formats


def test_values_are_finite_everywhere_in_both_precisions(model):
    edges = torch.tensor([1.0, 1 - 1e-15, 0.999, 0.5, 1e-3, 1e-6, 1e-12, 0.0, -0.5])
    wi = directions(edges.double())[:, None, None].expand(-1, 9, 3, 3)
    wo = torch.stack([directions(edges.double(), 0.7 + turn) for turn in (0, 1e-9, math.pi)], 1)
    for dtype in (torch.float32, torch.float64):
        values = model.evaluate(wi.to(dtype), wo.to(dtype))
        assert values.shape == (9, 9, 3, 3)
        assert values.dtype == dtype
        assert values.isfinite().all()
        assert torch.equal(values[-2], values[-3])  # the horizon is the limit from above
    below = (wi[..., 2] < 0) | (wo[..., 2] < 0)
    assert (values[below] == 0).all()
    assert (values[~below] != 0).any()


def test_gradients_are_right_inside_and_finite_at_the_poles(model):
    wi, wo = random_directions(12, 1), random_directions(12, 2)
    wi, wo = (w[(w[:, 2] > 0.2)][:6].requires_grad_() for w in (wi, wo))
    assert torch.autograd.gradcheck(model.evaluate, (wi[:4], wo[:4]), eps=1e-8, atol=1e-4)
    special = directions(torch.tensor([1.0, 0.7, 0.7, 1e-6, 1e-6, 1.0]).double())
    other = directions(
        torch.tensor([1.0, 0.7, 0.7, 1e-6, 1e-6, 0.3]).double(),
        torch.tensor([0.0, 0.7, 0.7 + math.pi, 0.7, 0.7 + math.pi, 0.0]).double(),
    )
    for dtype in (torch.float32, torch.float64):
        a, b = (w.detach().to(dtype).requires_grad_() for w in (special, other))
        model.evaluate(a, b).sum().backward()
        assert a.grad is not None
        assert b.grad is not None
        assert a.grad.isfinite().all()
        assert b.grad.isfinite().all()


def test_precisions_agree(model):
    wi, wo = random_directions(3000, 3), random_directions(3000, 4)
    kept = (wi[:, 2] > 0.05) & (wo[:, 2] > 0.05)
    exact = model.evaluate(wi[kept], wo[kept])
    single = model.evaluate(wi[kept].float(), wo[kept].float()).double()
    assert (single - exact).abs().median() <= 1e-6 * exact.abs().median()
    assert (single - exact).abs().max() <= 1e-2 * exact.abs().max()


def test_turning_about_the_normal_changes_nothing(model):
    wi, wo = random_directions(500, 5), random_directions(500, 6)
    c, s = math.cos(0.6), math.sin(0.6)
    turn = torch.tensor([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=torch.float64)
    assert model.isotropic
    before, after = model.evaluate(wi, wo), model.evaluate(wi @ turn, wo @ turn)
    assert torch.allclose(before, after, rtol=1e-7, atol=1e-9)


def test_reciprocal_is_said_where_it_holds(model):
    wi, wo = random_directions(2000, 7), random_directions(2000, 8)
    forward, backward = model.evaluate(wi, wo), model.evaluate(wo, wi)
    holds = torch.allclose(forward, backward, rtol=1e-9)
    assert holds == model.reciprocal


def test_many_pairs_are_as_one(model):
    wi, wo = random_directions(70_000, 9), random_directions(70_000, 10)
    some = slice(69_990, None)
    assert torch.equal(model.evaluate(wi, wo)[some], model.evaluate(wi[some], wo[some]))
    assert model.evaluate(wi[:0], wo[:0]).shape == (0, 3)


def test_descriptions_are_json_and_come_back(model):
    described = json.loads(json.dumps(model.describe()))
    assert set(described) == {"name", "path", "sha256"}
    assert brdf(described) == model
    both = brdf({"name": "sum", "parts": [described, {"name": "lambert", "albedo": 0.1}]})
    assert both == Sum((model, Lambert(0.1)))
    assert both.reciprocal == model.reciprocal


def test_a_file_that_changed_is_not_the_one_described(tmp_path):
    path = write_tensor_file(tmp_path / "a.bsdf", rgl_fields())
    described = RGL(path).describe()
    write_tensor_file(path, rgl_fields(seed=1))
    with pytest.raises(InputError, match=r"a\.bsdf: sha256: expected .*, the file has "):
        brdf(described)


@pytest.mark.parametrize("name", MEASURED_NAMES)
def test_files_that_are_none(name, tmp_path):
    empty = tmp_path / "empty"
    empty.touch()
    for path, message in [
        (tmp_path, f"is a folder, expected a {name} BRDF file"),
        (tmp_path / "none", f"no such {name} BRDF file"),
        (empty, "file is empty"),
    ]:
        with pytest.raises(InputError, match=message) as raised:
            brdf({"name": name, "path": str(path)})
        assert str(raised.value).startswith(f"{path}: ") or str(path) in str(raised.value)
        assert "\n" not in str(raised.value)
    with pytest.raises(InputError, match=r"brdf\.path: missing"):
        brdf({"name": name})
    with pytest.raises(InputError, match=r"brdf\.albedo: unknown parameter"):
        brdf({"name": name, "path": "x", "albedo": 1})


@pytest.mark.usefixtures("without_type_checker")
@pytest.mark.parametrize("name", MEASURED_NAMES)
def test_arguments_of_another_type(name, rgl_file):
    with pytest.raises(InputError, match=r"brdf\.path: expected a file, got 3"):
        brdf({"name": name, "path": 3})
    with pytest.raises(InputError, match=r"brdf\.sha256: expected hexadecimal digits, got 5"):
        brdf({"name": name, "path": str(rgl_file), "sha256": 5})


# ---------------------------------------------------------------- RGL


def test_rgl_in_closed_form(tmp_path):
    """A flat density maps the half vector to its own square, where the tables are linear."""
    square = np.linspace(0.0, 1.0, 4)
    fields = rgl_fields()
    fields["vndf"] = np.ones_like(fields["vndf"])
    fields["ndf"] = np.full((2, 7), 3.0, "<f4")
    fields["sigma"] = np.full((5, 6), 0.5, "<f4")
    columns, rows = np.meshgrid(square, square)  # of the half vector's polar angle, azimuth
    viewers = np.arange(4.0)[:, None, None]
    fields["rgb"][0, :, 0], fields["rgb"][0, :, 1] = columns, rows
    fields["rgb"][0, :, 2] = viewers
    model = RGL(str(write_tensor_file(tmp_path / "linear.bsdf", fields)))
    wi, wo = random_directions(1000, 11), random_directions(1000, 12)
    half = torch.nn.functional.normalize(wi + wo, dim=-1)
    turn = torch.atan2(half[:, 1], half[:, 0]) - torch.atan2(wo[:, 1], wo[:, 0])
    nodes = fields["theta_i"].astype(float)
    viewer = np.interp(wo[:, 2].acos().numpy(), nodes, np.arange(4.0))
    expected = [
        (half[:, 2].acos() / (math.pi / 2)).sqrt(),
        (turn / (2 * math.pi) + 0.5).remainder(1.0),
        torch.from_numpy(viewer),
    ]
    found = model.evaluate(wi, wo) * wi[:, 2:] / (3.0 / (4 * 0.5))
    assert torch.allclose(found, torch.stack(expected, -1), atol=1e-6)


@pytest.fixture
def measured_by_mitsuba(tmp_path):
    """Mitsuba's plugin reads spectra only: three wavelengths stand for the channels."""
    mi = pytest.importorskip("mitsuba", reason="mitsuba is not installed (pip install '.[check]')")
    previous = mi.variant()
    mi.set_variant("scalar_spectral")

    def evaluate(fields, wi, wo) -> torch.Tensor:
        spectral = {k: v for k, v in fields.items() if k not in ("rgb", "valid", "version")}
        spectral["wavelengths"] = np.array([400, 500, 600], "<f4")
        spectral["spectra"] = fields["rgb"]
        path = write_tensor_file(tmp_path / "spectral.bsdf", spectral)
        plugin = mi.load_dict({"type": "measured", "filename": str(path)})
        at, context = mi.SurfaceInteraction3f(), mi.BSDFContext()
        at.wavelengths = [400, 500, 600, 600]
        values = []
        for light, viewer in zip(wi.tolist(), wo.tolist(), strict=True):
            at.wi = viewer
            values.append(list(plugin.eval(context, at, light))[:3])
        return torch.tensor(values, dtype=torch.float64)

    yield evaluate
    if previous is not None:
        mi.set_variant(previous)


@pytest.mark.parametrize(
    ("turns", "span"),
    [(1, 0.0), (5, 2 * math.pi), (5, math.pi), (5, math.pi / 2)],
    ids=["isotropic", "whole turn", "half turn", "quarter turn"],
)
def test_rgl_against_mitsuba(turns, span, tmp_path, measured_by_mitsuba):
    fields = rgl_fields(turns, span=span)
    model = RGL(str(write_tensor_file(tmp_path / "a.bsdf", fields)))
    assert model.isotropic == (turns == 1)
    wi, wo = random_directions(1000, 13), random_directions(1000, 14)
    found = model.evaluate(wi, wo) * wi[:, 2:]
    expected = measured_by_mitsuba(fields, wi, wo)
    assert (found - expected).abs().max() < 4e-6


@pytest.mark.parametrize("name", RGL_FILES)
def test_real_rgl_against_mitsuba(name, assets, measured_by_mitsuba):
    path = assets / "brdf" / f"rgl_{name}_rgb.bsdf"
    fields = read_tensor_file(path, path.read_bytes())
    wi, wo = random_directions(1000, 15), random_directions(1000, 16)
    found = RGL(path).evaluate(wi, wo) * wi[:, 2:]
    expected = measured_by_mitsuba(fields, wi, wo)
    error = (found - expected).abs() / expected.max()
    # Mitsuba computes in float32, and beside the seam of azimuths not the same every time.
    assert error.quantile(0.99) < 1e-5
    assert error.max() < 1e-3


@pytest.mark.parametrize("name", RGL_FILES)
def test_real_rgl_albedo_is_the_mean_of_its_table(name, assets):
    path = assets / "brdf" / f"rgl_{name}_rgb.bsdf"
    fields = read_tensor_file(path, path.read_bytes())
    shares = np.ones(32)
    shares[[0, -1]] = 0.5
    shares /= shares.sum()
    means = np.einsum("tcyx,y,x->tc", fields["rgb"][0].astype(float), shares, shares)[:-1]
    viewers = directions(np.cos(fields["theta_i"][:-1].astype(float)))
    albedo = directional_albedo(RGL(path), viewers, resolution=64).numpy()
    assert (albedo <= 1.0).all()
    # The rest of the mean is outside the hemisphere of lights, and the 128 x 128 density.
    assert np.abs(albedo / means - 1.0).max() < 0.03
    assert np.abs(albedo / means - 1.0).mean() < 0.016


@pytest.mark.parametrize(
    ("name", "error", "negative"),
    [
        ("cc_ibiza_sunset", 0.3, 0.2),
        ("colodur_napoli_4f", 0.1, 0.0),
        ("paper_white", 0.07, 0.0),
    ],
)
def test_real_rgl_is_nearly_reciprocal_and_positive(name, error, negative, assets):
    model = RGL(str(assets / "brdf" / f"rgl_{name}_rgb.bsdf"))
    wi, wo = random_directions(20_000, 17), random_directions(20_000, 18)
    kept = (wi[:, 2] > 0.2) & (wo[:, 2] > 0.2)
    forward, backward = model.evaluate(wi[kept], wo[kept]), model.evaluate(wo[kept], wi[kept])
    relative = ((forward - backward).square().sum() / forward.square().sum()).sqrt()
    assert 0 < relative < error
    assert (forward < 0).double().mean() <= negative
    assert forward.min() > -0.002


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rgb": None}, "rgb: missing; an RGL material needs it"),
        ({"rgb": None, "spectra": np.ones((1, 4, 3, 4, 4), "<f4")}, "use the _rgb.bsdf file"),
        ({"sigma": np.zeros((5, 6), "<f4")}, "sigma: 30 of 30 values are not in 1e-06 to 1000"),
        ({"ndf": np.full((2, 7), np.nan, "<f4")}, r"ndf: 14 of 14 .* the first nan at \[0, 0\]"),
        ({"ndf": np.ones((2, 7))}, "ndf: expected 2 axes of float32, got 2 of float64"),
        ({"ndf": np.ones((1, 7), "<f4")}, r"ndf: expected at least 2 x 2 values, got \(1, 7\)"),
        ({"vndf": np.zeros((1, 4, 6, 5), "<f4")}, "vndf: a slice has no mass"),
        ({"vndf": np.ones((1, 3, 6, 5), "<f4")}, "vndf: expected 1 x 4 slices .* got 1 x 3"),
        ({"rgb": np.ones((1, 4, 4, 4, 4), "<f4")}, "rgb: expected 3 channels, got 4"),
        ({"theta_i": np.array([0, 1, 1, 1.5], "<f4")}, "theta_i: expected values that rise"),
        ({"theta_i": np.array([0, 1, 2, 3], "<f4")}, "theta_i: 2 of 4 values are not in 0 to 1.5"),
        ({"jacobian": np.array([7], "u1")}, "jacobian: 1 of 1 values are not in 0 to 1"),
    ],
)
def test_rgl_refuses(change, message, tmp_path):
    fields = {k: v for k, v in (rgl_fields() | change).items() if v is not None}
    path = write_tensor_file(tmp_path / "bad.bsdf", fields)
    with pytest.raises(InputError, match=message) as raised:
        RGL(path)
    assert str(raised.value).startswith(f"{path}: ")


def test_rgl_refuses_two_azimuths(tmp_path):
    path = write_tensor_file(tmp_path / "two.bsdf", rgl_fields(2, span=math.pi))
    with pytest.raises(InputError, match=r"phi_i: expected 1 azimuth, or at least 3 .* got 2"):
        RGL(path)


@pytest.mark.parametrize(
    ("at", "value", "message"),
    [
        (0, b"X", "not a tensor file, it begins with"),
        (12, b"\2", "version: expected 1.0, got 2.0"),
        (14, b"\xff\xff\xff\xff", "field 10 of 4294967295: "),
        (18, b"\0\0", "field 1 of 9: name: expected printable ASCII, got b''"),
        (18, b"\xff\xff", "field 1 of 9: truncated, its description ends beyond"),
        (31, b"\xff\xff", "description: axes: expected at most 8, got 65535"),
        (33, b"\x0c", "description: type: expected 1 to 11, got 12"),
        (34, b"\xff" * 8, "description: claims 6 values of 1 bytes at byte 18446744073709551615"),
        (42, b"\xff" * 8, "description: claims 18446744073709551615 values of 1 bytes"),
        (42, b"\0" * 8, r"description: shape: expected at least 1 along each axis, got \[0\]"),
    ],
)
def test_tensor_files_that_lie(at, value, message, rgl_file, tmp_path):
    data = bytearray(rgl_file.read_bytes())
    data[at : at + len(value)] = value
    path = tmp_path / "lies.bsdf"
    path.write_bytes(data)
    with pytest.raises(InputError, match=message) as raised:
        RGL(path)
    assert str(raised.value).startswith(f"{path}: ")


def loads_or_says_why(model, data: bytes, path: Path) -> bool:
    """True if broken bytes load, and then evaluate to numbers; else one clear line."""
    path.write_bytes(data)
    try:
        values = model(path).evaluate(random_directions(50, 19), random_directions(50, 20))
    except InputError as error:
        assert str(path) in str(error)  # noqa: PT017
        assert "\n" not in str(error)  # noqa: PT017
        return False
    assert values.isfinite().all()
    return True


def test_broken_rgl_files_load_or_say_why(rgl_file, tmp_path):
    data = rgl_file.read_bytes()
    lengths = [*range(1, 420, 17), *range(420, len(data) - 8, 211), len(data) - 8]
    assert not any(loads_or_says_why(RGL, data[:n], tmp_path / "cut.bsdf") for n in lengths)
    numbers = np.random.default_rng(21)
    outcomes = []
    for trial in range(120):
        flipped = bytearray(data)
        place = numbers.integers(400 if trial % 2 else len(data))
        flipped[place] ^= 1 << numbers.integers(8)
        outcomes.append(loads_or_says_why(RGL, bytes(flipped), tmp_path / "flip.bsdf"))
    assert 20 < sum(outcomes) < 110  # both ends occur


# ---------------------------------------------------------------- MERL


def test_half_difference_angles_by_turning_vectors():
    """Rusinkiewicz's definition: turn the half vector to the normal, and the light with it."""
    wi, wo = random_directions(500, 22).numpy(), random_directions(500, 23).numpy()
    half = wi + wo
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    polar, turn = np.arccos(half[:, 2]), np.arctan2(half[:, 1], half[:, 0])
    x = wi[:, 0] * np.cos(turn) + wi[:, 1] * np.sin(turn)
    y = -wi[:, 0] * np.sin(turn) + wi[:, 1] * np.cos(turn)
    across = x * np.cos(polar) - wi[:, 2] * np.sin(polar)
    expected = [polar, np.arccos((wi * half).sum(-1)), np.arctan2(y, across)]
    found = half_difference(torch.from_numpy(wi), torch.from_numpy(wo))
    for angle, by_turning in zip(found, expected, strict=True):
        assert np.abs(angle.numpy() - by_turning).max() < 1e-7


def merl_pair(half, difference, turn) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions that have these half and difference angles."""
    h, d, t = (torch.as_tensor(a, dtype=torch.float64) for a in (half, difference, turn))
    zero = torch.zeros_like(h)
    normal = torch.stack([h.sin(), zero, h.cos()], -1)
    down = torch.stack([h.cos(), zero, -h.sin()], -1)
    around = torch.stack([zero, zero + 1, zero], -1)
    offset = d.sin()[:, None] * (t.cos()[:, None] * down + t.sin()[:, None] * around)
    along = d.cos()[:, None] * normal
    return along + offset, along - offset


def test_merl_gives_back_what_was_tabulated(merl):
    numbers = np.random.default_rng(24)
    bins = numbers.integers((0, 0, 0), (89, 89, 180), (4000, 3))
    half = ((bins[:, 0] + 0.5) / 90) ** 2 * (math.pi / 2)
    difference, turn = ((bins[:, axis] + 0.5) * (math.pi / 180) for axis in (1, 2))
    wi, wo = merl_pair(half, difference, turn)
    above = ((wi[:, 2] > 0.02) & (wo[:, 2] > 0.02)).numpy()
    assert above.sum() > 1000
    found = merl.evaluate(wi, wo).numpy()[above]
    expected = merl_model(half, difference, turn).T[above]
    assert np.abs(found / expected - 1).max() < 1e-9  # at the middles of bins


def test_merl_between_bins(merl):
    wi, wo = random_directions(20_000, 25), random_directions(20_000, 26)
    half, difference, turn = (a.numpy() for a in half_difference(wi, wo))
    error = np.abs(merl.evaluate(wi, wo).numpy() / merl_model(half, difference, turn).T - 1).max(-1)
    clear = (torch.minimum(wi[:, 2], wo[:, 2]) > 0.05).numpy()
    assert np.median(error) < 2e-4
    assert error[clear].max() < 0.01
    assert error.max() < 0.1  # beside bins beyond the horizon


def test_merl_counts_bins_that_were_not_measured(merl, merl_file):
    raw = np.frombuffer(merl_file.read_bytes(), "<f8", offset=12)[: 90 * 90 * 180]
    assert merl.num_invalid_bins == (raw < 0).sum()
    assert 0.1 < merl.num_invalid_bins / raw.size < 0.9


def test_merl_refuses(merl_file, tmp_path):
    path = tmp_path / "bad.binary"
    cases = [
        (b"\0" * 11, "truncated, 11 bytes are less than a MERL header"),
        (
            np.array([90, 90, 360], "<i4").tobytes(),
            r"expected \(90, 90, 180\), got \(90, 90, 360\)",
        ),
        (np.array([90, 90, -180], "<i4").tobytes(), r"dimensions: .* got \(90, 90, -180\)"),
        (np.array([90, 90, 180], "<i4").tobytes() + b"\0" * 80, "expected 34992012 bytes, got 92"),
    ]
    for data, message in cases:
        path.write_bytes(data)
        with pytest.raises(InputError, match=message):
            MERL(path)
    broken = np.frombuffer(merl_file.read_bytes(), "<f8", offset=12).copy()
    broken[5] = np.nan
    path.write_bytes(np.array([90, 90, 180], "<i4").tobytes() + broken.tobytes())
    with pytest.raises(
        InputError, match=r"values: 1 of 4374000 .* the first nan at \[0, 0, 0, 5\]"
    ):
        MERL(path)


# ---------------------------------------------------------------- Cornell


def test_a_flat_spectrum_is_white_whatever_the_wavelengths():
    numbers = np.random.default_rng(27)
    for wavelengths in (np.arange(400.0, 701.0, 10.0), np.sort(numbers.uniform(380, 780, 40))):
        rgb = reflectance_to_xyz(wavelengths, np.ones((1, len(wavelengths)))) @ xyz_to_srgb().T
        assert np.allclose(rgb, 1.0, atol=1e-12)
    blue, red = np.zeros((2, 31))
    blue[:10], red[20:] = 1.0, 1.0
    found = reflectance_to_xyz(np.arange(400.0, 701.0, 10.0), np.stack([blue, red]))
    found = found @ xyz_to_srgb().T
    assert found.argmax(-1).tolist() == [2, 0]


def test_colour_tables_against_mitsuba():
    mi = pytest.importorskip("mitsuba", reason="mitsuba is not installed (pip install '.[check]')")
    previous = mi.variant()
    mi.set_variant("scalar_spectral")
    wavelengths = np.arange(380.0, 781.0, 5.0)
    tables = np.array([list(mi.cie1931_xyz(float(w))) for w in wavelengths])
    assert np.abs(tables - observer(wavelengths)).max() < 0.05
    light, at = mi.load_dict({"type": "d65"}), mi.SurfaceInteraction3f()
    power = []
    for wavelength in wavelengths:
        at.wavelengths = [float(wavelength)] * 4
        power.append(light.eval(at)[0])
    if previous is not None:
        mi.set_variant(previous)
    assert np.allclose(np.array(power) / power[36] * 100.0, daylight(wavelengths), rtol=1e-4)


def test_cornell_of_a_constant_is_that_constant(tmp_path):
    rows = cornell_rows(50, lambda wi, wo: torch.tensor([0.2 / math.pi], dtype=torch.float64))
    model = Cornell(str(write_cornell(tmp_path / "flat.brdf", rows)))
    wi, wo = random_directions(500, 28), random_directions(500, 29)
    assert torch.allclose(model.evaluate(wi, wo), torch.full((), 0.2 / math.pi).double(), rtol=1e-7)
    albedo = directional_albedo(model, directions(0.6)[None])
    assert torch.allclose(albedo, torch.full((), 0.2).double(), rtol=1e-6)


def test_cornell_finds_a_smooth_model_between_samples(cornell):
    wi, wo = random_directions(5000, 30), random_directions(5000, 31)
    kept = (wi[:, 2] > 0.1) & (wo[:, 2] > 0.1)
    wi, wo = wi[kept], wo[kept]
    expected = GGX(0.5, 0.4).evaluate(wi, wo) + 0.1
    error = (cornell.evaluate(wi, wo) / expected - 1).abs()
    assert error.median() < 0.01
    assert error.quantile(0.99) < 0.15


def test_leaving_out_as_by_doing_it(cornell):
    samples = read_samples(Path(cornell.path), Path(cornell.path).read_bytes())
    process, _ = interpolate(samples)
    residuals = process.leave_one_out()
    # Without sample 7 the same process is fitted anew, at fixed softening.
    from_others = type(process)(
        torch.cat([process.positions[:7], process.positions[8:]]),
        torch.cat([process.values[:7], process.values[8:]]),
        process.noise,
    )
    left_out = process.values[7] - from_others(process.positions[7:8])[0]
    assert torch.allclose(residuals[7], left_out, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "at_samples", "left_out", "typical"),
    [("acryl_blue", 0.03, 0.18, 0.012), ("krylon_blue", 0.01, 0.1, 0.006)],
)
def test_real_cornell_samples_are_predicted(name, at_samples, left_out, typical, assets):
    path = assets / "brdf" / f"cornell_{name}.brdf"
    samples = read_samples(path, path.read_bytes())
    assert len(samples.wi) == 1439
    process, _ = interpolate(samples)
    errors = process(process.positions) - process.values  # of logarithms, so relative
    residuals = process.leave_one_out()
    assert errors.square().mean().sqrt() < at_samples
    assert residuals.square().mean().sqrt() < left_out
    assert residuals.abs().median() < typical


@pytest.mark.slow  # a table of 1439 samples takes seconds
@pytest.mark.parametrize(
    ("name", "median", "most"), [("acryl_blue", 0.006, 0.06), ("krylon_blue", 0.003, 0.02)]
)
def test_real_cornell_samples_come_back(name, median, most, assets):
    path = assets / "brdf" / f"cornell_{name}.brdf"
    samples = read_samples(path, path.read_bytes())
    rgb = samples.xyz @ torch.from_numpy(xyz_to_srgb().T)
    largest = rgb.abs().amax(-1)
    found = Cornell(path).evaluate(samples.wi, samples.wo)
    error = (found - rgb).abs().amax(-1) / (largest + 0.3 * largest.median())
    assert error.median() < median
    assert error.quantile(0.95) < most


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hello", "line 1: expected numbers, got b'hello'"),
        ("# nothing\n", "number of wavelengths: expected 3 to 1000, got 0"),
        ("3.5 1 2", "number of wavelengths: expected 3 to 1000, got 3.5"),
        ("nan", "number of wavelengths: expected 3 to 1000, got nan"),
        ("1e300", "number of wavelengths: expected 3 to 1000, got 1e"),
        ("3 450 550", "truncated, -1 numbers after the wavelengths"),
        ("3 450 550 650 " + "0 0 0 0 1 1 1 " * 3, "samples: expected 16 to 5000, got 3"),
        ("3 450 550 650 " + "0 0 0 0 1 1 1 " * 20 + "0 0", "142 numbers .* whole samples of 7"),
        ("3 450 450 650 " + "0 0 0 0 1 1 1 " * 20, "wavelengths: expected values that rise"),
        ("3 450 550 950 " + "0 0 0 0 1 1 1 " * 20, "wavelengths: 1 of 3 .* not in 380 to 780"),
        ("3 450 550 650 " + "0 0 1.6 0 1 1 1 " * 20, "theta: 20 of 40 values are not in 0 to 1.57"),
        ("3 450 550 650 " + "0 0 0 0 1 -1 1 " * 20, r"values: 20 of 60 .* first -1 at \[0, 1\]"),
        ("3 450 550 650 " + "0 0 0 0 1 inf 1 " * 20, "values: 20 of 60 values"),
    ],
)
def test_cornell_refuses(text, message, tmp_path):
    path = tmp_path / "bad.brdf"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as raised:
        Cornell(path)
    assert str(raised.value).startswith(f"{path}: ")


def test_broken_cornell_files_read_or_say_why(cornell, tmp_path):
    data = Path(cornell.path).read_bytes()
    numbers = np.random.default_rng(32)
    outcomes = []
    for trial in range(300):
        if trial % 2:
            broken = data[: numbers.integers(1, len(data))]
        else:
            flipped = bytearray(data)
            flipped[numbers.integers(len(data))] ^= 1 << numbers.integers(8)
            broken = bytes(flipped)
        try:
            samples = read_samples(Path("a.brdf"), broken)
        except InputError as error:
            assert str(error).startswith("a.brdf: ")  # noqa: PT017
            outcomes.append(False)
        else:
            assert samples.xyz.isfinite().all()
            outcomes.append(True)
    assert 30 < sum(outcomes) < 270
    same = "3 450 550 650 " + "0.5 0 0.5 3.14 0 0 0 " * 40  # black, and all at one place
    assert loads_or_says_why(Cornell, same.encode(), tmp_path / "same.brdf")
