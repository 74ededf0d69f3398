# SPDX-License-Identifier: Apache-2.0
"""Where the nodes of a glTF binary are in a frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ...scene.assets import Floats
from ...scene.kinematics import matrix_from_quaternion
from .file import listed

USUAL = {"rotation": (0, 0, 0, 1), "translation": (0, 0, 0), "scale": (1, 1, 1)}
Values = Mapping[tuple[int, str], Floats]  # of a channel's node and path


def node_parents(nodes: list[dict[str, Any]]) -> dict[int, int]:
    """Return the parents of the nodes that have one.

    Raises:
        IndexError, TypeError: a child is no node of the document.
    """
    parents: dict[int, int] = {}
    for above, item in enumerate(nodes):
        for child in item.get("children", ()):
            listed(nodes, child)
            parents[child] = above
    return parents


def node_transform(
    node: int, nodes: list[dict[str, Any]], parents: Mapping[int, int], moved: Values, world: dict[int, Floats]
) -> Floats:
    """Return the transform of a node to the world, shape (4, 4).

    Args:
        nodes: as the document lists them.
        parents: of the nodes that have one.
        moved: animated values in place of the nodes' own.
        world: transforms that are known, to which this one and those of the nodes above are added.
    """
    if node not in world:
        item, above = listed(nodes, node), parents.get(node)
        own = np.array(item.get("matrix", np.eye(4)), dtype=np.float64).reshape(4, 4).T
        if "matrix" not in item:
            turn, place, scale = (
                moved.get((node, name), np.array(item.get(name, usual), dtype=np.float64))
                for name, usual in USUAL.items()
            )
            own[:3, :3], own[:3, 3] = matrix_from_quaternion(turn[[3, 0, 1, 2]]) * scale, place
        world[node] = own if above is None else node_transform(above, nodes, parents, moved, world) @ own
    return world[node]
