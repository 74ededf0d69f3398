# SPDX-License-Identifier: Apache-2.0
"""Joints that follow the skin of a body which takes another shape.

A joint moves as the skin about it does: the skin that it shares with its parent, point by point as much as the product
of both weights. Of the joints that share none, those with skin follow that, and those without any follow the nearest
skin. The affine map that best takes that skin to its new place (weighted least squares) is applied to the joint. So
each joint is a weighted mean of the points about it, as in SMPL's joint regressor, and the moves of several shapes
add up as the shapes do.

Skin that moves, grows by a factor or is stretched as a whole takes its joints along exactly, but for what is held
back where skin says little about a direction, such as a single ring of points along its axis: there the joint is
taken to grow as the ring does.
"""

from __future__ import annotations

import numpy as np

from .assets import Floats, Ints

HELD = 1e-3  # of the mean square distance along an axis, by which stretch along one is held to uniform growth
SHARED = 1e-6  # of the weight of a whole point, below which skin counts as none


def following_moves(
    joints: Floats, parents: Ints, points: Floats, moves: Floats, indices: Ints, weights: Floats
) -> Floats:
    """Return how far joints move with the skin, shape (J, 3), in the unit of the points.

    Args:
        joints: where they are bound, shape (J, 3).
        parents: -1 for roots, shape (J,).
        points, moves: of the skin, and how far a shape moves it, shape (V, 3).
        indices, weights: of the joints that move each point, shape (V, N).
    """
    of_joint = _by_joint(indices, weights, len(joints))
    found, whole = np.zeros_like(joints), np.zeros(len(points))
    if not len(points) or not moves.any():
        return found
    for joint, parent in enumerate(parents):
        rows, own = of_joint[joint]
        shared = np.zeros(0)
        if parent >= 0:
            its_rows, its = of_joint[parent]
            whole[its_rows] = its
            shared = own * whole[rows]
            whole[its_rows] = 0
        if shared.sum() > SHARED:
            found[joint] = _affine_move(joints[joint], points[rows], moves[rows], shared)
        elif own.sum() > SHARED:
            found[joint] = _affine_move(joints[joint], points[rows], moves[rows], own)
        else:
            away = np.square(points - joints[joint]).sum(axis=1)
            near = max(float(away.min()), 1e-12 * float(away.max()))
            found[joint] = _affine_move(joints[joint], points, moves, 1 / (away + near) ** 2)
    return found


def skinned_moves(joint_moves: Floats, indices: Ints, weights: Floats) -> Floats:
    """Return how far joints (J, 3) that move and do not turn take skin along, shape (V, 3)."""
    return np.einsum("vn,vni->vi", weights, joint_moves[indices])


def _by_joint(indices: Ints, weights: Floats, count: int) -> list[tuple[Ints, Floats]]:
    """Return for each joint the points that it moves, each once, and how much."""
    rows = np.repeat(np.arange(len(indices)), indices.shape[1] if indices.ndim == 2 else 1)
    flat, amount = indices.reshape(-1), weights.reshape(-1)
    kept = amount > 0
    keys, place = np.unique(flat[kept].astype(np.int64) * len(indices) + rows[kept], return_inverse=True)
    sums = np.bincount(place.reshape(-1), amount[kept], minlength=len(keys))
    bounds = np.searchsorted(keys, np.arange(count + 1) * len(indices))
    return [(keys[a:b] - joint * len(indices), sums[a:b]) for joint, (a, b) in enumerate(zip(bounds, bounds[1:]))]


def _affine_move(joint: Floats, points: Floats, moves: Floats, counts: Floats) -> Floats:
    """Return the move of a joint (3,) by the affine map that best moves points (V, 3), which count as `counts`."""
    counts = counts / counts.sum()
    middle, mean = counts @ points, counts @ moves
    off, own = points - middle, moves - mean
    spread = float(counts @ np.square(off).sum(axis=1))
    away = joint - middle
    if spread <= 1e-12 * float(np.square(away).sum()) or spread == 0:
        return mean
    grows = float(counts @ (off * own).sum(axis=1)) / spread
    left = own - grows * off
    second = (counts[:, None] * off).T @ off + HELD * spread / 3 * np.eye(3)
    stretch = np.linalg.solve(second, (counts[:, None] * off).T @ left)
    return mean + grows * away + away @ stretch
