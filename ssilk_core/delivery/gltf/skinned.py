# SPDX-License-Identifier: Apache-2.0
"""Play a skinned mesh of a glb that another program exported, as the specification of glTF 2.0 deforms it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import fail
from ...scene.assets import Floats
from .channel import NodeChannel
from .file import GlbFile, listed, understood
from .nodes import node_parents, node_transform


class SkinnedGlb:
    """One mesh of a glb under its one animation: nodes, joints of all sets, morph targets.

    Attributes:
        rest: vertices as they are stored, shape (V, 3); a seam has several in one place.
        start, end: times of the first and the last key [s].
    """

    def __init__(self, path: str | Path, node: str) -> None:
        """Open a file.

        Args:
            node: name of the node that has the mesh and a skin.

        Raises:
            SsilkError: not a readable file, or one without such a node, or without exactly one animation.
        """
        self.name, self._file = str(path), GlbFile(path)
        with self._understood():
            document = self._file.document
            self._nodes: list[dict[str, Any]] = document["nodes"]
            self._parents = node_parents(self._nodes)
            found = [index for index, item in enumerate(self._nodes) if item.get("name") == node and "skin" in item]
            animations = document.get("animations", [])
            if len(found) != 1 or len(animations) != 1:
                fail(
                    self.name, f"{len(found)} skinned nodes '{node}' and {len(animations)} animations", "one of each"
                )
            self._node = found[0]
            self._channels = [NodeChannel.of(self._file, animations[0], item) for item in animations[0]["channels"]]
            self.start = min(float(channel.times[0]) for channel in self._channels)
            self.end = max(float(channel.times[-1]) for channel in self._channels)
            self._read_mesh(document)

    def _read_mesh(self, document: Mapping[str, Any]) -> None:
        item = listed(document["meshes"], self._nodes[self._node]["mesh"])
        parts = item["primitives"]
        self.rest = self._joined(part["attributes"]["POSITION"] for part in parts)
        targets = range(len(parts[0].get("targets", ())))
        self._shapes = np.zeros((len(targets), *self.rest.shape))
        for target in targets:
            self._shapes[target] = self._joined(part["targets"][target]["POSITION"] for part in parts)
        self._weights = np.array(item.get("weights", np.zeros(len(targets))), dtype=np.float64)
        sets = sorted(name.partition("_")[2] for name in parts[0]["attributes"] if name.startswith("JOINTS_"))
        both = ("JOINTS", "WEIGHTS")
        joints, shares = (
            np.concatenate([self._joined(part["attributes"][f"{kind}_{each}"] for part in parts) for each in sets], 1)
            for kind in both
        )
        self._joints, self._shares = joints.astype(np.int64), shares
        if not (self._joints >= 0).all():
            raise IndexError("a vertex of a joint below zero")
        skin = listed(document["skins"], self._nodes[self._node]["skin"])
        self._skin: list[int] = list(skin["joints"])
        self._binds = self._file.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2).astype(float)

    def _joined(self, accessors: Iterator[int]) -> Floats:
        return np.concatenate([self._file.array(each) for each in accessors]).astype(np.float64)

    def vertices(self, time: float) -> Floats:
        """Return the vertices in the world of the file, y up, at a time [s], shape (V, 3)."""
        with self._understood():
            moved = {(channel.node, channel.path): channel.at(time) for channel in self._channels}
            world: dict[int, Floats] = {}
            placed = [node_transform(joint, self._nodes, self._parents, moved, world) for joint in self._skin]
            matrices = np.stack(placed) @ self._binds
            weights = moved.get((self._node, "weights"), self._weights)
            points = self.rest + np.tensordot(weights, self._shapes, 1)
            posed = np.zeros_like(points)
            for joint, share in zip(self._joints.T, self._shares.T):
                each = matrices[joint]
                posed += share[:, None] * (np.einsum("vab,vb->va", each[:, :3, :3], points) + each[:, :3, 3])
            return posed

    def place(self, node: str, time: float) -> Floats:
        """Return where a node with a mesh, and no skin, is in the world of the file at a time [s], shape (4, 4).

        Raises:
            SsilkError: there is no such node, or several.
        """
        with self._understood():
            items = list(enumerate(self._nodes))
            found = [at for at, item in items if item.get("name") == node and "mesh" in item and "skin" not in item]
            if len(found) != 1:
                fail(self.name, f"{len(found)} nodes '{node}' with a mesh and without a skin", "one is needed")
            moved = {(channel.node, channel.path): channel.at(time) for channel in self._channels}
            return node_transform(found[0], self._nodes, self._parents, moved, {})

    def _understood(self) -> AbstractContextManager[None]:
        """Raise `SsilkError` for a document that is not what the specification says."""
        return understood(self.name, "a damaged glb", "a skinned mesh is needed", "export again")
