"""From a scene to its transfer tensor."""

from prt_torch.baking.direct import project_diffuse
from prt_torch.baking.glossy import project_glossy
from prt_torch.baking.groove import groove_transfer
from prt_torch.baking.interreflection import Bounces, interreflect
from prt_torch.baking.patch import bake_patch
from prt_torch.baking.projection import check_memory
from prt_torch.baking.reflection import (
    RESOLVED,
    Reflection,
    diffuse_reflection,
    glossy_reflection,
    project_brdf,
)
from prt_torch.baking.scene import Stages, bake
from prt_torch.baking.subsurface import scatter
from prt_torch.baking.visibility import Progress, VisibilityField, trace_visibility

__all__ = [
    "RESOLVED",
    "Bounces",
    "Progress",
    "Reflection",
    "Stages",
    "VisibilityField",
    "bake",
    "bake_patch",
    "check_memory",
    "diffuse_reflection",
    "glossy_reflection",
    "groove_transfer",
    "interreflect",
    "project_brdf",
    "project_diffuse",
    "project_glossy",
    "scatter",
    "trace_visibility",
]
