"""Reflectance in a file: exact to the bit, and small where there are few colours."""

import pytest
import torch

from prt_torch.representations.palette import (
    packed_reflectance,
    reflectance_bytes,
    take_reflectance,
)


def _same_bits(one: torch.Tensor, other: torch.Tensor) -> bool:
    return one.dtype == other.dtype and torch.equal(one.view(torch.uint8), other.view(torch.uint8))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("num_colours", [1, 2, 300, 5000])
def test_comes_back_to_the_bit(dtype, num_colours):
    generator = torch.Generator().manual_seed(0)
    colours = torch.rand(num_colours, 3, generator=generator).to(dtype)
    reflectance = colours[torch.randint(num_colours, (5000,), generator=generator)]
    packed = packed_reflectance(reflectance)
    assert reflectance_bytes(reflectance) == sum(one.nbytes for one in packed.values())
    assert reflectance_bytes(reflectance) <= reflectance.nbytes
    assert _same_bits(take_reflectance(packed, 5000), reflectance)
    assert packed == {}


def test_signs_of_zeros_and_values_that_are_no_numbers_are_kept():
    odd = torch.tensor([0.0, -0.0, float("nan"), float("inf"), 1e-45])
    reflectance = odd[torch.arange(3000) % 5].view(1000, 3)
    packed = packed_reflectance(reflectance)
    assert "colours" in packed
    assert _same_bits(take_reflectance(packed, 1000), reflectance)


def test_two_objects_take_next_to_nothing():
    reflectance = torch.tensor([[0.8, 0.2, 0.1], [0.5, 0.5, 0.5]])[
        (torch.arange(9000) > 6000).long()
    ]
    assert reflectance_bytes(reflectance) < 100


def test_a_colour_for_all_and_colours_of_each_point_stay_as_they_are():
    for reflectance in (torch.rand(1, 3), torch.rand(50, 3)):
        assert list(packed_reflectance(reflectance)) == ["reflectance"]
        assert _same_bits(take_reflectance(packed_reflectance(reflectance), 50), reflectance)


def test_no_points():
    assert take_reflectance(packed_reflectance(torch.zeros(0, 3)), 0).shape == (0, 3)


def test_a_damaged_stream_is_told():
    packed = packed_reflectance(torch.tensor([[0.1, 0.2, 0.3], [0.3, 0.2, 0.1]]).repeat(200, 1))
    packed["colour_of_point"] = packed["colour_of_point"][:-3]
    with pytest.raises(ValueError, match=r"compressed codes|expected 400 codes"):
        take_reflectance(packed, 400)
