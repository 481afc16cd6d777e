"""Loading, checking and joining meshes, against known answers and a second loader."""

import base64
import json
import math
import struct

import numpy as np
import pytest
import torch
import trimesh

from prt_torch.assets import (
    DEFAULT_ALBEDO,
    concatenate,
    ground_plane,
    load_mesh,
    mesh_from_arrays,
)
from prt_torch.errors import InputError

CUBE_VERTICES = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
CUBE_QUADS = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
)
CUBE_FACES = np.concatenate([CUBE_QUADS[:, [0, 1, 2]], CUBE_QUADS[:, [0, 2, 3]]])


def cube(scale=1.0, shift=0.0, faces=CUBE_FACES):
    return mesh_from_arrays(
        "cube", torch.tensor(CUBE_VERTICES * scale + shift), torch.tensor(faces.copy())
    )


def names(mesh):
    return {warning.name: warning.count for warning in mesh.warnings}


def write(folder, name, content):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def obj_text(vertices=CUBE_VERTICES, polygons=CUBE_QUADS):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(vertices).tolist()]
    return "\n".join([*lines, *("f " + " ".join(str(i + 1) for i in p) for p in polygons), ""])


def ply_bytes(
    vertices=CUBE_VERTICES, polygons=CUBE_QUADS, order="ascii", vertex_count=None, face_count=None
):
    form = {"ascii": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = (
        f"ply\nformat {form} 1.0\ncomment x\n"
        f"element vertex {len(vertices) if vertex_count is None else vertex_count}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(polygons) if face_count is None else face_count}\n"
        "property uchar tag\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    if order == "ascii":
        rows = [" ".join(map(repr, row)) for row in np.asarray(vertices).tolist()]
        rows += [f"7 {len(p)} " + " ".join(map(str, p)) for p in polygons]
        return header + "\n".join(rows).encode() + b"\n"
    body = np.asarray(vertices, order + "f8").tobytes()
    for polygon in polygons:
        body += struct.pack(f"{order}BB{len(polygon)}i", 7, len(polygon), *polygon)
    return header + body


def off_text(vertices=CUBE_VERTICES, polygons=CUBE_QUADS, head="OFF\n"):
    rows = [" ".join(map(repr, row)) for row in np.asarray(vertices).tolist()]
    rows += [f"{len(p)} " + " ".join(map(str, p)) for p in polygons]
    return f"{head}{len(vertices)} {len(polygons)} 0\n" + "\n".join(rows) + "\n"


def stl_bytes(corners, count=None):
    record = b"".join(
        struct.pack("<12fH", 0, 0, 0, *map(float, np.ravel(facet)), 0) for facet in corners
    )
    return b"\0" * 80 + struct.pack("<I", len(corners) if count is None else count) + record


def gltf_document(vertices=CUBE_VERTICES, faces=CUBE_FACES, nodes=None, extra=None):
    """A document with one mesh in buffer 0, and the buffer."""
    positions = np.asarray(vertices, "<f4").tobytes()
    indices = np.asarray(faces, "<u2").tobytes()
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes or [{"mesh": 0, "name": "box"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(vertices), "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": np.size(faces), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(positions)},
            {"buffer": 0, "byteOffset": len(positions), "byteLength": len(indices)},
        ],
        "buffers": [{"byteLength": len(positions) + len(indices)}],
        **(extra or {}),
    }
    return document, positions + indices


def add_accessor(document, binary, values, accessor, stride=None):
    """Append an accessor and its bytes; the longer buffer."""
    content = np.ascontiguousarray(values).tobytes()
    view = {"buffer": 0, "byteOffset": len(binary), "byteLength": len(content)}
    document["bufferViews"].append(view if stride is None else {**view, "byteStride": stride})
    document["accessors"].append({"bufferView": len(document["bufferViews"]) - 1, **accessor})
    document["buffers"][0]["byteLength"] = len(binary + content)
    return binary + content


def glb_bytes(document, binary, length=None):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    body = struct.pack("<I", len(text)) + b"JSON" + text
    body += struct.pack("<I", len(binary)) + b"BIN\0" + binary
    return b"glTF" + struct.pack("<II", 2, len(body) + 12 if length is None else length) + body


class TestNormals:
    def test_cube_corner_is_the_diagonal_however_faces_are_split(self):
        # Area weights would favour the faces cut into two triangles at a corner.
        normals = cube().normals.numpy()
        np.testing.assert_allclose(normals, CUBE_VERTICES / math.sqrt(3), atol=1e-15)

    @pytest.mark.parametrize("scale", [1e-12, 1e-6, 1e6, 1e10, 1e60, 1e-60])
    def test_normals_do_not_depend_on_the_unit_of_length(self, scale):
        np.testing.assert_allclose(cube(scale).normals, cube().normals, atol=1e-14)

    def test_spiky_vertex_agrees_with_a_loop_over_corners(self):
        generator = np.random.default_rng(3)
        vertices = generator.normal(size=(30, 3))
        faces = np.array([generator.choice(30, 3, replace=False) for _ in range(60)])
        expected = np.zeros((30, 3))
        for face in faces:
            for k in range(3):
                p, a, b = (vertices[face[(k + j) % 3]] for j in range(3))
                u, v = a - p, b - p
                cosine = u @ v / np.linalg.norm(u) / np.linalg.norm(v)
                normal = np.cross(u, v)
                expected[face[k]] += math.acos(cosine) * normal / np.linalg.norm(normal)
        length = np.linalg.norm(expected, axis=1, keepdims=True)
        expected = np.divide(expected, length, where=length > 0, out=np.zeros_like(expected))
        mesh = mesh_from_arrays("random", torch.tensor(vertices), torch.tensor(faces))
        np.testing.assert_allclose(mesh.normals, expected, atol=1e-11)

    def test_zero_area_faces_weigh_nothing_and_isolated_vertices_have_no_normal(self):
        vertices = np.concatenate([CUBE_VERTICES, [[5.0, 5, 5], [6.0, 6, 6], [7.0, 7, 7]]])
        faces = np.concatenate([CUBE_FACES, [[0, 0, 1], [8, 9, 8]]])
        mesh = mesh_from_arrays("cube", torch.tensor(vertices), torch.tensor(faces))
        np.testing.assert_allclose(mesh.normals[:8], cube().normals, atol=1e-15)
        assert (mesh.normals[8:] == 0).all()
        counts = names(mesh)
        assert counts["zero_area_faces"] == 2
        assert counts["isolated_vertices"] == 1
        assert counts["undefined_normals"] == 2

    def test_given_normals_are_kept_and_bad_ones_computed(self):
        given = torch.tensor(CUBE_VERTICES) * 7
        given[2] = 0
        given[3] = math.nan
        given[5] *= -1
        mesh = mesh_from_arrays(
            "cube", torch.tensor(CUBE_VERTICES), torch.tensor(CUBE_FACES), normals=given
        )
        expected = CUBE_VERTICES / math.sqrt(3)
        expected[5] *= -1
        np.testing.assert_allclose(mesh.normals, expected, atol=1e-15)
        assert names(mesh) == {"recomputed_normals": 2, "opposed_normals": 1}


class TestOrientation:
    def test_inward_cube_is_found_flipped_and_turned(self, tmp_path):
        path = write(tmp_path, "in.obj", obj_text(polygons=CUBE_QUADS[:, ::-1]))
        as_is = load_mesh(path)
        assert names(as_is) == {"inward_normals": 12}
        assert "scene.orientation=flip" in as_is.warnings[0].message
        flipped, outward = (load_mesh(path, orientation=o) for o in ("flip", "outward"))
        assert names(flipped) == {}
        assert names(outward) == {"flipped": 12}
        np.testing.assert_allclose(flipped.normals, CUBE_VERTICES / math.sqrt(3), atol=1e-15)
        assert torch.equal(flipped.faces, outward.faces)

    def test_outward_leaves_an_outward_mesh(self, tmp_path):
        path = write(tmp_path, "out.obj", obj_text())
        assert names(load_mesh(path, orientation="outward")) == {}
        assert names(load_mesh(path, orientation="flip")) == {"inward_normals": 12}

    def test_file_normals_flip_with_the_faces(self, tmp_path):
        lines = obj_text().splitlines()
        lines = [line if line[0] == "v" else "" for line in lines]
        lines += [f"vn {x} {y} {z}" for x, y, z in CUBE_VERTICES]
        lines += ["f " + " ".join(f"{i + 1}//{i + 1}" for i in quad) for quad in CUBE_QUADS]
        mesh = load_mesh(write(tmp_path, "n.obj", "\n".join(lines)), orientation="flip")
        np.testing.assert_allclose(mesh.normals, -CUBE_VERTICES / math.sqrt(3), atol=1e-15)
        assert "opposed_normals" not in names(mesh)

    @pytest.mark.parametrize("shift", [0.0, 1e4])
    def test_ground_far_larger_than_the_object_does_not_hide_its_side(self, shift):
        ground = ground_plane(cube(), size=50.0)
        both = concatenate([cube(shift=shift), ground], "both")
        assert names(mesh_from_arrays("a", both.vertices, both.faces)).keys() == {"open_boundary"}
        inward = concatenate([cube(shift=shift, faces=CUBE_FACES[:, ::-1]), ground], "both")
        counts = names(mesh_from_arrays("a", inward.vertices, inward.faces))
        assert counts.keys() == {"open_boundary", "inward_normals"}

    def test_a_flat_sheet_has_no_inside(self):
        plane = ground_plane(cube())
        flipped = mesh_from_arrays("p", plane.vertices, plane.faces.flip(1))
        assert names(flipped).keys() == {"open_boundary"}


class TestDefects:
    def test_each_is_counted(self):
        faces = np.concatenate([CUBE_FACES[1:], CUBE_FACES[5:6], CUBE_FACES[5:6, [1, 2, 0]]])
        counts = names(cube(faces=faces))
        assert counts["duplicate_faces"] == 2
        assert counts["open_boundary"] == 3
        assert counts["non_manifold_edges"] == 3

    def test_a_face_the_wrong_way_round_is_told(self):
        turned = CUBE_FACES.copy()
        turned[3] = turned[3, ::-1]
        assert names(cube(faces=turned)) == {"mixed_orientation": 3}
        # Four faces at an edge, two each way round, are non-manifold but not mixed.
        shifted = cube().vertices + torch.tensor([2.0, 2.0, 0.0])
        both = torch.cat([cube().vertices, shifted]), torch.cat([cube().faces, cube().faces + 8])
        assert names(mesh_from_arrays("two", *both)) == {"non_manifold_edges": 1}

    def test_seams_that_only_split_vertices_are_not_open(self):
        soup = torch.tensor(CUBE_VERTICES[CUBE_FACES.ravel()])
        mesh = mesh_from_arrays("soup", soup, torch.arange(36).reshape(-1, 3))
        assert mesh.num_points == 36
        assert mesh.warnings == ()

    def test_messages_are_one_line_with_the_count(self):
        mesh = cube(faces=CUBE_FACES[1:])
        assert mesh.warnings
        for warning in mesh.warnings:
            assert warning.message.startswith(f"{warning.count} ")
            assert "\n" not in warning.message


class TestFormats:
    def check_cube(self, mesh):
        np.testing.assert_array_equal(mesh.vertices, CUBE_VERTICES)
        assert mesh.vertices.dtype == torch.float64
        assert mesh.faces.dtype == torch.int64
        assert mesh.num_faces == 12
        assert mesh.warnings == ()
        assert mesh.albedo[0].tolist() == list(DEFAULT_ALBEDO)
        np.testing.assert_allclose(mesh.normals, CUBE_VERTICES / math.sqrt(3), atol=1e-15)

    def test_obj(self, tmp_path):
        self.check_cube(load_mesh(write(tmp_path, "cube.obj", obj_text())))

    def test_obj_keeps_v_rows_where_texture_coordinates_split_them(self, tmp_path):
        text = obj_text(polygons=[]) + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        text += "".join(
            "f " + " ".join(f"{i + 1}/{k + 1}" for k, i in enumerate(quad)) + "\n"
            for quad in CUBE_QUADS
        )
        self.check_cube(load_mesh(write(tmp_path, "cube.obj", text)))

    def test_obj_flat_shading_normals_are_averaged_by_angle(self, tmp_path):
        text = obj_text(polygons=[])
        text += "vn -1 0 0\nvn 1 0 0\nvn 0 -1 0\nvn 0 1 0\nvn 0 0 -1\nvn 0 0 1\n"
        for number, quad in enumerate(CUBE_QUADS):
            text += "f " + " ".join(f"{i + 1}//{number + 1}" for i in quad) + "\n"
        mesh = load_mesh(write(tmp_path, "cube.obj", text))
        np.testing.assert_allclose(mesh.normals, CUBE_VERTICES / math.sqrt(3), atol=1e-15)
        assert names(mesh) == {"split_normals": 8}

    def test_obj_relative_indices_and_continued_lines(self, tmp_path):
        text = obj_text(polygons=[]) + "".join(
            f"f {p[0] - 8} {p[1] - 8} \\\n {p[2] - 8} {p[3] - 8}\r\n" for p in CUBE_QUADS
        )
        self.check_cube(load_mesh(write(tmp_path, "cube.obj", text)))

    @pytest.mark.parametrize("order", ["ascii", "<", ">"])
    @pytest.mark.parametrize("mixed", [False, True])
    def test_ply(self, tmp_path, order, mixed):
        polygons = [*CUBE_QUADS[:5].tolist(), *CUBE_FACES[[5, 11]].tolist()]
        data = ply_bytes(polygons=polygons if mixed else CUBE_QUADS.tolist(), order=order)
        self.check_cube(load_mesh(write(tmp_path, "cube.ply", data)))

    @pytest.mark.parametrize("head", ["OFF\n", "OFF ", "# made by hand\nOFF\n\n"])
    def test_off(self, tmp_path, head):
        self.check_cube(load_mesh(write(tmp_path, "cube.off", off_text(head=head))))

    @pytest.mark.parametrize("form", ["binary", "ascii"])
    def test_stl_corners_are_points_in_file_order(self, tmp_path, form):
        corners = CUBE_VERTICES[CUBE_FACES]
        data = stl_bytes(corners)
        if form == "ascii":
            facets = (
                "facet normal 0 0 0\nouter loop\n"
                + "".join(f"vertex {x} {y} {z}\n" for x, y, z in facet)
                + "endloop\nendfacet\n"
                for facet in corners
            )
            data = "solid cube\n" + "".join(facets) + "endsolid cube\n"
        mesh = load_mesh(write(tmp_path, "cube.stl", data))
        np.testing.assert_array_equal(mesh.vertices, corners.reshape(-1, 3))
        assert mesh.warnings == ()
        np.testing.assert_allclose(
            (mesh.normals * mesh.vertices).sum(dim=1), np.ones(36), atol=1e-15
        )

    def test_binary_stl_that_starts_like_ascii(self, tmp_path):
        data = b"solid " + stl_bytes(CUBE_VERTICES[CUBE_FACES])[6:]
        assert load_mesh(write(tmp_path, "cube.stl", data)).num_faces == 12

    def test_glb_and_gltf(self, tmp_path):
        document, binary = gltf_document()
        self.check_cube(load_mesh(write(tmp_path, "cube.glb", glb_bytes(document, binary))))
        beside = {**document, "buffers": [{"byteLength": len(binary), "uri": "a%20b.bin"}]}
        write(tmp_path, "a b.bin", binary)
        self.check_cube(load_mesh(write(tmp_path, "beside.gltf", json.dumps(beside))))
        uri = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
        inside = {**document, "buffers": [{"byteLength": len(binary), "uri": uri}]}
        self.check_cube(load_mesh(write(tmp_path, "inside.gltf", json.dumps(inside))))

    def test_gltf_nodes_are_parts_with_their_transforms(self, tmp_path):
        half = math.sqrt(0.5)
        nodes = [
            {"children": [1, 2], "translation": [10, 0, 0]},
            {"mesh": 0, "name": "turned", "rotation": [0, half, 0, half], "scale": [1, 2, 3]},
            {"mesh": 0, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 5, 0, 1]},
        ]
        data = glb_bytes(*gltf_document(nodes=nodes))
        mesh = load_mesh(write(tmp_path, "scene.glb", data))
        assert [(p.name, p.first_vertex, p.first_face) for p in mesh.parts] == [
            ("turned", 0, 0),
            ("node2", 8, 12),
        ]
        # A quarter turn about +y takes z to x and x to -z.
        x, y, z = CUBE_VERTICES.T
        np.testing.assert_allclose(
            mesh.vertices[:8], np.stack([3 * z + 10, 2 * y, -x], axis=1), atol=1e-12
        )
        np.testing.assert_allclose(mesh.vertices[8:], np.stack([10 - x, y + 5, z], axis=1))
        # The mirrored copy would be inside out if its winding had stayed.
        assert mesh.warnings == ()
        outward = mesh.vertices[8:] - torch.tensor([10.0, 5, 0], dtype=torch.float64)
        np.testing.assert_allclose(mesh.normals[8:], outward / math.sqrt(3), atol=1e-12)

    def test_gltf_material_colour(self, tmp_path):
        document, binary = gltf_document(
            extra={"materials": [{"pbrMetallicRoughness": {"baseColorFactor": [0.1, 0.2, 0.3, 1]}}]}
        )
        document["meshes"][0]["primitives"][0]["material"] = 0
        mesh = load_mesh(write(tmp_path, "red.glb", glb_bytes(document, binary)))
        np.testing.assert_allclose(mesh.albedo, np.tile([0.1, 0.2, 0.3], (8, 1)))

    def test_gltf_16_bit_colours_multiply_the_material(self, tmp_path):
        document, binary = gltf_document(
            extra={"materials": [{"pbrMetallicRoughness": {"baseColorFactor": [1, 0.5, 0.1, 1]}}]}
        )
        colours = np.tile(np.array([65535, 32768, 1000, 65535], "<u2"), (8, 1))
        attribute = {"componentType": 5123, "count": 8, "type": "VEC4", "normalized": True}
        binary = add_accessor(document, binary, colours, attribute)
        document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = 2
        document["meshes"][0]["primitives"][0]["material"] = 0
        mesh = load_mesh(write(tmp_path, "c.glb", glb_bytes(document, binary)))
        expected = np.array([1.0, 0.5 * 32768 / 65535, 0.1 * 1000 / 65535])
        np.testing.assert_allclose(mesh.albedo, np.tile(expected, (8, 1)), rtol=1e-12)

    def test_gltf_quantised_positions_are_fractions(self, tmp_path):
        document, binary = gltf_document(extra={"extensionsRequired": ["KHR_mesh_quantization"]})
        rows = np.pad(CUBE_VERTICES * 32767, ((0, 0), (0, 1))).astype("<i2")
        attribute = {"componentType": 5122, "count": 8, "type": "VEC3", "normalized": True}
        binary = add_accessor(document, binary, rows, attribute, stride=8)
        document["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = 2
        self.check_cube(load_mesh(write(tmp_path, "q.glb", glb_bytes(document, binary))))

    def test_gltf_primitives_of_one_mesh_share_its_points(self, tmp_path):
        document, binary = gltf_document(faces=CUBE_FACES[:4])
        rest = np.asarray(CUBE_FACES[4:], "<u2")
        attribute = {"componentType": 5123, "count": rest.size, "type": "SCALAR"}
        binary = add_accessor(document, binary, rest, attribute)
        primitives = document["meshes"][0]["primitives"]
        primitives.append({**primitives[0], "indices": 2})
        self.check_cube(load_mesh(write(tmp_path, "p.glb", glb_bytes(document, binary))))

    @pytest.mark.parametrize(
        "nodes",
        [
            [{"mesh": 0, "camera": 0, "translation": [5, 0, 0]}],
            [{"camera": 0, "translation": [5, 0, 0], "children": [1]}, {"mesh": 0}],
        ],
    )
    def test_gltf_cameras_hide_no_mesh(self, tmp_path, nodes):
        lens = {"type": "perspective", "perspective": {"yfov": 1, "znear": 0.1}}
        data = glb_bytes(*gltf_document(nodes=nodes, extra={"cameras": [lens]}))
        mesh = load_mesh(write(tmp_path, "camera.glb", data))
        np.testing.assert_array_equal(mesh.vertices, CUBE_VERTICES + [5, 0, 0])

    def test_gltf_without_a_scene_takes_the_nodes_without_parents(self, tmp_path):
        document, binary = gltf_document()
        del document["scene"], document["scenes"]
        self.check_cube(load_mesh(write(tmp_path, "n.glb", glb_bytes(document, binary))))

    def test_gltf_rounded_rotation_does_not_scale(self, tmp_path):
        nodes = [{"mesh": 0, "rotation": [0, 0.7, 0, 0.7]}]
        mesh = load_mesh(write(tmp_path, "r.glb", glb_bytes(*gltf_document(nodes=nodes))))
        x, y, z = CUBE_VERTICES.T
        np.testing.assert_allclose(mesh.vertices, np.stack([z, y, -x], axis=1), atol=1e-14)

    def test_gltf_tree_agrees_with_a_second_loader(self, tmp_path):
        generator = np.random.default_rng(5)
        nodes = [{"children": [1, 2]}, {"children": [3, 4]}, {"mesh": 0}, {"mesh": 0}, {"mesh": 0}]
        for index, node in enumerate(nodes):
            quaternion = generator.normal(size=4)
            node["name"] = f"node {index}"
            node["translation"] = generator.normal(size=3).tolist()
            node["rotation"] = (quaternion / np.linalg.norm(quaternion)).tolist()
            node["scale"] = generator.uniform(0.5, 2, size=3).tolist()
        path = write(tmp_path, "tree.glb", glb_bytes(*gltf_document(nodes=nodes)))
        mesh, scene = load_mesh(path), trimesh.load_scene(path, process=False)
        assert sorted(part.name for part in mesh.parts) == sorted(scene.graph.nodes_geometry)
        for part in mesh.parts:
            matrix, geometry = scene.graph[part.name]
            expected = scene.geometry[geometry].vertices @ matrix[:3, :3].T + matrix[:3, 3]
            found = mesh.vertices[part.first_vertex : part.first_vertex + part.num_vertices]
            np.testing.assert_allclose(found, expected, atol=1e-12)

    @pytest.mark.parametrize("form", ["stl", "stl_ascii"])
    def test_stl_agrees_with_a_second_writer(self, tmp_path, form):
        sphere = trimesh.creation.icosphere(subdivisions=2)
        data = sphere.export(file_type=form)
        mesh = load_mesh(write(tmp_path, "sphere.stl", data))
        corners = sphere.vertices[sphere.faces].reshape(-1, 3)
        np.testing.assert_allclose(mesh.vertices, corners, atol=1e-7)

    def test_ascii_stl_of_several_solids_is_not_welded(self, tmp_path):
        facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
        solid = "solid vertex\n" + 2 * (facet + "endloop\nendfacet\n") + "endsolid vertex\n"
        mesh = load_mesh(write(tmp_path, "two.stl", solid * 2))
        assert mesh.num_points == 12
        assert mesh.num_faces == 4

    def test_vertex_colours_are_decoded_from_srgb(self, tmp_path):
        text = ply_bytes(polygons=CUBE_QUADS.tolist()).decode()
        text = text.replace(
            "property double z\n",
            "property double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n",
        )
        head, body = text.split("end_header\n")
        rows = [f"{row} 255 188 0" if k < 8 else row for k, row in enumerate(body.splitlines())]
        mesh = load_mesh(write(tmp_path, "c.ply", head + "end_header\n" + "\n".join(rows) + "\n"))
        # sRGB 188 is half of the light.
        np.testing.assert_allclose(mesh.albedo, np.tile([1.0, 0.5029, 0.0], (8, 1)), atol=1e-4)
        grey = load_mesh(tmp_path / "c.ply", albedo=(0.1, 0.2, 0.3))
        np.testing.assert_allclose(grey.albedo, np.tile([0.1, 0.2, 0.3], (8, 1)))

    def test_coff_and_obj_colours_agree(self, tmp_path):
        coff = [f"{x} {y} {z} 255 51 0 255" for x, y, z in CUBE_VERTICES]
        coff = "COFF\n8 6 0\n" + "\n".join(coff) + "\n"
        coff += "".join(f"4 {' '.join(map(str, p))}\n" for p in CUBE_QUADS)
        text = [f"v {x} {y} {z} 1 0.2 0" for x, y, z in CUBE_VERTICES]
        text += ["f " + " ".join(str(i + 1) for i in p) for p in CUBE_QUADS]
        a = load_mesh(write(tmp_path, "c.off", coff))
        b = load_mesh(write(tmp_path, "c.obj", "\n".join(text)))
        np.testing.assert_allclose(a.albedo, b.albedo, atol=1e-15)
        assert abs(float(a.albedo[0, 1]) - 0.0331) < 1e-4

    def test_polygons_become_fans(self, tmp_path):
        angles = np.arange(7) * 2 * math.pi / 7
        ring = np.stack([np.cos(angles), np.zeros(7), -np.sin(angles)], axis=1)
        mesh = load_mesh(write(tmp_path, "h.obj", obj_text(ring, [range(7)])))
        assert mesh.faces.tolist() == [[0, k, k + 1] for k in range(1, 6)]
        np.testing.assert_allclose(mesh.normals, np.tile([0.0, 1, 0], (7, 1)), atol=1e-15)


class TestPlacement:
    def test_z_up(self, tmp_path):
        path = write(tmp_path, "a.obj", obj_text([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]))
        mesh = load_mesh(path, up="z")
        np.testing.assert_allclose(mesh.normals, np.tile([0.0, 1, 0], (3, 1)), atol=1e-15)
        np.testing.assert_array_equal(mesh.vertices[2], [0, 0, -1])

    def test_transform_acts_on_columns_after_up_and_keeps_outsides(self, tmp_path):
        path = write(tmp_path, "a.obj", obj_text())
        matrix = np.diag([-2.0, 1, 1, 1])
        matrix[:3, 3] = 1, 2, 3
        matrix = matrix.tolist()
        mesh = load_mesh(path, transform=matrix)
        np.testing.assert_array_equal(mesh.vertices, CUBE_VERTICES * [-2, 1, 1] + [1, 2, 3])
        assert mesh.warnings == ()
        assert (mesh.normals * (mesh.vertices - torch.tensor([1, 2, 3]))).sum(dim=1).min() > 0

    @pytest.mark.parametrize(
        ("option", "message"),
        [
            ({"transform": np.zeros((4, 4)).tolist()}, "last row"),
            ({"transform": np.diag([1.0, 1, 0, 1]).tolist()}, "singular"),
            ({"transform": np.eye(3).tolist()}, "4 rows"),
            ({"transform": np.diag([1.0, math.nan, 1, 1]).tolist()}, "finite"),
            ({"albedo": (0.5, 1.5, 0.5)}, "scene.albedo"),
        ],
    )
    def test_bad_options(self, tmp_path, option, message):
        path = write(tmp_path, "a.obj", obj_text())
        with pytest.raises(InputError, match=message):
            load_mesh(path, **option)

    @pytest.mark.usefixtures("without_type_checker")
    @pytest.mark.parametrize("option", [{"up": "x"}, {"orientation": "inward"}])
    def test_unknown_choices(self, tmp_path, option):
        path = write(tmp_path, "a.obj", obj_text())
        with pytest.raises(InputError, match=f"scene.{next(iter(option))}=.*expected"):
            load_mesh(path, **option)


ONE_NAN = CUBE_VERTICES.copy()
ONE_NAN[3, 1] = math.nan
BEYOND, NEGATIVE = CUBE_QUADS.copy(), CUBE_QUADS.copy()
BEYOND[2, 1], NEGATIVE[4, 3] = 8, -1
ZERO_INDEX = obj_text().replace("f 1 2 4 3", "f 0 2 4 3")
GLTF, GLTF_BINARY = gltf_document()


def changed(path, value):
    """The good document with one entry replaced."""
    document = json.loads(json.dumps(GLTF))
    *keys, last = path
    entry = document
    for key in keys:
        entry = entry[key]
    entry[last] = value
    return glb_bytes(document, GLTF_BINARY)


BAD_FILES = {
    "empty.obj": ("", "empty"),
    "words.obj": ("v 1 2 x\n", "line 1: .*x"),
    "short.obj": ("v 1 2\n", "line 1: .*3 coordinates"),
    "cloud.obj": ("v 0 0 0\n", "no faces; a point cloud"),
    "nothing.obj": ("# empty\n", "no vertices"),
    "nan.obj": (obj_text(ONE_NAN), "1 of 8 vertices are not finite, the first is vertex 4$"),
    "huge.obj": (obj_text(CUBE_VERTICES * 1e150), "1e\\+150 is beyond"),
    "zero.obj": (ZERO_INDEX, "1 vertex ind.* is 0 in face 1 .vertices are 1 to 8"),
    "beyond.obj": (obj_text(polygons=BEYOND), "is 9 in face 3 .vertices are 1 to 8"),
    "relative.obj": (obj_text() + "f -9 -1 -2\n", "is -9 in face 7"),
    "cut.obj": (obj_text()[:-5], "line 14: a face needs at least 3 corners"),
    "normal.obj": (obj_text() + "f 1//1 2//1 3//1\n", "line 15: normal 1 does not exist"),
    "index.obj": (obj_text() + "f 1 2 3.5\n", "line 15"),
    "wrong.ply": (b"PK\3\4", "not a PLY"),
    "header.ply": (ply_bytes()[:60], "header is cut off"),
    "format.ply": (ply_bytes().replace(b"ascii", b"binary"), "format binary 1.0"),
    "type.ply": (ply_bytes().replace(b"uchar int", b"uchar string"), "string"),
    "cloud.ply": (ply_bytes(polygons=[]), "point cloud"),
    "nan.ply": (ply_bytes(ONE_NAN), "1 of 8 .* the first is vertex 3$"),
    "beyond.ply": (ply_bytes(polygons=BEYOND), "is 8 in face 2 .vertices are 0 to 7"),
    "negative.ply": (ply_bytes(polygons=NEGATIVE, order="<"), "is -1 in face 4"),
    "fraction.ply": (ply_bytes().replace(b"7 4 0 1 3 2", b"7 4 0 1 3.5 2"), "3.5 is not a vertex"),
    "edge.ply": (ply_bytes(polygons=[[0, 1]]), "fewer than 3 corners, the first is face 0"),
    "cut_ascii.ply": (ply_bytes()[:-4], "claims 6 of element 'face'.* number 5"),
    "cut_binary.ply": (ply_bytes(order=">")[:-1], "claims 6 of element 'face'.* number 5"),
    "length.ply": (ply_bytes().replace(b"\n7 4 0 1", b"\n7 -4 0 1"), "-4.* is not a length"),
    "many_vertices.ply": (ply_bytes(order="<", vertex_count=10**15), "claims 10+ of"),
    "many_faces.ply": (ply_bytes(order="<", face_count=10**15), "claims 10+ of"),
    "many_ascii.ply": (ply_bytes(face_count=10**15), "claims 10+ of"),
    "wrong.off": ("FOO\n", "expected OFF"),
    "counts.off": ("OFF\na b c\n", "expected the numbers"),
    "cloud.off": (off_text(polygons=[]), "point cloud"),
    "nan.off": (off_text(ONE_NAN), "the first is vertex 3$"),
    "beyond.off": (off_text(polygons=BEYOND), "is 8 in face 2"),
    "negative.off": (off_text(polygons=NEGATIVE), "is -1 in face 4"),
    "cut.off": (off_text()[:-11], "claims 8 vertices and 6 faces, but only 13 lines"),
    "cut_line.off": (off_text()[:-3], "face 5: claims 4 corners, 3 numbers"),
    "many.off": ("OFF\n99999999999999 1 0\n0 0 0\n", "claims 9+ vertices"),
    "short.stl": (b"\0" * 50, "truncated"),
    "cloud.stl": (stl_bytes([]), "no vertices"),
    "nan.stl": (stl_bytes(ONE_NAN[CUBE_FACES]), "vertices are not finite"),
    "cut.stl": (stl_bytes(CUBE_VERTICES[CUBE_FACES])[:-1], "claims 12 triangles.* 684 .* 683"),
    "many.stl": (stl_bytes([], count=2**32 - 1), "claims 4294967295 triangles"),
    "cut_ascii.stl": ("solid x\nfacet\nouter loop\nvertex 0 0 0\n", "endsolid is missing"),
    "cut_solid.stl": (
        "solid x\nendsolid\nsolid y\n" + "vertex 0 0 0\n" * 99,
        "endsolid is missing",
    ),
    "moved.stl": ("solid x\nvertex 0 0\nvertex 0 1 1 1\nvertex 1 2 3\nendsolid\n", "line 2"),
    "words.stl": ("solid x\nvertex 0 0 a\nendsolid\n", "line 2"),
    "cut.glb": (glb_bytes(GLTF, GLTF_BINARY)[:-9], "truncated"),
    "chunk.glb": (glb_bytes(GLTF, GLTF_BINARY, length=660), "chunk b'.*' claims"),
    "json.gltf": ("{", "JSON cannot be read"),
    "list.gltf": ("[]", "not a valid glTF"),
    "cloud.glb": (changed(["meshes", 0, "primitives", 0, "mode"], 0), "no vertices"),
    "strip.glb": (changed(["meshes", 0, "primitives", 0, "mode"], 5), "strips"),
    "fan.glb": (changed(["meshes", 0, "primitives", 0, "mode"], 6), "fans"),
    "parents.glb": (changed(["scenes", 0, "nodes"], [0, 0]), "two parents"),
    "negative_node.glb": (changed(["scenes", 0, "nodes"], [-1]), r"nodes\[-1\]"),
    "negative_accessor.glb": (
        changed(["meshes", 0, "primitives", 0, "indices"], -1),
        r"accessors\[-1\]",
    ),
    "many.glb": (changed(["accessors", 0, "count"], 10**12), "claims 10+ items"),
    "view.glb": (changed(["bufferViews", 1, "byteLength"], 10**12), r"accessors\[1\]|claims"),
    "buffer.glb": (changed(["buffers", 0, "byteLength"], 10**12), r"buffers\[0\] claims"),
    "offset.glb": (changed(["accessors", 0, "byteOffset"], -4), "negative"),
    "outside.glb": (changed(["buffers", 0, "uri"], "../secret.bin"), "outside the scene"),
    "draco.glb": (
        changed(["extensionsRequired"], ["KHR_draco_mesh_compression"]),
        "KHR_draco_mesh_compression",
    ),
    "cycle.glb": (changed(["nodes", 0, "children"], [0]), "own ancestor"),
    "nan.glb": (glb_bytes(*gltf_document(ONE_NAN)), "the first is vertex 3$"),
    "beyond.glb": (
        glb_bytes(*gltf_document(faces=np.where(CUBE_FACES == 7, 9, CUBE_FACES))),
        r"accessors\[1\]: \d+ indices are out of range, the first is 9 at \d+, of 8 vertices",
    ),
    "texture.obj": (
        obj_text() + "vt 0 0\nf 1/1 2/2 3/1\n",
        "line 16: texture coordinate 2 does not exist .1 so far",
    ),
    "vt.obj": (obj_text() + "vt\n", "texture coordinates need at least 1 number"),
    "sparse.glb": (changed(["accessors", 0, "sparse"], {}), "sparse"),
    "mesh.blend": ("x", "unknown mesh format"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_file_is_one_line_that_names_it(tmp_path, name):
    content, pattern = BAD_FILES[name]
    path = write(tmp_path, name, content)
    with pytest.raises(InputError, match=pattern) as caught:
        load_mesh(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(InputError, match=r"absent.obj: no such mesh file"):
        load_mesh(tmp_path / "absent.obj")
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        load_mesh(tmp_path / "folder.obj")


@pytest.mark.parametrize("suffix", ["obj", "ply", "off", "stl", "glb"])
def test_no_damaged_file_raises_anything_else(tmp_path, suffix):
    """Cut and altered files either load or are refused in one line."""
    good = {
        "obj": obj_text().encode(),
        "ply": ply_bytes(order="<"),
        "off": off_text().encode(),
        "stl": stl_bytes(CUBE_VERTICES[CUBE_FACES]),
        "glb": glb_bytes(GLTF, GLTF_BINARY),
    }[suffix]
    generator = np.random.default_rng(0)
    messages = []
    for trial in range(150):
        data = bytearray(good)
        for _ in range(generator.integers(1, 4)):
            data[generator.integers(len(data))] = generator.integers(256)
        if trial % 3 == 0:
            data = data[: generator.integers(1, len(data))]
        path = write(tmp_path, f"damaged.{suffix}", bytes(data))
        try:
            mesh = load_mesh(path)
        except InputError as error:
            messages.append(str(error))
        else:
            assert torch.isfinite(mesh.vertices).all()
            assert int(mesh.faces.min()) >= 0
            assert int(mesh.faces.max()) < mesh.num_points
    assert len(messages) > 40
    assert not any("\n" in message for message in messages)


class TestJoining:
    def test_concatenate_offsets_everything(self):
        open_cube = cube(shift=5.0, faces=CUBE_FACES[1:])
        both = concatenate([cube(), open_cube, open_cube], "three")
        assert both.num_points == 24
        assert both.num_faces == 34
        assert [(p.first_vertex, p.first_face, p.num_faces) for p in both.parts] == [
            (0, 0, 12),
            (8, 12, 11),
            (16, 23, 11),
        ]
        assert torch.equal(both.vertices[both.faces[12:23]], open_cube.vertices[open_cube.faces])
        assert names(both) == {"open_boundary": 6}
        assert both.warnings[0].message.startswith("6 ")

    def test_concatenate_needs_a_mesh(self):
        with pytest.raises(ValueError, match="at least one"):
            concatenate([], "none")

    def test_bounds_leave_isolated_vertices_out(self):
        vertices = torch.tensor(np.concatenate([CUBE_VERTICES, [[99.0, 0, 0]]]))
        mesh = mesh_from_arrays("cube", vertices, torch.tensor(CUBE_FACES))
        assert mesh.bounds.tolist() == [[-1, -1, -1], [1, 1, 1]]
        assert mesh.extent == pytest.approx(math.sqrt(12))

    def test_arrays_are_checked(self):
        with pytest.raises(InputError, match=r"cube: .*is 8 in face"):
            cube(faces=np.where(CUBE_FACES == 7, 8, CUBE_FACES))
        with pytest.raises(InputError, match="albedos lie outside 0 to 1"):
            mesh_from_arrays(
                "cube",
                torch.tensor(CUBE_VERTICES),
                torch.tensor(CUBE_FACES),
                albedo=torch.full((8, 3), -0.1),
            )


REAL = {
    # vertices, faces and warnings as the assets' own table has them
    "armadillo_libigl.obj": (43243, 86482, {}),
    "bunny_closed.obj": (29834, 59664, {}),
    "bunny_zipper.ply": (35947, 69451, {"isolated_vertices": 1113, "open_boundary": 223}),
    "horse.ply": (48485, 96966, {"inward_normals": 96966}),
    "spot_hr.obj": (11533, 23062, {"split_normals": 11533}),
    "suzanne.obj": (
        507,
        968,
        {"duplicate_faces": 1, "open_boundary": 42, "non_manifold_edges": 1},
    ),
    "teapot_tess.ply": (25201, 49952, {"open_boundary": 448}),
}


@pytest.mark.parametrize("name", REAL)
def test_real_mesh(assets, name):
    vertices, faces, warnings = REAL[name]
    mesh = load_mesh(assets / "meshes" / name)
    assert (mesh.num_points, mesh.num_faces) == (vertices, faces)
    assert names(mesh) == warnings
    lengths = mesh.normals.norm(dim=1)
    assert int((lengths == 0).sum()) == warnings.get("isolated_vertices", 0)
    np.testing.assert_allclose(lengths[lengths > 0], 1.0, atol=1e-14)
    other = trimesh.load(assets / "meshes" / name, process=False, maintain_order=True)
    np.testing.assert_allclose(mesh.vertices, other.vertices, rtol=1e-6)
    assert {tuple(sorted(f)) for f in mesh.faces.tolist()} == {
        tuple(sorted(f)) for f in other.faces.tolist()
    }


CORNER_UV = np.random.default_rng(7).uniform(-0.5, 1.5, (8, 2))


class TestTextureCoordinates:
    def obj(self, corners=CUBE_QUADS, start=""):
        lines = [f"vt {u!r} {v!r}" for u, v in CORNER_UV.tolist()]
        faces = [
            "f " + " ".join(f"{i + 1}/{(i + k) % 8 + 1}" for i in q) for k, q in enumerate(corners)
        ]
        return start + obj_text(polygons=[]) + "\n".join([*lines, *faces, ""])

    def expected(self):
        quads = np.stack([CORNER_UV[(quad + k) % 8] for k, quad in enumerate(CUBE_QUADS)])
        return np.stack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]], axis=1).reshape(-1, 3, 2)

    def test_obj_seams_split_no_point(self, tmp_path):
        mesh = load_mesh(write(tmp_path, "a.obj", self.obj()))
        assert mesh.num_points == 8
        np.testing.assert_array_equal(mesh.uv, self.expected())

    def test_they_stay_at_their_corners_under_flips_and_mirrors(self, tmp_path):
        path = write(tmp_path, "a.obj", self.obj())
        plain = load_mesh(path)
        at = {
            tuple(point): coordinates
            for face, uv in zip(plain.faces.tolist(), plain.uv.tolist(), strict=True)
            for point, coordinates in zip([(f, tuple(face)) for f in face], uv, strict=True)
        }
        mirror = np.diag([-1.0, 1, 1, 1]).tolist()
        for options in ({"orientation": "flip"}, {"transform": mirror}):
            mesh = load_mesh(path, **options)
            assert not torch.equal(mesh.faces, plain.faces)
            for face, uv in zip(mesh.faces.tolist(), mesh.uv.tolist(), strict=True):
                winding = (face[0], face[2], face[1])
                assert [at[(f, winding)] for f in face] == uv

    def test_faces_that_lack_one_have_none_and_are_counted(self, tmp_path):
        text = self.obj().replace("f 1/1 ", "f 1 ")
        mesh = load_mesh(write(tmp_path, "a.obj", text))
        assert mesh.uv is not None
        expected = self.expected()
        expected[:2] = np.nan
        np.testing.assert_array_equal(mesh.uv, expected)
        assert names(mesh) == {"missing_uv": 2}
        text = text.replace(f"vt {CORNER_UV[5, 0].item()!r}", "vt nan")
        assert names(load_mesh(write(tmp_path, "b.obj", text)))["missing_uv"] > 2
        assert load_mesh(write(tmp_path, "c.obj", obj_text())).uv is None

    @pytest.mark.parametrize("properties", [("s", "t"), ("u", "v"), ("texture_u", "texture_v")])
    def test_ply_vertices(self, tmp_path, properties):
        head, body = ply_bytes(polygons=CUBE_QUADS.tolist()).decode().split("end_header\n")
        u, v = properties
        head = head.replace("double z\n", f"double z\nproperty float {u}\nproperty float {v}\n")
        rows = body.splitlines()
        rows[:8] = [f"{row} {u} {v}" for row, (u, v) in zip(rows[:8], CORNER_UV, strict=True)]
        text = head + "end_header\n" + "\n".join(rows) + "\n"
        mesh = load_mesh(write(tmp_path, "a.ply", text))
        np.testing.assert_array_equal(mesh.uv, CORNER_UV[mesh.faces])

    def test_gltf_runs_down_and_primitives_keep_their_own(self, tmp_path):
        document, binary = gltf_document(faces=CUBE_FACES[:4])
        rest = np.asarray(CUBE_FACES[4:], "<u2")
        attribute = {"componentType": 5123, "count": rest.size, "type": "SCALAR"}
        binary = add_accessor(document, binary, rest, attribute)
        codes = np.rint(CORNER_UV.clip(0, 1) * 65535).astype("<u2")
        attribute = {"componentType": 5123, "count": 8, "type": "VEC2", "normalized": True}
        binary = add_accessor(document, binary, codes, attribute)
        first = document["meshes"][0]["primitives"][0]
        attributes = {**first["attributes"], "TEXCOORD_0": 3}
        document["meshes"][0]["primitives"].append({"attributes": attributes, "indices": 2})
        document["nodes"][0]["scale"] = [1, -1, 1]
        mesh = load_mesh(write(tmp_path, "a.glb", glb_bytes(document, binary)))
        assert mesh.num_points == 8
        assert torch.isnan(mesh.uv[:4]).all()
        expected = (codes / 65535 * [1, -1] + [0, 1])[mesh.faces[4:]]
        np.testing.assert_allclose(mesh.uv[4:], expected, atol=1e-15)

    def test_arrays_and_joining(self):
        faces = torch.tensor(CUBE_FACES)
        uv = torch.rand(12, 3, 2, dtype=torch.float64)
        with_uv = mesh_from_arrays("a", torch.tensor(CUBE_VERTICES), faces, uv=uv)
        assert torch.equal(with_uv.uv, uv)
        both = concatenate([cube(), with_uv], "both")
        assert torch.isnan(both.uv[:12]).all()
        assert torch.equal(both.uv[12:], uv)
        assert concatenate([cube(), cube()], "none").uv is None

    @pytest.mark.usefixtures("without_type_checker")
    def test_arrays_must_fit(self):
        uv = torch.zeros(11, 3, 2, dtype=torch.float64)
        with pytest.raises(ValueError, match=r"shape \(12, 3, 2\), got \(11, 3, 2\)"):
            mesh_from_arrays("a", torch.tensor(CUBE_VERTICES), torch.tensor(CUBE_FACES), uv=uv)


class TestGroupsOfAnOBJ:
    LINES = """
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 2 0 0
v 2 1 0
{start}f 1 2 3 4
{middle}f 2 5 6 3
f 2 5 6
"""

    def parts(self, tmp_path, start, middle):
        path = tmp_path / "groups.obj"
        path.write_text(self.LINES.format(start=start, middle=middle))
        mesh = load_mesh(path)
        return [
            (p.name, p.first_vertex, p.num_vertices, p.first_face, p.num_faces) for p in mesh.parts
        ]

    def test_materials(self, tmp_path):
        found = self.parts(tmp_path, "o all\nusemtl dull red\n", "g ignored\nusemtl shiny\n")
        assert found == [("dull red", 0, 4, 0, 2), ("shiny", 1, 5, 2, 3)]

    def test_groups_and_objects(self, tmp_path):
        assert self.parts(tmp_path, "", "g wing\n") == [
            ("unnamed", 0, 4, 0, 2),
            ("wing", 1, 5, 2, 3),
        ]
        assert self.parts(tmp_path, "o\no body\n", "") == [("body", 0, 6, 0, 5)]
        assert self.parts(tmp_path, "", "") == [("groups", 0, 6, 0, 5)]
