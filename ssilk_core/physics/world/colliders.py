# SPDX-License-Identifier: Apache-2.0
"""The colliders of shots in one frame, relative to a character's root (numpy only)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Collider, Floats, Ints, Motion, Scene, ShotWorld
from ...scene.assets.world import frame_at
from ...scene.kinematics import (
    matrix_from_quaternion,
    motion_transforms,
    quaternion_from_matrix,
    rigid,
    skinning_matrices,
    slerp,
)
from ..loops import installed
from .moving import MovingSurface
from .surface import CollisionSurface, Garment, PosedSurface, Search, SurfaceDistance, boxes

AT_ONCE = 256  # frames that are skinned together, to bound memory
TOGETHER = 64  # frames in which a collider is searched together, likewise
COMPILED_FROM = 2**20  # triangles of a moving mesh, over all frames: they gain more by loops than these take to load
VOTERS = 512  # vertices of the garment that tell which side of a floor is the outside
Meet = Callable[[Floats, Garment, Floats, Floats], SurfaceDistance]  # as `PosedSurface.met`


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
    """What lies up to a distance `within` [m] from boxes of corners `low` and `high` (..., 3)."""

    low: Floats
    high: Floats
    within: float

    @classmethod
    def of(cls, points: Floats, within: float) -> Nearby:
        """Return that of the boxes around points (..., P, 3)."""
        rows = np.ascontiguousarray(points.swapaxes(-1, -2))  # along which numpy looks five times as fast
        return cls(rows.min(axis=-1), rows.max(axis=-1), within)

    def gap(self, place: Floats) -> Floats:
        """Return how far places (..., 3) are outside [m], shape (...); negative or zero inside."""
        away: Floats = np.linalg.norm(place - place.clip(self.low, self.high), axis=-1)
        return away - self.within


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
        firsts, found = accumulate((each.points.shape[1] for each in world.colliders), initial=0), []
        for collider, first in zip(world.colliders, firsts):
            if not collider.is_there(world.fps, seconds):
                continue
            place = placed_at(collider.placements, world, seconds)
            turn, place = place[:3, :3], place[:3, 3] - root
            if near and self._is_far(collider, turn, place, near):
                continue
            surface = self._surface(collider, world, seconds)
            found.append(PosedCollider(collider.name, first, surface, turn, place, carried))
        return tuple(found)

    def nearest(
        self, world: ShotWorld, seconds: Floats, queries: Floats, carried: Floats, within: float
    ) -> tuple[Floats, Floats]:
        """Return distances to the nearest of all colliders in N frames [m], (N, M), and their gradients (N, M, 3).

        Frames of a mesh that keeps its shape are searched together, which takes hardly longer than one of them did.

        Args:
            seconds: time of each frame (N,).
            queries, carried: points, and vertices of the garment as the body carries it, in the world [m], shapes
                (N, M, 3) and (N, V, 3).
            within: distance up to which colliders are looked for [m]; beyond, distances are infinite and gradients 0.
        """
        distance, normal = np.full(queries.shape[:2], np.inf), np.zeros(queries.shape)
        near, around = Nearby.of(queries, within), Nearby.of(carried, 0.0)
        middle, half = (around.low + around.high)[:, None] / 2, (around.high - around.low)[:, None] / 2
        for collider in world.colliders:
            there = np.array([collider.is_there(world.fps, each) for each in _changing(collider.present, seconds)])
            placed = np.stack(
                [placed_at(collider.placements, world, each) for each in _changing(collider.placements, seconds)]
            )
            placed = np.broadcast_to(placed, (len(seconds), 4, 4))
            turn, place = placed[:, :3, :3], placed[:, None, :3, 3]
            frames = np.flatnonzero(there & ~self._is_far(collider, turn, place[:, 0], near))
            for own, meet in self._together(collider, world, seconds, frames):
                back, here = turn[own], place[own]

                def garment(number: int, own: Ints = own, back: Floats = back, here: Floats = here) -> Floats:
                    return (carried[own[number]] - here[number]) @ back[number]

                centre, reach = ((middle[own] - here) @ back)[:, 0], (half[own] @ np.abs(back))[:, 0]
                found = meet((queries[own] - here) @ back, garment, centre - reach, centre + reach)
                reached, known = found.distance.reshape(len(own), -1), distance[own]
                closer = (reached <= within) & (reached < known)
                distance[own] = np.where(closer, reached, known)
                gradient = found.normal.reshape(*reached.shape, 3) @ back.swapaxes(1, 2)
                normal[own] = np.where(closer[..., None], gradient, normal[own])
        return distance, normal

    def _together(
        self, collider: Collider, world: ShotWorld, seconds: Floats, frames: Ints
    ) -> Iterator[tuple[Ints, Meet]]:
        """Yield frames that are searched together, and what finds the distances in these to a collider."""
        parts = [frames[at : at + TOGETHER] for at in range(0, len(frames), TOGETHER)]
        if len(collider.points) == 1:
            for part in parts:
                yield part, self._surface(collider, world, 0.0).met
        elif len(frames) * len(collider.faces) >= COMPILED_FROM and installed():
            moving = MovingSurface(self._shape(collider), collider.points[0])
            for part in parts:
                points = [world.between(collider.points, each) for each in seconds[part].tolist()]
                yield part, partial(moving.met, np.stack(points))
        else:
            for frame in frames:
                yield frame[None], self._surface(collider, world, float(seconds[frame])).met

    def _is_far(self, collider: Collider, turn: Floats, place: Floats, near: Nearby) -> NDArray[np.bool_]:
        """Return whether cloth does not meet a collider where turns (..., 3, 3) and places (..., 3) put it."""
        key = id(collider)
        if key not in self._balls:
            low, high = collider.points.min(axis=(0, 1)), collider.points.max(axis=(0, 1))
            self._balls[key] = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
        centre, radius = self._balls[key]
        return np.asarray(near.gap(turn @ centre + place) > radius)

    def _surface(self, collider: Collider, world: ShotWorld, seconds: float) -> PosedSurface:
        """Return a collider's surface at a time, in its own space."""
        key = id(collider)
        if len(collider.points) > 1:
            return self._shape(collider).at(world.between(collider.points, seconds), self._search)
        if key not in self._still:
            self._still[key] = self._shape(collider).at(collider.points[0], self._search)
        return self._still[key]

    def _shape(self, collider: Collider) -> CollisionSurface:
        key = id(collider)
        if key not in self._surfaces:
            self._surfaces[key] = CollisionSurface(collider.path, collider.points[0], collider.faces)
        return self._surfaces[key]


class CarriedPoints:
    """Some vertices (P,) of a garment under linear blend skinning."""

    def __init__(self, scene: Scene, rows: Ints) -> None:
        skin, skeleton = scene.lbs_skin, scene.character.skeleton
        self._joints, place = np.unique(skin.indices[rows], return_inverse=True)
        self._bind = skeleton.bind_transforms[self._joints]
        # Weights times points, homogeneous, of each joint: one product then blends all frames.
        points = np.concatenate([scene.garment.mesh.points[rows], np.ones((len(rows), 1))], axis=1)
        shares, own = np.zeros((len(self._joints), len(rows), 4)), np.arange(len(rows))
        for joint, weight in zip(place.reshape(len(rows), -1).T, skin.weights[rows].T):
            shares[joint, own] += weight[:, None] * points
        self._shares = shares.swapaxes(1, 2).reshape(-1, len(rows))

    def __call__(self, world: Floats) -> Floats:
        """Return the vertices in the world [m], shape (F, P, 3), of transforms of all joints (F, J, 4, 4)."""
        matrices = skinning_matrices(world[:, self._joints], self._bind)[:, :, :3]
        found = np.empty((len(matrices), 3, self._shares.shape[1]))
        for at in range(0, len(matrices), AT_ONCE):
            rows = matrices[at : at + AT_ONCE].swapaxes(1, 2).reshape(-1, len(self._shares))
            np.matmul(rows, self._shares, out=found[at : at + AT_ONCE].reshape(len(rows), -1))
        return found.swapaxes(1, 2)


def carried_points(motion: Motion, scene: Scene, rows: Ints) -> Floats:
    """Return some vertices (P,) of a garment under linear blend skinning in the world [m], shape (F, P, 3)."""
    return CarriedPoints(scene, rows)(motion_transforms(motion, scene.character.skeleton.parents))


def voting_points(motion: Motion, scene: Scene) -> Floats:
    """Return vertices of a garment by which floors have their outside, as `carried_points`, shape (F, P, 3)."""
    return carried_points(motion, scene, voting_rows(scene.garment.mesh.vertex_count))


def voting_rows(count: int) -> Ints:
    """Return which of a garment's vertices, so many, tell the outside of floors, shape (P,)."""
    return np.linspace(0, count - 1, min(VOTERS, count)).astype(int)


def _changing(values: NDArray, seconds: Floats) -> list[float]:
    """Return the times (N,) at which values (F or 1, ...) are looked up: the first alone for what does not change."""
    found: list[float] = (seconds if len(values) > 1 else seconds[:1]).tolist()
    return found


def placed_at(placements: Floats, world: ShotWorld, seconds: float) -> Floats:
    """Return the placement (4, 4) at a time; between frames it turns at a constant rate."""
    low, part = frame_at(seconds, world.fps, len(placements))
    if part == 0:
        return placements[low]
    turns = quaternion_from_matrix(placements[low : low + 2, :3, :3])
    turn = matrix_from_quaternion(slerp(turns[0], turns[1], np.array(part)))
    return rigid(turn, world.between(placements, seconds)[:3, 3])
