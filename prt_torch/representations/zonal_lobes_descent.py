"""Quasi-Newton descent of thousands of small fits side by side.

Each fit has its own approximation of the inverse Hessian, its own step length and its own end. An
iteration evaluates all running fits once: a step that does not win enough is shortened where it
failed, while others go on. Fits that have ended are set aside every few iterations.

Source:
    Sloan, Luna, Snyder 2005, section 4.1, who minimise by BFGS, one function after the other, over
    axes and coefficients; of the axes alone, the problem has a third of the unknowns.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.representations.zonal_lobes_objective import Fits, LobeObjective

_LONGEST = 0.5  # turn of a lobe in one step, in radians
_FIRST = 0.2  # turn of the first step
_SUFFICIENT = 1e-4  # share of the expected gain that a step must win
_SMALL_STEPS = 2  # in a row that end a fit
_SHORTEST = 1e-7  # share of a step that is worth trying
_ROUND = 6  # iterations between two looks at which fits have ended


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
        max_steps: Iterations, shortened steps included.
        tolerance: A step that wins a smaller share of the objective is small; two in a row end a
            fit.
        floor: An objective below which nothing is left to win.
    """
    result = objective.evaluate(axes / axes.square().sum(1, keepdim=True).sqrt())
    running = torch.arange(axes.shape[-1], device=axes.device)
    state = _State(objective, result)
    evaluations, done = axes.shape[-1], 0
    while done < max_steps and len(running):
        for _ in range(min(_ROUND, max_steps - done)):
            state.step(tolerance, floor)
            done += 1
            evaluations += len(running)
        ended = state.ended
        some = running[ended]
        result = _written(result, some, state.at.pick(ended))
        running = running[~ended]
        state.keep(~ended)
    return Descended(_written(result, running, state.at), evaluations, len(running))


def _written(into: Fits, where: Tensor, new: Fits) -> Fits:
    for name in ("axes", "objective", "gradient", "weights"):
        getattr(into, name)[..., where] = getattr(new, name)
    return into


class _State:
    """Running fits: places, inverse Hessians "unknowns unknowns fits", step lengths."""

    def __init__(self, objective: LobeObjective, at: Fits):
        self.objective, self.at = objective, at
        unknowns = at.axes.shape[0] * 3
        scale = _FIRST / at.gradient.square().sum((0, 1)).sqrt().clamp_min(1e-12)
        eye = torch.eye(unknowns, dtype=at.axes.dtype, device=at.axes.device)
        self.inverse = eye[..., None] * scale
        self.fresh = torch.ones_like(at.objective, dtype=torch.bool)
        self.length = torch.ones_like(at.objective)
        self.small = torch.zeros_like(at.objective)
        self.ended = torch.zeros_like(self.fresh)

    def keep(self, which: Tensor) -> None:
        """Go on with some of the fits."""
        self.objective, self.at = self.objective.pick(which), self.at.pick(which)
        for name in ("inverse", "fresh", "length", "small", "ended"):
            setattr(self, name, getattr(self, name)[..., which])

    def step(self, tolerance: float, floor: float) -> None:
        """Try one step of each fit."""
        at = self.at
        gradient = at.gradient.flatten(0, 1)
        direction = -(self.inverse * gradient).sum(1)
        slope = (direction * gradient).sum(0)
        turns = direction.view_as(at.axes).square().sum(1).amax(0).sqrt()
        shorter = self.length * (_LONGEST / turns.clamp_min(_LONGEST))
        trial = self.objective.evaluate(at.axes + (shorter * direction).view_as(at.axes))
        won = at.objective - trial.objective
        better = (won >= -_SUFFICIENT * shorter * slope) & (won > 0) & ~self.ended
        small = won <= tolerance * at.objective.clamp_min(1e-30)
        self._update(better, shorter * direction, trial.gradient.flatten(0, 1) - gradient)
        # the minimum of the parabola through both values and the slope, within limits
        share = -0.5 * slope * shorter / (-won - slope * shorter).clamp_min(1e-30)
        self.length = torch.where(better, 1.0, self.length * share.clamp(0.1, 0.5))
        self.at = at.replaced(better, trial)
        self.small = torch.where(better, torch.where(small, self.small + 1, 0.0), self.small)
        self.ended |= (self.small >= _SMALL_STEPS) | (self.length < _SHORTEST)
        self.ended |= self.at.objective <= floor

    def _update(self, where: Tensor, step: Tensor, change: Tensor) -> None:
        """BFGS of the inverse Hessian, where a step was taken along positive curvature."""
        curvature = (step * change).sum(0)
        squared = change.square().sum(0)
        usable = where & (curvature > 1e-10 * (squared * step.square().sum(0)).sqrt())
        safe = torch.where(usable, curvature, 1.0)
        first = torch.where(usable & self.fresh, curvature / squared.clamp_min(1e-30), 0.0)
        scale = torch.where(
            first > 0, first / self.inverse[0, 0].clamp_min(1e-30), torch.ones_like(first)
        )
        self.inverse.mul_(scale)
        self.fresh &= ~usable
        mapped = (self.inverse * change).sum(1)
        factor = torch.where(usable, 1.0 / safe, 0.0)
        half = 0.5 * factor * (1.0 + factor * (change * mapped).sum(0))
        other = half * step - factor * mapped
        self.inverse.addcmul_(other[:, None], step[None]).addcmul_(step[:, None], other[None])
