# SPDX-License-Identifier: Apache-2.0
"""Faces of an inner garment that may be hidden, because nothing sees them in any frame (numpy only).

Cloth has two sides. Its outside is covered as skin is (`hidden_faces`), by the outer garment in place of cloth. Its
inside is covered likewise by the body: who looks into a skirt from below sees its inside, whatever is worn over it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, Ints, Mesh
from ...scene.mesh.topology import components, edges, face_crosses, merged_places, vertex_normals
from .hidden_faces import HiddenFaces

AT_ONCE = 1 << 22  # distances in memory


class HiddenCloth:
    """Triangles of an inner garment that an outer one and the body have covered in every frame so far.

    Args:
        inner, outer: the garments in the bind pose, which counts as a frame.
        body: in the bind pose.
    """

    def __init__(self, inner: Mesh, outer: Mesh, body: Mesh) -> None:
        outward = turned_outward(inner, body)
        inward = np.ascontiguousarray(outward[:, ::-1])
        self._outside = HiddenFaces(replace(inner, faces=outward), outer)
        self._inside = HiddenFaces(replace(inner, faces=inward), body)

    def add(self, inner: Floats, outer: Floats, body: Floats) -> None:
        """Take a frame into account: vertices of all three (V, 3), (U, 3) and (B, 3) [m] in one space."""
        if self._outside.covered.any() and self._inside.covered.any():
            self._outside.add(inner, outer)
            self._inside.add(inner, body)

    def mask(self) -> NDArray[np.bool_]:
        """Return which triangles of the inner garment may be hidden, shape (F,)."""
        return self._outside.mask() & self._inside.mask()


def turned_outward(inner: Mesh, body: Mesh) -> Ints:
    """Return the triangles of an inner garment with the order of corners that faces away from the body, (F, 3).

    Each part that hangs together is turned as a whole, as most of its area says by the skin nearest to it.
    """
    faces, points = inner.faces, inner.points
    cross, middles = face_crosses(points, faces), points[faces].mean(axis=1)
    away = vertex_normals(body.points, body.faces)[_nearest(middles, body.points)]
    place = merged_places(points)
    part = components(edges(place[faces]), len(points))[place[faces[:, 0]]]
    inward = np.bincount(part, (cross * away).sum(axis=1), part.max(initial=0) + 1) < 0
    return np.where(inward[part][:, None], faces[:, ::-1], faces)


def _nearest(points: Floats, others: Floats) -> Ints:
    """Return the index of the nearest of other points (B, 3) to each (P, 3), shape (P,)."""
    found = np.zeros(len(points), dtype=np.int64)
    many = max(1, AT_ONCE // max(1, len(others)))
    for first in range(0, len(points), many):
        square = (others**2).sum(axis=1) - 2 * points[first : first + many] @ others.T
        found[first : first + many] = square.argmin(axis=1)
    return found
