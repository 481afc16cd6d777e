"""The report shows every result, escapes what it is given, and needs nothing but itself."""

import io
import itertools
import json
import math
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from rich.console import Console

from prt_torch.preview import encode_png
from prt_torch.report import (
    Picture,
    error_against_bytes,
    error_against_time,
    gather,
    solves_table,
    summary_table,
    write_html,
)
from prt_torch.report import numbers as text
from prt_torch.report.labels import place_labels
from prt_torch.report.outcome import endings, outcomes, uncompressed_reference_error
from prt_torch.report.plots import DARK

RAW_BYTES = 7104 * 64 * 4


def make_result(name: str, size: int, error: float | None, **more) -> dict:
    result = {
        "name": name,
        "representation": name.split()[0],
        "parameters": {"num_clusters": 64, "rank": 8},
        "status": "converged",
        "fit_seconds": 12.5,
        "bytes": size,
        "transfer_error": error,
        "reference_error": None if error is None else 0.02 + 0.98 * error,
        "radiance_error": {"beach": 0.0123, "<galileo>": 0.0456},
        "condition": 1.5e5,
        "relight_seconds": 2e-9 * size,
        "dense_seconds": 8e-3,
        "peak_bytes": 3 * size,
    }
    return result | more


def make_solve(what: str, **more) -> dict:
    known = {"condition": 1.5e5, "digits_lost": 5.18, "dtype": "float64", "warning": None}
    return {"what": what, "status": "solved", **known, **more}


def make_report(results: list[dict]) -> dict:
    return {
        "scene": {
            "mesh": "knot & ground.obj",
            "points": 7104,
            "faces": 14018,
            "material": "diffuse",
            "rows": 1,
            "channels": 1,
            "warnings": [{"name": "open", "count": 3, "message": "3 edges <have> one face"}],
        },
        "light": {"basis": "SH order 8", "coeffs": 64},
        "bake": {"seconds": 12.3, "rays": 174587904, "cached": False},
        "raw_bytes": RAW_BYTES,
        "left_out": [
            {"what": "colour channels", "why": "colour factors out", "saved_bytes": 3637248},
            {"what": "interreflection", "why": "adds < 0.1 %", "saved_seconds": 41.2},
        ],
        "solves": [
            make_solve("exit basis: Gram matrix"),
            make_solve("light [b]", status="regularised", condition=None, warning="stiff: <so>"),
            make_solve("cpca: refinement", status="max_steps", condition=None, digits_lost=None),
        ],
        "results": results,
    }


@pytest.fixture
def report() -> dict:
    families = ("cpca", "zonal_lobes", "wavelet")
    return make_report(
        [
            make_result(f"{family} rank={rank} [b]", 20000 * rank, 0.1 / rank**2)
            for family, rank in itertools.product(families, (2, 4, 8, 16))
        ]
    )


@pytest.fixture
def quick_plots(monkeypatch):
    """Blank plots, for tests of what stands round them."""
    png = encode_png(np.zeros((2, 2, 3), np.uint8))
    for name in ("error_against_bytes", "error_against_time"):
        monkeypatch.setattr(f"prt_torch.report.page.{name}", lambda *_, **__: png)


class Page(HTMLParser):
    """Text, references and table rows of a page."""

    def __init__(self, source: str):
        super().__init__()
        self.texts: list[str] = []
        self.references: list[str] = []
        self.tags: list[str] = []
        self.feed(source)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        names = ("src", "href", "srcset", "action", "data", "poster")
        self.references += [value or "" for name, value in attrs if name in names]

    def handle_data(self, data):
        self.texts.append(data)


def write_page(path, report: dict, pictures=()) -> str:
    write_html(path, report, pictures)
    return path.read_text(encoding="utf-8")


@pytest.mark.usefixtures("quick_plots")
def test_page_contains_every_result_and_fact(tmp_path, report):
    page = Page(write_page(tmp_path / "report.html", report))
    for result in report["results"]:
        assert page.texts.count(result["name"]) == 1
    for solve in report["solves"]:
        assert {solve["what"], solve["status"]} <= set(page.texts)
    whole = " ".join(page.texts)
    for fact in ("7,104", "174,587,904", "SH order 8", "3 edges <have> one face", "stiff: <so>"):
        assert fact in whole
    for entry in report["left_out"]:
        assert entry["what"] in page.texts
        assert entry["why"] in page.texts
    assert "3.47 MiB" in page.texts
    assert "41.2 s" in page.texts
    assert page.texts.count("1.23 %") == len(report["results"])


def test_page_refers_to_nothing_outside_itself(tmp_path, report):
    picture = Picture("a", "b", encode_png(np.zeros((2, 2, 3), np.uint8)), "sky")
    source = write_page(tmp_path / "report.html", report, [picture])
    page = Page(source)
    assert len(page.references) == 5, "two plots in two colour schemes, and a picture"
    assert all(reference.startswith("data:image/png;base64,") for reference in page.references)
    assert not re.search(r"https?://|url\(|@import|\bfetch\b", source)
    assert "link" not in page.tags
    assert "default-src 'none'" in source


@pytest.mark.usefixtures("quick_plots")
def test_page_escapes_all_text(tmp_path):
    hostile = '<img src="x" onerror="alert(1)">&amp;\'"'
    report = make_report([make_result(hostile, 1000, 0.1, representation=hostile, status=hostile)])
    report["results"][0]["parameters"] = {hostile: hostile}
    report["results"][0]["radiance_error"] = {hostile: 0.1}
    report["scene"]["mesh"] = report["scene"]["material"] = report["light"]["basis"] = hostile
    report["scene"]["warnings"][0]["message"] = hostile
    report["left_out"] = [{"what": hostile, "why": hostile, "saved_bytes": 1}]
    report["solves"] = [make_solve(hostile, status=hostile, warning=hostile)]
    plain = Page(write_page(tmp_path / "plain.html", make_report([make_result("a", 1000, 0.1)])))
    png = encode_png(np.zeros((2, 2, 3), np.uint8))
    picture = Picture(hostile, hostile, png, hostile)
    page = Page(write_page(tmp_path / "report.html", report, [picture]))
    assert page.tags.count("img") == plain.tags.count("img") + 1
    assert page.tags.count("script") == 1
    # Parsed back, the text is what was given, in each of the places.
    assert sum(hostile in piece for piece in page.texts) >= 12


@pytest.mark.usefixtures("quick_plots")
def test_pictures_stand_by_group_in_order_with_their_scale(tmp_path, report):
    png = encode_png(np.zeros((2, 2, 3), np.uint8))
    pictures = [
        Picture("first", "", png, "sky"),
        Picture("second", "", png, "beach"),
        Picture("third", "", png, "sky", scale=0.0321),
    ]
    texts = Page(write_page(tmp_path / "report.html", report, pictures)).texts
    order = [texts.index(name) for name in ("sky", "first", "third", "0.0321", "beach", "second")]
    assert order == sorted(order)


def shape_of(png: bytes) -> tuple[int, int]:
    image = Image.open(io.BytesIO(png))
    image.load()
    assert image.format == "PNG"
    return image.size


STRANGE = {
    "no result": [],
    "one result": [make_result("cpca", 5000, 0.1)],
    "zero error": [make_result("cpca", 5000, 0.0), make_result("wavelet", 9000, 1e-3)],
    "all errors zero": [make_result("cpca", 5000, 0.0)],
    "missing error": [make_result("cpca", 5000, None), make_result("wavelet", 9000, 1e-3)],
    "NaN error": [make_result("cpca", 5000, math.nan), make_result("wavelet", 9000, 1e-3)],
    "only NaN": [make_result("cpca", 5000, math.nan, relight_seconds=math.nan)],
    "infinite": [make_result("cpca", 5000, math.inf, condition=math.inf)],
    "no lights": [make_result("cpca", 5000, 0.1, radiance_error={})],
    "equal points": [make_result(f"cpca {index}", 5000, 0.1) for index in range(15)],
    "extreme": [make_result("a", 1, 1e-300), make_result("b", 10**15, 1e10)],
    "mathematical": [make_result("$x^{", 5000, 0.1), make_result("_a", 6000, 0.2)],
}


@pytest.mark.usefixtures("quick_plots")
@pytest.mark.parametrize("results", STRANGE.values(), ids=STRANGE.keys())
def test_everything_is_drawn_from_strange_results(tmp_path, results):
    report = make_report(results)
    for plot in (error_against_bytes, error_against_time):
        assert min(shape_of(plot(report))) > 400
    page = Page(write_page(tmp_path / "report.html", report))
    for result in results:
        assert result["name"] in page.texts
    visible = " ".join(page.texts[page.texts.index("Results") :])
    assert not re.search(r"\b(nan|inf)\b", visible, re.IGNORECASE)
    assert summary_table(report).row_count == len(results)


def drawn_texts(monkeypatch, plot, report) -> list[str]:
    """Names that a plot places in its left panel."""
    placed: list[list[str]] = []

    def remember(_, anchors, **__):
        placed.append([name for *_, name in anchors])

    monkeypatch.setattr("prt_torch.report.plots.place_labels", remember)
    plot(report)
    return placed[0]


@pytest.mark.parametrize("plot", [error_against_bytes, error_against_time])
def test_plots_name_every_result_and_the_uncompressed_tensor(monkeypatch, report, plot):
    names = [result["name"] for result in report["results"]]
    report["results"][0]["transfer_error"] = None
    assert drawn_texts(monkeypatch, plot, report) == [*names[1:], "uncompressed"]


def test_uncompressed_tensor_is_drawn_at_its_bytes_and_time(monkeypatch, report):
    anchors: list = []
    monkeypatch.setattr(
        "prt_torch.report.plots.place_labels", lambda _, found, **__: anchors.extend(found)
    )
    error_against_bytes(report)
    error_against_time(report)
    costs = [x for x, _, name in anchors if name == "uncompressed"]
    assert costs == [RAW_BYTES, RAW_BYTES, 8e-3, 8e-3]
    count = len(report["results"]) + 1
    for panel in (anchors[:count], anchors[count : 2 * count]):
        heights = [y for _, y, _ in panel]
        assert panel[-1][2] == "uncompressed"
        assert heights[-1] < min(heights[:-1]), "an error of 0 lies below all others"


def test_dark_plots_differ_only_in_colour(report):
    light, dark = error_against_bytes(report), error_against_bytes(report, palette=DARK)
    assert shape_of(light) == shape_of(dark)
    assert np.asarray(Image.open(io.BytesIO(light)).convert("L")).mean() > 200
    assert np.asarray(Image.open(io.BytesIO(dark)).convert("L")).mean() < 60


def test_labels_of_a_dozen_crowded_points_do_not_overlap():
    figure = Figure(figsize=(6, 5), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set(xlim=(0, 1), ylim=(0, 1))
    places = np.random.default_rng(0).uniform(0.4, 0.6, (14, 2))
    anchors = [(float(x), float(y), f"representation {i}") for i, (x, y) in enumerate(places)]
    place_labels(axes, anchors, ink="black", halo="white", leader="grey")
    renderer = canvas.get_renderer()
    names = [label for label in axes.texts if label.get_text()]
    boxes = [label.get_window_extent(renderer) for label in names]
    assert len(boxes) == 14
    for first, second in itertools.combinations(boxes, 2):
        width = min(first.x1, second.x1) - max(first.x0, second.x0)
        height = min(first.y1, second.y1) - max(first.y0, second.y0)
        assert min(width, height) < 1.0
    frame = axes.get_window_extent(renderer)
    assert all(frame.x0 <= box.x0 and box.x1 <= frame.x1 for box in boxes)


def test_table_holds_every_value(report):
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(summary_table(report))
    lines = console.export_text().splitlines()
    line = next(line for line in lines if "wavelet rank=4 [b]" in line)
    speed_up = 8e-3 / (2e-9 * 80000)
    expected = ["78.1 KiB", f"{RAW_BYTES / 80000:.1f}×", "6.25e-03", "2.61e-02", "1.23 %"]
    expected += ["4.56 %", "12.5 s", "160 µs", f"{speed_up:.1f}×", "converged"]
    assert re.split(r"\s{2,}", line.strip())[1:] == expected


def test_solves_are_told_with_what_they_cost(report):
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(solves_table(report))
    lines = console.export_text(styles=True).splitlines()[3:6]
    found = [re.split(r"\s{2,}", re.sub(r"\x1b\[[\d;]*m", "", line).strip()) for line in lines]
    assert found == [
        ["exit basis: Gram matrix", "1.50e+05", "5.2", "solved"],
        ["light [b]", "–", "5.2", "regularised"],
        ["cpca: refinement", "–", "–", "max_steps"],
    ]
    report["solves"][0]["warning"] = "stiff"
    report["solves"][2]["status"] = "nonfinite"
    assert [one.rating for one in endings(report)] == ["warn", "warn", "bad"]


@pytest.mark.usefixtures("quick_plots")
def test_gathered_runs_keep_their_own_facts_and_distinct_names(tmp_path):
    first = make_report([make_result("cpca", 5000, 0.1), make_result("wavelet", 9000, 0.01)])
    second = make_report([make_result("cpca", 7000, 0.2), make_result("zonal_lobes", 100, 0.3)])
    second["raw_bytes"] = 2 * RAW_BYTES
    second["light"]["basis"] = "Haar 8"
    before = json.dumps([first, second])
    joint = gather([first, second], ["sh", "haar"])
    assert json.dumps([first, second]) == before
    rows = outcomes(joint)
    assert [row.name for row in rows] == ["sh: cpca", "wavelet", "haar: cpca", "zonal_lobes"]
    assert [row.ratio for row in rows] == pytest.approx(
        [RAW_BYTES / 5000, RAW_BYTES / 9000, 2 * RAW_BYTES / 7000, 2 * RAW_BYTES / 100]
    )
    page = Page(write_page(tmp_path / "report.html", joint))
    for expected in ("sh: scene", "haar: scene", "SH order 8", "Haar 8", "sh: cpca", "haar: cpca"):
        assert expected in page.texts
    assert {"sh: colour channels", "haar: exit basis: Gram matrix"} <= set(page.texts)
    assert summary_table(joint).row_count == 4
    with pytest.raises(ValueError, match="distinct name"):
        gather([first, second], ["a", "a"])


def test_joint_plots_compare_against_the_full_resolution(monkeypatch):
    first = make_report([make_result("cpca", 5000, 0.1)])
    second = make_report([make_result("wavelet", 5000, 0.1, reference_error=None)])
    joint = gather([first, second])
    # The second has no reference error, so its point is left out, not drawn by another measure.
    assert "wavelet" not in drawn_texts(monkeypatch, error_against_bytes, joint)


def test_loss_of_the_light_basis_follows_from_both_errors():
    full, lost, error = 7.0, 0.5, 0.3
    result = make_result(
        "cpca",
        1,
        error / (full - lost),
        reference_error=(lost + error) / full,
    )
    rows = outcomes(make_report([result]))
    assert uncompressed_reference_error(rows) == pytest.approx(lost / full)
    assert uncompressed_reference_error([]) is None


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        (text.bytes_text(0), "0 B"),
        (text.bytes_text(1023), "1023 B"),
        (text.bytes_text(1536), "1.50 KiB"),
        (text.bytes_text(1024**2 - 1), "1024 KiB"),
        (text.bytes_text(5 * 1024**6), "5242880 TiB"),
        (text.bytes_text(None), "–"),
        (text.seconds_text(0.0123), "12.3 ms"),
        (text.seconds_text(0.9999), "1.00 s"),
        (text.seconds_text(3.2e-7), "320 ns"),
        (text.seconds_text(99.96), "100 s"),
        (text.seconds_text(600), "10 min"),
        (text.seconds_text(9000), "2.5 h"),
        (text.error_text(0.000123456), "1.23e-04"),
        (text.error_text(0.0), "0"),
        (text.percent_text(0.012345), "1.23 %"),
        (text.percent_text(1.23e-7), "1.2e-05 %"),
        (text.percent_text(0.0), "0 %"),
        (text.factor_text(12.345), "12.3×"),
        (text.factor_text(0.5), "0.500×"),
        (text.factor_text(12345.6), "12346×"),
        (text.count_text(1234567), "1,234,567"),
    ],
)
def test_numbers_read_well(shown, expected):
    assert shown == expected
