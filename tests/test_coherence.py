"""Cluster coherence: known overdraw, brute-force searches, exact budgets, the paper's limits."""

import itertools
import math
import time
from fractions import Fraction

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from prt_torch.representations.coherence import (
    _Borders,
    overdraw,
    reclassify,
    registers,
    superclusters,
)

EXAMPLES = settings(max_examples=60, deadline=None, derandomize=True)


def grid(rows: int, cols: int | None = None) -> torch.Tensor:
    """Faces of a grid of points, two a cell."""
    points = torch.arange(rows * (cols or rows)).view(rows, -1)
    a, b = points[:-1, :-1].flatten(), points[:-1, 1:].flatten()
    c, d = points[1:, :-1].flatten(), points[1:, 1:].flatten()
    return torch.cat([torch.stack([a, c, b], 1), torch.stack([b, c, d], 1)])


def total(labels, faces) -> int:
    return int(overdraw(labels, faces).sum())


class Table:
    """Errors of points in clusters, from a table; notes what it is asked."""

    def __init__(self, values: torch.Tensor):
        self.values = values
        self.calls: list[list[tuple[int, int]]] = []

    def __call__(self, points, clusters):
        self.calls.append(list(zip(points.tolist(), clusters.tolist(), strict=True)))
        return self.values[points, clusters]

    def exact(self, labels) -> Fraction:
        return sum(
            (Fraction(float(self.values[i, c])) for i, c in enumerate(labels.tolist())), Fraction(0)
        )


def random_case(seed: int, rows: int, clusters: int, whole: bool):
    """Labels of a grid and a table of errors; whole numbers give ties, zeros and decreases."""
    generator = torch.Generator().manual_seed(seed)
    labels = torch.randint(clusters, (rows * rows,), generator=generator)
    values = torch.rand(rows * rows, clusters, generator=generator, dtype=torch.float64)
    return labels, grid(rows), Table((values * 4).floor() if whole else values)


cases = st.builds(
    random_case, st.integers(0, 10**6), st.integers(2, 6), st.integers(1, 6), st.booleans()
)


# Overdraw


def test_overdraw_of_a_cell():
    faces = torch.tensor([[0, 1, 2], [2, 1, 3]])
    for labels, expected in [
        ([5, 5, 5, 5], [1, 1]),
        ([0, 1, 1, 1], [2, 1]),
        ([0, 0, 1, 1], [2, 2]),
        ([0, 1, 2, 0], [3, 3]),
        ([3, 3, 3, 9], [1, 2]),
    ]:
        assert overdraw(torch.tensor(labels), faces).tolist() == expected


def test_overdraw_of_two_halves_is_one_strip():
    """A straight border between columns crosses each face of one column of cells."""
    labels = (torch.arange(8) >= 3).long().repeat(5)
    assert total(labels, grid(5, 8)) == 2 * 4 * 7 + 2 * 4


def test_overdraw_of_all_different_points_is_three():
    faces = grid(6)
    assert overdraw(torch.arange(36), faces).tolist() == [3] * len(faces)


def test_overdraw_takes_any_integers():
    labels, faces = torch.tensor([0, 200, 7, 7], dtype=torch.int16), grid(2)
    assert overdraw(labels, faces.int()).tolist() == overdraw(labels.long(), faces).tolist()


# Reclassification


def brute_reclassify(labels, faces, table, budget):
    """Every move weighed anew at every step, by the overdraw of the whole mesh."""
    labels = labels.clone()
    limit = table.exact(labels) * (1 + Fraction(budget))
    adjacent = [set() for _ in labels]
    for face in faces.tolist():
        for point in face:
            adjacent[point] |= set(face) - {point}
    while True:
        now, best = total(labels, faces), None
        for point, near in enumerate(adjacent):
            own = int(labels[point])
            if int((labels == own).sum()) == 1:
                continue
            for cluster in {int(labels[other]) for other in near} - {own}:
                moved = labels.clone()
                moved[point] = cluster
                gain = now - total(moved, faces)
                increase = float(table.values[point, cluster]) - float(table.values[point, own])
                if gain <= 0 or table.exact(moved) > limit:
                    continue
                quotient = gain / increase if increase > 0 else math.inf
                best = min(best or (math.inf,), (-quotient, -gain, point, cluster))
        if best is None:
            return labels
        labels[best[2]] = best[3]


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("budget", [0.0, 0.05, 0.3, 10.0])
@pytest.mark.parametrize("seed", range(4))
def test_reclassify_equals_brute_force(seed, budget, whole):
    labels, faces, table = random_case(seed, 5, 4, whole)
    expected = brute_reclassify(labels, faces, table, budget)
    assert reclassify(labels, faces, table, budget=budget).tolist() == expected.tolist()


def test_one_stray_point_is_taken_in():
    """A point inside another cluster costs one draw in each of its six faces."""
    labels = torch.zeros(25, dtype=torch.long)
    labels[12], labels[0] = 1, 1
    values = torch.ones(25, 2, dtype=torch.float64)
    values[12, 0] = 2.0
    values[0, 0] = 1e3
    moved = reclassify(labels, grid(5), Table(values), budget=0.05)
    assert moved[12] == 0
    assert moved[0] == 1
    assert total(labels, grid(5)) - total(moved, grid(5)) == 6
    assert torch.equal(reclassify(labels, grid(5), Table(values), budget=0.039), labels)


def test_budget_is_exact_to_the_last_bit():
    """Moves that cost precisely the budget are made; one bit less and they are not."""
    labels = torch.tensor([0, 1, 0, 0, 1])
    faces = torch.tensor([[0, 1, 2], [2, 1, 3]])
    values = torch.full((5, 2), 0.25, dtype=torch.float64)
    values[1, 0] = 0.5  # a fifth of the sum, 1.25, more
    assert reclassify(labels, faces, Table(values), budget=0.2)[1] == 0  # float 0.2 > 1/5
    assert reclassify(labels, faces, Table(values), budget=math.nextafter(0.2, 0))[1] == 1


def test_sums_do_not_lose_small_errors_beside_large_ones():
    """1e16 and a thousand ones: a plain float64 sum would not see the moves."""
    labels, faces = torch.arange(900) % 3, grid(30)
    values = torch.rand(900, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    values[0] = 1e16
    table = Table(values)
    moved = reclassify(labels, faces, table, budget=1e-15)
    assert not torch.equal(moved, labels)
    assert table.exact(moved) <= table.exact(labels) * (1 + Fraction(1e-15))


@EXAMPLES
@given(cases, st.sampled_from([0.0, 0.01, 0.05, 0.5, 3.0]))
def test_reclassify_keeps_its_promises(case, budget):
    labels, faces, table = case
    moved = reclassify(labels, faces, table, budget=budget)
    assert table.exact(moved) <= table.exact(labels) * (1 + Fraction(budget))
    changed = int((moved != labels).sum())
    assert total(moved, faces) <= total(labels, faces) - changed
    assert set(moved.tolist()) == set(labels.tolist())
    asked = list(itertools.chain(*table.calls))
    assert len(asked) == len(set(asked))


@EXAMPLES
@given(cases, st.randoms(use_true_random=False))
def test_order_of_faces_and_corners_changes_nothing(case, random):
    labels, faces, table = case
    shuffled = [random.sample(face, 3) for face in random.sample(faces.tolist(), len(faces))]
    shuffled = torch.tensor(shuffled)
    moved = reclassify(labels, faces, table, budget=0.2)
    assert torch.equal(moved, reclassify(labels, shuffled, table, budget=0.2))
    sizes = torch.full((int(labels.max()) + 1,), 9)
    grouped = superclusters(labels, faces, registers_of_cluster=sizes, max_registers=27)
    again = superclusters(labels, shuffled, registers_of_cluster=sizes, max_registers=27)
    assert torch.equal(grouped, again)


def test_no_budget_makes_only_free_moves():
    labels, faces, table = random_case(3, 6, 4, whole=True)
    moved = reclassify(labels, faces, table, budget=0.0)
    assert not torch.equal(moved, labels)
    assert table.exact(moved) <= table.exact(labels)
    values = torch.ones_like(table.values) + 1e-12
    values[torch.arange(36), labels] = 1.0
    assert torch.equal(reclassify(labels, faces, Table(values), budget=0.0), labels)


def test_what_a_decrease_saves_is_spent():
    """A move too dear for the budget waits; a cheap one makes way for a decrease, which pays."""
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 4], [5, 6, 7], [5, 8, 9]])
    labels = torch.tensor([0, 1, 1, 1, 1, 0, 2, 2, 0, 2, 0])
    values = torch.full((11, 3), 100.0, dtype=torch.float64)
    values[torch.arange(11), labels] = 1.0
    values[0, 1] = 1.75  # spares 3 for 0.75: best, but the budget is 0.6
    values[5, 2] = 1.5  # spares 1 for 0.5
    values[8] = torch.tensor([2.0, 100.0, 1.0])  # spares nothing before 5 has moved
    expected = labels.clone()
    expected[[0, 5, 8]] = torch.tensor([1, 2, 2])
    assert torch.equal(reclassify(labels, faces, Table(values), budget=0.05), expected)
    values[8, 2] = 2.0
    expected[0] = 0
    assert torch.equal(reclassify(labels, faces, Table(values), budget=0.05), expected)


def test_a_lone_point_keeps_its_cluster():
    labels = torch.zeros(9, dtype=torch.long)
    labels[4] = 1
    table = Table(torch.zeros(9, 2, dtype=torch.float64))
    assert torch.equal(reclassify(labels, grid(3), table, budget=1.0), labels)
    different = torch.arange(9)
    table = Table(torch.zeros(9, 9, dtype=torch.float64))
    assert torch.equal(reclassify(different, grid(3), table, budget=1.0), different)


def test_isolated_points_and_points_of_one_cluster_are_left_alone():
    labels = torch.tensor([0, 0, 1, 1, 1, 0, 2])
    faces = torch.tensor([[0, 2, 3]])
    table = Table(torch.zeros(7, 3, dtype=torch.float64))
    moved = reclassify(labels, faces, table, budget=1.0)
    assert moved.tolist() == [1, 0, 1, 1, 1, 0, 2]
    one = torch.full((7,), 2)
    assert torch.equal(reclassify(one, faces, table, budget=1.0), one)
    assert torch.equal(reclassify(labels, faces[:0], table, budget=1.0), labels)


def test_faces_that_name_a_point_twice():
    faces = torch.tensor([[0, 0, 1], [1, 2, 1], [3, 3, 3], [0, 2, 3], [3, 4, 4], [3, 4, 5]])
    for labels in itertools.islice(itertools.product(range(3), repeat=6), 0, None, 5):
        labels = torch.tensor(labels)
        values = (torch.arange(18.0, dtype=torch.float64).view(6, 3) * 7) % 5
        found = reclassify(labels, faces, Table(values), budget=0.3)
        assert found.tolist() == brute_reclassify(labels, faces, Table(values), 0.3).tolist()


def test_errors_are_asked_in_two_batches_sorted_by_cluster():
    labels, faces, table = random_case(5, 12, 8, whole=False)
    reclassify(labels, faces, table, budget=0.1)
    near = {
        (point, int(labels[other]))
        for face in faces.tolist()
        for point, other in itertools.permutations(face, 2)
        if labels[other] != labels[point]
    }
    own = set(enumerate(labels.tolist()))
    for batch, expected in zip(table.calls, (own, near), strict=False):
        assert batch == sorted(expected, key=lambda pair: (pair[1], pair[0]))
    assert sum(map(len, table.calls[2:])) < len(near)


def test_reclassify_keeps_type_and_input():
    labels, faces, table = random_case(1, 4, 3, whole=False)
    before = labels.clone()
    moved = reclassify(labels.to(torch.int16), faces.int(), table)
    assert moved.dtype == torch.int16
    assert torch.equal(moved.long(), reclassify(labels, faces, table))
    assert torch.equal(labels, before)


# Superclusters


def brute_superclusters(labels, faces, sizes, limit):
    """Every pair weighed anew at every step, by the faces that have both."""
    owner = list(range(len(sizes)))
    while True:
        best = None
        corners = [{owner[int(labels[p])] for p in face} for face in faces.tolist()]
        for low, high in itertools.combinations(sorted(set(owner)), 2):
            count = sum({low, high} <= clusters for clusters in corners)
            taken = sum(s for s, o in zip(sizes, owner, strict=True) if o in (low, high))
            if count and taken <= limit:
                best = min(best or (0,), (-count, low, high))
        if best is None:
            numbers = {low: number for number, low in enumerate(sorted(set(owner)))}
            return [numbers[low] for low in owner]
        owner = [best[1] if o == best[2] else o for o in owner]


@EXAMPLES
@given(
    st.integers(0, 10**6),
    st.integers(3, 6),
    st.lists(st.integers(1, 6), min_size=1, max_size=12),
    st.integers(1, 30),
)
def test_superclusters_equal_brute_force(seed, rows, sizes, limit):
    generator = torch.Generator().manual_seed(seed)
    labels = torch.randint(len(sizes), (rows * rows,), generator=generator)
    found = superclusters(
        labels, grid(rows), registers_of_cluster=torch.tensor(sizes), max_registers=limit
    )
    assert found.tolist() == brute_superclusters(labels, grid(rows), sizes, limit)
    assert total(found[labels], grid(rows)) <= total(labels, grid(rows))
    for supercluster in range(int(found.max()) + 1):
        members = [s for s, f in zip(sizes, found.tolist(), strict=True) if f == supercluster]
        assert members
        assert sum(members) <= limit or len(members) == 1


@EXAMPLES
@given(st.integers(0, 10**6), st.randoms(use_true_random=False))
def test_shared_faces_after_any_merges_are_those_counted_anew(seed, random):
    generator = torch.Generator().manual_seed(seed)
    owner = torch.arange(8)
    corners = torch.randint(8, (40, 3), generator=generator)
    borders = _Borders(corners, 8)
    for _ in range(6):
        low, high = sorted(random.sample(owner.unique().tolist(), 2))
        borders.merge(low, high)
        owner[owner == high] = low
        assert borders.shared == _Borders(owner[corners], 8).shared


def test_four_strips_pair_up():
    """The longest border goes first: strips side by side, of different widths, all border alike."""
    labels = torch.tensor([0, 0, 1, 1, 2, 2, 3, 3]).repeat(4)
    faces = grid(4, 8)
    sizes = torch.full((4,), 10)

    def grouped(limit):
        return superclusters(
            labels, faces, registers_of_cluster=sizes, max_registers=limit
        ).tolist()

    assert grouped(19) == [0, 1, 2, 3]
    assert grouped(20) == [0, 0, 1, 1]
    assert grouped(30) == [0, 0, 0, 1]
    assert grouped(40) == [0, 0, 0, 0]
    assert total(torch.tensor(grouped(20))[labels], faces) == len(faces) + 6


def test_a_face_of_three_clusters_is_spared_twice_at_most():
    """Merging two of three leaves the third with the face once, not twice."""
    faces = torch.tensor([[0, 1, 2], [0, 1, 2], [2, 3, 4], [3, 4, 5], [2, 3, 3]])
    labels = torch.tensor([0, 1, 2, 3, 3, 3])
    sizes = torch.ones(4, dtype=torch.long)

    def grouped(limit):
        return superclusters(
            labels, faces, registers_of_cluster=sizes, max_registers=limit
        ).tolist()

    # All of 01, 02, 12 and 23 share two faces. Then {01} shares two with 2, no more than 23.
    assert grouped(2) == [0, 0, 1, 1]
    assert grouped(3) == [0, 0, 0, 1]


def test_clusters_too_large_or_without_points_stay_alone():
    labels, faces = torch.tensor([0, 1, 2, 1]), grid(2)
    sizes = torch.tensor([300, 1, 1, 1, 1])
    found = superclusters(labels, faces, registers_of_cluster=sizes)
    assert found.tolist() == [0, 1, 1, 2, 3]


def test_one_cluster_and_all_different_clusters():
    faces = grid(4)
    one = superclusters(
        torch.zeros(16, dtype=torch.long), faces, registers_of_cluster=torch.tensor([9])
    )
    assert one.tolist() == [0]
    sizes = torch.ones(16, dtype=torch.long)
    found = superclusters(torch.arange(16), faces, registers_of_cluster=sizes, max_registers=16)
    assert total(found, faces) == len(faces)


@pytest.mark.parametrize(("num_rows", "clusters"), [(16, 7), (24, 4), (1, 28)])
def test_clusters_a_supercluster_in_the_paper(num_rows, clusters):
    """256 registers for a mean and rank 8 each: as many clusters in a row as fit, no more."""
    sizes = registers(torch.full((60,), 9), num_rows)
    assert 256 // int(sizes[0]) == clusters
    labels = torch.arange(60).repeat(2)
    found = superclusters(labels, grid(2, 60), registers_of_cluster=sizes)
    assert int(torch.bincount(found).max()) == clusters


def test_registers():
    assert registers(torch.tensor([1, 4, 9]), 24).tolist() == [6, 24, 54]
    assert registers(torch.tensor([9]), 25).tolist() == [63]  # a seventh register for one number
    assert registers(torch.tensor([1, 9]), 1).tolist() == [1, 9]


# Mistakes


@pytest.mark.parametrize(
    ("labels", "faces", "message"),
    [
        ([0, 1], [[0, 1, 2]], "points 0 to 1"),
        ([0, 1], [[0, 1, -1]], "points 0 to 1"),
        ([0, -1], [[0, 1, 1]], "at least 0, got -1"),
        ([[0, 1]], [[0, 1, 1]], "one label a point"),
        ([0, 1], [[0, 1]], "faces of 3 points"),
        ([0.0, 1.0], [[0, 1, 1]], "integer labels"),
    ],
)
def test_labels_and_faces_that_do_not_fit(labels, faces, message, without_type_checker):
    labels, faces = torch.tensor(labels), torch.tensor(faces)
    table = Table(torch.zeros(2, 2))
    for call in (
        lambda: overdraw(labels, faces),
        lambda: reclassify(labels, faces, table),
        lambda: superclusters(labels, faces, registers_of_cluster=torch.tensor([1, 1])),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_budgets_errors_and_registers_out_of_range():
    labels, faces = torch.tensor([0, 1, 1]), torch.tensor([[0, 1, 2]])
    for budget in (-0.1, math.nan, math.inf):
        with pytest.raises(ValueError, match="budget"):
            reclassify(labels, faces, Table(torch.zeros(3, 2)), budget=budget)
    for wrong in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="finite and at least 0"):
            reclassify(labels, faces, Table(torch.full((3, 2), wrong)))
    with pytest.raises(ValueError, match="expected 3 errors"):
        reclassify(labels, faces, lambda points, _: torch.zeros(len(points) + 1))
    with pytest.raises(ValueError, match="registers of 2 clusters"):
        superclusters(labels, faces, registers_of_cluster=torch.tensor([1]))
    with pytest.raises(ValueError, match="at least 1"):
        superclusters(labels, faces, registers_of_cluster=torch.tensor([1, 0]))
    with pytest.raises(ValueError, match="at least 1 row"):
        registers(torch.tensor([1]), 0)
    with pytest.raises(ValueError, match="at least 1 vector"):
        registers(torch.tensor([0]), 4)


# Size


def test_a_mesh_of_65000_faces():
    """Noisy Voronoi cells as CPCA leaves them: both searches lower overdraw. Prints their time."""
    generator = torch.Generator().manual_seed(0)
    side, clusters = 182, 256
    faces = grid(side)
    steps = torch.linspace(0, 1, side, dtype=torch.float64)
    positions = torch.cartesian_prod(steps, steps)
    seeds = torch.rand(clusters, 2, generator=generator, dtype=torch.float64)
    noise = torch.randn(side * side, 2, generator=generator, dtype=torch.float64)
    features = positions + 0.01 * noise
    labels = torch.cdist(features, seeds).argmin(1)

    def errors(points, chosen):
        return (features[points] - seeds[chosen]).square().sum(1)

    start = time.perf_counter()
    moved = reclassify(labels, faces, errors, budget=0.05)
    between = time.perf_counter()
    sizes = registers(torch.full((clusters,), 9), 16)
    grouped = superclusters(moved, faces, registers_of_cluster=sizes)
    end = time.perf_counter()
    means = [total(each, faces) / len(faces) for each in (labels, moved, grouped[moved])]
    print(
        f"\n{len(faces)} faces: mean overdraw {means[0]:.3f}, reclassified {means[1]:.3f} in "
        f"{between - start:.2f} s, superclustered {means[2]:.3f} in {end - between:.2f} s"
    )
    assert means[0] > means[1] > means[2] >= 1
    everyone = torch.arange(side * side)
    before, after = (math.fsum(errors(everyone, each).tolist()) for each in (labels, moved))
    assert before * 1.04 < after <= before * 1.05
