"""Animations of the nodes of a glTF scene: keys in time, and the transforms between them.

A channel moves one property of one node: its translation, rotation or scale. Between two keys it
keeps the first (STEP), goes straight, rotations along the shorter arc (LINEAR), or follows a cubic
through both with the tangents of the keys (CUBICSPLINE); before the first and after the last it
stays. Nodes that no channel moves stay at rest.

Source:
    glTF 2.0 specification, sections 3.5 and 3.11, appendix C.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from prt_torch.assets.mesh_formats.gltf_document import (
    REST,
    Scene,
    composed,
    local_transform,
    nodes,
)
from prt_torch.errors import InputError

Interpolation = Literal["STEP", "LINEAR", "CUBICSPLINE"]

# Arcs below this [rad] are straight to rounding, and their sine would divide by it.
_STRAIGHT = 1e-7


@dataclass(frozen=True)
class Channel:
    """One property of one node over time."""

    node: int
    path: Literal["translation", "rotation", "scale"]
    interpolation: Interpolation
    times: Float64[np.ndarray, "keys"]
    """In seconds, rising."""
    values: Float64[np.ndarray, "keys 3 width"]
    """Tangent before, value and tangent after each key; tangents, per second, are for cubics."""

    def at(self, seconds: Float64[np.ndarray, "poses"]) -> Float64[np.ndarray, "poses width"]:
        """Values at some times; quaternions may differ from length 1."""
        if len(self.times) == 1:
            return np.broadcast_to(self.values[0, 1], (len(seconds), self.values.shape[2]))
        time = np.clip(seconds, self.times[0], self.times[-1])
        if self.interpolation == "STEP":
            return self.values[np.searchsorted(self.times, time, side="right") - 1, 1]
        key = np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, len(self.times) - 2)
        step = (self.times[key + 1] - self.times[key])[:, None]
        share = (time - self.times[key])[:, None] / step
        before, after = self.values[key, 1], self.values[key + 1, 1]
        if self.interpolation == "LINEAR":
            straight = self.path != "rotation"
            return before + share * (after - before) if straight else _slerp(before, after, share)
        leave, arrive = step * self.values[key, 2], step * self.values[key + 1, 0]
        square, cube = share**2, share**3
        return (
            (2 * cube - 3 * square + 1) * before
            + (cube - 2 * square + share) * leave
            + (3 * square - 2 * cube) * after
            + (cube - square) * arrive
        )


@dataclass(frozen=True)
class Animation:
    """Channels that run together."""

    name: str
    channels: tuple[Channel, ...]

    @property
    def duration(self) -> float:
        """Time of the last key of all channels, in seconds."""
        return max((float(channel.times[-1]) for channel in self.channels), default=0.0)


@dataclass(frozen=True)
class Hierarchy:
    """Nodes of the default scene, each after its parent."""

    indices: tuple[int, ...]
    """Of each node in the file."""
    parents: tuple[int, ...]
    """Place in this order of each node's parent; -1 of roots."""
    rest: dict[str, Float64[np.ndarray, "nodes width"]]
    """Translations, rotations and scales of nodes that channels may move."""
    local: Float64[np.ndarray, "nodes 4 4"]
    """Transforms at rest, relative to the parent."""

    @classmethod
    def of(cls, scene: Scene) -> "Hierarchy":
        """Read from the document.

        Raises:
            InputError: If a node has two parents.
        """
        visited = [(index, node) for index, node, _ in nodes(scene)]
        place = {index: position for position, (index, _) in enumerate(visited)}
        parents = [-1] * len(visited)
        for position, (_, node) in enumerate(visited):
            for child in node.get("children", []):
                parents[place[child]] = position
        rest = {
            name: np.array([node.get(name, start) for _, node in visited], np.float64)
            for name, start in REST.items()
        }
        local = np.array([local_transform(node) for _, node in visited]).reshape(-1, 4, 4)
        return cls(tuple(place), tuple(parents), rest, local)

    def world(
        self, seconds: Float64[np.ndarray, "poses"], animation: Animation | None
    ) -> Float64[np.ndarray, "poses nodes 4 4"]:
        """World transforms of all nodes at some times; at rest without an animation."""
        world = np.repeat(self.local[None], len(seconds), axis=0)  # relative to parents so far
        moved: dict[int, dict[str, Float64[np.ndarray, "poses width"]]] = {}
        for channel in animation.channels if animation else ():
            moved.setdefault(channel.node, {})[channel.path] = channel.at(seconds)
        for index, by_path in moved.items():
            place = self.indices.index(index)
            world[:, place] = composed(
                *(
                    by_path.get(name, np.repeat(rest[place, None], len(seconds), axis=0))
                    for name, rest in self.rest.items()
                )
            )
        for place, parent in enumerate(self.parents):
            if parent >= 0:
                world[:, place] = world[:, parent] @ world[:, place]
        return world


def read_animations(scene: Scene, hierarchy: Hierarchy) -> tuple[Animation, ...]:
    """All animations of a scene; morph targets are left out.

    Raises:
        InputError: If times do not rise, or a sampler or its target is not what the standard says.
    """
    return tuple(
        Animation(
            str(animation.get("name", f"animation{number}")),
            tuple(
                _channel(scene, animation, f"animations[{number}].channels[{index}]", channel)
                for index, channel in enumerate(animation["channels"])
                if channel["target"].get("node") in hierarchy.indices
                and channel["target"]["path"] != "weights"
            ),
        )
        for number, animation in enumerate(scene.document.get("animations", []))
    )


def _channel(
    scene: Scene, animation: dict[str, Any], where: str, channel: dict[str, Any]
) -> Channel:
    """One channel, checked."""
    target, samplers = channel["target"], animation["samplers"]
    node, path = scene.item("nodes", target["node"]), target["path"]
    if path not in REST:
        raise InputError(f"{scene.path}: {where} moves {path!r}, expected one of {', '.join(REST)}")
    if "matrix" in node:
        raise InputError(f"{scene.path}: {where} moves a node that has a matrix")
    if not 0 <= channel["sampler"] < len(samplers):
        raise InputError(
            f"{scene.path}: {where} has sampler {channel['sampler']} of {len(samplers)}"
        )
    sampler = samplers[channel["sampler"]]
    interpolation = sampler.get("interpolation", "LINEAR")
    if interpolation not in ("STEP", "LINEAR", "CUBICSPLINE"):
        raise InputError(f"{scene.path}: {where} has the unknown interpolation {interpolation!r}")
    times = scene.accessor(sampler["input"]).astype(np.float64)
    if times.shape[1] != 1 or not len(times) or not np.isfinite(times).all():
        raise InputError(f"{scene.path}: {where} has no finite times, one a key")
    falls = np.diff(times[:, 0]) <= 0
    if falls.any():
        first = int(falls.argmax())
        raise InputError(
            f"{scene.path}: {where}: times do not rise, key {first + 1} is at "
            f"{times[first + 1, 0]:g} s after {times[first, 0]:g} s"
        )
    values = scene.accessor(sampler["output"]).astype(np.float64)
    cubic, width = interpolation == "CUBICSPLINE", len(REST[path])
    expected = (len(times) * (3 if cubic else 1), width)
    if values.shape != expected or not np.isfinite(values).all():
        raise InputError(
            f"{scene.path}: {where} has {len(values)} rows of {values.shape[1]}, expected "
            f"{expected[0]} of {expected[1]}, all finite"
        )
    values = values.reshape(len(times), -1, width)
    if not cubic:
        values = np.concatenate([0 * values, values, 0 * values], axis=1)
    return Channel(target["node"], path, interpolation, times[:, 0], values)


def _slerp(
    before: Float64[np.ndarray, "poses 4"],
    after: Float64[np.ndarray, "poses 4"],
    share: Float64[np.ndarray, "poses 1"],
) -> Float64[np.ndarray, "poses 4"]:
    """Along the shorter arc between unit quaternions, at constant speed."""
    before, after = (
        quaternion / np.maximum(np.linalg.norm(quaternion, axis=-1, keepdims=True), 1e-300)
        for quaternion in (before, after)
    )
    # A quaternion and its negative are one rotation.
    after = np.where((before * after).sum(axis=-1, keepdims=True) < 0, -after, after)
    half_chord = np.linalg.norm(after - before, axis=-1, keepdims=True)
    arc = 2 * np.arctan2(half_chord, np.linalg.norm(after + before, axis=-1, keepdims=True))
    straight = arc < _STRAIGHT
    sine = np.where(straight, 1.0, np.sin(arc))
    first = np.where(straight, 1 - share, np.sin((1 - share) * arc) / sine)
    second = np.where(straight, share, np.sin(share * arc) / sine)
    return first * before + second * after
