"""Sweeps: what is read off larger fits is right, few are fitted, and what was killed goes on."""

import itertools
import json
import sys
import types
from concurrent.futures import BrokenExecutor, Future, wait
from pathlib import Path

import pytest
import torch
import trimesh
from contract import random_transfer
from rich.console import Console

from prt_torch import InputError, TransferTensor, evaluate, store, sweep
from prt_torch.bases import Haar, SphericalHarmonics
from prt_torch.construction import Problem, closed_form
from prt_torch.metric import Metric
from prt_torch.nesting import NESTINGS, Chain, chains, nested
from prt_torch.reductions import (
    fewer_functions,
    fewer_segment_vectors,
    fewer_terms,
    fewer_vectors,
    smaller_tensor,
)
from prt_torch.representations import (
    CPCA,
    ClusteredTensor,
    ScatteredSRBF,
    SegmentedCPCA,
    WaveletTransfer,
    save,
)
from prt_torch.sweep import parse_sweep, planned
from prt_torch.sweep.chain import Kept, job, run_chain
from prt_torch.sweep.execution import _outcome
from prt_torch.sweep.measure import Judge
from prt_torch.sweep.settings import SlurmConfig
from prt_torch.sweep.workers import workers

CONFIGS = Path(__file__).resolve().parent.parent / "configs"


def smooth_transfer(points: int = 300, rows: int = 1, basis=None, seed: int = 0) -> TransferTensor:
    """Random transfer whose every point has a light basis to be fitted in."""
    basis = basis or SphericalHarmonics(4)
    values = random_transfer(points, rows=rows, coeffs=basis.num_coeffs, seed=seed).dense()
    return TransferTensor.from_dense(values, light_basis=basis)


# ---- reading small representations off larger ones


def test_of_one_cluster_principal_vectors_of_few_are_among_those_of_many():
    transfer = smooth_transfer()
    large = CPCA.from_transfer(transfer, num_clusters=1, rank=8)
    for rank in (0, 1, 5):
        own = CPCA.from_transfer(transfer, num_clusters=1, rank=rank)
        read = fewer_vectors(large, rank)
        torch.testing.assert_close(read.dense(), own.dense(), rtol=1e-9, atol=1e-9)
        assert read.condition == pytest.approx(own.condition, rel=1e-6)
        assert sum(read.storage().values()) == sum(own.storage().values())


@pytest.mark.parametrize("affine", [True, False])
def test_fewer_vectors_lose_the_squares_of_the_others(affine):
    transfer = smooth_transfer()
    large = CPCA.from_transfer(transfer, num_clusters=4, rank=6, affine=affine)
    read = fewer_vectors(large, 3)
    dropped = large.layout.by_point(large.weights.detach())[:, 3:].square().sum()
    more = evaluate.squared_errors(read, transfer).sum() - (
        evaluate.squared_errors(large, transfer).sum()
    )
    assert float(more) == pytest.approx(float(dropped), rel=1e-6)


def test_no_more_vectors_can_be_read_than_there_are():
    model = CPCA.from_transfer(smooth_transfer(), num_clusters=4, rank=2)
    with pytest.raises(ValueError, match="one rank of at least 3, got 2"):
        fewer_vectors(model, 3)


@pytest.mark.parametrize("channels", [1, 3])
def test_fewer_terms_are_those_of_the_closed_form(channels):
    transfer = random_transfer(80, channels=channels, rows=2, coeffs=16)
    large = WaveletTransfer.from_transfer(transfer, num_terms=12, codes="float")
    for terms in (1, 5, 12):
        own = WaveletTransfer.from_transfer(transfer, num_terms=terms, codes="float")
        assert torch.equal(fewer_terms(large, terms).dense(), own.dense())
        assert fewer_terms(large, terms).storage() == own.storage()


def test_fewer_terms_of_codes_differ_by_rounding_alone():
    transfer = random_transfer(80, coeffs=16)
    read = fewer_terms(WaveletTransfer.from_transfer(transfer, num_terms=12), 4)
    own = WaveletTransfer.from_transfer(transfer, num_terms=4)
    assert evaluate.transfer_error(read, transfer) == pytest.approx(
        evaluate.transfer_error(own, transfer), rel=1e-3
    )
    with pytest.raises(ValueError, match="at most 4 terms"):
        fewer_terms(read, 5)


def test_tensor_cut_to_its_own_ranks_is_itself():
    transfer = smooth_transfer(rows=4)
    model = ClusteredTensor.from_transfer(transfer, num_clusters=3, ranks=(3, 6, 5), bits=None)
    read = smaller_tensor(model, (3, 6, 5))
    torch.testing.assert_close(read.dense(), model.dense(), rtol=1e-9, atol=1e-9)


def test_tensor_of_one_mode_is_cut_as_principal_components():
    """With all of view and light, ranks of points are those of a linear subspace."""
    transfer = smooth_transfer(rows=2)
    size = transfer.num_rows * transfer.num_coeffs
    model = ClusteredTensor.from_transfer(transfer, num_clusters=1, ranks=(2, 16, size), bits=None)
    own = CPCA.from_transfer(transfer, num_clusters=1, rank=3, affine=False, method="static")
    read = smaller_tensor(model, (2, 16, 3))
    torch.testing.assert_close(read.dense(), own.dense(), rtol=1e-6, atol=1e-6)


def test_smaller_tensors_lose_more_and_take_less():
    transfer = smooth_transfer(rows=4)
    model = ClusteredTensor.from_transfer(transfer, num_clusters=3, ranks=(4, 12, 12))
    read = [smaller_tensor(model, ranks) for ranks in ((4, 12, 8), (4, 8, 8), (2, 8, 8), (1, 2, 1))]
    errors = [evaluate.transfer_error(one, transfer) for one in [model, *read]]
    sizes = [sum(one.storage().values()) for one in [model, *read]]
    assert errors == sorted(errors)
    assert sizes == sorted(sizes, reverse=True)
    assert read[-1].budget["ranks"] == [1, 1, 1]  # two of light would hold nothing more


def test_fewer_functions_have_the_best_weights():
    transfer = smooth_transfer(120)
    model = ScatteredSRBF.from_transfer(
        transfer, num_clusters=2, num_functions=8, resolution=4, bits=None
    )
    metric = Metric.l2(transfer)
    read = fewer_functions(model, 3, metric)
    lost = metric.weigh(read.dense() - model.dense()).detach()[:, 0]
    kept = metric.weigh(read.functions()).detach()[read.labels]
    cosines = (lost @ kept.mT).abs().amax() / (lost.norm() * kept.norm())
    assert float(cosines) < 1e-12
    every = fewer_functions(model, 8, metric)
    torch.testing.assert_close(every.dense(), model.dense(), rtol=1e-6, atol=1e-6)


def test_functions_chosen_hold_more_than_most_choices():
    """Against all triples of 6: the greedy choice is among the best tenth."""
    transfer = smooth_transfer(100)
    model = ScatteredSRBF.from_transfer(
        transfer, num_clusters=1, num_functions=6, resolution=4, bits=None
    )
    metric = Metric.l2(transfer)
    functions, whole = metric.weigh(model.functions())[0], metric.weigh(model.dense())[:, 0, 0]
    held = sorted(
        float((whole @ torch.linalg.qr(functions[list(some)].mT)[0]).square().sum())
        for some in itertools.combinations(range(6), 3)
    )
    own = metric.weigh(fewer_functions(model, 3, metric).dense()).square().sum()
    assert float(own) >= held[-2] * (1 - 1e-9)


def test_fewer_vectors_of_segments():
    transfer = smooth_transfer(150, basis=Haar(4, 4))
    metric = Metric.l2(transfer)
    model = SegmentedCPCA.from_transfer(transfer, points_per_cluster=50, rank=4)
    whole = fewer_segment_vectors(model, 4, transfer, metric, 0.05)
    errors = [evaluate.transfer_error(model, transfer), evaluate.transfer_error(whole, transfer)]
    assert errors[1] == pytest.approx(errors[0], rel=0.1)
    for rank in (3, 2, 1):
        read = fewer_segment_vectors(model, rank, transfer, metric, 0.05)
        own = SegmentedCPCA.from_transfer(transfer, points_per_cluster=50, rank=rank)
        errors.append(evaluate.transfer_error(read, transfer))
        assert errors[-1] < 1.6 * evaluate.transfer_error(own, transfer)
        assert read.budget["rank"] == rank
        assert read.condition < 1e6
        size = sum(read.storage().values())
        assert size < 1.1 * sum(own.storage().values())
    assert errors[1:] == sorted(errors[1:])


# ---- chains


def test_chains_cover_the_grid_largest_first():
    grid = {"num_clusters": [4, 8], "rank": [1, 3, 2]}
    found = chains("cpca", grid)
    assert [one.fixed for one in found] == [{"num_clusters": 4}, {"num_clusters": 8}]
    assert [point["rank"] for point in found[0].points()] == [3, 2, 1]
    lobes = chains("zonal_lobes", {"num_lobes": [1, 2], "effort": ["fast"]})
    assert [one.points() for one in lobes] == [
        [{"num_lobes": 1, "effort": "fast"}],
        [{"num_lobes": 2, "effort": "fast"}],
    ]


@pytest.mark.parametrize("kind", NESTINGS)
def test_twenty_points_cost_at_most_three_of_the_largest(kind):
    """Sizes of what is fitted add up; what costs the same at any size is fitted three times."""
    axis = NESTINGS[kind].axis
    values = [[k, 2 * k, k] for k in range(1, 21)] if axis == "ranks" else list(range(1, 21))
    (chain,) = chains(kind, {axis: values})
    fits = [point[axis] for point, fitted in chain.plan() if fitted == point]
    sizes = [fit[0] if axis == "ranks" else fit for fit in fits]
    assert sum(sizes) <= 3 * 20
    if kind in ("clustered_tensor", "scattered_srbf", "wavelet"):
        assert len(fits) <= 3
    for point, fitted in chain.plan():
        assert fitted == point or NESTINGS[kind].reaches(point, fitted)


def test_points_that_cannot_be_read_off_are_fitted():
    grid = {"method": ["adaptive"], "num_clusters": [4], "rank": [3, 2]}
    (chain,) = chains("cpca", grid)
    assert all(fitted == point for point, fitted in chain.plan())


def test_of_nearly_all_dimensions_fewer_are_fitted_anew():
    (chain,) = chains("cpca", {"rank": [28, 24, 20, 14]})
    assert [fitted["rank"] for _, fitted in chain.plan(size=36)] == [28, 28, 20, 20]
    assert [fitted["rank"] for _, fitted in chain.plan(size=250)] == [28, 28, 28, 14]


def test_codes_of_all_shares_are_made_of_the_same_fits():
    grid = {"num_clusters": [4], "rank": [8, 7, 2], "quantisation_share": [4, None, 1]}
    (chain,) = chains("cpca", grid)
    assert [point["quantisation_share"] for point in chain.points()[:3]] == [None, 1, 4]
    assert [fitted["rank"] for _, fitted in chain.plan()] == [8] * 6 + [2] * 3
    assert all(fitted["quantisation_share"] is None for _, fitted in chain.plan())
    # What is not compressed has codes of 16 bits here, which compressed ones are not made of.
    tensors = chains("clustered_tensor", {"ranks": [[1, 2, 2]], "quantisation_share": [None, 1, 4]})
    assert [one.shares for one in tensors] == [(None,), (1, 4)]
    ((_, fitted), _) = tensors[1].plan()
    assert fitted == {"ranks": [1, 2, 2], "quantisation_share": None, "bits": None}
    lobes = chains("zonal_lobes", {"num_lobes": [1, 2], "quantisation_share": [1, 4]})
    assert [one.points() for one in lobes] == [
        [{"num_lobes": count, "quantisation_share": share} for share in (1, 4)] for count in (1, 2)
    ]
    # The share of this kind is that of its own codes.
    (segments,) = chains("segmented_cpca", {"rank": [2, 1], "quantisation_share": [0.05]})
    assert segments.fixed == {"quantisation_share": 0.05}


@pytest.mark.parametrize("kind", ["cpca", "clustered_tensor", "zonal_lobes"])
def test_codes_of_a_chain_are_those_of_own_fits(kind):
    """Of the largest point, whose numbers are its own; smaller ones are near, in fewer bytes."""
    problem = Problem(smooth_transfer(120))
    grids = {
        "cpca": {"num_clusters": [4], "rank": [4, 3]},
        "clustered_tensor": {"num_clusters": [4], "ranks": [[1, 5, 5], [1, 4, 4]]},
        "zonal_lobes": {"num_lobes": [1], "effort": ["fast"]},
    }
    (chain,) = chains(kind, {**grids[kind], "quantisation_share": [1, 4]})
    made = list(nested(problem, chain))
    for one in made:
        own = closed_form(problem, kind, one.parameters)
        errors = [evaluate.transfer_error(model, problem.transfer) for model in (one.model, own)]
        sizes = [sum(model.storage().values()) for model in (one.model, own)]
        assert errors[0] == pytest.approx(errors[1], rel=1e-3 if one.read_off is None else 1.0)
        assert sizes[0] == pytest.approx(sizes[1], rel=0.01 if one.read_off is None else 0.2)
        assert one.model.condition == pytest.approx(own.condition, rel=1.0)
    assert [one.read_off is None for one in made[:2]] == [True, True]
    assert all(one.read_off for one in made[2:])
    assert made[0].seconds > made[1].seconds  # which has no fit of its own


@pytest.mark.parametrize("kind", ["cpca", "clustered_tensor", "scattered_srbf", "wavelet"])
def test_nested_errors_fall_and_stay_near_own_fits(kind):
    problem = Problem(smooth_transfer(200))
    grids = {
        "cpca": {"num_clusters": [4], "rank": [1, 2, 3, 4]},
        "clustered_tensor": {"num_clusters": [4], "ranks": [[1, 2, 2], [1, 3, 3], [1, 5, 5]]},
        "scattered_srbf": {"num_clusters": [2], "num_functions": [3, 6], "resolution": [4]},
        "wavelet": {"num_terms": [3, 6, 9]},
    }
    (chain,) = chains(kind, grids[kind])
    made = list(nested(problem, chain))
    errors = [evaluate.transfer_error(one.model, problem.transfer) for one in made]
    assert errors == sorted(errors)
    assert made[0].read_off is None
    assert any(one.read_off for one in made)
    for one, error in zip(made, errors, strict=True):
        own = closed_form(problem, kind, one.parameters)
        assert one.model.budget == own.budget
        if kind != "scattered_srbf":  # whose functions must move to make up for those that go
            assert error < 2.0 * evaluate.transfer_error(own, problem.transfer) + 1e-9


# ---- a sweep on disk


def judge_of(transfer: TransferTensor) -> Judge:
    light = torch.rand(transfer.num_coeffs, 3, generator=torch.Generator().manual_seed(1))
    return Judge(transfer, {"light": light.to(transfer.values.dtype)})


def contents(folder: Path) -> dict[str, object]:
    """Representations to the byte, records without their times."""
    found: dict[str, object] = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix == ".safetensors":
            found[path.name] = path.read_bytes()
        elif path.suffix == ".json":
            record = json.loads(path.read_text())
            found[path.name] = {k: v for k, v in record.items() if not k.endswith("seconds")}
    return found


@pytest.mark.parametrize("shares", [[None], [None, 1], [1, 4]])
@pytest.mark.parametrize("stop_after", [0, 1, 3])
def test_killed_chain_ends_as_if_it_had_not_been(tmp_path, monkeypatch, stop_after, shares):
    problem, judge = Problem(smooth_transfer(150)), judge_of(smooth_transfer(150))
    ranks = [8, 7, 6, 5, 2, 1] if shares == [None] else [8, 7, 2]
    grid = {"num_clusters": [4], "rank": ranks, "quantisation_share": shares}
    (chain,) = chains("cpca", grid)
    assert run_chain(problem, chain, Kept(tmp_path / "whole"), judge) == 6
    keep, kept = Kept.keep, []

    def dies(self, kind, made, worth):
        if len(kept) == stop_after:  # the representation is there, its record is not
            save(made.model, self.path(kind, made.parameters))
            raise KeyboardInterrupt
        kept.append(made)
        keep(self, kind, made, worth)

    monkeypatch.setattr(Kept, "keep", dies)
    with pytest.raises(KeyboardInterrupt):
        run_chain(problem, chain, Kept(tmp_path / "killed"), judge)
    monkeypatch.undo()
    assert run_chain(problem, chain, Kept(tmp_path / "killed"), judge) == 6 - stop_after
    assert run_chain(problem, chain, Kept(tmp_path / "killed"), judge) == 0
    assert contents(tmp_path / "killed") == contents(tmp_path / "whole")


def test_nothing_is_read_off_what_was_read_off_itself(tmp_path):
    """As a point that a budget picks, whose numbers are there, but of a larger fit."""
    problem, judge = Problem(smooth_transfer(150)), judge_of(smooth_transfer(150))
    after, alone = Kept(tmp_path / "after"), Kept(tmp_path / "alone")
    (chain,) = chains("cpca", {"num_clusters": [12], "rank": [3, 2], "quantisation_share": [None]})
    run_chain(problem, chain, after, judge)
    picked = {"num_clusters": 12, "rank": 2, "quantisation_share": 2.0}
    for kept in (after, alone):
        run_chain(problem, Chain("cpca", picked), kept, judge)
    assert after.path("cpca", picked).read_bytes() == alone.path("cpca", picked).read_bytes()


def test_judge_against_definitions():
    transfer = smooth_transfer(60)
    judge = judge_of(transfer)
    model = CPCA.from_transfer(transfer, num_clusters=2, rank=1)
    worth = judge.errors(model)
    light = judge.lights["light"]
    exact, own = (
        torch.einsum("pcri,ik->prk", one, light) for one in (transfer.dense(), model.dense())
    )
    expected = float((own - exact).norm() / exact.norm())
    assert worth["radiance_error"]["light"] == pytest.approx(expected, rel=1e-9)
    assert worth["transfer_error"] == pytest.approx(evaluate.transfer_error(model, transfer))
    assert worth["bytes"] == sum(model.storage().values())
    for seconds in (judge.seconds(model), judge.dense_seconds(memory_budget=2**24)):
        assert set(seconds) == {"light", "view", "both"}
        assert min(seconds.values()) > 0.0


@pytest.fixture(scope="module")
def small_scene(tmp_path_factory) -> list[str]:
    folder = tmp_path_factory.mktemp("scene")
    trimesh.creation.icosphere(subdivisions=2).export(folder / "ball.obj")
    return [
        f"scene.mesh={folder / 'ball.obj'}",
        "scene.ground_resolution=8",
        "transfer.resolution=8",
        "transfer.order=4",
        "light.test=[sky]",
        f"cache={folder / 'cache'}",
        "sweep.executor=here",
        "sweep.waterfall=false",
        "preview.width=32",
        "preview.height=24",
    ]


def run_sweep(arguments: list[str], folder: Path) -> dict:
    config = parse_sweep([*arguments, f"out={folder}"], CONFIGS, script="train/sweep.py")
    return sweep.execute(config, Console(quiet=True))


FIRST = "sweep.representations=[{name: cpca, num_clusters: 8, rank: [1, 2]}]"
BOTH = FIRST[:-1] + ", {name: wavelet, num_terms: [4, 2]}, {name: wavelet, codes: 11/11/10}]"


def test_sweep_leaves_out_what_a_run_would(small_scene, tmp_path):
    alone = [*small_scene, "scene.ground=false", "transfer.order=6", FIRST]
    report = run_sweep(alone, tmp_path / "fewer")
    assert report["light"]["coeffs"] < 36  # a convex diffuse ball hardly has a sixth band
    (entry,) = [one for one in report["left_out"] if "bands" in one["what"]]
    assert entry["saved_bytes"] > 0
    forced = run_sweep([*alone, "transfer.keep=[bands]"], tmp_path / "all")
    assert forced["light"]["coeffs"] == 36
    assert not any("bands" in one["what"] for one in forced["left_out"])
    assert forced["results"][0]["bytes"] > report["results"][0]["bytes"]


def test_sweep_takes_further_points_and_leaves_out_what_does_not_suit(small_scene, tmp_path):
    first = run_sweep([*small_scene, FIRST], tmp_path)
    assert [one["name"] for one in first["results"]] == ["cpca 8x2", "cpca 8x1"]
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "points").glob("cpca-*")}
    both = run_sweep([*small_scene, BOTH], tmp_path)
    assert both["results"][:2] == first["results"]
    assert [one["name"] for one in both["results"][2:]] == ["wavelet 4", "wavelet 2"]
    assert "three channels" in both["failed"][0]["why"]
    assert {path: path.stat().st_mtime_ns for path in files} == files
    needed = {"bytes", "transfer_error", "reference_error", "radiance_error", "fit_seconds"}
    needed |= {"relight_seconds", "light_seconds", "view_seconds", "peak_bytes", "condition"}
    assert all(needed <= set(one) for one in both["results"])


def test_sweep_with_a_budget_explains_its_choice_and_where_its_error_is_from(small_scene, tmp_path):
    grid = "sweep.representations=[{name: cpca, num_clusters: [2, 16], rank: [1, 4]}]"
    report = run_sweep([*small_scene, grid, "budget.error=0.01", "sweep.waterfall=true"], tmp_path)
    assert report["budget"]["asked"] == "squared transfer error at most 1.00e-02"
    chosen = next(one for one in report["results"] if one["name"] == report["budget"]["name"])
    assert chosen["transfer_error"] <= 0.01
    assert chosen["bytes"] == min(
        one["bytes"] for one in report["results"] if one["transfer_error"] <= 0.01
    )
    stages = report["waterfall"]["stages"]
    names = ["bake noise", "light basis", "clusters", "rank", "half of the light"]
    assert [one["name"] for one in stages] == names
    total = sum(one["difference"] for one in stages)
    assert total == stages[-1]["error"]
    by_name = {one["name"]: one for one in stages}
    assert by_name["clusters"]["difference"] > -by_name["rank"]["difference"] > 0
    assert all(one["alone"] > 0 for one in stages)
    page = (tmp_path / "tradeoff.html").read_text()
    assert report["budget"]["why"][0].split(":")[0] in page


@pytest.mark.parametrize(
    ("entry", "coded"),
    [
        ("{name: cpca, num_clusters: 4, rank: 3, quantisation_share: 4}", True),
        (
            "{name: clustered_tensor, num_clusters: 4, ranks: [1, 4, 4], quantisation_share: 1}",
            True,
        ),
        ("{name: wavelet, num_terms: 9, codes: float}", False),
    ],
)
def test_codes_are_a_stage_of_their_own(small_scene, tmp_path, entry, coded):
    wanted = [f"sweep.representations=[{entry}]", "sweep.waterfall=true"]
    report = run_sweep([*small_scene, *wanted], tmp_path)
    stages = {one["name"]: one for one in report["waterfall"]["stages"]}
    assert ("codes" in stages) == coded
    if coded:
        assert abs(stages["codes"]["difference"]) > 1e-6 * stages["rank"]["error"]
        assert stages["codes"]["alone"] > 1e-9


def test_folder_of_another_sweep_is_refused(small_scene, tmp_path):
    run_sweep([*small_scene, FIRST], tmp_path)
    with pytest.raises(InputError, match="holds another sweep"):
        run_sweep([*small_scene, FIRST, "seed=1"], tmp_path)
    with store.locked(tmp_path), pytest.raises(InputError, match="in use"):
        run_sweep([*small_scene, FIRST], tmp_path)


def test_nothing_that_suits_is_an_error(small_scene, tmp_path):
    only = "sweep.representations=[{name: wavelet, codes: 11/11/10}]"
    with pytest.raises(InputError, match="none suits the scene; expected three channels"):
        run_sweep([*small_scene, only], tmp_path)


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("sweep=none", "sweep: unknown 'none'; expected one of"),
        ("sweep.workrs=2", "sweep.workrs: unknown key"),
        ("sweep.workers", "not KEY=VALUE"),
        ("sweep.workers=[1", r"sweep.workers=\[1: line 1, column 3: expected ',' or '\]'"),
        ("sweep.representations=[{name: cpcb}]", "representations.0.name: expected one of cpca"),
        ("sweep.representations=[{name: cpca, rnk: 1}]", "0.rnk: unknown key; expected one of"),
        ("sweep.representations=[{name: cpca, rank: [2, 0]}]", "0.rank: .* equal to 1, got '0'"),
        ("sweep.representations=[{name: cpca, rank: [2, 2]}]", "0.rank: expected different"),
        ("sweep.representations=[{name: cpca, rank: []}]", "expected at least one value"),
        ("budget.bytes=0", "budget.bytes: .* equal to 1"),
        ("fit.max_steps=3", "fit.max_steps: .* expected 0, got 3"),
        ("scene.gruond=1", "scene.gruond: unknown key"),
        ("--workers", "unknown option"),
    ],
)
def test_wrong_configurations_are_one_line(argument, message):
    with pytest.raises(InputError, match=message) as caught:
        parse_sweep([argument], CONFIGS, script="train/sweep.py")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("part", ["glossy", "parts.ball.glossy"])
def test_glossy_bounces_have_no_waterfall(part):
    """Refused at once: it comes last, after hours perhaps."""
    given = [f"+material.{part}={{name: ggx, roughness: 0.4, f0: 0.5}}", "transfer.max_bounces=1"]
    with pytest.raises(InputError, match=r"^sweep.waterfall: .* set it to false"):
        parse_sweep(given, CONFIGS, script="train/sweep.py")
    for other in ("sweep.waterfall=false", "transfer.max_bounces=0"):
        parse_sweep([*given, other], CONFIGS, script="train/sweep.py")


def test_a_point_that_is_asked_for_twice_is_named():
    twice = "sweep.representations=[{name: cpca, rank: [1, 2]}, {name: cpca, rank: 2}]"
    config = parse_sweep([twice], CONFIGS, script="train/sweep.py")
    with pytest.raises(InputError, match="cpca 128x2 is asked for twice"):
        planned(config)


def test_one_list_is_one_triple_of_ranks():
    given = "sweep.representations=[{name: clustered_tensor, ranks: [1, 4, 4]}]"
    config = parse_sweep([given], CONFIGS, script="train/sweep.py")
    assert config.sweep.grids() == [("clustered_tensor", {"ranks": [[1, 4, 4]]})]


# ---- who runs the chains


@pytest.mark.parametrize(("executor", "package"), [("dask", "distributed"), ("slurm", "submitit")])
def test_missing_packages_are_named(monkeypatch, tmp_path, executor, package):
    monkeypatch.setitem(sys.modules, package, None)
    config = parse_sweep([f"sweep.executor={executor}"], CONFIGS, script="train/sweep.py").sweep
    with (
        pytest.raises(InputError, match=f"sweep.executor: {executor} needs the package"),
        workers(config, tmp_path),
    ):
        pass


class FakeJob:
    def __init__(self, call):
        self.call, self.asked = call, 0

    def done(self):
        self.asked += 1
        return self.asked > 1

    def result(self):
        return self.call()


class FakeQueue:
    options: dict = {}  # noqa: RUF012

    def __init__(self, folder):
        self.folder = folder

    def update_parameters(self, **options):
        FakeQueue.options = options

    def submit(self, fn, *args):
        return FakeJob(lambda: fn(*args))


def test_queue_gives_results_and_errors(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "submitit", types.SimpleNamespace(AutoExecutor=FakeQueue))
    monkeypatch.setattr("prt_torch.sweep.workers._POLL_SECONDS", 0.01)
    given = ["sweep.executor=slurm", "sweep.slurm.partition=night"]
    config = parse_sweep(given, CONFIGS, script="train/sweep.py").sweep
    with workers(config, tmp_path) as executor:
        futures = [executor.submit(divmod, 7, 2), executor.submit(divmod, 7, 0)]
        wait(futures, 5)
        assert futures[0].result() == (3, 1)
        assert isinstance(futures[1].exception(), ZeroDivisionError)
    assert FakeQueue.options["slurm_partition"] == "night"
    assert FakeQueue.options["timeout_min"] == SlurmConfig.model_validate({}).minutes


class KilledWorker(Exception):
    """As Dask has one."""


class UncompletedJobError(RuntimeError):
    """As submitit has one."""


@pytest.mark.parametrize("error", [BrokenExecutor, KilledWorker, UncompletedJobError])
def test_a_killed_worker_is_one_line(error):
    future: Future = Future()
    future.set_exception(error("gone"))
    with pytest.raises(InputError, match=r"sweep.workers: a worker was killed"):
        _outcome(future)


def test_chains_travel_as_plain_json():
    config = parse_sweep([], CONFIGS, script="train/sweep.py")
    chain = Chain("cpca", {"num_clusters": 4}, "rank", (2, 1))
    work = job(config.run, chain, Path("folder"), alone=True)
    assert json.loads(json.dumps(work))["chain"]["values"] == [2, 1]
