"""The stability suite: its limits bite, no row holds it up, naive formulas turn rows red."""

import importlib
import json
import math
import os
import sys
import time
from pathlib import Path
from types import ModuleType

import pytest
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "eval"))
case = importlib.import_module("stability_case")


def theme(name: str) -> ModuleType:
    """A module of cases; only when wanted, as the runner's process loads this file too."""
    return importlib.import_module(f"stability_{name}")


def fine(dtype: torch.dtype):
    return case.Outcome((case.at_most("error", 0.0, 1.0),), condition=math.inf)


def raises(dtype: torch.dtype):
    raise ArithmeticError("on purpose")


def sleeps(dtype: torch.dtype):
    time.sleep(60)


def dies(dtype: torch.dtype):
    os._exit(3)


def counts(dtype: torch.dtype, seeds: int):
    return case.Outcome((case.exactly("seeds", seeds, 7),))


def row(measure, name: str = "some", seconds: float = 60.0, seeded: bool = False):
    return case.Case(name, "test", "an input", "a result", seconds, measure, seeded)


class TestChecks:
    @pytest.mark.parametrize(
        ("check", "passes"),
        [
            (case.at_most("x", 1.0, 1.0), True),
            (case.at_most("x", 1.0 + 1e-9, 1.0), False),
            (case.at_most("x", -math.inf, 1.0), False),
            (case.at_least("x", torch.tensor(2.0), 2.0), True),
            (case.at_least("x", math.inf, 2.0), False),
            (case.exactly("x", 0.0, 0), True),
            (case.exactly("x", 1e-300, 0), False),
            (case.near("x", -1.01, -1.0, 0.02), True),
            (case.near("x", 1.01, -1.0, 0.02), False),
            (case.Check("x", math.nan), False),
        ],
    )
    def test_limits_and_numbers_that_are_none(self, check, passes):
        assert check.passed is passes
        assert math.isinf(check.strain) is not passes

    def test_an_outcome_needs_checks_and_all_of_them(self):
        good, bad = case.at_most("x", 0.5, 1.0), case.at_most("x", 2.0, 1.0)
        assert case.Outcome((good, good)).passed
        assert not case.Outcome((good, bad)).passed
        assert not case.Outcome(()).passed


def test_no_row_holds_up_the_suite():
    """Errors, endless rows and lost processes are red, and the rows after them are measured."""
    runner = importlib.import_module("stability_runner")
    cases = [
        row(raises),
        row(counts, seeded=True),
        row(sleeps, seconds=0.3),
        row(fine),
        row(dies),
    ]
    with runner.Runner(seeds=7) as running:
        raised, counted, slept, passed, died = running.rows(cases)
    assert [one.passed for one in (raised, counted, slept, passed, died)] == [0, 1, 0, 1, 0]
    assert "raised ArithmeticError at test_stability.py" in raised.failure
    assert raised.failure.count("on purpose") == 2  # both types were tried
    assert "took more than 0.3 s" in slept.failure
    assert "ended its process" in died.failure
    assert set(passed.outcomes) == {"float32", "float64"}


class TestFiles:
    def rows(self):
        runner = importlib.import_module("stability_runner")
        both = {"float32": fine(torch.float32), "float64": fine(torch.float64)}
        wrong = case.Outcome((case.at_most("a < b | c", math.nan, 1.0),))
        return [
            runner.Row(row(fine, "good"), both, "", 0.1),
            runner.Row(row(fine, "bad"), {**both, "float32": wrong}, "", 0.1),
            runner.Row(row(raises, "broken"), {}, "float32: raised", 0.1),
        ]

    def test_all_three_say_the_same(self, tmp_path):
        output = importlib.import_module("stability_output")
        output.write(tmp_path, self.rows(), seeds=3)
        content = json.loads((tmp_path / "stability.json").read_text())
        assert [one["passed"] for one in content["rows"]] == [True, False, False]
        assert content["rows"][0]["condition"] == "inf"
        assert content["rows"][1]["float32"]["checks"][0]["value"] == "nan"
        markdown = (tmp_path / "stability.md").read_text()
        assert "3 cases, 2 red: bad, broken." in markdown
        lines = [line for line in markdown.splitlines() if line.startswith("| ")]
        columns = [line.replace("\\|", "").count("|") for line in lines]
        assert len(lines) == 5
        assert len(set(columns)) == 1
        page = (tmp_path / "stability.html").read_text()
        assert "a &lt; b" in page
        assert "http" not in page.replace("http-equiv", "")

    def test_exit_status(self, tmp_path, monkeypatch, capsys):
        main, rows = importlib.import_module("stability"), self.rows()

        class Told:
            def __init__(self, seeds: int):
                assert seeds == 5

            def __enter__(self):
                return self

            def __exit__(self, *_):
                return None

            def rows(self, cases):
                return iter(rows[: len(list(cases))])

        monkeypatch.setattr(main, "Runner", Told)
        names = list(main.all_cases())
        options = ["--seeds=5", f"--out={tmp_path}"]
        assert main.run([f"--only={names[0]}", *options]) == 0
        with pytest.raises(SystemExit) as red:
            main.run([f"--only={names[0]},{names[1]}", *options])
        assert red.value.code == 1
        for wrong in ("--only=no-such-row", "--seeds=0", "--out=", "--fast"):
            assert main.run([wrong]) == 2
            assert capsys.readouterr().err.count("\n") == 1


def test_every_row_has_a_name_an_input_and_a_limit():
    main = importlib.import_module("stability")
    cases = main.all_cases()
    assert len(cases) == sum(len(one.CASES.cases) for one in main.THEMES)
    for name, one in cases.items():
        assert name == one.name == name.lower()
        assert one.given
        assert one.required
        assert 0 < one.seconds <= 300
    page = (ROOT / "docs" / "stability.md").read_text()
    assert [name for name in cases if f"`{name}`" not in page] == []


QUICK = [
    ("sloan2003", "identical_points"),
    ("liu2004", "roughness"),
    ("wang2004", "opposite_eigenvalues"),
    ("wang2004", "frame_at_the_pole"),
    ("wang2004", "exponent_0_over_0"),
    ("tsai2006", "products_of_extreme_kernels"),
    ("tsai2006", "coincident_centres"),
    ("sloan2005", "axes_at_the_poles"),
    ("sloan2005", "numbers_that_are_none"),
]


@pytest.mark.parametrize("dtype", case.DTYPES, ids=str)
@pytest.mark.parametrize(("module", "name"), QUICK, ids=lambda one: one)
def test_some_rows(module, name, dtype):
    outcome = getattr(theme(module), name)(dtype)
    assert [check.text for check in outcome.checks if not check.passed] == []


@pytest.mark.parametrize("dtype", case.DTYPES, ids=str)
@pytest.mark.parametrize("name", ["least_squares", "gram_matrices", "coincident_lobes"])
def test_some_rows_over_seeds(name, dtype):
    outcome = getattr(theme("fits"), name)(dtype, 8)
    assert [check.text for check in outcome.checks if not check.passed] == []
    assert outcome.condition is not None
    assert outcome.condition > 1e6


class TestNaiveFormulasAreRed:
    def red(self, outcome) -> bool:
        return not outcome.passed

    def test_frame(self, monkeypatch):
        def printed(normal):
            x, y, z = normal.unbind(-1)
            tangent = torch.stack([1 - x * x / (1 + y), -x, -x * z / (1 + y)], dim=-1)
            bitangent = torch.linalg.cross(normal, tangent)
            return torch.stack([tangent, bitangent, normal], dim=-2)

        module = theme("wang2004")
        monkeypatch.setattr(module, "frame_from_normal", printed)
        assert self.red(module.frame_at_the_pole(torch.float64))

    def test_power_iteration(self, monkeypatch):
        def printed(matrix, count):
            values, vectors, rest = [], [], matrix.clone()
            for _ in range(count):
                vector = torch.linspace(0.3, 1.0, len(matrix), dtype=matrix.dtype)
                for _ in range(50):
                    vector = rest @ vector
                    vector = vector / vector.norm()
                values.append(vector @ rest @ vector)
                vectors.append(vector)
                rest = rest - values[-1] * torch.outer(vector, vector)
            return torch.stack(values), torch.stack(vectors, dim=1)

        module = theme("wang2004")
        monkeypatch.setattr(module, "leading_eigenpairs", printed)
        assert self.red(module.opposite_eigenvalues(torch.float64))

    def test_product_of_kernels(self, monkeypatch):
        def printed(center_a, width_a, center_b, width_b):
            r = (width_a * center_a + width_b * center_b).norm()
            return 4 * math.pi * torch.exp(-width_a - width_b) * torch.sinh(r) / r

        module = theme("tsai2006")
        monkeypatch.setattr(module.srbf, "gaussian_inner_product", printed)
        assert self.red(module.products_of_extreme_kernels(torch.float64))

    def test_normal_equations(self, monkeypatch):
        srbf = importlib.import_module("prt_torch.bases.srbf_projection")

        def naive(kernels, values):
            gram = kernels.mT @ kernels
            return srbf.Fit(torch.linalg.pinv(gram) @ (kernels.mT @ values), 1.0)

        module = theme("fits")
        monkeypatch.setattr(module.srbf, "collocation_projection", naive)
        assert self.red(module.least_squares(torch.float64, 8))


class TestWhatTheSuiteFound:
    """Defects of the library that rows showed, mended since."""

    def test_slopes_of_frames_beside_the_pole(self):
        sphere = importlib.import_module("prt_torch.sphere")
        angles = torch.logspace(-30, -1, 100, dtype=torch.float64)
        for dtype in case.DTYPES:
            level = [angles.sin() * 0.6, -angles.cos(), angles.sin() * 0.8]
            normals = torch.stack(level, dim=-1).to(dtype).requires_grad_()
            frames = sphere.frame_from_normal(normals)
            (slopes,) = torch.autograd.grad(frames.sum(), normals)
            assert torch.isfinite(slopes).all()
            identity = torch.eye(3, dtype=dtype).expand_as(frames)
            torch.testing.assert_close(frames @ frames.mT, identity, rtol=0, atol=1e-6)

    def test_steps_that_vanish_in_their_type_are_rounded_up(self):
        quantize = importlib.import_module("prt_torch.quantize")
        steps = torch.tensor([0.0, 3e-47, 1e-45, 2e-45, 1e-3], dtype=torch.float64)
        rounded = quantize.rounded_up(steps, torch.float32)
        assert (rounded.double() >= steps).all()
        assert rounded[:2].tolist() == [0.0, 2.0**-149]
        # No step is larger than the next number above the exact one.
        below = rounded.nextafter(torch.zeros(5))
        assert (below.double()[1:] < steps[1:]).all()

    def test_wavelets_of_the_least_numbers(self):
        module = theme("problems")
        wavelet = importlib.import_module("prt_torch.representations").WaveletTransfer
        values = torch.randn(5, 36, generator=module.generator()) * 1e-43
        model = wavelet.from_transfer(module.transfer_of(values), num_terms=36)
        assert torch.isfinite(model.values).all()
        assert float((model.dense().detach()[:, 0, 0] - values).abs().max()) < 3e-45
