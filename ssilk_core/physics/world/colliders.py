# SPDX-License-Identifier: Apache-2.0
"""The colliders of shots in one frame, relative to a character's root (numpy only)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from ...scene.assets import Collider, Floats, Ints, Motion, Scene, ShotWorld, SkinWeights
from ...scene.assets.world import frame_at
from ...scene.kinematics import (
    matrix_from_quaternion,
    motion_transforms,
    quaternion_from_matrix,
    rigid,
    skin_points,
    skinning_matrices,
    slerp,
)
from .surface import CollisionSurface, PosedSurface, Search, SurfaceDistance, boxes

AT_ONCE = 256  # frames that are skinned together, to bound memory
VOTERS = 512  # vertices of the garment that tell which side of a floor is the outside


class PosedCollider:
    """A collider in one frame, relative to the character's root.

    Attributes:
        name: as `Collider` has it.
        first: the place of its first vertex among those of all colliders of its shot, whichever are there.
        count: of its vertices, P.
        points: of its mesh, shape (P, 3).
    """

    def __init__(
        self, name: str, first: int, surface: PosedSurface, turn: Floats, place: Floats, carried: Floats
    ) -> None:
        self.name, self.first, self.count = name, first, len(surface.points)
        self._surface, self._turn, self._place = surface, turn, place
        self._sides = surface.outside(self._inward(carried))
        self._known: tuple[Floats, Floats] | None = None
        self._last: tuple[Floats, float, tuple[Ints, SurfaceDistance]] | None = None

    @property
    def points(self) -> Floats:
        return self._surface.points @ self._turn.T + self._place

    def on_surface(self, corners: Ints, weights: Floats) -> Floats:
        """Return points (M, 3) of the mesh, each between three of its vertices (M, 3) with weights (M, 3)."""
        own = (weights[:, :, None] * self._surface.points[corners]).sum(axis=1)
        return own @ self._turn.T + weights.sum(axis=1)[:, None] * self._place

    def near(self, queries: Floats, within: float) -> tuple[Ints, SurfaceDistance]:
        """Return the queries (S, 3) that are nearer than `within` [m] or inside, and their distances.

        No distance falls by more than a query has moved: those that were far enough away are not searched for again.
        """
        if self._last and self._last[1] == within and np.array_equal(self._last[0], queries):
            return self._last[2]
        asked = np.arange(len(queries))
        if self._known is not None and len(self._known[0]) == len(queries):
            moved = np.linalg.norm(queries - self._known[0], axis=1)
            asked = np.flatnonzero(~(self._known[1] - moved > within))
        found = self._surface.distance(self._inward(queries[asked]), self._sides)
        if len(asked) == len(queries):
            # Beyond the border of a floor, what is below it can come to lie beneath it.
            self._known = queries.copy(), np.where(found.behind, -np.inf, found.distance)
        kept = ~(found.distance > within)
        result = asked[kept], found.only(kept, self._turn)
        self._last = queries.copy(), within, result
        return result

    def _inward(self, points: Floats) -> Floats:
        return (points - self._place) @ self._turn


@dataclass(frozen=True, eq=False)
class Nearby:
    """What lies up to a distance `within` [m] from a box of corners `low` and `high` (3,)."""

    low: Floats
    high: Floats
    within: float

    @classmethod
    def of(cls, points: Floats, within: float) -> Nearby:
        """Return that of the box around points (P, 3)."""
        return cls(points.min(axis=0), points.max(axis=0), within)

    def gap(self, place: Floats) -> float:
        """Return how far a place (3,) is outside [m]; negative or zero inside."""
        return float(np.linalg.norm(place - place.clip(self.low, self.high))) - self.within


class ColliderPoser:
    """Places colliders, of which each is prepared once.

    Args:
        search: finds nearest points on triangles.
    """

    def __init__(self, search: Search = boxes) -> None:
        self._search = search
        self._surfaces: dict[int, CollisionSurface] = {}
        self._still: dict[int, PosedSurface] = {}
        self._balls: dict[int, tuple[Floats, float]] = {}  # around each collider in all frames, before it is placed

    def at(
        self, world: ShotWorld, seconds: float, root: Floats, carried: Floats, near: Nearby | None = None
    ) -> tuple[PosedCollider, ...]:
        """Return the colliders of a shot at a time, relative to a root (3,).

        Args:
            carried: vertices of the garment as the body carries it, relative to the root (V, 3).
            near: leaves out what is further away; by default nothing is.
        """
        firsts = accumulate((each.points.shape[1] for each in world.colliders), initial=0)
        own = [
            self._posed(each, first, world, seconds, root, carried, near)
            for each, first in zip(world.colliders, firsts)
        ]
        return tuple(each for each in own if each)

    def _posed(
        self,
        collider: Collider,
        first: int,
        world: ShotWorld,
        seconds: float,
        root: Floats,
        carried: Floats,
        near: Nearby | None,
    ) -> PosedCollider | None:
        """Return a collider at a time; None where cloth does not meet it then."""
        if not collider.is_there(world.fps, seconds):
            return None
        key = id(collider)
        place = placed_at(collider.placements, world, seconds)
        if near:
            if key not in self._balls:
                low, high = collider.points.min(axis=(0, 1)), collider.points.max(axis=(0, 1))
                self._balls[key] = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
            centre, radius = self._balls[key]
            if near.gap(place[:3, :3] @ centre + place[:3, 3] - root) > radius:
                return None
        if key not in self._surfaces:
            self._surfaces[key] = CollisionSurface(collider.path, collider.points[0], collider.faces)
        if len(collider.points) > 1:
            surface = self._surfaces[key].at(world.between(collider.points, seconds), self._search)
        else:
            if key not in self._still:
                self._still[key] = self._surfaces[key].at(collider.points[0], self._search)
            surface = self._still[key]
        return PosedCollider(collider.name, first, surface, place[:3, :3], place[:3, 3] - root, carried)


def carried_points(motion: Motion, scene: Scene, rows: Ints) -> Floats:
    """Return some vertices (P,) of a garment under linear blend skinning in the world [m], shape (F, P, 3)."""
    skin, skeleton = scene.lbs_skin, scene.character.skeleton
    matrices = skinning_matrices(motion_transforms(motion, skeleton.parents), skeleton.bind_transforms)
    own = SkinWeights(skin.path, skin.indices[rows], skin.weights[rows])
    points = scene.garment.mesh.points[rows]
    parts = (matrices[at : at + AT_ONCE] for at in range(0, len(matrices), AT_ONCE))
    return np.concatenate([skin_points(points, own, part) for part in parts])


def voting_points(motion: Motion, scene: Scene) -> Floats:
    """Return vertices of a garment by which floors have their outside, as `carried_points`, shape (F, P, 3)."""
    return carried_points(motion, scene, voting_rows(scene.garment.mesh.vertex_count))


def voting_rows(count: int) -> Ints:
    """Return which of a garment's vertices, so many, tell the outside of floors, shape (P,)."""
    return np.linspace(0, count - 1, min(VOTERS, count)).astype(int)


def placed_at(placements: Floats, world: ShotWorld, seconds: float) -> Floats:
    """Return the placement (4, 4) at a time; between frames it turns at a constant rate."""
    low, part = frame_at(seconds, world.fps, len(placements))
    if part == 0:
        return placements[low]
    turns = quaternion_from_matrix(placements[low : low + 2, :3, :3])
    turn = matrix_from_quaternion(slerp(turns[0], turns[1], np.array(part)))
    return rigid(turn, world.between(placements, seconds)[:3, 3])
