# SPDX-License-Identifier: Apache-2.0
"""Gravity and wind as one acceleration for each frame, which networks are trained with.

Drag pulls cloth of area density rho with (c / rho) (w - v), where v is its velocity and w that of the air. Networks
are trained in air that moves with the character's root, w = r. Air that moves otherwise adds (c / rho) (w - r), which
depends on no velocity of the cloth: where w is the same all over the garment, that is gravity of another strength and
direction, and nothing else. An uneven wind is averaged over the garment as its body carries it.
"""

from __future__ import annotations

import numpy as np

from ...scene.assets import LOOSE, UP, Floats, Motion, Scene, ShotWorld, SkinWeights
from ...scene.fabrics import Fabric
from ...scene.kinematics import hub_places, motion_transforms, skin_points, skinning_matrices, split_at_cuts
from ..constants import GRAVITY
from .air import MovingAir

PLACES = 32  # vertices at which the air is averaged


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
        found = np.stack([world.between(world.gravity, float(each)) for each in seconds])
    if world.air and fabric.drag:
        air, places = MovingAir(world.air, world.fps), _carried(motion, scene)
        blown = np.stack([air.velocity(points, float(each)).mean(axis=0) for points, each in zip(places, seconds)])
        found += fabric.drag / fabric.density * (blown - _root_velocity(motion, scene))
    return found


def _carried(motion: Motion, scene: Scene) -> Floats:
    """Return some vertices of the loose cloth under linear blend skinning [m], shape (F, P, 3)."""
    loose = np.flatnonzero(scene.classes == LOOSE)
    rows = loose if len(loose) else np.arange(scene.garment.mesh.vertex_count)
    rows = rows[np.linspace(0, len(rows) - 1, min(PLACES, len(rows))).astype(int)]
    skin, skeleton = scene.lbs_skin, scene.character.skeleton
    matrices = skinning_matrices(motion_transforms(motion, skeleton.parents), skeleton.bind_transforms)
    own = SkinWeights(skin.path, skin.indices[rows], skin.weights[rows])
    return skin_points(scene.garment.mesh.points[rows], own, matrices)


def _root_velocity(motion: Motion, scene: Scene) -> Floats:
    """Return the velocity of the character's root since the frame before [m/s], shape (F, 3), none across cuts."""
    skeleton, found = scene.character.skeleton, []
    for span in split_at_cuts(motion, skeleton):
        steps = np.diff(hub_places(skeleton, span.rotations, span.translations), axis=0) * span.fps
        found.append(np.concatenate([steps[:1], steps]) if len(steps) else np.zeros((1, 3)))
    return np.concatenate(found)
