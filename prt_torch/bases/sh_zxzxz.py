r"""Rotation of spherical harmonics at every point by its own matrix, as five turns around z and x.

Around z a turn by α mixes only the two harmonics ±m of a band, by mα. Around any other axis a whole
band mixes, unless the turn is a quarter around x: it takes y to z, so what is even in y becomes
even in z, and what is even in z becomes even in y, which leaves a quarter of the matrix. So

.. math:: R = Z(\alpha)\, X(90°)\, Z(\beta)\, X(-90°)\, Z(\gamma)

takes three cheap steps and two sparse constant ones. It never forms a matrix a point, which
:func:`prt_torch.bases.sh.rotation_matrix` does.

Angles appear as cosine and sine only. Where β is 0 or π the other two are not unique; γ is then
read from what α leaves of R, so any α does and the product is R to rounding. Gradients do not go
through the angles: a small turn by w before R changes the result by
:math:`D(R) \sum_k w_k J_k c`, with generators J of the turns around x, y and z, so no rotation is
singular.

Source:
    Sloan, Luna, Snyder 2005, section 3.4.
"""

import math
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from prt_torch.bases import sh
from prt_torch.bases.tables import kept

_QUARTER = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))  # +y to +z, around x


def rotate(
    harmonics: Float[Tensor, "*#batch coeffs"], rotation: Float[Tensor, "*#batch 3 3"]
) -> Float[Tensor, "*out coeffs"]:
    """Coefficients of f(R⁻¹ s): each function turned by its own rotation.

    Batch axes broadcast: one rotation may turn many functions, or many one.

    Args:
        harmonics: Spherical-harmonic coefficients.
        rotation: Rotation matrices; not checked for orthogonality. Gradients are those along
            rotations, three of the nine dimensions, and finite everywhere.

    Returns:
        Coefficients in the dtype of ``harmonics``.

    Raises:
        ValueError: If the number of coefficients is not a square.

    Source:
        Sloan, Luna, Snyder 2005, section 3.4. A turn around z of band l takes l turns of pairs,
        where the paper says l - 1. Our γ is read so that it makes up for rounding in α.
    """
    sh.order_of(harmonics)
    shape = torch.broadcast_shapes(harmonics.shape[:-1], rotation.shape[:-2])
    functions = harmonics.expand(*shape, -1).reshape(-1, harmonics.shape[-1])
    rotations = rotation.expand(*shape, 3, 3).reshape(-1, 3, 3)
    return _Turn.apply(functions.mT, rotations).mT.reshape(*shape, harmonics.shape[-1])


def multiplications(order: int) -> int:
    """Multiplications of one such rotation, written out in scalars for ``order`` bands.

    Nine for the linear band, which R turns as a vector (:func:`rotate` treats it as the others). In
    each further band 4l for each of three turns around z, one for each entry of two quarter turns,
    and six for the next cos mα and sin mα of three angles by Chebyshev's recurrence. Taking the
    angles' cosines and sines from R is not counted.

    Raises:
        ValueError: If ``order`` is below 2.

    Source:
        Sloan, Luna, Snyder 2005, the table of section 3.4, which it reproduces for n = 3 to 9.
    """
    if order < 2:
        raise ValueError(f"expected at least two bands, got {order}")
    entries = {band: int(quarter_turn_pattern(band).sum()) for band in range(2, order)}
    return 9 + sum(3 * 4 * band + 2 * count + 6 for band, count in entries.items())


def quarter_turn_pattern(band: int) -> Bool[Tensor, "m m"]:
    """Which entries of the quarter turn around x of a band can be other than zero.

    A harmonic is even or odd in y, which becomes z, and in z, which becomes y. In numbers,
    ``l² + l + 1`` of ``(2l + 1)²``.
    """
    m = torch.arange(-band, band + 1)
    even_in_y, even_in_z = m >= 0, (band + m) % 2 == 0
    y_to_z = even_in_z[:, None] == even_in_y
    z_to_y = even_in_y[:, None] == even_in_z
    return y_to_z & z_to_y


@kept
def quarter_turn(order: int) -> tuple[Int[Tensor, "2 entries"], Float[Tensor, "entries"]]:
    """Entries of the quarter turn around x of all bands: rows and columns, values in float64.

    It takes +y to +z; its transpose turns back.

    Raises:
        ValueError: If ``order`` is out of range.
    """
    matrix = sh.rotation_matrix(torch.tensor(_QUARTER, dtype=torch.float64), order)
    places = [quarter_turn_pattern(band).nonzero() + band * band for band in range(order)]
    rows, columns = torch.cat(places).mT
    return torch.stack([rows, columns]), matrix[rows, columns]


@kept
def _degrees_about_z(order: int) -> Int[Tensor, "coeffs"]:
    """The m of each coefficient."""
    return torch.cat([torch.arange(-band, band + 1) for band in range(order)])


@kept
def _partners(order: int) -> Int[Tensor, "coeffs"]:
    """Index of the harmonic of opposite m in the same band."""
    return torch.arange(order * order) - 2 * _degrees_about_z(order)


def _quarter(
    functions: Float[Tensor, "coeffs points"], *, back: bool
) -> Float[Tensor, "coeffs points"]:
    """A quarter turn around x, +y to +z, or back."""
    count = len(functions)
    places, values = quarter_turn(math.isqrt(count))
    rows_and_columns = (places.flip(0) if back else places).to(functions.device)
    matrix = torch.sparse_coo_tensor(
        rows_and_columns, values.to(functions), (count, count), check_invariants=True
    )
    return torch.sparse.mm(matrix, functions)


def _multiples(
    cosine: Float[Tensor, "points"], sine: Float[Tensor, "points"], order: int
) -> Float[Tensor, "2 degrees points"]:
    """Of an angle α: cos mα and -sin mα for m of 1 - order to order - 1."""
    cosines, sines = [torch.ones_like(cosine), cosine], [torch.zeros_like(sine), sine]
    twice = cosine + cosine
    for m in range(2, order):
        cosines.append(twice * cosines[m - 1] - cosines[m - 2])
        sines.append(twice * sines[m - 1] - sines[m - 2])
    even, odd = torch.stack(cosines[:order]), torch.stack(sines[:order])
    return torch.stack([torch.cat([even[1:].flip(0), even]), torch.cat([odd[1:].flip(0), -odd])])


def _about_z(
    functions: Float[Tensor, "coeffs points"], multiples: Float[Tensor, "2 degrees points"]
) -> Float[Tensor, "coeffs points"]:
    """A turn around z by the angle of :func:`_multiples`."""
    order = math.isqrt(len(functions))
    device = functions.device
    rows = _degrees_about_z(order).to(device) + order - 1
    swapped = functions[_partners(order).to(device)]
    return multiples[0, rows] * functions + multiples[1, rows] * swapped


def _turn(
    functions: Float[Tensor, "coeffs points"], rotations: Float[Tensor, "points 3 3"]
) -> Float[Tensor, "coeffs points"]:
    """Each function turned by its rotation; no gradients with respect to the rotations."""
    order = math.isqrt(len(functions))
    turns = [
        _multiples(cosine, sine, order).to(functions)
        for cosine, sine in _zxzxz_angles(rotations.to(torch.float64))
    ]
    turned = _quarter(_about_z(functions, turns[2]), back=True)
    return _about_z(_quarter(_about_z(turned, turns[1]), back=False), turns[0])


def _zxzxz_angles(
    rotations: Float[Tensor, "points 3 3"],
) -> list[tuple[Float[Tensor, "points"], Float[Tensor, "points"]]]:
    """Cosine and sine of α, β and γ."""
    (xx, xy, xz), (yx, yy, yz), (_, _, zz) = (row.unbind(-1) for row in rotations.unbind(-2))
    radius = torch.hypot(xz, yz)
    upright = radius < torch.finfo(radius.dtype).tiny
    safe = torch.where(upright, 1.0, radius)
    cosine, sine = torch.where(upright, 1.0, xz / safe), torch.where(upright, 0.0, yz / safe)
    return [
        (cosine, sine),
        (zz, -radius),
        (cosine * yy - sine * xy, cosine * yx - sine * xx),
    ]


def _spin_z(functions: Float[Tensor, "coeffs points"]) -> Float[Tensor, "coeffs points"]:
    """Rate of change by a turn around z."""
    order = math.isqrt(len(functions))
    degrees, partners = _degrees_about_z(order), _partners(order)
    return functions[partners.to(functions.device)] * -degrees[:, None].to(functions)


def _spin_y(functions: Float[Tensor, "coeffs points"]) -> Float[Tensor, "coeffs points"]:
    """Rate of change by a turn around y: the quarter turn takes z to -y."""
    return -_quarter(_spin_z(_quarter(functions, back=True)), back=False)


def _spins(functions: Float[Tensor, "coeffs points"]) -> list[Float[Tensor, "coeffs points"]]:
    """Rates of change by turns around x, y and z; x is the commutator of y and z."""
    about_y, about_z = _spin_y(functions), _spin_z(functions)
    return [_spin_y(about_z) - _spin_z(about_y), about_y, about_z]


class _Turn(torch.autograd.Function):
    """:func:`_turn` with the gradients of the module's head, of any order."""

    @staticmethod
    def forward(ctx: Any, functions: Tensor, rotations: Tensor) -> Tensor:
        ctx.save_for_backward(functions, rotations)
        return _turn(functions, rotations)

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor, Tensor | None]:
        functions, rotations = ctx.saved_tensors
        turned_back = _Turn.apply(slopes[0], rotations.mT)
        if not ctx.needs_input_grad[1]:
            return turned_back, None
        spun = [(turned_back * spin).sum(dim=0) for spin in _spins(functions)]
        along = torch.stack(spun, dim=-1).to(rotations)
        columns = torch.eye(3, dtype=along.dtype, device=along.device).expand(len(along), 3, 3)
        skew = torch.linalg.cross(along[:, None, :].expand_as(columns), columns, dim=-1).mT
        return turned_back, 0.5 * rotations @ skew
