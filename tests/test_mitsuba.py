"""Direct light against Mitsuba 3, an independent renderer, by a z-test over many points.

Needs the test extra ``check`` and the real meshes; skipped with a reason elsewhere.
"""

import math

import numpy as np
import pytest
import torch

from prt_torch.assets import Environment, concatenate, ground_plane, load_mesh
from prt_torch.baking import bake
from prt_torch.bases import SphericalHarmonics, sh
from prt_torch.evaluate import dense_radiance

mi = pytest.importorskip("mitsuba", reason="mitsuba is not installed (pip install '.[check]')")

POINTS, SAMPLES = 120, 4096
BIAS = 0.004  # of the mean radiance: what 128 x 128 rays a cube face leave


def smooth_light() -> tuple[torch.Tensor, np.ndarray]:
    """A positive light of order 4 by its coefficients and as a lat-long image, centre -z."""
    generator = torch.Generator().manual_seed(0)
    coefficients = 0.15 * torch.randn(16, 3, generator=generator, dtype=torch.float64)
    coefficients[0] = torch.tensor([4.0, 3.0, 2.0])
    rows = 256
    polar = (torch.arange(rows, dtype=torch.float64) + 0.5) * (math.pi / rows)
    azimuth = (torch.arange(2 * rows, dtype=torch.float64) + 0.5) * (math.pi / rows) - math.pi
    polar, azimuth = torch.meshgrid(polar, azimuth, indexing="ij")
    directions = torch.stack(
        [polar.sin() * azimuth.sin(), polar.cos(), -polar.sin() * azimuth.cos()], dim=-1
    )
    image = (sh.evaluate(directions, 4) @ coefficients).float().numpy()
    assert image.min() > 0
    return coefficients, image


def mitsuba_scene(mesh, image):
    shape = mi.Mesh("scene", mesh.num_points, mesh.num_faces)
    params = mi.traverse(shape)
    params["vertex_positions"] = mesh.vertices.float().numpy().ravel()
    params["faces"] = mesh.faces.int().numpy().ravel()
    params.update()
    # Its image starts at -z where ours has its centre: half a turn about the vertical.
    turn = mi.ScalarTransform4f().rotate([0, 1, 0], 180)
    light = {"type": "envmap", "bitmap": mi.Bitmap(image), "to_world": turn}
    return mi.load_dict({"type": "scene", "shape": shape, "light": light})


def estimate(scene, position, normal, generator) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard error of albedo-free diffuse radiance at one point."""
    interaction = mi.SurfaceInteraction3f()
    interaction.p = mi.Point3f(*position)
    interaction.n = mi.Normal3f(*normal)
    interaction.sh_frame = mi.Frame3f(mi.Vector3f(*normal))
    values = np.zeros((SAMPLES, 3))
    for index, sample in enumerate(generator.random((SAMPLES, 2))):
        found, weight = scene.sample_emitter_direction(interaction, mi.Point2f(*sample), True)
        cosine = float(np.dot(np.array(found.d), normal))
        if cosine > 0:
            values[index] = np.array(weight) * cosine / math.pi
    return values.mean(0), values.std(0, ddof=1) / math.sqrt(SAMPLES)


@pytest.mark.slow
def test_direct_light_agrees(assets):
    mi.set_variant("scalar_rgb")
    monkey = load_mesh(assets / "meshes" / "suzanne.obj", albedo=(1.0, 1.0, 1.0))
    ground = ground_plane(monkey, albedo=(1.0, 1.0, 1.0), resolution=12)
    mesh = concatenate([monkey, ground], "suzanne")
    coefficients, image = smooth_light()
    ours = dense_radiance(
        bake(mesh, light_basis=SphericalHarmonics(4)), coefficients[None].float()
    )[0, 0].numpy()
    # The same light through our own image projection: checks orientation end to end.
    projected = SphericalHarmonics(4).project(
        Environment("smooth", torch.from_numpy(image), "latlong")
    )
    assert torch.allclose(projected, coefficients, atol=2e-3)
    scene = mitsuba_scene(mesh, image)
    generator = np.random.default_rng(0)
    chosen = generator.choice(mesh.num_points, POINTS, replace=False)
    normals = mesh.normals.numpy()
    scores = []
    for point in chosen:
        offset = mesh.vertices[point].numpy() + 1e-4 * normals[point]
        mean, error = estimate(scene, offset, normals[point], generator)
        spread = np.sqrt(error**2 + (BIAS * ours.mean(0)) ** 2)
        scores.append((ours[point] - mean) / spread)
    scores = np.array(scores)
    # Bonferroni over 360 two-sided tests at 0.1 % in all: |z| < 4.7.
    assert np.abs(scores).max() < 4.7
    assert np.abs(scores.mean(0)).max() < 4.7 / math.sqrt(POINTS)
