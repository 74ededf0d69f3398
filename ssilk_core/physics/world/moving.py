# SPDX-License-Identifier: Apache-2.0
"""A mesh that changes its shape with each frame, in loops that numba compiles; reference: `surface.PosedSurface`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, Ints
from ...scene.mesh.blocks import compact_blocks
from .surface import ON_EDGE, CollisionSurface, Garment, SurfaceDistance

TRIANGLES = 4  # of a block


class Found(NamedTuple):
    """What is nearest to M queries in N frames, as `loops.moving_surface.nearest_on_moving` writes it."""

    face: Ints
    weights: Floats
    normal: Floats
    squares: Floats
    whole: Floats
    volumes: Floats


class MovingSurface:
    """Takes a surface from pose to pose.

    Args:
        points: of its mesh in some frame, shape (P, 3), in which blocks of triangles are compact.
    """

    def __init__(self, surface: CollisionSurface, points: Floats) -> None:
        self.surface = surface
        self._faces = np.ascontiguousarray(surface.faces, dtype=np.int32)
        self._part = np.ascontiguousarray(surface.part, dtype=np.int32)
        self._blocks = compact_blocks(points[surface.faces].mean(axis=1), TRIANGLES)
        self._at_edges, self._at_vertices = (_listed(numbers) for numbers in (surface.edge, surface.welded))

    def met(self, points: Floats, queries: Floats, garment: Garment, low: Floats, high: Floats) -> SurfaceDistance:
        """Return the distances of queries (N, M, 3) in N frames, as `PosedSurface.met`.

        Args:
            points: of the mesh in these [m], shape (N, P, 3).
        """
        found = self._nearest(points, queries)
        inside = (low >= found.whole[:, :3]).all(axis=1) & (high <= found.whole[:, 3:]).all(axis=1)
        sides = np.ones((len(points), len(self.surface.closed)))
        inside_out = (found.volumes[:, self.surface.closed] <= 0).any(axis=1)
        for frame in np.flatnonzero(inside | inside_out | ~self.surface.closed.all()):
            here, voters, wound = points[frame, None], garment(frame)[None], np.ones_like(sides[:1])
            sides[frame] = self.surface.voted(self._signed(here, voters, self._nearest(here, voters), wound))
        return self._signed(points, queries, found, sides)

    def _nearest(self, points: Floats, queries: Floats) -> Found:
        from ..loops.moving_surface import nearest_on_moving

        shape = queries.shape[:2]
        found = Found(
            np.empty(shape, np.int32), np.empty(queries.shape), np.empty(queries.shape), np.empty(shape),
            np.empty((len(points), 6)), np.empty((len(points), len(self.surface.closed))),
        )  # fmt: skip
        mesh = (
            np.ascontiguousarray(points),
            self._faces,
            self._part,
            self._blocks,
            self._at_edges,
            self._at_vertices,
            ON_EDGE,
        )
        nearest_on_moving(*mesh, np.ascontiguousarray(queries), *found)
        return found

    def _signed(self, points: Floats, queries: Floats, found: Found, sides: Floats) -> SurfaceDistance:
        rows, face, weights = np.arange(len(points))[:, None], found.face.reshape(-1), found.weights.reshape(-1, 3)
        corners = points[rows[..., None], self._faces[found.face]]
        away = queries - np.einsum("nmk,nmkc->nmc", found.weights, corners)
        turned = sides[rows, self.surface.part[found.face]].reshape(-1)
        length, normal = np.sqrt(found.squares).reshape(-1), found.normal.reshape(-1, 3)
        return self.surface.signed(away.reshape(-1, 3), length, face, weights, normal, turned)


def _listed(numbers: Ints) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Return numbers (T, 3), where each stands among them, (3 T,), and where each begins in that."""
    flat = numbers.reshape(-1)
    order = np.argsort(flat, kind="stable")
    begins = np.searchsorted(flat[order], np.arange(flat.max() + 2))
    return numbers.astype(np.int32), order.astype(np.int32), begins.astype(np.int32)
