# SPDX-License-Identifier: Apache-2.0
"""Ray casting against triangles with Embree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...scene.assets import Floats, Ints
from .surface import Geometry


@dataclass(frozen=True, eq=False)
class Hits:
    """Rays that hit a face: indices `rays` (N,), `faces` (N,), `barycentric` (N, 3), `distances` [m] (N,)."""

    rays: Ints
    faces: Ints
    barycentric: Floats
    distances: Floats

    def where(self, kept: np.ndarray) -> Hits:
        """Return the hits for which the mask (N,) is true."""
        return Hits(self.rays[kept], self.faces[kept], self.barycentric[kept], self.distances[kept])


class Tracer:
    """Ray caster for the triangles of a geometry; it releases the GIL, so threads run in parallel."""

    def __init__(self, geometry: Geometry) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.scene = EmbreeScene()
        self.mesh = TriangleMesh(self.scene, geometry.points, geometry.faces)

    def first_hits(self, origin: Floats, directions: Floats) -> Hits:
        """Return the nearest faces along unit rays (N, 3) from one origin (3,)."""
        origins = np.broadcast_to(origin, directions.shape).astype(np.float32)
        found = self.scene.run(origins, directions, output=True)
        rays = np.flatnonzero(found["primID"] >= 0)
        u, v = found["u"][rays], found["v"][rays]
        return Hits(rays, found["primID"][rays], np.stack([1 - u - v, u, v], axis=1), found["tfar"][rays])

    def blocked(self, origins: Floats, directions: Floats) -> np.ndarray:
        """Return whether rays (N, 3) from points (N, 3) hit any face, shape (N,)."""
        directions = np.broadcast_to(directions, origins.shape).astype(np.float32)
        return self.scene.run(np.ascontiguousarray(origins, np.float32), directions, query="OCCLUDED") >= 0
