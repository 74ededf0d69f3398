# SPDX-License-Identifier: Apache-2.0
"""Pairs of points that lie near each other, frame by frame, found in a grid; and pairs of some frames alone."""

from __future__ import annotations

import torch
from torch import Tensor

from .. import loops

AT_ONCE = 1 << 24  # pairs in memory before distances are compared
MOST_CELLS = 1 << 16  # of the grid along an axis, so that cells of many frames have numbers of 64 bits


def near_pairs(
    points: Tensor,
    reach: Tensor,
    others: Tensor,
    other_reach: Tensor,
    *,
    groups: tuple[Tensor, Tensor] | None = None,
    ascending: bool = False,
) -> Tensor:
    """Return all pairs whose distance is at most the sum of both reaches, by frame, point and other.

    The cost grows with the number of points times the pairs within the largest reach.

    Args:
        points, others: finite positions [m], shapes (A, 3, N) and (B, 3, N).
        reach, other_reach: of each [m], shapes (A,) and (B,).
        groups: numbers (A,) and (B,); what has the same one is no pair.
        ascending: whether the other of a pair has the greater index, as where both lists are one.

    Returns:
        Frame, point and other of each pair, shape (3, P).
    """
    low = torch.minimum(points.amin((0, 2)), others.amin((0, 2)))
    span = torch.maximum(points.amax((0, 2)), others.amax((0, 2))) - low
    size = max(float(reach.max() + other_reach.max()), float(span.max()) / MOST_CELLS)
    cells = (span / size).long() + 3  # an empty layer of cells on each side
    own, theirs = (_cells(x, low, size, cells) for x in (points, others))
    key, order = theirs.flatten().sort(stable=True)
    other_frame, other = order // len(others), order % len(others)
    steps = torch.arange(-1, 2, device=points.device)
    rows = ((steps[:, None] * cells[1] + steps) * cells[2]).flatten()
    row = (own[..., None] + rows).contiguous()
    starts = torch.searchsorted(key, row - 1)
    ends = torch.searchsorted(key, row + 1, right=True)
    if loops.available(points.device):
        from ..loops.near_pairs import near_pairs_loop

        parts = order, starts.flatten(0, 1), ends.flatten(0, 1)
        return near_pairs_loop(points, reach, others, other_reach, *parts, groups, ascending)
    counts = ends - starts
    starts, counts = starts.flatten(), counts.flatten()
    found, first, total = [], 0, counts.cumsum(0)
    while first < len(counts):
        before = total[first - 1] if first else 0
        last = max(first + 1, int(torch.searchsorted(total, before + AT_ONCE, right=True)))
        query = torch.repeat_interleave(torch.arange(first, last, device=key.device), counts[first:last])
        within = torch.arange(len(query), device=key.device) - (total[query] - counts[query] - before)
        at = starts[query] + within
        frame, point = query // (9 * len(points)), query // 9 % len(points)
        far = points[point, :, frame] - others[other[at], :, other_frame[at]]
        limit = reach[point] + other_reach[other[at]]
        near = (far * far).sum(1) <= limit * limit
        if groups is not None:
            near &= groups[0][point] != groups[1][other[at]]
        if ascending:
            near &= other[at] > point
        found.append(torch.stack([frame[near], point[near], other[at][near]]))
        first = last
    pairs = torch.cat(found, dim=1)
    keys = (pairs[0] * len(points) + pairs[1]) * len(others) + pairs[2]
    return pairs[:, keys.argsort()]


def places_among(frame: Tensor, frames: Tensor, count: int) -> Tensor:
    """Return where the frame of each pair (P,) is among frames with indices (M,), -1 where it is not, shape (P,).

    Args:
        count: of all frames.
    """
    place = torch.full((count,), -1, device=frame.device)
    place[frames] = torch.arange(len(frames), device=frame.device)
    return place[frame]


def _cells(x: Tensor, low: Tensor, size: float, cells: Tensor) -> Tensor:
    """Return the cell of each point in each frame, shape (N, A)."""
    place = ((x - low[:, None]) / size).long() + 1
    frame = torch.arange(x.shape[-1], device=x.device)
    key = ((frame * cells[0] + place[:, 0]) * cells[1] + place[:, 1]) * cells[2] + place[:, 2]
    return key.T
