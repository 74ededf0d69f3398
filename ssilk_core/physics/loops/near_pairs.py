# SPDX-License-Identifier: Apache-2.0
"""Pairs of points that lie near each other; reference: `self_contact.neighbours.near_pairs`, which makes the grid."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from .compiling import compiled
from .running import array, run_parts


def near_pairs_loop(
    points: Tensor,
    reach: Tensor,
    others: Tensor,
    other_reach: Tensor,
    order: Tensor,
    first: Tensor,
    last: Tensor,
    groups: tuple[Tensor, Tensor] | None,
    ascending: bool,
) -> Tensor:
    """Return frame, point and other of each pair, by frame, point and other, shape (3, P).

    Args:
        points, reach, others, other_reach, groups, ascending: as `near_pairs` takes them.
        order: frame and other, as one number, in the order of cells, shape (N B,).
        first, last: the parts of this order in which those near a point are, shapes (N A, 9).
    """
    frames, count = points.shape[-1], len(points)
    placed = others.permute(2, 0, 1).reshape(-1, 3)[order]
    number = order % len(others)
    none = number.new_zeros(1)
    own, theirs = (none, none) if groups is None else (groups[0], groups[1][number])
    given = (
        array(points.permute(2, 0, 1).reshape(-1, 3)),
        array(reach),
        array(placed),
        array(other_reach[number]),
        array(number),
        array(first),
        array(last),
        array(own),
        array(theirs),
        groups is not None,
        ascending,
    )
    ends = np.zeros(frames * count + 1, dtype=np.int64)
    found = np.zeros((3, 0), dtype=np.int64)
    run_parts(_near, frames * count, *given, ends[1:], False, ends, found)
    ends = ends.cumsum()
    found = np.empty((3, int(ends[-1])), dtype=np.int64)
    run_parts(_near, frames * count, *given, ends[1:], True, ends, found)
    return torch.from_numpy(found)


@compiled
def _near(
    points, reach, others, other_reach, number, first, last, own, theirs, grouped, ascending, counts, fills, ends,
    found, start, stop,
):  # fmt: skip
    count = len(reach)
    for q in range(start, stop):
        point = q % count
        x, y, z, most = points[q, 0], points[q, 1], points[q, 2], reach[point]
        place = ends[q]
        total = 0
        for row in range(first.shape[1]):
            for at in range(first[q, row], last[q, row]):
                if ascending and number[at] <= point:
                    continue
                if grouped and own[point] == theirs[at]:
                    continue
                dx, dy, dz = x - others[at, 0], y - others[at, 1], z - others[at, 2]
                limit = most + other_reach[at]
                if dx * dx + dy * dy + dz * dz <= limit * limit:
                    if fills:
                        found[0, place + total] = q // count
                        found[1, place + total] = point
                        found[2, place + total] = number[at]
                    total += 1
        if fills:
            found[2, place : place + total].sort()
        else:
            counts[q] = total
