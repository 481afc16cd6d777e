"""Fewer numbers, and what they lose: small coefficients of light, bands and colours of transfer.

*Light.* In a wavelet basis most of a light is in few coefficients, and relighting with a
representation costs by coefficient. Three orders decide which are the largest: magnitude, magnitude
times the area where a function is not zero, and magnitude times what transfer makes of it.
Truncated light flickers when it moves, since other coefficients are kept from one picture to the
next, and lights of many small sources need most of theirs: nothing of this is applied unless it is
called.

*Transfer.* Its highest bands of spherical harmonics may hold next to nothing, and its colours may
be one function times three numbers at each point. Both are measured first, over all points, as
shares of the squared norm of the whole; :func:`fewer_bands` and :func:`one_channel` then make
transfer without them, read lazily from the old one.

Source:
    Liu, Sloan, Shum, Snyder 2004, section 6 (the three orders, after Ng, Ramamoorthi, Hanrahan
    2003) and 7 (what they cost); Wang, Tran, Luebke 2004, section 3.4 (unweighted).
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from prt_torch.bases import LightBasis, SphericalHarmonics
from prt_torch.transfer import Rows, TransferTensor

_BLOCK_BYTES = 2**24


def truncate(
    light: Float[Tensor, "batch coeffs rgb"],
    light_basis: LightBasis,
    keep: int,
    *,
    weights: Float[Tensor, "coeffs"] | None = None,
) -> tuple[Float[Tensor, "batch coeffs rgb"], Float[Tensor, "batch"]]:
    """Light whose coefficients are zero but for the largest, each light on its own.

    A coefficient's magnitude is the root of its sum of squares over colours, so colours keep the
    same coefficients. Of equal ones the first are kept.

    Args:
        light: Light coefficients.
        light_basis: Their basis, for what was lost.
        keep: How many coefficients stay; all of them if there are no more.
        weights: What magnitudes are multiplied by; ones if not given. :meth:`Haar.areas
            <prt_torch.bases.Haar.areas>` gives the area-weighted choice, :func:`transfer_weights`
            the transfer-weighted one.

    Returns:
        The truncated light, and the share of its energy that was lost: squared L2 norm over the
        sphere of the difference, over that of the light (0 for black). It may pass 1 in a basis
        that is not orthogonal.

    Raises:
        ValueError: If ``keep`` is negative, or the sizes do not fit.
    """
    coeffs = light.shape[1]
    if keep < 0:
        raise ValueError(f"expected at least 0 coefficients to keep, got {keep}")
    if coeffs != light_basis.num_coeffs:
        raise ValueError(f"expected {light_basis.num_coeffs} light coefficients, got {coeffs}")
    if weights is not None and weights.shape != (coeffs,):
        raise ValueError(f"expected {coeffs} weights, got shape {tuple(weights.shape)}")
    importance = light.detach().to(torch.float64).norm(dim=2)
    if weights is not None:
        importance = importance * weights.to(importance)
    order = importance.argsort(dim=1, descending=True, stable=True)
    kept = torch.zeros_like(importance, dtype=torch.bool).scatter_(1, order[:, :keep], True)
    truncated = torch.where(kept[:, :, None], light, 0.0)
    whole = _energy(light, light_basis)
    lost = _energy(light - truncated, light_basis) / torch.where(whole > 0, whole, 1.0)
    return truncated, lost


def _energy(light: Tensor, light_basis: LightBasis) -> Float[Tensor, "batch"]:
    return light_basis.weigh_light(light.to(torch.float64)).square().sum((1, 2))


def transfer_weights(transfer: TransferTensor) -> Float[Tensor, "coeffs"]:
    """Root mean square of each transfer coefficient over points, channels and rows, float64.

    Read by blocks of points. Times the magnitude of a light coefficient, it is the radiance that
    the coefficient is worth on the surface.

    Source:
        Liu et al. 2004, section 6, of Ng et al. 2003: "magnitude weighted by average transfer
        response on the surface"; the average here is a root mean square.
    """
    total = torch.zeros(transfer.num_coeffs, dtype=torch.float64)
    for _, values in transfer.blocks():
        total = total.to(values.device) + values.to(torch.float64).square().sum((0, 1, 2))
    count = transfer.num_points * transfer.num_channels * transfer.num_rows
    return (total / max(count, 1)).sqrt()


def band_losses(transfer: TransferTensor) -> Float64[Tensor, "orders"]:
    """What transfer loses if only its first bands are kept.

    Args:
        transfer: In spherical harmonics.

    Returns:
        For each number of bands, from none to all: the squared norm of the others over that of
        all, 1 down to 0; zeros where transfer is zero.

    Raises:
        ValueError: If its light is not in spherical harmonics.
    """
    order = _order(transfer)
    energy = torch.zeros(order, dtype=torch.float64)
    for _, values in transfer.blocks(_BLOCK_BYTES):
        for band in range(order):
            alone = torch.zeros_like(values)
            own = slice(band * band, (band + 1) ** 2)
            alone[..., own] = values[..., own]
            energy[band] += transfer.squared_norm_of(alone).sum().cpu()
    beyond = torch.cat([energy.flip(0).cumsum(0).flip(0), torch.zeros(1, dtype=torch.float64)])
    return beyond / torch.where(beyond[0] > 0, beyond[0], 1.0)


def fewer_bands(transfer: TransferTensor, order: int) -> TransferTensor:
    """The first bands of transfer in spherical harmonics.

    What is known of the norm before projection stays, so that ``reference_error`` counts the loss.

    Args:
        transfer: In spherical harmonics.
        order: How many bands are kept, at least 1 and no more than there are.

    Raises:
        ValueError: If its light is not in spherical harmonics, or the order is out of range.
    """
    if not 1 <= order <= _order(transfer):
        raise ValueError(f"expected an order in 1..{_order(transfer)}, got {order}")
    return replace(
        transfer,
        values=_FirstCoefficients(transfer.values, order * order),
        surface=replace(transfer.surface, light_basis=SphericalHarmonics(order)),
    )


def _order(transfer: TransferTensor) -> int:
    basis = transfer.surface.light_basis
    if not isinstance(basis, SphericalHarmonics):
        raise ValueError(f"expected transfer in spherical harmonics, got {basis and basis.name}")
    return basis.order


class _FirstCoefficients:
    """The first light coefficients of values, where they are read."""

    def __init__(self, values: Rows, count: int):
        self._values, self._count = values, count
        self.shape, self.dtype = (*values.shape[:3], count), values.dtype

    def __getitem__(self, rows: slice, /) -> Tensor:
        return self._values[rows][..., : self._count].contiguous()


@dataclass(frozen=True)
class SharedColour:
    """Transfer of three channels as one function of light and view for each point, times a colour.

    Attributes:
        colours: ``"points rgb"``: what to multiply it with, unit vectors, so that norms stay; zero
            where transfer is.
        lost: Squared norm of the difference over that of the transfer.
    """

    colours: Float[Tensor, "points rgb"]
    lost: float


def shared_colour(transfer: TransferTensor) -> SharedColour:
    r"""The colours that make one channel of three with the smallest error, and this error.

    By the largest eigenvector a of the inner products of a point's three channels: what is lost is
    :math:`\operatorname{tr} G - a^T G a`.

    Args:
        transfer: Of three channels.

    Raises:
        ValueError: If it has not three.
    """
    if transfer.num_channels != 3:
        raise ValueError(f"expected transfer of 3 channels, got {transfer.num_channels}")
    colours, lost, total = [], 0.0, 0.0
    for _, values in transfer.blocks(_BLOCK_BYTES):
        gram = _channel_gram(transfer, values)
        # Light is not negative and neither are inner products but for ringing: nor are colours.
        largest = torch.linalg.eigh(gram).eigenvectors[..., -1]
        own = (largest * largest.sum(1, keepdim=True).sign()).clamp_min(0.0)
        trace = gram.diagonal(dim1=1, dim2=2).sum(1)
        length = own.norm(dim=1, keepdim=True)
        own = own / torch.where(length > 0, length, 1.0) * (trace > 0)[:, None]
        kept = torch.einsum("pc,pcd,pd->p", own, gram, own)
        lost += float((trace - kept).clamp_min(0.0).sum())
        total += float(trace.sum())
        colours.append(own)
    return SharedColour(torch.cat(colours), lost / (total or 1.0))


def _channel_gram(
    transfer: TransferTensor, values: Float[Tensor, "points channels rows coeffs"]
) -> Float64[Tensor, "points channels channels"]:
    """Inner products of the channels of points, by the norms of their sums."""
    norms = [transfer.squared_norm_of(values[:, [c]]) for c in range(3)]
    gram = torch.diag_embed(torch.stack(norms, dim=1))
    for one, other in ((0, 1), (0, 2), (1, 2)):
        both = transfer.squared_norm_of(values[:, [one]] + values[:, [other]])
        gram[:, one, other] = gram[:, other, one] = (both - norms[one] - norms[other]) / 2
    return gram


def one_channel(transfer: TransferTensor, shared: SharedColour) -> TransferTensor:
    """Transfer of one channel, whose colours have become a factor of the reflectance.

    Args:
        transfer: Of three channels.
        shared: Its :func:`shared_colour`.
    """
    reflectance = transfer.surface.reflectance
    return replace(
        transfer,
        values=_OneChannel(transfer.values, shared.colours),
        surface=replace(transfer.surface, reflectance=reflectance * shared.colours.to(reflectance)),
    )


class _OneChannel:
    """The function that three channels share best, where it is read."""

    def __init__(self, values: Rows, colours: Float[Tensor, "points rgb"]):
        self._values, self._colours = values, colours
        self.shape, self.dtype = (values.shape[0], 1, *values.shape[2:]), values.dtype

    def __getitem__(self, rows: slice, /) -> Tensor:
        values = self._values[rows]
        return torch.einsum("pc,pcrl->prl", self._colours[rows].to(values), values)[:, None]
