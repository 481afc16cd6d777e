"""Fewer light coefficients: keep the largest, and say what was lost.

In a wavelet basis most of a light is in few coefficients, and relighting with a representation
costs by coefficient. Three orders decide which are the largest: magnitude, magnitude times the
area where a function is not zero, and magnitude times what transfer makes of it. Truncated light
flickers when it moves, since other coefficients are kept from one picture to the next, and lights
of many small sources need most of theirs: nothing here is applied unless it is called.

Source:
    Liu, Sloan, Shum, Snyder 2004, section 6 (the three orders, after Ng, Ramamoorthi, Hanrahan
    2003) and 7 (what they cost); Wang, Tran, Luebke 2004, section 3.4 (unweighted).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.bases import LightBasis
from prt_torch.transfer import TransferTensor


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
