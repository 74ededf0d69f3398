# SPDX-License-Identifier: Apache-2.0
"""Distance of garment vertices to the posed body, and its penalty."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .nearest import nearest_vertex


@dataclass(frozen=True, eq=False)
class PosedBody:
    """Body vertices [m] and unit vertex normals for each frame, both (B, 3, N)."""

    points: Tensor
    normals: Tensor


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
