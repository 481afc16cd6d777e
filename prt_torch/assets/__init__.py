"""What a bake is made of: meshes, environments and materials, validated and frozen."""

from prt_torch.assets.environment import Environment, load_environment
from prt_torch.assets.lights import NAMED, area_lights, constant, find_environment, sky, sunset
from prt_torch.assets.mesh import (
    DEFAULT_ALBEDO,
    Mesh,
    MeshWarning,
    Part,
    concatenate,
    load_mesh,
    mesh_from_arrays,
)
from prt_torch.assets.procedural import ground_plane, procedural_scene
from prt_torch.assets.rgbe import read_hdr

__all__ = [
    "DEFAULT_ALBEDO",
    "NAMED",
    "Environment",
    "Mesh",
    "MeshWarning",
    "Part",
    "area_lights",
    "concatenate",
    "constant",
    "find_environment",
    "ground_plane",
    "load_environment",
    "load_mesh",
    "mesh_from_arrays",
    "procedural_scene",
    "read_hdr",
    "sky",
    "sunset",
]
