# SPDX-License-Identifier: Apache-2.0
"""The meshes, the gravity and the air of shots, placed around the characters of N frames.

Cloth meets each mesh on its own, and the energies add up: where a floor meets a wall, the distance to both together
would have a crease. Distances are searched for on a processor, in float64, whatever the device of the cloth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Collider, Floats, Ints, ShotWorld
from ...scene.assets.world import frame_at
from ...scene.kinematics import matrix_from_quaternion, quaternion_from_matrix, rigid, slerp
from .air import MovingAir
from .surface import CollisionSurface, PosedSurface, SurfaceDistance

VOTERS = 512  # vertices of the garment that tell which side of a floor is the outside


@dataclass(frozen=True, eq=False)
class Touched:
    """P samples of the cloth that are near what surrounds the character, in N frames, ascending.

    Attributes:
        row, frame: of each, shape (P,).
        normal: away from what it meets, unit vectors, shape (3, P).
        distance: [m], shape (P,).
        corners: of the nearest point, among `PosedWorld.points`, shape (3, P); weights: likewise.
    """

    row: Tensor
    frame: Tensor
    normal: Tensor
    distance: Tensor
    corners: Tensor
    weights: Tensor


class PosedCollider:
    """A collider in one frame, relative to the character's root.

    Attributes:
        points: of its mesh, shape (P, 3).
    """

    def __init__(self, surface: PosedSurface, turn: Floats, place: Floats, carried: Floats) -> None:
        self._surface, self._turn, self._place = surface, turn, place
        self._sides = surface.outside(self._inward(carried))
        self._known: tuple[Floats, Floats] | None = None
        self._last: tuple[Floats, float, tuple[Ints, SurfaceDistance]] | None = None

    @property
    def points(self) -> Floats:
        return self._surface.points @ self._turn.T + self._place

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
class PosedWorld:
    """What surrounds the characters of N frames, relative to their roots.

    Attributes:
        colliders: of each frame.
        gravity: [m/s2], shape (3, N).
        air: of each frame, or None for air that moves with the root.
        seconds: since the first frame of each motion, length N.
        roots: positions of the characters' roots in the world [m], shape (N, 3).
    """

    colliders: tuple[tuple[PosedCollider, ...], ...]
    gravity: Tensor
    air: tuple[MovingAir | None, ...]
    seconds: tuple[float, ...]
    roots: Floats
    _points: list[Tensor] = field(default_factory=list, repr=False)

    def select(self, frames: Tensor) -> PosedWorld:
        """Return that of the frames with indices (M,)."""
        chosen = frames.tolist()
        colliders = tuple(self.colliders[index] for index in chosen)
        air, seconds = tuple(self.air[index] for index in chosen), tuple(self.seconds[index] for index in chosen)
        return PosedWorld(colliders, self.gravity[:, frames], air, seconds, self.roots[chosen])

    @property
    def has_colliders(self) -> bool:
        return any(self.colliders)

    def points(self, like: Tensor) -> Tensor:
        """Return the points of all colliders, shape (B, 3, N), padded with zeros; `like` gives type and device."""
        if not self._points:
            frames = [
                np.concatenate([each.points for each in own]) if own else np.zeros((0, 3)) for own in self.colliders
            ]
            padded = np.zeros((max(map(len, frames), default=0), 3, len(frames)))
            for frame, own in enumerate(frames):
                padded[: len(own), :, frame] = own
            self._points.append(torch.as_tensor(padded, dtype=like.dtype, device=like.device))
        return self._points[0]

    def touched(self, samples: Tensor, within: float) -> Touched:
        """Return which samples (S, 3, N) are nearer to a collider than `within` [m], or inside one."""
        queries = samples.detach().double().cpu().numpy()
        rows, frames, distances, normals, corners, weights = ([] for _ in range(6))
        for frame, own in enumerate(self.colliders):
            first = 0
            for collider in own:
                row, found = collider.near(np.ascontiguousarray(queries[:, :, frame]), within)
                rows.append(row)
                frames.append(np.full(len(row), frame))
                distances.append(found.distance)
                normals.append(found.normal)
                corners.append(found.corners + first)
                weights.append(found.weights)
                first += len(collider.points)

        def joined(parts: Sequence[np.ndarray], empty: np.ndarray) -> np.ndarray:
            return np.concatenate(parts) if parts else empty

        def real(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values.T.copy(), dtype=samples.dtype, device=samples.device)

        def whole(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values.T.copy(), dtype=torch.long, device=samples.device)

        none, vectors = np.zeros(0), np.zeros((0, 3))
        return Touched(
            whole(joined(rows, none)),
            whole(joined(frames, none)),
            real(joined(normals, vectors)),
            real(joined(distances, none)),
            whole(joined(corners, vectors)),
            real(joined(weights, vectors)),
        )


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


class Surroundings:
    """The worlds of shots, each prepared once.

    Args:
        gravity: where a world says none [m/s2], shape (3,).
    """

    def __init__(self, worlds: Sequence[ShotWorld | None], gravity: Floats) -> None:
        self._worlds = [world or ShotWorld(1.0) for world in worlds]
        self._gravity = gravity
        self._air = [MovingAir(world.air, world.fps) if world.air else None for world in self._worlds]
        self._surfaces: dict[int, CollisionSurface] = {}
        self._still: dict[int, PosedSurface] = {}
        self._balls: dict[int, tuple[Floats, float]] = {}  # around each collider in all frames, before it is placed

    def around(self, places: Sequence[tuple[int, float]], root: Tensor, carried: Tensor) -> PosedWorld:
        """Return what surrounds N characters.

        Args:
            places: shot and seconds since its first frame, of each.
            root: their roots in the world [m], shape (3, N).
            carried: the garment as the body carries it, relative to the roots, shape (V, 3, N).
        """
        roots = root.double().cpu().numpy().T
        voters = np.linspace(0, len(carried) - 1, min(VOTERS, len(carried))).astype(int)
        points = carried[torch.as_tensor(voters, device=carried.device)].double().cpu().numpy()
        gravity = np.zeros((len(places), 3))
        colliders = []
        for frame, (shot, seconds) in enumerate(places):
            world = self._worlds[shot]
            at = self._gravity if world.gravity is None else world.between(world.gravity, seconds)
            gravity[frame] = at
            colliders.append(self.colliders(shot, seconds, roots[frame], points[..., frame]))
        down = torch.as_tensor(gravity.T.copy(), dtype=carried.dtype, device=carried.device)
        air = tuple(self._air[shot] for shot, _ in places)
        return PosedWorld(tuple(colliders), down, air, tuple(seconds for _, seconds in places), roots)

    def colliders(
        self, shot: int, seconds: float, root: Floats, carried: Floats, near: Nearby | None = None
    ) -> tuple[PosedCollider, ...]:
        """Return the colliders of a shot at a time, relative to a root (3,).

        Args:
            carried: vertices of the garment as the body carries it, relative to the root (V, 3).
            near: leaves out what is further away; by default nothing is.
        """
        world = self._worlds[shot]
        own = [self._posed(each, world, seconds, root, carried, near) for each in world.colliders]
        return tuple(each for each in own if each)

    def _posed(
        self,
        collider: Collider,
        world: ShotWorld,
        seconds: float,
        root: Floats,
        carried: Floats,
        near: Nearby | None,
    ) -> PosedCollider | None:
        """Return a collider at a time; None where cloth does not meet it then."""
        frame = min(max(int(seconds * world.fps + 1e-6), 0), len(collider.present) - 1)
        if not collider.present[frame]:
            return None
        key = id(collider)
        place = _placed(collider.placements, world, seconds)
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
            surface = self._surfaces[key].at(world.between(collider.points, seconds))
        else:
            if key not in self._still:
                self._still[key] = self._surfaces[key].at(collider.points[0])
            surface = self._still[key]
        return PosedCollider(surface, place[:3, :3], place[:3, 3] - root, carried)


def _placed(placements: Floats, world: ShotWorld, seconds: float) -> Floats:
    """Return the placement (4, 4) at a time; between frames it turns at a constant rate."""
    low, part = frame_at(seconds, world.fps, len(placements))
    if part == 0:
        return placements[low]
    turns = quaternion_from_matrix(placements[low : low + 2, :3, :3])
    turn = matrix_from_quaternion(slerp(turns[0], turns[1], np.array(part)))
    return rigid(turn, world.between(placements, seconds)[:3, 3])
