# SPDX-License-Identifier: Apache-2.0
"""The body's surface, and which side of it cloth belongs to, even where cloth lies deep inside or came out beyond."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, Ints, Mesh
from ...scene.mesh.laplacian import laplacian
from ...scene.mesh.topology import components, edges, is_inside_out, islands, smooth, vertex_areas, vertex_normals
from ..setup.surface import closest_on_surface, is_enclosed
from .winding import consistent_flips

Mask = NDArray[np.bool_]
BURIED = 1e-3  # [m] in front of a face of the body; where this is inside the body, the face is buried in it
CROSSING = 2e-3  # [m] depth of an edge's middle from which the edge leads through the body
REACH = 0.05  # [m] distance to the body over which the direction of cloth tells less and less about its side
INSIDE_WEIGHT = 0.01  # how much vertices inside the body tell about the winding of cloth, relative to those outside
VOTE_COUPLING = 0.1  # how much neighbours agree on their winding, relative to what vertices outside tell
SMOOTHING = 3  # rounds over which normals are averaged, so that a dent hardly turns them
MINOR = 0.2  # share of an island's area below which a part beyond the body may have passed through it
OPPOSITE = 0.6  # cosine between cloth's normal and that of the surface beneath, below minus which it is the wrong one
MUCH_FARTHER = 2.0  # times the distance of the nearest surface, which is right unless the cloth is opposite to it
FACING = 0.2  # the same cosine for the right one, at least
# All 26 directions of a cube's faces, edges and corners.
DIRECTIONS = np.array([row for row in product((-1.0, 0.0, 1.0), repeat=3) if any(row)])
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


@dataclass(frozen=True, eq=False)
class SurfaceSide:
    """The points of the surface that S points belong to.

    Attributes:
        normals: unit directions out of the body, shape (S, 3).
        points: the points of the surface [m], shape (S, 3).
        inside: whether each point lies in the body, shape (S,).
        distance: distance to the surface [m], negative inside and for cloth on the wrong side, shape (S,).
    """

    normals: Floats
    points: Floats
    inside: Mask
    distance: Floats


@dataclass(frozen=True, eq=False)
class Facing:
    """Where cloth should face.

    Attributes:
        directions: unit normals of the cloth, all on the side away from the body, shape (V, 3).
        doubtful: vertices whose nearest surface may be the wrong one, shape (V,).
        crossed: those of them that have left the body on the wrong side, shape (V,).
    """

    directions: Floats
    doubtful: Mask
    crossed: Mask


class ClothObstacle(Protocol):
    """What cloth is settled off: a body's `OuterSurface`, or that with garments on it (`LayeredSurface`)."""

    mesh: Mesh

    def inside(self, points: Floats) -> Mask: ...

    def nearest(self, points: Floats) -> SurfaceSide: ...

    def belonging(
        self, points: Floats, inside: Mask, facing: Floats, doubtful: Mask, crossed: Mask
    ) -> SurfaceSide: ...


class OuterSurface:
    """The part of a body's surface that is not buried in the body itself, with its normals outward."""

    def __init__(self, body: Mesh) -> None:
        outward = replace(body, faces=_outward_faces(body), polygon_counts=None, polygon_indices=None, uvs=None)
        a, b, c = np.moveaxis(outward.points[outward.faces], 1, 0)
        crosses = np.cross(b - a, c - a)
        size = np.linalg.norm(crosses, axis=1)
        directions = crosses / np.maximum(size, 1e-30)[:, None]
        self.whole = outward
        seen = (size > 0) & ~self.inside((a + b + c) / 3 + BURIED * directions)
        self.mesh = replace(outward, faces=outward.faces[seen]) if seen.any() else outward
        self.face_normals = directions[seen] if seen.any() else directions

    def inside(self, points: Floats) -> Mask:
        """Return whether points (S, 3) lie in the body, shape (S,)."""
        return is_enclosed(points, self.whole)

    def nearest(self, points: Floats) -> SurfaceSide:
        """Return the nearest points of the surface."""
        normals, found, distance = _closest(points, self.mesh)
        return oriented(points, normals, found, self.inside(points), distance)

    def belonging(self, points: Floats, inside: Mask, facing: Floats, doubtful: Mask, crossed: Mask) -> SurfaceSide:
        """Return the points of the surface that cloth belongs to.

        That is the nearest point, unless the surface there faces away from where doubtful cloth should face.

        Args:
            points: of the cloth [m], shape (S, 3).
            inside: whether they lie in the body, shape (S,).
            facing: unit directions, shape (S, 3).
            doubtful, crossed: as in `Facing`, shape (S,).
        """
        normals, found, distance = _closest(points, self.mesh)
        agreement = np.einsum("sc,sc->s", normals, facing)
        wrong = (doubtful & inside & (agreement < FACING)) | (crossed & ~inside & (agreement < -OPPOSITE))
        beyond = np.zeros(len(points), dtype=bool)
        bins = _bins(facing)
        for number in np.unique(bins[wrong]):
            chosen = np.flatnonzero(wrong & (bins == number))
            faces = self.mesh.faces[self.face_normals @ DIRECTIONS[number] > FACING]
            if len(faces):
                part = replace(self.mesh, faces=faces, polygon_counts=None, polygon_indices=None)
                other = _closest(points[chosen], part, self.mesh)
                better = (agreement[chosen] < -OPPOSITE) | (other[2] < MUCH_FARTHER * distance[chosen])
                rows = chosen[better]
                normals[rows], found[rows], distance[rows] = (values[better] for values in other)
                beyond[rows] = True
        side = oriented(points, normals, found, inside | beyond, distance)
        return replace(side, inside=inside)


def find_facing(points: Floats, faces: Ints, surface: ClothObstacle) -> Facing:
    """Find out where cloth should face.

    Vertices outside the body tell whether the cloth is wound with the surface beneath it or against it, as the inner
    layer of a hem is. Vertices inside follow their neighbours. So do small parts that are cut off from the others by
    the body: they have passed through it.

    Args:
        points: the cloth's vertices [m], coincident ones joined, shape (V, 3).
        faces: triangles, shape (F, 3).
        surface: the body's.
    """
    import scipy.sparse as sparse
    from scipy.sparse.linalg import spsolve

    count, pairs = len(points), edges(faces)
    flips = consistent_flips(np.full(len(faces), 3), faces.reshape(-1))[0]
    normals = vertex_normals(points, np.where(flips[:, None], faces[:, ::-1], faces))
    normals = _unit(smooth(normals, pairs, SMOOTHING))
    side = surface.nearest(points)
    agreement = np.einsum("vc,vc->v", normals, closest_on_surface(points, surface.mesh).normals)
    middle = surface.nearest(points[pairs].mean(axis=1))
    open_edge = ~side.inside[pairs].any(axis=1) & ~(middle.inside & (middle.distance < -CROSSING))
    share = _share_of_island(components(pairs[open_edge], count), points, faces)
    weight = np.where(side.inside, INSIDE_WEIGHT, share) * np.exp(-np.abs(side.distance) / REACH) + 1e-9
    coupling = VOTE_COUPLING * laplacian(pairs, 1.0, count)
    vote = spsolve((sparse.diags(weight) + coupling).tocsc(), weight * agreement)
    sign = np.where(vote < 0, -1.0, 1.0)
    crossed = ~side.inside & (share < MINOR) & (sign * agreement < -FACING) & (side.distance < REACH)
    return Facing(sign[:, None] * normals, side.inside | crossed, crossed)


def _share_of_island(part: Ints, points: Floats, faces: Ints) -> Floats:
    """Return the share that the part of each vertex has in its island's area, shape (V,)."""
    area = vertex_areas(points, faces)
    island = islands(faces, len(points))
    whole = np.maximum(np.bincount(island, area)[island], 1e-30)
    return np.bincount(part, area)[part] / whole


def _outward_faces(body: Mesh) -> Ints:
    return body.faces[:, ::-1] if is_inside_out(body.points, body.faces) else body.faces


def _closest(points: Floats, mesh: Mesh, shaded: Mesh | None = None) -> tuple[Floats, Floats, Floats]:
    """Return normals (S, 3), points (S, 3) and distances (S,) of the closest points of a mesh."""
    found = closest_on_surface(points, mesh)
    corners = (shaded or mesh).points[found.corners]
    return found.normals.copy(), np.einsum("sk,skc->sc", found.barycentric, corners), found.distance.copy()


def oriented(points: Floats, normals: Floats, found: Floats, inside: Mask, distance: Floats) -> SurfaceSide:
    """Return the side with directions to or from the surface where these agree with its normals."""
    sign = np.where(inside, -1.0, 1.0)
    away = (points - found) * sign[:, None] / np.maximum(distance, 1e-12)[:, None]
    agrees = (distance > 1e-5) & (np.einsum("sc,sc->s", away, normals) > np.where(inside, 0.5, 0.0))
    return SurfaceSide(np.where(agrees[:, None], away, normals), found, inside, sign * distance)


def _bins(directions: Floats) -> Ints:
    return np.asarray((directions @ DIRECTIONS.T).argmax(axis=1))


def _unit(vectors: Floats) -> Floats:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
