"""Bending, twisting and frames of deformed surfaces, against known answers and decompositions."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import polar
from tolerances import ROUNDING

from prt_torch.assets import (
    bend,
    concatenate,
    deformed,
    deformed_frames,
    load_mesh,
    mesh_from_arrays,
    procedural_scene,
    twist,
)
from prt_torch.errors import InputError
from prt_torch.sphere import frame_from_normal

EXACT = ROUNDING[torch.float64]


def grid(rows=7, cols=5):
    """A flat sheet in the plane z = 0, unevenly divided, its normal +z."""
    y, x = torch.meshgrid(
        torch.linspace(0, 2, rows, dtype=torch.float64) ** 1.2,
        torch.linspace(-0.5, 0.5, cols, dtype=torch.float64) ** 3 * 4,
        indexing="ij",
    )
    vertices = torch.stack([x, y, torch.zeros_like(x)], dim=-1).reshape(-1, 3)
    corner = (torch.arange(rows - 1)[:, None] * cols + torch.arange(cols - 1)).reshape(-1)
    faces = torch.cat(
        [
            torch.stack([corner, corner + 1, corner + cols + 1], dim=1),
            torch.stack([corner, corner + cols + 1, corner + cols], dim=1),
        ]
    )
    return mesh_from_arrays("grid", vertices, faces)


def torus(num_around, num_along, normals=None):
    """A ring of rings with exact normals."""
    u = torch.arange(num_around, dtype=torch.float64) * (2 * math.pi / num_around)
    v = torch.arange(num_along, dtype=torch.float64) * (2 * math.pi / num_along)
    u, v = torch.meshgrid(u, v, indexing="ij")
    normal = torch.stack([v.cos() * u.cos(), v.sin(), -v.cos() * u.sin()], dim=-1).reshape(-1, 3)
    centre = torch.stack([u.cos(), torch.zeros_like(u), -u.sin()], dim=-1).reshape(-1, 3)
    a, b = torch.meshgrid(torch.arange(num_around), torch.arange(num_along), indexing="ij")
    right, up = (a + 1) % num_around * num_along, (b + 1) % num_along
    here = a * num_along
    faces = torch.stack(
        [here + b, right + b, right + up, here + b, right + up, here + up], dim=-1
    ).reshape(-1, 3)
    return mesh_from_arrays("torus", centre + 0.4 * normal, faces, normals=normal)


def rotation(seed=0):
    generator = torch.Generator().manual_seed(seed)
    matrix, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=generator))
    return matrix * matrix.det()


def knot():
    return procedural_scene()


def plain_bend(points, angle, extent, low, middle):
    """A second implementation, about a centre of curvature, which knows no angle 0."""
    radius = extent / angle
    theta = angle * (points[:, 1] - low) / extent
    distance = radius - (points[:, 0] - middle[0])
    x = middle[0] + radius - distance * np.cos(theta)
    return np.stack([x, low + distance * np.sin(theta), points[:, 2]], axis=1)


def plain_twist(points, angle, extent, low, middle):
    theta = angle * (points[:, 1] - low) / extent
    arm = (points[:, 0] - middle[0]) - 1j * (points[:, 2] - middle[2])
    arm = arm * np.exp(1j * theta)
    return np.stack([middle[0] + arm.real, points[:, 1], middle[2] - arm.imag], axis=1)


def plain(deform, vertices, angle, at=None):
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    function = plain_bend if deform is bend else plain_twist
    at = vertices if at is None else at
    return function(at, angle, high[1] - low[1], low[1], (low + high) / 2)


def plain_jacobians(deform, vertices, angle, step=1e-6):
    columns = []
    for axis in np.eye(3) * step:
        ahead, behind = (plain(deform, vertices, angle, vertices + s * axis) for s in (1, -1))
        columns.append((ahead - behind) / (2 * step))
    return np.stack(columns, axis=-1)


def assert_orthonormal(frames):
    product = frames @ frames.mT
    torch.testing.assert_close(
        product, torch.eye(3, dtype=frames.dtype).expand_as(product), atol=EXACT, rtol=0
    )
    assert (torch.linalg.det(frames) > 0).all()


class TestBendAndTwist:
    def test_the_line_becomes_an_arc_of_its_length(self):
        line = torch.zeros(101, 3, dtype=torch.float64)
        line[:, 1] = torch.linspace(3, 5, 101, dtype=torch.float64)
        bent = bend(line, math.pi / 2)
        radius = 2 / (math.pi / 2)
        expected = [radius, 3 + radius, 0]
        np.testing.assert_allclose(bent[-1], expected, atol=1e-14)
        np.testing.assert_allclose(bent[0], line[0], atol=0)
        centre = torch.tensor([radius, 3.0, 0], dtype=torch.float64)
        np.testing.assert_allclose((bent - centre).norm(dim=1), radius, atol=1e-14)
        steps = (bent[1:] - bent[:-1]).norm(dim=1)
        np.testing.assert_allclose(steps, steps[0], rtol=1e-10)

    @pytest.mark.parametrize("angle", [-2.0, 1e-3, 1.2, 9.0])
    @pytest.mark.parametrize("deform", [bend, twist])
    def test_a_second_implementation(self, deform, angle):
        vertices = knot().vertices
        expected = plain(deform, vertices.numpy(), angle)
        np.testing.assert_allclose(deform(vertices, angle), expected, atol=1e-11)

    def test_a_slab_bent_by_a_half_turn(self):
        # Height 2 turns by pi: points 0.1 inside lie on a radius smaller by 0.1.
        slab = torch.tensor([[0.1, 2.0, 0.3], [-0.1, 2, -0.3], [0.1, 0, 0], [-0.1, 0, 0]])
        bent = bend(slab.double(), math.pi)
        radius = 2 / math.pi
        np.testing.assert_allclose(bent[0], [2 * radius - 0.1, 0, 0.3], atol=1e-7)
        np.testing.assert_allclose(bent[1], [2 * radius + 0.1, 0, -0.3], atol=1e-7)

    def test_twisting_keeps_heights_and_distances(self):
        vertices = torch.rand(
            50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
        )
        vertices[0], vertices[1] = 0.0, 1.0  # the corners of its box
        twisted = twist(vertices, math.pi / 2)
        torch.testing.assert_close(twisted[:, 1], vertices[:, 1], atol=0, rtol=0)
        middle = torch.tensor([0.5, 0.0, 0.5], dtype=torch.float64)
        flat = torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)
        before, after = (((each - middle) * flat).norm(dim=1) for each in (vertices, twisted))
        torch.testing.assert_close(before, after)
        # The top turns counter-clockwise seen from above: +x goes to -z.
        np.testing.assert_allclose(twisted[1], [1, 1, 0], atol=1e-15)
        np.testing.assert_allclose(twisted[0], [0, 0, 0], atol=1e-15)

    @pytest.mark.parametrize("deform", [bend, twist])
    def test_nothing_changes_at_zero(self, deform):
        vertices = knot().vertices
        assert torch.equal(deform(vertices, 0.0), vertices)
        nearby = deform(vertices, torch.tensor([1e-300, 1e-9], dtype=torch.float64))
        assert (nearby - vertices).abs().max() < 1e-8
        angle = torch.zeros((), dtype=torch.float64, requires_grad=True)
        (deform(vertices, angle) ** 2).sum().backward()
        h = 1e-6
        numeric = sum(s * float((deform(vertices, s * h) ** 2).sum()) for s in (1, -1)) / (2 * h)
        assert float(angle.grad) == pytest.approx(numeric, rel=1e-5)

    @pytest.mark.parametrize("deform", [bend, twist])
    def test_poses_are_batched_and_directions_are_free(self, deform):
        vertices, turn = knot().vertices[::50], rotation(1)
        angles = torch.tensor([[0.3, -2.0], [0.0, 7.0]], dtype=torch.float64)
        together = deform(vertices, angles, along=(0.2, -1.0, 0.5))
        for index in np.ndindex(2, 2):
            alone = deform(vertices, float(angles[index]), along=(0.4, -2.0, 1.0))
            torch.testing.assert_close(together[index], alone, atol=1e-13, rtol=0)
        # Along a turned axis it is the same deformation of a turned mesh.
        along, toward = turn[:, 1], {"toward": turn[:, 0]} if deform is bend else {}
        line = torch.zeros(2, 3, dtype=torch.float64)
        line[1, 1] = 2.0
        torch.testing.assert_close(
            deform(line @ turn.T, 1.3, along=along, **toward), deform(line, 1.3) @ turn.T
        )

    @pytest.mark.parametrize("deform", [bend, twist])
    @pytest.mark.parametrize("angle", [0.0, 1e-9, 1.1])
    def test_gradients(self, deform, angle):
        generator = torch.Generator().manual_seed(2)
        vertices = torch.randn(6, 3, dtype=torch.float64, generator=generator, requires_grad=True)
        angles = torch.tensor([angle, 0.4], dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(deform, (vertices, angles))

    @pytest.mark.parametrize("deform", [bend, twist])
    def test_a_mesh_without_extent_stays(self, deform):
        flat = torch.rand(4, 3, dtype=torch.float64)
        flat[:, 1] = 0.7
        torch.testing.assert_close(deform(flat, 1.0), flat)

    @pytest.mark.parametrize(
        "directions", [{"along": (0.0, 0.0, 0.0)}, {"along": (0.0, math.nan, 0.0)}]
    )
    def test_directions_need_a_length(self, directions):
        with pytest.raises(ValueError, match="direction of some length"):
            bend(grid().vertices, 1.0, **directions)

    def test_bending_along_the_line_is_refused(self):
        with pytest.raises(ValueError, match="away from the line"):
            bend(grid().vertices, 1.0, toward=(0.0, 2.0, 0.0))


class TestFrames:
    @pytest.mark.parametrize("scale", [1e-12, 1.0, 1e10])
    def test_rest_and_rigid_motions_are_exact(self, scale):
        generator = torch.Generator().manual_seed(3)
        mesh = knot()
        # Normals and tangents that are not those of the faces keep their places.
        normals = mesh.normals + 0.3 * torch.randn(mesh.normals.shape, generator=generator)
        mesh = mesh_from_arrays("knot", mesh.vertices * scale, mesh.faces, normals=normals)
        frames = frame_from_normal(mesh.normals)
        torch.testing.assert_close(deformed_frames(mesh, mesh.vertices), frames, atol=1e-12, rtol=0)
        turn = rotation()
        moved = 3 * mesh.vertices @ turn.T + scale
        turned = deformed_frames(mesh, torch.stack([mesh.vertices, moved]))
        torch.testing.assert_close(turned[0], frames, atol=1e-12, rtol=0)
        torch.testing.assert_close(turned[1], frames @ turn.T, atol=1e-10, rtol=0)
        own = torch.randn(len(frames), 3, 3, dtype=torch.float64, generator=generator)
        torch.testing.assert_close(
            deformed_frames(mesh, moved, own), own @ turn.T, atol=1e-9, rtol=0
        )

    def test_half_turns_have_no_singular_axis(self):
        mesh = knot()
        for axis in range(3):
            turn = -torch.eye(3, dtype=torch.float64)
            turn[axis, axis] = 1.0
            found = deformed_frames(mesh, mesh.vertices @ turn.T)
            torch.testing.assert_close(
                found, frame_from_normal(mesh.normals) @ turn.T, atol=1e-12, rtol=0
            )

    def test_a_stretched_and_sheared_sheet_turns_by_the_polar_factor(self):
        mesh = grid()
        generator = np.random.default_rng(4)
        for _ in range(5):
            linear = np.eye(2) + 0.8 * generator.normal(size=(2, 2))
            if np.linalg.det(linear) < 0:
                linear[:, 0] *= -1
            vertices = mesh.vertices.clone()
            vertices[:, :2] = vertices[:, :2] @ torch.from_numpy(linear).T
            turn = np.eye(3)
            turn[:2, :2] = polar(linear)[0]
            expected = frame_from_normal(mesh.normals) @ torch.from_numpy(turn).T
            torch.testing.assert_close(deformed_frames(mesh, vertices), expected, atol=1e-5, rtol=0)

    @pytest.mark.parametrize("deform", [bend, twist])
    def test_a_fine_mesh_approaches_the_turn_of_the_deformation(self, deform):
        errors = []
        for count in (16, 32, 64):
            mesh = torus(2 * count, count)
            frames = frame_from_normal(mesh.normals)
            found = deformed_frames(mesh, deform(mesh.vertices, 0.1))
            jacobians = plain_jacobians(deform, mesh.vertices.numpy(), 0.1)
            tangents = jacobians @ frames[:, :2].mT.numpy()
            # The closest pair of orthonormal tangents.
            left, _, right = np.linalg.svd(tangents, full_matrices=False)
            expected = np.swapaxes(left @ right, 1, 2)
            errors.append(np.abs(found[:, :2].numpy() - expected).max())
        # Of second order in the size of faces.
        assert errors[-1] < 6e-4
        assert errors[0] / errors[1] > 3
        assert errors[1] / errors[2] > 3

    def test_gradients(self):
        mesh = torus(4, 3)
        generator = torch.Generator().manual_seed(5)
        noise = 0.1 * torch.randn(mesh.vertices.shape, dtype=torch.float64, generator=generator)
        moved = (mesh.vertices @ rotation(2).T + noise).requires_grad_()
        assert torch.autograd.gradcheck(lambda v: deformed_frames(mesh, v), (moved,))

    def test_damaged_faces_are_finite_and_points_without_a_surface_keep_their_frame(self):
        sheet = grid()
        extra = torch.tensor([[9.0, 9, 9], [0, 0, 1], [1, 0, 1], [2, 0, 1]], dtype=torch.float64)
        vertices = torch.cat([sheet.vertices, extra, sheet.vertices[:1]])
        count = sheet.num_points
        faces = torch.cat(
            [
                sheet.faces,
                torch.tensor([[count + 1, count + 2, count + 3]]),  # collinear
                torch.tensor([[0, 0, 1], [count + 4, 1, 6]]),  # a repeated corner, a repeated point
            ]
        )
        mesh = mesh_from_arrays("damaged", vertices, faces)
        generator = torch.Generator().manual_seed(6)
        rest = frame_from_normal(mesh.normals)
        noise = 0.2 * torch.randn(vertices.shape, dtype=torch.float64, generator=generator)
        poses = [vertices + noise, torch.zeros_like(vertices), vertices * torch.tensor([1.0, 0, 0])]
        moved = torch.stack(poses).requires_grad_()
        frames = deformed_frames(mesh, moved)
        frames.square().mul(torch.arange(9.0).view(3, 3)).sum().backward()
        assert torch.isfinite(frames).all()
        assert torch.isfinite(moved.grad).all()
        torch.testing.assert_close(frames[0, count : count + 4], rest[count : count + 4])
        # A surface that collapses has no direction to turn to.
        torch.testing.assert_close(frames[1], rest, atol=1e-15, rtol=0)
        torch.testing.assert_close(frames[2], rest, atol=1e-15, rtol=0)
        assert_orthonormal(frames[0, :count])

    def test_a_seam_stays_closed(self):
        """Points that were split at a seam turn as if they had not been."""
        whole = torus(16, 8)
        split = whole.faces.clone()
        side = whole.vertices[whole.faces][:, :, 2].mean(dim=1) > 0
        split[side] += whole.num_points
        seam = mesh_from_arrays(
            "seam", whole.vertices.repeat(2, 1), split, normals=whole.normals.repeat(2, 1)
        )
        vertices = twist(whole.vertices, 1.0)
        expected = deformed_frames(whole, vertices)
        found = deformed_frames(seam, vertices.repeat(2, 1))
        used = torch.unique(split)
        torch.testing.assert_close(found[used], expected.repeat(2, 1, 1)[used], atol=EXACT, rtol=0)

    def test_single_precision_poses(self):
        mesh = knot()
        vertices = bend(mesh.vertices, 1.0)
        found = deformed_frames(mesh, vertices.float())
        assert found.dtype == torch.float32
        torch.testing.assert_close(
            found.double(), deformed_frames(mesh, vertices), atol=3e-4, rtol=0
        )

    def test_shapes_are_checked(self):
        with pytest.raises(ValueError, match="expected vertices of shape"):
            deformed_frames(grid(), torch.zeros(5, 3, dtype=torch.float64))


class TestDeformed:
    def test_the_rest_pose_is_the_mesh(self):
        mesh = concatenate([knot(), torus(8, 6)], "both")
        same = deformed(mesh, mesh.vertices)
        torch.testing.assert_close(same.normals, mesh.normals, atol=1e-12, rtol=0)
        assert torch.equal(same.faces, mesh.faces)
        assert torch.equal(same.albedo, mesh.albedo)
        assert same.parts == mesh.parts
        assert same.warnings == mesh.warnings

    def test_normals_are_those_of_a_mesh_made_of_the_moved_points(self):
        # Where the mesh's normals are those of its faces, the deformed mesh's are so as well.
        mesh = grid()
        vertices = bend(mesh.vertices, 1.5, toward=(0.0, 0.0, 1.0))
        made = mesh_from_arrays("made", vertices, mesh.faces)
        torch.testing.assert_close(
            deformed(mesh, vertices).normals, made.normals, atol=1e-12, rtol=0
        )

    def test_positions_must_be_finite(self):
        mesh = grid()
        vertices = mesh.vertices.clone()
        vertices[3, 1] = math.nan
        with pytest.raises(
            InputError, match=r"grid: 1 of 35 deformed vertices are not finite.* vertex 3"
        ):
            deformed(mesh, vertices)


def test_real_mesh(assets):
    mesh = load_mesh(assets / "meshes" / "suzanne.obj")
    turn = rotation(3)
    frames = frame_from_normal(mesh.normals)
    found = deformed_frames(mesh, mesh.vertices @ turn.T)
    # A doubled face has two sides at its one point, so its faces give no direction.
    turned = torch.arange(mesh.num_points) != 137
    torch.testing.assert_close(found[turned], (frames @ turn.T)[turned], atol=1e-10, rtol=0)
    bent = deformed_frames(mesh, bend(mesh.vertices, 2.0))
    assert_orthonormal(bent)
