r"""Interreflection: bounces of radiance transfer between the points of a scene.

Transfer of one bounce becomes the light of the next. A point gathers, from its hidden directions
s, the exit radiance of what is there, and reflects it:

.. math:: J_p = \int_{\text{hidden}} y(s)\, L_{x(p,s)}(-s)\, ds, \qquad
          e_p \leftarrow \rho_p\, M_p\, D(R_p)\, J_p

Everything is a row of coefficients of distant light, so all of them bounce at once; an emitter is
one coefficient. Exit radiance is a function in the shading frame of whatever exit basis the
reflection has, and the constant of a diffuse point is its simplest case: there is one code path.

Source:
    Sloan, Kautz, Snyder 2002, section 5.2 (interreflected transfer by bounces), with glossy
    points as in Sloan, Hall, Hart, Snyder 2003.
"""

import functools
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor
from torch.nn.functional import embedding_bag

from prt_torch import store
from prt_torch.assets.mesh import Mesh
from prt_torch.baking.hits import HitFinder, Hits
from prt_torch.baking.reflection import Reflection
from prt_torch.baking.visibility import Progress, VisibilityField
from prt_torch.bases import BRDFFactors, Diffuse, ExitBasis, HemisphericalHarmonics, sh
from prt_torch.sphere import cubemap_directions, frame_from_normal
from prt_torch.transfer import colour_channels

_ALGORITHM = 1  # raise it when the same inputs would give other values
_POINTS_PER_SHARD = 4096
_RADIANCE_ELEMENTS = 2**26  # of a block's incident radiance, if a closed scene hides everything
_ROTATIONS_AT_ONCE = 1024


@dataclass(frozen=True)
class Bounces:
    """What bounces add to transfer.

    Attributes:
        gathered: ``"points channels rows coeffs"`` float32: the sum over all bounces, before
            reflectance, as transfer has it.
        added: Norm of each bounce over the norm of all exit radiance up to and including it.
        rays: How many rays were traced for it.
        missed: How many of them hit nothing, though their visibility bit says that they must.
        seconds: How long it took.
        cached: Whether all of it was read from a cache instead.
        skipped: Whether nothing in the scene hides anything, so that there was nothing to do.
    """

    gathered: Float32[Tensor, "points channels rows coeffs"]
    added: list[float]
    rays: int
    missed: int
    seconds: float
    cached: bool
    skipped: bool


def interreflect(
    mesh: Mesh,
    visibility: VisibilityField,
    reflection: Reflection,
    exit_radiance: Float[Tensor, "points channels rows coeffs"],
    reflectance: Float[Tensor, "points_or_one rgb"],
    *,
    max_bounces: int,
    tolerance: float = 1e-3,
    resolution: int = 32,
    inputs: Mapping[str, Any] | None = None,
    cache: Path | None = None,
    progress: Progress | None = None,
) -> Bounces:
    """Let exit radiance bounce until it adds nothing that counts.

    Args:
        mesh: The scene.
        visibility: Its visibility bits.
        reflection: How points reflect; its exit basis is that of ``exit_radiance``.
        exit_radiance: What leaves the points before any bounce, in the shading frame, reflectance
            included: emission, or direct transfer of any number of light coefficients.
        reflectance: What each channel of reflected light is multiplied with. Colour makes three
            channels of one; grey does not.
        max_bounces: Most bounces.
        tolerance: A bounce whose share of all exit radiance is smaller is the last.
        resolution: Rays along an edge of a cube face, over all hidden directions of a point.
        inputs: What ``exit_radiance`` follows from, in plain JSON, to name it in the cache; its
            content if not given.
        cache: Folder of bakes, one bounce a folder; a killed bake resumes within a bounce. None
            keeps the values in memory.
        progress: Told of points done and points in all, for each bounce anew.

    Raises:
        ValueError: If points, rows or the number of bounces do not fit.
        InputError: If the cache cannot be written or is damaged.
    """
    _check(mesh, visibility, reflection, exit_radiance, reflectance, max_bounces)
    scale, channels = _per_channel(reflectance)
    channels = max(channels, reflection.num_channels, exit_radiance.shape[1])
    exit_radiance = exit_radiance.detach().float().expand(-1, channels, -1, -1)
    transport = _Transport(mesh, visibility, reflection, resolution, exit_radiance[0, :, 0].numel())
    gathered = torch.zeros_like(exit_radiance, memory_format=torch.contiguous_format)
    if max_bounces > 0 and transport.finder.nothing_hidden():
        return Bounces(gathered, [], 0, 0, 0.0, cached=False, skipped=True)
    described = {
        "exit_radiance": store.digest(exit_radiance) if inputs is None else dict(inputs),
        "visibility": store.digest(mesh.vertices, mesh.faces, mesh.normals, visibility.resolution),
        "reflection": reflection.digest(),
        "reflectance": store.digest(reflectance),
        "resolution": resolution,
        "algorithm": _ALGORITHM,
    }
    total, added, bounces = exit_radiance.clone(), [], []
    while len(bounces) < max_bounces and (not added or added[-1] >= tolerance):
        naming = {**described, "bounce": len(bounces)}
        built = _bounce(transport, exit_radiance, naming, cache, progress)
        bounces.append(built)
        incoming = built.tensors["gathered"][0 : mesh.num_points]
        gathered += incoming
        exit_radiance = incoming * scale
        total += exit_radiance
        all_of_it = _norm(total, reflection.exit_basis)
        added.append(_norm(exit_radiance, reflection.exit_basis) / all_of_it if all_of_it else 0.0)
    return Bounces(
        gathered,
        added,
        rays=sum(int(built.counts["rays"]) for built in bounces),
        missed=sum(int(built.counts["missed"]) for built in bounces),
        seconds=math.fsum(built.counts["seconds"] for built in bounces),
        cached=bool(bounces) and all(built.cached for built in bounces),
        skipped=False,
    )


def _check(
    mesh: Mesh,
    visibility: VisibilityField,
    reflection: Reflection,
    exit_radiance: Tensor,
    reflectance: Tensor,
    max_bounces: int,
) -> None:
    expected = {
        "visibility": visibility.bits.shape[0],
        "reflection": len(reflection.materials),
        "exit radiance": exit_radiance.shape[0],
    }
    for what, points in expected.items():
        if points != mesh.num_points:
            raise ValueError(f"expected {what} of {mesh.num_points} points, got {points}")
    if len(reflectance) not in (1, mesh.num_points):
        raise ValueError(
            f"expected reflectance of 1 or {mesh.num_points} points, got {len(reflectance)}"
        )
    rows = reflection.exit_basis.num_rows
    if exit_radiance.shape[2] != rows:
        raise ValueError(f"expected exit radiance of {rows} rows, got {exit_radiance.shape[2]}")
    if max_bounces < 0:
        raise ValueError(f"expected at least 0 bounces, got {max_bounces}")


def _per_channel(
    reflectance: Float[Tensor, "points_or_one rgb"],
) -> tuple[Float32[Tensor, "points_or_one channels 1 1"], int]:
    """Reflectance of each channel, and whether these are one or three."""
    channels = colour_channels(reflectance)
    return channels.detach().float()[:, :, None, None], channels.shape[1]


def _norm(
    exit_radiance: Float[Tensor, "points channels rows coeffs"], exit_basis: ExitBasis
) -> float:
    """Root of the sum of squares, averaged over views."""
    gram = exit_basis.gram().to(exit_radiance)
    squares = [
        float(((gram @ some) * some).sum(dtype=torch.float64))
        for some in exit_radiance.split(_POINTS_PER_SHARD)
    ]
    # Rounding can take the square of nearly nothing below zero where rows nearly cancel.
    return math.sqrt(max(math.fsum(squares), 0.0))


def _bounce(
    transport: "_Transport",
    exit_radiance: Float32[Tensor, "points channels rows coeffs"],
    inputs: Mapping[str, Any],
    cache: Path | None,
    progress: Progress | None,
) -> store.Sharded:
    """One bounce, before reflectance, block by block."""

    @functools.cache  # made only when there is something to gather
    def senders() -> Tensor:
        return transport.senders(exit_radiance)

    def gather(rows: slice) -> tuple[dict[str, Tensor], dict[str, int | float]]:
        start = time.perf_counter()
        table = senders()
        made, rays, missed = [], 0, 0
        for block in transport.finder.blocks(rows):
            hits = transport.finder.find(block)
            made.append(transport.receive(block, hits, table, exit_radiance.shape[1]))
            rays, missed = rays + hits.rays, missed + hits.missed
        counts = {"rays": rays, "missed": missed, "seconds": time.perf_counter() - start}
        return {"gathered": torch.cat(made)}, counts

    return store.build_sharded(
        gather,
        rows=exit_radiance.shape[0],
        rows_per_shard=_POINTS_PER_SHARD,
        inputs=inputs,
        folder=None if cache is None else Path(cache) / f"bounce-{store.digest(inputs)[:16]}",
        progress=progress,
    )


class _Transport:
    """Takes exit radiance of all points to what each of them reflects of it.

    Exit radiance is turned into world harmonics once a bounce, since the directions that it is
    wanted in are the same few for all points.
    """

    def __init__(
        self,
        mesh: Mesh,
        visibility: VisibilityField,
        reflection: Reflection,
        resolution: int,
        num_columns: int,
    ):
        self._faces, self._reflection = mesh.faces, reflection
        self._frames = frame_from_normal(mesh.normals)
        texels = 6 * resolution * resolution
        self.finder = HitFinder(
            mesh,
            visibility,
            resolution=resolution,
            order=reflection.order,
            points_at_once=_RADIANCE_ELEMENTS // (texels // 2 * num_columns),
        )
        self._embedding, self._exit_order = _in_harmonics(reflection.exit_basis)
        directions = cubemap_directions(visibility.resolution, dtype=torch.float64).reshape(-1, 3)
        # Radiance that arrives along s left along -s.
        self._exit_functions = sh.evaluate(-directions, self._exit_order).float()

    def senders(
        self, exit_radiance: Float32[Tensor, "points channels rows coeffs"]
    ) -> Float32[Tensor, "points_by_harmonics columns"]:
        """Exit radiance in world harmonics, one row a point and harmonic."""
        turned = []
        for some, frames in zip(
            exit_radiance.split(_ROTATIONS_AT_ONCE),
            self._frames.split(_ROTATIONS_AT_ONCE),
            strict=True,
        ):
            # The world function is f(R s), hence the transpose of the matrix that makes f(R⁻¹ s).
            to_world = sh.rotation_matrix(frames, self._exit_order).mT @ self._embedding
            world = to_world.float()[:, None] @ some
            turned.append(world.transpose(1, 2).flatten(2).flatten(0, 1))
        return torch.cat(turned)

    def receive(
        self,
        block: slice,
        hits: Hits,
        senders: Float32[Tensor, "points_by_harmonics columns"],
        channels: int,
    ) -> Float32[Tensor, "points channels rows coeffs"]:
        """What a block of points reflects of what its hidden directions send."""
        radiance = self._incident_radiance(hits, senders)
        incident = senders.new_zeros(len(hits.counts), hits.moments.shape[1], senders.shape[1])
        first = 0
        for point, count in enumerate(hits.counts.tolist()):
            own = slice(first, first + count)
            torch.mm(hits.moments[own].mT, radiance[own], out=incident[point])
            first += count
        to_local = sh.rotation_matrix(self._frames[block], self._reflection.order)
        local = (to_local @ incident.double()).unflatten(2, (channels, -1)).transpose(1, 2)
        return self._reflection.reflect(block, local).float()

    def _incident_radiance(
        self, hits: Hits, senders: Float32[Tensor, "points_by_harmonics columns"]
    ) -> Float32[Tensor, "hits columns"]:
        """Radiance along each hit's ray, interpolated over the corners of its face."""
        harmonics = self._exit_functions.shape[1]
        corners = self._faces[hits.faces.long()]
        indices = corners[:, :, None] * harmonics + torch.arange(harmonics)
        factors = hits.weights[:, :, None] * self._exit_functions[hits.texels.long()][:, None]
        return embedding_bag(
            indices.flatten(1), senders, mode="sum", per_sample_weights=factors.flatten(1)
        )


def _in_harmonics(exit_basis: ExitBasis) -> tuple[Float64[Tensor, "harmonics rows"], int]:
    """The rows of an exit basis as combinations of spherical harmonics, and the order of these."""
    match exit_basis:
        case Diffuse():
            return torch.full((1, 1), math.sqrt(4.0 * math.pi), dtype=torch.float64), 1
        case HemisphericalHarmonics():
            order = exit_basis.order
            embedding = torch.zeros(order * order, exit_basis.num_rows, dtype=torch.float64)
            embedding[exit_basis.indices, torch.arange(exit_basis.num_rows)] = 1.0
            return embedding, order
        case BRDFFactors(light_order=int(order), num_channels=1):
            # Maps of views are fitted with as many bands as their material has towards light.
            views, weights = sh.hemisphere_quadrature(4 * exit_basis.hemisphere.resolution)
            fit = sh.hemisphere_projection(sh.evaluate(views, order), weights)
            return fit @ exit_basis.evaluate(views).detach().double().cpu(), order
        case _:
            raise ValueError(
                "expected an exit basis that is diffuse, hemispherical, or of grey factors whose "
                f"light side is in harmonics, got {exit_basis}"
            )
