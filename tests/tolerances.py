"""The one table of tolerances: what rounding alone may do, by element type."""

import torch

ROUNDING = {torch.float32: 2e-5, torch.float64: 1e-11}
"""Largest relative difference between two ways to compute the same thing."""

SH_EXACT = {torch.float32: 4e-5, torch.float64: 1e-12}
"""Largest absolute error of a spherical harmonic up to order 33."""

SH_ROTATION = {torch.float32: 1e-5, torch.float64: 1e-10}
"""Largest absolute error of a rotated function with unit coefficients, order 6."""
