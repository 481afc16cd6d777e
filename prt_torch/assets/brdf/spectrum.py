r"""Reflectance spectra to linear sRGB under daylight.

.. math:: X = \frac{\sum_\lambda f(\lambda)\, \bar x(\lambda)\, D_{65}(\lambda)\, \Delta\lambda}
    {\sum_\lambda \bar x(\lambda)\, D_{65}(\lambda)\, \Delta\lambda}

and so for Y and Z, each with its own norm: a reflectance of 1 at all wavelengths has X = Y = Z = 1
whichever wavelengths were measured, and sRGB (1, 1, 1), whose white is that of D65. The observer
is the multi-lobe fit to CIE 1931, within 0.035 of the tables (whose largest value is 1.78).
"""

import numpy as np

SHORTEST, LONGEST = 380.0, 780.0
"""Wavelengths [nm] between which spectra can be converted."""

_LOBES = {  # height, centre, widths to the left and to the right [nm]
    "x": ((1.056, 599.8, 37.9, 31.0), (0.362, 442.0, 16.0, 26.7), (-0.065, 501.1, 20.4, 26.2)),
    "y": ((0.821, 568.8, 46.9, 40.5), (0.286, 530.9, 16.3, 31.1)),
    "z": ((1.217, 437.0, 11.8, 36.0), (0.681, 459.0, 26.0, 13.8)),
}
# fmt: off
_DAYLIGHT = (  # CIE standard illuminant D65, 380 to 780 nm in steps of 10
    49.9755, 54.6482, 82.7549, 91.4860, 93.4318, 86.6823, 104.865, 117.008, 117.812, 114.861,
    115.923, 108.811, 109.354, 107.802, 104.790, 107.689, 104.405, 104.046, 100.000, 96.3342,
    95.7880, 88.6856, 90.0062, 89.5991, 87.6987, 83.2886, 83.6992, 80.0268, 80.2146, 82.2778,
    78.2842, 69.7213, 71.6091, 74.3490, 61.6040, 69.8856, 75.0870, 63.5927, 46.4182, 66.8054,
    63.3828,
)
# fmt: on
_SRGB_TO_XYZ = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)


def observer(wavelengths: np.ndarray) -> np.ndarray:
    """Colour matching functions of the CIE 1931 standard observer, ``"wavelengths 3"``.

    Args:
        wavelengths: In nm.

    Source:
        :cite:`wyman2013simple`, the fit by several lobes.
    """
    columns = []
    for lobes in _LOBES.values():
        total = np.zeros_like(wavelengths, dtype=np.float64)
        for height, centre, left, right in lobes:
            offset = wavelengths - centre
            total += height * np.exp(-0.5 * (offset / np.where(offset < 0.0, left, right)) ** 2)
        columns.append(total.clip(min=0.0))
    return np.stack(columns, axis=-1)


def daylight(wavelengths: np.ndarray) -> np.ndarray:
    """Relative power of standard illuminant D65, 100 at 560 nm, linear between 10 nm steps.

    Args:
        wavelengths: In nm, 380 to 780.
    """
    return np.interp(wavelengths, np.linspace(SHORTEST, LONGEST, len(_DAYLIGHT)), _DAYLIGHT)


def reflectance_to_xyz(wavelengths: np.ndarray, spectra: np.ndarray) -> np.ndarray:
    """X, Y, Z relative to a perfect reflector, ``"samples 3"``; non-negative for such spectra.

    Args:
        wavelengths: In nm, rising, 380 to 780, at least 3.
        spectra: Reflectance, ``"samples wavelengths"``.
    """
    steps = np.gradient(wavelengths)
    steps[[0, -1]] *= 0.5  # a trapezoid at either end
    weights = observer(wavelengths) * (daylight(wavelengths) * steps)[:, None]
    return spectra @ (weights / weights.sum(0))


def xyz_to_srgb() -> np.ndarray:
    """The matrix from X, Y, Z relative to a perfect reflector to linear sRGB; its rows sum to 1.

    Source:
        IEC 61966-2-1.
    """
    return np.linalg.solve(_SRGB_TO_XYZ, np.diag(_SRGB_TO_XYZ.sum(1)))
