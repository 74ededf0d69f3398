# SPDX-License-Identifier: GPL-3.0-or-later
"""Vertex classes as numbers and as colours; numpy alone."""

from __future__ import annotations

import numpy as np
from ssilk_usd.names import CLASS, LEVEL

from ssilk_core.scene.assets import LOOSE, PINNED

COLORS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # sRGB, by class
ATTRIBUTE = CLASS.removeprefix("primvars:")  # Blender's USD importer keeps the name
LEVELS = LEVEL.removeprefix("primvars:")  # attribute: the least tightness at which each vertex is tight
COLOR_ATTRIBUTE = "SSILK Classes"


def colors_of(classes: np.ndarray) -> np.ndarray:
    """Return opaque sRGB colours, shape (V, 4), of classes, shape (V,)."""
    return np.concatenate([COLORS[classes], np.ones((len(classes), 1))], axis=1)


def nearest(colors: np.ndarray) -> np.ndarray:
    """Return the class of the nearest palette colour, shape (V,); the lower class where two are as near.

    Args:
        colors: sRGB, alpha ignored, shape (V, 3) or (V, 4). Brushes blend at their rim, hence the search.
    """
    distance = np.linalg.norm(colors[:, None, :3] - COLORS, axis=-1)
    return distance.argmin(axis=1).astype(np.int32)


def point_colors(corner_colors: np.ndarray, corner_points: np.ndarray, point_count: int) -> np.ndarray:
    """Return the mean of each point's corners, shape (point_count, 4), zero for points without corners.

    Args:
        corner_colors: shape (corners, 4).
        corner_points: the point of each corner, shape (corners,).
    """
    total = np.zeros((point_count, corner_colors.shape[1]))
    np.add.at(total, corner_points, corner_colors)
    return total / np.maximum(np.bincount(corner_points, minlength=point_count), 1)[:, None]


def in_range(classes: np.ndarray) -> bool:
    """Return whether all values are classes."""
    return bool(((classes >= PINNED) & (classes <= LOOSE)).all())


def counts(classes: np.ndarray) -> tuple[int, int, int]:
    """Return how many vertices are pinned, tight and loose."""
    pinned, tight, loose = np.bincount(classes, minlength=3)[:3]
    return int(pinned), int(tight), int(loose)


def adrift(classes: np.ndarray, island: np.ndarray) -> np.ndarray:
    """Return which vertices are on islands that are all loose, and so fall off unless stitched, shape (V,).

    Args:
        classes: shape (V,).
        island: number of the island of each vertex, shape (V,).
    """
    return ~np.isin(island, island[classes != LOOSE])


def mirrored(classes: np.ndarray, points: np.ndarray, partners: np.ndarray, *, from_left: bool) -> np.ndarray:
    """Return classes in which one side has taken those of the other.

    Args:
        points: shape (V, 3); the sides lie along x, and left is the character's, +x.
        partners: for each point the one at its mirrored place, -1 where there is none, shape (V,).
    """
    side = points[:, 0] < 0 if from_left else points[:, 0] > 0
    taking = side & (partners >= 0)
    return np.where(taking, classes[partners], classes)
