r"""Meshes that joints move: linear-blend skinning of glTF scenes, and their animations.

A point follows a few joints by weights that sum to 1,

.. math:: x_p = \sum_k w_{pk} \, M_{j_{pk}} \, \bar x_p, \qquad M_j = W_j B_j

where :math:`W_j` is where the joint's node stands in the world, and the inverse bind matrix
:math:`B_j` takes the file's positions to where they are as the joint sees them. The transform of a
node that has a skinned mesh does not count, as the standard says. A mesh without a skin follows its
own node, as the one joint of all its points, so that whole scenes move.

The mesh at rest has its nodes as the file places them outside of any animation.

Source:
    glTF 2.0 specification, section 3.7.3.
"""

import os
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64, Shaped
from torch import Tensor

from prt_torch.assets.animation import Animation, Hierarchy, read_animations
from prt_torch.assets.input_file import read_input
from prt_torch.assets.mesh import Mesh, mesh_from_raw
from prt_torch.assets.mesh_formats.gltf import Points, assembled, meshes
from prt_torch.assets.mesh_formats.gltf_document import Scene, open_scene, refusals
from prt_torch.errors import InputError

# Weights of 8 bits miss 1 by their rounding, and writers normalise carelessly.
_LARGEST_MISS = 0.02


@dataclass(frozen=True, eq=False)
class SkinnedMesh:
    """A mesh, what moves its points, and its animations. Made by :func:`load_skinned`."""

    mesh: Mesh
    """At rest."""
    bind_vertices: Float64[Tensor, "points 3"]
    """What joint matrices act on."""
    joints: Int64[Tensor, "points influences"]
    """Joints that each point follows, padded with joint 0."""
    weights: Float64[Tensor, "points influences"]
    """Of those joints; they sum to 1."""
    inverse_bind: Float64[Tensor, "joints 4 4"]
    """From the points to each joint."""
    joint_nodes: Int64[Tensor, "joints"]
    """Place of each joint's node in the hierarchy."""
    hierarchy: Hierarchy
    animations: tuple[Animation, ...]
    source: str
    """What messages call the file."""

    @property
    def rest_matrices(self) -> Float64[Tensor, "joints 4 4"]:
        """Joint matrices outside of any animation: ``pose(rest_matrices)`` is the mesh."""
        return self._matrices(np.zeros(1), None)[0]

    def joint_matrices(
        self, seconds: Float[Tensor, "poses"], animation: int = 0
    ) -> Float64[Tensor, "poses joints 4 4"]:
        """Where the joints take points at some times of an animation.

        Args:
            seconds: Times; before the first and after the last key the pose stays.
            animation: Which one.

        Raises:
            InputError: If the file has no such animation.
        """
        if not 0 <= animation < len(self.animations):
            raise InputError(
                f"{self.source}: has no animation {animation}, it has {len(self.animations)}"
            )
        times = seconds.detach().cpu().double().numpy()
        return self._matrices(times, self.animations[animation])

    def pose(
        self, matrices: Float[Tensor, "*poses joints 4 4"]
    ) -> Float[Tensor, "*poses points 3"]:
        """Positions of the points, differentiable in the matrices.

        Args:
            matrices: Affine, acting on columns; those of :meth:`joint_matrices` or any others.

        Raises:
            ValueError: If there is not one for each joint.
        """
        if matrices.shape[-3:] != self.inverse_bind.shape:
            expected = tuple(self.inverse_bind.shape)
            raise ValueError(f"expected matrices of shape (..., {expected}), got {matrices.shape}")
        device = matrices.device
        weights, joints = self.weights.to(matrices), self.joints.to(device)
        rows = matrices[..., :3, :]
        blended = rows.new_zeros(*rows.shape[:-3], len(joints), 3, 4)
        for weight, joint in zip(weights.mT, joints.mT, strict=True):
            blended = blended + weight[:, None, None] * rows[..., joint, :, :]
        moved = blended[..., :3] @ self.bind_vertices.to(matrices)[..., None]
        return moved[..., 0] + blended[..., 3]

    def _matrices(
        self, seconds: Float64[np.ndarray, "poses"], animation: Animation | None
    ) -> Float64[Tensor, "poses joints 4 4"]:
        world = torch.from_numpy(self.hierarchy.world(seconds, animation))
        return world[:, self.joint_nodes] @ self.inverse_bind


def load_skinned(path: str | os.PathLike[str]) -> SkinnedMesh:
    """Load a glTF scene (.glb, .gltf) with skins and animations.

    Points, faces, parts, colours and texture coordinates are those of
    :func:`~prt_torch.assets.load_mesh`. All sets of joints and weights count. Morph targets are not
    read.

    Raises:
        InputError: If the file cannot be read or has no skin; joints are out of range or outside
            the scene; weights are negative or do not sum to 1; or an animation is malformed.
    """
    file, data = read_input(path, "mesh")
    with refusals(file):
        scene = open_scene(file, data)
        hierarchy = Hierarchy.of(scene)
        rig = _Rig(scene, hierarchy)
        blocks = [
            (name, [rig.add(index, world, points) for points in found])
            for index, name, world, found in meshes(scene)
        ]
        if not scene.document.get("skins") or not rig.skinned:
            raise InputError(f"{path}: has no mesh with a skin; load_mesh reads it")
        animations = read_animations(scene, hierarchy)
        return SkinnedMesh(
            mesh=mesh_from_raw(file.stem, str(path), assembled(blocks)),
            bind_vertices=torch.from_numpy(np.concatenate(rig.bind_vertices)),
            joints=torch.from_numpy(_padded(rig.joints)),
            weights=torch.from_numpy(_padded(rig.weights)),
            inverse_bind=torch.from_numpy(np.concatenate(rig.inverse_bind)),
            joint_nodes=torch.tensor(rig.joint_nodes),
            hierarchy=hierarchy,
            animations=animations,
            source=str(path),
        )


class _Rig:
    """Joints and weights of all points, gathered mesh by mesh."""

    def __init__(self, scene: Scene, hierarchy: Hierarchy) -> None:
        self.skinned = False
        self.bind_vertices: list[Float64[np.ndarray, "points 3"]] = []
        self.joints: list[Int64[np.ndarray, "points influences"]] = []
        self.weights: list[Float64[np.ndarray, "points influences"]] = []
        self.inverse_bind: list[Float64[np.ndarray, "joints 4 4"]] = []
        self.joint_nodes: list[int] = []
        self._scene = scene
        self._place = {index: place for place, index in enumerate(hierarchy.indices)}
        self._rest = hierarchy.world(np.zeros(1), None)[0]
        self._first_joint: dict[tuple[str, int], int] = {}

    def add(self, index: int, world: Float64[np.ndarray, "4 4"], points: Points) -> Points:
        """Take in the points of a node; they come back in the rest pose."""
        skin = self._scene.item("nodes", index).get("skin")
        if skin is None:
            points = points.moved(world)
            first = self._first_joint.get(("node", index))
            if first is None:
                first = self._add_joints(
                    ("node", index), [index], _inverse(self._scene, index, world)
                )
            count = len(points.vertices)
            joints, weights = np.full((count, 1), first), np.ones((count, 1))
            rest = points
        else:
            self.skinned = True
            first = self._first_joint.get(("skin", skin))
            if first is None:
                first = self._add_skin(skin)
            count = len(self._scene.item("skins", skin)["joints"])
            joints, weights = _influences(self._scene, points, count)
            rest = self._at_rest(points, joints + first, weights)
            joints = joints + first
        self.bind_vertices.append(points.vertices)
        self.joints.append(joints)
        self.weights.append(weights)
        return rest

    def _add_skin(self, index: int) -> int:
        """Joints of a skin; the number of the first."""
        skin = self._scene.item("skins", index)
        joints = skin["joints"]
        if outside := [joint for joint in joints if joint not in self._place]:
            raise InputError(
                f"{self._scene.path}: skins[{index}] has the joint nodes[{outside[0]}], which is "
                "not in the scene"
            )
        inverse = np.tile(np.eye(4), (len(joints), 1, 1))
        if "inverseBindMatrices" in skin:
            given = self._scene.accessor(skin["inverseBindMatrices"]).astype(np.float64)
            if given.shape[1] != 16 or len(given) < len(joints) or not np.isfinite(given).all():
                raise InputError(
                    f"{self._scene.path}: skins[{index}] has {len(given)} inverse bind matrices, "
                    f"expected {len(joints)}, all finite"
                )
            inverse = given[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)
        return self._add_joints(("skin", index), joints, inverse)

    def _add_joints(
        self, key: tuple[str, int], joints: list[int], inverse: Float64[np.ndarray, "joints 4 4"]
    ) -> int:
        first = len(self.joint_nodes)
        self._first_joint[key] = first
        self.joint_nodes.extend(self._place[joint] for joint in joints)
        self.inverse_bind.append(inverse)
        return first

    def _at_rest(
        self,
        points: Points,
        joints: Int64[np.ndarray, "points influences"],
        weights: Float64[np.ndarray, "points influences"],
    ) -> Points:
        """Skinned points where their joints take them outside of any animation."""
        matrices = self._rest[self.joint_nodes] @ np.concatenate(self.inverse_bind)
        blended = np.einsum("pk,pkij->pij", weights, matrices[joints])
        linear = blended[:, :3, :3]
        vertices = np.einsum("pij,pj->pi", linear, points.vertices) + blended[:, :3, 3]
        a, b, c = np.moveaxis(linear, 1, 0)
        cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
        mirrored = np.linalg.det(linear) < 0
        cofactors = np.where(mirrored[:, None, None], -cofactors, cofactors)
        normals = np.einsum("pij,pj->pi", cofactors, points.normals)
        rest = replace(points, vertices=vertices, normals=normals)
        return rest.turned_over() if mirrored.sum() > len(mirrored) / 2 else rest


def _inverse(
    scene: Scene, index: int, world: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "1 4 4"]:
    """From the world at rest to a node."""
    if not np.linalg.det(world[:3, :3]):
        raise InputError(f"{scene.path}: nodes[{index}] flattens its mesh, which cannot be moved")
    return np.linalg.inv(world)[None]


def _influences(
    scene: Scene, points: Points, num_joints: int
) -> tuple[Int64[np.ndarray, "points influences"], Float64[np.ndarray, "points influences"]]:
    """Joints and weights of a primitive's points, checked; weights sum to 1 exactly."""
    named, *others = [
        {name: index for name, index in each.items() if name.startswith(("JOINTS_", "WEIGHTS_"))}
        for each in points.attributes
    ]
    if "JOINTS_0" not in named:
        raise InputError(f"{scene.path}: a mesh with a skin has no JOINTS_0")
    if any(other != named for other in others):
        raise InputError(f"{scene.path}: primitives share points that have different joints")
    pairs = [
        _influence_set(scene, named, name, (len(points.vertices), num_joints))
        for name in sorted(named)
        if name.startswith("JOINTS_")
    ]
    joints = np.concatenate([joint for joint, _ in pairs], axis=1)
    weights = np.concatenate([weight for _, weight in pairs], axis=1)
    total = weights.sum(axis=1)
    misses = ~(np.abs(total - 1) <= _LARGEST_MISS) | (weights < 0).any(axis=1)
    if misses.any():
        first = int(misses.argmax())
        raise InputError(
            f"{scene.path}: weights of {misses.sum()} vertices are negative or do not sum to 1, "
            f"the first are {weights[first].tolist()} at vertex {first}"
        )
    return joints, weights / total[:, None]


def _influence_set(
    scene: Scene, accessors: dict[str, int], name: str, shape: tuple[int, int]
) -> tuple[Int64[np.ndarray, "points 4"], Float64[np.ndarray, "points 4"]]:
    """One set of four joints and weights a point, of ``shape`` points and joints."""
    num_points, num_joints = shape
    partner = name.replace("JOINTS", "WEIGHTS")
    if partner not in accessors:
        raise InputError(f"{scene.path}: a mesh with {name} has no {partner}")
    joints = scene.accessor(accessors[name])
    weights = scene.accessor(accessors[partner]).astype(np.float64)
    expected = (num_points, 4)
    if joints.dtype.kind != "u" or not joints.shape == weights.shape == expected:
        raise InputError(
            f"{scene.path}: {name} and {partner} are {joints.dtype} {joints.shape} and "
            f"{weights.shape}, expected unsigned integers and weights of {expected}"
        )
    joints = joints.astype(np.int64)
    # Joints without weight may say anything.
    wrong = (joints >= num_joints) & (weights != 0)
    if wrong.any():
        first = int(wrong.any(axis=1).argmax())
        raise InputError(
            f"{scene.path}: {name}: {wrong.sum()} joints are out of range, the first is "
            f"{joints[first][wrong[first]][0]} at vertex {first}, of {num_joints} joints"
        )
    return np.where(weights != 0, joints, 0), weights


def _padded(
    blocks: list[Shaped[np.ndarray, "_ _"]],
) -> Shaped[np.ndarray, "total influences"]:
    """Blocks of rows one after the other, filled up with zeros to the same width."""
    width = max(block.shape[1] for block in blocks)
    return np.concatenate(
        [np.pad(block, ((0, 0), (0, width - block.shape[1]))) for block in blocks]
    )
