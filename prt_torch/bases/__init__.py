"""Light bases and exit bases, and the closed list of their names."""

from typing import Any

from prt_torch.bases import sh
from prt_torch.bases.base import ExitBasis, LightBasis, Radiance
from prt_torch.bases.cube import CubeDirections
from prt_torch.bases.exit import Diffuse, HemisphericalHarmonics, Rowwise
from prt_torch.bases.sh import SphericalHarmonics
from prt_torch.errors import InputError

__all__ = [
    "CubeDirections",
    "Diffuse",
    "ExitBasis",
    "HemisphericalHarmonics",
    "LightBasis",
    "Radiance",
    "Rowwise",
    "SphericalHarmonics",
    "exit_basis",
    "light_basis",
    "sh",
]


def light_basis(description: dict[str, Any]) -> LightBasis:
    """The light basis that :meth:`LightBasis.describe` described."""
    match description:
        case {"name": "sh", "order": int(order)}:
            return SphericalHarmonics(order)
        case {"name": "cube", "resolution": int(resolution)}:
            return CubeDirections(resolution)
        case _:
            raise InputError(f"light basis: expected sh or cube, got {description}")


def exit_basis(description: dict[str, Any]) -> ExitBasis:
    """The exit basis that :meth:`ExitBasis.describe` described."""
    match description:
        case {"name": "diffuse"}:
            return Diffuse()
        case {"name": "hemispherical", "num_rows": int(num_rows)}:
            return HemisphericalHarmonics(num_rows)
        case {"name": "rows", "num_rows": int(num_rows)}:
            return Rowwise(num_rows)
        case _:
            raise InputError(
                f"exit basis: expected diffuse, hemispherical or rows, got {description}"
            )
