r"""Sparse transfer: for every point and row, the few light coefficients that matter most.

In a wavelet basis over the light, the transfer of a point under shadows is nearly sparse: it is
large for a few wavelets at the rims of what the point sees and small elsewhere. Light is a vector
of wavelet coefficients too, so radiance is a short weighted sum,

.. math:: B_{p,r} = \sum_{t} v_{p,r,t}\; L_{i(p,r,t)}

Any light basis may be used; the choice is optimal where it is orthonormal, as Haar wavelets are
over the texels of a cube map.

Values are integer codes with one step for each row and colour; terms whose code is zero are
dropped. The module always evaluates the decoded values, so its errors are those of its file.

Source:
    Wang, Tran, Luebke 2004, sections 3.3 and 3.4; Ng, Ramamoorthi, Hanrahan 2003. Steps for each
    row and colour are ours (the paper states none), and light is not quantised: at 16 bits a small
    bright sun takes the whole range and the ambient light is lost.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal, get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from prt_torch.metric import Metric
from prt_torch.quantize import (
    dequantize,
    full_scale,
    least_unsigned,
    pack_fields,
    quantize,
    rounded_up,
    straight_through,
    unpack_fields,
)
from prt_torch.representations.base import Representation
from prt_torch.representations.sparse_product import sparse_product
from prt_torch.representations.wavelet_selection import SparseTerms, largest_terms
from prt_torch.transfer import Surface, TransferTensor

Codes = Literal["11/11/10", "16", "8", "float"]
"""Bits of a value: those of three colours in four bytes, of each by itself, or not coded."""

_FIELDS = (11, 11, 10)


@dataclass(frozen=True)
class Coding:
    """How values become integers.

    Attributes:
        codes: Bits of a value.
        steps: ``"rows channels"`` in the type of the values; None where they are not coded.
    """

    codes: Codes
    steps: Float[Tensor, "rows channels"] | None

    @classmethod
    def at_full_scale(
        cls, values: Float[Tensor, "points rows terms channels"], codes: Codes
    ) -> "Coding":
        """The least steps, one for each row and channel, at which no value is clamped."""
        if codes == "float":
            return cls(codes, None)
        bits = _bits(codes, values.shape[-1])
        each = [full_scale(v, b, dim=(0, 2)) for v, b in zip(values.unbind(-1), bits, strict=True)]
        exact = torch.stack(each, dim=-1)[0, :, 0]
        return cls(codes, rounded_up(exact, values.dtype))


def _bits(codes: Codes, channels: int) -> tuple[int, ...]:
    return _FIELDS if codes == "11/11/10" else (int(codes),) * channels


class WaveletTransfer(Representation):
    """The largest light coefficients of each point and row.

    The parameter is ``values`` ``"points rows terms channels"``, zero where a point and row have
    fewer terms than another. Gradients pass straight through the coding, whose steps stay fixed.

    Args:
        terms: Indices and values, the values already decoded ones.
        coding: How values become integers.
        surface: Bases, frames and reflectance.
        shape: Points, channels, rows, coeffs.
        num_terms: The budget; more than the terms here where zeros were dropped.
        light_threshold: As for :meth:`from_transfer`.

    Attributes:
        indices: ``"points rows terms"``: light coefficient of each term, ascending.
        steps: ``"rows channels"``; None where values are not coded.
        codes: Bits of a value.
        light_threshold: Share of a light's largest coefficient at or below which its coefficients
            are left out. May be set at any time; a file keeps it.
    """

    kind: ClassVar[str] = "wavelet"
    indices: Tensor
    steps: Tensor | None

    def __init__(
        self,
        terms: SparseTerms,
        coding: Coding,
        surface: Surface,
        shape: tuple[int, int, int, int],
        *,
        num_terms: int,
        light_threshold: float = 0.0,
    ):
        super().__init__(surface, shape)
        self.codes: Codes = coding.codes
        self.num_terms = num_terms
        self.light_threshold = light_threshold
        self.values = nn.Parameter(terms.values.contiguous())
        self.register_buffer("indices", terms.indices.contiguous())
        self.register_buffer("steps", coding.steps)
        self._decoded: _Decoded | None = None

    @classmethod
    def from_transfer(
        cls,
        transfer: TransferTensor,
        *,
        num_terms: int = 96,
        codes: Codes | None = None,
        light_threshold: float = 0.0,
        metric: Metric | None = None,
        generator: torch.Generator | None = None,
    ) -> "WaveletTransfer":
        """Keep the coefficients of largest magnitude.

        Args:
            transfer: The tensor to stand for; read by blocks.
            num_terms: Coefficients for each point and row, at least 1. As many as there are, with
                codes ``float``, lose nothing.
            codes: Bits of a value. If not given ``11/11/10`` for three channels, as the paper, and
                ``16`` for one.
            light_threshold: Light coefficients are left out where none of their three colours is
                larger than this share of the light's largest; 0 keeps all. The paper's is
                1024 / 32767, or 0.031. It saves no time here, where a dense light is as fast.
            metric: If given, coefficients are compared by magnitude times the norm of their basis
                function; else by magnitude alone, as the paper does.
            generator: Not used: nothing is random.

        Raises:
            ValueError: If an option is out of range, or ``11/11/10`` is asked for one channel.

        Source:
            Wang et al. 2004, section 3.3.
        """
        if num_terms < 1:
            raise ValueError(f"expected at least 1 term, got {num_terms}")
        if not 0.0 <= light_threshold < 1.0:
            raise ValueError(f"expected a light threshold in 0..1, got {light_threshold}")
        channels = transfer.num_channels
        chosen: Codes = codes or ("11/11/10" if channels == 3 else "16")
        if chosen not in get_args(Codes):
            raise ValueError(f"expected codes 11/11/10, 16, 8 or float, got {codes!r}")
        if chosen == "11/11/10" and channels != 3:
            raise ValueError(f"expected three channels for codes 11/11/10, got {channels}")
        num_terms = min(num_terms, transfer.num_coeffs)
        terms = largest_terms(transfer, num_terms, metric)
        coding = Coding.at_full_scale(terms.values, chosen)
        decoded = SparseTerms(terms.indices, _decode(terms.values, coding).movedim(0, -1))
        return cls(
            decoded.without_zeros(),
            coding,
            transfer.surface,
            tuple(transfer.values.shape),
            num_terms=num_terms,
            light_threshold=light_threshold,
        )

    def forward(
        self, light: Float[Tensor, "batch *points coeffs rgb"], frames: Tensor | None = None
    ) -> Float[Tensor, "batch points rows rgb"]:
        """Weighted sums of a few light coefficients.

        Raises:
            ValueError: If shapes do not fit, or ``frames`` are given: transfer by wavelets over
                world directions is fixed to the rest pose.
        """
        if frames is not None:
            raise ValueError("sparse transfer is fixed to the rest pose and cannot be posed")
        local = self._check_light(light)
        light, weights = self._above_threshold(light), self._weights()
        if local:
            return self._forward_local(light, weights)
        indices = self.indices.flatten(0, 1)
        if self.num_channels == 1:
            table = light.permute(1, 2, 0).reshape(self.num_coeffs, -1)
            lit = sparse_product(indices, weights[0].flatten(0, 1), table)
        else:
            tables = light.permute(2, 1, 0).contiguous()  # rgb, coeffs, batch
            each = [
                sparse_product(indices, own.flatten(0, 1), table)
                for own, table in zip(weights, tables, strict=True)
            ]
            lit = torch.stack(each, dim=1)
        return lit.view(self.num_points, self.num_rows, 3, len(light)).permute(3, 0, 1, 2)

    def _forward_local(self, light: Tensor, weights: Tensor) -> Tensor:
        """Each point meets its own light."""
        places = self.indices.flatten(1).long().expand(len(light), -1, -1)
        colours = []
        for colour in range(3):
            own = weights[colour if self.num_channels == 3 else 0]
            met = light[..., colour].gather(2, places).view(len(light), *own.shape)
            colours.append((met * own).sum(-1))
        return torch.stack(colours, dim=-1)

    def _above_threshold(self, light: Tensor) -> Tensor:
        if self.light_threshold == 0.0:
            return light
        magnitude = light.detach().abs().amax(-1, keepdim=True)
        weak = magnitude <= self.light_threshold * magnitude.amax(-2, keepdim=True)
        return light.masked_fill(weak, 0.0)

    @property
    def _coding(self) -> Coding:
        return Coding(self.codes, self.steps)

    def _weights(self) -> Float[Tensor, "channels points rows terms"]:
        """Decoded values; those of the last call if nothing has changed and no gradient is due."""
        tracked = torch.is_grad_enabled() and self.values.requires_grad
        # A traced version would never change again, and those of inference mode have none.
        if tracked or torch.compiler.is_compiling() or self.values.is_inference():
            return _decode(self.values, self._coding)
        if self._decoded is None or not self._decoded.is_of(self.values):
            values = self.values.detach()
            with torch.inference_mode(False):  # so that gradients can pass through it later
                decoded = _decode(values, self._coding).contiguous()
            self._decoded = _Decoded(values, values._version, decoded)
        return self._decoded.weights

    def dense(self, points: Tensor | None = None) -> Float[Tensor, "points channels rows coeffs"]:
        """The terms in their places, zeros elsewhere."""
        every = slice(None) if points is None else points
        weights, indices = self._weights()[:, every].movedim(0, 1), self.indices[every]
        places = indices[:, None].expand(weights.shape).long()
        shape = (len(indices), self.num_channels, self.num_rows, self.num_coeffs)
        # Unused terms point at the first coefficient with value zero: add, do not overwrite.
        return weights.new_zeros(shape).scatter_add(-1, places, weights)

    def packed(self) -> dict[str, Tensor]:
        """The terms that are not zero, one point and row after the other.

        ``counts`` ``"points rows"`` of them; their ``indices`` in the least whole bytes; and their
        values: ``words`` of 11, 11 and 10 bits, ``codes`` ``"entries channels"`` of 8 or 16 bits
        with ``steps`` ``"rows channels"``, or ``values`` as they are.
        """
        weights = self._weights().detach().movedim(0, -1)
        used = (weights != 0).any(-1)
        parts = {
            "counts": least_unsigned(used.sum(-1), self.num_coeffs),
            "indices": least_unsigned(self.indices[used], self.num_coeffs - 1),
            "num_terms": torch.tensor(self.num_terms, dtype=torch.int32),
            "light_threshold": torch.tensor(self.light_threshold, dtype=torch.float64),
        }
        if self.steps is None:
            return {**parts, "values": weights[used]}
        bits = _bits(self.codes, self.num_channels)
        steps = self.steps.detach().clone()
        codes = torch.stack(
            [quantize(weights[..., c], steps[:, c, None], b)[used] for c, b in enumerate(bits)],
            dim=-1,
        )
        match self.codes:
            case "11/11/10":
                return {**parts, "steps": steps, "words": pack_fields(codes, _FIELDS)}
            case "8":
                return {**parts, "steps": steps, "codes": codes.to(torch.int8)}
            case _:
                return {**parts, "steps": steps, "codes": codes}

    @classmethod
    def from_packed(
        cls, packed: dict[str, Tensor], surface: Surface, shape: tuple[int, int, int, int]
    ) -> "WaveletTransfer":
        """The inverse of :meth:`packed`."""
        counts = packed["counts"].int()
        slots = torch.arange(max(1, int(counts.max())), device=counts.device)
        used = slots < counts[..., None]
        indices = torch.zeros(used.shape, dtype=torch.int32, device=counts.device)
        indices[used] = packed["indices"].int()
        coding = _coding_of(packed)
        entries = _entries(packed, coding, used)
        values = entries.new_zeros(*used.shape, shape[1])
        values[used] = entries
        return cls(
            SparseTerms(indices, values),
            coding,
            surface,
            shape,
            num_terms=int(packed["num_terms"]),
            light_threshold=float(packed["light_threshold"]),
        )

    @property
    def budget(self) -> dict[str, Any]:
        """Terms for each point and row, and codes; ``light_threshold`` only where there is one."""
        budget: dict[str, Any] = {"num_terms": self.num_terms, "codes": self.codes}
        if self.light_threshold > 0.0:
            budget["light_threshold"] = self.light_threshold
        return budget

    @property
    def condition(self) -> float:
        """1: nothing was solved."""
        return 1.0


@dataclass(frozen=True)
class _Decoded:
    """Decoded values, and what they were decoded from: storage, type and version of it."""

    source: Tensor
    version: int
    weights: Tensor

    def is_of(self, values: Tensor) -> bool:
        """Whether nothing was written to the values since; holding them keeps their address."""
        return (
            values.data_ptr() == self.source.data_ptr()
            and values.dtype == self.source.dtype
            and values._version == self.version
        )


def _decode(
    values: Float[Tensor, "points rows terms channels"], coding: Coding
) -> Float[Tensor, "channels points rows terms"]:
    if coding.steps is None:
        return values.movedim(-1, 0)
    each = zip(values.unbind(-1), _bits(coding.codes, values.shape[-1]), strict=True)
    return torch.stack(
        [straight_through(v, coding.steps[:, c, None], b) for c, (v, b) in enumerate(each)]
    )


def _coding_of(packed: dict[str, Tensor]) -> Coding:
    if "values" in packed:
        return Coding("float", None)
    if "words" in packed:
        return Coding("11/11/10", packed["steps"])
    return Coding("8" if packed["codes"].dtype == torch.int8 else "16", packed["steps"])


def _entries(
    packed: dict[str, Tensor], coding: Coding, used: Tensor
) -> Float[Tensor, "entries channels"]:
    """Values of a file in the order they stand there, each by the step of its row."""
    if coding.steps is None:
        return packed["values"]
    codes: Int[Tensor, "entries channels"] = (
        unpack_fields(packed["words"], _FIELDS) if "words" in packed else packed["codes"]
    )
    rows = used.nonzero()[:, 1]
    return dequantize(codes, coding.steps[rows], coding.steps.dtype)
