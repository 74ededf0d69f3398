# SPDX-License-Identifier: Apache-2.0
"""What a trained garment sees of the colliders of its shot (`network.proximity`)."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from ...physics.world.felt import ColliderSight
from ...physics.world.surface import Search, boxes
from ...scene.assets import Floats, Motion, ShotWorld
from ..proximity import proximity, proximity_reach, proximity_vertices
from .character import about_root, unseeing
from .garment import NumpyGarment
from .skinning import picked, skin_garment

AT_ONCE = 256  # frames, to bound memory


class RestingPoints:
    """The points at which a garment sees colliders, where they would rest without any."""

    def __init__(self, garment: NumpyGarment) -> None:
        self._garment = garment
        self._tile = picked(garment.tiles, proximity_vertices(garment.file.scene, garment.file.config))

    def __call__(self, motion: Motion, joints: Floats) -> Floats:
        """Return the points in each frame of a motion with transforms of joints (F, J, 4, 4) [m], shape (F, M, 3)."""
        alone = replace(motion, proximity=None)
        parts = [slice(at, at + AT_ONCE) for at in range(0, motion.frame_count, AT_ONCE)]
        return np.concatenate([self._of(alone.picked(part), joints[part]) for part in parts])

    def _of(self, motion: Motion, joints: Floats) -> Floats:
        garment, file = self._garment, self._garment.file
        static = unseeing(motion, joints, garment.skeleton, file.joints, file.config.descriptors)
        activations, transforms = garment.decoder.decode(garment.quasi_static(static))
        character, origins = about_root(joints, garment.skeleton)
        matrices = garment.kinematics.matrices(transforms, character)
        return skin_garment([self._tile], activations, matrices, origins)


def collider_sight(garment: NumpyGarment, world: ShotWorld, search: Search = boxes) -> ColliderSight:
    """Return what a garment sees of the colliders of a world, whose time runs from the first frame of motions."""
    scene = garment.file.scene
    reach = proximity_reach(scene)
    return ColliderSight(world, scene, RestingPoints(garment), reach, partial(proximity, reach=reach), search)


def seen_proximity(world: ShotWorld | None, motion: Motion, garment: NumpyGarment) -> Floats | None:
    """Return what a garment sees of the colliders of a shot in each frame of a motion, as `Motion.proximity`.

    Args:
        world: as for `collider_sight`; None for none.

    Returns:
        None where there are no colliders, or the garment sees none.
    """
    if world is None or not world.colliders or not garment.proximity:
        return None
    return collider_sight(garment, world).near(motion, np.arange(motion.frame_count))
