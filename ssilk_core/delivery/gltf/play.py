# SPDX-License-Identifier: Apache-2.0
"""Play a baked glb back as the specification of glTF 2.0 deforms it: morph targets, then skin."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import fail
from ...scene.assets import Floats, Ints
from ...scene.kinematics import slerp
from .container import GlbFile, understood
from .nodes import node_transform
from .shot import ARMATURE, GARMENT

WRITTEN = "a .glb that 'ssilk bake' wrote is needed"


@dataclass(frozen=True, eq=False)
class GlbMesh:
    """A mesh of a glb.

    Attributes:
        name: of the mesh.
        faces: triangles, shape (F, 3).
        is_garment: it is the garment; what is not counts as body.
        colour: none of its own, because `write_glb` gives all garments one plain material.
    """

    name: str
    faces: Ints
    is_garment: bool
    colour: None = None


class GlbShot:
    """Meshes over time, in metres and y up. Points that seams doubled are left out.

    Joints count as seen where the file hides them by their scale.

    Attributes:
        name: path of the file.
        fps: frames per second.
        frame_times: time code of each frame.
        meshes: every mesh of the file, in its order.
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
            timing = document["asset"]["extras"]
            self.fps, self._start = float(timing["timeCodesPerSecond"]), float(timing["startTimeCode"])
            self._per_frame = int(timing["samplesPerFrame"])
            if not (0 < self.fps < np.inf and self._per_frame > 0 and np.isfinite(self._start)):
                raise ValueError("times")
            self.provenance: Mapping[str, Any] = dict(timing.get("ssilk", {}))
            self._nodes = document["nodes"]
            (animation,), (skin,) = document["animations"], document["skins"]
            self._channels = [
                _Channel.of(self._file, animation["samplers"][item["sampler"]], item["target"], self._rate)
                for item in animation["channels"]
                if item["target"]["node"] != ARMATURE
            ]
            self._joints = list(skin["joints"])
            binds = self._file.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4)
            self._binds = binds.swapaxes(1, 2).astype(np.float64)
            self._parents = {
                child: node for node, item in enumerate(self._nodes) for child in item.get("children", ())
            }
            drawn = [node for node, item in enumerate(self._nodes) if "mesh" in item]
            self._surfaces = [_SkinnedSurface(self._file, self._nodes[node]["mesh"], node) for node in drawn]
            (self._count,) = {len(channel.values) for channel in self._channels}
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
        return [self._posed(surface, time) for surface in self._surfaces]

    def garment_points(self, time: float) -> Floats:
        """Return the points of the one garment [m], shape (V, 3).

        Raises:
            SsilkError: the shot has no garment, or several.
        """
        found = [surface for surface in self._surfaces if surface.mesh.is_garment]
        if len(found) != 1:
            fail(self.name, f"{len(found)} meshes are marked as garments", "one is needed")
        return self._posed(found[0], time)

    def _posed(self, surface: _SkinnedSurface, time: float) -> Floats:
        with self._understood():
            position = (time - self._start) * self._per_frame
            values = {(channel.node, channel.path): channel.at(position) for channel in self._channels}
            world: dict[int, Floats] = {}
            placed = [node_transform(joint, self._nodes, self._parents, values, world) for joint in self._joints]
            matrices = np.stack(placed) @ self._binds
            weights = values.get((surface.node, "weights"), surface.weights)
            return surface.posed(weights, matrices)

    def _understood(self) -> AbstractContextManager[None]:
        """Raise `SsilkError` for a document of another shape than `write_glb` writes."""
        return understood(self.name, "another or a damaged glb", WRITTEN, "bake it again")


@dataclass(frozen=True, eq=False)
class _Channel:
    """What an animation does to one property of a node: `values` of its samples, shape (F, width)."""

    node: int
    path: str
    values: Floats

    @classmethod
    def of(cls, file: GlbFile, sampler: Mapping[str, Any], target: Mapping[str, Any], rate: float) -> _Channel:
        """Return the channel; its keys must be the shot's samples, `rate` in a second."""
        times = file.array(sampler["input"])[:, 0]
        due = np.arange(len(times)) / rate
        if sampler["interpolation"] != "LINEAR" or not (np.abs(times - due) <= 1e-6 * (due + 1 / rate)).all():
            raise ValueError(f"other keys of {target['path']} than the samples")
        values = file.array(sampler["output"]).astype(np.float64).reshape(len(times), -1)
        return cls(target["node"], target["path"], values)

    def at(self, position: float) -> Floats:
        """Return the value at a fractional sample, shape (width,)."""
        position = float(np.clip(position, 0, len(self.values) - 1))
        near = round(position)
        if abs(position - near) < 1e-6:
            return self.values[near]
        before, share = int(position), position - int(position)
        if self.path == "rotation":
            return slerp(self.values[before], self.values[before + 1], np.asarray(share))
        return (1 - share) * self.values[before] + share * self.values[before + 1]


class _SkinnedSurface:
    """A mesh with its morph targets and skinning weights."""

    def __init__(self, file: GlbFile, index: int, node: int) -> None:
        item = file.document["meshes"][index]
        (primitive,) = item["primitives"]
        attributes, count = primitive["attributes"], int(item["extras"]["points"])
        self.node = node
        rest = file.array(attributes["POSITION"])[:count].astype(np.float64)
        targets = [file.array(target["POSITION"])[:count] for target in primitive.get("targets", ())]
        self.offsets = np.array(targets, dtype=np.float64).reshape(len(targets), *rest.shape)
        self.weights = np.array(item.get("weights", ()), dtype=np.float64)
        sets = [name.partition("_")[2] for name in attributes if name.startswith("JOINTS_")]
        self.joints = np.concatenate([file.array(attributes[f"JOINTS_{each}"])[:count] for each in sets], axis=1)
        self.influences = np.concatenate([file.array(attributes[f"WEIGHTS_{each}"])[:count] for each in sets], axis=1)
        self.rest = rest
        self.mesh = GlbMesh(item["name"], self._faces(file, primitive, attributes), item["extras"]["kind"] == GARMENT)

    def _faces(self, file: GlbFile, primitive: Mapping[str, Any], attributes: Mapping[str, Any]) -> Ints:
        """Return the triangles, each vertex of a seam as the point that it doubles: the one in the same place."""
        faces = file.array(primitive["indices"]).reshape(-1, 3).astype(np.int64)
        every, count = file.array(attributes["POSITION"]), len(self.rest)
        if not ((faces >= 0) & (faces < len(every))).all():
            raise ValueError("a triangle of vertices that are not there")
        if len(every) == count:
            return faces
        where = {place.tobytes(): point for point, place in reversed(list(enumerate(every[:count])))}
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
