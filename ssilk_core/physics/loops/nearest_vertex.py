# SPDX-License-Identifier: Apache-2.0
"""The exact nearest body vertex; reference: `collision.nearest_vertex`.

As in `kernels.nearest_vertex`, vertices of the garment come in compact blocks and those of the body in compact
groups, each with its bounding box. A block first visits the group nearest to it, which bounds the distances, and then
only groups whose boxes are within this bound. Of equally near vertices the one visited first counts, so that results
are deterministic.
"""

from __future__ import annotations

from math import inf

import numpy as np
import torch
from torch import Tensor

from .compiling import compiled
from .running import array, run_parts

SAFE = np.float32(1 - 1e-5)  # bounds the relative rounding error of a gap, so that rounding skips no group
FAR = np.float32(np.inf)


def nearest_vertex_loop(x: Tensor, points: Tensor, blocks: Tensor, groups: Tensor, enough: float = inf) -> Tensor:
    """Return the index of the nearest body vertex, int32 of shape (V, N).

    Args:
        x, points: garment (V, 3, N) and body (B, 3, N), float32.
        blocks, groups: their vertices in compact blocks (`collision.nearest_vertex.compact_blocks`), int32.
        enough: vertices of the garment further than this from every body vertex [m] get any of these.
    """
    found = torch.empty(len(x), x.shape[2], dtype=torch.int32)
    given = array(x), array(points), array(blocks), array(groups)
    run_parts(_nearest, x.shape[2], *given, np.float32(enough**2), found.numpy())
    return found


def nearest_candidate_loop(x: Tensor, points: Tensor, lists: Tensor) -> Tensor:
    """Return the index of the nearest candidate, int32 of shape (V, N); of equally near ones the first in its list.

    Args:
        x, points: garment (V, 3, N) and body (B, 3, N), float32.
        lists: for each garment vertex the number of candidates, then their indices, int32 (V, 1 + C).
    """
    found = torch.empty(len(x), x.shape[2], dtype=torch.int32)
    run_parts(_listed, len(x), array(x), array(points), array(lists), found.numpy())
    return found


@compiled
def _pack(points, table, frame, packed, boxes):
    """Copy a frame of points in the order of a table (rows, size) to (3, rows * size), and boxes to (6, rows)."""
    rows, size = table.shape
    for row in range(rows):
        for axis in range(3):
            low, high = FAR, -FAR
            for i in range(size):
                value = points[table[row, i], axis, frame]
                packed[axis, row * size + i] = value
                low, high = min(low, value), max(high, value)
            boxes[axis, row], boxes[3 + axis, row] = low, high


@compiled
def _nearest(x, points, blocks, groups, enough, found, start, stop):
    count, size = blocks.shape
    group_count, group_size = groups.shape
    cloth, cloth_boxes = np.empty((3, count * size), np.float32), np.empty((6, count), np.float32)
    body, body_boxes = np.empty((3, group_count * group_size), np.float32), np.empty((6, group_count), np.float32)
    gap = np.empty(group_count, np.float32)
    best, owner = np.empty(size, np.float32), np.empty(size, np.int32)
    zero = np.float32(0)
    for frame in range(start, stop):
        _pack(x, blocks, frame, cloth, cloth_boxes)
        _pack(points, groups, frame, body, body_boxes)
        for block in range(count):
            lx, ly, lz = cloth_boxes[0, block], cloth_boxes[1, block], cloth_boxes[2, block]
            hx, hy, hz = cloth_boxes[3, block], cloth_boxes[4, block], cloth_boxes[5, block]
            for g in range(group_count):
                dx = max(max(body_boxes[0, g] - hx, lx - body_boxes[3, g]), zero)
                dy = max(max(body_boxes[1, g] - hy, ly - body_boxes[4, g]), zero)
                dz = max(max(body_boxes[2, g] - hz, lz - body_boxes[5, g]), zero)
                gap[g] = (dx * dx + dy * dy + dz * dz) * SAFE
            seed = 0
            for g in range(group_count):
                if gap[g] < gap[seed]:
                    seed = g
            best[:], owner[:] = FAR, 0
            at = slice(block * size, block * size + size)
            px, py, pz = cloth[0, at], cloth[1, at], cloth[2, at]
            bound = FAR
            for turn in range(-1, group_count):
                g = seed if turn < 0 else turn
                if turn >= 0 and (g == seed or gap[g] > bound):
                    continue
                for place in range(g * group_size, g * group_size + group_size):
                    bx, by, bz = body[0, place], body[1, place], body[2, place]
                    for i in range(size):
                        dx, dy, dz = px[i] - bx, py[i] - by, pz[i] - bz
                        square = dx * dx + dy * dy + dz * dz
                        closer = square < best[i]
                        best[i] = square if closer else best[i]
                        owner[i] = place if closer else owner[i]
                bound = zero
                for i in range(size):
                    bound = max(bound, best[i])
                bound = enough if bound > enough else bound
            for i in range(size):
                found[blocks[block, i], frame] = groups[owner[i] // group_size, owner[i] % group_size]


@compiled
def _listed(x, points, lists, found, start, stop):
    frames = x.shape[2]
    best = np.empty(frames, np.float32)
    for v in range(start, stop):
        best[:] = FAR
        mine = found[v]
        mine[:] = lists[v, 1]
        for place in range(1, 1 + lists[v, 0]):
            candidate = lists[v, place]
            for n in range(frames):
                dx = x[v, 0, n] - points[candidate, 0, n]
                dy = x[v, 1, n] - points[candidate, 1, n]
                dz = x[v, 2, n] - points[candidate, 2, n]
                square = dx * dx + dy * dy + dz * dz
                closer = square < best[n]
                best[n] = square if closer else best[n]
                mine[n] = candidate if closer else mine[n]
