"""Points of a CPCA in other clusters than their own: what they would lose there, and moving them.

Refined vectors are no longer orthonormal, so each cluster gets an orthonormal basis of their span
by a singular value decomposition in float64; directions that the stored precision cannot tell from
zero are left out, which makes the solve safe where vectors nearly depend on each other.

Source:
    Sloan, Hall, Hart, Snyder 2003, section 5 (what reclassification needs).
"""

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.metric import Metric
from prt_torch.representations.coherence import draws, reclassify, registers
from prt_torch.representations.cpca import CPCA
from prt_torch.representations.cpca_encoding import Encoding
from prt_torch.representations.cpca_subspaces import one_thread
from prt_torch.representations.grouped import ClusterBlocks, sort_labels
from prt_torch.transfer import TransferTensor

_BLOCK_BYTES = 2**25


class ClusterErrors:
    """What points of a transfer lose at best in given clusters of a model.

    Args:
        model: Its clusters; they are read once.
        transfer: What it stands for.
        metric: What errors are worth; the L2 norm over light directions if not given.
    """

    def __init__(self, model: CPCA, transfer: TransferTensor, metric: Metric | None = None):
        self._transfer = transfer
        self._metric = metric or Metric.l2(transfer)
        self._spans = _Spans(model, self._metric)

    def __call__(
        self, points: Int[Tensor, "pairs"], clusters: Int[Tensor, "pairs"]
    ) -> Float[Tensor, "pairs"]:
        """Squared errors in the metric, float64.

        Args:
            points: Numbers of points, in any order and as often as wanted.
            clusters: A cluster for each of them.

        Raises:
            ValueError: If a point or a cluster does not exist.
        """
        _check_range("points", points, self._transfer.num_points)
        _check_range("clusters", clusters, len(self._spans.means))
        errors = torch.zeros(len(points), dtype=torch.float64, device=points.device)
        for pairs, values in _blocks_of(self._transfer, self._metric, points):
            errors[pairs] = self._spans.fit(values, clusters[pairs])[1]
        return errors


def with_labels(
    model: CPCA,
    transfer: TransferTensor,
    labels: Int[Tensor, "points"],
    metric: Metric | None = None,
) -> CPCA:
    """The same subspaces with every point in the cluster it is told, at its best weights there.

    Clusters are numbered anew, from the largest to the smallest; those without a point are left
    out.

    Args:
        model: Its subspaces; left as it is.
        transfer: What it stands for.
        labels: New cluster of each point, in the numbers of ``model``.
        metric: What errors are worth; the L2 norm over light directions if not given.

    Raises:
        ValueError: If there is not one label a point, or a cluster does not exist.
    """
    if len(labels) != model.num_points:
        raise ValueError(f"expected {model.num_points} labels, got {len(labels)}")
    _check_range("labels", labels, model.num_clusters)
    metric = metric or Metric.l2(transfer)
    spans = _Spans(model, metric)
    weights = model.weights.new_zeros(model.num_points, model.layout.max_rank)
    every = torch.arange(model.num_points, device=labels.device)
    for points, values in _blocks_of(transfer, metric, every):
        weights[points] = spans.fit(values, labels[points])[0].to(weights)
    new_labels, old = sort_labels(labels, model.num_clusters)
    old = old[: len(torch.unique(labels))]
    steps = torch.arange(model.layout.max_rank, device=labels.device)
    counts = model.ranks + int(model.affine)
    first = counts.cumsum(0) - counts
    runs = [torch.arange(a, a + n) for a, n in zip(first.tolist(), counts.tolist(), strict=True)]
    vectors = torch.cat([runs[cluster] for cluster in old.tolist()]).to(labels.device)
    encoding = Encoding(
        labels=new_labels,
        ranks=model.ranks[old],
        representatives=model.representatives.detach()[vectors].flatten(1),
        weights=weights[steps < model.ranks[labels][:, None]],
        affine=model.affine,
        condition=model.condition,
    )
    return CPCA(encoding, model.surface, model.shape)


def reclassified(
    model: CPCA,
    transfer: TransferTensor,
    faces: Int[Tensor, "faces 3"],
    *,
    budget: float,
    metric: Metric | None = None,
) -> CPCA:
    """Points moved to clusters of their neighbours, so that faces are drawn less often.

    Args:
        model: What was fitted; left as it is.
        transfer: What it stands for.
        faces: Points of each face.
        budget: Share of the error that may be paid for it.
        metric: What errors are worth; the L2 norm over light directions if not given.
    """
    errors = ClusterErrors(model, transfer, metric)
    labels = reclassify(model.labels, faces, errors, budget=budget)
    return with_labels(model, transfer, labels, metric)


def coherence(model: CPCA, faces: Int[Tensor, "faces 3"]) -> dict[str, float]:
    """How often a face is drawn, by clusters and by superclusters of 256 registers.

    Source:
        Sloan, Hall, Hart, Snyder 2003, sections 5 and 6.2.
    """
    vectors = (model.ranks + int(model.affine)).clamp_min(1)  # a linear cluster may have none
    return draws(model.labels, faces, registers(vectors, model.num_rows))


def _check_range(name: str, numbers: Tensor, count: int) -> None:
    if len(numbers) and not 0 <= int(numbers.min()) <= int(numbers.max()) < count:
        raise ValueError(
            f"expected {name} from 0 to {count - 1}, "
            f"got {int(numbers.min())} to {int(numbers.max())}"
        )


def _blocks_of(
    transfer: TransferTensor, metric: Metric, points: Tensor
) -> Iterator[tuple[Int[Tensor, "some"], Float[Tensor, "some values"]]]:
    """Weighed values of the points asked for, float64, with their places among these."""
    point_bytes = 8 * transfer.num_channels * transfer.num_rows * transfer.num_coeffs
    for some in points.argsort(stable=True).split(max(1, _BLOCK_BYTES // point_bytes)):
        if len(some) == 0:
            continue
        first = int(points[some[0]])
        values = transfer.values[first : int(points[some[-1]]) + 1]
        yield some, metric.weigh(values[points[some] - first].double()).flatten(1)


class _Spans:
    """Means and orthonormal bases of every cluster, and the way back to its own vectors."""

    def __init__(self, model: CPCA, metric: Metric):
        own = model.layout.by_cluster(model.representatives.detach().double())
        own = metric.weigh(own).flatten(2)
        self.means = own[:, 0] if model.affine else torch.zeros_like(own[:, 0])
        vectors = own[:, 1:] if model.affine else own
        with one_thread():
            left, singular, bases = torch.linalg.svd(vectors, full_matrices=False)
        resolution = torch.finfo(model.weights.dtype).eps * max(vectors.shape[1:])
        kept = singular > resolution * singular[:, :1]
        self.bases = bases * kept[..., None]
        inverse = kept / torch.where(kept, singular, 1.0)
        self.to_weights = inverse[..., None] * left.mT

    def fit(
        self, values: Float[Tensor, "some values"], clusters: Int[Tensor, "some"]
    ) -> tuple[Float[Tensor, "some rank"], Float[Tensor, "some"]]:
        """Best weights of each point in its cluster, and the squared error left."""
        labels, old = sort_labels(clusters, len(self.means))
        blocks = ClusterBlocks(labels, len(self.means))
        slots = blocks.to_slots(values - self.means[clusters])
        bases = self.bases[old]
        within = blocks.matmul(slots, bases.mT)
        left = slots - blocks.matmul(within, bases)
        weights = blocks.matmul(within, self.to_weights[old])
        return blocks.to_points(weights), blocks.to_points(left.square().sum(1))
