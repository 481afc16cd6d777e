"""A run's account of itself: errors, bytes, times, pictures and what was left out."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from prt_torch import evaluate, gallery, store
from prt_torch.assets import Environment, Mesh
from prt_torch.bases import LightBasis
from prt_torch.config import PreviewConfig
from prt_torch.relight import Relighter
from prt_torch.report import write_html
from prt_torch.representations import DenseTransfer, Representation
from prt_torch.transfer import TransferTensor

PICTURES = "pictures"  # folder of them inside a run folder
_DENSE_BLOCK_POINTS = 2000  # timed and scaled up when the whole tensor does not fit


@dataclass(frozen=True)
class Inputs:
    """Everything a run reads, loaded and validated before anything is written."""

    mesh: Mesh
    fit_lights: list[Environment]
    test_lights: list[Environment]
    light_basis: LightBasis


@dataclass(frozen=True)
class Fitted:
    """One result: a representation and how it came about."""

    name: str
    representation: Representation
    status: str
    seconds: float
    condition: float


def write_report(
    out: Path,
    inputs: Inputs,
    transfer: TransferTensor,
    fitted: list[Fitted],
    *,
    preview: PreviewConfig,
    memory_budget: int,
) -> dict[str, Any]:
    """Evaluate all results, draw them, and write report.json and report.html."""
    relighters = {one.name: Relighter(one.representation).eval() for one in fitted}
    projected = [inputs.light_basis.project(light).float() for light in inputs.test_lights]
    lit = []
    with torch.no_grad():
        for environment, light in zip(inputs.test_lights, projected, strict=True):
            reference = evaluate.dense_radiance(transfer, light[None])[0]
            images = {name: relight(light[None])[0, 0] for name, relight in relighters.items()}
            lit.append(gallery.Lit(environment, reference, images))
    errors = {one.name: evaluate.squared_errors(one.representation, transfer) for one in fitted}
    times, dense_seconds, scaled = _time(relighters, transfer, projected[0], memory_budget)
    norms = transfer.squared_norm()
    scale = float(norms.mean()) or 1.0
    pictures, opengl_drew = gallery.draw(
        out / PICTURES,
        inputs.mesh,
        lit,
        {name: (squared / scale).sqrt() for name, squared in errors.items()},
        width=preview.width,
        height=preview.height,
        opengl=preview.opengl,
    )
    report = _facts(inputs, transfer)
    report["left_out"] = _left_out(inputs, transfer, opengl_missing=not opengl_drew)
    report["results"] = []
    for one in fitted:
        lost = float(errors[one.name].sum())
        result = {
            "name": one.name,
            "representation": one.representation.kind,
            "parameters": one.representation.budget,
            "status": one.status,
            "fit_seconds": one.seconds,
            "bytes": sum(one.representation.storage().values()),
            "transfer_error": lost / (float(norms.sum()) or 1.0),
            "reference_error": evaluate.reference_error(lost, transfer),
            "radiance_error": {
                light.environment.name: evaluate.radiance_error(
                    light.fitted[one.name], light.reference
                )
                for light in lit
            },
            "condition": one.condition,
            "relight_seconds": times[one.name],
            "dense_seconds": dense_seconds,
            "peak_bytes": evaluate.peak_bytes(
                lambda one=one: relighters[one.name](projected[0][None])
            ),
        }
        if scaled:
            result["dense_scaled"] = True
        report["results"].append(result)
    store.write_json(out / "report.json", report)
    write_html(out / "report.html", report, pictures)
    return report


def _time(
    relighters: dict[str, Relighter], transfer: TransferTensor, light: Tensor, memory_budget: int
) -> tuple[dict[str, float], float, bool]:
    """Seconds to relight by each result and by the tensor itself, measured in turn."""
    scaled = transfer.num_bytes > memory_budget // 2
    points = _DENSE_BLOCK_POINTS if scaled else transfer.num_points
    dense = Relighter(DenseTransfer.from_transfer(transfer.block(slice(0, points))))
    calls = [lambda relight=relight: relight(light[None]) for relight in relighters.values()]
    with torch.no_grad():
        *taken, dense_taken = evaluate.median_seconds([*calls, lambda: dense(light[None])])
    factor = transfer.num_points / points
    return dict(zip(relighters, taken, strict=True)), dense_taken * factor, scaled


def _facts(inputs: Inputs, transfer: TransferTensor) -> dict[str, Any]:
    """Scene, light and bake of report.json."""
    mesh, made = inputs.mesh, transfer.provenance
    return {
        "scene": {
            "mesh": mesh.name,
            "points": mesh.num_points,
            "faces": mesh.num_faces,
            "material": "diffuse",
            "rows": transfer.num_rows,
            "channels": transfer.num_channels,
            "warnings": [asdict(warning) for warning in mesh.warnings],
        },
        "light": {"basis": inputs.light_basis.name, "coeffs": transfer.num_coeffs},
        "bake": {
            "seconds": made["visibility_seconds"] + made["projection_seconds"],
            "rays": made["rays"],
            "cached": made["visibility_cached"] and made["projection_cached"],
        },
        "raw_bytes": transfer.num_bytes,
    }


def _left_out(
    inputs: Inputs, transfer: TransferTensor, *, opengl_missing: bool
) -> list[dict[str, Any]]:
    """What this scene does not need, why, and what leaving it out saved."""
    mesh, values = inputs.mesh, transfer.num_bytes - transfer.surface.reflectance.nbytes
    left_out = [
        {
            "what": "two of three colour channels of transfer",
            "why": "reflectance is a factor of its own",
            "saved_bytes": 2 * values,
        },
        {
            "what": "views and exit rows",
            "why": "the material is diffuse: radiance is the same in every direction",
            "saved_bytes": 0,
        },
    ]
    if len(transfer.surface.reflectance) == 1:
        left_out.append(
            {
                "what": "reflectance by point",
                "why": "all points have the same",
                "saved_bytes": 12 * (mesh.num_points - 1),
            }
        )
    rays_traced = transfer.provenance["rays"]
    blind = int((mesh.normals == 0).all(dim=1).sum())
    if blind and rays_traced:
        per_point = transfer.provenance["visibility_seconds"] / (mesh.num_points - blind)
        left_out.append(
            {
                "what": f"rays of {blind} points",
                "why": "they have no normal and are part of no face; their transfer is zero",
                "saved_seconds": per_point * blind,
            }
        )
    if opengl_missing:
        left_out.append(
            {
                "what": "the OpenGL preview",
                "why": "not asked for, or no EGL here; the ray-cast pictures are exact anyway",
                "saved_seconds": 0.0,
            }
        )
    return left_out
