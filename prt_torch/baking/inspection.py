"""What a scene needs, measured before it is paid for: rays, bounces, colours, factors.

Each answer is a :class:`Finding`: how much of what there is a stated error needs, how that was
decided, and what leaving out the rest saves. Three ways of deciding are told apart. A *proof* holds
whatever the rays would say. An *exact* one adds up all there is. A *sample*, of rays or of points,
is an estimate, and nothing that may change a result is left out for it alone: rays that all miss
make it likely that nothing is hidden, and :func:`~prt_torch.baking.visibility.proven_free` makes it
sure or the scene is traced.

Errors are squared ones over the squared norm of the whole, 0.1 % unless said.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float64
from scipy.special import betaincinv
from torch import Tensor
from torch.quasirandom import SobolEngine

from prt_torch.assets.brdf import BRDF, lobe_quadrature
from prt_torch.assets.mesh import Mesh
from prt_torch.baking.visibility import Tracer, VisibilityField, proven_free
from prt_torch.bases import BRDFFactors, sh
from prt_torch.sphere import frame_from_normal

ERROR = 1e-3
"""Squared error, over the squared norm of the whole, that a scene's needs are stated for."""

_CONFIDENCE = 0.95
_FEWEST_TEXELS = 2  # along an edge: the tracer's own directions are not used
_VIEW_DEGREE, _LIGHT_NODES = 15, 16  # of quadratures that colours of materials are compared by
_FACTOR_DEGREE = 127  # of the quadrature of light functions


@dataclass(frozen=True)
class Finding:
    """How much of something a scene needs.

    Attributes:
        what: What is counted, in a few words.
        needed: How many of them the stated error needs; None if more than there are.
        available: How many there are.
        error: Squared error with those that are needed, over the squared norm of the whole.
        decided_by: ``proof``, ``exact`` measurement of everything, or a ``sample``.
        left_out: Whether the rest is left out unless forced on.
        why: What was measured.
        saved_bytes: What leaving out the rest saves, or would save, of uncompressed values.
        saved_seconds: Likewise in time; None where it is bytes that count.
    """

    what: str
    needed: int | None
    available: int
    error: float
    decided_by: Literal["proof", "exact", "sample"]
    left_out: bool
    why: str
    saved_bytes: int = 0
    saved_seconds: float | None = None

    def entry(self) -> dict[str, Any]:
        """As a report lists what was left out."""
        spare = self.available - (self.available if self.needed is None else self.needed)
        entry: dict[str, Any] = {
            "what": f"{spare} of {self.available} {self.what}",
            "why": self.why,
        }
        if self.saved_seconds is None:
            return {**entry, "saved_bytes": self.saved_bytes}
        return {**entry, "saved_seconds": self.saved_seconds}


@dataclass(frozen=True)
class Occlusion:
    """How much of the sky is hidden from the points of a scene.

    Attributes:
        points: Points with a normal.
        free: Those of them that are proven to see all above their horizon.
        rays: Test rays from the others; none where there are no others.
        hits: How many of them hit something.
    """

    points: int
    free: int
    rays: int
    hits: int

    @property
    def decided_by(self) -> Literal["proof", "sample"]:
        """What it is known from: a proof for all points, or test rays."""
        return "proof" if self.free == self.points else "sample"

    @property
    def hidden(self) -> float:
        """Estimated share of the cosine-weighted sky that is hidden, mean over points."""
        return self._of_all(self.hits / self.rays) if self.rays else 0.0

    @property
    def hidden_at_most(self) -> float:
        """What that share does not exceed, at 95 % confidence, as of independent rays.

        Source:
            Clopper and Pearson 1934, "The use of confidence or fiducial limits".
        """
        if not self.rays:
            return 0.0
        missed = self.rays - self.hits
        limit = float(betaincinv(self.hits + 1, missed, _CONFIDENCE)) if missed else 1.0
        return self._of_all(limit)

    def _of_all(self, of_others: float) -> float:
        return of_others * (self.points - self.free) / self.points

    def bounces(self, reflectance: float, error: float = ERROR) -> int:
        """How many bounces an error needs, as if all points were alike.

        Light that a share h of all directions sends back, times reflectance, is a geometric series;
        so after k bounces the share ``(reflectance h)^(k + 1)`` of all light is missing.

        Args:
            reflectance: Mean over points of the brightest colour, below 1 unless nothing is hidden.
            error: Squared share that may be missing.

        Raises:
            ValueError: If the series does not end.
        """
        ratio = reflectance * self.hidden
        if ratio >= 1:
            raise ValueError(f"expected a reflectance below {1 / self.hidden:g}, got {reflectance}")
        if ratio == 0:
            return 0
        return max(0, math.ceil(math.log(error) / (2 * math.log(ratio))) - 1)


def inspect_occlusion(mesh: Mesh, *, rays: int = 4096, seed: int = 0) -> Occlusion:
    """Test by few rays how much is hidden, before all are traced.

    Points that are proven free get no ray. The others share the rays, whose directions follow the
    cosine; pairs of a point and a direction are a scrambled Sobol sequence.

    Args:
        mesh: The scene.
        rays: How many.
        seed: Of the scrambling.

    Raises:
        ValueError: If there is not at least one ray.
    """
    if rays < 1:
        raise ValueError(f"expected at least 1 ray, got {rays}")
    free, has_normal = proven_free(mesh), (mesh.normals != 0).any(1)
    others = (has_normal & ~free).nonzero()[:, 0]
    points, num_free = int(has_normal.sum()), int((has_normal & free).sum())
    if not len(others):
        return Occlusion(points, num_free, 0, 0)
    tracer = Tracer(mesh, _FEWEST_TEXELS)
    draw = SobolEngine(3, scramble=True, seed=seed).draw(rays, dtype=torch.float64)
    chosen = others[(draw[:, 0] * len(others)).long().clamp_max(len(others) - 1)]
    to_world = frame_from_normal(mesh.normals[chosen]).mT
    directions = (to_world @ _by_cosine(draw[:, 1], draw[:, 2])[..., None])[..., 0]
    hits = int(tracer.hidden(chosen.numpy(), directions.numpy()).sum())
    return Occlusion(points, num_free, rays, hits)


def _by_cosine(
    height: Float64[Tensor, "rays"], turn: Float64[Tensor, "rays"]
) -> Float64[Tensor, "rays 3"]:
    """Directions about +z whose density follows the cosine, of uniform numbers in [0, 1)."""
    radius, angle = height.sqrt(), 2 * math.pi * turn
    z = (1 - height).clamp_min(0.0).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=1)


def visibility_finding(
    occlusion: Occlusion, visibility: VisibilityField, *, traced_all: bool = False
) -> Finding:
    """What was saved by tracing no more points than needed.

    Args:
        occlusion: What the test found.
        visibility: What was traced then.
        traced_all: Whether points were traced although they are free.
    """
    points, free = occlusion.points, occlusion.free
    if free == points:
        why = "no face reaches above any point's tangent plane; no bit is kept"
        saved, seconds = points * visibility.bits.shape[1], None
    else:
        why = (
            f"no face reaches above their tangent planes; of {occlusion.rays} test rays from "
            f"others {occlusion.hits} hit: {100 * occlusion.hidden:.2g} % of the sky is hidden, "
            f"at most {100 * occlusion.hidden_at_most:.2g} %"
        )
        traced = points if traced_all else points - free
        saved, seconds = 0, visibility.seconds * free / traced
    left_out = free > 0 and not traced_all
    what = "points to be traced"
    return Finding(what, points - free, points, 0.0, "proof", left_out, why, saved, seconds)


def bounce_finding(
    occlusion: Occlusion, reflectance: float, max_bounces: int, *, error: float = ERROR
) -> Finding:
    """How many bounces a scene needs. Baking measures each bounce and stops by itself.

    Args:
        occlusion: What the test found.
        reflectance: Mean over points of the brightest colour.
        max_bounces: How many were asked for.
        error: Squared error that is allowed.
    """
    if occlusion.decided_by == "proof":
        why = "nothing in the scene sees anything else of it"
        return Finding("bounces between points", 0, max_bounces, 0.0, "proof", True, why)
    ratio = reflectance * occlusion.hidden
    needed = occlusion.bounces(reflectance, error) if ratio < 1 else None
    possible = None if needed is None or needed > max_bounces else needed
    kept = max_bounces if possible is None else possible
    why = f"each bounce carries {100 * ratio:.2g} % of the one before, by test rays"
    lost = min(1.0, ratio ** (2 * (kept + 1)))
    return Finding("bounces between points", possible, max_bounces, lost, "sample", False, why)


def colour_finding(brdf: BRDF, *, error: float = ERROR) -> Finding:
    r"""Whether a material's colours are proportional: one function times three numbers.

    By inner products of its channels over pairs of light and view, times the cosine of the light.
    Models know of themselves whether they are coloured; measurements are three functions that may
    or may not be alike.

    Args:
        brdf: The material.
        error: Squared error that is allowed.
    """
    what = "colours of the material"
    if brdf.num_channels == 1:
        return Finding(what, 1, 3, 0.0, "exact", True, "the material has no colour")
    views, view_weights = sh.hemisphere_quadrature(_VIEW_DEGREE)
    lights, solid_angles = lobe_quadrature(views, _LIGHT_NODES)
    values = brdf.evaluate(lights, views[:, None]) * lights[..., 2:]
    gram = torch.einsum("vlc,vl,vld->cd", values, solid_angles * view_weights[:, None], values)
    total = float(gram.trace())
    lost = max(0.0, 1 - float(torch.linalg.eigvalsh(gram)[-1]) / total) if total > 0 else 0.0
    proportional = lost <= error
    why = f"{100 * lost:.2g} % of the square of its colours is not common to them"
    return Finding(what, 1 if proportional else 3, 3, lost, "sample", False, why)


def factor_finding(factors: BRDFFactors, *, error: float = ERROR) -> Finding:
    """How many of the BRDF factors of a scene's materials an error needs.

    Factors are ordered, and what each adds is the product of the squared norms of its two sides; so
    what fewer of them lose follows from these and from what all of them lose.

    Args:
        factors: As :meth:`~prt_torch.bases.BRDFFactors.from_brdf` made them, which knows their
            error, and not refined since.
        error: Squared error that is allowed.

    Raises:
        ValueError: If their error is not known.
    """
    if factors.rms is None:
        raise ValueError("expected factors that know their error, as from_brdf makes them")
    directions, solid_angles = sh.hemisphere_quadrature(_FACTOR_DEGREE)
    lights = torch.zeros(factors.num_rows, dtype=torch.float64)
    for material in range(factors.num_materials):
        values = factors.light(directions, material).detach()
        lights += (values.square() * solid_angles[:, None]).sum(0)
    energies = factors.gram().diagonal() * lights
    most = factors.rms**2
    beyond = energies.sum() - energies.cumsum(0)
    losses = most + (1 - most) * beyond.clamp_min(0.0) / (float(energies.sum()) or 1.0)
    enough = (losses <= error).nonzero()[:, 0]
    least = max(1, factors.num_constants)
    needed = max(int(enough[0]) + 1, least) if len(enough) else None
    lost = most if needed is None else float(losses[needed - 1])
    why = f"{needed or factors.num_rows} factors lose {100 * lost:.2g} % of the square"
    return Finding("BRDF factors", needed, factors.num_rows, lost, "exact", False, why)
