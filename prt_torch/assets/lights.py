"""Environments made of formulas, and the one place where a name or a path becomes light.

Azimuths are 0 ahead (-z) and grow to the right (+x), as columns of a lat-long image do.
"""

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from prt_torch.assets.environment import Environment, adjusted, load_environment
from prt_torch.errors import InputError

_SUN_SPREAD = math.radians(1.5)
_SUN_IRRADIANCE = 3.0


def _pixel_directions(rows: int) -> Float64[Tensor, "rows cols 3"]:
    """Centres of the pixels of a lat-long image twice as wide as high."""
    if rows < 1:
        raise ValueError(f"expected at least 1 row, got {rows}")
    polar = (torch.arange(rows, dtype=torch.float64) + 0.5)[:, None] * (math.pi / rows)
    azimuth = (torch.arange(2 * rows, dtype=torch.float64) + 0.5) * (math.pi / rows) - math.pi
    height = polar.cos().expand(rows, 2 * rows)
    return torch.stack([polar.sin() * azimuth.sin(), height, -polar.sin() * azimuth.cos()], dim=-1)


def _pixel_solid_angles(rows: int) -> Float64[Tensor, "rows 1"]:
    """Exact solid angle of a pixel in each row [sr]."""
    polar = (torch.arange(rows, dtype=torch.float64) + 0.5)[:, None] * (math.pi / rows)
    return 2 * math.pi / rows * math.sin(math.pi / (2 * rows)) * polar.sin()


def _direction(azimuth_degrees: float, elevation_degrees: float) -> Float64[Tensor, "3"]:
    azimuth, elevation = math.radians(azimuth_degrees), math.radians(elevation_degrees)
    level = math.cos(elevation)
    return torch.tensor(
        [level * math.sin(azimuth), math.sin(elevation), -level * math.cos(azimuth)],
        dtype=torch.float64,
    )


def _smoothstep(low: float, high: float, value: Tensor) -> Tensor:
    """0 below ``low``, 1 above ``high``, smooth between."""
    t = ((value - low) / (high - low)).clamp(0, 1)
    return t * t * (3 - 2 * t)


def _rgb(*values: float) -> Float64[Tensor, "3"]:
    return torch.tensor(values, dtype=torch.float64)


def sky(
    name: str = "sky",
    rows: int = 128,
    *,
    sun_elevation_degrees: float = 40.0,
    sun_azimuth_degrees: float = 35.0,
) -> Environment:
    r"""A clear sky: gradient, darker warm ground, and a sun of a few pixels.

    The sun is a narrow lobe :math:`e^{(\cos\theta - 1)/\sigma^2}`, σ = 1.5 degrees, that is
    normalised over the exact solid angles of the pixels: its irradiance on a surface that faces
    it is 3 times its colour at any resolution, and its peak is several hundred times the sky.
    Low suns are orange and warm the horizon.

    Args:
        name: What reports call it.
        rows: Height of the lat-long image; it is twice as wide.
        sun_elevation_degrees: Above the horizon, -90 to 90.
        sun_azimuth_degrees: From -z towards +x.

    Raises:
        ValueError: If an argument is out of range.
    """
    if not -90 <= sun_elevation_degrees <= 90:
        raise ValueError(f"expected an elevation of -90 to 90, got {sun_elevation_degrees}")
    directions = _pixel_directions(rows)
    toward_sun = directions @ _direction(sun_azimuth_degrees, sun_elevation_degrees)
    high_sun = min(max(sun_elevation_degrees / 35.0, 0.0), 1.0)
    sun_colour = torch.lerp(_rgb(1.0, 0.48, 0.16), _rgb(1.0, 0.95, 0.86), high_sun)
    horizon = torch.lerp(_rgb(0.95, 0.50, 0.28), _rgb(0.70, 0.80, 0.95), high_sun)
    zenith = torch.lerp(_rgb(0.10, 0.14, 0.35), _rgb(0.14, 0.30, 0.75), high_sun)
    ground = _rgb(0.14, 0.10, 0.07)
    height = directions[..., 1:2]
    image = horizon + (zenith - horizon) * height.clamp(min=0).sqrt()
    # The sky is brighter on the sun's side.
    image = image * (1 + 0.6 * (0.5 + 0.5 * toward_sun[..., None]) ** 4)
    image = torch.lerp(ground.expand_as(image), image, _smoothstep(-0.04, 0.04, height))
    lobe = ((toward_sun - toward_sun.max()) / _SUN_SPREAD**2).exp()
    lobe = lobe / (lobe * _pixel_solid_angles(rows)).sum()
    image = image + _SUN_IRRADIANCE * lobe[..., None] * sun_colour
    return Environment(name, image.float(), "latlong")


def sunset(name: str = "sunset", rows: int = 128) -> Environment:
    """:func:`sky` with an orange sun 6 degrees above the horizon, to the left."""
    return sky(name, rows, sun_elevation_degrees=6.0, sun_azimuth_degrees=-70.0)


def area_lights(name: str = "area_lights", rows: int = 128) -> Environment:
    """Three coloured lights with soft edges in a dim room: a rectangle and two discs."""
    directions = _pixel_directions(rows)
    image = torch.lerp(
        _rgb(0.03, 0.03, 0.035), _rgb(0.07, 0.07, 0.08), 0.5 + 0.5 * directions[..., 1:2]
    )
    discs = (
        (_direction(-60.0, 35.0), 18.0, _rgb(14.0, 6.0, 2.0)),
        (_direction(150.0, 15.0), 25.0, _rgb(1.0, 2.5, 7.0)),
    )
    for centre, radius_degrees, colour in discs:
        cosine = math.cos(math.radians(radius_degrees))
        inside = _smoothstep(cosine - 0.02, cosine + 0.02, directions @ centre)
        image = image + inside[..., None] * colour
    # The rectangle is seen through a window straight above the right: plane y = 1.
    x, y, z = directions.unbind(-1)
    above = y > 0.1
    across = torch.where(above, x / y.clamp(min=0.1) - 0.5, math.inf)
    along = torch.where(above, z / y.clamp(min=0.1), math.inf)
    inside = (1 - _smoothstep(0.35, 0.45, across.abs())) * (1 - _smoothstep(0.6, 0.7, along.abs()))
    image = image + inside[..., None] * _rgb(5.0, 6.0, 5.0)
    return Environment(name, image.float(), "latlong")


def constant(radiance: float | Sequence[float] = 1.0, name: str = "constant") -> Environment:
    """The same radiance from everywhere, a number or one per channel."""
    values = torch.as_tensor(radiance, dtype=torch.float32)
    return Environment(name, values.expand(4, 8, 3).contiguous(), "latlong")


NAMED: dict[str, Callable[[], Environment]] = {
    "sky": sky,
    "sunset": sunset,
    "area_lights": area_lights,
    "constant": constant,
}
"""Environments that need no file, by name."""


def find_environment(
    name_or_path: str | os.PathLike[str],
    *,
    layout: Literal["auto", "latlong", "vertical_cross", "horizontal_cross"] = "auto",
    rotation_degrees: float = 0.0,
    exposure: float = 0.0,
) -> Environment:
    """The environment that a configuration means: a name in :data:`NAMED`, else a file.

    Args:
        name_or_path: A name wins over a file that is called the same; write ``./sky`` for it.
        layout: For files, as in :func:`load_environment`.
        rotation_degrees: Turns the light about +y, counter-clockwise seen from above.
        exposure: Stops; radiance is multiplied by 2^exposure.

    Raises:
        InputError: If it is neither a name nor a file, and as :func:`load_environment` does.
    """
    make = NAMED.get(os.fspath(name_or_path))
    if make is not None:
        return adjusted(make(), rotation_degrees=rotation_degrees, exposure=exposure)
    if not Path(name_or_path).exists():
        raise InputError(
            f"environment {os.fspath(name_or_path)!r} is neither a file nor one of "
            f"{', '.join(NAMED)}"
        )
    return load_environment(
        name_or_path, layout=layout, rotation_degrees=rotation_degrees, exposure=exposure
    )
