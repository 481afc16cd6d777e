"""Relight bent and twisted meshes by zonal lobes, beside baking them anew and simpler ways.

python eval/deformation.py [--mesh=FILE] [--deform=bend|twist] [--degrees=90] [--lobes=4]
                           [--effort=default|fast] [--lights=NAME,...]
                           [--supersampling=N] [--out=FOLDER]

Diffuse transfer with shadows in harmonics of order 6 is baked at rest. The mesh, deformed along the
longest edge of its box, is lit by

  lobes       that transfer as zonal lobes, turned by the frames of the points
  SH turned   the same transfer uncompressed, each point's harmonics turned exactly
  rigid SH    the same transfer, not turned
  unshadowed  the clamped cosine around the deformed normal
  linear      one lobe along the linear band of the transfer, turned (optimal linear lobe)

and compared with transfer that is baked on the deformed mesh: relative RMS errors of radiance over
all points. The error of lobes has two sides: what the fit loses, lobes against SH turned, and what
turning cannot know, SH turned against the truth: shadows of distant parts, that move, appear or go.
Squared, they add up but for a small mixed term; the last columns are their shares.

Lights are named ones and files of env/ in PRT_TORCH_ASSETS (or ../shared/assets) where there are
any. Pictures (--out) show, from left to right, the truth, lobes, SH turned, rigid SH, unshadowed
and the difference of lobes from the truth; each row is a light.
"""

import math
import os
import sys
import time
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from rich.console import Console
from rich.table import Table
from torch import Tensor

from prt_torch import store
from prt_torch.assets import (
    Mesh,
    bend,
    deformed,
    deformed_frames,
    find_environment,
    load_mesh,
    mesh_from_arrays,
    procedural_scene,
    twist,
)
from prt_torch.baking import bake
from prt_torch.bases import SphericalHarmonics, zonal
from prt_torch.bases.sh_zxzxz import rotate
from prt_torch.command import main
from prt_torch.errors import InputError
from prt_torch.evaluate import radiance_error, transfer_error
from prt_torch.preview import (
    Camera,
    automatic_exposure,
    difference_image,
    encode_png,
    tone_map,
    trace,
)
from prt_torch.relight import Relighter
from prt_torch.representations import ZonalLobes
from prt_torch.representations.zonal_lobes_search import Effort
from prt_torch.transfer import TransferTensor

ORDER = 6
DEFAULT_ASSETS = Path(__file__).resolve().parent.parent.parent / "shared" / "assets"
NAMED_LIGHTS = ("sky", "sunset", "area_lights")
FILE_LIGHTS = ("debevec_galileo_latlong.hdr", "debevec_rnl_latlong.hdr", "ict_uffizi_latlong.hdr")
METHODS = ("lobes", "SH turned", "rigid SH", "unshadowed", "linear")
SHOWN = ("lobes", "SH turned", "rigid SH", "unshadowed")
WIDTH, HEIGHT = 320, 320

Radiances = dict[str, Float[Tensor, "lights points rgb"]]


@main
def compare(arguments: list[str]) -> None:
    """Print a table, and write a picture, for each deformation."""
    mesh, which, degrees, lobes, supersampling = None, ["bend", "twist"], 90.0, 4, 2
    effort: Effort = "default"
    lights, out = _default_lights(), Path("runs/deformation")
    for argument in arguments:
        match argument.partition("="):
            case ("--mesh", "=", path):
                mesh = load_mesh(path)
            case ("--deform", "=", name) if name in which:
                which = [name]
            case ("--degrees", "=", number) if number.lstrip("-").replace(".", "", 1).isdigit():
                degrees = float(number)
            case ("--lobes", "=", count) if count.isdigit() and int(count) > 0:
                lobes = int(count)
            case ("--effort", "=", "default" | "fast" as chosen):
                effort = chosen
            case ("--lights", "=", names):
                lights = names.split(",")
            case ("--supersampling", "=", count) if count.isdigit():
                supersampling = int(count)
            case ("--out", "=", folder):
                out = Path(folder)
            case _:
                raise InputError(
                    f"{argument}: expected --mesh=FILE, --deform=bend|twist, --degrees=NUMBER, "
                    "--lobes=N, --effort=default|fast, --lights=NAME,..., --supersampling=N or "
                    "--out=FOLDER"
                )
    mesh = mesh or _knot()
    console = Console(width=150)
    console.print(f"{mesh.name}: {mesh.num_points} points, {mesh.num_faces} faces")
    rest = _baked(mesh, supersampling)
    start = time.perf_counter()
    model = ZonalLobes.from_transfer(rest, num_lobes=lobes, effort=effort)
    fitted = time.perf_counter() - start
    error = transfer_error(model, rest)
    console.print(f"{lobes} lobes, fitted in {fitted:.1f} s: squared transfer error {error:.2e}")
    basis = SphericalHarmonics(ORDER)
    light = torch.stack([basis.project(find_environment(name)) for name in lights]).float()
    for name in which:
        vertices = _deform(mesh, name, math.radians(degrees))
        moved = deformed(mesh, vertices)
        frames = deformed_frames(mesh, vertices)
        truth = _radiance(_baked(moved, supersampling).dense(), light) * rest.surface.reflectance
        radiances, seconds = _methods(rest, model, frames, light)
        console.print(_table(f"{name} by {degrees:g} degrees", lights, truth, radiances))
        console.print(f"lobes relit {len(lights)} lights in {seconds * 1e3:.0f} ms")
        _picture(out / f"{mesh.name}_{name}.png", moved, truth, radiances)


def _default_lights() -> list[str]:
    folder = Path(os.environ.get("PRT_TORCH_ASSETS", DEFAULT_ASSETS)) / "env"
    files = [str(folder / name) for name in FILE_LIGHTS if (folder / name).exists()]
    return [*NAMED_LIGHTS, *files]


def _knot() -> Mesh:
    """The embedded scene without its ground, which would not bend with it."""
    scene = procedural_scene()
    knot = scene.parts[0]
    points = slice(knot.first_vertex, knot.first_vertex + knot.num_vertices)
    faces = scene.faces[knot.first_face : knot.first_face + knot.num_faces]
    return mesh_from_arrays(knot.name, scene.vertices[points], faces, albedo=scene.albedo[points])


def _deform(mesh: Mesh, which: str, angle: float) -> Float64[Tensor, "points 3"]:
    """Along the longest edge of the bounding box, bent towards where it is flattest."""
    low, high = mesh.bounds
    directions = torch.eye(3, dtype=torch.float64)[(high - low).argsort()]
    if which == "bend":
        return bend(mesh.vertices, angle, along=directions[2], toward=directions[0])
    return twist(mesh.vertices, angle, along=directions[2])


def _baked(mesh: Mesh, supersampling: int) -> TransferTensor:
    return bake(
        mesh,
        light_basis=SphericalHarmonics(ORDER),
        supersampling=supersampling,
        cache=".cache/bakes",
    )


def _methods(
    rest: TransferTensor,
    model: ZonalLobes,
    frames: Float[Tensor, "points 3 3"],
    light: Float[Tensor, "lights coeffs rgb"],
) -> tuple[Radiances, float]:
    """Radiance by each way that bakes nothing anew, and the time that lobes take [s]."""
    values, rest_frames = rest.dense().double(), rest.surface.frames
    if rest_frames is None:
        raise ValueError("expected transfer with shading frames")
    turns = frames.mT @ rest_frames.double()
    normals = frames[:, 2]
    cosine = (zonal.clamped_cosine_coefficients(ORDER) / math.pi).to(normals)
    unshadowed = zonal.zonal_to_sh(cosine.expand(len(normals), ORDER), normals)
    axes = zonal.optimal_linear_axis(values[:, 0, 0])
    fitted = zonal.fit_coefficients(values[:, 0, 0], axes[:, None])
    linear = zonal.lobes_to_sh((turns @ axes[..., None]).mT, fitted)
    with torch.no_grad():
        start = time.perf_counter()
        lobes = Relighter(model)(light, frames=frames.float())[:, 0]
        seconds = time.perf_counter() - start
    others = {
        "SH turned": rotate(values, turns[:, None, None]),
        "rigid SH": values,
        "unshadowed": unshadowed[:, None, None],
        "linear": linear[:, None, None],
    }
    by_method = {
        name: _radiance(each, light) * rest.surface.reflectance for name, each in others.items()
    }
    return {"lobes": lobes, **by_method}, seconds


def _radiance(
    values: Float[Tensor, "points 1 1 coeffs"], light: Float[Tensor, "lights coeffs rgb"]
) -> Float[Tensor, "lights points rgb"]:
    return torch.einsum("pi,bic->bpc", values[:, 0, 0].float(), light)


def _table(
    title: str,
    lights: list[str],
    truth: Float[Tensor, "lights points rgb"],
    radiances: Radiances,
) -> Table:
    """Relative RMS errors, and where the squared error of lobes comes from."""
    table = Table(title=title, title_justify="left")
    for column in ("light", *METHODS, "lobes / SH turned", "share distant", "share fit", "mixed"):
        table.add_column(column, justify="left" if column == "light" else "right")
    for index, light in enumerate(lights):
        errors = [f"{radiance_error(radiances[name][index], truth[index]):.4f}" for name in METHODS]
        lobes, turned = (radiances[name][index].double() for name in ("lobes", "SH turned"))
        distant, fit = turned - truth[index].double(), lobes - turned
        whole = (distant + fit).square().sum()
        shares = [distant.square().sum(), fit.square().sum(), 2 * (distant * fit).sum()]
        own = f"{radiance_error(lobes, turned):.4f}"
        table.add_row(
            Path(light).stem, *errors, own, *(f"{float(share / whole):.1%}" for share in shares)
        )
    return table


def _picture(
    path: Path, mesh: Mesh, truth: Float[Tensor, "lights points rgb"], radiances: Radiances
) -> None:
    """A row for each light, as the head of this file says."""
    hits = trace(mesh, Camera.framing(mesh, aspect=WIDTH / HEIGHT, margin=1.05), WIDTH, HEIGHT)
    rows = []
    for index, reference in enumerate(truth):
        images = [hits.shade(reference)]
        images += [hits.shade(radiances[name][index]) for name in SHOWN]
        exposure = automatic_exposure(images[0])
        difference, _ = difference_image(images[1], images[0], limit=0.25 / exposure)
        shown = [tone_map(image, exposure) for image in images]
        rows.append(np.concatenate([*shown, difference], axis=1))
    path.parent.mkdir(parents=True, exist_ok=True)
    store.write_bytes(path, encode_png(np.concatenate(rows, axis=0)))


if __name__ == "__main__":
    sys.exit(compare(sys.argv[1:]))
