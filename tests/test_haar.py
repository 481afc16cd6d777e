"""The Haar transform and the light bases that norms and radiance must agree between."""

from pathlib import Path

import pytest
import torch
from tolerances import ROUNDING

from prt_torch.assets import find_environment, mesh_from_arrays
from prt_torch.baking import bake
from prt_torch.bases import CubeDirections, Haar, LightBasis, SphericalHarmonics, haar, light_basis
from prt_torch.config import load_config
from prt_torch.errors import InputError
from prt_torch.evaluate import dense_radiance, transfer_error
from prt_torch.inputs import load_inputs
from prt_torch.metric import Metric
from prt_torch.representations import CPCA
from prt_torch.sphere import cubemap_directions, cubemap_index, rotation_about_up
from prt_torch.transfer import TransferTensor

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
BOTH = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def random(*shape: int, dtype=torch.float64, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def by_definition(image: torch.Tensor) -> torch.Tensor:
    """One image, one block of four at a time."""
    out, means = torch.zeros_like(image), image.clone()
    while len(means) > 1:
        half = len(means) // 2
        smaller = means.new_zeros(half, half)
        for row in range(half):
            for col in range(half):
                a, b, c, d = means[2 * row : 2 * row + 2, 2 * col : 2 * col + 2].flatten().tolist()
                smaller[row, col] = (a + b + c + d) / 2
                out[row, half + col] = (a - b + c - d) / 2
                out[half + row, col] = (a + b - c - d) / 2
                out[half + row, half + col] = (a - b - c + d) / 2
        means = smaller
    out[0, 0] = means[0, 0]
    return out


class TestTransform:
    @BOTH
    @pytest.mark.parametrize("edge", [1, 2, 8, 64])
    def test_orthonormal_and_invertible(self, edge: int, dtype: torch.dtype):
        image = random(3, edge, edge, dtype=dtype)
        coefficients = haar.forward(image)
        assert coefficients.dtype == dtype
        norms = coefficients.square().sum((1, 2)), image.square().sum((1, 2))
        assert torch.allclose(*norms, rtol=ROUNDING[dtype])
        assert torch.allclose(haar.inverse(coefficients), image, atol=ROUNDING[dtype])
        assert torch.allclose(haar.forward(haar.inverse(image)), image, atol=ROUNDING[dtype])

    def test_basis_functions_are_orthonormal(self):
        matrix = haar.forward(torch.eye(64, dtype=torch.float64).view(64, 8, 8)).flatten(1)
        assert torch.equal(matrix @ matrix.mT, torch.eye(64, dtype=torch.float64))

    @pytest.mark.parametrize("edge", [2, 4, 16])
    def test_definition(self, edge: int):
        image = random(edge, edge)
        assert torch.allclose(haar.forward(image), by_definition(image), atol=1e-13)

    @pytest.mark.parametrize("edge", [1, 2, 16, 64])
    def test_pywavelets(self, edge: int):
        pywt = pytest.importorskip("pywt", reason="PyWavelets is of the check extra")
        image = random(edge, edge)
        theirs, _ = pywt.coeffs_to_array(pywt.wavedec2(image.numpy(), "haar"))
        assert torch.allclose(haar.forward(image), torch.from_numpy(theirs), atol=1e-12)

    @BOTH
    @pytest.mark.parametrize("shape", [(70, 8, 8), (2, 1, 15, 4, 4), (3, 16, 16)])
    def test_blocks_and_strides_change_nothing(self, shape, dtype: torch.dtype, monkeypatch):
        """More than one cache block; batch axes of any length; rows and columns swapped."""
        images = random(*shape, dtype=dtype)
        at_once = haar.forward(images)
        monkeypatch.setattr(haar, "_BLOCK_BYTES", 1000)
        assert torch.equal(haar.forward(images), at_once)
        one_by_one = torch.stack([haar.forward(image) for image in images.flatten(0, -3)])
        assert torch.equal(at_once.flatten(0, -3), one_by_one)
        swapped = haar.forward(images.mT)
        assert torch.allclose(swapped, at_once.mT, atol=ROUNDING[dtype])
        assert torch.allclose(haar.inverse(swapped.mT), images, atol=ROUNDING[dtype])

    def test_no_images(self):
        assert haar.forward(torch.zeros(0, 4, 4)).shape == (0, 4, 4)

    @BOTH
    def test_constant_has_no_detail(self, dtype: torch.dtype):
        coefficients = haar.forward(torch.full((5, 16, 16), 0.1, dtype=dtype))
        assert (coefficients != 0).sum() == 5
        assert torch.allclose(coefficients[:, 0, 0], torch.tensor(1.6, dtype=dtype))

    @pytest.mark.parametrize("transform", [haar.forward, haar.inverse])
    def test_gradients(self, transform):
        image = random(1, 4, 4).requires_grad_()
        assert torch.autograd.gradcheck(transform, image)
        assert torch.autograd.gradgradcheck(lambda x: transform(x).pow(3), image, fast_mode=True)

    def test_refusals(self, without_type_checker):
        for shape in [(4,), (3, 3), (2, 4), (5, 0, 0)]:
            with pytest.raises(ValueError, match="power of two"):
                haar.forward(torch.zeros(shape))
        with pytest.raises(ValueError, match="floating-point"):
            haar.inverse(torch.zeros(4, 4, dtype=torch.int32))


BASES = [SphericalHarmonics(4), CubeDirections(4), Haar(4, 2), Haar(4, 4), Haar(6, 2), Haar(4, 1)]


@pytest.mark.parametrize("basis", BASES, ids=lambda basis: basis.name)
class TestEveryLightBasis:
    """The contract of norms."""

    def test_weigh_is_a_root_of_the_gram_matrix(self, basis: LightBasis):
        values = random(2, 3, basis.num_coeffs)
        gram = basis.gram()
        gram = torch.diag(gram) if gram.ndim == 1 else gram
        weighed = basis.weigh(values)
        assert weighed.shape == values.shape
        assert torch.allclose(weighed @ weighed.mT, values @ gram @ values.mT, rtol=1e-12)
        assert torch.allclose(basis.squared_norm(values), weighed.square().sum(-1), rtol=1e-14)

    @BOTH
    def test_unweigh_is_the_inverse(self, basis: LightBasis, dtype: torch.dtype):
        values = random(2, 3, basis.num_coeffs, dtype=dtype)
        for there, back in [(basis.weigh, basis.unweigh), (basis.unweigh, basis.weigh)]:
            assert there(values).dtype == dtype
            assert torch.allclose(back(there(values)), values, atol=ROUNDING[dtype])

    @BOTH
    def test_weighed_light_gives_the_same_radiance(self, basis: LightBasis, dtype: torch.dtype):
        light = random(2, basis.num_coeffs, 3, dtype=dtype)
        values = random(5, basis.num_coeffs, dtype=dtype, seed=1)
        weighed = basis.weigh_light(light)
        assert weighed.dtype == dtype
        assert torch.allclose(basis.weigh(values) @ weighed, values @ light, atol=1e-4)
        if dtype == torch.float64:
            assert torch.allclose(basis.weigh(values) @ weighed, values @ light, atol=1e-12)

    def test_description_makes_it_again(self, basis: LightBasis):
        again = light_basis(basis.describe())
        assert type(again) is type(basis)
        assert again.name == basis.name
        assert again.describe() == basis.describe()

    def test_gradients(self, basis: LightBasis):
        values = random(2, basis.num_coeffs).requires_grad_()
        light = random(1, basis.num_coeffs, 3).requires_grad_()
        assert torch.autograd.gradcheck(basis.weigh, values, fast_mode=True)
        assert torch.autograd.gradcheck(basis.unweigh, values, fast_mode=True)
        assert torch.autograd.gradcheck(basis.weigh_light, light, fast_mode=True)


def texel_light(resolution: int, *batch: int) -> torch.Tensor:
    return random(*batch, 6 * resolution**2, 3, seed=3).square()


def of_texels(basis: Haar, texels: torch.Tensor) -> torch.Tensor:
    """Basis coefficients of rows of texels, as transfer is given to it."""
    flat = basis.project_cube(texels.flatten(0, -2), basis.resolution)
    return flat.view(texels.shape)


class TestHaarBasis:
    def test_defaults_are_those_of_liu(self):
        basis = Haar()
        assert (basis.num_coeffs, basis.num_segments, basis.coeffs_per_segment) == (6144, 24, 256)
        assert basis.name == "Haar 6x32x32 in 24 segments"
        assert Haar(64, 64).num_segments == 6

    @pytest.mark.parametrize("segment", [2, 4, 8])
    def test_order_of_segments(self, segment: int):
        """A texel's light is in the coefficients of its own segment, transformed there."""
        basis, along = Haar(8, segment), 8 // segment
        for face, row, col in [(0, 0, 0), (2, 1, 6), (5, 7, 3)]:
            texels = torch.zeros(6, 8, 8, dtype=torch.float64)
            texels[face, row, col] = 1.0
            segments = basis.segments(of_texels(basis, texels.view(1, -1)))[0]
            own = (face * along + row // segment) * along + col // segment
            image = torch.zeros(segment, segment, dtype=torch.float64)
            image[row % segment, col % segment] = 1.0
            expected = torch.zeros_like(segments)
            expected[own] = haar.forward(image).flatten()
            assert torch.equal(segments, expected)

    def test_constant_light_has_one_coefficient_a_segment(self):
        basis = Haar(8, 4)
        flat = of_texels(basis, torch.ones(1, basis.num_coeffs))
        assert (flat != 0).sum() == basis.num_segments
        assert torch.equal(basis.segments(flat)[0, :, 0], torch.full((24,), 4.0))

    @BOTH
    def test_sun_over_ambient(self, dtype: torch.dtype):
        """1e6 in one texel over 1, faces of 64 x 64: six means, three details a level."""
        texels = torch.ones(6 * 64 * 64, dtype=dtype)
        texels[2 * 64 * 64 + 17 * 64 + 42] = 1e6
        basis = Haar(64, 64)
        coefficients = of_texels(basis, texels[None])[0]
        assert (coefficients != 0).sum() == 24
        assert float(coefficients.abs().max()) == 499999.5
        assert basis.segments(coefficients)[[0, 1, 3, 4, 5], 0].tolist() == [64.0] * 5
        restored = basis.weigh(coefficients) * CubeDirections(64).solid_angles.sqrt().to(dtype)
        assert torch.allclose(restored, texels, rtol=ROUNDING[dtype], atol=0.05)  # the ambient

    def test_projected_environment_is_that_of_texels(self):
        sky = find_environment("sky")
        basis, cube = Haar(8, 4), CubeDirections(8)
        light, texels = basis.project(sky), cube.project(sky)
        assert light.dtype == torch.float64
        assert torch.allclose(of_texels(basis, texels.mT), light.mT)
        flux = (texels * cube.solid_angles[:, None]).sum(0)
        kept = basis.weigh_light(light) * basis.weigh_light(of_texels(basis, cube_ones(8)).mT)
        assert torch.allclose(kept.sum(0), flux)

    @BOTH
    def test_radiance_and_norms_agree_with_cube_directions(self, dtype: torch.dtype):
        """From finer texels, through either basis."""
        basis, cube = Haar(8, 4), CubeDirections(8)
        transfer = random(20, 6 * 16 * 16, dtype=dtype)
        texels = texel_light(8).to(dtype)
        in_haar = basis.project_cube(transfer, 16) @ of_texels(basis, texels.mT).mT
        in_cube = cube.project_cube(transfer, 16) @ texels
        assert torch.allclose(in_haar, in_cube, atol=1e-6 * float(in_cube.abs().max()))
        norms = [b.squared_norm(b.project_cube(transfer, 16)) for b in (basis, cube)]
        assert torch.allclose(*norms, rtol=ROUNDING[dtype])

    def test_turned_light_is_that_of_texels(self):
        basis, cube = Haar(8, 4), CubeDirections(8)
        turn, texels = rotation_about_up(33.0), texel_light(8, 2)
        light = of_texels(basis, texels.mT).mT
        turned = of_texels(basis, cube.rotate(texels, turn).mT).mT
        assert torch.allclose(basis.rotate(light, turn), turned, atol=1e-12)
        quarter = basis.rotate(light, rotation_about_up(90.0))  # exact: texels to texels
        source = cubemap_directions(8, dtype=torch.float64).view(-1, 3) @ rotation_about_up(90.0)
        assert torch.allclose(
            quarter, of_texels(basis, texels[:, cubemap_index(source, 8)].mT).mT, atol=1e-12
        )

    @pytest.mark.parametrize("basis", [Haar(8, 4), Haar(4, 4), Haar(3, 1)], ids=lambda b: b.name)
    def test_areas_are_supports(self, basis: Haar):
        each = torch.eye(basis.num_coeffs, dtype=torch.float64)
        texels = basis.weigh(each)  # of a texel's segment: zero where the function is
        ones = of_texels(basis, CubeDirections(basis.resolution).solid_angles[None])
        solid_angles = basis.weigh(ones)[0].square()  # integral over root, squared
        support = (texels != 0).double() @ solid_angles
        assert torch.allclose(basis.areas(), support)

    def test_refusals(self):
        for segment in (0, 3, -4):
            with pytest.raises(ValueError, match="power of two"):
                Haar(12, segment)
        for resolution in (0, 24):
            with pytest.raises(ValueError, match="multiple of the segments' 16"):
                Haar(resolution, 16)
        with pytest.raises(ValueError, match="multiple"):
            Haar(8, 4).project_cube(torch.zeros(1, 6 * 12 * 12), 12)
        with pytest.raises(InputError, match="haar"):
            light_basis({"name": "haar", "resolution": 8})


def cube_ones(resolution: int) -> torch.Tensor:
    return torch.ones(1, 6 * resolution**2, dtype=torch.float64)


class TestThroughTheLibrary:
    def test_baked_transfer_is_that_of_cube_directions(self):
        sky = find_environment("sky")
        tent = torch.tensor(
            [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1], [0.5, 0.7, 0.5]], dtype=torch.float64
        )
        faces = torch.tensor([[0, 2, 1], [0, 3, 2], [0, 4, 3], [2, 1, 4]])
        mesh = mesh_from_arrays("tent", tent, faces)
        radiance, norms = [], []
        for basis in (Haar(4, 2), CubeDirections(4)):
            transfer = bake(mesh, light_basis=basis, resolution=4, supersampling=2)
            radiance.append(dense_radiance(transfer, basis.project(sky).float()[None]))
            norms.append(transfer.squared_norm())
            assert (norms[-1] <= transfer.reference_squared_norm * (1 + 1e-5)).all()
        assert float(radiance[0].max()) > 0.01
        assert torch.allclose(*radiance, atol=1e-6 * float(radiance[0].max()))
        assert torch.allclose(*norms, rtol=1e-5)

    def test_fits_are_those_of_cube_directions(self):
        """The weighed spaces are the same but for the order of texels."""
        texels = random(60, 5, seed=4) @ random(5, 96, seed=5) + 0.1 * random(60, 96, seed=6)
        errors = []
        for basis in (Haar(4, 2), CubeDirections(4)):
            values = basis.project_cube(texels, 4)
            transfer = TransferTensor.from_dense(values, light_basis=basis)
            metric = Metric.l2(transfer)
            assert torch.allclose(metric.unweigh(metric.weigh(values)), values, atol=1e-12)
            model = CPCA.from_transfer(transfer, num_clusters=2, rank=3)
            errors.append(transfer_error(model, transfer))
        assert 1e-4 < errors[0] < 0.5
        assert errors[0] == pytest.approx(errors[1], rel=1e-9)


class TestConfiguration:
    @pytest.mark.parametrize(
        ("overrides", "expected"),
        [
            (
                ["transfer.light_basis=haar", "transfer.resolution=16"],
                "Haar 6x16x16 in 24 segments",
            ),
            (
                ["transfer=haar", "transfer.light_resolution=64", "transfer.light_segments=1"],
                "Haar 6x64x64 in 6 segments",
            ),
            (["transfer=cube", "transfer.resolution=12"], "cube 6x12x12"),
            (["transfer=cube", "transfer.light_resolution=64"], "cube 6x64x64"),
        ],
    )
    def test_basis(self, overrides: list[str], expected: str):
        config = load_config(CONFIGS, "fit", overrides)
        assert load_inputs(config).light_basis.name == expected

    @pytest.mark.parametrize(
        ("overrides", "limit"),
        [
            (["transfer=haar", "transfer.light_resolution=48"], "128 rays"),
            (["transfer=haar", "transfer.resolution=24"], "power of two"),
            (["transfer=haar", "transfer.light_segments=3"], "power of two"),
        ],
    )
    def test_refusals(self, overrides: list[str], limit: str):
        with pytest.raises(InputError, match=limit) as caught:
            load_config(CONFIGS, "fit", overrides)
        assert str(caught.value).startswith("transfer")
        assert "\n" not in str(caught.value)
