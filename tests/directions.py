"""Directions above the surface, for tests of materials."""

import math

import torch


def directions(cosine, azimuth=0.7) -> torch.Tensor:
    z = torch.as_tensor(cosine, dtype=torch.float64)
    angle = torch.as_tensor(azimuth, dtype=torch.float64).expand_as(z)
    level = torch.sqrt((1 - z) * (1 + z))
    return torch.stack([level * angle.cos(), level * angle.sin(), z], dim=-1)


def random_directions(count: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    z, turn = torch.rand(2, count, generator=generator, dtype=torch.float64)
    return directions(z.clamp(min=1e-6), 2 * math.pi * turn)
