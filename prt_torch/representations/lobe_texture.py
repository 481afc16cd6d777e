r"""Textures of lobes: transfer of a small patch, mapped onto any surface however it deforms.

A patch of bumps, weave or wrinkles is baked once. Its transfer has a few lobes a texel, in the
tangent frame: tangent along u, bitangent along v, normal. At a place of a surface the texture's
lobes are looked up by its texture coordinates and turned by its tangent frame, whatever pose it is
in, so shadows, bounces and scattering inside the patch follow the surface. What the surface does
to itself at a distance is not in it.

Lobes of neighbouring texels need not correspond, so they are point-sampled; constant and linear
terms, which are most of the energy, are kept beside them from three lobes on and are interpolated.
Where lobes do correspond (:mod:`prt_torch.representations.wrinkle`), all of it is.

The rows of glossy transfer are functions of the view in the *micro frames* of the patch, one a
texel, which the texture keeps in its tangent frame and interpolates as well.

Source:
    Sloan, Luna, Snyder 2005, sections 3.2, 5 and 6.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from prt_torch import store
from prt_torch.assets.patches import PATCH_FRAME
from prt_torch.assets.tangents import orthonormal_frames
from prt_torch.bases import SphericalHarmonics, exit_basis, light_basis, sh, zonal
from prt_torch.errors import InputError
from prt_torch.representations.palette import packed_reflectance, take_reflectance
from prt_torch.representations.texture_map import TexelGrid
from prt_torch.representations.zonal_lobes import ZonalLobes
from prt_torch.representations.zonal_lobes_coding import Lobes
from prt_torch.representations.zonal_lobes_shading import radiance, turned
from prt_torch.transfer import Surface, TransferTensor

_KIND = "lobe_texture"


class LobeTexture(nn.Module):
    """A map of lobes in the tangent frame.

    Its parameters are those of ``texels``, so it is refined as they are, by
    :func:`prt_torch.fit` against the patch's transfer in the tangent frame, or through pictures.

    Args:
        texels: Lobes of the texels in row order, in tangent coordinates: x along u, y along v, z
            along the normal. Its surface has micro frames in these coordinates where radiance
            depends on the view.
        grid: How texels lie.
        interpolate: Whether lobes of neighbouring texels correspond, and are interpolated as
            constant and linear terms are.

    Raises:
        ValueError: If there are not as many points as texels, or micro frames are missing.
    """

    texels: ZonalLobes

    def __init__(self, texels: ZonalLobes, grid: TexelGrid, *, interpolate: bool = False):
        super().__init__()
        if texels.num_points != grid.num_texels:
            raise ValueError(f"expected {grid.num_texels} texels, got {texels.num_points}")
        micro = texels.surface.frames
        if texels.surface.exit_basis.view_dependent and micro is None:
            raise ValueError("expected micro frames of texels whose radiance depends on the view")
        self.texels, self.grid, self.interpolate = texels, grid, interpolate

    @classmethod
    def from_transfer(
        cls,
        transfer: TransferTensor,
        shape: tuple[int, int],
        *,
        periodic: tuple[bool, bool] = (True, True),
        frame: Float[Tensor, "3 3"] = PATCH_FRAME,
        **options: Any,
    ) -> "LobeTexture":
        """Fit the transfer of a patch, as :func:`prt_torch.baking.bake_patch` gives it.

        Args:
            transfer: Of the texels in row order, in the world of the patch.
            shape: Rows and columns.
            periodic: Whether the texture repeats along v, and along u.
            frame: Tangent, bitangent and normal of the patch.
            options: Those of :meth:`ZonalLobes.from_transfer`: ``num_lobes``, ``effort`` and
                others.

        Raises:
            ValueError: If the shape does not fit, or an option is out of range.
        """
        local = in_frame(transfer, frame)
        return cls(ZonalLobes.from_transfer(local, **options), TexelGrid(*shape, periodic))

    def lobes(self, uv: Float[Tensor, "points 2"]) -> Lobes:
        """Lobes at some places, in tangent coordinates."""
        every = Lobes(self.texels.axes, self.texels.coefficients, self.texels.linear)
        if self.interpolate:
            units = zonal.unit_axes(every.axes)
            mixed = (units, every.coefficients, every.linear)
            return Lobes(*(self.grid.sample(values, uv) for values in mixed))
        own = every[self.grid.nearest(uv)]
        return replace(own, linear=self.grid.sample(every.linear, uv))

    def reflectance(self, uv: Float[Tensor, "points 2"]) -> Float[Tensor, "points_or_one rgb"]:
        """What multiplies radiance at some places, interpolated."""
        every = self.texels.reflectance
        return every if len(every) == 1 else self.grid.sample(every, uv)

    def shading_frames(
        self, uv: Float[Tensor, "points 2"], frames: Float[Tensor, "*batch points 3 3"]
    ) -> Float[Tensor, "*batch points 3 3"]:
        """Frames that the rows of the texture are meant in, of a surface with tangent frames.

        Tangent frames themselves where radiance does not depend on the view.
        """
        micro = self.texels.surface.frames
        if micro is None or not self.texels.surface.exit_basis.view_dependent:
            return frames
        mixed = self.grid.sample(micro.to(frames), uv)
        local = orthonormal_frames(
            mixed[:, 0], mixed[:, 2], mirrored=mixed.new_zeros(len(mixed), dtype=torch.bool)
        )
        return local @ frames

    def forward(
        self,
        light: Float[Tensor, "batch *points coeffs rgb"],
        uv: Float[Tensor, "points 2"],
        frames: Float[Tensor, "points 3 3"],
    ) -> Float[Tensor, "batch points rows rgb"]:
        """Radiance in the exit basis, before reflectance, as of any representation.

        Differentiable in the light, the frames and the parameters; in ``uv`` as far as the lookup
        is bilinear.

        Args:
            light: In world coordinates, one for all points or one for each.
            uv: Texture coordinates.
            frames: Tangent frames of the places (:func:`prt_torch.tangent_frames`).

        Raises:
            ValueError: If shapes do not fit.
        """
        self._check(uv, frames)
        placed = turned(self.lobes(uv.to(light)), frames.mT.to(light))
        return radiance(placed, light, self.texels.num_channels)

    @torch.no_grad()
    def on(
        self,
        uv: Float[Tensor, "points 2"],
        frames: Float[Tensor, "points 3 3"],
        positions: Float[Tensor, "points 3"] | None = None,
    ) -> ZonalLobes:
        """The texture on points of a surface, as lobes of their own.

        They are relit, posed and tabulated as any others; the frames of another pose are
        ``texture.shading_frames(uv, frames)`` of its tangent frames. They are copies: gradients to
        the texture go through :meth:`forward`.

        Args:
            uv: Texture coordinates of the points.
            frames: Their tangent frames at rest.
            positions: Where they are, for views that are given as places.

        Raises:
            ValueError: If shapes do not fit.
        """
        self._check(uv, frames)
        like = self.texels.linear
        uv, frames = uv.to(like), frames.to(like)
        surface = replace(
            self.texels.surface,
            frames=self.shading_frames(uv, frames),
            positions=positions,
            reflectance=self.reflectance(uv),
            materials=None,
        )
        shape = (len(uv), *self.texels.shape[1:])
        return ZonalLobes(turned(self.lobes(uv), frames.mT), None, surface, shape)

    def storage(self) -> dict[str, int]:
        """Bytes of each part of a file of it."""
        frames = self.texels.surface.frames
        return {**self.texels.storage(), **({} if frames is None else {"frames": frames.nbytes})}

    def save(self, path: Path | str) -> None:
        """Write one safetensors file, with a hash of its content in the header.

        Raises:
            InputError: If the folder cannot be written.
        """
        surface = self.texels.surface
        tensors = {**self.texels.packed(), **packed_reflectance(surface.reflectance)}
        tensors |= {_EXIT + name: own for name, own in surface.exit_basis.tensors().items()}
        if surface.frames is not None:
            tensors["frames"] = surface.frames
        basis = surface.light_basis or SphericalHarmonics(self.texels.order)
        header = {
            "kind": _KIND,
            "shape": list(self.texels.shape),
            "grid": [self.grid.rows, self.grid.cols, *self.grid.periodic],
            "interpolate": self.interpolate,
            "light_basis": basis.describe(),
            "exit_basis": surface.exit_basis.describe(),
            "content": store.digest(*(tensors[name] for name in sorted(tensors))),
        }
        store.write_tensors(Path(path), tensors, header)

    @classmethod
    def load(cls, path: Path | str) -> "LobeTexture":
        """Read what :meth:`save` wrote, exact to the bit.

        Raises:
            InputError: If the file is missing, damaged, or no texture of lobes.
        """
        tensors, header = store.read_tensors(Path(path))
        kind = header.get("kind") if isinstance(header, dict) else None
        if kind != _KIND:
            raise InputError(f"{path}: expected a {_KIND}, got {kind!r}")
        if store.digest(*(tensors[name] for name in sorted(tensors))) != header["content"]:
            raise InputError(f"{path}: its hash differs from the one recorded; it is damaged")
        own = {name: tensors.pop(name) for name in list(tensors) if name.startswith(_EXIT)}
        of_exit = {name.removeprefix(_EXIT): values for name, values in own.items()}
        points, channels, rows, coeffs = header["shape"]
        surface = Surface(
            exit_basis=exit_basis(header["exit_basis"], of_exit),
            light_basis=light_basis(header["light_basis"]),
            reflectance=take_reflectance(tensors, points),
            frames=tensors.pop("frames", None),
        )
        texels = ZonalLobes.from_packed(tensors, surface, (points, channels, rows, coeffs))
        high, wide, along_v, along_u = header["grid"]
        grid = TexelGrid(high, wide, (along_v, along_u))
        return cls(texels, grid, interpolate=header["interpolate"])

    def _check(self, uv: Tensor, frames: Tensor) -> None:
        if uv.ndim != 2 or uv.shape[1] != 2 or frames.shape != (len(uv), 3, 3):
            raise ValueError(
                f'expected uv "points 2" and frames "points 3 3", got {tuple(uv.shape)} and '
                f"{tuple(frames.shape)}"
            )


_EXIT = "exit."  # before the names of the tensors of the exit basis


def in_frame(transfer: TransferTensor, frame: Float[Tensor, "3 3"]) -> TransferTensor:
    """Transfer in the coordinates of a frame, micro frames included.

    Micro frames go where radiance does not depend on the view, and positions always.

    Args:
        transfer: In world coordinates, in spherical harmonics.
        frame: Rows tangent, bitangent and normal.
    """
    values, surface = transfer.dense(), transfer.surface
    turn = sh.rotation_matrix(frame.double(), sh.order_of(values)).to(values)
    frames = surface.frames
    if frames is not None:
        seen = surface.exit_basis.view_dependent
        frames = (frames @ frame.mT.to(frames)) if seen else None
    return replace(
        transfer,
        values=values @ turn.mT,
        surface=replace(surface, frames=frames, positions=None),
    )
