"""Where the error of one result comes from: each approximation on the way to it, one by one.

Truth is radiance under the held-out lights from a bake of twice the rays along a texel's edge,
light by the texels of a cube map at the resolution of the rays, and glossy materials in many
factors. From there on, one more approximation each: fewer rays (bake noise), BRDF factors, the
light basis, clusters with as little rank as there is, rank, codes, and light cut to its largest
half of coefficients. Stages that a scene or a kind does not have are left out.

Alone, an approximation changes the truth by what it changes by itself: clusters and rank (of all
points together) the tensor of the sweep, codes the representation without them, the others the
truth as it is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from pydantic import BaseModel
from torch import Tensor

from prt_torch import evaluate
from prt_torch.baking import bake
from prt_torch.bases import CubeDirections
from prt_torch.construction import (
    NO_CODES,
    Parameters,
    Problem,
    before_codes,
    closed_form,
    in_codes,
)
from prt_torch.inputs import Inputs
from prt_torch.preview import Camera
from prt_torch.relight import Relighter
from prt_torch.representations import Representation
from prt_torch.settings import KINDS, RunConfig
from prt_torch.sweep.measure import VIEWS
from prt_torch.tradeoff import Stage, waterfall
from prt_torch.transfer import TransferTensor, project
from prt_torch.truncation import truncate

_TRUE_ROWS = 24  # BRDF factors of the truth
_FINER = 2  # times the rays along an edge of a texel

_LEAST: dict[str, Parameters] = {
    "cpca": {"rank": 1},
    "segmented_cpca": {"rank": 1},
    "clustered_tensor": {"ranks": [1, 1, 1]},
}
"""What leaves clusters and next to nothing else, of kinds that have them."""

_ONE_CLUSTER: dict[str, Parameters] = {
    "cpca": {"num_clusters": 1},
    "segmented_cpca": {"points_per_cluster": 2**31},
    "clustered_tensor": {"num_clusters": 1},
}


@torch.no_grad()
def error_stages(
    config: RunConfig, inputs: Inputs, problem: Problem, kind: str, parameters: Parameters
) -> list[Stage]:
    """The waterfall of one result of a sweep.

    Args:
        config: Of the sweep's bake.
        inputs: Its scene and lights.
        problem: Its transfer.
        kind: Of the result.
        parameters: Of the result.

    Raises:
        InputError: If the cache cannot be written.
        ValueError: If the parameters do not suit the kind.
    """
    scene = _Scene(config, inputs)
    glossy = problem.transfer.surface.exit_basis.view_dependent
    factored = glossy and config.transfer.exit_basis == "factors"
    fine, rows = config.transfer.supersampling * _FINER, _TRUE_ROWS if glossy else None
    truth = scene.bake(fine, rows)
    noisy = scene.bake(config.transfer.supersampling, rows)
    together = {"bake noise": scene.dense(noisy)}
    alone = {"bake noise": together["bake noise"]}
    if factored:
        few = problem.transfer.num_rows
        together["BRDF factors"] = scene.dense(scene.bake(config.transfer.supersampling, few))
        alone["BRDF factors"] = scene.dense(scene.bake(fine, few))
    basis = "light basis" if factored or not glossy else "light and exit basis"
    together[basis] = scene.dense(problem.transfer)
    alone[basis] = scene.dense(project(truth, inputs.light_basis))
    models = _models(problem, kind, parameters)
    together |= {name: scene.lit(model) for name, model in models.items()}
    last = list(models.values())[-1]
    together["half of the light"] = scene.lit(last, cut=True)
    alone["half of the light"] = scene.dense(truth, cut=True)
    exact = scene.dense(truth)
    alone |= _alone(scene, exact, problem, kind, parameters, together)
    return waterfall(exact, together, alone)


def _models(problem: Problem, kind: str, parameters: Parameters) -> dict[str, Representation]:
    """Clusters, rank and codes, as far as the kind has them."""
    uncoded, found = {**parameters, **NO_CODES.get(kind, {})}, {}
    if kind in _LEAST:
        found["clusters"] = closed_form(problem, kind, {**uncoded, **_LEAST[kind]})
    name = "rank" if kind in _LEAST else kind
    found[name] = closed_form(problem, kind, uncoded)
    if before_codes(kind, parameters) != parameters:
        found["codes"] = in_codes(problem, found[name], parameters)
    elif _named(kind, uncoded) != _named(kind, parameters):
        found["codes"] = closed_form(problem, kind, parameters)
    return found


def _named(kind: str, parameters: Parameters) -> BaseModel:
    """All parameters, those that were not given too."""
    return KINDS[kind].model_validate({"name": kind, **parameters})


def _alone(
    scene: "_Scene",
    truth: Tensor,
    problem: Problem,
    kind: str,
    parameters: Parameters,
    together: dict[str, Tensor],
) -> dict[str, Tensor]:
    """The truth as clusters, rank and codes would change it with nothing else."""
    uncoded, found = {**parameters, **NO_CODES.get(kind, {})}, {}
    uncompressed, name = scene.dense(problem.transfer), "rank" if kind in _LEAST else kind
    if kind in _LEAST:
        found["clusters"] = truth + together["clusters"] - uncompressed
    else:
        found[name] = truth + together[name] - uncompressed
    if kind in _ONE_CLUSTER:
        model = closed_form(problem, kind, {**uncoded, **_ONE_CLUSTER[kind]})
        found["rank"] = truth + scene.lit(model) - uncompressed
    if "codes" in together:
        found["codes"] = truth + together["codes"] - together[name]
    return found


@dataclass(frozen=True)
class _Scene:
    """A scene with its lights and views, baked in several ways and lit alike."""

    config: RunConfig
    inputs: Inputs

    def bake(self, supersampling: int, rows: int | None) -> TransferTensor:
        """Transfer by texels; of glossy materials in so many factors."""
        wanted, given = self.config.transfer, self.inputs
        return bake(
            given.mesh,
            materials=given.materials,
            light_basis=CubeDirections(wanted.resolution),
            exit_basis=None if rows is None else "factors",
            num_rows=rows,
            max_bounces=wanted.max_bounces,
            tolerance=wanted.tolerance,
            resolution=wanted.resolution,
            supersampling=supersampling,
            cache=self.config.cache,
            memory_budget=self.config.memory_budget,
        )

    def dense(self, transfer: TransferTensor, *, cut: bool = False) -> Float[Tensor, "..."]:
        """Radiance of a tensor itself under all lights."""
        return self._under_all(
            transfer,
            lambda light, views: evaluate.dense_radiance(transfer, light, views),
            cut,
        )

    def lit(self, model: Representation, *, cut: bool = False) -> Float[Tensor, "..."]:
        """Radiance of a representation under all lights."""
        return self._under_all(model, Relighter(model).eval(), cut)

    def _under_all(
        self,
        of: TransferTensor | Representation,
        relight: Callable[[Tensor, Tensor | None], Tensor],
        cut: bool,
    ) -> Float[Tensor, "lights views points rgb"]:
        """Where no viewer is, radiance counts as black."""
        basis, surface = of.surface.light_basis, of.surface
        if basis is None:
            raise ValueError("expected transfer with a light basis, got none")
        views, seen = None, torch.ones(1, 1, 1)
        if surface.exit_basis.view_dependent:
            views = Camera.framing(self.inputs.mesh).around(VIEWS)
            seen = evaluate.seen_from(surface, views)[..., None]
        found = []
        for environment in self.inputs.test_lights:
            light = basis.project(environment).float()[None]
            if cut:
                light, _ = truncate(light, basis, basis.num_coeffs // 2)
            found.append(relight(light, views)[0] * seen)
        return torch.stack(found)


def explained(results: Sequence[dict[str, Any]], unbeaten: Sequence[str]) -> dict[str, Any]:
    """The result whose error is taken apart: the middle one of those that nothing beats."""
    name = unbeaten[len(unbeaten) // 2]
    return next(one for one in results if one["name"] == name)
