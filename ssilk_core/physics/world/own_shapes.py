# SPDX-License-Identifier: Apache-2.0
"""Colliders that stand for the character's own body: capsules of ragdolls, and other shapes of physics rigs.

They collide for a rigid body solver. Cloth meets the body that they fill, so as props they would only push it off
skin that it may touch. Such a shape lies inside the body in each frame: half of its volume or more, or of its area
where it is open. Much of a capsule in a limb may stick out, as the limb is not round; hardly any of a bracelet is
inside, and of a chair what its cushion overlaps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...scene.assets import Collider, Floats, Ints, Motion, Scene
from ...scene.kinematics import body_at_rest, motion_transforms, skin_points, skinning_matrices
from .colliders import voting_points
from .surface import CollisionSurface, PosedSurface, Search, boxes

# Share of a shape that lies inside the body, from which on it is the body's own. Capsules from joint to joint of the
# demo's body, each with the median distance of its skin, have 0.54 (trunk) to 0.83 (legs and arms).
INSIDE = 0.5
LOOKED_AT = 8  # frames, spread over those in which it collides
STEPS = (6, 16)  # samples along a side of its box, at least and at most
FEWEST = 16  # samples of a volume; of thinner shapes the area is looked at


@dataclass(frozen=True, eq=False)
class BodyInFrame:
    """A body in a frame, in the world [m].

    Attributes:
        points: of its surface, shape (B, 3).
        voters: vertices of the garment, which tell the outside of its open parts, shape (P, 3).
    """

    points: Floats
    voters: Floats


class OwnShapes:
    """Tells which colliders stand for the character's body.

    Args:
        faces: triangles of the body, shape (T, 3).
        frames: of the shot, at which colliders are placed.
        posed: returns the body in a frame.
        search: finds nearest points on triangles.
    """

    def __init__(self, faces: Ints, frames: int, posed: Callable[[int], BodyInFrame], search: Search = boxes) -> None:
        self._faces, self._frames, self._pose, self._search = faces, frames, posed, search
        self._surface: CollisionSurface | None = None
        self._posed: dict[int, BodyInFrame] = {}
        self._prepared: dict[int, tuple[PosedSurface, Floats]] = {}

    @classmethod
    def of(cls, scene: Scene, motion: Motion) -> OwnShapes:
        """Return what tells it of the character of a scene over a motion, as its skeleton poses its bodies."""
        body, skeleton = scene.character.merged_body(), scene.character.skeleton

        def posed(frame: int) -> BodyInFrame:
            part = motion.picked(np.array([frame]))
            matrices = skinning_matrices(motion_transforms(part, skeleton.parents), skeleton.bind_transforms)
            rest = body_at_rest(scene.character, part)
            return BodyInFrame(skin_points(rest, body.skin, matrices)[0], voting_points(part, scene)[0])

        return cls(body.mesh.faces, motion.frame_count, posed)

    def has(self, collider: Collider) -> bool:
        """Return whether a collider is inside the body, whenever it collides."""
        present = np.flatnonzero(np.broadcast_to(collider.present, self._frames))
        frames = present[np.unique(np.linspace(0, len(present) - 1, min(LOOKED_AT, len(present))).astype(int))]
        return bool(len(frames)) and all(self._is_inside(collider, frame) for frame in frames.tolist())

    def _is_inside(self, collider: Collider, frame: int) -> bool:
        points = collider.points[min(frame, len(collider.points) - 1)]
        place = collider.placements[min(frame, len(collider.placements) - 1)]
        body = self._body(frame).points
        middle = place[:3, :3] @ ((points.min(axis=0) + points.max(axis=0)) / 2) + place[:3, 3]
        if not ((middle > body.min(axis=0)) & (middle < body.max(axis=0))).all():
            return False
        samples = _samples(collider, points, self._search) @ place[:3, :3].T + place[:3, 3]
        surface, sides = self._skin(frame)
        return float((surface.distance(samples, sides).distance < 0).mean()) >= INSIDE

    def _body(self, frame: int) -> BodyInFrame:
        if frame not in self._posed:
            self._posed[frame] = self._pose(frame)
        return self._posed[frame]

    def _skin(self, frame: int) -> tuple[PosedSurface, Floats]:
        """Return the surface of the body in a frame, and on which side the outside of each part is."""
        if frame not in self._prepared:
            body = self._body(frame)
            self._surface = self._surface or CollisionSurface("the body", body.points, self._faces)
            posed = self._surface.at(body.points, self._search)
            self._prepared[frame] = posed, posed.outside(body.voters)
        return self._prepared[frame]


def _samples(collider: Collider, points: Floats, search: Search) -> Floats:
    """Return points (N, 3) spread over the volume of a collider with vertices (P, 3), or over its area."""
    surface = CollisionSurface(collider.path, points, collider.faces)
    low, high = points.min(axis=0), points.max(axis=0)
    if surface.closed.all():
        steps = np.ceil((high - low) / (high - low).max() * STEPS[1]).clip(*STEPS).astype(int)
        sides = [
            (np.arange(count) + 0.5) / count * (end - begin) + begin for begin, end, count in zip(low, high, steps)
        ]
        grid = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
        within = grid[surface.at(points, search).distance(grid).distance < 0]
        if len(within) >= FEWEST:
            return within
    corners = points[surface.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = np.searchsorted(np.cumsum(area), (np.arange(256) + 0.5) / 256 * area.sum())
    weights = np.random.default_rng(0).dirichlet(np.ones(3), 256)
    return np.einsum("nk,nkc->nc", weights, corners[np.minimum(chosen, len(area) - 1)])
