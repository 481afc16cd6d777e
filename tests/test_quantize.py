"""Codes: exact packing, known steps, gradients, and numbers of very different size."""

import math

import numpy as np
import pytest
import torch

from prt_torch.quantize import (
    compress,
    decompress,
    dequantize,
    full_scale,
    largest_code,
    least_unsigned,
    pack,
    pack_fields,
    quantize,
    straight_through,
    unpack,
    unpack_fields,
)


def random_codes(count: int, bits: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    low, high = -(2 ** (bits - 1)), 2 ** (bits - 1)
    codes = torch.randint(low, high, (count,), generator=generator)
    if count > 1:
        codes[0], codes[-1] = low, high - 1
    return codes


class TestQuantize:
    def test_known_codes(self):
        values = torch.tensor([0.0, 0.26, -0.26, 0.24, 0.25, 0.75, 1e9, -1e9])
        codes = quantize(values, 0.5, 4)
        assert codes.tolist() == [0, 1, -1, 0, 0, 2, 7, -7]  # ties to even; symmetric clamp

    @pytest.mark.parametrize("bits", [2, 8, 10, 11, 16, 17, 32])
    def test_error_is_at_most_half_a_step_and_the_largest_value_takes_the_largest_code(self, bits):
        values = torch.randn(1000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        step = full_scale(values, bits)
        codes = quantize(values, step, bits)
        assert codes.dtype == (torch.int16 if bits <= 16 else torch.int32)
        assert int(codes.abs().max()) == largest_code(bits)
        error = (dequantize(codes, step, torch.float64) - values).abs().max()
        assert float(error / step) <= 0.5 + 1e-6
        smaller_clamps = (values / (step * (1 - 1.0 / largest_code(bits)))).round().abs().max()
        assert float(smaller_clamps) > largest_code(bits)

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_quantising_twice_changes_nothing(self, dtype):
        values = torch.randn(20000, generator=torch.Generator().manual_seed(1), dtype=dtype)
        step = full_scale(values, 16)
        once = dequantize(quantize(values, step, 16), step, dtype)
        assert torch.equal(dequantize(quantize(once, step, 16), step, dtype), once)
        assert torch.equal(quantize(-values, step, 16), -quantize(values, step, 16))

    def test_a_step_for_each_column(self):
        values = torch.tensor([[1.0, 1e-6, 0.0], [-0.5, 3e-6, 0.0]])
        step = full_scale(values, 8, dim=0)
        assert step.shape == (1, 3)
        torch.testing.assert_close(step[0].float(), torch.tensor([1.0 / 127, 3e-6 / 127, 1.0]))
        assert quantize(values, step, 8).tolist() == [[127, 42, 0], [-64, 127, 0]]

    def test_zeros_and_nothing(self):
        zeros = torch.zeros(3, 4)
        step = full_scale(zeros, 16)
        assert step.shape == ()
        assert float(step) == 1.0
        assert torch.equal(dequantize(quantize(zeros, step, 16), step, torch.float32), zeros)
        assert torch.equal(full_scale(torch.zeros(0, 4), 16, dim=0), torch.ones(1, 4).double())
        assert quantize(torch.zeros(0), full_scale(torch.zeros(0), 16), 16).shape == (0,)
        assert float(full_scale(torch.tensor(254.0), 8)) == 2.0

    @pytest.mark.parametrize(
        ("largest", "dtype"),
        [
            (1e-40, torch.float32),  # denormal
            (1.4e-45, torch.float32),  # the least of all
            (5e-324, torch.float64),
            (2e-319, torch.float64),  # its step is denormal and coarse
            (65504.0, torch.float16),
            (3.4e38, torch.float32),
            (1.7e308, torch.float64),
        ],
    )
    def test_extreme_sizes_survive(self, largest, dtype):
        values = torch.tensor([largest, -largest, largest / 2, 0.0], dtype=dtype)
        step = full_scale(values, 16)
        codes = quantize(values, step, 16)
        back = dequantize(codes, step, dtype)
        assert torch.isfinite(back).all()
        assert int(codes[0]) == -int(codes[1]) > 0
        error = (back.double() - values.double()).abs().max()
        assert float(error) <= float(step) * 0.51

    def test_a_sun_over_an_ambient(self):
        """Algorithms of Liu 2004 and Wang 2004: a sun of 1e6 in one texel over ambient 1.

        In Haar coefficients of 64 x 64 texels the ambient is one coefficient of 64 on each face;
        the sun's largest is (1e6 - 1) / 2. Dropping codes below 1024 of 16 bits takes the ambient.
        """
        ambient, sun = torch.full((5,), 64.0), torch.tensor([(1e6 - 1) / 2])
        both = torch.cat([ambient, sun])
        step = full_scale(both, 16)
        codes = quantize(both, step, 16)
        assert codes[:5].tolist() == [4] * 5
        kept = torch.where(codes.abs() < 1024, 0, codes)
        assert torch.equal(dequantize(kept, step, torch.float32)[:5], torch.zeros(5))
        by_band = torch.stack([ambient, sun.expand(5)])
        steps = full_scale(by_band, 16, dim=1)
        codes = quantize(by_band, steps, 16)
        kept = torch.where(codes.abs() < 1024, 0, codes)
        torch.testing.assert_close(dequantize(kept, steps, torch.float32), by_band)

    @pytest.mark.parametrize("bits", [1, 0, 33])
    def test_bits_out_of_range(self, bits):
        with pytest.raises(ValueError, match=r"expected 2\.\.32 bits"):
            quantize(torch.ones(1), 1.0, bits)
        with pytest.raises(ValueError, match=r"expected 2\.\.32 bits"):
            full_scale(torch.ones(1), bits)


class TestStraightThrough:
    def test_values_are_those_of_the_file_and_gradients_those_of_a_clamp(self):
        values = torch.randn(5000, generator=torch.Generator().manual_seed(2)).requires_grad_()
        step = full_scale(values, 8) / 2  # half the range: some values are clamped
        result = straight_through(values, step, 8)
        assert torch.equal(result, dequantize(quantize(values, step, 8), step, torch.float32))
        weights = torch.randn(5000, generator=torch.Generator().manual_seed(3))
        result.backward(weights)
        clamped = values.detach().abs() > 127.5 * step
        assert 0 < int(clamped.sum()) < 2500
        assert torch.equal(values.grad, torch.where(clamped, 0.0, weights))

    def test_the_largest_value_of_a_full_scale_has_a_gradient(self):
        for seed in range(50):
            values = torch.randn(7, generator=torch.Generator().manual_seed(seed)).requires_grad_()
            straight_through(values, full_scale(values, 11), 11).sum().backward()
            assert torch.equal(values.grad, torch.ones(7))


class TestPacking:
    @pytest.mark.parametrize("bits", range(1, 33))
    def test_round_trip_is_exact_and_has_no_gaps(self, bits):
        for count in (0, 1, 7, 8, 9, 1000):
            codes = random_codes(count, bits, seed=count)
            packed = pack(codes, bits)
            assert packed.dtype == torch.uint8
            assert len(packed) == -(-count * bits // 8)
            assert torch.equal(unpack(packed, bits, count), codes)

    @pytest.mark.parametrize("bits", [1, 3, 8, 11, 16, 27, 32])
    def test_against_numpy_bits(self, bits):
        codes = random_codes(101, bits)
        stream = (codes[:, None].numpy() >> np.arange(bits)) & 1
        expected = np.packbits(stream.astype(np.uint8).ravel(), bitorder="little")
        assert np.array_equal(pack(codes, bits).numpy(), expected)

    def test_whole_bytes_are_little_endian_integers(self):
        codes = random_codes(300, 16).to(torch.int16)
        assert pack(codes, 16).numpy().tobytes() == codes.numpy().astype("<i2").tobytes()

    def test_pieces_join_without_seams(self):
        codes = random_codes(2**18 + 13, 11)
        assert torch.equal(unpack(pack(codes, 11), 11, len(codes)), codes)

    def test_refusals(self):
        with pytest.raises(ValueError, match="expected codes that fit 4 bits, got 0 to 8"):
            pack(torch.tensor([0, 8]), 4)
        with pytest.raises(ValueError, match=r"expected 1\.\.32 bits"):
            pack(torch.tensor([0]), 33)
        with pytest.raises(ValueError, match="expected 2 bytes for 3 codes of 4 bits, got 3"):
            unpack(torch.zeros(3, dtype=torch.uint8), 4, 3)


class TestFields:
    @pytest.mark.parametrize("bits", [(11, 11, 10), (16, 16), (32,), (1, 30, 1)])
    def test_round_trip(self, bits):
        codes = torch.stack([random_codes(500, b, seed=i) for i, b in enumerate(bits)], dim=-1)
        words = pack_fields(codes, bits)
        assert words.dtype == torch.int32
        assert words.nbytes == 2000
        assert torch.equal(unpack_fields(words, bits), codes)

    def test_first_field_is_lowest(self):
        words = pack_fields(torch.tensor([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, -1, -1]]))
        assert words.tolist() == [1, 1 << 11, 1 << 22, -1]

    def test_refusals(self):
        with pytest.raises(ValueError, match="expected fields of at least 1 bit and 32 in all"):
            pack_fields(torch.zeros(1, 3, dtype=torch.int64), (11, 11, 11))
        with pytest.raises(ValueError, match="expected 3 codes a word, got 2"):
            pack_fields(torch.zeros(1, 2, dtype=torch.int64))
        with pytest.raises(ValueError, match="expected codes that fit 10 bits"):
            pack_fields(torch.tensor([[0, 0, 512]]))


def test_least_unsigned_takes_the_least_bytes():
    values = torch.tensor([[0, 255]], dtype=torch.int32)
    kinds = [(255, torch.uint8), (256, torch.uint16), (65535, torch.uint16), (65536, torch.int32)]
    for largest, dtype in kinds:
        stored = least_unsigned(values, largest)
        assert stored.dtype == dtype
        assert torch.equal(stored.int(), values)
    assert least_unsigned(torch.tensor([65535]), 65535).int().tolist() == [65535]
    assert least_unsigned(torch.zeros(0, dtype=torch.int64), 3).dtype == torch.uint8
    with pytest.raises(ValueError, match="expected values of 0 to 254 < "):
        least_unsigned(values, 254)
    with pytest.raises(ValueError, match="got -1 to 0"):
        least_unsigned(torch.tensor([-1, 0]), 254)


@pytest.mark.parametrize("count", [0, 1, 1000])
@pytest.mark.parametrize("largest", [0, 1, 127, 128, 40000, 2**31 - 1])
@pytest.mark.parametrize("signed", [False, True])
def test_compressed_integers_come_back(count: int, largest: int, signed: bool):
    generator = torch.Generator().manual_seed(0)
    least = -largest if signed else 0
    values = torch.randint(least, largest + 1, (count,), generator=generator)
    values[:1] = largest
    assert torch.equal(decompress(compress(values, signed=signed), count, signed=signed), values)


def test_compression_comes_near_the_entropy():
    """Of independent normal numbers: log2(deviation) + 2.05 bits each."""
    generator = torch.Generator().manual_seed(0)
    for deviation in (1.0, 4.0):
        codes = (deviation * torch.randn(40000, generator=generator)).round().long()
        bits = 8 * len(compress(codes, signed=True)) / len(codes)
        entropy = 0.5 * math.log2(2 * math.pi * math.e * (deviation**2 + 1 / 12))
        assert entropy - 0.05 < bits < 1.2 * entropy


def test_what_was_not_compressed_is_refused():
    codes = compress(torch.arange(100), signed=False)
    for wrong, count in ((codes, 99), (codes[:-20], 100), (codes, 0), (codes.flip(0), 100)):
        with pytest.raises(ValueError, match="expected"):
            decompress(wrong, count, signed=False)
    with pytest.raises(ValueError, match="expected values"):
        compress(torch.tensor([-1]), signed=False)
