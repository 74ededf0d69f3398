# SPDX-License-Identifier: Apache-2.0
"""Distance of garment vertices to the posed body, and its penalty."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .. import kernels
from .nearest import BLOCK, GROUP, consecutive_blocks, nearest_vertex
from .surface_point import nearest_on_rings

# Further than this from every body vertex [m], the tangent plane at the nearest vertex says all that is needed.
FAR = 0.08


@dataclass(frozen=True, eq=False)
class PosedBody:
    """Body vertices [m] and unit vertex normals for each frame, both (B, 3, N).

    Attributes:
        rings: neighbours around each vertex (`surface_point.triangle_rings`); without them the nearest body point is
            the nearest vertex.
        groups: the vertices in compact groups (`nearest.compact_blocks` of `nearest.GROUP`), int32; they make the
            search on a GPU fast, and change no result but which of several equally near vertices is meant.
    """

    points: Tensor
    normals: Tensor
    rings: Tensor | None = None
    groups: Tensor | None = None


def gather_frames(values: Tensor, index: Tensor) -> Tensor:
    """Pick `values[index[v, n], :, n]`; values (B, 3, N), index (V, N), result (V, 3, N)."""
    return values.gather(0, index[:, None, :].expand(-1, 3, -1))


def signed_distance(x: Tensor, body: PosedBody, blocks: Tensor | None = None) -> Tensor:
    """Distance along the normal of the nearest body point b [m], n_b . (x - b), shape (V, N); its gradient is n_b."""
    normal, offset = nearest_planes(x, body, blocks)
    return (normal * x).sum(1) - offset


@torch.no_grad()
def nearest_planes(x: Tensor, body: PosedBody, blocks: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return unit normals n_b (V, 3, N) and offsets n_b . b (V, N) of the nearest body points b, without gradients.

    Args:
        x: garment positions (V, 3, N).
        body: the body in the same frames.
        blocks: garment vertices in compact blocks (`nearest.compact_blocks` of `nearest.BLOCK`), int32; they make
            the search on a GPU fast, and change no result.
    """
    if x.dtype == torch.float32 and kernels.available(x.device):
        return _by_kernels(x, body, blocks)
    index = nearest_vertex(x, body.points)
    normal, point = gather_frames(body.normals, index), gather_frames(body.points, index)
    offset = (normal * point).sum(1)
    if body.rings is None:
        return normal, offset
    return _on_triangles(x, index, normal, offset, ((x - point) ** 2).sum(1) < FAR**2, body)


def _by_kernels(x: Tensor, body: PosedBody, blocks: Tensor | None) -> tuple[Tensor, Tensor]:
    from ..kernels.nearest import nearest_kernel
    from ..kernels.surface import surface_kernel

    blocks = consecutive_blocks(len(x), BLOCK, x.device) if blocks is None else blocks
    groups = consecutive_blocks(len(body.points), GROUP, x.device) if body.groups is None else body.groups
    index = nearest_kernel(x, body.points, blocks, groups)
    rings = index.new_zeros(len(body.points), 1) if body.rings is None else body.rings
    return surface_kernel(x, index, body.points, body.normals, rings, FAR)


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
