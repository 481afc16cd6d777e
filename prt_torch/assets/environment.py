"""Distant light from all directions: lat-long and cube images, looked up and sampled.

An environment is never resampled. Turning it composes a rotation, and projections into a basis
go through :meth:`Environment.sample_blocks`, whose pieces of source pixels have exact solid
angles: a sun of one pixel keeps its energy in any basis.

Crosses (the viewer is in the middle, +x to the right, +y up; -z is ahead):

    vertical          horizontal

        +y                +y
    -x  -z  +x        -x  -z  +x  +z
        -y                -y
        +z (turned by 180 degrees, so that it folds up under -y)
"""

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from prt_torch import conventions, sphere
from prt_torch.assets.exr import read_exr
from prt_torch.assets.rgbe import read_hdr
from prt_torch.errors import InputError
from prt_torch.sphere import rotation_about_up

_READERS = {".hdr": read_hdr, ".exr": read_exr}
_ASPECT_TOLERANCE = 0.02


def _identity() -> Float64[Tensor, "3 3"]:
    return torch.eye(3, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Environment:
    """Radiance from every direction, as an image and a rotation.

    The radiance seen in world direction s is the image looked up at ``rotation.T @ s``.
    """

    name: str
    image: Float[Tensor, "*face rows cols 3"]
    """Linear RGB, ``"rows cols 3"`` (lat-long) or ``"6 n n 3"`` (cube), laid out as
    :mod:`prt_torch.conventions` says."""
    layout: Literal["latlong", "cube"]
    rotation: Float64[Tensor, "3 3"] = field(default_factory=_identity)
    """Turns the light: a source at d in the image is seen at ``rotation @ d``."""

    def __post_init__(self) -> None:
        """Check shapes.

        Raises:
            ValueError: If image, layout and rotation do not go together.
        """
        shape = tuple(self.image.shape)
        match self.layout:
            case "latlong":
                fits = len(shape) == 3
            case "cube":
                fits = len(shape) == 4 and shape[0] == 6 and shape[1] == shape[2]
            case _:
                raise ValueError(f"expected layout latlong or cube, got {self.layout}")
        if not fits or shape[-1] != 3 or not self.image.numel():
            raise ValueError(f"expected an image for layout {self.layout}, got shape {shape}")
        turn = self.rotation.double()
        if turn.shape != (3, 3) or not torch.allclose(
            turn @ turn.T, _identity().to(turn), atol=1e-6
        ):
            raise ValueError("expected a 3 x 3 rotation matrix")

    def rotated(self, rotation: Float[Tensor, "3 3"]) -> "Environment":
        """The same light turned further: a source seen at s is then seen at ``rotation @ s``."""
        return replace(self, rotation=rotation.to(self.rotation) @ self.rotation)

    def scaled(self, factor: float | Float[Tensor, "..."]) -> "Environment":
        """The same light with its radiance times ``factor`` (a number, or one per channel)."""
        return replace(self, image=self.image * factor)

    def radiance(self, directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Bilinear lookup, differentiable in the image.

        Lat-long images wrap around in azimuth and are clamped at the poles; cube images are
        clamped at the edges of each face.

        Args:
            directions: World directions of any length but zero; float64 keeps the weights exact.

        Returns:
            Linear RGB radiance, in the wider type of image and directions.
        """
        directions = directions.to(torch.promote_types(self.image.dtype, directions.dtype))
        local = directions @ self.rotation.to(directions)
        if self.layout == "latlong":
            return self._lookup_latlong(local)
        return self._lookup_cube(local)

    def _lookup_latlong(self, local: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        rows, cols, _ = self.image.shape
        x, y, z = local.unbind(-1)
        pole = (x == 0) & (z == 0)
        # At a pole the azimuth has no gradient; any finite argument will do there.
        level = torch.where(pole, 0.0, torch.sqrt(torch.where(pole, 1.0, x * x + z * z)))
        azimuth = torch.atan2(torch.where(pole, 0.0, x), torch.where(pole, 1.0, -z))
        col = (azimuth / (2 * math.pi) + 0.5) * cols - 0.5
        row = torch.atan2(level, y) / math.pi * rows - 0.5
        # One more column on either side closes the circle.
        image = torch.cat([self.image[:, -1:], self.image, self.image[:, :1]], dim=1)
        return _bilinear(image, (), row, col + 1)

    def _lookup_cube(self, local: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        half = self.image.shape[1] / 2
        face = sphere.cubemap_index(local, 1)
        axes = conventions.CUBE_FACES.to(local)[face]
        major, u, v = (axes * local[..., None, :]).sum(-1).unbind(-1)
        col, row = (u / major + 1) * half - 0.5, (v / major + 1) * half - 0.5
        return _bilinear(self.image, (face,), row, col)

    def sample_blocks(
        self, max_spacing: float, block: int = 2**18
    ) -> Iterator[
        tuple[
            Float64[Tensor, "samples 3"], Float64[Tensor, "samples"], Float64[Tensor, "samples 3"]
        ]
    ]:
        r"""The whole sphere as pieces of source pixels, for integrals over the light.

        Every pixel is cut into s x s pieces, equal in azimuth and polar angle (lat-long) or in
        face coordinates (cube), s as small as ``max_spacing`` allows. Radiance is constant over
        a source pixel. Solid angles are exact and sum to 4π; a lat-long piece is represented by
        the direction that halves its area, a cube piece by its centre.

        Args:
            max_spacing: Largest width of a piece [rad], more than 0.
            block: Samples to yield at a time, at least 1; rounded to whole rows of pieces.

        Yields:
            World directions, solid angles [sr] and radiance. Differentiable in the image.

        Raises:
            ValueError: If an argument is out of range.
        """
        if not max_spacing > 0 or block < 1:
            raise ValueError(f"expected a spacing and a block above 0, got {max_spacing}, {block}")
        if self.layout == "latlong":
            pieces = self._latlong_pieces(max_spacing, block)
        else:
            pieces = self._cube_pieces(max_spacing, block)
        turn = self.rotation.to(self.image.device).T
        for local, solid_angles, radiance in pieces:
            directions = local.reshape(-1, 3) @ turn
            yield directions, solid_angles.reshape(-1), radiance.reshape(-1, 3).double()

    def _latlong_pieces(
        self, max_spacing: float, block: int
    ) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        rows, cols, _ = self.image.shape
        split = math.ceil(max(2 * math.pi / cols, math.pi / rows) / max_spacing)
        device = self.image.device
        half = math.pi / (2 * rows * split)
        index = torch.arange(rows * split, device=device)
        middle = (2 * index.double() + 1) * half
        # Mean and difference of cos at the two edges of a row, without cancellation.
        height = middle.cos() * math.cos(half)
        level = torch.sqrt(1 - height * height)
        step = 2 * math.pi / (cols * split)
        solid_angle = 2 * step * math.sin(half) * middle.sin()
        index = torch.arange(cols * split, device=device)
        azimuth = (index.double() + 0.5) * step - math.pi
        sine, cosine = azimuth.sin(), azimuth.cos()
        for row in torch.arange(rows * split, device=device).split(max(1, block // len(index))):
            shape = (len(row), len(index))
            local = torch.stack(
                [
                    level[row, None] * sine,
                    height[row, None].expand(shape),
                    -level[row, None] * cosine,
                ],
                dim=-1,
            )
            radiance = self.image[row[:, None] // split, index // split]
            yield local, solid_angle[row, None].expand(shape), radiance

    def _cube_pieces(
        self, max_spacing: float, block: int
    ) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        resolution = self.image.shape[1]
        split = math.ceil(2 / resolution / max_spacing)
        device = self.image.device
        index = torch.arange(resolution * split, device=device)
        centre = (index.double() + 0.5) * (2 / len(index)) - 1
        edge = torch.linspace(-1.0, 1.0, len(index) + 1, dtype=torch.float64, device=device)
        for face, (constant, along_u, along_v) in enumerate(conventions.CUBE_FACES.to(device)):
            for row in index.split(max(1, block // len(index))):
                local = constant + centre[:, None] * along_u + centre[row, None, None] * along_v
                local = local / local.norm(dim=-1, keepdim=True)
                # Solid angle of the rectangle from the middle of the face to each corner.
                v = edge[row[0] : row[-1] + 2, None]
                corner = torch.atan2(edge * v, torch.sqrt(1 + edge * edge + v * v))
                radiance = self.image[face][row[:, None] // split, index // split]
                yield local, corner.diff(dim=0).diff(dim=1), radiance


def _bilinear(
    image: Float[Tensor, "*face rows cols 3"],
    face: tuple[Tensor, ...],
    row: Float[Tensor, "*batch"],
    col: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch 3"]:
    """Interpolate between pixel centres, which are whole numbers; clamped at the borders."""
    rows, cols = image.shape[-3:-1]
    row, col = row.clamp(0, rows - 1), col.clamp(0, cols - 1)
    top, left = row.floor(), col.floor()
    down, across = (row - top)[..., None], (col - left)[..., None]
    top, left = top.long(), left.long()
    below, right = (top + 1).clamp(max=rows - 1), (left + 1).clamp(max=cols - 1)
    above = (1 - across) * image[(*face, top, left)] + across * image[(*face, top, right)]
    under = (1 - across) * image[(*face, below, left)] + across * image[(*face, below, right)]
    return (1 - down) * above + down * under


# (row, col) of the faces in a cross, in the order +x, -x, +y, -y, +z, -z.
_VERTICAL = ((1, 2), (1, 0), (0, 1), (2, 1), (3, 1), (1, 1))
_HORIZONTAL = ((1, 2), (1, 0), (0, 1), (2, 1), (1, 3), (1, 1))


def _cube_from_cross(
    image: Float32[np.ndarray, "rows cols 3"], layout: Literal["vertical_cross", "horizontal_cross"]
) -> Float32[np.ndarray, "6 n n 3"]:
    """Cut the faces out. The corners of the cross between them are never read.

    A cross shows faces as a viewer inside sees them, OpenGL's axes as one outside does: faces are
    mirrored left to right; +y, -y and the upside-down +z of a vertical cross top to bottom.
    """
    size = image.shape[1] // (3 if layout == "vertical_cross" else 4)
    faces = []
    places = _VERTICAL if layout == "vertical_cross" else _HORIZONTAL
    for name, (row, col) in zip(conventions.CUBE_FACE_NAMES, places, strict=True):
        face = image[row * size : (row + 1) * size, col * size : (col + 1) * size]
        upside_down = name == "+z" and layout == "vertical_cross"
        faces.append(face[::-1] if "y" in name or upside_down else face[:, ::-1])
    return np.stack(faces)


def _find_layout(path: Path, rows: int, cols: int, layout: str) -> str:
    """The layout of an image of this size, checked against what the user said."""
    vertical = cols % 3 == 0 and rows % 4 == 0 and cols * 4 == rows * 3
    horizontal = cols % 4 == 0 and rows % 3 == 0 and cols * 3 == rows * 4
    match layout:
        case "latlong":
            return layout
        case "vertical_cross" | "horizontal_cross":
            if not (vertical if layout == "vertical_cross" else horizontal):
                shape = "3:4" if layout == "vertical_cross" else "4:3"
                raise InputError(f"{path}: layout={layout} needs {shape}, not {cols} x {rows}")
            return layout
        case "auto":
            if vertical or horizontal:
                return "vertical_cross" if vertical else "horizontal_cross"
            if abs(cols / rows - 2) <= 2 * _ASPECT_TOLERANCE:
                return "latlong"
            square = " (no angular maps)" if rows == cols else ""
            raise InputError(
                f"{path}: {cols} x {rows} is neither 2:1 (latlong), 3:4 (vertical_cross) nor "
                f"4:3 (horizontal_cross); set layout to one{square}"
            )
        case _:
            raise InputError(
                f"layout={layout}: expected auto, latlong, vertical_cross or horizontal_cross"
            )


def _check_radiance(path: Path, image: Float32[np.ndarray, "*shape 3"]) -> None:
    """Radiance is finite and not negative."""
    for wrong, what in ((~np.isfinite(image), "not finite"), (image < 0, "negative")):
        if wrong.any():
            first = np.unravel_index(int(wrong.argmax()), image.shape)
            place = ", ".join(str(int(i)) for i in first[:-1])
            kind = "(row, col)" if image.ndim == 3 else "(face, row, col)"
            raise InputError(
                f"{path}: {int(wrong.sum())} radiance values are {what}, "
                f"the first at {kind} = ({place})"
            )


def load_environment(
    path: str | os.PathLike[str],
    *,
    layout: Literal["auto", "latlong", "vertical_cross", "horizontal_cross"] = "auto",
    rotation_degrees: float = 0.0,
    exposure: float = 0.0,
    name: str | None = None,
) -> Environment:
    """Load a Radiance .hdr or an OpenEXR .exr file.

    Args:
        path: The file; its suffix names the format.
        layout: How directions are laid out; ``"auto"`` tells 2:1 (within 2 %), 3:4 and 4:3 apart.
        rotation_degrees: Turns the light about +y, counter-clockwise seen from above.
        exposure: Stops; radiance is multiplied by 2^exposure.
        name: What reports call it; the file's name by default.

    Raises:
        InputError: If the file is missing, empty, truncated, of another format or of no known
            layout, has radiance that is negative or not finite, or an argument is out of range.
    """
    file = Path(path)
    read = _READERS.get(file.suffix.lower())
    if read is None:
        raise InputError(f"{path}: unknown image format, expected one of {', '.join(_READERS)}")
    image = read(file)
    found = _find_layout(file, image.shape[0], image.shape[1], layout)
    if found == "vertical_cross" or found == "horizontal_cross":
        image = _cube_from_cross(image, found)
    _check_radiance(file, image)
    environment = Environment(
        name=file.stem if name is None else name,
        image=torch.from_numpy(np.ascontiguousarray(image)),
        layout="latlong" if found == "latlong" else "cube",
    )
    return adjusted(environment, rotation_degrees=rotation_degrees, exposure=exposure)


def adjusted(
    environment: Environment, *, rotation_degrees: float = 0.0, exposure: float = 0.0
) -> Environment:
    """An environment turned about +y, and brighter by stops, as a configuration asks.

    Raises:
        InputError: If an argument is not finite, or the exposure overflows the image.
    """
    if not math.isfinite(rotation_degrees):
        raise InputError(f"rotation_degrees={rotation_degrees}: expected a finite number")
    if not abs(exposure) <= 100:
        raise InputError(f"exposure={exposure}: expected -100 to 100 stops")
    if rotation_degrees:
        environment = environment.rotated(rotation_about_up(rotation_degrees))
    if exposure:
        environment = environment.scaled(2.0**exposure)
        if not bool(torch.isfinite(environment.image).all()):
            raise InputError(f"exposure={exposure}: {environment.name} overflows float32")
    return environment
