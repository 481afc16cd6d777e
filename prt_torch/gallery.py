"""The pictures of a run: uncompressed beside fitted, their difference, and where the error is."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch import store
from prt_torch.assets import Environment, Mesh
from prt_torch.preview import (
    Camera,
    PrimaryHits,
    automatic_exposure,
    difference_image,
    encode_png,
    render_opengl,
    tone_map,
    trace,
    write_exr,
)
from prt_torch.report import Picture

_ERROR_LIMIT_PERCENTILE = 99.5


@dataclass(frozen=True)
class Lit:
    """What one light does to a scene.

    Attributes:
        environment: The light.
        reference: Radiance of every point towards the camera from the uncompressed tensor.
        fitted: The same from each result, by name.
    """

    environment: Environment
    reference: Float[Tensor, "points rgb"]
    fitted: Mapping[str, Float[Tensor, "points rgb"]]


def draw(
    folder: Path,
    mesh: Mesh,
    lit: list[Lit],
    errors: Mapping[str, Float[Tensor, "points"]],
    *,
    camera: Camera,
    width: int,
    height: int,
    opengl: bool,
) -> tuple[list[Picture], bool]:
    """Draw and write all pictures of a run.

    Each light gives ``LIGHT-uncompressed`` and ``LIGHT-RESULT`` as EXR (linear) and PNG (tone
    mapped, one exposure a light), their differences and, by OpenGL where that works, a preview.

    Args:
        folder: Where the files go.
        mesh: The scene.
        lit: What each light does to it.
        errors: Relative error of each point, by result.
        camera: Where all pictures are taken from.
        width: Pixels in a row.
        height: Rows.
        opengl: Whether to try OpenGL.

    Returns:
        Pictures for the report, and whether OpenGL drew.

    Raises:
        InputError: If a file cannot be written.
    """
    hits = trace(mesh, camera, width, height)
    pictures = []
    for light in lit:
        pictures += _draw_light(folder, hits, light)
    drawn = False
    if opengl:
        exposure = _exposure(hits, lit[0])
        drawn = _draw_opengl(folder, mesh, camera, lit[0], width, height, exposure)
    return pictures + _draw_errors(folder, hits, errors), drawn


def file_name(text: str) -> str:
    """A text as part of a file name: letters, digits, dots and dashes."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", text).strip("-") or "unnamed"


def _draw_light(folder: Path, hits: PrimaryHits, light: Lit) -> list[Picture]:
    stem, group = file_name(light.environment.name), f"Lit by {light.environment.name}"
    reference = hits.shade(light.reference, light.environment)
    exposure = _exposure(hits, light)
    plain = encode_png(tone_map(reference, exposure))
    store.write_bytes(folder / f"{stem}-uncompressed.png", plain)
    write_exr(folder / f"{stem}-uncompressed.exr", reference)
    pictures = []
    for name, radiance in light.fitted.items():
        image = hits.shade(radiance, light.environment)
        path = folder / f"{stem}-{file_name(name)}"
        png = encode_png(tone_map(image, exposure))
        difference, scale = difference_image(image, reference)
        difference_png = encode_png(difference)
        store.write_bytes(path.with_name(path.name + ".png"), png)
        store.write_bytes(path.with_name(path.name + "-difference.png"), difference_png)
        write_exr(path.with_name(path.name + ".exr"), image)
        pictures += [
            Picture("uncompressed", "", plain, group),
            Picture(name, "", png, group),
            Picture("difference", f"of {name}", difference_png, group, scale),
        ]
    return pictures


def _exposure(hits: PrimaryHits, light: Lit) -> float:
    """One exposure for all pictures of a light: that of the mesh, whatever is behind it."""
    return automatic_exposure(hits.shade(light.reference))


def _draw_opengl(
    folder: Path, mesh: Mesh, camera: Camera, light: Lit, width: int, height: int, exposure: float
) -> bool:
    name, radiance = list(light.fitted.items())[-1]
    environment = light.environment
    image = render_opengl(mesh, radiance, camera, width, height, environment, exposure=exposure)
    if image is None:
        return False
    stem = f"{file_name(environment.name)}-{file_name(name)}-opengl.png"
    store.write_bytes(folder / stem, encode_png(image))
    return True


def _draw_errors(folder: Path, hits: PrimaryHits, errors: Mapping[str, Tensor]) -> list[Picture]:
    """Error maps of all results on one scale."""
    every = torch.stack(list(errors.values())).numpy()
    limit = float(np.percentile(every, _ERROR_LIMIT_PERCENTILE)) or 1.0
    pictures = []
    for name, values in errors.items():
        colours, scale = hits.error_map(values, limit)
        png = encode_png(colours)
        store.write_bytes(folder / f"error-{file_name(name)}.png", png)
        caption = "relative error of each point's transfer"
        pictures.append(Picture(name, caption, png, "Where the error is", scale))
    return pictures
