"""Compare scattered functions with harmonics and wavelets as models of measured lights.

python eval/environments.py [--lights=FOLDER] [--out=FOLDER] [--only=PART] [--scipy]

Every .hdr and .exr file of the folder (env/ of PRT_TORCH_ASSETS, or ../shared/assets/env), as the
mean radiance of 6x32x32 texels. Errors are squared errors over squared norms on the sphere.
Compared at 972 numbers: harmonics of order 18 (324 functions of three colours, fitted to the
texels), the 324 area-weighted Haar wavelets of three colours, 243 of them where the index of each
counts as a number too, 972 of them (2916 numbers, for those who read the paper so), and 162
scattered Gaussians (two numbers for the centre, one for the width, three for the colour).
--scipy also minimises the same objective from the same seeds by L-BFGS-B; --out writes pictures,
from left to right, top to bottom: the light, harmonics, wavelets, scattered functions.
"""

import os
import sys
import time
from pathlib import Path

import numpy as np
import scipy.optimize
import torch
from torch import Tensor

from prt_torch.assets import load_environment
from prt_torch.bases import CubeDirections, Haar, sh
from prt_torch.bases.srbf_fitting import EnvironmentFit, fit_texels, seeds
from prt_torch.bases.srbf_objective import TexelObjective
from prt_torch.command import main
from prt_torch.errors import InputError
from prt_torch.preview.images import automatic_exposure, write_png
from prt_torch.sphere import cubemap_directions, cubemap_index, frame_from_normal
from prt_torch.truncation import truncate

RESOLUTION, ORDER, NUM_FUNCTIONS = 32, 18, 162
NUMBERS = 3 * ORDER**2
BRIGHT_SHARE = 0.01  # of the sphere
ROWS = 128  # of a picture
LBFGS_STEPS = 200
DEFAULT_ASSETS = Path(__file__).resolve().parent.parent.parent / "shared" / "assets"
COLUMNS = (
    "light",
    "share in 1 %",
    "SH order 18",
    "Haar 972",
    "Haar 972, indices counted",
    "Haar 972 x RGB",
    "scattered 162",
    "seconds",
    "status",
    "condition",
)


@main
def compare(arguments: list[str]) -> None:
    """Print the table, and write pictures if asked for."""
    lights = Path(os.environ.get("PRT_TORCH_ASSETS", DEFAULT_ASSETS)) / "env"
    out, part, with_scipy = None, "", False
    for argument in arguments:
        match argument.partition("="):
            case ("--lights", "=", folder):
                lights = Path(folder)
            case ("--out", "=", folder):
                out = Path(folder)
            case ("--only", "=", name):
                part = name
            case ("--scipy", "", ""):
                with_scipy = True
            case _:
                raise InputError(
                    f"{argument}: expected --lights=FOLDER, --out=FOLDER, --only=PART or --scipy"
                )
    files = sorted(f for f in lights.glob("*") if f.suffix in {".hdr", ".exr"} and part in f.name)
    if not files:
        raise InputError(f"{lights}: expected .hdr or .exr files, got none")
    columns = (*COLUMNS, "L-BFGS-B", "seconds", "steps") if with_scipy else COLUMNS
    print(f"{torch.get_num_threads()} threads\n")
    print("| " + " | ".join(columns) + " |")
    print("|" + " --- |" * len(columns))
    for file in files:
        row = compared(file, out, with_scipy=with_scipy)
        print("| " + " | ".join(row) + " |", flush=True)


def compared(file: Path, out: Path | None, *, with_scipy: bool) -> list[str]:
    """One line of the table."""
    cube, haar = CubeDirections(RESOLUTION), Haar(RESOLUTION, RESOLUTION // 2)
    environment = load_environment(file)
    light = cube.project(environment)
    harmonics = in_harmonics(light)
    coefficients, areas = haar.project(environment)[None], haar.areas()
    kept, lost = truncate(coefficients, haar, NUMBERS // 3, weights=areas)
    _, lost_by_indices = truncate(coefficients, haar, NUMBERS // 4, weights=areas)
    _, lost_of_more = truncate(coefficients, haar, NUMBERS, weights=areas)
    start = time.perf_counter()
    fit = fit_texels(light[None], NUM_FUNCTIONS)
    seconds = time.perf_counter() - start
    if out:
        models = [light, harmonics, haar.radiance(kept)[0]]
        write_pictures(out / f"{file.stem}.png", models, fit)
    row = [
        file.stem,
        f"{share_of_brightest(light):.2f}",
        f"{error(harmonics, light):.2e}",
        *(f"{float(e):.2e}" for e in (lost, lost_by_indices, lost_of_more)),
        f"{fit.squared_error[0]:.2e}",
        f"{seconds:.1f}",
        fit.status[0],
        f"{fit.condition[0]:.0e}",
    ]
    return [*row, *by_lbfgs(light)] if with_scipy else row


def share_of_brightest(light: Tensor) -> float:
    """Share of the light that comes from the brightest hundredth of the sphere."""
    solid_angles = CubeDirections(RESOLUTION).solid_angles
    flux = light.sum(1) * solid_angles
    order = light.sum(1).argsort(descending=True)
    inside = solid_angles[order].cumsum(0) <= BRIGHT_SHARE * solid_angles.sum()
    return float(flux[order][inside].sum() / flux.sum())


def error(model: Tensor, light: Tensor) -> float:
    """Squared error over squared norm, both by solid angle."""
    weights = CubeDirections(RESOLUTION).solid_angles[:, None]
    return float((weights * (model - light).square()).sum() / (weights * light.square()).sum())


def in_harmonics(light: Tensor) -> Tensor:
    """The texels of the harmonics that are closest to the light."""
    cube = CubeDirections(RESOLUTION)
    roots = cube.solid_angles.sqrt()[:, None]
    values = sh.evaluate(cubemap_directions(RESOLUTION, dtype=torch.float64).view(-1, 3), ORDER)
    return values @ torch.linalg.lstsq(values * roots, light * roots).solution


def by_lbfgs(light: Tensor) -> list[str]:
    """Error, seconds and iterations of L-BFGS-B on the same objective from the same seeds."""
    objective = TexelObjective(light[None], "gaussian")
    start = time.perf_counter()
    centers, log_widths = (one[0] for one in seeds(objective, NUM_FUNCTIONS))

    def of(unknowns: np.ndarray) -> tuple[float, np.ndarray]:
        raw = torch.from_numpy(unknowns).view(NUM_FUNCTIONS, 4)
        at = objective.evaluate(raw[None, :, :3], raw[None, :, 3])
        first, second, wider = 2.0 * objective.gradient(at)[0].view(3, -1)
        frames = frame_from_normal(at.centers[0])
        along = first[:, None] * frames[:, 0] + second[:, None] * frames[:, 1]
        along = along / raw[:, :3].norm(dim=1, keepdim=True)
        return float(at.objective), torch.cat([along, wider[:, None]], dim=1).flatten().numpy()

    begin = torch.cat([centers, log_widths[:, None]], dim=1).flatten().numpy()
    options = {"maxiter": LBFGS_STEPS, "maxfun": 2 * LBFGS_STEPS}
    found = scipy.optimize.minimize(of, begin, jac=True, method="L-BFGS-B", options=options)
    return [f"{found.fun:.2e}", f"{time.perf_counter() - start:.1f}", str(found.nit)]


def write_pictures(path: Path, models: list[Tensor], fit: EnvironmentFit) -> None:
    """Lat-long pictures of texels, and of the functions themselves, in a square of four."""
    polar = (torch.arange(ROWS, dtype=torch.float64) + 0.5)[:, None] * (torch.pi / ROWS)
    azimuth = (torch.arange(2 * ROWS, dtype=torch.float64) + 0.5) * (torch.pi / ROWS) - torch.pi
    level, height = polar.sin(), polar.cos().expand(ROWS, 2 * ROWS)
    directions = torch.stack([level * azimuth.sin(), height, -level * azimuth.cos()], dim=-1)
    texels = cubemap_index(directions, RESOLUTION)
    pictures = [model[texels] for model in models]
    pictures.append(fit.expansion.evaluate(directions.view(-1, 3)).view(ROWS, 2 * ROWS, 3))
    rows = [torch.cat(pictures[:2], dim=1), torch.cat(pictures[2:], dim=1)]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, torch.cat(rows).numpy(), automatic_exposure(pictures[0].numpy()))


if __name__ == "__main__":
    sys.exit(compare(sys.argv[1:]))
