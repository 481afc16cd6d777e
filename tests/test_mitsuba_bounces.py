"""Diffuse interreflection against Mitsuba 3's path tracer, by a z-test over many points.

Scenes are made of facets with their own vertices and normals, as the renderer sees them, and
radiance is compared at the middle of facets. Needs the test extra ``check``.
"""

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
import trimesh
from smooth_light import smooth_light

from prt_torch.assets import mesh_from_arrays
from prt_torch.assets.mesh import Mesh
from prt_torch.baking import project_diffuse, trace_visibility
from prt_torch.baking.interreflection import interreflect
from prt_torch.baking.reflection import diffuse_reflection
from prt_torch.bases import SphericalHarmonics

mi = pytest.importorskip("mitsuba", reason="mitsuba is not installed (pip install '.[check]')")

ORDER, POINTS, SAMPLES = 3, 60, 8192
BIAS = 0.01  # of a point's radiance: facets that carry linear radiance, and one ray a texel
LARGEST = 4.6  # |z| by Bonferroni, 180 two-sided tests at 0.1 % in all


@dataclass
class Wall:
    """Flat facets of one colour, each with three vertices of its own."""

    corners: np.ndarray  # "facets 3 3"
    albedo: tuple[float, float, float]


def grid(a, b, c, d, steps: int) -> np.ndarray:
    """Facets of a flat quadrilateral, its corners counter-clockwise."""
    a, b, c, d = (np.asarray(corner, float) for corner in (a, b, c, d))
    line = np.linspace(0, 1, steps + 1)
    u, v = (axis[..., None] for axis in np.meshgrid(line, line))
    places = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * d + u * c)
    p, q, r, s = places[:-1, :-1], places[:-1, 1:], places[1:, 1:], places[1:, :-1]
    facets = np.stack([np.stack([p, q, r], -2), np.stack([p, r, s], -2)])
    return facets.reshape(-1, 3, 3)


def open_box() -> list[Wall]:
    """A box without a lid, a red and a green wall, and a plate that floats in it.

    Its walls lean outwards: where they meet at right angles, vertices would lie in the plane of
    the next wall, and whether that hides what is behind it is rounding.
    """
    turns = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]], float)
    low = [np.array([0.7 * x, -1.0, 0.7 * z]) for x, z in turns]
    high = [np.array([x, 0.5, z]) for x, z in turns]
    front, right, back, left = (
        grid(low[(i + 1) % 4], low[i], high[i], high[(i + 1) % 4], 12) for i in range(4)
    )
    plate = grid([-0.2, -0.1, 0.5], [0.4, 0.0, 0.5], [0.4, 0.05, -0.2], [-0.2, -0.05, -0.2], 6)
    return [
        Wall(grid(*low, 12), (0.7, 0.7, 0.7)),
        Wall(left, (0.75, 0.15, 0.1)),
        Wall(right, (0.1, 0.6, 0.2)),
        Wall(np.concatenate([back, front]), (0.7, 0.65, 0.5)),
        Wall(plate, (0.8, 0.8, 0.9)),
    ]


def ball_in_bowl() -> list[Wall]:
    """A blue ball in an orange hemispherical bowl."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    bowl = sphere.vertices[sphere.faces[:, ::-1]]
    bowl = bowl[(bowl[..., 1] <= 1e-9).all(axis=1)]
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.4)
    return [
        Wall(bowl, (0.85, 0.6, 0.3)),
        Wall(ball.vertices[ball.faces] + [0.15, -0.4, 0.1], (0.3, 0.4, 0.85)),
    ]


def as_mesh(walls: list[Wall]) -> Mesh:
    corners = np.concatenate([wall.corners for wall in walls])
    albedo = np.concatenate([np.tile(wall.albedo, (3 * len(wall.corners), 1)) for wall in walls])
    return mesh_from_arrays(
        "walls",
        torch.from_numpy(corners.reshape(-1, 3)),
        torch.arange(3 * len(corners)).reshape(-1, 3),
        albedo=torch.from_numpy(albedo),
    )


def mitsuba_scene(walls: list[Wall], image: np.ndarray):
    # Its image starts at -z where ours has its centre: half a turn about the vertical.
    turn = mi.ScalarTransform4f().rotate([0, 1, 0], 180)
    light = {"type": "envmap", "bitmap": mi.Bitmap(image), "to_world": turn}
    scene = {"type": "scene", "light": light}
    for index, wall in enumerate(walls):
        colour = {"type": "rgb", "value": list(wall.albedo)}
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": colour})
        facets = len(wall.corners)
        shape = mi.Mesh(f"wall{index}", 3 * facets, facets, props=properties)
        params = mi.traverse(shape)
        params["vertex_positions"] = wall.corners.astype(np.float32).ravel()
        params["faces"] = np.arange(3 * facets, dtype=np.uint32)
        params.update()
        scene[f"wall{index}"] = shape
    return mi.load_dict(scene)


def path_traced(scene, position, normal, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard error of radiance that leaves a place along its normal."""
    integrator = mi.load_dict({"type": "path", "max_depth": 24, "rr_depth": 1000})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed)
    ray = mi.RayDifferential3f(mi.Point3f(*(position + 1e-3 * normal)), mi.Vector3f(*-normal))
    values = np.array([np.array(integrator.sample(scene, sampler, ray)[0]) for _ in range(SAMPLES)])
    return values.mean(0), values.std(0, ddof=1) / math.sqrt(SAMPLES)


@pytest.mark.slow
@pytest.mark.parametrize("make", [open_box, ball_in_bowl])
def test_bounced_light_agrees(make):
    mi.set_variant("scalar_rgb")
    walls = make()
    mesh = as_mesh(walls)
    coefficients, image = smooth_light((4.0, 3.0, 2.5), 0.3, ORDER)
    visibility = trace_visibility(mesh, resolution=32, supersampling=2)
    direct = project_diffuse(mesh, visibility, SphericalHarmonics(ORDER)).dense()
    albedo = mesh.albedo.float()
    bounces = interreflect(
        mesh,
        visibility,
        diffuse_reflection(mesh.num_points),
        albedo[:, :, None, None] * direct,
        albedo,
        max_bounces=24,
        tolerance=5e-4,
    )
    assert bounces.missed <= 1e-5 * bounces.rays

    def radiance(transfer: torch.Tensor) -> np.ndarray:
        channels = transfer.expand(-1, 3, -1, -1)[:, :, 0].double()
        at_corners = mesh.albedo * torch.einsum("pcj,jc->pc", channels, coefficients)
        return at_corners.unflatten(0, (-1, 3)).mean(1).numpy()  # at the middle of each facet

    ours, unbounced = radiance(direct + bounces.gathered), radiance(direct)
    corners, normals = mesh.vertices.unflatten(0, (-1, 3)).numpy(), mesh.normals[::3].numpy()
    scene = mitsuba_scene(walls, image)
    chosen = np.random.default_rng(0).choice(mesh.num_faces, POINTS, replace=False)
    scores, differences = [], []
    for seed, facet in enumerate(chosen):
        mean, error = path_traced(scene, corners[facet].mean(0), normals[facet], seed)
        scores.append((ours[facet] - mean) / np.hypot(error, BIAS * mean))
        differences.append((ours[facet] - mean) / mean)
    scores, differences = np.array(scores), np.array(differences)
    assert np.abs(scores).max() < LARGEST
    # On average over points there is no room for a bias of that size.
    assert np.abs(np.median(differences, axis=0)).max() < BIAS
    # The test can fail: without bounces a good part of the light is not there.
    assert (1 - unbounced[chosen] / ours[chosen]).mean() > 0.1
