"""Fronts, equal costs, the waterfall, and the page that shows them."""

import math
import re

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from prt_torch.report.tradeoff import write_tradeoff
from prt_torch.report.tradeoff_svg import bars, plot, told
from prt_torch.tradeoff import Stage, at_equal, error_of, front, fronts, waterfall, within

COORDINATES = st.tuples(st.integers(1, 8), st.integers(1, 8))


@settings(max_examples=200, derandomize=True, deadline=None)
@given(st.lists(COORDINATES, max_size=20))
def test_front_is_what_nothing_beats(points):
    def beaten(one):
        return any(all(a <= b for a, b in zip(o, one, strict=True)) and o != one for o in points)

    kept = [points[place] for place in front(points)]
    assert set(kept) == {one for one in points if not beaten(one)}
    assert len(kept) == len(set(kept))
    assert kept == sorted(kept)


def result(name, family, size, error, *, light=None, **more):
    lights = {"a": error**0.5, "b": 3 * error**0.5} if light is None else light
    return {
        "name": name,
        "representation": family,
        "parameters": {"rank": 1},
        "bytes": size,
        "transfer_error": error,
        "reference_error": error + 0.1,
        "radiance_error": lights,
        "fit_seconds": 1.0,
        "relight_seconds": 1e-3,
        "light_seconds": 1e-3,
        "view_seconds": 1e-4,
        "peak_bytes": 1000,
        **more,
    }


RESULTS = [
    result("x1", "x", 100, 1e-2),
    result("x2", "x", 400, 1e-4, read_off={"rank": 2}),
    result("y1", "y<&", 200, 1e-3),
    result("y2", "y<&", 300, 2e-3),
]


def test_fronts_of_all_and_of_each_family():
    found = fronts(RESULTS, "bytes", "transfer_error")
    assert found == {"joint": ["x1", "y1", "x2"], "x": ["x1", "x2"], "y<&": ["y1"]}
    unknown = [*RESULTS, result("z", "z", None, 1e-9), result("w", "w", 1, 1e-9, light={})]
    assert fronts(unknown, "bytes", "mean_radiance_error") == found
    assert error_of(RESULTS[0], "mean_radiance_error") == pytest.approx(0.2)


def test_least_within_limits():
    def error(one):
        return one["transfer_error"]

    assert within(RESULTS, {"bytes": 350}, error)["name"] == "y1"
    assert within(RESULTS, {"bytes": 350, "transfer_error": 5e-4}, error) is None
    assert within(RESULTS, {"mean_radiance_error": 0.03}, lambda one: one["bytes"])["name"] == "x2"


def test_equal_levels_are_the_lowest_that_all_families_reach():
    level, chosen = at_equal(RESULTS, "bytes", "transfer_error")
    assert level == 200
    assert [one["name"] for one in chosen] == ["x1", "y1"]
    level, chosen = at_equal(RESULTS, "transfer_error", "transfer_error")
    assert level == 1e-3
    assert [one["name"] for one in chosen] == ["x2", "y1"]


@settings(max_examples=60, derandomize=True, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 7), st.floats(-4, 3))
def test_differences_add_up_exactly(seed, count, magnitude):
    generator = torch.Generator().manual_seed(seed)
    truth = torch.randn(30, generator=generator, dtype=torch.float64)
    noise = torch.randn(count, 30, generator=generator, dtype=torch.float64) * 10**magnitude
    together = {str(at): truth + noise[: at + 1].sum(0) for at in range(count)}
    stages = waterfall(truth, together, {"0": truth + noise[0]})
    total = 0.0
    for one in stages:
        total += one.difference
    assert total == stages[-1].error  # not nearly: exactly
    assert math.fsum(one.difference for one in reversed(stages)) == stages[-1].error
    expected = float(noise.sum(0).square().sum() / truth.square().sum())
    assert stages[-1].error == pytest.approx(expected, rel=1e-6)
    assert stages[0].alone == pytest.approx(stages[0].error, rel=1e-6)
    assert all(one.alone is None for one in stages[1:])


def test_an_error_that_another_takes_back_is_negative():
    truth = torch.ones(4)
    stages = waterfall(truth, {"clusters": torch.zeros(4), "rank": 0.9 * truth}, {})
    assert [one.difference > 0 for one in stages] == [True, False]
    assert stages[-1].error == pytest.approx(0.01, rel=1e-5)
    with pytest.raises(ValueError, match="at least one stage"):
        waterfall(truth, {}, {})


def test_black_and_exact():
    stages = waterfall(torch.zeros(3), {"a": torch.zeros(3)}, {"a": torch.zeros(3)})
    assert (stages[0].error, stages[0].alone) == (0.0, 0.0)


# ---- the page


def centres(svg: str) -> dict[str, tuple[float, float]]:
    found = {}
    for tag in re.findall(r"<(?:circle|polygon)[^>]*data-name[^>]*>", svg):
        name = re.search(r'data-name="([^"]*)"', tag)[1]
        numbers = re.search(r'cx="([\d.]+)" cy="([\d.]+)"|translate\(([\d.]+) ([\d.]+)\)', tag)
        found[name] = tuple(float(one) for one in numbers.groups() if one)
    return found


def test_places_are_logarithmic():
    svg = plot(RESULTS, "bytes", "transfer_error")
    at = centres(svg)
    assert set(at) == {"x1", "x2", "y1", "y2"}
    across = (at["x2"][0] - at["x1"][0]) / (at["y1"][0] - at["x1"][0])
    assert across == pytest.approx(2.0, rel=0.01)  # 100, 200, 400
    assert at["x2"][1] > at["y1"][1] > at["x1"][1]  # less error is further down
    assert svg.count("mark family0 read") == 1
    assert "y&lt;&amp;" in plot([{**RESULTS[2], "name": "y<&"}], "bytes", "transfer_error")


def test_a_point_tells_its_figures():
    line = told(RESULTS[1])
    for part in ("x2 (rank 1)", "read off a larger fit", "storage 400 B", "1.00e-04", "2.00 %"):
        assert part in line


@pytest.mark.parametrize("cost", [1.0, 1.2, 8.4, 8.8, 9.5, 99.0])
def test_costs_that_are_all_alike_have_ticks(cost):
    drawn = plot([result("a", "a", 1, 0.1, fit_seconds=cost)], "fit_seconds", "transfer_error")
    assert drawn.count('class="grid"') >= 6


def test_nothing_to_plot_is_said():
    assert "no result has both" in plot([result("a", "a", 1, 0.0)], "bytes", "transfer_error")


def test_bars_are_as_long_as_what_they_stand_for():
    stages = [Stage("a<", 0.5, 0.5, 0.5), Stage("b", 0.25, -0.25, None)]
    svg = bars(stages)
    widths = [
        float(one) for one in re.findall(r'class="(?:more|less|total)"[^>]*width="([\d.]+)', svg)
    ]
    assert widths[0] == pytest.approx(2 * widths[1], rel=0.01)
    assert widths[1] == pytest.approx(widths[2], rel=0.01)
    assert "a&lt;" in svg


def test_page_is_one_file_and_escapes(tmp_path):
    report = {
        "scene": {"mesh": "<b>", "points": 3, "material": "m", "rows": 1, "channels": 1},
        "light": {"basis": "SH", "coeffs": 9},
        "raw_bytes": 1000,
        "results": RESULTS,
        "left_out": [{"what": "<bands>", "why": "nothing there", "saved_bytes": 7}],
        "failed": [{"what": "<w>", "why": "no"}],
        "budget": {"asked": "1 MiB", "name": "x1", "why": ["<because>"]},
    }
    stages = [Stage("noise", 0.5, 0.5, 0.5)]
    write_tradeoff(tmp_path / "page.html", report, stages=stages, stages_of="Of x1.")
    page = (tmp_path / "page.html").read_text()
    assert not re.search(r'(src|href)="(?!data:)', page)
    for raw in ("<b>", "<w>", "<because>", "<bands>"):
        assert raw not in page
        assert raw.replace("<", "&lt;").replace(">", "&gt;") in page
    assert page.count('data-name="x1"') >= 13  # twelve plots and the table
    assert "x1 ★" in page
    assert "y2 ★" not in page
