"""Skinned glTF scenes, against an implementation written straight from the specification."""

import copy
import json
import struct

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from prt_torch.assets import deformed_frames, load_mesh, load_skinned
from prt_torch.errors import InputError

CODES = {"u1": 5121, "u2": 5123, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
SECONDS = torch.tensor([-1.0, 0.0, 0.1, 0.5, 0.73, 1.0, 1.4, 2.0, 9.0], dtype=torch.float64)
RINGS, SIDES = 9, 6


class Writer:
    """A glTF document and its buffer, grown accessor by accessor."""

    def __init__(self):
        self.document = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": []}
        self.binary = b""

    def add(self, values, kind="f4", normalized=False):
        values = np.asarray(values)
        values = values.reshape(len(values), -1).astype("<" + kind)
        self.binary += b"\0" * (-len(self.binary) % 4)
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": values.nbytes}
        self.document["bufferViews"].append(view)
        accessor = {
            "bufferView": len(self.document["bufferViews"]) - 1,
            "componentType": CODES[kind],
            "count": len(values),
            "type": TYPES[values.shape[1]],
        }
        if normalized:
            accessor["normalized"] = True
        self.document["accessors"].append(accessor)
        self.binary += values.tobytes()
        return len(self.document["accessors"]) - 1

    def save(self, path):
        self.document["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.document).encode()
        text += b" " * (-len(text) % 4)
        binary = self.binary + b"\0" * (-len(self.binary) % 4)
        body = struct.pack("<I", len(text)) + b"JSON" + text
        body += struct.pack("<I", len(binary)) + b"BIN\0" + binary
        path.write_bytes(b"glTF" + struct.pack("<II", 2, len(body) + 12) + body)
        return path


def tube():
    """Positions, normals, texture coordinates and faces of an open tube along +y, with a seam."""
    height, angle = np.meshgrid(
        np.linspace(0, 3, RINGS), np.linspace(0, 2 * np.pi, SIDES + 1), indexing="ij"
    )
    normals = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], axis=-1).reshape(-1, 3)
    vertices = 0.4 * normals + np.stack([0 * height, height, 0 * height], axis=-1).reshape(-1, 3)
    uv = np.stack([angle / (2 * np.pi), height / 3], axis=-1).reshape(-1, 2)
    corner = (np.arange(RINGS - 1)[:, None] * (SIDES + 1) + np.arange(SIDES)).reshape(-1)
    up = corner + SIDES + 1
    faces = np.concatenate(
        [np.stack([corner, corner + 1, up + 1], 1), np.stack([corner, up + 1, up], 1)]
    )
    return vertices, normals, uv, faces


def quaternions(generator, count):
    return Rotation.random(count, rng=generator).as_quat()


def rig(seed=0, tangents=True):
    """A tube with two sets of influences on four joints, and all kinds of samplers."""
    generator = np.random.default_rng(seed)
    vertices, normals, uv, faces = tube()
    writer = Writer()
    joints = generator.integers(0, 4, (len(vertices), 8))
    weights = generator.random((len(vertices), 8)) ** 4
    weights /= weights.sum(axis=1, keepdims=True)
    attributes = {
        "POSITION": writer.add(vertices),
        "NORMAL": writer.add(normals),
        "TEXCOORD_0": writer.add(uv * [1, -1] + [0, 1]),
        "JOINTS_0": writer.add(joints[:, :4], "u1"),
        "WEIGHTS_0": writer.add(weights[:, :4]),
        "JOINTS_1": writer.add(joints[:, 4:], "u2"),
        "WEIGHTS_1": writer.add(weights[:, 4:]),
    }
    primitive = {"attributes": attributes, "indices": writer.add(faces.ravel(), "u2")}
    inverse = np.stack([np.eye(4)] * 4)
    inverse[:, :3, :] += 0.2 * generator.normal(size=(4, 3, 4))
    matrix = np.eye(4)
    matrix[:3] += 0.1 * generator.normal(size=(3, 4))
    nodes = [
        {"mesh": 0, "skin": 0, "translation": [100, 0, 0], "scale": [5, 5, 5]},
        {"children": [2, 0], "matrix": matrix.T.ravel().tolist(), "name": "armature"},
        {"children": [3, 5], "translation": [0, 0.1, 0]},
        {"children": [4], "translation": [0, 1, 0], "scale": [1, 1.2, 0.9]},
        {"translation": [0, 1, 0], "rotation": quaternions(generator, 1)[0].tolist()},
        {"translation": [0.2, 0.5, 0]},
    ]
    key_times, keys = np.array([0.0, 0.5, 1.0, 2.0]), quaternions(generator, 4)
    channels = {
        (2, "rotation", "LINEAR"): keys,
        (3, "translation", "LINEAR"): generator.normal(size=(4, 3)),
        (3, "scale", "STEP"): generator.uniform(0.5, 1.5, (4, 3)),
        (4, "translation", "CUBICSPLINE"): generator.normal(size=(12, 3)),
        (5, "rotation", "CUBICSPLINE"): np.concatenate(
            [np.stack([0.1 * q[::-1], q, -0.2 * q[::-1]]) for q in keys]
        ),
    }
    times = writer.add(key_times)
    animation = {"name": "sway", "samplers": [], "channels": []}
    for (node, path, interpolation), values in channels.items():
        sampler = {"input": times, "output": writer.add(values), "interpolation": interpolation}
        animation["samplers"].append(sampler)
        target = {"node": node, "path": path}
        animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": target})
    writer.document.update(
        scenes=[{"nodes": [1]}],
        scene=0,
        nodes=nodes,
        meshes=[{"primitives": [primitive]}],
        skins=[
            {
                "joints": [2, 3, 4, 5],
                "inverseBindMatrices": writer.add(inverse.transpose(0, 2, 1).reshape(4, 16)),
            }
        ],
        animations=[animation],
    )
    truth = {
        "vertices": vertices.astype("f4").astype(float),
        "joints": joints,
        "weights": weights.astype("f4").astype(float),
        "inverse": inverse.astype("f4").astype(float),
        "nodes": nodes,
        "times": key_times,
        "channels": {key: values.astype("f4").astype(float) for key, values in channels.items()},
    }
    return writer, truth


def at_time(path, interpolation, times, values, second):
    """A sampler by the letter of the specification."""
    second = np.clip(second, times[0], times[-1])
    match interpolation:
        case "STEP":
            return values[max(k for k in range(len(times)) if times[k] <= second)]
        case "LINEAR" if path == "rotation":
            return Slerp(times, Rotation.from_quat(values))(second).as_quat()
        case "LINEAR":
            return np.array([np.interp(second, times, column) for column in values.T])
    keys = values.reshape(len(times), 3, -1)
    k = min(max(j for j in range(len(times)) if times[j] <= second), len(times) - 2)
    spline = CubicHermiteSpline(times[k : k + 2], keys[k : k + 2, 1], [keys[k, 2], keys[k + 1, 0]])
    return spline(second)


def poses_by_the_book(truth, second):
    """World positions at one time, joint by joint and point by point."""

    def local(index):
        node = truth["nodes"][index]
        if "matrix" in node:
            return np.array(node["matrix"]).reshape(4, 4).T
        values = {
            "translation": np.array(node.get("translation", [0, 0, 0]), float),
            "rotation": np.array(node.get("rotation", [0, 0, 0, 1]), float),
            "scale": np.array(node.get("scale", [1, 1, 1]), float),
        }
        for (target, path, interpolation), keys in truth["channels"].items():
            if target == index and second is not None:
                values[path] = at_time(path, interpolation, truth["times"], keys, second)
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat(values["rotation"]).as_matrix() * values["scale"]
        matrix[:3, 3] = values["translation"]
        return matrix

    def world(index):
        parent = [k for k, node in enumerate(truth["nodes"]) if index in node.get("children", [])]
        return (world(parent[0]) if parent else np.eye(4)) @ local(index)

    matrices = [world(joint) @ truth["inverse"][k] for k, joint in enumerate((2, 3, 4, 5))]
    points = np.concatenate([truth["vertices"], np.ones((len(truth["vertices"]), 1))], axis=1)
    moved = np.zeros((len(points), 3))
    for p, point in enumerate(points):
        for joint, weight in zip(truth["joints"][p], truth["weights"][p], strict=True):
            moved[p] += weight * (matrices[joint] @ point)[:3]
    return moved


class TestSkinning:
    @pytest.mark.parametrize("seed", [0, 1])
    def test_the_specification(self, tmp_path, seed):
        writer, truth = rig(seed)
        skinned = load_skinned(writer.save(tmp_path / "rig.glb"))
        found = skinned.pose(skinned.joint_matrices(SECONDS))
        expected = np.stack([poses_by_the_book(truth, float(second)) for second in SECONDS])
        np.testing.assert_allclose(found, expected, atol=2e-6)  # weights are renormalised
        rest = poses_by_the_book(truth, None)
        np.testing.assert_allclose(skinned.mesh.vertices, rest, atol=1e-6)
        torch.testing.assert_close(
            skinned.pose(skinned.rest_matrices), skinned.mesh.vertices, atol=1e-14, rtol=0
        )
        assert [(a.name, a.duration) for a in skinned.animations] == [("sway", 2.0)]

    def test_the_mesh_is_the_one_that_is_loaded_without_its_skin(self, tmp_path):
        writer, _ = rig()
        writer.document["nodes"][0] = {"mesh": 0, "skin": 0}
        writer.document["nodes"][1]["matrix"] = np.eye(4).ravel().tolist()
        path = writer.save(tmp_path / "rig.glb")
        plain, skinned = load_mesh(path), load_skinned(path)
        vertices, _, uv, faces = tube()
        np.testing.assert_allclose(plain.vertices, vertices, atol=1e-6)
        assert torch.equal(skinned.mesh.faces, plain.faces)
        assert torch.equal(skinned.mesh.uv, plain.uv)
        np.testing.assert_allclose(plain.uv, uv[faces], atol=1e-6)
        assert skinned.mesh.parts == plain.parts
        np.testing.assert_allclose(skinned.bind_vertices, plain.vertices)
        # Joints that undo their bind matrices leave the mesh as it was.
        matrices = torch.eye(4, dtype=torch.float64).expand(4, 4, 4)
        torch.testing.assert_close(skinned.pose(matrices), plain.vertices)

    def test_normals_at_rest_are_those_of_the_turned_surface(self, tmp_path):
        writer, _ = rig()
        turn = Rotation.from_euler("xyz", [0.3, 1.0, -2.0]).as_matrix()
        for mirror in (1.0, -1.0):
            matrix = np.eye(4)
            matrix[:3, :3] = turn * [mirror, 1, 1]
            nodes = [{"mesh": 0, "skin": 0}, {"matrix": matrix.T.ravel().tolist()}]
            document = copy.deepcopy(writer.document)
            document.update(
                nodes=[*nodes, {"children": [1]}],
                scenes=[{"nodes": [0, 2]}],
                skins=[{"joints": [1, 1, 1, 1]}],
                animations=[],
            )
            other = Writer()
            other.document, other.binary = document, writer.binary
            mesh = load_skinned(other.save(tmp_path / "turned.glb")).mesh
            np.testing.assert_allclose(mesh.normals, tube()[1] @ matrix[:3, :3].T, atol=1e-6)
            assert "opposed_normals" not in {warning.name for warning in mesh.warnings}

    def test_meshes_without_a_skin_follow_their_node(self, tmp_path):
        writer, _ = rig()
        nodes = writer.document["nodes"]
        nodes.append({"mesh": 1, "translation": [0, 0, 2], "scale": [1, -1, 1]})
        nodes[4]["children"] = [6]
        positions = writer.add([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
        writer.document["meshes"].append({"primitives": [{"attributes": {"POSITION": positions}}]})
        path = writer.save(tmp_path / "scene.glb")
        skinned, plain = load_skinned(path), load_mesh(path)
        assert torch.equal(skinned.mesh.faces, plain.faces)
        # It comes first, as the hand is visited before the mesh.
        torch.testing.assert_close(skinned.mesh.vertices[:3], plain.vertices[:3])
        assert skinned.joints.shape == (skinned.mesh.num_points, 8)
        matrices = skinned.joint_matrices(SECONDS)
        moved = skinned.pose(matrices)[:, :3]
        # The hand is node 4, joint 2 of the skin, after the mesh's own.
        to_hand = torch.linalg.inv(skinned.rest_matrices[3])
        rest = torch.cat([plain.vertices[:3], torch.ones(3, 1, dtype=torch.float64)], dim=1)
        expected = rest @ (matrices[:, 3] @ to_hand).mT
        torch.testing.assert_close(moved, expected[..., :3])

    def test_gradients_and_batches(self, tmp_path):
        writer, _ = rig()
        skinned = load_skinned(writer.save(tmp_path / "rig.glb"))
        matrices = skinned.joint_matrices(SECONDS[2:4])
        both = skinned.pose(matrices[None])
        assert both.shape == (1, 2, skinned.mesh.num_points, 3)
        torch.testing.assert_close(both[0, 1], skinned.pose(matrices[1]))
        weights = torch.randn(both.shape[1:], dtype=torch.float64)
        leaf = matrices.clone().requires_grad_()
        assert torch.autograd.gradcheck(lambda m: (skinned.pose(m) * weights).sum(), (leaf,))
        frames = deformed_frames(skinned.mesh, skinned.pose(leaf))
        frames.square().mul(torch.arange(9.0).view(3, 3)).sum().backward()
        assert torch.isfinite(leaf.grad).all()

    def test_weights_of_8_bits_are_normalised(self, tmp_path):
        writer, truth = rig()
        codes = np.rint(truth["weights"] * 255)
        attributes = writer.document["meshes"][0]["primitives"][0]["attributes"]
        attributes["WEIGHTS_0"] = writer.add(codes[:, :4], "u1", normalized=True)
        attributes["WEIGHTS_1"] = writer.add(codes[:, 4:], "u1", normalized=True)
        skinned = load_skinned(writer.save(tmp_path / "rig.glb"))
        np.testing.assert_allclose(skinned.weights.sum(dim=1), 1.0, atol=1e-15)
        truth["weights"] = codes / codes.sum(axis=1, keepdims=True)
        np.testing.assert_allclose(
            skinned.pose(skinned.joint_matrices(SECONDS[3:4]))[0],
            poses_by_the_book(truth, 0.5),
            atol=1e-6,
        )

    def test_one_key_is_constant_and_missing_bind_matrices_are_identities(self, tmp_path):
        writer, truth = rig()
        writer.document["animations"][0] = {
            "samplers": [{"input": writer.add([0.5]), "output": writer.add([[1.0, 2.0, 3.0]])}],
            "channels": [
                {"sampler": 0, "target": {"node": 2, "path": "translation"}},
                {"sampler": 0, "target": {"node": 2, "path": "weights"}},
                {"sampler": 0, "target": {"path": "translation"}},
            ],
        }
        del writer.document["skins"][0]["inverseBindMatrices"]
        skinned = load_skinned(writer.save(tmp_path / "rig.glb"))
        truth["inverse"] = np.stack([np.eye(4)] * 4)
        truth["nodes"][2]["translation"] = [1.0, 2.0, 3.0]
        found = skinned.pose(skinned.joint_matrices(SECONDS))
        expected = np.broadcast_to(poses_by_the_book(truth, None), found.shape)
        np.testing.assert_allclose(found, expected, atol=2e-6)

    def test_wrong_use(self, tmp_path):
        writer, _ = rig()
        skinned = load_skinned(writer.save(tmp_path / "rig.glb"))
        with pytest.raises(ValueError, match="expected matrices of shape"):
            skinned.pose(torch.zeros(3, 4, 4, dtype=torch.float64))
        with pytest.raises(InputError, match=r"rig.glb: has no animation 1, it has 1"):
            skinned.joint_matrices(SECONDS, animation=1)
        del writer.document["animations"]
        still = load_skinned(writer.save(tmp_path / "still.glb"))
        with pytest.raises(InputError, match=r"still.glb: has no animation 0, it has 0"):
            still.joint_matrices(SECONDS)


def _attribute(name, values, kind="f4"):
    def change(writer):
        attributes = writer.document["meshes"][0]["primitives"][0]["attributes"]
        attributes[name] = writer.add(values(attributes, writer), kind)

    return change


def _field(keys, value):
    def change(writer):
        inner = writer.document
        for key in keys[:-1]:
            inner = inner[key]
        if value is None:
            del inner[keys[-1]]
        else:
            inner[keys[-1]] = value

    return change


def _times(values):
    def change(writer):
        accessor = writer.add(values)
        for sampler in writer.document["animations"][0]["samplers"]:
            sampler["input"] = accessor

    return change


COUNT = RINGS * (SIDES + 1)
ATTRIBUTES = ["meshes", 0, "primitives", 0, "attributes"]
BAD = {
    "sum": (_attribute("WEIGHTS_0", lambda *_: np.full((COUNT, 4), 0.3)), "do not sum to 1"),
    "nan weight": (
        _attribute("WEIGHTS_0", lambda *_: np.full((COUNT, 4), np.nan)),
        f"weights of {COUNT} vertices",
    ),
    "joint": (
        _attribute("JOINTS_0", lambda *_: np.full((COUNT, 4), 4), "u1"),
        "JOINTS_0: .* out of range, the first is 4 at vertex 0, of 4 joints",
    ),
    "float joints": (
        _attribute("JOINTS_0", lambda *_: np.zeros((COUNT, 4))),
        "expected unsigned integers",
    ),
    "few joints": (_attribute("JOINTS_0", lambda *_: np.zeros((3, 4)), "u1"), r"\(3, 4\)"),
    "no joints": (_field([*ATTRIBUTES, "JOINTS_0"], None), "has no JOINTS_0"),
    "no weights": (_field([*ATTRIBUTES, "WEIGHTS_1"], None), "JOINTS_1 has no WEIGHTS_1"),
    "missing accessor": (_field([*ATTRIBUTES, "WEIGHTS_0"], 99), r"accessors\[99\]"),
    "no skin": (_field(["nodes", 0, "skin"], None), "has no mesh with a skin"),
    "wrong skin": (_field(["nodes", 0, "skin"], 3), r"skins\[3\], of which there are 1"),
    "joint node": (_field(["skins", 0, "joints"], [2, 3, 4, 99]), r"nodes\[99\], which is not"),
    "bind matrices": (_field(["skins", 0, "inverseBindMatrices"], 0), "inverse bind matrices"),
    "falling times": (
        _times([0.0, 1.0, 0.5, 2.0]),
        r"animations\[0\].channels\[0\]: times do not rise, key 2 is at 0.5 s after 1 s",
    ),
    "equal times": (_times([0.0, 1.0, 1.0, 2.0]), "times do not rise"),
    "nan times": (_times([0.0, 1.0, np.nan, 2.0]), "no finite times"),
    "few keys": (_times([0.0, 1.0]), r"channels\[0\] has 4 rows of 4, expected 2 of 4"),
    "sampler": (_field(["animations", 0, "channels", 1, "sampler"], 7), "sampler 7 of 5"),
    "interpolation": (
        _field(["animations", 0, "samplers", 0, "interpolation"], "SLOW"),
        "unknown interpolation 'SLOW'",
    ),
    "path": (_field(["animations", 0, "channels", 0, "target", "path"], "spin"), "moves 'spin'"),
    "matrix": (_field(["animations", 0, "channels", 0, "target", "node"], 1), "has a matrix"),
    "no samplers": (_field(["animations", 0, "samplers"], None), "not a valid glTF document"),
    "points": (
        _field([*ATTRIBUTES, "TEXCOORD_0"], 0),
        "TEXCOORD_0 of a primitive has 63 rows of 3",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_one_line_that_names_it(tmp_path, name):
    change, pattern = BAD[name]
    writer, _ = rig()
    change(writer)
    path = writer.save(tmp_path / "bad.glb")
    with pytest.raises(InputError, match=pattern) as caught:
        load_skinned(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_points_shared_by_primitives_of_other_joints_are_refused(tmp_path):
    writer, _ = rig()
    primitives = writer.document["meshes"][0]["primitives"]
    primitives.append(copy.deepcopy(primitives[0]))
    assert load_skinned(writer.save(tmp_path / "same.glb")).mesh.num_points == COUNT
    primitives[1]["attributes"]["JOINTS_0"] = writer.add(np.zeros((COUNT, 4)), "u1")
    with pytest.raises(InputError, match="share points that have different joints"):
        load_skinned(writer.save(tmp_path / "bad.glb"))


def test_no_damaged_file_raises_anything_else(tmp_path):
    writer, _ = rig()
    good = writer.save(tmp_path / "good.glb").read_bytes()
    length = int.from_bytes(good[12:16], "little")
    generator = np.random.default_rng(0)
    messages = []
    for _ in range(150):
        data = bytearray(good)
        for _ in range(generator.integers(1, 4)):
            data[20 + generator.integers(length)] = generator.integers(32, 127)
        path = tmp_path / "damaged.glb"
        path.write_bytes(bytes(data))
        try:
            skinned = load_skinned(path)
            if skinned.animations:
                skinned.pose(skinned.joint_matrices(SECONDS))
        except InputError as error:
            messages.append(str(error))
    assert len(messages) > 40
    assert not any("\n" in message for message in messages)
