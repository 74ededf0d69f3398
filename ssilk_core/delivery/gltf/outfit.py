# SPDX-License-Identifier: Apache-2.0
"""Several garments of one character as one glb: one skeleton and body, a skin and an animation of each garment's own.

Each garment is written as a glb of its own first. Joined, the joints of the character are there once, with the
proxies of all garments beneath them, and a mesh is bound to the joints that its own file had.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import fail
from ...files import replacing
from .container import GlbBuilder
from .file import GlbFile, understood
from .shot import ARMATURE, GARMENT, RIDER

GARMENTS = "garments"  # under this name a file says where each of its garments came from
MORPHS = "weights"  # path of the channels that move a mesh's targets


def join_glbs(parts: Mapping[str, Path], output: Path) -> None:
    """Join garments that `write_glb` wrote over the same motion, with the body of the first.

    Args:
        parts: their files, by names that are all different.

    Raises:
        SsilkError: they are of different characters, motions or times, or the file cannot be written.
    """
    (first, path), *others = parts.items()
    base = GlbFile(path)
    with understood(str(path), "another or a damaged glb", "one that 'ssilk bake' wrote is needed", "bake it again"):
        joined = _Joined(base, first)
        for name, each in others:
            joined.add(GlbFile(each), name)
        joined.write(output)


def write_alone(source: Path, garment: str, output: Path) -> None:
    """Write a glb with one of the garments of a joined one, as it was before it was joined; the body stays.

    Raises:
        SsilkError: it cannot be read or written, or has no such garment.
    """
    file = GlbFile(source)
    with understood(
        str(source), "another or a damaged glb", "one that 'ssilk bake' wrote is needed", "bake it again"
    ):
        document = file.document
        said = document["asset"]["extras"]
        own = said["ssilk"][GARMENTS][garment]
        said["ssilk"] = own
        left = {
            node
            for node, item in enumerate(document["nodes"])
            if "mesh" in item and _owner(document, item) not in (None, garment)
        }
        for node in left:
            for key in ("mesh", "skin"):
                del document["nodes"][node][key]
        (animation,) = document["animations"]
        animation["channels"] = [each for each in animation["channels"] if each["target"]["node"] not in left]
    with replacing(output) as temporary:
        file.write(temporary)


def _owner(document: Mapping[str, Any], node: Mapping[str, Any]) -> str | None:
    """Return the garment that a node's mesh belongs to; None for bodies."""
    return document["meshes"][node["mesh"]]["extras"].get(GARMENT)


class _Joined:
    """A document under way, and its buffer."""

    def __init__(self, base: GlbFile, name: str) -> None:
        self._glb = GlbBuilder()
        own = base.document
        self._joints = _character_joints(own)
        self._accessors: dict[int, int] = {}
        self._source = base
        glb = self._glb.document
        glb["asset"] = {**glb["asset"], "extras": {**own["asset"]["extras"], "ssilk": {}}}
        glb["nodes"], glb["scenes"], glb["scene"] = copy.deepcopy(own["nodes"]), copy.deepcopy(own["scenes"]), 0
        glb["materials"] = copy.deepcopy(own["materials"])
        (animation,) = own["animations"]
        glb["animations"] = [{"name": animation["name"], "samplers": [], "channels": []}]
        self._base = base
        self._add(base, name, {node: node for node in range(len(own["nodes"]))}, 0)

    def add(self, file: GlbFile, name: str) -> None:
        """Add the garment of a file, without its body."""
        document = file.document
        self._need_same(file)
        glb, nodes = self._glb.document, document["nodes"]
        moved = {node: node for node in range(self._joints + 1)}
        taken = {str(item.get("name")) for item in glb["nodes"]}
        for node in range(self._joints + 1, len(nodes)):
            item = {key: value for key, value in nodes[node].items() if key != "children"}
            if "mesh" in item and not _is_of_garment(document, item):
                continue
            moved[node] = len(glb["nodes"])
            if str(item.get("name")) in taken:
                item["name"] = f"{name}_{item['name']}"
            glb["nodes"].append(item)
            if "mesh" in item:
                glb["scenes"][0]["nodes"].append(moved[node])
        for node, new in moved.items():
            added = [moved[child] for child in nodes[node].get("children", ()) if child > self._joints]
            if added:
                glb["nodes"][new].setdefault("children", []).extend(added)
        glb["materials"].append(copy.deepcopy(document["materials"][0]))
        self._add(file, name, moved, len(glb["materials"]) - 1)

    def _add(self, file: GlbFile, name: str, moved: Mapping[int, int], material: int) -> None:
        """Add skin, meshes, channels and origin of a garment, whose nodes are there by their own numbers."""
        glb, document = self._glb.document, file.document
        self._source, self._accessors = file, {}
        (skin,) = document["skins"]
        number = self._glb.add("skins", {
            "joints": [moved[joint] for joint in skin["joints"]], "skeleton": ARMATURE,
            "inverseBindMatrices": self._accessor(skin["inverseBindMatrices"]),
        })  # fmt: skip
        for node, new in moved.items():
            if "mesh" in document["nodes"][node]:
                item = glb["nodes"][new]
                mesh = {**document["meshes"][document["nodes"][node]["mesh"]], "name": item["name"]}
                item["mesh"] = self._mesh(mesh, name, material)
                item["skin"] = number
        self._animate(document["animations"][0], moved, everything=not glb["animations"][0]["channels"])
        glb["asset"]["extras"]["ssilk"].setdefault(GARMENTS, {})[name] = document["asset"]["extras"].get("ssilk", {})

    def _mesh(self, mesh: dict[str, Any], garment: str, material: int) -> int:
        item = copy.deepcopy(mesh)
        if item["extras"]["kind"] in (GARMENT, RIDER):
            item["extras"][GARMENT] = garment
        for primitive in item["primitives"]:
            primitive["attributes"] = {key: self._accessor(at) for key, at in primitive["attributes"].items()}
            primitive["indices"] = self._accessor(primitive["indices"])
            if item["extras"]["kind"] == GARMENT:
                primitive["material"] = material
            if "targets" in primitive:
                primitive["targets"] = [
                    {key: self._accessor(at) for key, at in target.items()} for target in primitive["targets"]
                ]
        return self._glb.add("meshes", item)

    def _animate(self, animation: Mapping[str, Any], moved: Mapping[int, int], *, everything: bool) -> None:
        """Add channels: all of the first garment's, and those of others that the character does not have."""
        own = self._glb.document["animations"][0]
        for channel in animation["channels"]:
            target, sampler = channel["target"], animation["samplers"][channel["sampler"]]
            if target["node"] not in moved or not (everything or target["node"] > self._joints):
                continue
            own["samplers"].append({
                **sampler, "input": self._accessor(sampler["input"]), "output": self._accessor(sampler["output"])
            })  # fmt: skip
            new = {**target, "node": moved[target["node"]]}
            own["channels"].append({"sampler": len(own["samplers"]) - 1, "target": new})

    def _accessor(self, index: int) -> int:
        """Copy an accessor of the file that is being added, with its views; return its index."""
        if index not in self._accessors:
            item = copy.deepcopy(self._source.document["accessors"][index])
            if "bufferView" in item:
                item["bufferView"] = self._view(item["bufferView"])
            for part in ("indices", "values") if "sparse" in item else ():
                item["sparse"][part]["bufferView"] = self._view(item["sparse"][part]["bufferView"])
            self._accessors[index] = self._glb.add("accessors", item)
        return self._accessors[index]

    def _view(self, index: int) -> int:
        view = self._source.document["bufferViews"][index]
        return self._glb.bytes_of(self._source.view_bytes(index), view.get("target"))

    def _need_same(self, file: GlbFile) -> None:
        """Raise `SsilkError` unless a file has the character, the times and the motion of the first."""
        ours, document = self._base.document, file.document
        allowed = "garments of one file are of one character and one motion"
        names = [[item.get("name") for item in each["nodes"][: self._joints + 1]] for each in (ours, document)]
        if _character_joints(document) != self._joints or names[0] != names[1]:
            fail(str(file.path), "another skeleton", allowed)
        timing = [{**each["asset"]["extras"], "ssilk": None} for each in (ours, document)]
        if timing[0] != timing[1]:
            fail(str(file.path), "other times", allowed, "bake both with the same range and rate")
        both = [_tracks(each, self._joints) for each in (self._base, file)]
        if both[0].keys() != both[1].keys() or any(
            not (len(track) == len(both[1][key]) and np.allclose(track, both[1][key], atol=1e-5))
            for key, track in both[0].items()
        ):
            fail(str(file.path), "another motion of the character", allowed, "bake both over the same motion")

    def write(self, path: Path) -> None:
        with replacing(path) as temporary:
            self._glb.write(temporary)


def _character_joints(document: Mapping[str, Any]) -> int:
    """Return how many joints of a document are the character's, which come before its proxies."""
    return int(document["asset"]["extras"]["characterJoints"])


def _is_of_garment(document: Mapping[str, Any], node: Mapping[str, Any]) -> bool:
    return document["meshes"][node["mesh"]]["extras"]["kind"] in (GARMENT, RIDER)


def _tracks(file: GlbFile, joints: int) -> dict[tuple[int, str], np.ndarray]:
    """Return the values of the channels of the character's joints, by node and path."""
    (animation,) = file.document["animations"]
    return {
        (channel["target"]["node"], channel["target"]["path"]): file.array(
            animation["samplers"][channel["sampler"]]["output"]
        )
        for channel in animation["channels"]
        if channel["target"]["node"] <= joints and channel["target"]["path"] != MORPHS
    }


def garments_in(provenance: Mapping[str, Any]) -> Sequence[str]:
    """Return the names of the garments of a joined glb, from what it says of its origin; none of a single one."""
    said = provenance.get(GARMENTS)
    return list(said) if isinstance(said, Mapping) else []
