r"""Angles that measured reflectance is tabulated in, with gradients everywhere.

Tables of isotropic materials use half and difference angles, in which lobes follow the axes:
with the half vector :math:`h \propto \omega_i + \omega_o`, :math:`\theta_h` is its angle to the
normal, :math:`\theta_d` the angle between it and either direction, and :math:`\phi_d` the azimuth
of :math:`\omega_i` about it. Exchanging the directions adds half a turn to :math:`\phi_d` and
changes nothing else; a mirrored pair has :math:`-\phi_d`.

Angles are undefined or have infinite slope at their poles. Here they come from the smallest
vectors that still have a direction: closer to the pole nothing changes and gradients are zero.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import embedding

_POLE = 1e-7  # radians; its square is still a normal number in float32


def polar_angle(directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Angle to the z axis [radians], at least 1e-7; accurate at the pole and at the horizon.

    Args:
        directions: Vectors of any length but zero.
    """
    return length_angle(directions[..., :2].square().sum(-1), directions[..., 2])


def length_angle(
    across_squared: Float[Tensor, "*batch"], along: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """Angle of a right triangle from the square of one side and the other side [radians].

    Args:
        across_squared: The square of the side opposite to the angle.
        along: The side beside the angle.
    """
    return torch.atan2(across_squared.clamp(min=_POLE**2).sqrt(), along)


def azimuth(y: Float[Tensor, "*batch"], x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """``atan2(y, x)`` from -π to π, and 0 where the vector is shorter than 1e-12."""
    defined = y * y + x * x > 1e-24
    return torch.atan2(torch.where(defined, y, 0.0), torch.where(defined, x, 1.0))


def half_difference(
    wi: Float[Tensor, "*batch 3"], wo: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    r"""Half and difference angles :math:`\theta_h, \theta_d` (0 to π/2), :math:`\phi_d` (-π to π).

    No vector is turned: along the axes across h that point down the slope and around the normal,
    the components of :math:`\omega_i - \omega_o` times :math:`\sin\theta_h` are
    :math:`\omega_{o,z} - \omega_{i,z}` and a cross product.

    Args:
        wi: Unit vectors above the surface.
        wo: Unit vectors above the surface.

    Source:
        :cite:`rusinkiewicz1998change`.
    """
    total, difference = wi + wo, wi - wo
    length = total.square().sum(-1).sqrt()
    around = 2.0 * (wi[..., 1] * wo[..., 0] - wi[..., 0] * wo[..., 1]) / length
    return (
        polar_angle(total),
        length_angle(difference.square().sum(-1), length),
        azimuth(around, wo[..., 2] - wi[..., 2]),
    )


def split_index(
    position: Float[Tensor, "*batch"], count: int
) -> tuple[Tensor, Float[Tensor, "*batch"]]:
    """The node below a position and the share of the node above.

    Args:
        position: In units of nodes; taken into 0 to ``count - 1``.
        count: Nodes, at least 2.
    """
    inside = position.clamp(0.0, count - 1.0)
    below = inside.detach().floor().clamp(max=count - 2.0)
    return below.long(), inside - below


def trilinear(
    table: Float[Tensor, "a b c channels"],
    a: Float[Tensor, "*batch"],
    b: Float[Tensor, "*batch"],
    c: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch channels"]:
    """Interpolate a table between its nodes; beyond its ends it stays as at the ends.

    Args:
        table: Values at nodes, at least two along each axis.
        a: Positions along the first axis, in units of nodes.
        b: Positions along the second.
        c: Positions along the third.
    """
    rows = table.flatten(0, 2)
    (index_a, share_a), (index_b, share_b), (index_c, share_c) = (
        split_index(at, count) for at, count in zip((a, b, c), table.shape, strict=False)
    )
    stride_b, stride_a = table.shape[2], table.shape[1] * table.shape[2]
    first = index_a * stride_a + index_b * stride_b + index_c
    across, along = share_b[..., None], share_c[..., None]

    def face(start: Tensor) -> Tensor:
        near = torch.lerp(embedding(start, rows), embedding(start + 1, rows), along)
        further = start + stride_b
        far = torch.lerp(embedding(further, rows), embedding(further + 1, rows), along)
        return torch.lerp(near, far, across)

    return torch.lerp(face(first), face(first + stride_a), share_a[..., None])
