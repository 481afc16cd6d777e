"""Repeat the tables of docs/brdf_factors.md; prints Markdown.

python eval/brdf_factors.py [--quick] [--tables NAME ...] [--resolutions N ...]

Errors are root mean squares over pairs of directions spread evenly over both hemispheres, weighted
by the cosine of the light, relative to that of the material. Pairs are a Sobol sequence: random
ones of the same number leave the scale itself uncertain by a percent.
"""

import argparse
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from prt_torch.assets.brdf import BRDF, AshikhminShirley, brdf
from prt_torch.assets.brdf.microfacet import (
    beckmann_distribution,
    dielectric_fresnel,
    half_vector,
    schlick_fresnel,
)
from prt_torch.bases import BRDFFactors, HemisphereMap, factor_error, sh
from prt_torch.bases.brdf_factoring import Target, singular_factors
from prt_torch.bases.brdf_refinement import refine

TERMS = (1, 2, 4, 8, 16, 32)
ANISOTROPIC = AshikhminShirley(specular=0.75, diffuse=0.5, exponent_u=10.0, exponent_v=100.0)
# Of the project's notes on Wang et al. 2004: 80,000 random pairs, over their RMS of f.
WANG = {
    16: (0.21166, 0.19598, 0.17002, 0.13471, 0.09266, 0.06303),
    32: (0.21139, 0.19547, 0.16850, 0.13170, 0.08508, 0.04401),
    48: (0.21133, 0.19540, 0.16831, 0.13132, 0.08403, 0.04200),
    64: (0.21122, 0.19517, 0.16790, 0.13050, 0.08240, 0.03843),
}
WANG_SCALE = 0.2371
# Of the notes on Liu et al. 2004: singular 10 terms, harmonics of order 4 to 7; RMS and maximum.
LIU = {
    "A: F D G / (π nv)": ".2576/2.896 .3559 .2917 .2414 .2033",
    "B: F D G / (4π nv)": ".1616/2.909 .1915 .1734 .1573 .1430",
    "C: F D G s_z": ".0723/.842 .1444/.984 .0935/.823 .0662/.717 .0499/.618",
    "D: 0.5 D s_z": ".0659/.553 .1492/.784 .0965/.629 .0668/.523 .0485/.443",
    "E: (4/π) F_CT D G s_z": ".0717/.724 .1650/1.044 .1027/.791 .0695/.614 .0495/.517",
}
FILES = {"rgl": "rgl_cc_ibiza_sunset_rgb.bsdf", "cornell": "cornell_acryl_blue.brdf"}


def main() -> None:
    """Print the tables that were asked for."""
    tables = {table.__name__: table for table in (resolutions, constraints, materials, conventions)}
    parser = argparse.ArgumentParser(description="Tables of errors of BRDF factors.")
    parser.add_argument("--quick", action="store_true", help="16 and 32 texels, fewer pairs")
    parser.add_argument("--tables", nargs="+", choices=list(tables), default=list(tables))
    parser.add_argument(
        "--resolutions", nargs="+", type=int, choices=list(WANG), default=list(WANG)
    )
    options = parser.parse_args()
    for name in options.tables:
        tables[name](options)


def resolutions(options: argparse.Namespace) -> None:
    """Wang's closed form and the optimum through lookups, clamped at 3, without the cosine."""
    errors, rows = Errors(ANISOTROPIC, 17 if options.quick else 21), []
    for resolution in options.resolutions[:2] if options.quick else options.resolutions:
        wang = _wang(resolution, TERMS[-1])
        printed = [value / WANG_SCALE for value in WANG[resolution]]
        closed, found = errors(wang), errors(refine(wang, ANISOTROPIC).factors)
        rows += [
            [f"{resolution} printed", *printed],
            [f"{resolution} symmetric", *closed],
            ["against printed", *_ratios(closed, printed)],
            [f"{resolution} refined", *found],
            ["against symmetric", *_ratios(found, closed)],
        ]
    print(f"\nRMS f {errors.scale:.5f}, {errors.num_pairs:,} pairs\n")
    _table(["texels", *(f"K={k}" for k in TERMS)], rows)


def constraints(options: argparse.Namespace) -> None:
    """What reciprocity and signs cost."""
    errors, rows = Errors(ANISOTROPIC, 17 if options.quick else 20), []
    resolution = 16 if options.quick else 32
    for terms in (4, 8, 16, 32):
        wang = _wang(resolution, terms)
        kinds: tuple[dict[str, bool], ...] = ({}, {"reciprocal": True}, {"nonnegative": True})
        refined = [refine(wang, ANISOTROPIC, **kind).factors for kind in kinds]
        rows.append([str(terms), *(errors(kind)[-1] for kind in (wang, *refined))])
    print(f"\n{resolution} x {resolution} orthographic, without the cosine\n")
    _table(["K", "symmetric", "refined", "reciprocal", "nonnegative"], rows)


def materials(options: argparse.Namespace) -> None:
    """Measured materials: errors, albedo and the worst view of each method."""
    folder = os.environ.get("PRT_TORCH_ASSETS")
    if folder is None:
        print("\nMeasured materials left out: PRT_TORCH_ASSETS does not name their folder\n")
        return
    resolution, rows = 16 if options.quick else 24, []
    for name, file in FILES.items():
        material = brdf({"name": name, "path": str(Path(folder) / "brdf" / file)})
        for terms in (4, 8):
            make = partial(BRDFFactors.from_brdf, num_terms=terms, resolution=resolution)
            best = make(material)
            made = {
                "interpolated": best,
                "nonnegative": refine(best, material, nonnegative=True).factors,
                "singular": make(material, method="singular", supersampling=2),
                "harmonic": make(material, method="harmonic"),
            }
            for method, factors in made.items():
                error = factor_error(factors, material, clamp=3.0)
                figures = (error.relative, error.largest, error.albedo, error.worst_view)
                rows.append([file.partition(".")[0], str(terms), method, *figures])
    print(f"\n{resolution} x {resolution} parabolic, with the cosine, clamped at 3\n")
    _table(["material", "K", "method", "relative RMS", "largest", "albedo", "worst view"], rows)


def conventions(options: argparse.Namespace) -> None:
    """Cook-Torrance by five conventions: singular factors beside harmonics of the light."""
    hemisphere, rows = HemisphereMap("parabolic", 32), []
    directions, used = hemisphere.centres()
    samples = directions[used]
    for name, printed in LIU.items():
        target = Target([Convention(name[0])], True, 3.0)
        points = target.values(samples, samples)[:, 0, 0]
        ten, _ = _singular(target, hemisphere, 10, 1)
        rows.append([name, "printed", *printed.split(), *[""] * (7 - len(printed.split()))])
        for kind, least in (("points", False), ("least squares", True)):
            series = [_harmonics(target, samples, order, least=least) for order in range(4, 8)]
            figures = [_two(found, points) for found in (ten, *series)]
            rows.append(["", kind, *figures, _equal_rows(ten, series, points)])
        if not options.quick:
            ten, means = _singular(target, hemisphere, len(points), 4)
            rows.append(["", "of means of 4 x 4", _two(ten, means), "", "", "", "", ""])
    print("\nRMS/maximum over 812 x 812 samples, clamped at 3\n")
    head = ["convention", "", "10 terms", *(f"order {order}" for order in range(4, 8))]
    _table([*head, "harmonics as good as 10 terms"], rows)


@dataclass(frozen=True)
class Convention:
    """Cook and Torrance's model times s_z, Beckmann m = 0.4 without 1/π, F0 = 0.5, over s_z."""

    letter: str
    num_channels: int = 1

    def evaluate(self, wi: Tensor, wo: Tensor, /) -> Tensor:
        """The BRDF whose product with the cosine is the convention."""
        wi, wo = torch.broadcast_tensors(wi, wo)
        half, inner = half_vector(wi, wo)
        normal, light, view = half[..., 2:], wi[..., 2:], wo[..., 2:]
        shape, f0 = math.pi * beckmann_distribution(half, 0.4)[..., None], wi.new_tensor([0.5])
        schlick, exact = schlick_fresnel(f0, inner), dielectric_fresnel(f0, inner)
        cavity = 2 * normal / inner[..., None]
        masked = shape * (cavity * torch.minimum(light, view)).clamp(max=1)
        match self.letter:
            case "A" | "B":  # G / (nl nv) with the cosines cancelled, finite at the horizon
                masking = torch.minimum(1 / (light * view), cavity / torch.maximum(light, view))
                return schlick * shape * masking / (math.pi if self.letter == "A" else 4 * math.pi)
            case "C":
                return schlick * masked
            case "D":
                return 0.5 * shape
            case _:
                return 4 / math.pi * exact * masked


class Errors:
    """Relative errors of the first terms of factors of one material, clamped at 3."""

    def __init__(self, material: BRDF, log_pairs: int):
        self.num_pairs = 2**log_pairs
        points = torch.quasirandom.SobolEngine(4, scramble=True, seed=0).draw(self.num_pairs)
        self.lights, self.views = (_directions(side).split(2**16) for side in points.split(2, 1))
        self.expected = [
            material.evaluate(s, v)[:, 0].clamp(max=3) * s[:, 2]
            for s, v in zip(self.lights, self.views, strict=True)
        ]
        squares = sum(float(values.double().square().sum()) for values in self.expected)
        self.scale = math.sqrt(squares / self.num_pairs)

    def __call__(self, factors: BRDFFactors) -> list[float]:
        """For each of TERMS that the factors have."""
        wanted = [k - 1 for k in TERMS if k <= factors.num_rows]
        total = torch.zeros(len(wanted), dtype=torch.float64)
        with torch.no_grad():
            for s, v, values in zip(self.lights, self.views, self.expected, strict=True):
                sums = (factors.evaluate(v) * factors.light(s)).cumsum(1)[:, wanted]
                total += (sums - values[:, None]).double().square().sum(0)
        return ((total / self.num_pairs).sqrt() / self.scale).tolist()


def _wang(resolution: int, terms: int) -> BRDFFactors:
    make = partial(BRDFFactors.from_brdf, method="symmetric", mapping="orthographic")
    return make(ANISOTROPIC, num_terms=terms, resolution=resolution)


def _directions(uniform: Tensor) -> Tensor:
    z, turn = uniform[:, 0], uniform[:, 1] * (2 * math.pi)
    level = (1 - z * z).sqrt()
    return torch.stack([level * turn.cos(), level * turn.sin(), z], -1)


def _harmonics(target: Target, samples: Tensor, order: int, *, least: bool) -> Tensor:
    """Series over the light at the samples: zero below the horizon, or least squares above it."""
    lights, solid_angles = sh.hemisphere_quadrature(127)
    weighted = sh.evaluate(lights, order) * solid_angles[:, None]
    projected = target.values(samples, lights)[:, 0, 0] @ weighted
    if least:
        projected = torch.linalg.solve(sh.hemisphere_gram(order), projected.mT).mT
    return projected @ sh.evaluate(samples, order).mT


def _singular(
    target: Target, hemisphere: HemisphereMap, terms: int, supersampling: int
) -> tuple[Tensor, Tensor]:
    """Ten terms, and as many as were asked for, at the samples."""
    _, used = hemisphere.centres()
    found = singular_factors(target, hemisphere, terms, supersampling=supersampling)
    view, light = found.view[:, 0, used], found.light[0][:, used]
    return view[:10].mT @ light[:10], view.mT @ light


def _equal_rows(best: Tensor, series: Sequence[Tensor], points: Tensor) -> str:
    """Harmonics that would do as well as ``best``, by the logarithm of the error."""
    goal, *logs = (math.log(float((a - points).square().mean())) for a in (best, *series))
    place = next((i for i in (1, 2) if logs[i] <= goal), 3)
    low, high = (place + 3) ** 2, (place + 4) ** 2
    share = (goal - logs[place - 1]) / (logs[place] - logs[place - 1])
    return f"{low + share * (high - low):.1f}"


def _two(approximate: Tensor, exact: Tensor) -> str:
    wrong = approximate - exact
    return f"{float(wrong.square().mean().sqrt()):.4f}/{float(wrong.abs().max()):.3f}"


def _ratios(values: Sequence[float], others: Sequence[float]) -> list[str]:
    return [f"{100 * (a / b - 1):+.1f} %" for a, b in zip(values, others, strict=True)]


def _table(head: Sequence[str], rows: Sequence[Sequence[str | float]]) -> None:
    for cells in (head, ["---"] * len(head), *rows):
        words = (cell if isinstance(cell, str) else f"{cell:.4g}" for cell in cells)
        print("| " + " | ".join(words) + " |", flush=True)


if __name__ == "__main__":
    main()
