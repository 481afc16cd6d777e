"""The scene that needs no file, and the ground under a mesh."""

import math

import numpy as np
import pytest
import torch

from prt_torch.assets import ground_plane, mesh_from_arrays, procedural_scene
from prt_torch.assets.procedural import grid_surface, surface_of_revolution
from prt_torch.errors import InputError


def triangle(points):
    return mesh_from_arrays("t", torch.tensor(points).double(), torch.tensor([[0, 1, 2]]))


def test_scene_is_a_closed_outward_tube_over_a_ground():
    scene = procedural_scene()
    assert 5000 <= scene.num_points <= 8000
    # Open edges and inward faces would be warnings; the ground's border is not one.
    assert scene.warnings == ()
    tube, ground = scene.parts
    knot = mesh_from_arrays(
        "knot", scene.vertices[: tube.num_vertices], scene.faces[: tube.num_faces]
    )
    assert knot.warnings == ()
    corners = knot.vertices[knot.faces]
    volume = torch.linalg.det(corners).sum() / 6
    # Pappus: cross section times length of the curve, to the error of a 24-gon.
    t = torch.arange(2000, dtype=torch.float64) * (2 * math.pi / 2000)
    distance = 1 + 0.45 * torch.cos(3 * t)
    length = torch.sqrt((2 * distance) ** 2 + (3 * 0.45) ** 2).mean() * 2 * math.pi
    section = 24 / 2 * math.sin(2 * math.pi / 24) * 0.24**2
    assert float(volume) == pytest.approx(float(section * length), rel=5e-3)
    assert ground.name == "ground"
    assert scene.vertices[ground.first_vertex :, 1].max() < knot.bounds[0, 1]


def test_tube_shadows_itself():
    """Some points see another strand straight ahead: the scene is worth baking."""
    scene = procedural_scene()
    count = scene.parts[0].num_vertices
    points, normals = scene.vertices[:count:8], scene.normals[:count:8]
    offsets = points[None] - points[:, None]
    ahead = torch.einsum("ijk,ik->ij", offsets, normals)
    distance = offsets.norm(dim=-1)
    blocked = ((ahead > 0.25) & (ahead > 0.95 * distance) & (distance < 1.5)).any(dim=1)
    assert 0.2 < float(blocked.double().mean()) < 0.9


def test_scene_is_smooth_coloured_and_repeatable():
    first, second = procedural_scene(), procedural_scene()
    for field in ("vertices", "faces", "normals", "albedo"):
        assert torch.equal(getattr(first, field), getattr(second, field))
    edges = first.albedo[first.faces[:, 0]] - first.albedo[first.faces[:, 1]]
    assert float(edges.abs().max()) < 0.25
    assert float(first.albedo.min()) > 0.05
    assert float(first.albedo.max()) < 0.95


def test_unknown_scene_lists_the_known():
    with pytest.raises(InputError, match="'teapot' is unknown, expected one of torus_knot"):
        procedural_scene("teapot")


def test_ground_is_centred_below_and_faces_up():
    mesh = triangle([[1.0, 2, 3], [5, 2, 4], [1, 9, 3]])
    plane = ground_plane(mesh, size=3.0, resolution=9, albedo=(0.1, 0.2, 0.3), offset=0.01)
    assert plane.num_points == 81
    np.testing.assert_array_equal(plane.normals, np.tile([0.0, 1, 0], (81, 1)))
    np.testing.assert_allclose(plane.albedo, np.tile([0.1, 0.2, 0.3], (81, 1)))
    height = 2 - 0.01 * math.sqrt(16 + 49 + 1)
    np.testing.assert_allclose(plane.bounds, [[-3, height, -2.5], [9, height, 9.5]], atol=1e-12)
    steps = plane.vertices[:9, 0].diff()
    assert steps.min() > 0
    assert steps[0] > 2 * steps[4]
    assert plane.warnings == ()


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_ground_scales_with_the_mesh(scale):
    points = np.array([[1.0, 2, 3], [5, 2, 4], [1, 9, 3]])
    plane, scaled = (ground_plane(triangle(points * s), resolution=5) for s in (1.0, scale))
    np.testing.assert_allclose(scaled.vertices, plane.vertices * scale, rtol=1e-12)


@pytest.mark.parametrize(
    "option", [{"resolution": 1}, {"size": 0.0}, {"size": math.nan}, {"offset": -1.0}]
)
def test_ground_options_are_checked(option):
    with pytest.raises(InputError, match=f"ground.{next(iter(option))}="):
        ground_plane(triangle([[1.0, 2, 3], [5, 2, 4], [1, 9, 3]]), **option)


def test_texture_coordinates_of_a_cylinder_are_its_angle_and_height():
    """As an image lies on it: u to the right of who looks at its front, v up, outside outside."""
    height = torch.linspace(3.0, 1.0, 5, dtype=torch.float64)
    profile = torch.stack([torch.full_like(height, 2.0), height], dim=-1)
    cylinder = surface_of_revolution("cylinder", profile, 16, repeats=(4.0, 3.0))
    assert cylinder.num_points == 5 * 16  # its seam has no points of its own
    assert cylinder.uv is not None
    corners = cylinder.vertices[cylinder.faces]
    angle = torch.atan2(corners[..., 0], corners[..., 2]) / (2 * math.pi)
    off = cylinder.uv[..., 0] / 4.0 - angle
    np.testing.assert_allclose(off, off.round(), atol=1e-12)
    np.testing.assert_allclose(cylinder.uv[..., 1], 3.0 * (corners[..., 1] - 1.0) / 2.0, atol=1e-12)
    assert float(cylinder.uv[..., 0].diff(dim=1).abs().max()) < 4.0 / 16 + 1e-12
    outward = (cylinder.normals * cylinder.vertices * torch.tensor([1.0, 0.0, 1.0])).sum(-1)
    assert float(outward.min()) > 1.99


def test_vase_has_a_seamless_texture():
    vase = procedural_scene("vase")
    assert vase.uv is not None
    assert vase.warnings == ()
    np.testing.assert_array_equal(vase.uv.amax((0, 1)), [8.0, 8.0])


@pytest.mark.parametrize("shape", [(1, 4), (4, 1)])
def test_a_surface_needs_rows_and_columns(shape):
    with pytest.raises(InputError, match="sheet: expected a grid of at least 2 x 2"):
        grid_surface("sheet", torch.zeros(*shape, 3, dtype=torch.float64))
    with pytest.raises(InputError, match="at least 3 columns"):
        surface_of_revolution("tube", torch.ones(4, 2, dtype=torch.float64), 2)
