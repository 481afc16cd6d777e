"""The contract every representation of transfer keeps, and no more.

A representation is set up in closed form by ``from_transfer``, relights by ``forward`` without ever
forming the dense tensor, shows what it stands for by ``dense``, and lists what a file of it holds
by ``packed``, which is also what its storage counts. ``tests/contract.py`` holds each to it.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from prt_torch.metric import Metric
from prt_torch.representations.palette import reflectance_bytes
from prt_torch.representations.processes import ALONE, Processes
from prt_torch.transfer import Surface, TransferTensor

_BLOCK_BYTES = 2**25


class Representation(nn.Module, ABC):
    """A compressed transfer tensor.

    Args:
        surface: Bases, frames and reflectance of the tensor it stands for.
        shape: Shape of that tensor: points, channels, rows, coeffs.
    """

    kind: ClassVar[str]
    """Name in configurations and files."""

    places: ClassVar[tuple[str, ...]] = ()
    """Buffers that further tables are made of: only a checkpoint that has the same ones fits."""

    reflectance: Tensor

    def __init__(self, surface: Surface, shape: tuple[int, int, int, int]):
        super().__init__()
        self._surface = surface
        self.num_points, self.num_channels, self.num_rows, self.num_coeffs = shape
        self.register_buffer("reflectance", surface.reflectance)
        self.register_load_state_dict_pre_hook(_refuse_other_places)

    @property
    def surface(self) -> Surface:
        """Bases, frames and reflectance, where the module is."""
        return replace(self._surface, reflectance=self.reflectance)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "Representation":
        """As of any module; frames, positions and materials go to its device, in their own type.

        No buffers: they belong to the mesh, and casting parameters must not round where points are.
        """
        super()._apply(fn, recurse)
        surface, device = self._surface, self.reflectance.device
        self._surface = replace(
            surface,
            frames=None if surface.frames is None else surface.frames.to(device),
            positions=None if surface.positions is None else surface.positions.to(device),
            materials=None if surface.materials is None else surface.materials.to(device),
        )
        return self

    @classmethod
    @abstractmethod
    def from_transfer(
        cls,
        transfer: TransferTensor,
        *,
        metric: Metric | None = None,
        generator: torch.Generator | None = None,
    ) -> "Representation":
        """The paper's closed-form construction. Subclasses add their budget as keywords.

        Args:
            transfer: The tensor to stand for.
            metric: What errors are worth; the L2 norm over light directions if not given.
            generator: Source of randomness; seed 0 if not given.
        """

    @abstractmethod
    def forward(
        self, light: Float[Tensor, "batch *points coeffs rgb"], frames: Tensor | None = None
    ) -> Float[Tensor, "batch points rows rgb"]:
        """Radiance in the exit basis, before reflectance, for a batch of lights.

        The result is a new tensor; its strides are free.

        Args:
            light: Light coefficients ``"batch coeffs rgb"``, or ``"batch points coeffs rgb"``
                where each point has its own light.
            frames: Shading frames of a deformed surface: one pose ``"points 3 3"`` for all lights,
                or ``"batch points 3 3"``, a pose for each light. A single light serves all poses.

        Raises:
            ValueError: If shapes do not fit, or the representation cannot be posed.
        """

    @abstractmethod
    def dense(self, points: Tensor | None = None) -> Float[Tensor, "points channels rows coeffs"]:
        """The tensor it stands for; only some points if their indices are given."""

    @abstractmethod
    def packed(self) -> dict[str, Tensor]:
        """What a file holds: everything needed to relight, reflectance aside."""

    @classmethod
    @abstractmethod
    def from_packed(
        cls, packed: dict[str, Tensor], surface: Surface, shape: tuple[int, int, int, int]
    ) -> "Representation":
        """The inverse of :meth:`packed`, to the bit."""

    @property
    @abstractmethod
    def budget(self) -> dict[str, Any]:
        """What it was given to spend, such as ``{"num_clusters": 128, "rank": 4}``."""

    @property
    @abstractmethod
    def condition(self) -> float:
        """Condition number of the worst solve of its construction; 1 where there was none."""

    def storage(self) -> dict[str, int]:
        """Bytes of each part of a file of it, reflectance and exit basis included."""
        parts = {name: tensor.nbytes for name, tensor in self.packed().items()}
        exit_bytes = sum(tensor.nbytes for tensor in self._surface.exit_basis.tensors().values())
        exits = {"exit_basis": exit_bytes} if exit_bytes else {}
        return {**parts, "reflectance": reflectance_bytes(self.reflectance), **exits}

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of the tensor it stands for."""
        return self.num_points, self.num_channels, self.num_rows, self.num_coeffs

    def _check_light(self, light: Tensor) -> bool:
        """Whether each point has its own light.

        Raises:
            ValueError: If the shape does not fit.
        """
        local = light.ndim == 4
        expected = (self.num_points, self.num_coeffs, 3) if local else (self.num_coeffs, 3)
        if light.ndim not in (3, 4) or tuple(light.shape[1:]) != expected:
            raise ValueError(
                f'expected light "batch {self.num_coeffs} 3" or '
                f'"batch {self.num_points} {self.num_coeffs} 3", got {tuple(light.shape)}'
            )
        return local

    def _poses(
        self, light: Float[Tensor, "batch *points coeffs rgb"], frames: Tensor
    ) -> list[tuple[Float[Tensor, "some *points coeffs rgb"], Float[Tensor, "points 3 3"]]]:
        """Lights with the rotations, one for each point, from the rest pose to the pose they light.

        Raises:
            ValueError: If shapes do not fit, or the surface has no frames at rest.
        """
        if frames.ndim not in (3, 4) or frames.shape[-3:] != (self.num_points, 3, 3):
            raise ValueError(
                f'expected frames "{self.num_points} 3 3" or "batch {self.num_points} 3 3", '
                f"got {tuple(frames.shape)}"
            )
        rest = self._surface.frames
        if rest is None:
            raise ValueError("expected a surface with frames at rest to be posed by others")
        turns = frames.mT @ rest.to(frames)
        if turns.ndim == 3 or len(turns) == 1:
            return [(light, turns.view(-1, 3, 3))]
        if len(light) not in (1, len(turns)):
            raise ValueError(f"expected 1 light or {len(turns)}, one a pose, got {len(light)}")
        return list(zip(light.expand(len(turns), *light.shape[1:]).split(1), turns, strict=True))


class CodedRepresentation(Representation):
    """A representation whose file holds codes of its parameters.

    Where the module is in training mode, gradients pass straight through the rounding to codes;
    leaving it (:meth:`train`, ``eval``) rounds the parameters to what a file holds. They are *at
    rest* from construction, from loading, and from ``eval()`` on, until they are written to.

    A subclass ends its construction by :meth:`_rest`.
    """

    @abstractmethod
    def _rounded(self) -> dict[str, Tensor]:
        """The parameters by name, at what a file would hold."""

    def _squared_error(
        self, transfer: TransferTensor, metric: Metric, processes: Processes = ALONE
    ) -> float:
        """Against transfer, read once by blocks, over the points of all processes."""
        every = torch.arange(self.num_points, device=self.reflectance.device)
        error = torch.zeros(1, dtype=torch.float64, device=every.device)
        for rows, values in transfer.blocks(_BLOCK_BYTES):
            lost = metric.weigh(self.dense(every[rows]).double() - values)
            error += lost.square().sum().to(error)
        return float(processes.sum(error))

    def train(self, mode: bool = True) -> "CodedRepresentation":
        """Enter training; on leaving it, round the parameters to what a file holds."""
        if not mode and not self._at_rest:
            with torch.no_grad():
                for name, values in self._rounded().items():
                    getattr(self, name).copy_(values)
            self._rest()
        super().train(mode)
        return self

    def _rest(self) -> None:
        """Remember that the parameters are what a file holds.

        Nobody counts what is written to tensors of inference mode, so they are never at rest. The
        reflectance, which a user may make a parameter, is in no code.
        """
        own = {n: p for n, p in self.named_parameters(recurse=False) if n != "reflectance"}
        counted = not any(one.is_inference() for one in own.values())
        self._resting = {n: (p, p._version) for n, p in own.items()} if counted else {}

    @property
    def _at_rest(self) -> bool:
        """Whether no parameter has been replaced or written to since."""
        if torch.compiler.is_compiling():  # a traced answer would never change again
            return False
        return bool(self._resting) and all(
            getattr(self, name) is then and then._version == version
            for name, (then, version) in self._resting.items()
        )

    def __getstate__(self) -> dict[str, Any]:
        """As of any module; versions of tensors do not survive a copy, being at rest does."""
        return {**self.__dict__, "_resting": self._at_rest}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """The inverse of :meth:`__getstate__`."""
        at_rest = state.pop("_resting")
        super().__setstate__(state)
        self._resting = {}
        if at_rest:
            self._rest()


def _refuse_other_places(
    module: Representation, state: dict[str, Any], prefix: str, *_: object
) -> None:
    """Refuse a checkpoint of other clusters, whose numbers would be given to the wrong points.

    Raises:
        ValueError: If a buffer of ``places`` differs.
    """
    for name in module.places:
        own, given = module.get_buffer(name), state.get(prefix + name)
        if given is not None and not torch.equal(given.to(own.device), own):
            raise ValueError(
                f"expected a checkpoint with the same {name}, got another clustering "
                "(representations.save and load keep the clusters)"
            )
