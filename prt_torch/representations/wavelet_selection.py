"""Which light coefficients of a transfer tensor are worth keeping.

In an orthonormal basis the error of keeping some coefficients is the sum of squares of the others,
so the best of any number are the largest, and the choices for growing numbers are nested. All
faces of the cube compete with each other; each point and each row choose for themselves; colours
share one choice, since they share the index.

Source:
    Wang, Tran, Luebke 2004, section 3.3.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Int32
from torch import Tensor

from prt_torch.metric import Metric
from prt_torch.transfer import TransferTensor

_BLOCK_BYTES = 2**24  # of transfer read at once: choosing takes a quarter longer from 2**26
_UNITS_BYTES = 2**26  # of unit functions weighed at once


@dataclass(frozen=True)
class SparseTerms:
    """Some coefficients of every point and row, in ascending order of their index.

    Attributes:
        indices: Which of the light coefficients; zero where there is none.
        values: Their values; zero where there is none.
    """

    indices: Int32[Tensor, "points rows terms"]
    values: Float[Tensor, "points rows terms channels"]

    def without_zeros(self) -> "SparseTerms":
        """Terms of value zero dropped, the others moved to the front.

        As many terms as the point and row with the most of them needs, one at least.
        """
        used = (self.values != 0).any(-1)
        width = max(1, int(used.sum(-1).max()))
        order = used.logical_not().sort(dim=-1, stable=True).indices[..., :width]
        used = used.gather(-1, order)
        values = self.values.gather(2, order[..., None].expand(-1, -1, -1, self.values.shape[-1]))
        return SparseTerms(
            torch.where(used, self.indices.gather(-1, order), 0),
            torch.where(used[..., None], values, 0.0),
        )


def largest_terms(
    transfer: TransferTensor, num_terms: int, metric: Metric | None = None
) -> SparseTerms:
    """The coefficients of largest magnitude, of equal ones those with the lowest index.

    Args:
        transfer: Read by blocks of points.
        num_terms: How many for each point and row, at most as many as there are.
        metric: Weighs each coefficient by the norm of its basis function; all the same if not
            given.
    """
    importance = None if metric is None else function_norms(metric, transfer)
    indices, kept = [], []
    for _, values in transfer.blocks(_BLOCK_BYTES):
        chosen = _largest(_magnitudes(values, importance), num_terms)
        by_channel = chosen[:, None].expand(-1, values.shape[1], -1, -1)
        kept.append(values.gather(-1, by_channel).movedim(1, -1).contiguous())
        indices.append(chosen.int())
    return SparseTerms(torch.cat(indices), torch.cat(kept))


def function_norms(metric: Metric, transfer: TransferTensor) -> Float[Tensor, "coeffs"]:
    """Norm of each light basis function in a metric, float64, up to a common factor."""
    rows, coeffs = transfer.num_rows, transfer.num_coeffs
    norms = torch.empty(coeffs, dtype=torch.float64)
    at_once = max(1, _UNITS_BYTES // (8 * rows * coeffs))
    for some in torch.arange(coeffs).split(at_once):
        units = torch.zeros(len(some), rows, coeffs, dtype=torch.float64)
        units[torch.arange(len(some)), 0, some] = 1.0
        norms[some] = metric.weigh(units).square().sum((1, 2)).sqrt()
    return norms


def _magnitudes(
    values: Float[Tensor, "points channels rows coeffs"], importance: Tensor | None
) -> Float[Tensor, "points rows coeffs"]:
    """Over channels together; scaled, so that squares neither overflow nor vanish."""
    magnitudes = values.abs()
    if values.shape[1] == 1:
        magnitudes = magnitudes[:, 0]
    else:
        largest = magnitudes.amax((1, 3), keepdim=True)
        scaled = magnitudes.div_(torch.where(largest > 0, largest, 1.0)).square_()
        magnitudes = scaled.sum(1).sqrt_()
    if importance is not None:
        magnitudes = magnitudes * importance.to(magnitudes)
    return magnitudes


def _largest(
    magnitudes: Float[Tensor, "points rows coeffs"], num_terms: int
) -> Int[Tensor, "points rows terms"]:
    """Indices of the largest, in ascending order."""
    coeffs = magnitudes.shape[-1]
    if num_terms >= coeffs:
        return torch.arange(coeffs, device=magnitudes.device).expand(magnitudes.shape)
    top = magnitudes.topk(num_terms + 1)
    chosen = top.indices[..., :-1].sort().values
    last, next_best = top.values[..., -2], top.values[..., -1]
    tied = (last == next_best) & (last > 0)
    if bool(tied.any()):
        chosen[tied] = _lowest_of_equals(magnitudes[tied], last[tied], num_terms)
    return chosen


def _lowest_of_equals(
    magnitudes: Float[Tensor, "vectors coeffs"], last: Float[Tensor, "vectors"], num_terms: int
) -> Int[Tensor, "vectors terms"]:
    """All above the last magnitude that is kept, then of those equal to it the lowest indices."""
    above, equal = magnitudes > last[:, None], magnitudes == last[:, None]
    missing = num_terms - above.sum(-1, keepdim=True)
    kept = above | (equal & (equal.cumsum(-1, dtype=torch.int32) <= missing))
    return kept.nonzero()[:, 1].view(-1, num_terms)
