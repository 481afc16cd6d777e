"""The transfer tensor: for every point, the linear map from distant light to outgoing radiance.

Everything upstream (meshes, rays, materials) ends in a :class:`TransferTensor`; everything
downstream (representations, relighting, reports) begins with one. It need not have come from a
mesh: :meth:`TransferTensor.from_dense` takes any array.

Several transfers of one scene, such as glossy reflection and subsurface scattering, add up to one
by :func:`add`, whatever their exit bases.
"""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from prt_torch.bases import CubeDirections, Diffuse, ExitBasis, LightBasis, Rowwise

_BLOCK_BYTES = 2**24  # of values that are weighed at once: more need fresh memory each time


@runtime_checkable
class Rows(Protocol):
    """Values read by slices of points: a tensor in memory, or shards on disk."""

    @property
    def shape(self) -> Any:
        """Shape of the whole."""
        ...

    @property
    def dtype(self) -> torch.dtype:
        """Type of the elements."""
        ...

    def __getitem__(self, rows: slice, /) -> Tensor:
        """The points ``start:stop``."""
        ...


@dataclass(frozen=True)
class Surface:
    """What is known of the points and the two bases; shared by a tensor and what is fitted to it.

    Attributes:
        exit_basis: What the rows mean.
        light_basis: What the coefficients mean; None for a tensor given without one, which then
            can be relit by coefficients only.
        reflectance: ``"points rgb"``, or ``"1 rgb"`` where all points share it. Multiplies the
            radiance at the end.
        frames: ``"points 3 3"`` shading frames, rows tangent, bitangent, normal; None where views
            do not matter.
        positions: ``"points 3"`` in mesh units; None for a tensor that never was a mesh.
        materials: ``"points"``: which material each point has; None where all have one.
    """

    exit_basis: ExitBasis = field(default_factory=Diffuse)
    light_basis: LightBasis | None = None
    reflectance: Float[Tensor, "points_or_one rgb"] = field(
        default_factory=lambda: torch.ones(1, 3)
    )
    frames: Float[Tensor, "points 3 3"] | None = None
    positions: Float[Tensor, "points 3"] | None = None
    materials: Int[Tensor, "points"] | None = None


@dataclass(frozen=True)
class TransferTensor:
    """Values ``"points channels rows coeffs"`` with what is needed to understand them.

    Acts on world-frame light, in the rest pose. Make one with :func:`prt_torch.bake` or
    :meth:`from_dense`.

    Attributes:
        values: A tensor, or anything that gives blocks of points on slicing.
        surface: Bases, frames, reflectance.
        reference_squared_norm: ``"points"``: squared L2 norm over the sphere of the transfer
            function at the full resolution it was baked at, before projection into the light
            basis; None when not known. Allows errors that compare across bases.
        provenance: Hashes of the inputs, seed, versions, timings.
    """

    values: Rows
    surface: Surface = field(default_factory=Surface)
    reference_squared_norm: Float[Tensor, "points"] | None = None
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.values.shape) != 4:
            raise ValueError(
                'expected values "points channels rows coeffs" (from_dense adds missing '
                f"dimensions), got shape {tuple(self.values.shape)}"
            )
        rows, coeffs = self.surface.exit_basis.num_rows, self.num_coeffs
        if self.num_rows != rows:
            raise ValueError(f"expected {rows} rows for the exit basis, got {self.num_rows}")
        basis = self.surface.light_basis
        if basis is not None and basis.num_coeffs != coeffs:
            raise ValueError(f"expected {basis.num_coeffs} coeffs for {basis.name}, got {coeffs}")
        if len(self.surface.reflectance) not in (1, self.num_points):
            raise ValueError(
                f"expected reflectance of 1 or {self.num_points} points, "
                f"got {len(self.surface.reflectance)}"
            )
        materials = self.surface.materials
        if materials is not None and len(materials) != self.num_points:
            raise ValueError(
                f"expected materials of {self.num_points} points, got {len(materials)}"
            )

    @classmethod
    def from_dense(
        cls, values: Tensor, *, light_basis: LightBasis | None = None, **surface: Any
    ) -> "TransferTensor":
        """A tensor from any array, without a mesh.

        Args:
            values: ``"points coeffs"``, ``"points rows coeffs"`` or
                ``"points channels rows coeffs"``. Several rows without an ``exit_basis`` have no
                view functions (:class:`prt_torch.bases.Rowwise`).
            light_basis: What the coefficients mean, if they mean anything.
            surface: Further fields of :class:`Surface`.

        Raises:
            ValueError: If the shape is none of these, or a value is NaN or infinite.
        """
        if not 2 <= values.ndim <= 4:
            raise ValueError(f"expected 2, 3 or 4 dimensions, got shape {tuple(values.shape)}")
        if not torch.isfinite(values).all():
            bad = int((~torch.isfinite(values)).sum())
            raise ValueError(f"transfer values: {bad} are NaN or infinite")
        values = values.detach()
        while values.ndim < 4:
            values = values.unsqueeze(1)
        if "exit_basis" not in surface and values.shape[2] > 1:
            surface["exit_basis"] = Rowwise(values.shape[2])
        return cls(values, Surface(light_basis=light_basis, **surface))

    @property
    def num_points(self) -> int:
        """Surface points."""
        return self.values.shape[0]

    @property
    def num_channels(self) -> int:
        """1 where colour factors out, else 3."""
        return self.values.shape[1]

    @property
    def num_rows(self) -> int:
        """Functions of the exit basis."""
        return self.values.shape[2]

    @property
    def num_coeffs(self) -> int:
        """Functions of the light basis."""
        return self.values.shape[3]

    @property
    def num_bytes(self) -> int:
        """Bytes to relight from the uncompressed tensor: values and reflectance."""
        count = self.num_points * self.num_channels * self.num_rows * self.num_coeffs
        reflectance = self.surface.reflectance
        return count * self.values.dtype.itemsize + reflectance.nbytes

    def dense(self) -> Float[Tensor, "points channels rows coeffs"]:
        """The whole tensor in memory."""
        return self.values[0 : self.num_points]

    def block(self, rows: slice) -> "TransferTensor":
        """Some of the points as a tensor of their own, in memory."""
        surface = self.surface
        shared = len(surface.reflectance) == 1
        return TransferTensor(
            self.values[rows],
            Surface(
                exit_basis=surface.exit_basis,
                light_basis=surface.light_basis,
                reflectance=surface.reflectance if shared else surface.reflectance[rows],
                frames=None if surface.frames is None else surface.frames[rows],
                positions=None if surface.positions is None else surface.positions[rows],
                materials=None if surface.materials is None else surface.materials[rows],
            ),
        )

    def ranges(self, max_bytes: int = 2**28) -> Iterator[slice]:
        """Ranges of points whose values take at most ``max_bytes`` (one point at least)."""
        point_bytes = (
            self.num_channels * self.num_rows * self.num_coeffs * self.values.dtype.itemsize
        )
        step = max(1, max_bytes // point_bytes)
        for start in range(0, self.num_points, step):
            yield slice(start, min(start + step, self.num_points))

    def blocks(self, max_bytes: int = 2**28) -> Iterator[tuple[slice, Tensor]]:
        """The :meth:`ranges` of points with their values, in order."""
        for rows in self.ranges(max_bytes):
            yield rows, self.values[rows]

    def squared_norm(self) -> Float[Tensor, "points"]:
        """Squared L2 norm of each point's transfer, float64.

        Over the sphere of light directions, averaged over the hemisphere of views, summed over
        channels.
        """
        return torch.cat([self.squared_norm_of(values) for _, values in self.blocks(_BLOCK_BYTES)])

    def squared_norm_of(
        self, values: Float[Tensor, "points channels rows coeffs"]
    ) -> Float[Tensor, "points"]:
        """Squared norm in this tensor's light basis of other values, such as a difference.

        Weighed in the type of the values, added up in float64.
        """
        basis = self.surface.light_basis
        if self.num_rows > 1:
            values = self._row_root.mT.to(values) @ values
        weighed = values if basis is None else basis.weigh(values)
        return torch.linalg.vector_norm(weighed, dim=(1, 2, 3), dtype=torch.float64).square()

    @functools.cached_property
    def _row_root(self) -> Float[Tensor, "rows rows"]:
        return self.surface.exit_basis.gram_root()


def project(transfer: TransferTensor, light_basis: LightBasis) -> TransferTensor:
    """Transfer by texels of a cube map, in another light basis, projected where it is read.

    Args:
        transfer: By :class:`prt_torch.bases.CubeDirections`.
        light_basis: The other basis.

    Returns:
        Values that are the least-squares fit to the texels in the basis, with the squared norms of
        ``transfer`` as reference where it knows no other.

    Raises:
        ValueError: If ``transfer`` is not by texels of a cube map.
    """
    if not isinstance(transfer.surface.light_basis, CubeDirections):
        given = transfer.surface.light_basis
        raise ValueError(f"expected transfer by cube directions, got {given and given.name}")
    known = transfer.reference_squared_norm
    return replace(
        transfer,
        values=_Projected(transfer.values, transfer.surface.light_basis.resolution, light_basis),
        surface=replace(transfer.surface, light_basis=light_basis),
        reference_squared_norm=transfer.squared_norm() if known is None else known,
        provenance={**transfer.provenance, "projected_from": transfer.surface.light_basis.name},
    )


class _Projected:
    """Values in a light basis, projected from texels where they are read."""

    def __init__(self, texels: Rows, resolution: int, basis: LightBasis):
        self._texels, self._resolution, self._basis = texels, resolution, basis
        self.shape, self.dtype = (*texels.shape[:3], basis.num_coeffs), texels.dtype

    def __getitem__(self, rows: slice, /) -> Tensor:
        texels = self._texels[rows]
        values = self._basis.project_cube(texels.flatten(0, 2), self._resolution)
        return values.view(*texels.shape[:3], -1)


def add(terms: Sequence[TransferTensor]) -> TransferTensor:
    """The sum of several transfers of the same points and light basis, read lazily by blocks.

    Diffuse terms enter the constant function of a glossy exit basis. Reflectance stays a factor
    where all terms share it; otherwise it is multiplied in, which makes three channels unless it
    is grey. Materials are those of the terms that know them.

    Args:
        terms: At least one. Their exit bases are diffuse, or one and the same.

    Raises:
        ValueError: If points, materials, light bases or exit bases do not fit together, diffuse
            terms meet an exit basis that does not hold the constant, or reflectances differ under
            coloured ones.

    Source:
        Sloan et al. 2003, section 3.1 and figure 9 (subsurface and glossy transfer in one matrix).
    """
    first = terms[0]
    if len(terms) == 1:
        return first
    glossy = [term for term in terms if not isinstance(term.surface.exit_basis, Diffuse)]
    surface = (glossy or terms)[0].surface
    kinds = {str(term.surface.exit_basis.describe()) for term in glossy}
    sizes = {(term.num_points, term.num_coeffs) for term in terms}
    lights = {str(t.surface.light_basis and t.surface.light_basis.describe()) for t in terms}
    if len(kinds) > 1 or len(sizes) > 1 or len(lights) > 1:
        raise ValueError(
            "expected terms of the same points and light basis, diffuse or of one exit basis, got "
            f"points and coeffs {sorted(sizes)}, light {sorted(lights)}, exit {sorted(kinds)}"
        )
    if len(glossy) < len(terms) and not len(surface.exit_basis.constants()):
        raise ValueError("expected an exit basis that holds the constant, for diffuse terms")
    shared = all(torch.equal(term.surface.reflectance, first.surface.reflectance) for term in terms)
    if not shared and surface.exit_basis.num_channels > 1:
        raise ValueError("expected terms of one reflectance, for coloured exit functions")
    values = _SumOfRows(terms, surface.exit_basis, factored=shared)
    surface = replace(
        surface,
        reflectance=first.surface.reflectance if shared else torch.ones(1, 3),
        materials=_shared_materials(terms),
    )
    provenance = {"terms": [term.provenance for term in terms]}
    return TransferTensor(values, surface, None, provenance)


def _shared_materials(terms: Sequence[TransferTensor]) -> Int[Tensor, "points"] | None:
    """Those of the terms that know them, which must be the same."""
    known = [own for term in terms if (own := term.surface.materials) is not None]
    if not all(torch.equal(own, known[0]) for own in known):
        raise ValueError("expected terms of the same materials, got different ones")
    return known[0] if known else None


class _SumOfRows:
    """Values of several transfers in one exit basis, added where they are read."""

    def __init__(self, terms: Sequence[TransferTensor], basis: ExitBasis, *, factored: bool):
        self._terms, self._factored = list(terms), factored
        self._constants = basis.constants()
        colours = [term.num_channels for term in terms]
        if not factored:
            colours += [colour_channels(term.surface.reflectance).shape[1] for term in terms]
        if len(self._constants) == 3:  # its rows are coloured already
            colours = [1]
        first = terms[0]
        self.shape = (first.num_points, max(colours), basis.num_rows, first.num_coeffs)
        self.dtype = functools.reduce(torch.promote_types, (term.values.dtype for term in terms))

    def __getitem__(self, rows: slice, /) -> Tensor:
        pieces = [term.values[rows].to(self.dtype) for term in self._terms]
        total = pieces[0].new_zeros(len(pieces[0]), *self.shape[1:])
        for term, values in zip(self._terms, pieces, strict=True):
            if not self._factored:
                reflectance = term.surface.reflectance.to(values)
                reflectance = reflectance if len(reflectance) == 1 else reflectance[rows]
                values = values * reflectance[:, : self.shape[1], None, None]
            if term.num_rows == self.shape[2]:
                total += values
            else:
                total += self._embed(values[:, :, 0])
        return total

    def _embed(
        self, diffuse: Float[Tensor, "points channels coeffs"]
    ) -> Float[Tensor, "points out_channels rows coeffs"]:
        """Diffuse radiance in the rows of the exit basis."""
        constants = self._constants.to(diffuse)
        if len(constants) == 1:
            return diffuse[:, :, None] * constants[0][:, None]
        diffuse = diffuse.expand(-1, len(constants), -1)
        return torch.einsum("pci,cr->pri", diffuse, constants)[:, None]


def colour_channels(
    reflectance: Float[Tensor, "points rgb"],
) -> Float[Tensor, "points channels"]:
    """The one channel of a reflectance that is grey at every point, else all three."""
    return reflectance[:, :1] if bool((reflectance == reflectance[:, :1]).all()) else reflectance
