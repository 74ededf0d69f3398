# SPDX-License-Identifier: Apache-2.0
"""Which rays a moving triangle mesh blocks (numpy only, so that Blender runs it as well).

From frame to frame a ray is mostly blocked by the same triangle, or by one near it. A search therefore starts at the
last one and walks over the mesh to where the line of the ray passes through. Only where that leads nowhere, all
triangles are searched by the bounding spheres of compact blocks.
"""

from __future__ import annotations

import numpy as np

from ...scene.assets import Floats, Ints
from ...scene.mesh.blocks import compact_blocks
from ...scene.mesh.topology import edge_keys, half_edges

BLOCK = 16  # triangles
MAX_PAIRS = 1 << 21  # of a ray and a block, or a ray and a triangle, in memory at once
MAX_STEPS = 24  # of a walk
ROUNDING = 1e-6  # [m2], of squared distances in float32
EDGE_SLACK = 1e-5  # in barycentric coordinates, so that no ray slips between two triangles
NO_TRIANGLE = -1


class BlockedRays:
    """Finds for each of many rays a triangle that blocks it, in any pose of a mesh.

    Args:
        points: vertices in some pose (V, 3); they tell only which triangles lie close together.
        faces: triangles (F, 3).
    """

    def __init__(self, points: Floats, faces: Ints) -> None:
        self.faces = np.asarray(faces)
        self.neighbours = neighbouring_faces(self.faces)
        self.blocks = compact_blocks(points[faces].mean(axis=1), BLOCK)

    def find(
        self, points: Floats, starts: Floats, directions: Floats, low: Floats, high: Floats, guesses: Ints
    ) -> tuple[Ints, Floats]:
        """Return for each ray a triangle that it meets (R,), or `NO_TRIANGLE`, and its distance there [m] (R,).

        Of several triangles any one is returned.

        Args:
            points: vertices in this pose (V, 3).
            starts, directions: of the rays, (R, 3); directions of unit length.
            low, high: the part of each ray that counts, as distances from its start [m], (R,).
            guesses: a triangle to start from, or `NO_TRIANGLE`, (R,).
        """
        found, distances = np.full(len(starts), NO_TRIANGLE), np.full(len(starts), np.inf)
        rays = np.flatnonzero(guesses != NO_TRIANGLE)
        at = guesses[rays]
        for _ in range(MAX_STEPS):
            if not len(rays):
                break
            weights, distance = _meet(points[self.faces[at]], starts[rays], directions[rays])
            through = weights.min(axis=0) >= -EDGE_SLACK
            hit = through & (distance >= low[rays]) & (distance <= high[rays])
            found[rays[hit]], distances[rays[hit]] = at[hit], distance[hit]
            onward = self.neighbours[at, weights.argmin(axis=0)]
            on = ~through & (onward != NO_TRIANGLE)
            rays, at = rays[on], onward[on]
        missing = np.flatnonzero(found == NO_TRIANGLE)
        if len(missing):
            part = starts[missing], directions[missing], low[missing], high[missing]
            found[missing], distances[missing] = self._search(points, *part)
        return found, distances

    def _search(
        self, points: Floats, starts: Floats, directions: Floats, low: Floats, high: Floats
    ) -> tuple[Ints, Floats]:
        """Return the result of `find`, from all triangles."""
        found, distances = np.full(len(starts), NO_TRIANGLE), np.full(len(starts), np.inf)
        if not len(self.blocks):
            return found, distances
        corners = np.ascontiguousarray(points.T)[:, self.faces[self.blocks].reshape(len(self.blocks), -1)]
        centres = (corners.min(axis=2) + corners.max(axis=2)) / 2
        radii = np.linalg.norm(corners - centres[..., None], axis=0).max(axis=1) * (1 + EDGE_SLACK)
        centres = np.ascontiguousarray(centres.T)
        many = max(1, MAX_PAIRS // len(self.blocks))
        for first in range(0, len(starts), many):
            rays = slice(first, first + many)
            ray, block = self._near(starts[rays], directions[rays], low[rays], high[rays], centres, radii)
            for part in range(0, len(ray), MAX_PAIRS // BLOCK):
                chosen = slice(part, part + MAX_PAIRS // BLOCK)
                each = np.repeat(ray[chosen] + first, BLOCK)
                triangle = self.blocks[block[chosen]].reshape(-1)
                weights, distance = _meet(points[self.faces[triangle]], starts[each], directions[each])
                within = (distance >= low[each]) & (distance <= high[each])
                hit = within & (weights.min(axis=0) >= -EDGE_SLACK)
                found[each[hit]], distances[each[hit]] = triangle[hit], distance[hit]
        return found, distances

    @staticmethod
    def _near(
        starts: Floats, directions: Floats, low: Floats, high: Floats, centres: Floats, radii: Floats
    ) -> tuple[Ints, Ints]:
        """Return the pairs of rays and spheres that meet."""
        to = directions @ centres.T - (directions * starts).sum(axis=1)[:, None]
        square = (starts * starts).sum(axis=1)[:, None] + (centres * centres).sum(axis=1) - 2 * starts @ centres.T
        nearest = to.clip(low[:, None], high[:, None])
        ray, sphere = np.nonzero(square + nearest * (nearest - 2 * to) <= radii * radii + ROUNDING)
        return ray, sphere


def _meet(corners: Floats, starts: Floats, directions: Floats) -> tuple[Floats, Floats]:
    """Intersect lines with the planes of triangles, by Cramer's rule.

    Args:
        corners: (R, 3, 3); starts, directions: (R, 3).

    Returns:
        Barycentric coordinates (3, R) and distances along the lines (R,), not finite where they are parallel.
    """
    # Long rows take numpy a fraction of the time of sums and minima over three columns.
    a, b, c = (np.ascontiguousarray(corners[:, corner].T) for corner in range(3))
    start, direction = np.ascontiguousarray(starts.T), np.ascontiguousarray(directions.T)
    first, second, away = b - a, c - a, start - a
    across, turned = _cross(direction, second), _cross(away, first)
    volume = _dot(first, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = _dot(away, across) / volume, _dot(direction, turned) / volume
        return np.stack([1 - u - v, u, v]), _dot(second, turned) / volume


def _dot(a: Floats, b: Floats) -> Floats:
    """Return scalar products (R,) of vectors (3, R)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Floats, b: Floats) -> Floats:
    """Return cross products of vectors (3, R); `numpy.cross` takes twice as long."""
    (ax, ay, az), (bx, by, bz) = a, b
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def neighbouring_faces(faces: Ints) -> Ints:
    """Return the triangle across the edge opposite each corner, shape (F, 3); `NO_TRIANGLE` at borders.

    Edges of more than two triangles count as borders.
    """
    _, group, uses = np.unique(edge_keys(half_edges(faces)), return_inverse=True, return_counts=True)
    order = np.argsort(group, kind="stable")
    starts = np.concatenate([[0], np.cumsum(uses)[:-1]])[uses == 2]
    first, second = order[starts], order[starts + 1]
    across = np.full(3 * len(faces), NO_TRIANGLE)
    across[first], across[second] = second // 3, first // 3
    return np.roll(across.reshape(-1, 3), 2, axis=1)  # edge k runs from corner k to k + 1; corner k + 2 is opposite
