# SPDX-License-Identifier: Apache-2.0
"""A character's motion as network input: descriptors, and skinning matrices relative to the root."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, Motion, Skeleton
from ...scene.kinematics import motion_transforms, skinning_matrices
from ..descriptors import pose_features


@dataclass(frozen=True, eq=False)
class CharacterFrames:
    """Descriptors and skinning matrices of the character over F frames of a motion.

    Attributes:
        static: static descriptors, gravity included, shape (F, S), float32.
        rates: dynamic part of the descriptors, zero while the character holds still, shape (F, R), float32.
        matrices: skinning matrices relative to the root, shape (J, 3, 4, F), float32.
        origins: positions of the root [m], shape (F, 3).
    """

    static: NDArray
    rates: NDArray
    matrices: NDArray
    origins: Floats


def character_frames(motion: Motion, skeleton: Skeleton, joints: NDArray, lookback: int = 0) -> CharacterFrames:
    """Return descriptors and skinning matrices of a motion at the model's rate, with gravity along -y.

    The first `lookback` frames only serve the finite differences of the descriptors and are left out.
    """
    world = motion_transforms(motion, skeleton.parents)
    features = pose_features(motion, skeleton, joints, world)
    down = -features.down[..., 1].reshape(motion.frame_count, -1)
    static = np.concatenate([features.static, down], axis=1, dtype=np.float32)
    matrices, origins = _about_root(world[lookback:], skeleton)
    return CharacterFrames(static[lookback:], features.dynamic[lookback:].astype(np.float32), matrices, origins)


def character_matrices(motion: Motion, skeleton: Skeleton) -> tuple[NDArray, Floats]:
    """Return skinning matrices relative to the root (J, 3, 4, F), float32, and root positions (F, 3) [m]."""
    return _about_root(motion_transforms(motion, skeleton.parents), skeleton)


def _about_root(world: Floats, skeleton: Skeleton) -> tuple[NDArray, Floats]:
    """Convert joint-to-world transforms (F, J, 4, 4).

    Relative to the root, float32 is precise anywhere in the world.
    """
    origins = world[:, 0, :3, 3].copy()
    world = world.copy()
    world[..., :3, 3] -= origins[:, None]
    matrices = skinning_matrices(world, skeleton.bind_transforms)[:, :, :3]
    return np.ascontiguousarray(matrices.transpose(1, 2, 3, 0), dtype=np.float32), origins
