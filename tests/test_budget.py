"""Budgets: what is picked keeps its limits and is near the best of an exhaustive grid."""

import functools
import itertools
import math

import pytest
import torch
import trimesh

from prt_torch import InputError, TransferTensor, bake, evaluate
from prt_torch.assets import concatenate, ground_plane, mesh_from_arrays
from prt_torch.bases import CubeDirections, SphericalHarmonics
from prt_torch.budget import Limits, Tried, choose, coarse, coarse_grids, refine
from prt_torch.construction import Problem, closed_form

GRIDS = {
    "cpca": {"num_clusters": [2, 6, 16], "rank": [1, 2, 4]},
    "wavelet": {"num_terms": [2, 4, 9, 13]},
}
EXHAUSTIVE = [
    ("cpca", {"num_clusters": clusters, "rank": rank})
    for clusters, rank in itertools.product((2, 3, 4, 5, 6, 8, 11, 16), (1, 2, 3, 4))
] + [("wavelet", {"num_terms": terms}) for terms in range(1, 14, 2)]


@functools.cache
def scene(name: str) -> Problem:
    """A small object over a ground."""
    match name:
        case "ring":
            shape = trimesh.creation.torus(1.0, 0.4, major_sections=14, minor_sections=6)
        case _:
            shape = trimesh.creation.icosphere(subdivisions=1)
    vertices = torch.as_tensor(shape.vertices.copy(), dtype=torch.float64)
    faces = torch.as_tensor(shape.faces.copy(), dtype=torch.int64)
    mesh = mesh_from_arrays(name, vertices + torch.tensor([0.0, 1.3, 0.0]), faces)
    mesh = concatenate([mesh, ground_plane(mesh, resolution=10)], name)
    order = SphericalHarmonics(4)
    return Problem(bake(mesh, light_basis=order, resolution=8, supersampling=2))


@functools.cache
def exhaustive(name: str) -> list[tuple[int, float]]:
    """Bytes and error of every point of a fine grid, each fitted by itself."""
    problem, found = scene(name), []
    for kind, parameters in EXHAUSTIVE:
        model = closed_form(problem, kind, parameters)
        error = evaluate.transfer_error(model, problem.transfer)
        found.append((sum(model.storage().values()), error))
    return found


@functools.cache
def tried(name: str):
    return coarse(scene(name), GRIDS)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ring", "ball"])
@pytest.mark.parametrize("share", [0.4])
def test_bytes_within_ten_percent_of_the_best_of_an_exhaustive_grid(name, share):
    problem = scene(name)
    limit = int(share * problem.transfer.num_bytes)
    choice = refine(problem, Limits(bytes=limit), tried(name))
    best = min(error for size, error in exhaustive(name) if size <= limit)
    assert choice.tried.bytes <= limit
    assert sum(choice.model.storage().values()) == choice.tried.bytes
    assert evaluate.transfer_error(choice.model, problem.transfer) == choice.tried.error
    assert choice.tried.error <= 1.1 * best


@pytest.mark.parametrize("name", [pytest.param("ring", marks=pytest.mark.slow), "ball"])
@pytest.mark.parametrize("error", [1e-2])
def test_error_within_ten_percent_of_the_fewest_bytes(name, error):
    choice = refine(scene(name), Limits(error=error), tried(name))
    fewest = min(size for size, lost in exhaustive(name) if lost <= error)
    assert choice.tried.error <= error
    assert choice.tried.bytes <= 1.1 * fewest


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ring", "ball"])
def test_bytes_of_codes_within_ten_percent_of_an_exhaustive_grid(name):
    problem, fewest = scene(name), math.inf
    grid = {
        "num_clusters": [2, 6, 16],
        "rank": [1, 2, 4, 8, 12],
        "quantisation_share": [None, 1, 4],
    }
    choice = refine(problem, Limits(error=1e-3), coarse(problem, {"cpca": grid}))
    values = itertools.product((2, 4, 6, 8, 11), (5, 6, 7, 8, 10), (1.0, 2.0, 4.0, 8.0))
    for clusters, rank, share in values:
        parameters = {"num_clusters": clusters, "rank": rank, "quantisation_share": share}
        model = closed_form(problem, "cpca", parameters)
        if evaluate.transfer_error(model, problem.transfer) <= 1e-3:
            fewest = min(fewest, sum(model.storage().values()))
    assert choice.tried.error <= 1e-3
    assert choice.tried.bytes <= 1.1 * fewest


def test_time_and_several_limits_at_once():
    problem = scene("ball")
    grids = {"cpca": {"num_clusters": [4], "rank": [1, 2]}}
    choice = choose(problem, Limits(relight_seconds=5.0, bytes=10**6), grids=grids)
    assert choice.tried.relight_seconds <= 5.0
    assert choice.tried.parameters["rank"] == 2
    with pytest.raises(InputError, match="the least of all tried is"):
        choose(problem, Limits(relight_seconds=1e-9), grids=grids)


def test_what_cannot_be_is_one_line():
    with pytest.raises(InputError, match=r"nothing has bytes of at most 10; the least .* is"):
        refine(scene("ball"), Limits(bytes=10), tried("ball"))
    both = Limits(bytes=min(one.bytes for one in tried("ball")), error=1e-3)
    with pytest.raises(InputError, match=r"nothing keeps all of bytes=.* error=.* at once"):
        refine(scene("ball"), both, tried("ball"))
    with pytest.raises(ValueError, match="expected a limit"):
        Limits()


def test_reasons_name_the_choice_and_the_others():
    choice = refine(scene("ring"), Limits(bytes=10**6), tried("ring"))
    assert choice.why[0].startswith(f"{choice.tried.kind} with ")
    assert f"of {len(choice.all_tried)} tried" in choice.why[0]
    others = {one.kind for one in choice.all_tried} - {choice.tried.kind}
    assert all(any(reason.startswith(kind) for reason in choice.why[1:]) for kind in others)


def with_share(rank: int, share: float | None, size: int, error: float) -> Tried:
    parameters = {"num_clusters": 4, "rank": rank, "quantisation_share": share}
    return Tried("cpca", parameters, size, error, 0.0)


def test_only_sizes_have_others_between():
    """Between a share and none nothing is fitted; ranks of either are followed."""
    known = [
        with_share(1, 4.0, 600, 0.4),
        with_share(4, 4.0, 9000, 0.1),
        with_share(1, None, 8000, 0.3),
    ]
    choice = refine(scene("ball"), Limits(bytes=5000), known)
    fresh = [one.parameters for one in choice.all_tried[len(known) :]]
    assert {one["rank"] for one in fresh if one["quantisation_share"] == 4.0} == {2, 3}
    assert None not in {one["quantisation_share"] for one in fresh}


@pytest.mark.parametrize("fine", [0.05, 1])
def test_shares_have_others_between(fine):
    """Until they hardly differ."""
    known = [with_share(2, 4, 600, 0.4), with_share(2, fine, 9000, 0.1)]
    choice = refine(scene("ball"), Limits(bytes=5000), known)
    shares = [one.parameters["quantisation_share"] for one in choice.all_tried]
    assert shares[2] == pytest.approx((4 * fine) ** 0.5, rel=0.01)
    assert len(shares) > 3
    assert len(set(shares)) == len(shares)
    assert all(fine < share < 4 for share in shares[2:])


def test_entries_of_one_kind_may_have_different_parameters():
    """As configs/sweep/comparison.yaml has them: in codes and as they are."""
    plain = [
        Tried("cpca", {"num_clusters": 4, "rank": rank}, size, error, 0.0)
        for rank, size, error in ((1, 3000, 0.4), (4, 9000, 0.2))
    ]
    coded = [with_share(1, 4.0, 600, 0.3), with_share(4, 4.0, 9000, 0.1)]
    choice = refine(scene("ball"), Limits(bytes=5000), [*plain, *coded])
    assert choice.tried.bytes <= 5000
    fresh = [one.parameters for one in choice.all_tried[4:]]
    assert {one["rank"] for one in fresh if one.get("quantisation_share", 4.0) == 4.0} == {2, 3}


def test_codes_become_finer_while_they_fit_and_coarser_while_the_error_allows():
    problem = scene("ball")
    known = coarse(problem, {"cpca": {"num_clusters": [4], "rank": [4], "quantisation_share": [4]}})
    finer = refine(problem, Limits(bytes=10**6), known).tried
    coarser = refine(problem, Limits(error=0.5), known).tried
    assert finer.parameters["quantisation_share"] == 4 / 2**4
    assert finer.error < known[0].error
    assert coarser.parameters["quantisation_share"] == 4 * 2**4
    assert coarser.bytes < known[0].bytes


@pytest.mark.slow
def test_same_choice_again():
    limits = Limits(error=0.02)
    first, second = (refine(scene("ball"), limits, tried("ball")) for _ in range(2))
    assert first.tried.parameters == second.tried.parameters
    assert torch.equal(first.model.dense(), second.model.dense())


def test_first_grids_suit_the_transfer():
    values = torch.rand(100, 1, 1, 24)
    by_texel = TransferTensor.from_dense(values, light_basis=CubeDirections(2))
    grids = coarse_grids(by_texel)
    assert "zonal_lobes" not in grids
    assert max(grids["cpca"]["num_clusters"]) <= 25
    assert max(grids["wavelet"]["num_terms"]) <= 24
    assert "zonal_lobes" in coarse_grids(scene("ball").transfer)
