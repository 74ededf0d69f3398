# SPDX-License-Identifier: Apache-2.0
"""What a character's motion alone says: descriptors for the network, and skinning matrices about the root."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..assets import Floats, Motion, Skeleton
from ..descriptors import pose_features
from ..kinematics import motion_transforms, skinning_matrices


@dataclass(frozen=True, eq=False)
class CharacterFrames:
    """The character's share of a motion of F frames.

    Attributes:
        static: static descriptors, gravity included, shape (F, S), float32.
        rates: what dynamic descriptors add to them, zero where the character holds still, shape (F, R), float32.
        matrices: bind pose to posed world, about the root, shape (J, 3, 4, F), float32.
        origins: places of the root [m], shape (F, 3).
    """

    static: NDArray
    rates: NDArray
    matrices: NDArray
    origins: Floats


def drive(motion: Motion, skeleton: Skeleton, joints: NDArray, seen: int = 0) -> CharacterFrames:
    """Return what a motion at the model's rate says about its frames, gravity pointing down.

    The first `seen` frames are only what descriptors look back on.
    """
    world = motion_transforms(motion, skeleton.parents)
    features = pose_features(motion, skeleton, joints, world)
    down = -features.down[..., 1].reshape(motion.frame_count, -1)
    static = np.concatenate([features.static, down], axis=1, dtype=np.float32)
    matrices, origins = _about_root(world[seen:], skeleton)
    return CharacterFrames(static[seen:], features.dynamic[seen:].astype(np.float32), matrices, origins)


def character_matrices(motion: Motion, skeleton: Skeleton) -> tuple[NDArray, Floats]:
    """Return skinning matrices about the root (J, 3, 4, F), float32, and where the root is (F, 3) [m]."""
    return _about_root(motion_transforms(motion, skeleton.parents), skeleton)


def _about_root(world: Floats, skeleton: Skeleton) -> tuple[NDArray, Floats]:
    """Take joints to world (F, J, 4, 4); about the root, single precision is as good far away as at the origin."""
    origins = world[:, 0, :3, 3].copy()
    world = world.copy()
    world[..., :3, 3] -= origins[:, None]
    matrices = skinning_matrices(world, skeleton.bind_transforms)[:, :, :3]
    return np.ascontiguousarray(matrices.transpose(1, 2, 3, 0), dtype=np.float32), origins
