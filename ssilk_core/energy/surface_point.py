# SPDX-License-Identifier: Apache-2.0
"""The nearest point of a body's surface, from its nearest vertex and the triangles around that."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..assets import Ints


def triangle_rings(faces: Ints, vertex_count: int) -> Ints:
    """Return, for each vertex, the two other corners of every triangle around it, shape (B, D, 2).

    Rows with fewer than D triangles are padded with the vertex itself, a triangle without extent.
    """
    corners = np.concatenate([np.roll(faces, -turn, axis=1) for turn in range(3)])
    order = np.argsort(corners[:, 0], kind="stable")
    owner, others = corners[order, 0], corners[order, 1:]
    counts = np.bincount(owner, minlength=vertex_count)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    rings = np.repeat(np.arange(vertex_count)[:, None, None], 2, axis=2).repeat(max(counts.max(initial=0), 1), axis=1)
    rings[owner, place] = others
    return rings


def nearest_on_rings(
    x: Tensor, vertex: Tensor, frame: Tensor, points: Tensor, rings: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the nearest point on the triangles around each query's nearest vertex.

    Args:
        x: queries, shape (3, M).
        vertex, frame: nearest body vertex and frame of each query, shape (M,).
        points: body vertices, shape (3, B, N).
        rings: other corners of the triangles around each body vertex, shape (B, D, 2).

    Returns:
        Body vertices at the corners of the winning triangle, shape (3, M), and barycentric coordinates, (3, M).
    """
    origin = points[:, vertex, frame]
    p = x - origin
    corners = vertex.repeat(3, 1)
    best, s_best, t_best = torch.zeros_like(p[0]), torch.zeros_like(p[0]), torch.zeros_like(p[0])
    for ring in rings.unbind(1):
        second, third = ring[vertex].unbind(1)
        s, t, value = _closest_in_triangle(p, points[:, second, frame] - origin, points[:, third, frame] - origin)
        closer = value < best
        best = torch.where(closer, value, best)
        s_best, t_best = torch.where(closer, s, s_best), torch.where(closer, t, t_best)
        corners[1] = torch.where(closer, second, corners[1])
        corners[2] = torch.where(closer, third, corners[2])
    return corners, torch.stack([1 - s_best - t_best, s_best, t_best])


def _closest_in_triangle(p: Tensor, e1: Tensor, e2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Minimise |p - s e1 - t e2|^2 over s, t >= 0, s + t <= 1; return s, t and the minimum less |p|^2.

    The inside counts where it is feasible; otherwise the minimum lies on one of the three edges.
    """
    d1, d2 = (e1 * p).sum(0), (e2 * p).sum(0)
    a, b, c = (e1 * e1).sum(0), (e1 * e2).sum(0), (e2 * e2).sum(0)

    def value(s: Tensor, t: Tensor) -> Tensor:
        return s * (s * a - 2 * d1) + t * (t * c - 2 * d2) + 2 * s * t * b

    zero = torch.zeros_like(d1)
    tiny = torch.finfo(p.dtype).tiny
    determinant = (a * c - b * b).clamp_min(tiny)
    s, t = (c * d1 - b * d2) / determinant, (a * d2 - b * d1) / determinant
    inside = (s >= 0) & (t >= 0) & (s + t <= 1)
    along = ((d2 - d1 - b + a) / (a - 2 * b + c).clamp_min(tiny)).clamp(0, 1)
    options = [
        ((d1 / a.clamp_min(tiny)).clamp(0, 1), zero),
        (zero, (d2 / c.clamp_min(tiny)).clamp(0, 1)),
        (1 - along, along),
    ]
    best_s, best_t = torch.where(inside, s, zero), torch.where(inside, t, zero)
    best = torch.where(inside, value(s, t), zero)  # the vertex itself is always feasible, with a value of zero
    for s, t in options:
        found = value(s, t)
        closer = (found < best) & ~inside
        best = torch.where(closer, found, best)
        best_s, best_t = torch.where(closer, s, best_s), torch.where(closer, t, best_t)
    return best_s, best_t, best
