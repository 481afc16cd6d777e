"""Extremes of Tsai, Shih 2006: narrow and wide kernels, few distinct centres and points."""

import math
from decimal import Decimal, localcontext

import torch
from stability_case import (
    Collection,
    Outcome,
    at_least,
    at_most,
    exactly,
    not_finite,
    relative_error,
    rounding,
)
from stability_problems import generator
from torch import Tensor

from prt_torch import evaluate
from prt_torch.bases import srbf
from prt_torch.representations import ClusteredTensor
from prt_torch.transfer import TransferTensor

CASES = Collection("Tsai 2006")
_UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
_PI = "3.14159265358979323846264338327950288419716939937510"
_DELTA = 30  # exponents beyond this are as good as zero


def _at_angle(angle: float) -> Tensor:
    return torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)


@CASES.case(
    "products-of-extreme-kernels",
    given="bandwidths 0 to 1e6, coincident to antipodal",
    required="4 pi, 12.566370363031763, 6.2831790240005625e-6, 8.5033751351278617e-7, "
    "3.1415926535897932e-6, 2.4466751372845875e-6, 0",
)
def products_of_extreme_kernels(dtype: torch.dtype) -> Outcome:
    """The printed hyperbolic sine overflows at 710 in float64, at 89 in float32."""
    pi = math.pi
    rows = [
        (0.0, 0.0, pi, 4 * pi),
        (1e-8, 1e-8, pi, 12.566370363031763),
        (1e6, 1.0, 0.0, 6.2831790240005625e-6),
        (1e6, 1.0, pi, 8.5033751351278617e-7),
        (1e6, 1e6, 0.0, 3.1415926535897932e-6),
        (1e6, 1e6, 1e-3, 2.4466751372845875e-6),
        (1e6, 1e6, pi, 0.0),
    ]
    checks = []
    for width_a, width_b, angle, expected in rows:
        center = -_UP if angle == pi else _at_angle(angle)
        given = (_UP, torch.tensor(width_a), center, torch.tensor(width_b))
        found = float(srbf.gaussian_inner_product(*(one.to(dtype) for one in given)))
        # Where exponents are subtracted, float32 keeps half of its digits.
        limit = 1e-14 if dtype == torch.float64 else 6e-5
        name = f"relative error at {width_a:g}, {width_b:g}, {angle:.3g} rad"
        checks.append(at_most(name, abs(found - expected) / (expected or 1.0), limit))
    return Outcome(tuple(checks))


@CASES.case(
    "products-to-the-last-digit",
    given="2,000 pairs of bandwidths 1e-8 to 1e6 at all distances, exponents below 30",
    required="relative error at most 9e-15 in float64",
)
def products_to_the_last_digit(dtype: torch.dtype) -> Outcome:
    """Against the same form in 50 decimal digits, of the same rounded centres."""
    source = generator()
    count = 2000
    widths = 10.0 ** (14.0 * torch.rand(2, count, generator=source).double() - 8.0)
    reach = (60.0 / (1.0 / (1.0 / widths).sum(0))).sqrt().clamp_max(math.pi)
    angles = reach * torch.rand(count, generator=source).double()
    centers = torch.stack([angles.sin(), 0 * angles, angles.cos()], dim=-1).to(dtype)
    widths = widths.to(dtype)
    up = _UP.to(dtype).expand(count, 1, 3)
    found = srbf.gaussian_inner_product(
        up, widths[0][:, None], centers[:, None], widths[1][:, None]
    )
    worst, compared = 0.0, 0
    for value, center, a, b in zip(
        found[:, 0, 0].tolist(), centers.tolist(), *widths.tolist(), strict=True
    ):
        expected, delta = _product(center, a, b)
        if delta < _DELTA:
            compared += 1
            worst = max(worst, abs(float(Decimal(value) / expected - 1)))
    limit = 9e-15 if dtype == torch.float64 else 40 * rounding(dtype)
    return Outcome(
        (at_least("pairs compared", compared, 1000), at_most("relative error", worst, limit))
    )


def _product(center: list[float], width_a: float, width_b: float) -> tuple[Decimal, Decimal]:
    """Integral of the product of a Gaussian around +z with another, and its exponent."""
    with localcontext() as context:
        context.prec = 50
        x, y, z = (Decimal(one) for one in center)
        a, b = Decimal(width_a), Decimal(width_b)
        apart = x * x + y * y + (1 - z) ** 2
        r = ((b * x) ** 2 + (b * y) ** 2 + (a + b * z) ** 2).sqrt()
        delta = a * b * apart / (a + b + r)
        return 2 * Decimal(_PI) * (-delta).exp() * (1 - (-2 * r).exp()) / r, delta


@CASES.case(
    "narrow-kernels",
    given="Gaussians of bandwidth 1e6 and Abel-Poisson kernels of 0.9999 near their centres",
    required="float32: 4.8e-5, 1.2e-3 and 5.9e-5 for products; dot products give 0.154, NaN, 0.32",
)
def narrow_kernels(dtype: torch.dtype) -> Outcome:
    """Against the angle itself; the dot-product form beside it."""
    angles = torch.linspace(0.0, 5e-3, 200, dtype=torch.float64)
    tilt = [[0.48, 0.6, 0.64], [0.8, 0.0, -0.6], [-0.36, 0.8, -0.48]]
    tilt = torch.tensor(tilt, dtype=torch.float64)
    places = torch.stack([_at_angle(float(angle)) for angle in angles]) @ tilt.mT
    center = (tilt @ _UP)[None]
    squared, half = 4.0 * (0.5 * angles).sin().square(), (0.5 * angles).cos()
    wide, poisson = torch.tensor([[1e6], [0.9999]], dtype=torch.float64)
    expected = {
        "Gaussian": torch.exp(-5e5 * squared),
        "Abel-Poisson": (1 - 0.9999**2) / (1e-8 + 0.9999 * squared) ** 1.5,
        "product": math.pi * 1e-6 / half * torch.exp(-5e5 * squared / (1.0 + half)),
    }
    arguments = [one.to(dtype) for one in (places, center, wide, poisson)]
    found = {
        "Gaussian": srbf.gaussian(*arguments[:3])[:, 0],
        "Abel-Poisson": srbf.abel_poisson(arguments[0], arguments[1], arguments[3])[:, 0],
        "product": srbf.gaussian_inner_product(
            arguments[0], arguments[2].expand(200), arguments[1], arguments[2]
        )[:, 0],
    }
    limits = {"Gaussian": 1e-4, "Abel-Poisson": 3e-3, "product": 1e-4}
    scale = 1.0 if dtype == torch.float32 else 1e-7
    dot = torch.exp(-1e6 * (1.0 - arguments[0] @ arguments[1][0])).double()
    naive = float((dot - expected["Gaussian"]).abs().max())
    checks = [
        at_most(
            f"{name}, error over the peak",
            (found[name].double() - expected[name]).abs().max() / expected[name].max(),
            limits[name] * scale,
        )
        for name in expected
    ]
    return Outcome(tuple(checks), note=f"the dot product's error is {naive:.2g}")


@CASES.case(
    "coincident-centres",
    given="two of three kernels with the same centre",
    required="least norm, coefficients (1, 1, 2) for values of (2, 0, 2); no LinAlgError",
)
def coincident_centres(dtype: torch.dtype) -> Outcome:
    """By inner products and by samples."""
    centers = torch.stack([_UP, _UP, _at_angle(0.5)]).to(dtype)
    widths = torch.full((3,), 20.0, dtype=dtype)
    gram = srbf.gaussian_inner_product(centers, widths, centers, widths)
    function = torch.tensor([[2.0], [0.0], [2.0]], dtype=dtype)
    expected = torch.tensor([[1.0], [1.0], [2.0]], dtype=dtype)
    places = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator()).to(dtype))
    kernels = srbf.gaussian(places, centers, widths)
    products = srbf.gram_projection(gram, gram @ function)
    samples = srbf.collocation_projection(kernels, kernels @ function)
    return Outcome(
        (
            at_most(
                "error by inner products",
                (products.coefficients - expected).abs().max(),
                100 * rounding(dtype),
            ),
            at_most(
                "error by samples",
                (samples.coefficients - expected).abs().max(),
                100 * rounding(dtype),
            ),
            at_least("condition told", min(products.condition, 1e300), 0.1 / rounding(dtype)),
        ),
        condition=products.condition,
    )


@CASES.case(
    "few-distinct-members",
    given="15 members of 3 distinct points at rank 6; a cluster of one; more clusters than points",
    required="ranks capped at the numerical one, spare vectors zero; empty clusters start again",
)
def few_distinct_members(dtype: torch.dtype) -> Outcome:
    """Orthonormal dual bases where they are used; V V^T - I of a naive form is off by 0.93."""
    rank, off, worst, bad, smallest = 0, 0.0, 0.0, 0, 15
    for seed in range(5):
        distinct = torch.randn(3, 4, 20, generator=generator(seed)).to(dtype)
        repeated = TransferTensor.from_dense(distinct[torch.arange(15) % 3])
        one = ClusteredTensor.from_transfer(repeated, num_clusters=1, ranks=(4, 12, 6), bits=None)
        many = ClusteredTensor.from_transfer(repeated, num_clusters=9, ranks=(4, 12, 6), bits=None)
        single = TransferTensor.from_dense(distinct[:1])
        alone = ClusteredTensor.from_transfer(single, num_clusters=1, ranks=(4, 12, 6), bits=None)
        dual = one.cores.detach().flatten(2)
        used = (dual != 0).any(2).double()
        off = max(off, float((dual @ dual.mT - torch.diag_embed(used)).abs().max()))
        rank = max(rank, dual.shape[1])
        smallest = min(smallest, int(torch.bincount(many.labels).min()))
        for model, transfer in ((one, repeated), (many, repeated), (alone, single)):
            bad += not_finite(tensor.detach() for tensor in model.parameters())
            worst = max(worst, evaluate.transfer_error(model, transfer))
    return Outcome(
        (
            exactly("rank of 3 distinct points", rank, 3),
            at_most("V V^T less the identity", off, 32 * rounding(dtype)),
            at_least("points of the smallest cluster", smallest, 1),
            at_most("squared error", worst, (64 * rounding(dtype)) ** 2),
            exactly("numbers not finite", bad, 0),
        )
    )


@CASES.case(
    "wide-kernels",
    given="642 Gaussians of bandwidth 12.5 (the paper's variance read literally): singular Gram",
    required="regularised least squares at a condition of 1e8, and the true condition told",
    seconds=60.0,
)
def wide_kernels(dtype: torch.dtype) -> Outcome:
    """A basis whose Gram matrix float64 cannot factor."""
    basis = srbf.SRBF(bandwidth=12.477)
    values = torch.randn(4, basis.num_coeffs, generator=generator()).to(dtype)
    again = basis.unweigh(basis.weigh(values))
    smooth = basis.weigh(values)
    return Outcome(
        (
            at_least("condition told", min(basis.condition, 1e300), 1e15),
            at_most("condition used", torch.linalg.cond(basis.gram()), 1.01e8),
            # Errors of coefficients grow by the root of the condition.
            at_most("weighed and back", relative_error(again, values), 1e5 * rounding(dtype)),
            at_most("norm after going back", relative_error(basis.weigh(again), smooth), 1e-3),
        ),
        condition=basis.condition,
    )
