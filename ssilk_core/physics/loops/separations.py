# SPDX-License-Identifier: Apache-2.0
"""How far vertices are from faces, and edges from edges; reference: `self_contact.self_contact.PairKind`."""

from __future__ import annotations

from math import inf, sqrt
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from .compiling import compiled
from .running import array, run_parts

if TYPE_CHECKING:
    from ..self_contact.neighbours import Grid

SPACE = 16  # pairs of each point for which there is room at first
TINY = 1e-24


def near_loop(
    x: Tensor,
    first: Tensor,
    second: Tensor,
    middles: tuple[Tensor, Tensor],
    reaches: tuple[Tensor, Tensor],
    grid: Grid,
    groups: tuple[Tensor, Tensor] | None,
    ascending: bool,
    reach: float,
) -> tuple[Tensor, ...]:
    """Return what `PairKind.near` does: frame, first, second and distance of each pair, by frame.

    Args:
        first, second: vertices of what comes first in pairs, and second, shapes (A, 1) and (B, 3), or both (A, 2).
        middles, reaches: of both; pairs whose middles are further apart than the sum of their reaches are not near.
        grid: of the second ones' middles.
        groups: numbers (A,) and (B,); what has the same one is no pair.
        ascending: whether both are the same, and what comes second in a pair has the greater index.
    """
    count, number = len(first), grid.order % len(second)
    # Of two that are of one sort, the one that comes first in the grid's order looks for the other.
    place = grid.order.argsort() if ascending else number.new_full((x.shape[-1] * count,), -1)
    none = number.new_zeros(1)
    own, theirs = (none, none) if groups is None else (groups[0], groups[1][number])
    given = (
        array(x.permute(2, 0, 1)),
        array(first),
        array(second),
        array(middles[0].permute(2, 0, 1).reshape(-1, 3)),
        array(reaches[0]),
        array(middles[1].permute(2, 0, 1).reshape(-1, 3)[grid.order]),
        array(reaches[1][number]),
        array(number),
        array(grid.first.flatten(0, 1)),
        array(grid.last.flatten(0, 1)),
        array(place),
        array(own),
        array(theirs),
        groups is not None,
        reach,
    )
    found: list[tuple[int, np.ndarray, np.ndarray]] = []

    def part(start: int, stop: int) -> None:
        size = SPACE * (stop - start)
        while start < stop:
            pairs, distance = np.empty((3, size), dtype=np.int64), np.empty(size, dtype=given[0].dtype)
            held, after = _near(*given, pairs, distance, start, stop)
            found.append((start, pairs[:, :held], distance[:held]))
            size = size if after > start else 2 * size
            start = after

    run_parts(part, x.shape[-1] * count)
    found.sort(key=lambda each: each[0])
    pairs = np.concatenate([each for _, each, _ in found], axis=1)
    return *torch.from_numpy(pairs), torch.from_numpy(np.concatenate([each for *_, each in found]))


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
    """Return which pairs `PairKind.close` keeps, bool (P,).

    Args:
        first, second: as `near_loop` takes them.
        frame, one, other, known: of each pair, and its distance where it was found, shape (P,).
        moves: how much nearer what comes first, and second, may bring it, shapes (A, N) and (B, N).
        near, step: as `PairKind.close` takes them.
        closing: share of the distance by which pairs may come nearer in the step.
    """
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
def _over_face(x, i, j, k, o):
    """Return the vector from the nearest point of the face j, k, o to the vertex i."""
    px, py, pz = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
    ux, uy, uz = x[k, 0] - x[j, 0], x[k, 1] - x[j, 1], x[k, 2] - x[j, 2]
    vx, vy, vz = x[o, 0] - x[j, 0], x[o, 1] - x[j, 1], x[o, 2] - x[j, 2]
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
def _between_edges(x, i, j, k, o):
    """Return the vector from the nearest point of the edge k, o to that of the edge i, j."""
    ux, uy, uz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
    vx, vy, vz = x[o, 0] - x[k, 0], x[o, 1] - x[k, 1], x[o, 2] - x[k, 2]
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
def _near(
    x, first, second, points, limits, others, other_limits, number, starts, ends, place, own, theirs, grouped,
    reach, pairs, distance, start, stop,
):  # fmt: skip
    """Write the near pairs of points from `start` on; return how many, and the point that there was no room for."""
    count, held, faces = len(first), 0, first.shape[1] == 1
    for q in range(start, stop):
        point, begun, frame = q % count, held, x[q // count]
        px, py, pz, most = points[q, 0], points[q, 1], points[q, 2], limits[point]
        for row in range(starts.shape[1]):
            for at in range(max(starts[q, row], place[q] + 1), ends[q, row]):
                dx, dy, dz = px - others[at, 0], py - others[at, 1], pz - others[at, 2]
                limit = most + other_limits[at]
                if dx * dx + dy * dy + dz * dz > limit * limit:
                    continue
                if grouped and own[point] == theirs[at]:
                    continue
                other = number[at]
                i, j, k, o = _four(first, second, point, other)
                if i in (k, o) or (i == j if faces else j in (k, o)):
                    continue
                dx, dy, dz = _over_face(frame, i, j, k, o) if faces else _between_edges(frame, i, j, k, o)
                far = dx * dx + dy * dy + dz * dz
                if far >= reach * reach:
                    continue
                if held == len(distance):
                    return begun, q
                turned = place[q] >= 0 and other < point
                pairs[0, held], pairs[1 + turned, held], pairs[2 - turned, held] = q // count, point, other
                distance[held] = sqrt(far)
                held += 1
    return held, stop


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
        i, j, k, o = _four(first, second, p, q)
        dx, dy, dz = _over_face(x[f], i, j, k, o) if faces else _between_edges(x[f], i, j, k, o)
        far = sqrt(dx * dx + dy * dy + dz * dz)
        if far < near:
            found[pair] = True
        elif steps:
            lowest, highest = 0.0, 0.0
            for number in range(4):
                v = i if number == 0 else (j if number == 1 else (k if number == 2 else o))
                along = dx * step[f, v, 0] + dy * step[f, v, 1] + dz * step[f, v, 2]
                if number < (1 if faces else 2):
                    lowest = min(lowest, along)
                else:
                    highest = max(highest, along)
            found[pair] = highest - lowest > closing * far * far
