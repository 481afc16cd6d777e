"""Where lobes go: many starts for every function, and more where the error stays high.

The error has many local minima in the axes, as many as dozens of starts find for four lobes of a
random function. Transfer of a diffuse surface is kinder. So the search spends by need:

- *Seeds* put a first lobe along the axis of the linear band, or in one of a few spread directions,
  and each further lobe where it wins most of what the others leave. Opposite axes make the same
  lobe, so half a sphere of directions is enough, and no shading frame is needed.
- The seeds go a few steps downhill; the best few of them, all the way.
- *Hops* turn one lobe of one of the best to a random direction, and go downhill from there. A
  function gets a round of them for each 0.3 % of its norm that is still missing, up to a limit,
  and none after several rounds that won nothing: the more, the more is missing. A single lobe
  needs none.
- The best few are finished in float64; all before is float32.

All starts of a block of functions are descended side by side. Random directions are drawn once and
are the same for all functions, so a function's fit does not depend on the others.

Source:
    Sloan, Luna, Snyder 2005, section 4.1: single lobes from all directions of a hemicube, greedy
    fits to the residual, random sets of axes where the error is high. Hops are ours: at the same
    number of starts they find lower minima than sets of random axes.
"""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases import sh, zonal
from prt_torch.representations.zonal_lobes_descent import Descended, descend
from prt_torch.representations.zonal_lobes_objective import LobeObjective

Effort = Literal["default", "fast"]

_SCAN = 96  # directions of half the sphere that a further lobe is sought among
_BLOCK = 12288  # fits side by side
_EXACT = 1e-15  # objective, of the squared norm, below which nothing is left to win
_PATIENCE, _MOST_PATIENCE = 2, 10  # rounds of hops in a row that may win nothing
_PATIENT = 0.015  # of the norm that is missing, for each further one of them
_SAME = 1e-3  # relative difference of objectives of the same minimum


@dataclass(frozen=True)
class Plan:
    """How much is spent.

    Attributes:
        seeds: Starts of every function.
        rough_steps: Of each seed.
        kept: Of the seeds that go on, and of the places that hops start from.
        hops: Starts of a round.
        rounds: At most, of hops.
        share: Of the norm that is missing, for each round.
        steps: At most, of a start.
        last_steps: At most, of the last descent.
        finished: Of the places kept, that are descended to the end.
    """

    seeds: int
    rough_steps: int
    kept: int
    hops: int
    rounds: int
    share: float
    steps: int
    last_steps: int
    finished: int


_PLANS: dict[Effort, Plan] = {
    "default": Plan(12, 9, 6, 12, 40, 0.003, 48, 240, 3),
    "fast": Plan(4, 6, 1, 0, 0, 1.0, 24, 36, 1),
}


@dataclass(frozen=True)
class Found:
    """Axes of lobes, and what finding them took.

    Attributes:
        axes: Of unit length.
        starts: Of all functions together.
        steps: Evaluations of the objective, of all functions together.
        unfinished: Functions whose last descent was ended by the limit of steps.
    """

    axes: Float[Tensor, "functions lobes 3"]
    starts: int
    steps: int
    unfinished: int


def search(
    functions: Float[Tensor, "functions coeffs"],
    num_lobes: int,
    *,
    first_band: int,
    ridge: float,
    effort: Effort,
    generator: torch.Generator,
) -> Found:
    """Axes of lobes for each function.

    Args:
        functions: By spherical harmonics; of any scale.
        num_lobes: At least 1.
        first_band: First band that counts, at least 1.
        ridge: On squared norms of the lobes, as in :func:`prt_torch.bases.zonal.fit_coefficients`.
        effort: ``default``, or ``fast``: few starts and no hops.
        generator: Source of the directions of hops.

    Raises:
        ValueError: If the effort is unknown.
    """
    if effort not in get_args(Effort):
        raise ValueError(f"expected effort default or fast, got {effort!r}")
    order, plan = math.isqrt(functions.shape[1]), _PLANS[effort]
    if first_band >= order:
        up = functions.new_tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        return Found(up.expand(len(functions), num_lobes, 3).clone(), 0, 0, 0)
    draws = torch.randn(plan.rounds, max(plan.hops, 1), 3, generator=generator, dtype=torch.float64)
    found = []
    for some in functions.split(max(1, _BLOCK // plan.seeds)):
        some = some.double()
        norms = some.square().sum(1, keepdim=True).sqrt()
        scaled = some / torch.where(norms > 0, norms, 1.0)
        found.append(_Search(scaled, num_lobes, first_band, ridge, plan).run(draws))
    return Found(
        axes=torch.cat([part.axes for part in found]),
        starts=sum(part.starts for part in found),
        steps=sum(part.steps for part in found),
        unfinished=sum(part.unfinished for part in found),
    )


class _Search:
    """The search for functions of norm one, or zero."""

    def __init__(
        self,
        functions: Float[Tensor, "functions coeffs"],
        num_lobes: int,
        first_band: int,
        ridge: float,
        plan: Plan,
    ):
        self.functions, self.num_lobes, self.plan = functions, num_lobes, plan
        self.exact = LobeObjective(functions, first_band, ridge)
        self.rough = LobeObjective(functions.float(), first_band, ridge)
        self.starts = self.steps = 0

    def run(self, draws: Float[Tensor, "rounds hops 3"]) -> Found:
        """Seeds, hops and the last descent."""
        count, plan = len(self.functions), self.plan
        everyone = torch.arange(count, device=self.functions.device)
        axes = self._seeds()  # lobes 3 functions starts
        errors, axes = self._descend(everyone, axes, plan.rough_steps, 1e-3)
        self.starts += errors.numel()
        errors, axes = self._descend(everyone, _best(errors, axes, plan.kept)[1], plan.steps, 1e-3)
        errors, axes = _best(errors, axes, plan.kept)
        idle = torch.zeros_like(everyone)
        for turn, draw in enumerate(draws if self.num_lobes > 1 else draws[:0]):
            missing = errors[:, 0].clamp_min(0.0).sqrt()
            patience = (_PATIENCE + missing / _PATIENT).clamp_max(_MOST_PATIENCE)
            which = everyone[(missing > (turn + 1) * plan.share) & (idle < patience)]
            if len(which) == 0:
                break
            hopped = _hops(axes[:, :, which], draw.to(axes), turn)
            new_errors, new_axes = self._descend(which, hopped, plan.steps, 1e-3)
            self.starts += new_errors.numel()
            both = torch.cat([errors[which], new_errors], 1)
            best = _best(both, torch.cat([axes[:, :, which], new_axes], 3), plan.kept)
            won = best[0][:, 0] < (1.0 - _SAME) * errors[which, 0]
            idle[which] = torch.where(won, 0, idle[which] + 1)
            errors[which], axes[:, :, which] = best
        last = self._finish(axes[..., : plan.finished].double())
        found = zonal.unit_axes(last.fits.axes.permute(2, 0, 1))
        return Found(found, self.starts, self.steps, last.unfinished)

    def _finish(self, axes: Float[Tensor, "lobes 3 functions kept"]) -> Descended:
        """The best of the places kept, all of them descended to the end."""
        count, kept = len(self.functions), axes.shape[-1]
        flat = torch.arange(count, device=axes.device).repeat_interleave(kept)
        last = descend(
            self.exact.pick(flat),
            axes.flatten(2),
            max_steps=self.plan.last_steps,
            tolerance=1e-6,
            floor=_EXACT,
        )
        self.steps += last.steps
        best = last.fits.objective.view(count, kept).argmin(1)
        numbers = torch.arange(count, device=axes.device) * kept + best
        return Descended(last.fits.pick(numbers), last.steps, last.unfinished)

    def _descend(
        self,
        which: Tensor,
        axes: Float[Tensor, "lobes 3 some starts"],
        steps: int,
        tolerance: float,
    ) -> tuple[Float[Tensor, "some starts"], Float[Tensor, "lobes 3 some starts"]]:
        """Objectives and axes after so many steps from each start."""
        starts = axes.shape[-1]
        pieces: list[Descended] = []
        flat = axes.flatten(2)
        for own in torch.arange(flat.shape[-1], device=flat.device).split(_BLOCK):
            objective = self.rough.pick(which[own // starts])
            pieces.append(
                descend(objective, flat[..., own], max_steps=steps, tolerance=tolerance, floor=1e-7)
            )
        self.steps += sum(piece.steps for piece in pieces)
        errors = torch.cat([piece.fits.objective for piece in pieces])
        found = torch.cat([piece.fits.axes for piece in pieces], dim=-1)
        return errors.unflatten(0, (-1, starts)), found.unflatten(-1, (-1, starts))

    def _seeds(self) -> Float[Tensor, "lobes 3 functions starts"]:
        """First lobes spread out, or along the linear band; further ones where they win most."""
        plan, count = self.plan, len(self.functions)
        functions = self.functions.float()
        linear = zonal.optimal_linear_axis(functions)[:, None]
        spread = _half_sphere(plan.seeds - 1).to(linear).expand(count, -1, -1)
        lobes = [torch.cat([linear, spread], dim=1).flatten(0, 1)]
        scanned = _half_sphere(_SCAN).to(linear)
        order, first = self.rough.order, self.rough.bands.start
        widths = 2.0 * torch.arange(order, dtype=torch.float64) + 1.0
        scales = (4.0 * math.pi / widths).repeat_interleave(widths.long()).sqrt().to(linear)
        at_scanned = sh.evaluate(scanned, order) * scales
        targets = functions.repeat_interleave(plan.seeds, 0)
        for _ in range(1, self.num_lobes):
            axes = torch.stack(lobes, dim=1)
            fitted = zonal.lobes_to_sh(axes, zonal.fit_coefficients(targets, axes, 1e-4))
            rest = targets - fitted
            gain = sum(
                (rest[:, own] @ at_scanned[:, own].mT).square()
                for own in (slice(b * b, (b + 1) ** 2) for b in range(first, order))
            )
            lobes.append(scanned[torch.as_tensor(gain).argmax(1)])
        axes = torch.stack(lobes, dim=1)  # functions * starts, lobes, 3
        return axes.unflatten(0, (count, plan.seeds)).permute(2, 3, 0, 1).contiguous()


def _hops(
    axes: Float[Tensor, "lobes 3 some kept"], draw: Float[Tensor, "hops 3"], turn: int
) -> Float[Tensor, "lobes 3 some hops"]:
    """Each of the places in turn, with one lobe after the other turned anywhere."""
    lobes, kept, hops = axes.shape[0], axes.shape[-1], len(draw)
    numbers = torch.arange(hops, device=axes.device)
    hopped = axes[..., numbers % kept].clone()
    moved = (numbers // kept + turn * math.ceil(hops / kept)) % lobes
    hopped[moved, :, :, numbers] = draw[:, :, None].expand(-1, -1, axes.shape[2])
    return hopped


def _best(
    errors: Float[Tensor, "some starts"], axes: Float[Tensor, "lobes 3 some starts"], count: int
) -> tuple[Float[Tensor, "some count"], Float[Tensor, "lobes 3 some count"]]:
    """The least errors first, of different minima as far as there are enough."""
    ordered, order = errors.sort(dim=1, stable=True)
    same = torch.zeros_like(ordered, dtype=torch.bool)
    same[:, 1:] = ordered.diff(dim=1) <= _SAME * ordered[:, 1:]
    order = order.gather(1, same.to(torch.int8).sort(dim=1, stable=True)[1])[:, :count]
    return errors.gather(1, order), axes.gather(3, order.expand(*axes.shape[:2], -1, -1))


def _half_sphere(count: int) -> Float[Tensor, "count 3"]:
    """Directions spread evenly over half the sphere, on a spiral; float64."""
    numbers = torch.arange(count, dtype=torch.float64)
    y = 1.0 - (numbers + 0.5) / max(count, 1)
    azimuth = numbers * (math.pi * (3.0 - math.sqrt(5.0)))
    radius = (1.0 - y.square()).sqrt()
    return torch.stack([radius * azimuth.cos(), y, radius * azimuth.sin()], dim=-1)
