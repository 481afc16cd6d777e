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
    SkinnedMesh,
    bend,
    concatenate,
    deformed,
    deformed_frames,
    find_environment,
    ground_plane,
    load_environment,
    load_mesh,
    load_skinned,
    procedural_scene,
    twist,
)
from prt_torch.assets.tangents import frames_on_faces, tangent_frames
from prt_torch.baking import bake, bake_patch
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
    "SkinnedMesh",
    "Surface",
    "TransferTensor",
    "bake",
    "bake_patch",
    "bases",
    "bend",
    "concatenate",
    "deformed",
    "deformed_frames",
    "find_environment",
    "fit",
    "frames_on_faces",
    "ground_plane",
    "load",
    "load_environment",
    "load_mesh",
    "load_skinned",
    "procedural_scene",
    "representations",
    "save",
    "sphere",
    "tangent_frames",
    "twist",
]
