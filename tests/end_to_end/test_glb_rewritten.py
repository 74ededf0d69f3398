# SPDX-License-Identifier: Apache-2.0
"""Baked glbs that another program wrote anew: interleaved, in other nodes, views and buffers, quantised."""

from __future__ import annotations

import base64
import json
import shlex
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssilk_core.cli import main
from ssilk_core.delivery.gltf.channel import CUBIC, NodeChannel
from ssilk_core.delivery.gltf.play import GlbShot

CODES = {"i1": 5120, "u1": 5121, "<i2": 5122, "<u2": 5123, "<u4": 5125, "<f4": 5126}
TYPES = {code: name for name, code in CODES.items()}
WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
NAMES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
QUANTIZED = "KHR_mesh_quantization"


def run(words: str) -> int:
    return main(shlex.split(words))


@pytest.fixture(scope="module")
def world(glb_world):
    return glb_world


def parts(path: str) -> tuple[dict[str, Any], bytes]:
    data = Path(path).read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def dense(document: dict[str, Any], buffer: bytes, index: int) -> np.ndarray:
    """An accessor of a file that was baked: one buffer, tight views."""
    item = document["accessors"][index]
    width, kind = WIDTH[item["type"]], TYPES[item["componentType"]]

    def view(number: int, of: str, count: int) -> np.ndarray:
        return np.frombuffer(buffer, of, count, document["bufferViews"][number]["byteOffset"])

    values = np.zeros((item["count"], width), kind)
    if "bufferView" in item:
        values[:] = view(item["bufferView"], kind, values.size).reshape(values.shape)
    if sparse := item.get("sparse"):
        rows = view(sparse["indices"]["bufferView"], TYPES[sparse["indices"]["componentType"]], sparse["count"])
        values[rows] = view(sparse["values"]["bufferView"], kind, sparse["count"] * width).reshape(-1, width)
    return values


class Rewriter:
    """Writes a baked glb anew, as the specification allows it."""

    def __init__(self, path: str, quantized: bool) -> None:
        self.document, self.buffer = parts(path)
        self.arrays = [dense(self.document, self.buffer, index) for index in range(len(self.document["accessors"]))]
        self.quantized, self.accessors, self.views = quantized, [], []
        self.data = [bytearray(16), bytearray(8)]  # the second buffer is in the document

    def view(self, data: bytes, buffer: int, **more: int) -> int:
        place = {"buffer": buffer, "byteOffset": len(self.data[buffer]), "byteLength": len(data)}
        self.data[buffer] += data + bytes(-len(data) % 4)
        self.views.append({**place, **more})
        return len(self.views) - 1

    def accessor(self, values: np.ndarray, view: int, **more: object) -> int:
        kind = CODES[next(name for name in CODES if np.dtype(name) == values.dtype)]
        shape = {"count": len(values), "type": NAMES[values.shape[1]]}
        self.accessors.append({"bufferView": view, "componentType": kind, **shape, **more})
        return len(self.accessors) - 1

    def tight(self, values: np.ndarray, buffer: int = 0) -> int:
        return self.accessor(values, self.view(np.ascontiguousarray(values).tobytes(), buffer))

    def interleaved(self, attributes: dict[str, tuple[np.ndarray, bool]]) -> dict[str, int]:
        """Add attributes of vertices, each normalized or not, in one view."""
        widths = [values.shape[1] * values.itemsize for values, _ in attributes.values()]
        starts = np.cumsum([0] + [width + -width % 4 for width in widths])
        rows = np.zeros((len(next(iter(attributes.values()))[0]), int(starts[-1])), np.uint8)
        for (values, _), start, width in zip(attributes.values(), starts, widths):
            rows[:, start : start + width] = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), width)
        view = self.view(rows.tobytes(), 0, byteStride=int(starts[-1]), target=34962)
        return {
            name: self.accessor(values, view, byteOffset=int(start), **({"normalized": True} if whole else {}))
            for (name, (values, whole)), start in zip(attributes.items(), starts)
        }

    def mesh(self, mesh: dict[str, Any], binds: np.ndarray) -> np.ndarray:
        """Rewrite a mesh; return its inverse bind matrices, which undo what quantisation does to it."""
        (primitive,) = mesh["primitives"]
        named = {name: (self.arrays[index], False) for name, index in primitive["attributes"].items()}
        offsets = [self.arrays[target["POSITION"]] for target in primitive.get("targets", ())]
        undo = np.eye(4)
        if self.quantized:
            points = named["POSITION"][0].astype(np.float64)
            centre, size = (points.max(0) + points.min(0)) / 2, np.ptp(points, axis=0).max() / 2
            undo[:3, :3], undo[:3, 3] = size * np.eye(3), centre
            named["POSITION"] = (np.round((points - centre) / size * 32767).astype("<i2"), True)
            named["NORMAL"] = (np.round(named["NORMAL"][0] * 127).astype("i1"), True)
            for name in [name for name in named if name.startswith("WEIGHTS")]:
                named[name] = (np.round(named[name][0] * 65535).astype("<u2"), True)
            offsets = [np.round(offset / size * 32767).astype("<i2") for offset in offsets]
        primitive["attributes"] = self.interleaved(named)
        primitive["indices"] = self.tight(self.arrays[primitive["indices"]].astype("<u4"))
        if offsets:
            primitive["targets"] = [self.interleaved({"POSITION": (each, self.quantized)}) for each in offsets]
        return binds @ undo

    def write(self, path: str) -> None:
        document, count = self.document, len(self.document["nodes"])
        (skin,), (animation,) = document["skins"], document["animations"]
        binds = self.arrays[skin["inverseBindMatrices"]].reshape(-1, 4, 4).swapaxes(1, 2)
        joints, skins = [count - 1 - joint for joint in skin["joints"]], []
        for node in document["nodes"]:
            node["children"] = [count - 1 - child for child in node.get("children", ())]
            if "mesh" in node:
                own = self.mesh(document["meshes"][node["mesh"]], binds).swapaxes(1, 2).reshape(-1, 16)
                node["skin"] = len(skins)
                skins.append({"joints": joints, "inverseBindMatrices": self.tight(own.astype("<f4"))})
        document["skins"], document["nodes"] = skins, document["nodes"][::-1]
        document["scenes"] = [{"nodes": [count - 1 - node for node in document["scenes"][0]["nodes"]]}]
        for channel in animation["channels"]:
            channel["target"]["node"] = count - 1 - channel["target"]["node"]
        for sampler in animation["samplers"]:
            del sampler["interpolation"]  # linear is the default
            sampler |= {name: self.tight(self.arrays[sampler[name]], buffer=1) for name in ("input", "output")}
        document["accessors"], document["bufferViews"] = self.accessors, self.views
        held = f"data:application/octet-stream;base64,{base64.b64encode(self.data[1]).decode()}"
        document["buffers"] = [{"byteLength": len(self.data[0])}, {"byteLength": len(self.data[1]), "uri": held}]
        document["asset"]["generator"] = "another program"
        if self.quantized:
            document["extensionsUsed"] = document["extensionsRequired"] = [QUANTIZED]
        write(path, document, bytes(self.data[0]))


def write(path: str, document: dict[str, Any], data: bytes) -> None:
    text = json.dumps(document).encode()
    text, data = text + b" " * (-len(text) % 4), data + bytes(-len(data) % 4)
    chunks = [(b"JSON", text), (b"BIN\0", data), (b"XTRA", bytes(4))]
    body = b"".join(struct.pack("<I4s", len(part), kind) + part for kind, part in chunks)
    Path(path).write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)


def away(one: GlbShot, other: GlbShot) -> float:
    """How far meshes of two shots are from each other at most [m], at frames and between them."""
    pairs = [(one.points(time), other.points(time)) for time in (*one.frame_times, 2.5)]
    by_name = [dict(zip([mesh.name for mesh in shot.meshes], range(9))) for shot in (one, other)]
    return max(
        float(np.abs(a[by_name[0][name]] - b[by_name[1][name]]).max()) for a, b in pairs for name in by_name[0]
    )


def test_a_file_that_was_written_anew_is_played_and_verified(copy):
    Rewriter("all.glb", quantized=False).write("anew.glb")
    before, after = GlbShot("all.glb"), GlbShot("anew.glb")
    assert away(before, after) < 1e-7 and after.frame_times == before.frame_times
    faces = {mesh.name: mesh.faces for mesh in before.meshes}
    assert [mesh.name for mesh in after.meshes] == [mesh.name for mesh in before.meshes][::-1]
    for mesh in after.meshes:
        np.testing.assert_array_equal(mesh.faces, faces[mesh.name])
    assert run("verify anew.glb") == 0
    assert run("view anew.glb -o anew.png --columns 2 --size 64x64") == 0


def test_a_quantised_file_is_played_and_verify_says_how_far_it_is_off(copy, capsys):
    Rewriter("all.glb", quantized=True).write("anew.glb")
    before, after = GlbShot("all.glb"), GlbShot("anew.glb")
    assert 1e-6 < away(before, after) < 2e-4  # 1.7 m in 65,535 steps, weights as well
    assert run("view anew.glb -o anew.png --columns 2 --size 64x64") == 0
    capsys.readouterr()
    assert run("verify anew.glb") == 3
    assert "m from where the decoder has it" in (said := capsys.readouterr().err)
    assert "another program wrote it anew, and may have stored vertices as integers, which rounds them" in said
    document, data = parts("all.glb")
    at = document["bufferViews"][document["accessors"][0]["bufferView"]]["byteOffset"]  # of inverse bind matrices
    document["asset"]["generator"] = "Exporter 2"
    write("anew.glb", document, data[: at + 48] + struct.pack("<f", 0.5) + data[at + 52 :])
    assert run("verify anew.glb") == 3
    said = capsys.readouterr().err
    assert "Exporter 2 wrote it anew, and may have reordered vertices or dropped keys: verify it before" in said


@pytest.mark.parametrize("verb", ["verify {}", "view {} -o anew.png"])
@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"extensionsRequired": ["EXT_meshopt_compression"]}, "needs the extension EXT_meshopt_compression"),
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "plain glTF 2.0 and KHR_mesh_quantization are"),
        ({"buffers": [{"byteLength": 8, "uri": "data.bin"}]}, "buffer 0 is in another file"),
        ({"asset": {"version": "2.0"}}, "no times of a shot in its asset.extras"),
    ],
)
def test_what_is_not_read_is_told_by_name(copy, capsys, change, says, verb):
    document, data = parts("all.glb")
    write("anew.glb", document | change, data)
    assert run(verb.format("anew.glb")) == 2
    assert says in capsys.readouterr().err


def test_splines_are_what_their_tangents_say():
    def cubic(t: np.ndarray) -> np.ndarray:
        return np.stack([t**3 - t, 2 * t**2, 1 - t], axis=-1)

    def slope(t: np.ndarray) -> np.ndarray:
        return np.stack([3 * t**2 - 1, 4 * t, -np.ones_like(t)], axis=-1)

    times = np.array([0.0, 0.5, 2.0])
    channel = NodeChannel(0, "translation", times, np.stack([slope(times), cubic(times), slope(times)], 1), CUBIC)
    for time in np.linspace(0, 2, 9):
        np.testing.assert_allclose(channel.at(time), cubic(np.array(time)), atol=1e-12)
    np.testing.assert_array_equal(channel.at(5.0), channel.at(2.0))
