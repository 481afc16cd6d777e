"""Maps over the hemisphere: against formulas, naive loops and torch's own bilinear sampling."""

import math
from typing import get_args

import pytest
import torch
from tolerances import ROUNDING

from prt_torch.bases.brdf_error import even_directions
from prt_torch.bases.hemisphere_map import HemisphereMap, Mapping

MAPPINGS = get_args(Mapping)
AWKWARD = [
    [0.0, 0.0, 1.0],
    [1.0, 0.0, 0.0],
    [-1.0, 0.0, 0.0],
    [0.0, -1.0, 0.0],
    [0.0, 0.0, -1.0],
    [0.6, 0.6, 0.28**0.5],
    [0.6, -0.6, 0.28**0.5],
    [0.8, 0.0, -0.6],
    [-0.8, 0.0, 0.6],
    [-1.0, -0.0, 0.0],
]


def even(count: int = 500, seed: int = 0) -> torch.Tensor:
    return even_directions(count, torch.Generator().manual_seed(seed))


def naive_lookup(hemisphere: HemisphereMap, texels: torch.Tensor, direction: torch.Tensor) -> float:
    """One bilinear value from a square image by its definition."""
    size = hemisphere.resolution
    image = texels.reshape(size, size).tolist()
    column, row = (hemisphere.coordinates(direction) * size - 0.5).tolist()
    total = 0.0
    for i in (math.floor(row), math.floor(row) + 1):
        for j in (math.floor(column), math.floor(column) + 1):
            weight = (1 - abs(row - i)) * (1 - abs(column - j))
            inside = j % size if hemisphere.mapping == "polar" else min(max(j, 0), size - 1)
            total += weight * image[min(max(i, 0), size - 1)][inside]
    return total


@pytest.mark.parametrize("mapping", MAPPINGS)
def test_round_trips(mapping):
    hemisphere = HemisphereMap(mapping, 9)
    directions = even()
    coordinates = hemisphere.coordinates(directions)
    assert float(coordinates.min()) >= 0
    assert float(coordinates.max()) <= 1
    back, inside = hemisphere.directions(coordinates)
    assert bool(inside.all())
    assert torch.allclose(back, directions, atol=1e-9)
    generator = torch.Generator().manual_seed(1)
    coordinates = torch.rand(500, 2, generator=generator, dtype=torch.float64)
    directions, inside = hemisphere.directions(coordinates)
    assert torch.allclose(directions.norm(dim=1), torch.ones(500, dtype=torch.float64))
    again = hemisphere.coordinates(directions)[inside]
    assert torch.allclose(again, coordinates[inside], atol=1e-9)
    assert bool(inside.all()) == (mapping in ("concentric", "polar"))


def test_coordinates_by_the_formulas():
    directions = even()
    x, y, z = directions.unbind(1)
    expected = {
        "parabolic": (x / (1 + z) / 2 + 0.5, y / (1 + z) / 2 + 0.5),
        "orthographic": (x / 2 + 0.5, y / 2 + 0.5),
        "polar": (torch.atan2(y, x) / (2 * math.pi) + 0.5, (1 - z).sqrt()),
    }
    for mapping, columns in expected.items():
        found = HemisphereMap(mapping).coordinates(directions)
        assert torch.allclose(found, torch.stack(columns, 1), atol=1e-12)


def test_concentric_rings_keep_areas():
    # A ring of the square, max(|u|, |v|) < r, holds the share r² of it: 1 - z = r² above it.
    coordinates = HemisphereMap("concentric").coordinates(even(20_000))
    ring = (2 * coordinates - 1).abs().amax(1)
    assert torch.allclose(ring.square(), 1 - even(20_000)[:, 2], atol=1e-9)
    # Inside a ring azimuths are spread evenly over its four sides.
    quarter = ((coordinates[:, 0] - 0.5) > (coordinates[:, 1] - 0.5).abs()).double().mean()
    assert float(quarter) == pytest.approx(0.25, abs=4 * math.sqrt(0.25 * 0.75 / 20_000))


def test_texels_with_a_direction():
    # Algorithms of the papers: 812 of 32 x 32 and 1804 of 48 x 48 centres lie in the disk.
    assert int(HemisphereMap("parabolic", 32).centres()[1].sum()) == 812
    assert int(HemisphereMap("orthographic", 48).centres()[1].sum()) == 1804
    directions, inside = HemisphereMap("parabolic", 32).centres()
    assert torch.equal(directions[0], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    assert not bool(inside[0])


@pytest.mark.parametrize("mapping", MAPPINGS)
def test_solid_angles(mapping):
    directions, solid_angles = HemisphereMap(mapping, 48).nodes(4)
    z = directions[:, 2]
    assert float(solid_angles.sum()) == pytest.approx(2 * math.pi, rel=1e-12)
    # Solid angle per area grows without limit at the rim of the orthographic disk: what the last
    # sub-texels miss falls with the root of their number alone.
    error = 8e-3 if mapping == "orthographic" else 5e-4
    for power in (1, 2, 4):
        integral = float((solid_angles * z**power).sum())
        assert integral == pytest.approx(2 * math.pi / (power + 1), rel=error)
    moment = float((solid_angles * directions[:, 0] * directions[:, 1]).sum())
    assert moment == pytest.approx(0.0, abs=1e-9)
    if mapping == "concentric":
        assert torch.allclose(solid_angles, solid_angles.mean(), rtol=1e-12)


@pytest.mark.parametrize("mapping", MAPPINGS)
def test_lookups_are_bilinear(mapping):
    hemisphere = HemisphereMap(mapping, 5)
    texels = torch.randn(1, 25, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    directions = torch.cat([even(300), torch.tensor(AWKWARD, dtype=torch.float64)])
    indices, weights = hemisphere.taps(directions)
    assert torch.allclose(weights.sum(1), torch.ones(len(directions), dtype=torch.float64))
    assert float(weights.min()) >= 0
    assert int(indices.min()) >= 0
    assert int(indices.max()) < 25
    found = hemisphere.lookup(texels, directions)[:, 0]
    for value, direction in zip(found, directions, strict=True):
        assert float(value) == pytest.approx(naive_lookup(hemisphere, texels, direction), abs=1e-12)


@pytest.mark.parametrize("mapping", MAPPINGS)
def test_lookups_as_torch_samples_them(mapping):
    hemisphere = HemisphereMap(mapping, 7)
    texels = torch.randn(3, 49, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    directions = even()
    image = texels.view(1, 3, 7, 7)
    grid = 2 * hemisphere.coordinates(directions) - 1
    if mapping == "polar":  # torch does not wrap: one more column on either side
        image = torch.cat([image[..., -1:], image, image[..., :1]], -1)
        grid = grid * grid.new_tensor([7 / 9, 1.0])
    sampled = torch.nn.functional.grid_sample(
        image, grid[None, None], padding_mode="border", align_corners=False
    )
    expected = sampled[0, :, 0].mT
    assert torch.allclose(hemisphere.lookup(texels, directions), expected, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("mapping", MAPPINGS)
def test_cells_of_padded_texels_are_the_taps(mapping, dtype):
    hemisphere = HemisphereMap(mapping, 6)
    generator = torch.Generator().manual_seed(4)
    texels = torch.randn(2, 36, generator=generator, dtype=torch.float64).to(dtype)
    directions = even().to(dtype)
    cell, right, lower = hemisphere.cells(*directions.unbind(-1))
    padded = hemisphere.pad(texels).mT
    assert padded.shape == (42, 2)
    top = padded[cell] * (1 - right)[:, None] + padded[cell + 1] * right[:, None]
    bottom = padded[cell + 7] * (1 - right)[:, None] + padded[cell + 8] * right[:, None]
    mixed = top * (1 - lower)[:, None] + bottom * lower[:, None]
    found = hemisphere.lookup(texels, directions)
    assert float((mixed - found).abs().max()) <= ROUNDING[dtype] * float(texels.abs().max())


@pytest.mark.parametrize("mapping", MAPPINGS)
def test_seams(mapping):
    """Lookups do not jump where azimuths wrap around, nor where rings turn a corner."""
    hemisphere = HemisphereMap(mapping, 8)
    texels = torch.randn(4, 64, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    azimuths = torch.arange(8, dtype=torch.float64)[:, None] * (math.pi / 4)
    azimuths = azimuths + torch.tensor([-1e-7, 1e-7], dtype=torch.float64)
    for level in (0.05, 0.5, 1.0):
        z = torch.full_like(azimuths, math.sqrt(1 - level * level))
        directions = torch.stack([level * azimuths.cos(), level * azimuths.sin(), z], -1)
        before, after = hemisphere.lookup(texels, directions).unbind(1)
        assert torch.allclose(before, after, atol=1e-5)


def test_views_below_the_horizon_are_taken_to_it():
    hemisphere = HemisphereMap("parabolic", 8)
    below = torch.tensor([0.48, -0.64, -0.6], dtype=torch.float64)
    level = torch.tensor([0.6, -0.8, 0.0], dtype=torch.float64)
    assert torch.allclose(hemisphere.coordinates(below), hemisphere.coordinates(level))


@pytest.mark.parametrize("mapping", MAPPINGS)
def test_gradients(mapping):
    hemisphere = HemisphereMap(mapping, 5)
    texels = torch.randn(2, 25, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    directions = even(20, seed=7).requires_grad_()
    assert torch.autograd.gradcheck(hemisphere.coordinates, directions)
    free = texels.clone().requires_grad_()
    assert torch.autograd.gradcheck(hemisphere.lookup, (free, directions))
    awkward = torch.tensor(AWKWARD, dtype=torch.float64, requires_grad=True)
    for values in (hemisphere.coordinates(awkward), hemisphere.lookup(texels, awkward)):
        (gradient,) = torch.autograd.grad(values.square().sum(), awkward)
        assert bool(torch.isfinite(gradient).all())


@pytest.mark.usefixtures("without_type_checker")
def test_bad_arguments():
    with pytest.raises(ValueError, match=r"expected a mapping of .*parabolic.*, got 'cube'"):
        HemisphereMap("cube")
    for resolution in (1, 513):
        with pytest.raises(ValueError, match=f"expected 2 to 512 .*, got {resolution}"):
            HemisphereMap("polar", resolution)
