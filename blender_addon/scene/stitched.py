# SPDX-License-Identifier: GPL-3.0-or-later
"""Which pieces of a garment stitches hold, as `ssilk_core.scene.mesh.stitches` has it, but without scipy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from mathutils.bvhtree import BVHTree

from ssilk_core.scene.mesh.stitches import ABOVE, LEAST_COSINE, SAGITTA, SAME_PLACE, TOUCH
from ssilk_core.scene.mesh.topology import face_areas, vertex_normals


class _Feet(NamedTuple):
    """Feet of vertices on triangles, one row each.

    `corners` are of the triangles, `near` tells which are near enough for a stitch, `opposed` where the normals of
    vertex and triangle are.
    """

    vertices: np.ndarray
    corners: np.ndarray
    near: np.ndarray
    opposed: np.ndarray


def unstitched(points: np.ndarray, triangles: np.ndarray, island: np.ndarray, adrift: np.ndarray) -> np.ndarray:
    """Return which vertices that are adrift lie on no piece that is held, not by way of others either, shape (V,).

    Sides that face each other do not hold, unless a piece lies wholly on a larger one.

    Args:
        points: at rest [m], shape (V, 3).
        triangles: shape (T, 3).
        island: number of the island of each vertex, shape (V,).
        adrift: whether each vertex is on an island without a pinned or tight vertex, shape (V,).
    """
    area = np.bincount(island[triangles[:, 0]], face_areas(points, triangles), len(points))
    used = np.bincount(island[np.unique(triangles)], minlength=len(points))
    normals, held = vertex_normals(points, triangles), ~adrift
    while held.any() and adrift.any():
        sewn = []
        for above, below in ((adrift, held), (held, adrift)):
            feet = _feet(points, normals, triangles[below[triangles[:, 0]]], np.flatnonzero(above))
            own, other = island[feet.vertices], island[feet.corners]
            whole = (np.bincount(own, minlength=len(points)) == used)[own] & (area[own] < area[other])
            sewn.append((own if above is adrift else other)[feet.near & (whole | ~feet.opposed)])
        held = adrift & np.isin(island, np.concatenate(sewn))
        adrift = adrift & ~held
    return adrift


def _feet(points: np.ndarray, normals: np.ndarray, triangles: np.ndarray, vertices: np.ndarray) -> _Feet:
    """Return the feet of some vertices within `ABOVE`, each on the nearest one of some triangles (T, 3)."""
    found: list[tuple[int, int, bool, bool]] = []
    if len(triangles):
        corners = points[triangles]
        longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=1)
        reach = np.clip(SAGITTA * longest, TOUCH, ABOVE)
        tree = BVHTree.FromPolygons(points.tolist(), triangles.tolist(), all_triangles=True)
        for vertex, point in zip(vertices.tolist(), points[vertices].tolist()):
            foot, normal, face, distance = tree.find_nearest(point, ABOVE)
            if foot is None:
                continue
            height = abs(normal.dot(foot) - normal.dot(point))
            if distance < SAME_PLACE or height >= LEAST_COSINE * distance:
                opposed = normals[vertex] @ np.array(normal) < -LEAST_COSINE
                found.append((vertex, triangles[face, 0], distance <= reach[face], opposed))
    table = np.array(found, dtype=np.int64).reshape(-1, 4)
    return _Feet(table[:, 0], table[:, 1], table[:, 2].astype(bool), table[:, 3].astype(bool))
