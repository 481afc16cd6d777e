"""What a light basis and an exit basis are: the two ends of a transfer tensor.

Radiance is ``exit(view) · transfer · light_basis.project(environment)``. A transfer function of
the light direction is the sum of its *values* times the basis functions; light enters as its
inner products with them. Where the basis is not orthonormal, norms go through :meth:`weigh`.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

_LEAST_SQUARE = 1e-10  # of the mean, that a dependent row counts


@runtime_checkable
class Radiance(Protocol):
    """Distant light that can be integrated: an environment map, or anything like one."""

    def sample_blocks(self, max_spacing: float) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Yield directions "k 3", solid angles "k" [sr] and radiance "k rgb" that tile the sphere.

        No sample may stand for a piece of the sphere wider than ``max_spacing`` [rad].
        """
        ...


class LightBasis(ABC):
    """Functions on the sphere that distant light is expanded in, in world coordinates."""

    @property
    @abstractmethod
    def num_coeffs(self) -> int:
        """How many functions the basis has."""

    @property
    @abstractmethod
    def name(self) -> str:
        """Short name for tables, such as ``SH order 6``."""

    @abstractmethod
    def project(self, environment: Radiance) -> Float[Tensor, "coeffs rgb"]:
        """Inner products of the light with each basis function, float64.

        Every source pixel enters with its exact solid angle, so no light is lost or made; linear
        and differentiable in the image.
        """

    @abstractmethod
    def project_cube(
        self, values: Float[Tensor, "points texels"], resolution: int
    ) -> Float[Tensor, "points coeffs"]:
        """Expansion coefficients of functions given by cube-map texels.

        Args:
            values: Function times solid angle at each texel centre, ``"6 row col"`` flattened.
            resolution: Texels along an edge of a face.
        """

    @abstractmethod
    def table_bytes(self, resolution: int) -> int:
        """Memory that :meth:`project_cube` keeps for this resolution between calls."""

    @abstractmethod
    def gram(self) -> Float[Tensor, "coeffs coeffs"] | Float[Tensor, "coeffs"]:
        """Inner products of the basis functions, float64; a vector where it is diagonal."""

    @abstractmethod
    def rotate(
        self, coefficients: Float[Tensor, "*batch coeffs rgb"], rotation: Float[Tensor, "3 3"]
    ) -> Float[Tensor, "*batch coeffs rgb"]:
        """Light coefficients of the light turned by ``rotation``: L'(s) = L(R⁻¹ s).

        Exact for a basis that is closed under rotation; otherwise resampled, which the basis'
        docstring states.
        """

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """What :func:`prt_torch.bases.light_basis` needs to make this basis again; plain JSON."""

    @abstractmethod
    def weigh(self, values: Float[Tensor, "... coeffs"]) -> Float[Tensor, "... coeffs"]:
        """Expansion coefficients into the space where sums of squares are squared L2 norms.

        Of the functions, over the sphere: ``weigh(v) · weigh(w)`` is their inner product. In the
        dtype of ``values``; a matrix of coefficients by coefficients only where functions overlap.
        May return ``values`` itself.
        """

    @abstractmethod
    def unweigh(self, values: Float[Tensor, "... coeffs"]) -> Float[Tensor, "... coeffs"]:
        """The inverse of :meth:`weigh`."""

    @abstractmethod
    def weigh_light(
        self, light: Float[Tensor, "*batch coeffs rgb"]
    ) -> Float[Tensor, "*batch coeffs rgb"]:
        """Light coefficients into the space of :meth:`weigh`, as inner products with it.

        So ``weigh_light(light) · weigh(values)`` is the radiance ``light · values``, and sums of
        squares are squared L2 norms of the light, as far as the basis can express it. May return
        ``light`` itself.
        """

    def squared_norm(self, values: Float[Tensor, "... coeffs"]) -> Float[Tensor, "..."]:
        """Squared L2 norm over the sphere of the functions with these expansion coefficients.

        Weighed in the type of the values, added up in float64.
        """
        return torch.linalg.vector_norm(self.weigh(values), dim=-1, dtype=torch.float64).square()


class ExitBasis(ABC):
    """Functions of the view direction, in the shading frame, that radiance leaves in."""

    @property
    @abstractmethod
    def num_rows(self) -> int:
        """How many functions the basis has."""

    @property
    @abstractmethod
    def num_channels(self) -> int:
        """3 if the functions are coloured, else 1."""

    @property
    @abstractmethod
    def view_dependent(self) -> bool:
        """Whether radiance depends on the view; if not, relighting skips views altogether."""

    @abstractmethod
    def evaluate(
        self, view: Float[Tensor, "*batch 3"]
    ) -> Float[Tensor, "*batch rows"] | Float[Tensor, "*batch rows rgb"]:
        """Basis functions at unit view directions in the shading frame.

        Coloured ones have a last axis of three.
        """

    @abstractmethod
    def gram(self) -> Float[Tensor, "rows rows"]:
        """Mean of the products of two functions over views of the upper hemisphere, float64.

        And over colours, where they are coloured.

        A mean and not an integral, so that the Gram matrix of the constant is 1 and squared norms
        are those of the radiance that a view sees on average.
        """

    @abstractmethod
    def constants(self) -> Float[Tensor, "colours rows"]:
        """Rows of light that leaves alike in every direction, float64.

        One line for light of any colour, or three for red, green and blue where the functions are
        coloured; none where the basis does not hold the constant.
        """

    def gram_root(self) -> Float[Tensor, "rows rows"]:
        """Lower Cholesky factor of :meth:`gram`, float64.

        Where rows are dependent, or one is zero, each gets a little more than its square, so that
        the factor can be inverted.
        """
        gram = self.gram()
        root, failed = torch.linalg.cholesky_ex(gram)
        if int(failed) == 0:
            return root
        ridge = _LEAST_SQUARE * (gram.diagonal().mean() + torch.finfo(gram.dtype).tiny)
        return torch.linalg.cholesky(gram + ridge * torch.eye(len(gram), dtype=gram.dtype))

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """What :func:`prt_torch.bases.exit_basis` needs to make this basis again; plain JSON."""

    @abstractmethod
    def tensors(self) -> dict[str, Tensor]:
        """What evaluating it needs besides :meth:`describe`; counted and kept in files."""
