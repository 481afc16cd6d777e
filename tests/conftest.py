"""Fixtures that several test files share."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch


@pytest.fixture(scope="session")
def assets() -> Path:
    """Folder of the real meshes, environments and materials, which are not part of the project."""
    default = Path(__file__).resolve().parent.parent.parent / "shared" / "assets"
    folder = Path(os.environ.get("PRT_TORCH_ASSETS", default))
    if not (folder / "meshes").is_dir():
        pytest.skip("real assets are absent: set PRT_TORCH_ASSETS to their folder")
    return folder


@pytest.fixture(autouse=True)
def _whatever_ran_before() -> Iterator[None]:
    """The same random numbers in any order of tests, and nothing left behind for the next one."""
    torch.manual_seed(0)
    before = _global_state()
    yield
    assert _global_state() == before


def _global_state() -> dict[str, Any]:
    return {
        "threads": torch.get_num_threads(),
        "dtype": torch.get_default_dtype(),
        "gradients": torch.is_grad_enabled(),
        "inference": torch.is_inference_mode_enabled(),
        "deterministic": torch.are_deterministic_algorithms_enabled(),
        "folder": Path.cwd(),
    }


@pytest.fixture
def without_type_checker(request: pytest.FixtureRequest) -> None:
    """For tests that pass wrong types on purpose, which jaxtyping's plug-in refuses first."""
    if request.config.getoption("jaxtyping_packages", default=None):
        pytest.skip("annotations are checked at run time")
