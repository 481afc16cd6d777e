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

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.representations.cpca_subspaces import condensed, one_thread, principal
from prt_torch.representations.orthonormal import orthonormal
from prt_torch.representations.points import Points, SortedChunk, SortedPoints, cluster_sizes
from prt_torch.representations.steady import laid_out, steady_product
from prt_torch.representations.whitening import whitening

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
        return laid_out(columns.mT)


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
        laid_out(light.to(like).expand(num_clusters, -1, -1)),
        laid_out(dual.to(like).expand(num_clusters, -1, -1)),
    )


def weights(
    chunk: SortedChunk, columns: Float[Tensor, "clusters view_times_light point_rank"]
) -> Float[Tensor, "slots point_rank"]:
    """Each slot's point in the columns (:meth:`Bases.together`) of its place: equation 17."""
    return chunk.matmul(chunk.slots.flatten(1), columns)


def held(members: SortedPoints, bases: Bases) -> float:
    """Squared norm of what the bases hold of the tensor."""
    columns = bases.together()

    def of_chunk(chunk: SortedChunk) -> Tensor:
        return weights(chunk, columns).square().sum(dtype=torch.float64)

    return float(members.sum(of_chunk))


def refit(members: SortedPoints, bases: Bases, steps: int) -> Bases:
    """One turn over light and points, each by so many steps; the error never rises.

    Rounding aside: the points' basis holds the weights, the light's step starts from the basis
    that they were made with, and the dual basis holds the core of both. The points' basis itself
    is never formed: all that is asked of it are its products with the points, which are those of
    the weights but for a small matrix (:mod:`prt_torch.representations.whitening`).

    Args:
        members: Points ``"view light"`` by cluster.
        bases: To improve.
        steps: Of each mode.
    """
    dual, clusters = bases.dual, len(bases.light)
    for _ in range(steps - 1):
        dual = _dual_step(members, bases.light, dual)
    compressed = _compressed(members, bases.light, dual)
    compressed = compressed.view(clusters, -1, bases.light.shape[1])
    light = bases.light.double()
    for _ in range(steps):
        light = orthonormal(compressed.mT @ (compressed @ light))
    core = (compressed @ light).view(clusters, dual.shape[1], -1)
    return Bases(laid_out(light.to(dual)), laid_out(orthonormal(core.mT).mT.to(dual)))


def _dual_step(
    members: SortedPoints,
    light: Float[Tensor, "clusters light light_rank"],
    dual: Float[Tensor, "clusters point_rank view_times_light_rank"],
) -> Float[Tensor, "clusters point_rank view_times_light_rank"]:
    """One step of orthogonal iteration of the mode of the points."""
    columns = laid_out(dual.mT)

    def of_chunk(chunk: SortedChunk) -> tuple[Tensor, Tensor]:
        within = chunk.matmul(chunk.slots, light).flatten(1)
        return chunk.matmul(within, columns), within

    moved = members.products(of_chunk, *dual.shape[1:])
    return laid_out(orthonormal(moved.mT).mT.to(dual))


def _compressed(
    members: SortedPoints,
    light: Float[Tensor, "clusters light light_rank"],
    dual: Float[Tensor, "clusters point_rank view_times_light_rank"],
) -> Float[Tensor, "clusters point_rank view_times_light"]:
    """Products of the points with an orthonormal basis of their weights, float64."""
    columns, rank = Bases(light, dual).together(), dual.shape[1]

    def of_chunk(chunk: SortedChunk) -> tuple[Tensor, Tensor]:
        own = weights(chunk, columns)
        return own, torch.cat([chunk.slots.flatten(1), own], dim=1)

    total = members.products(of_chunk, rank, columns.shape[1] + rank)
    products, gram = total.split([columns.shape[1], rank], dim=2)
    return whitening(gram).mT @ products


def refit_view(
    members: SortedPoints, view: Float[Tensor, "view_axes view"], bases: Bases
) -> tuple[Float[Tensor, "view_axes view"], Bases]:
    """The best view basis for the points' and light's; the dual basis follows it.

    Args:
        members: Points ``"view_axes light"`` by cluster.
        view: Basis of the view to improve.
        bases: In that view.

    Source:
        Tsai, Shih 2006, equation 19.
    """
    columns, (clusters, rank, _) = bases.together(), bases.dual.shape
    axes, width = len(view), len(view) * bases.light.shape[2]

    def of_chunk(chunk: SortedChunk) -> tuple[Tensor, Tensor]:
        seen = SortedChunk(chunk.rows, chunk.blocks, in_view(chunk.slots, view))
        own, lit = weights(seen, columns), chunk.matmul(chunk.slots, bases.light).flatten(1)
        return own, torch.cat([lit, own], dim=1)

    total = members.products(of_chunk, rank, width + rank)
    products, gram = total.split([width, rank], dim=2)
    core = (whitening(gram).mT @ products).view(clusters, rank, axes, -1)
    flat = core.movedim(2, 0).flatten(1)
    with one_thread():
        found = torch.linalg.eigh(flat @ flat.mT)[1].flip(1)[:, : view.shape[1]]
    core = torch.einsum("cpal,av->cpvl", core, found).flatten(2)
    dual = orthonormal(core.mT).mT
    return laid_out(found.to(view)), Bases(bases.light, laid_out(dual.to(view)))


def in_view(
    points: Float[Tensor, "points view_axes light"], view: Float[Tensor, "view_axes view"]
) -> Float[Tensor, "points view light"]:
    """Points in a view basis: equation 14."""
    count, axes, light = points.shape
    across = points.mT.reshape(-1, axes)
    return laid_out(steady_product(across, view).view(count, light, view.shape[1]).mT)


@dataclass(frozen=True)
class Decomposition:
    """Exact dual bases for given bases of view and light, float64.

    Attributes:
        dual: Rows are right singular vectors; zero beyond the numerical rank.
        singular: Their singular values, falling.
    """

    dual: Float[Tensor, "clusters point_rank view_times_light_rank"]
    singular: Float[Tensor, "clusters point_rank"]

    @property
    def condition(self) -> float:
        """Largest over smallest singular value kept, of the worst cluster."""
        smallest = torch.where(self.singular > 0, self.singular, torch.inf).amin(1)
        return float((self.singular[:, 0] / smallest).max().clamp_min(1.0))

    @property
    def squared_norm(self) -> float:
        """Of the weights, so of what is held of the tensor."""
        return float(self.singular.square().sum())


def decompose(
    points: Points,
    labels: Int[Tensor, "points"],
    light: Float[Tensor, "clusters light light_rank"],
    point_rank: int,
) -> Decomposition:
    """The last step: the mode of the points by singular values.

    Vectors that no cluster has a use for are left out.

    Args:
        points: In the view basis, ``"points view light"``.
        labels: Their clusters.
        light: Light basis of each.
        point_rank: Vectors at most.

    Source:
        Tsai, Shih 2006, equations 15 to 17.
    """
    clusters, exact = len(light), light.double()
    sizes = cluster_sizes(labels, clusters, points.processes)
    width = points.rest[0] * light.shape[2]

    def within(members: Tensor, cluster: int) -> Tensor:
        return (members.double() @ exact[cluster]).flatten(1)

    singular = exact.new_zeros(clusters, point_rank)
    dual = exact.new_zeros(clusters, point_rank, width)
    stiff = _STIFF[points.like.dtype]
    for cluster, rows in condensed(points, labels, sizes, within, width):
        values, vectors = principal(rows[None], point_rank, stiff)
        singular[cluster], dual[cluster] = values[0], vectors[0]
    used = max(1, int((singular > 0).sum(1).max()))
    return Decomposition(dual[:, :used], singular[:, :used])


def exact_weights(
    members: SortedPoints, light: Float[Tensor, "clusters light light_rank"], dual: Tensor
) -> Iterator[tuple[slice | Int[Tensor, "some"], Float[Tensor, "some point_rank"]]]:
    """Weights of every point in its own cluster, float64, chunk by chunk."""
    exact, columns = light.double(), dual.mT
    for chunk in members:
        within = chunk.blocks.matmul(chunk.slots.double(), exact).flatten(1)
        yield chunk.rows, chunk.blocks.to_points(chunk.blocks.matmul(within, columns))
