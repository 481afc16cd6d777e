r"""Uniform integer codes: what a number costs in a file, and what it loses there.

A value becomes the nearest multiple of a *step*,

.. math:: c = \mathrm{clamp}(\mathrm{round}(v / \Delta), -N, N), \quad N = 2^{b-1} - 1,
    \quad \hat v = c\, \Delta

Everything rests on the choice of the step. One step for numbers of very different size keeps the
large ones and loses the small ones: a sun of 1e6 over an ambient of 1 leaves nothing of the ambient
in 16 bits. So a step is a tensor, one for each band of numbers that belong together, and is kept in
float64: the step of denormal numbers underflows in their own type.

Range and rounding are symmetric about zero, so negating values negates codes. A step is a constant
to gradients; :func:`straight_through` lets them pass to the values as if nothing were rounded.

Codes are packed side by side in a fixed number of bits, or compressed to about their entropy: where
one step serves numbers of very different size, most codes are small, and a fixed width is that of
the few that are not.

Source:
    Wang, Tran, Luebke 2004, section 3.3 (signed uniform codes; 11, 11 and 10 bits in four bytes);
    Liu, Sloan, Shum, Snyder 2004, section 5 (16 bits). Compression is ours.
"""

import lzma
import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float, Int, Int32, Int64, Integer, UInt8
from torch import Tensor

_GROUP = 8  # codes that end on a whole byte, whatever their bits
_CODES_AT_ONCE = 2**18  # keeps the 64-bit intermediates of packing in the cache
_COMPRESSION = [  # an adaptive range coder over bytes, in the context of the byte before
    {"id": lzma.FILTER_LZMA2, "dict_size": 2**20, "lc": 4, "lp": 0, "pb": 0, "nice_len": 64}
]


def largest_code(bits: int) -> int:
    """Largest code N of so many bits; the smallest is -N.

    Raises:
        ValueError: If ``bits`` is not in 2..32.
    """
    if not 2 <= bits <= 32:
        raise ValueError(f"expected 2..32 bits a code, got {bits}")
    return 2 ** (bits - 1) - 1


def quantize(
    values: Float[Tensor, "..."], step: Float[Tensor, "..."] | float, bits: int
) -> Int[Tensor, "..."]:
    """The nearest codes, ties to even, clamped to the symmetric range of ``bits``.

    Args:
        values: Finite, of any floating type; divided in float64.
        step: Positive; one number, or a tensor that broadcasts to the shape of ``values``.
        bits: Of a code with its sign, 2 to 32.

    Returns:
        int16 up to 16 bits, int32 above.

    Raises:
        ValueError: If ``bits`` is out of range.
    """
    limit = largest_code(bits)
    codes = (values.detach().double() / step).round_().clamp_(-limit, limit)
    return codes.to(torch.int16 if bits <= 16 else torch.int32)


def dequantize(
    codes: Int[Tensor, "..."], step: Float[Tensor, "..."] | float, dtype: torch.dtype
) -> Float[Tensor, "..."]:
    """Codes times step, multiplied in float64 and rounded once to ``dtype``.

    Quantising the result gives the same codes again as long as ``dtype`` has a few bits more than
    the codes: float32 up to 22 bits.
    """
    return (codes.double() * step).to(dtype)


def full_scale(
    values: Float[Tensor, "..."], bits: int, dim: int | Sequence[int] | None = None
) -> Float[Tensor, "..."]:
    """The least step at which no value is clamped.

    Args:
        values: Finite.
        bits: Of a code with its sign, 2 to 32.
        dim: Dimensions that share a step, which keep size 1 in the result; all if not given.

    Returns:
        float64, never zero: 1 where all values are zero or there are none.

    Raises:
        ValueError: If ``bits`` is out of range.
    """
    limit = largest_code(bits)
    dims = range(values.ndim) if dim is None else [dim] if isinstance(dim, int) else dim
    dims = sorted({d % values.ndim for d in dims})
    if values.numel() == 0:
        shape = [1 if d in dims else size for d, size in enumerate(values.shape)]
        largest = torch.zeros(shape, dtype=torch.float64, device=values.device)
    else:
        magnitudes = values.detach().abs().double()
        largest = magnitudes.amax(dims, keepdim=True) if dims else magnitudes
    smallest = math.ulp(0.0)
    step = (largest / limit).clamp_min(smallest)
    # A denormal step is coarse: rounded down, it may be too small for the largest value.
    step = torch.where(largest / step < limit + 0.5, step, step + smallest)
    step = torch.where(largest > 0, step, 1.0)
    return step.reshape(()) if dim is None else step


def rounded_up(steps: Float[Tensor, "..."], dtype: torch.dtype) -> Float[Tensor, "..."]:
    """Steps in another type, no smaller than they were, so that what they cover stays covered."""
    rounded = steps.to(dtype)
    above = rounded.nextafter(torch.full_like(rounded, math.inf))
    return torch.where(rounded.double() < steps, above, rounded)


def straight_through(
    values: Float[Tensor, "..."], step: Float[Tensor, "..."] | float, bits: int
) -> Float[Tensor, "..."]:
    """Quantised values, to the bit, with the gradient of a clamp.

    The gradient with respect to ``values`` is 1 where the code is not clamped and 0 where it is.

    Args:
        values: Finite.
        step: As in :func:`quantize`; no gradient reaches it.
        bits: Of a code with its sign, 2 to 32.

    Raises:
        ValueError: If ``bits`` is out of range.
    """
    steps = torch.as_tensor(step, device=values.device)
    return _StraightThrough.apply(values, steps, largest_code(bits))  # pyright: ignore[reportReturnType]


class _StraightThrough(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(values: Tensor, step: Tensor, limit: int) -> Tensor:
        codes = (values.double() / step).round_().clamp_(-limit, limit)
        return ((codes + 0.0) * step).to(values.dtype)  # as integers: no negative zero

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, int], output: Tensor) -> None:
        values, step, ctx.limit = inputs
        ctx.save_for_backward(values, step)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        values, step = ctx.saved_tensors
        inside = (values.double() / step).abs() <= ctx.limit + 0.5
        return gradients[0].where(inside, 0.0), None, None


def pack(codes: Int[Tensor, "codes"], bits: int) -> UInt8[Tensor, "bytes"]:
    """Codes side by side without gaps.

    Two's complement, little-endian: code i takes bits ``i * bits`` to ``(i + 1) * bits - 1`` of
    the stream, its lowest bit first, and bit k of the stream is bit ``k % 8`` of byte ``k // 8``.
    The last byte is filled with zeros.

    Args:
        codes: Integers of -2^(bits-1) to 2^(bits-1) - 1.
        bits: 1 to 32.

    Raises:
        ValueError: If ``bits`` is out of range or a code does not fit.
    """
    _check_fits(codes, bits)
    pieces = [_pack_groups(some, bits) for some in codes.split(_CODES_AT_ONCE)]
    return torch.cat(pieces)[: _packed_bytes(len(codes), bits)]


def _pack_groups(codes: Tensor, bits: int) -> UInt8[Tensor, "bytes"]:
    """Groups of eight codes to ``bits`` bytes each; the last group is filled with zeros."""
    filled = torch.nn.functional.pad(codes.long(), (0, -len(codes) % _GROUP))
    groups = (filled & ((1 << bits) - 1)).view(-1, _GROUP)
    packed = torch.zeros(len(groups), bits, dtype=torch.int64, device=codes.device)
    for code in range(_GROUP):
        for byte, shift in _overlaps(code, bits):
            own = groups[:, code]
            packed[:, byte] |= (own << shift if shift >= 0 else own >> -shift) & 0xFF
    return packed.to(torch.uint8).flatten()


def unpack(packed: UInt8[Tensor, "bytes"], bits: int, count: int) -> Int64[Tensor, "codes"]:
    """The inverse of :func:`pack`.

    Args:
        packed: Bytes of :func:`pack`.
        bits: 1 to 32.
        count: How many codes there are.

    Raises:
        ValueError: If ``bits`` is out of range, or the number of bytes is not that of the codes.
    """
    _check_bits(bits)
    if len(packed) != _packed_bytes(count, bits):
        raise ValueError(
            f"expected {_packed_bytes(count, bits)} bytes for {count} codes of {bits} bits, "
            f"got {len(packed)}"
        )
    pieces = [_unpack_groups(some, bits) for some in packed.split(_CODES_AT_ONCE // 8 * bits)]
    return torch.cat(pieces)[:count]


def _unpack_groups(packed: Tensor, bits: int) -> Int64[Tensor, "codes"]:
    filled = torch.nn.functional.pad(packed.long(), (0, -len(packed) % bits)).view(-1, bits)
    codes = torch.zeros(len(filled), _GROUP, dtype=torch.int64, device=packed.device)
    for code in range(_GROUP):
        for byte, shift in _overlaps(code, bits):
            own = filled[:, byte]
            codes[:, code] |= own >> shift if shift >= 0 else own << -shift
    return _signed(codes, bits).flatten()


def _overlaps(code: int, bits: int) -> list[tuple[int, int]]:
    """Bytes of a group that a code lies in, and where in each its lowest bit would be."""
    first, last = code * bits // 8, ((code + 1) * bits - 1) // 8
    return [(byte, code * bits - 8 * byte) for byte in range(first, last + 1)]


def pack_fields(
    codes: Int[Tensor, "words fields"], bits: Sequence[int] = (11, 11, 10)
) -> Int32[Tensor, "words"]:
    """Several codes in each 32-bit word.

    Two's complement, the first field in the lowest bits.

    Args:
        codes: Integers that fit the bits of their field.
        bits: Of each field; at most 32 in all.

    Raises:
        ValueError: If the bits do not fit a word, or a code its field.

    Source:
        Wang et al. 2004, section 3.3, whose order of the fields is not stated.
    """
    _check_word(bits)
    if codes.shape[-1] != len(bits):
        raise ValueError(f"expected {len(bits)} codes a word, got {codes.shape[-1]}")
    words = torch.zeros(len(codes), dtype=torch.int64, device=codes.device)
    start = 0
    for field, width in zip(codes.unbind(-1), bits, strict=True):
        _check_fits(field, width)
        words |= (field.long() & ((1 << width) - 1)) << start
        start += width
    return _signed(words, 32).to(torch.int32)


def unpack_fields(
    words: Int32[Tensor, "words"], bits: Sequence[int] = (11, 11, 10)
) -> Int64[Tensor, "words fields"]:
    """The inverse of :func:`pack_fields`.

    Raises:
        ValueError: If the bits do not fit a word.
    """
    _check_word(bits)
    fields, start = [], 0
    for width in bits:
        fields.append(_signed((words.long() >> start) & ((1 << width) - 1), width))
        start += width
    return torch.stack(fields, dim=-1)


def compress(values: Integer[Tensor, "..."], *, signed: bool) -> UInt8[Tensor, "bytes"]:
    """Integers in about as many bits as their entropy: few where most are small or alike.

    The lowest byte of all values comes first, then the next where any value needs it. Values that
    go together should lie together: the coder learns as it goes.

    Args:
        values: Of magnitudes below 2^31; read row by row.
        signed: Whether some may be negative; signs take the lowest bit then.

    Returns:
        A raw LZMA2 stream, which other versions of its library may make of another length. What
        it decompresses to is the same.

    Raises:
        ValueError: If a value is negative and ``signed`` is not set, or too large.
    """
    low, high = (int(bound) for bound in values.aminmax()) if values.numel() else (0, 0)
    if (low < 0 and not signed) or low <= -(2**31) or high >= 2**31:
        raise ValueError(f"expected values below 2^31 with signed={signed}, got {low} to {high}")
    wide = values.detach().long().flatten()
    folded = torch.where(wide < 0, -2 * wide - 1, 2 * wide) if signed else wide
    largest = int(folded.max()) if len(folded) else 0
    planes = [folded >> shift & 0xFF for shift in range(0, max(1, largest.bit_length()), 8)]
    raw = torch.cat(planes).to(torch.uint8).cpu().numpy().tobytes()
    stream = bytearray(lzma.compress(raw, format=lzma.FORMAT_RAW, filters=_COMPRESSION))
    return torch.frombuffer(stream, dtype=torch.uint8).to(values.device)


def decompress(
    compressed: UInt8[Tensor, "bytes"], count: int, *, signed: bool
) -> Int64[Tensor, "values"]:
    """The inverse of :func:`compress`, flat.

    Args:
        compressed: Bytes of :func:`compress`.
        count: How many values there are.
        signed: As it was.

    Raises:
        ValueError: If these are no such bytes, or of another number of values.
    """
    decoder = lzma.LZMADecompressor(format=lzma.FORMAT_RAW, filters=_COMPRESSION)
    stream = compressed.cpu().numpy().tobytes()
    try:
        raw = decoder.decompress(stream, max_length=4 * count + 1)  # no more, whatever they say
    except (lzma.LZMAError, EOFError) as error:
        raise ValueError(f"expected compressed codes, got {len(stream)} other bytes") from error
    planes = len(raw) // max(count, 1)
    if len(raw) != planes * count or (count and not 1 <= planes <= 4):
        raise ValueError(f"expected {count} codes of 1 to 4 bytes, got {len(raw)} bytes")
    if count == 0:
        return torch.zeros(0, dtype=torch.int64, device=compressed.device)
    by_plane = torch.frombuffer(bytearray(raw), dtype=torch.uint8).view(planes, count).long()
    shifts = 8 * torch.arange(planes)[:, None]
    folded = (by_plane << shifts).sum(0).to(compressed.device)
    return torch.where(folded % 2 == 1, -(folded + 1) // 2, folded // 2) if signed else folded


def least_unsigned(values: Integer[Tensor, "..."], largest: int) -> Integer[Tensor, "..."]:
    """Indices or counts in the least whole bytes that hold the largest there may be.

    Returns:
        uint8 below 2^8, uint16 below 2^16, else int32. Few operations take uint16; convert it
        back before computing with it.

    Raises:
        ValueError: If a value is negative or above ``largest``, or that is above 2^31 - 1.
    """
    low, high = (int(bound) for bound in values.aminmax()) if values.numel() else (0, 0)
    if low < 0 or high > largest or largest >= 2**31:
        raise ValueError(f"expected values of 0 to {largest} < 2^31, got {low} to {high}")
    match largest:
        case small if small < 2**8:
            return values.to(torch.uint8)
        case medium if medium < 2**16:
            return values.to(torch.uint16)
        case _:
            return values.to(torch.int32)


def _signed(unsigned: Int64[Tensor, "..."], bits: int) -> Int64[Tensor, "..."]:
    """The low ``bits``, beyond which there may be others, read as two's complement."""
    half = 1 << (bits - 1)
    return ((unsigned & ((1 << bits) - 1)) ^ half) - half


def _packed_bytes(count: int, bits: int) -> int:
    return -(-count * bits // 8)


def _check_bits(bits: int) -> None:
    if not 1 <= bits <= 32:
        raise ValueError(f"expected 1..32 bits a code, got {bits}")


def _check_word(bits: Sequence[int]) -> None:
    if min(bits, default=0) < 1 or sum(bits) > 32:
        raise ValueError(f"expected fields of at least 1 bit and 32 in all, got {tuple(bits)}")


def _check_fits(codes: Tensor, bits: int) -> None:
    _check_bits(bits)
    if len(codes) == 0:
        return
    low, high = (int(bound) for bound in codes.aminmax())
    if low < -(1 << (bits - 1)) or high >= 1 << (bits - 1):
        raise ValueError(f"expected codes that fit {bits} bits, got {low} to {high}")
