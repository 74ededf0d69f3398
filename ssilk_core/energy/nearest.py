# SPDX-License-Identifier: Apache-2.0
"""The nearest body vertex of each garment vertex, exact by brute force on every device.

All paths minimise |x - b|^2 / 2 - |x|^2 / 2 = [x, 1] . [-b, |b|^2 / 2], with coordinates centred on the body so that
the cancellation stays far under the length of a body edge. Ties go to the lower index.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from .. import kernels

CHUNK = 1 << 27  # scores held at once where no kernel serves


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
    if kernels.available(x.device):
        from ..kernels.nearest import nearest_kernel

        return nearest_kernel(left, right)
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
