# SPDX-License-Identifier: GPL-3.0-or-later
"""Which pieces of a garment stitches hold, as `ssilk_core.mesh.stitches` has it, without the scipy that it needs."""

from __future__ import annotations

import numpy as np
from mathutils.bvhtree import BVHTree

from ssilk_core.mesh.stitches import ABOVE, LEAST_COSINE, SAGITTA, SAME_PLACE, TOUCH
from ssilk_core.mesh.topology import vertex_normals


def unstitched(points: np.ndarray, triangles: np.ndarray, island: np.ndarray, adrift: np.ndarray) -> np.ndarray:
    """Return which vertices that are adrift lie on no piece that is held, not by way of others either, shape (V,).

    Sides that face each other do not hold, unless a piece lies wholly on what is held.

    Args:
        points: at rest [m], shape (V, 3).
        triangles: shape (T, 3).
        island: number of the island of each vertex, shape (V,).
        adrift: whether each vertex is on an island without a pinned or tight vertex, shape (V,).
    """
    normals, held = vertex_normals(points, triangles), ~adrift
    while held.any() and adrift.any():
        over = _lying(points, normals, triangles[held[triangles[:, 0]]], np.flatnonzero(adrift))
        under = _lying(points, normals, triangles[adrift[triangles[:, 0]]], np.flatnonzero(held))
        sewn = [vertex for vertex, _, opposed in over if not opposed]
        sewn += [corner for _, corner, opposed in under if not opposed]
        whole = np.bincount(island[[vertex for vertex, _, _ in over]], minlength=len(points)) == np.bincount(
            island, minlength=len(points)
        )
        held = adrift & (np.isin(island, island[np.array(sewn, dtype=np.int64)]) | whole[island])
        adrift = adrift & ~held
    return adrift


def _lying(
    points: np.ndarray, normals: np.ndarray, triangles: np.ndarray, vertices: np.ndarray
) -> list[tuple[int, int, bool]]:
    """Return which of some vertices lie on triangles (T, 3).

    Each comes with a corner of the nearest triangle, and with whether its normal and the triangle's are opposed.
    """
    if not len(triangles):
        return []
    corners = points[triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=1)
    reach = np.clip(SAGITTA * longest, TOUCH, ABOVE)
    tree = BVHTree.FromPolygons(points.tolist(), triangles.tolist(), all_triangles=True)
    found = []
    for vertex, point in zip(vertices.tolist(), points[vertices].tolist()):
        foot, normal, face, distance = tree.find_nearest(point, ABOVE)
        if foot is None or distance > reach[face]:
            continue
        height = abs(normal.dot(foot) - normal.dot(point))
        if distance < SAME_PLACE or height >= LEAST_COSINE * distance:
            opposed = normals[vertex] @ np.array(normal) < -LEAST_COSINE
            found.append((vertex, int(triangles[face, 0]), bool(opposed)))
    return found
