# SPDX-License-Identifier: Apache-2.0
"""How far vertices are from faces, and edges from edges; reference: `self_contact.self_contact.PairKind`."""

from __future__ import annotations

from math import inf, sqrt

import torch
from torch import Tensor

from .compiling import compiled
from .running import array, run_parts

TINY = 1e-24


def distances_loop(x: Tensor, first: Tensor, second: Tensor, frame: Tensor, one: Tensor, other: Tensor) -> Tensor:
    """Return the distance of each pair at positions (V, 3, N), infinite with a common vertex, shape (P,).

    Args:
        first, second: vertices of what comes first in pairs, and second, shapes (A, 1) and (B, 3), or both (A, 2).
        frame, one, other: of each pair, shape (P,).
    """
    found = x.new_empty(len(frame))
    tables = array(x.permute(2, 0, 1)), array(first), array(second)
    run_parts(_distances, len(frame), *tables, array(frame), array(one), array(other), found.numpy())
    return found


def close_loop(
    x: Tensor,
    first: Tensor,
    second: Tensor,
    frame: Tensor,
    one: Tensor,
    other: Tensor,
    known: Tensor,
    moves: tuple[Tensor, Tensor],
    near: float,
    step: Tensor | None,
    closing: float,
) -> Tensor:
    """Return which pairs `PairKind.close` keeps, bool (P,); the other arguments are those of `distances_loop`."""
    found = torch.empty(len(frame), dtype=torch.bool)
    pairs = array(frame), array(one), array(other), array(known)
    own = array(x.permute(2, 0, 1))
    steps = own if step is None else array(step.permute(2, 0, 1))
    given = own, array(first), array(second), *pairs, array(moves[0]), array(moves[1]), near
    run_parts(_close, len(frame), *given, steps, step is not None, closing, found.numpy())
    return found


@compiled
def _four(first, second, p, q):
    """Return the four vertices of a pair."""
    if first.shape[1] == 1:
        return first[p, 0], second[q, 0], second[q, 1], second[q, 2]
    return first[p, 0], first[p, 1], second[q, 0], second[q, 1]


@compiled
def _clamped(value):
    return min(max(value, 0.0), 1.0)


@compiled
def _over_face(x, i, j, k, l):  # noqa: E741
    """Return the vector from the nearest point of the face j, k, l to the vertex i."""
    px, py, pz = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
    ux, uy, uz = x[k, 0] - x[j, 0], x[k, 1] - x[j, 1], x[k, 2] - x[j, 2]
    vx, vy, vz = x[l, 0] - x[j, 0], x[l, 1] - x[j, 1], x[l, 2] - x[j, 2]
    d1, d2 = ux * px + uy * py + uz * pz, vx * px + vy * py + vz * pz
    a, b, c = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    determinant = max(a * c - b * b, TINY)
    s, t = (c * d1 - b * d2) / determinant, (a * d2 - b * d1) / determinant
    if not (s >= 0.0 and t >= 0.0 and s + t <= 1.0):
        best = inf
        s1, t2 = _clamped(d1 / max(a, TINY)), _clamped(d2 / max(c, TINY))
        w = _clamped((d2 - d1 - b + a) / max(a - 2.0 * b + c, TINY))
        for e in range(3):
            m, n = (s1, 0.0) if e == 0 else ((0.0, t2) if e == 1 else (1.0 - w, w))
            value = m * (m * a - 2.0 * d1) + n * (n * c - 2.0 * d2) + 2.0 * m * n * b
            if value < best:
                best, s, t = value, m, n
    return px - s * ux - t * vx, py - s * uy - t * vy, pz - s * uz - t * vz


@compiled
def _between_edges(x, i, j, k, l):  # noqa: E741
    """Return the vector from the nearest point of the edge k, l to that of the edge i, j."""
    ux, uy, uz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
    vx, vy, vz = x[l, 0] - x[k, 0], x[l, 1] - x[k, 1], x[l, 2] - x[k, 2]
    ax, ay, az = x[i, 0] - x[k, 0], x[i, 1] - x[k, 1], x[i, 2] - x[k, 2]
    ff, ss, fs = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, ux * vx + uy * vy + uz * vz
    fa, sa = ux * ax + uy * ay + uz * az, vx * ax + vy * ay + vz * az
    s = _clamped((fs * sa - ss * fa) / max(ff * ss - fs * fs, TINY))
    t = (fs * s + sa) / max(ss, TINY)
    if t < 0.0 or t > 1.0:
        t = _clamped(t)
        s = _clamped((fs * t - fa) / max(ff, TINY))
    return ax + s * ux - t * vx, ay + s * uy - t * vy, az + s * uz - t * vz


@compiled
def _distances(x, first, second, frame, one, other, found, start, stop):
    for pair in range(start, stop):
        i, j, k, l = _four(first, second, one[pair], other[pair])  # noqa: E741
        faces = first.shape[1] == 1
        if i == k or i == l or (i == j if faces else (j == k or j == l)):
            found[pair] = inf
            continue
        at = x[frame[pair]]
        dx, dy, dz = _over_face(at, i, j, k, l) if faces else _between_edges(at, i, j, k, l)
        found[pair] = sqrt(dx * dx + dy * dy + dz * dz)


@compiled
def _close(
    x, first, second, frame, one, other, known, moves, other_moves, near, step, steps, closing, found, start, stop
):  # fmt: skip
    faces = first.shape[1] == 1
    for pair in range(start, stop):
        p, q, f = one[pair], other[pair], frame[pair]
        found[pair] = False
        if known[pair] - moves[p, f] - other_moves[q, f] >= near:
            continue
        i, j, k, l = _four(first, second, p, q)  # noqa: E741
        dx, dy, dz = _over_face(x[f], i, j, k, l) if faces else _between_edges(x[f], i, j, k, l)
        far = sqrt(dx * dx + dy * dy + dz * dz)
        if far < near:
            found[pair] = True
        elif steps:
            lowest, highest = 0.0, 0.0
            for number in range(4):
                v = i if number == 0 else (j if number == 1 else (k if number == 2 else l))
                along = dx * step[f, v, 0] + dy * step[f, v, 1] + dz * step[f, v, 2]
                if number < (1 if faces else 2):
                    lowest = min(lowest, along)
                else:
                    highest = max(highest, along)
            found[pair] = highest - lowest > closing * far * far
