# SPDX-License-Identifier: GPL-3.0-or-later
"""Vertices and their partners across the plane x = 0 of a mesh."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils.kdtree import KDTree


def partners_across(mesh: bpy.types.Mesh, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (V, 3), and for each the nearest one at its mirrored place, -1 where none is near."""
    points = np.empty(len(mesh.vertices) * 3, dtype=np.float32)
    mesh.vertices.foreach_get("co", points)
    points = points.reshape(-1, 3)
    tree = KDTree(len(points))
    for index, point in enumerate(points.tolist()):
        tree.insert(point, index)
    tree.balance()
    found = (tree.find(point) for point in (points * [-1, 1, 1]).tolist())
    return points, np.array([index if away <= distance else -1 for _, index, away in found], dtype=np.int64)
