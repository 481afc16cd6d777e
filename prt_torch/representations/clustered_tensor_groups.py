"""Groups of points of one material each, whose clusters share a view basis.

Outgoing radiance of different reflectances lies in different subspaces of the rows, so points of
different materials share no cluster and no view basis: the tensor is cut into one for each
material, each is encoded by itself, and the encodings are put together. Smaller ranks of a group
are filled up with zeros, such as the view rank of Lambertian points, which have one row.

Each group has one cluster, and each further cluster goes to the group of most squared norm a
cluster. So clusters are shared out about in proportion to the squared norm, which is what is at
stake: as many clusters take about the same share of it from any group, whereas by number of points
a large dim ground would take clusters that lower the error by next to nothing.

Source:
    Tsai, Shih 2006, section 5.2.1. How clusters are shared out is ours.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from prt_torch.errors import InputError
from prt_torch.representations.clustered_tensor_coding import Encoding, Parameters
from prt_torch.representations.points import renumber
from prt_torch.representations.processes import ALONE, Processes
from prt_torch.transfer import Rows, Surface, TransferTensor


def split(
    transfer: TransferTensor, processes: Processes = ALONE
) -> list[tuple[Int[Tensor, "_"], TransferTensor]]:
    """The points of each material that occurs, and their transfer, read where it is asked for.

    A process may have no points of a material that others have.
    """
    materials = transfer.surface.materials
    kinds = [] if materials is None else processes.gather(materials.unique()).unique()
    if materials is None or len(kinds) < 2:
        return [(torch.arange(transfer.num_points), transfer)]
    bases = Surface(transfer.surface.exit_basis, transfer.surface.light_basis)
    groups = [torch.nonzero(materials == kind)[:, 0] for kind in kinds]
    return [(own, TransferTensor(_Some(transfer.values, own), bases)) for own in groups]


class _Some:
    """Values of some points, in rising order, read in runs of points side by side."""

    def __init__(self, values: Rows, points: Int[Tensor, "some"]):
        self._values, self._points = values, points
        self.shape, self.dtype = (len(points), *values.shape[1:]), values.dtype

    def __getitem__(self, rows: slice, /) -> Tensor:
        points = self._points[rows].cpu()
        if len(points) == 0:
            return self._values[0:0]
        borders = torch.nonzero(points.diff() != 1)[:, 0] + 1
        runs = [run.tolist() for run in points.tensor_split(borders)]
        return torch.cat([self._values[run[0] : run[-1] + 1] for run in runs])


def share_out(num_clusters: int, squared_norms: Sequence[float], sizes: Sequence[int]) -> list[int]:
    """Clusters of each group: one, and each further one where most squared norm a cluster is.

    Args:
        num_clusters: Of all groups; fewer are shared out if there are fewer points.
        squared_norms: Of the transfer of each group.
        sizes: Points of each group, the most clusters that it takes.

    Raises:
        InputError: If there are fewer clusters than groups.
    """
    counts = [1] * len(sizes)
    if num_clusters < len(counts):
        raise InputError(
            f"num_clusters: {len(counts)} materials need a cluster each, got {num_clusters}"
        )
    for _ in range(min(num_clusters, sum(sizes)) - len(counts)):
        unfilled = [place for place, size in enumerate(sizes) if counts[place] < size]
        counts[max(unfilled, key=lambda place: squared_norms[place] / counts[place])] += 1
    return counts


def join(
    parts: Sequence[tuple[Int[Tensor, "_"], Encoding]], processes: Processes = ALONE
) -> Encoding:
    """One encoding of all points from those of the groups, in which nothing is rounded yet.

    Args:
        parts: Points of each group, and their encoding with one view basis.
        processes: Those that have points too.
    """
    if len(parts) == 1:
        return parts[0][1]
    each = [encoding.parameters for _, encoding in parts]
    counts = [len(one.cores) for one in each]
    shapes = zip(*(one.cores.shape[1:] for one in each), strict=True)
    rank, view, light = (max(sizes) for sizes in shapes)
    labels = parts[0][1].labels.new_empty(sum(len(points) for points, _ in parts))
    weights = each[0].weights.new_zeros(len(labels), rank)
    first = 0
    for (points, encoding), count in zip(parts, counts, strict=True):
        points = points.to(labels.device)
        labels[points] = encoding.labels + first
        weights[points] = _filled_up(encoding.parameters.weights, rank)
        first += count
    labels, old = renumber(labels, first, processes)
    numbers = [old.new_full((count,), group) for group, count in enumerate(counts)]
    light_bases = [_filled_up(one.light_bases, light, one.light_bases.shape[2]) for one in each]
    return Encoding(
        labels=labels,
        groups=torch.cat(numbers)[old],
        parameters=Parameters(
            view_basis=torch.cat([_filled_up(one.view_basis, view) for one in each]),
            light_bases=torch.cat(light_bases)[old],
            cores=torch.cat([_filled_up(one.cores, rank, view, light) for one in each])[old],
            weights=weights,
        ),
        steps=None,
        condition=max(encoding.condition for _, encoding in parts),
    )


def _filled_up(values: Float[Tensor, "..."], *sizes: int) -> Float[Tensor, "..."]:
    """With zeros behind, so that the last dimensions are of these sizes."""
    missing = [size - own for size, own in zip(sizes, values.shape[-len(sizes) :], strict=True)]
    return pad(values, [count for size in reversed(missing) for count in (0, size)])
