# SPDX-License-Identifier: Apache-2.0
"""Samples of cloth: vertices, and points on edges and inside triangles as near to each other as contact needs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, Ints

Mask = NDArray[np.bool_]
SAMPLE_SPACING = 0.01  # [m] between samples inside triangles, at most while `MAX_ORDER` allows
MAX_ORDER = 6  # parts into which samples divide an edge, at most


@dataclass(frozen=True, eq=False)
class ClothSamples:
    """Points on triangles of cloth: vertices first, then points on edges and inside triangles.

    Attributes:
        corners: vertices of the triangle, shape (S, 3).
        weights: barycentric coordinates, shape (S, 3).
    """

    corners: Ints
    weights: Floats

    def of(self, rows: Floats) -> Floats:
        """Interpolate values at the vertices (V, N), shape (S, N)."""
        return np.einsum("sk,skc->sc", self.weights, rows[self.corners])

    def __getitem__(self, chosen: Ints | Mask) -> ClothSamples:
        return ClothSamples(self.corners[chosen], self.weights[chosen])

    def __add__(self, other: ClothSamples) -> ClothSamples:
        return ClothSamples(
            *(np.concatenate(rows) for rows in zip((self.corners, self.weights), (other.corners, other.weights)))
        )


def sample_cloth(points: Floats, faces: Ints) -> ClothSamples:
    """Return samples of all vertices of faces, and on a grid in each triangle, `SAMPLE_SPACING` apart."""
    used = np.unique(faces)
    corners, weights = [np.repeat(used[:, None], 3, axis=1)], [np.tile([1.0, 0, 0], (len(used), 1))]
    sides = points[faces] - points[np.roll(faces, 1, axis=1)]
    longest = np.linalg.norm(sides, axis=2).max(axis=1, initial=0.0)
    order = np.clip(np.ceil(longest / SAMPLE_SPACING), 2, MAX_ORDER).astype(int)
    for size in np.unique(order):
        inner = _grid(int(size))
        chosen = faces[order == size]
        corners.append(np.repeat(chosen, len(inner), axis=0))
        weights.append(np.tile(inner, (len(chosen), 1)))
    return _distinct(ClothSamples(np.concatenate(corners), np.concatenate(weights)))


def _distinct(samples: ClothSamples) -> ClothSamples:
    """Return each sample once: those on an edge belong to both of its triangles. Vertices stay first."""
    used = samples.weights > 0
    corners = np.where(used, samples.corners, -1)
    order = np.argsort(corners, axis=1, kind="stable")
    keys = np.c_[np.take_along_axis(corners, order, 1), np.take_along_axis(samples.weights, order, 1).round(6)]
    return samples[np.sort(np.unique(keys, axis=0, return_index=True)[1])]


def _grid(order: int) -> Floats:
    """Return barycentric coordinates of a grid on a triangle without its corners, shape (S, 3)."""
    rows = [(i, j, order - i - j) for i in range(order + 1) for j in range(order + 1 - i)]
    return np.array([row for row in rows if max(row) < order]) / order
