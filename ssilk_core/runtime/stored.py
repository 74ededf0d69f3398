# SPDX-License-Identifier: Apache-2.0
"""A garment from the poses that a shot stores, without its network."""

from __future__ import annotations

import numpy as np

from ..assets import Deformer, Floats, GarmentPose, Motion
from ..kinematics import local_transforms, matrix_from_quaternion
from .character import character_matrices
from .kinematics import ProxyKinematics
from .skinning import skin_garment, tiles_of


class StoredPlayer:
    """Skins stored poses: rotations and translations of proxies, and weights of all blendshapes of a deformer."""

    def __init__(self, deformer: Deformer) -> None:
        scene = deformer.scene
        self.skeleton, joints = scene.character.skeleton, scene.character.skeleton.joint_count
        binds = scene.bind_transforms[:, :3, :3]
        self.parent_rotations, self.bind_rotations = binds[scene.rig.parents], binds[joints:]
        self.places = local_transforms(scene.bind_transforms, scene.parents)[joints:, :3, 3]
        self.kinematics = ProxyKinematics(scene.rig, joints)
        rest = scene.garment.mesh.points[None]
        shapes = np.concatenate([deformer.shapes, rest]).transpose(0, 2, 1).astype(np.float32)
        self.tiles = tiles_of(shapes, deformer.skin.indices, deformer.skin.weights)

    def vertices(self, motion: Motion, pose: GarmentPose) -> Floats:
        """Return the vertices of a pose's frames in world space [m], shape (F, V, 3)."""
        frames = motion.clip(pose.start, pose.start + pose.frame_count)
        character, origins = character_matrices(frames, self.skeleton)
        own = self.bind_rotations.swapaxes(-1, -2)
        turned = self.parent_rotations @ matrix_from_quaternion(pose.rotations) @ own
        rotations = np.ascontiguousarray(turned.transpose(1, 2, 3, 0), dtype=np.float32)
        weights = pose.weights.T.astype(np.float32)
        matrices = self.kinematics.matrices(rotations, character, self._shifts(pose))
        return skin_garment(self.tiles, weights, matrices, origins)

    def _shifts(self, pose: GarmentPose) -> Floats | None:
        """Return how far the proxies are from their places in the bind pose, in its axes [m], shape (P, 3, F)."""
        if pose.translations is None:
            return None
        away = (self.parent_rotations @ (pose.translations - self.places)[..., None])[..., 0]
        return np.ascontiguousarray(away.transpose(1, 2, 0), dtype=np.float32)
