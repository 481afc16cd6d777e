"""Strict readers of mesh files, one a format.

General loaders repair what they read: in the one that this project's preview uses, an OBJ index 0
becomes vertex 0, a PLY index -1 stays and wraps when it is used, and truncated ASCII files give
the faces that were left. Transfer is stored per vertex, so a repair moves data. These readers
keep the file's vertices, their number and order, and refuse the rest in one line.
"""

from collections.abc import Callable
from pathlib import Path

from prt_torch.assets.mesh_formats.gltf import read_gltf
from prt_torch.assets.mesh_formats.obj import read_obj
from prt_torch.assets.mesh_formats.off import read_off
from prt_torch.assets.mesh_formats.ply import read_ply
from prt_torch.assets.mesh_formats.raw import RawMesh, RawPart, finite_normals
from prt_torch.assets.mesh_formats.stl import read_stl

READERS: dict[str, Callable[[Path, bytes], RawMesh]] = {
    ".obj": read_obj,
    ".ply": read_ply,
    ".stl": read_stl,
    ".off": read_off,
    ".glb": read_gltf,
    ".gltf": read_gltf,
}
"""Reader of each file name suffix, in lower case."""

__all__ = ["READERS", "RawMesh", "RawPart", "finite_normals"]
