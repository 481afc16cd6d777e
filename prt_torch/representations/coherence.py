"""Cluster coherence: fewer triangles drawn twice, by moving points and by merging clusters.

A renderer of clustered transfer draws a face once for each cluster among its corners: that number
is the face's *overdraw*. Two greedy searches lower its sum over a mesh. :func:`reclassify` moves
points into neighbouring clusters for a little error; :func:`superclusters` lets clusters be drawn
together for none. Both rest on a count of faces:

- Moving a point from cluster x to y spares one draw in each face around it that has y at another
  corner, and adds one in each that has x there. So the reduction is the difference of two counts.
- Merging superclusters x and y spares one draw in each face that has both.

Both searches are deterministic and do not depend on the order of faces or of a face's corners.

Source:
    Sloan, Hall, Hart, Snyder 2003, sections 5 and 6.2.
"""

import heapq
import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable
from fractions import Fraction

import torch
from jaxtyping import Float, Int
from torch import Tensor

Errors = Callable[[Int[Tensor, "n"], Int[Tensor, "n"]], Float[Tensor, "n"]]
"""Squared errors of points, each in a cluster whose subspace stays as it is."""


def _check(labels: Tensor, faces: Tensor) -> None:
    for name, given in (("labels", labels), ("faces", faces)):
        if given.is_floating_point() or given.is_complex() or given.dtype == torch.bool:
            raise ValueError(f"expected integer {name}, got {given.dtype}")
    if labels.ndim != 1:
        raise ValueError(f"expected one label a point, got shape {tuple(labels.shape)}")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"expected faces of 3 points, got shape {tuple(faces.shape)}")
    if len(labels) and int(labels.min()) < 0:
        raise ValueError(f"expected labels of at least 0, got {int(labels.min())}")
    if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < len(labels):
        raise ValueError(f"expected faces of points 0 to {len(labels) - 1}")


def overdraw(labels: Int[Tensor, "points"], faces: Int[Tensor, "faces 3"]) -> Int[Tensor, "faces"]:
    """How often each face is drawn: distinct clusters of its corners, 1 to 3.

    Args:
        labels: Cluster of each point; or its supercluster, ``superclusters(...)[labels]``.
        faces: Points of each face.

    Raises:
        ValueError: If shapes do not fit, or a label or an index is out of range.

    Source:
        Sloan et al. 2003, section 5.
    """
    _check(labels, faces)
    corners = labels[faces.long()].sort(dim=1).values
    return 1 + (corners[:, 1:] != corners[:, :-1]).sum(dim=1)


def reclassify(
    labels: Int[Tensor, "points"],
    faces: Int[Tensor, "faces 3"],
    errors: Errors,
    *,
    budget: float = 0.05,
) -> Int[Tensor, "points"]:
    """Move points into the clusters of their neighbours, so that faces are drawn less often.

    Of all moves that lower the sum of overdraw, the one that lowers it most for its increase of
    error is made, again and again. A move that lowers the error, or keeps it, comes before all
    others, and what it saves may be spent. A move that no longer fits the budget is passed over
    and cheaper ones go on. Equals are taken by larger reduction, then by lower point and cluster.
    A cluster keeps at least one point, so the set of clusters stays as it was.

    Args:
        labels: Cluster of each point.
        faces: Points of each face. Points of no face stay where they are.
        errors: Squared error of points, each in a cluster: ``errors(points, clusters)``. Called
            once with every point in its own cluster, once with all first candidates (a few a
            border point), and with a handful at a time when a move makes a new pair of point and
            neighbouring cluster. Pairs come sorted by cluster; none is asked for twice.
        budget: Increase of the sum of errors allowed, as a share of the initial sum. It is kept
            without rounding. The paper uses 0.05 and 0.1; 0 makes only moves that cost nothing.

    Returns:
        New labels. The sum of overdraw is never above what it was.

    Raises:
        ValueError: If shapes do not fit, a label or an index is out of range, the budget is
            negative or not finite, or ``errors`` returns something negative or not finite.

    Source:
        Sloan et al. 2003, section 5.
    """
    _check(labels, faces)
    if not (math.isfinite(budget) and budget >= 0):
        raise ValueError(f"expected a budget of at least 0, got {budget}")
    search = _Reclassification(labels, faces, errors)
    search.run(search.total + math.floor(search.total * Fraction(budget)))
    return torch.tensor(search.labels, dtype=labels.dtype, device=labels.device)


class _Reclassification:
    """State of the greedy search of :func:`reclassify`.

    Moves lie in a heap, best first. One that a later move has changed is not taken out: its
    point's stamp has gone on, and it is dropped when it comes up.
    """

    def __init__(self, labels: Tensor, faces: Tensor, errors: Errors):
        self.labels: list[int] = labels.tolist()
        self.sizes = Counter(self.labels)
        self.around = _other_corners(faces, len(labels))
        self.stamps = [0] * len(labels)
        self.heap: list[tuple[float, int, int, int, int]] = []
        self.errors = errors
        self.device = labels.device
        self.known: list[dict[int, float]] = [{} for _ in self.labels]
        self._evaluate(enumerate(self.labels))
        own = (error[label] for error, label in zip(self.known, self.labels, strict=True))
        self.total = sum(map(_exact, own))

    def _evaluate(self, pairs: Iterable[tuple[int, int]]) -> None:
        """Make the errors of these points in these clusters known."""
        ordered = sorted(pairs, key=lambda pair: (pair[1], pair[0]))
        if not ordered:
            return
        columns = torch.tensor(ordered, device=self.device)
        values = self.errors(columns[:, 0], columns[:, 1])
        if values.shape != (len(ordered),):
            raise ValueError(f"expected {len(ordered)} errors, got {tuple(values.shape)}")
        if not bool(((values >= 0) & values.isfinite()).all()):
            raise ValueError("expected errors that are finite and at least 0")
        for (point, cluster), error in zip(ordered, values.tolist(), strict=True):
            self.known[point][cluster] = error

    def _reductions(self, point: int) -> dict[int, int]:
        """Overdraw that a move into each cluster at the faces around a point would spare."""
        faces_with: dict[int, int] = {}
        labels = self.labels
        for first, second in self.around[point]:
            one, other = labels[first], labels[second]
            faces_with[one] = faces_with.get(one, 0) + 1
            if other != one:
                faces_with[other] = faces_with.get(other, 0) + 1
        kept = faces_with.pop(labels[point], 0)
        return {cluster: count - kept for cluster, count in faces_with.items()}

    def _consider(self, points: Iterable[int]) -> None:
        """Put the moves of these points into the heap, in place of what it has of them."""
        reductions = {point: self._reductions(point) for point in points}
        self._evaluate(
            (point, cluster)
            for point, clusters in reductions.items()
            for cluster in clusters
            if cluster not in self.known[point]
        )
        for point, clusters in reductions.items():
            self.stamps[point] += 1
            known = self.known[point]
            error = known[self.labels[point]]
            for cluster, reduction in clusters.items():
                if reduction > 0:
                    increase = known[cluster] - error
                    quotient = reduction / increase if increase > 0 else math.inf
                    move = (-quotient, -reduction, point, cluster, self.stamps[point])
                    heapq.heappush(self.heap, move)

    def run(self, limit: int) -> None:
        """Make moves, best first, while the sum of errors stays within the limit."""
        self._consider(range(len(self.labels)))
        too_dear = []
        while self.heap:
            move = heapq.heappop(self.heap)
            _, _, point, cluster, stamp = move
            own = self.labels[point]
            # A lone point may leave once another joins it, which stamps it anew as a neighbour.
            if stamp != self.stamps[point] or self.sizes[own] == 1:
                continue
            known = self.known[point]
            increase = _exact(known[cluster]) - _exact(known[own])
            if self.total + increase > limit:
                too_dear.append(move)
                continue
            self.total += increase
            self.sizes[own] -= 1
            self.sizes[cluster] += 1
            self.labels[point] = cluster
            if increase < 0:
                for again in too_dear:
                    heapq.heappush(self.heap, again)
                too_dear.clear()
            self._consider({point}.union(*self.around[point]))


def _exact(error: float) -> int:
    """A float as a multiple of 2**-1074, the smallest, so that sums are not rounded."""
    numerator, denominator = error.as_integer_ratio()
    return numerator << (1075 - denominator.bit_length())


def _other_corners(faces: Tensor, num_points: int) -> list[list[tuple[int, int]]]:
    """For each point, the other two corners of each face around it.

    A face that names a point twice counts once for it, with the other corner doubled; a face of
    one point is left out, for its overdraw is 1 whatever happens.
    """
    around: list[list[tuple[int, int]]] = [[] for _ in range(num_points)]
    for face in faces.tolist():
        corners = set(face)
        for point in corners:
            others = sorted(corners - {point})
            if others:
                around[point].append((others[0], others[-1]))
    return around


def registers(vectors: Int[Tensor, "clusters"], num_rows: int) -> Int[Tensor, "clusters"]:
    """Registers of four numbers that each cluster's lit representatives take.

    Each vector is one colour where transfer is diffuse, and ``num_rows`` numbers a colour channel,
    one channel a pass, where it is glossy. A vector starts at a whole register, so a quarter of the
    rows is rounded up.

    Args:
        vectors: Of each cluster, its mean included.
        num_rows: Rows of a lit vector; 1 if diffuse.

    Raises:
        ValueError: If a cluster has no vector or there are no rows.

    Source:
        Sloan et al. 2003, section 6.2.
    """
    if num_rows < 1:
        raise ValueError(f"expected at least 1 row, got {num_rows}")
    if len(vectors) and int(vectors.min()) < 1:
        raise ValueError(f"expected at least 1 vector a cluster, got {int(vectors.min())}")
    return vectors * math.ceil(num_rows / 4)


def draws(
    labels: Int[Tensor, "points"],
    faces: Int[Tensor, "faces 3"],
    registers_of_cluster: Int[Tensor, "clusters"],
) -> dict[str, float]:
    """How often a face is drawn, by clusters and by superclusters of 256 registers.

    Args:
        labels: Cluster of each point.
        faces: Points of each face.
        registers_of_cluster: Registers that each cluster takes, as :func:`registers` gives them.

    Returns:
        ``overdraw``, the mean over faces; how many ``superclusters`` there are; and
        ``overdraw_merged``, the mean where these are drawn.

    Source:
        Sloan et al. 2003, sections 5 and 6.2.
    """
    merged = superclusters(labels, faces, registers_of_cluster=registers_of_cluster)
    return {
        "overdraw": float(overdraw(labels, faces).double().mean()),
        "superclusters": len(merged.unique()),
        "overdraw_merged": float(overdraw(merged[labels], faces).double().mean()),
    }


def superclusters(
    labels: Int[Tensor, "points"],
    faces: Int[Tensor, "faces 3"],
    *,
    registers_of_cluster: Int[Tensor, "clusters"],
    max_registers: int = 256,
) -> Int[Tensor, "clusters"]:
    """Group clusters that are drawn together, so that faces are drawn less often.

    Of all pairs of superclusters that share a face and fit the registers together, the one that
    shares most faces is merged, again and again. Equals are taken by their lowest clusters.

    Args:
        labels: Cluster of each point.
        faces: Points of each face.
        registers_of_cluster: Registers that each cluster takes, as :func:`registers` gives them;
            also of clusters without points, which stay alone.
        max_registers: Registers that a supercluster may take. A cluster that takes more on its
            own stays alone.

    Returns:
        Supercluster of each cluster, numbered from 0 by lowest cluster.

    Raises:
        ValueError: If shapes do not fit, a label or an index is out of range, or a number of
            registers is below 1.

    Source:
        Sloan et al. 2003, sections 5 and 6.2.
    """
    _check(labels, faces)
    num_clusters = len(registers_of_cluster)
    if len(labels) and int(labels.max()) >= num_clusters:
        raise ValueError(f"expected registers of {int(labels.max()) + 1} clusters")
    if max_registers < 1 or (num_clusters and int(registers_of_cluster.min()) < 1):
        raise ValueError("expected numbers of registers of at least 1")
    owners = _merge(
        _Borders(labels[faces.long()], num_clusters), registers_of_cluster, max_registers
    )
    numbers = torch.tensor(owners, dtype=torch.long).unique(return_inverse=True)[1]
    return numbers.to(labels.device)


class _Borders:
    """How many faces each two superclusters share; a supercluster goes by its lowest cluster."""

    def __init__(self, corners: Tensor, num_clusters: int):
        self.shared: list[dict[int, int]] = [{} for _ in range(num_clusters)]
        self.triples: list[tuple[set[int], int]] = []
        self.triples_of: list[list[int]] = [[] for _ in range(num_clusters)]
        ordered = corners.sort(dim=1).values
        straddling = ordered[ordered[:, 0] != ordered[:, 2]]
        kinds, counts = straddling.unique(dim=0, return_counts=True)
        for kind, count in zip(kinds.tolist(), counts.tolist(), strict=True):
            clusters = set(kind)
            for one, other in itertools.permutations(clusters, 2):
                self.shared[one][other] = self.shared[one].get(other, 0) + count
            if len(clusters) == 3:
                for cluster in clusters:
                    self.triples_of[cluster].append(len(self.triples))
                self.triples.append((clusters, count))

    def merge(self, low: int, high: int) -> list[int]:
        """Make one of two superclusters, and tell with which others it now shares other counts."""
        changed = []
        for other, count in self.shared[high].items():
            del self.shared[other][high]
            if other != low:
                self._add(low, other, count)
                changed.append(other)
        self.shared[high].clear()
        for number in self.triples_of[high]:
            clusters, count = self.triples[number]
            if len(clusters) < 3:
                continue
            clusters.remove(high)
            if low in clusters:  # both shared this face with the third: it was added twice
                (third,) = clusters - {low}
                self._add(low, third, -count)
            else:
                clusters.add(low)
                self.triples_of[low].append(number)
        return changed

    def _add(self, one: int, other: int, count: int) -> None:
        self.shared[one][other] = self.shared[other][one] = self.shared[one].get(other, 0) + count


def _merge(borders: _Borders, registers_of_cluster: Tensor, max_registers: int) -> list[int]:
    """The greedy search: lowest cluster of each cluster's supercluster."""
    taken: list[int] = registers_of_cluster.tolist()
    owners = list(range(len(taken)))
    heap = [
        (-count, low, high)
        for low, counts in enumerate(borders.shared)
        for high, count in counts.items()
        if low < high
    ]
    heapq.heapify(heap)
    while heap:
        negated, low, high = heapq.heappop(heap)
        # A pair that has grown since comes up with its new count; one that is gone has none.
        current = borders.shared[low].get(high) == -negated
        if not current or taken[low] + taken[high] > max_registers:
            continue
        changed = borders.merge(low, high)
        owners[high] = low
        taken[low] += taken[high]
        for other in changed:
            move = (-borders.shared[low][other], min(low, other), max(low, other))
            heapq.heappush(heap, move)
    for cluster, owner in enumerate(owners):  # owners are lower, so theirs are known
        owners[cluster] = owners[owner]
    return owners
