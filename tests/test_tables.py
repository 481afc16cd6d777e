"""Kept tables: where they are first asked for decides nothing."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from prt_torch.bases import SRBF, CubeDirections, Haar, LightBasis
from prt_torch.bases.zonal_table import LatLongTable, band_table
from prt_torch.representations.zonal_lobes_objective import LobeObjective

Call = Callable[[Tensor], Tensor]


def of(make: Callable[[], LightBasis], name: str) -> Callable[[], Call]:
    return lambda: getattr(make(), name)


def turned() -> Call:
    basis = SRBF(12, resolution=2)
    return lambda light: basis.rotate(light, torch.eye(3)[[1, 2, 0]])


def bands(cols: int) -> Call:  # a grid that nothing else asks for
    return lambda light: band_table(light, LatLongTable(3, cols))


def lobes(order: int) -> Call:
    axes = torch.eye(3, dtype=torch.float64)[..., None].expand(3, 3, 2)
    return lambda targets: LobeObjective(targets, 2, 1e-3).evaluate(axes[:2]).objective


class Layer(nn.Module):
    def __init__(self, call: Call):
        super().__init__()
        self.call = call

    def forward(self, values: Tensor) -> Tensor:
        return self.call(values)


def in_inference_mode(call: Call, values: Tensor) -> None:
    with torch.inference_mode():
        call(values)


def in_export(call: Call, values: Tensor) -> None:
    torch.export.export(Layer(call), (values,), strict=False)


OF_BASES: dict[str, tuple[Callable[[], Call], tuple[int, ...]]] = {
    "texels": (of(lambda: SRBF(12, resolution=2), "project_texels"), (24, 3)),
    "weigh": (of(lambda: SRBF(12, resolution=2), "weigh"), (2, 12)),
    "weigh_light": (of(lambda: SRBF(12, resolution=2), "weigh_light"), (12, 3)),
    "turned": (turned, (12, 3)),
    "cube": (of(lambda: CubeDirections(2), "weigh"), (2, 24)),
    "haar": (of(lambda: Haar(4, 2), "weigh"), (2, 96)),
}
CASES = [
    pytest.param(first, *case, id=f"{name} {first.__name__}")
    for first in (in_inference_mode, in_export)
    for name, case in OF_BASES.items()
]
CASES += [  # of the process, so each of these asks for a table that no other does
    pytest.param(in_inference_mode, lambda: bands(5), (9,), id="bands in_inference_mode"),
    pytest.param(in_export, lambda: bands(7), (9,), id="bands in_export"),
    pytest.param(in_inference_mode, lambda: lobes(7), (2, 49), id="lobes in_inference_mode"),
    pytest.param(in_export, lambda: lobes(8), (2, 64), id="lobes in_export"),
]


@pytest.mark.parametrize(("first", "make", "shape"), CASES)
def test_gradients_pass_wherever_a_table_was_made(first, make, shape, without_type_checker):
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(shape, generator=generator, dtype=torch.float64)
    call = make()
    first(call, values)
    tracked = values.clone().requires_grad_()
    found = call(tracked)
    assert torch.allclose(found, make()(values), rtol=1e-12, atol=0)
    along = torch.rand(shape, generator=generator, dtype=torch.float64)
    found.sum().backward()
    ahead, behind = (call(values + step * along).sum() for step in (1e-6, -1e-6))
    assert float((tracked.grad * along).sum()) == pytest.approx(
        float(ahead - behind) / 2e-6, rel=1e-5
    )


def test_tables_are_made_once():
    basis = SRBF(12, resolution=2)
    basis.weigh(torch.zeros(1, 12))
    assert basis._root is basis._root
