r"""Transfer of a wrinkle: a sinusoidal groove in a plane, extruded, in closed form but for a sum.

The groove has depth d and width 1,

.. math:: h(x) = -\tfrac{d}{2} (1 + \cos 2 \pi x), \quad |x| \le \tfrac12, \qquad
          h(x) = 0 \text{ beyond.}

It does not change along the extrusion, so a direction is seen if its projection onto the cross
section is: if its angle φ lies between two horizons. With θ from the axis of extrusion the transfer
is

.. math:: \frac{1}{\pi} \int_{\varphi_r}^{\varphi_l} \int_0^\pi y_{lm}(\theta, \varphi)\,
    \sin\theta \cos(\varphi - \varphi_n)\, \sin\theta\; d\theta\, d\varphi,

both integrals by Gauss-Legendre nodes: the integrand is a short trigonometric sum, so they are
exact to rounding. Horizons are the steepest slopes to points of the profile.

The frame is tangent across the groove, bitangent along it, and the normal of the plane.

Source:
    Sloan, Luna, Snyder 2005, section 4.2, who simulate a height field.
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from prt_torch.bases import sh

_SPARE_NODES = 10  # beside one for each band; more change nothing in float64
_PROFILE = 2048  # points of the profile that horizons are sought among
_AT_ONCE = 2**11


def groove_profile(
    across: Float[Tensor, "*#batch"], depth: Float[Tensor, "*#batch"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Height and slope of the groove; its width is the unit of length.

    Args:
        across: From its middle; the groove is within half a width.
        depth: In widths.
    """
    angle = 2 * math.pi * across.clamp(-0.5, 0.5)
    return -0.5 * depth * (1 + angle.cos()), depth * math.pi * angle.sin()


def groove_horizons(
    across: Float64[Tensor, "points"], depth: Float64[Tensor, "points"]
) -> Float64[Tensor, "points 2"]:
    """Angles between which the sky is seen, from +x towards the normal [rad].

    The second counts from +x as well, so a plane has 0 and π.
    """
    height, slope = groove_profile(across, depth)
    # The rim is a point of the profile; between points the steepest slope is missed by its square.
    others = torch.linspace(-0.5, 0.5, _PROFILE + 1, dtype=torch.float64)
    distance = others - across[:, None]
    rise = groove_profile(others[None], depth[:, None])[0] - height[:, None]
    far = distance.abs() > 0.5 / _PROFILE
    slopes = rise / torch.where(far, distance.abs(), 1.0)
    right = slopes.masked_fill(~far | (distance < 0), -math.inf).amax(1)
    left = slopes.masked_fill(~far | (distance > 0), -math.inf).amax(1)
    right, left = torch.maximum(right, slope), torch.maximum(left, -slope)
    # Past the rim the plane goes on, and its horizon is level.
    right, left = right.clamp_min(0.0), left.clamp_min(0.0)
    return torch.stack([right.atan(), math.pi - left.atan()], dim=-1)


def groove_transfer(
    across: Float[Tensor, "points"], depth: Float[Tensor, "points"], order: int
) -> Float64[Tensor, "points coeffs"]:
    """Diffuse transfer, shadowed and without bounces, in the frame of the plane.

    Args:
        across: From the middle of the groove, in widths.
        depth: In widths, not negative.
        order: Bands of light.

    Raises:
        ValueError: If a depth is negative, or ``order`` is out of range.
    """
    if bool((depth < 0).any()):
        raise ValueError(f"expected depths of at least 0, got {float(depth.min()):g}")
    across, depth = across.double(), depth.double()
    pieces = zip(across.split(_AT_ONCE), depth.split(_AT_ONCE), strict=True)
    return torch.cat([_projected(x, d, order) for x, d in pieces])


def _projected(x: Tensor, d: Tensor, order: int) -> Float64[Tensor, "points coeffs"]:
    nodes, weights = map(torch.from_numpy, np.polynomial.legendre.leggauss(order + _SPARE_NODES))
    first, last = groove_horizons(x, d).unbind(-1)
    azimuth = first[:, None] + (last - first)[:, None] * (nodes + 1) / 2
    polar = (nodes + 1) * (math.pi / 2)
    sine, cosine = polar.sin(), polar.cos()
    directions = torch.stack(
        torch.broadcast_tensors(
            sine * azimuth.cos()[..., None], cosine, sine * azimuth.sin()[..., None]
        ),
        dim=-1,
    )
    facing = torch.cos(azimuth - math.pi / 2 - groove_profile(x, d)[1].atan()[:, None])
    of_azimuth = facing * weights * (last - first)[:, None] / 2
    of_polar = sine.square() * weights * (math.pi / 2)
    functions = sh.evaluate(directions, order)
    return torch.einsum("pa,t,patk->pk", of_azimuth, of_polar, functions) / math.pi
