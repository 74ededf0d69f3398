# SPDX-License-Identifier: Apache-2.0
"""Distance of garment vertices to the posed body, and its penalty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

# Distances held at once on a GPU; on the CPU one frame at a time stays in the cache.
CHUNK = 1 << 27


@dataclass(frozen=True, eq=False)
class PosedBody:
    """Body vertices [m] and unit vertex normals for each frame, both (B, 3, N)."""

    points: Tensor
    normals: Tensor


def nearest_vertex(x: Tensor, body: Tensor) -> Tensor:
    """Index of the nearest body vertex, exact by brute force.

    Args:
        x: garment positions, shape (V, 3, N).
        body: body positions, shape (B, 3, N).

    Returns:
        int64, shape (V, N).
    """
    # |x - b|^2 / 2 = |x|^2 / 2 + [x, 1] . [-b, |b|^2 / 2], whose first part does not matter to the choice. Centring
    # keeps the cancellation far under the length of a body edge.
    centre = body.mean(0, keepdim=True)
    x, body = x - centre, body - centre
    left = torch.cat([x, x.new_ones(len(x), 1, x.shape[-1])], dim=1).permute(2, 0, 1).contiguous()
    right = torch.cat([-body, 0.5 * (body * body).sum(1, keepdim=True)], dim=1).permute(2, 1, 0).contiguous()
    if x.device.type == "cpu":
        return _nearest_on_cpu(left, right)
    step = max(1, CHUNK // (left.shape[1] * right.shape[2]))
    found = [torch.bmm(left[i : i + step], right[i : i + step]).argmin(-1) for i in range(0, len(left), step)]
    return torch.cat(found).T.contiguous()


def _nearest_on_cpu(left: Tensor, right: Tensor) -> Tensor:
    # One buffer serves all frames, and numpy's argmin uses the processor's vector units.
    score = left.new_empty(left.shape[1], right.shape[2])
    found = np.stack([torch.mm(a, b, out=score).numpy().argmin(-1) for a, b in zip(left, right)], axis=1)
    return torch.from_numpy(found)


def gather_frames(values: Tensor, index: Tensor) -> Tensor:
    """Pick `values[index[v, n], :, n]`; values (B, 3, N), index (V, N), result (V, 3, N)."""
    return values.gather(0, index[:, None, :].expand(-1, 3, -1))


def signed_distance(x: Tensor, body: PosedBody) -> Tensor:
    """Distance along the nearest body vertex's normal [m], n_b . (x - b), shape (V, N); gradient n_b."""
    with torch.no_grad():
        index = nearest_vertex(x, body.points)
        normal = gather_frames(body.normals, index)
        offset = (normal * gather_frames(body.points, index)).sum(1)
    return (normal * x).sum(1) - offset


def collision_energy(distance: Tensor, stiffness: float, margin: float) -> Tensor:
    """Penalty of each vertex [J], stiffness * min(distance - margin, 0)^2, shape (V, N)."""
    return stiffness * (distance - margin).clamp_max(0) ** 2
