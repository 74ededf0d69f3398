# SPDX-License-Identifier: Apache-2.0
"""A garment from the poses that a shot stores, without its network."""

from __future__ import annotations

import numpy as np

from ...scene.assets import Deformer, Floats, GarmentPose, Motion
from ...scene.kinematics import ProxyAxes
from .character import character_matrices
from .kinematics import ProxyKinematics
from .skinning import skin_garment, tiles_of


class StoredPlayer:
    """Skins stored poses: rotations and translations of proxies, and weights of all blendshapes of a deformer."""

    def __init__(self, deformer: Deformer) -> None:
        scene = deformer.scene
        self.skeleton, joints = scene.character.skeleton, scene.character.skeleton.joint_count
        self.axes = ProxyAxes.of(scene)
        self.kinematics = ProxyKinematics(scene.rig, joints)
        rest = scene.garment.mesh.points[None]
        shapes = np.concatenate([deformer.shapes, rest]).transpose(0, 2, 1).astype(np.float32)
        self.tiles = tiles_of(shapes, deformer.skin.indices, deformer.skin.weights)

    def vertices(self, motion: Motion, pose: GarmentPose) -> Floats:
        """Return the vertices of a pose's frames in world space [m], shape (F, V, 3)."""
        frames = motion.clip(pose.start, pose.start + pose.frame_count)
        character, origins = character_matrices(frames, self.skeleton)
        moved = self.axes.to_bind(pose.rotations, pose.translations)
        transforms = np.ascontiguousarray(moved.transpose(1, 2, 3, 0), dtype=np.float32)
        weights = pose.weights.T.astype(np.float32)
        matrices = self.kinematics.matrices(transforms, character)
        return skin_garment(self.tiles, weights, matrices, origins)
