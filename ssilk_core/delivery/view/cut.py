# SPDX-License-Identifier: Apache-2.0
"""Triangles cut by planes and split into small ones, as arrays of their corners (T, 3, 3)."""

from __future__ import annotations

import numpy as np

from ...scene.assets import Floats, Ints


def cut_by_plane(corners: Floats, normal: Floats, offset: float) -> tuple[Floats, Ints]:
    """Return what of triangles (T, 3, 3) is beyond a plane, and of which triangle each part (N,) is.

    Args:
        normal: of the plane, shape (3,); what x of has `normal @ x >= offset` is kept.
    """
    height = corners @ normal - offset
    beyond = height >= 0
    count = beyond.sum(axis=1)
    whole = np.flatnonzero(count == 3)
    parts, rows = [corners[whole]], [whole]
    for above in (1, 2):
        cut = np.flatnonzero(count == above)
        # The corner that is alone on its side comes first, and the order around the triangle stays.
        alone = beyond[cut].argmax(axis=1) if above == 1 else (~beyond[cut]).argmax(axis=1)
        order = (alone[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(corners[cut], order[..., None], axis=1), 1, 0)
        high = np.take_along_axis(height[cut], order, axis=1)
        on_ab, on_ac = (a + (high[:, 0] / (high[:, 0] - high[:, k]))[:, None] * (b - a if k == 1 else c - a)
                        for k in (1, 2))  # fmt: skip
        if above == 1:
            parts.append(np.stack([a, on_ab, on_ac], axis=1))
            rows.append(cut)
        else:
            parts += [np.stack([on_ab, b, c], axis=1), np.stack([on_ab, c, on_ac], axis=1)]
            rows += [cut, cut]
    return np.concatenate(parts), np.concatenate(rows)


def cut_to_box(corners: Floats, low: Floats, high: Floats) -> Floats:
    """Return what of triangles (T, 3, 3) is in a box with corners `low` and `high` (3,)."""
    for axis, normal in enumerate(np.eye(3)):
        corners, _ = cut_by_plane(corners, normal, low[axis])
        corners, _ = cut_by_plane(corners, -normal, -high[axis])
    return corners


def split(corners: Floats, edge: float) -> Floats:
    """Return triangles (T, 3, 3) halved until no edge is longer than `edge` [m]."""
    done = [np.zeros((0, 3, 3))]
    while len(corners):
        lengths = edge_lengths(corners)
        short = lengths.max(axis=1) <= edge
        done.append(corners[short])
        corners, first = corners[~short], lengths[~short].argmax(axis=1)
        rows = np.arange(len(corners))
        a, b, c = (corners[rows, (first + step) % 3] for step in range(3))  # a to b is longest
        middle = (a + b) / 2
        corners = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return np.concatenate(done)


def edge_lengths(corners: Floats) -> Floats:
    """Return the lengths of the edges from each corner to the next of triangles (T, 3, 3), shape (T, 3)."""
    return np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
