"""What a bake is made of: meshes, environments and materials, validated and frozen."""

from prt_torch.assets.animation import Animation
from prt_torch.assets.deformation import bend, deformed, deformed_frames, twist
from prt_torch.assets.environment import Environment, load_environment
from prt_torch.assets.lights import NAMED, area_lights, constant, find_environment, sky, sunset
from prt_torch.assets.mesh import (
    Mesh,
    Part,
    concatenate,
    load_mesh,
    mesh_from_arrays,
)
from prt_torch.assets.mesh_checks import DEFAULT_ALBEDO, MeshWarning
from prt_torch.assets.procedural import ground_plane, procedural_scene
from prt_torch.assets.rgbe import read_hdr
from prt_torch.assets.skinning import SkinnedMesh, load_skinned

__all__ = [
    "DEFAULT_ALBEDO",
    "NAMED",
    "Animation",
    "Environment",
    "Mesh",
    "MeshWarning",
    "Part",
    "SkinnedMesh",
    "area_lights",
    "bend",
    "concatenate",
    "constant",
    "deformed",
    "deformed_frames",
    "find_environment",
    "ground_plane",
    "load_environment",
    "load_mesh",
    "load_skinned",
    "mesh_from_arrays",
    "procedural_scene",
    "read_hdr",
    "sky",
    "sunset",
    "twist",
]
