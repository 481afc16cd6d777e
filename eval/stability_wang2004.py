"""Extremes of Wang, Tran, Luebke 2004: eigenvalues that differ in sign only, frames at a pole."""

import math

import torch
from stability_case import (
    Collection,
    Outcome,
    at_most,
    exactly,
    near,
    not_finite,
    rounding,
)
from torch import Tensor

from prt_torch.assets.brdf import AshikhminShirley
from prt_torch.bases import HemisphereMap
from prt_torch.bases.brdf_factoring import Target, leading_eigenpairs
from prt_torch.sphere import frame_from_normal

CASES = Collection("Wang 2004")
_MATERIAL = AshikhminShirley(specular=0.75, diffuse=0.5, exponent_u=10.0, exponent_v=100.0)


def _matrix(resolution: int, dtype: torch.dtype) -> Tensor:
    """Values of the material for all pairs of texel centres, without a clamp."""
    directions, used = HemisphereMap("orthographic", resolution).centres()
    target = Target([_MATERIAL], cosine=False)
    blocks = target.blocks(directions[used], directions[used])
    return torch.cat([values[:, 0, 0] for _, values in blocks]).to(dtype)


def _residual(matrix: Tensor, eigenvalues: Tensor, vectors: Tensor) -> float:
    """Largest norm of what should be zero, over the largest eigenvalue."""
    left = matrix @ vectors - vectors * eigenvalues
    return float(left.norm(dim=0).max() / eigenvalues.abs().max().clamp_min(1e-300))


@CASES.case(
    "opposite-eigenvalues",
    given="diag(1, -1, 0.5), three terms",
    required="1, -1, 0.5; the printed power iteration returns -0.049, 1.024, -0.974",
)
def opposite_eigenvalues(dtype: torch.dtype) -> Outcome:
    """The smallest matrix that power iteration cannot take apart."""
    eigenvalues, _ = leading_eigenpairs(torch.diag(torch.tensor([1.0, -1.0, 0.5], dtype=dtype)), 3)
    found = sorted(eigenvalues.tolist())
    worst = max(abs(one - other) for one, other in zip(found, (-1.0, 0.5, 1.0), strict=True))
    return Outcome((at_most("largest error of an eigenvalue", worst, 4 * rounding(dtype)),))


@CASES.case(
    "opposite-eigenvalues-of-a-material",
    given="Ashikhmin-Shirley without a clamp at 16 x 16: terms 3 and 4 are -51.7893 and 51.7893",
    required="both; the printed power iteration returns -7.67 and 55.20",
)
def material_16(dtype: torch.dtype) -> Outcome:
    """Third and fourth eigenvalue by magnitude."""
    matrix = _matrix(16, dtype)
    eigenvalues, vectors = leading_eigenpairs(matrix, 4)
    low, high = sorted(eigenvalues[2:].tolist())
    return Outcome(
        (
            near("lower", low, -51.7893, 2e-6),
            near("upper", high, 51.7893, 2e-6),
            at_most("residual", _residual(matrix, eigenvalues, vectors), 100 * rounding(dtype)),
        ),
        condition=abs(high / (abs(high) - abs(low))) if abs(high) != abs(low) else math.inf,
        note="the condition is that of telling the two vectors apart by magnitude",
    )


@CASES.case(
    "close-eigenvalues-of-a-material",
    given="the same at 48 x 48: terms 6 and 7 are -241.98475 and 241.98364",
    required="both; the printed power iteration returns 29.05 and -255.20",
    seconds=90.0,
)
def material_48(dtype: torch.dtype) -> Outcome:
    """Sixth and seventh of eight eigenvalues of 1804 texels."""
    matrix = _matrix(48, dtype)
    eigenvalues, vectors = leading_eigenpairs(matrix, 8)
    found = eigenvalues.tolist()
    low = min(found, key=lambda one: abs(one + 241.98475))
    high = min(found, key=lambda one: abs(one - 241.98364))
    # Printed to 5 digits; beyond them eigenvalues keep the digits of the largest.
    slack = 3e-8 + 20 * rounding(dtype) * abs(found[0]) / 242.0
    return Outcome(
        (
            near("lower", low, -241.98475, slack),
            near("upper", high, 241.98364, slack),
            at_most("residual", _residual(matrix, eigenvalues, vectors), 100 * rounding(dtype)),
        ),
        condition=abs(high / (high + low)) if high + low else math.inf,
    )


@CASES.case(
    "matrix-of-rank-0-and-1",
    given="a matrix of zeros and one of rank 1, three terms",
    required="eigenvalues 0, maps 0, no NaN; terms beyond the rank exactly 0",
)
def ranks_0_and_1(dtype: torch.dtype) -> Outcome:
    """Terms are products of maps with the root of the magnitude of an eigenvalue."""
    column = torch.linspace(0.1, 1.0, 20, dtype=dtype)[:, None]
    checks = []
    for name, scale in (("rank 0", 0.0), ("rank 1", 1.0), ("rank 1, tiny", 1e-30)):
        eigenvalues, vectors = leading_eigenpairs(scale * (column @ column.mT), 3)
        maps = vectors * eigenvalues.abs().sqrt()
        beyond = maps if scale == 0.0 else maps[:, 1:]
        checks.append(exactly(f"largest map beyond, {name}", beyond.abs().max(), 0.0))
        checks.append(exactly(f"numbers not finite, {name}", not_finite([maps]), 0))
    return Outcome(tuple(checks))


@CASES.case(
    "frame-at-the-pole",
    given="normal (0, -1, 0), and normals 1e-4 to 1e-30 rad from it",
    required="tangent (1, 0, 0) and no NaN at the pole; an orthonormal frame beside it",
)
def frame_at_the_pole(dtype: torch.dtype) -> Outcome:
    """Orthonormality, the pole's own frame, and gradients."""
    angles = torch.tensor([1e-2, 1e-4, 1e-6, 1e-10, 1e-19, 1e-30, 0.0], dtype=torch.float64)
    azimuths = torch.linspace(0.0, 6.0, 7, dtype=torch.float64)[:, None]
    level = [angles.sin() * azimuths.cos(), angles.sin() * azimuths.sin()]
    normals = torch.stack([level[0], -angles.cos() + 0 * level[0], level[1]], dim=-1)
    normals = normals.view(-1, 3).to(dtype).requires_grad_()
    frames = frame_from_normal(normals)
    off = frames @ frames.mT - torch.eye(3, dtype=dtype)
    pole = frame_from_normal(torch.tensor([0.0, -1.0, 0.0], dtype=dtype))
    tangent = torch.tensor([1.0, 0.0, 0.0], dtype=dtype)
    slopes = torch.autograd.grad(frames.sum(), normals)
    return Outcome(
        (
            at_most("largest departure from orthonormal", off.abs().max(), 8 * rounding(dtype)),
            exactly("tangent at the pole", (pole[0] - tangent).abs().max(), 0.0),
            exactly("numbers and gradients not finite", not_finite([frames, *slopes]), 0),
        )
    )


@CASES.case(
    "exponent-0-over-0",
    given="Ashikhmin-Shirley where the half vector is the normal: exponent 0 / 0 of a base 1",
    required="the power is 1",
)
def exponent_0_over_0(dtype: torch.dtype) -> Outcome:
    """Light and view at the normal, and mirroring each other; beside these the same to rounding."""
    angles = torch.tensor([0.0, 0.3, 1.2], dtype=torch.float64)
    wi = torch.stack([angles.sin(), 0 * angles, angles.cos()], dim=-1).to(dtype).requires_grad_()
    wo = wi.detach() * wi.new_tensor((-1.0, 1.0, 1.0))
    only = AshikhminShirley(specular=0.75, diffuse=0.0, exponent_u=10.0, exponent_v=100.0)
    found = only.evaluate(wi, wo)[:, 0]
    cosines = angles.cos()
    fresnel = 0.75 + 0.25 * (1.0 - cosines) ** 5
    expected = math.sqrt(11.0 * 101.0) / (8 * math.pi) * fresnel / cosines.square()
    error = float((found.detach().double() / expected - 1.0).abs().max())
    slopes = torch.autograd.grad(found.sum(), wi)
    return Outcome(
        (
            at_most("relative error", error, 64 * rounding(dtype)),
            exactly("numbers and gradients not finite", not_finite([found.detach(), *slopes]), 0),
        )
    )
