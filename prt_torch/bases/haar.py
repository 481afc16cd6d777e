r"""Haar wavelets over square segments of a cube map: a basis that follows bright, small lights.

The transform is normalised and non-standard: each level takes every 2 x 2 block of means a, b, c, d
(row by row) to

.. math:: \tfrac12 (a+b+c+d), \quad \tfrac12 (a-b+c-d), \quad
          \tfrac12 (a+b-c-d), \quad \tfrac12 (a-b-c+d)

and goes on with the first of them, so it is orthonormal, and its factors are exact in binary: a
constant image has details that are exactly zero. Smooth coefficients lie at the top left, those of
detail along a row at the top right, along a column at the bottom left, along both at the bottom
right of what a level transforms.

Light coefficients are the transform of mean texel radiances, transfer values that of integrals
over texels, as for :class:`prt_torch.bases.CubeDirections`. Since texels differ in solid angle,
functions of a segment are orthonormal in texels but not over the sphere;
:meth:`Haar.weigh` goes through texels to get the L2 norm.

Source:
    Liu, Sloan, Shum, Snyder 2004, section 4 (segments, normalised non-standard transform); Wang,
    Tran, Luebke 2004, section 3.3 (whole faces); both after Ng, Ramamoorthi, Hanrahan 2003.
"""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases.base import LightBasis, Radiance
from prt_torch.bases.cube import CubeDirections
from prt_torch.bases.tables import kept_property

_BLOCK_BYTES = 2**20  # of images transformed at once on a processor: they stay in its cache


def forward(image: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch n n"]:
    """Haar coefficients of square images: normalised, non-standard, over the last two axes.

    In the layout of PyWavelets' ``coeffs_to_array(wavedec2(image, "haar"))``, in the dtype of the
    image. Orthonormal, so the sum of squares stays, and differentiable any number of times.

    Args:
        image: Images whose edge n is a power of two.

    Raises:
        ValueError: If they are not, or are not of a floating-point type.

    Source:
        Liu et al. 2004, section 4; Wang et al. 2004, section 3.3.
    """
    return _checked(image, backwards=False)


def inverse(coefficients: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch n n"]:
    """Images from their Haar coefficients: the inverse, and transpose, of :func:`forward`.

    Raises:
        ValueError: As :func:`forward`.
    """
    return _checked(coefficients, backwards=True)


def _checked(values: Tensor, *, backwards: bool) -> Tensor:
    if not values.is_floating_point():
        raise ValueError(f"expected floating-point values, got {values.dtype}")
    shape = tuple(values.shape)
    if len(shape) < 2 or shape[-1] != shape[-2] or not _is_power_of_two(shape[-1]):
        raise ValueError(f"expected square images with an edge of a power of two, got {shape}")
    return _Transform.apply(values, backwards)  # pyright: ignore[reportReturnType]


def _is_power_of_two(number: int) -> bool:
    return number > 0 and number & (number - 1) == 0


class _Transform(torch.autograd.Function):
    """Orthonormal, so that the gradient of one direction is the other direction."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, backwards: bool) -> Tensor:
        ctx.backwards = backwards
        out = torch.empty(values.shape, dtype=values.dtype, device=values.device)
        _by_blocks(_synthesise if backwards else _analyse, values, out)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return _Transform.apply(gradients[0], not ctx.backwards), None  # pyright: ignore[reportReturnType]


def _by_blocks(transform: Callable[[Tensor, Tensor], None], values: Tensor, out: Tensor) -> None:
    """Halve the longest batch axis until a block fits into the cache."""
    batch = values.shape[:-2]
    if values.device.type != "cpu" or values.nbytes <= _BLOCK_BYTES or max(batch, default=1) == 1:
        transform(values, out)
        return
    axis = batch.index(max(batch))
    for some in zip(values.tensor_split(2, axis), out.tensor_split(2, axis), strict=True):
        _by_blocks(transform, *some)


def _analyse(image: Tensor, coefficients: Tensor) -> None:
    """From the finest level to the coarsest."""
    means, edge = image, image.shape[-1]
    while edge > 1:
        half = edge // 2
        upper, lower = means[..., 0::2, :], means[..., 1::2, :]
        smooth, detail = (upper + lower).mul_(0.5), (upper - lower).mul_(0.5)
        near, far = slice(0, half), slice(half, edge)
        _difference(smooth, coefficients[..., near, far])
        torch.add(detail[..., 0::2], detail[..., 1::2], out=coefficients[..., far, near])
        _difference(detail, coefficients[..., far, far])
        means, edge = smooth[..., 0::2] + smooth[..., 1::2], half
    coefficients[..., :1, :1] = means


def _difference(pairs: Tensor, out: Tensor) -> None:
    torch.sub(pairs[..., 0::2], pairs[..., 1::2], out=out)


def _synthesise(coefficients: Tensor, image: Tensor) -> None:
    """From the coarsest level to the finest."""
    size = image.shape[-1]
    means, half = coefficients[..., :1, :1], 1
    while half < size:
        edge = 2 * half
        along_row = coefficients[..., :half, half:edge]
        along_column = coefficients[..., half:edge, :half]
        along_both = coefficients[..., half:edge, half:edge]
        smooth = _interleaved(means, along_row)
        detail = _interleaved(along_column, along_both)
        target = image if edge == size else means.new_empty(*means.shape[:-2], edge, edge)
        torch.add(smooth, detail, out=target[..., 0::2, :])
        torch.sub(smooth, detail, out=target[..., 1::2, :])
        means, half = target, edge
    if size == 1:
        image.copy_(means)


def _interleaved(mean: Tensor, difference: Tensor) -> Tensor:
    """Neighbours along a row, halved, from what they have in common and what tells them apart."""
    pairs = mean.new_empty(*mean.shape[:-1], 2 * mean.shape[-1])
    torch.add(mean, difference, out=pairs[..., 0::2])
    torch.sub(mean, difference, out=pairs[..., 1::2])
    return pairs.mul_(0.5)


class Haar(LightBasis):
    """Haar wavelets over square segments of a ``6 x resolution x resolution`` cube map.

    Coefficients go segment by segment (face, row of segments, column of segments), inside a
    segment row by row of :func:`forward`'s result. The defaults are the 24 segments of Liu et al.;
    ``Haar(64, 64)`` has the whole faces of Wang et al.

    Not closed under rotation: :meth:`rotate` takes the radiance at the turned texel centre
    (nearest), so prefer to turn the environment and project again.

    Args:
        resolution: Texels along an edge of a face.
        segment: Texels along an edge of a segment; a power of two that divides ``resolution``.

    Raises:
        ValueError: If ``segment`` is no power of two or does not divide ``resolution``.

    Source:
        Liu et al. 2004, sections 4 and 6; Wang et al. 2004, section 3.3.
    """

    def __init__(self, resolution: int = 32, segment: int = 16):
        if not _is_power_of_two(segment):
            raise ValueError(f"expected segments of a power of two of texels, got {segment}")
        if resolution < 1 or resolution % segment:
            raise ValueError(
                f"expected a cube resolution that is a multiple of the segments' {segment} "
                f"texels, got {resolution}"
            )
        self.resolution = resolution
        self.segment = segment
        self._cube = CubeDirections(resolution)

    @property
    def num_coeffs(self) -> int:
        """``6 * resolution**2``."""
        return self._cube.num_coeffs

    @property
    def num_segments(self) -> int:
        """``6 * (resolution / segment)**2``."""
        return 6 * (self.resolution // self.segment) ** 2

    @property
    def coeffs_per_segment(self) -> int:
        """``segment**2``."""
        return self.segment**2

    @property
    def name(self) -> str:
        """``Haar 6xRxR in N segments``."""
        return f"Haar 6x{self.resolution}x{self.resolution} in {self.num_segments} segments"

    def segments(
        self, values: Float[Tensor, "*batch coeffs"]
    ) -> Float[Tensor, "*batch segments coeffs_per_segment"]:
        """The same values with an axis for the segments: a view."""
        return values.unflatten(-1, (self.num_segments, self.coeffs_per_segment))

    def project(self, environment: Radiance) -> Float[Tensor, "coeffs rgb"]:
        """Transform of the mean radiance of each texel, float64; total flux is kept exactly.

        Source pixels are divided by :class:`CubeDirections` until a texel has at least 8 x 8 of
        them (the papers supersample 4 x 4).
        """
        return self._of_radiance(self._cube.project(environment))

    def project_cube(
        self, values: Float[Tensor, "points texels"], resolution: int
    ) -> Float[Tensor, "points coeffs"]:
        """Transform of sums of finer texels, whose resolution must be a multiple of this one.

        Raises:
            ValueError: If it is not.
        """
        return self._of_texels(self._cube.project_cube(values, resolution))

    def table_bytes(self, resolution: int) -> int:
        """None."""
        return 0

    def gram(self) -> Float[Tensor, "coeffs coeffs"]:
        """Inner products of all pairs: for small bases only, as it has their squared number."""
        weighed = self.weigh(torch.eye(self.num_coeffs, dtype=torch.float64))
        return weighed @ weighed.mT

    def weigh(self, values: Float[Tensor, "... coeffs"]) -> Float[Tensor, "... coeffs"]:
        """Integrals over texels, each over the square root of its solid angle.

        Texels come segment by segment.
        """
        texels = inverse(self._images(values))
        return (texels / self._root_solid_angles.to(values)).flatten(-3)

    def unweigh(self, values: Float[Tensor, "... coeffs"]) -> Float[Tensor, "... coeffs"]:
        """The inverse of :meth:`weigh`."""
        texels = self._images(values) * self._root_solid_angles.to(values)
        return forward(texels).flatten(-3)

    def weigh_light(
        self, light: Float[Tensor, "*batch coeffs rgb"]
    ) -> Float[Tensor, "*batch coeffs rgb"]:
        """Mean radiances of texels, each times the square root of its solid angle."""
        texels = inverse(self._images(light.mT)) * self._root_solid_angles.to(light)
        return texels.flatten(-3).mT

    def areas(self) -> Float[Tensor, "coeffs"]:
        """Solid angle where each function is not zero [sr], float64."""
        texels = self._root_solid_angles.square()
        areas = torch.empty_like(texels)
        areas[:, 0, 0] = texels.sum((1, 2))
        edge = 1
        while edge < self.segment:  # blocks along an edge of a segment; three wavelets a block
            width = self.segment // edge
            blocks = texels.view(-1, edge, width, edge, width).sum((2, 4))
            areas[:, : 2 * edge, edge : 2 * edge] = blocks.repeat(1, 2, 1)
            areas[:, edge : 2 * edge, :edge] = blocks
            edge *= 2
        return areas.flatten()

    def rotate(
        self, coefficients: Float[Tensor, "*batch coeffs rgb"], rotation: Float[Tensor, "3 3"]
    ) -> Float[Tensor, "*batch coeffs rgb"]:
        """Radiance at the nearest turned texel centre; approximate (see the class)."""
        return self._of_radiance(self._cube.rotate(self.radiance(coefficients), rotation))

    def radiance(
        self, coefficients: Float[Tensor, "*batch coeffs rgb"]
    ) -> Float[Tensor, "*batch texels rgb"]:
        """Mean radiance of each texel, ``"6 row col"`` flattened, from light coefficients."""
        texels = inverse(self._images(coefficients.mT)).unflatten(-3, self._segment_grid)
        return texels.transpose(-3, -2).flatten(-5).mT

    def describe(self) -> dict[str, Any]:
        """``{"name": "haar", "resolution": R, "segment": S}``."""
        return {"name": "haar", "resolution": self.resolution, "segment": self.segment}

    @property
    def _segment_grid(self) -> tuple[int, int, int]:
        along = self.resolution // self.segment
        return 6, along, along

    def _images(self, values: Tensor) -> Float[Tensor, "*batch segments row col"]:
        return values.unflatten(-1, (self.num_segments, self.segment, self.segment))

    def _segmented(self, texels: Float[Tensor, "*batch coeffs"]) -> Tensor:
        """Texels "6 row col" as images "segments row col"."""
        faces, along, _ = self._segment_grid
        split = texels.unflatten(-1, (faces, along, self.segment, along, self.segment))
        return split.transpose(-3, -2).flatten(-5, -3)

    def _of_texels(self, texels: Float[Tensor, "*batch coeffs"]) -> Tensor:
        return forward(self._segmented(texels)).flatten(-3)

    def _of_radiance(self, radiance: Float[Tensor, "*batch coeffs rgb"]) -> Tensor:
        return self._of_texels(radiance.mT).mT.contiguous()

    @kept_property
    def _root_solid_angles(self) -> Float[Tensor, "segments row col"]:
        return self._segmented(self._cube.solid_angles.sqrt())
