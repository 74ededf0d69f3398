# SPDX-License-Identifier: Apache-2.0
"""Pairs of points that lie near each other, frame by frame, found in a grid; and pairs of some frames alone."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .. import kernels

AT_ONCE = 1 << 24  # pairs in memory before distances are compared
MOST_CELLS = 1 << 16  # of the grid along an axis, so that cells of many frames have numbers of 64 bits


@dataclass(frozen=True, eq=False)
class Grid:
    """B points in N frames in the order of cells, and where in it those are that may be near A others.

    Attributes:
        order: frame and point as one number, frame B + point, shape (N B,).
        first, last: the parts of this order in which those near one of the others are, shapes (N, A, 9).
    """

    order: Tensor
    first: Tensor
    last: Tensor

    @classmethod
    def of(cls, points: Tensor, others: Tensor, reach: float) -> Grid:
        """Return the grid of points (B, 3, N), for others (A, 3, N) within reach [m] of them; all must be finite."""
        low = torch.minimum(points.amin((0, 2)), others.amin((0, 2)))
        span = torch.maximum(points.amax((0, 2)), others.amax((0, 2))) - low
        size = max(reach, float(span.max()) / MOST_CELLS)
        cells = (span / size).long() + 3  # an empty layer of cells on each side
        own, theirs = (_cells(x, low, size, cells) for x in (others, points))
        key, order = theirs.flatten().sort(stable=True)
        steps = torch.arange(-1, 2, device=points.device)
        rows = ((steps[:, None] * cells[1] + steps) * cells[2]).flatten()
        if kernels.available(points.device):
            row = own.contiguous()[..., None] + rows
            return cls(order, torch.searchsorted(key, row - 1), torch.searchsorted(key, row + 1, right=True))
        asked, at = own.unique(return_inverse=True)  # many points share a cell
        row = asked[:, None] + rows
        return cls(order, torch.searchsorted(key, row - 1)[at], torch.searchsorted(key, row + 1, right=True)[at])


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
    grid = Grid.of(others, points, float(reach.max() + other_reach.max()))
    other_frame, other = grid.order // len(others), grid.order % len(others)
    starts, counts = grid.first.flatten(), (grid.last - grid.first).flatten()
    found, first, total = [], 0, counts.cumsum(0)
    while first < len(counts):
        before = total[first - 1] if first else 0
        last = max(first + 1, int(torch.searchsorted(total, before + AT_ONCE, right=True)))
        query = torch.repeat_interleave(torch.arange(first, last, device=points.device), counts[first:last])
        within = torch.arange(len(query), device=points.device) - (total[query] - counts[query] - before)
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
