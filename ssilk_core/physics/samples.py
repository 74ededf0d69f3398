# SPDX-License-Identifier: Apache-2.0
"""The points of the cloth at which it meets the body.

An integral over the cloth is a sum over its vertices and over points inside its triangles, each with the area that it
stands for. Finer meshes have more points with less area each, so that the sum depends on the garment and not on its
mesh. Samples are about `MAX_SPACING` apart, so that a vertex of the body does not pass between them unnoticed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..scene.assets import LOOSE, PINNED, TIGHT, Floats, Ints, Mesh
from ..scene.fabrics import Fabric
from ..scene.mesh import topology

MAX_SPACING = 0.02  # [m] between the samples of a triangle, at rest
MAX_DIVISIONS = 8  # of an edge: 64 samples in a large triangle


@dataclass(frozen=True, eq=False)
class ContactSamples:
    """Samples of a garment; the first V are its vertices.

    Attributes:
        corners: vertices of each sample's triangle; three times the same one for a vertex, shape (S, 3).
        weights: barycentric coordinates, shape (S, 3).
        area: what the sample stands for at rest [m2]; 1 for the paper's energy, which counts vertices, shape (S,).
        faces: the triangle of each sample that is no vertex, shape (S - V,); None for the paper's energy.
    """

    vertex_count: int
    corners: Ints
    weights: Floats
    area: Floats
    faces: Ints | None = None

    def points(self, vertices: Floats) -> Floats:
        """Return the samples' positions (S, 3) on a mesh of `vertices` (V, 3)."""
        return np.einsum("sk,skc->sc", self.weights, vertices[self.corners])

    def classes(self, classes: Ints) -> Ints:
        """Return the class of each sample (S,): pinned if all corners are, loose if most of its weight is."""
        loose = (self.weights * (classes[self.corners] == LOOSE)).sum(axis=1) >= 0.5
        pinned = ((self.weights > 0) <= (classes[self.corners] == PINNED)).all(axis=1)
        return np.where(pinned, PINNED, np.where(loose, LOOSE, TIGHT)).astype(classes.dtype)


def vertex_samples(vertex_count: int) -> ContactSamples:
    """Return one sample at each vertex, each of unit area."""
    corners = np.repeat(np.arange(vertex_count)[:, None], 3, axis=1)
    return ContactSamples(vertex_count, corners, np.tile([1.0, 0, 0], (vertex_count, 1)), np.ones(vertex_count))


def contact_samples(mesh: Mesh, fabric: Fabric) -> ContactSamples:
    """Return the samples at which a garment of a fabric meets the body.

    Large triangles are divided into n^2 equal ones, with a sample in the middle of each. The corners stand for
    1 / (1 + 3 n^2) of the area: so the rule integrates quadratic functions exactly for every n.
    """
    vertices = vertex_samples(mesh.vertex_count)
    if fabric.contact_model == "vertex":
        return vertices
    faces = mesh.faces
    a, b, c = (mesh.points[faces[:, corner]] for corner in range(3))
    area = topology.face_areas(mesh.points, faces)
    longest = np.max([np.linalg.norm(side, axis=1) for side in (b - a, c - b, a - c)], axis=0)
    # The middles of equal triangles are apart by 1 / sqrt(3) of their edge.
    divisions = np.ceil(longest / np.sqrt(3) / MAX_SPACING).clip(1, MAX_DIVISIONS).astype(int)
    at_corners = area / (1 + 3 * divisions**2)
    corners, weights, of = [vertices.corners], [vertices.weights], [np.zeros(0, dtype=np.int64)]
    areas = [np.bincount(faces.reshape(-1), np.repeat(at_corners / 3, 3), mesh.vertex_count)]
    for n in np.unique(divisions):
        own, middles = divisions == n, topology.subdivision_middles(n)
        corners.append(np.repeat(faces[own], len(middles), axis=0))
        weights.append(np.tile(middles, (own.sum(), 1)))
        of.append(np.repeat(np.flatnonzero(own), len(middles)))
        areas.append(np.repeat((area - at_corners)[own] / len(middles), len(middles)))
    return ContactSamples(
        mesh.vertex_count, np.concatenate(corners), np.concatenate(weights), np.concatenate(areas), np.concatenate(of)
    )
