"""Sums over points that come out the same to the bit in any order.

Values are cut into limbs of 20 bits, whole numbers whose products and sums float64 holds exactly,
and whole numbers of int64 add up without rounding. So it does not matter in which chunks, or on how
many processes, the points are. Directions that weak values have are close to arbitrary, and the
clusters of points are chosen by comparisons, so all that follows would be another if such a sum
differed in its last digits.

Values of float32 are cut to their first limb: 20 bits of the largest of their column. Nothing is
made of these sums but directions to work in, which need no more.

Source:
    After Demmel, Nguyen 2015, "Parallel reproducible summation", whose bins are limbs here.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.representations.grouped import ClusterBlocks
from prt_torch.representations.processes import Processes

_EXACT = 53  # bits of whole numbers in float64
_LEAST_EXPONENT = -100  # of the largest: a unit of less has no inverse in float32
_ROWS = 512  # that are converted together, so that they stay in cache
_TABLE = 2**17  # elements of a product
_LIMBS = {torch.float64: 3}  # that hold all digits; of other types, one


@dataclass(frozen=True)
class FixedPoint:
    """Numbers of so many bits that their products add up without rounding.

    Args:
        total: How many products are added at most.
    """

    total: int

    @property
    def bits(self) -> int:
        """Of a number, its sign aside: 20, or less where very many are added in int64."""
        return min(20, (60 - math.ceil(math.log2(max(2, self.total)))) // 2)

    @property
    def rows(self) -> int:
        """How many products add up exactly in float64."""
        return 2 ** (_EXACT - 2 * self.bits - 1)

    def step(self, largest: Float[Tensor, "*some"]) -> Float[Tensor, "*some"]:
        """What a unit is for numbers up to these: a power of two, so scaling rounds nothing."""
        exponents = torch.frexp(largest.double()).exponent.clamp_min(_LEAST_EXPONENT) - self.bits
        return torch.ldexp(torch.ones_like(exponents, dtype=torch.float64), exponents)

    @staticmethod
    def units(values: Float[Tensor, "*#some"], per_step: Float[Tensor, "*#some"]) -> Tensor:
        """Whole numbers of steps, float64; ``per_step`` are the inverses, in the type of values."""
        return values.mul(per_step).round_().double()


class ExactProducts:
    """Sum over points of the outer products of their values, ``left^T right``.

    Args:
        left: Largest magnitude of each column, of all points, in the type of the values.
        right: The same.
        total: Points in all.
        processes: Those that have some of them.
    """

    def __init__(
        self, left: Float[Tensor, "a"], right: Float[Tensor, "b"], total: int, processes: Processes
    ):
        self._fixed = FixedPoint(total)
        self._left, self._right = self._fixed.step(left), self._fixed.step(right)
        shape = (_LIMBS.get(left.dtype, 1), len(left), len(right))
        self._sums = torch.zeros(shape, dtype=torch.int64, device=left.device)
        self._processes = processes

    def _limbs(self, values: Tensor, step: Tensor) -> list[Float[Tensor, "some columns"]]:
        """Whole numbers, each a unit of the one before cut in ``2^bits``."""
        limbs = [self._fixed.units(values, (1.0 / step).to(values))]
        for _ in self._sums[1:]:
            values = values - limbs[-1] * step
            step = step / 2**self._fixed.bits
            limbs.append(self._fixed.units(values, 1.0 / step))
        return limbs

    def add(self, left: Float[Tensor, "some a"], right: Float[Tensor, "some b"]) -> None:
        """Some points' values."""
        most = min(_ROWS, self._fixed.rows)
        pairs = zip(left.split(most), right.split(most), strict=True)
        for some, others in pairs:
            first = self._limbs(some, self._left)
            second = first if left is right else self._limbs(others, self._right)
            for place, total in enumerate(self._sums):
                for limb in range(place + 1):
                    _add_product(total, first[limb], second[place - limb])

    def value(self) -> Float[Tensor, "a b"]:
        """The sum over all processes, float64."""
        total = torch.zeros_like(self._sums[0], dtype=torch.float64)
        for own in reversed(self._processes.sum(self._sums).unbind()):  # the smallest first
            total.div_(2**self._fixed.bits).add_(own)
        return total.mul_(self._left[:, None]).mul_(self._right)


class ExactClusterProducts:
    """The same for each cluster, whose points are told twice: first how large they are.

    Args:
        shape: Clusters, columns of the first and of the second values.
        like: Type and device of the values.
        total: Points in all.
        processes: Those that have some of them.
    """

    def __init__(self, shape: tuple[int, int, int], like: Tensor, total: int, processes: Processes):
        clusters, left, right = shape
        self._fixed, self._processes = FixedPoint(total), processes
        self._left, self._right = like.new_zeros(clusters, left), like.new_zeros(clusters, right)
        self._sum = like.new_zeros(shape, dtype=torch.int64)

    def look(self, *largest: Float[Tensor, "clusters _"]) -> None:
        """Largest magnitudes of some points' values of both kinds."""
        for known, own in zip((self._left, self._right), largest, strict=True):
            torch.maximum(known, own, out=known)

    def looked(self) -> None:
        """All have been seen."""
        self._left, self._right = (
            self._fixed.step(self._processes.largest(one)) for one in (self._left, self._right)
        )

    def add(self, blocks: ClusterBlocks, *values: Float[Tensor, "slots _"]) -> None:
        """The same values again, to be added."""
        steps = (self._left, self._right)
        left, right = (blocks.by_size(1.0 / step)[:, None].to(values[0]) for step in steps)
        found, most = [], self._fixed.rows
        for some, (first, second) in blocks.runs(*values):
            one = self._fixed.units(first, left[some]).split(most, dim=1)
            other = self._fixed.units(second, right[some]).split(most, dim=1)
            found.append(sum(_product(a, b).long() for a, b in zip(one, other, strict=True)))
        self._sum += blocks.by_number(torch.cat(found))

    def value(self) -> Float[Tensor, "clusters left right"]:
        """The sum over all processes, float64."""
        total = self._processes.sum(self._sum).double()
        return total * self._left[:, :, None] * self._right[:, None]


def _add_product(total: Tensor, left: Tensor, right: Tensor) -> None:
    """Add ``left^T right`` to whole numbers, a few rows at a time, as products take memory too."""
    most = max(1, _TABLE // total.shape[1])
    for rows, columns in zip(total.split(most), left.split(most, dim=1), strict=True):
        rows += (columns.mT @ right).long()


def _product(
    left: Float[Tensor, "clusters size a"], right: Float[Tensor, "clusters size b"]
) -> Float[Tensor, "clusters a b"]:
    """``left^T right``; with the wider one last it takes less than half the time."""
    if left.shape[2] <= right.shape[2]:
        return torch.bmm(left.mT, right)
    return torch.bmm(right.mT, left).mT
