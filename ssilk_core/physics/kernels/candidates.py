# SPDX-License-Identifier: Apache-2.0
"""The nearest of each garment vertex's candidate body vertices; reference: `collision.nearest_vertex`.

A program owns one garment vertex in a block of frames: the list is the same for all of its threads.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from .vectors import dot, load3

FRAMES, WARPS = 128, 2  # of one program


def nearest_candidate_kernel(x: Tensor, points: Tensor, lists: Tensor) -> Tensor:
    """Return the index of the nearest candidate, int32 of shape (V, N); of equally near ones the first in its list.

    Args:
        x, points: garment (V, 3, N) and body (B, 3, N), float32.
        lists: for each garment vertex the number of candidates, then their indices, int32 (V, 1 + C).
    """
    x, points, lists = x.contiguous(), points.contiguous(), lists.contiguous()
    vertices, _, frames = x.shape
    found = torch.empty(vertices, frames, dtype=torch.int32, device=x.device)
    grid = (vertices, triton.cdiv(frames, FRAMES))
    _listed[grid](x, points, lists, found, frames, lists.shape[1], FRAMES, num_warps=WARPS)
    return found


@triton.jit
def _listed(x, points, lists, found, frames, width, block: tl.constexpr):
    v = tl.program_id(0).to(tl.int64)
    n = tl.program_id(1) * block + tl.arange(0, block)
    inside = n < frames
    px, py, pz = load3(x + v * 3 * frames, frames, n, inside)
    best = tl.full((block,), float("inf"), tl.float32)
    mine = lists + v * width
    nearest = tl.zeros((block,), tl.int32) + tl.load(mine + 1)
    for place in range(1, 1 + tl.load(mine)):
        candidate = tl.load(mine + place)
        bx, by, bz = load3(points + candidate.to(tl.int64) * 3 * frames, frames, n, inside)
        bx, by, bz = px - bx, py - by, pz - bz
        square = dot(bx, by, bz, bx, by, bz)
        closer = square < best
        best, nearest = tl.where(closer, square, best), tl.where(closer, candidate, nearest)
    tl.store(found + v * frames + n, nearest, mask=inside)
