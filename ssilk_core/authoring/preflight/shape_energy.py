# SPDX-License-Identifier: Apache-2.0
"""How much a settled garment differs in shape from the authored one: as rigid as possible, in length and in bend."""

from __future__ import annotations

import numpy as np

from ...scene.assets import Floats, Ints
from ...scene.mesh.laplacian import cotangent_weights, laplacian
from ...scene.mesh.topology import edges, vertex_areas

BEND_LENGTH = 0.005  # [m] wavelength below which bending resists more than stretching
PULL_LENGTH = 0.1  # [m] over which the pull towards the authored places outweighs stretching
COTANGENTS = (0.1, 4.0)  # bounds of the edge weights; slivers would exceed them
LAYER_STIFFNESS = 10.0  # of the tie between two layers, relative to an edge


class ShapeEnergy:
    """A quadratic energy of positions x (V, 3), for given rotations R of the vertices' surroundings.

    Sum over edges of w |(x_i - x_j) - R (p_i - p_j)|^2, with cotangent weights w and authored places p (Sorkine and
    Alexa 2007, As-Rigid-As-Possible Surface Modeling), the same for the curvature (L x)_i - R_i (L p)_i, a pull
    |x_i - p_i|^2 for each area, and |(x_i - p_i) - (x_j - p_j)|^2 for ties (i, j) of layers.
    """

    def __init__(self, points: Floats, faces: Ints, ties: Ints) -> None:
        import scipy.sparse as sparse

        count = len(points)
        self.authored, self.pairs = points, edges(faces)
        self.weights = cotangent_weights(points, faces, self.pairs, COTANGENTS)
        area = np.maximum(vertex_areas(points, faces), 1e-8)
        self.laplacian = laplacian(self.pairs, self.weights, count)
        self.smoother = BEND_LENGTH**2 * (self.laplacian @ sparse.diags(1 / area)).tocsr()
        self.fixed = (sparse.diags(area / PULL_LENGTH**2) + laplacian(ties, LAYER_STIFFNESS, count)).tocsr()
        self.matrix = (self.laplacian + self.smoother @ self.laplacian + self.fixed).tocsr()
        self.curvature = self.laplacian @ points
        self.pulled = self.fixed @ points
        self.offsets = points[self.pairs[:, 0]] - points[self.pairs[:, 1]]

    def load(self, points: Floats) -> Floats:
        """Return the right-hand side b of `matrix` x = b, shape (V, 3), for the rotations that fit `points` best."""
        rotations = self._rotations(points)
        first, second = self.pairs.T
        turned = np.einsum("eij,ej->ei", 0.5 * (rotations[first] + rotations[second]), self.offsets)
        turned *= self.weights[:, None]
        load = _scattered(first, turned, len(points)) - _scattered(second, turned, len(points))
        return load + self.smoother @ np.einsum("vij,vj->vi", rotations, self.curvature) + self.pulled

    def _rotations(self, points: Floats) -> Floats:
        """Return the rotations that take the authored edges around each vertex to the present ones, (V, 3, 3)."""
        first, second = self.pairs.T
        present = points[first] - points[second]
        products = (self.weights[:, None, None] * present[:, :, None] * self.offsets[:, None, :]).reshape(-1, 9)
        total = _scattered(first, products, len(points)) + _scattered(second, products, len(points))
        left, _, right = np.linalg.svd(total.reshape(-1, 3, 3))
        left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
        return np.asarray(left @ right)


def _scattered(index: Ints, rows: Floats, count: int) -> Floats:
    return np.stack([np.bincount(index, column, minlength=count) for column in rows.T], axis=1)
