"""What transfer needs for a stated error, from a sample of its points, and leaving out the rest.

:func:`inspect` reads a sample and says how many vectors, exit rows, bands of light, segments,
wavelet terms and lobes the error needs: where a search for a representation may begin. It changes
nothing. :func:`leave_out` measures over all points, and returns transfer without what they do not
need within the error: highest bands of harmonics, and two of three channels where colours are
proportional.

The number of clusters is not among the answers: a sample is too sparse for clusters.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Literal, get_args

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from prt_torch.baking.inspection import ERROR, Finding
from prt_torch.bases import Haar, SphericalHarmonics
from prt_torch.metric import Metric
from prt_torch.representations import ZonalLobes
from prt_torch.transfer import Surface, TransferTensor
from prt_torch.truncation import (
    band_losses,
    fewer_bands,
    one_channel,
    shared_colour,
)

Part = Literal["bands", "channels"]
"""What :func:`leave_out` may leave out of transfer."""

_SAMPLE_BYTES = 2**27
_LOBE_POINTS = 32  # whose lobes are fitted, one number of lobes after the other
_MOST_LOBES = 6
_HELD_BACK = 2  # every second vector of a sample tests what the others span


@dataclass(frozen=True)
class _Sample:
    """Some points of a transfer tensor, and the same in the space where errors are squares."""

    transfer: TransferTensor
    weighed: Float64[Tensor, "points channels rows coeffs"]
    bytes_in_all: int


def inspect(
    transfer: TransferTensor,
    *,
    lights: Float[Tensor, "lights coeffs rgb"] | None = None,
    error: float = ERROR,
    points: int = 512,
    seed: int = 0,
) -> list[Finding]:
    """What a sample of points needs for a stated error.

    Args:
        transfer: Of any bases.
        lights: Light coefficients that it will be lit by; adds what these lights need.
        error: Squared error that is allowed, over the squared norm of the whole.
        points: How many are read, fewer if their values exceed 128 MiB.
        seed: Of the choice of points.

    Raises:
        ValueError: If the error is not in (0, 1), there are fewer than 2 points, or lights do not
            fit.
    """
    if not 0 < error < 1:
        raise ValueError(f"expected an error in (0, 1), got {error}")
    if min(points, transfer.num_points) < 2:
        raise ValueError(f"expected at least 2 points, got {min(points, transfer.num_points)}")
    if lights is not None and tuple(lights.shape[1:]) != (transfer.num_coeffs, 3):
        raise ValueError(
            f'expected lights "lights {transfer.num_coeffs} 3", got {tuple(lights.shape)}'
        )
    sample = _draw(transfer, points, seed)
    findings = [_dimensions(sample, error)]
    if transfer.num_rows > 1:
        findings.append(_rows(sample, error))
    match transfer.surface.light_basis:
        case SphericalHarmonics() as basis:
            findings.append(_bands(sample, basis.order, error))
            if lights is not None:
                findings.append(_bands_of_lights(sample, basis.order, lights, error))
            findings.append(_lobes(sample, error))
        case Haar() as basis:
            findings += _wavelets(sample, basis, error)
    return findings


def leave_out(
    transfer: TransferTensor, *, error: float = ERROR, force: Collection[Part] = ()
) -> tuple[TransferTensor, list[Finding]]:
    """Transfer without what it does not need within an error, and what that was.

    Colours come first, bands share what they left of the error. Values are read lazily from
    ``transfer``; nothing is left out that would cost more bytes than it saves.

    Args:
        transfer: Of any bases.
        error: Squared error that is allowed in all, over the squared norm of the whole.
        force: What is kept in any case.

    Raises:
        ValueError: If the error is negative, or ``force`` names what there is not.
    """
    if error < 0:
        raise ValueError(f"expected an error of at least 0, got {error}")
    unknown = set(force) - set(get_args(Part))
    if unknown:
        raise ValueError(f"expected some of {get_args(Part)}, got {sorted(unknown)}")
    findings, left = [], error
    if transfer.num_channels == 3:
        shared = shared_colour(transfer)
        fewer = one_channel(transfer, shared)
        saved = transfer.num_bytes - fewer.num_bytes
        applied = "channels" not in force and shared.lost <= left and saved > 0
        why = f"{100 * shared.lost:.2g} % of the square is not common to the colours of a point"
        what, needed = "channels of transfer", 1 if shared.lost <= left else 3
        findings.append(Finding(what, needed, 3, shared.lost, "exact", applied, why, saved))
        if applied:
            transfer, left = fewer, left - shared.lost
    basis = transfer.surface.light_basis
    if isinstance(basis, SphericalHarmonics):
        # Of what is kept after colours, whose norm is no larger than that of the whole.
        losses = band_losses(transfer)
        needed = _first_below(losses[1:], left) + 1
        fewer = fewer_bands(transfer, needed)
        applied = "bands" not in force and needed < basis.order
        why = f"{100 * float(losses[needed]):.2g} % of the square is in the others"
        saved, lost = transfer.num_bytes - fewer.num_bytes, float(losses[needed])
        what = "bands of light in transfer"
        findings.append(Finding(what, needed, basis.order, lost, "exact", applied, why, saved))
        transfer = fewer if applied else transfer
    return transfer, findings


def _first_below(losses: Float64[Tensor, "counts"], limit: float) -> int:
    """Index of the first that is not above a limit; the last is 0."""
    return int((losses <= limit).nonzero()[0])


def _draw(transfer: TransferTensor, points: int, seed: int) -> _Sample:
    """Points at random, in their order."""
    point_bytes = 8 * transfer.num_channels * transfer.num_rows * transfer.num_coeffs
    count = max(2, min(points, transfer.num_points, _SAMPLE_BYTES // point_bytes))
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randperm(transfer.num_points, generator=generator)[:count].sort().values
    values = torch.cat([transfer.values[i : i + 1] for i in chosen.tolist()]).double().cpu()
    frames = transfer.surface.frames
    surface = Surface(
        exit_basis=transfer.surface.exit_basis,
        light_basis=transfer.surface.light_basis,
        frames=None if frames is None else frames[chosen],
    )
    weighed = Metric.l2(transfer).weigh(values)
    return _Sample(TransferTensor(values, surface), weighed, transfer.num_bytes)


def _dimensions(sample: _Sample, error: float) -> Finding:
    """Vectors, beside a mean, that span the transfer of all points."""
    losses = _held_back_losses(sample.weighed.flatten(1))
    most = len(losses) - 1
    why = "by points that took no part in finding the vectors"
    return _counted("vectors for all points", losses, most, error, why)


def _rows(sample: _Sample, error: float) -> Finding:
    """Combinations of exit rows that span those of all points."""
    rows = sample.weighed.movedim(2, 3).flatten(0, 2)
    energies = torch.linalg.eigvalsh(rows.mT @ rows).flip(0).clamp_min(0.0)
    why = "by singular values of the sample's rows"
    return _counted("combinations of exit rows", _tails(energies), rows.shape[1], error, why)


def _bands(sample: _Sample, order: int, error: float) -> Finding:
    """Bands of spherical harmonics that transfer needs."""
    energy = sample.weighed.square().sum((0, 1, 2))
    band = torch.arange(order).repeat_interleave(2 * torch.arange(order) + 1)
    losses = _tails(torch.zeros(order, dtype=torch.float64).index_add(0, band, energy))
    found = _counted("bands of light", losses, order, error, "by the sample's energy in each band")
    kept = (found.needed or order) ** 2
    return replace(found, saved_bytes=sample.bytes_in_all * (order**2 - kept) // order**2)


def _bands_of_lights(
    sample: _Sample, order: int, lights: Float[Tensor, "lights coeffs rgb"], error: float
) -> Finding:
    """Bands that the radiance of all given lights needs."""
    values, lights = sample.weighed, lights.to(sample.weighed)
    losses = torch.zeros(order + 1, dtype=torch.float64)
    radiance = values @ lights[:, None, None]  # lights points channels rows rgb, by broadcasting
    whole = radiance.square().flatten(1).sum(1)
    for kept in range(order):
        first = kept * kept
        missing = values[..., first:] @ lights[:, None, None, first:]
        lost = missing.square().flatten(1).sum(1) / torch.where(whole > 0, whole, 1.0)
        losses[kept] = lost.max()
    # Fewer bands may by chance be better than more; what is needed is enough with all above it.
    losses = losses.flip(0).cummax(0).values.flip(0)
    why = f"by the radiance of the sample under the {len(lights)} lights given"
    return _counted("bands of light under the lights given", losses, order, error, why)


def _lobes(sample: _Sample, error: float) -> Finding:
    """Zonal lobes of a row of a point."""
    some = sample.transfer.block(slice(0, _LOBE_POINTS))
    whole = float(some.squared_norm().sum()) or 1.0
    losses = [1.0]
    while losses[-1] > error and len(losses) <= _MOST_LOBES:
        lobes = ZonalLobes.from_transfer(some, num_lobes=len(losses), effort="fast", bits=None)
        difference = some.dense() - lobes.dense().detach()
        losses.append(float(some.squared_norm_of(difference).sum()) / whole)
    why = f"by quick fits of {some.num_points} points"
    return _counted("zonal lobes", torch.tensor(losses), _MOST_LOBES, error, why)


def _wavelets(sample: _Sample, basis: Haar, error: float) -> list[Finding]:
    """Terms of a row of a point, and pairs of a point and a segment, in the norm of texels."""
    energies = sample.transfer.dense().square()
    ordered = energies.flatten(0, 2).sort(dim=1, descending=True).values
    terms = _counted(
        "wavelet terms of a row",
        _tails(ordered.sum(0)),
        basis.num_coeffs,
        error,
        "by the largest coefficients of each point and row of the sample",
    )
    segments = energies.unflatten(3, (-1, basis.segment**2)).sum((1, 2, 4))
    lit = int((segments > 0).sum())
    blind = segments.numel() - lit
    dark = int((segments == 0).all(0).sum())
    why = f"points see nothing of the others; {dark} of {segments.shape[1]} are seen by none"
    pairs = Finding(
        "pairs of a point and a segment of the light",
        lit,
        segments.numel(),
        0.0,
        "sample",
        False,
        why,
        sample.bytes_in_all * blind // segments.numel(),
    )
    return [terms, pairs]


def _held_back_losses(vectors: Float64[Tensor, "vectors size"]) -> Float64[Tensor, "counts"]:
    """What is lost of every second vector by the mean and principal vectors of the others."""
    tested, known = vectors[::_HELD_BACK], vectors[1::_HELD_BACK]
    whole = float(tested.square().sum()) or 1.0
    mean = known.mean(0)
    tested, known = tested - mean, known - mean
    values, vectors = torch.linalg.eigh(known @ known.mT)
    values, vectors = values.flip(0), vectors.flip(1)
    solid = values > len(values) * torch.finfo(values.dtype).eps * values[0]
    onto = (tested @ known.mT) @ vectors[:, solid] / values[solid].sqrt()
    kept = onto.square().sum(0).cumsum(0)
    all_of_it = tested.square().sum()
    return torch.cat([all_of_it[None], (all_of_it - kept).clamp_min(0.0)]) / whole


def _tails(energies: Float64[Tensor, "count"]) -> Float64[Tensor, "counts"]:
    """What is lost by keeping the first none, one, ... all, over the whole."""
    whole = energies.sum()
    beyond = energies.flip(0).cumsum(0).flip(0) / torch.where(whole > 0, whole, 1.0)
    return torch.cat([beyond, torch.zeros(1, dtype=energies.dtype)])


def _counted(what: str, losses: Tensor, available: int, error: float, why: str) -> Finding:
    """The smallest count whose loss is allowed."""
    enough = (losses <= error).nonzero()[:, 0]
    needed = int(enough[0]) if len(enough) else None
    lost = float(losses[-1] if needed is None else losses[needed])
    return Finding(what, needed, available, lost, "sample", False, why)
