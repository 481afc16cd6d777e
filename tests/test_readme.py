"""The README's Python example runs as printed."""

import re
from pathlib import Path
from typing import Any

import pytest

README = Path(__file__).resolve().parent.parent / "README.md"


def test_the_example_runs_as_printed(tmp_path, monkeypatch, capsys):
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert blocks, "README.md has no Python example"
    monkeypatch.chdir(tmp_path)
    exec(compile(blocks[0], "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert re.search(r"squared error \d\.\d\de-0[23]", printed)
    assert (tmp_path / "knot.safetensors").exists()


def test_the_example_of_a_deforming_surface_runs():
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    (block,) = [one for one in blocks if "deformed_frames" in one]
    names: dict[str, Any] = {}
    exec(compile(block, "README.md", "exec"), names)
    assert names["radiance"].shape == (1, 1, names["scene"].num_points, 3)
    assert bool((names["radiance"] > -0.1).all())


@pytest.mark.parametrize("link", re.findall(r"\]\(((?!http)[^)#]+)\)", README.read_text()))
def test_links_lead_somewhere(link):
    assert (README.parent / link).exists()
