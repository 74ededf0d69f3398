# SPDX-License-Identifier: Apache-2.0
"""Nearest points on a mesh that changes its shape with each frame; reference: `world.surface.PosedSurface`.

A tree for each frame would take longer to build than a few points take to search. Here triangles come in compact
blocks, the same in all frames, and boxes around these are all that a frame needs. What was nearest to a point in the
frame before bounds its distance, and only boxes within this bound are looked into. Of equally near triangles the
first one counts, so that no result depends on the frames before.
"""

from __future__ import annotations

from math import atan2, sqrt

import numpy as np

from .compiling import compiled

FAR = np.inf
ABOVE = 1 + 1e-9  # bounds the relative rounding error of a gap, so that rounding skips no block
TINY = 1e-300
GROUP = 8  # blocks that have a box together


@compiled
def _enclose(points, faces, part, volumes):
    """Add up six times the volumes that parts (C,) enclose, of which each triangle (T,) belongs to one."""
    o, volumes[:] = points[faces[0, 0]], 0
    for face in range(len(faces)):
        i, j, k = faces[face]
        ax, ay, az = points[i, 0] - o[0], points[i, 1] - o[1], points[i, 2] - o[2]
        bx, by, bz = points[j, 0] - o[0], points[j, 1] - o[1], points[j, 2] - o[2]
        cx, cy, cz = points[k, 0] - o[0], points[k, 1] - o[1], points[k, 2] - o[2]
        x, y, z = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        volumes[part[face]] += ax * x + ay * y + az * z


@compiled
def _bound(points, faces, blocks, boxes, groups, whole):
    """Write boxes around blocks (B, size) of triangles (T, 3), groups of `GROUP` of these, and all, (..., 6)."""
    whole[:3], whole[3:], groups[:, :3], groups[:, 3:] = FAR, -FAR, FAR, -FAR
    for block in range(len(blocks)):
        group = groups[block // GROUP]
        for axis in range(3):
            low, high = FAR, -FAR
            for face in blocks[block]:
                for corner in range(3):
                    value = points[faces[face, corner], axis]
                    low, high = min(low, value), max(high, value)
            boxes[block, axis], boxes[block, 3 + axis] = low, high
            group[axis], group[3 + axis] = min(group[axis], low), max(group[3 + axis], high)
            whole[axis], whole[3 + axis] = min(whole[axis], low), max(whole[3 + axis], high)


@compiled
def _gap(box, x, y, z):
    """Return the squared distance of a point from a box (6,)."""
    dx = max(max(box[0] - x, x - box[3]), 0.0)
    dy = max(max(box[1] - y, y - box[4]), 0.0)
    dz = max(max(box[2] - z, z - box[5]), 0.0)
    return dx * dx + dy * dy + dz * dz


@compiled
def _share(part, whole):
    return min(max(part / max(whole, TINY), 0.0), 1.0)


@compiled
def _closest(points, face, x, y, z, own):
    """Write where on a triangle (3,) the point nearest to a query is, and its squared distance, into own (3,).

    It is at the first corner plus own[0] and own[1] times the edges to the others.
    """
    i, j, k = face
    px, py, pz = x - points[i, 0], y - points[i, 1], z - points[i, 2]
    ux, uy, uz = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
    wx, wy, wz = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1], points[k, 2] - points[i, 2]
    a, b, c = ux * ux + uy * uy + uz * uz, ux * wx + uy * wy + uz * wz, wx * wx + wy * wy + wz * wz
    d, e = ux * px + uy * py + uz * pz, wx * px + wy * py + wz * pz
    determinant = a * c - b * b
    s, t = (c * d - b * e) / max(determinant, TINY), (a * e - b * d) / max(determinant, TINY)
    if not (determinant > 0 and s >= 0 and t >= 0 and s + t <= 1):  # on one of the three edges
        s, t = _share(d, a), 0.0
        best = s * (s * a - 2 * d)
        along = _share(e, c)
        value = along * (along * c - 2 * e)
        if value < best:
            s, t, best = 0.0, along, value
        along = _share(e - d - b + a, a - 2 * b + c)
        rest = 1 - along
        value = rest * (rest * a - 2 * d) + along * (along * c - 2 * e) + 2 * rest * along * b
        if value < best:
            s, t = rest, along
    px, py, pz = px - s * ux - t * wx, py - s * uy - t * wy, pz - s * uz - t * wz
    own[0], own[1], own[2] = s, t, px * px + py * py + pz * pz


@compiled
def _add_normal(points, face, corner, by_angle, normal):
    """Add the unit normal of a triangle (3,), times its angle at a corner where asked for, to normal (3,)."""
    i, j, k = face[corner], face[(corner + 1) % 3], face[(corner + 2) % 3]
    ux, uy, uz = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
    wx, wy, wz = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1], points[k, 2] - points[i, 2]
    x, y, z = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    length = sqrt(x * x + y * y + z * z)
    share = 1 / max(length, TINY)
    if by_angle:
        share *= atan2(length, ux * wx + uy * wy + uz * wz)
    normal[0] += share * x
    normal[1] += share * y
    normal[2] += share * z


@compiled
def nearest_on_moving(points, faces, part, blocks, at_edges, at_vertices, on_edge, queries, face, weights, normal,
                      squares, whole, volumes):  # fmt: skip
    """Write the nearest triangles, the weights of their corners there, pseudonormals and squared distances [m2].

    Args:
        points: of the mesh in N frames [m], (N, P, 3); faces: its triangles, (T, 3).
        part: of each triangle, (T,); blocks: of triangles, (B, size).
        at_edges, at_vertices: for each, its number at the sides and corners of triangles, (T, 3), then the corners
            that have a number, counted through all triangles in the order of the numbers, (3 T,), and where each
            number begins among these.
        on_edge: weight up to which a point is on the edge opposite.
        queries: of each frame [m], shape (N, M, 3).
        face, weights, normal, squares: shapes (N, M), (N, M, 3), (N, M, 3) and (N, M).
        whole, volumes: corners of the boxes around the mesh, and six times what parts enclose, (N, 6) and (N, C).
    """
    boxes, groups, own = np.empty((len(blocks), 6)), np.empty(((len(blocks) - 1) // GROUP + 1, 6)), np.empty(3)
    for n in range(len(points)):
        _bound(points[n], faces, blocks, boxes, groups, whole[n])
        _enclose(points[n], faces, part, volumes[n])
        for m in range(queries.shape[1]):
            x, y, z = queries[n, m]
            guess = face[n - 1, m] if n else face[n, max(m - 1, 0)] * (m > 0)
            _closest(points[n], faces[guess], x, y, z, own)
            bound, best, s, t, found = own[2] * ABOVE, FAR, 0.0, 0.0, guess
            for group in range(len(groups)):
                if _gap(groups[group], x, y, z) > bound:
                    continue
                for block in range(group * GROUP, min(group * GROUP + GROUP, len(blocks))):
                    if _gap(boxes[block], x, y, z) > bound:
                        continue
                    for number in blocks[block]:
                        _closest(points[n], faces[number], x, y, z, own)
                        if own[2] < best:
                            s, t, best, found = own[0], own[1], own[2], number
                            bound = min(bound, best * ABOVE)
            share, to = weights[n, m], normal[n, m]
            share[0], share[1], share[2] = max(1 - s - t, 0.0), s, t
            face[n, m], squares[n, m] = found, best
            empty, last, largest = 0, 0, 0
            for corner in range(3):
                if share[corner] <= on_edge:
                    empty += 1
                    last = corner
                if share[corner] > share[largest]:
                    largest = corner
            to[:] = 0
            if empty == 0:
                _add_normal(points[n], faces[found], 0, False, to)
                continue
            numbers, corners, firsts = at_edges if empty == 1 else at_vertices
            number = numbers[found, (last + 1) % 3 if empty == 1 else largest]
            for place in range(firsts[number], firsts[number + 1]):
                at = corners[place]
                _add_normal(points[n], faces[at // 3], at % 3, empty > 1, to)
