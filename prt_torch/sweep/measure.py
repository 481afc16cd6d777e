"""What a representation is worth in a sweep: errors under held-out lights, bytes, and three times.

A change of light alone costs the way from light coefficients to exit rows; a change of view alone
costs the way from exit rows, which are kept, to radiance; a change of both costs the whole. Times
are medians of calls taken in turn, by one process that does nothing else.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from prt_torch import evaluate
from prt_torch.inputs import Inputs
from prt_torch.preview import Camera
from prt_torch.relight import Relighter
from prt_torch.representations import DenseTransfer, Representation
from prt_torch.transfer import TransferTensor

VIEWS = 6
"""Around the scene."""
_ROUNDS, _WARM_UP = 9, 2


class Judge:
    """Measures representations of one tensor; what the tensor itself gives is computed once.

    Args:
        transfer: What they stand for.
        lights: Held-out light coefficients ``"coeffs rgb"`` by name; at least one.
        views: Where viewers stand, ``"views 3"``; needed where radiance depends on the view.
    """

    def __init__(
        self,
        transfer: TransferTensor,
        lights: Mapping[str, Float[Tensor, "coeffs rgb"]],
        views: Float[Tensor, "views 3"] | None = None,
    ):
        self.transfer, self.lights = transfer, dict(lights)
        self.views = views if transfer.surface.exit_basis.view_dependent else None
        self._references: dict[str, Tensor] = {}
        self._norm = float(transfer.squared_norm().sum()) or 1.0

    @classmethod
    def of_inputs(cls, inputs: Inputs, transfer: TransferTensor) -> "Judge":
        """With the held-out lights of a run, and viewers around its scene."""
        lights = {one.name: inputs.light_basis.project(one).float() for one in inputs.test_lights}
        return cls(transfer, lights, Camera.framing(inputs.mesh).around(VIEWS))

    def _seen(self) -> Bool[Tensor, "views points 1"] | Float[Tensor, "1 1 1"]:
        if self.views is None:
            return torch.ones(1, 1, 1)
        return evaluate.seen_from(self.transfer.surface, self.views)[..., None]

    def _reference(self, name: str) -> Float[Tensor, "views points rgb"]:
        if name not in self._references:
            light = self.lights[name][None]
            self._references[name] = evaluate.dense_radiance(self.transfer, light, self.views)[0]
        return self._references[name]

    @torch.no_grad()
    def errors(self, model: Representation) -> dict[str, Any]:
        """Bytes, errors of transfer and radiance, and memory, under the names of a report."""
        relighter, seen = Relighter(model).eval(), self._seen()
        radiance_error = {}
        for name, light in self.lights.items():
            reference = self._reference(name)
            radiance = relighter(light[None].to(reference), self.views)[0]
            radiance_error[name] = evaluate.radiance_error(radiance * seen, reference * seen)
        lost = float(evaluate.squared_errors(model, self.transfer).sum())
        light, view = self._light_and_view()
        return {
            "bytes": sum(model.storage().values()),
            "transfer_error": lost / self._norm,
            "reference_error": evaluate.reference_error(lost, self.transfer),
            "radiance_error": radiance_error,
            "peak_bytes": evaluate.peak_bytes(lambda: relighter(light, view)),
        }

    def _light_and_view(self) -> tuple[Float[Tensor, "1 coeffs rgb"], Tensor | None]:
        light = next(iter(self.lights.values()))[None].to(self.transfer.values.dtype)
        return light, None if self.views is None else self.views[:1]

    @torch.no_grad()
    def seconds(self, model: Representation, device: str = "cpu") -> dict[str, float]:
        """Median times of a change of ``light``, of ``view``, and of ``both``.

        Args:
            model: Moved to the device and back.
            device: Of torch.
        """
        light, view = self._light_and_view()
        light, view = light.to(device), None if view is None else view.to(device)
        relighter = Relighter(model).eval().to(device)
        rows = relighter.transferred(light)
        calls: list[Callable[[], Any]] = [
            lambda: relighter.transferred(light),
            lambda: relighter.shade(rows, view),
            lambda: relighter(light, view),
        ]
        taken = evaluate.median_seconds(calls, rounds=_ROUNDS, warm_up=_WARM_UP)
        model.cpu()
        return dict(zip(("light", "view", "both"), taken, strict=True))

    @torch.no_grad()
    def dense_seconds(self, memory_budget: int) -> dict[str, float]:
        """The same of the tensor itself, from some of its points where it takes too much memory."""
        block, factor = evaluate.timed_block(self.transfer, memory_budget)
        own = Judge(block, dict(list(self.lights.items())[:1]), self.views)
        taken = own.seconds(DenseTransfer.from_transfer(block))
        return {name: value * factor for name, value in taken.items()}
