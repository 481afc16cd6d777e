"""All-frequency glossy light against Mitsuba 3's path tracer, seen from one eye.

Two steps, so that each error stands alone: the reflected integral over our own visibility with the
exact material is held to Mitsuba's by a z-test over many points; the bake with factors must then be
no further from Mitsuba's than factors and that integral differ. Needs the test extra ``check``.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch
import trimesh
from smooth_light import smooth_light

from prt_torch.assets import Environment, mesh_from_arrays
from prt_torch.assets.brdf.base import AnalyticBRDF
from prt_torch.assets.brdf.microfacet import ggx_distribution, ggx_masking, half_vector
from prt_torch.assets.material import Material
from prt_torch.assets.mesh import Mesh
from prt_torch.baking import bake, trace_visibility
from prt_torch.bases import BRDFFactors, Haar, factor_error, sh
from prt_torch.evaluate import dense_radiance
from prt_torch.sphere import cubemap_directions, cubemap_solid_angles, frame_from_normal

mi = pytest.importorskip("mitsuba", reason="mitsuba is not installed (pip install '.[check]')")

EYE = np.array([0.9, 2.6, 0.7])
ORDER, POINTS, SAMPLES = 4, 60, 4096
ROUGHNESS, COLOUR = 0.3, (0.9, 0.6, 0.3)
BIAS = 0.01  # of a point's radiance: borders of shadows between 128 x 128 rays a cube face
LARGEST = 4.6  # |z| by Bonferroni, 180 two-sided tests at 0.1 % in all


@dataclass(frozen=True)
class RoughConductor(AnalyticBRDF):
    """Mitsuba's: GGX that masks light and viewer independently, without Fresnel reflectance."""

    name: ClassVar[str] = "rough_conductor"

    def _evaluate_above(self, wi: torch.Tensor, wo: torch.Tensor) -> torch.Tensor:
        half, _ = half_vector(wi, wo)
        masked = ggx_masking(wi, ROUGHNESS, ROUGHNESS) * ggx_masking(wo, ROUGHNESS, ROUGHNESS)
        shape = (
            ggx_distribution(half, ROUGHNESS, ROUGHNESS) * masked / (4 * wi[..., 2] * wo[..., 2])
        )
        return shape[..., None] * wi.new_tensor(COLOUR)

    @property
    def num_channels(self) -> int:
        return 3

    @property
    def isotropic(self) -> bool:
        return True


def ball_in_bowl() -> np.ndarray:
    """Facets "facets 3 3" of a ball in a hemispherical bowl."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    bowl = sphere.vertices[sphere.faces[:, ::-1]]
    bowl = bowl[(bowl[..., 1] <= 1e-9).all(axis=1)]
    small = trimesh.creation.icosphere(subdivisions=2, radius=0.4)
    return np.concatenate([bowl, small.vertices[small.faces] + [0.15, -0.4, 0.1]])


def with_middles(facets: np.ndarray, chosen: np.ndarray) -> Mesh:
    """Chosen facets cut in three; their middles come first and alone have a normal and light."""
    corners = len(chosen) + np.arange(3 * len(facets)).reshape(-1, 3)
    middles = np.arange(len(chosen))[:, None]
    cut = [np.hstack([corners[chosen][:, [i, (i + 1) % 3]], middles]) for i in range(3)]
    faces = np.concatenate([np.delete(corners, chosen, axis=0), *cut])
    vertices = np.concatenate([facets[chosen].mean(1), facets.reshape(-1, 3)])
    mesh = mesh_from_arrays("middles", torch.from_numpy(vertices), torch.from_numpy(faces))
    normals = mesh.normals.clone()
    normals[len(chosen) :] = 0
    return replace(mesh, normals=normals)


def mitsuba_scene(facets: np.ndarray, image: np.ndarray):
    # Its image starts at -z where ours has its centre: half a turn about the vertical.
    turn = mi.ScalarTransform4f().rotate([0, 1, 0], 180)
    light = {"type": "envmap", "bitmap": mi.Bitmap(image), "to_world": turn}
    colour = {"type": "rgb", "value": list(COLOUR)}
    conductor = {"type": "roughconductor", "material": "none", "distribution": "ggx"}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(
        {**conductor, "alpha": ROUGHNESS, "specular_reflectance": colour}
    )
    shape = mi.Mesh("facets", 3 * len(facets), len(facets), props=properties)
    params = mi.traverse(shape)
    params["vertex_positions"] = facets.astype(np.float32).ravel()
    params["faces"] = np.arange(3 * len(facets), dtype=np.uint32)
    params.update()
    return mi.load_dict({"type": "scene", "light": light, "facets": shape})


def ray_to(place: np.ndarray):
    towards = place - EYE
    return mi.RayDifferential3f(mi.Point3f(*EYE), mi.Vector3f(*(towards / np.linalg.norm(towards))))


def seen_facets(scene, facets: np.ndarray) -> np.ndarray:
    """Some of the facets whose middle the eye sees from the front."""
    normals = np.cross(facets[:, 1] - facets[:, 0], facets[:, 2] - facets[:, 0])
    seen = []
    for facet in np.flatnonzero((normals * (EYE - facets.mean(1))).sum(1) > 0):
        hit = scene.ray_intersect(ray_to(facets[facet].mean(0)))
        if hit.is_valid() and hit.prim_index == facet:
            seen.append(facet)
    return np.random.default_rng(0).choice(seen, POINTS, replace=False)


def path_traced(scene, place: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard error of direct light that a place reflects to the eye."""
    integrator = mi.load_dict({"type": "path", "max_depth": 2, "rr_depth": 1000})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed)
    ray = ray_to(place)
    values = np.array([np.array(integrator.sample(scene, sampler, ray)[0]) for _ in range(SAMPLES)])
    return values.mean(0), values.std(0, ddof=1) / math.sqrt(SAMPLES)


def integrals(
    mesh: Mesh, reflected: Callable[..., torch.Tensor], coefficients: torch.Tensor
) -> np.ndarray:
    """Light to the eye "points rgb" over our own visibility, of a BRDF times the cosine."""
    visibility = trace_visibility(mesh)
    directions = cubemap_directions(visibility.resolution, dtype=torch.float64).reshape(-1, 3)
    solid_angles = cubemap_solid_angles(visibility.resolution, dtype=torch.float64).flatten()
    light = (sh.evaluate(directions, ORDER) @ coefficients) * solid_angles[:, None]
    found = []
    for point in range(POINTS):
        seen = visibility.unpack(slice(point, point + 1))[0].bool()
        frame = frame_from_normal(mesh.normals[point])
        towards = torch.nn.functional.normalize(torch.tensor(EYE) - mesh.vertices[point], dim=0)
        local = directions[seen] @ frame.mT
        found.append((reflected(local, frame @ towards) * light[seen]).sum(0))
    return torch.stack(found).numpy()


@pytest.mark.slow
def test_glossy_light_agrees():
    mi.set_variant("scalar_rgb")
    coefficients, image = smooth_light((5.0, 4.5, 4.0), 0.4, ORDER)
    facets = ball_in_bowl()
    scene = mitsuba_scene(facets, image)
    mesh = with_middles(facets, seen_facets(scene, facets))
    places = mesh.vertices[:POINTS].numpy()
    traced = [path_traced(scene, place, seed) for seed, place in enumerate(places)]
    theirs, errors = np.array(traced).swapaxes(0, 1)
    noise = np.hypot(errors, BIAS * theirs)
    brdf = RoughConductor()

    def material(light: torch.Tensor, view: torch.Tensor) -> torch.Tensor:
        return brdf.evaluate(light, view.expand_as(light)) * light[:, 2:]

    exact = integrals(mesh, material, coefficients)
    assert np.abs((exact - theirs) / noise).max() < LARGEST
    # On average over points there is no room for a bias of that size.
    assert np.abs(np.median(exact / theirs - 1, axis=0)).max() < BIAS
    basis, lost = Haar(32, 16), []
    light = basis.project(Environment("smooth", torch.from_numpy(image), "latlong"))
    for rows in (10, 24):
        factors = BRDFFactors.from_brdf(brdf, num_terms=rows, clamp=None).double()

        def factored(light: torch.Tensor, view: torch.Tensor, factors=factors) -> torch.Tensor:
            return (factors.light(light) @ factors.evaluate(view)).detach()

        by_factors = integrals(mesh, factored, coefficients)
        made_of = Material(lambertian=False, glossy=brdf)
        transfer = bake(mesh, materials=made_of, light_basis=basis, factors=factors.float())
        eye = torch.tensor(EYE, dtype=torch.float32)[None]
        ours = dense_radiance(transfer, light[None].float(), eye)[0, 0, :POINTS].double().numpy()
        # All that separates the bake from the renderer is what the factors are off.
        assert np.abs((ours - theirs - (by_factors - exact)) / noise).max() < LARGEST
        difference = np.abs(ours / theirs - 1).mean()
        lost.append(np.abs(by_factors / exact - 1).mean())
        assert difference < lost[-1] + (noise / theirs).mean()
        assert difference < factor_error(factors, brdf).relative
    assert lost[1] < lost[0]
