r"""Clustered principal component analysis: an affine subspace for each cluster of points.

A point's transfer, seen as one vector, is its cluster's mean plus a few weighted vectors,

.. math:: x_p \approx x_0 + \sum_i w_p^i\, x_i

The mean and the vectors are the cluster's *representatives*. Light meets the representatives once
a cluster; a point then costs ``rank + 1`` weighted sums of the results, whatever the order of the
light.

Source:
    Sloan, Hall, Hart, Snyder 2003, sections 3.3, 4 and 6.
"""

from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from prt_torch.metric import Metric
from prt_torch.representations.base import Representation
from prt_torch.representations.cpca_encoding import Encoding, encode
from prt_torch.representations.grouped import ClusterBlocks
from prt_torch.transfer import Surface, TransferTensor


class CPCA(Representation):
    """Clustered affine subspaces of transfer.

    Parameters are ``representatives`` ``"clusters rank+1 channels rows coeffs"``, the mean first,
    and ``weights`` ``"points rank"``. The vectors come orthonormal (in the
    metric) from the closed form and are free afterwards: any invertible mixture of them with the
    inverse mixture of the weights is the same transfer, so a constraint would only slow a fit.

    Args:
        encoding: Clusters, representatives and weights.
        surface: Bases, frames and reflectance.
        shape: Points, channels, rows, coeffs.
    """

    kind: ClassVar[str] = "cpca"
    labels: Tensor
    _own_vectors: Tensor
    _own_borders: Tensor

    def __init__(self, encoding: Encoding, surface: Surface, shape: tuple[int, int, int, int]):
        super().__init__(surface, shape)
        num_clusters = encoding.representatives.shape[0]
        self.blocks = ClusterBlocks(encoding.labels, num_clusters)
        self._condition = encoding.condition
        self.representatives = nn.Parameter(
            encoding.representatives.unflatten(-1, shape[1:]).contiguous()
        )
        self.weights = nn.Parameter(encoding.weights.clone())
        self.register_buffer("labels", encoding.labels)
        vectors = self.rank + 1
        steps = torch.arange(vectors, device=encoding.labels.device)
        own = (encoding.labels[:, None] * vectors + steps).int().flatten()
        borders = torch.arange(0, len(own) + 1, vectors, dtype=torch.int32, device=own.device)
        self.register_buffer("_own_vectors", own, persistent=False)
        self.register_buffer("_own_borders", borders, persistent=False)

    @classmethod
    def from_transfer(
        cls,
        transfer: TransferTensor,
        *,
        num_clusters: int = 128,
        rank: int = 4,
        method: Literal["iterative", "static"] = "iterative",
        metric: Metric | None = None,
        generator: torch.Generator | None = None,
    ) -> "CPCA":
        """Cluster the points and fit each cluster's subspace.

        Args:
            transfer: The tensor to stand for; read by blocks.
            num_clusters: At least 1; fewer are made if there are fewer distinct points.
            rank: Vectors a cluster beside its mean, at least 0 (vector quantisation). Limited to
                the number of values of a point.
            method: ``static`` clusters by distance to the mean, then fits; ``iterative`` clusters
                by the error of the fit itself, adding vectors one by one.
            metric: What errors are worth; the L2 norm over light directions if not given.
            generator: Source of randomness; seed 0 if not given.

        Raises:
            ValueError: If ``num_clusters < 1``, ``rank < 0``, or the method is unknown.

        Source:
            Sloan et al. 2003, section 4.1 (static), 4.2 (iterative). We reassign a point among the
            clusters nearest to its own and close with passes over all clusters.
        """
        if num_clusters < 1:
            raise ValueError(f"expected at least 1 cluster, got {num_clusters}")
        if rank < 0:
            raise ValueError(f"expected a rank of at least 0, got {rank}")
        if method not in ("iterative", "static"):
            raise ValueError(f"expected method iterative or static, got {method!r}")
        encoding = encode(
            transfer,
            num_clusters=num_clusters,
            rank=rank,
            iterative=method == "iterative",
            metric=metric or Metric.l2(transfer),
            generator=generator or torch.Generator().manual_seed(0),
        )
        shape = tuple(transfer.values.shape)
        return cls(encoding, transfer.surface, shape)

    @property
    def num_clusters(self) -> int:
        """Clusters made."""
        return self.representatives.shape[0]

    @property
    def rank(self) -> int:
        """Vectors a cluster beside its mean."""
        return self.representatives.shape[1] - 1

    def forward(
        self, light: Float[Tensor, "batch *points coeffs rgb"], frames: Tensor | None = None
    ) -> Float[Tensor, "batch points rows rgb"]:
        """Light the representatives, then mix them for each point.

        Raises:
            ValueError: If shapes do not fit, or ``frames`` are given: transfer by spherical
                coefficients is fixed to the rest pose.
        """
        if frames is not None:
            raise ValueError("CPCA stores transfer in the rest pose and cannot be posed by frames")
        if self._check_light(light):
            return self._forward_local(light)
        lit = self._light_representatives(light)  # clusters, rank+1, rows * rgb * batch
        wants_grad = lit.requires_grad or self.weights.requires_grad
        mix = self._mix_grouped if torch.is_grad_enabled() and wants_grad else self._mix_gathered
        return mix(lit).view(self.num_points, self.num_rows, 3, -1).permute(3, 0, 1, 2)

    def _mix_grouped(self, vectors: Tensor) -> Float[Tensor, "points values"]:
        """Weighted sums of each point's own vectors, by batched products: fast to differentiate."""
        slots = self.blocks.to_slots(self.weights)
        mixed = self.blocks.matmul(slots, vectors[:, 1:], offsets=vectors[:, 0])
        return self.blocks.to_points(mixed)

    def _mix_gathered(self, vectors: Tensor) -> Float[Tensor, "points values"]:
        """The same in one pass that writes every result once and in place: fast to evaluate.

        The lit vectors of all clusters stay in the processor's cache.
        """
        mixture = nn.functional.pad(self.weights, (1, 0), value=1.0)
        return nn.functional.embedding_bag(
            self._own_vectors,
            vectors.flatten(0, 1),
            self._own_borders,
            mode="sum",
            per_sample_weights=mixture.flatten(),
            include_last_offset=True,
        )

    def _light_representatives(self, light: Tensor) -> Tensor:
        clusters, vectors, channels, _, coeffs = self.representatives.shape
        if channels == 1:
            columns = light.permute(1, 2, 0).reshape(coeffs, -1)
            lit = self.representatives.view(-1, coeffs) @ columns
        else:
            by_channel = self.representatives.permute(2, 0, 1, 3, 4).reshape(channels, -1, coeffs)
            lit = torch.bmm(by_channel, light.permute(2, 1, 0)).permute(1, 0, 2)
        return lit.reshape(clusters, vectors, -1)

    def _forward_local(self, light: Tensor) -> Tensor:
        """Each point's own light meets its cluster's representatives, then its weights."""
        mixture = self.blocks.to_slots(nn.functional.pad(self.weights, (1, 0), value=1.0))
        by_point = self.blocks.to_slots(light.permute(1, 3, 0, 2))  # slots rgb batch coeffs
        colours = []
        for colour in range(3):
            channel = self.representatives[:, :, colour if self.num_channels == 3 else 0]
            matrices = channel.flatten(1, 2).mT  # clusters, coeffs, (rank+1) * rows
            lit = self.blocks.matmul(by_point[:, colour], matrices)
            lit = lit.unflatten(-1, (self.rank + 1, self.num_rows))
            colours.append(torch.einsum("sv,sbvr->sbr", mixture, lit))
        radiance = self.blocks.to_points(torch.stack(colours, dim=-1))
        return radiance.permute(1, 0, 2, 3)

    def dense(self, points: Tensor | None = None) -> Float[Tensor, "points channels rows coeffs"]:
        """Mean plus weighted vectors of each point."""
        flat = self.representatives.flatten(2)
        if points is None:
            values = self._mix_grouped(flat)
        else:
            own = flat[self.labels[points]]
            weights = self.weights[points]
            values = torch.baddbmm(own[:, :1], weights[:, None], own[:, 1:])[:, 0]
        return values.view(-1, self.num_channels, self.num_rows, self.num_coeffs)

    def packed(self) -> dict[str, Tensor]:
        """Representatives, weights by point, and cluster numbers in the least whole bytes."""
        match self.num_clusters:
            case few if few <= 2**8:
                index_type = torch.uint8
            case some if some <= 2**15:
                index_type = torch.int16
            case _:
                index_type = torch.int32
        return {
            "representatives": self.representatives.detach().clone(),
            "weights": self.weights.detach().clone(),
            "labels": self.labels.to(index_type),
        }

    @classmethod
    def from_packed(
        cls, packed: dict[str, Tensor], surface: Surface, shape: tuple[int, int, int, int]
    ) -> "CPCA":
        """The inverse of :meth:`packed`."""
        encoding = Encoding(
            labels=packed["labels"].long(),
            representatives=packed["representatives"].flatten(2),
            weights=packed["weights"],
            condition=float("nan"),
        )
        return cls(encoding, surface, shape)

    @property
    def budget(self) -> dict[str, Any]:
        """Clusters and rank."""
        return {"num_clusters": self.num_clusters, "rank": self.rank}

    @property
    def condition(self) -> float:
        """Largest over smallest kept singular value, of the worst cluster; NaN if loaded."""
        return self._condition
