# SPDX-License-Identifier: Apache-2.0
"""The nearest body vertex of each garment vertex, exact on every device."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

MAX_SCORES = 1 << 27  # in memory at once, in batched matrix products
GARMENT_BLOCK, BODY_GROUP = 32, 8  # vertices of the garment and of the body that the kernel processes together


def consecutive_blocks(count: int, size: int, device: torch.device) -> Tensor:
    """Return indices 0 to count - 1 in consecutive blocks, int32; the last block is padded with its last index."""
    return (
        torch.arange(-(-count // size) * size, dtype=torch.int32, device=device).clamp_max(count - 1).view(-1, size)
    )


def nearest_vertex(x: Tensor, body: Tensor, allowed: Tensor | None = None) -> Tensor:
    """Return the index of the nearest body vertex by brute force; equal distances go to the lower index.

    All implementations minimise |x - b|^2 / 2 - |x|^2 / 2 = [x, 1] . [-b, |b|^2 / 2], with coordinates centred on the
    body so that cancellation errors stay far below the length of a body edge.

    Args:
        x: garment positions, shape (V, 3, N).
        body: body positions, shape (B, 3, N).
        allowed: the number of body vertices that each garment vertex can find, then their indices, shape (V, 1 + C);
            all by default.

    Returns:
        int64, shape (V, N).
    """
    centre = body.mean(0, keepdim=True)
    x, body = x - centre, body - centre
    half = 0.5 * (body * body).sum(1, keepdim=True)
    left = torch.cat([x, torch.ones_like(x[:, :1])], dim=1).permute(2, 1, 0).contiguous()
    right = torch.cat([-body, half], dim=1).permute(2, 1, 0).contiguous()
    barred = _barred(allowed, len(body), x.dtype)
    return _by_rows(left, right, barred) if x.device.type == "cpu" else _by_products(left, right, barred)


def _barred(allowed: Tensor | None, count: int, dtype: torch.dtype) -> Tensor | None:
    """Return the term added to scores (V, B): infinity for body vertices that are not allowed, else zero."""
    if allowed is None:
        return None
    barred = torch.full((len(allowed), count), torch.inf, dtype=dtype, device=allowed.device)
    return barred.scatter_(1, allowed[:, 1:].long(), 0.0)


def _by_rows(left: Tensor, right: Tensor, barred: Tensor | None) -> Tensor:
    # One buffer serves all frames; numpy's argmin is vectorised.
    score = left.new_empty(left.shape[2], right.shape[2])
    found = []
    for a, b in zip(left, right):
        torch.mm(a.T, b, out=score) if barred is None else torch.addmm(barred, a.T, b, out=score)
        found.append(score.numpy().argmin(-1))
    return torch.from_numpy(np.stack(found, axis=1))


def _by_products(left: Tensor, right: Tensor, barred: Tensor | None) -> Tensor:
    step = max(1, MAX_SCORES // (left.shape[2] * right.shape[2]))
    found = []
    for i in range(0, len(left), step):
        factors = left[i : i + step].transpose(1, 2), right[i : i + step]
        score = torch.bmm(*factors) if barred is None else torch.baddbmm(barred[None], *factors)
        found.append(score.argmin(-1))
    return torch.cat(found).T.contiguous()
