# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics of proxies with slopes; reference: `network.latent_solver.slopes`.

A loop owns some frames and goes over the proxies, parents first. Its innermost loops run over the directions of
change.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from torch import Tensor

from .compiling import compiled
from .running import array, run_parts

MIN_LENGTH = np.float32(1e-8)  # floor for the length that a vector is divided by


def proxy_slopes_loop(
    values: Tensor,
    slopes: Tensor,
    scale: Tensor,
    pivots: Tensor,
    parents: Tensor,
    character: Tensor,
    reach: float,
) -> tuple[Tensor, Tensor]:
    """Return skinning matrices of the character's joints, then of the proxies (J + P, 3, 4, N), and the slopes of
    those of the proxies, columns first: (N, P, 4, 3, m).

    Args:
        values: 6D rotations in bind-pose axes (P, 6, N), or these and displacements (P, 9, N) [m].
        slopes: of what is scaled to give the values, (N, 6 P, m) or (N, 9 P, m); scale: (6,) or (9,).
        pivots: bind positions (P, 3); parents: combined index of each proxy's parent, before its own (P,), integers.
        character: skinning matrices of the character's joints (J, 3, 4, N).
        reach: the longest displacement [m].
    """
    count, frames = len(values), values.shape[2]
    matrices = character.new_empty(len(character) + count, 3, 4, frames)
    matrices[: len(character)] = character
    found = slopes.new_empty(frames, count, 4, 3, slopes.shape[2])
    given = array(values), array(slopes), array(scale), array(pivots), array(parents)
    run_parts(_slopes, frames, *given, len(character), np.float32(reach), matrices.numpy(), found.numpy())
    return matrices, found


@compiled
def _unit(vector, slopes, own):
    """Replace a vector (3,) and its slopes (3, m) by those of its direction, with a row of scratch numbers (m,)."""
    length = sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
    scale = np.float32(1) / max(length, MIN_LENGTH)
    x, y, z = scale * vector[0], scale * vector[1], scale * vector[2]
    vector[0], vector[1], vector[2] = x, y, z
    for k in range(len(own)):
        own[k] = x * slopes[0, k] + y * slopes[1, k] + z * slopes[2, k]
    for axis in range(3):
        at = vector[axis]
        for k in range(len(own)):
            slopes[axis, k] = scale * (slopes[axis, k] - at * own[k])


@compiled
def _limit(vector, slopes, own, reach):
    """Shorten a displacement (3,) beyond `reach`, with its slopes (3, m)."""
    length = sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
    if length > reach:
        _unit(vector, slopes, own)
        for axis in range(3):
            vector[axis] *= reach
            for k in range(len(own)):
                slopes[axis, k] *= reach


@compiled
def _slopes(values, slopes, scale, pivots, parents, joints, reach, matrices, found, start, stop):
    count, size, directions = len(values), values.shape[1], slopes.shape[2]
    turn, d_turn = np.empty((4, 3), np.float32), np.empty((4, 3, directions), np.float32)  # columns, then rows
    own = np.empty(directions, np.float32)
    for n in range(start, stop):
        for p in range(count):
            turn[3], d_turn[3] = 0, 0
            for part in range(size // 3):
                column = 3 if part == 2 else part
                for axis in range(3):
                    place = 3 * part + axis
                    turn[column, axis] = values[p, place, n]
                    factor, row = scale[place], slopes[n, p * size + place]
                    for k in range(directions):
                        d_turn[column, axis, k] = factor * row[k]
            _unit(turn[0], d_turn[0], own)
            x, y = turn[0], turn[1]
            along = x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
            for k in range(directions):
                total = d_turn[0, 0, k] * y[0] + d_turn[0, 1, k] * y[1] + d_turn[0, 2, k] * y[2]
                own[k] = total + x[0] * d_turn[1, 0, k] + x[1] * d_turn[1, 1, k] + x[2] * d_turn[1, 2, k]
            for axis in range(3):
                at = x[axis]
                y[axis] -= along * at
                for k in range(directions):
                    d_turn[1, axis, k] -= own[k] * at + along * d_turn[0, axis, k]
            _unit(turn[1], d_turn[1], own)
            for axis in range(3):
                i, j = (axis + 1) % 3, (axis + 2) % 3
                xi, xj, yi, yj = x[i], x[j], y[i], y[j]
                turn[2, axis] = xi * yj - xj * yi
                for k in range(directions):
                    change = d_turn[0, i, k] * yj - d_turn[0, j, k] * yi
                    d_turn[2, axis, k] = change + xi * d_turn[1, j, k] - xj * d_turn[1, i, k]
            _limit(turn[3], d_turn[3], own, reach)
            px, py, pz = pivots[p, 0], pivots[p, 1], pivots[p, 2]
            for axis in range(3):
                turn[3, axis] += pivots[p, axis] - (turn[0, axis] * px + turn[1, axis] * py + turn[2, axis] * pz)
                for k in range(directions):
                    d_turn[3, axis, k] -= d_turn[0, axis, k] * px + d_turn[1, axis, k] * py + d_turn[2, axis, k] * pz
            above, made = matrices[parents[p]], matrices[joints + p]
            for column in range(4):
                for row in range(3):
                    mx, my, mz = above[row, 0, n], above[row, 1, n], above[row, 2, n]
                    total = mx * turn[column, 0] + my * turn[column, 1] + mz * turn[column, 2]
                    made[row, column, n] = total + (above[row, 3, n] if column == 3 else np.float32(0))
                    out = found[n, p, column, row]
                    for k in range(directions):
                        out[k] = mx * d_turn[column, 0, k] + my * d_turn[column, 1, k] + mz * d_turn[column, 2, k]
                    if parents[p] >= joints:
                        moved = found[n, parents[p] - joints]
                        tx, ty, tz = turn[column, 0], turn[column, 1], turn[column, 2]
                        for k in range(directions):
                            out[k] += moved[0, row, k] * tx + moved[1, row, k] * ty + moved[2, row, k] * tz
                        if column == 3:
                            for k in range(directions):
                                out[k] += moved[3, row, k]
