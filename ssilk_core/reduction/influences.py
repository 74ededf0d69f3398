# SPDX-License-Identifier: Apache-2.0
"""Fewer influences: the weights with which fewer joints keep each vertex nearest to where all of them have it.

A vertex that joint c alone would carry to p_c is at x = sum_c w_c p_c. Other weights v, summing to one too, put it
sum_c (v_c - w_c) p_c away from there, whose mean square over frames is (v - w)^T H (v - w) with
H_cd = mean (p_c - x) . (p_d - x).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..assets import Floats, Ints

AT_ONCE = 64  # vertices; H of so many takes some 50 MB of positions
RIDGE = 1e-3  # pull towards the weights that were, relative to H: decides where joints move alike


@dataclass(frozen=True, eq=False)
class InfluenceCandidates:
    """Weights of each vertex over its candidate joints, and what others would cost.

    Attributes:
        joints: candidates, shape (V, C), -1 where a vertex has fewer.
        weights: w, shape (V, C), zero for candidates that do not move the vertex.
        costs: H of each vertex, shape (V, C, C) [m2].
    """

    joints: Ints
    weights: Floats
    costs: Floats

    def lost(self, weights: Floats) -> Floats:
        """Return the mean squared distances (V,) [m2] by which other weights (V, C) move the vertices."""
        change = weights - self.weights
        return np.einsum("vc,vcd,vd->v", change, self.costs, change).clip(min=0)

    def of(self, rows: Ints) -> InfluenceCandidates:
        """Return those of some vertices."""
        return InfluenceCandidates(self.joints[rows], self.weights[rows], self.costs[rows])


def measured(joints: Ints, weights: Floats, matrices: NDArray, points: NDArray) -> InfluenceCandidates:
    """Measure what other weights cost.

    Args:
        joints, weights: as in `InfluenceCandidates`.
        matrices: skinning matrices of all joints (J + P, 3, 4, F); points: unskinned ones (V, 3, F) [m].
    """
    costs = np.empty((*joints.shape, joints.shape[1]))
    for start in range(0, len(joints), AT_ONCE):
        rows = slice(start, start + AT_ONCE)
        carried = carried_by(joints[rows], matrices, points[rows])
        carried -= np.einsum("vc,vcaf->vaf", weights[rows], carried)[:, None]
        flat = carried.reshape(*joints[rows].shape, -1)
        costs[rows] = flat @ flat.swapaxes(1, 2) / points.shape[2]
    return InfluenceCandidates(joints, weights, costs)


def carried_by(joints: Ints, matrices: NDArray, points: NDArray) -> NDArray:
    """Return where each joint alone carries each point, shape (V, C, 3, F)."""
    chosen = matrices[joints].astype(np.float64)
    return np.einsum("vcabf,vbf->vcaf", chosen[:, :, :, :3], points) + chosen[:, :, :, 3]


def fitted(influences: InfluenceCandidates, allowed: NDArray, most: int) -> Floats:
    """Return weights (V, C), not negative and summing to one, of at most `most` of the `allowed` candidates (V, C).

    Each moves its vertex as little as its support allows. Supports shrink by one candidate at a time, first by those
    whose weight would be negative, then by what is missed least: w_c^2 / [K^-1]_cc, with K the matrix of the
    constrained least squares.
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
    """Return the best weights that sum to one (V, C), of whatever sign, and what dropping each would cost (V, C)."""
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
