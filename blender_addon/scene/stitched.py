# SPDX-License-Identifier: GPL-3.0-or-later
"""Which pieces of a garment stitches hold, as `ssilk_core.mesh.stitches` has it, without the scipy that it needs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from mathutils.bvhtree import BVHTree

from ssilk_core.mesh.stitches import ABOVE, LEAST_COSINE, SAGITTA, SAME_PLACE, TOUCH


def unstitched(points: np.ndarray, triangles: np.ndarray, island: np.ndarray, adrift: np.ndarray) -> np.ndarray:
    """Return which vertices that are adrift lie on no piece that is held, not by way of others either, shape (V,).

    Args:
        points: at rest [m], shape (V, 3).
        triangles: shape (T, 3).
        island: number of the island of each vertex, shape (V,).
        adrift: whether each vertex is on an island without a pinned or tight vertex, shape (V,).
    """
    held = ~adrift
    while held.any() and adrift.any():
        on_held = [vertex for vertex, _ in _lying(points, triangles[held[triangles[:, 0]]], np.flatnonzero(adrift))]
        under = [face for _, face in _lying(points, triangles[adrift[triangles[:, 0]]], np.flatnonzero(held))]
        held = adrift & np.isin(island, island[np.array(on_held + under, dtype=np.int64)])
        adrift = adrift & ~held
    return adrift


def _lying(points: np.ndarray, triangles: np.ndarray, vertices: np.ndarray) -> Iterator[tuple[int, int]]:
    """Yield which of some vertices lie on triangles (T, 3), each with a corner of the nearest one."""
    if not len(triangles):
        return
    corners = points[triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=1)
    reach = np.clip(SAGITTA * longest, TOUCH, ABOVE)
    tree = BVHTree.FromPolygons(points.tolist(), triangles.tolist(), all_triangles=True)
    for vertex, point in zip(vertices.tolist(), points[vertices].tolist()):
        foot, normal, face, distance = tree.find_nearest(point, ABOVE)
        if foot is None or distance > reach[face]:
            continue
        height = abs(normal.dot(foot) - normal.dot(point))
        if distance < SAME_PLACE or height >= LEAST_COSINE * distance:
            yield vertex, int(triangles[face, 0])
