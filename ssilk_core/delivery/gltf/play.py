# SPDX-License-Identifier: Apache-2.0
"""Play a baked glb back as the specification of glTF 2.0 deforms it: morph targets, then skin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import fail
from ...scene.assets import Floats, Ints, Mesh
from .channel import NodeChannel
from .container import GENERATOR
from .file import GlbFile, listed, understood
from .nodes import node_parents, node_transform
from .shot import GARMENT, RIDER

WRITTEN = "a .glb that 'ssilk bake' wrote is needed"
TRIANGLES = 4  # the mode of primitives that are such


@dataclass(frozen=True, eq=False)
class GlbMesh:
    """A mesh of a glb.

    Attributes:
        name: of the mesh.
        faces: triangles, shape (F, 3).
        is_garment: it is the garment; what is not counts as body.
        colour: none of its own, because `write_glb` gives all garments one plain material.
        is_rider: it rides on the garment.
    """

    name: str
    faces: Ints
    is_garment: bool
    colour: None = None
    is_rider: bool = False


class GlbShot:
    """Meshes over time, in metres and y up. Points that seams doubled are left out.

    Joints count as seen where the file hides them by their scale. Other programs may have written the file anew: node
    order, accessors and keys are theirs, as long as vertices keep their order and `extras` stay.

    Attributes:
        name: path of the file.
        fps: frames per second.
        frame_times: time code of each frame.
        meshes: every mesh of the file, in its order.
        rewritten: what another program may have done to the file since it was baked; empty where none wrote it.
    """

    is_skinned = True

    def __init__(self, path: str | Path) -> None:
        """Open a shot.

        Raises:
            SsilkError: not a readable file, or not one that `write_glb` wrote.
        """
        self.name, self._file = str(path), GlbFile(path)
        with self._understood():
            document = self._file.document
            self.rewritten = _rewritten(self._file)
            timing = document["asset"].get("extras", {})
            if "timeCodesPerSecond" not in timing:
                fail(self.name, "no times of a shot in its asset.extras", WRITTEN, "keep extras when you rewrite it")
            self.fps, self._start = float(timing["timeCodesPerSecond"]), float(timing["startTimeCode"])
            self._per_frame = int(timing["samplesPerFrame"])
            if not (0 < self.fps < np.inf and self._per_frame > 0 and np.isfinite(self._start)):
                raise ValueError("times")
            self.provenance: Mapping[str, Any] = dict(timing.get("ssilk", {}))
            self._nodes = document["nodes"]
            self._skins = [_Skin.of(self._file, item) for item in document["skins"]]
            (animation,) = document["animations"]
            joints = {joint for skin in self._skins for joint in skin.joints}
            channels = [NodeChannel.of(self._file, animation, item) for item in animation["channels"]]
            # What scales nodes above all joints hides them.
            self._channels = [each for each in channels if each.path != "scale" or each.node in joints]
            self._parents = node_parents(self._nodes)
            drawn = [node for node, item in enumerate(self._nodes) if "mesh" in item]
            self._surfaces = [_SkinnedSurface(self._file, self._nodes[node], node) for node in drawn]
            self._count = round(max(float(each.times[-1]) for each in channels) * self._rate) + 1
        self.meshes = tuple(surface.mesh for surface in self._surfaces)
        self.frame_times = self.sample_times()

    def sample_times(self, per_frame: int = 1) -> tuple[float, ...]:
        """Return the time codes of the frames, or of several samples per frame."""
        count = (self._count - 1) * per_frame // self._per_frame + 1
        return tuple(self._start + index / per_frame for index in range(count))

    @property
    def _rate(self) -> float:
        return self.fps * self._per_frame

    def points(self, time: float) -> list[Floats]:
        """Return the points of each mesh in world space [m], float64, shape (V, 3), at a time code."""
        return self._posed(self._surfaces, time)

    def garment_points(self, time: float) -> Floats:
        """Return the points of the one garment [m], shape (V, 3).

        Raises:
            SsilkError: the shot has no garment, or several.
        """
        found = [surface for surface in self._surfaces if surface.mesh.is_garment]
        if len(found) != 1:
            fail(self.name, f"{len(found)} meshes are marked as garments", "one is needed")
        return self._posed(found, time)[0]

    @property
    def garment_at_rest(self) -> Mesh:
        """The one garment in the bind pose [m]; raises `SsilkError` as `garment_points` does."""
        self.garment_points(self._start)
        found = next(surface for surface in self._surfaces if surface.mesh.is_garment)
        return Mesh(found.mesh.name, found.rest, found.mesh.faces)

    def rider_points(self, time: float) -> list[Floats]:
        """Return the points of each mesh that rides on the garment [m], shape (V, 3), in the file's order."""
        return self._posed([surface for surface in self._surfaces if surface.mesh.is_rider], time)

    def _posed(self, surfaces: Sequence[_SkinnedSurface], time: float) -> list[Floats]:
        with self._understood():
            seconds = (time - self._start) / self.fps
            values = {(channel.node, channel.path): channel.at(seconds) for channel in self._channels}
            world: dict[int, Floats] = {}
            found = []
            for surface in surfaces:
                skin = listed(self._skins, surface.skin)
                placed = [node_transform(joint, self._nodes, self._parents, values, world) for joint in skin.joints]
                weights = values.get((surface.node, "weights"), surface.weights)
                found.append(surface.posed(weights, np.stack(placed) @ skin.binds))
            return found

    def _understood(self) -> AbstractContextManager[None]:
        """Raise `SsilkError` for a document of another shape than `write_glb` writes."""
        return understood(self.name, "another or a damaged glb", WRITTEN, "bake it again")


def _rewritten(file: GlbFile) -> str:
    generator = str(file.document["asset"].get("generator", "another program"))
    if generator.startswith(GENERATOR):
        return ""
    did = "reordered vertices or dropped keys"
    if file.is_quantized:
        did = "stored vertices as integers, which rounds them"
    return f"{generator[:60]} wrote it anew, and may have {did}"


@dataclass(frozen=True, eq=False)
class _Skin:
    """Nodes that are joints; their inverse bind matrices as column vectors, shape (J, 4, 4)."""

    joints: tuple[int, ...]
    binds: Floats

    @classmethod
    def of(cls, file: GlbFile, item: Mapping[str, Any]) -> _Skin:
        binds = file.array(item["inverseBindMatrices"]).reshape(-1, 4, 4)
        return cls(tuple(item["joints"]), binds.swapaxes(1, 2).astype(np.float64))


class _SkinnedSurface:
    """A mesh with its morph targets and skinning weights."""

    def __init__(self, file: GlbFile, holder: Mapping[str, Any], node: int) -> None:
        item = listed(file.document["meshes"], holder["mesh"])
        (primitive,) = item["primitives"]
        attributes, count = primitive["attributes"], int(item["extras"]["points"])
        if primitive.get("mode", TRIANGLES) != TRIANGLES:
            raise ValueError(f"primitives of mode {primitive['mode']}")
        if count < 0:
            raise ValueError(f"{count} points")
        self.node, self.skin = node, holder["skin"]
        rest = file.array(attributes["POSITION"])[:count].astype(np.float64)
        targets = [file.array(target["POSITION"])[:count] for target in primitive.get("targets", ())]
        self.offsets = np.array(targets, dtype=np.float64).reshape(len(targets), *rest.shape)
        self.weights = np.array(item.get("weights", ()), dtype=np.float64)
        sets = [name.partition("_")[2] for name in attributes if name.startswith("JOINTS_")]
        self.joints = np.concatenate([file.array(attributes[f"JOINTS_{each}"])[:count] for each in sets], axis=1)
        if not (self.joints >= 0).all():
            raise IndexError("a vertex of a joint below zero")
        self.influences = np.concatenate([file.array(attributes[f"WEIGHTS_{each}"])[:count] for each in sets], axis=1)
        self.rest = rest
        faces, kind = self._faces(file, primitive, attributes), item["extras"]["kind"]
        self.mesh = GlbMesh(item["name"], faces, kind == GARMENT, is_rider=kind == RIDER)

    def _faces(self, file: GlbFile, primitive: Mapping[str, Any], attributes: Mapping[str, Any]) -> Ints:
        """Return the triangles, each vertex of a seam as the point that it doubles: the one in the same place."""
        faces = file.array(primitive["indices"]).reshape(-1, 3).astype(np.int64)
        every, count = file.array(attributes["POSITION"]), len(self.rest)
        if not ((faces >= 0) & (faces < len(every))).all():
            raise ValueError("a triangle of vertices that are not there")
        if len(every) == count:
            return faces
        where = {place.tobytes(): point for point, place in reversed(list(enumerate(every[:count])))}
        if missing := [place for place in every[count:] if place.tobytes() not in where]:
            raise ValueError(f"{len(missing)} vertices that double none of the first {count}: others' order")
        doubles = [where[place.tobytes()] for place in every[count:]]
        return np.concatenate([np.arange(count), doubles])[faces]

    def posed(self, weights: Floats, matrices: Floats) -> Floats:
        """Return the points in the world [m], shape (V, 3), for joint matrices (J, 4, 4)."""
        morphed = self.rest + np.tensordot(weights, self.offsets, 1)
        result = np.zeros_like(morphed)
        for joint, share in zip(self.joints.T, self.influences.T.astype(np.float64)):
            each = matrices[joint]
            result += share[:, None] * (np.einsum("vab,vb->va", each[:, :3, :3], morphed) + each[:, :3, 3])
        return result
