# SPDX-License-Identifier: Apache-2.0
"""The signed distance to a mesh that cloth meets besides the body.

The nearest point is found with libigl's tree of boxes, or with what is handed in where that is not installed, as in
Blender's Python. The side is that of the angle-weighted pseudonormal there
(Baerentzen and Aanaes, IEEE TVCG 11, 2005), which is exact for closed meshes. Corners that lie on one another are
one: exporters split them along seams of normals and textures, and a box of six quads is still closed.

A part of a mesh that has a border, such as a floor, has two sides. The outside is that on which most of the garment
is, as the body carries it. A query whose nearest point is on the border is outside: beyond its border a floor has no
below. A closed part is solid, but for one that the whole garment is inside of, such as a room.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...errors import fail
from ...scene.assets import Floats, Ints
from ...scene.mesh import topology

ON_EDGE = 1e-7  # barycentric coordinate up to which a point is on the edge opposite
FEW = 8  # times as many triangles as queries, from which on normals are found where they are needed
TOUCHING = 1e-9  # [m] from the surface, up to which its normal is the direction away from it
Nearest = Callable[[Floats], tuple[Floats, Ints, Floats]]
Search = Callable[[Floats, Ints], Nearest]
Garment = Callable[[int], Floats]


def boxes(points: Floats, faces: Ints) -> Nearest:
    """Return what finds the nearest points of triangles (T, 3) with vertices (P, 3), by libigl.

    It takes queries (M, 3) and returns squared distances [m2] (M,), triangles (M,) and the points on them (M, 3).
    """
    import igl

    tree = igl.AABB()
    tree.init(points, faces)

    def nearest(queries: Floats) -> tuple[Floats, Ints, Floats]:
        squares, face, found = tree.squared_distance(points, faces, np.ascontiguousarray(queries))
        return np.asarray(squares).reshape(-1), np.asarray(face).reshape(-1), np.asarray(found).reshape(-1, 3)

    return nearest


@dataclass(frozen=True, eq=False)
class SurfaceDistance:
    """Distances of M queries to a surface.

    Attributes:
        distance: negative inside [m], shape (M,).
        normal: its gradient, unit vectors, shape (M, 3).
        part: of the surface, shape (M,).
        on_border: whether the nearest point is on the border of its part, shape (M,).
        behind: whether it is, and the query lies on the inner side of the surface there, shape (M,).
        corners, weights: of the nearest point, vertices of the mesh and barycentric coordinates, shape (M, 3).
    """

    distance: Floats
    normal: Floats
    part: Ints
    on_border: NDArray[np.bool_]
    behind: NDArray[np.bool_]
    corners: Ints
    weights: Floats

    def only(self, kept: NDArray[np.bool_], turn: Floats) -> SurfaceDistance:
        """Return those that are kept (M,), with their gradients turned (3, 3)."""
        normal, part, on_border = self.normal[kept] @ turn.T, self.part[kept], self.on_border[kept]
        where = self.corners[kept], self.weights[kept]
        return SurfaceDistance(self.distance[kept], normal, part, on_border, self.behind[kept], *where)


class CollisionSurface:
    """The triangles of a mesh, all wound the same way; a closed part is wound counter-clockwise from outside.

    Attributes:
        faces: the mesh's vertices at the corners, shape (T, 3).
        part: of each triangle, shape (T,).
        closed: whether each part has no border, shape (C,).
        welded: places of the corners, (T, 3): one number for all that lie on one another.
        edge: numbers of the edges between corners 0 and 1, 1 and 2, 2 and 0, shape (T, 3).

    Args:
        path: of the mesh, for messages.
        points: of the mesh in its first frame, shape (P, 3).

    Raises:
        SsilkError: no triangle has an area.
    """

    def __init__(self, path: str, points: Floats, faces: Ints) -> None:
        place = topology.merged_places(points)
        welded = place[faces]
        kept = (welded != np.roll(welded, 1, axis=1)).all(axis=1)
        if not (kept.any() and topology.face_areas(points, faces)[kept].max() > 0):
            fail(path, "no triangle of it has an area", "cloth meets surfaces", "leave it out of the colliders")
        swapped, self.part = _wound_alike(welded[kept])
        own = np.where(swapped[:, None], faces[kept][:, ::-1], faces[kept])
        sides = topology.half_edges(place[own])
        _, edge, used = np.unique(topology.edge_keys(sides), return_inverse=True, return_counts=True)
        self.edge = edge.reshape(-1, 3)
        border = used == 1
        self.closed = np.ones(self.part.max() + 1, dtype=bool)
        self.closed[self.part[border[self.edge].any(axis=1)]] = False
        inward = np.bincount(self.part, _volumes(points[own])) < 0
        inward &= self.closed
        # The winding of an open part is the mesh's own, where it is consistent: of most of its area.
        area = topology.face_areas(points, own)
        inward |= ~self.closed & (np.bincount(self.part, np.where(swapped, area, -area)) > 0)
        flipped = inward[self.part]
        own[flipped] = own[flipped][:, ::-1]
        self.edge[flipped] = self.edge[flipped][:, [1, 0, 2]]
        self.faces, self.welded = own, place[own]
        self._border_edge = border
        self._border_vertex = np.zeros(len(points), dtype=bool)
        self._border_vertex[sides[border[edge.reshape(-1)]]] = True
        self._edge_count = len(used)
        self._by_part = np.argsort(self.part, kind="stable")
        self._firsts = np.searchsorted(self.part[self._by_part], np.arange(len(self.closed)))

    def features(self, face: Ints, weights: Floats) -> tuple[Ints, Ints, Ints, Ints]:
        """Return which of points (M,) are on an edge, on which, which are at a vertex, and at which."""
        none = weights <= ON_EDGE
        count = none @ np.ones(3, dtype=np.int8)
        on_edge, at_vertex = np.flatnonzero(count == 1), np.flatnonzero(count == 2)
        edge = self.edge[face[on_edge], (none[on_edge].argmax(axis=1) + 1) % 3]
        vertex = self.welded[face[at_vertex], weights[at_vertex].argmax(axis=1)]
        return on_edge, edge, at_vertex, vertex

    def signed(
        self, away: Floats, length: Floats, face: Ints, weights: Floats, normal: Floats, turned: Floats
    ) -> SurfaceDistance:
        """Return the distances of M queries.

        Args:
            away: from the nearest points [m], (M, 3); length: of these, (M,); normal: pseudonormals there, (M, 3).
            face, weights: of the nearest points, shapes (M,) and (M, 3).
            turned: whether the outside there is as the part is wound, 1, or the other one, -1, (M,) or (1,).
        """
        side = np.where(_dot(away, normal) * turned < 0, -1.0, 1.0)
        on_edge, edge, at_vertex, vertex = self.features(face, weights)
        on_border = np.zeros(len(face), dtype=bool)
        on_border[on_edge], on_border[at_vertex] = self._border_edge[edge], self._border_vertex[vertex]
        behind = on_border & (side < 0)
        side[on_border] = 1.0
        direction = away * (side / np.maximum(length, TOUCHING))[:, None]
        if len(touching := np.flatnonzero(length <= TOUCHING)):
            own = normal[touching]
            outward = np.broadcast_to(turned, length.shape)[touching]
            direction[touching] = own * (outward / np.maximum(np.sqrt(_dot(own, own)), np.finfo(float).tiny))[:, None]
        where = self.part.take(face), on_border, behind, self.faces.take(face, axis=0), weights
        return SurfaceDistance(side * length, direction, *where)

    def voted(self, found: SurfaceDistance) -> Floats:
        """Return on which side each part's outside is, 1 or -1 (C,), by the distances of a garment's vertices."""
        count = len(self.closed)
        votes = np.bincount(found.part, np.where(found.on_border, 0.0, np.sign(found.distance)), count)
        near, voters = np.bincount(found.part, minlength=count), len(found.part)
        around = self.closed & (near == voters) & (votes == -voters)
        return np.where(around | (~self.closed & (votes < 0)), -1.0, 1.0)

    def at(self, points: Floats, search: Search = boxes) -> PosedSurface:
        """Return the surface with its mesh's points (P, 3) [m]."""
        return PosedSurface(self, points, search)


class PosedSurface:
    """A surface at given points; built in time in proportion to its triangles, and queried often."""

    def __init__(self, surface: CollisionSurface, points: Floats, search: Search) -> None:
        self.surface, self.points = surface, np.ascontiguousarray(points)
        self._nearest = search(self.points, np.ascontiguousarray(surface.faces))
        self._is_new = True  # until it was asked for the first time

    @cached_property
    def _normals(self) -> tuple[Floats, Floats, Floats]:
        """Pseudonormals of faces (T, 3), edges (E, 3) and vertices (P, 3)."""
        return self._normals_of(np.arange(len(self.surface.faces)))

    def _normals_of(self, rows: Ints) -> tuple[Floats, Floats, Floats]:
        """Return the same, but as if some faces (R,) were all that there are; those of others are zero."""
        surface, corners = self.surface, self.points[self.surface.faces[rows]]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.sqrt(_dot(cross, cross))[:, None]
        face, unit = np.zeros(surface.faces.shape), cross / np.maximum(length, np.finfo(float).tiny)
        face[rows] = unit
        edge = _added(surface.edge[rows], unit[:, None], surface._edge_count)
        ahead, behind = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
        # Twice the area is the sine at each corner, times the lengths of its sides as the cosine is.
        angle = np.arctan2(length, (ahead * behind).sum(axis=2))
        return face, edge, _added(surface.welded[rows], angle[..., None] * unit[:, None], len(self.points))

    @cached_property
    def _is_inside_out(self) -> bool:
        """Whether some closed part encloses no volume, or a negative one."""
        volumes = np.bincount(self.surface.part, _volumes(self.points[self.surface.faces]))
        return bool((volumes[self.surface.closed] <= 0).any())

    @cached_property
    def _bounds(self) -> tuple[Floats, Floats]:
        """The corners of the box around each part, shapes (C, 3)."""
        corners = self.points[self.surface.faces[self.surface._by_part].reshape(-1)]
        firsts = 3 * self.surface._firsts
        return np.minimum.reduceat(corners, firsts), np.maximum.reduceat(corners, firsts)

    @cached_property
    def _up(self) -> tuple[Floats, Floats]:
        """The mean normal n of each part, times its area, (C, 3), and the largest n . x of its points (C,).

        That is infinite for a part that does not face along n everywhere.
        """
        surface = self.surface
        corners = self.points[surface.faces[surface._by_part]]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal, part = np.add.reduceat(cross, surface._firsts), surface.part[surface._by_part]
        facing = np.minimum.reduceat((cross * normal[part]).sum(axis=1), surface._firsts) > 0
        height = np.einsum("tkc,tc->tk", corners, normal[part]).max(axis=1)
        return normal, np.where(facing, np.maximum.reduceat(height, surface._firsts), np.inf)

    def distance(self, queries: Floats, sides: Floats | None = None, garment: Ints | None = None) -> SurfaceDistance:
        """Return the distances of queries (M, 3).

        Args:
            sides: by which each part's outside is turned, 1 or -1, shape (C,).
            garment: the row of each query (M,) in `sides` of several garments (N, C).
        """
        squares, face, nearest = self._nearest(queries)
        weights = self._weights(face, nearest)
        turned = np.ones(1)
        if sides is not None:
            part = self.surface.part[face]
            turned = sides[part] if garment is None else sides[garment, part]
        return self.surface.signed(
            queries - nearest, np.sqrt(squares.clip(0)), face, weights, self._at(face, weights), turned
        )

    def outside(self, carried: Floats) -> Floats:
        """Return on which side each part's outside is, 1 or -1 (C,), for a garment (V, 3) as the body carries it."""
        if self.needs_no_vote(carried.min(axis=0), carried.max(axis=0)):
            return np.ones(len(self.surface.closed))
        return self.surface.voted(self.distance(carried))

    def met(self, queries: Floats, garment: Garment, low: Floats, high: Floats) -> SurfaceDistance:
        """Return the distances of queries (N, M, 3) of N garments, one garment after the other.

        Args:
            garment: returns the vertices (V, 3) of one of them, as the body carries it, by its number.
            low, high: corners of boxes that hold these, shapes (N, 3).
        """
        sides = np.ones((len(queries), len(self.surface.closed)))
        for number in np.flatnonzero(~self.needs_no_vote(low, high)):
            sides[number] = self.surface.voted(self.distance(garment(number)))
        return self.distance(queries.reshape(-1, 3), sides, np.arange(len(queries)).repeat(queries.shape[1]))

    def needs_no_vote(self, low: Floats, high: Floats) -> NDArray[np.bool_]:
        """Return whether garments in boxes of corners (..., 3) are surely outside of each part as it is wound, (...).

        None is inside a closed part that reaches beyond the part's box. None is below an open part that is above the
        highest of its points, if the whole part faces up, along its mean normal. A closed part that this pose turns
        inside out, as a scale that becomes negative does, needs votes.
        """
        surface = self.surface
        if self._is_inside_out:
            return np.zeros(low.shape[:-1], dtype=bool)
        if surface.closed.all() and not self._may_hold(low, high, *self._whole).any():
            return np.ones(low.shape[:-1], dtype=bool)
        clear = ~self._may_hold(low[..., None, :], high[..., None, :], *self._bounds)
        if not surface.closed.all():
            normal, top = self._up
            lowest = (low + high) / 2 @ normal.T - (high - low) / 2 @ np.abs(normal).T
            clear = np.where(surface.closed, clear, lowest > top)
        return np.asarray(clear.all(axis=-1))

    @cached_property
    def _whole(self) -> tuple[Floats, Floats]:
        """The corners of the box around all of it, shapes (3,)."""
        return self.points.min(axis=0), self.points.max(axis=0)

    @staticmethod
    def _may_hold(low: Floats, high: Floats, least: Floats, most: Floats) -> NDArray[np.bool_]:
        return ((low >= least) & (high <= most)).all(axis=-1)

    def _few(self, count: int) -> bool:
        """Return whether so many queries need few of the triangles: of a mesh that moves, few are asked for."""
        return self._is_new and FEW * count < len(self.surface.faces)

    @cached_property
    def _gradients(self) -> Floats:
        return _gradients(self.points[self.surface.faces])

    def _weights(self, face: Ints, points: Floats) -> Floats:
        """Return the barycentric coordinates (M, 3), none negative, of points on faces, shapes (M, 3) and (M,)."""
        if self._few(len(face)):
            known = _gradients(self.points[self.surface.faces[face]])
        else:
            known = self._gradients.take(face, axis=0)
        found = np.empty((len(face), 3))
        for corner in (0, 1):
            away, along = points - known[:, corner, 0], known[:, corner, 1]
            np.einsum("mc,mc->m", away, along, out=found[:, corner])
        np.subtract(1 - found[:, 0], found[:, 1], out=found[:, 2])
        np.clip(found, 0.0, 1.0, out=found)
        found /= (found[:, 0] + found[:, 1] + found[:, 2])[:, None]
        return found

    def _at(self, face: Ints, weights: Floats) -> Floats:
        """Return the pseudonormals at points of faces, shape (M, 3)."""
        surface = self.surface
        on_edge, edge, at_vertex, vertex = surface.features(face, weights)
        if self._few(len(face)):
            edges, vertices = np.zeros(surface._edge_count, dtype=bool), np.zeros(len(self.points), dtype=bool)
            edges[edge], vertices[vertex] = True, True
            around = edges[surface.edge].any(axis=1) | vertices[surface.welded].any(axis=1)
            around[face] = True
            of_faces, of_edges, of_vertices = self._normals_of(np.flatnonzero(around))
        else:
            of_faces, of_edges, of_vertices = self._normals
        self._is_new = False
        normal = of_faces.take(face, axis=0)
        normal[on_edge], normal[at_vertex] = of_edges[edge], of_vertices[vertex]
        return normal


def _dot(one: Floats, other: Floats) -> Floats:
    """Return the products of vectors (M, 3), shape (M,)."""
    found: Floats = np.einsum("mc,mc->m", one, other)
    return found


def _added(place: Ints, values: Floats, count: int) -> Floats:
    """Return sums (count, 3) of values, broadcast to (T, 3, 3), that belong to places (T, 3)."""
    place, values = place.reshape(-1), np.broadcast_to(values, (*place.shape, 3)).reshape(-1, 3)
    return np.stack([np.bincount(place, part, count) for part in values.T], axis=1)


def _gradients(corners: Floats) -> Floats:
    """Return of triangles (T, 3, 3) where the first two barycentric coordinates are zero, and their gradients.

    Shape (T, 2, 2, 3): of each coordinate the corner after its own, and its gradient in the plane.
    """
    a, b, c = corners.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(_dot(normal, normal), np.finfo(float).tiny)[:, None]
    return np.stack([b, np.cross(normal, c - b), c, np.cross(normal, a - c)], axis=1).reshape(-1, 2, 2, 3)


def _volumes(corners: Floats) -> Floats:
    """Return six times the signed volumes (T,) that triangles (T, 3, 3) span with their first corner of all."""
    a, b, c = (corners - corners[0, 0]).transpose(1, 0, 2)
    return (a * np.cross(b, c)).sum(axis=1)


def _wound_alike(faces: Ints) -> tuple[NDArray[np.bool_], Ints]:
    """Return which triangles (T, 3) to turn, so that neighbours are wound alike, and the part of each, shapes (T,).

    Neighbours share an edge that no third one has. A part that has one side alone is left as it is wound.
    """
    half, count = topology.half_edges(faces), len(faces)
    _, group, uses = np.unique(topology.edge_keys(half), return_inverse=True, return_counts=True)
    order = np.argsort(group.reshape(-1), kind="stable")
    starts = np.concatenate([[0], np.cumsum(uses)[:-1]])[uses == 2]
    one, other = order[starts], order[starts + 1]
    against = (half[one] == half[other]).all(axis=1)  # two that run along their edge the same way
    one, other = one // 3, other // 3
    part = topology.components(np.stack([one, other], axis=1), count)
    # Each triangle twice, as it is and turned, numbers T and more: those that are wound alike belong together.
    as_is, turned = other + count * against, other + count * ~against
    pairs = np.concatenate([np.stack([one, as_is], axis=1), np.stack([one + count, turned], axis=1)])
    side = topology.components(pairs, 2 * count)[:count]
    first = np.unique(part, return_index=True)[1]
    return side != side[first[part]], part
