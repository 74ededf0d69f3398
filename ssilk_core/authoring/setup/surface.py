# SPDX-License-Identifier: Apache-2.0
"""Closest points on the body's surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, Ints, Mesh
from ...scene.mesh.topology import vertex_normals


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """The closest point of a triangle mesh for each of V queries.

    Attributes:
        distance: distance of the query to that point [m], shape (V,).
        corners: vertices of the triangle that contains the point, shape (V, 3).
        barycentric: barycentric coordinates of the point; rows sum to one, shape (V, 3).
        normals: unit normals, continuous because interpolated from the vertices, shape (V, 3).
    """

    distance: Floats
    corners: Ints
    barycentric: Floats
    normals: Floats


def closest_on_surface(points: Floats, mesh: Mesh) -> SurfacePoints:
    """Return the closest point of `mesh` for each of `points` [m], shape (V, 3)."""
    import igl

    squared, face, found = igl.point_mesh_squared_distance(np.ascontiguousarray(points), mesh.points, mesh.faces)
    corners = mesh.faces[face]
    barycentric = barycentric_coordinates(found, mesh.points[corners])
    normals = np.einsum("vk,vkc->vc", barycentric, vertex_normals(mesh.points, mesh.faces)[corners])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return SurfacePoints(np.sqrt(squared), corners, barycentric, normals / np.maximum(length, 1e-12))


def barycentric_coordinates(points: Floats, triangles: Floats) -> Floats:
    """Return barycentric coordinates of points (V, 3) on triangles (V, 3, 3); slivers snap to the nearest corner."""
    import igl

    corners = [np.ascontiguousarray(triangles[:, corner]) for corner in range(3)]
    with np.errstate(invalid="ignore", divide="ignore"):
        found = np.clip(np.asarray(igl.barycentric_coordinates(points, *corners)), 0, 1)
        found /= found.sum(axis=1, keepdims=True)
    nearest = np.linalg.norm(triangles - points[:, None], axis=2).argmin(axis=1)
    return np.where(np.isfinite(found).all(axis=1, keepdims=True), found, np.eye(3)[nearest])


def is_enclosed(points: Floats, mesh: Mesh) -> NDArray[np.bool_]:
    """Return whether a closed mesh encloses points (S, 3): their winding number exceeds 0.5, shape (S,)."""
    import igl

    if not len(points):
        return np.zeros(0, dtype=bool)
    winding = igl.fast_winding_number(mesh.points, mesh.faces, np.ascontiguousarray(points))
    return np.abs(winding) > 0.5
