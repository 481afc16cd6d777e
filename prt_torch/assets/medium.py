r"""Translucent media: the dipole model of light that scatters many times below a surface.

Light that enters a half-space at one point leaves it at distance r with the radiosity

.. math:: R_d(r) = \frac{\alpha'}{4\pi} \sum_{z \in \{z_r, z_v\}}
    z\, (1 + \sigma_{tr} d)\, \frac{e^{-\sigma_{tr} d}}{d^3}, \qquad d^2 = r^2 + z^2

a share of the incident flux per area: a source at the real depth :math:`z_r` of one mean free path
below the surface, and its mirror image :math:`z_v` above. All that a renderer needs of it has a
closed form, since :math:`e^{-\sigma_{tr} d} / d` is its integral over rings.

Source:
    Jensen, Marschner, Levoy, Hanrahan 2001, section 2.2. Their printed equation 4 divides the
    second term by :math:`\sigma_t'` once more, which its units do not allow; this is the form of
    Jensen and Buhler 2002, and its integral is their total.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from prt_torch.errors import InputError

_MAX_COEFFICIENT = 1e6  # per mm: mean free paths below a nanometre are no matter
_MIN_EXTINCTION = 1e-6  # per mm: beyond a kilometre there is no medium to speak of
_MIN_INDEX, _MAX_INDEX = 1.0, 2.2  # where the polynomial of diffuse_fresnel holds
_NODES, _NODE_WEIGHTS = map(torch.from_numpy, np.polynomial.legendre.leggauss(16))


@dataclass(frozen=True, eq=False)
class Dipole:
    """The dipole of some colour channels, in any unit of length.

    Made by :meth:`Medium.dipole`.
    """

    reduced_albedo: Float[Tensor, "channels"]
    """Share of the extinction that is scattering."""
    effective_transport: Float[Tensor, "channels"]
    """How fast light dies off far from where it entered [1/length]; zero without absorption."""
    depths: Float[Tensor, "2 channels"]
    """Distances from the surface to the real and to the virtual source [length]."""

    def to(self, like: Tensor) -> "Dipole":
        """The same in the dtype and on the device of ``like``."""
        return Dipole(
            self.reduced_albedo.to(like),
            self.effective_transport.to(like),
            self.depths.to(like),
        )

    def reflectance(self, distance: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch channels"]:
        """Radiosity at a distance from where unit flux enters [1/length²]."""
        squared = (distance * distance)[..., None]
        total: Tensor | float = 0.0
        for depth in self.depths:
            d = torch.sqrt(squared + depth * depth)
            decay = self.effective_transport * d
            total = total + depth * (1 + decay) * torch.exp(-decay) / (d * d * d)
        return total * (self.reduced_albedo / (4 * math.pi))

    def disk_reflectance(
        self, radius: Float[Tensor, "*batch"], height: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch channels"]:
        r"""Integral of the reflectance over a disk, seen from a point on its axis.

        .. math:: \int_0^a R_d\, 2\pi r\, dr = \frac{\alpha'}{2} \sum_z z \left(
            \frac{e^{-\sigma_{tr} c}}{c} - \frac{e^{-\sigma_{tr} d}}{d} \right),
            \quad c^2 = h^2 + z^2, \; d^2 = c^2 + a^2

        Args:
            radius: That of the disk [length].
            height: Distance of the point from the disk's plane [length].
        """
        radius2, height2 = (radius * radius)[..., None], (height * height)[..., None]
        total: Tensor | float = 0.0
        for depth in self.depths:
            centre = torch.sqrt(height2 + depth * depth)
            rim = torch.sqrt(height2 + depth * depth + radius2)
            inside = torch.exp(-self.effective_transport * centre) / centre
            outside = torch.exp(-self.effective_transport * rim) / rim
            total = total + depth * (inside - outside)
        return total * (self.reduced_albedo / 2)

    def mean_distance(self, radius: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch channels"]:
        r"""Mean distance from the centre within a disk, weighted by the reflectance [length].

        Two thirds of the radius where the disk is small, and a few mean free paths where it is
        large. By parts, the first moment of a source is
        :math:`z (-a\, e^{-\sigma_{tr} d}/d + \int_0^a e^{-\sigma_{tr} d} / d \; dr)`; the integral
        is taken by 16 Gauss-Legendre nodes in :math:`\operatorname{asinh}(r / z)`.

        Args:
            radius: That of the disk [length], above zero.
        """
        reach, nodes = radius[..., None], _NODES.to(radius)
        first: Tensor | float = 0.0
        zeroth: Tensor | float = 0.0
        for depth in self.depths:
            rim = torch.sqrt(reach * reach + depth * depth)
            outside = torch.exp(-self.effective_transport * rim) / rim
            half = torch.asinh(reach / depth)[..., None] / 2
            decay = (self.effective_transport * depth)[..., None] * torch.cosh(half * (1 + nodes))
            integral = (torch.exp(-decay) * half) @ _NODE_WEIGHTS.to(radius)
            first = first + depth * (integral - reach * outside)
            inside = torch.exp(-self.effective_transport * depth) / depth
            zeroth = zeroth + depth * (inside - outside)
        # Opaque enough, and both are zero in this number type; the mean is as near as can be told.
        tiny = torch.finfo(radius.dtype).tiny
        mean = torch.as_tensor(first) / torch.as_tensor(zeroth).clamp_min(tiny)
        return torch.minimum(mean.clamp_min(0.0), reach * (2 / 3))

    def total_reflectance(self) -> Float[Tensor, "channels"]:
        """Integral of the reflectance over the plane."""
        decays = torch.exp(-self.effective_transport * self.depths)
        return self.reduced_albedo / 2 * decays.sum(dim=0)


@dataclass(frozen=True)
class Medium:
    """A homogeneous, strongly scattering medium below a smooth surface.

    Raises:
        InputError: If a coefficient is not finite, negative or above 1e6 per mm, a channel has
            less than 1e-6 per mm of both together, or the refractive index is outside 1..2.2.
    """

    reduced_scattering: tuple[float, float, float]
    """Scattering times (1 - mean cosine), for linear RGB [1/mm]."""
    absorption: tuple[float, float, float]
    """For linear RGB [1/mm]; zero is allowed."""
    refractive_index: float = 1.3
    """Relative to the air outside, 1 to 2.2."""

    def __post_init__(self) -> None:
        for field in ("reduced_scattering", "absorption"):
            values = getattr(self, field)
            if len(values) != 3:
                raise InputError(f"medium.{field}: expected 3 values (rgb), got {len(values)}")
            if not all(0 <= value <= _MAX_COEFFICIENT for value in values):
                raise InputError(
                    f"medium.{field}={tuple(values)}: expected 0 to {_MAX_COEFFICIENT:.0e} per mm"
                )
        if float(self.extinction().min()) < _MIN_EXTINCTION:
            raise InputError(
                f"medium.reduced_scattering={tuple(self.reduced_scattering)}: expected, with "
                f"absorption, at least {_MIN_EXTINCTION:.0e} per mm in each channel"
            )
        if not _MIN_INDEX <= self.refractive_index <= _MAX_INDEX:
            raise InputError(
                f"medium.refractive_index={self.refractive_index}: "
                f"expected {_MIN_INDEX} to {_MAX_INDEX}"
            )

    def extinction(self) -> Float64[Tensor, "3"]:
        """Reduced extinction, scattering plus absorption [1/mm]; 1 / it is the mean free path."""
        return self._rgb(self.reduced_scattering) + self._rgb(self.absorption)

    def reduced_albedo(self) -> Float64[Tensor, "3"]:
        """Scattering over extinction, 0 to 1."""
        return self._rgb(self.reduced_scattering) / self.extinction()

    def effective_transport(self) -> Float64[Tensor, "3"]:
        """Square root of 3 x absorption x extinction [1/mm]."""
        return torch.sqrt(3 * self._rgb(self.absorption) * self.extinction())

    def diffuse_fresnel(self) -> float:
        """Share of diffuse light that the surface reflects back inside.

        The fit ``-1.440 / n² + 0.710 / n + 0.668 + 0.0636 n``, within 0.0016 of the integral of
        Fresnel's equations for n from 1 to 2.2 and off by 0.005 at 2.5.

        Source:
            Egan and Hilgeman 1973, as given by Jensen et al. 2001, section 2.1.
        """
        n = self.refractive_index
        return -1.440 / n**2 + 0.710 / n + 0.668 + 0.0636 * n

    def boundary(self) -> float:
        """``A = (1 + F) / (1 - F)`` of the diffuse Fresnel reflectance F: 1 without a boundary."""
        reflected = self.diffuse_fresnel()
        return (1 + reflected) / (1 - reflected)

    def real_depth(self) -> Float64[Tensor, "3"]:
        """Depth of the real source, one mean free path [mm]."""
        return 1 / self.extinction()

    def virtual_depth(self) -> Float64[Tensor, "3"]:
        """Height of the virtual source above the surface [mm]."""
        return self.real_depth() * (1 + 4 / 3 * self.boundary())

    def is_grey(self) -> bool:
        """Whether the three channels are the same."""
        return len({*self.reduced_scattering}) == len({*self.absorption}) == 1

    def dipole(self) -> Dipole:
        """The dipole in millimetres; one channel where the medium is grey."""
        channels = 1 if self.is_grey() else 3
        return Dipole(
            self.reduced_albedo()[:channels],
            self.effective_transport()[:channels],
            torch.stack([self.real_depth(), self.virtual_depth()])[:, :channels],
        )

    def diffuse_reflectance(self, distance: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3"]:
        """Radiosity at a distance [mm] from where unit flux enters a half-space [1/mm²]."""
        reflectance = self.dipole().to(distance).reflectance(distance)
        return reflectance.expand(*distance.shape, 3)

    def total_reflectance(self) -> Float64[Tensor, "3"]:
        r"""Radiosity of a half-space over its uniform irradiance, 0 to 1.

        .. math:: \frac{\alpha'}{2} \left(1 + e^{-\frac{4}{3} A \sqrt{3 (1 - \alpha')}}\right)
            e^{-\sqrt{3 (1 - \alpha')}}

        Source:
            Jensen et al. 2001, section 2.4 (their diffuse reflectance of uniform light).
        """
        return self.dipole().total_reflectance().expand(3)

    @staticmethod
    def _rgb(values: tuple[float, float, float]) -> Float64[Tensor, "3"]:
        return torch.tensor(tuple(values), dtype=torch.float64)


PRESETS = {
    "apple": Medium((2.29, 2.39, 1.97), (0.0030, 0.0034, 0.046)),
    "chicken1": Medium((0.15, 0.21, 0.38), (0.015, 0.077, 0.19)),
    "chicken2": Medium((0.19, 0.25, 0.32), (0.018, 0.088, 0.20)),
    "cream": Medium((7.38, 5.47, 3.15), (0.0002, 0.0028, 0.0163)),
    "ketchup": Medium((0.18, 0.07, 0.03), (0.061, 0.97, 1.45)),
    "marble": Medium((2.19, 2.62, 3.00), (0.0021, 0.0041, 0.0071), 1.5),
    "potato": Medium((0.68, 0.70, 0.55), (0.0024, 0.0090, 0.12)),
    "skimmilk": Medium((0.70, 1.22, 1.90), (0.0014, 0.0025, 0.0142)),
    "skin1": Medium((0.74, 0.88, 1.01), (0.032, 0.17, 0.48)),
    "skin2": Medium((1.09, 1.59, 1.79), (0.013, 0.070, 0.145)),
    "spectralon": Medium((11.6, 20.4, 14.9), (0.0, 0.0, 0.0)),
    "wholemilk": Medium((2.55, 3.21, 3.77), (0.0011, 0.0024, 0.014)),
}
"""Media as measured, by name: Jensen et al. 2001, figure 5.

Their rows, at two digits, give the diffuse reflectance printed beside them to within 0.01, but for
chicken1 in blue: 0.126 where 0.10 is printed.
"""
