# SPDX-License-Identifier: Apache-2.0
"""The nearest body vertex by brute force; `energy.nearest` holds the plain twin.

A program owns one frame and a block of garment vertices. Layouts are (frames, coordinates, vertices), so that
neighbouring threads read neighbouring memory. Nothing is written twice: results do not depend on the order.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

BLOCK_GARMENT, BLOCK_BODY = 128, 32  # scores that one program keeps in registers


def nearest_kernel(left: Tensor, right: Tensor) -> Tensor:
    """Return argmin over body vertices of left . right; (N, 4, V) and (N, 4, B) to int64 (V, N)."""
    frames, _, vertices = left.shape
    found = torch.empty(frames, vertices, dtype=torch.int64, device=left.device)
    grid = (frames, -(-vertices // BLOCK_GARMENT))
    _nearest[grid](left, right, found, vertices, right.shape[2], BLOCK_GARMENT, BLOCK_BODY)
    return found.T.contiguous()


@triton.jit
def _nearest(left, right, found, vertices, body, block_v: tl.constexpr, block_b: tl.constexpr):
    frame = tl.program_id(0).to(tl.int64)
    v = tl.program_id(1) * block_v + tl.arange(0, block_v)
    inside = v < vertices
    point = left + frame * 4 * vertices + v
    x = tl.load(point, mask=inside, other=0.0)[:, None]
    y = tl.load(point + vertices, mask=inside, other=0.0)[:, None]
    z = tl.load(point + 2 * vertices, mask=inside, other=0.0)[:, None]
    best = tl.full((block_v, block_b), float("inf"), tl.float32)
    index = tl.zeros((block_v, block_b), tl.int32)
    for start in range(0, body, block_b):
        b = start + tl.arange(0, block_b)
        here = b < body
        base = right + frame * 4 * body + b
        bx = tl.load(base, mask=here, other=0.0)[None, :]
        by = tl.load(base + body, mask=here, other=0.0)[None, :]
        bz = tl.load(base + 2 * body, mask=here, other=0.0)[None, :]
        half = tl.load(base + 3 * body, mask=here, other=float("inf"))[None, :]
        score = x * bx + y * by + z * bz + half
        index = tl.where(score < best, b[None, :], index)
        best = tl.minimum(score, best)
    least = tl.min(best, axis=1)
    winner = tl.min(tl.where(best == least[:, None], index, 2147483647), axis=1)
    tl.store(found + frame * vertices + v, winner.to(tl.int64), mask=inside)
