"""Bytes at equal held-out radiance error: compressed codes under a light prior against 16 bits.

python eval/radiance_metric.py [--mesh=FILE] [--material=diffuse|glossy] [--method=cpca|zh|cta]
                               [--lights=FOLDER] [--supersampling=N] [--cache=FOLDER]
                               [--points=N] [--shrinkage=S] [--short]

The baseline is each paper's closed form at the L2 metric, every number in 16 bits, over a grid of
sizes. Beside it stand the same sizes in compressed codes, at L2 and under a prior of seven measured
environments (env/ of PRT_TORCH_ASSETS, or ../shared/assets/env). Errors are relative root mean
square radiance over points, colours and all views (through the exit basis), under six environments
of other places in four turns, each of one power; and under 100 random point lights.
Diffuse transfer is of order 6; glossy transfer is Cook-Torrance in 24 rows by order 5.

A ratio is bytes over those of the baseline at equal error, interpolated between the sizes of its
front (log over log). The floor is reverse water-filling over the covariance of each cluster: the
bits without which weights cannot have the error, whatever codes they are in. --points
keeps so many points, evenly picked; --shrinkage is that of the prior; --short takes a third of the
grid.
"""

import itertools
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.assets import load_environment, load_mesh, procedural_scene
from prt_torch.assets.brdf import CookTorrance
from prt_torch.assets.material import Material
from prt_torch.baking import bake
from prt_torch.bases import SphericalHarmonics, sh
from prt_torch.command import main
from prt_torch.errors import InputError
from prt_torch.metric import Metric
from prt_torch.representations import CPCA, ClusteredTensor, Representation, ZonalLobes
from prt_torch.representations.clustered_tensor_coding import Encoding, Parameters
from prt_torch.sphere import rotation_about_up
from prt_torch.transfer import TransferTensor

DEFAULT_ASSETS = Path(__file__).resolve().parent.parent.parent / "shared" / "assets"
FITTED = (
    "debevec_beach_latlong",
    "debevec_campus_cross",
    "debevec_galileo_latlong",
    "ph_adams_place_bridge_1k",
    "ph_leadenhall_market_1k",
    "ph_noon_grass_1k",
    "ph_studio_small_05_1k",
)
HELD_OUT = (
    "debevec_building_cross",
    "debevec_rnl_latlong",
    "ict_uffizi_latlong",
    "ph_forest_slope_1k",
    "ph_phalzer_forest_01_1k",
    "ph_potsdamer_platz_1k",
)
TURNS = (10.0, 100.0, 190.0, 280.0)  # between those of the prior
GLOSSY = Material(lambertian=False, glossy=CookTorrance(f0=0.5, roughness=0.4))
SHARES = {
    ("cpca", "diffuse"): (4.0, 8.0),
    ("cpca", "glossy"): (0.25, 1.0),
    ("zh", "diffuse"): (1.0, 4.0),
    ("zh", "glossy"): (0.25, 1.0),
    ("cta", "diffuse"): (1.0, 4.0),
    ("cta", "glossy"): (0.25, 1.0),
}
SIZES: dict[tuple[str, str], Sequence[tuple[int, ...]]] = {
    ("cpca", "diffuse"): [(64, 4), (128, 4), (256, 4), (512, 4), (128, 8), (256, 8), (512, 8)],
    ("cpca", "glossy"): [(16, 2), (32, 8), (64, 16)],
    ("zh", "diffuse"): [(1,), (2,), (3,), (4,)],
    ("zh", "glossy"): [(1,), (2,), (3,)],
    ("cta", "diffuse"): [(32, 1, 16, 4), (64, 1, 24, 8), (128, 1, 24, 8)],
    ("cta", "glossy"): [(8, 6, 12, 4), (16, 12, 20, 8), (32, 16, 24, 16)],
}
"""Clusters and rank; lobes; clusters and ranks of view, light and points."""

_BLOCK_BYTES = 2**25


@dataclass(frozen=True)
class Point:
    """A size on a curve.

    Attributes:
        name: Of the size.
        stored: Bytes of a file, reflectance and exit basis aside.
        error: Under held-out environments.
        error_of_points: Under point lights.
        note: Floor of the weights, where known.
    """

    name: str
    stored: float
    error: float
    error_of_points: float
    note: str = ""


class Judge:
    """Radiance errors of representations of one transfer tensor.

    Args:
        transfer: The tensor.
        lights: Folder of environments.
        shares: Of squared error, that codes may add.
        shrinkage: Of the prior.
    """

    def __init__(
        self, transfer: TransferTensor, lights: Path, shares: Sequence[float], shrinkage: float
    ):
        basis = transfer.surface.light_basis
        if not isinstance(basis, SphericalHarmonics):
            raise ValueError("expected transfer in spherical harmonics")
        self.transfer, self.shares, self._basis = transfer, shares, basis
        self._rows = Metric("l2", None, transfer.surface.exit_basis.gram_root())
        fitted = self._project(lights, FITTED)
        exit_basis = transfer.surface.exit_basis
        self.prior = Metric.light_prior(fitted, basis, exit_basis=exit_basis, shrinkage=shrinkage)
        held_out = self._project(lights, HELD_OUT)
        turned = [basis.rotate(held_out, rotation_about_up(turn)) for turn in TURNS]
        generator = torch.Generator().manual_seed(5)
        directions = torch.randn(100, 3, generator=generator, dtype=torch.float64)
        directions = torch.nn.functional.normalize(directions, dim=1)
        points = sh.evaluate(directions, basis.order)[..., None]
        self._columns = [_of_one_power(one) for one in (torch.cat(turned), points)]

    def _project(self, folder: Path, names: Sequence[str]) -> Float[Tensor, "lights coeffs rgb"]:
        lights = [self._basis.project(load_environment(folder / f"{name}.hdr")) for name in names]
        return torch.stack(lights).double()

    @torch.no_grad()
    def __call__(self, name: str, model: Representation, stored: float, note: str = "") -> Point:
        """Errors of a representation."""
        lost, norms = [0.0, 0.0], [0.0, 0.0]
        every = torch.arange(self.transfer.num_points)
        for rows, values in self.transfer.blocks(_BLOCK_BYTES):
            exact = self._rows.weigh(values.double())
            difference = self._rows.weigh(model.dense(every[rows]).double()) - exact
            for place, columns in enumerate(self._columns):
                lost[place] += float((difference @ columns).square().sum())
                norms[place] += float((exact @ columns).square().sum())
        errors = [math.sqrt(one / norm) for one, norm in zip(lost, norms, strict=True)]
        return Point(name, stored, errors[0], errors[1], note)


def _of_one_power(
    lights: Float[Tensor, "lights coeffs rgb"],
) -> Float[Tensor, "coeffs lights_times_rgb"]:
    """Side by side, each light of squared norm 1."""
    unit = lights / lights.square().sum((1, 2), keepdim=True).sqrt()
    return unit.movedim(1, 0).flatten(1)


@main
def compare(arguments: list[str]) -> None:
    """Print the curves and the ratios."""
    options = {"mesh": "", "material": "diffuse", "method": "cpca", "supersampling": "2"}
    options |= {"cache": ".cache/bakes", "lights": "", "points": "0", "shrinkage": "0.5"}
    short = "--short" in arguments
    for argument in arguments:
        name, _, value = argument.removeprefix("--").partition("=")
        if argument != "--short" and (name not in options or not value):
            raise InputError(f"{argument}: expected one of --{', --'.join(options)} or --short")
        if argument != "--short":
            options[name] = value
    method, material = options["method"], options["material"]
    if (method, material) not in SIZES:
        raise InputError(f"{method}, {material}: expected {sorted(SIZES)}")
    assets = Path(os.environ.get("PRT_TORCH_ASSETS", DEFAULT_ASSETS))
    mesh = load_mesh(options["mesh"]) if options["mesh"] else procedural_scene(detail=2)
    baking = {"supersampling": int(options["supersampling"]), "cache": options["cache"]}
    if material == "glossy":
        glossy = {mesh.parts[0].name: GLOSSY}
        transfer = bake(mesh, materials=glossy, light_basis=SphericalHarmonics(5), **baking)
    else:
        transfer = bake(mesh, **baking)
    transfer = _some_points(transfer, int(options["points"]))
    lights, shares = Path(options["lights"] or assets / "env"), SHARES[method, material]
    judge = Judge(transfer, lights, shares, float(options["shrinkage"]))
    sizes = SIZES[method, material]
    shape = tuple(judge.transfer.values.shape)
    print(f"{mesh.name}, {material}, {method}: {shape}\n", flush=True)
    curves: dict[str, list[Point]] = {"16 bits": [], "codes, l2": [], "codes, prior": []}
    for size in sizes[:: 3 if short else 1]:
        for curve, point in CURVES[method](judge, size):
            curves[curve].append(point)
            print(_row(curve, point), flush=True)
    print_ratios(curves)


def _some_points(transfer: TransferTensor, count: int) -> TransferTensor:
    """Evenly picked points; all of them for 0."""
    if not 0 < count < transfer.num_points:
        return transfer
    values = transfer.dense()[:: transfer.num_points // count]
    surface = transfer.surface
    return TransferTensor.from_dense(
        values, light_basis=surface.light_basis, exit_basis=surface.exit_basis
    )


def cpca_curves(judge: Judge, size: tuple[int, ...]) -> Iterator[tuple[str, Point]]:
    """CPCA of one size."""
    transfer, name = judge.transfer, "x".join(map(str, size))
    for curve, metric in (("codes, l2", Metric.l2(transfer)), ("codes, prior", judge.prior)):
        model = CPCA.from_transfer(transfer, num_clusters=size[0], rank=size[1], metric=metric)
        if curve == "codes, l2":
            numbers = model.weights.numel() + model.representatives.numel()
            labels = model.packed()["labels"].nbytes
            yield "16 bits", judge(name, model, 2 * numbers + labels)
        for share in judge.shares:
            found = model.coded(transfer, share=share, metric=metric)
            note = _floor(found, transfer, metric)
            yield curve, judge(f"{name} share {share:g}", found, _stored(found), note)


def zonal_curves(judge: Judge, size: tuple[int, ...]) -> Iterator[tuple[str, Point]]:
    """Zonal lobes of one size."""
    transfer, name = judge.transfer, f"{size[0]} lobes"
    fine = ZonalLobes.from_transfer(transfer, num_lobes=size[0], effort="fast")
    yield "16 bits", judge(name, fine, _stored(fine))
    for curve, metric in (("codes, l2", Metric.l2(transfer)), ("codes, prior", judge.prior)):
        for share in judge.shares:
            found = fine.coded(transfer, share=share, metric=metric)
            yield curve, judge(f"{name} share {share:g}", found, _stored(found))


def tensor_curves(judge: Judge, size: tuple[int, ...]) -> Iterator[tuple[str, Point]]:
    """Clustered tensors of one size."""
    transfer, name = judge.transfer, f"{size[0]}x{'/'.join(map(str, size[1:]))}"
    for curve, metric in (("codes, l2", Metric.l2(transfer)), ("codes, prior", judge.prior)):
        model = ClusteredTensor.from_transfer(
            transfer, num_clusters=size[0], ranks=size[1:], bits=None, metric=metric
        )
        if curve == "codes, l2":
            parts = {part: getattr(model, part).detach() for part in Parameters.names()}
            plain = Encoding(model.labels, model.groups, Parameters(**parts), None, model.condition)
            half = ClusteredTensor(plain.coded(), transfer.surface, model.shape)
            yield "16 bits", judge(name, half, _stored(half))
        for share in judge.shares:
            found = model.coded(transfer, share=share, metric=metric)
            yield curve, judge(f"{name} share {share:g}", found, _stored(found))


CURVES: dict[str, Callable[[Judge, tuple[int, ...]], Iterator[tuple[str, Point]]]] = {
    "cpca": cpca_curves,
    "zh": zonal_curves,
    "cta": tensor_curves,
}


def _stored(model: Representation) -> float:
    """Bytes of a file that codes can change."""
    return sum(tensor.nbytes for tensor in model.packed().values())


@torch.no_grad()
def _floor(model: CPCA, transfer: TransferTensor, metric: Metric) -> str:
    """Bytes of weights over the least that their clusters' covariances allow at their error."""
    size = transfer.num_channels * transfer.num_rows * transfer.num_coeffs
    if size > 64:
        return ""
    values = metric.weigh(transfer.dense().double()).flatten(1)
    lost = metric.weigh(model.dense().double()).flatten(1) - values
    spectra, counts = [], []
    for cluster in range(model.num_clusters):
        own = values[model.labels == cluster]
        centred = own - own.mean(0)
        spectra.append(torch.linalg.eigvalsh(centred.mT @ centred / len(own)).clamp_min(1e-30))
        counts.append(len(own))
    variances = torch.stack(spectra)
    sizes = torch.tensor(counts, dtype=torch.float64)[:, None]
    allowed, low, high = float(lost.square().sum()), 1e-30, float(variances.max())
    for _ in range(100):
        level = math.sqrt(low * high)
        over = float((sizes * variances.clamp_max(level)).sum()) > allowed
        low, high = (low, level) if over else (level, high)
    bits = float((sizes * 0.5 * torch.log2(variances / low).clamp_min(0.0)).sum())
    return f"{model.packed()['weight_stream'].nbytes / (bits / 8):.2f}"


def _row(curve: str, point: Point) -> str:
    return (
        f"| {curve} | {point.name} | {point.stored / 1e3:.0f} | {point.error:.5f} "
        f"| {point.error_of_points:.5f} | {point.note} |"
    )


def print_ratios(curves: dict[str, list[Point]]) -> None:
    """Bytes over those of the baseline at equal error, for each coded point within its range."""
    print("\n| curve | size | ratio at equal error | at equal error under point lights |")
    print("| --- | --- | --- | --- |")
    for curve in ("codes, l2", "codes, prior"):
        for point in curves[curve]:
            base = curves["16 bits"]
            environments = _ratio(point.stored, point.error, [(p.error, p.stored) for p in base])
            error = point.error_of_points
            lights = _ratio(point.stored, error, [(p.error_of_points, p.stored) for p in base])
            if environments or lights:
                print(f"| {curve} | {point.name} | {environments} | {lights} |")


def _ratio(stored: float, error: float, baseline: list[tuple[float, float]]) -> str:
    """Against the front of the baseline at this error; empty where it does not reach."""
    front: list[tuple[float, float]] = []
    for lost, size in sorted(baseline):
        if not front or size < front[-1][1]:
            front.append((lost, size))
    for (low, large), (high, small) in itertools.pairwise(front):
        if low <= error <= high:
            along = math.log(error / low) / math.log(high / low)
            return (
                f"{stored / math.exp(math.log(large) * (1 - along) + math.log(small) * along):.3f}"
            )
    return ""


if __name__ == "__main__":
    sys.exit(compare(sys.argv[1:]))
