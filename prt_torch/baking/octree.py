"""Octree of points in space: who is near whom, level by level, without pointers.

Points are sorted along a space-filling curve on which the points of every cell follow each other,
so a node is a run of points, and a level of the tree is a list of runs.

Source:
    Morton 1966 (the curve); Barnes and Hut 1986 (nodes that stand for what they hold).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

_LEAF = 4  # points that are not divided further
_LEVELS = 16  # below the root


def morton_codes(positions: Float64[Tensor, "points 3"]) -> Int64[Tensor, "points"]:
    """Cells of 2^16 along each axis of the bounding cube, numbered along the octree's curve.

    Args:
        positions: At least one.
    """
    low = positions.amin(dim=0)
    extent = float((positions - low).max()) or 1.0
    cells = ((positions - low) * (2**_LEVELS / extent)).long().clamp(0, 2**_LEVELS - 1)
    codes = torch.zeros_like(cells[:, 0])
    for bit in range(_LEVELS):
        for axis in range(3):
            codes |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return codes


@dataclass(frozen=True, eq=False)
class Octree:
    """Nodes in order of their levels, the root first; children of a node follow each other.

    Made by :func:`build_octree`.
    """

    order: Int64[Tensor, "points"]
    """Points along the curve, where a node's are a run."""
    leaf_of: Int64[Tensor, "points"]
    """By place on the curve."""
    levels: list[slice]
    """Nodes of each level."""
    parent: Int64[Tensor, "nodes"]
    first_child: Int64[Tensor, "nodes"]
    num_children: Int64[Tensor, "nodes"]
    first_point: Int64[Tensor, "nodes"]
    """Place on the curve."""
    num_points: Int64[Tensor, "nodes"]

    @property
    def num_nodes(self) -> int:
        """Of all levels."""
        return len(self.parent)

    def sums(self, values: Float[Tensor, "points columns"]) -> Float[Tensor, "nodes columns"]:
        """Sums over the points of each node."""
        sums = values.new_zeros(self.num_nodes, values.shape[1])
        sums.index_add_(0, self.leaf_of, values[self.order])
        for level in reversed(self.levels[1:]):
            sums.index_add_(0, self.parent[level], sums[level].clone())
        return sums

    def highest(
        self, values: Float64[Tensor, "points columns"]
    ) -> Float64[Tensor, "nodes columns"]:
        """Largest values among the points of each node."""
        highest = values.new_full((self.num_nodes, values.shape[1]), -math.inf)
        _raise_to(highest, self.leaf_of, values[self.order])
        for level in reversed(self.levels[1:]):
            _raise_to(highest, self.parent[level], highest[level].clone())
        return highest

    def select(
        self,
        num_viewers: int,
        suffices: Callable[[Tensor, Tensor], Bool[Tensor, "pairs"]],
    ) -> tuple[Int64[Tensor, "pairs"], Int64[Tensor, "pairs"]]:
        """The nodes and points by which each viewer sees all points, every point once.

        Args:
            num_viewers: How many traverse the tree.
            suffices: Whether viewers (first argument) may see nodes (second) as one.

        Returns:
            Viewers in ascending order, and the rows that each sees: points as they are numbered,
            then nodes from the number of points on.
        """
        viewer = torch.arange(num_viewers, device=self.order.device)
        node = torch.zeros_like(viewer)
        viewers, rows = [], []
        while len(node):
            whole = suffices(viewer, node)
            viewers.append(viewer[whole])
            rows.append(node[whole] + len(self.order))
            viewer, node = viewer[~whole], node[~whole]
            is_leaf = self.num_children[node] == 0
            leaf, inner = node[is_leaf], node[~is_leaf]
            seeing, place = _expand(viewer[is_leaf], self.first_point[leaf], self.num_points[leaf])
            viewers.append(seeing)
            rows.append(self.order[place])
            children = self.first_child[inner], self.num_children[inner]
            viewer, node = _expand(viewer[~is_leaf], *children)
        ascending, by_viewer = torch.cat(viewers).sort(stable=True)
        return ascending, torch.cat(rows)[by_viewer]


def build_octree(positions: Float64[Tensor, "points 3"]) -> Octree:
    """Divide nodes of more than 4 points, along the curve, level by level, 16 times at most.

    Args:
        positions: At least one.
    """
    codes, order = morton_codes(positions).sort(stable=True)
    leaf_of = torch.zeros_like(order)
    first_point, num_points, parent, levels = [], [], [], []
    first_node = 0
    inside = torch.arange(len(codes), device=codes.device)  # points of nodes still to be divided
    for level in range(_LEVELS + 1):
        prefix = codes[inside] >> (3 * (_LEVELS - level))
        node, count = torch.unique_consecutive(prefix, return_inverse=True, return_counts=True)[1:]
        start = inside[count.cumsum(0) - count]
        first_point.append(start)
        num_points.append(count)
        parent.append(leaf_of[start])
        leaf_of[inside] = node + first_node
        levels.append(slice(first_node, first_node + len(count)))
        first_node += len(count)
        inside = inside[count[node] > _LEAF]
        if not len(inside):
            break
    parents = torch.cat(parent)
    # Children follow in the order of their parents, so a node's begin where its predecessors' end.
    num_children = torch.bincount(parents[1:], minlength=first_node)
    return Octree(
        order=order,
        leaf_of=leaf_of,
        levels=levels,
        parent=parents,
        first_child=num_children.cumsum(0) - num_children + 1,
        num_children=num_children,
        first_point=torch.cat(first_point),
        num_points=torch.cat(num_points),
    )


def _raise_to(highest: Tensor, rows: Int64[Tensor, "values"], values: Tensor) -> None:
    """Replace elements by larger ones."""
    highest.scatter_reduce_(0, rows[:, None].expand_as(values), values, "amax")


def _expand(
    viewer: Int64[Tensor, "nodes"], first: Int64[Tensor, "nodes"], count: Int64[Tensor, "nodes"]
) -> tuple[Int64[Tensor, "pairs"], Int64[Tensor, "pairs"]]:
    """Each viewer with each number of its run ``first .. first + count - 1``."""
    skipped = torch.repeat_interleave(count.cumsum(0) - count - first, count)
    steps = torch.arange(len(skipped), device=first.device)
    return torch.repeat_interleave(viewer, count), steps - skipped
