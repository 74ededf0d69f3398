# SPDX-License-Identifier: Apache-2.0
"""What cloth feels of the world around its character, as networks are trained with it.

Gravity and wind are one acceleration for each frame.

Drag pulls cloth of area density rho with (c / rho) (w - v), where v is its velocity and w that of the air. Networks
are trained in air that moves with the character's root, w = r. Air that moves otherwise adds (c / rho) (w - r), which
depends on no velocity of the cloth: where w is the same all over the garment, that is gravity of another strength and
direction, and nothing else. An uneven wind is averaged over the garment as its body carries it.

Colliders are seen from points of the garment (`network.proximity`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...scene.assets import LOOSE, UP, Floats, Ints, Motion, Scene, ShotWorld
from ...scene.assets.world import interpolated
from ...scene.fabrics import Fabric
from ...scene.kinematics import hub_places, motion_transforms, split_at_cuts
from ..constants import GRAVITY
from .air import MovingAir
from .colliders import CarriedPoints, ColliderPoser, carried_points, voting_rows
from .surface import Search, boxes

AT_ONCE = 64  # frames in which air is looked for together, to bound memory
PLACES = 32  # vertices at which the air is averaged
Places = Callable[[Motion, Floats], Floats]
Proximity = Callable[[Floats, Floats, Floats, Floats], Floats]


def felt_gravity(world: ShotWorld | None, motion: Motion, scene: Scene, fabric: Fabric) -> Floats | None:
    """Return the acceleration that cloth feels in each frame of a motion [m/s2], (F, 3); None for the usual one.

    Args:
        world: whose time runs from the first frame of the motion.
    """
    if world is None or (world.gravity is None and not (world.air and fabric.drag)):
        return None
    seconds = np.arange(motion.frame_count) / motion.fps
    found = np.tile(-GRAVITY * UP, (motion.frame_count, 1))
    if world.gravity is not None:
        found = interpolated(world.gravity, seconds, world.fps)
    if world.air and fabric.drag:
        air, places = MovingAir(world.air, world.fps), np.zeros((len(seconds), 0, 3))
        if air.has_gusts:
            places = carried_points(motion, scene, _loose(scene))
        parts = [slice(at, at + AT_ONCE) for at in range(0, len(seconds), AT_ONCE)]
        blown = np.concatenate([air.mean_velocities(places[part], seconds[part]) for part in parts])
        found = found + fabric.drag / fabric.density * (blown - _root_velocity(motion, scene))
    return found


class ColliderSight:
    """What a garment sees of the colliders of its shot.

    Args:
        world: its time runs from the first frame of motions.
        places: takes a motion and the transforms of its joints (F, J, 4, 4), and returns the points from which
            colliders are seen in its frames [m], (F, M, 3).
        within: distance up to which they count [m].
        see: takes the points of frames (N, M, 3), distances (N, M), directions away from what is nearest (N, M, 3)
            and positions of the root (N, 3), and returns what is seen (N, M, 5); where nothing is near distances are
            infinite and directions zero.
        search: finds nearest points on triangles.
    """

    def __init__(
        self, world: ShotWorld, scene: Scene, places: Places, within: float, see: Proximity, search: Search = boxes
    ) -> None:
        self._world, self._scene, self._places, self._within, self._see = world, scene, places, within, see
        self._poser = ColliderPoser(search)
        self._voters = CarriedPoints(scene, voting_rows(scene.garment.mesh.vertex_count))

    def near(self, motion: Motion, frames: Ints) -> Floats:
        """Return how near colliders are in some frames (N,) of a motion, shape (N, M, 5)."""
        own = motion if len(frames) == motion.frame_count else motion.picked(frames)
        joints = motion_transforms(own, self._scene.character.skeleton.parents)
        points, voters = self._places(own, joints), self._voters(joints)
        roots = hub_places(self._scene.character.skeleton, own.rotations, own.translations)
        found = self._poser.nearest(self._world, frames / motion.fps, points, voters, self._within)
        return self._see(points, *found, roots)


def _loose(scene: Scene) -> Ints:
    """Return some vertices of the loose cloth, or of all cloth where none is loose, shape (P,)."""
    loose = np.flatnonzero(scene.classes == LOOSE)
    return _spread(loose if len(loose) else np.arange(scene.garment.mesh.vertex_count), PLACES)


def _spread(rows: Ints, count: int) -> Ints:
    """Return so many of some vertices, or all."""
    return rows[np.linspace(0, len(rows) - 1, min(count, len(rows))).astype(int)]


def _root_velocity(motion: Motion, scene: Scene) -> Floats:
    """Return the velocity of the character's root since the frame before [m/s], shape (F, 3), none across cuts."""
    skeleton, found = scene.character.skeleton, []
    for span in split_at_cuts(motion, skeleton):
        steps = np.diff(hub_places(skeleton, span.rotations, span.translations), axis=0) * span.fps
        found.append(np.concatenate([steps[:1], steps]) if len(steps) else np.zeros((1, 3)))
    return np.concatenate(found)
