r"""Isotropic materials as scattered spectral samples, ``.brdf``, of Cornell's gonioreflectometer.

Text with ``#`` comments: the number of wavelengths; the wavelengths in nm; then for each sample
:math:`\theta_i, \phi_i, \theta_o, \phi_o` in radians and a value [1/sr] for each wavelength.

Spectra become X, Y, Z, which are not negative, and their logarithm (of the value plus a third of
its median, as dark samples are mostly noise) is interpolated by a Gaussian process over
:math:`(\sqrt{\theta_h}, \cos\theta_d, \cos\theta_i - \cos\theta_o)`: the first follows the lobe
however sharp, and what is smooth in directions is smooth in all three. Mirrored pairs have the same
coordinates, exchanged ones do not: the samples known to us differ there by up to ten times, for
light at 80 degrees, and following what the file says predicts left-out samples three times better
(in the median) than a reciprocal function does. The process is tabulated once, over half and
difference angles, so evaluation costs eight look-ups; values stay within those of the samples.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.assets.brdf.angles import half_difference, trilinear
from prt_torch.assets.brdf.kriging import Kriging
from prt_torch.assets.brdf.measured import MeasuredBRDF, check_values
from prt_torch.assets.brdf.spectrum import LONGEST, SHORTEST, reflectance_to_xyz, xyz_to_srgb
from prt_torch.errors import InputError

MOST_SAMPLES = 5000
"""Samples that a file may have: the process needs the square of it in memory."""

_LEAST_SAMPLES = 16
_MOST_WAVELENGTHS = 1000
_SOFTENING = 0.3  # of the median: where the logarithm turns into a straight line
_LENGTHS = (0.5, 0.5, 1.0)  # of correlation; by leave-one-out error of two materials
_NOISE = 1e-4
_NODES = (56, 32, 32)


@dataclass(frozen=True)
class Samples:
    """What a file holds.

    Attributes:
        wi: Unit vectors towards the light, float64.
        wo: Unit vectors towards the viewer.
        xyz: Values [1/sr] as X, Y, Z relative to a perfect reflector.
    """

    wi: Float[Tensor, "samples 3"]
    wo: Float[Tensor, "samples 3"]
    xyz: Float[Tensor, "samples 3"]


@dataclass(frozen=True)
class Cornell(MeasuredBRDF):
    """A material of scattered isotropic samples.

    Values are linear sRGB under D65, slightly negative where the material is more saturated than
    sRGB can say.

    Args:
        path: The ``.brdf`` file.
        sha256: What the file's hash must be; None takes the file as it is.

    Raises:
        InputError: If the file is missing, malformed, or not the one that ``sha256`` names.

    Source:
        The format of pbrt-v2's ``measured`` material. Its interpolation (a weighted mean of
        neighbours over the coordinates of :cite:`marschner1998inverse`) is not used.
    """

    name: ClassVar[str] = "cornell"

    def _read(self, path: Path, data: bytes) -> dict[str, Tensor]:
        samples = read_samples(path, data)
        process, softening = interpolate(samples)
        half, difference, turn = (torch.linspace(0.0, 1.0, n, dtype=torch.float64) for n in _NODES)
        nodes = torch.cartesian_prod(
            half.square() * (0.5 * math.pi), difference * (0.5 * math.pi), turn * math.pi
        )
        softened = (samples.xyz + softening).log()
        low, high = softened.amin(0), softened.amax(0)
        table = torch.minimum(torch.maximum(process(_coordinates(*nodes.unbind(-1))), low), high)
        return {
            "table": table.unflatten(0, _NODES),
            "softening": softening,
            "to_srgb": torch.from_numpy(xyz_to_srgb().T.copy()),
        }

    def _look_up(
        self, wi: Float[Tensor, "pairs 3"], wo: Float[Tensor, "pairs 3"]
    ) -> Float[Tensor, "pairs rgb"]:
        tables = self._tables_like(wi)
        half, difference, turn = half_difference(wi, wo)
        quarter = 0.5 * math.pi
        softened = trilinear(
            tables["table"],
            (half / quarter).sqrt() * (_NODES[0] - 1),
            difference * ((_NODES[1] - 1) / quarter),
            turn.abs() * ((_NODES[2] - 1) / math.pi),
        )
        return (softened.exp() - tables["softening"]).clamp(min=0.0) @ tables["to_srgb"]

    @property
    def isotropic(self) -> bool:
        """True."""
        return True

    @property
    def reciprocal(self) -> bool:
        """False: measurements are only nearly so."""
        return False


def interpolate(samples: Samples) -> tuple[Kriging, Float[Tensor, "3"]]:
    """The process through the samples' softened logarithms, and what was added before those.

    Args:
        samples: What a file holds.
    """
    softening = _SOFTENING * samples.xyz.median(0).values.clamp(min=1e-9)
    angles = half_difference(samples.wi, samples.wo)
    values = (samples.xyz + softening).log()
    return Kriging(_coordinates(*angles), values, _NOISE), softening


def _coordinates(
    half: Float[Tensor, "points"],
    difference: Float[Tensor, "points"],
    turn: Float[Tensor, "points"],
) -> Float[Tensor, "points 3"]:
    """Positions in units of correlation lengths; the last is cos θi - cos θo."""
    cosines = -2.0 * half.sin() * difference.sin() * turn.cos()
    position = torch.stack([half.sqrt(), difference.cos(), cosines], dim=-1)
    return position / position.new_tensor(_LENGTHS)


def read_samples(path: Path, data: bytes) -> Samples:
    """Read a ``.brdf`` file.

    Args:
        path: The file, for messages.
        data: Its content.

    Raises:
        InputError: If it is not text of numbers, is cut off, or has values that are not finite,
            negative, or directions that are not above the surface.
    """
    numbers = _numbers(path, data)
    count = numbers[0] if numbers else 0.0
    if not (3 <= count <= _MOST_WAVELENGTHS and count == int(count)):
        raise InputError(
            f"{path}: number of wavelengths: expected 3 to {_MOST_WAVELENGTHS}, got {count:g}"
        )
    wavelengths = np.array(numbers[1 : 1 + int(count)])
    columns = 4 + int(count)
    rest = len(numbers) - 1 - int(count)
    if rest < 0 or rest % columns:
        raise InputError(
            f"{path}: truncated, {rest} numbers after the wavelengths are not whole samples of "
            f"{columns}"
        )
    if not _LEAST_SAMPLES <= rest // columns <= MOST_SAMPLES:
        raise InputError(
            f"{path}: samples: expected {_LEAST_SAMPLES} to {MOST_SAMPLES}, got {rest // columns}"
        )
    check_values(path, "wavelengths", wavelengths, SHORTEST, LONGEST)
    if not bool((np.diff(wavelengths) > 0.0).all()):
        raise InputError(f"{path}: wavelengths: expected values that rise")
    rows = np.array(numbers[1 + int(count) :]).reshape(-1, columns)
    below_horizon = math.nextafter(0.5 * math.pi, 0.0)
    polar = check_values(path, "theta", rows[:, [0, 2]], 0.0, below_horizon)
    turns = check_values(path, "phi", rows[:, [1, 3]], -2.0 * math.pi - 1e-3, 2.0 * math.pi + 1e-3)
    spectra = check_values(path, "values", rows[:, 4:], 0.0, 1e6)
    wi, wo = (_direction(polar[:, side], turns[:, side]) for side in (0, 1))
    xyz = torch.from_numpy(reflectance_to_xyz(wavelengths, spectra))
    return Samples(wi, wo, xyz)


def _numbers(path: Path, data: bytes) -> list[float]:
    numbers: list[float] = []
    for place, line in enumerate(data.splitlines(), start=1):
        try:
            numbers += [float(word) for word in line.split(b"#")[0].split()]
        except ValueError:
            raise InputError(f"{path}: line {place}: expected numbers, got {line[:40]!r}") from None
    return numbers


def _direction(polar: np.ndarray, turn: np.ndarray) -> Float[Tensor, "samples 3"]:
    level = np.sin(polar)
    return torch.from_numpy(
        np.stack([level * np.cos(turn), level * np.sin(turn), np.cos(polar)], axis=-1)
    )
