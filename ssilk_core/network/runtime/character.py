# SPDX-License-Identifier: Apache-2.0
"""A character's motion as network input: descriptors, and skinning matrices relative to the root."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import fail
from ...scene.assets import Floats, Motion, Skeleton
from ...scene.kinematics import motion_transforms, skinning_matrices
from ..descriptors import PoseFeatures, pose_features
from ..feedback import bends
from ..proximity import sees_at

HISTORY = 2  # frames before others that their descriptors, and what S sees of the cloth, look back on


@dataclass(frozen=True, eq=False)
class CharacterFrames:
    """Descriptors and skinning matrices of the character over F frames of a motion.

    Attributes:
        static: static descriptors, proximity and gravity included, shape (F, S), float32.
        rates: dynamic part of the descriptors, shape (F, R), float32; relative ones are zero while the character
            holds still.
        all_matrices: skinning matrices relative to the root, of the two frames before and these, shape
            (J, 3, 4, F + 2), float32; the first frame stands for those before a motion.
        all_origins: positions of the root in these [m], shape (F + 2, 3).
        proximity: to colliders in these, as `Motion` has it, shape (F + 2, M, 5); None where none are looked for.
    """

    static: NDArray
    rates: NDArray
    all_matrices: NDArray
    all_origins: Floats
    proximity: Floats | None = None

    @property
    def matrices(self) -> NDArray:
        """Skinning matrices relative to the root in the F frames, shape (J, 3, 4, F)."""
        return self.all_matrices[..., HISTORY:]

    @property
    def origins(self) -> Floats:
        """Positions of the root in the F frames [m], shape (F, 3)."""
        return self.all_origins[HISTORY:]

    @property
    def bend(self) -> Floats:
        """Second differences of the root's position in the F frames [m], shape (F, 3)."""
        return bends(self.all_origins)[HISTORY:]


def character_frames(
    motion: Motion, skeleton: Skeleton, joints: NDArray, lookback: int = 0, kind: str = "relative", seen: int = 0
) -> CharacterFrames:
    """Return descriptors and skinning matrices of a motion at the model's rate.

    Args:
        lookback: number of first frames, at most two, that only serve what looks back, and are none of the F frames.
        kind: of the descriptors.
        seen: features of proximity, which are zero where the motion says of none.

    Raises:
        SsilkError: the motion has the proximity of another number of points.
    """
    world = motion_transforms(motion, skeleton.parents)
    features = pose_features(motion, skeleton, joints, world, kind)
    near = np.zeros((len(world), seen)) if features.proximity is None else features.proximity
    if near.shape[1] != seen:
        fail(motion.path, f"proximity at {near.shape[1] // 3} points", *sees_at(seen))
    static = np.concatenate([near, *_static(features)], axis=1, dtype=np.float32)
    rates = np.concatenate([_into(features.earlier, features.gravity), features.dynamic], axis=1, dtype=np.float32)
    missing = HISTORY - lookback
    every = np.maximum(np.arange(-missing, len(world)), 0)
    matrices, origins = about_root(world[every], skeleton)
    met = None if motion.proximity is None else motion.proximity[every]
    return CharacterFrames(static[lookback:], rates[lookback:], matrices, origins, met)


def unseeing(motion: Motion, world: Floats, skeleton: Skeleton, joints: NDArray, kind: str = "relative") -> NDArray:
    """Return static descriptors of a motion without the proximity of colliders, which comes first, float32 (F, S').

    Args:
        world: transforms of all joints in its frames (F, J, 4, 4); others as for `character_frames`.
    """
    features = pose_features(motion, skeleton, joints, world, kind, moving=False)
    return np.concatenate(_static(features), axis=1, dtype=np.float32)


def _static(features: PoseFeatures) -> tuple[Floats, Floats]:
    return features.static, _into(features.down, features.gravity)


def _into(frames: Floats, gravity: Floats | None) -> Floats:
    """Return gravity as seen (F, 3) in frames (F, J, 3, 3), shape (F, 3 J); along -y by default."""
    found = -frames[..., 1] if gravity is None else (frames @ gravity[:, None, :, None])[..., 0]
    return found.reshape(len(frames), -1)


def character_matrices(motion: Motion, skeleton: Skeleton) -> tuple[NDArray, Floats]:
    """Return skinning matrices relative to the root (J, 3, 4, F), float32, and root positions (F, 3) [m]."""
    return about_root(motion_transforms(motion, skeleton.parents), skeleton)


def about_root(world: Floats, skeleton: Skeleton) -> tuple[NDArray, Floats]:
    """Return what `character_matrices` does, of joint-to-world transforms (F, J, 4, 4).

    Relative to the root, float32 is precise anywhere in the world.
    """
    origins = world[:, skeleton.hub, :3, 3].copy()
    world = world.copy()
    world[..., :3, 3] -= origins[:, None]
    matrices = skinning_matrices(world, skeleton.bind_transforms)[:, :, :3]
    return np.ascontiguousarray(matrices.transpose(1, 2, 3, 0), dtype=np.float32), origins
