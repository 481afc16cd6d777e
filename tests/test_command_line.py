"""The command lines: bad input is one line and leaves nothing behind, good input a whole run."""

import hashlib
import json
import os
import re
import runpy
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
import trimesh

import prt_torch
from prt_torch import store

ROOT = Path(__file__).resolve().parent.parent
FIT, BAKE, REPORT = (
    ROOT / "train" / "fit.py",
    ROOT / "train" / "bake.py",
    ROOT / "eval" / "report.py",
)
MAINS = {script: runpy.run_path(str(script))[script.stem] for script in (FIT, BAKE, REPORT)}

TINY = (
    "scene.ground_resolution=8",
    "transfer.resolution=4",
    "transfer.supersampling=2",
    "transfer.order=3",
    "representation.num_clusters=8",
    "representation.rank=2",
    "fit.max_steps=2",
    "preview.width=32",
    "preview.height=24",
    "preview.opengl=false",
    "light.fit=[constant]",
    "light.test=[sky]",
    "cache=cache",
)

BALL = trimesh.creation.icosphere(subdivisions=1)
POINTS = np.asarray(BALL.vertices, np.float64) + np.array([0, 1.5, 0])
FACES = np.asarray(BALL.faces)


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch) -> Iterator[None]:
    """Everything here is small: threads would cost more than they give."""
    monkeypatch.chdir(tmp_path)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def write(name: str, content: bytes | str) -> str:
    Path(name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return name


def obj(points=POINTS, faces=FACES) -> str:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(points).tolist()]
    return "\n".join([*lines, *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces), ""])


def off(points=POINTS, faces=FACES) -> str:
    rows = [" ".join(map(repr, row)) for row in np.asarray(points).tolist()]
    rows += [f"3 {a} {b} {c}" for a, b, c in faces]
    return f"OFF\n{len(points)} {len(faces)} 0\n" + "\n".join(rows) + "\n"


def ply(points=POINTS, faces=FACES, *, order: str = "") -> bytes:
    """ASCII, or binary in the byte order ``<`` or ``>``."""
    form = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = (
        f"ply\nformat {form} 1.0\nelement vertex {len(points)}\nproperty double x\n"
        f"property double y\nproperty double z\nelement face {len(faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    if not order:
        return (header + off(points, faces).partition("0\n")[2]).encode()
    body = b"".join(struct.pack(f"{order}B3i", 3, *map(int, face)) for face in faces)
    return header.encode() + np.asarray(points, f"{order}f8").tobytes() + body


def stl(points=POINTS, faces=FACES) -> bytes:
    corners = np.asarray(points)[faces].reshape(len(faces), 9)
    facets = [struct.pack("<12fH", 0, 0, 0, *map(float, row), 0) for row in corners]
    return bytes(80) + struct.pack("<I", len(faces)) + b"".join(facets)


def gltf(points=POINTS, faces=FACES, *, binary: bool) -> bytes:
    positions, indices = np.asarray(points, "<f4").tobytes(), np.asarray(faces, "<u2").tobytes()
    indices += b"\0" * (-len(indices) % 4)
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(points), "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": np.size(faces), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(positions)},
            {"buffer": 0, "byteOffset": len(positions), "byteLength": len(indices)},
        ],
        "buffers": [{"byteLength": len(positions) + len(indices)}],
    }
    if not binary:
        write("buffer.bin", positions + indices)
        document["buffers"][0]["uri"] = "buffer.bin"
        return json.dumps(document).encode()
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I", len(text)) + b"JSON" + text
    chunks += struct.pack("<I", len(positions + indices)) + b"BIN\0" + positions + indices
    return b"glTF" + struct.pack("<II", 2, len(chunks) + 12) + chunks


def exr(name: str, value: float | None = None, *, rest: float = 1.0) -> bytes:
    """A 16 x 8 image of one value, with one pixel of another if given."""
    pixels = np.full((8, 16, 3), rest, np.float32)
    if value is not None:
        pixels[3, 5] = value
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": pixels}) as file:
        file.write(name)
    return Path(name).read_bytes()


def huge_exr(name: str) -> bytes:
    """The image above with a header that claims 2^31 pixels."""
    data = bytearray(exr(name))
    for window in (b"dataWindow", b"displayWindow"):
        at = data.index(window + b"\0box2i\0") + len(window) + 7 + 4
        data[at : at + 16] = struct.pack("<4i", 0, 0, 65535, 32767)
    return bytes(data)


def hdr() -> bytes:
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8 +X 16\n" + b"\x80\x80\x80\x81" * 128


def changed(array: np.ndarray, value: float) -> np.ndarray:
    """The array with one element in the middle replaced."""
    array = array.copy()
    array[7, 1] = value
    return array


NAN, FAR = changed(POINTS, np.nan), changed(FACES, len(POINTS))
NO_FACES = FACES[:0]

BAD_MESHES: dict[str, tuple[str, Callable[[], bytes | str], str]] = {
    "empty": ("m.obj", lambda: b"", "empty (0 bytes)"),
    "empty ply": ("m.ply", lambda: b"", "empty (0 bytes)"),
    "unknown suffix": ("m.fbx", lambda: obj(), "expected one of .obj"),
    "no suffix": ("m", lambda: obj(), "expected one of .obj"),
    "truncated ply": ("m.ply", lambda: ply(order="<")[:-5], "claims 80"),
    "truncated stl": ("m.stl", lambda: stl()[:-5], "claims 80 triangles"),
    "not finite obj": ("m.obj", lambda: obj(NAN), "not finite"),
    "not finite ply": ("m.ply", lambda: ply(NAN, order="<"), "not finite, the first is vertex 7"),
    "not finite stl": ("m.stl", lambda: stl(NAN), "not finite"),
    "far index obj": ("m.obj", lambda: obj(faces=FAR), "(vertices are 1 to 42)"),
    "far index ascii ply": ("m.ply", lambda: ply(faces=FAR), "(vertices are 0 to 41)"),
    "far index ply": ("m.ply", lambda: ply(faces=FAR, order="<"), "(vertices are 0 to 41)"),
    "far index big ply": ("m.ply", lambda: ply(faces=FAR, order=">"), "(vertices are 0 to 41)"),
    "far index off": ("m.off", lambda: off(faces=FAR), "(vertices are 0 to 41)"),
    "far index glb": (
        "m.glb",
        lambda: gltf(faces=FAR, binary=True),
        "out of range, the first is 42",
    ),
    "far index gltf": (
        "m.gltf",
        lambda: gltf(faces=FAR, binary=False),
        "out of range, the first is 42",
    ),
    "negative index ply": (
        "m.ply",
        lambda: ply(faces=changed(FACES, -1), order="<"),
        "the first is -1 in face 7",
    ),
    "no faces obj": ("m.obj", lambda: obj(faces=NO_FACES), "has no faces"),
    "no faces ply": ("m.ply", lambda: ply(faces=NO_FACES), "has no faces"),
    "no faces off": ("m.off", lambda: off(faces=NO_FACES), "has no faces"),
}

BAD_LIGHTS: dict[str, tuple[str, Callable[[], bytes | str], str]] = {
    "empty exr": ("l.exr", lambda: b"", "empty (0 bytes)"),
    "truncated exr": ("l.exr", lambda: exr("l.exr")[:-40], "truncated"),
    "header of an exr": ("l.exr", lambda: exr("l.exr")[:60], "truncated"),
    "2^31 pixels": ("l.exr", lambda: huge_exr("l.exr"), "claims 65536 x 32768 pixels"),
    "not finite exr": ("l.exr", lambda: exr("l.exr", np.nan), "the first at (row, col) = (3, 5)"),
    "infinite exr": ("l.exr", lambda: exr("l.exr", np.inf), "not finite"),
    "negative exr": ("l.exr", lambda: exr("l.exr", -1e-3), "are negative, the first at"),
    "truncated hdr": ("l.hdr", lambda: hdr()[:-40], "truncated"),
    "header of an hdr": ("l.hdr", lambda: hdr()[:30], "truncated"),
    "unknown suffix": ("l.png", lambda: exr("l.exr"), "expected"),
}

BAD_CONFIGURATIONS = {
    "lobes without harmonics": (
        ["representations=[zonal_lobes]", "transfer.light_basis=cube"],
        "representation",
        "zonal_lobes need transfer.light_basis=sh, got cube",
    ),
    "prior of too many": (
        [
            "fit.metric=light_prior",
            "transfer.light_basis=cube",
            "transfer.resolution=32",
            "transfer.light_resolution=32",
        ],
        "fit.metric",
        "at most 2048 light coefficients, cube 6x32x32 has 6144",
    ),
    "unknown key": (["sceen.mesh=m.obj"], "sceen.mesh", "expected one of scene, material, light"),
    "unknown nested key": (["scene.mash=m.obj"], "scene.mash", "expected one of mesh, ground"),
    "unknown representation": (["representation=spca"], "representation", "expected one of"),
    "unknown in a list": (["representations=[spca]"], "representations", "expected one of"),
    "wrong type": (["representation.rank=two"], "representation.rank", "valid integer"),
    "rank 0": (["representation.rank=0"], "representation.rank", "equal to 1, got 0"),
    "negative clusters": (["representation.num_clusters=-4"], "num_clusters", "equal to 1, got -4"),
    "odd visibility": (["transfer.resolution=3", "transfer.supersampling=1"], "transfer", "even"),
    "no memory for the order": (
        ["transfer.order=40", "transfer.resolution=32", "memory_budget=16777216"],
        "memory_budget",
        "got 16777216",
    ),
    "one light twice": (["light.test=[sky,sky]"], "light.test", "expected different lights"),
    "one name twice": (["light.test=[sky,sky.exr]"], "light.test", "expected different lights"),
    "one representation twice": (
        ["representations=[{name:cpca,rank:2},{name:cpca,rank:2}]"],
        "representations",
        "expected different ones",
    ),
    "no light to expect": (["fit.metric=light_prior", "light.fit=[]"], "light.fit", "at least one"),
    "black light to expect": (
        ["fit.metric=light_prior", "light.fit=[black.exr]"],
        "light.fit",
        "not black",
    ),
    "unknown light": (["light.test=[moon]"], "moon", "neither a file nor one of"),
    "unknown option": (["--fast"], "--fast", "unknown option"),
    "unknown configuration": (["--config-name=fast"], "--config-name=fast", "expected one of"),
    "flattened": (["scene.transform=[[1,0],[0,1]]"], "scene.transform", "4 rows of 4"),
    "one folder, two runs": (["-m", "seed=1,2", "out=out"], "out", "several runs"),
}


def arguments(*more: str, mesh: str = "ball.obj") -> list[str]:
    return [f"scene.mesh={mesh}", "out=out", *TINY, *more]


def tree(folder: Path = Path()) -> dict[str, bytes | None]:
    """Every file and folder, with what files hold."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


def check_line(line: str, *mentioned: str) -> None:
    assert line.startswith("error: ")
    assert line.endswith("\n")
    assert line.count("\n") == 1
    assert "Traceback" not in line
    for words in mentioned:
        assert words in line


def refuse(capfd, script: Path, given: list[str], *mentioned: str) -> None:
    """Status 2, one line on the descriptor of standard error, and no file more or less."""
    before = tree()
    capfd.readouterr()
    assert MAINS[script](given) == 2
    check_line(capfd.readouterr().err, *mentioned)
    assert tree() == before


def run(script: Path, *given: str, folder: Path = Path()) -> subprocess.CompletedProcess[str]:
    """A real process."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, str(script), *given],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )


def check_manifest(out: Path) -> None:
    """The manifest lists every other file of a run folder, with its size and hash."""
    manifest = json.loads((out / store.MANIFEST).read_text())
    files = {name: data for name, data in tree(out).items() if data is not None}
    assert set(manifest["files"]) == set(files) - {store.MANIFEST}
    for name, entry in manifest["files"].items():
        assert entry["bytes"] == len(files[name])
        assert entry["sha256"] == hashlib.sha256(files[name]).hexdigest(), name


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """A folder in which a process has done a whole run; not to be changed."""
    folder = tmp_path_factory.mktemp("finished")
    (folder / "ball.obj").write_text(obj())
    done = run(FIT, *arguments(), folder=folder)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert "report: out/report.html" in done.stdout
    return folder


class TestWholeRun:
    def test_report_has_the_keys_of_the_design(self, finished):
        report = json.loads((finished / "out/report.json").read_text())
        keys = {"scene", "light", "bake", "raw_bytes", "left_out", "solves", "results"}
        assert set(report) == keys
        scene = {"mesh", "points", "faces", "material", "rows", "channels"}
        assert set(report["scene"]) - {"warnings"} == scene
        assert set(report["light"]) == {"basis", "coeffs"}
        assert set(report["bake"]) == {"seconds", "rays", "cached"}
        for entry in report["left_out"]:
            assert set(entry) in ({"what", "why", "saved_bytes"}, {"what", "why", "saved_seconds"})
        (result,) = report["results"]
        assert set(result) - {"dense_scaled"} == {
            "name",
            "representation",
            "parameters",
            "status",
            "fit_seconds",
            "bytes",
            "transfer_error",
            "reference_error",
            "radiance_error",
            "condition",
            "relight_seconds",
            "coherence",
            "dense_seconds",
            "peak_bytes",
        }

    def test_report_says_what_was_asked_for(self, finished):
        report = json.loads((finished / "out/report.json").read_text())
        points = len(POINTS) + 64  # the ground has 8 x 8
        assert report["scene"]["mesh"] == "ball"
        assert report["scene"]["points"] == points
        assert report["scene"]["faces"] == len(FACES) + 2 * 49
        assert report["light"] == {"basis": "SH order 3", "coeffs": 9}
        assert report["raw_bytes"] == (9 + 3) * 4 * points  # ball and ground differ in colour
        assert report["bake"]["cached"] is False
        (result,) = report["results"]
        assert result["representation"] == "cpca"
        assert result["parameters"] == {"num_clusters": 8, "rank": 2}
        assert set(result["radiance_error"]) == {"sky"}
        assert 0 < result["transfer_error"] < result["reference_error"] < 1
        assert 0 < result["bytes"] < report["raw_bytes"]

    def test_result_is_what_the_report_says(self, finished):
        report = json.loads((finished / "out/report.json").read_text())
        (path,) = (finished / "out/results").glob("*.safetensors")
        representation = prt_torch.load(path)
        assert representation.num_points == report["scene"]["points"]
        result = report["results"][0]
        assert sum(representation.storage().values()) == result["bytes"]
        mesh = prt_torch.load_mesh(finished / "ball.obj")
        ground = prt_torch.ground_plane(mesh, resolution=8)
        scene = prt_torch.concatenate([mesh, ground], "ball")
        basis = prt_torch.bases.SphericalHarmonics(3)
        transfer = prt_torch.bake(scene, light_basis=basis, resolution=4, supersampling=2)
        lost = (representation.dense().detach().double() - transfer.dense()).square().sum()
        error = float(lost / transfer.dense().double().square().sum())
        assert error == pytest.approx(result["transfer_error"], rel=1e-6)

    def test_files(self, finished):
        check_manifest(finished / "out")
        files = set(tree(finished / "out"))
        assert {"config.yaml", "report.html", "report.json", "manifest.json"} <= files
        pictures = {name for name in files if name.startswith("pictures/")}
        assert {"pictures/sky-uncompressed.exr", "pictures/sky-uncompressed.png"} <= pictures
        for suffix in (".exr", ".png", "-difference.png"):
            assert f"pictures/sky-cpca-8x2{suffix}" in pictures
        with OpenEXR.File(str(finished / "out/pictures/sky-uncompressed.exr")) as image:
            assert image.channels()["RGB"].pixels.shape == (24, 32, 3)
        assert not [name for name in tree(finished) if ".writing-" in name or "checkpoint" in name]

    def test_page_needs_nothing_beside_it(self, finished):
        page = (finished / "out/report.html").read_text()
        assert "cpca 8x2" in page
        assert not re.search(r"""(?:src|href)=["'](?!data:|#)""", page)

    def test_second_start_takes_what_is_there(self, monkeypatch, capsys, finished):
        shutil.copytree(finished, ".", dirs_exist_ok=True)
        before = tree()

        def refuse_to_work(*_, **__):
            raise AssertionError("fitted again")

        monkeypatch.setattr("prt_torch.run.fit", refuse_to_work)
        monkeypatch.setattr("prt_torch.solves.STIFF", 1.0)
        assert MAINS[FIT](arguments()) == 0
        told = "stiff: cpca 8x2: closed form: condition 1.9e+00 may cost 0.3 of the 15.7 digits"
        assert f"warning: {told}" in capsys.readouterr().out
        after = tree()
        assert after.keys() == before.keys()
        timed = {"out/report.json", "out/report.html", "out/manifest.json"}
        assert {name for name in after if after[name] != before[name]} <= timed
        report = json.loads(after["out/report.json"])
        assert report["bake"]["cached"] is True
        earlier = json.loads(before["out/report.json"])
        first, again = (one["solves"][0] for one in (earlier, report))
        assert first["warning"] is None
        assert told in again["warning"]
        assert {**first, "warning": again["warning"]} == again
        timings = ("relight_seconds", "dense_seconds")
        for result in (report["results"][0], earlier["results"][0]):
            assert all(result.pop(key) > 0 for key in timings)
        assert report["results"] == earlier["results"]
        check_manifest(Path("out"))

    def test_files_of_others_in_the_folder_are_left_alone(self, finished):
        shutil.copytree(finished, ".", dirs_exist_ok=True)
        write("out/notes.txt", "mine")
        assert MAINS[FIT](arguments()) == 0
        assert Path("out/notes.txt").read_text() == "mine"
        assert "notes.txt" not in Path("out/manifest.json").read_text()

    def test_grid(self, capfd, finished):
        shutil.copytree(finished / "cache", "cache")
        write("ball.obj", obj())
        given = [argument for argument in arguments() if not argument.startswith("out=")]
        assert MAINS[FIT](["-m", *given, "representation.rank=1,2"]) == 0
        reports = [json.loads(path.read_text()) for path in Path("runs").glob("*/report.json")]
        assert all(folder.name.startswith("ball-") for folder in Path("runs").iterdir())
        ranks = [report["results"][0]["parameters"]["rank"] for report in reports]
        assert sorted(ranks) == [1, 2]
        errors = dict(zip(ranks, (r["results"][0]["transfer_error"] for r in reports), strict=True))
        assert errors[2] < errors[1]
        assert capfd.readouterr().err == ""

    def test_several_representations_in_one_run(self):
        write("ball.obj", obj())
        several = "representations=[{name:cpca,num_clusters:8,rank:1},{name:cpca,num_clusters:4}]"
        assert MAINS[FIT](arguments(several)) == 0
        report = json.loads(Path("out/report.json").read_text())
        assert [result["name"] for result in report["results"]] == ["cpca 8x1", "cpca 4x4"]
        check_manifest(Path("out"))

    def test_all_frequency_glossy(self):
        """Segmented CPCA and wavelets of one bake in BRDF factors; started again, it reads them."""
        write("ball.obj", obj())
        chosen = (
            "transfer=haar",
            "transfer.rows=4",
            "material.glossy={name: ggx, f0: 0.5, roughness: 0.4}",
            "representation=segmented_cpca",
            "representations=[{name: segmented_cpca, rank: 4, points_per_cluster: 20},"
            " {name: wavelet, num_terms: 16}]",
        )
        kept = [one for one in TINY if not one.startswith("representation.")]
        reports = []
        for _ in range(2):
            assert MAINS[FIT](["scene.mesh=ball.obj", "out=out", *kept, *chosen]) == 0
            reports.append(json.loads(Path("out/report.json").read_text()))
        first, second = reports
        assert first["results"][0]["transfer_error"] < 0.05
        assert [one["bytes"] for one in first["results"]] == [
            one["bytes"] for one in second["results"]
        ]
        assert first["scene"]["rows"] == 4
        assert 0 < first["bake"]["factor_error"] < 1
        assert second["bake"]["cached"] is True
        assert any("segment" in entry["what"] for entry in first["left_out"])
        check_manifest(Path("out"))

    def test_radial_basis_functions(self):
        """Clustered tensors and scattered functions of one glossy bake of two materials."""
        write("ball.obj", obj())
        chosen = (
            "scene.ground=true",
            "scene.ground_resolution=4",
            "transfer=srbf",
            "transfer.light_centers=42",
            "transfer.rows=4",
            "material.glossy={name: ggx, f0: 0.5, roughness: 0.4}",
            "representation=clustered_tensor",
            "representations=[{name: clustered_tensor, num_clusters: 4, ranks: [4, 12, 8]},"
            " {name: scattered_srbf, num_clusters: 2, num_functions: 8, resolution: 4}]",
        )
        dropped = ("representation.", "scene.ground")
        kept = [one for one in TINY if not one.startswith(dropped)]
        for _ in range(2):
            assert MAINS[FIT](["scene.mesh=ball.obj", "out=out", *kept, *chosen]) == 0
        report = json.loads(Path("out/report.json").read_text())
        tensors, scattered = report["results"]
        assert report["light"] == {"basis": "SRBF 42 gaussian", "coeffs": 42}
        assert 0 < tensors["transfer_error"] < scattered["transfer_error"] < 0.3
        assert tensors["transfer_error"] < tensors["reference_error"] < 0.3
        assert tensors["coherence"]["overdraw"] >= 1
        check_manifest(Path("out"))

    def test_bake_then_fit(self, capfd):
        write("my ball = round.obj", obj())
        mesh = "'my ball = round.obj'"
        assert MAINS[BAKE](arguments(mesh=mesh)) == 0
        assert "106 points, SH order 3" in capfd.readouterr().out
        assert {path.name for path in Path().iterdir()} == {"my ball = round.obj", "cache"}
        baked = tree(Path("cache"))
        assert MAINS[FIT](arguments(mesh=mesh)) == 0
        assert tree(Path("cache")) == baked
        report = json.loads(Path("out/report.json").read_text())
        assert report["bake"]["cached"] is True
        assert report["scene"]["mesh"] == "my ball = round"

    def test_black_light_and_surfaces_that_see_nothing(self):
        write("ball.obj", obj(faces=FACES[:, ::-1]))
        with OpenEXR.File(
            {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage},
            {"RGB": np.zeros((8, 16, 3), np.float32)},
        ) as file:
            file.write("black.exr")
        given = arguments("scene.ground=false", "light.test=[black.exr,sky]")
        assert MAINS[FIT](given) == 0
        (result,) = json.loads(Path("out/report.json").read_text())["results"]
        assert result["radiance_error"] == {"black": 0.0, "sky": 0.0}
        assert result["transfer_error"] == 0.0


class TestBadInput:
    @pytest.mark.parametrize("case", BAD_MESHES)
    def test_mesh(self, capfd, case):
        name, content, expected = BAD_MESHES[case]
        write(name, content())
        refuse(capfd, FIT, arguments(mesh=name), name, expected)

    def test_mesh_that_is_not_there_or_a_folder(self, capfd):
        Path("folder.obj").mkdir()
        for script in (FIT, BAKE):
            refuse(capfd, script, arguments(mesh="gone.obj"), "gone.obj", "no such mesh file")
            refuse(capfd, script, arguments(mesh="folder.obj"), "folder.obj", "is a folder")

    @pytest.mark.parametrize("case", BAD_LIGHTS)
    def test_light(self, capfd, case):
        name, content, expected = BAD_LIGHTS[case]
        write("ball.obj", obj())
        write(name, content())
        refuse(capfd, FIT, arguments(f"light.test=[{name}]"), name, expected)
        refuse(capfd, FIT, arguments(f"light.fit=[{name}]"), name, expected)

    def test_light_that_is_not_there(self, capfd):
        write("ball.obj", obj())
        refuse(
            capfd, FIT, arguments("light.test=[gone.hdr]"), "gone.hdr", "neither a file nor one of"
        )

    @pytest.mark.parametrize("case", BAD_CONFIGURATIONS)
    def test_configuration(self, capfd, case):
        given, key, expected = BAD_CONFIGURATIONS[case]
        write("ball.obj", obj())
        exr("sky.exr")
        exr("black.exr", rest=0.0)
        for script in (FIT, BAKE):
            refuse(capfd, script, arguments(*given), key, expected)

    def test_what_only_the_bake_can_tell(self, capfd):
        """Codes of three channels, of transfer that has one."""
        write("ball.obj", obj())
        wanted = "representations=[{name: wavelet, codes: 11/11/10}]"
        assert MAINS[FIT](arguments(wanted, "scene.ground=false")) == 2
        *_, last = capfd.readouterr().err.splitlines()
        assert last.startswith("error: wavelet 96 11/11/10: expected three channels")

    def test_processes(self):
        write("ball.obj", obj())
        write("far.glb", gltf(faces=FAR, binary=True))
        write("huge.exr", huge_exr("huge.exr"))
        before = tree()
        for script, given, name in (
            (BAKE, arguments(mesh="far.glb"), "far.glb"),
            (FIT, arguments("light.test=[huge.exr]"), "huge.exr"),
            (REPORT, ["gone"], "gone"),
        ):
            done = run(script, *given)
            assert done.returncode == 2
            check_line(done.stderr, name)
            assert done.stdout == ""
        assert tree() == before


class TestOutputFolder:
    @pytest.fixture(autouse=True)
    def _ball(self):
        write("ball.obj", obj())

    @pytest.mark.parametrize("key", ["out", "cache"])
    def test_file_in_its_place(self, capfd, key):
        write("taken", "something else")
        for folder in ("taken", "taken/inside"):
            refuse(capfd, FIT, arguments(f"{key}={folder}"), folder, "cannot be made")

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write into read-only folders")
    def test_read_only(self, capfd):
        Path("locked").mkdir(mode=0o555)
        refuse(capfd, FIT, arguments("out=locked"), "locked", "not writable")
        refuse(capfd, FIT, arguments("out=locked/inside"), "locked", "cannot be made")

    def test_in_use_by_another_run(self, capfd):
        with store.locked(Path("out")):
            refuse(capfd, FIT, arguments(), "out", "in use by another run")
            refuse(capfd, REPORT, [str(self.reported("a")), "--out=out"], "out", "in use")

    def test_belongs_to_another_run(self, capfd, finished):
        shutil.copytree(finished / "out", "out")
        for other in ("seed=1", "representation.rank=1", "light.test=[sunset]"):
            refuse(capfd, FIT, arguments(other), "out", "holds another run")

    def test_results_of_a_mesh_that_was_changed_since(self, capfd, finished):
        shutil.copytree(finished / "out", "out")
        write("ball.obj", obj(POINTS * [1, 1, 1.01]))
        refuse(capfd, FIT, arguments(), "out", "holds another run")

    def test_damaged_result(self, capfd, finished):
        shutil.copytree(finished, ".", dirs_exist_ok=True)
        (path,) = Path("out/results").glob("*.safetensors")
        data = bytearray(path.read_bytes())
        data[-1] ^= 1
        path.write_bytes(data)
        refuse(capfd, FIT, arguments(), str(path), "damaged")

    def test_full_disk_harms_nothing(self, capfd, monkeypatch, finished):
        shutil.copytree(finished, ".", dirs_exist_ok=True)
        original = Path.write_bytes

        def write_some(path: Path, data: bytes) -> int:
            original(path, bytes(data)[:10])
            raise OSError(28, os.strerror(28))

        monkeypatch.setattr(Path, "write_bytes", write_some)
        refuse(capfd, FIT, arguments(), "out", "No space left on device")
        refuse(capfd, FIT, arguments("transfer.order=2", "out=new"), "No space left on device")

    def test_interrupted_run_goes_on(self, capfd, monkeypatch):
        def stop(*_, **__):
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr("prt_torch.run.write_report", stop)
            assert MAINS[FIT](arguments()) == 130
        assert capfd.readouterr().err == "interrupted; start the same command again to go on\n"
        assert not Path("out/report.json").exists()
        assert MAINS[FIT](arguments()) == 0
        check_manifest(Path("out"))

    @staticmethod
    def reported(name: str) -> Path:
        parts = ("scene", "light", "bake", "raw_bytes", "left_out", "results")
        store.write_json(Path(name) / "report.json", {key: [] for key in parts})
        return Path(name)


class TestReport:
    @pytest.mark.parametrize("content", [b"", b'{"scene": {', b"\xff\xfe\x00"])
    def test_damaged_report(self, capfd, content):
        Path("run").mkdir()
        write("run/report.json", content)
        refuse(capfd, REPORT, ["run", "--out=all"], "run/report.json", "not a JSON file")

    @pytest.mark.parametrize("content", [b"{}", b"[]", b'{"results": []}'])
    def test_json_that_is_no_report(self, capfd, content):
        Path("run").mkdir()
        write("run/report.json", content)
        refuse(capfd, REPORT, ["run", "--out=all"], "run/report.json", "not the report of a run")

    def test_no_run_or_the_same_run_twice(self, capfd):
        for runs in ([], ["run", "./run"]):
            refuse(capfd, REPORT, [*runs, "--out=all"], "different run folders", f"{len(runs)}")

    def test_missing_report(self, capfd):
        Path("run").mkdir()
        for folder in ("run", "gone"):
            refuse(capfd, REPORT, [folder, "--out=all"], f"{folder}/report.json", "cannot be read")

    def test_unknown_option(self, capfd):
        refuse(capfd, REPORT, ["run", "--output=all"], "--output=all", "usage: ")
        refuse(capfd, REPORT, ["run", "--out=./run"], "--out=run", "own report would be lost")

    def test_two_runs(self, capfd, finished):
        write("ball.obj", obj())
        assert MAINS[FIT](arguments("representation.rank=1", "out=other")) == 0
        given = [str(finished / "out"), "other", "--out=all"]
        assert MAINS[REPORT](given) == 0
        assert set(tree(Path("all"))) == {"report.html", "report.json"}
        gathered = json.loads(Path("all/report.json").read_text())
        assert [result["parameters"]["rank"] for result in gathered["results"]] == [2, 1]
        assert len(gathered["runs"]) == 2
        page = Path("all/report.html").read_text()
        assert all(result["name"] in page for result in gathered["results"])
