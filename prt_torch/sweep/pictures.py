"""Pictures of a sweep: one result of each family at equal bytes, equal time and equal error.

Beside the uncompressed, and each with its difference to it, under the first held-out light. The
level of each comparison is the lowest that all families reach.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from prt_torch import evaluate, gallery
from prt_torch.inputs import Inputs
from prt_torch.preview import Camera
from prt_torch.relight import Relighter
from prt_torch.report import Picture
from prt_torch.report.numbers import bytes_text, percent_text, seconds_text
from prt_torch.settings import PreviewConfig
from prt_torch.sweep.chain import Kept
from prt_torch.tradeoff import Result, at_equal, error_of
from prt_torch.transfer import TransferTensor

_ERROR = "mean_radiance_error"
_COMPARISONS = (
    ("bytes", "At most", bytes_text),
    ("relight_seconds", "A relighting in at most", seconds_text),
    (_ERROR, "Radiance error of at most", percent_text),
)


@torch.no_grad()
def pictures(
    folder: Path,
    results: list[dict[str, Any]],
    kept: Kept,
    inputs: Inputs,
    transfer: TransferTensor,
    preview: PreviewConfig,
) -> list[Picture]:
    """Draw the comparisons and write their files.

    Args:
        folder: Where they go.
        results: Of the sweep's report.
        kept: Their representations.
        inputs: Scene and lights.
        transfer: What all of them stand for.
        preview: Size of a picture.

    Raises:
        InputError: If a file cannot be written.
    """
    camera = Camera.framing(inputs.mesh, aspect=preview.width / preview.height)
    view = None
    if transfer.surface.exit_basis.view_dependent:
        view = torch.tensor(camera.eye)[None]
    environment = inputs.test_lights[0]
    light = inputs.light_basis.project(environment).float()[None]
    reference = evaluate.dense_radiance(transfer, light, view)[0, 0]
    drawn = []
    for key, words, text in _COMPARISONS:
        level, chosen = at_equal(results, key, _ERROR)
        fitted = {str(one["name"]): _radiance(one, kept, light, view) for one in chosen}
        found, _ = gallery.draw(
            folder / gallery.file_name(key),
            inputs.mesh,
            [gallery.Lit(environment, reference, fitted)],
            {name: (one - reference).norm(dim=1) for name, one in fitted.items()},
            camera=camera,
            width=preview.width,
            height=preview.height,
            opengl=False,
        )
        heading = f"{words} {text(level)}, lit by {environment.name}"
        drawn += _told(found, chosen, heading)
    return drawn


def _radiance(result: Result, kept: Kept, light: Tensor, view: Tensor | None) -> Tensor:
    """Towards the camera, of every point."""
    model = kept.model(result["representation"], result["parameters"])
    if model is None:
        raise ValueError(f"expected a point that is kept, got {result['name']}")
    return Relighter(model).eval()(light, view)[0, 0]


def _told(found: list[Picture], chosen: list[Result], heading: str) -> list[Picture]:
    """The pictures of one light, with the figures of results beside their names."""
    captions = {
        str(one["name"]): f"{bytes_text(one['bytes'])}, {seconds_text(one['relight_seconds'])}, "
        f"error {percent_text(error_of(one, _ERROR))}"
        for one in chosen
    }
    return [
        replace(one, group=heading, caption=captions.get(one.title, one.caption))
        for one in found
        if one.group.startswith("Lit by")
    ]
