# SPDX-License-Identifier: Apache-2.0
"""Where islands of a garment lie on one another at rest: straps on a panel, pockets, buttons, panels that only touch.

A vertex lies on a face of another island if its foot there, the closest point, is near and beneath it: the offset
leans from the face's normal by no more than 60 degrees, or nearly vanishes. So strips side by side do not lie on one
another, whatever the gap between them, unless their borders coincide. Nor do parts whose outsides face each other,
such as two trouser legs, unless one of them lies wholly on the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..assets import PINNED, Floats, Ints, Mesh
from ..fabrics import Fabric
from .topology import SLIVER, components, edges, islands, vertex_normals

TOUCH = 0.005  # [m] between islands that lie on one another: thick cloth, and what modelling leaves
SAGITTA = 0.1  # of a face's longest edge: how far a curved part may lie from a coarse face under it
ABOVE = 0.01  # [m] of a foot beneath a vertex at most: a button is no thicker
LEAST_COSINE = 0.5  # of the offset and the face's normal
SAME_PLACE = 1e-4  # [m] within which the direction of an offset does not matter
FARTHEST_FOOT = 2.0  # barycentric coordinate on the face's plane; others multiply its corners' motion
FACES_AT_ONCE = 1 << 14


@dataclass(frozen=True, eq=False)
class Stitches:
    """Pairs of a vertex and a point of a face of another island, at rest.

    Attributes:
        vertices: shape (S,), in ascending order.
        corners: vertices of the face, shape (S, 3).
        weights: barycentric coordinates of the vertex on the plane of the face, rows sum to one, shape (S, 3). They
            are outside [0, 1] where the vertex lies past the face's border.
        height: of the vertex over the face, along the face's normal [m], shape (S,).
        distance: of the vertex from the closest point of the face [m], shape (S,).
        on_larger: whether the face is of the larger one of both islands, by area, shape (S,).
    """

    vertices: Ints
    corners: Ints
    weights: Floats
    height: Floats
    distance: Floats
    on_larger: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.vertices)

    def select(self, chosen: NDArray[np.bool_] | Ints) -> Stitches:
        """Return some of them."""
        return Stitches(*(values[chosen] for values in vars(self).values()))

    @property
    def nearest(self) -> Ints:
        """The corner of each face that is nearest to the foot, shape (S,)."""
        return self.corners[np.arange(len(self)), self.weights.argmax(axis=1)]

    @property
    def shares(self) -> Floats:
        """The weights within [0, 1], rows sum to one, shape (S, 3)."""
        inside = self.weights.clip(0, 1)
        return inside / inside.sum(axis=1, keepdims=True)


NONE = Stitches(
    *(np.zeros(shape, kind) for shape, kind in (
        (0, np.int64), ((0, 3), np.int64), ((0, 3), float), (0, float), (0, float), (0, bool),
    ))
)  # fmt: skip


def find_feet(mesh: Mesh) -> Stitches:
    """Return what lies within `ABOVE` over another island at rest.

    Each vertex has one foot at most on the larger islands and one on the smaller ones, the nearest.
    """
    island = islands(mesh.faces, mesh.vertex_count)
    of_face = island[mesh.faces[:, 0]]
    if (of_face == of_face[0]).all():
        return NONE
    corners = mesh.points[mesh.faces]
    sides = corners[:, 1:] - corners[:, :1]
    normals = np.cross(sides[:, 0], sides[:, 1])
    doubled = np.linalg.norm(normals, axis=1)
    longest = _longest_edges(corners)
    sound = np.flatnonzero(doubled > longest**2 / SLIVER)
    vertices, faces = _near(mesh, island, sound)
    rank = _ranks(mesh, island)
    offset = mesh.points[vertices] - corners[faces, 0]
    normal = normals[faces] / doubled[faces, None]
    height = np.einsum("mc,mc->m", offset, normal)
    weights = shares_on_plane(offset, sides[faces], normals[faces])
    foot = np.einsum("mk,mkc->mc", closest_shares(weights, offset, sides[faces]), corners[faces])
    distance = np.linalg.norm(mesh.points[vertices] - foot, axis=1)
    beneath = (np.abs(height) >= LEAST_COSINE * distance) | (distance < SAME_PLACE)
    kept = beneath & (distance <= ABOVE) & (np.abs(weights).max(axis=1, initial=0) <= FARTHEST_FOOT)
    on_larger = rank[of_face[faces]] < rank[island[vertices]]
    order = np.flatnonzero(kept)
    order = order[np.lexsort((faces[order], distance[order].round(9), on_larger[order], vertices[order]))]
    keys = 2 * vertices[order] + on_larger[order]
    order = order[np.unique(keys, return_index=True)[1]]
    values = vertices, mesh.faces[faces], weights, height, distance, on_larger
    return Stitches(*(each[order] for each in values))


def find_stitches(mesh: Mesh) -> Stitches:
    """Return what lies on another island at rest: the feet within `TOUCH`, or `SAGITTA` of a long edge."""
    feet = find_feet(mesh)
    return touching(mesh, feet, find_carried(mesh, feet))


def held_stitches(mesh: Mesh, fabric: Fabric, classes: Ints | None) -> Stitches:
    """Return the stitches of a garment, without those between pinned vertices alone, which hold anyway."""
    if not fabric.stitch:
        return NONE
    found = find_stitches(mesh)
    if classes is None:
        return found
    moves = np.column_stack([found.vertices, found.corners])
    return found.select((classes[moves] != PINNED).any(axis=1))


def touching(mesh: Mesh, feet: Stitches, carried: Stitches) -> Stitches:
    """Return the feet that are stitched: those near enough, where the sides that meet do not face each other.

    Args:
        carried: those of `find_carried`, whose sides may.
    """
    near = _near_enough(mesh, feet)
    whole = near.on_larger & np.isin(near.vertices, carried.vertices)
    return near.select(whole | ~_face_to_face(mesh, near))


def _near_enough(mesh: Mesh, feet: Stitches) -> Stitches:
    longest = _longest_edges(mesh.points[feet.corners])
    return feet.select(feet.distance <= np.maximum(TOUCH, SAGITTA * longest))


def _face_to_face(mesh: Mesh, feet: Stitches) -> NDArray[np.bool_]:
    """Return where the normals of the vertex and of the face are opposed, shape (S,)."""
    corners = mesh.points[feet.corners]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    own = vertex_normals(mesh.points, mesh.faces)[feet.vertices]
    return np.einsum("sc,sc->s", own, normals) < -LEAST_COSINE


def find_carried(mesh: Mesh, feet: Stitches) -> Stitches:
    """Return the feet of islands that lie wholly on larger ones, such as buttons and pockets, one for each vertex.

    All their vertices have feet, and one at least is stitched. Islands come in descending order of area, so that
    what carries others comes before them.
    """
    feet = feet.select(feet.on_larger)
    if not len(feet):
        return NONE
    island = islands(mesh.faces, mesh.vertex_count)
    rank = _ranks(mesh, island)
    parts = len(rank)
    sewn = np.bincount(island[_near_enough(mesh, feet).vertices], minlength=parts)
    whole = np.bincount(island[feet.vertices], minlength=parts) == np.bincount(
        island[np.unique(mesh.faces)], minlength=parts
    )
    feet = feet.select((whole & (sewn > 0))[island[feet.vertices]])
    return feet.select(np.argsort(rank[island[feet.vertices]], kind="stable"))


def joined_islands(mesh: Mesh, stitches: Stitches) -> NDArray[np.int64]:
    """Return the islands, numbered by first vertex, where stitches join what they hold, shape (V,)."""
    if not len(stitches):
        return islands(mesh.faces, mesh.vertex_count)
    held = np.column_stack([stitches.vertices, stitches.nearest])
    return components(np.concatenate([edges(mesh.faces), held]), mesh.vertex_count)


def joined_mesh(mesh: Mesh, stitches: Stitches) -> Mesh:
    """Return a mesh with a degenerate face along each stitch, so that its edges lead from island to island."""
    if not len(stitches):
        return mesh
    held = np.column_stack([stitches.vertices, stitches.nearest, stitches.nearest])
    return Mesh(mesh.path, mesh.points, np.concatenate([mesh.faces, held]))


def _longest_edges(triangles: Floats) -> Floats:
    return np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=-1).max(axis=1, initial=0)


def _ranks(mesh: Mesh, island: Ints) -> Ints:
    """Return the place of each island in descending order of area, shape (islands,)."""
    sides = np.diff(mesh.points[mesh.faces], axis=1)
    areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    order = np.argsort(-np.bincount(island[mesh.faces[:, 0]], areas, island.max() + 1), kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return rank


def _near(mesh: Mesh, island: Ints, sound: Ints) -> tuple[Ints, Ints]:
    """Return vertices (M,) and faces (M,) of other islands that may lie within `ABOVE` of one another."""
    used, of_face = np.unique(mesh.faces), island[mesh.faces[:, 0]]
    widest = np.bincount(of_face).argmax()  # most faces are its own, and of most vertices
    large = of_face[sound] == widest
    found = [
        _in_balls(mesh, used[island[used] != widest], sound[large]),
        _in_balls(mesh, used, sound[~large]),
    ]
    vertices, faces = (np.concatenate(each) for each in zip(*found))
    apart = island[vertices] != of_face[faces]
    return vertices[apart], faces[apart]


def _in_balls(mesh: Mesh, vertices: Ints, faces: Ints) -> tuple[Ints, Ints]:
    """Return those of some vertices (M,) that lie within `ABOVE` of the ball around a face, and that face (M,)."""
    from scipy.spatial import cKDTree

    tree, found = cKDTree(mesh.points[vertices]), [(np.zeros(0, dtype=np.int64),) * 2]
    for start in range(0, len(faces), FACES_AT_ONCE):
        part = faces[start : start + FACES_AT_ONCE]
        corners = mesh.points[mesh.faces[part]]
        centre = corners.mean(axis=1)
        radius = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
        near = tree.query_ball_point(centre, radius + ABOVE)
        inside = np.concatenate([np.asarray(each, dtype=np.int64) for each in near])
        found.append((vertices[inside], np.repeat(part, [len(each) for each in near])))
    inner, around = (np.concatenate(each) for each in zip(*found))
    return inner, around


def shares_on_plane(offset: Floats, sides: Floats, normal: Floats) -> Floats:
    """Return barycentric coordinates (M, 3) of offsets from the first corner (M, 3) on the plane of two sides."""
    square = np.einsum("mc,mc->m", normal, normal)
    second = np.einsum("mc,mc->m", np.cross(offset, sides[:, 1]), normal) / square
    third = np.einsum("mc,mc->m", np.cross(sides[:, 0], offset), normal) / square
    return np.column_stack([1 - second - third, second, third])


def closest_shares(weights: Floats, offset: Floats, sides: Floats) -> Floats:
    """Return barycentric coordinates of the closest points of triangles (M, 3), from those on their planes."""
    if not len(weights):
        return weights
    corners = np.concatenate([np.zeros_like(sides[:, :1]), sides], axis=1)
    tried, distances = [weights], [np.where((weights >= 0).all(axis=1), -1.0, np.inf)]
    for first in range(3):
        second = (first + 1) % 3
        along = corners[:, second] - corners[:, first]
        start = offset - corners[:, first]
        share = (np.einsum("mc,mc->m", start, along) / np.einsum("mc,mc->m", along, along)).clip(0, 1)
        at = np.zeros_like(weights)
        at[:, first], at[:, second] = 1 - share, share
        tried.append(at)
        distances.append(np.linalg.norm(start - share[:, None] * along, axis=1))
    best = np.argmin(distances, axis=0)
    return np.stack(tried)[best, np.arange(len(weights))]
