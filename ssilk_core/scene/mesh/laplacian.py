# SPDX-License-Identifier: Apache-2.0
"""The cotangent Laplacian of a surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..assets import Floats, Ints

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


def cotangent_weights(points: Floats, faces: Ints, pairs: Ints, bounds: tuple[float, float]) -> Floats:
    """Return half the sum of the cotangents opposite each edge (E, 2), within bounds, shape (E,).

    Slivers would exceed any bound, and obtuse angles give negative weights.
    """
    import scipy.sparse as sparse

    count = len(points)
    total = sparse.csr_matrix((count, count))
    for corner in range(3):
        apex, one, other = (faces[:, (corner + step) % 3] for step in range(3))
        u, v = points[one] - points[apex], points[other] - points[apex]
        sine = np.linalg.norm(np.cross(u, v), axis=1)
        cotangent = 0.5 * np.einsum("fc,fc->f", u, v) / np.maximum(sine, 1e-12)
        low, high = np.minimum(one, other), np.maximum(one, other)
        total = total + sparse.coo_matrix((cotangent, (low, high)), shape=(count, count)).tocsr()
    return np.clip(np.asarray(total[pairs[:, 0], pairs[:, 1]]).reshape(-1), *bounds)


def laplacian(pairs: Ints, weights: Floats | float, count: int) -> csr_matrix:
    """Return the matrix L (count, count) with x L x = sum over pairs (i, j) of w (x_i - x_j)^2."""
    import scipy.sparse as sparse

    values = np.broadcast_to(np.asarray(weights, dtype=np.float64), len(pairs))
    links = sparse.coo_matrix((values, (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()
    links = links + links.T
    return (sparse.diags(np.asarray(links.sum(axis=1)).reshape(-1)) - links).tocsr()
