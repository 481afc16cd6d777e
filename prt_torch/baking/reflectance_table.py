"""The dipole's reflectance by squared distance, from a table.

Knots divide each power of two of the squared distance, plus a constant, into equal parts. So the
knot is the head of the number's bits, and the place after the knot is their tail: no logarithm, and
no root, exponential or division for each distance and channel.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.assets.medium import Dipole

_KNOT_BITS = 8  # 256 knots a power of two: within 1e-5 but where light has died off
_INTEGERS = {torch.float32: (torch.int32, 23), torch.float64: (torch.int64, 52)}  # and mantissa


class ReflectanceTable:
    """Reflectance between zero and a largest distance, piecewise linear in the squared distance."""

    def __init__(self, dipole: Dipole, max_squared: float):
        """Tabulate.

        Args:
            dipole: In the dtype of the distances, float32 or float64.
            max_squared: Largest squared distance.
        """
        depths = dipole.depths
        self._integer, mantissa = _INTEGERS[depths.dtype]
        self._shift = mantissa - _KNOT_BITS
        ends = torch.stack([depths.min() ** 2, depths.min() ** 2 + 2 * max_squared])
        first, last = (ends.view(self._integer) >> self._shift).tolist()
        heads = torch.arange(first, last + 2, dtype=self._integer, device=depths.device)
        knots = (heads << self._shift).view(depths.dtype).double()
        self._first, self._offset = first, float(knots[0])
        exact = dipole.to(knots)
        values = exact.reflectance((knots - knots[0]).sqrt()).T
        self._values = values[:, :-1].to(depths).contiguous()
        self._steps = (values.diff(dim=1) / 2**self._shift).to(depths).contiguous()

    def __call__(self, squared: Float[Tensor, "*batch"]) -> list[Float[Tensor, "*batch"]]:
        """Reflectance by channel.

        Args:
            squared: Distances [length²].
        """
        bits = (squared + self._offset).view(self._integer).flatten()
        knot = (bits >> self._shift).sub_(self._first)
        tail = bits.bitwise_and_(2**self._shift - 1).to(squared.dtype)
        return [
            values.index_select(0, knot)
            .addcmul_(steps.index_select(0, knot), tail)
            .view(squared.shape)
            for values, steps in zip(self._values, self._steps, strict=True)
        ]
