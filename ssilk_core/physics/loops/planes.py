# SPDX-License-Identifier: Apache-2.0
"""The plane at the nearest body vertex, or at the nearest point on the triangles around it.

Reference: `collision.distance.nearest_planes` of a body without faces. A loop owns some garment vertices.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
import torch
from torch import Tensor

from .compiling import compiled
from .running import array, run_parts

TINY = np.float32(1e-30)
LEAST = np.float32(1e-5)  # [m], for the length that a direction is divided by, as in the reference


def one_ring_loop(
    x: Tensor,
    index: Tensor,
    points: Tensor,
    normals: Tensor,
    rings: Tensor,
    max_distance: float,
    reach: float,
    on_triangles: bool,
) -> tuple[Tensor, Tensor]:
    """Return unit normals (V, 3, N) and offsets n . b (V, N) of the nearest body points b.

    Arguments are those of `kernels.one_ring.one_ring_kernel`.
    """
    normal, offset = torch.empty(x.shape), torch.empty(index.shape)
    given = array(x), array(index), array(points), array(normals), array(rings)
    limits = np.float32(max_distance**2), np.float32(reach), on_triangles
    run_parts(_planes, len(x), *given, normal.numpy(), offset.numpy(), *limits)
    return normal, offset


@compiled
def _planes(x, index, points, normals, rings, normal, offset, max_square, reach, on_triangles, start, stop):
    zero, one = np.float32(0), np.float32(1)
    for v in range(start, stop):
        for n in range(x.shape[2]):
            i = index[v, n]
            ox, oy, oz = points[i, 0, n], points[i, 1, n], points[i, 2, n]
            px, py, pz = x[v, 0, n] - ox, x[v, 1, n] - oy, x[v, 2, n] - oz
            square = px * px + py * py + pz * pz
            near, s, t, j, k = square < max_square, zero, zero, i, i
            if near and on_triangles:
                j, k, s, t, left = _around(px, py, pz, ox, oy, oz, i, n, points, rings)
                near = square + left < reach * reach
            elif near:
                height = normals[i, 0, n] * px + normals[i, 1, n] * py + normals[i, 2, n] * pz
                near = abs(height) < reach
            if near:
                r = one - s - t
                bx = r * ox + s * points[j, 0, n] + t * points[k, 0, n]
                by = r * oy + s * points[j, 1, n] + t * points[k, 1, n]
                bz = r * oz + s * points[j, 2, n] + t * points[k, 2, n]
                nx = r * normals[i, 0, n] + s * normals[j, 0, n] + t * normals[k, 0, n]
                ny = r * normals[i, 1, n] + s * normals[j, 1, n] + t * normals[k, 1, n]
                nz = r * normals[i, 2, n] + s * normals[j, 2, n] + t * normals[k, 2, n]
                if on_triangles:
                    length = one / max(sqrt(nx * nx + ny * ny + nz * nz), np.float32(1e-8))
                    nx, ny, nz = nx * length, ny * length, nz * length
            else:
                bx, by, bz = ox, oy, oz
                length = one / max(sqrt(square), LEAST)
                nx, ny, nz = px * length, py * length, pz * length
            normal[v, 0, n], normal[v, 1, n], normal[v, 2, n] = nx, ny, nz
            offset[v, n] = nx * bx + ny * by + nz * bz


@compiled
def _around(px, py, pz, ox, oy, oz, i, n, points, rings):
    """Corners j and k, s, t, and |p - b|^2 - |p|^2 of the nearest point b on the triangles around i."""
    zero = np.float32(0)
    best, s_best, t_best, j_best, k_best = zero, zero, zero, i, i
    k, wx, wy, wz = i, zero, zero, zero
    for step in range(1, 1 + rings[i, 0]):
        j, ux, uy, uz = k, wx, wy, wz
        k = rings[i, step]
        wx, wy, wz = points[k, 0, n] - ox, points[k, 1, n] - oy, points[k, 2, n] - oz
        s, t, value = _closest(px, py, pz, ux, uy, uz, wx, wy, wz)
        if value < best:
            best, s_best, t_best, j_best, k_best = value, s, t, j, k
    return j_best, k_best, s_best, t_best, best


@compiled
def _clamped(part, whole):
    return min(max(part / max(whole, TINY), np.float32(0)), np.float32(1))


@compiled
def _closest(px, py, pz, ux, uy, uz, wx, wy, wz):
    """Minimise |p - s u - t w|^2 over s, t >= 0, s + t <= 1; return s, t and the minimum minus |p|^2.

    The edge along u is skipped, since it was the edge along w of the previous triangle.
    """
    zero, one, two = np.float32(0), np.float32(1), np.float32(2)
    d1, d2 = ux * px + uy * py + uz * pz, wx * px + wy * py + wz * pz
    a, b, c = ux * ux + uy * uy + uz * uz, ux * wx + uy * wy + uz * wz, wx * wx + wy * wy + wz * wz
    determinant = max(a * c - b * b, TINY)
    s, t = (c * d1 - b * d2) / determinant, (a * d2 - b * d1) / determinant
    if not (s >= zero and t >= zero and s + t <= one):
        s, t = zero, zero
    e = s * (s * a - two * d1) + t * (t * c - two * d2) + two * s * t * b
    alone = _clamped(d2, c)
    value = alone * (alone * c - two * d2)
    if value < e:
        s, t, e = zero, alone, value
    opposite, length = d2 - d1 - b + a, a - two * b + c
    along = _clamped(opposite, length)
    value = a - two * d1 + along * (along * length - two * opposite)
    if value < e:
        s, t, e = one - along, along, value
    return s, t, e
