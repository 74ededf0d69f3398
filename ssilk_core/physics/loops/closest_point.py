# SPDX-License-Identifier: Apache-2.0
"""The tangent plane at the nearest point of a body's whole surface; reference: `collision.closest_point`.

As in `kernels.closest_point`, queries come in compact blocks and triangles in compact patches, each with its bounding
box; the distance to the nearest body vertex bounds the search, and patches out of reach are skipped.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
import torch
from torch import Tensor

from .compiling import compiled
from .running import array, run_parts

TRIANGLES = 8  # of a patch; their corners are four rows of a table, the last of them padding
SAFE = np.float32(1 - 1e-5)  # as in `loops.nearest_vertex`
TINY = np.float32(1e-30)
FAR = np.float32(np.inf)


def closest_point_loop(
    x: Tensor,
    index: Tensor,
    points: Tensor,
    normals: Tensor,
    blocks: Tensor,
    patches: Tensor,
    max_distance: float,
    max_depth: float,
    deep_cosine: float,
    surface_epsilon: float,
) -> tuple[Tensor, Tensor]:
    """Return unit normals (V, 3, N) and offsets n . b (V, N) of the nearest body points b, as `nearest_planes` does.

    Arguments are those of `kernels.closest_point.closest_point_kernel`.
    """
    normal, offset = torch.empty(x.shape), torch.empty(index.shape)
    given = array(x), array(index), array(points), array(normals), array(blocks), array(patches)
    limits = (np.float32(limit) for limit in (max_distance, max_depth, deep_cosine, surface_epsilon))
    run_parts(_search, x.shape[2], *given, normal.numpy(), offset.numpy(), *limits)
    return normal, offset


@compiled
def _triangles(points, patches, frame, corners, numbers, boxes):
    """Write the first corners and both edges of all triangles (9, T), products of the edges (3, T), boxes (6, P)."""
    for patch in range(len(patches)):
        for axis in range(3):
            boxes[axis, patch], boxes[3 + axis, patch] = FAR, -FAR
        for lane in range(TRIANGLES):
            place = patch * TRIANGLES + lane
            i, j, k = patches[patch, lane], patches[patch, TRIANGLES + lane], patches[patch, 2 * TRIANGLES + lane]
            for axis in range(3):
                a, b, c = points[i, axis, frame], points[j, axis, frame], points[k, axis, frame]
                corners[axis, place], corners[3 + axis, place], corners[6 + axis, place] = a, b - a, c - a
                boxes[axis, patch] = min(boxes[axis, patch], min(a, min(b, c)))
                boxes[3 + axis, patch] = max(boxes[3 + axis, patch], max(a, max(b, c)))
            ux, uy, uz = corners[3, place], corners[4, place], corners[5, place]
            wx, wy, wz = corners[6, place], corners[7, place], corners[8, place]
            numbers[0, place] = ux * ux + uy * uy + uz * uz
            numbers[1, place] = ux * wx + uy * wy + uz * wz
            numbers[2, place] = wx * wx + wy * wy + wz * wz


@compiled
def _part(part, whole):
    return min(max(part / max(whole, TINY), np.float32(0)), np.float32(1))


@compiled
def _visit(triangle, px, py, pz, best, s_best, t_best, owner, corners, numbers):
    """Compare the nearest point of a triangle with the best so far of each query in a block."""
    zero, one, two = np.float32(0), np.float32(1), np.float32(2)
    ax, ay, az = corners[0, triangle], corners[1, triangle], corners[2, triangle]
    ux, uy, uz = corners[3, triangle], corners[4, triangle], corners[5, triangle]
    wx, wy, wz = corners[6, triangle], corners[7, triangle], corners[8, triangle]
    a, b, c = numbers[0, triangle], numbers[1, triangle], numbers[2, triangle]
    determinant, length = one / max(a * c - b * b, TINY), a - two * b + c
    for i in range(len(px)):
        qx, qy, qz = px[i] - ax, py[i] - ay, pz[i] - az
        d1, d2 = ux * qx + uy * qy + uz * qz, wx * qx + wy * qy + wz * qz
        s, t = (c * d1 - b * d2) * determinant, (a * d2 - b * d1) * determinant
        within = (s >= zero) & (t >= zero) & (s + t <= one)
        s, t = s if within else zero, t if within else zero
        e = s * (s * a - two * d1) + t * (t * c - two * d2) + two * s * t * b
        alone = _part(d1, a)
        value = alone * (alone * a - two * d1)
        closer = value < e
        s, t, e = alone if closer else s, zero if closer else t, value if closer else e
        alone = _part(d2, c)
        value = alone * (alone * c - two * d2)
        closer = value < e
        s, t, e = zero if closer else s, alone if closer else t, value if closer else e
        opposite = d2 - d1 - b + a
        along = _part(opposite, length)
        value = a - two * d1 + along * (along * length - two * opposite)
        closer = value < e
        s, t, e = one - along if closer else s, along if closer else t, value if closer else e
        square = qx * qx + qy * qy + qz * qz + e
        closer = square < best[i]
        best[i] = square if closer else best[i]
        s_best[i] = s if closer else s_best[i]
        t_best[i] = t if closer else t_best[i]
        owner[i] = triangle if closer else owner[i]


@compiled
def _search(x, index, points, normals, blocks, patches, normal, offset, max_distance, max_depth, deep_cosine,
            surface_epsilon, start, stop):  # fmt: skip
    zero, one = np.float32(0), np.float32(1)
    size, patch_count = blocks.shape[1], len(patches)
    corners = np.empty((9, patch_count * TRIANGLES), np.float32)
    numbers, boxes = np.empty((3, patch_count * TRIANGLES), np.float32), np.empty((6, patch_count), np.float32)
    gap = np.empty(patch_count, np.float32)
    px, py, pz = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    best, s_best, t_best = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    owner, asked = np.empty(size, np.int32), np.empty(size, np.bool_)
    for frame in range(start, stop):
        _triangles(points, patches, frame, corners, numbers, boxes)
        for block in range(len(blocks)):
            bound = -one
            lx, ly, lz, hx, hy, hz = FAR, FAR, FAR, -FAR, -FAR, -FAR
            for i in range(size):
                v = blocks[block, i]
                first = index[v, frame]
                px[i], py[i], pz[i] = x[v, 0, frame], x[v, 1, frame], x[v, 2, frame]
                dx, dy = px[i] - points[first, 0, frame], py[i] - points[first, 1, frame]
                dz = pz[i] - points[first, 2, frame]
                height = dx * normals[first, 0, frame] + dy * normals[first, 1, frame] + dz * normals[first, 2, frame]
                square = dx * dx + dy * dy + dz * dz
                asked[i] = square < max_distance * max_distance or (height < zero and square < max_depth * max_depth)
                best[i], s_best[i], t_best[i], owner[i] = FAR, zero, zero, -1
                if asked[i]:
                    bound = max(bound, square)
                    lx, ly, lz = min(lx, px[i]), min(ly, py[i]), min(lz, pz[i])
                    hx, hy, hz = max(hx, px[i]), max(hy, py[i]), max(hz, pz[i])
            if bound >= zero:
                for g in range(patch_count):
                    dx = max(max(boxes[0, g] - hx, lx - boxes[3, g]), zero)
                    dy = max(max(boxes[1, g] - hy, ly - boxes[4, g]), zero)
                    dz = max(max(boxes[2, g] - hz, lz - boxes[5, g]), zero)
                    gap[g] = (dx * dx + dy * dy + dz * dz) * SAFE
                for g in range(patch_count):
                    if gap[g] <= bound:
                        for lane in range(TRIANGLES):
                            place = g * TRIANGLES + lane
                            _visit(place, px, py, pz, best, s_best, t_best, owner, corners, numbers)
            for i in range(size):
                v, s, t = blocks[block, i], s_best[i], t_best[i]
                first = index[v, frame]
                found = asked[i] and owner[i] >= 0
                j, k = first, first
                if found:
                    row, lane = owner[i] // TRIANGLES, owner[i] % TRIANGLES
                    first, j = patches[row, lane], patches[row, TRIANGLES + lane]
                    k = patches[row, 2 * TRIANGLES + lane]
                else:
                    s, t = zero, zero
                r = one - s - t
                bx = r * points[first, 0, frame] + s * points[j, 0, frame] + t * points[k, 0, frame]
                by = r * points[first, 1, frame] + s * points[j, 1, frame] + t * points[k, 1, frame]
                bz = r * points[first, 2, frame] + s * points[j, 2, frame] + t * points[k, 2, frame]
                nx = r * normals[first, 0, frame] + s * normals[j, 0, frame] + t * normals[k, 0, frame]
                ny = r * normals[first, 1, frame] + s * normals[j, 1, frame] + t * normals[k, 1, frame]
                nz = r * normals[first, 2, frame] + s * normals[j, 2, frame] + t * normals[k, 2, frame]
                length = max(sqrt(nx * nx + ny * ny + nz * nz), np.float32(1e-8))
                nx, ny, nz = nx / length, ny / length, nz / length
                dx, dy, dz = px[i] - bx, py[i] - by, pz[i] - bz
                if found:  # along the edges, whose rounding errors are smaller than those of positions
                    e = owner[i]
                    dx = px[i] - corners[0, e] - s * corners[3, e] - t * corners[6, e]
                    dy = py[i] - corners[1, e] - s * corners[4, e] - t * corners[7, e]
                    dz = pz[i] - corners[2, e] - s * corners[5, e] - t * corners[8, e]
                away = sqrt(dx * dx + dy * dy + dz * dz)
                level = -deep_cosine * away * min(away / max_distance, one)
                side = -one if found and dx * nx + dy * ny + dz * nz < level else one
                if away > surface_epsilon or not found:
                    scale = side / max(away, surface_epsilon)
                    nx, ny, nz = scale * dx, scale * dy, scale * dz
                normal[v, 0, frame], normal[v, 1, frame], normal[v, 2, frame] = nx, ny, nz
                offset[v, frame] = nx * bx + ny * by + nz * bz
