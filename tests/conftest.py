"""Fixtures that several test files share."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def assets() -> Path:
    """Folder of the real meshes, environments and materials, which are not part of the project."""
    default = Path(__file__).resolve().parent.parent.parent / "shared" / "assets"
    folder = Path(os.environ.get("PRT_TORCH_ASSETS", default))
    if not (folder / "meshes").is_dir():
        pytest.skip("real assets are absent: set PRT_TORCH_ASSETS to their folder")
    return folder


@pytest.fixture
def without_type_checker(request: pytest.FixtureRequest) -> None:
    """For tests that pass wrong types on purpose, which jaxtyping's plug-in refuses first."""
    if request.config.getoption("jaxtyping_packages", default=None):
        pytest.skip("annotations are checked at run time")
