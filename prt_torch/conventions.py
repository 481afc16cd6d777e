"""Frames, orders, signs and units, stated once.

World frame
    Right-handed, +y up, -z ahead (as light probes and glTF have it). A direction ``s`` is a
    unit vector that points *away* from the surface; light from ``s`` travels along ``-s``.
    Lengths are in mesh units, radiance in linear RGB.

Shading frame
    z is the normal. A *frame* is a rotation matrix whose rows are tangent, bitangent and
    normal in world coordinates, so ``frame @ world`` is local and ``frame.T @ local`` is world.

Spherical harmonics
    Real, orthonormal, without the Condon-Shortley phase, at index ``l * (l + 1) + m``:
    band 1 is ``0.4886 * (y, z, x)``. "Order n" means the bands ``l = 0 .. n - 1``, n² functions.

Cube maps
    ``"6 row col"``, faces +x, -x, +y, -y, +z, -z with OpenGL's in-face axes. For (u, v) in
    (-1, 1) growing with col and row, the direction before normalising is given by
    :data:`CUBE_FACES`. Texels weigh their exact solid angle; the weights sum to 4π.

Latitude-longitude maps
    Top row +y, centre -z, +x to the right of the centre (at three quarters of the width).

Transfer
    Includes BRDF, cosine, visibility and solid angle, so radiance is transfer times light.
    Diffuse BRDF is reflectance / π; a reflectance that factors out multiplies at the end.
    Values are expansion coefficients in the light basis, light is the vector of its inner
    products with the basis functions; norms of transfer go through the basis' Gram matrix.
"""

import torch

CUBE_FACE_NAMES = ("+x", "-x", "+y", "-y", "+z", "-z")

CUBE_FACES = torch.tensor(
    [
        # constant,      times u,      times v
        [[+1, 0, 0], [0, 0, -1], [0, -1, 0]],
        [[-1, 0, 0], [0, 0, +1], [0, -1, 0]],
        [[0, +1, 0], [+1, 0, 0], [0, 0, +1]],
        [[0, -1, 0], [+1, 0, 0], [0, 0, -1]],
        [[0, 0, +1], [+1, 0, 0], [0, -1, 0]],
        [[0, 0, -1], [-1, 0, 0], [0, -1, 0]],
    ],
    dtype=torch.float64,
)
"""``"face term axis"``: direction = constant + u * du + v * dv, before normalising."""


def sh_index(band: int, m: int) -> int:
    """Index in a coefficient vector of the spherical harmonic of degree ``band``, order ``m``."""
    return band * (band + 1) + m
