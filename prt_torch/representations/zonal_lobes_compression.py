r"""Lobes as few bits as they are worth: coordinates in which errors add up, and one step for all.

At given axes, transfer of a row is linear in its numbers: constant and linear terms, and a
coefficient for each band of each lobe. Lobes that point nearly the same way nearly depend on each
other, so their coefficients are large against each other, and rounding each to a step of its own
spends bits on what cancels. With the Cholesky factor R of the Gram matrix of the row's functions in
the metric, :math:`G = R R^T`, the coordinates :math:`q = R^T x` have squared errors that are those
of transfer. One step serves all of them, numbers that say nothing new round to zero, and what codes
of all rows lose is known beforehand (compare :mod:`prt_torch.representations.cpca_coding`).

R needs the axes only, which are decoded first. An axis has as many bits as its lobe is worth on the
average over points: where turning it by one code loses about as much as a step of a coordinate.

Source:
    Ours. Rounding coordinates of a triangular factor, not the unknowns, is transform coding.
    Sloan, Luna, Snyder 2005 store floating-point textures.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from prt_torch.bases import Diffuse, sh, zonal
from prt_torch.metric import Metric
from prt_torch.quantize import compress, decompress
from prt_torch.representations.octahedron import from_octahedron, to_octahedron
from prt_torch.representations.points import slices
from prt_torch.representations.zonal_lobes_coding import Lobes

_RIDGE = 1e-5  # of the Gram matrix, relative: what lobes that coincide may be against each other
_AXIS_STEPS = 1.4  # steps of a coordinate that turning an axis by one code may cost
_ROWS_AT_ONCE = 2**13


@dataclass(frozen=True)
class LobeCoding:
    """What turns codes into lobes.

    Attributes:
        steps: Of the coordinates of each row, float64.
        axis_bits: Of each of the two codes of an axis, by row and place of the lobe.
        metric: In which coordinates are orthonormal; its light side only.
        order: Bands of the light.
        low: Constant and linear terms that are kept beside lobes.
    """

    steps: Float[Tensor, "rows"]
    axis_bits: UInt8[Tensor, "rows lobes"]
    metric: Metric
    order: int
    low: int

    def axis_codes(
        self, axes: Float[Tensor, "points rows lobes 3"]
    ) -> Int[Tensor, "points rows lobes 2"]:
        """Octahedral codes of axes."""
        return to_octahedron(zonal.unit_axes(axes), self.axis_bits.long())

    def axes_at(
        self, codes: Int[Tensor, "points rows lobes 2"], dtype: torch.dtype
    ) -> Float[Tensor, "points rows lobes 3"]:
        """What codes of axes stand for."""
        return from_octahedron(codes, dtype, self.axis_bits.long())

    def codes(
        self, lobes: Lobes
    ) -> tuple[Int[Tensor, "points rows lobes 2"], Int[Tensor, "points rows unknowns"]]:
        """Of axes, and of coordinates."""
        axes = self.axis_codes(lobes.axes)
        unknowns = torch.cat([lobes.linear, lobes.coefficients.flatten(2)], dim=2).detach().double()
        codes = torch.empty(unknowns.shape, dtype=torch.int64, device=unknowns.device)
        for some in self._slices(axes):
            factor, _ = self._factor(axes[some])
            coordinates = (factor.mT @ unknowns[some][..., None])[..., 0]
            codes[some] = (coordinates / self.steps[:, None]).round().long()
        return axes, codes

    def lobes(
        self,
        axes: Int[Tensor, "points rows lobes 2"],
        codes: Int[Tensor, "points rows unknowns"],
        dtype: torch.dtype,
    ) -> Lobes:
        """What codes stand for."""
        axes, codes = axes.contiguous(), codes.contiguous()  # products round by their strides
        unknowns = torch.empty(codes.shape, dtype=dtype, device=codes.device)
        for some in self._slices(axes):
            factor, _ = self._factor(axes[some])
            coordinates = (codes[some] * self.steps[:, None])[..., None]
            solved = torch.linalg.solve_triangular(factor.mT, coordinates, upper=True)
            unknowns[some] = solved[..., 0].to(dtype)
        return self._split(self.axes_at(axes, dtype), unknowns)

    def rounded(self, lobes: Lobes) -> Lobes:
        """The same at what codes stand for."""
        return self.lobes(*self.codes(lobes), lobes.coefficients.dtype)

    def straight_through(self, lobes: Lobes) -> Lobes:
        """The same values, whose gradients pass as if nothing were rounded."""
        units = Lobes(zonal.unit_axes(lobes.axes), lobes.coefficients, lobes.linear)
        rounded = self.rounded(units)
        names = Lobes.names()
        pairs = [(getattr(units, name), getattr(rounded, name)) for name in names]
        return Lobes(*(own + (there - own).detach() for own, there in pairs))

    def solved(
        self, axes: Int[Tensor, "points rows lobes 2"], values: Float[Tensor, "points rows coeffs"]
    ) -> tuple[Lobes, Float[Tensor, "rows"]]:
        """The lobes closest to transfer in the metric at these axes, and their squared errors.

        Errors are summed over points, row by row.
        """
        bands = self.order - (math.isqrt(self.low) if self.low else 0)
        count = self.low + axes.shape[2] * bands
        unknowns = values.new_empty(*values.shape[:2], count)
        errors = torch.zeros(values.shape[1], dtype=torch.float64, device=values.device)
        for some in self._slices(axes):
            factor, functions = self._factor(axes[some])
            weighed = self.metric.weigh(values[some].double())
            moments = functions @ weighed[..., None]
            solved = torch.cholesky_solve(moments, factor)
            errors += (weighed - (functions.mT @ solved)[..., 0]).square().sum((0, 2))
            unknowns[some] = solved[..., 0].to(values)
        return self._split(self.axes_at(axes, values.dtype), unknowns), errors

    def _slices(self, axes: Tensor) -> list[slice]:
        return list(slices(len(axes), max(1, _ROWS_AT_ONCE // axes.shape[1])))

    def _factor(
        self, axes: Int[Tensor, "points rows lobes 2"]
    ) -> tuple[
        Float[Tensor, "points rows unknowns unknowns"], Float[Tensor, "points rows unknowns coeffs"]
    ]:
        """Cholesky factor of the Gram matrix of the rows' functions, and these in the metric."""
        harmonics = sh.evaluate(self.axes_at(axes, torch.float64), self.order)
        degrees = torch.arange(self.order**2, device=axes.device).sqrt().floor().long()
        first = math.isqrt(self.low)
        bands = torch.arange(first, self.order, device=axes.device)
        by_band = torch.where(degrees == bands[:, None], harmonics[..., None, :], 0.0)
        lobes = by_band.flatten(2, 3)
        linear = torch.eye(self.low, self.order**2, dtype=torch.float64, device=axes.device)
        functions = torch.cat([linear.expand(*lobes.shape[:2], *linear.shape), lobes], dim=2)
        functions = self.metric.weigh(functions)
        gram = functions @ functions.mT
        gram = gram + _RIDGE * torch.diag_embed(gram.diagonal(dim1=-2, dim2=-1))
        return torch.linalg.cholesky(gram), functions

    def _split(self, axes: Tensor, unknowns: Float[Tensor, "points rows unknowns"]) -> Lobes:
        coefficients = unknowns[..., self.low :].unflatten(2, (axes.shape[2], -1))
        return Lobes(axes, coefficients.contiguous(), unknowns[..., : self.low].contiguous())


def coded(
    lobes: Lobes,
    values: Float[Tensor, "points rows coeffs"],
    *,
    share: float,
    metric: Metric,
    order: int,
) -> tuple[Lobes, LobeCoding]:
    """Lobes at codes, their numbers fitted anew in the metric, and the coding.

    Args:
        lobes: As a fit left them.
        values: Transfer; rows of three channels one channel after the other.
        share: Of the squared error in the metric, which codes may add.
        metric: What errors are worth; rows count by themselves, each with its own power.
        order: Bands of the light.
    """
    num_rows, num_lobes = lobes.axes.shape[1:3]
    powers = metric.row_factor.square().sum(1).repeat(num_rows // len(metric.row_factor))
    powers = powers.to(values.device)
    finest = torch.full((num_rows, num_lobes), 16, dtype=torch.uint8, device=values.device)
    ones, low = torch.ones_like(powers), lobes.linear.shape[2]
    fine = LobeCoding(ones, finest, Metric(metric.name, metric.light), order, low)
    axes = fine.axis_codes(lobes.axes)
    lobes, errors = fine.solved(axes, values)
    numbers = values.shape[0] * num_rows * (low + lobes.coefficients[0, 0].numel() + 2 * num_lobes)
    error = float((errors * powers).sum())
    step = (12.0 * share * error / max(numbers, 1)) ** 0.5
    largest = float(lobes.coefficients.abs().max()) if lobes.coefficients.numel() else 0.0
    largest = max(largest, float(lobes.linear.abs().max()) if low else 0.0)
    steps = torch.full_like(powers, max(step, largest * 2.0**-16) or 1.0) / powers.sqrt()
    turned = _turned(lobes.coefficients, fine)
    bits = torch.log2(math.sqrt(4 * math.pi) * turned / (_AXIS_STEPS * steps[:, None]))
    coding = LobeCoding(steps, bits.round().clamp(3, 16).to(torch.uint8), fine.metric, order, low)
    axes = coding.axis_codes(lobes.axes)
    return coding.rounded(coding.solved(axes, values)[0]), coding


def by_strength(lobes: Lobes) -> Lobes:
    """Each row's lobes from the strongest to the weakest, which makes codes alike."""
    strength = lobes.coefficients.square().sum(3)
    order = strength.argsort(dim=2, descending=True, stable=True)[..., None]
    return Lobes(
        lobes.axes.gather(2, order.expand_as(lobes.axes)),
        lobes.coefficients.gather(2, order.expand_as(lobes.coefficients)),
        lobes.linear,
    )


def _turned(
    coefficients: Float[Tensor, "points rows lobes bands"], coding: LobeCoding
) -> Float[Tensor, "rows lobes"]:
    r"""Error a radian of turned axes, root mean square over points.

    A band of a lobe changes by :math:`g^{*2}_l\, m_l\, l (l + 1) / 2` a squared radian, where
    :math:`m_l` is the metric's mean over the sphere of the squared norm of :math:`y_l`.
    """
    order, bands = coding.order, coefficients.shape[3]
    every = torch.eye(order**2, dtype=torch.float64, device=coefficients.device)
    powers = coding.metric.weigh(every).square().sum(1)
    degrees = torch.arange(order, device=powers.device)
    by_band = torch.stack([one.sum() for one in powers.split((2 * degrees + 1).tolist())])
    gains = (by_band / (4 * math.pi) * degrees * (degrees + 1) / 2)[order - bands :]
    return (coefficients.double().square() * gains).sum(3).mean(0).sqrt()


def pack(lobes: Lobes, coding: LobeCoding) -> dict[str, Tensor]:
    """What a file holds.

    ``steps``, ``axis_bits`` and, of a light prior, ``light_factor``, the lower triangle of its
    factor, row by row (:class:`LobeCoding`); ``axis_stream`` and ``lobe_stream``, the codes,
    compressed, points side by side; ``low``, the terms beside lobes.
    """
    axes, codes = coding.codes(lobes)
    return {
        "steps": coding.steps.clone(),
        "axis_bits": coding.axis_bits.clone(),
        "low": torch.tensor([coding.low], dtype=torch.uint8, device=codes.device),
        "axis_stream": compress(axes.permute(1, 2, 3, 0), signed=True),
        "lobe_stream": compress(codes.permute(2, 1, 0), signed=True),
        **coding.metric.to_file(),
    }


def unpack(
    packed: dict[str, Tensor], points: int, order: int, dtype: torch.dtype
) -> tuple[Lobes, LobeCoding]:
    """The inverse of :func:`pack`."""
    bits, low = packed["axis_bits"], int(packed["low"])
    rows, lobes = bits.shape
    metric = Metric.from_file(packed, None, Diffuse())
    coding = LobeCoding(packed["steps"], bits, metric, order, low)
    unknowns = low + lobes * (order - math.isqrt(low))
    axes = decompress(packed["axis_stream"], points * rows * lobes * 2, signed=True)
    codes = decompress(packed["lobe_stream"], points * rows * unknowns, signed=True)
    axes = axes.view(rows, lobes, 2, points).permute(3, 0, 1, 2)
    return coding.lobes(axes, codes.view(unknowns, rows, points).permute(2, 1, 0), dtype), coding
