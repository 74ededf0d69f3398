# SPDX-License-Identifier: Apache-2.0
"""The nearest body vertex of each garment vertex, exact by brute force on every device.

All paths minimise |x - b|^2 / 2 - |x|^2 / 2 = [x, 1] . [-b, |b|^2 / 2], with coordinates centred on the body so that
the cancellation stays far under the length of a body edge. Ties go to the lower index.
"""

from __future__ import annotations

import importlib.util
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

CHUNK = 1 << 27  # scores held at once where no kernel serves
BLOCK_GARMENT, BLOCK_BODY = 128, 32  # scores that one program of the kernel keeps in registers


def nearest_vertex(x: Tensor, body: Tensor) -> Tensor:
    """Return the index of the nearest body vertex.

    Args:
        x: garment positions, shape (V, 3, N).
        body: body positions, shape (B, 3, N).

    Returns:
        int64, shape (V, N).
    """
    centre = body.mean(0, keepdim=True)
    x, body = x - centre, body - centre
    half = 0.5 * (body * body).sum(1, keepdim=True)
    left = torch.cat([x, torch.ones_like(x[:, :1])], dim=1).permute(2, 1, 0).contiguous()
    right = torch.cat([-body, half], dim=1).permute(2, 1, 0).contiguous()
    if x.device.type == "cpu":
        return _on_cpu(left, right)
    if x.device.type == "cuda" and importlib.util.find_spec("triton"):
        return _by_kernel(left, right)
    return _by_products(left, right)


def _on_cpu(left: Tensor, right: Tensor) -> Tensor:
    # One buffer serves all frames, and numpy's argmin uses the processor's vector units.
    score = left.new_empty(left.shape[2], right.shape[2])
    found = [torch.mm(a.T, b, out=score).numpy().argmin(-1) for a, b in zip(left, right)]
    return torch.from_numpy(np.stack(found, axis=1))


def _by_products(left: Tensor, right: Tensor) -> Tensor:
    step = max(1, CHUNK // (left.shape[2] * right.shape[2]))
    found = [
        torch.bmm(left[i : i + step].transpose(1, 2), right[i : i + step]).argmin(-1)
        for i in range(0, len(left), step)
    ]
    return torch.cat(found).T.contiguous()


def _by_kernel(left: Tensor, right: Tensor) -> Tensor:
    frames, _, vertices = left.shape
    found = torch.empty(frames, vertices, dtype=torch.int64, device=left.device)
    grid = (frames, -(-vertices // BLOCK_GARMENT))
    _kernel()[grid](left, right, found, vertices, right.shape[2], BLOCK_GARMENT, BLOCK_BODY)
    return found.T.contiguous()


@cache
def _kernel() -> Any:
    """Compile the kernel: a program owns one frame and a block of garment vertices, and walks over the body."""
    import triton
    import triton.language as tl

    @triton.jit
    def nearest(left, right, found, vertices, body, block_v: tl.constexpr, block_b: tl.constexpr):  # type: ignore[no-untyped-def]
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

    return nearest
