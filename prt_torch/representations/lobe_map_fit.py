r"""Lobes of all texels of a map fitted together, so that they can be interpolated.

Fitted by themselves, lobes of neighbouring texels have no correspondence: lobe 1 here may be lobe 2
there, and what lies halfway between them is neither. So the map is fitted as it is looked up: its
axes and coefficients are interpolated to many more places than it has texels, and the squared error
there is that of all texels together. Lobes that do not match lose by themselves.

Constant and linear terms, kept beside the lobes, are a linear least-squares problem of their own.
Lobes begin where their texels fit best under a common rule and go downhill by L-BFGS, whose memory
does not grow with the square of the unknowns.

Source:
    Sloan, Luna, Snyder 2005, section 4.2, who take conjugate gradients, since the matrix of BFGS
    became too large.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from prt_torch.bases import sh, zonal
from prt_torch.representations.texture_map import TexelGrid
from prt_torch.representations.zonal_lobes_coding import Lobes

LINEAR_BANDS = 2
"""Bands that are kept beside the lobes: constant and linear."""

_HISTORY = 12
_RIDGE = 1e-6  # on weights of lobes of norm one, as their fit by texels has it
_LEAST_GAIN = 1e-7  # of the error, that a step must win


@dataclass(frozen=True)
class MapFit:
    """A map of lobes fitted as a whole.

    Attributes:
        lobes: Of the texels, float64.
        error: Norm of the error over that of the signals, at all places together.
        start_error: The same before the descent.
        steps: Evaluations.
    """

    lobes: Lobes
    error: float
    start_error: float
    steps: int


def fit_map(
    signals: Float[Tensor, "places coeffs"],
    uv: Float[Tensor, "places 2"],
    grid: TexelGrid,
    axes: Float[Tensor, "texels lobes 3"],
    coefficients: Float[Tensor, "texels lobes bands"],
    *,
    max_steps: int = 300,
) -> MapFit:
    """Fit lobes whose parameters are interpolated between texels.

    Args:
        signals: Transfer at many places, by spherical harmonics, in tangent coordinates.
        uv: Where they are on the map; every texel needs some around it.
        grid: The map.
        axes: Of the texels, where the descent begins.
        coefficients: g* of bands 2 and on, likewise.
        max_steps: Iterations of L-BFGS.

    Raises:
        ValueError: If shapes do not fit.
    """
    order = sh.order_of(signals)
    if coefficients.shape[-1] != order - LINEAR_BANDS or len(axes) != grid.num_texels:
        raise ValueError(
            f"expected lobes of {grid.num_texels} texels with {order - LINEAR_BANDS} bands, got "
            f"{len(axes)} with {coefficients.shape[-1]}"
        )
    low = LINEAR_BANDS**2
    signals, uv = signals.double(), uv.double()
    linear = interpolated_least_squares(signals[:, :low], uv, grid)
    missed = float((grid.sample(linear, uv) - signals[:, :low]).square().sum())
    problem = _Problem(signals[:, low:], uv, grid, order)
    found, before, after, steps = problem.descend(axes.double(), coefficients.double(), max_steps)
    norm = float(signals.square().sum())
    return MapFit(
        lobes=Lobes(found[0][:, None], found[1][:, None], linear[:, None]),
        error=math.sqrt((after + missed) / norm),
        start_error=math.sqrt((before + missed) / norm),
        steps=steps,
    )


def interpolated_least_squares(
    values: Float64[Tensor, "places columns"], uv: Float64[Tensor, "places 2"], grid: TexelGrid
) -> Float64[Tensor, "texels columns"]:
    """Texels whose bilinear interpolation is closest to values at many places.

    Texels that no place touches are zero.
    """
    indices, shares = grid.bilinear(uv)
    design = shares.new_zeros(len(uv), grid.num_texels).scatter_add(1, indices, shares)
    gram = design.mT @ design
    damping = 1e-12 * gram.diagonal().mean() * torch.eye(len(gram), dtype=gram.dtype)
    root = torch.linalg.cholesky(gram + damping.to(gram))
    return torch.cholesky_solve(design.mT @ values, root)


class _Problem:
    """Squared error of the bands that lobes are for."""

    def __init__(
        self, targets: Float64[Tensor, "places coeffs"], uv: Tensor, grid: TexelGrid, order: int
    ):
        self.targets, self.order = targets, order
        self.indices, self.shares = grid.bilinear(uv)
        widths = 2.0 * torch.arange(LINEAR_BANDS, order, dtype=torch.float64) + 1.0
        self.scales = (widths / (4 * math.pi)).sqrt().to(targets)

    def error(self, axes: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Squared error, and the same with the ridge; weights are of lobes of norm one."""
        units = zonal.unit_axes(axes)
        both = torch.cat([units, weights / self.scales], dim=-1)
        mixed = torch.einsum("pk,pkn...->pn...", self.shares, both[self.indices])
        filled = torch.nn.functional.pad(mixed[..., 3:], (LINEAR_BANDS, 0))
        fitted = zonal.lobes_to_sh(mixed[..., :3], filled)[:, LINEAR_BANDS**2 :]
        squared = (fitted - self.targets).square().sum()
        # Each texel's weights count as often as there are places to a texel.
        often = len(self.targets) / len(axes)
        return squared, squared + _RIDGE * often * weights.square().sum()

    @torch.enable_grad()
    def descend(
        self, axes: Tensor, coefficients: Tensor, max_steps: int
    ) -> tuple[tuple[Tensor, Tensor], float, float, int]:
        """Axes and coefficients found, the error before and after, and evaluations."""
        start = axes.clone(memory_format=torch.contiguous_format), coefficients * self.scales
        unknown = [values.contiguous().requires_grad_() for values in start]
        before = float(self.error(*unknown)[0].detach())
        solver = torch.optim.LBFGS(
            unknown,
            max_iter=max_steps,
            history_size=_HISTORY,
            tolerance_change=_LEAST_GAIN * before,
            tolerance_grad=0.0,
            line_search_fn="strong_wolfe",
        )
        norm = max(float(self.targets.square().sum()), torch.finfo(torch.float64).tiny)
        evaluations = 0

        def closure() -> Tensor:
            nonlocal evaluations
            evaluations += 1
            solver.zero_grad()
            objective = self.error(*unknown)[1] / norm
            objective.backward()
            return objective

        solver.step(closure)
        found = zonal.unit_axes(unknown[0].detach()), unknown[1].detach() / self.scales
        return found, before, float(self.error(*unknown)[0].detach()), evaluations
