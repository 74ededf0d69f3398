# SPDX-License-Identifier: Apache-2.0
"""Cloth above and beneath points, along a direction of each: short rays cast both ways.

Rays are compared with the bounding spheres of compact patches of triangles, as products of matrices. The triangles of
the patches that a ray can meet are intersected exactly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Mesh
from ...scene.mesh.blocks import compact_blocks

RAY_PATCH = 8  # triangles with one bounding sphere
MAX_RAY_PAIRS = 1 << 20, 1 << 26  # pairs of a ray and a patch, or a triangle, at once on a CPU and on a GPU: 1 GB
SPHERE_SLACK = 1e-4  # [m] added to bounding spheres; rounding is smaller
TINY = 1e-9  # [m], so that a segment of no length has a direction
EDGE_TOLERANCE = 1e-6  # in barycentric coordinates, so that no ray slips between two triangles


@dataclass(frozen=True, eq=False)
class RayHits:
    """Which points have cloth above them, and which beneath, both bool (P, N)."""

    above: Tensor
    beneath: Tensor


class RayCaster:
    """Finds the triangles of a mesh along short rays, in any pose.

    Attributes:
        faces: the triangles, shape (F, 3).

    Args:
        mesh: at rest, which tells only which triangles lie close together.
    """

    def __init__(self, mesh: Mesh, *, device: torch.device) -> None:
        numbers = compact_blocks(mesh.points[mesh.faces].mean(axis=1), RAY_PATCH)
        self.faces = torch.as_tensor(np.array(mesh.faces), device=device)
        self.numbers = torch.as_tensor(numbers, dtype=torch.int64, device=device)  # triangles of each patch
        self.patches = self.faces[self.numbers]  # (patches, triangles, corners)

    @torch.no_grad()
    def cast(self, points: Tensor, directions: Tensor, x: Tensor, *, above: float, beneath: float) -> RayHits:
        """Tell which points have a triangle within reach along their directions, and which against them.

        Args:
            points: [m]; directions: of unit length; both (P, 3, N).
            x: vertices of the mesh in the same frames [m], shape (V, 3, N).
            above, beneath: reach along the directions and against them [m].
        """
        shape = len(points), x.shape[2]
        hits = RayHits(*(torch.zeros(shape, dtype=torch.bool, device=x.device) for _ in range(2)))
        for ray, frame, _, distance in self._meetings(points, directions, x, above, beneath):
            upward = ((distance >= 0) & (distance <= above)).any(1)
            downward = ((distance < 0) & (distance >= -beneath)).any(1)
            hits.above[ray[upward], frame[upward]] = True
            hits.beneath[ray[downward], frame[downward]] = True
        return hits

    @torch.no_grad()
    def outermost(
        self, points: Tensor, directions: Tensor, x: Tensor, *, above: float, beneath: float
    ) -> tuple[Tensor, Tensor]:
        """Return how far along its direction each point meets the outermost triangle, and which that is.

        Arguments are those of `cast`.

        Returns:
            Signed distances [m], minus infinity without a triangle within reach, and indices of triangles, both
            (P, N).
        """
        frames = x.shape[2]
        farthest = x.new_full((len(points) * frames,), -torch.inf)
        found = torch.full_like(farthest, len(self.faces), dtype=torch.int64)
        for ray, frame, patch, distance in self._meetings(points, directions, x, above, beneath):
            reached = distance.where((distance <= above) & (distance >= -beneath), -torch.inf)
            here = (ray * frames + frame)[:, None].expand_as(reached).reshape(-1)
            reached, number = reached.reshape(-1), self.numbers[patch].reshape(-1)
            before = farthest.clone()
            farthest.scatter_reduce_(0, here, reached, "amax")
            found[farthest > before] = len(self.faces)
            best = (reached == farthest[here]) & (reached > -torch.inf)
            found.scatter_reduce_(0, here[best], number[best], "amin")  # of equally far ones always the same
        return farthest.reshape(-1, frames), found.reshape(-1, frames)

    @torch.no_grad()
    def crossings(self, starts: Tensor, ends: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return how many triangles each segment crosses, how far along it the last of them is, and which.

        Args:
            starts, ends: of the segments [m], both (P, 3, N).
            x: vertices of the mesh in the same frames [m], shape (V, 3, N).

        Returns:
            Counts, shares of the length and indices of triangles, zero without a crossing, all (P, N).
        """
        lengths = (ends - starts).norm(dim=1).clamp_min(TINY)
        counts, last = torch.zeros_like(lengths, dtype=torch.int64), torch.zeros_like(lengths)
        found = torch.zeros_like(counts)
        along = (ends - starts) / lengths[:, None]
        for ray, frame, patch, distance in self._meetings(starts, along, x, lengths, 0.0):
            share = distance / lengths[ray, frame][:, None]
            share = share.where((share >= 0) & (share <= 1), -1.0)
            here = ray * lengths.shape[1] + frame
            counts.view(-1).scatter_add_(0, here, (share >= 0).sum(1))
            best, place = share.max(1)
            last.view(-1).scatter_reduce_(0, here, best.clamp_min(0), "amax")
            won = (best >= 0) & (best == last.view(-1)[here])
            found.view(-1)[here[won]] = self.numbers[patch[won], place[won]]
        return counts, last, found

    def _meetings(
        self, points: Tensor, directions: Tensor, x: Tensor, above: float | Tensor, beneath: float
    ) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """Yield rays, frames and patches (M,) of pairs that can meet, and where the patch's triangles meet the line.

        Distances (M, `RAY_PATCH`) are along the directions [m], infinite where a triangle does not meet the line.
        `above` may be (P, N).
        """
        limit, patches = MAX_RAY_PAIRS[x.is_cuda], max(1, len(self.patches))
        frames, rays = max(1, limit // max(1, len(points) * patches)), max(1, limit // patches)
        for chosen in torch.arange(x.shape[2], device=x.device).split(frames):
            # Products lose fewer digits about the middle of the cloth.
            middle = x[..., chosen].mean(0)
            start, direction, vertices = (
                values.permute(2, 0, 1)
                for values in (points[..., chosen] - middle, directions[..., chosen], x[..., chosen] - middle)
            )
            triangles = vertices[:, self.patches]  # (n, patches, triangles, corners, 3)
            spheres = _bounding_spheres(triangles.flatten(2, 3))
            reach = above[:, chosen].T[..., None] if isinstance(above, Tensor) else above
            for first in range(0, len(points), rays):
                part = slice(first, first + rays)
                far = reach[:, part] if isinstance(reach, Tensor) else reach
                pairs = _reachable(start[:, part], direction[:, part], *spheres, far, beneath)
                pairs[:, 1] += first
                for frame, ray, patch in (some.unbind(1) for some in pairs.split(max(1, limit // RAY_PATCH))):
                    lines = start[frame, ray][:, None], direction[frame, ray][:, None]
                    yield ray, chosen[frame], patch, ray_distances(*lines, triangles[frame, patch])


def _bounding_spheres(corners: Tensor) -> tuple[Tensor, Tensor]:
    """Return centres (n, patches, 3) and radii (n, patches, 1) of corners (n, patches, C, 3)."""
    centre = corners.mean(2)
    return centre, (corners - centre[:, :, None]).norm(dim=-1).amax(-1, keepdim=True) + SPHERE_SLACK


def _reachable(
    start: Tensor, direction: Tensor, centre: Tensor, radius: Tensor, above: float | Tensor, beneath: float
) -> Tensor:
    """Return frames, rays and patches of all pairs that can meet, shape (M, 3).

    A ray can meet a patch if the patch's sphere, of centre c and radius r, meets the line, and its centre projects
    within r of the ray. With the vector q from the ray's middle to c, and the ray's direction d, these are
    |q|^2 - (q . d)^2 <= r^2 and |q . d| <= r + h, where h is half the ray's length.

    Args:
        start, direction: shape (n, P, 3).
        centre, radius: of the patches' spheres, as `_bounding_spheres` returns.
        above, beneath: one for all rays; `above` may be (n, P, 1).
    """
    middle, one = start + direction * ((above - beneath) / 2), torch.ones_like(start[..., :1])
    squares = (middle * middle).sum(-1, keepdim=True)
    power = (centre * centre).sum(-1, keepdim=True) - radius * radius
    from_rays = torch.cat([-2 * middle, squares, one], -1)
    from_patches = torch.cat([centre, torch.ones_like(radius), power], -1)
    apart = from_rays @ from_patches.mT
    along = torch.cat([direction, -(middle * direction).sum(-1, keepdim=True)], -1) @ from_patches[..., :4].mT
    near = torch.addcmul(apart, along, along, value=-1) <= 0
    return (near & (along.abs_().sub_(radius.mT) <= (above + beneath) / 2)).nonzero()


def ray_distances(start: Tensor, direction: Tensor, triangle: Tensor) -> Tensor:
    """Return signed distances along directions at which lines meet triangles [m]; infinity where they do not.

    The distance t and the barycentric coordinates u, v solve start + t direction = a + u (b - a) + v (c - a) by
    Cramer's rule.

    Args:
        start, direction: shape (..., 3); triangle: corners a, b, c, shape (..., 3, 3).
    """
    a = triangle[..., 0, :]
    first, second, s = triangle[..., 1, :] - a, triangle[..., 2, :] - a, start - a
    across, turned = torch.linalg.cross(direction, second), torch.linalg.cross(s, first)
    determinant = (first * across).sum(-1)
    u, v = (s * across).sum(-1) / determinant, (direction * turned).sum(-1) / determinant
    inside = (u >= -EDGE_TOLERANCE) & (v >= -EDGE_TOLERANCE) & (u + v <= 1 + EDGE_TOLERANCE)  # not where parallel
    return ((second * turned).sum(-1) / determinant).where(inside, torch.inf)
