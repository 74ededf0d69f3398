# SPDX-License-Identifier: Apache-2.0
"""Indices of a glb below zero, which Python would count from the end of a list: each is refused."""

from __future__ import annotations

from functools import reduce
from pathlib import Path

import numpy as np
import pytest

from ssilk_core.delivery.gltf.container import GlbBuilder
from ssilk_core.delivery.gltf.play import GlbShot
from ssilk_core.delivery.gltf.skinned import SkinnedGlb
from ssilk_core.errors import SsilkError

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float32)


def triangle() -> GlbBuilder:
    """A garment of one triangle on two joints, with a sparse shape, that moves for a second."""
    glb = GlbBuilder()
    glb.document["asset"]["extras"] = {"timeCodesPerSecond": 30.0, "startTimeCode": 0.0, "samplesPerFrame": 1}
    rows = [glb._view(values, None) for values in (np.array([1], dtype="u1"), POINTS[2:])]
    sparse = {
        "count": 1,
        "indices": {"bufferView": rows[0], "componentType": 5120},
        "values": {"bufferView": rows[1]},
    }
    shape = glb.add("accessors", {"componentType": 5126, "count": 3, "type": "VEC3", "sparse": sparse})
    joints, shares = np.array([[1, 0, 0, 0]] * 3, dtype="u1"), np.array([[1, 0, 0, 0]] * 3, dtype="<f4")
    attributes = {
        "POSITION": glb.array(POINTS, "VEC3"),
        "JOINTS_0": glb.array(joints, "VEC4"),
        "WEIGHTS_0": glb.array(shares, "VEC4"),
    }
    faces = glb.array(np.arange(3, dtype="<u2"), "SCALAR")
    primitive = {"attributes": attributes, "indices": faces, "targets": [{"POSITION": shape}]}
    extras = {"points": 3, "kind": "garment"}
    glb.add("meshes", {"name": "Skirt", "primitives": [primitive], "weights": [0.5], "extras": extras})
    binds = glb.array(np.tile(np.eye(4, dtype="<f4").reshape(16), (2, 1)), "MAT4")
    for node in ({"children": [1, 2]}, {}, {"name": "Skirt", "mesh": 0, "skin": 0}):
        glb.add("nodes", node)
    glb.add("skins", {"joints": [0, 1], "inverseBindMatrices": binds})
    times, places = np.array([0, 1], dtype="<f4"), POINTS[:2]
    sampler = {"input": glb.array(times, "SCALAR"), "output": glb.array(places, "VEC3")}
    channel = {"sampler": 0, "target": {"node": 1, "path": "translation"}}
    glb.add("animations", {"samplers": [sampler], "channels": [channel]})
    return glb


def bake(path: Path) -> np.ndarray:
    """The garment at the end, read as a bake."""
    return GlbShot(path).garment_points(30.0)


def other(path: Path) -> np.ndarray:
    """The garment at the end, read as a file of any program."""
    return SkinnedGlb(path, "Skirt").vertices(1.0)


def test_the_file_is_one_that_is_played(tmp_path):
    triangle().write(tmp_path / "triangle.glb")
    for read in (bake, other):
        shown = read(tmp_path / "triangle.glb")
        np.testing.assert_allclose(shown, [[1, 0, 0], [2, 0.5, 0], [1, 1, 0]], atol=1e-6)


OF_KIND = {
    "bufferView": "bufferViews", "POSITION": "accessors", "JOINTS_0": "accessors", "inverseBindMatrices": "accessors",
    "output": "accessors", "mesh": "meshes", "skin": "skins", "node": "nodes", 0: "nodes",
}  # fmt: skip
PLACES: tuple[tuple[str | int, ...], ...] = (
    ("accessors", 1, "bufferView"),
    ("accessors", 0, "sparse", "indices", "bufferView"),
    ("accessors", 0, "sparse", "values", "bufferView"),
    ("bufferViews", 2, "buffer"),
    ("meshes", 0, "primitives", 0, "attributes", "POSITION"),
    ("meshes", 0, "primitives", 0, "attributes", "JOINTS_0"),
    ("meshes", 0, "primitives", 0, "targets", 0, "POSITION"),
    ("nodes", 0, "children", 0),
    ("nodes", 2, "mesh"),
    ("nodes", 2, "skin"),
    ("skins", 0, "joints", 0),
    ("skins", 0, "inverseBindMatrices"),
    ("animations", 0, "channels", 0, "sampler"),
    ("animations", 0, "channels", 0, "target", "node"),
    ("animations", 0, "samplers", 0, "output"),
)


@pytest.mark.parametrize("place", PLACES, ids=lambda place: ".".join(map(str, place)))
def test_an_index_below_zero_is_refused(tmp_path, place):
    """It is the index of the same item, counted from the end."""
    glb = triangle()
    holder = reduce(lambda inner, name: inner[name], place[:-1], glb.document)
    holder[place[-1]] -= len(glb.document[OF_KIND[place[-1]]]) if place[-1] in OF_KIND else 1
    assert holder[place[-1]] < 0
    glb.write(tmp_path / "odd.glb")
    for read in (bake, other):
        with pytest.raises(SsilkError, match=r"odd.glb: (another or )?a damaged glb \(IndexError: .* again\.$"):
            read(tmp_path / "odd.glb")


def test_numbers_below_zero_in_arrays_are_refused(tmp_path):
    """The row of a sparse accessor, the joint of a vertex, and how many points a bake has."""
    for which, value in ((0, 255), (3, 255), (None, -1)):
        glb = triangle()
        if which is None:
            glb.document["meshes"][0]["extras"]["points"] = value
        else:
            glb._parts[which] = bytes([value]) + glb._parts[which][1:]
        glb.document["accessors"][2]["componentType"] = 5120  # signed, as no file may have joints
        glb.write(tmp_path / "odd.glb")
        for read in (bake,) if which is None else (bake, other):
            with pytest.raises(SsilkError, match=r"odd.glb: (another or )?a damaged glb \((Index|Value)Error: "):
                read(tmp_path / "odd.glb")
