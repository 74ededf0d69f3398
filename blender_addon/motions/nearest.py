# SPDX-License-Identifier: GPL-3.0-or-later
"""The nearest points of a mesh, with Blender's own tree, as `ssilk_core.physics.world.surface` asks for them.

The tree computes in single precision. It only chooses triangles; points on them are found in double precision. Where
a point is on the border of its triangle, a neighbour may have a nearer one: all that are as near to the tree compete.
"""

from __future__ import annotations

import numpy as np
from mathutils.bvhtree import BVHTree

from ssilk_core.physics.world.surface import Nearest

SINGLE = 1e-5  # of the size of what is searched, by which the tree's distances may be wrong
INSIDE = 1e-9  # barycentric coordinate from which on a point is within its triangle


def tree_nearest(points: np.ndarray, faces: np.ndarray) -> Nearest:
    """Return what finds the nearest points of triangles (T, 3) with vertices (P, 3), as `surface.boxes` does."""
    centre = points[faces.reshape(-1)].mean(axis=0)
    points = points - centre  # near the origin, single precision is finer
    tree = BVHTree.FromPolygons(points.tolist(), faces.tolist(), all_triangles=True)
    size = float(np.abs(points[faces.reshape(-1)]).max())

    def nearest(queries: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        queries = queries - centre
        found = [tree.find_nearest(each) for each in queries.tolist()]
        face = np.array([each[2] for each in found], dtype=np.int64)
        squares, on, within = on_triangles(points[faces[face]], queries)
        rows, rivals = [], []
        for row in np.flatnonzero(~within).tolist():
            query, away = queries[row].tolist(), found[row][3]
            near = tree.find_nearest_range(query, away + SINGLE * (size + away))
            rows += [row] * len(near)
            rivals += [each[2] for each in near]
        if rows:
            row, rival = np.array(rows), np.array(rivals)
            square, place, _ = on_triangles(points[faces[rival]], queries[row])
            order = np.lexsort((square, row))
            best = order[np.unique(row[order], return_index=True)[1]]
            best = best[square[best] < squares[row[best]]]
            squares[row[best]], face[row[best]], on[row[best]] = square[best], rival[best], place[best]
        return squares, face, on + centre

    return nearest


def on_triangles(corners: np.ndarray, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the nearest points of triangles (M, 3, 3) to queries (M, 3), one each.

    Returns:
        Squared distances (M,), points (M, 3), and whether each point is within its triangle, off the border (M,).
    """
    ahead = np.roll(corners, -1, axis=1) - corners
    length = np.maximum((ahead * ahead).sum(axis=2), np.finfo(float).tiny)
    part = ((queries[:, None] - corners) * ahead).sum(axis=2) / length
    sides = corners + part.clip(0, 1)[..., None] * ahead
    squares = ((queries[:, None] - sides) ** 2).sum(axis=2)
    side, rows = squares.argmin(axis=1), np.arange(len(queries))
    square, found = squares[rows, side], sides[rows, side]
    normal = np.cross(ahead[:, 0], ahead[:, 1])
    area = np.maximum((normal * normal).sum(axis=1), np.finfo(float).tiny)
    # Twice the areas, over the whole, of the triangles that the query spans with each side.
    share = (np.cross(ahead, queries[:, None] - corners) * normal[:, None]).sum(axis=2) / area[:, None]
    within = (share > INSIDE).all(axis=1)
    height = ((queries - corners[:, 0]) * normal).sum(axis=1)
    square = np.where(within, height**2 / area, square)
    foot = queries - (height / area)[:, None] * normal
    return square, np.where(within[:, None], foot, found), within
