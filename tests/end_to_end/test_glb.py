# SPDX-License-Identifier: Apache-2.0
"""Bakes as glTF binaries in a small reader of the test's own, which deforms them as the specification says."""

from __future__ import annotations

import json
import shlex
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdSkel, Vt
from ssilk_usd.reading.mesh import read_mesh
from ssilk_usd.shots.play import Shot

from ssilk_core.cli import main
from ssilk_core.delivery.gltf.geometry import ShapeNormals, drawn_mesh
from ssilk_core.delivery.gltf.play import GlbShot
from ssilk_core.scene.assets import Mesh

TOLERANCE = 1e-5  # [m]
TYPES = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Reader:
    """A glb: its JSON, and its accessors as float64 arrays."""

    def __init__(self, path: str) -> None:
        data = Path(path).read_bytes()
        assert data[:4] == b"glTF" and struct.unpack_from("<II", data, 4) == (2, len(data))
        (length,) = struct.unpack_from("<I", data, 12)
        assert data[16:20] == b"JSON" and length % 4 == 0
        self.json = json.loads(data[20 : 20 + length])
        size, kind = struct.unpack_from("<I4s", data, 20 + length)
        assert kind == b"BIN\0" and 28 + length + size == len(data)
        assert self.json["buffers"] == [{"byteLength": size}]
        self.buffer = data[28 + length :]

    def view(self, index: int, component: int, count: int) -> np.ndarray:
        view = self.json["bufferViews"][index]
        assert view["byteOffset"] % 4 == 0 and np.dtype(TYPES[component]).itemsize * count == view["byteLength"]
        return np.frombuffer(self.buffer, TYPES[component], count, view["byteOffset"])

    def __getitem__(self, index: int) -> np.ndarray:
        item = self.json["accessors"][index]
        count, width, component = item["count"], WIDTH[item["type"]], item["componentType"]
        values = np.zeros((count, width))
        if "bufferView" in item:
            values[:] = self.view(item["bufferView"], component, count * width).reshape(count, width)
        if sparse := item.get("sparse"):
            rows = self.view(sparse["indices"]["bufferView"], sparse["indices"]["componentType"], sparse["count"])
            assert (np.diff(rows.astype(int)) > 0).all()
            new = self.view(sparse["values"]["bufferView"], component, sparse["count"] * width)
            values[rows] = new.reshape(-1, width)
        if "min" in item:
            assert values.min(axis=0).tolist() == item["min"] and values.max(axis=0).tolist() == item["max"]
        return values

    def frame(self, number: int) -> dict[tuple[int, str], np.ndarray]:
        """What the animation says of each node at its key of this number."""
        (animation,) = self.json["animations"]
        found = {}
        for channel in animation["channels"]:
            sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
            times = self[sampler["input"]]
            assert (np.diff(times[:, 0]) > 0).all() and times[0, 0] >= 0
            if sampler["interpolation"] == "LINEAR":
                found[target["node"], target["path"]] = self[sampler["output"]].reshape(len(times), -1)[number]
        return found

    def world(self, number: int) -> list[np.ndarray]:
        """Transforms of the nodes, columns as vectors."""
        nodes, moved = self.json["nodes"], self.frame(number)
        above = {child: index for index, node in enumerate(nodes) for child in node.get("children", ())}

        def place(index: int) -> np.ndarray:
            node = nodes[index]
            x, y, z, w = moved.get((index, "rotation"), node.get("rotation", (0, 0, 0, 1)))
            own = np.eye(4)
            own[:3, :3] = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                           [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                           [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]  # fmt: skip
            own[:3, 3] = moved.get((index, "translation"), node.get("translation", (0, 0, 0)))
            return place(above[index]) @ own if index in above else own

        return [place(index) for index in range(len(nodes))]

    def skinned(self, name: str, number: int) -> np.ndarray:
        """Vertices of a mesh [m] at a key of the animation."""
        ((index, node),) = [(i, each) for i, each in enumerate(self.json["nodes"]) if each["name"] == name]
        mesh, skin = self.json["meshes"][node["mesh"]], self.json["skins"][node["skin"]]
        (primitive,) = mesh["primitives"]
        attributes = primitive["attributes"]
        points = self[attributes["POSITION"]]
        weights = self.frame(number).get((index, "weights"), ())
        assert len(weights) == len(primitive.get("targets", ()))
        for weight, target in zip(weights, primitive.get("targets", ())):
            points += weight * self[target["POSITION"]]
        binds = self[skin["inverseBindMatrices"]].reshape(-1, 4, 4).swapaxes(1, 2)
        world = self.world(number)
        matrices = np.stack([world[joint] @ bind for joint, bind in zip(skin["joints"], binds)])
        placed = np.concatenate([points, np.ones((len(points), 1))], axis=1)
        result, total = np.zeros_like(points), np.zeros(len(points))
        for number in range(sum(key.startswith("JOINTS_") for key in attributes)):
            joints, shares = self[attributes[f"JOINTS_{number}"]].astype(int), self[attributes[f"WEIGHTS_{number}"]]
            result += np.einsum("vk,vkab,vb->va", shares, matrices[joints], placed)[:, :3]
            total += shares.sum(axis=1)
        np.testing.assert_allclose(total, 1, atol=1e-6)
        return result


def run(words: str) -> int:
    return main(shlex.split(words))


@pytest.fixture(scope="module")
def world(glb_world, tmp_path_factory):
    """Bakes of the toy as glb (five influences in two sets), as glb4, and the same as stages of USD."""
    folder = shutil.copytree(glb_world, tmp_path_factory.mktemp("glb"), dirs_exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        bake = "bake model.safetensors --stage rigged.usda --motion sway.usda"
        assert run(f"{bake} --target glb4 -o four.glb") == 0
        assert run(f"{bake} -o all.usdc --no-verify") == 0
        assert run(f"{bake} --target game4 -o four.usdc --no-verify") == 0
    return folder


@pytest.mark.parametrize(("name", "sets"), [("all", 2), ("four", 1)])
def test_an_independent_reader_skins_body_and_garment_where_usd_does(copy, name, sets):
    glb, shot = Reader(f"{name}.glb"), Shot(f"{name}.usdc")
    (mesh,) = [mesh for mesh in glb.json["meshes"] if mesh["name"] == "Skirt"]
    (primitive,) = mesh["primitives"]
    assert sum(key.startswith("JOINTS_") for key in primitive["attributes"]) == sets
    assert len(mesh["extras"]["targetNames"]) == len(primitive["targets"]) > 0
    for frame, time in enumerate(shot.frame_times):
        for each, expected in zip(shot.meshes, shot.points(time)):
            assert np.abs(glb.skinned(each.name, frame) - expected).max() < TOLERANCE
    assert len(shot.frame_times) == 6


def test_triangles_and_normals_are_those_of_the_meshes(copy):
    glb, stage = Reader("all.glb"), Usd.Stage.Open("all.usdc")
    for mesh in glb.json["meshes"]:
        (primitive,) = mesh["primitives"]
        (prim,) = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh) and prim.GetName() == mesh["name"]]
        expected, attributes = read_mesh(prim, np.eye(4)), primitive["attributes"]
        np.testing.assert_array_equal(glb[primitive["indices"]].reshape(-1, 3), expected.faces)
        normals = glb[attributes["NORMAL"]]
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
        points = glb[attributes["POSITION"]]
        a, b, c = points[expected.faces].swapaxes(0, 1)
        crosses, around = np.cross(b - a, c - a), np.zeros_like(points)
        for corner in expected.faces.T:
            np.add.at(around, corner, crosses)
        np.testing.assert_allclose(normals, around / np.linalg.norm(around, axis=1)[:, None], atol=1e-5)


def test_normals_turn_with_the_shapes_as_differences_say():
    random = np.random.default_rng(0)
    points = np.stack([*np.mgrid[0:5, 0:5].reshape(2, -1), np.zeros(25)], axis=1) + 0.1 * random.normal(size=(25, 3))
    faces = np.array([[i, i + 5, i + 1] for i in range(19) if i % 5 < 4] + [[i + 1, i + 5, i + 6] for i in range(19)])
    offsets, step = random.normal(size=(25, 3)), 1e-5
    ahead, behind = (ShapeNormals(points + sign * step * offsets, faces).rest for sign in (1, -1))
    difference = (ahead - behind) / (2 * step)
    np.testing.assert_allclose(ShapeNormals(points, faces).change(offsets), difference, atol=1e-6)


def test_seams_of_the_texture_double_their_points_behind_all_others():
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0]])
    counts, corners = np.array([4, 3]), np.array([0, 1, 2, 3, 1, 4, 2])
    uvs = np.array([[0, 0], [0.5, 0], [0.5, 1], [0, 1], [0.6, 0], [1, 0], [0.5, 1]])
    mesh = Mesh("strip", points, np.array([[0, 1, 2], [0, 2, 3], [1, 4, 2]]), counts, corners, uvs)
    drawn = drawn_mesh(mesh)
    np.testing.assert_array_equal(drawn.source, [0, 1, 2, 3, 4, 1])
    np.testing.assert_array_equal(drawn.faces, [[0, 1, 2], [0, 2, 3], [5, 4, 2]])
    np.testing.assert_allclose(drawn.uvs, [[0, 1], [0.5, 1], [0.5, 0], [0, 0], [1, 1], [0.6, 1]], atol=1e-6)
    part = drawn_mesh(mesh, np.array([True, False]))
    np.testing.assert_array_equal(part.faces, [[1, 4, 2]])  # what is left needs no second coordinate


def test_colour_and_texture_coordinates_are_those_that_the_stage_has_by_now(copy):
    """Cloth is often unwrapped after it was trained; materials then read a set that the model does not know."""
    shutil.copy("rigged.usda", "unwrapped.usda")
    stage = Usd.Stage.Open("unwrapped.usda")
    cape = next(UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.HasAttribute("ssilk:proxyJoints"))
    corners = len(cape.GetFaceVertexIndicesAttr().Get())
    wanted = np.random.default_rng(5).random((corners, 2)).astype(np.float32)
    primvar = UsdGeom.PrimvarsAPI(cape).CreatePrimvar("map1", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
    primvar.Set(Vt.Vec2fArray.FromNumpy(wanted))
    cape.CreateDisplayColorAttr([(0.1, 0.2, 0.75)])
    stage.Save()
    assert run("bake model.safetensors --stage unwrapped.usda --motion sway.usda --target glb -o unwrapped.glb") == 0
    reader = Reader("unwrapped.glb")
    (mesh,) = [each for each in reader.json["meshes"] if each["name"] == cape.GetPrim().GetName()]
    found = reader[mesh["primitives"][0]["attributes"]["TEXCOORD_0"]] * [1, -1] + [0, 1]
    assert np.abs(found[:, None] - wanted).max(axis=-1).min(axis=1).max() < 1e-6
    material = reader.json["materials"][mesh["primitives"][0]["material"]]
    np.testing.assert_allclose(material["pbrMetallicRoughness"]["baseColorFactor"], [0.1, 0.2, 0.75, 1], atol=1e-6)
    assert len(np.unique(found, axis=0)) == len(np.unique(wanted, axis=0))


def test_verify_finds_a_key_that_was_changed_and_says_what_a_file_lacks(copy, capsys):
    assert run("verify all.glb") == 0
    data = bytearray(Path("all.glb").read_bytes())
    glb = Reader("all.glb")
    (animation,) = glb.json["animations"]
    at = next(each["sampler"] for each in animation["channels"] if each["target"]["path"] == "translation")
    view = glb.json["bufferViews"][glb.json["accessors"][animation["samplers"][at]["output"]]["bufferView"]]
    struct.pack_into("<f", data, len(data) - len(glb.buffer) + view["byteOffset"], 9.0)
    Path("bent.glb").write_bytes(data)
    assert run("verify bent.glb") == 3
    Path("cut.glb").write_bytes(data[:-4])
    capsys.readouterr()
    assert run("verify cut.glb") == 2 and "not a whole glb" in capsys.readouterr().err
    for right, wrong in ((b'"samplesPerFrame":1', b'"samplesPerFrame":0'), (b'"JOINTS_0"', b'"JOINTS_x"')):
        Path("odd.glb").write_bytes(Path("all.glb").read_bytes().replace(right, wrong))
        assert run("verify odd.glb") == 2 and "another or a damaged glb" in capsys.readouterr().err
    Path("other.glb").write_bytes(bytes(data).replace(b'"ssilk":', b'"sslik":'))
    assert run("verify other.glb") == 2 and "does not say how it was baked" in capsys.readouterr().err


def test_bytes_are_the_same_again_and_samples_between_frames_are_kept(copy):
    bake = "bake model.safetensors --stage rigged.usda --motion sway.usda --target glb"
    assert run(f"{bake} -o again.glb --no-verify") == 0
    assert Path("again.glb").read_bytes() == Path("all.glb").read_bytes()
    assert run(f"{bake} --range 1-3 --samples-per-frame 2 -o blur.glb") == 0 and run("verify blur.glb") == 0
    shot = GlbShot("blur.glb")
    assert shot.frame_times == (1.0, 2.0, 3.0) and shot.sample_times(2) == (1.0, 1.5, 2.0, 2.5, 3.0)
    assert shot.fps == 30 and len(Reader("blur.glb")[0]) > 0


def test_a_character_is_scaled_to_nothing_while_it_is_hidden(copy):
    stage = Usd.Stage.CreateNew("acted.usda")
    prim = UsdSkel.Root.Define(stage, "/Hero").GetPrim()
    prim.GetReferences().AddReference("rigged.usda", "/Hero")
    stage.DefinePrim("/Hero/Clip").GetReferences().AddReference("sway.usda", "/Clip")
    UsdSkel.BindingAPI.Apply(prim).CreateAnimationSourceRel().SetTargets(["/Hero/Clip"])
    for time, token in ((0, "inherited"), (2, "invisible"), (4, "inherited")):
        UsdGeom.Imageable(prim).CreateVisibilityAttr().Set(token, time)
    stage.SetTimeCodesPerSecond(30.0)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    stage.Save()
    del stage, prim
    assert run("bake model.safetensors --stage rigged.usda --motion acted.usda --target glb -o acted.glb") == 0
    glb = Reader("acted.glb")
    (animation,) = glb.json["animations"]
    (channel,) = [each for each in animation["channels"] if each["target"]["path"] == "scale"]
    assert glb.json["nodes"][channel["target"]["node"]]["children"] == [1]  # above all joints
    sampler = animation["samplers"][channel["sampler"]]
    assert sampler["interpolation"] == "STEP"
    np.testing.assert_allclose(glb[sampler["input"]][:, 0] * 30, [0, 2, 4], atol=1e-5)
    np.testing.assert_array_equal(glb[sampler["output"]][:, 0], [1, 0, 1])


def test_what_a_glb_cannot_hold_is_refused_and_what_viewers_miss_is_told(copy, capsys):
    bake = "bake model.safetensors --stage rigged.usda --motion sway.usda --no-verify"
    assert run(f"{bake} --target glb --refine 1 --refined-output points -o new.glb") == 2
    assert "a glb holds joints and morph targets" in capsys.readouterr().err
    assert run(f"{bake} --target glb -o new.usdc") == 2 and run(f"{bake} -o new.glb") == 2
    assert "usd takes .usdc, .usd, .usda, .usdz; --target glb or --target glb4 writes it" in capsys.readouterr().err
    assert run(f"{bake} --target glb -o layers") == 2 and "it takes .glb" in capsys.readouterr().err
    assert not list(Path().glob("*new*"))
    assert run(f"{bake} --target glb -o new.glb") == 0 and "--target glb4" in capsys.readouterr().err
