# SPDX-License-Identifier: Apache-2.0
"""The exact nearest point of a body's whole surface.

The nearest point may lie on a triangle that does not touch the nearest vertex. A search around that vertex
(`nearest_vertex`, `one_ring`) ignores this: there the distance is too large, by millimetres on a coarse body, and
discontinuous. A solver does not converge across such discontinuities, and in training loose cloth gains energy from
them. This module therefore checks every triangle that can hold the nearest point. The result is the Euclidean
distance, which is continuous, and smooth where the nearest point is unique.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Floats, Ints
from ...scene.mesh.blocks import compact_blocks
from .one_ring import closest_in_triangle

MAX_PAIRS = 1 << 25  # pairs of a vertex and a triangle in memory at once, on a CPU
GPU_FACTOR = 8  # times as many pairs on a GPU: 2 GB, in few launches
PATCH_SIZE = 8  # triangles that the kernel processes together
FEW_PAIRS = 1 << 21  # pairs that a CPU scores one by one, too few for blocks to pay
QUERY_BLOCK = 64  # queries with one bounding sphere, on a CPU
ROUNDING = 1e-6  # relative, by which spheres are larger than what they hold


def triangle_patches(points: Floats, faces: Ints) -> Ints:
    """Return the corners of triangles in compact patches, int32 (ceil(F / PATCH_SIZE), 4 PATCH_SIZE).

    A patch holds the first corners of its triangles, then the second, then the third; the last quarter is padding.
    """
    triangles = faces[compact_blocks(points[faces].mean(axis=1), PATCH_SIZE)]
    corners = np.concatenate([triangles, triangles[..., :1]], axis=-1)
    return corners.transpose(0, 2, 1).reshape(len(triangles), 4 * PATCH_SIZE).astype(np.int32)


def closest_on_faces(
    x: Tensor, search_radius: Tensor, points: Tensor, faces: Tensor, candidates: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the nearest points on triangles for the Q queries that have one within their search radius.

    Args:
        x: queries, shape (V, 3, N).
        search_radius: upper bound of each distance [m], shape (V, N); negative values skip a query.
        points: corners of the triangles, shape (B, 3, N).
        faces: triangles, shape (F, 3).
        candidates: triangles that each row of queries may find, padded with -1, shape (V, L); all by default.

    Returns:
        Row and frame of each query (Q,); the body vertices at the corners of its triangle and barycentric
        coordinates, both (3, Q).
    """
    frames = frames_at_once(x, faces, candidates)
    parts = [
        _closest(x, search_radius, points, faces, candidates, at, min(at + frames, x.shape[2]))
        for at in range(0, x.shape[2], frames)
    ]
    row, frame, corners, weights = (torch.cat(part, dim=-1) for part in zip(*parts))
    return row, frame, corners, weights


def frames_at_once(x: Tensor, faces: Tensor, candidates: Tensor | None) -> int:
    """Return how many frames of queries are processed at once."""
    scores = MAX_PAIRS * (GPU_FACTOR if x.is_cuda else 1)
    return max(1, scores // (len(x) * (len(faces) if candidates is None else candidates.shape[1])))


def _closest(
    x: Tensor, search_radius: Tensor, points: Tensor, faces: Tensor, candidates: Tensor | None, start: int, stop: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the result of `closest_on_faces` for frames `start` to `stop`."""
    part = x[..., start:stop], search_radius[:, start:stop], points[..., start:stop]
    row, frame, face = candidate_pairs(*part, faces, candidates)
    frame = frame + start
    corners = faces[face].T
    origin, second, third = (points[corner, :, frame].T for corner in corners)
    p = x[row, :, frame].T - origin
    s, t, value = closest_in_triangle(p, second - origin, third - origin)
    squares = (p * p).sum(0) + value
    query = row * x.shape[2] + frame
    _, first = segment_min(query, squares, x[:, 0].numel())
    winner = first[first < len(query)]
    return row[winner], frame[winner], corners[:, winner], torch.stack([1 - s - t, s, t])[:, winner]


def segment_min(query: Tensor, values: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the minimum of each query's values and its index, both (count,); infinity and Q where there is none.

    Of equal values the first counts, so that results are deterministic.

    Args:
        query: the query that each value belongs to, shape (Q,); values: shape (Q,).
    """
    least = values.new_full((count,), torch.inf).scatter_reduce(0, query, values, "amin")
    place = torch.arange(len(query), device=query.device)
    chosen = place.where(values <= least[query], len(place))
    return least, place.new_full((count,), len(place)).scatter_reduce(0, query, chosen, "amin")


def candidate_pairs(
    x: Tensor, search_radius: Tensor, points: Tensor, faces: Tensor, candidates: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return row, frame and face of all pairs of a query and a triangle whose bounding sphere is within reach, (M,)
    each.

    Arguments are those of `closest_on_faces`. All frames are processed at once.
    """
    if candidates is not None:
        return _listed_pairs(x, search_radius, points, faces, candidates)
    if x.is_cuda:  # a GPU multiplies faster than it selects
        return all_pairs(x, search_radius, points, faces)
    rows = (search_radius >= 0).any(1).nonzero()[:, 0]
    found = all_pairs if len(rows) * len(faces) * x.shape[2] <= FEW_PAIRS else blocked_pairs
    row, frame, face = found(x[rows], search_radius[rows], points, faces)
    return rows[row], frame, face


def _listed_pairs(
    x: Tensor, search_radius: Tensor, points: Tensor, faces: Tensor, candidates: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the result of `all_pairs` among the candidates of each query, shape (V, L)."""
    centre, radius = bounding_spheres(points, faces)
    apart = sum((x[:, None, axis] - centre[:, axis][candidates]).square() for axis in range(3))  # (V, L, N)
    within = apart <= ((radius[:, 0][candidates] + search_radius[:, None]) * (1 + ROUNDING)).square()
    asked = (search_radius >= 0)[:, None] & (candidates >= 0)[..., None]
    row, place, frame = (within & asked).nonzero(as_tuple=True)
    return row, frame, candidates[row, place]


def bounding_spheres(points: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Return centres (F, 3, N) and radii (F, 1, N) of spheres around triangles."""
    corners = points[faces]
    centre = corners.mean(1)
    return centre, (corners - centre[:, None]).norm(dim=2).amax(1)[:, None]


def all_pairs(x: Tensor, search_radius: Tensor, points: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return row, frame and face of all pairs whose triangle's bounding sphere is within reach, (M,) each.

    The condition |x - c| <= r + u, squared and expanded, is one matrix product: [-2 x, -2 u, |x|^2 - u^2, 1] times
    [c, r, 1, |c|^2 - r^2].
    """
    centre, radius = bounding_spheres(points, faces)
    asked, search_radius = (search_radius >= 0)[:, None], search_radius[:, None]
    squares, about = (x * x).sum(1, keepdim=True), (centre * centre).sum(1, keepdim=True)
    left = [
        -2 * x,
        -2 * search_radius,
        (squares - search_radius**2).where(asked, torch.inf),
        torch.ones_like(search_radius),
    ]
    right = [centre, radius, torch.ones_like(radius), about - radius**2]
    scores = torch.cat(left, dim=1).permute(2, 0, 1) @ torch.cat(right, dim=1).permute(2, 1, 0)
    rounding = 16 * torch.finfo(x.dtype).eps * about.amax()
    near = scores <= rounding
    if x.is_cuda:
        frame, row, face = near.nonzero(as_tuple=True)
        return row, frame, face
    # Of few ones among many, numpy finds the places in a tenth of the time.
    at = torch.from_numpy(np.flatnonzero(near.numpy()))
    pair = at // len(faces)
    return pair % len(x), pair // len(x), at % len(faces)


def blocked_pairs(x: Tensor, search_radius: Tensor, points: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the result of `all_pairs`, but for rounding: triangles meet compact blocks of queries first.

    The sphere of a block holds those that its queries search.
    """
    centre, radius = bounding_spheres(points, faces)
    size = max(1, min(QUERY_BLOCK, len(x)))
    blocks = torch.from_numpy(compact_blocks(np.nan_to_num(x[..., 0].detach().numpy()), size)).long()
    padded = (torch.arange(blocks.numel()) >= len(x)).reshape(blocks.shape)[..., None]
    asked = (search_radius >= 0)[blocks] & ~padded & x[blocks].isfinite().all(2)
    queries = x[blocks].where(asked[:, :, None], 0)  # NaN in one must not hide the others
    middle = queries.sum(1) / asked.sum(1)[:, None].clamp_min(1)
    reach = (queries - middle[:, None]).norm(dim=2) + search_radius[blocks]
    reach = reach.where(asked, -torch.inf).amax(1)[:, None] + radius[:, 0]
    apart = (middle[:, None, 0] - centre[:, 0]).square()
    for axis in (1, 2):
        apart += (middle[:, None, axis] - centre[:, axis]).square()
    near = (apart <= (reach * (1 + ROUNDING)).square()) & (reach >= 0)
    block, face, frame = near.nonzero(as_tuple=True)
    row, at = blocks[block], frame[:, None]
    limit = (radius[face, 0, frame][:, None] + search_radius[row, at]) * (1 + ROUNDING)
    apart = torch.zeros_like(limit)
    for axis in range(3):
        apart += (x[row, axis, at] - centre[face, axis, frame][:, None]).square()
    pair, place = ((apart <= limit.square()) & asked[block, :, frame]).nonzero(as_tuple=True)
    return row[pair, place], frame[pair], face[pair]
