"""Clustered tensors of several materials: view bases, shares of clusters, overdraw, bakes."""

from dataclasses import replace

import pytest
import torch
from contract import contract_by_dense, random_transfer, relative
from torch import Tensor

from prt_torch.assets import concatenate, mesh_from_arrays
from prt_torch.assets.brdf import Phong
from prt_torch.assets.material import Material
from prt_torch.baking import bake
from prt_torch.bases import Rowwise, SphericalHarmonics
from prt_torch.errors import InputError
from prt_torch.evaluate import transfer_error
from prt_torch.representations import CPCA, ClusteredTensor
from prt_torch.representations.clustered_tensor_groups import share_out, split
from prt_torch.representations.coherence import draws
from prt_torch.representations.cpca_relabel import coherence
from prt_torch.transfer import Surface, TransferTensor, add


def normal(*shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def of_rank(points: int, rows: int, coeffs: int, view: int, seed: int) -> Tensor:
    """Transfer of Tucker ranks 4, ``view`` and 5, of points, rows and light."""
    core = torch.einsum("pa,avl->pvl", normal(points, 4, seed=seed), normal(4, view, 5, seed=seed))
    by_row = normal(rows, view, seed=seed + 1) @ core
    return by_row @ normal(5, coeffs, seed=seed + 2)


def two_materials(dtype: torch.dtype = torch.float64) -> TransferTensor:
    """Interleaved points of view ranks 3 and 1 in 8 rows; those of rank 1 have one row."""
    shiny = of_rank(90, 8, 12, 3, seed=1)
    ground = torch.zeros(150, 8, 12, dtype=torch.float64)
    ground[:, 2:3] = of_rank(150, 1, 12, 1, seed=7)
    order = torch.randperm(240, generator=torch.Generator().manual_seed(5))
    materials = torch.tensor([4, 1]).repeat_interleave(torch.tensor([90, 150]))[order]
    values = torch.cat([shiny, ground])[order].to(dtype)
    return TransferTensor.from_dense(values, materials=materials)


def squared_error(model: ClusteredTensor, transfer: TransferTensor) -> float:
    with torch.no_grad():
        return float((model.dense() - transfer.dense()).square().sum())


def test_rows_of_different_subspaces_are_recovered_where_one_basis_cannot():
    values = torch.cat([of_rank(60, 8, 15, 3, seed=1), of_rank(80, 8, 15, 3, seed=30)])
    order = torch.randperm(140, generator=torch.Generator().manual_seed(3))
    materials = (order >= 60).long()
    mixed = TransferTensor.from_dense(values[order])
    known = TransferTensor.from_dense(values[order], materials=materials)
    options = {"num_clusters": 2, "ranks": (3, 5, 4), "bits": None}
    model = ClusteredTensor.from_transfer(known, **options)
    shared = ClusteredTensor.from_transfer(mixed, **options)
    assert relative(model.dense(), known.dense()) < 1e-9
    assert relative(shared.dense(), known.dense()) > 0.1
    assert shared.cores.shape == model.cores.shape
    assert torch.equal(model.groups[model.labels], materials)


def test_points_of_one_row_take_one_column_and_zeros():
    transfer = two_materials()
    model = ClusteredTensor.from_transfer(
        transfer, num_clusters=6, ranks=(5, 5, 4), bits=None, tolerance=0.0
    )
    assert relative(model.dense(), transfer.dense()) < 1e-9
    materials = transfer.surface.materials
    assert materials is not None
    assert torch.equal(model.groups[model.labels] == 1, materials == 4)
    views, cores = model.view_basis.detach(), model.cores.detach()
    assert views.shape == (2, 8, 3)  # of 5 asked for, 3 are there
    assert float(views[0, :, 1:].abs().max()) == 0.0
    assert float(views[0, 2, 0].abs()) == pytest.approx(1.0)
    assert float(cores[model.groups == 0][:, :, 1:].abs().max()) == 0.0


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("local", [False, True])
def test_forward_is_the_contraction_of_dense(channels, local):
    plain = random_transfer(channels=channels, rows=4)
    materials = torch.arange(60) % 3
    transfer = replace(plain, surface=replace(plain.surface, materials=materials))
    model = ClusteredTensor.from_transfer(transfer, num_clusters=7, ranks=(3, 5, 3)).eval()
    assert len(model.view_basis) == 3
    light = normal(2, *((60,) if local else ()), 9, 3, seed=2).requires_grad_()
    expected = contract_by_dense(model.dense(), light)
    assert relative(model(light), expected) < 1e-12
    points = torch.tensor([7, 3, 59, 3])
    assert relative(model.dense(points), model.dense()[points]) < 1e-12
    model(light).square().sum().backward()
    assert all(float(own.grad.abs().max()) > 0 for own in model.parameters())


@pytest.mark.parametrize("bits", [16, None])
def test_what_is_written_is_exact(bits):
    transfer = two_materials(dtype=torch.float32)
    model = ClusteredTensor.from_transfer(transfer, num_clusters=5, ranks=(3, 4, 3), bits=bits)
    packed = model.packed()
    assert packed["groups"].tolist() == model.groups.tolist()
    assert packed["groups"].nbytes == 5
    loaded = ClusteredTensor.from_packed(packed, model.surface, model.shape)
    assert torch.equal(loaded.eval().dense(), model.eval().dense())
    assert all(torch.equal(loaded.packed()[name], own) for name, own in packed.items())


def test_one_material_is_as_if_none_were_known():
    plain = random_transfer(points=150, rows=5, coeffs=12, dtype=torch.float32)
    named = replace(
        plain, surface=replace(plain.surface, materials=torch.full((150,), 3, dtype=torch.long))
    )
    options = {"num_clusters": 6, "ranks": (3, 4, 3)}
    packed = [ClusteredTensor.from_transfer(t, **options).packed() for t in (plain, named)]
    assert "groups" not in packed[0]
    assert packed[0].keys() == packed[1].keys()
    assert all(torch.equal(own, packed[1][name]) for name, own in packed[0].items())


def test_a_group_is_what_its_points_alone_are():
    """Labels, bases and errors of each material are those of its own tensor."""
    transfer = two_materials()
    materials = transfer.surface.materials
    assert materials is not None
    noisy = replace(transfer, values=transfer.dense() + 0.2 * normal(*transfer.dense().shape))
    options = {"ranks": (3, 4, 3), "bits": None}
    generator = torch.Generator().manual_seed(0)
    model = ClusteredTensor.from_transfer(noisy, num_clusters=9, generator=generator, **options)
    generator, lost = torch.Generator().manual_seed(0), 0.0
    for group, kind in enumerate((1, 4)):
        own = TransferTensor.from_dense(noisy.dense()[materials == kind])
        count = int((model.groups == group).sum())
        alone = ClusteredTensor.from_transfer(
            own, num_clusters=count, generator=generator, **options
        )
        lost += squared_error(alone, own)
        assert relative(model.dense()[materials == kind], alone.dense()) < 1e-9
    facts = model.statistics
    assert facts is not None
    assert facts.squared_error == pytest.approx(lost, rel=1e-9)
    assert squared_error(model, noisy) == pytest.approx(lost, rel=1e-9)
    assert facts.squared_norm == pytest.approx(float(noisy.dense().square().sum()))
    assert facts.errors == sorted(facts.errors, reverse=True)
    assert facts.errors[-1] == pytest.approx(lost, rel=1e-6)


def test_clusters_go_where_the_norm_is():
    assert share_out(10, [8.0, 2.0], [1000, 9000]) == [8, 2]
    assert share_out(3, [1.0, 0.0, 0.0], [50, 50, 50]) == [1, 1, 1]
    assert share_out(12, [1.0, 0.0], [4, 50]) == [4, 8]  # no more clusters than points
    assert share_out(140, [5.0], [20]) == [20]
    with pytest.raises(InputError, match="num_clusters: 3 materials need a cluster each, got 2"):
        share_out(2, [1.0] * 3, [9] * 3)


def test_parts_are_read_by_runs():
    values = normal(40, 1, 2, 3)
    materials = torch.tensor([0, 0, 1, 0, 1, 1, 1, 0]).repeat(5)
    parts = split(TransferTensor(values, Surface(Rowwise(2), materials=materials)))
    assert len(parts) == 2
    for points, part in parts:
        assert torch.equal(part.dense(), values[points])
        assert torch.equal(part.values[3:9], values[points[3:9]])


class TestMaterialsOfATransfer:
    def test_blocks_keep_them(self):
        transfer = two_materials()
        assert transfer.surface.materials is not None
        kept = transfer.block(slice(10, 17)).surface.materials
        assert kept is not None
        assert torch.equal(kept, transfer.surface.materials[10:17])

    def test_sums_keep_them(self):
        transfer = two_materials()
        plain = replace(transfer, surface=replace(transfer.surface, materials=None))
        for terms in ([plain, transfer], [transfer, plain], [transfer, transfer]):
            assert add(terms).surface.materials is transfer.surface.materials
        assert add([plain, plain]).surface.materials is None
        other = replace(transfer.surface, materials=torch.zeros(240, dtype=torch.long))
        with pytest.raises(ValueError, match="same materials"):
            add([transfer, replace(transfer, surface=other)])

    def test_one_a_point(self):
        with pytest.raises(ValueError, match="materials of 5 points, got 4"):
            TransferTensor.from_dense(torch.zeros(5, 3), materials=torch.zeros(4, dtype=torch.long))


def hills(points: int, name: str):
    """A small height field with shadows on itself."""
    line = torch.linspace(-1, 1, points, dtype=torch.float64)
    x, z = torch.meshgrid(line, line, indexing="ij")
    vertices = torch.stack([x, 0.4 * torch.sin(3 * x) * torch.cos(4 * z), z], dim=-1)
    corner = (torch.arange(points - 1)[:, None] * points + torch.arange(points - 1)).reshape(-1)
    upper = torch.stack([corner, corner + 1, corner + points + 1], 1)
    lower = torch.stack([corner, corner + points + 1, corner + points], 1)
    return mesh_from_arrays(name, vertices.reshape(-1, 3), torch.cat([upper, lower]))


def test_a_bake_of_two_materials():
    scene = concatenate([hills(5, "floor"), hills(4, "lid")], "scene")
    common = {"light_basis": SphericalHarmonics(3), "resolution": 8, "supersampling": 1}
    baked = bake(scene, materials={"lid": Material(glossy=Phong(1.0, 8.0))}, **common)
    materials = baked.surface.materials
    assert materials is not None
    assert materials.tolist() == [0] * (scene.num_points - 16) + [1] * 16
    assert bake(scene, **common).surface.materials is None
    options = {"num_clusters": 4, "ranks": (2, 6, 4)}
    model = ClusteredTensor.from_transfer(baked, **options)
    plain = replace(baked, surface=replace(baked.surface, materials=None))
    shared = ClusteredTensor.from_transfer(plain, **options)
    assert torch.equal(model.groups[model.labels] == model.groups[model.labels[-1]], materials == 1)
    assert transfer_error(model, baked) < transfer_error(shared, baked)


class TestOverdraw:
    faces = torch.tensor([[0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5]])

    def test_clusters_that_fit_are_drawn_together(self):
        labels = torch.tensor([0, 0, 0, 1, 1, 2])
        alone = {"overdraw": 1.75, "superclusters": 3, "overdraw_merged": 1.75}
        assert draws(labels, self.faces, torch.tensor([200, 200, 200])) == alone
        found = draws(labels, self.faces, torch.tensor([100, 100, 100]))
        assert found == {"overdraw": 1.75, "superclusters": 2, "overdraw_merged": 1.25}

    @pytest.mark.parametrize(("view", "superclusters"), [(8, 1), (9, 2)])
    def test_a_clustered_tensor_takes_rank_times_view_numbers(self, view, superclusters):
        """Three clusters of 42 vectors: 252 registers for 8 numbers a vector, 378 for 9."""
        transfer = TransferTensor.from_dense(normal(6, 16, 90))
        model = ClusteredTensor.from_transfer(transfer, num_clusters=3, ranks=(view, 9, 2))
        cores = torch.zeros(3, 42, model.cores.shape[2], 1, dtype=torch.float64)
        model.cores = torch.nn.Parameter(cores)
        faces = torch.combinations(torch.arange(6), 3)
        assert model.coherence(faces)["superclusters"] == superclusters

    def test_linear_clusters_have_no_mean(self):
        """Rank 64 and diffuse: four clusters of 256 registers without a mean, three with one."""
        transfer = random_transfer(points=40, coeffs=9)
        faces = torch.combinations(torch.arange(40), 3)
        for affine, superclusters in ((False, 4), (True, 5)):
            model = CPCA.from_transfer(transfer, num_clusters=13, rank=9, affine=affine)
            model.ranks = torch.full_like(model.ranks, 64)
            assert coherence(model, faces)["superclusters"] == superclusters
