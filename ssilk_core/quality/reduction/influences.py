# SPDX-License-Identifier: Apache-2.0
"""Fewer influences: weights of fewer joints that change each vertex's position least.

With p_c the position of a vertex under joint c alone, it lies at x = sum_c w_c p_c. Other weights v, with sum one,
displace it by sum_c (v_c - w_c) p_c. The mean square of that over frames is (v - w)^T H (v - w) with
H_cd = mean (p_c - x) . (p_d - x).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, Ints

VERTICES_PER_BLOCK = 64  # vertices; H of so many takes some 50 MB of positions
RIDGE = 1e-3  # regularisation towards the original weights, relative to H, for joints that move alike


@dataclass(frozen=True, eq=False)
class InfluenceCandidates:
    """Weights of each vertex over its candidate joints, and the cost of changing them.

    Attributes:
        joints: candidates, shape (V, C), -1 where a vertex has fewer.
        weights: w, shape (V, C), zero for candidates that do not move the vertex.
        costs: H of each vertex, shape (V, C, C) [m2].
    """

    joints: Ints
    weights: Floats
    costs: Floats

    def error(self, weights: Floats) -> Floats:
        """Return the mean squared distances (V,) [m2] by which other weights (V, C) move the vertices."""
        change = weights - self.weights
        return np.einsum("vc,vcd,vd->v", change, self.costs, change).clip(min=0)

    def of(self, rows: Ints) -> InfluenceCandidates:
        """Return the candidates of some vertices."""
        return InfluenceCandidates(self.joints[rows], self.weights[rows], self.costs[rows])


def measure_costs(joints: Ints, weights: Floats, matrices: NDArray, points: NDArray) -> InfluenceCandidates:
    """Measure the cost of changing weights.

    Args:
        joints, weights: as in `InfluenceCandidates`.
        matrices: skinning matrices of all joints (J + P, 3, 4, F); points: unskinned ones (V, 3, F) [m].
    """
    costs = np.empty((*joints.shape, joints.shape[1]))
    for start in range(0, len(joints), VERTICES_PER_BLOCK):
        rows = slice(start, start + VERTICES_PER_BLOCK)
        carried = transform_by_each(joints[rows], matrices, points[rows])
        carried -= np.einsum("vc,vcaf->vaf", weights[rows], carried)[:, None]
        flat = carried.reshape(*joints[rows].shape, -1)
        costs[rows] = flat @ flat.swapaxes(1, 2) / points.shape[2]
    return InfluenceCandidates(joints, weights, costs)


def transform_by_each(joints: Ints, matrices: NDArray, points: NDArray) -> NDArray:
    """Return the position of each point under each joint alone, shape (V, C, 3, F)."""
    chosen = matrices[joints].astype(np.float64)
    return np.einsum("vcabf,vbf->vcaf", chosen[:, :, :, :3], points) + chosen[:, :, :, 3]


def fit_weights(influences: InfluenceCandidates, allowed: NDArray, most: int) -> Floats:
    """Return non-negative weights (V, C) that sum to one, of at most `most` of the `allowed` candidates (V, C).

    They displace each vertex least for the remaining candidates. Candidates are removed one at a time, first those
    with a negative weight, then that with the least cost w_c^2 / [K^-1]_cc, with K the matrix of the constrained
    least squares.
    """
    allowed, weights = allowed.copy(), np.empty(influences.weights.shape)
    rows = np.arange(len(weights))
    while len(rows):
        found, missed = _constrained(influences.of(rows), allowed[rows])
        weights[rows] = found
        negative, many = found.min(axis=1) < 0, allowed[rows].sum(axis=1) > most
        dropped = np.where(negative, np.where(allowed[rows], found, np.inf).argmin(axis=1), missed.argmin(axis=1))
        allowed[rows[negative | many], dropped[negative | many]] = False
        rows = rows[negative | many]
    return weights


def _constrained(influences: InfluenceCandidates, allowed: NDArray) -> tuple[Floats, Floats]:
    """Return the best weights of any sign that sum to one (V, C), and the cost of removing each (V, C)."""
    count, size = allowed.shape
    scale = np.einsum("vcc->v", influences.costs)[:, None, None] / size + 1e-30
    both = allowed[:, :, None] & allowed[:, None]
    costs = influences.costs / scale
    system = np.zeros((count, size + 1, size + 1))
    system[:, :size, :size] = np.where(both, costs, 0)
    diagonal = np.arange(size)
    system[:, diagonal, diagonal] += np.where(allowed, RIDGE, 1)
    system[:, :size, size] = system[:, size, :size] = allowed
    pull = np.einsum("vcd,vd->vc", costs, influences.weights) + RIDGE * influences.weights
    inverse = np.linalg.inv(system)
    wanted = np.append(pull * allowed, np.ones((count, 1)), axis=1)
    weights = np.where(allowed, (inverse @ wanted[:, :, None])[:, :size, 0], 0)
    missed = weights**2 / np.maximum(inverse[:, diagonal, diagonal], 1e-30)
    return weights, np.where(allowed, missed, np.inf)
