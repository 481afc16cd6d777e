"""What a run's configuration may say: every key, its type and its range.

:mod:`prt_torch.config` composes and validates it.
"""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Albedo = tuple[
    Annotated[float, Field(ge=0, le=1)],
    Annotated[float, Field(ge=0, le=1)],
    Annotated[float, Field(ge=0, le=1)],
]


class SceneConfig(_Section):
    """What is lit."""

    mesh: str | None = Field(
        None, min_length=1, description="mesh file; null is the embedded procedural scene"
    )
    ground: bool = Field(True, description="put a mesh file on a ground plane")
    ground_size: float = Field(4.0, gt=0, description="its edge, in horizontal extents of the mesh")
    ground_resolution: int = Field(48, ge=2, le=2048, description="points along its edge")
    up: Literal["y", "z"] = Field("y", description="up axis of the mesh file")
    orientation: Literal["file", "flip", "outward"] = Field("file", description="facing of faces")
    albedo: Albedo | None = Field(None, description="linear RGB, in place of the file's colours")
    transform: list[list[float]] | None = Field(None, description="4x4, applied after up")


class LightConfig(_Section):
    """Distant light: names of embedded lights, or files."""

    fit: list[str] = Field(default_factory=list, description="lights that a light prior expects")
    test: list[str] = Field(..., min_length=1, description="held-out lights that errors are for")
    layout: Literal["auto", "latlong", "vertical_cross", "horizontal_cross"] = "auto"
    rotation_degrees: float = Field(0.0, description="turns every light about +y")
    exposure: float = Field(0.0, ge=-100, le=100, description="stops")


class PartConfig(_Section):
    """What a part of the scene is made of."""

    lambertian: bool = Field(True, description="reflects diffusely with the albedo of the mesh")
    glossy: dict[str, Any] | None = Field(None, description="a reflectance model: name, parameters")
    medium: str | None = Field(None, description="a translucent inside, by name of a preset")
    millimetres_per_unit: float = Field(1.0, gt=0, description="size of a mesh unit")


class MaterialConfig(PartConfig):
    """What the object is made of; the ground is Lambertian."""

    parts: dict[str, PartConfig] = Field(
        default_factory=dict, description="other materials, by name of a part of the mesh"
    )

    @property
    def is_glossy(self) -> bool:
        """Whether any part is."""
        return any(made_of.glossy for made_of in (self, *self.parts.values()))


class TransferConfig(_Section):
    """What is baked."""

    light_basis: Literal["sh", "cube", "haar", "srbf"] = "sh"
    order: int = Field(6, ge=1, le=64, description="bands of spherical harmonics")
    light_resolution: int | None = Field(
        None, ge=1, le=512, description="texels along a light cube's edge; null is resolution"
    )
    light_segments: int = Field(
        2, ge=1, le=512, description="Haar segments along a light cube's edge; 1 is whole faces"
    )
    light_centers: Literal[12, 42, 162, 642, 2562] = Field(
        642, description="radial basis functions of the light"
    )
    light_kernel: Literal["gaussian", "abel_poisson"] = Field("gaussian", description="their shape")
    resolution: int = Field(32, ge=2, le=512, description="texels along a visibility cube's edge")
    supersampling: int = Field(4, ge=1, le=16, description="rays along a texel's edge")
    exit_basis: Literal["harmonics", "factors"] | None = Field(
        None, description="of glossy scenes; null is harmonics for sh, else BRDF factors"
    )
    rows: int | None = Field(
        None, ge=2, le=64, description="exit functions; null is 24 harmonics, or 10 factors"
    )
    keep: list[Literal["rays", "channels", "bands"]] = Field(
        default_factory=list, description="what is kept though the scene does not need it"
    )
    needless: float = Field(
        1e-3, ge=0, lt=1, description="squared error of transfer that counts as no need"
    )
    max_bounces: int = Field(0, ge=0, le=64, description="0 is direct light only")
    tolerance: float = Field(1e-3, ge=0, lt=1, description="share of the light of a last bounce")

    @model_validator(mode="after")
    def _rays_fill_whole_bytes(self) -> "TransferConfig":
        if self.resolution * self.supersampling % 2:
            raise PydanticCustomError(
                "odd",
                "resolution times supersampling must be even, got {resolution} times {factor}",
                {"resolution": self.resolution, "factor": self.supersampling},
            )
        return self

    @model_validator(mode="after")
    def _harmonics_meet_harmonics(self) -> "TransferConfig":
        if self.exit_basis == "harmonics" and self.light_basis != "sh":
            raise PydanticCustomError(
                "exit_basis",
                "exit_basis=harmonics needs light_basis=sh, got {basis}",
                {"basis": self.light_basis},
            )
        return self

    @property
    def light_texels(self) -> int:
        """Texels along an edge of the cube that light is given on."""
        return self.light_resolution or self.resolution

    @model_validator(mode="after")
    def _light_texels_are_whole(self) -> "TransferConfig":
        if self.light_basis == "sh":
            return self
        texels, fine = self.light_texels, self.resolution * self.supersampling
        if fine % texels:
            raise PydanticCustomError(
                "light_resolution",
                "light_resolution must divide all {fine} rays along an edge, got {texels}",
                {"texels": texels, "fine": fine},
            )
        segment, rest = divmod(texels, self.light_segments)
        if self.light_basis == "haar" and (rest or segment.bit_count() != 1):
            raise PydanticCustomError(
                "light_segments",
                "light_resolution {texels} over light_segments {segments} must be a power of two",
                {"texels": texels, "segments": self.light_segments},
            )
        return self


class CPCAConfig(_Section):
    """Sloan et al. 2003."""

    name: Literal["cpca"] = "cpca"
    num_clusters: int = Field(128, ge=1)
    rank: int = Field(4, ge=1, description="vectors a cluster beside its mean")
    method: Literal["iterative", "static", "adaptive"] = "iterative"
    affine: bool = Field(True, description="clusters have means")
    quantisation_share: float | None = Field(
        None, gt=0, description="of the error that codes may add; null keeps numbers as they are"
    )
    max_error: float | None = Field(None, gt=0, description="choose clusters and rank by error")
    max_bytes: int | None = Field(None, ge=1, description="choose clusters and rank by bytes")
    max_relight_seconds: float | None = Field(None, gt=0, description="choose them by time")
    reclassify: float = Field(0.0, ge=0, le=1, description="share of error to lower overdraw for")

    @property
    def limits(self) -> dict[str, float]:
        """The limit that chooses clusters and rank, if one is given."""
        given = {
            "max_error": self.max_error,
            "max_bytes": self.max_bytes,
            "max_relight_seconds": self.max_relight_seconds,
        }
        return {name: value for name, value in given.items() if value is not None}

    @property
    def label(self) -> str:
        """Name of the result."""
        method = "" if self.method == "iterative" else f" {self.method}"
        linear = "" if self.affine else " linear"
        moved = f" reclassified {self.reclassify:g}" if self.reclassify else ""
        size = f"{self.num_clusters}x{self.rank}"
        for limit, value in self.limits.items():
            size = f"{limit.removeprefix('max_')} {value:g}"
        share = self.quantisation_share
        coded = f" coded {share:g}" if share else ""
        return f"{self.name}{method}{linear} {size}{moved}{coded}"

    @model_validator(mode="after")
    def _one_limit(self) -> "CPCAConfig":
        if len(self.limits) > 1:
            raise PydanticCustomError(
                "limits",
                "at most one limit may be given, got {names}",
                {"names": list(self.limits)},
            )
        if self.limits and not self.affine:
            raise PydanticCustomError("limits", "a limit chooses affine clusters only")
        return self


class ScatteredSRBFConfig(_Section):
    """Scattered functions of Tsai and Shih 2006, fitted to transfer."""

    name: Literal["scattered_srbf"] = "scattered_srbf"
    num_clusters: int = Field(64, ge=1)
    num_functions: int = Field(32, ge=1, description="of a cluster")
    resolution: int = Field(16, ge=2, le=64, description="texels that functions are sampled at")
    bits: Literal[16] | None = Field(16, description="of a code; null keeps numbers as they are")

    @property
    def label(self) -> str:
        """Name of the result."""
        bits = "" if self.bits else " float"
        return f"{self.name} {self.num_clusters}x{self.num_functions}{bits}"


class SegmentedCPCAConfig(_Section):
    """Liu et al. 2004."""

    name: Literal["segmented_cpca"] = "segmented_cpca"
    points_per_cluster: int = Field(200, ge=1, description="mean size of a segment's clusters")
    rank: int = Field(16, ge=1, description="vectors a cluster")
    bits: int = Field(16, ge=2, le=16, description="of a code, with its sign")
    quantisation_share: float = Field(0.05, ge=0, description="of the error that rounding may add")

    @property
    def label(self) -> str:
        """Name of the result."""
        return f"{self.name} {self.points_per_cluster}x{self.rank}"


class ClusteredTensorConfig(_Section):
    """Tsai and Shih 2006."""

    name: Literal["clustered_tensor"] = "clustered_tensor"
    num_clusters: int = Field(140, ge=1)
    ranks: tuple[
        Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]
    ] = Field((16, 48, 24), description="of rows, light coefficients and points of a cluster")
    bits: Literal[16] | None = Field(16, description="of a code; null keeps numbers as they are")
    quantisation_share: float | None = Field(
        None, gt=0, description="of the error that codes may add, compressed, in place of bits"
    )
    tolerance: float = Field(1e-4, ge=0, lt=1, description="gain of a turn that ends a phase")
    max_turns: int = Field(40, ge=1, description="of each phase")

    @property
    def label(self) -> str:
        """Name of the result."""
        share = self.quantisation_share
        bits = f" coded {share:g}" if share else "" if self.bits else " float"
        return f"{self.name} {self.num_clusters}x{'/'.join(map(str, self.ranks))}{bits}"


class WaveletConfig(_Section):
    """Wang et al. 2004."""

    name: Literal["wavelet"] = "wavelet"
    num_terms: int = Field(96, ge=1, description="light coefficients kept of a point and row")
    codes: Literal["11/11/10", "16", "8", "float"] | None = Field(
        None, description="bits of a value; null is 11/11/10 for three channels, 16 for one"
    )
    light_threshold: float = Field(
        0.0, ge=0, lt=1, description="light coefficients below this share of the largest are cut"
    )

    @property
    def label(self) -> str:
        """Name of the result."""
        codes = f" {self.codes}" if self.codes else ""
        cut = f" light above {self.light_threshold:g}" if self.light_threshold else ""
        return f"{self.name} {self.num_terms}{codes}{cut}"


class ZonalLobesConfig(_Section):
    """Sloan, Luna, Snyder 2005, for spherical-harmonic light."""

    name: Literal["zonal_lobes"] = "zonal_lobes"
    num_lobes: int = Field(4, ge=1, le=16, description="of each row of a point")
    effort: Literal["default", "fast"] = Field("default", description="of the search for axes")
    ridge: float = Field(1e-7, ge=1e-12, le=1, description="keeps lobes from growing without bound")
    bits: Literal[16] | None = Field(16, description="of a code; null keeps numbers as they are")
    quantisation_share: float | None = Field(
        None, gt=0, description="of the error that codes may add, compressed, in place of bits"
    )

    @property
    def label(self) -> str:
        """Name of the result."""
        effort = "" if self.effort == "default" else f" {self.effort}"
        bits = "" if self.bits else " float"
        share = self.quantisation_share
        bits = f" coded {share:g}" if share else bits
        return f"{self.name} {self.num_lobes}{effort}{bits}"


RepresentationConfig = Annotated[
    CPCAConfig
    | ClusteredTensorConfig
    | ScatteredSRBFConfig
    | SegmentedCPCAConfig
    | WaveletConfig
    | ZonalLobesConfig,
    Field(discriminator="name"),
]

KINDS: dict[str, type[_Section]] = {
    "cpca": CPCAConfig,
    "clustered_tensor": ClusteredTensorConfig,
    "scattered_srbf": ScatteredSRBFConfig,
    "segmented_cpca": SegmentedCPCAConfig,
    "wavelet": WaveletConfig,
    "zonal_lobes": ZonalLobesConfig,
}
"""The closed registry of representations that a run can fit, told apart by ``name``."""


class FitConfig(_Section):
    """Refinement by gradients after the closed form."""

    optimizer: Literal["lbfgs", "adam"] = "lbfgs"
    max_steps: int = Field(10, ge=0, description="0 keeps the closed form")
    metric: Literal["l2", "light_prior"] = Field("l2", description="what errors are worth")


class PreviewConfig(_Section):
    """Pictures."""

    width: int = Field(480, ge=16, le=8192)
    height: int = Field(360, ge=16, le=8192)
    opengl: bool = Field(True, description="also draw with pyrender where EGL exists")


class RunConfig(_Section):
    """One complete run."""

    scene: SceneConfig
    material: MaterialConfig
    light: LightConfig
    transfer: TransferConfig
    representation: RepresentationConfig = Field(..., description="the one to fit")
    representations: list[RepresentationConfig] = Field(
        default_factory=list, description="several to fit; wins over representation"
    )
    fit: FitConfig
    preview: PreviewConfig
    out: str | None = Field(None, description="run folder; null is runs/SCENE-HASH")
    cache: str = Field(..., min_length=1, description="folder of bakes")
    memory_budget: int = Field(4 * 2**30, ge=2**24, description="bytes a computation may take")
    seed: int = Field(0, ge=0, lt=2**63)

    @property
    def fitted(self) -> list[RepresentationConfig]:
        """The representations that this run fits."""
        return self.representations or [self.representation]
