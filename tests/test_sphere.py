"""Cube maps and frames against closed forms."""

import math

import pytest
import torch

from prt_torch.sphere import (
    cubemap_directions,
    cubemap_index,
    cubemap_solid_angles,
    frame_from_normal,
)


@pytest.mark.parametrize("resolution", [1, 2, 7, 32, 128])
def test_solid_angles_sum_to_the_sphere(resolution):
    total = cubemap_solid_angles(resolution, dtype=torch.float64).sum()
    assert float(total) == pytest.approx(4 * math.pi, rel=1e-14)


def test_solid_angles_at_32():
    face = cubemap_solid_angles(32, dtype=torch.float64)[0]
    assert float(face[15, 15]) == pytest.approx(3.89106040e-3, rel=1e-8)
    assert float(face[0, 0]) == pytest.approx(8.00670608e-4, rel=1e-8)


def test_face_axes_are_opengls():
    """The direction of each face's top left texel, in the limit of many texels."""
    corners = cubemap_directions(1024, dtype=torch.float64)[:, 0, 0] * math.sqrt(3)
    expected = [[1, 1, 1], [-1, 1, -1], [-1, 1, -1], [-1, -1, 1], [-1, 1, 1], [1, 1, -1]]
    assert torch.allclose(corners, torch.tensor(expected, dtype=torch.float64), atol=3e-3)


def test_index_inverts_directions():
    directions = cubemap_directions(17)
    index = cubemap_index(directions, 17)
    assert torch.equal(index.flatten(), torch.arange(6 * 17 * 17))


def normals() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    random = torch.randn(500, 3, generator=generator, dtype=torch.float64)
    near_pole = random * torch.tensor([1e-4, 0, 1e-4]) + torch.tensor([0.0, -1, 0])
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    return torch.nn.functional.normalize(torch.cat([random, near_pole, axes]), dim=1)


@pytest.mark.parametrize(("dtype", "limit"), [(torch.float32, 1e-6), (torch.float64, 1e-14)])
def test_frames_are_rotations_that_take_the_normal_to_z(dtype, limit):
    normal = normals().to(dtype)
    frame = frame_from_normal(torch.nn.functional.normalize(normal, dim=1))
    identity = frame @ frame.mT - torch.eye(3, dtype=dtype)
    assert float(identity.abs().max()) < limit * 2
    assert float((torch.linalg.det(frame) - 1).abs().max()) < limit * 4
    z = (frame @ normal[..., None])[..., 0]
    assert torch.allclose(z, torch.tensor([0, 0, 1], dtype=dtype).expand_as(z), atol=limit * 2)


def test_frame_at_the_singular_pole():
    frame = frame_from_normal(torch.tensor([0.0, -1.0, 0.0]))
    assert torch.equal(frame[0], torch.tensor([1.0, 0.0, 0.0]))


def test_frame_gradients_are_finite_at_the_pole_and_right_elsewhere():
    pole = torch.tensor([[0.0, -1.0, 0.0]], requires_grad=True)
    frame_from_normal(pole).sum().backward()
    assert torch.isfinite(pole.grad).all()
    normal = normals()[:5].clone().requires_grad_()
    assert torch.autograd.gradcheck(frame_from_normal, normal)
