"""A run's account of itself: errors, bytes, times, pictures and what was left out."""

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from prt_torch import evaluate, gallery, store
from prt_torch.baking import RESOLVED
from prt_torch.inputs import Inputs
from prt_torch.preview import Camera
from prt_torch.relight import Relighter
from prt_torch.report import write_html
from prt_torch.representations import (
    CPCA,
    ClusteredTensor,
    DenseTransfer,
    Representation,
    SegmentedCPCA,
)
from prt_torch.representations.cpca_relabel import coherence
from prt_torch.representations.palette import reflectance_bytes
from prt_torch.settings import PreviewConfig
from prt_torch.solves import Fitted, Solve
from prt_torch.transfer import TransferTensor

PICTURES = "pictures"  # folder of them inside a run folder
_ALL_BUT_ONE = 24  # functions of order 5 without the best replaced one
_VIEWS = 6  # around the scene, that errors of glossy transfer are averaged over
_NO_OPENGL = {
    "what": "the OpenGL preview",
    "why": "not asked for, or no EGL here; the ray-cast pictures are exact anyway",
    "saved_seconds": 0.0,
}


@torch.no_grad()
def write_report(
    out: Path,
    inputs: Inputs,
    transfer: TransferTensor,
    fitted: list[Fitted],
    *,
    solved: list[Solve],
    preview: PreviewConfig,
    memory_budget: int,
) -> dict[str, Any]:
    """Evaluate all results, draw them, and write report.json and report.html."""
    relighters = {one.name: Relighter(one.representation).eval() for one in fitted}
    projected = [inputs.light_basis.project(light).float() for light in inputs.test_lights]
    camera = Camera.framing(inputs.mesh, aspect=preview.width / preview.height)
    views = camera.around(_VIEWS) if transfer.surface.exit_basis.view_dependent else None
    lit, radiance_errors = [], {one.name: {} for one in fitted}
    for environment, light in zip(inputs.test_lights, projected, strict=True):
        shown, lost = _relight(relighters, transfer, light, views)
        lit.append(gallery.Lit(environment, *shown))
        for name, error in lost.items():
            radiance_errors[name][environment.name] = error
    errors = {one.name: evaluate.squared_errors(one.representation, transfer) for one in fitted}
    first_view = None if views is None else views[:1]
    times, dense_seconds, scaled = _time(
        relighters, transfer, projected[0], first_view, memory_budget
    )
    norms = transfer.squared_norm()
    scale = float(norms.mean()) or 1.0
    pictures, opengl_drew = gallery.draw(
        out / PICTURES,
        inputs.mesh,
        lit,
        {name: (squared / scale).sqrt() for name, squared in errors.items()},
        camera=camera,
        width=preview.width,
        height=preview.height,
        opengl=preview.opengl,
    )
    report = facts(inputs, transfer)
    report["left_out"] = [
        *left_out(inputs, transfer),
        *([] if opengl_drew else [_NO_OPENGL]),
        *_left_out_segments(transfer, fitted),
    ]
    report["solves"] = [solve.entry() for solve in solved]
    report["results"] = [
        {
            **_worth(one, transfer, float(errors[one.name].sum()), float(norms.sum())),
            "radiance_error": radiance_errors[one.name],
            "relight_seconds": times[one.name],
            "dense_seconds": dense_seconds,
            **({"dense_scaled": True} if scaled else {}),
            "peak_bytes": evaluate.peak_bytes(
                partial(relighters[one.name], projected[0][None], first_view)
            ),
            **_coherence(one.representation, inputs.mesh.faces),
        }
        for one in fitted
    ]
    store.write_json(out / "report.json", report)
    write_html(out / "report.html", report, pictures)
    return report


def _worth(one: Fitted, transfer: TransferTensor, lost: float, norm: float) -> dict[str, Any]:
    """A result with its squared error, that of the transfer it stands for."""
    return {
        "name": one.name,
        "representation": one.representation.kind,
        "parameters": one.representation.budget,
        "status": one.status,
        "fit_seconds": one.seconds,
        "bytes": sum(one.representation.storage().values()),
        "transfer_error": lost / (norm or 1.0),
        "reference_error": evaluate.reference_error(lost, transfer),
        "condition": one.condition,
    }


def _coherence(model: Representation, faces: Tensor) -> dict[str, Any]:
    """How often a face is drawn, of clusters that a renderer draws one by one."""
    match model:
        case CPCA():
            return {"coherence": coherence(model, faces)}
        case ClusteredTensor():
            return {"coherence": model.coherence(faces)}
    return {}


@torch.no_grad()
def _relight(
    relighters: dict[str, Relighter], transfer: TransferTensor, light: Tensor, views: Tensor | None
) -> tuple[tuple[Tensor, dict[str, Tensor]], dict[str, float]]:
    """Radiance towards the camera, uncompressed and by each result, and errors over all views."""
    reference = evaluate.dense_radiance(transfer, light[None], views)[0]
    seen = torch.ones(1, 1) if views is None else evaluate.seen_from(transfer.surface, views)
    seen = seen[..., None].to(reference)
    expected = reference * seen
    shown, errors = {}, {}
    for name, relight in relighters.items():
        radiance = relight(light[None], views)[0]
        shown[name] = radiance[0]
        errors[name] = evaluate.radiance_error(radiance * seen, expected)
    return (reference[0], shown), errors


def _time(
    relighters: dict[str, Relighter],
    transfer: TransferTensor,
    light: Tensor,
    view: Tensor | None,
    memory_budget: int,
) -> tuple[dict[str, float], float, bool]:
    """Seconds to relight by each result and by the tensor itself, measured in turn."""
    block, factor = evaluate.timed_block(transfer, memory_budget)
    dense = Relighter(DenseTransfer.from_transfer(block))
    calls = [lambda relight=relight: relight(light[None], view) for relight in relighters.values()]
    with torch.no_grad():
        *taken, dense_taken = evaluate.median_seconds([*calls, lambda: dense(light[None], view)])
    return dict(zip(relighters, taken, strict=True)), dense_taken * factor, factor > 1


def facts(inputs: Inputs, transfer: TransferTensor) -> dict[str, Any]:
    """Scene, light and bake of a report."""
    mesh, made = inputs.mesh, transfer.provenance
    bounces = made.get("bounces", {})
    return {
        "scene": {
            "mesh": mesh.name,
            "points": mesh.num_points,
            "faces": mesh.num_faces,
            "material": inputs.material,
            "rows": transfer.num_rows,
            "channels": transfer.num_channels,
            "warnings": [asdict(warning) for warning in mesh.warnings],
        },
        "light": {"basis": inputs.light_basis.name, "coeffs": transfer.num_coeffs},
        "bake": {
            "seconds": made["visibility_seconds"]
            + made["projection_seconds"]
            + bounces.get("seconds", 0.0)
            + made.get("subsurface_seconds", 0.0),
            "rays": made["rays"] + bounces.get("rays", 0),
            "cached": made["visibility_cached"]
            and made["projection_cached"]
            and bounces.get("cached", True),
            **({"bounces": bounces["added"]} if bounces else {}),
            **({"factor_error": made["factor_error"]} if "factor_error" in made else {}),
            **({"unresolved": made["unresolved"]} if made["unresolved"] > RESOLVED else {}),
        },
        "raw_bytes": transfer.num_bytes,
    }


def left_out(inputs: Inputs, transfer: TransferTensor) -> list[dict[str, Any]]:
    """What this scene does not need, why, and what leaving it out saved."""
    mesh, values = inputs.mesh, transfer.num_bytes - transfer.surface.reflectance.nbytes
    needless = transfer.provenance.get("left_out", [])
    entries = [*_left_out_rays(transfer), *_left_out_light(transfer), *needless]
    if transfer.num_channels == 1 and not any("channels" in one["what"] for one in needless):
        entries.append(
            {
                "what": "two of three colour channels of transfer",
                "why": "colour is a factor of its own, or there is none",
                "saved_bytes": 2 * values,
            }
        )
    if not transfer.surface.exit_basis.view_dependent:
        entries.append(
            {
                "what": "views and exit rows",
                "why": "the material is diffuse: radiance is the same in every direction",
                "saved_bytes": 0,
            }
        )
    elif transfer.num_rows == _ALL_BUT_ONE:
        entries.append(
            {
                "what": "the exit function y_(1,0)",
                "why": "over the hemisphere the other 24 replace it to 1.5e-5 of its square",
                "saved_bytes": values // _ALL_BUT_ONE,
            }
        )
    reflectance = transfer.surface.reflectance
    saved = 3 * mesh.num_points * reflectance.itemsize - reflectance_bytes(reflectance)
    if saved:
        shared = len(reflectance) == 1
        entries.append(
            {
                "what": "reflectance by point",
                "why": "all have the same" if shared else "a file keeps a few colours once",
                "saved_bytes": saved,
            }
        )
    rays_traced = transfer.provenance["rays"]
    blind = int((mesh.normals == 0).all(dim=1).sum())
    if blind and rays_traced:
        per_point = transfer.provenance["visibility_seconds"] / (mesh.num_points - blind)
        entries.append(
            {
                "what": f"rays of {blind} points",
                "why": "they have no normal and are part of no face; their transfer is zero",
                "saved_seconds": per_point * blind,
            }
        )
    return entries


def _left_out_segments(transfer: TransferTensor, fitted: list[Fitted]) -> list[dict[str, Any]]:
    """Segments of the light that points see nothing of."""
    shares = [
        one.representation.culled_share
        for one in fitted
        if isinstance(one.representation, SegmentedCPCA)
    ]
    if not shares:
        return []
    values = transfer.num_bytes - transfer.surface.reflectance.nbytes
    return [
        {
            "what": f"{100 * shares[0]:.0f} % of all pairs of a point and a segment of the light",
            "why": "the point sees nothing of the segment",
            "saved_bytes": round(shares[0] * values),
        }
    ]


def _left_out_rays(transfer: TransferTensor) -> list[dict[str, Any]]:
    """Points that were proven to see all above their horizon."""
    made, points = transfer.provenance, transfer.num_points
    free = made.get("free_points", 0)
    why = "no face reaches above their tangent planes, so nothing hides the sky from them"
    if not free:
        return []
    if not made["rays"]:
        saved = points * made["bits_bytes"]
        return [{"what": "all rays and visibility bits", "why": why, "saved_bytes": saved}]
    saved = made["visibility_seconds"] * free / (points - free)
    return [{"what": f"rays of {free} of {points} points", "why": why, "saved_seconds": saved}]


def _left_out_light(transfer: TransferTensor) -> list[dict[str, Any]]:
    """Bounces that were not gathered."""
    bounces = transfer.provenance.get("bounces")
    if bounces is None:
        return []
    if bounces["skipped"]:
        why = "no ray from any point hits the scene again"
        return [{"what": "all bounces between points", "why": why, "saved_seconds": 0.0}]
    if not bounces["ended"]:
        return []
    added, seconds = bounces["added"], bounces["seconds"]
    why = f"bounce {len(added)} added {added[-1]:.1e} of the light, the first {added[0]:.1e}"
    saved = seconds / len(added)
    return [{"what": f"bounces after {len(added)}", "why": why, "saved_seconds": saved}]
