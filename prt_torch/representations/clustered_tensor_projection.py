"""Transfer in its principal axes of view and light: one small tensor that all later work is on.

The second moments of the rows and of the light coefficients, summed by blocks, give orthonormal
axes of falling energy. The tensor is then read once more and kept in the first of them, in memory;
what lies beyond is lost alike whatever the clusters are. Bases found there are bases of the tensor
itself, and so are the weights: products with the axes are exact.

Source:
    Tsai, Shih 2006, equation 14, for the view mode. Axes of the light mode are ours; they save most
    of the time.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from prt_torch.metric import Metric
from prt_torch.representations.cpca_subspaces import one_thread
from prt_torch.transfer import TransferTensor

_COPIES = 3  # of the projected points: themselves, in fewer rows, and sorted by cluster


@dataclass(frozen=True)
class Axes:
    """Orthonormal axes of one mode, by falling energy, float64.

    Attributes:
        vectors: One a column.
        beyond: Energy of the tensor outside of the first 0, 1, 2... of them.
    """

    vectors: Float[Tensor, "size size"]
    beyond: Float[Tensor, "size_and_one"]

    @classmethod
    def of_moment(cls, moment: Float[Tensor, "size size"]) -> "Axes":
        """The axes of a second moment."""
        with one_thread():
            energies, vectors = torch.linalg.eigh(moment)
        energies = energies.clamp_min(0.0)
        beyond = torch.nn.functional.pad(energies.cumsum(0).flip(0), (0, 1))
        return cls(vectors.flip(1), beyond)

    def enough(self, allowed: float, least: int) -> int:
        """How many axes leave out no more than this energy; at least so many."""
        return max(least, int((self.beyond > allowed).sum()))


@dataclass(frozen=True)
class Moments:
    """Axes of both modes of a weighed tensor that was divided by its scale.

    Attributes:
        view: Of channels times rows.
        light: Of the coefficients.
        scale: Root mean square of the weighed values.
        squared_norm: Of the tensor divided by its scale.
        precision: Type that the values were weighed in.
    """

    view: Axes
    light: Axes
    scale: float
    squared_norm: float
    precision: torch.dtype

    @property
    def view_rank(self) -> int:
        """View axes whose energy is more than rounding."""
        return self.view.enough(torch.finfo(self.precision).eps * self.squared_norm, least=1)


@dataclass(frozen=True)
class Projection:
    """The tensor in its first axes.

    Attributes:
        points: Divided by the scale of the moments.
        view_axes: Orthonormal columns.
        light_axes: Orthonormal columns.
        lost: Energy beyond the axes, over that of the tensor, as the moments tell; not below.
    """

    points: Float[Tensor, "points view light"]
    view_axes: Float[Tensor, "rows view"]
    light_axes: Float[Tensor, "coeffs light"]
    lost: float


def read_moments(transfer: TransferTensor, metric: Metric) -> Moments:
    """Second moments of both modes, in one pass over blocks of points.

    Raises:
        ValueError: If a value is NaN or infinite.
    """
    rows, coeffs = transfer.num_channels * transfer.num_rows, transfer.num_coeffs
    device = transfer.values[0:1].device
    view = torch.zeros(rows, rows, dtype=torch.float64, device=device)
    light = torch.zeros(coeffs, coeffs, dtype=torch.float64, device=device)
    for _, values in transfer.blocks():
        weighed = metric.weigh(_at_least_single(values)).flatten(1, 2)
        # Divided by the largest, so that squares of tiny and huge signals stay in range.
        largest = float(weighed.abs().max()) or 1.0
        weighed = weighed / largest
        view += torch.bmm(weighed, weighed.mT).sum(0, dtype=torch.float64) * largest**2
        flat = weighed.flatten(0, 1)
        light += (flat.mT @ flat).double() * largest**2
    energy = float(view.trace())
    if not energy < float("inf"):
        raise ValueError("transfer values: some are NaN or infinite")
    scale = (energy / (transfer.num_points * rows * coeffs)) ** 0.5 or 1.0
    of_view, of_light = Axes.of_moment(view / scale**2), Axes.of_moment(light / scale**2)
    precision = _at_least_single(transfer.values[0:1]).dtype
    return Moments(of_view, of_light, scale, energy / scale**2, precision)


def project(
    transfer: TransferTensor,
    metric: Metric,
    moments: Moments,
    *,
    allowed: float,
    least: tuple[int, int],
    memory_budget: int,
) -> Projection:
    """Keep the axes that matter.

    Args:
        transfer: The tensor; read by blocks.
        metric: Of the moments.
        moments: Of the tensor.
        allowed: Energy that each mode may lose, in the scale of the moments.
        least: Axes of view and light that are kept in any case.
        memory_budget: Bytes of the projected points and what is made of them. Where ``allowed``
            asks for more, fewer light axes are kept, and the result says what is lost.
    """
    first = _at_least_single(transfer.values[0:1])
    view = moments.view.enough(allowed, least[0])
    light = moments.light.enough(allowed, least[1])
    affordable = memory_budget // (_COPIES * transfer.num_points * view * first.element_size())
    light = max(least[1], min(light, affordable))
    view_axes = moments.view.vectors[:, :view]
    light_axes = moments.light.vectors[:, :light]
    points = first.new_empty(transfer.num_points, view, light)
    for some, values in transfer.blocks():
        weighed = metric.weigh(_at_least_single(values)).flatten(1, 2) / moments.scale
        points[some] = view_axes.mT.to(weighed) @ (weighed @ light_axes.to(weighed))
    beyond = float(moments.view.beyond[view] + moments.light.beyond[light])
    return Projection(points, view_axes, light_axes, beyond / (moments.squared_norm or 1.0))


def _at_least_single(values: Tensor) -> Tensor:
    return values.to(torch.promote_types(values.dtype, torch.float32))
