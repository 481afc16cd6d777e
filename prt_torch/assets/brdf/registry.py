"""The one place where a description becomes a model."""

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any

from prt_torch.assets.brdf.ashikhmin_shirley import AshikhminShirley
from prt_torch.assets.brdf.base import BRDF, AnalyticBRDF
from prt_torch.assets.brdf.cook_torrance import CookTorrance
from prt_torch.assets.brdf.cornell import Cornell
from prt_torch.assets.brdf.ggx import GGX
from prt_torch.assets.brdf.lafortune import Lafortune
from prt_torch.assets.brdf.lambert import Lambert
from prt_torch.assets.brdf.measured import MeasuredBRDF
from prt_torch.assets.brdf.merl import MERL
from prt_torch.assets.brdf.phong import BlinnPhong, Phong
from prt_torch.assets.brdf.rgl import RGL
from prt_torch.assets.brdf.schlick import Schlick
from prt_torch.assets.brdf.sum import Sum
from prt_torch.errors import InputError

NAMES = (
    "lambert",
    "phong",
    "blinn_phong",
    "cook_torrance",
    "schlick",
    "ashikhmin_shirley",
    "lafortune",
    "ggx",
    "sum",
)
"""What a description's ``name`` may be for a model that is a formula."""

MEASURED_NAMES = ("rgl", "cornell", "merl")
"""What it may be for a file of measurements; its other parameter is the ``path``."""


def brdf(description: Mapping[str, Any]) -> BRDF:
    """The model that a plain description stands for, the inverse of :meth:`BRDF.describe`.

    Args:
        description: ``name`` and the model's parameters; colours may be lists.

    Raises:
        InputError: If the name or a key is unknown, a key is missing, a value out of range, or a
            file missing, malformed or not the one described.
    """
    return _build("brdf", description)


def _build(key: str, description: object) -> BRDF:
    if not isinstance(description, Mapping):
        raise InputError(f"{key}: expected a name and parameters, got {description!r}")
    parameters = dict(description)
    name = parameters.pop("name", None)
    model = _model(key, name)
    if model is Sum and isinstance(parameters.get("parts"), (list, tuple)):
        parts = enumerate(parameters["parts"])
        parameters["parts"] = tuple(_build(f"{key}.parts[{i}]", part) for i, part in parts)
    known = {field.name: field.default is MISSING for field in fields(model)}
    for parameter in parameters:
        if parameter not in known:
            raise InputError(
                f"{key}.{parameter}: unknown parameter of {name}; choose from {', '.join(known)}"
            )
    for parameter, required in known.items():
        if required and parameter not in parameters:
            raise InputError(f"{key}.{parameter}: missing; {name} needs it")
    try:
        return model(**parameters)
    except InputError:
        raise  # about a file, which its line names
    except ValueError as error:
        raise InputError(f"{key}.{error}") from None


def _model(key: str, name: object) -> type[AnalyticBRDF | MeasuredBRDF]:
    match name:
        case "lambert":
            return Lambert
        case "phong":
            return Phong
        case "blinn_phong":
            return BlinnPhong
        case "cook_torrance":
            return CookTorrance
        case "schlick":
            return Schlick
        case "ashikhmin_shirley":
            return AshikhminShirley
        case "lafortune":
            return Lafortune
        case "ggx":
            return GGX
        case "sum":
            return Sum
        case "rgl":
            return RGL
        case "cornell":
            return Cornell
        case "merl":
            return MERL
        case _:
            known = ", ".join(NAMES + MEASURED_NAMES)
            raise InputError(f"{key}.name: expected one of {known}, got {name!r}")
