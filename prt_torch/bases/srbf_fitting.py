"""Light as few spherical radial basis functions, wherever and as wide as it needs them.

A light of a few small bright sources needs few functions, if they may stand anywhere and be of any
width: six numbers each, two of the centre, one of the width and three of the colour. The fit
eliminates colours (:mod:`prt_torch.bases.srbf_objective`), takes damped Gauss-Newton steps in
centres and widths together, and between short runs of them moves functions of no use to where the
residual is (:mod:`prt_torch.bases.srbf_seeds`). Several lights are fitted side by side, each with
its own damping and its own end.

Source:
    Tsai, Shih 2006, section 5.3. The paper alternates L-BFGS-B over centres and over widths with
    least squares, for up to nine minutes a light. It also fits coarse maps first; measured, this
    costs more than it saves here, so only seeds come from the coarser map.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases.base import Radiance
from prt_torch.bases.cube import CubeDirections
from prt_torch.bases.srbf_kernels import KernelName, check_kernel
from prt_torch.bases.srbf_light import SRBFExpansion
from prt_torch.bases.srbf_objective import (
    Projected,
    TexelObjective,
    bandwidths_from_widths,
    widths_from_bandwidths,
)
from prt_torch.bases.srbf_seeds import coverage_seeds, relocate
from prt_torch.sphere import cubemap_directions, frame_from_normal

Status = Literal["converged", "max_steps", "stagnated"]

_SMALL_STEPS = 2  # in a row that end a run
_EXACT = 1e-14  # objective below which nothing is left to fit
_ROUND_STEPS = 3  # between two relocations
_ROUND_SHARE = 0.25  # of functions that the first relocation moves; later ones fewer
_ROUND_GAIN = 0.01  # a round that wins less ends the relocations of a warm start
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-7, 1e8
_LONGEST_TURN, _LONGEST_WIDENING = 1.0, 0.7  # of one step: in widths, and of the log width


@dataclass(frozen=True)
class EnvironmentFit:
    """Scattered functions of several lights, and how their fit ended.

    Attributes:
        expansions: One a light.
        squared_error: Squared error over squared norm of each light's texels; 0 for black.
        steps: Gauss-Newton steps tried for each.
        status: How each ended: ``converged`` (steps won nearly nothing), ``max_steps``, or
            ``stagnated`` (no step, however short, won anything).
        condition: Of the last normal equations of each, functions scaled to norm one.
    """

    expansions: tuple[SRBFExpansion, ...]
    squared_error: tuple[float, ...]
    steps: tuple[int, ...]
    status: tuple[Status, ...]
    condition: tuple[float, ...]

    @property
    def expansion(self) -> SRBFExpansion:
        """The only one.

        Raises:
            ValueError: If several lights were fitted.
        """
        if len(self.expansions) != 1:
            raise ValueError(f"expected a fit of one light, got {len(self.expansions)}")
        return self.expansions[0]


def fit_environment(
    environment: Radiance | Sequence[Radiance],
    num_functions: int = 162,
    *,
    kernel: KernelName = "gaussian",
    resolution: int = 32,
    start: SRBFExpansion | None = None,
    rounds: int = 8,
    max_steps: int = 12,
    tolerance: float = 1e-3,
) -> EnvironmentFit:
    """Scattered functions closest to distant light, or to each of several lights.

    Least squares over the sphere of the mean radiance of cube-map texels; colours share centres
    and widths. Deterministic. Since errors are squared, a source a million times as bright as the
    rest takes all functions it can use first.

    Args:
        environment: One light, or several to be fitted side by side.
        num_functions: Functions of each light, at least 1; six numbers each.
        kernel: ``gaussian`` or ``abel_poisson``.
        resolution: Texels along an edge of a face, at least 2.
        start: Functions to begin with, such as those of the frame before of a moving light; their
            number and kernel win. Relocations end as soon as one of them wins little.
        rounds: Relocations, of three steps each; 0 for none.
        max_steps: Steps after the last of them.
        tolerance: Share of the objective that a step must win not to count as small; two small
            ones in a row end a run of steps.

    Raises:
        ValueError: If an argument is out of range, or radiance is not finite.

    Source:
        Tsai, Shih 2006, section 5.3.
    """
    lights = list(environment) if isinstance(environment, Sequence) else [environment]
    if not lights:
        raise ValueError("expected at least one light, got none")
    cube = CubeDirections(resolution)
    texels = torch.stack([cube.project(light) for light in lights])
    return fit_texels(
        texels,
        num_functions,
        kernel=kernel,
        start=start,
        rounds=rounds,
        max_steps=max_steps,
        tolerance=tolerance,
    )


def fit_texels(
    radiance: Float[Tensor, "batch texels rgb"],
    num_functions: int = 162,
    *,
    kernel: KernelName = "gaussian",
    start: SRBFExpansion | None = None,
    rounds: int = 8,
    max_steps: int = 12,
    tolerance: float = 1e-3,
) -> EnvironmentFit:
    """As :func:`fit_environment`, of mean radiances of cube-map texels, ``"6 row col"`` flattened.

    Raises:
        ValueError: If an argument is out of range, or radiance is not finite.
    """
    check_kernel(kernel)
    if num_functions < 1 or rounds < 0 or max_steps < 0 or not tolerance >= 0:
        raise ValueError(
            "expected at least 1 function and no negative rounds, steps or tolerance, got "
            f"{num_functions}, {rounds}, {max_steps}, {tolerance}"
        )
    kernel = start.kernel if start else kernel
    objective = TexelObjective(radiance, kernel)
    places = _continued(objective, start) if start else seeds(objective, num_functions)
    descent = Descent(objective, *places)
    for turn in range(rounds):
        before = descent.best.objective
        descent.run(_ROUND_STEPS, tolerance)
        if start and turn and bool((descent.best.objective > (1 - _ROUND_GAIN) * before).all()):
            break
        share = _ROUND_SHARE * (1.0 - turn / rounds)
        descent.move(max(1, int(share * descent.best.centers.shape[1])))
    descent.run(max_steps, tolerance)
    return _result(descent)


def _continued(objective: TexelObjective, start: SRBFExpansion) -> tuple[Tensor, Tensor]:
    """Centres and log widths of an expansion, for each light."""
    batch, target = len(objective.target), objective.target
    widths = widths_from_bandwidths(start.bandwidths.to(target), objective.kernel)
    centers = start.centers.to(target).expand(batch, -1, -1)
    return centers, widths.log().expand(batch, -1)


def seeds(
    objective: TexelObjective, num_functions: int
) -> tuple[Float[Tensor, "batch n 3"], Float[Tensor, "batch n"]]:
    """Centres and log widths to begin with, by coverage on a map of half the resolution.

    Source:
        Tsai, Shih 2006, section 5.3.
    """
    target = objective.target / objective.root_solid_angles
    halved = objective.resolution // 2 if objective.resolution % 2 == 0 else objective.resolution
    coarse = CubeDirections(halved)
    flux = (target * objective.root_solid_angles.square()).mT
    sums = coarse.project_cube(flux.flatten(0, 1), objective.resolution)
    means = (sums / coarse.solid_angles.to(sums)).unflatten(0, flux.shape[:2]).mT
    directions = cubemap_directions(halved, dtype=torch.float64).view(-1, 3).to(means)
    each = [coverage_seeds(light, directions, num_functions) for light in means]
    centers, widths = (torch.stack(parts) for parts in zip(*each, strict=True))
    return centers, widths.log()


class Descent:
    """Damped Gauss-Newton steps of several fits side by side, and the best place of each so far.

    Args:
        objective: What is made small.
        centers: Where to begin.
        log_widths: Logarithms of widths to begin with [rad].

    Attributes:
        best: The least objective found for each light.
        steps: Steps tried for each.
        status: How the last run of steps ended for each.
    """

    def __init__(self, objective: TexelObjective, centers: Tensor, log_widths: Tensor):
        self.objective = objective
        self.best = self._current = objective.evaluate(centers, log_widths)
        self.steps = torch.zeros(len(centers), dtype=torch.int64, device=centers.device)
        self.status: list[Status] = ["max_steps"] * len(centers)

    def move(self, count: int) -> None:
        """Go on from the best place, with the least useful functions moved to the residual."""
        self._current = self.objective.evaluate(*relocate(self.objective, self.best, count))

    def run(self, max_steps: int, tolerance: float) -> None:
        """Step from the current place until steps are small, or as often as allowed."""
        small = torch.zeros_like(self.steps)
        damping = torch.full_like(self.best.objective, _FIRST_DAMPING)
        running = torch.ones_like(small, dtype=torch.bool)
        self.status = ["max_steps"] * len(small)
        system: tuple[Tensor, Tensor] | None = None
        stale = running.clone()
        for _ in range(max_steps):
            self._finish(running & (self._current.objective < _EXACT), running, "converged")
            if not bool(running.any()):
                break
            system = self._system(system, stale & running)
            trial = self._trial(running, damping, *system)
            self.steps += running
            better = running & (trial.objective < self._current.objective)
            won = 1.0 - trial.objective / self._current.objective
            self._current = self._current.replaced(better, trial)
            small = torch.where(better, torch.where(won < tolerance, small + 1, 0), small)
            damping = torch.where(better, damping / 3.0, damping * 4.0).clamp_min(_LEAST_DAMPING)
            stale = better
            self._finish(small >= _SMALL_STEPS, running, "converged")
            self._finish(damping > _MOST_DAMPING, running, "stagnated")
        self._finish(running & (self._current.objective < _EXACT), running, "converged")
        self.best = self.best.replaced(self._current.objective < self.best.objective, self._current)

    def _finish(self, done: Tensor, running: Tensor, status: Status) -> None:
        for light in torch.nonzero(done & running)[:, 0].tolist():
            self.status[light] = status
        running &= ~done

    def _system(self, known: tuple[Tensor, Tensor] | None, stale: Tensor) -> tuple[Tensor, Tensor]:
        """Normal equations at the current places; new ones only where they changed."""
        if known is None:
            return self.objective.normal_equations(self._current)
        if bool(stale.any()):
            new = self.objective.pick(stale).normal_equations(self._current.pick(stale))
            for old, part in zip(known, new, strict=True):
                old[stale] = part
        return known

    def _trial(
        self, running: Tensor, damping: Tensor, matrix: Tensor, gradient: Tensor
    ) -> Projected:
        """The objective one damped step further, where still running."""
        at = self._current
        diagonal = matrix.diagonal(dim1=1, dim2=2).clamp_min(0.0)
        floor = 1e-12 * diagonal.amax(1, keepdim=True) + torch.finfo(diagonal.dtype).tiny
        damped = matrix + torch.diag_embed(damping[:, None] * (diagonal + floor))
        factor, failed = torch.linalg.cholesky_ex(damped)
        usable = running & (failed == 0)
        factor = torch.where(usable[:, None, None], factor, torch.eye(factor.shape[-1]).to(factor))
        step = -torch.cholesky_solve(gradient[..., None], factor)[..., 0]
        step = torch.where(usable[:, None], step, 0.0)
        first, second, widening = step.unflatten(1, (3, -1)).unbind(1)
        length = (first.square() + second.square()).sqrt()
        longest = _LONGEST_TURN * at.log_widths.exp()
        shorter = torch.where(length > longest, longest / torch.where(length > 0, length, 1.0), 1.0)
        frames = frame_from_normal(at.centers)
        along = first[..., None] * frames[:, :, 0] + second[..., None] * frames[:, :, 1]
        widening = widening.clamp(-_LONGEST_WIDENING, _LONGEST_WIDENING)
        return self.objective.evaluate(
            at.centers + shorter[..., None] * along, at.log_widths + widening
        )


def _result(descent: Descent) -> EnvironmentFit:
    """Expansions of the best places."""
    best, objective = descent.best, descent.objective
    kernel = objective.kernel
    bandwidths = bandwidths_from_widths(best.log_widths.exp(), kernel)
    coefficients = best.coefficients * objective.norms[:, None, None]
    if kernel == "abel_poisson":  # from peak 1 to integral 4 pi
        peaks = (1.0 + bandwidths) / (1.0 - bandwidths).square()
        coefficients = coefficients / peaks[..., None]
    spectra = torch.linalg.eigvalsh(best.factor @ best.factor.mT)
    return EnvironmentFit(
        expansions=tuple(
            SRBFExpansion(*parts, kernel=kernel)
            for parts in zip(best.centers, bandwidths, coefficients, strict=True)
        ),
        squared_error=tuple(best.residual.square().sum((1, 2)).tolist()),
        steps=tuple(descent.steps.tolist()),
        status=tuple(descent.status),
        condition=tuple((spectra[:, -1] / spectra[:, 0]).tolist()),
    )
