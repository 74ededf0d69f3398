# SPDX-License-Identifier: Apache-2.0
"""The nearest point of a body's whole surface, exactly.

The nearest point may lie on a triangle that does not touch the nearest vertex. Training overlooks that, as `nearest`
and `surface_point` do: where it happens the distance they find is larger, by millimetres on a coarse body, and jumps.
A solver that moves vertices over such seams does not settle; here every triangle counts that can hold the nearest
point, and the Euclidean distance is continuous, and smooth wherever the nearest point is unique.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..assets import Floats, Ints
from .nearest_vertex import compact_blocks
from .one_ring import closest_in_triangle

SCORES = 1 << 25  # pairs of a vertex and a triangle looked at together, on a processor
ON_GPU = 8  # times as many: 2 GB of scores, in few launches
PATCH = 8  # triangles that the kernel takes together


def patches_of(points: Floats, faces: Ints) -> Ints:
    """Return the corners of triangles in compact patches, int32 (ceil(F / PATCH), 4 PATCH).

    A patch has the first corners of its triangles, then the second, then the third; the last quarter fills it up.
    """
    triangles = faces[compact_blocks(points[faces].mean(axis=1), PATCH)]
    corners = np.concatenate([triangles, triangles[..., :1]], axis=-1)
    return corners.transpose(0, 2, 1).reshape(len(triangles), -1).astype(np.int32)


def closest_on_faces(
    x: Tensor, reach: Tensor, points: Tensor, faces: Tensor, listed: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the nearest points of triangles to all queries that have one within reach, Q of them.

    Args:
        x: queries, shape (V, 3, N).
        reach: distance that each nearest point is known to be within [m], shape (V, N); negative: not asked.
        points: corners of the triangles, shape (B, 3, N).
        faces: triangles, shape (F, 3).
        listed: the triangles that each row of queries may find, filled up by -1, shape (V, L); any by default.

    Returns:
        Row and frame of each query (Q,), body vertices at the corners of its triangle and barycentric coordinates,
        both (3, Q).
    """
    frames = frames_at_once(x, faces, listed)
    parts = [
        _closest(x, reach, points, faces, listed, at, min(at + frames, x.shape[2]))
        for at in range(0, x.shape[2], frames)
    ]
    row, frame, corners, weights = (torch.cat(part, dim=-1) for part in zip(*parts))
    return row, frame, corners, weights


def frames_at_once(x: Tensor, faces: Tensor, listed: Tensor | None) -> int:
    """Return how many frames of such queries are looked at together."""
    scores = SCORES * (ON_GPU if x.is_cuda else 1)
    return max(1, scores // (len(x) * (len(faces) if listed is None else listed.shape[1])))


def _closest(
    x: Tensor, reach: Tensor, points: Tensor, faces: Tensor, listed: Tensor | None, start: int, stop: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return what `closest_on_faces` does, in frames `start` to `stop`."""
    part = x[..., start:stop], reach[:, start:stop], points[..., start:stop]
    row, frame, face = pairs_within_reach(*part, faces, listed)
    frame = frame + start
    corners = faces[face].T
    origin, second, third = (points[corner, :, frame].T for corner in corners)
    p = x[row, :, frame].T - origin
    s, t, value = closest_in_triangle(p, second - origin, third - origin)
    squares = (p * p).sum(0) + value
    query = row * x.shape[2] + frame
    _, first = least_of_each(query, squares, x[:, 0].numel())
    winner = first[first < len(query)]
    return row[winner], frame[winner], corners[:, winner], torch.stack([1 - s - t, s, t])[:, winner]


def least_of_each(query: Tensor, values: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the least value of each query and where it stands, both (count,); infinity and Q where there is none.

    Of several that are equal it is the first: results are the same in every run.

    Args:
        query: which query each value is of, shape (Q,); values: shape (Q,).
    """
    least = values.new_full((count,), torch.inf).scatter_reduce(0, query, values, "amin")
    place = torch.arange(len(query), device=query.device)
    chosen = place.where(values <= least[query], len(place))
    return least, place.new_full((count,), len(place)).scatter_reduce(0, query, chosen, "amin")


def pairs_within_reach(
    x: Tensor, reach: Tensor, points: Tensor, faces: Tensor, listed: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return row, frame and face of all pairs of a query and a triangle whose sphere is within reach, (M,) each.

    Arguments are those of `closest_on_faces`. All frames are looked at together.
    """
    if listed is None:
        return _within_reach(x, reach, points, faces)
    return _listed_within_reach(x, reach, points, faces, listed)


def _listed_within_reach(
    x: Tensor, reach: Tensor, points: Tensor, faces: Tensor, listed: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what `_within_reach` does, of the faces listed for each query, shape (V, L)."""
    centre, radius = bounding_spheres(points, faces)
    apart = sum((x[:, None, axis] - centre[:, axis][listed]).square() for axis in range(3))  # (V, L, N)
    within = apart <= ((radius[:, 0][listed] + reach[:, None]) * (1 + 1e-6)).square()
    asked = (reach >= 0)[:, None] & (listed >= 0)[..., None]
    row, place, frame = (within & asked).nonzero(as_tuple=True)
    return row, frame, listed[row, place]


def bounding_spheres(points: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Return centres (F, 3, N) and radii (F, 1, N) of spheres around triangles."""
    corners = points[faces]
    centre = corners.mean(1)
    return centre, (corners - centre[:, None]).norm(dim=2).amax(1)[:, None]


def _within_reach(x: Tensor, reach: Tensor, points: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return row, frame and face of all pairs whose triangle's bounding sphere comes within reach, (M,) each.

    |x - c| <= r + u, squared and spread out, is one product of matrices: [-2 x, -2 u, |x|^2 - u^2, 1] with
    [c, r, 1, |c|^2 - r^2].
    """
    centre, radius = bounding_spheres(points, faces)
    asked, reach = (reach >= 0)[:, None], reach[:, None]
    squares, about = (x * x).sum(1, keepdim=True), (centre * centre).sum(1, keepdim=True)
    left = [-2 * x, -2 * reach, (squares - reach**2).where(asked, torch.inf), torch.ones_like(reach)]
    right = [centre, radius, torch.ones_like(radius), about - radius**2]
    scores = torch.cat(left, dim=1).permute(2, 0, 1) @ torch.cat(right, dim=1).permute(2, 1, 0)
    rounding = 16 * torch.finfo(x.dtype).eps * about.amax()
    frame, row, face = (scores <= rounding).nonzero(as_tuple=True)
    return row, frame, face
