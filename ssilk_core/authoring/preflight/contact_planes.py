# SPDX-License-Identifier: Apache-2.0
"""Planes that hold cloth off the body: beneath its samples, and at the body's vertices that it covers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, Ints
from ...scene.mesh.topology import vertex_normals
from ..setup.surface import barycentric_coordinates
from .cloth_samples import ClothSamples
from .sides import ClothObstacle, Facing

Mask = NDArray[np.bool_]
TURNED = 0.9  # cosine between planes below which the earlier is kept as well
CREASE, CREASE_WIDTH = 2e-4, 0.02  # [m] depth and width of a crease between two planes
COVER = 0.02  # [m] within which cloth is held off a vertex of the body
ASIDE = 1e-3  # [m] that cloth over a vertex of the body may lie beside its normal


@dataclass(frozen=True, eq=False)
class HeldSamples:
    """Samples of cloth, and the planes that each must lie in front of.

    Attributes:
        samples: S samples.
        normals: unit normals out of the body, shape (S, 3).
        offsets: normals . points of the planes [m], shape (S,).
    """

    samples: ClothSamples
    normals: Floats
    offsets: Floats

    def heights(self, points: Floats) -> Floats:
        """Return how far the samples of cloth with vertices at `points` (V, 3) are above their planes [m], (S,)."""
        return np.asarray(np.einsum("sc,sc->s", self.normals, self.samples.of(points)) - self.offsets)

    def __add__(self, other: HeldSamples) -> HeldSamples:
        return HeldSamples(
            self.samples + other.samples, np.r_[self.normals, other.normals], np.r_[self.offsets, other.offsets]
        )


class ContactPlanes:
    """The plane that holds each sample off the body, and an earlier one in whose crease with it the sample lies.

    Attributes:
        distance: distance of each sample to the surface that it belongs to [m], negative inside, shape (S,).
    """

    def __init__(self, surface: ClothObstacle, samples: ClothSamples, facing: Facing, points: Floats) -> None:
        """Query all samples of cloth with vertices at `points` (V, 3)."""
        among, count = samples.weights > 0, len(samples.corners)
        directions = samples.of(facing.directions)
        self.surface, self.samples = surface, samples
        self.directions = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
        self.crossed = (facing.crossed[samples.corners] & among).any(axis=1)
        self.doubtful = (facing.doubtful[samples.corners] & among).any(axis=1)
        self.distance, self.places = np.full(count, -np.inf), np.zeros((count, 3))
        self.inside = np.zeros(count, dtype=bool)
        self.normals, self.points = np.zeros((2, count, 3)), np.zeros((2, count, 3))
        self.update(points, 0.0)

    def update(self, points: Floats, distance: float) -> None:
        """Query the samples again that may have come within a distance of the body [m] since they were queried."""
        places = self.samples.of(points)
        travel = np.linalg.norm(places - self.places, axis=1)
        due = np.flatnonzero(self.distance - travel < distance)
        across = due[self.distance[due] <= travel[due]]
        self.inside[across] = self.surface.inside(places[across])
        self.doubtful[across] |= self.inside[across]
        side = self.surface.belonging(
            places[due], self.inside[due], self.directions[due], self.doubtful[due], self.crossed[due]
        )
        turned = due[np.einsum("sc,sc->s", self.normals[0, due], side.normals) < TURNED]
        self.normals[1, turned], self.points[1, turned] = self.normals[0, turned], self.points[0, turned]
        self.distance[due], self.places[due] = side.distance, places[due]
        self.normals[0, due], self.points[0, due] = side.normals, side.points

    def near(self, among: Mask, distance: float) -> HeldSamples:
        """Return those `among` the samples (S,) that lie within a distance of the body [m]."""
        near = np.flatnonzero(among & (self.distance < distance))
        (now, before), (here, there) = self.normals[:, near], self.points[:, near]
        # Of two planes at a crease, each holds the other's point in front of it; at a ridge, it does not.
        front = np.einsum("sc,sc->s", there - here, now), np.einsum("sc,sc->s", here - there, before)
        crease = (front[0] > CREASE) & (front[1] > CREASE) & (np.linalg.norm(there - here, axis=1) < CREASE_WIDTH)
        crease &= before.any(axis=1)
        normals = np.r_[now, before[crease]]
        samples, points = self.samples[np.r_[near, near[crease]]], np.r_[here, there[crease]]
        return HeldSamples(samples, normals, np.einsum("sc,sc->s", normals, points))


def covering_planes(
    surface: ClothObstacle, points: Floats, faces: Ints, facing: Facing, distance: float
) -> HeldSamples:
    """Return the points of cloth over vertices of the body that it covers, with the planes through these.

    Args:
        points, faces: of the cloth, shapes (V, 3) and (F, 3).
        distance: height above the body's vertices up to which cloth is returned [m].
    """
    import igl

    if not len(faces):
        none = np.zeros((0, 3))
        return HeldSamples(ClothSamples(np.zeros((0, 3), dtype=np.int64), none), none, np.zeros(0))
    body = surface.mesh
    squared, face, found = igl.point_mesh_squared_distance(
        body.points, np.ascontiguousarray(points), np.ascontiguousarray(faces)
    )
    normals, corners = vertex_normals(body.points, body.faces), faces[face]
    height = np.einsum("bc,bc->b", found - body.points, normals)
    aside = np.sqrt(np.maximum(squared - height**2, 0.0))
    agreement = np.einsum("bc,bc->b", facing.directions[corners].mean(axis=1), normals)
    covered = (squared < COVER**2) & (height < distance) & (aside < ASIDE) & (agreement > 0.5)
    covered &= normals.any(axis=1)
    corners, found, normals = corners[covered], found[covered], normals[covered]
    offsets = np.einsum("bc,bc->b", normals, body.points[covered])
    return HeldSamples(ClothSamples(corners, barycentric_coordinates(found, points[corners])), normals, offsets)
