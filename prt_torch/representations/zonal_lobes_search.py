"""Where lobes go: from seeds, from what alike functions have found, and from random places.

The error has many local minima in the axes: for five lobes of a random function, the best of 600
random starts is a third better than the best of 200. But functions of a surface are alike, and so
are their good minima, so searches are shared:

- *Pools*: functions are cut into pools of alike ones, by halving at the median of the coefficient
  that varies most. Each pool is searched by itself.
- *Seeds* put a first lobe along the axis of the linear band, or in one of a few spread directions,
  and each further lobe where it wins most of what the others leave. Opposite axes make the same
  lobe, so half a sphere of directions is enough, and no shading frame is needed.
- *Random starts*: a function that is alone has several hundred; of n alike ones each has an n-th of
  them, and none where that is few. They go a few steps, the best quarter of them all the way.
- *Spreading*: a function tries the axes of those most like it, a few steps from each, and all the
  way from the best if that promises to be better than its own. What is found spreads on.
- *Hops* turn one lobe to a random direction, and spreading follows them: a lucky one helps its
  neighbours too.
- The best few are finished in float64; all before is float32.

Functions are alike up to scale and sign. A fit depends on the functions that are fitted with it: it
is better in company, and not the same alone.

Source:
    Sloan, Luna, Snyder 2005, section 4.1: single lobes from all directions of a hemicube, greedy
    fits to the residual, random sets of axes where the error is high. Sharing is ours: spreading
    alone halves the squared error that seeds leave, for about as many evaluations as seeds take.
"""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from prt_torch.bases import sh, zonal
from prt_torch.representations.zonal_lobes_descent import Descended, descend
from prt_torch.representations.zonal_lobes_objective import LobeObjective

Effort = Literal["default", "fast"]

_SCAN = 96  # directions of half the sphere that a further lobe is sought among
_POOL = 8192  # functions at most that are searched together
_ROWS = 1024  # functions that are compared with all others at a time
_ALIKE = 0.7  # squared cosine of the angle between functions that share their random starts
_STARTS = 24  # random starts of a function that is alone, times the squared number of lobes
_FEW_STARTS = 8  # too few to be worth it
_SOME = 512  # functions that have random starts together
_ROUND = 64  # random starts of a function at a time
_FIRST_STEPS = 8  # of seeds and random starts, before the best go on
_TRIAL_STEPS = 3  # from axes of another function
_STEPS = 20  # at most, of a start
_LAST_STEPS = 120  # at most, of the last descent
_PROMISING = 1.3  # objective after the trial steps, over the function's own
_DIFFERENT = 1e-2  # relative difference of objectives that is worth a descent
_SAME = 1e-3  # relative difference of objectives of the same minimum
_TOLERANCE = 1e-3  # share of the objective that a step must win, before the last descent
_ENOUGH = 1e-7  # squared error, of the squared norm, that float32 cannot better
_EXACT = 1e-15  # the same of float64
_BARE = 1e-3  # share of the ridge that is left where it is most of what is left


@dataclass(frozen=True)
class Plan:
    """How much is spent.

    Attributes:
        seeds: Of every function.
        kept: Places of a function that go on.
        random: Whether functions with little company have random starts.
        neighbours: Functions most alike that a function tries the axes of.
        sweeps: Of spreading, one after the other.
        rounds: Of hops, each with spreading after it.
        hops: Of a function in a round.
        last_tolerance: Share of the objective that a step of the last descent must win.
    """

    seeds: int
    kept: int
    random: bool
    neighbours: int
    sweeps: int
    rounds: int
    hops: int
    last_tolerance: float


_PLANS: dict[Effort, Plan] = {
    "default": Plan(6, 2, True, 12, 3, 3, 4, 1e-6),
    "fast": Plan(2, 1, False, 6, 2, 0, 0, 1e-3),
}


@dataclass(frozen=True)
class Found:
    """Axes of lobes, and what finding them took.

    Attributes:
        axes: Of unit length.
        starts: Of all functions together; axes tried of others do not count.
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
        effort: ``default``, or ``fast``: two seeds and what spreads from them.
        generator: Source of random starts and hops.

    Raises:
        ValueError: If the effort is unknown.
    """
    if effort not in get_args(Effort):
        raise ValueError(f"expected effort default or fast, got {effort!r}")
    order, plan = math.isqrt(functions.shape[1]), _PLANS[effort]
    up = functions.new_tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    axes = up.expand(len(functions), num_lobes, 3).clone()
    starts = steps = unfinished = 0
    if first_band < order and len(functions):
        scaled = _unit(functions.double())
        for pool in _pools(_unit(scaled[:, first_band**2 :])):
            own = _Search(scaled[pool], num_lobes, first_band, ridge, plan, generator)
            last = own.run()
            axes[pool] = last.fits.axes.permute(2, 0, 1)
            starts, steps = starts + own.starts, steps + own.steps
            unfinished += last.unfinished
    return Found(axes, starts, steps, unfinished)


def _unit(functions: Float[Tensor, "functions coeffs"]) -> Float[Tensor, "functions coeffs"]:
    """Of norm one; zero stays zero."""
    largest = functions.abs().amax(1, keepdim=True)
    scaled = functions / torch.where(largest > 0, largest, 1.0)
    norms = scaled.square().sum(1, keepdim=True).sqrt()
    return scaled / torch.where(norms > 0, norms, 1.0)


def _pools(functions: Float[Tensor, "functions coeffs"]) -> list[Int[Tensor, "pool"]]:
    """Numbers of functions in pools of alike ones."""
    pools = [torch.arange(len(functions), device=functions.device)]
    while any(len(pool) > _POOL for pool in pools):
        halves = []
        for pool in pools:
            own = functions[pool]
            column = own[:, own.var(0, correction=0).argmax()]
            halves += pool[column.argsort(stable=True)].tensor_split(2)
        pools = halves
    return pools


class _Search:
    """The search for functions of one pool, of norm one, or zero.

    Each function keeps a few places, the best first: ``errors`` (the objective) and ``axes``.
    """

    errors: Float[Tensor, "functions kept"]
    axes: Float[Tensor, "lobes 3 functions kept"]

    def __init__(
        self,
        functions: Float[Tensor, "functions coeffs"],
        num_lobes: int,
        first_band: int,
        ridge: float,
        plan: Plan,
        generator: torch.Generator,
    ):
        self.functions, self.num_lobes, self.plan = functions, num_lobes, plan
        self.generator = generator
        self.exact = LobeObjective(functions, first_band, ridge)
        self.bare = LobeObjective(functions, first_band, _BARE * ridge)
        self.rough = LobeObjective(functions.float(), first_band, ridge)
        self.starts = self.steps = 0
        self.everyone = torch.arange(len(functions), device=functions.device)

    def run(self) -> Descended:
        """Seeds, random starts, spreading and hops, and the last descent."""
        plan = self.plan
        seeded = self._from(self.everyone, self._seeds(), plan.kept)
        self.errors, self.axes = _best(*seeded, plan.kept)
        alike = _Alike(self.functions[:, self.rough.bands.start**2 :], plan.neighbours)
        if plan.random:
            self._random_starts(alike.company)
        self._spread(alike.nearest, torch.ones_like(self.everyone, dtype=torch.bool))
        for _ in range(plan.rounds):
            self._spread(alike.nearest, self._hop())
        return self._finish()

    def _random_starts(self, company: Int[Tensor, "functions"]) -> None:
        """The fewer functions are like one, the more of them."""
        wanted = _STARTS * self.num_lobes**2 // company
        wanted = torch.where(wanted < _FEW_STARTS, 0, wanted)
        for done in range(0, int(wanted.max()), _ROUND):
            which = self.everyone[(wanted > done) & self._missing()]
            if len(which) == 0:
                return
            for some in which.split(_SOME):
                count = int((wanted[some] - done).max().clamp_max(_ROUND))
                draws = self._draw(len(some), count)
                self._keep_better(some, *self._from(some, draws, max(1, count // 4)))

    def _spread(
        self, nearest: Int[Tensor, "functions neighbours"], changed: Bool[Tensor, "functions"]
    ) -> None:
        """Try the axes of the functions most alike, if they are new, and those found so again."""
        for _ in range(self.plan.sweeps):
            function, neighbour = changed[nearest].nonzero(as_tuple=True)
            changed = torch.zeros_like(changed)
            if len(function) == 0:
                return
            tried = self.axes[:, :, nearest[function, neighbour], :1]
            errors, axes = self._descend(function, tried, _TRIAL_STEPS)
            table = torch.full_like(nearest, math.inf, dtype=errors.dtype)
            table[function, neighbour] = errors[:, 0]
            least, best = table.min(1)
            own = self.errors[:, 0]
            new = (least < _PROMISING * own) & ((least - own).abs() > _DIFFERENT * own)
            which = self.everyone[new & self._missing()]
            place = torch.full_like(nearest, -1)
            place[function, neighbour] = torch.arange(len(function), device=place.device)
            begin = axes[:, :, place[which, best[which]]]
            better = self._keep_better(which, *self._descend(which, begin, _STEPS))
            changed[which[better]] = True

    def _hop(self) -> Bool[Tensor, "functions"]:
        """Turn a lobe of each function to a random direction; whether that won."""
        which, hops = self.everyone[self._missing()], self.plan.hops
        device = which.device
        places = torch.arange(hops, device=device) % self.axes.shape[-1]
        hopped = self.axes[:, :, which][..., places]
        lobe = torch.randint(self.num_lobes, (len(which), hops), generator=self.generator)
        turned = lobe.to(device) == torch.arange(self.num_lobes, device=device).view(-1, 1, 1)
        hopped = torch.where(turned[:, None], self._draw(len(which), hops), hopped)
        self.starts += hopped[0, 0].numel()
        changed = torch.zeros_like(self.everyone, dtype=torch.bool)
        changed[which] = self._keep_better(which, *self._descend(which, hopped, _STEPS))
        return changed

    def _finish(self) -> Descended:
        """The best of the places kept, all of them descended to the end.

        Functions that lobes meet so well that the ridge is most of what is left go on from there
        with hardly any: they have an exact fit near by, and coefficients that do not grow.
        """
        count, kept = self.errors.shape
        flat = self.everyone.repeat_interleave(kept)
        last = self._to_the_end(self.exact.pick(flat), self.axes.double().flatten(2))
        best = last.fits.objective.view(count, kept).argmin(1)
        fits = last.fits.pick(self.everyone * kept + best)
        met = self.everyone[2.0 * self.exact.squared_error(fits) < fits.objective]
        if len(met):
            again = self._to_the_end(self.bare.pick(met), fits.axes[..., met])
            fits.axes[..., met] = again.fits.axes
        return Descended(fits, last.steps, last.unfinished)

    def _to_the_end(self, objective: LobeObjective, axes: Tensor) -> Descended:
        """The last descent."""
        limits = {"tolerance": self.plan.last_tolerance, "floor": _EXACT}
        last = descend(objective, axes, max_steps=_LAST_STEPS, **limits)
        self.steps += last.steps
        return last

    def _missing(self) -> Bool[Tensor, "functions"]:
        """Which functions more may be won of."""
        best = self.rough.evaluate(self.axes[..., 0])
        return self.rough.squared_error(best) > _ENOUGH

    def _draw(self, functions: int, starts: int) -> Float[Tensor, "lobes 3 functions starts"]:
        """Axes in random directions."""
        shape = (self.num_lobes, 3, functions, starts)
        return torch.randn(shape, generator=self.generator).to(self.functions.device)

    def _from(
        self, which: Int[Tensor, "some"], axes: Float[Tensor, "lobes 3 some starts"], kept: int
    ) -> tuple[Float[Tensor, "some kept"], Float[Tensor, "lobes 3 some kept"]]:
        """A few steps from each start, and all the way from the best of them."""
        self.starts += axes[0, 0].numel()
        errors, axes = self._descend(which, axes, _FIRST_STEPS)
        return self._descend(which, _best(errors, axes, kept)[1], _STEPS)

    def _keep_better(
        self,
        which: Int[Tensor, "some"],
        errors: Float[Tensor, "some starts"],
        axes: Float[Tensor, "lobes 3 some starts"],
    ) -> Bool[Tensor, "some"]:
        """The best of what functions have and of these; whether one of these is clearly best."""
        kept, before = self.errors.shape[1], self.errors[which, 0]
        both = torch.cat([self.errors[which], errors], dim=1)
        best = _best(both, torch.cat([self.axes[:, :, which], axes], dim=3), kept)
        self.errors[which], self.axes[:, :, which] = best
        return best[0][:, 0] < (1.0 - _DIFFERENT) * before

    def _descend(
        self, which: Int[Tensor, "some"], axes: Float[Tensor, "lobes 3 some starts"], steps: int
    ) -> tuple[Float[Tensor, "some starts"], Float[Tensor, "lobes 3 some starts"]]:
        """Objectives and axes after so many steps from each start."""
        count, starts = axes.shape[2:]
        objective = self.rough.pick(which.repeat_interleave(starts))
        flat, limits = axes.flatten(2), {"tolerance": _TOLERANCE, "floor": _ENOUGH}
        found = descend(objective, flat, max_steps=steps, **limits)
        self.steps += found.steps
        errors, axes = found.fits.objective, found.fits.axes
        return errors.view(count, starts), axes.unflatten(-1, (count, starts))

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


class _Alike:
    """Which functions are like which, by the squared cosines of the angles between them.

    Args:
        functions: The bands that lobes are for.
        neighbours: Wanted of each.

    Attributes:
        nearest: Numbers of the functions most alike, other than itself.
        company: How many are alike enough to share starts, itself among them.
    """

    nearest: Int[Tensor, "functions neighbours"]
    company: Int[Tensor, "functions"]

    def __init__(self, functions: Float[Tensor, "functions coeffs"], neighbours: int):
        units = _unit(functions)
        count = min(neighbours, len(units) - 1)
        nearest, company = [], []
        numbers = torch.arange(len(units), device=units.device)
        for rows in numbers.split(_ROWS):
            alike = (units[rows] @ units.mT).square()
            alike[numbers[: len(rows)], rows] = -1.0
            nearest.append(alike.topk(count, dim=1).indices)
            company.append((alike > _ALIKE).sum(1) + 1)
        self.nearest, self.company = torch.cat(nearest), torch.cat(company)


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
