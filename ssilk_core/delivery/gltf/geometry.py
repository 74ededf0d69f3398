# SPDX-License-Identifier: Apache-2.0
"""Meshes as graphics cards draw them: triangles, one texture coordinate for each vertex, normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, Ints, Mesh


@dataclass(frozen=True, eq=False)
class DrawnMesh:
    """A mesh with one texture coordinate for each vertex.

    Attributes:
        source: which point of the mesh each vertex is, shape (N,). The first ones are all points in their order.
            Points on a seam of the texture follow again, once for each further coordinate.
        faces: triangles of vertices, shape (F, 3).
        uvs: texture coordinates from the upper left corner, shape (N, 2), or None.
    """

    source: Ints
    faces: Ints
    uvs: Floats | None


def drawn_mesh(mesh: Mesh, hidden: NDArray[np.bool_] | None = None) -> DrawnMesh:
    """Return a mesh as it is drawn.

    Args:
        hidden: polygons that are left out, shape (polygons,).
    """
    counts = np.asarray(mesh.polygon_counts, dtype=np.int64)
    polygons = np.repeat(np.arange(len(counts)), counts - 2)  # triangles follow the order of their polygons
    kept = slice(None) if hidden is None else ~hidden[polygons]
    faces, points = mesh.faces[kept], np.arange(mesh.vertex_count)
    if mesh.uvs is None:
        return DrawnMesh(points, faces, None)
    uvs = mesh.uvs[_corners(mesh, faces, polygons[kept])].reshape(-1, 2)
    pairs = np.column_stack([faces.reshape(-1).astype(np.float64), uvs])
    unique, first, inverse = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    owner = unique[:, 0].astype(np.int64)
    leading = np.concatenate([[True], owner[1:] != owner[:-1]])  # sorted by point: its first coordinate stays there
    place = np.where(leading, owner, 0)
    place[~leading] = mesh.vertex_count + np.arange(np.count_nonzero(~leading))
    found = np.zeros((mesh.vertex_count + np.count_nonzero(~leading), 2), dtype=np.float32)
    found[place] = uvs[first] * [1, -1] + [0, 1]
    return DrawnMesh(np.concatenate([points, owner[~leading]]), place[inverse.reshape(-1)].reshape(-1, 3), found)


def _corners(mesh: Mesh, faces: Ints, polygons: Ints) -> Ints:
    """Return which polygon corner each corner of a triangle is, shape (F, 3)."""
    owners = np.repeat(np.arange(len(mesh.polygon_counts)), mesh.polygon_counts)  # type: ignore[arg-type]
    keys = owners * mesh.vertex_count + mesh.indices_of_corners
    order = np.argsort(keys, kind="stable")
    return order[np.searchsorted(keys[order], polygons[:, None] * mesh.vertex_count + faces)]


class ShapeNormals:
    """Normals of a mesh at rest, and how they turn with its blendshapes.

    A normal n = N / |N| is the mean of the normals of the faces around, weighted by area. N is quadratic in the
    points, so an offset d changes n by (I - n n^T) N'(d) / |N| to first order. First order is what adds up, since
    viewers add the changes of all blendshapes by their weights.

    Attributes:
        rest: unit normals, shape (V, 3); y for points without faces.
    """

    def __init__(self, points: Floats, faces: Ints) -> None:
        self._points, self._faces = points[faces], faces
        total = self._around(np.cross(self._side(self._points, 1), self._side(self._points, 2)), len(points))
        self._length = np.linalg.norm(total, axis=1, keepdims=True)
        flat = self._length > 0
        self.rest = np.where(flat, total / np.where(flat, self._length, 1), [0.0, 1.0, 0.0])

    def change(self, offsets: Floats) -> Floats:
        """Return the change of the normals for offsets of the points (V, 3), of the same shape."""
        moved = np.asarray(offsets, dtype=np.float64)[self._faces]
        b, c, db, dc = (self._side(of, at) for of in (self._points, moved) for at in (1, 2))
        change = self._around(np.cross(db, c) + np.cross(b, dc), len(offsets))
        across = change - self.rest * np.sum(self.rest * change, axis=1, keepdims=True)
        return np.divide(across, self._length, out=np.zeros_like(across), where=self._length > 0)

    @staticmethod
    def _side(corners: Floats, at: int) -> NDArray[np.float64]:
        return corners[:, at] - corners[:, 0]

    def _around(self, of_faces: Floats, count: int) -> Floats:
        """Return the sums of vectors (F, 3) over the faces around each point."""
        each = np.repeat(of_faces, 3, axis=0)
        corners = self._faces.reshape(-1)
        return np.stack([np.bincount(corners, axis, minlength=count) for axis in each.T], axis=-1)
