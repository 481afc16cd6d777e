"""Descent of thousands of small fits side by side, by damped Gauss-Newton steps.

Each fit has its own damping and its own end. A step solves the linearised problem, its matrix's
diagonal raised by the damping; a step that wins about what it promised lowers the damping, one that
wins nothing is not taken and raises it. So the descent is Newton's where lobes meet the function
well, and a careful one by the gradient where they do not. Fits that have ended are set aside every
few iterations.

An iteration costs a third more than one of BFGS over axes, and half as many are needed; of as many
starts, more end in low minima, for quasi-Newton steps are lost in the long valleys of lobes that
stand in for each other.

Source:
    Sloan, Luna, Snyder 2005, section 4.1, who minimise by BFGS, one function after the other, over
    axes and coefficients. The damping is Nielsen's, "Damping parameter in Marquardt's method",
    1999.
"""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.representations.zonal_lobes_objective import Fits, LobeObjective

_LONGEST = 0.5  # turn of a lobe in one step, in radians
_DAMPING = 1e-2  # at first, of the largest entry of the diagonal
_SUFFICIENT = 1e-4  # share of the expected gain that a step must win
_SMALL_STEPS = 2  # in a row that end a fit
_FAILURES = 10  # in a row that end a fit
_BLOCK = 8192  # fits side by side
_ROUND = 3  # iterations between two looks at which fits have ended
_TINY = 1e-30


@dataclass(frozen=True)
class Descended:
    """Where fits ended.

    Attributes:
        fits: The least objectives found.
        steps: Evaluations, of all fits together.
        unfinished: Fits that were ended by the limit of iterations.
    """

    fits: Fits
    steps: int
    unfinished: int


def descend(
    objective: LobeObjective,
    axes: Float[Tensor, "lobes 3 fits"],
    *,
    max_steps: int,
    tolerance: float,
    floor: float = 0.0,
) -> Descended:
    """Local minima near these axes.

    Args:
        objective: Of as many fits.
        axes: Where to begin, of any length but zero.
        max_steps: Iterations, steps that are not taken included.
        tolerance: A step that wins a smaller share of the objective is small; two in a row end a
            fit.
        floor: A squared error, without the ridge, below which nothing is left to win.
    """
    pieces = [
        _descend_block(objective.pick(own), axes[..., own], max_steps, tolerance, floor)
        for own in torch.arange(axes.shape[-1], device=axes.device).split(_BLOCK)
    ]
    parts = (
        torch.cat([getattr(piece.fits, field.name) for piece in pieces], dim=-1)
        for field in fields(Fits)
    )
    steps, unfinished = (sum(getattr(p, n) for p in pieces) for n in ("steps", "unfinished"))
    return Descended(Fits(*parts), steps, unfinished)


def _descend_block(
    objective: LobeObjective,
    axes: Float[Tensor, "lobes 3 fits"],
    max_steps: int,
    tolerance: float,
    floor: float,
) -> Descended:
    """The descent of some fits side by side."""
    state = _State(objective, objective.evaluate(axes))
    running = torch.arange(axes.shape[-1], device=axes.device)
    result = state.at.pick(running)
    evaluations, done = axes.shape[-1], 0
    while done < max_steps and len(running):
        for _ in range(min(_ROUND, max_steps - done)):
            state.step(tolerance, floor)
            done += 1
            evaluations += len(running)
        ended = state.ended
        _write(result, running[ended], state.at.pick(ended))
        running = running[~ended]
        state.keep(~ended)
    _write(result, running, state.at)
    return Descended(result, evaluations, len(running))


def _write(into: Fits, where: Tensor, new: Fits) -> None:
    for field in fields(Fits):
        getattr(into, field.name)[..., where] = getattr(new, field.name)


class _State:
    """Running fits: places, dampings, how often in a row they won little or nothing."""

    def __init__(self, objective: LobeObjective, at: Fits):
        self.objective, self.at = objective, at
        diagonal = at.curvature.diagonal(dim1=0, dim2=1)  # fits turns
        self.damping = _DAMPING * diagonal.amax(1).clamp_min(1e-12)
        self.failures = torch.zeros_like(at.objective)
        self.small = torch.zeros_like(at.objective)
        self.ended = torch.zeros_like(at.objective, dtype=torch.bool)

    def keep(self, which: Tensor) -> None:
        """Go on with some of the fits."""
        self.objective, self.at = self.objective.pick(which), self.at.pick(which)
        for name in ("damping", "failures", "small", "ended"):
            setattr(self, name, getattr(self, name)[which])

    def step(self, tolerance: float, floor: float) -> None:
        """Try one step of each fit."""
        at = self.at
        turns = -_solve(at.curvature, at.slope, self.damping)
        by_lobe = turns.view(len(at.axes), 2, 1, -1)
        longest = by_lobe.square().sum(1).amax((0, 1)).sqrt()
        shorter = _LONGEST / longest.clamp_min(_LONGEST)
        trial = self.objective.evaluate(at.axes + shorter * (by_lobe * at.tangents).sum(1))
        turns = shorter * turns
        bent = (turns * (at.curvature * turns).sum(1)).sum(0)
        promised = (-2.0 * (at.slope * turns).sum(0) - bent).clamp_min(_TINY)
        won = at.objective - trial.objective
        share = won / promised
        better = (won > 0) & (share > _SUFFICIENT) & ~self.ended
        # less damping the better the promise was kept, twice or more of it where it was not at all
        factor = (1.0 - (2.0 * share.clamp(0.0, 2.0) - 1.0) ** 3).clamp(0.2, 2.0)
        raised = 2.0 ** (self.failures + 1.0)
        self.damping = self.damping * torch.where(better, factor, raised)
        self.failures = torch.where(better, 0.0, self.failures + 1.0)
        limit = tolerance * at.objective.clamp_min(_TINY)
        small = torch.where(better, won, promised) <= limit
        self.small = torch.where(small, self.small + 1.0, torch.where(better, 0.0, self.small))
        self.at = at.replaced(better, trial)
        self.ended |= (self.small >= _SMALL_STEPS) | (self.failures >= _FAILURES)
        self.ended |= self.objective.squared_error(self.at) <= floor


def _solve(
    matrices: Float[Tensor, "turns turns fits"],
    right: Float[Tensor, "turns fits"],
    damping: Float[Tensor, "fits"],
) -> Float[Tensor, "turns fits"]:
    """Solutions with the diagonal raised, by elimination."""
    rest, values = matrices.clone(), right.clone()
    rest.diagonal(dim1=0, dim2=1).add_(damping[:, None])
    count = len(right)
    columns: list[Tensor] = []
    pivots: list[Tensor] = []
    for k in range(count):
        pivot = rest[k, k].maximum(damping)  # below it by rounding alone
        column = rest[k + 1 :, k] / pivot
        rest[k + 1 :, k + 1 :].addcmul_(column[:, None], rest[k + 1 :, k].clone(), value=-1.0)
        values[k + 1 :].addcmul_(column, values[k], value=-1.0)
        columns.append(column)
        pivots.append(pivot)
    for k in reversed(range(count)):
        values[k] /= pivots[k]
        values[k] -= (columns[k] * values[k + 1 :]).sum(0)
    return values
