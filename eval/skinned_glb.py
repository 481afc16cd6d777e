"""Relight a skinned animation by zonal lobes: a strip of pictures, and one of each frame.

python eval/skinned_glb.py [--file=FILE.glb] [--light=NAME] [--frames=24] [--out=FOLDER]

Without a file one is made and kept in the folder: a ridged tentacle of five joints that bends,
coils and twists, with normals, texture coordinates, colours and weights of four joints a point.
Diffuse transfer with shadows is baked once, at rest, and fitted by four lobes. All poses are then
relit in one call. Every fourth frame or so is also baked anew, for its error.
"""

import json
import math
import struct
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64
from rich.console import Console
from scipy.spatial.transform import Rotation
from torch import Tensor

from prt_torch import store
from prt_torch.assets import (
    Mesh,
    SkinnedMesh,
    deformed,
    deformed_frames,
    find_environment,
    load_skinned,
    mesh_from_arrays,
)
from prt_torch.baking import bake
from prt_torch.bases import SphericalHarmonics
from prt_torch.command import main
from prt_torch.errors import InputError
from prt_torch.evaluate import dense_radiance, radiance_error
from prt_torch.preview import Camera, automatic_exposure, encode_png, tone_map, trace
from prt_torch.relight import Relighter
from prt_torch.representations import ZonalLobes
from prt_torch.transfer import TransferTensor

RINGS, SIDES, JOINTS, HEIGHT = 120, 48, 5, 4.0
SECONDS, KEYS = 4.0, 17
ORDER, LOBES = 6, 4
WIDTH, ROWS, STRIP = 240, 320, 6


@main
def animate(arguments: list[str]) -> None:
    """Make or load a file, bake and fit it, relight its animation and write pictures."""
    file, light_name, count, out = None, "sunset", 24, Path("runs/skinned")
    for argument in arguments:
        match argument.partition("="):
            case ("--file", "=", path):
                file = Path(path)
            case ("--light", "=", name):
                light_name = name
            case ("--frames", "=", number) if number.isdigit() and int(number) >= STRIP:
                count = int(number)
            case ("--out", "=", folder):
                out = Path(folder)
            case _:
                raise InputError(
                    f"{argument}: expected --file=FILE.glb, --light=NAME, --frames=N (at least "
                    f"{STRIP}) or --out=FOLDER"
                )
    out.mkdir(parents=True, exist_ok=True)
    if file is None:
        file = out / "tentacle.glb"
        store.write_bytes(file, tentacle())
    skinned = load_skinned(file)
    mesh = skinned.mesh
    console = Console()
    console.print(f"{file}: {mesh.num_points} points, {len(skinned.joint_nodes)} joints")
    transfer = _baked(mesh)
    model = ZonalLobes.from_transfer(transfer, num_lobes=LOBES, effort="fast")
    seconds = torch.arange(count, dtype=torch.float64) * (_duration(skinned) / count)
    relighter, light = Relighter(model), find_environment(light_name)
    with torch.no_grad():
        start = time.perf_counter()
        poses = skinned.pose(skinned.joint_matrices(seconds))
        frames = deformed_frames(mesh, poses)
        posed = time.perf_counter()
        radiance = relighter(light, frames=frames.float())[:, 0]
        done = time.perf_counter()
    console.print(
        f"{count} poses: {(posed - start) / count * 1e3:.1f} ms each to skin and frame, "
        f"{(done - posed) / count * 1e3:.1f} ms to relight"
    )
    _draw(out, skinned, poses, radiance)
    coefficients = relighter.project(light)
    for index in range(0, count, max(1, count // STRIP)):
        anew = _baked(deformed(mesh, poses[index]))
        truth = dense_radiance(anew, coefficients)[0, 0]
        error = radiance_error(radiance[index], truth)
        console.print(f"at {float(seconds[index]):.2f} s: relative error {error:.4f}")


def _baked(mesh: Mesh) -> TransferTensor:
    basis = SphericalHarmonics(ORDER)
    return bake(mesh, light_basis=basis, supersampling=2, cache=".cache/bakes")


def _duration(skinned: SkinnedMesh) -> float:
    if not skinned.animations:
        raise InputError(f"{skinned.source}: has no animation to relight")
    return skinned.animations[0].duration


def _draw(
    out: Path,
    skinned: SkinnedMesh,
    poses: Float64[Tensor, "poses points 3"],
    radiance: Tensor,
) -> None:
    """A picture of each pose, and some of them side by side, seen by one camera."""
    low, high = poses.amin(dim=(0, 1)), poses.amax(dim=(0, 1))
    corners = torch.cartesian_prod(*torch.stack([low, high], dim=1))
    around = mesh_from_arrays("around", corners, torch.tensor([[0, 1, 2], [3, 4, 5], [5, 6, 7]]))
    camera = Camera.framing(around, azimuth_degrees=20.0, aspect=WIDTH / ROWS, margin=1.0)
    pictures, exposure = [], None
    for index, (vertices, lit) in enumerate(zip(poses, radiance, strict=True)):
        hits = trace(deformed(skinned.mesh, vertices), camera, WIDTH, ROWS)
        image = hits.shade(lit)
        exposure = automatic_exposure(image) if exposure is None else exposure
        pictures.append(tone_map(image, exposure))
        store.write_bytes(out / f"frame_{index:03d}.png", encode_png(pictures[-1]))
    chosen = pictures[:: max(1, len(pictures) // STRIP)][:STRIP]
    store.write_bytes(out / "strip.png", encode_png(np.concatenate(chosen, axis=1)))


def tentacle() -> bytes:
    """A GLB file: mesh, skin, chain of joints, and an animation of their rotations."""
    vertices, normals, uv, colours, faces = _surface()
    # Along the chain each point follows the joints around it by a smooth hat of four joints.
    place = vertices[:, 1] / HEIGHT * (JOINTS - 1)
    hat = np.maximum(0.0, 1 - np.abs(place[:, None] - np.arange(JOINTS)) / 1.6) ** 2
    joints = np.argsort(-hat, axis=1, kind="stable")[:, :4]
    weights = np.take_along_axis(hat, joints, axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    step = HEIGHT / (JOINTS - 1)
    inverse = np.tile(np.eye(4), (JOINTS, 1, 1))
    inverse[:, 1, 3] = -step * np.arange(JOINTS)
    times = np.linspace(0.0, SECONDS, KEYS)
    phase = 2 * math.pi * times / SECONDS
    file = _File()
    attributes = {
        "POSITION": file.add(vertices, "VEC3"),
        "NORMAL": file.add(normals, "VEC3"),
        "TEXCOORD_0": file.add(uv * [1, -1] + [0, 1], "VEC2"),  # the format's v runs down
        "COLOR_0": file.add(colours, "VEC3"),
        "JOINTS_0": file.add(joints, "VEC4", "<u2"),
        "WEIGHTS_0": file.add(weights, "VEC4"),
    }
    primitive = {"attributes": attributes, "indices": file.add(faces.ravel(), "SCALAR", "<u4")}
    samplers, channels = [], []
    shared_times = file.add(times, "SCALAR")
    for joint in range(JOINTS):
        swing = 0.5 * np.sin(phase - 0.7 * joint)
        angles = np.stack([0.6 * swing, 0.7 * np.sin(phase), 0.3 * np.cos(phase) - 0.3], axis=1)
        rotations = Rotation.from_euler("xyz", angles * (joint > 0)).as_quat()
        samplers.append({"input": shared_times, "output": file.add(rotations, "VEC4")})
        channels.append({"sampler": joint, "target": {"node": joint + 1, "path": "rotation"}})
    bones = [{"name": f"bone{joint}", "translation": [0, step, 0]} for joint in range(JOINTS)]
    bones[0]["translation"] = [0, 0, 0]
    for joint in range(JOINTS - 1):
        bones[joint]["children"] = [joint + 2]
    matrices = file.add(inverse.transpose(0, 2, 1).reshape(JOINTS, 16), "MAT4")
    return file.finish(
        scenes=[{"nodes": [0, 1]}],
        scene=0,
        nodes=[{"mesh": 0, "skin": 0, "name": "tentacle"}, *bones],
        meshes=[{"primitives": [primitive]}],
        skins=[{"joints": list(range(1, JOINTS + 1)), "inverseBindMatrices": matrices}],
        animations=[{"name": "sway", "samplers": samplers, "channels": channels}],
    )


def _surface() -> tuple[
    Float64[np.ndarray, "points 3"],
    Float64[np.ndarray, "points 3"],
    Float64[np.ndarray, "points 2"],
    Float64[np.ndarray, "points 3"],
    Int64[np.ndarray, "faces 3"],
]:
    """Positions, normals, texture coordinates, colours and faces of the tentacle, tip closed."""
    along, around = np.meshgrid(
        np.linspace(0, 1, RINGS), np.linspace(0, 1, SIDES + 1), indexing="ij"
    )
    angle = 2 * math.pi * around
    taper = 0.55 * (1 - 0.75 * along) * np.sqrt(np.maximum(0.0, 1 - along**8))
    ridges = 1 + 0.16 * np.sin(2 * math.pi * 11 * along) * (1 - along) + 0.1 * np.cos(5 * angle)
    radius = taper * ridges
    shape = [radius * np.cos(angle), HEIGHT * along, -radius * np.sin(angle)]
    vertices = np.stack(shape, axis=-1).reshape(-1, 3)
    corner = (np.arange(RINGS - 1)[:, None] * (SIDES + 1) + np.arange(SIDES)).reshape(-1)
    up = corner + SIDES + 1
    faces = np.concatenate(
        [np.stack([corner, corner + 1, up + 1], 1), np.stack([corner, up + 1, up], 1)]
    )
    # Normals across the seam are those of a mesh without one.
    column = np.arange(len(vertices)) % (SIDES + 1)
    joined = np.where(column == SIDES, np.arange(len(vertices)) - SIDES, np.arange(len(vertices)))
    whole = mesh_from_arrays("whole", torch.from_numpy(vertices), torch.from_numpy(joined[faces]))
    normals = whole.normals.numpy()[joined]
    stripe = (0.5 + 0.5 * np.sin(2 * math.pi * 11 * along)).reshape(-1, 1)
    colours = stripe * [0.85, 0.45, 0.3] + (1 - stripe) * [0.45, 0.15, 0.3]
    uv = np.stack([around, along], axis=-1).reshape(-1, 2)
    return vertices, normals, uv, colours, faces


class _File:
    """A GLB file that grows by accessors."""

    def __init__(self) -> None:
        self._binary = b""
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []

    def add(self, values: np.ndarray, kind: str, dtype: str = "<f4") -> int:
        """Append an accessor; its number."""
        content = np.ascontiguousarray(values, dtype).tobytes()
        code = {"<f4": 5126, "<u2": 5123, "<u4": 5125}[dtype]
        view = {"buffer": 0, "byteOffset": len(self._binary), "byteLength": len(content)}
        accessor = {"componentType": code, "count": len(values), "type": kind}
        if kind in ("VEC3", "SCALAR"):  # required of positions and times, allowed elsewhere
            rows = np.asarray(values, dtype).reshape(len(values), -1)
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self._accessors.append({"bufferView": len(self._views), **accessor})
        self._views.append(view)
        self._binary += content + b"\0" * (-len(content) % 4)
        return len(self._accessors) - 1

    def finish(self, **document: Any) -> bytes:
        """The whole file, with the rest of its document."""
        document |= {
            "asset": {"version": "2.0"},
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": len(self._binary)}],
        }
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        body = struct.pack("<I", len(text)) + b"JSON" + text
        body += struct.pack("<I", len(self._binary)) + b"BIN\0" + self._binary
        return b"glTF" + struct.pack("<II", 2, len(body) + 12) + body


if __name__ == "__main__":
    sys.exit(animate(sys.argv[1:]))
