r"""Parts of microfacet models: half vectors, distributions, masking and Fresnel terms.

Distributions :math:`D(h)` [1/sr] are normalised over projected area,
:math:`\int D(h)\,(n \cdot h)\,dh = 1` over the upper hemisphere.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def half_vector(
    wi: Float[Tensor, "*batch 3"], wo: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]]:
    """Unit half vectors, and the cosine between them and either direction.

    The cosine is half the length of the sum, which loses no digits where directions oppose.

    Args:
        wi: Unit vectors above the surface.
        wo: Unit vectors above the surface.
    """
    total = wi + wo
    length = total.square().sum(-1).sqrt()
    return total / length[..., None], 0.5 * length


def ggx_distribution(
    half: Float[Tensor, "*batch 3"], roughness_x: float, roughness_y: float
) -> Float[Tensor, "*batch"]:
    r"""Trowbridge-Reitz distribution of normals [1/sr].

    .. math:: D = \frac{1}{\pi \alpha_x \alpha_y
        \left(h_x^2/\alpha_x^2 + h_y^2/\alpha_y^2 + h_z^2\right)^2}

    Args:
        half: Unit normals of microfacets, above the surface.
        roughness_x: :math:`\alpha_x`, along the tangent.
        roughness_y: :math:`\alpha_y`, along the bitangent.

    Source:
        :cite:`walter2007microfacet`, equation 33, stretched as in :cite:`heitz2014masking`.
    """
    scaled = half / half.new_tensor((roughness_x, roughness_y, 1.0))
    stretch = scaled.square().sum(-1)
    return 1.0 / (math.pi * roughness_x * roughness_y * stretch * stretch)


def ggx_slant(
    direction: Float[Tensor, "*batch 3"], roughness_x: float, roughness_y: float
) -> Float[Tensor, "*batch"]:
    r"""Length of a direction in the space where the surface has unit roughness.

    :math:`s = \sqrt{\alpha_x^2 x^2 + \alpha_y^2 y^2 + z^2}`, and Smith's
    :math:`1 + \Lambda = (1 + s / z) / 2`.
    """
    scaled = direction * direction.new_tensor((roughness_x, roughness_y, 1.0))
    return scaled.square().sum(-1).sqrt()


def ggx_masking(
    direction: Float[Tensor, "*batch 3"], roughness_x: float, roughness_y: float
) -> Float[Tensor, "*batch"]:
    r"""Smith's masking of one direction above the surface, :math:`G_1 = 1 / (1 + \Lambda)`.

    Source:
        :cite:`walter2007microfacet`, equation 34, stretched as in :cite:`heitz2014masking`.
    """
    z = direction[..., 2]
    return 2.0 * z / (z + ggx_slant(direction, roughness_x, roughness_y))


def beckmann_distribution(
    half: Float[Tensor, "*batch 3"], roughness: float
) -> Float[Tensor, "*batch"]:
    r"""Beckmann distribution, :math:`D = e^{-\tan^2\theta / m^2} / (\pi m^2 \cos^4\theta)` [1/sr].

    Args:
        half: Unit normals of microfacets, above the surface.
        roughness: m, root mean square slope times :math:`\sqrt 2`.

    Source:
        :cite:`walter2007microfacet`, equation 25.
    """
    x, y, z = half.unbind(-1)
    # One exponential: tiny times huge would be 0 * inf in a gradient.
    exponent = -(x * x + y * y) / (z * z) / roughness**2 - 4.0 * z.log()
    return torch.exp(exponent - math.log(math.pi * roughness**2))


def schlick_fresnel(
    f0: Float[Tensor, "channels"], cosine: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch channels"]:
    r"""Reflectance :math:`f_0 + (1 - f_0)(1 - \cos)^5`.

    Source:
        :cite:`schlick1994inexpensive`, the Fresnel factor.
    """
    return f0 + (1.0 - f0) * ((1.0 - cosine) ** 5)[..., None]


def dielectric_fresnel(
    f0: Float[Tensor, "channels"], cosine: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch channels"]:
    r"""Exact unpolarised reflectance of a smooth dielectric with reflectance ``f0`` at 0 degrees.

    Its index of refraction is :math:`(1 + \sqrt{f_0}) / (1 - \sqrt{f_0})`.

    Args:
        f0: Below 1.
        cosine: Between light and facet normal, above 0.

    Source:
        :cite:`cook1982reflectance`, the Fresnel equation and its inversion for the index.
    """
    root = f0.sqrt()
    index = (1.0 + root) / (1.0 - root)
    c = cosine[..., None]
    g = torch.sqrt(index * index - 1.0 + c * c)
    across = (g - c) / (g + c)
    along = (c * (g + c) - 1.0) / (c * (g - c) + 1.0)
    return 0.5 * across * across * (1.0 + along * along)
