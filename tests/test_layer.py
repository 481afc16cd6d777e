"""A Relighter inside other people's training loops: docs/layer.md, and every claim of its table."""

import copy
import functools
import json
import multiprocessing
import os
import pickle
import re
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed
from contract import relative
from tolerances import ROUNDING
from torch import Tensor, nn
from torch._inductor.exc import InductorError
from torch.nn.parallel import DistributedDataParallel

from prt_torch.bases import HemisphericalHarmonics, SphericalHarmonics
from prt_torch.relight import Relighter
from prt_torch.representations.files import KINDS, load, save
from prt_torch.sphere import frame_from_normal
from prt_torch.transfer import TransferTensor

PAGE = Path(__file__).resolve().parent.parent / "docs" / "layer.md"
BUDGETS: dict[str, dict[str, Any]] = {
    "cpca": {"num_clusters": 4, "rank": 2},
    "clustered_tensor": {"num_clusters": 3, "ranks": (4, 6, 4)},
    "dense": {},
    "scattered_srbf": {"num_clusters": 3, "num_functions": 5, "resolution": 4},
    "segmented_cpca": {"points_per_cluster": 15, "rank": 3},
    "wavelet": {"num_terms": 5},
    "zonal_lobes": {"num_lobes": 3, "effort": "fast"},
}
EYES = torch.tensor([[3.0, 1.0, 0.0], [0.0, 5.0, 2.0]])
LIGHT = torch.randn(4, 9, 3, generator=torch.Generator().manual_seed(1))
FLOAT = ROUNDING[torch.float32]


def table() -> dict[str, dict[str, str]]:
    """Rows of the page's table: what it says of each kind."""
    lines = re.findall(r"^\| (.*) \|$", PAGE.read_text(), re.MULTILINE)
    header, _, *rows = [line.split(" | ") for line in lines]
    return {row[0]: dict(zip(header[1:], row[1:], strict=True)) for row in rows}


SAID = table()


def rows_of(feature: str, *quick: str) -> Any:
    """Parametrise over every kind with what the page says of it; all are quick if none is named."""
    cases = [
        pytest.param(kind, said, marks=[pytest.mark.slow] if quick and kind not in quick else [])
        for kind, said in SAID[feature].items()
    ]
    return pytest.mark.parametrize(("kind", "said"), cases)


def kept(function: Any) -> Any:
    """Its results, once each, made with gradients whatever the mode of the test that asks first."""

    @functools.cache
    @functools.wraps(function)
    def in_ordinary_mode(*arguments: Any) -> Any:
        with torch.inference_mode(False), torch.enable_grad():
            return function(*arguments)

    return in_ordinary_mode


@kept
def glossy() -> TransferTensor:
    """Groups of random points in four exit functions, with frames and reflectances of their own."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    groups = normal(5, 36)[torch.randint(5, (60,), generator=generator)]
    values = groups + 0.4 * normal(60, 3) @ normal(3, 36) + 0.01 * normal(60, 36)
    normals = nn.functional.normalize(normal(60, 3), dim=1)
    return TransferTensor.from_dense(
        values.view(60, 1, 4, 9).float(),
        light_basis=SphericalHarmonics(3),
        exit_basis=HemisphericalHarmonics(4),
        frames=frame_from_normal(normals).float(),
        positions=normals.float(),
        reflectance=torch.rand(60, 3, generator=generator),
    )


def made(kind: str, transfer: TransferTensor | None = None) -> Relighter:
    transfer = glossy() if transfer is None else transfer
    return Relighter(KINDS[kind].from_transfer(transfer, **BUDGETS[kind]))


@kept
def shared(kind: str) -> Relighter:
    """One that no test writes to."""
    return made(kind)


@kept
def expected(kind: str) -> Tensor:
    return shared(kind)(LIGHT, EYES).detach()


def gradients(call: Any, relight: Relighter) -> list[Tensor]:
    """Of light and parameters."""
    light = LIGHT.clone().requires_grad_()
    loss = call(light, EYES).square().mean()
    return list(torch.autograd.grad(loss, [light, *relight.parameters()]))


def worst(found: list[Tensor], wanted: list[Tensor]) -> float:
    assert len(found) == len(wanted)
    return max(relative(a, b) for a, b in zip(found, wanted, strict=True) if b.numel())


def holds(said: str, check: Any) -> None:
    """``yes`` must hold and ``no`` must be an error: the page is neither bold nor stale."""
    if said == "yes":
        check()
        return
    assert said == "no"
    with pytest.raises(Exception):  # noqa: B017, PT011 - of torch, of ours, or a wrong number
        check()


def test_the_page_speaks_of_every_kind():
    assert set(KINDS) == set(BUDGETS)
    assert all(set(row) == set(KINDS) for row in SAID.values())


def blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)


def test_the_page_runs_as_printed(capsys, without_type_checker):
    space: dict[str, Any] = {}
    for block in blocks():
        if "torch.distributed" not in block:  # that is for test_two_processes
            exec(compile(block, "docs/layer.md", "exec"), space)
    assert space["light_error"] < 0.01
    assert space["albedo_error"] < 0.005
    assert space["transfer_error"] < 0.01
    assert space["angle"].item() == pytest.approx(0.7, abs=2e-3)
    assert relative(space["light"], space["sky"]) < 5e-3
    lobes = [space[name].representation.dense() for name in ("guess", "truth")]
    assert relative(*lobes) < 5e-3
    printed = capsys.readouterr().out
    shown = dict(re.findall(r"(\w+): ([\d.e+-]+)\n", printed))
    assert float(shown["compiled"]) < FLOAT
    assert 1e-4 < float(shown["autocast"]) < 2e-2
    assert space["jacobian"].shape == (1, 1, 162, 3, 1, 9, 3)


def compiled_holds(kind: str, said: str, backend: str, tolerance: float) -> None:
    relight = made(kind)

    def check() -> None:
        torch._dynamo.reset()
        compiled = torch.compile(relight, backend=backend, fullgraph=True)
        assert worst(gradients(compiled, relight), gradients(relight, relight)) < tolerance
        with torch.no_grad():  # compiled code must see what is written to parameters
            for parameter in relight.parameters():
                parameter.mul_(1.5)
        assert relative(compiled(LIGHT, EYES), relight(LIGHT, EYES)) < tolerance

    holds(said, check)


@rows_of("`torch.compile(fullgraph=True)`")
def test_traced_without_a_break(kind, said, without_type_checker):
    compiled_holds(kind, said, "eager", FLOAT)


@pytest.mark.parametrize("kind", ["cpca", "clustered_tensor"])
def test_traced_as_loaded(kind, tmp_path, without_type_checker):
    """Before anything was evaluated."""
    fitted, path = made(kind), tmp_path / "fitted.safetensors"
    save(fitted.representation, path)
    relight = Relighter(load(path, geometry=fitted.representation.surface))
    torch._dynamo.reset()
    found = torch.compile(relight, backend="eager", fullgraph=True)(LIGHT, EYES)
    assert relative(found, fitted(LIGHT, EYES)) < FLOAT


@pytest.mark.slow
@rows_of("`torch.compile(fullgraph=True)`")
def test_traced_with_its_gradients(kind, said, without_type_checker):
    compiled_holds(kind, said, "aot_eager", FLOAT)


@pytest.mark.slow
@rows_of("`torch.compile(fullgraph=True)`")
def test_compiled_by_inductor(kind, said, without_type_checker):
    try:
        compiled_holds(kind, said, "inductor", 5 * FLOAT)
    except InductorError as error:
        pytest.skip(f"Inductor does not work here: {str(error).splitlines()[0]}")


@rows_of("error of bfloat16 autocast")
def test_autocast(kind, said):
    relight = shared(kind)

    def check(limit: float) -> None:
        for context in (torch.no_grad, torch.enable_grad):
            with context(), torch.autocast("cpu", dtype=torch.bfloat16):
                found = relight(LIGHT, EYES)
            assert relative(found.float(), expected(kind)) < limit

    within(said, check)


@rows_of("error of its gradients")
def test_gradients_of_autocast(kind, said):
    relight = shared(kind)

    def check(limit: float) -> None:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            found = gradients(relight, relight)
        assert worst(found, gradients(relight, relight)) < limit

    within(said, check)


def within(said: str, check: Any) -> None:
    """A share must hold as a limit; ``no`` as in :func:`holds`."""
    if said.endswith(" %"):
        check(float(said.removesuffix(" %")) / 100)
    else:
        holds(said, lambda: check(1.0))


@rows_of("error of `.to(torch.bfloat16)`")
def test_half(kind, said):
    def check(limit: float) -> None:
        relight = copy.deepcopy(shared(kind)).to(torch.bfloat16)
        found = relight(LIGHT.to(torch.bfloat16), EYES)  # views stay as they are
        assert found.dtype == torch.bfloat16
        assert relative(found.float(), expected(kind)) < limit

    within(said, check)


def test_double():
    for kind in KINDS:
        relight = copy.deepcopy(shared(kind)).double()
        assert relative(relight(LIGHT.double(), EYES.double()), expected(kind)) < 1e-4


@rows_of("`torch.func.grad` of parameters")
def test_functional_gradients(kind, said):
    relight = shared(kind)
    state = {name: p.detach() for name, p in relight.named_parameters()}

    def loss(state: dict[str, Tensor]) -> Tensor:
        return torch.func.functional_call(relight, state, (LIGHT, EYES)).square().mean()

    def check() -> None:
        found = list(torch.func.grad(loss)(state).values())
        assert worst(found, gradients(relight, relight)[1:]) < FLOAT

    holds(said, check)


@rows_of("`torch.func.vmap`, `jacrev`, `jacfwd`")
def test_vectorised(kind, said):
    relight = shared(kind)

    def check() -> None:
        mapped = torch.func.vmap(lambda light: relight(light[None], EYES)[0])(LIGHT)
        assert relative(mapped, expected(kind)) < FLOAT
        for jacobian in (torch.func.jacrev, torch.func.jacfwd):
            matrix = jacobian(lambda light: relight(light[None], EYES)[0])(LIGHT[0])
            # Radiance is linear in the light, so its Jacobian gives all of it.
            found = torch.einsum("vpcik,bik->bvpc", matrix, LIGHT)
            assert relative(found, expected(kind)) < 10 * FLOAT

    holds(said, check)


@rows_of("gradients after use in `inference_mode`")
def test_gradients_after_inference(kind, said):
    relight = made(kind).requires_grad_(False)
    with torch.inference_mode():
        assert relative(relight(LIGHT, EYES), expected(kind)) < FLOAT

    def check() -> None:
        light = LIGHT.clone().requires_grad_()
        relight(light, EYES).square().mean().backward()
        assert light.grad is not None
        assert relative(light.grad, gradients(shared(kind), shared(kind))[0]) < FLOAT

    holds(said, check)


@rows_of("made in `inference_mode`")
def test_made_in_inference_mode(kind, said):
    def check() -> None:
        with torch.inference_mode():
            assert relative(made(kind)(LIGHT, EYES), expected(kind)) < FLOAT

    holds(said, check)


@rows_of("`deepcopy`, `pickle`, `state_dict`")
def test_copies(kind, said):
    assert said == "yes"
    relight = made(kind)
    with torch.no_grad():  # a state that no construction gives
        for parameter in relight.parameters():
            parameter.mul_(1.01)
    wanted = relight.eval()(LIGHT, EYES)
    assert torch.equal(copy.deepcopy(relight)(LIGHT, EYES), wanted)
    assert torch.equal(pickle.loads(pickle.dumps(relight))(LIGHT, EYES), wanted)
    other = made(kind)
    other.load_state_dict(relight.state_dict())
    assert torch.equal(other.eval()(LIGHT, EYES), wanted)
    for one, two in zip(relight.state_dict().values(), other.state_dict().values(), strict=True):
        assert torch.equal(one, two)


@pytest.mark.parametrize("kind", BUDGETS)
def test_geometry_goes_where_the_module_goes(kind):
    rest = glossy().surface
    rounded = made(kind).to(torch.bfloat16).representation
    assert torch.equal(rounded.surface.frames, rest.frames)  # casting parameters moves no point
    assert torch.equal(rounded.surface.positions, rest.positions)
    surface = made(kind).to("meta").representation.surface  # a device that every machine has
    assert {surface.frames.device.type, surface.positions.device.type} == {"meta"}


@rows_of("refuses a checkpoint of other clusters")
def test_checkpoints_of_other_clusters(kind, said):
    values = glossy().dense()[torch.randperm(60, generator=torch.Generator().manual_seed(3))]
    other = made(kind, replace(glossy(), values=values))
    relight = made(kind)
    match said:
        case "yes":
            with pytest.raises(ValueError, match="another clustering"):
                relight.load_state_dict(other.state_dict())
            assert torch.equal(relight(LIGHT, EYES), expected(kind))
        case "loads it":
            relight.load_state_dict(other.state_dict())
            assert torch.equal(relight.eval()(LIGHT, EYES), other(LIGHT, EYES))
        case _:
            assert said == "no"
            relight.load_state_dict(other.state_dict())
            assert relative(relight.eval()(LIGHT, EYES), other(LIGHT, EYES)) > 0.1


@rows_of("reflectance as a parameter")
def test_reflectance_as_a_parameter(kind, said):
    relight = made(kind)
    reflectance = nn.Parameter(0.5 * relight.representation.reflectance)
    relight.representation.reflectance = reflectance

    def check() -> None:
        radiance = relight(LIGHT, EYES)
        assert relative(radiance, 0.5 * expected(kind)) < FLOAT
        radiance.sum().backward()
        assert reflectance.grad is not None
        by_point = (radiance / reflectance).sum((0, 1)).detach()
        assert relative(reflectance.grad, by_point) < 1e-3

    holds(said, check)


@rows_of("`torch.export`", "scattered_srbf")
def test_exported(kind, said, without_type_checker):
    relight = made(kind)

    def check() -> None:
        with torch.no_grad():
            program = torch.export.export(relight, (LIGHT, EYES))
            assert relative(program.module()(LIGHT, EYES), expected(kind)) < FLOAT
            # Nothing that was traced may stay behind in a table.
            assert relative(relight(LIGHT, EYES), expected(kind)) < FLOAT

    holds(said, check)


@rows_of("posed by `frames`")
def test_posed(kind, said, without_type_checker):
    relight = shared(kind)
    rest = glossy().surface.frames
    assert rest is not None
    turn = frame_from_normal(torch.tensor([0.6, 0.0, 0.8]))
    frames = torch.stack([rest, rest @ turn.mT]).requires_grad_()

    def check() -> None:
        radiance = relight(LIGHT[:1], frames=frames, views=torch.zeros(1, 60, 3) + turn[2])
        (slope,) = torch.autograd.grad(radiance.square().mean(), frames)
        assert torch.isfinite(slope).all()
        assert float(slope[1].abs().max()) > 0

    holds(said, check)


def share(rank: int, folder: Path, port: int) -> None:
    """One of two processes."""
    torchrun = {"RANK": rank, "WORLD_SIZE": 2, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    os.environ.update({name: str(value) for name, value in torchrun.items()})
    (block,) = (one for one in blocks() if "torch.distributed" in one)
    diffuse = TransferTensor.from_dense(glossy().dense()[:, :, :1])
    relight = made("cpca", diffuse)
    space = {
        "torch": torch,
        "relight": relight,
        "known": LIGHT,
        "expected": 0.5 * relight(LIGHT).detach(),
    }
    exec(compile(block, "docs/layer.md", "exec"), space)
    torch.distributed.init_process_group(
        "gloo", store=torch.distributed.FileStore(str(folder / "store"), 2), rank=rank, world_size=2
    )
    page = [p.grad for p in relight.parameters() if p.grad is not None]
    wanted = torch.autograd.grad(
        misfit(relight(LIGHT), space["expected"]), list(relight.parameters())
    )
    errors = {"page": [worst(page, list(wanted))]}
    layers = {}
    for kind in SAID["`DistributedDataParallel`"]:
        relight = made(kind)
        if rank == 0:  # what one process did before must not matter
            with torch.no_grad():
                relight(LIGHT, EYES)
        layers[kind] = DistributedDataParallel(relight, broadcast_buffers=False)
        errors[kind] = split_errors(layers[kind], relight, slice(rank, None, 2))
    leave(folder, rank, errors)


def split_errors(layer: DistributedDataParallel, relight: Relighter, own: slice) -> list[float]:
    """Errors of averaged gradients where lights are shared out, and where points are."""
    goal = torch.rand(4, 2, 60, 3, generator=torch.Generator().manual_seed(2))
    misfit(relight(LIGHT, EYES), goal).backward()
    wanted = [p.grad.clone() for p in relight.parameters() if p.grad is not None]
    errors = []
    for lights, points in ((own, slice(None)), (slice(None), own)):
        relight.zero_grad()
        misfit(layer(LIGHT[lights], EYES)[:, :, points], goal[lights][:, :, points]).backward()
        found = [p.grad for p in relight.parameters() if p.grad is not None]
        errors.append(worst(found, wanted))
    return errors


def misfit(radiance: Tensor, goal: Tensor) -> Tensor:
    return (radiance - goal).square().mean()


@pytest.mark.slow  # two more imports of torch: 16 s
def test_two_processes(tmp_path):
    assert set(SAID["`DistributedDataParallel`"].values()) == {"yes"}
    spawn = multiprocessing.get_context("spawn").Process
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    both = [spawn(target=share, args=(rank, tmp_path, port), daemon=True) for rank in range(2)]
    for one in both:
        one.start()
    try:
        for one in both:
            one.join(timeout=120)
        assert [one.exitcode for one in both] == [0, 0]
    finally:
        for one in both:
            one.kill()
    for rank in range(2):
        errors = json.loads((tmp_path / f"{rank}.json").read_text())
        assert set(errors) == {"page", *KINDS}
        assert max(max(pair) for pair in errors.values()) < 1e-5
