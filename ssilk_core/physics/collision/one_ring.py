# SPDX-License-Identifier: Apache-2.0
"""The nearest point of a body's surface on the triangles around its nearest vertex."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Ints


def triangle_rings(faces: Ints, vertex_count: int) -> Ints:
    """Return for each vertex the number of entries, then its neighbours in order around it, shape (B, 1 + D).

    Each two consecutive neighbours form a triangle with the vertex. The vertex itself separates triangles that are
    not adjacent, and pads shorter rows: the triangles that it forms degenerate to an edge or a point.
    """
    following: list[dict[int, list[int]]] = [{} for _ in range(vertex_count)]
    for a, b, c in faces.tolist():
        following[a].setdefault(b, []).append(c)
        following[b].setdefault(c, []).append(a)
        following[c].setdefault(a, []).append(b)
    walks = [_walk(vertex, after) for vertex, after in enumerate(following)]
    longest = max(map(len, walks), default=0)
    rows = [[len(walk), *walk] + [vertex] * (longest - len(walk)) for vertex, walk in enumerate(walks)]
    return np.array(rows, dtype=np.int32).reshape(vertex_count, 1 + longest)


def _walk(vertex: int, after: dict[int, list[int]]) -> list[int]:
    """Consume all steps from one neighbour of a vertex to the next, in as few walks as possible."""
    entered = {neighbour for followers in after.values() for neighbour in followers}
    walk: list[int] = []
    for start in sorted(after, key=lambda neighbour: neighbour in entered):  # walks of an open fan begin at its edge
        while after[start]:
            walk += [vertex, start] if walk else [start]
            while after.get(walk[-1]):
                walk.append(after[walk[-1]].pop(0))
    return walk


def nearest_on_rings(
    x: Tensor, vertex: Tensor, frame: Tensor, points: Tensor, rings: Tensor
) -> tuple[Tensor, Tensor]:
    """Find the nearest point on the triangles around each query's nearest vertex.

    Args:
        x: queries, shape (3, M).
        vertex, frame: nearest body vertex and frame of each query, shape (M,).
        points: body vertices, shape (3, B, N).
        rings: neighbours around each body vertex (`triangle_rings`), shape (B, 1 + D).

    Returns:
        Body vertices at the corners of the nearest triangle, shape (3, M), and barycentric coordinates, (3, M).
    """
    origin = points[:, vertex, frame]
    p = x - origin
    corners = vertex.repeat(3, 1)
    best, s_best, t_best = torch.zeros_like(p[0]), torch.zeros_like(p[0]), torch.zeros_like(p[0])
    third, e2 = vertex, torch.zeros_like(p)
    for neighbour in rings[:, 1:].long().unbind(1):
        second, third, e1 = third, neighbour[vertex], e2
        e2 = points[:, third, frame] - origin
        s, t, value = closest_in_triangle(p, e1, e2)
        closer = value < best
        best = torch.where(closer, value, best)
        s_best, t_best = torch.where(closer, s, s_best), torch.where(closer, t, t_best)
        corners[1] = torch.where(closer, second, corners[1])
        corners[2] = torch.where(closer, third, corners[2])
    return corners, torch.stack([1 - s_best - t_best, s_best, t_best])


def closest_in_triangle(p: Tensor, e1: Tensor, e2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Minimise |p - s e1 - t e2|^2 over s, t >= 0, s + t <= 1; return s, t and the minimum minus |p|^2.

    The minimum is taken over the projection onto the plane, if it lies inside, and the three edges.
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
        (torch.where(inside, s, zero), torch.where(inside, t, zero)),
        ((d1 / a.clamp_min(tiny)).clamp(0, 1), zero),
        (zero, (d2 / c.clamp_min(tiny)).clamp(0, 1)),
        (1 - along, along),
    ]
    best, best_s, best_t = zero, zero, zero  # the vertex itself
    for s, t in options:
        found = value(s, t)
        closer = found < best
        best, best_s, best_t = (torch.where(closer, *pair) for pair in ((found, best), (s, best_s), (t, best_t)))
    return best_s, best_t, best
