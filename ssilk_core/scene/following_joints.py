# SPDX-License-Identifier: Apache-2.0
"""Joints that follow the skin of a body which takes another shape.

A joint moves as the skin about it does: the skin that it shares with its parent, point by point as much as the
product of both weights. Of the joints that share none, those with skin follow that, those without follow that of the
joint above them, and where none above has any, the nearest skin. The affine map that best takes that skin to its new
place (weighted least squares) is applied to the joint. So each joint is a weighted mean of the points about it, as in
SMPL's joint regressor, and the moves of several shapes add up as the shapes do.

A body that moves, grows or is stretched as a whole takes its joints along exactly, and so does each part of it for
which that holds. A single ring of points says nothing of stretch along its axis: there both joints' skin says it, and
where that is flat too, the joint is taken to grow as the skin does.
"""

from __future__ import annotations

import numpy as np

from .assets import Floats, Ints

HELD = 1e-5  # of the mean square distance of skin, along an axis: what is less says little of stretch along it
NO_SKIN = 1e-6  # of the weight of a whole point, below which skin counts as none


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
        if parent >= 0:
            its_rows, its = of_joint[parent]
            both = np.concatenate([rows, its_rows]), np.concatenate([own, its])
            whole[its_rows] = its
            shared = own * whole[rows]
            whole[its_rows] = 0
            if shared.sum() > NO_SKIN:
                wide = _gradient(points[both[0]], moves[both[0]], both[1])
                found[joint] = _affine_move(joints[joint], points[rows], moves[rows], shared, wide)
                continue
        at = joint
        while at >= 0 and of_joint[at][1].sum() <= NO_SKIN:
            at = parents[at]
        if at >= 0:
            rows, own = of_joint[at]
            found[joint] = _affine_move(joints[joint], points[rows], moves[rows], own)
        else:
            away = np.square(points - joints[joint]).sum(axis=1)
            near = max(float(away.min()), 1e-12 * float(away.max()))
            found[joint] = _affine_move(joints[joint], points, moves, 1 / (away + near) ** 2)
    return found


def skinned_moves(joint_moves: Floats, indices: Ints, weights: Floats) -> Floats:
    """Return how far joints (J, 3) that move and do not turn take skin along, shape (V, 3)."""
    return np.asarray(np.einsum("vn,vni->vi", weights, joint_moves[indices]))


def _by_joint(indices: Ints, weights: Floats, count: int) -> list[tuple[Ints, Floats]]:
    """Return for each joint the points that it moves, each once, and how much."""
    rows = np.repeat(np.arange(len(indices)), indices.shape[1] if indices.ndim == 2 else 1)
    flat, amount = indices.reshape(-1), weights.reshape(-1)
    kept = amount > 0
    keys, place = np.unique(flat[kept].astype(np.int64) * len(indices) + rows[kept], return_inverse=True)
    sums = np.bincount(place.reshape(-1), amount[kept], minlength=len(keys)).astype(np.float64)
    starts = np.searchsorted(keys, np.arange(1, count) * len(indices))
    return list(zip(np.split(keys % max(1, len(indices)), starts), np.split(sums, starts)))


def _affine_move(joint: Floats, points: Floats, moves: Floats, counts: Floats, usual: Floats | None = None) -> Floats:
    """Return the move of a joint (3,) by the affine map that best moves points (V, 3), which count as `counts`.

    Args:
        usual: as for `_gradient`.
    """
    counts = counts / counts.sum()
    return np.asarray(counts @ moves + (joint - counts @ points) @ _gradient(points, moves, counts, usual))


def _gradient(points: Floats, moves: Floats, counts: Floats, usual: Floats | None = None) -> Floats:
    """Return by how much moves grow along each axis (3, 3), as the affine map has it that best moves points (V, 3).

    Args:
        usual: what it is along axes of which the points say little; by default they grow alike along all.
    """
    counts = counts / counts.sum()
    off, own = points - counts @ points, moves - counts @ moves
    spread = float(counts @ np.square(off).sum(axis=1))
    if not spread > 0:
        return np.zeros((3, 3)) if usual is None else usual
    if usual is None:
        usual = np.eye(3) * float(counts @ (off * own).sum(axis=1)) / spread
    weighed = counts[:, None] * off
    return usual + np.linalg.solve(weighed.T @ off + HELD * spread / 3 * np.eye(3), weighed.T @ (own - off @ usual))
