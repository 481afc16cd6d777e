"""The processes of one fit, each with points of its own; usually there is just one.

Fits look at points in two ways only: they change what belongs to a point (its cluster, its
weights), which needs no other process, and they add up over points (means, moments, errors), which
is one reduction. So a fit on several processes is the fit on one with :meth:`Processes.sum` where
sums are. Sums are those of float64 and all else follows from them, so every process makes the same
clusters and vectors, and those of a single process but for the order of the additions.

What one process alone may decide (which of its points has the largest error, where a random draw
falls) is told by numbers of points counted over all processes, in order of rank.
"""

from dataclasses import replace

import torch
import torch.distributed as distributed
from jaxtyping import Shaped
from torch import Tensor

from prt_torch.transfer import Surface


class Processes:
    """Reductions over a process group; over nothing where there is none.

    Args:
        group: Of ``torch.distributed``, such as ``torch.distributed.group.WORLD``; None for a fit
            in this process alone.
    """

    def __init__(self, group: distributed.ProcessGroup | None = None):
        self._group = group
        self.count = 1 if group is None else distributed.get_world_size(group)
        self.rank = 0 if group is None else distributed.get_rank(group)

    def sum(self, values: Shaped[Tensor, "*shape"]) -> Shaped[Tensor, "*shape"]:
        """Over all processes, in place where there are several; give float64."""
        if self.count > 1:
            distributed.all_reduce(values, group=self._group)
        return values

    def largest(self, values: Tensor) -> Tensor:
        """The largest of all processes, element by element, in place where there are several."""
        if self.count > 1:
            distributed.all_reduce(values, distributed.ReduceOp.MAX, group=self._group)
        return values

    def gather(self, values: Shaped[Tensor, "some *rest"]) -> Shaped[Tensor, "all *rest"]:
        """The rows of all processes, in order of rank; each may have another number of them."""
        if self.count == 1:
            return values
        lengths = self.lengths(len(values))
        padded = values.new_zeros(max(lengths), *values.shape[1:])
        padded[: len(values)] = values
        parts = [torch.empty_like(padded) for _ in lengths]
        distributed.all_gather(parts, padded, group=self._group)
        return torch.cat([part[:length] for part, length in zip(parts, lengths, strict=True)])

    def lengths(self, length: int) -> list[int]:
        """This number of every process, in order of rank."""
        if self.count == 1:
            return [length]
        device = "cuda" if distributed.get_backend(self._group) == "nccl" else "cpu"
        own = torch.tensor([length], device=device)
        every = [torch.empty_like(own) for _ in range(self.count)]
        distributed.all_gather(every, own, group=self._group)
        return [int(one) for one in every]

    def gather_surface(self, surface: Surface, num_points: int) -> Surface:
        """The surface of all points, where each process has ``num_points`` of its own."""
        shared = all(length == 1 for length in self.lengths(len(surface.reflectance)))
        shared &= max(self.lengths(num_points)) > 1

        def whole(values: Tensor | None) -> Tensor | None:
            return None if values is None else self.gather(values)

        return replace(
            surface,
            reflectance=surface.reflectance if shared else self.gather(surface.reflectance),
            frames=whole(surface.frames),
            positions=whole(surface.positions),
            materials=whole(surface.materials),
        )


ALONE = Processes()
"""A fit in this process alone."""
