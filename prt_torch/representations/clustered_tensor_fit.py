r"""Tucker decompositions of all clusters at once, by higher-order orthogonal iteration.

A cluster's points form a tensor of points, view and light. It is approximated in orthonormal bases
of its points and of the light, and in one basis of the view that all clusters of a group share.
Each turn improves one mode after the other while the rest is held still, the mode of the points
last, so that the *dual* basis V, whose rows are right singular vectors of the points in the other
two bases, is orthonormal exactly as the paper has it, and the error of any point in any cluster is

.. math:: \|Z_p\|^2 - \|W_{p,c}\|^2, \quad W_{p,c} = V_c\, \mathrm{vec}(Z_p U_{light,c})

Bases are improved by steps of orthogonal iteration from where they stand, which never loses what
they held and costs a small part of a decomposition.

Source:
    Tsai, Shih 2006, sections 5.2.3 and 5.2.4; De Lathauwer et al. 2000 (the iteration).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.representations.cpca_subspaces import one_thread, principal
from prt_torch.representations.grouped import ClusterBlocks
from prt_torch.representations.orthonormal import orthonormal

_STIFF = {torch.float64: 1e3, torch.float32: 1e5}  # as in cpca_subspaces


@dataclass(frozen=True)
class Bases:
    """Orthonormal bases of every cluster.

    Attributes:
        light: Columns span each cluster's light.
        dual: Rows span its points in view and light, light varying fastest.
    """

    light: Float[Tensor, "clusters light light_rank"]
    dual: Float[Tensor, "clusters point_rank view_times_light_rank"]

    def of(self, clusters: Int[Tensor, "some"]) -> "Bases":
        """Those of some clusters."""
        return Bases(self.light[clusters], self.dual[clusters])

    def together(self) -> Float[Tensor, "clusters view_times_light point_rank"]:
        """Both in one: the orthonormal columns that weights are products with.

        With these they cost half of what two products cost, at the paper's ranks.
        """
        clusters, rank, _ = self.dual.shape
        dual = self.dual.reshape(clusters, -1, self.light.shape[2])  # rank times view, light
        columns = (dual @ self.light.mT).view(clusters, rank, -1)
        return columns.mT.contiguous()


def first_bases(
    num_clusters: int,
    view_rank: int,
    light_axes: int,
    light_rank: int,
    point_rank: int,
    generator: torch.Generator,
    like: Tensor,
) -> Bases:
    """Where iterations begin: the first light axes, and random directions of the points."""
    light = torch.eye(light_axes, light_rank)
    dual = torch.randn(view_rank * light_rank, point_rank, generator=generator)
    dual = orthonormal(dual.double()).mT
    return Bases(
        light.to(like).expand(num_clusters, -1, -1),
        dual.to(like).expand(num_clusters, -1, -1),
    )


def weights(
    blocks: ClusterBlocks,
    slots: Float[Tensor, "slots view light"],
    columns: Float[Tensor, "clusters view_times_light point_rank"],
) -> Float[Tensor, "slots point_rank"]:
    """Each slot's point in the columns (:meth:`Bases.together`) of its place: equation 17."""
    return blocks.matmul(slots.flatten(1), columns)


def _point_bases(
    blocks: ClusterBlocks, weights: Float[Tensor, "slots point_rank"]
) -> Float[Tensor, "slots point_rank"]:
    """Orthonormal columns over each cluster's points; zero where it has fewer of them."""
    rank = weights.shape[1]
    bases = [orthonormal(rows) for rows in blocks.by_bucket(weights)]
    padded = [torch.nn.functional.pad(one, (0, rank - one.shape[2])) for one in bases]
    return torch.cat([one.flatten(0, 1) for one in padded])


def refit(
    blocks: ClusterBlocks, slots: Float[Tensor, "slots view light"], bases: Bases, steps: int
) -> Bases:
    """One turn over light and points, each by so many steps; the error never rises.

    Rounding aside: the points' basis holds the weights, the light's step starts from the basis
    that they were made with, and the dual basis holds the core of both.
    """
    light, dual = bases.light, bases.dual
    within = blocks.matmul(slots, light).flatten(1)
    own = _point_bases(blocks, blocks.matmul(within, dual.mT))
    for _ in range(steps - 1):
        dual = orthonormal(blocks.transposed_matmul(own, within).mT).mT
        own = _point_bases(blocks, blocks.matmul(within, dual.mT))
    compressed = blocks.transposed_matmul(own, slots.flatten(1))
    compressed = compressed.view(len(light), -1, slots.shape[2])
    for _ in range(steps):
        light = orthonormal(compressed.mT @ (compressed @ light))
    core = (compressed @ light).view(len(light), dual.shape[1], -1)
    return Bases(light, orthonormal(core.mT).mT)


def refit_view(
    blocks: ClusterBlocks,
    points: Float[Tensor, "points view_axes light"],
    view: Float[Tensor, "view_axes view"],
    bases: Bases,
) -> tuple[Float[Tensor, "view_axes view"], Bases]:
    """The best view basis for the points' and light's; the dual basis follows it.

    Source:
        Tsai, Shih 2006, equation 19.
    """
    slots = blocks.to_slots(in_view(points, view))
    own = _point_bases(blocks, weights(blocks, slots, bases.together()))
    rows = [  # one at a time, as all of them sorted by cluster would double the memory
        blocks.transposed_matmul(own, blocks.to_slots(row)) @ bases.light
        for row in points.unbind(1)
    ]
    core = torch.stack(rows)  # view axes, clusters, points, light
    flat = core.flatten(1).double()
    with one_thread():
        view = torch.linalg.eigh(flat @ flat.mT)[1].flip(1)[:, : view.shape[1]].to(view)
    core = torch.einsum("acpl,av->cpvl", core, view).flatten(2)
    return view, Bases(bases.light, orthonormal(core.mT).mT)


def in_view(
    points: Float[Tensor, "points view_axes light"], view: Float[Tensor, "view_axes view"]
) -> Float[Tensor, "points view light"]:
    """Points in a view basis: equation 14."""
    return view.mT @ points


@dataclass(frozen=True)
class Decomposition:
    """Exact dual bases and weights for given bases of view and light, float64.

    Attributes:
        dual: Rows are right singular vectors; zero beyond the numerical rank.
        singular: Their singular values, falling.
        weights: Of every point in its own cluster.
    """

    dual: Float[Tensor, "clusters point_rank view_times_light_rank"]
    singular: Float[Tensor, "clusters point_rank"]
    weights: Float[Tensor, "points point_rank"]

    @property
    def condition(self) -> float:
        """Largest over smallest singular value kept, of the worst cluster."""
        smallest = torch.where(self.singular > 0, self.singular, torch.inf).amin(1)
        return float((self.singular[:, 0] / smallest).max().clamp_min(1.0))


def decompose(
    blocks: ClusterBlocks,
    slots: Float[Tensor, "slots view light"],
    light: Float[Tensor, "clusters light light_rank"],
    point_rank: int,
) -> Decomposition:
    """The last step: the mode of the points by singular values.

    Vectors that no cluster has a use for are left out.

    Source:
        Tsai, Shih 2006, equations 15 to 17.
    """
    within = blocks.matmul(slots, light).flatten(1).double()
    found = [principal(rows, point_rank, _STIFF[slots.dtype]) for rows in blocks.by_bucket(within)]
    singular = torch.cat([values for values, _ in found])
    dual = torch.cat([vectors for _, vectors in found])
    used = max(1, int((singular > 0).sum(1).max()))
    singular, dual = singular[:, :used], dual[:, :used]
    return Decomposition(dual, singular, blocks.to_points(blocks.matmul(within, dual.mT)))
