"""Light bases and exit bases, and the closed list of their names."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from prt_torch.bases import haar, sh, sh_zxzxz, srbf, zonal, zonal_table
from prt_torch.bases.base import ExitBasis, LightBasis, Radiance
from prt_torch.bases.brdf_error import FactorError, factor_error
from prt_torch.bases.brdf_factors import BRDFFactors
from prt_torch.bases.cube import CubeDirections
from prt_torch.bases.exit import Diffuse, HemisphericalHarmonics, Rowwise
from prt_torch.bases.haar import Haar
from prt_torch.bases.hemisphere_map import HemisphereMap
from prt_torch.bases.sh import SphericalHarmonics
from prt_torch.bases.srbf import SRBF, SRBFExpansion
from prt_torch.bases.srbf_fitting import EnvironmentFit, fit_environment
from prt_torch.errors import InputError

__all__ = [
    "SRBF",
    "BRDFFactors",
    "CubeDirections",
    "Diffuse",
    "EnvironmentFit",
    "ExitBasis",
    "FactorError",
    "Haar",
    "HemisphereMap",
    "HemisphericalHarmonics",
    "LightBasis",
    "Radiance",
    "Rowwise",
    "SRBFExpansion",
    "SphericalHarmonics",
    "TexelBasis",
    "exit_basis",
    "factor_error",
    "fit_environment",
    "haar",
    "light_basis",
    "sh",
    "sh_zxzxz",
    "srbf",
    "zonal",
    "zonal_table",
]

TexelBasis = CubeDirections | Haar | SRBF
"""Bases whose transfer comes from the texels of a cube of their own ``resolution``."""


def light_basis(description: dict[str, Any]) -> LightBasis:
    """The light basis that :meth:`LightBasis.describe` described."""
    match description:
        case {"name": "sh", "order": int(order)}:
            return SphericalHarmonics(order)
        case {"name": "cube", "resolution": int(resolution)}:
            return CubeDirections(resolution)
        case {"name": "haar", "resolution": int(resolution), "segment": int(segment)}:
            return Haar(resolution, segment)
        case {
            "name": "srbf",
            "num_centers": int(num_centers),
            "kernel": str(kernel),
            "bandwidth": float(bandwidth),
            "resolution": int(resolution),
        }:
            return SRBF(num_centers, kernel, bandwidth, resolution)  # pyright: ignore[reportArgumentType]
        case _:
            raise InputError(f"light basis: expected sh, cube, haar or srbf, got {description}")


def exit_basis(description: dict[str, Any], tensors: Mapping[str, Tensor]) -> ExitBasis:
    """The exit basis that :meth:`ExitBasis.describe` and :meth:`ExitBasis.tensors` gave."""
    match description:
        case {"name": "diffuse"}:
            return Diffuse()
        case {"name": "hemispherical", "num_rows": int(num_rows)}:
            return HemisphericalHarmonics(num_rows)
        case {"name": "rows", "num_rows": int(num_rows)}:
            return Rowwise(num_rows)
        case {
            "name": "brdf_factors",
            "mapping": str(mapping),
            "resolution": int(resolution),
            "num_constants": int(num_constants),
        }:
            hemisphere = HemisphereMap(mapping, resolution)  # pyright: ignore[reportArgumentType]
            view_values = tensors["view_values"]
            no_lights = view_values.new_zeros(0, len(view_values), hemisphere.num_texels)
            return BRDFFactors(view_values, no_lights, hemisphere, num_constants=num_constants)
        case _:
            raise InputError(
                "exit basis: expected diffuse, hemispherical, rows or brdf_factors, "
                f"got {description}"
            )
