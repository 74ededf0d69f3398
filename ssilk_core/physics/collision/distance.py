# SPDX-License-Identifier: Apache-2.0
"""Distances of garment vertices to the posed body."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from numpy.typing import NDArray
from torch import Tensor

from .. import kernels, loops
from ..framed import Framed
from .closest_point import bounding_spheres, closest_on_faces, frames_at_once
from .limb_axes import PosedLimbs
from .nearest_vertex import BODY_GROUP, GARMENT_BLOCK, consecutive_blocks, nearest_vertex
from .one_ring import nearest_on_rings
from .smoothed_distance import EDGE_EPSILON, SEARCH_MARGIN, SMOOTHING_EXPONENT, SmoothedDistance, smoothed_distance

# Cloth further than this from every body vertex [m] is searched for on the surface only if it may lie inside: behind
# the tangent plane at the nearest vertex, and no deeper than `MAX_DEPTH`. All other cloth this far away touches
# nothing. The tangent plane alone must not decide: it extends beyond the body, and differs from vertex to vertex. In
# training these jumps added energy to cloth that the body never touched.
MAX_QUERY_DISTANCE = 0.08
MAX_DEPTH = 0.25
# Tight cloth further than this from its patch touches nothing; only a tether moves it back. A patch is open: beyond
# its border and across its folds, the side of the nearest point does not tell where the cloth is. Far away such an
# error is a large force at random. The price is a jump at this depth, where the energy of contact falls to zero.
TIGHT_REACH = 0.02
# At the border of an open body the direction to the nearest point is across the normal there, and inside it is along
# it. `MAX_QUERY_DISTANCE` deep or deeper, the two may differ by 60 degrees; the cosine grows from zero to that.
DEEP_COSINE = 0.5
SMOOTHING_MEMORY_FACTOR = 4  # memory of a candidate pair for the smoothed distance, relative to the exact one
SURFACE_EPSILON = 1e-5  # [m]; closer to the surface, float32 no longer resolves the direction to it


@dataclass(frozen=True, eq=False)
class PosedBody(Framed):
    """Body vertices [m] and unit vertex normals for each frame, both (B, 3, N).

    Attributes:
        rings: neighbours around each vertex (`one_ring.triangle_rings`). With them cloth with a patch of its own, in
            training, finds its nearest body point on the triangles around the nearest vertex. Its normal is
            interpolated, so that it varies smoothly up to the edge of the patch.
        groups: the vertices in compact groups (`nearest_vertex.compact_blocks` of `BODY_GROUP`), int32. They speed up
            the search on a GPU; only the choice among equally near vertices depends on them.
        faces: triangles (F, 3). With them the nearest body point is that of the whole surface (`closest_point`); the
            distance is Euclidean in training and for measuring, and smoothed for simulation. Without faces and rings
            it is the nearest vertex.
        patches: the triangles in compact patches (`closest_point.triangle_patches`), int32, for the search on a GPU.
        limbs: axes that loose cloth must not cross; none by default.
    """

    SHARED = frozenset({"rings", "groups", "faces", "patches"})

    points: Tensor
    normals: Tensor
    rings: Tensor | None = None
    groups: Tensor | None = None
    faces: Tensor | None = None
    patches: Tensor | None = None
    limbs: PosedLimbs | None = None

    @cached_property
    def sphere_bounds(self) -> tuple[NDArray, NDArray]:
        """Spheres around its triangles, for loops: one body is queried several times."""
        from ..loops.smoothed_distance import sphere_bounds

        assert self.faces is not None
        return sphere_bounds(self.points, self.faces)


def gather_frames(values: Tensor, index: Tensor) -> Tensor:
    """Pick `values[index[v, n], :, n]`; values (B, 3, N), index (V, N), result (V, 3, N)."""
    return values.gather(0, index[:, None, :].expand(-1, 3, -1))


def signed_distance(x: Tensor, body: PosedBody) -> Tensor:
    """Distance along the normal of the nearest body point b [m], n_b . (x - b), shape (V, N); its gradient is n_b."""
    return signed_distance_to_planes(x, *nearest_planes(x, body))


def signed_distance_to_planes(x: Tensor, normal: Tensor, offset: Tensor) -> Tensor:
    """Return signed distances of x (V, 3, N) to planes of normals (V, 3, N) and offsets (V, N) [m], (V, N)."""
    return (normal * x).sum(1) - offset


@dataclass(frozen=True, eq=False)
class Patches:
    """The part of the body that each garment vertex can touch.

    Attributes:
        vertices: the number of body vertices, then their indices, int32 (V, 1 + C).
        faces: the triangles with any of these as a corner, padded with -1, shape (V, L).
    """

    vertices: Tensor
    faces: Tensor


@torch.no_grad()
def nearest_planes(
    x: Tensor, body: PosedBody, blocks: Tensor | None = None, patches: Patches | None = None
) -> tuple[Tensor, Tensor]:
    """Return unit normals n_b (V, 3, N) and offsets n_b . b (V, N) of the nearest body points b, without gradients.

    With `body.faces` normals are the directions from b to x, which are the gradient of the distance; otherwise they
    are interpolated. Cloth that is far away (`MAX_QUERY_DISTANCE`, and `TIGHT_REACH` with `patches`) has the
    direction from the nearest vertex, or on a processor from any that is as far away.

    Args:
        x: garment positions (V, 3, N).
        body: the body in the same frames.
        blocks: garment vertices in compact blocks (`nearest_vertex.compact_blocks` of `GARMENT_BLOCK`), int32. They
            speed up the search on a GPU and change no result.
        patches: the part of the body that each garment vertex can touch; all of it by default.
    """
    if patches is not None and body.rings is not None:
        body = replace(body, faces=None)
    if (kernels.supports(x) or loops.supports(x)) and _have_kernel(body, patches):
        return _by_kernels(x, body, blocks, patches)
    index, normal, offset, search_radius = _at_vertices(x, body, blocks, patches)
    if body.faces is not None:
        candidates = patches.faces if patches else None
        found = closest_on_faces(x, search_radius, body.points, body.faces, candidates)
        return _on_triangles(normal, offset, x, body, _reach(patches), *found)
    if body.rings is None:
        return normal, offset
    around = _around(x, index, search_radius >= 0, body)
    return _on_triangles(normal, offset, x, body, _reach(patches), *around)


@torch.no_grad()
def smoothed_planes(
    x: Tensor,
    body: PosedBody,
    blocks: Tensor | None = None,
    patches: Patches | None = None,
    within: float = math.inf,
) -> SmoothedDistance:
    """Return the smoothed distances of x to the body's surface, in the precision of x.

    Arguments are those of `nearest_planes`. Nothing is smoothed for a body without `faces`, or beyond
    `MAX_QUERY_DISTANCE`, or `TIGHT_REACH` with `patches`.

    Args:
        within: distances that matter outside of the body [m]; what is further away has that to a vertex that is
            further away, too. On a processor a small one saves time.
    """
    single = x.float()
    flat = single.new_zeros(len(x), 3, *x.shape[1:])
    if not x.numel():
        return SmoothedDistance(x, x[:, 0], flat)
    if body.faces is None or not len(body.faces):
        return SmoothedDistance(*nearest_planes(single, replace(body, faces=None), blocks, patches), flat).to(x.dtype)
    if kernels.supports(single):
        return _smoothed_by_kernel(single, body, blocks, patches).to(x.dtype)
    _, normal, offset, search_radius = _at_vertices(single, body, blocks, patches, within)
    plane, candidates = SmoothedDistance(normal, offset, flat).to(x.dtype), patches.faces if patches else None
    reach = _reach(patches)
    if loops.available(x.device):
        found, smoothed = _smoothed_by_loop(x, search_radius, body, candidates, reach)
        return SmoothedDistance(
            smoothed.normal.where(found[:, None], plane.normal),
            smoothed.offset.where(found, plane.offset),
            smoothed.curvature,
        )
    many = max(1, frames_at_once(x, body.faces, candidates) // SMOOTHING_MEMORY_FACTOR)
    for frames in torch.arange(x.shape[2], device=x.device).split(many):
        part = x[..., frames], search_radius[:, frames], body.points[..., frames], body.normals[..., frames]
        found, smoothed = smoothed_distance(*part, body.faces, SURFACE_EPSILON, lies_inside, reach, candidates)
        plane.normal[..., frames] = smoothed.normal.where(found[:, None], plane.normal[..., frames])
        plane.offset[..., frames] = smoothed.offset.where(found, plane.offset[..., frames])
        plane.curvature[..., frames] = smoothed.curvature
    return plane


def _smoothed_by_loop(
    x: Tensor, search_radius: Tensor, body: PosedBody, candidates: Tensor | None, reach: float
) -> tuple[Tensor, SmoothedDistance]:
    """Return the result of `smoothed_distance`."""
    from ..loops.smoothed_distance import smoothed_distance_loop

    assert body.faces is not None
    found, *smoothed = smoothed_distance_loop(
        x, search_radius, body.points, body.normals, body.faces, candidates, body.sphere_bounds,
        reach=reach, max_distance=MAX_QUERY_DISTANCE, deep_cosine=DEEP_COSINE, surface_epsilon=SURFACE_EPSILON,
        exponent=SMOOTHING_EXPONENT, search_margin=SEARCH_MARGIN, edge_epsilon=EDGE_EPSILON,
    )  # fmt: skip
    return found, SmoothedDistance(*smoothed)


def _smoothed_by_kernel(
    x: Tensor, body: PosedBody, blocks: Tensor | None, patches: Patches | None
) -> SmoothedDistance:
    """Return the result of `smoothed_planes`.

    Offsets are float64, since distances are more precise than positions.
    """
    from ..kernels.smoothed_distance import smoothed_distance_kernel

    assert body.faces is not None
    index = _nearest_vertex(x, body, blocks, patches).int()
    surface = body.points, body.normals, body.faces, torch.cat(bounding_spheres(body.points, body.faces), dim=1)
    normal, distance, curvature = smoothed_distance_kernel(
        x, index, *surface, patches.faces if patches else None,
        max_distance=MAX_QUERY_DISTANCE, max_depth=MAX_DEPTH, reach=_reach(patches), deep_cosine=DEEP_COSINE,
        surface_epsilon=SURFACE_EPSILON, exponent=SMOOTHING_EXPONENT, search_margin=SEARCH_MARGIN,
        edge_epsilon=EDGE_EPSILON,
    )  # fmt: skip
    return SmoothedDistance(normal, (normal.double() * x.double()).sum(1) - distance.double(), curvature)


def _at_vertices(
    x: Tensor, body: PosedBody, blocks: Tensor | None, patches: Patches | None, within: float = math.inf
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return indices (V, N), normals and offsets of planes at the nearest body vertices, and distances to them [m].

    Distances (V, N) are -1 where nothing nearer is to be searched for. Planes are tangent planes only where vertices
    are the surface, near enough to touch; all others are across the direction from the vertex.
    """
    index = _nearest_vertex(x, body, blocks, patches).long()
    normal, point = gather_frames(body.normals, index), gather_frames(body.points, index)
    away = x - point
    length = away.norm(dim=1)
    searched, height = length < MAX_QUERY_DISTANCE, (normal * away).sum(1)
    if patches is None and body.faces is not None:
        searched |= (height < 0) & (length < MAX_DEPTH)
    tangent = searched & (height.abs() < _reach(patches)) & (body.faces is None and body.rings is None)
    normal = torch.where(tangent[:, None], normal, away / length[:, None].clamp_min(SURFACE_EPSILON))
    radius = length.clamp_max(_reach(patches))
    radius = torch.where(height > 0, radius.clamp_max(within), radius)
    return index, normal, (normal * point).sum(1), radius.where(searched, -1)


def _have_kernel(body: PosedBody, patches: Patches | None) -> bool:
    return body.faces is None or (body.patches is not None and patches is None)


def _nearest_vertex(
    x: Tensor, body: PosedBody, blocks: Tensor | None, patches: Patches | None, enough: float = math.inf
) -> Tensor:
    """Return the index of the nearest body vertex (V, N), int32 from kernels and loops and int64 elsewhere.

    Where all vertices are further than `enough` [m], it may be that of any: on a processor this saves time.
    """
    on_gpu = kernels.supports(x)
    if not on_gpu and not loops.supports(x):
        return nearest_vertex(x, body.points, patches.vertices if patches else None)
    if patches is not None:
        if on_gpu:
            from ..kernels.candidates import nearest_candidate_kernel as among
        else:
            from ..loops.nearest_vertex import nearest_candidate_loop as among
        return among(x, body.points, patches.vertices)
    groups = consecutive_blocks(len(body.points), BODY_GROUP, x.device) if body.groups is None else body.groups
    given = x, body.points, _in_blocks(x, blocks), groups
    if on_gpu:
        from ..kernels.nearest_vertex import nearest_vertex_kernel

        return nearest_vertex_kernel(*given)
    from ..loops.nearest_vertex import nearest_vertex_loop

    return nearest_vertex_loop(*given, enough)


def _in_blocks(x: Tensor, blocks: Tensor | None) -> Tensor:
    """Return `blocks`, or consecutive ones by default."""
    return consecutive_blocks(len(x), GARMENT_BLOCK, x.device) if blocks is None else blocks


def _by_kernels(
    x: Tensor, body: PosedBody, blocks: Tensor | None, patches: Patches | None = None
) -> tuple[Tensor, Tensor]:
    """Return the result of `nearest_planes` from fused kernels, or on a processor from compiled loops."""
    if kernels.supports(x):
        from ..kernels.closest_point import closest_point_kernel as on_surface
        from ..kernels.one_ring import one_ring_kernel as around_vertex
    else:
        from ..loops.closest_point import closest_point_loop as on_surface
        from ..loops.planes import one_ring_loop as around_vertex
    enough = MAX_QUERY_DISTANCE if body.faces is None else MAX_DEPTH
    index = _nearest_vertex(x, body, blocks, patches, enough)
    if body.faces is not None and body.patches is not None:
        limits = MAX_QUERY_DISTANCE, MAX_DEPTH, DEEP_COSINE, SURFACE_EPSILON
        return on_surface(x, index, body.points, body.normals, _in_blocks(x, blocks), body.patches, *limits)
    rings = index.new_zeros(len(body.points), 1) if body.rings is None else body.rings
    on_triangles = body.rings is not None
    return around_vertex(
        x, index, body.points, body.normals, rings, MAX_QUERY_DISTANCE, _reach(patches), on_triangles
    )


def _reach(patches: Patches | None) -> float:
    """Return how far from its nearest point cloth can touch the body [m]; `MAX_QUERY_DISTANCE` bounds the search.

    Where vertices are the surface it bounds the height over the tangent plane: vertices may be far apart.
    """
    return math.inf if patches is None else TIGHT_REACH


def _around(x: Tensor, index: Tensor, near: Tensor, body: PosedBody) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the result of `closest_on_faces` for the triangles around the nearest vertex, where `near` (V, N)."""
    assert body.rings is not None
    row, frame = near.nonzero(as_tuple=True)
    points = body.points.transpose(0, 1).contiguous()
    queries = x.transpose(0, 1)[:, row, frame]
    return row, frame, *nearest_on_rings(queries, index[row, frame], frame, points, body.rings)


def _on_triangles(
    normal: Tensor,
    offset: Tensor,
    x: Tensor,
    body: PosedBody,
    reach: float,
    row: Tensor,
    frame: Tensor,
    corners: Tensor,
    weights: Tensor,
) -> tuple[Tensor, Tensor]:
    """Replace normals (V, 3, N) and offsets (V, N) by those at points on triangles, the result of `closest_on_faces`.

    Points further than `reach` from their queries x (V, 3, N) are left out. With `body.faces` normals are the
    directions from these points to the queries.
    """
    points, normals = body.points.transpose(0, 1).contiguous(), body.normals.transpose(0, 1).contiguous()
    point = (points[:, corners, frame] * weights).sum(1)
    found = (normals[:, corners, frame] * weights).sum(1)
    found = found / found.norm(dim=0).clamp_min(1e-8)
    away = x[row, :, frame].T - point
    if body.faces is not None:
        found = _outward(away, found)
    near = away.norm(dim=0) < reach
    row, frame, found, point = row[near], frame[near], found[:, near], point[:, near]
    normal[row, :, frame] = found.T
    offset[row, frame] = (found * point).sum(0)
    return normal, offset


def lies_inside(distance: Tensor, height: Tensor) -> Tensor:
    """Return whether queries lie inside the body, from their distances and heights over the nearest points [m]."""
    return height < -DEEP_COSINE * distance * (distance / MAX_QUERY_DISTANCE).clamp_max(1)


def _outward(away: Tensor, normal: Tensor) -> Tensor:
    """Return unit directions of vectors (3, M) away from the surface, on the side of its normals (3, M)."""
    length = away.norm(dim=0)
    side = torch.where(lies_inside(length, (away * normal).sum(0)), -1.0, 1.0)
    return torch.where(length > SURFACE_EPSILON, away * (side / length.clamp_min(SURFACE_EPSILON)), normal)
