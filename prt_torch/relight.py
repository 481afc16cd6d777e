"""Relighting: light in, radiance out, for any representation of transfer.

Batching over lights lives here once. Everything is differentiable: in the light, the views, the
frames and the parameters of the representation.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from prt_torch.bases import Radiance
from prt_torch.representations import Representation

_ROWS_BYTES = 2**24  # of exit rows between two steps: more leave the cache and need fresh memory


class Relighter(nn.Module):
    """Radiance of every point under distant light.

    Args:
        representation: Any compressed or dense transfer.
        max_bytes: Largest radiance tensor made in one pass; more lights are taken in turns.
    """

    def __init__(self, representation: Representation, *, max_bytes: int = 2**30):
        super().__init__()
        self.representation = representation
        self._max_bytes = max_bytes

    def project(self, lights: Radiance | Sequence[Radiance]) -> Float[Tensor, "batch coeffs rgb"]:
        """Light coefficients of one or several environments.

        Raises:
            ValueError: If the transfer was given without a light basis.
        """
        basis = self.representation.surface.light_basis
        if basis is None:
            raise ValueError("this transfer has no light basis; give light coefficients instead")
        several = lights if isinstance(lights, Sequence) else [lights]
        like = next(self.representation.parameters())
        return torch.stack([basis.project(light).to(like) for light in several])

    def forward(
        self,
        light: Tensor | Radiance | Sequence[Radiance],
        views: Float[Tensor, "views *points 3"] | None = None,
        frames: Float[Tensor, "*batch points 3 3"] | None = None,
        positions: Float[Tensor, "*batch points 3"] | None = None,
    ) -> Float[Tensor, "batch views points rgb"]:
        """Outgoing radiance.

        Args:
            light: An environment, several, or light coefficients ``"batch coeffs rgb"`` (or
                ``"batch points coeffs rgb"`` where each point has its own light).
            views: Where each viewer is, ``"views 3"`` in mesh units, or unit directions towards
                it ``"views points 3"``. Diffuse transfer skips them: its views dimension has size
                1, whatever is given here.
            frames: Shading frames of a deformed surface: one pose for all lights, or a sequence
                ``"batch points 3 3"``, a pose for each light. A single light serves all poses.
            positions: Where the points of the deformed surface are, of one pose or of each, for
                viewers in mesh units; where they were at rest if not given.

        Returns:
            Linear RGB radiance, reflectance included.

        Raises:
            ValueError: If shapes do not fit, or views are needed and not given.
        """
        if not isinstance(light, Tensor):
            light = self.project(light)
        if frames is not None and frames.ndim == 4:
            sequence = _sequence(light, frames, positions)
            return torch.cat([self(lit, views, pose, where) for lit, pose, where in sequence])
        rows = self._view_rows(views, frames, positions)
        radiance_bytes = 3 * self.representation.num_points * self.representation.num_rows
        most = self._max_bytes if rows is None else min(self._max_bytes, _ROWS_BYTES)
        at_once = max(1, most // (radiance_bytes * light.dtype.itemsize))
        if len(light) <= at_once:
            return self._shade(self.transferred(light, frames), rows, own=True)
        turns = light.split(at_once)
        lit = (self.transferred(some, frames) for some in turns)
        return torch.cat([self._shade(some, rows, own=True) for some in lit])

    def transferred(
        self, light: Tensor, frames: Float[Tensor, "points 3 3"] | None = None
    ) -> Float[Tensor, "batch points rows rgb"]:
        """What light becomes before anyone looks at it; it stays as it is when only views change.

        Args:
            light: Light coefficients, as in :meth:`forward`.
            frames: Shading frames of a deformed surface.
        """
        reflectance = self.representation.reflectance
        if len(reflectance) == 1:  # as well times the few coefficients of the light as every point
            light = light * reflectance
        return self.representation(light, frames)

    def shade(
        self,
        transferred: Float[Tensor, "batch points rows rgb"],
        views: Float[Tensor, "views *points 3"] | None = None,
        frames: Float[Tensor, "points 3 3"] | None = None,
        positions: Float[Tensor, "points 3"] | None = None,
    ) -> Float[Tensor, "batch views points rgb"]:
        """Radiance of what :meth:`transferred` gave: a change of view costs only this.

        Args:
            transferred: Of a batch of lights.
            views: As in :meth:`forward`.
            frames: Shading frames of a deformed surface.
            positions: Where its points are.

        Raises:
            ValueError: If views are needed and not given.
        """
        rows = self._view_rows(views, frames, positions)
        return self._shade(transferred, rows, own=rows is not None)

    def _shade(self, radiance: Tensor, rows: Tensor | None, *, own: bool) -> Tensor:
        """Radiance towards views; ``own`` if it may be written to."""
        reflectance = self.representation.reflectance
        radiance = radiance[:, None, :, 0] if rows is None else _towards(radiance, rows)
        if len(reflectance) == 1:
            return radiance
        tracked = torch.is_grad_enabled() and (radiance.requires_grad or reflectance.requires_grad)
        return radiance.mul_(reflectance) if own and not tracked else radiance * reflectance

    def _view_rows(
        self, views: Tensor | None, frames: Tensor | None, positions: Tensor | None
    ) -> Float[Tensor, "views points rows"] | Float[Tensor, "views points rows rgb"] | None:
        """The exit basis at each view; None where radiance does not depend on it."""
        surface = self.representation.surface
        if not surface.exit_basis.view_dependent:
            return None
        if views is None:
            raise ValueError("this transfer depends on the view; give views")
        frames = surface.frames if frames is None else frames
        if frames is None:
            raise ValueError("this transfer has no shading frames to take views into")
        if views.ndim == 2:
            positions = surface.positions if positions is None else positions
            if positions is None:
                raise ValueError('this transfer has no positions; give views "views points 3"')
            views = views[:, None] - positions.to(views)
            views = torch.nn.functional.normalize(views, dim=-1)
        local = torch.einsum("pij,vpj->vpi", frames.to(views), views)
        return surface.exit_basis.evaluate(local)


def _sequence(
    light: Tensor, frames: Tensor, positions: Tensor | None
) -> list[tuple[Tensor, Tensor, Tensor | None]]:
    """The light, the frames and the positions of each pose; what there is one of serves all."""
    count = max(len(light), len(frames))
    if {len(light), len(frames)} - {1, count}:
        raise ValueError(
            f"expected as many poses as lights, or one, got {len(frames)} and {len(light)}"
        )
    lights = light.expand(count, *light.shape[1:]).split(1)
    poses = frames.expand(count, *frames.shape[1:])
    if positions is None or positions.ndim == 2:
        return [(lit, pose, positions) for lit, pose in zip(lights, poses, strict=True)]
    where = positions.expand(count, *positions.shape[1:])
    return list(zip(lights, poses, where, strict=True))


def _towards(
    radiance: Float[Tensor, "batch points rows rgb"],
    rows: Float[Tensor, "views points rows"] | Float[Tensor, "views points rows rgb"],
) -> Float[Tensor, "batch views points rgb"]:
    """Rows of radiance times what each view sees of them."""
    rows = rows.to(radiance)  # views may have another type than light
    if rows.ndim == 3:
        by_point = radiance.permute(1, 2, 3, 0).flatten(2)  # points, rows, rgb * batch
        seen = torch.bmm(rows.transpose(0, 1), by_point)  # points, views, rgb * batch
        return seen.unflatten(2, (3, -1)).permute(3, 1, 0, 2)
    by_point = radiance.permute(1, 3, 2, 0).flatten(0, 1)  # points * rgb, rows, batch
    seen = torch.bmm(rows.permute(1, 3, 0, 2).flatten(0, 1), by_point)
    return seen.unflatten(0, (-1, 3)).permute(3, 2, 0, 1)
