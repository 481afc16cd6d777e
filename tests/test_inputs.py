"""What a run reads: a folder of results belongs to what the files held, not to their names."""

from pathlib import Path

import pytest

from prt_torch.config import load_config
from prt_torch.errors import InputError
from prt_torch.inputs import Inputs, load_inputs
from prt_torch.sweep.execution import _claim
from prt_torch.transfer import TransferTensor

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
CORNERS = ((0, 0, 0), (1, 0, 0), (0, 0, -1), (0, 1, 0), (1, 1, 0), (0, 1, -1))


def two_triangles(path: Path, *, parts=("low", "high"), red: float = 0.5) -> Inputs:
    """One part glossy, the other not; read anew, by the same configuration."""
    corners = "".join(f"v {x} {y} {z} {red} 0.5 0.5\n" for x, y, z in CORNERS)
    path.write_text(f"{corners}o {parts[0]}\nf 1 2 3\no {parts[1]}\nf 4 5 6\n")
    glossy = "{glossy: {name: ggx, roughness: 0.4, f0: 0.5}}"
    given = [f"scene.mesh={path}", "scene.ground=false", f"+material.parts.low={glossy}"]
    return load_inputs(load_config(CONFIGS, "fit", given))


def test_digest_follows_what_files_held(tmp_path):
    path = tmp_path / "two.obj"
    digests = [
        two_triangles(path).digest(),
        two_triangles(path, parts=("high", "low")).digest(),
        two_triangles(path, red=0.25).digest(),
    ]
    assert len(set(digests)) == 3
    assert two_triangles(path).digest() == digests[0]


@pytest.mark.parametrize("changed", [{"parts": ("high", "low")}, {"red": 0.25}])
def test_a_sweep_of_a_changed_file_is_another(tmp_path, changed):
    path, config = tmp_path / "two.obj", load_config(CONFIGS, "sweep", [])
    transfer = TransferTensor.from_dense(two_triangles(path).mesh.vertices)
    transfer.provenance["inputs"] = "the same: of the bake of direct light"
    for _ in range(2):
        _claim(tmp_path / "out", config, two_triangles(path), transfer)
    with pytest.raises(InputError, match="holds another sweep"):
        _claim(tmp_path / "out", config, two_triangles(path, **changed), transfer)
