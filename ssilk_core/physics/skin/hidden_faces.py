# SPDX-License-Identifier: Apache-2.0
"""Faces of a body that may be hidden, because a garment covers them in every frame (numpy only).

A point of the skin is covered in a frame when nothing outside sees it, or when whoever does would see cloth if the
skin were not there:

- Along its normal there is cloth within `COVER_REACH` above it; or other skin, as in an armpit; or cloth within
  `SHOW_DEPTH` beneath it and no skin before. In the last case skin shows through the cloth, which is what hiding is
  for.
- So it is in a fan of directions tilted from the normal: cloth not higher than `COVER_REACH` above the point, or the
  body, blocks a ray. Of the flat ones `FLAT_FREE` may be free. Where cloth touches the skin, or skin shows through,
  the line of a ray may also meet cloth within `SHOW_DEPTH` beneath the skin, or leave a round limb before. Flat rays
  do not count where cloth is less than `SHALLOW` beneath: `APART` keeps openings further away than they look.
- At least one of these rays meets cloth: a mouth is no covered skin.

A triangle is covered when points all over it are, in all frames. What is hidden keeps a distance of `APART`, and of
one triangle, from skin without cloth along its normal: from hems, collars and holes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, Ints, Mesh
from ...scene.mesh.topology import subdivision_middles, vertex_normals
from .blocked_rays import NO_TRIANGLE, BlockedRays
from .figures import COVER_REACH, SHOW_DEPTH

FAN = ((40.0, 4), (70.0, 12))  # tilts from the normal [degrees], and how many directions at each
SPACING = 0.02  # [m]; points on a triangle are at most so far apart
APART = 0.03  # [m]
SHALLOW = 0.01  # [m]
STEEP = float(np.cos(np.radians(55)))  # cosine of the tilt that parts them
FLAT_FREE = 1  # flat rays of a point that may be free: an opening nearby lets several pass
LIFT = 0.002  # [m] of the start of rays above the skin, so that they do not start in the body where that is concave
TOUCHING = 0.005  # [m]; where cloth is not higher, lines of rays may also meet cloth beneath the skin
LEAVING = 0.001  # [m]; a ray into the body does not meet the skin that it starts from
DISTANCES_AT_ONCE = 1 << 22


class HiddenFaces:
    """Triangles of a body that a garment has covered in every frame so far.

    Args:
        body: in its bind pose.
        cloth: the garment in its bind pose, which counts as a frame.

    Attributes:
        covered: triangles that were covered in every frame, shape (F,).
        bare: triangles that were covered until a frame in which points on them had no cloth along the normal,
            shape (F,).
    """

    def __init__(self, body: Mesh, cloth: Mesh) -> None:
        self._body, self._faces = body, body.faces
        self._cloth_rays = BlockedRays(cloth.points, cloth.faces)
        self._body_rays = BlockedRays(body.points, body.faces)
        self.covered = np.ones(len(self._faces), dtype=bool)
        self.bare = np.zeros(len(self._faces), dtype=bool)
        self._fan = _fan().astype(np.float32)
        for inside in (False, True):  # vertices alone tell of most triangles that nothing covers
            self._spread_points(inside)
            self.add(body.points, cloth.points)

    def _spread_points(self, inside: bool) -> None:
        """Spread points over the triangles that are still covered: their vertices, and with `inside` more on each."""
        chosen = np.flatnonzero(self.covered)
        self._corners, self._weights, self._owners = _points_on(self._body, chosen, inside)
        self._above, self._facing = (np.full(len(self._corners), NO_TRIANGLE) for _ in range(2))
        self._around = np.full((len(self._corners), len(self._fan)), NO_TRIANGLE)
        self._by_body = np.zeros(self._around.shape, dtype=bool)

    def add(self, body: Floats, cloth: Floats) -> None:
        """Take a frame into account: vertices of the body (B, 3) and of the garment (V, 3) [m] in one space."""
        if not self.covered.any():
            return
        middle = cloth.mean(axis=0)
        body, cloth = ((points - middle).astype(np.float32) for points in (body, cloth))
        normals = vertex_normals(body, self._faces).astype(np.float32)
        heights = self._heights(body, cloth, normals)
        before = self.covered.copy()
        self._keep(~np.isinf(heights))
        self.bare |= before & ~self.covered
        if self.covered.any():
            self._keep(self._is_closed(body, cloth, normals, heights[self._kept]))

    def mask(self) -> NDArray[np.bool_]:
        """Return which triangles may be hidden, shape (F,): those covered, apart from bare ones."""
        points, hidden = self._body.points, self.covered
        seen, inner = np.unique(self._faces[self.bare]), np.unique(self._faces[hidden])
        near = np.zeros(len(points), dtype=bool)
        near[seen] = True
        many = max(1, DISTANCES_AT_ONCE // max(1, len(seen)))
        for part in (inner[first : first + many] for first in range(0, len(inner), many)):
            square = (points[part] ** 2).sum(axis=1)[:, None] + (points[seen] ** 2).sum(axis=1)
            near[part] |= (square - 2 * points[part] @ points[seen].T).min(axis=1, initial=np.inf) < APART**2
        return hidden & ~near[self._faces].any(axis=1)

    def _keep(self, good: NDArray[np.bool_]) -> None:
        """Give up the triangles of points that are not good, and points that are on no other triangle."""
        lost = np.zeros(len(self._faces), dtype=bool)
        interior = self._owners >= 0
        lost[self._owners[~good & interior]] = True
        open_vertices = np.zeros(self._body.vertex_count, dtype=bool)
        open_vertices[self._corners[~good & ~interior, 0]] = True
        self.covered &= ~lost & ~open_vertices[self._faces].any(axis=1)
        needed = np.zeros(self._body.vertex_count, dtype=bool)
        needed[self._faces[self.covered]] = True
        kept = np.where(interior, self.covered[self._owners], needed[self._corners[:, 0]])
        self._kept = kept
        for name in ("_corners", "_weights", "_owners", "_above", "_facing", "_around", "_by_body"):
            setattr(self, name, getattr(self, name)[kept])

    def _at(self, values: Floats) -> Floats:
        """Return values of vertices (B, 3) at the points (P, 3)."""
        return np.einsum("pk,pkx->px", self._weights, values[self._corners])

    def _heights(self, body: Floats, cloth: Floats, normals: Floats) -> Floats:
        """Return the height of cloth over each point [m] (P,), negative beneath it.

        It is infinite where neither is within reach, and NaN where other skin faces the point instead.
        """
        starts, up = self._at(body), _unit(self._at(normals))
        low, high = _all(-SHOW_DEPTH, starts), _all(COVER_REACH, starts)
        self._above, heights = self._cloth_rays.find(cloth, starts, up, low, high, self._above)
        self._settle_beneath(heights, body, cloth, starts, up)
        open_ = np.flatnonzero(np.isinf(heights))
        part = starts[open_] + LIFT * up[open_], up[open_], _all(0, open_), high[open_]
        self._facing[open_], skin = self._body_rays.find(body, *part, self._facing[open_])
        heights[open_[np.isfinite(skin)]] = np.nan
        return heights

    def _settle_beneath(self, heights: Floats, body: Floats, cloth: Floats, starts: Floats, up: Floats) -> None:
        """Where cloth was found beneath points, prefer cloth above them; discard cloth behind another skin."""
        beneath = np.flatnonzero(heights < 0)
        starts, up, depths, guesses = starts[beneath], up[beneath], -heights[beneath], self._above[beneath]
        nothing, unknown = _all(0, beneath), np.full(len(beneath), NO_TRIANGLE)
        again, above = self._cloth_rays.find(cloth, starts, up, nothing, nothing + COVER_REACH, guesses)
        skin, _ = self._body_rays.find(body, starts, -up, nothing + LEAVING, depths, unknown)
        self._above[beneath] = np.where(np.isfinite(above), again, guesses)
        heights[beneath] = np.where(np.isfinite(above), above, np.where(skin == NO_TRIANGLE, -depths, np.inf))

    def _is_closed(self, body: Floats, cloth: Floats, normals: Floats, heights: Floats) -> NDArray[np.bool_]:
        """Return for which points (P,) all rays of the fan are blocked."""
        points, up = self._at(body), _unit(self._at(normals))
        along = body[self._corners[:, 1]] - body[self._corners[:, 0]]
        east = _unit(along - (along * up).sum(axis=1)[:, None] * up)
        rays = np.einsum("dx,pxy->pdy", self._fan, np.stack([east, np.cross(up, east), up], axis=1))
        upright = np.isfinite(rays).all(axis=(1, 2))
        touched = heights < TOUCHING
        lifted, high = points + LIFT * up, _all(COVER_REACH, points)[:, None] / self._fan[:, 2]
        low = -SHOW_DEPTH * touched[:, None] / self._fan[:, 2]
        around = np.where(self._around == NO_TRIANGLE, self._above[:, None], self._around)
        found, by_body = np.full(around.shape, NO_TRIANGLE), self._by_body & (self._around != NO_TRIANGLE)
        shows = np.broadcast_to(touched[:, None], by_body.shape)
        leaves: Floats = -LEAVING / self._fan[:, 2] + 0 * low
        passes: tuple[tuple[BlockedRays, Floats, Floats, NDArray, bool, NDArray, NDArray], ...] = (
            (self._body_rays, body, lifted, by_body, True, 0 * low, high),  # first what blocked a ray before
            (self._cloth_rays, cloth, points, np.ones_like(by_body), False, low, high),
            (self._body_rays, body, lifted, ~by_body, True, 0 * low, high),
            (self._body_rays, body, points, shows, True, leaves - SHOW_DEPTH / self._fan[:, 2], leaves),
        )
        flat = self._fan[:, 2] < STEEP
        shallow = (heights < 0) & (heights > -SHALLOW)
        asked = upright[:, None] & ~(shallow[:, None] & flat)
        for mesh, vertices, starts, tried, is_body, start, end in passes:
            point, ray = np.nonzero((found == NO_TRIANGLE) & tried & asked)
            guesses = np.where(by_body[point, ray] == is_body, around[point, ray], NO_TRIANGLE)
            lines = starts[point], rays[point, ray], start[point, ray], end[point, ray]
            found[point, ray], _ = mesh.find(vertices, *lines, guesses)
            self._by_body[point, ray] = is_body
        self._around = found
        meets_cloth = np.isfinite(heights) | ((found != NO_TRIANGLE) & ~self._by_body).any(axis=1)
        free = (found == NO_TRIANGLE) & asked
        return upright & meets_cloth & ~free[:, ~flat].any(axis=1) & (free[:, flat].sum(axis=1) <= FLAT_FREE)


def _points_on(mesh: Mesh, chosen: Ints, inside: bool) -> tuple[Ints, Floats, Ints]:
    """Spread points over some triangles of a mesh: their vertices and, with `inside`, middles of equal parts of each.

    Returns:
        The corners that they lie between (P, 3), their barycentric coordinates (P, 3), and for the points inside a
        triangle its index, -1 for vertices, (P,). The first corner of a vertex is that vertex.
    """
    faces = mesh.faces[chosen]
    corners = mesh.points[faces]
    used, first = np.unique(faces.reshape(-1), return_index=True)
    turned = np.stack([np.roll(faces, -k, axis=1) for k in range(3)], axis=1).reshape(-1, 3)[first]
    found = [(turned, np.tile([1.0, 0.0, 0.0], (len(used), 1)), np.full(len(used), -1))]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.maximum(1, np.ceil(longest / SPACING)).astype(int) if inside else np.zeros(0, dtype=int)
    for count in np.unique(parts):
        weights, which = subdivision_middles(count), np.flatnonzero(parts == count)
        each = np.repeat(which, len(weights))
        found.append((faces[each], np.tile(weights, (len(which), 1)), chosen[each]))
    indices, weights, owners = (np.concatenate(part) for part in zip(*found))
    return indices, weights.astype(np.float32), owners


def _fan() -> Floats:
    """Return the directions of the fan over a normal along the third axis."""
    rays = []
    for tilt, count in FAN:
        around, slope = np.arange(count) * 2 * np.pi / count, np.radians(tilt)
        rays.append(np.stack([np.sin(slope) * np.cos(around), np.sin(slope) * np.sin(around),
                              np.full(count, np.cos(slope))], axis=1))  # fmt: skip
    return np.concatenate(rays)


def _unit(vectors: Floats) -> Floats:
    """Return vectors of unit length; those without length are not finite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _all(value: float, like: NDArray) -> Floats:
    return np.full(len(like), value, dtype=np.float32)


def hidden_polygons(triangles: NDArray[np.bool_], meshes: Sequence[Mesh]) -> list[NDArray[np.bool_]]:
    """Return for each of several meshes which of its polygons have all their triangles among those that are hidden.

    Args:
        triangles: of all meshes in their order, as `HiddenFaces.mask` returns them for the meshes as one.
    """
    found, start = [], 0
    for mesh in meshes:
        own = triangles[start : start + len(mesh.faces)]
        start += len(mesh.faces)
        sizes = np.asarray(mesh.polygon_counts, dtype=np.int64) - 2  # triangles follow the order of their polygons
        found.append(np.logical_and.reduceat(own, np.cumsum(sizes) - sizes))
    return found
