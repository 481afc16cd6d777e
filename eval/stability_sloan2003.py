"""Extremes of Sloan, Hall, Hart, Snyder 2003: hemispherical projections and clustered subspaces."""

import torch
from stability_case import (
    Collection,
    Outcome,
    at_least,
    at_most,
    exactly,
    near,
    not_finite,
    relative_error,
    rounding,
)
from stability_problems import every_representation, generator, light_of, stiff_matrix
from torch import Tensor

from prt_torch import evaluate
from prt_torch.bases import HemisphericalHarmonics, sh
from prt_torch.quantize import dequantize, full_scale, quantize
from prt_torch.representations import CPCA
from prt_torch.transfer import TransferTensor

CASES = Collection("Sloan 2003")
_METHODS = ("static", "iterative", "adaptive")


@CASES.case(
    "hemisphere-order-8",
    given="inner products of harmonics over the hemisphere at order 8, condition 3.5e9",
    required="float64 or truncation, never a float32 inverse",
)
def hemisphere_order_8(dtype: torch.dtype) -> Outcome:
    """Project a function of the space, and see how much noise a projection could multiply."""
    gram = sh.hemisphere_gram(8)
    eigenvalues = torch.linalg.eigvalsh(gram)
    directions, weights = (t.to(dtype) for t in sh.hemisphere_quadrature(32))
    functions = sh.evaluate(directions, 8)
    projection = sh.hemisphere_projection(functions, weights)
    root = weights.sqrt()
    gain = torch.linalg.matrix_norm((projection / root).double(), 2) * eigenvalues[-1].sqrt()
    wanted = functions @ torch.randn(64, 1, generator=generator()).to(dtype)
    again = functions @ (projection @ wanted)
    single = gram.float()
    naive = torch.linalg.inv(single) @ single - torch.eye(64)
    rows = torch.randn(5, 64, 9, generator=generator(1)).to(dtype)
    transfer = TransferTensor.from_dense(rows, exit_basis=HemisphericalHarmonics(64))
    model = CPCA.from_transfer(transfer, num_clusters=5, rank=4)
    return Outcome(
        (
            near("condition at order 8", eigenvalues[-1] / eigenvalues[0], 3.465e9, 1e-3),
            # Weights of combinations below 1e-3 of the largest norm are taken as zero.
            at_most("largest gain of noise", gain, 1.001e3),
            at_most(
                "error of a function of the space",
                relative_error(again * root[:, None], wanted * root[:, None]),
                2e-3,
            ),
            at_most(
                "squared error of 64 rows kept whole",
                evaluate.transfer_error(model, transfer),
                3.5e9 * rounding(dtype) ** 2,
            ),
        ),
        condition=float(eigenvalues[-1] / eigenvalues[0]),
        note=f"a float32 inverse of the matrix is off by {float(naive.abs().max()):.2g}",
    )


@CASES.case(
    "singular-values-to-1e-9",
    given="points of one cluster whose tenth singular value is 1e-9 of the first",
    required="singular values of the points, not of their squares",
)
def singular_values(dtype: torch.dtype) -> Outcome:
    """What nine of ten vectors leave is the tenth singular value, if no digits are lost."""
    exact = stiff_matrix(80, 10, 1e9, generator())
    transfer = TransferTensor.from_dense(exact.to(dtype))
    checks, condition = [], 1.0
    for method in _METHODS:
        model = CPCA.from_transfer(transfer, num_clusters=1, rank=9, affine=False, method=method)
        lost = float((model.dense().detach()[:, 0, 0].double() - exact).norm())
        # Rounding the points to float32 alone costs 1e-7 of the first.
        checks.append(
            at_most(f"left by 9 of 10 vectors, {method}", lost, 1e-9 + 3 * rounding(dtype))
        )
        condition = max(condition, model.condition)
    expected = 1e8
    if dtype == torch.float64:
        checks.append(near("condition of the kept vectors", condition, expected, 1e-3))
    return Outcome(tuple(checks), condition=condition)


@CASES.case(
    "identical-points",
    given="30 points that are all the same",
    required="mean exact, vectors with zero weights, error 0",
)
def identical_points(dtype: torch.dtype) -> Outcome:
    """One cluster, whatever was asked for."""
    values = torch.randn(1, 9, generator=generator()).to(dtype).expand(30, 9)
    transfer = TransferTensor.from_dense(values)
    models = [
        CPCA.from_transfer(transfer, num_clusters=4, rank=3, method=method) for method in _METHODS
    ]
    difference = max(float((m.dense().detach()[:, 0, 0] - values).abs().max()) for m in models)
    weights = max(float(m.weights.detach().abs().max()) for m in models if len(m.weights))
    return Outcome(
        (
            at_most("largest error", difference, rounding(dtype) * float(values.abs().max())),
            exactly("largest weight", weights, 0),
            exactly("clusters", max(model.num_clusters for model in models), 1),
            exactly("numbers not finite", _not_finite(models), 0),
        )
    )


@CASES.case(
    "rank-above-members",
    given="clusters of 3 points at rank 8",
    required="no division by zero singular values; spare vectors zero, error 0",
)
def rank_above_members(dtype: torch.dtype) -> Outcome:
    """Four far groups of three points, which two vectors beside the mean hold exactly."""
    centres = 10.0 * torch.eye(4, 20).repeat_interleave(3, 0)
    values = (centres + torch.randn(12, 20, generator=generator())).to(dtype)
    transfer = TransferTensor.from_dense(values)
    models = [
        CPCA.from_transfer(transfer, num_clusters=4, rank=8, method=method) for method in _METHODS
    ]
    error = max(evaluate.transfer_error(model, transfer) for model in models)
    spare = models[0].layout.by_cluster(models[0].representatives.detach())[:, 3:]
    return Outcome(
        (
            at_most("squared error", error, (16 * rounding(dtype)) ** 2),
            exactly("largest number of a spare vector", spare.abs().max(), 0),
            exactly("numbers not finite", _not_finite(models), 0),
        ),
        condition=max(model.condition for model in models),
    )


@CASES.case(
    "empty-clusters",
    given="two tight heaps of points and one outlier, asked for 8 clusters",
    required="clusters without points start again from the worst point; no NaN mean",
    seconds=120.0,
    seeded=True,
)
def empty_clusters(dtype: torch.dtype, seeds: int) -> Outcome:
    """Seeds fall into the heaps, where most means would lose all their points."""
    smallest, bad, worst = 40, 0, 0.0
    for seed in range(seeds):
        points = 1e-3 * torch.randn(41, 12, generator=generator(seed)).to(dtype)
        points[20:40] += 1.0
        points[40] = 50.0
        transfer = TransferTensor.from_dense(points)
        model = CPCA.from_transfer(
            transfer,
            num_clusters=8,
            rank=1,
            method=_METHODS[seed % len(_METHODS)],
            generator=generator(seed),
        )
        sizes = torch.bincount(model.labels, minlength=model.num_clusters)
        smallest = min(smallest, int(sizes.min()))
        bad += _not_finite([model])
        worst = max(worst, evaluate.transfer_error(model, transfer))
    return Outcome(
        (
            at_least("points of the smallest cluster", smallest, 1),
            exactly("numbers not finite", bad, 0),
            # The heaps are 1e-3 wide and the outlier is 50 away from them.
            at_most("squared error", worst, 1e-6),
        )
    )


@CASES.case(
    "zero-transfer",
    given="transfer that is zero everywhere, in every representation",
    required="representatives zero, relative error defined as 0",
)
def zero_transfer(dtype: torch.dtype) -> Outcome:
    """Closed form, errors and radiance."""
    models = every_representation(torch.zeros(12, 36, dtype=dtype))
    errors = [evaluate.transfer_error(model, transfer) for model, transfer in models]
    lit = [model(light_of(transfer)) for model, transfer in models]
    dense = [model.dense().detach() for model, _ in models]
    return Outcome(
        (
            exactly("representations", len(models), 7),
            exactly("largest relative error", max(errors), 0),
            exactly("largest transfer", max(float(one.abs().max()) for one in dense), 0),
            exactly("largest radiance", max(float(one.detach().abs().max()) for one in lit), 0),
            exactly("numbers not finite", _not_finite([model for model, _ in models]), 0),
        )
    )


@CASES.case(
    "codes-of-weights",
    given="weights of 8 vectors as bf16, f16, int16 and int8 a column; a constant column",
    required="relative error about 8.9e-4, 1.07e-4, 1.3e-5, 3.4e-3; a constant column exact",
)
def codes_of_weights(dtype: torch.dtype) -> Outcome:
    """Of a cluster whose mean is most of it; twice the numbers of the table are allowed."""
    size = 2.0 * 0.7 ** torch.arange(8)
    spread = torch.randn(500, 8, generator=generator()) * size
    vectors = torch.linalg.qr(torch.randn(36, 8, generator=generator(1)))[0]
    points = (1.0 + spread @ vectors.mT).to(dtype)
    model = CPCA.from_transfer(TransferTensor.from_dense(points), num_clusters=1, rank=8)
    weights = model.weights.detach().view(500, 8)
    norm = float(points.norm())  # vectors are orthonormal, so errors of weights are those of points

    def coded(bits: int, values: Tensor) -> Tensor:
        step = full_scale(values, bits, dim=0)
        return dequantize(quantize(values, step, bits), step, values.dtype)

    constant = torch.full((50, 2), 0.37, dtype=dtype)
    constant[:, 1] = 0.0
    kept = {
        "bf16": (weights.bfloat16().to(dtype), 8.9e-4),
        "f16": (weights.half().to(dtype), 1.07e-4),
        "int16": (coded(16, weights), 1.3e-5),
        "int8": (coded(8, weights), 3.4e-3),
    }
    checks = [
        at_most(f"relative error of {name}", (found - weights).norm() / norm, 2.0 * limit)
        for name, (found, limit) in kept.items()
    ]
    lost = max(float((coded(bits, constant) - constant).abs().max()) for bits in (8, 16))
    return Outcome((*checks, at_most("error of a constant column", lost, rounding(dtype))))


def _not_finite(models: list) -> int:
    return not_finite(tensor.detach() for model in models for tensor in model.parameters())
