"""Radiance of CPCA: light on the representatives, then the mixtures of each point.

Source:
    Sloan, Hall, Hart, Snyder 2003, section 6.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from prt_torch.representations.cpca_layout import VectorLayout
from prt_torch.representations.grouped import ClusterBlocks
from prt_torch.representations.products import matmul_few


def lit(
    representatives: Float[Tensor, "vectors channels rows coeffs"],
    light: Float[Tensor, "batch coeffs rgb"],
) -> Float[Tensor, "vectors rows_times_rgb_times_batch"]:
    """Radiance of each representative."""
    vectors, channels, rows, coeffs = representatives.shape
    if channels == 1:
        columns = light.permute(1, 2, 0).reshape(coeffs, -1)
        radiance = matmul_few(representatives.view(-1, coeffs), columns)
    else:
        by_channel = representatives.transpose(0, 1).reshape(channels, -1, coeffs)
        radiance = torch.bmm(by_channel, light.permute(2, 1, 0)).permute(1, 0, 2)
    return radiance.reshape(vectors, rows * 3 * len(light))


def mix_grouped(
    layout: VectorLayout,
    blocks: ClusterBlocks,
    vectors: Float[Tensor, "vectors values"],
    weights: Float[Tensor, "entries"],
) -> Float[Tensor, "points values"]:
    """Weighted sums of each point's own vectors, by batched products: fast to differentiate."""
    slots = blocks.to_slots(layout.by_point(weights))
    own = layout.by_cluster(vectors)
    if layout.affine:
        mixed = blocks.matmul(slots, own[:, 1:], offsets=own[:, 0])
    else:
        mixed = blocks.matmul(slots, own)
    return blocks.to_points(mixed)


def mix_gathered(
    layout: VectorLayout,
    vectors: Float[Tensor, "vectors values"],
    weights: Float[Tensor, "entries"],
) -> Float[Tensor, "points values"]:
    """The same in one pass that writes every result once and in place: fast to evaluate.

    The lit vectors of all clusters stay in the processor's cache.
    """
    return nn.functional.embedding_bag(
        layout.own_vectors,
        vectors.to(weights.dtype),  # autocast, which leaves them short, stops here
        layout.own_borders,
        mode="sum",
        per_sample_weights=layout.mixture(weights),
        include_last_offset=True,
    )


def local_radiance(
    layout: VectorLayout,
    blocks: ClusterBlocks,
    representatives: Float[Tensor, "vectors channels rows coeffs"],
    weights: Float[Tensor, "entries"],
    light: Float[Tensor, "batch points coeffs rgb"],
) -> Float[Tensor, "batch points rows rgb"]:
    """Each point's own light meets its cluster's representatives, then its weights."""
    padded = nn.functional.pad(layout.by_point(weights), (int(layout.affine), 0), value=1.0)
    mixture = blocks.to_slots(padded)
    own = layout.by_cluster(representatives)
    by_point = blocks.to_slots(light.permute(1, 3, 0, 2))  # slots rgb batch coeffs
    colours = []
    for colour in range(3):
        channel = own[:, :, colour if own.shape[2] == 3 else 0]
        matrices = channel.flatten(1, 2).mT  # clusters, coeffs, vectors * rows
        radiance = blocks.matmul(by_point[:, colour], matrices)
        radiance = radiance.unflatten(-1, (own.shape[1], own.shape[3]))
        colours.append(torch.einsum("sv,sbvr->sbr", mixture, radiance))
    return blocks.to_points(torch.stack(colours, dim=-1)).permute(1, 0, 2, 3)
