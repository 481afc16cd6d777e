"""Stiff fits over many seeds: conditions up to 1e14, lobes that nearly coincide.

Each solve is held against float64 QR or against what the problem was made of, and each fit's word
against a measurement of one's own: errors as told, never larger than before, and an ending that the
history bears out.
"""

import math
from collections import Counter

import torch
from stability_case import (
    Collection,
    Outcome,
    at_least,
    at_most,
    exactly,
    not_finite,
    rounding,
    tally,
)
from stability_problems import generator, spread_condition, stiff_matrix
from torch import Tensor

from prt_torch.bases import SphericalHarmonics, srbf, zonal
from prt_torch.fitting import FitResult, fit
from prt_torch.metric import Metric
from prt_torch.representations import CPCA
from prt_torch.transfer import TransferTensor

CASES = Collection("stiff fits")
_TOLERANCE = 1e-3  # share of the error that the last step of a converged fit wins


@CASES.case(
    "least-squares-of-any-condition",
    given="60 samples of 12 functions, condition 1e2 to 1e14, by samples (collocation)",
    required="residuals of float64 QR; coefficients as good as the condition allows; it is told",
    seeded=True,
)
def least_squares(dtype: torch.dtype, seeds: int) -> Outcome:
    """Minimum-norm solutions where singular values are below rounding."""
    residual, error, told, bad, largest = 0.0, 0.0, 0.0, 0, 0.0
    for seed in range(seeds):
        source, condition = generator(seed), spread_condition(seed, seeds)
        kernels = stiff_matrix(60, 12, condition, source).to(dtype).double()
        wanted = torch.randn(12, 2, generator=source).double()
        noise = torch.randn(60, 2, generator=source).double()
        span = torch.linalg.qr(kernels)[0]
        values = kernels @ wanted + 1e-3 * (noise - span @ (span.mT @ noise))
        kernels, values = kernels.to(dtype), values.to(dtype)
        found = srbf.collocation_projection(kernels, values)
        basis, triangle = torch.linalg.qr(kernels.double())
        expected = torch.linalg.solve_triangular(triangle, basis.mT @ values.double(), upper=True)
        kernels, values = kernels.double(), values.double()
        least = (kernels @ expected - values).norm()
        left = (kernels @ found.coefficients.double() - values).norm()
        residual = max(residual, float(left - least) / float(values.norm()))
        if condition * rounding(dtype) < 1e-2:
            # First order: condition for values, its square for what no coefficients explain.
            slack = condition * float(expected.norm()) + condition**2 * float(least)
            off = float((found.coefficients.double() - expected).norm())
            error = max(error, off / (slack * rounding(dtype)))
            told = max(told, abs(found.condition / condition - 1.0))
        bad += not_finite([found.coefficients])
        largest = max(largest, found.condition)
    return Outcome(
        (
            at_most("residual above that of QR, over the values", residual, 60 * rounding(dtype)),
            at_most("error of coefficients over condition times rounding", error, 60.0),
            at_most("relative error of the condition told", told, 0.05),
            exactly("numbers not finite", bad, 0),
        ),
        condition=largest,
    )


@CASES.case(
    "gram-matrices-of-any-condition",
    given="Gram matrices of 12 functions, condition 1e2 to 1e14, by inner products",
    required="the function that was there, to the root of rounding; no LinAlgError",
    seeded=True,
)
def gram_matrices(dtype: torch.dtype, seeds: int) -> Outcome:
    """The squared norm of what is lost is below the least eigenvalue that is kept."""
    error, bad, told, largest = 0.0, 0, 0.0, 0.0
    for seed in range(seeds):
        source, condition = generator(seed), spread_condition(seed, seeds)
        root = stiff_matrix(12, 12, condition**0.5, source)
        gram = root.mT @ root
        wanted = torch.nn.functional.normalize(torch.randn(12, 1, generator=source).double(), dim=0)
        found = srbf.gram_projection(gram.to(dtype), (gram @ wanted).to(dtype))
        error = max(error, float((root @ (found.coefficients.double() - wanted)).norm()))
        bad += not_finite([found.coefficients])
        if condition * rounding(dtype) < 1e-3:
            told = max(told, abs(found.condition / condition - 1.0))
        largest = max(largest, found.condition)
    return Outcome(
        (
            at_most("norm of what is lost", error, 12 * rounding(dtype) ** 0.5),
            at_most("relative error of the condition told", told, 0.05),
            exactly("numbers not finite", bad, 0),
        ),
        condition=largest,
    )


@CASES.case(
    "subspaces-of-any-condition",
    given="a cluster of 40 points in 12 dimensions, condition 1e2 to 1e14, rank 11",
    required="what the singular value decomposition loses, and no more",
    seeded=True,
)
def subspaces(dtype: torch.dtype, seeds: int) -> Outcome:
    """Loss beyond the optimum, over the largest singular value."""
    beyond, bad, largest = 0.0, 0, 0.0
    for seed in range(seeds):
        condition = spread_condition(seed, seeds)
        points = stiff_matrix(40, 12, condition, generator(seed)).to(dtype)
        model = CPCA.from_transfer(
            TransferTensor.from_dense(points), num_clusters=1, rank=11, affine=False
        )
        optimum = torch.linalg.svdvals(points.double())[11:].norm()
        lost = (model.dense().detach()[:, 0, 0].double() - points.double()).norm()
        beyond = max(beyond, float(lost - optimum))
        bad += not_finite(model.parameters())
        largest = max(largest, model.condition)
    return Outcome(
        (
            at_most("loss beyond the optimum", beyond, 4 * rounding(dtype)),
            exactly("numbers not finite", bad, 0),
        ),
        condition=largest,
    )


@CASES.case(
    "lobes-that-nearly-coincide",
    given="two lobes 1e-1 to 1e-12 rad apart, fitted to random signals of norm 1",
    required="coefficients bounded by the ridge; no worse than one lobe",
    seeded=True,
)
def coincident_lobes(dtype: torch.dtype, seeds: int) -> Outcome:
    """Without a ridge they grow as one over the distance."""
    ridge, growth, worse, bad = 1e-8, 0.0, 0.0, 0
    for seed in range(seeds):
        source = generator(seed)
        signal = torch.nn.functional.normalize(torch.randn(36, generator=source).double(), dim=0)
        axis = zonal.unit_axes(torch.randn(3, generator=source).double())
        side = torch.linalg.cross(axis, axis.roll(1))
        apart = 10.0 ** -(1.0 + 11.0 * seed / max(seeds - 1, 1))
        axes = torch.stack([axis, zonal.unit_axes(axis + apart * side / side.norm())])
        axes, target = axes.to(dtype), signal.to(dtype)
        pair = zonal.fit_coefficients(target, axes, ridge)
        single = zonal.fit_coefficients(target, axes[:1], ridge)
        errors = [
            float(zonal.squared_errors(target.double(), axes[:n].double(), one.double()).sum())
            for n, one in ((2, pair), (1, single))
        ]
        growth = max(growth, float(pair.abs().max()))
        worse = max(worse, errors[0] - errors[1])
        bad += not_finite([pair])
    # Lobes of norm one weigh at most half of norm / root of the ridge.
    return Outcome(
        (
            at_most("largest coefficient", growth, 0.5 * math.sqrt(4 * math.pi / ridge)),
            # Coefficients of 1e4 are rounded in float32.
            at_most("squared error above that of one lobe", worse, 1e-7 + 1e4 * rounding(dtype)),
            exactly("numbers not finite", bad, 0),
        ),
        condition=(2.0 + ridge) / ridge,
    )


def _stiff_metric(condition: float, source: torch.Generator) -> Metric:
    """A metric of 9 coefficients whose squared errors differ by the condition."""
    factor = stiff_matrix(9, 9, math.sqrt(condition), source)
    lower = torch.linalg.cholesky_ex(factor @ factor.mT + 1e-30 * torch.eye(9).double())[0]
    return Metric("light_prior", lower)


def _disturbed(transfer: TransferTensor, seed: int) -> CPCA:
    model = CPCA.from_transfer(transfer, num_clusters=3, rank=2)
    with torch.no_grad():
        noise = torch.randn(model.representatives.shape, generator=generator(seed))
        model.representatives.add_(0.1 * noise.to(model.representatives))
    return model


def _dishonest(result: FitResult, measured: float, limit: float) -> list[str]:
    """What a fit says of itself and is not so."""
    wrong = []
    history = [result.error_before, *result.history]
    if abs(result.error_after - measured) > limit * max(result.error_before, measured):
        wrong.append("error")
    if result.error_after > result.error_before:
        wrong.append("worse")
    last = min(history[:-1], default=math.inf) - history[-1]
    match result.status:
        case "converged":
            honest = 0 <= last <= _TOLERANCE * min(history[:-1])
        case "max_steps":
            honest = all(math.isfinite(error) for error in history)
        case "stagnated":
            honest = min(history[-5:]) > result.error_after
        case "nonfinite":
            honest = not math.isfinite(history[-1])
        case _:
            honest = False
    return wrong if honest else [*wrong, result.status]


@CASES.case(
    "refinement-of-any-condition",
    given="CPCA refined by L-BFGS in metrics of condition 1e2 to 1e14; every eighth by Adam at a "
    "rate that throws it out of range",
    required="FitResult: never worse, the error told is the error, the status is what happened",
    seconds=300.0,
    seeded=True,
)
def refinement(dtype: torch.dtype, seeds: int) -> Outcome:
    """What each fit says of itself, against its history and an error measured anew."""
    statuses: Counter[str] = Counter()
    wrong: Counter[str] = Counter()
    bad, largest = 0, 0.0
    for seed in range(seeds):
        condition = spread_condition(seed, seeds)
        source = generator(seed)
        values = torch.randn(20, 9, generator=source).to(dtype)
        transfer = TransferTensor.from_dense(values, light_basis=SphericalHarmonics(3))
        metric, model = _stiff_metric(condition, source), _disturbed(transfer, seed)
        explodes = seed % 8 == 7
        result = fit(
            model,
            transfer,
            optimizer="adam" if explodes else "lbfgs",
            learning_rate=torch.finfo(dtype).max ** 0.8 if explodes else None,
            max_steps=12,
            tolerance=_TOLERANCE,
            metric=metric,
        )
        squares = [
            float(metric.weigh(one.double()).square().sum())
            for one in (model.dense().detach() - transfer.dense(), transfer.dense())
        ]
        statuses[result.status] += 1
        # Differences are weighed in the type of the values.
        wrong.update(_dishonest(result, squares[0] / squares[1], 100 * rounding(dtype)))
        bad += not_finite(model.parameters())
        largest = max(largest, condition)
    return Outcome(
        (
            exactly("words that are not so", wrong.total(), 0),
            exactly("parameters not finite", bad, 0),
            at_least("different endings", len(statuses), 2),
        ),
        condition=largest,
        note=tally(statuses) + (f"; not so: {tally(wrong)}" if wrong else ""),
    )


@CASES.case(
    "light-prior-of-one-light",
    given="a metric from a single light, whose second moment has rank 3 of 36",
    required="its floor bounds the condition; weighing and back loses its root at most",
    seeded=True,
)
def light_prior(dtype: torch.dtype, seeds: int) -> Outcome:
    """No turns, so that the moment is as poor as it can be."""
    worst, bad, largest = 0.0, 0, 0.0
    for seed in range(seeds):
        light = torch.randn(1, 36, 3, generator=generator(seed))
        metric = Metric.light_prior(light, SphericalHarmonics(6), turns=1)
        values = torch.randn(8, 1, 1, 36, generator=generator(seed + 1)).to(dtype)
        weighed = metric.weigh(values)
        back = metric.unweigh(weighed)
        worst = max(worst, float((back - values).abs().max()))
        bad += not_finite([weighed, back])
        factor = metric.light
        if isinstance(factor, Tensor):
            largest = max(largest, float(torch.linalg.cond(factor)) ** 2)
    # Of the mean power 1 a light has at most all 36, and each direction keeps 1e-3.
    return Outcome(
        (
            at_most("condition", largest, 36 / 1e-3 + 2),
            at_most("error of weighing and back", worst, 64 * math.sqrt(3.6e4) * rounding(dtype)),
            exactly("numbers not finite", bad, 0),
        ),
        condition=largest,
    )
