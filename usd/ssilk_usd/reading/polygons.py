# SPDX-License-Identifier: Apache-2.0
"""Triangulate polygons: quads along their better diagonal, larger polygons by ear clipping."""

from __future__ import annotations

import numpy as np

from ssilk_core.scene.assets import Floats, Ints

_EPSILON = 1e-12


def triangulate(points: Floats, counts: Ints, indices: Ints) -> Ints:
    """Split polygons into triangles of the same winding, in the order of the polygons.

    Args:
        points: positions, shape (V, 3).
        counts: number of corners of each polygon, at least 3, shape (P,).
        indices: vertices of the corners, polygon by polygon, shape (sum of counts,).

    Returns:
        Triangles, shape (sum of (counts - 2), 3). They cover concave polygons exactly and keep collinear corners.
    """
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    parts = [(starts[counts == 3], indices[starts[counts == 3][:, None] + np.arange(3)][:, None])]
    quads = starts[counts == 4]
    parts.append((quads, _split_quads(points, indices[quads[:, None] + np.arange(4)])))
    for start, count in zip(starts[counts > 4], counts[counts > 4]):
        polygon = indices[start : start + count]
        parts.append((np.array([start]), polygon[_clip_ears(points[polygon])][None]))
    order = np.concatenate([np.repeat(first, tris.shape[1]) for first, tris in parts])
    triangles = np.concatenate([tris.reshape(-1, 3) for _, tris in parts])
    return triangles[np.argsort(order, kind="stable")]


def _split_quads(points: Floats, quads: Ints) -> Ints:
    """Split each quad along the shorter diagonal, unless only the other one lies inside, shape (Q, 2, 3)."""
    options = np.array([[[0, 1, 2], [0, 2, 3]], [[0, 1, 3], [1, 2, 3]]])
    corners = points[quads]
    normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    a, b, c = np.moveaxis(corners[:, options], -2, 0)
    inside = (np.einsum("qotx,qx->qot", np.cross(b - a, c - a), normal) > 0).all(axis=-1)
    length = np.stack(
        [np.linalg.norm(corners[:, i] - corners[:, i + 2], axis=-1) for i in (0, 1)],
        axis=-1,
    )
    best = np.argmin(np.where(inside, length, length + length.sum(axis=-1, keepdims=True)), axis=-1)
    return quads[np.arange(len(quads))[:, None, None], options[best]]


def _clip_ears(corners: Floats) -> Ints:
    """Triangulate a polygon (N, 3) in the plane of its Newell normal, shortest cuts first, shape (N - 2, 3)."""
    flat = _project(corners)
    left = list(range(len(flat)))
    triangles = []
    while len(left) > 3:
        at = _best_ear(flat, left)
        triangles.append([left[at - 1], left[at], left[(at + 1) % len(left)]])
        del left[at]
    return np.array([*triangles, left])


def _project(corners: Floats) -> Floats:
    """Project the corners onto a plane in which the polygon runs counter-clockwise, shape (N, 2)."""
    normal = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
    axis = np.eye(3)[np.argmin(np.abs(normal))]
    u = np.cross(axis, normal)
    v = np.cross(normal, u)
    size = [max(float(np.linalg.norm(side)), _EPSILON) for side in (u, v)]
    return np.stack([(corners - corners[0]) @ u / size[0], (corners - corners[0]) @ v / size[1]], axis=-1)


def _best_ear(flat: Floats, left: list[int]) -> int:
    """Return the index in `left` of the valid ear with the shortest cut, or of the shortest cut if none is."""
    ring = flat[left]
    before, after = np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0)
    cut = np.linalg.norm(after - before, axis=-1)
    for at in np.argsort(cut, kind="stable"):
        if _is_ear(before[at], ring[at], after[at], ring):
            return int(at)
    return int(np.argmin(cut))


def _is_ear(a: Floats, b: Floats, c: Floats, ring: Floats) -> bool:
    if _cross(b - a, c - a) <= _EPSILON:
        return False
    inside = np.ones(len(ring), dtype=bool)
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= _cross(end - start, ring - start) >= -_EPSILON
    # The ear's own corners, and points that coincide with them, do not block it.
    own = (np.abs(ring[:, None] - np.stack([a, b, c])).max(axis=-1) <= _EPSILON).any(axis=1)
    return not (inside & ~own).any()


def _cross(p: Floats, q: Floats) -> Floats:
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
