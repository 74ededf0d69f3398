# SPDX-License-Identifier: Apache-2.0
"""Distance of garment vertices to the posed body, and its penalty."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .. import kernels
from .nearest import nearest_vertex
from .surface_point import nearest_on_rings

# Further than this from every body vertex [m], the tangent plane at the nearest vertex says all that is needed.
FAR = 0.08


@dataclass(frozen=True, eq=False)
class PosedBody:
    """Body vertices [m] and unit vertex normals for each frame, both (B, 3, N).

    `rings` (B, D, 2) are the triangles around each vertex (`surface_point.triangle_rings`); without them the
    nearest body point is the nearest vertex.
    """

    points: Tensor
    normals: Tensor
    rings: Tensor | None = None


def gather_frames(values: Tensor, index: Tensor) -> Tensor:
    """Pick `values[index[v, n], :, n]`; values (B, 3, N), index (V, N), result (V, 3, N)."""
    return values.gather(0, index[:, None, :].expand(-1, 3, -1))


def signed_distance(x: Tensor, body: PosedBody) -> Tensor:
    """Distance along the normal of the nearest body point b [m], n_b . (x - b), shape (V, N); its gradient is n_b."""
    with torch.no_grad():
        index = nearest_vertex(x, body.points)
        if body.rings is not None and kernels.available(x.device):
            from ..kernels.surface import surface_kernel

            normal, offset = surface_kernel(x, index, body.points, body.normals, body.rings)
        else:
            normal, offset = _on_planes(x, index, body)
    return (normal * x).sum(1) - offset


def _on_planes(x: Tensor, index: Tensor, body: PosedBody) -> tuple[Tensor, Tensor]:
    """Return normals n_b (V, 3, N) and offsets n_b . b (V, N) of the nearest body points."""
    normal, point = gather_frames(body.normals, index), gather_frames(body.points, index)
    offset = (normal * point).sum(1)
    if body.rings is None:
        return normal, offset
    return _on_triangles(x, index, normal, offset, ((x - point) ** 2).sum(1) < FAR**2, body)


def _on_triangles(
    x: Tensor, index: Tensor, normal: Tensor, offset: Tensor, near: Tensor, body: PosedBody
) -> tuple[Tensor, Tensor]:
    """Replace normals (V, 3, N) and offsets (V, N) by those of the nearest surface point where `near` (V, N)."""
    assert body.rings is not None
    row, frame = near.nonzero(as_tuple=True)
    points, normals = body.points.transpose(0, 1).contiguous(), body.normals.transpose(0, 1).contiguous()
    corners, weights = nearest_on_rings(
        x.transpose(0, 1)[:, row, frame], index[row, frame], frame, points, body.rings
    )
    point = (points[:, corners, frame] * weights).sum(1)
    found = (normals[:, corners, frame] * weights).sum(1)
    found = found / found.norm(dim=0).clamp_min(1e-8)
    normal[row, :, frame] = found.T
    offset[row, frame] = (found * point).sum(0)
    return normal, offset


def collision_energy(distance: Tensor, stiffness: float, margin: float) -> Tensor:
    """Penalty of each vertex [J], stiffness * min(distance - margin, 0)^2, shape (V, N)."""
    return stiffness * (distance - margin).clamp_max(0) ** 2
