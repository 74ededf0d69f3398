# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes at the bind pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import fail
from .arrays import Floats, Ints, assign, frozen, need_finite

SOFTEST, STIFFEST = 0.01, 100.0  # of a fabric's own resistance to stretching and bending
ROUNDING = 1e-6  # of values that were stored as float32


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh at the bind pose, in world space.

    Attributes:
        path: prim path (and file), for messages and for writing back.
        points: positions [m], shape (V, 3).
        faces: triangles, shape (F, 3).
        polygon_counts, polygon_indices: the authored polygons, for writing back; by default the triangles.
        uvs: texture coordinates per polygon corner, shape (len(polygon_indices), 2), or None.
        stiffness: of cloth at each vertex, by which its fabric's resistance to stretching and to bending is
            multiplied, shape (V,); None where it is 1 everywhere.

    Raises:
        SsilkError: a shape or an index does not fit, a value is not finite, or a stiffness is out of range.
    """

    path: str
    points: Floats
    faces: Ints
    polygon_counts: Ints | None = None
    polygon_indices: Ints | None = None
    uvs: Floats | None = None
    stiffness: Floats | None = None

    def __post_init__(self) -> None:
        assign(self, points=frozen(self.points, np.float64), faces=frozen(self.faces, np.int64))
        self._check_triangles()
        counts = np.full(len(self.faces), 3) if self.polygon_counts is None else self.polygon_counts
        indices = self.faces.reshape(-1) if self.polygon_indices is None else self.polygon_indices
        uvs = None if self.uvs is None else frozen(self.uvs, np.float32)
        assign(self, polygon_counts=frozen(counts, np.int32), polygon_indices=frozen(indices, np.int32), uvs=uvs)
        self._check_polygons(int(np.sum(counts)))
        if self.stiffness is not None:
            assign(self, stiffness=self._checked_stiffness(frozen(self.stiffness, np.float64)))

    def _checked_stiffness(self, stiffness: Floats) -> Floats | None:
        if stiffness.shape != (len(self.points),):
            found = f"{stiffness.size} values of stiffness for {len(self.points)} points"
            fail(self.path, found, "primvars:ssilk:stiffness needs one for each point", "paint it again")
        within = (stiffness >= SOFTEST * (1 - ROUNDING)) & (stiffness <= STIFFEST * (1 + ROUNDING))
        bad = np.flatnonzero(~within)  # NaN too
        if len(bad):
            found = f"a stiffness of {stiffness[bad[0]]:g} at {len(bad)} points, first at point {bad[0]}"
            allowed = f"{SOFTEST:g} to {STIFFEST:g} times the fabric's are allowed"
            fail(self.path, found, allowed, "paint less, or choose another fabric")
        return None if (stiffness == 1).all() else stiffness

    def _check_triangles(self) -> None:
        points, faces = self.points, self.faces
        if not (points.ndim == 2 and points.shape[-1] == 3 and len(points) > 0):
            fail(self.path, "the mesh has no points", "a mesh needs points and faces")
        if not (faces.ndim == 2 and faces.shape[-1] == 3 and len(faces) > 0):
            fail(self.path, "the mesh has no faces", "a mesh needs points and faces")
        need_finite(points, self.path, "points")
        bad = int(np.count_nonzero((faces < 0) | (faces >= len(points))))
        if bad != 0:
            fail(
                self.path,
                f"{bad} face indices lie outside 0 to {len(points) - 1}",
                "an index names a point of the mesh",
                "re-export the mesh",
            )

    def _check_polygons(self, count: int) -> None:
        corners, uvs, last = self.indices_of_corners, self.uvs, len(self.points) - 1
        if not (count == len(corners) and bool(((corners >= 0) & (corners <= last)).all())):
            fail(
                self.path,
                "the polygons do not fit their points",
                f"counts that add up to {len(corners)} corners, and indices from 0 to {last}, are needed",
                "re-export the mesh",
            )
        if not (uvs is None or uvs.shape == (len(corners), 2)):
            fail(
                self.path, "texture coordinates do not match the face corners", "one (u, v) for each corner is needed"
            )

    @property
    def indices_of_corners(self) -> Ints:
        assert self.polygon_indices is not None
        return self.polygon_indices

    @property
    def diagonal(self) -> float:
        """Length of the diagonal of the bounding box [m]."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @property
    def vertex_count(self) -> int:
        return len(self.points)
