r"""Materials of the RGL database (EPFL), ``.bsdf``, in their adaptive parametrisation.

The angles where a material is measured follow its own lobe. For a fixed direction, the visible
normals of the microfacet model that fits its retro-reflection have a density on a square
:math:`(\sqrt{2\theta_m/\pi},\ \phi_m/2\pi)`; running along the rows of that density until a share
x, and over the rows until a share y of its mass has passed, maps the half vector to a point
(x, y) in which a measurement of 32 x 32 values is smooth however sharp the material is. Then

.. math:: f \cos\theta = \mathrm{rgb}(x, y)\, \frac{D(m)}{4\, \sigma(\omega_{fixed})}

with the distribution of normals D and the projected area σ, all three read from tables.
Densities, and the running integrals of their bilinear interpolants, are mixed linearly between
the fixed angles measured (eight between the normal and the horizon, as a rule).

The fixed direction is the viewer's and the cosine that of the light, as renderers use these files.
So the product that light is integrated with, :math:`f \cos\theta_i`, is bounded as measured, and
its integral over lights is the mean of ``rgb``. Turned round, f would be divided by the cosine of
the viewer, and radiance at the horizon would not be bounded.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import embedding

from prt_torch.assets.brdf.angles import azimuth, polar_angle, split_index
from prt_torch.assets.brdf.measured import MeasuredBRDF, check_values
from prt_torch.assets.brdf.microfacet import half_vector
from prt_torch.assets.brdf.tensor_file import read_tensor_file
from prt_torch.errors import InputError

_LEAST_ROW = 1e-20  # a row of the density without mass is divided by it; every share there is zero


@dataclass(frozen=True)
class RGL(MeasuredBRDF):
    """A material of the RGL database, RGB variant, isotropic or anisotropic.

    Values are linear sRGB as the file has them: slightly negative where the material is more
    saturated than sRGB can say.

    Args:
        path: The ``_rgb.bsdf`` file.
        sha256: What the file's hash must be; None takes the file as it is.

    Raises:
        InputError: If the file is missing, malformed, or not the one that ``sha256`` names.

    Source:
        :cite:`dupuy2018adaptive`. Evaluated as its authors' renderer Mitsuba 3 does, to 1e-5 of the
        largest value; their RGB loader differs in setting negative values to zero.
    """

    name: ClassVar[str] = "rgl"

    def _read(self, path: Path, data: bytes) -> dict[str, Tensor]:
        fields = _check_fields(path, read_tensor_file(path, data))
        object.__setattr__(self, "_symmetry", _symmetry(path, fields["phi_i"]))
        object.__setattr__(self, "_shapes", {name: fields[name].shape for name in fields})
        tables = {name: torch.from_numpy(fields[name]) for name in ("phi_i", "theta_i")}
        tables |= {name: _patches(fields[name][..., None]) for name in ("ndf", "sigma")}
        tables["rgb"] = _patches(np.moveaxis(fields["rgb"], 2, -1))
        tables["vndf"] = _warp(fields["vndf"])
        if not bool(fields["jacobian"][0]):  # values are f cos θ themselves
            tables["ndf"], tables["sigma"] = tables["ndf"] * 0.0 + 4.0, tables["sigma"] * 0.0 + 1.0
        return tables

    def _look_up(
        self, wi: Float[Tensor, "pairs 3"], wo: Float[Tensor, "pairs 3"]
    ) -> Float[Tensor, "pairs rgb"]:
        tables, shapes = self._tables_like(wi), self.__dict__["_shapes"]
        light_cosine = wi[..., 2:]
        wi, wo = self._fold(wi, wo)
        half, _ = half_vector(wi, wo)
        viewer_angle = polar_angle(wo)
        viewer_turn = wi.new_zeros(()) if self.isotropic else azimuth(wo[..., 1], wo[..., 0])
        spot = _unit(polar_angle(half), _turn(half, wo if self.isotropic else None))

        slices = _Slices(tables["theta_i"], viewer_angle)
        if not self.isotropic:
            slices.cross(tables["phi_i"], viewer_turn)
        warped = _invert(tables["vndf"], shapes["vndf"], slices, spot)
        rgb = _bilinear(tables["rgb"], shapes["rgb"], slices, warped)
        normals = _bilinear(tables["ndf"], shapes["ndf"], None, spot)
        area = _bilinear(tables["sigma"], shapes["sigma"], None, _unit(viewer_angle, viewer_turn))
        return rgb * (normals / (4.0 * area * light_cosine))

    def _fold(
        self, wi: Float[Tensor, "*batch 3"], wo: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
        """Turn or mirror pairs into the viewer's azimuths that were measured, -π to 0."""
        symmetry = self.__dict__["_symmetry"]
        if symmetry == 1:
            return wi, wo
        y = torch.where(wo[..., 1] >= 0.0, -1.0, 1.0)
        x = torch.where(wo[..., 0] >= 0.0, -1.0, 1.0) if symmetry == 4 else y
        signs = torch.stack([x, y, torch.ones_like(x)], dim=-1).to(wi)
        return wi * signs, wo * signs

    @property
    def isotropic(self) -> bool:
        """Whether one azimuth of the viewer was measured."""
        return len(self._tables_like(torch.zeros((), dtype=torch.float64))["phi_i"]) == 1

    @property
    def reciprocal(self) -> bool:
        """False: measurements are only nearly so."""
        return False


def _check_fields(path: Path, fields: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The fields that evaluation needs, in the shapes and ranges that it relies on."""
    if "rgb" not in fields and "spectra" in fields:
        raise InputError(f"{path}: rgb: missing, the file has spectra; use the _rgb.bsdf file")
    expected = {
        "phi_i": (1, -2.0 * math.pi, 2.0 * math.pi),
        "theta_i": (1, 0.0, 0.5 * math.pi + 1e-6),
        "ndf": (2, 0.0, 1e9),
        "sigma": (2, 1e-6, 1e3),
        "vndf": (4, 0.0, 1e30),
        "rgb": (5, -1e6, 1e6),
        "jacobian": (1, 0.0, 1.0),
    }
    checked = {}
    for name, (axes, low, high) in expected.items():
        if name not in fields:
            raise InputError(f"{path}: {name}: missing; an RGL material needs it")
        values = fields[name]
        dtype = np.dtype("u1" if name == "jacobian" else "<f4")
        if values.ndim != axes or values.dtype != dtype:
            raise InputError(
                f"{path}: {name}: expected {axes} axes of {dtype}, "
                f"got {values.ndim} of {values.dtype}"
            )
        checked[name] = check_values(path, name, values, low, high)
    _check_shapes(path, checked)
    return checked


def _check_shapes(path: Path, fields: dict[str, np.ndarray]) -> None:
    for name in ("phi_i", "theta_i"):
        if not bool((np.diff(fields[name]) > 0.0).all()):
            raise InputError(f"{path}: {name}: expected values that rise")
    if len(fields["theta_i"]) < 2:
        raise InputError(f"{path}: theta_i: expected at least 2 values, got 1")
    measured = (len(fields["phi_i"]), len(fields["theta_i"]))
    for name in ("vndf", "rgb"):
        if fields[name].shape[:2] != measured:
            raise InputError(
                f"{path}: {name}: expected {measured[0]} x {measured[1]} slices as phi_i and "
                f"theta_i say, got {fields[name].shape[0]} x {fields[name].shape[1]}"
            )
    if fields["rgb"].shape[2] != 3:
        raise InputError(f"{path}: rgb: expected 3 channels, got {fields['rgb'].shape[2]}")
    for name in ("ndf", "sigma", "vndf", "rgb"):
        if min(fields[name].shape[-2:]) < 2:
            raise InputError(
                f"{path}: {name}: expected at least 2 x 2 values, got {fields[name].shape[-2:]}"
            )
    if not bool((fields["vndf"][..., :-1, :].sum((-2, -1)) > 0.0).all()):
        raise InputError(f"{path}: vndf: a slice has no mass")


def _symmetry(path: Path, phi_i: np.ndarray) -> int:
    """Into how many parts of equal reflectance a turn of the viewer divides."""
    if len(phi_i) == 1:
        return 1
    span = float(phi_i[-1] - phi_i[0])
    parts = round(2.0 * math.pi / span)
    if len(phi_i) == 2 or parts not in (1, 2, 4):
        raise InputError(
            f"{path}: phi_i: expected 1 azimuth, or at least 3 over a turn, a half or a quarter, "
            f"got {len(phi_i)} over {span:.3g} radians"
        )
    return parts


def _patches(values: np.ndarray) -> Float[Tensor, "patches corners"]:
    """The four corners of each bilinear patch, side by side, channels last."""
    lower, upper = values[..., :-1, :, :], values[..., 1:, :, :]
    corners = [lower[..., :-1, :], lower[..., 1:, :], upper[..., :-1, :], upper[..., 1:, :]]
    packed = np.stack(corners, axis=-2)
    return torch.from_numpy(packed.reshape(-1, 4 * values.shape[-1]))


def _running(values: np.ndarray) -> np.ndarray:
    """Integrals of linear interpolants along the last axis, from its start to each node."""
    steps = 0.5 * (values[..., :-1] + values[..., 1:])
    return np.concatenate([np.zeros_like(values[..., :1]), steps.cumsum(-1)], axis=-1)


def _warp(density: np.ndarray) -> Float[Tensor, "patches nine"]:
    """What a patch of the density needs: corners, mass before it in its rows, rows, rows before."""
    in_row = _running(density)
    rows = in_row[..., -1]
    before = _running(rows)
    mass = before[..., -1]
    columns = density.shape[-1] - 1

    def each(values: np.ndarray) -> np.ndarray:
        return np.repeat(values[..., None], columns, axis=-1)

    parts = [
        density[..., :-1, :-1],
        density[..., :-1, 1:],
        density[..., 1:, :-1],
        density[..., 1:, 1:],
        in_row[..., :-1, :-1],
        in_row[..., 1:, :-1],
        each(rows[..., :-1]),
        each(rows[..., 1:]),
        each(before[..., :-1]),
    ]
    packed = np.stack(parts, axis=-1) / mass[..., None, None, None]
    return torch.from_numpy(packed.reshape(-1, 9))


class _Slices:
    """Between which fixed directions a viewer lies, and the share of each."""

    def __init__(self, nodes: Float[Tensor, "nodes"], angle: Float[Tensor, "*batch"]):
        below, share = _between(nodes, angle)
        self.parts = [(below, 1.0 - share), (below + 1, share)]
        self._count = len(nodes)

    def cross(self, nodes: Float[Tensor, "nodes"], turn: Float[Tensor, "*batch"]) -> None:
        """Divide each part between two azimuths, the slower axis of the tables."""
        below, share = _between(nodes, turn)
        turns = [(below, 1.0 - share), (below + 1, share)]
        self.parts = [
            (outer * self._count + inner, far * near)
            for outer, far in turns
            for inner, near in self.parts
        ]


def _between(
    nodes: Float[Tensor, "nodes"], at: Float[Tensor, "*batch"]
) -> tuple[Tensor, Float[Tensor, "*batch"]]:
    below = torch.bucketize(at.detach(), nodes, right=True).sub(1).clamp(0, len(nodes) - 2)
    start, end = nodes[below], nodes[below + 1]
    return below, ((at - start) / (end - start)).clamp(0.0, 1.0)


def _turn(
    half: Float[Tensor, "*batch 3"], origin: Float[Tensor, "*batch 3"] | None
) -> Float[Tensor, "*batch"]:
    """Azimuth of the half vector, counted from that of a direction if there is one."""
    x, y = half[..., 0], half[..., 1]
    if origin is None:
        return azimuth(y, x)
    # A viewer along the normal has azimuth 0, so that all of the square is still in use.
    level = origin[..., :2].square().sum(-1) > 1e-24
    along = torch.where(level, origin[..., 0], 1.0)
    across = torch.where(level, origin[..., 1], 0.0)
    return azimuth(along * y - across * x, along * x + across * y)


def _unit(
    polar: Float[Tensor, "*batch"], turn: Float[Tensor, "*#batch"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Coordinates of a direction in the unit square: polar angle (columns), azimuth (rows)."""
    column = (polar * (2.0 / math.pi)).sqrt()
    return column, ((turn + math.pi) * (0.5 / math.pi)).expand_as(column)


def _locate(
    shape: tuple[int, ...],
    slices: _Slices | None,
    spot: tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]],
    table: Float[Tensor, "patches values"],
) -> tuple[Float[Tensor, "*batch values"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """The patch under a point of the unit square, mixed between slices, and the point in it."""
    rows, columns = shape[-2:]
    column, x = split_index(spot[0] * (columns - 1.0), columns)
    row, y = split_index(spot[1] * (rows - 1.0), rows)
    patch = row * (columns - 1) + column
    if slices is None:
        return embedding(patch, table), x, y
    per_slice = (rows - 1) * (columns - 1)
    mixed = [embedding(at * per_slice + patch, table) * w[..., None] for at, w in slices.parts]
    total = mixed[0]
    for part in mixed[1:]:
        total = total + part
    return total, x, y


def _bilinear(
    table: Float[Tensor, "patches values"],
    shape: tuple[int, ...],
    slices: _Slices | None,
    spot: tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]],
) -> Float[Tensor, "*batch channels"]:
    corners, x, y = _locate(shape, slices, spot, table)
    lower_left, lower_right, upper_left, upper_right = corners.chunk(4, dim=-1)
    x, y = x[..., None], y[..., None]
    return torch.lerp(
        torch.lerp(lower_left, lower_right, x), torch.lerp(upper_left, upper_right, x), y
    )


def _invert(
    table: Float[Tensor, "patches nine"],
    shape: tuple[int, ...],
    slices: _Slices,
    spot: tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Shares of the mass that lie before a point: in its row, and in the rows below it."""
    patch, x, y = _locate(shape, slices, spot, table)
    a, b, c, d, before_a, before_c, row_a, row_c, below = patch.unbind(-1)
    left, right = torch.lerp(a, c, y), torch.lerp(b, d, y)
    in_row = torch.lerp(before_a, before_c, y) + x * (left + 0.5 * x * (right - left))
    row = torch.lerp(row_a, row_c, y).clamp(min=_LEAST_ROW)
    return in_row / row, below + y * (row_a + 0.5 * y * (row_c - row_a))
