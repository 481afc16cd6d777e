"""Draw textures of lobes on surfaces that deform, as figures 1, 6, 7 of Sloan, Luna, Snyder 2005.

python eval/lobe_textures.py [--out=FOLDER] [--size=PIXELS] [--only=vase,wrinkle,membrane]

Patches (weave, bumps with bounces, a translucent waffle, glossy bumps) are baked periodically,
fitted, and wrapped round a vase that twists and bends; a cylinder has wrinkles whose place and
depth vary; a wing with veins is lit from behind. Prints texels, bytes, times and errors. Every
picture is shaded sample by sample, not by vertices.
"""

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from prt_torch import evaluate
from prt_torch.assets import Environment, Mesh, bend, find_environment, procedural_scene, twist
from prt_torch.assets.brdf import CookTorrance
from prt_torch.assets.material import Material
from prt_torch.assets.medium import Medium
from prt_torch.assets.patches import PATCH_FRAME, Patch, bumps, waffle, weave
from prt_torch.assets.procedural import grid_surface, surface_of_revolution
from prt_torch.assets.tangents import frames_on_faces, tangent_frames
from prt_torch.baking import bake_patch, groove_transfer
from prt_torch.bases import SphericalHarmonics, zonal
from prt_torch.command import main
from prt_torch.errors import InputError
from prt_torch.preview import Camera
from prt_torch.preview.images import automatic_exposure, write_png
from prt_torch.preview.rays import PrimaryHits, trace
from prt_torch.representations import (
    LobeTexture,
    WrinkleMap,
    ZonalLobes,
    membrane_texture,
    towards_viewer,
    wrinkle_texture,
)
from prt_torch.representations.lobe_texture import in_frame
from prt_torch.transfer import TransferTensor

PICTURES = ("vase", "wrinkle", "membrane")
_AT_ONCE = 2**15  # samples shaded together
_TRANSLUCENT = Medium((2.2, 1.9, 1.3), (0.004, 0.012, 0.04))


@main
def draw(arguments: list[str]) -> None:
    """Draw the pictures that were asked for and print the table."""
    folder, size, wanted = Path("runs/lobe_textures"), 480, list(PICTURES)
    for argument in arguments:
        match argument.partition("="):
            case ("--out", "=", path):
                folder = Path(path)
            case ("--size", "=", count) if count.isdigit() and int(count):
                size = int(count)
            case ("--only", "=", names) if set(names.split(",")) <= set(PICTURES):
                wanted = names.split(",")
            case _:
                raise InputError(
                    f"{argument}: expected --out=FOLDER, --size=PIXELS or --only=vase,wrinkle,"
                    "membrane"
                )
    folder.mkdir(parents=True, exist_ok=True)
    table = Table(title="Textures of lobes", title_justify="left")
    for column in ("texture", "texels", "rows", "lobes", "KiB", "raw KiB", "bake s", "fit s"):
        table.add_column(column, justify="right")
    table.add_column("error", justify="right")
    with torch.no_grad():
        if "vase" in wanted:
            draw_vases(folder, size, table)
        if "wrinkle" in wanted:
            draw_wrinkles(folder, size, table)
        if "membrane" in wanted:
            draw_membrane(folder, size)
    Console(width=120).print(table)


@dataclass(frozen=True)
class Kind:
    """A patch, how it is baked and fitted, and how large it lies on the vase."""

    name: str
    patch: Callable[[], Patch]
    bake: Callable[[Patch], TransferTensor]
    lobes: int = 4
    repeats: float = 1.0


def _glossy(patch: Patch) -> TransferTensor:
    """Three rows of BRDF factors, for light of order 4, as the paper's figure 7d."""
    return bake_patch(
        patch,
        materials=Material(lambertian=False, glossy=CookTorrance(0.6, 0.3)),
        light_basis=SphericalHarmonics(4),
        exit_basis="factors",
        num_rows=3,
        supersampling=2,
    )


KINDS = (
    Kind(
        "weave",
        lambda: weave(64),
        lambda patch: bake_patch(patch, supersampling=1),
        repeats=0.5,
    ),
    Kind(
        "bumps, 3 bounces",
        lambda: bumps(32),
        lambda patch: bake_patch(patch, supersampling=1, max_bounces=3),
    ),
    Kind(
        "waffle, translucent",
        lambda: waffle(32),
        lambda patch: bake_patch(
            patch,
            supersampling=1,
            materials=Material(lambertian=False, medium=_TRANSLUCENT, millimetres_per_unit=12.0),
        ),
    ),
    Kind("glossy bumps", lambda: bumps(32, height=0.06), _glossy, lobes=3),
)


def draw_vases(folder: Path, size: int, table: Table) -> None:
    """Each texture on a vase at rest, twisted and bent."""
    vase = procedural_scene("vase")
    poses = [
        vase.vertices,
        bend(twist(vase.vertices, 1.2), 0.5),
        bend(twist(vase.vertices, -0.6), -0.9),
    ]
    light = find_environment("area_lights", rotation_degrees=90)
    cameras = [
        Camera.framing(replace(vase, vertices=pose), elevation_degrees=10, aspect=0.75)
        for pose in poses
    ]
    for kind in KINDS:
        start = time.perf_counter()
        patch = kind.patch()
        transfer = kind.bake(patch)
        baked = time.perf_counter()
        rows, cols = patch.texels.shape
        texture = LobeTexture.from_transfer(transfer, (rows, cols), num_lobes=kind.lobes)
        fitted = time.perf_counter()
        error = evaluate.transfer_error(texture.texels, in_frame(transfer, PATCH_FRAME))
        seconds = baked - start, fitted - baked
        _add(table, kind.name, texture, transfer.num_bytes, seconds, math.sqrt(error))
        images = [
            shade(
                texture,
                replace(vase, vertices=pose),
                camera,
                light,
                size * 3 // 4,
                size,
                uv=lambda uv, kind=kind: uv * kind.repeats,
                two_sided=True,
            )
            for pose, camera in zip(poses, cameras, strict=True)
        ]
        write_strip(folder / f"vase-{kind.name.replace(',', '').replace(' ', '-')}.png", images)


def shade(
    texture: LobeTexture,
    mesh: Mesh,
    camera: Camera,
    light: Environment,
    width: int,
    height: int,
    *,
    uv: Callable[[Tensor], Tensor] = lambda uv: uv,
    two_sided: bool = False,
    across_v: bool = False,
) -> np.ndarray:
    """A picture of a textured mesh, linear; every sample of a pixel is looked up by itself.

    Args:
        texture: What lies on it.
        mesh: In its pose.
        camera: Where from.
        light: Distant light, and the background.
        width: Of the picture [pixels].
        height: Likewise.
        uv: Place on the texture of texture coordinates of the mesh.
        two_sided: Whether frames are turned over where the back is seen.
        across_v: Whether the texture's tangent goes along v of the mesh.
    """
    hits = trace(mesh, camera, width, height, 3)
    frames = tangent_frames(mesh)
    hit = np.flatnonzero(hits.face.reshape(-1) >= 0)
    samples = _background(hits, light)
    coefficients = SphericalHarmonics(texture.texels.order).project(light)[None].float()
    for some in np.array_split(hit, max(1, len(hit) // _AT_ONCE)):
        faces = torch.from_numpy(hits.face.reshape(-1)[some].astype(np.int64))
        weights = torch.from_numpy(hits.weights.reshape(-1, 3)[some])
        views = -torch.from_numpy(hits.directions.reshape(-1, 3)[some])
        where, turned = frames_on_faces(mesh, frames, faces, weights)
        turned = towards_viewer(turned, views) if two_sided else turned
        if across_v:
            turned = torch.stack([turned[:, 1], -turned[:, 0], turned[:, 2]], dim=1)
        place, turned = uv(where).float(), turned.float()
        rows = texture(coefficients, place, turned)[0]
        local = texture.shading_frames(place, turned) @ views[..., None]
        exits = texture.texels.surface.exit_basis.evaluate(local[..., 0])
        exits = exits if exits.ndim == 3 else exits[..., None]
        samples[some] = ((rows * exits).sum(1) * texture.reflectance(place)).numpy()
    return samples.reshape(*hits.face.shape, 3).mean(2).clip(0.0)


def _background(hits: PrimaryHits, light: Environment) -> np.ndarray:
    directions = torch.from_numpy(hits.directions.reshape(-1, 3)).double()
    return light.radiance(directions).float().numpy().copy()


def _add(
    table: Table,
    name: str,
    texture: LobeTexture,
    raw_bytes: int,
    seconds: tuple[float, float],
    error: float,
) -> None:
    """One row: the error is the root of squared error over squared norm."""
    table.add_row(
        name,
        f"{texture.grid.rows} x {texture.grid.cols}",
        str(texture.texels.num_rows),
        str(texture.texels.num_lobes),
        f"{sum(texture.storage().values()) / 1024:.0f}",
        f"{raw_bytes / 1024:.0f}",
        *(f"{taken:.1f}" for taken in seconds),
        f"{error:.4f}",
    )


def draw_wrinkles(folder: Path, size: int, table: Table) -> None:
    """A cylinder with grooves of varying place and depth, straight and bent; and what fits do."""
    wrinkles = WrinkleMap(0.6)
    start = time.perf_counter()
    across, depth = wrinkles.places(2)
    signals, places = groove_transfer(across, depth, 6), wrinkles.uv(across, depth)
    simulated = time.perf_counter()
    texture, _ = wrinkle_texture(wrinkles)
    seconds = simulated - start, time.perf_counter() - simulated
    raw = signals.numel() * 4
    _add(
        table, "wrinkles, fitted together", texture, raw, seconds, _missed(texture, signals, places)
    )
    texels = TransferTensor.from_dense(groove_transfer(*wrinkles.places(1), 6).float())
    start = time.perf_counter()
    alone = ZonalLobes.from_transfer(
        replace(texels, surface=texture.texels.surface), num_lobes=3, bits=None
    )
    seconds = 0.0, time.perf_counter() - start
    for interpolate, what in ((True, "interpolated"), (False, "point-sampled")):
        each = LobeTexture(alone, wrinkles.grid, interpolate=interpolate)
        error = _missed(each, signals, places)
        _add(table, f"wrinkles, each alone, {what}", each, raw, seconds, error)

    def uv(at: Tensor) -> Tensor:
        """Nine grooves along the cylinder, wavy round it, deepest at the front."""
        around, along = 2 * math.pi * at[:, 0], at[:, 1] * 9.0
        place = along + 0.25 * torch.sin(2 * around) + 0.1 * torch.sin(5 * around)
        return wrinkles.uv(torch.remainder(place, 1.0) - 0.5, 0.3 + 0.3 * torch.cos(around))

    # Across the grooves is along the cylinder, so the texture's u is the cylinder's v.
    height = torch.linspace(2.4, 0.0, 97, dtype=torch.float64)
    profile = torch.stack([torch.full_like(height, 0.45), height], dim=-1)
    cylinder = surface_of_revolution("cylinder", profile, 128)
    light, images = find_environment("area_lights", rotation_degrees=90), []
    for angle in (0.0, 0.9):
        posed = replace(cylinder, vertices=bend(cylinder.vertices, angle))
        camera = Camera.framing(posed, azimuth_degrees=0, elevation_degrees=10, aspect=0.75)
        images.append(
            shade(texture, posed, camera, light, size * 3 // 4, size, uv=uv, across_v=True)
        )
    write_strip(folder / "wrinkles.png", images)


def _missed(texture: LobeTexture, signals: Tensor, places: Tensor) -> float:
    """Relative error of what is looked up at many places of the map."""
    looked_up = texture.lobes(places.float())
    filled = torch.nn.functional.pad(looked_up.coefficients, (2, 0))
    values = zonal.lobes_to_sh(looked_up.axes, filled)[:, 0]
    values = torch.cat([looked_up.linear[:, 0], values[:, 4:]], dim=-1)
    return evaluate.radiance_error(values[None], signals[None].float())


def draw_membrane(folder: Path, size: int) -> None:
    """A wing with veins, lit from behind, from in front, and with two transparencies."""
    wing, light = _wing(), find_environment("sunset", rotation_degrees=-115)
    camera = Camera.framing(wing, azimuth_degrees=0, elevation_degrees=4, aspect=4 / 3)
    away = Camera.framing(wing, azimuth_degrees=180, elevation_degrees=4, aspect=4 / 3)
    alpha, reflectance = _veins(256, 384)
    veined = membrane_texture(alpha, reflectance=reflectance)
    opaque = membrane_texture(torch.zeros_like(alpha), reflectance=reflectance)
    images = [
        shade(texture, wing, view, light, size * 4 // 3, size, two_sided=True)
        for texture, view in ((veined, camera), (opaque, camera), (veined, away))
    ]
    write_strip(folder / "membrane.png", images)


def _wing() -> Mesh:
    """A sheet between four fingers that spread from a wrist, hanging through between them."""
    v, u = torch.meshgrid(
        torch.linspace(1.0, 0.0, 96, dtype=torch.float64),
        torch.linspace(0.0, 1.0, 160, dtype=torch.float64),
        indexing="ij",
    )
    angle = math.radians(8.0) - u * math.radians(105.0)
    finger = torch.cos(3 * 2 * math.pi * u)  # 1 at a finger, -1 between two
    reach = (1.0 - v) * (1.6 - 0.5 * u) * (0.86 + 0.14 * finger)
    sag = 0.10 * (1.0 - finger) * (1.0 - v) - 0.25 * (1.0 - v).square()
    return grid_surface(
        "wing", torch.stack([reach * angle.cos(), reach * angle.sin(), sag], dim=-1)
    )


def _veins(rows: int, cols: int) -> tuple[Tensor, Tensor]:
    """Transparency and colour: fingers are opaque, branches between them let little through."""
    v, u = torch.meshgrid(
        1.0 - (torch.arange(rows) + 0.5) / rows, (torch.arange(cols) + 0.5) / cols, indexing="ij"
    )
    out = 1.0 - v
    finger = torch.exp(-((torch.remainder(3 * u + 0.5, 1.0) - 0.5) * (0.3 + out) / 0.045).square())
    wave = 0.06 * torch.sin(11 * out + 5 * u) + 0.03 * torch.sin(23 * out - 9 * u)
    branch = (torch.remainder(9 * u * (0.4 + 0.6 * out) + wave * 6, 1.0) - 0.5).abs() / 0.10
    cross = (torch.remainder(7 * out + 1.5 * torch.sin(9 * u), 1.0) - 0.5).abs() / 0.06
    vein = torch.maximum(torch.exp(-branch.square()), torch.exp(-cross.square()))
    alpha = 0.75 * (1.0 - 0.95 * finger) * (1.0 - 0.6 * vein)
    skin, vessel = torch.tensor([0.52, 0.30, 0.20]), torch.tensor([0.40, 0.10, 0.08])
    bone = torch.tensor([0.30, 0.22, 0.17])
    colour = skin + vein[..., None] * (vessel - skin)
    return alpha, colour + finger[..., None] * (bone - colour)


def write_strip(path: Path, images: list[np.ndarray]) -> None:
    """Pictures side by side at one exposure."""
    strip = np.concatenate(images, axis=1)
    write_png(path, strip, automatic_exposure(strip))


if __name__ == "__main__":
    sys.exit(draw(sys.argv[1:]))
