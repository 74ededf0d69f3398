# SPDX-License-Identifier: Apache-2.0
"""Distance of garment vertices to the posed body."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from .. import kernels
from .closest_point import bounding_spheres, closest_on_faces, frames_at_once
from .nearest_vertex import BLOCK, GROUP, consecutive_blocks, nearest_vertex
from .one_ring import nearest_on_rings
from .smoothed_distance import ON_EDGE, SHARPNESS, SLACK, SmoothedDistance, smoothed_distance

# Further than this from every body vertex [m], the tangent plane at the nearest vertex says all that is needed.
FAR = 0.08
SMOOTHED_PAIRS = 4  # times as much is kept of a pair of vertex and triangle to smooth as to find the nearest
TOUCHING = 1e-5  # [m] from the surface, within which single precision no longer tells the direction to it


@dataclass(frozen=True, eq=False)
class PosedBody:
    """Body vertices [m] and unit vertex normals for each frame, both (B, 3, N).

    Attributes:
        rings: neighbours around each vertex (`surface_point.triangle_rings`); without them the nearest body point is
            the nearest vertex.
        groups: the vertices in compact groups (`nearest.compact_blocks` of `nearest.GROUP`), int32; they make the
            search on a GPU fast, and change no result but which of several equally near vertices is meant.
        faces: triangles (F, 3); with them the nearest body point is that of the whole surface (`closest`), and the
            distance the Euclidean one, for measuring, and smoothed for simulating. Training's differs where a
            triangle away from the nearest vertex is nearer than those around it, and by the cosine between the
            interpolated normal and the direction to the surface.
        patches: the triangles in compact patches (`closest.patches_of`), int32; a GPU searches by them.
    """

    points: Tensor
    normals: Tensor
    rings: Tensor | None = None
    groups: Tensor | None = None
    faces: Tensor | None = None
    patches: Tensor | None = None

    def select(self, frames: Tensor) -> PosedBody:
        """Return the body in the frames with indices (M,)."""
        return replace(self, points=self.points[..., frames], normals=self.normals[..., frames])


def gather_frames(values: Tensor, index: Tensor) -> Tensor:
    """Pick `values[index[v, n], :, n]`; values (B, 3, N), index (V, N), result (V, 3, N)."""
    return values.gather(0, index[:, None, :].expand(-1, 3, -1))


def signed_distance(x: Tensor, body: PosedBody) -> Tensor:
    """Distance along the normal of the nearest body point b [m], n_b . (x - b), shape (V, N); its gradient is n_b."""
    return signed(x, *nearest_planes(x, body))


def signed(x: Tensor, normal: Tensor, offset: Tensor) -> Tensor:
    """Return signed distances of x (V, 3, N) to planes of normals (V, 3, N) and offsets (V, N) [m], (V, N)."""
    return (normal * x).sum(1) - offset


@dataclass(frozen=True, eq=False)
class Patches:
    """What garment vertices may find of a body instead of all of it.

    Attributes:
        vertices: how many, then these, the nearest of which has the nearest point, int32 (V, 1 + C).
        faces: triangles that have one of them for a corner, filled up by -1, shape (V, L).
    """

    vertices: Tensor
    faces: Tensor


@torch.no_grad()
def nearest_planes(
    x: Tensor, body: PosedBody, blocks: Tensor | None = None, patches: Patches | None = None
) -> tuple[Tensor, Tensor]:
    """Return unit normals n_b (V, 3, N) and offsets n_b . b (V, N) of the nearest body points b, without gradients.

    Normals are interpolated, or with `body.faces` the directions from b: held still, as all take them, those are
    the true gradient of the distance, and interpolated ones are not.

    Args:
        x: garment positions (V, 3, N).
        body: the body in the same frames.
        blocks: garment vertices in compact blocks (`nearest.compact_blocks` of `nearest.BLOCK`), int32; they make
            the search on a GPU fast, and change no result.
        patches: what each garment vertex may find; all by default.
    """
    if kernels.serve(x) and _have_kernel(body, patches):
        return _by_kernels(x, body, blocks, patches)
    index, normal, offset, reach = _at_vertices(x, body, blocks, patches)
    if body.faces is not None:
        listed = patches.faces if patches else None
        found = closest_on_faces(x, reach, body.points, body.faces, listed)
        return _on_triangles(normal, offset, body, *found, x)
    if body.rings is None:
        return normal, offset
    return _on_triangles(normal, offset, body, *_around(x, index, reach >= 0, body))


@torch.no_grad()
def smoothed_planes(
    x: Tensor, body: PosedBody, blocks: Tensor | None = None, patches: Patches | None = None
) -> SmoothedDistance:
    """Return the smoothed distances of x to the body's surface, in its precision, as `nearest_planes` is asked.

    A body without `faces` is not smoothed, nor are points `FAR` from it.
    """
    single = x.float()
    flat = single.new_zeros(len(x), 3, *x.shape[1:])
    if not x.numel():
        return SmoothedDistance(x, x[:, 0], flat)
    if body.faces is None or not len(body.faces):
        return SmoothedDistance(*nearest_planes(single, replace(body, faces=None), blocks, patches), flat).to(x.dtype)
    if kernels.serve(single):
        return _smoothed_by_kernel(single, body, blocks, patches).to(x.dtype)
    _, normal, offset, reach = _at_vertices(single, body, blocks, patches)
    plane, listed = SmoothedDistance(normal, offset, flat).to(x.dtype), patches.faces if patches else None
    many = max(1, frames_at_once(x, body.faces, listed) // SMOOTHED_PAIRS)
    for frames in torch.arange(x.shape[2], device=x.device).split(many):
        part = x[..., frames], reach[:, frames], body.points[..., frames], body.normals[..., frames]
        found, smoothed = smoothed_distance(*part, body.faces, TOUCHING, listed)
        plane.normal[..., frames] = smoothed.normal.where(found[:, None], plane.normal[..., frames])
        plane.offset[..., frames] = smoothed.offset.where(found, plane.offset[..., frames])
        plane.curvature[..., frames] = smoothed.curvature
    return plane


def _smoothed_by_kernel(
    x: Tensor, body: PosedBody, blocks: Tensor | None, patches: Patches | None
) -> SmoothedDistance:
    """Return what `smoothed_planes` does; offsets are float64, for distances are known better than positions."""
    from ..kernels.smoothed_distance import smoothed_distance_kernel

    assert body.faces is not None
    index = _nearest_vertex(x, body, blocks, patches).int()
    surface = body.points, body.normals, body.faces, torch.cat(bounding_spheres(body.points, body.faces), dim=1)
    normal, distance, curvature = smoothed_distance_kernel(
        x, index, *surface, patches.faces if patches else None,
        far=FAR, touching=TOUCHING, sharpness=SHARPNESS, slack=SLACK, on_edge=ON_EDGE,
    )  # fmt: skip
    return SmoothedDistance(normal, (normal.double() * x.double()).sum(1) - distance.double(), curvature)


def _at_vertices(
    x: Tensor, body: PosedBody, blocks: Tensor | None, patches: Patches | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the index of the nearest body vertices (V, N), their normals and offsets, and how far they are.

    The distances [m] (V, N) are -1 from `FAR` on.
    """
    index = _nearest_vertex(x, body, blocks, patches).long()
    normal, point = gather_frames(body.normals, index), gather_frames(body.points, index)
    square = ((x - point) ** 2).sum(1)
    return index, normal, (normal * point).sum(1), square.sqrt().where(square < FAR**2, -1)


def _have_kernel(body: PosedBody, patches: Patches | None) -> bool:
    return body.faces is None or (body.patches is not None and patches is None)


def _nearest_vertex(x: Tensor, body: PosedBody, blocks: Tensor | None, patches: Patches | None) -> Tensor:
    """Return the index of the nearest body vertex (V, N), int32 from the kernels and int64 elsewhere."""
    if not kernels.serve(x):
        return nearest_vertex(x, body.points, patches.vertices if patches else None)
    if patches is not None:
        from ..kernels.candidates import listed_kernel

        return listed_kernel(x, body.points, patches.vertices)
    from ..kernels.nearest_vertex import nearest_kernel

    groups = consecutive_blocks(len(body.points), GROUP, x.device) if body.groups is None else body.groups
    return nearest_kernel(x, body.points, _in_blocks(x, blocks), groups)


def _in_blocks(x: Tensor, blocks: Tensor | None) -> Tensor:
    """Return the blocks, or those of vertices as they come where there are none."""
    return consecutive_blocks(len(x), BLOCK, x.device) if blocks is None else blocks


def _by_kernels(
    x: Tensor, body: PosedBody, blocks: Tensor | None, patches: Patches | None = None
) -> tuple[Tensor, Tensor]:
    from ..kernels.closest_point import closest_kernel
    from ..kernels.one_ring import surface_kernel

    index = _nearest_vertex(x, body, blocks, patches)
    if body.faces is not None and body.patches is not None:
        reach = FAR, TOUCHING
        return closest_kernel(x, index, body.points, body.normals, _in_blocks(x, blocks), body.patches, *reach)
    rings = index.new_zeros(len(body.points), 1) if body.rings is None else body.rings
    return surface_kernel(x, index, body.points, body.normals, rings, FAR)


def _around(x: Tensor, index: Tensor, near: Tensor, body: PosedBody) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return what `closest_on_faces` does, where `near` (V, N) and of the triangles around the nearest vertex."""
    assert body.rings is not None
    row, frame = near.nonzero(as_tuple=True)
    points = body.points.transpose(0, 1).contiguous()
    queries = x.transpose(0, 1)[:, row, frame]
    return row, frame, *nearest_on_rings(queries, index[row, frame], frame, points, body.rings)


def _on_triangles(
    normal: Tensor,
    offset: Tensor,
    body: PosedBody,
    row: Tensor,
    frame: Tensor,
    corners: Tensor,
    weights: Tensor,
    x: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Replace normals (V, 3, N) and offsets (V, N) by those of points on triangles, as `closest_on_faces` gives.

    Normals are the directions from these points to queries x (V, 3, N) where those are given.
    """
    points, normals = body.points.transpose(0, 1).contiguous(), body.normals.transpose(0, 1).contiguous()
    point = (points[:, corners, frame] * weights).sum(1)
    found = (normals[:, corners, frame] * weights).sum(1)
    found = found / found.norm(dim=0).clamp_min(1e-8)
    if x is not None:
        found = _outward(x[row, :, frame].T - point, found)
    normal[row, :, frame] = found.T
    offset[row, frame] = (found * point).sum(0)
    return normal, offset


def _outward(away: Tensor, normal: Tensor) -> Tensor:
    """Return unit directions of vectors (3, M) away from the surface, to the side that its normals (3, M) show."""
    length = away.norm(dim=0)
    side = torch.where((away * normal).sum(0) < 0, -1.0, 1.0)
    return torch.where(length > TOUCHING, away * (side / length.clamp_min(TOUCHING)), normal)
