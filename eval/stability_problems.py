"""Small problems that several cases share: stiff matrices, all representations, simple lights."""

import math

import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from prt_torch.assets import Environment, Mesh, concatenate, mesh_from_arrays
from prt_torch.bases import SphericalHarmonics
from prt_torch.representations import (
    CPCA,
    ClusteredTensor,
    DenseTransfer,
    Representation,
    ScatteredSRBF,
    SegmentedCPCA,
    WaveletTransfer,
    ZonalLobes,
)
from prt_torch.transfer import TransferTensor

ORDER = 6
"""Bands of the light that all representations are tried with."""


def generator(seed: int = 0) -> torch.Generator:
    """A source of randomness of its own."""
    return torch.Generator().manual_seed(seed)


def stiff_matrix(
    rows: int, columns: int, condition: float, source: torch.Generator
) -> Float[Tensor, "rows columns"]:
    """Singular values from 1 down to one over the condition, in random directions; float64."""
    values = torch.logspace(0, -math.log10(condition), columns, dtype=torch.float64)
    left = torch.randn(rows, columns, generator=source, dtype=torch.float64)
    right = torch.randn(columns, columns, generator=source, dtype=torch.float64)
    return (torch.linalg.qr(left)[0] * values) @ torch.linalg.qr(right)[0].mT


def spread_condition(seed: int, seeds: int) -> float:
    """From 1e2 at the first seed to 1e14 at the last."""
    return 10.0 ** (2.0 + 12.0 * seed / max(seeds - 1, 1))


def transfer_of(values: Float[Tensor, "points coeffs"]) -> TransferTensor:
    """Diffuse transfer in harmonics."""
    return TransferTensor.from_dense(values, light_basis=SphericalHarmonics(ORDER))


def every_representation(
    values: Float[Tensor, "points coeffs"],
) -> list[tuple[Representation, TransferTensor]]:
    """Transfer in every representation at a small budget; lobes last."""
    transfer = transfer_of(values)
    made: list[Representation] = [
        DenseTransfer.from_transfer(transfer),
        CPCA.from_transfer(transfer, num_clusters=3, rank=2),
        SegmentedCPCA.from_transfer(transfer, points_per_cluster=5, rank=2, num_segments=2),
        ClusteredTensor.from_transfer(transfer, num_clusters=3, ranks=(1, 6, 3)),
        ScatteredSRBF.from_transfer(transfer, num_clusters=2, num_functions=4, resolution=4),
        WaveletTransfer.from_transfer(transfer, num_terms=12),
        ZonalLobes.from_transfer(transfer, num_lobes=3, effort="fast"),
    ]
    return [(model.eval(), transfer) for model in made]


def light_of(transfer: TransferTensor) -> Float[Tensor, "1 coeffs 3"]:
    """Random light coefficients in the type of the transfer."""
    light = torch.randn(1, transfer.num_coeffs, 3, generator=generator(99))
    return light.to(transfer.values.dtype)


def cube_light(resolution: int, ambient: float, sun: float, dtype: torch.dtype) -> Environment:
    """The same radiance from everywhere, but for one texel above the horizon."""
    image = torch.full((6, resolution, resolution, 3), ambient, dtype=dtype)
    image[2, resolution // 3, resolution // 4] = sun
    return Environment("sun", image, "cube")


def ball_on_ground(scale: float, dtype: torch.dtype) -> Mesh:
    """A ball of 162 points over a square, of any size."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.6)
    vertices = torch.from_numpy(ball.vertices.copy()).to(dtype) * scale
    corners = [[-2, -0.7, 2], [2, -0.7, 2], [2, -0.7, -2], [-2, -0.7, -2]]
    ground = torch.tensor(corners, dtype=dtype) * scale
    return concatenate(
        [
            mesh_from_arrays("ball", vertices, torch.from_numpy(ball.faces.copy())),
            mesh_from_arrays("ground", ground, torch.tensor([[0, 1, 2], [0, 2, 3]])),
        ],
        "ball on ground",
    )
