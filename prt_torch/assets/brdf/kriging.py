r"""Smooth functions through scattered samples, by a Gaussian process (kriging).

The function is taken as a constant plus a random field of covariance
:math:`k(r) = (1 + \sqrt{3} r)\, e^{-\sqrt{3} r}` (Matérn 3/2: once differentiable), with some
variance of its own at each sample for noise. The expected field given the samples is a weighted
sum of one bump a sample; far from all samples it returns to the constant, so nothing runs away.
The error that each sample would have, were it left out, follows from the same matrix.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

_PAIRS_AT_ONCE = 2**18


class Kriging:
    """An interpolant of scattered samples.

    Args:
        positions: Where the samples are, in units of the correlation length.
        values: Samples, several functions side by side.
        noise: Variance at a sample over that of the field, above 0.

    Source:
        :cite:`rasmussen2006gaussian`, equations 2.25, 4.17 and 5.12, with a constant as in 2.7.
    """

    def __init__(
        self,
        positions: Float[Tensor, "samples axes"],
        values: Float[Tensor, "samples functions"],
        noise: float,
    ):
        self.positions, self.values, self.noise = positions, values, noise
        covariance = _covariance(positions, positions)
        covariance.diagonal().add_(noise)
        self._factor = torch.linalg.cholesky(covariance)
        ones = values.new_ones(len(values), 1)
        self._of_ones = torch.cholesky_solve(ones, self._factor)
        self._constant = (self._of_ones * values).sum(0) / self._of_ones.sum()
        self._weights = torch.cholesky_solve(values - self._constant, self._factor)

    def __call__(
        self, positions: Float[Tensor, "points axes"]
    ) -> Float[Tensor, "points functions"]:
        """The interpolant at other positions."""
        at_once = max(1, _PAIRS_AT_ONCE // len(self.positions))
        pieces = [
            _covariance(some, self.positions) @ self._weights for some in positions.split(at_once)
        ]
        return torch.cat(pieces) + self._constant

    def leave_one_out(self) -> Float[Tensor, "samples functions"]:
        """Each sample minus what the others say there, the constant found anew."""
        inverse = torch.cholesky_inverse(self._factor).diagonal()[:, None]
        without_constant = inverse - self._of_ones.square() / self._of_ones.sum()
        return self._weights / without_constant


def _covariance(a: Float[Tensor, "a axes"], b: Float[Tensor, "b axes"]) -> Float[Tensor, "a b"]:
    scaled = torch.cdist(a, b).mul_(math.sqrt(3.0))
    return torch.exp(-scaled).mul_(scaled.add_(1.0))
