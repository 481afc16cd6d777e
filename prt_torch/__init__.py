"""Fit, compress and relight precomputed radiance transfer.

Mesh and light go in; a transfer tensor is baked, a small representation of it fitted, and a
differentiable module relights it::

    import prt_torch

    transfer = prt_torch.bake(prt_torch.procedural_scene())
    model = prt_torch.representations.CPCA.from_transfer(transfer)
    radiance = prt_torch.Relighter(model)(prt_torch.find_environment("sky"))
"""

from prt_torch import bases, representations, sphere
from prt_torch.assets import (
    Environment,
    Mesh,
    concatenate,
    find_environment,
    ground_plane,
    load_environment,
    load_mesh,
    procedural_scene,
)
from prt_torch.baking import bake
from prt_torch.errors import InputError
from prt_torch.fitting import FitResult, fit
from prt_torch.metric import Metric
from prt_torch.relight import Relighter
from prt_torch.representations import load, save
from prt_torch.transfer import Surface, TransferTensor

__version__ = "0.1.0"

__all__ = [
    "Environment",
    "FitResult",
    "InputError",
    "Mesh",
    "Metric",
    "Relighter",
    "Surface",
    "TransferTensor",
    "bake",
    "bases",
    "concatenate",
    "find_environment",
    "fit",
    "ground_plane",
    "load",
    "load_environment",
    "load_mesh",
    "procedural_scene",
    "representations",
    "save",
    "sphere",
]
