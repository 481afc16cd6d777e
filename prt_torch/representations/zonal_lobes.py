r"""Transfer as sums of zonal lobes, which turn with the surface.

Each row of a point's transfer is a sum of a few functions that are symmetric around axes of their
own (:mod:`prt_torch.bases.zonal`),

.. math:: T_{p,r}(s) \approx \sum_{i=1}^{N} \sum_l g^*_{il}\; y_l(s_i) \cdot y_l(s).

Where the surface deforms, the transfer at a point turns with its frame, and that of a sum of lobes
by turning N axes: no representation by coefficients of light can do so. Light, by spherical
harmonics, may turn too, or differ from point to point. Radiance takes the light's band l at each
axis, :math:`\hat e_l(s_i) = \sum_m y_{lm}(s_i)\, e_{lm}`, times the lobe's coefficient of the band.

Three lobes can meet any constant and linear term, so from three on those four coefficients are kept
as they are, and lobes are fitted to, and have coefficients for, the bands from 2 on. Constant and
linear terms may be interpolated over the surface, which lobes may not.

The turn carries what happens near the point, such as the shadow of a bump, and leaves out what
happens far away, whose shadow would not move with the point.

Source:
    Sloan, Luna, Snyder 2005, sections 3.1, 3.2, 4.1 and 5. Light is exact at every axis unless a
    ``table`` is set; the paper always looks it up, in 64 x 32 directions.
"""

import math
import time
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from prt_torch.bases import SphericalHarmonics, zonal
from prt_torch.bases.zonal_table import LatLongTable
from prt_torch.metric import Metric
from prt_torch.representations.base import CodedRepresentation
from prt_torch.representations.zonal_lobes_coding import BITS, Lobes, on_codes, pack, unpack
from prt_torch.representations.zonal_lobes_compression import LobeCoding, by_strength, coded
from prt_torch.representations.zonal_lobes_compression import pack as compressed
from prt_torch.representations.zonal_lobes_compression import unpack as decompressed
from prt_torch.representations.zonal_lobes_correspondence import between, corresponding
from prt_torch.representations.zonal_lobes_search import Effort, search
from prt_torch.representations.zonal_lobes_shading import radiance, turned
from prt_torch.transfer import Surface, TransferTensor

LINEAR_LOBES = 3
"""Lobes from which on constant and linear terms are kept beside them."""


class ZonalLobes(CodedRepresentation):
    """A few lobes for each row of each point.

    Parameters are ``axes`` ``"points rows lobes 3"``, taken by their directions, in the world frame
    of the rest pose; ``coefficients`` ``"points rows lobes bands"``, the g* of the paper; and
    ``linear`` ``"points rows low"``, harmonics of bands 0 and 1 where there are at least three
    lobes (low is 4, or 1 at order 1), else of no elements. Rows of three channels come one channel
    after the other.

    Args:
        lobes: Axes and coefficients.
        steps: Of codes, as :meth:`Lobes.steps`; None where parameters are kept as they are.
        surface: Bases, frames and reflectance; the rest frames are needed to pose it.
        shape: Points, channels, rows, coeffs.
        coding: In place of ``steps``, where lobes are compressed.

    Attributes:
        table: Size of the table that light at the axes is looked up in; None, at first, for exact
            evaluation. May be set at any time; belongs to nothing that is saved.
        bits: Of a code; None where parameters are kept as they are.
        statistics: ``largest_coefficient`` (of g*), ``starts``, ``steps`` (evaluations),
            ``unfinished`` (fits that were ended by the limit of steps), ``seconds``; empty if
            loaded.

    Raises:
        ValueError: If the light basis is not one of spherical harmonics.
    """

    kind: ClassVar[str] = "zonal_lobes"
    axes: nn.Parameter
    coefficients: nn.Parameter
    linear: nn.Parameter
    _steps: Tensor | None
    _row_steps: Tensor | None
    _axis_bits: Tensor | None

    def __init__(
        self,
        lobes: Lobes,
        steps: Float[Tensor, "points rows"] | None,
        surface: Surface,
        shape: tuple[int, int, int, int],
        coding: LobeCoding | None = None,
    ):
        super().__init__(surface, shape)
        self.order = _order(surface, shape[3])
        self.bits: Literal[16] | None = None if steps is None else BITS
        self.table: LatLongTable | None = None
        self.statistics: dict[str, float] = {}
        self._condition = float("nan")
        for name in Lobes.names():
            values = getattr(lobes, name).detach()
            copy = values.clone(memory_format=torch.contiguous_format)
            self.register_parameter(name, nn.Parameter(copy))
        self.register_buffer("_steps", steps)
        self._metric = None if coding is None else coding.metric
        self.register_buffer("_row_steps", None if coding is None else coding.steps)
        self.register_buffer("_axis_bits", None if coding is None else coding.axis_bits)
        self._rest()

    @classmethod
    def from_transfer(
        cls,
        transfer: TransferTensor,
        *,
        num_lobes: int = 4,
        effort: Effort = "default",
        ridge: float = 1e-7,
        bits: Literal[16] | None = 16,
        quantisation_share: float | None = None,
        edges: Int[Tensor, "edges 2"] | None = None,
        metric: Metric | None = None,
        generator: torch.Generator | None = None,
    ) -> "ZonalLobes":
        """Fit the lobes of all rows of all points, side by side.

        Args:
            transfer: The tensor to stand for, in spherical harmonics of any order; one without a
                light basis is taken for that if its coefficients are a square number.
            num_lobes: Of each row of a point, at least 1.
            effort: ``default``, or ``fast``: a fifth to a quarter of the time, for a third to a
                half more squared error of diffuse transfer by four lobes.
            ridge: Share of the squared norms of lobes that is added to the squared error, at least
                ``1e-12``; keeps pairs of lobes from growing against each other.
            bits: Of a code; None keeps parameters as they are.
            quantisation_share: Compress lobes, in place of ``bits``, to codes that may add this
                share of the squared error in the metric; numbers are then fitted anew in it, at the
                axes' codes (:mod:`prt_torch.representations.zonal_lobes_compression`).
            edges: Pairs of neighbouring points whose lobes are to correspond, so that they can be
                interpolated (:meth:`at`); points alone have up to a few times less error without.
            metric: Of ``quantisation_share`` only: lobes are fitted in L2 over the sphere, row by
                row. What errors are worth enters with the refinement by gradients.
            generator: Source of random starts; seed 0 if not given.

        Raises:
            ValueError: If an option is out of range, or the transfer is not in spherical
                harmonics.

        Source:
            Sloan, Luna, Snyder 2005, sections 4.1 and 5, with coefficients eliminated
            (:mod:`prt_torch.representations.zonal_lobes_objective`) and another search
            (:mod:`prt_torch.representations.zonal_lobes_search`).
        """
        _check_options(transfer, num_lobes, ridge, bits, quantisation_share)
        bits = bits if quantisation_share is None else None
        start = time.perf_counter()
        values = transfer.dense().flatten(1, 2)  # points, rows, coeffs
        values = values.to(torch.promote_types(values.dtype, torch.float32))
        own_linear = num_lobes >= LINEAR_LOBES
        found = search(
            values.flatten(0, 1),
            num_lobes,
            first_band=2 if own_linear else 1,
            ridge=ridge,
            effort=effort,
            generator=generator or torch.Generator().manual_seed(0),
        )
        axes = found.axes.unflatten(0, values.shape[:2]).to(values)
        axes = axes if bits is None else on_codes(axes)
        lobes = _solved(values, axes, ridge, own_linear)
        lobes = by_strength(lobes) if edges is None else corresponding(lobes, values, edges)
        steps = None if bits is None else lobes.steps()
        lobes = lobes if steps is None else lobes.rounded(steps)
        model = cls(lobes, steps, transfer.surface, tuple(transfer.values.shape))
        model._condition = _worst_condition(lobes, model.order, ridge)
        if quantisation_share is not None:
            model = model.coded(transfer, share=quantisation_share, metric=metric)
        model.statistics = {
            "largest_coefficient": _largest(model.coefficients.detach()),
            **{name: getattr(found, name) for name in ("starts", "steps", "unfinished")},
            "seconds": time.perf_counter() - start,
        }
        return model

    @torch.no_grad()
    def coded(
        self, transfer: TransferTensor, *, share: float, metric: Metric | None = None
    ) -> "ZonalLobes":
        """The same in compressed codes: axes at theirs, numbers fitted anew there.

        Args:
            transfer: What it stands for.
            share: Of the squared error in the metric, which codes may add; down to what 15 bits do.
            metric: What errors are worth; the L2 norm over light directions if not given.

        Raises:
            ValueError: If the share is not positive.
        """
        if not share > 0.0:
            raise ValueError(f"expected a positive share, got {share}")
        values = transfer.dense().flatten(1, 2)
        lobes, coding = coded(
            self._values(),
            values.to(torch.promote_types(values.dtype, torch.float32)),
            share=share,
            metric=(metric or Metric.l2(transfer)).in_float32(),
            order=self.order,
        )
        found = ZonalLobes(lobes, None, self.surface, self.shape, coding)
        found._condition, found.statistics = self._condition, self.statistics
        return found

    @property
    def num_lobes(self) -> int:
        """Of each row of a point."""
        return self.axes.shape[2]

    @property
    def first_band(self) -> int:
        """The first that lobes have coefficients of."""
        return self.order - self.coefficients.shape[3]

    def at(
        self,
        corners: Int[Tensor, "samples corners"],
        weights: Float[Tensor, "samples corners"],
        frames: Float[Tensor, "samples 3 3"] | None = None,
    ) -> "ZonalLobes":
        """Lobes between points, such as at the pixels of a picture; of a fit along ``edges``.

        They are interpolated, but for seams, where lobes of neighbours do not correspond and those
        of the nearest point are taken.

        Args:
            corners: Points that a sample lies between.
            weights: Of the corners, which sum to one.
            frames: Shading frames of the samples at rest, where they are to be posed or their
                radiance depends on the view.

        Source:
            Sloan, Luna, Snyder 2005, section 6, which samples lobes and interpolates the rest.
        """
        with torch.no_grad():
            lobes = between(self._values(), corners, weights, self.order)
            reflectance = self.reflectance
            if len(reflectance) > 1:
                reflectance = torch.einsum(
                    "sc,scr->sr", weights.to(reflectance), reflectance[corners]
                )
        surface = Surface(
            exit_basis=self._surface.exit_basis,
            light_basis=self._surface.light_basis,
            reflectance=reflectance,
            frames=frames,
        )
        shape = (len(corners), self.num_channels, self.num_rows, self.num_coeffs)
        return ZonalLobes(lobes, None, surface, shape)

    def _values(self) -> Lobes:
        """Parameters as a file would hold them, while gradients refine them."""
        lobes, coding = Lobes(self.axes, self.coefficients, self.linear), self._coding()
        if self._at_rest or not self.training:
            return lobes
        if coding is not None:
            return coding.straight_through(lobes)
        return lobes if self._steps is None else lobes.straight_through(self._steps)

    def _rounded(self) -> dict[str, Tensor]:
        lobes, coding = Lobes(self.axes, self.coefficients, self.linear), self._coding()
        if self._steps is not None:
            lobes = lobes.rounded(self._steps)
        elif coding is not None:
            lobes = coding.rounded(lobes)
        return {name: getattr(lobes, name) for name in Lobes.names()}

    def _coding(self) -> LobeCoding | None:
        if self._metric is None or self._row_steps is None or self._axis_bits is None:
            return None
        low = self.linear.shape[2]
        return LobeCoding(self._row_steps, self._axis_bits, self._metric, self.order, low)

    def forward(
        self, light: Float[Tensor, "batch *points coeffs rgb"], frames: Tensor | None = None
    ) -> Float[Tensor, "batch points rows rgb"]:
        """The light's bands at each axis, times the lobes' coefficients.

        Args:
            light: In world coordinates.
            frames: Shading frames of the deformed surface, rows tangent, bitangent and normal: what
                points the same way in a point's frame as at rest is what its transfer turns to.
                One pose ``"points 3 3"``, or ``"batch points 3 3"`` with one for each light.

        Raises:
            ValueError: If shapes do not fit, or ``frames`` are given and the surface has none to
                tell how it stood at rest (:func:`load` takes them as ``geometry``).

        Source:
            Sloan, Luna, Snyder 2005, equations 10, 24 and 25.
        """
        self._check_light(light)
        lobes = self._values()
        if frames is None:
            return radiance(lobes, light, self.num_channels, self.table)
        poses = [
            radiance(turned(lobes, turns), lit, self.num_channels, self.table)
            for lit, turns in self._poses(light, frames)
        ]
        return torch.cat(poses) if len(poses) > 1 else poses[0]

    def dense(self, points: Tensor | None = None) -> Float[Tensor, "points channels rows coeffs"]:
        """Sums of the lobes' harmonics, in the rest pose."""
        lobes = self._values() if points is None else self._values()[points]
        filled = nn.functional.pad(lobes.coefficients, (self.first_band, 0))
        harmonics = zonal.lobes_to_sh(lobes.axes, filled)
        low = lobes.linear.shape[-1]
        values = torch.cat([lobes.linear, harmonics[..., low:]], dim=-1)
        return values.unflatten(1, (self.num_channels, self.num_rows))

    def packed(self) -> dict[str, Tensor]:
        """Compressed codes (:func:`zonal_lobes_compression.pack`), codes, or parameters."""
        lobes, coding = Lobes(self.axes, self.coefficients, self.linear), self._coding()
        return pack(lobes, self._steps) if coding is None else compressed(lobes, coding)

    @classmethod
    def from_packed(
        cls, packed: dict[str, Tensor], surface: Surface, shape: tuple[int, int, int, int]
    ) -> "ZonalLobes":
        """The inverse of :meth:`packed`."""
        if "lobe_stream" not in packed:
            return cls(*unpack(packed), surface, shape)
        order, dtype = _order(surface, shape[3]), surface.reflectance.dtype
        lobes, coding = decompressed(packed, shape[0], order, dtype)
        return cls(lobes, None, surface, shape, coding)

    @property
    def budget(self) -> dict[str, Any]:
        """Lobes of each row of a point."""
        return {"num_lobes": self.num_lobes}

    @property
    def condition(self) -> float:
        """Of the worst solve for coefficients, ridge included; NaN if loaded."""
        return self._condition


def _order(surface: Surface, num_coeffs: int) -> int:
    """Bands of the light basis; without one, those of as many harmonics."""
    basis = surface.light_basis
    if isinstance(basis, SphericalHarmonics):
        return basis.order
    order = math.isqrt(num_coeffs)
    if basis is not None or order * order != num_coeffs:
        given = basis.name if basis else f"{num_coeffs} coeffs without a light basis"
        raise ValueError(f"expected transfer in spherical harmonics for lobes, got {given}")
    return order


def _check_options(
    transfer: TransferTensor, num_lobes: int, ridge: float, bits: int | None, share: float | None
) -> None:
    _order(transfer.surface, transfer.num_coeffs)
    if num_lobes < 1:
        raise ValueError(f"expected at least 1 lobe, got {num_lobes}")
    if bits not in (BITS, None):
        raise ValueError(f"expected 16 bits or None, got {bits!r}")
    if share is not None and not share > 0.0:
        raise ValueError(f"expected a positive share, got {share}")
    if not ridge >= zonal.LEAST_RIDGE:
        raise ValueError(f"expected a ridge of at least {zonal.LEAST_RIDGE:g}, got {ridge:g}")


def _solved(
    values: Float[Tensor, "points rows coeffs"],
    axes: Float[Tensor, "points rows lobes 3"],
    ridge: float,
    own_linear: bool,
) -> Lobes:
    """The coefficients closest to transfer at these axes."""
    coefficients = zonal.fit_coefficients(values, axes, ridge)
    if not own_linear:
        return Lobes(axes, coefficients, values[..., :0])
    return Lobes(axes, coefficients[..., 2:], values[..., :4])


def _worst_condition(lobes: Lobes, order: int, ridge: float) -> float:
    """Of the matrices that coefficients were solved with."""
    axes, bands = lobes.axes.double(), lobes.coefficients.shape[-1]
    if lobes.coefficients.numel() == 0:
        return 1.0
    grams = zonal.legendre(axes @ axes.mT, order)[..., order - bands :].movedim(-1, -3)
    spectra = torch.linalg.eigvalsh(grams).clamp_min(0.0) + ridge
    return float((spectra[..., -1] / spectra[..., 0]).max())


def _largest(coefficients: Tensor) -> float:
    return float(coefficients.abs().max()) if coefficients.numel() else 0.0
