# SPDX-License-Identifier: Apache-2.0
"""What displacements of a garment cost: their size, and how sharply they change along the cloth.

With the areas M of the vertices and the cotangent Laplacian L at rest, the cost of u is |M u + l^2 L u|^2 in the
norm of M^-1. A vertex that is pushed takes the cloth around it along, without a spike, and what is farther than a few
lengths l away stays.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ...scene.assets import Floats, Ints, Mesh
from ...scene.mesh import topology
from ...scene.mesh.laplacian import cotangent_weights, laplacian
from ...scene.mesh.stitches import find_stitches

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix

COTANGENTS = (0.05, 5.0)  # bounds of the Laplacian's weights, which slivers leave
SMALLEST = 0.05  # of the mean area: the least that a vertex counts, so that slivers do not fly


class DisplacementMetric:
    """The cost of displacements of one garment.

    Args:
        mesh: in the bind pose.
        length: over which a push spreads [m].

    Attributes:
        matrix: K (V, V), without units, about one on the diagonal where the length is below that of an edge.
    """

    def __init__(self, mesh: Mesh, length: float) -> None:
        import scipy.sparse as sparse

        count, pairs = mesh.vertex_count, topology.edges(mesh.faces)
        areas = topology.vertex_areas(mesh.points, mesh.faces)
        areas = np.maximum(areas, SMALLEST * areas.mean())
        links = laplacian(pairs, cotangent_weights(mesh.points, mesh.faces, pairs, COTANGENTS), count)
        stitches = find_stitches(mesh)
        if len(stitches.vertices):
            held = np.stack([np.repeat(stitches.vertices, 3), stitches.corners.reshape(-1)], axis=1)
            links = links + laplacian(held, 1.0, count)
        operator = sparse.diags(areas) + length**2 * links
        self.matrix: csc_matrix = (operator @ sparse.diags(1 / areas) @ operator / areas.mean()).tocsc()
        self._faces, self._points = mesh.faces, mesh.points

    def within(self, rows: Ints) -> DisplacementSolver:
        """Return a solver of displacements that are zero at all vertices but these (R,)."""
        return DisplacementSolver(self.matrix[rows][:, rows].tocsc())


class DisplacementSolver:
    """Displacements of some vertices; `matrix` (R, R) is their cost."""

    def __init__(self, matrix: csc_matrix) -> None:
        self.matrix = matrix

    @cached_property
    def _factors(self):
        from scipy.sparse.linalg import splu

        return splu(self.matrix)

    def response(self, forces: Floats) -> Floats:
        """Return the displacements under forces, both (R, N)."""
        return np.asarray(self._factors.solve(np.ascontiguousarray(forces)), dtype=np.float64)
