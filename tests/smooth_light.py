"""Light without edges, whose coefficients and image are the same function."""

import math

import numpy as np
import torch

from prt_torch.bases import sh


def smooth_light(
    mean: tuple[float, float, float], spread: float, order: int
) -> tuple[torch.Tensor, np.ndarray]:
    """A positive coloured light by its coefficients and as a lat-long image, centre -z."""
    generator = torch.Generator().manual_seed(3)
    coefficients = spread * torch.randn(order**2, 3, generator=generator, dtype=torch.float64)
    coefficients[0] = torch.tensor(mean)
    rows = 256
    polar = (torch.arange(rows, dtype=torch.float64) + 0.5) * (math.pi / rows)
    azimuth = (torch.arange(2 * rows, dtype=torch.float64) + 0.5) * (math.pi / rows) - math.pi
    polar, azimuth = torch.meshgrid(polar, azimuth, indexing="ij")
    directions = torch.stack(
        [polar.sin() * azimuth.sin(), polar.cos(), -polar.sin() * azimuth.cos()], dim=-1
    )
    image = (sh.evaluate(directions, order) @ coefficients).float().numpy()
    assert image.min() > 0
    return coefficients, image
