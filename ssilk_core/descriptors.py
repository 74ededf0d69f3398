# SPDX-License-Identifier: Apache-2.0
"""What the network sees of a motion (paper, Sections 3.1 and 3.2).

A garment hangs and swings the same wherever its character stands, whichever way it faces and however fast it
glides, and turning character and gravity together only turns the result. The descriptors have these symmetries
by construction: gravity enters as its direction in each joint's own frame, and the root enters through its
angular motion and through accelerations, never through a position, a heading or a velocity. Augmenting with a
rotation of the character is then the same as turning gravity the other way, which costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .assets import Floats, Motion, Skeleton
from .constants import GRAVITY
from .kinematics import matrix_from_quaternion, motion_transforms

# Time over which rates are expressed, so that everyday motion gives features of order one.
RATE_TIME = 0.1  # [s]
# Features of rates and accelerations saturate here: a teleport must not push the network out of its range.
SATURATION = 4.0


@dataclass(frozen=True, eq=False)
class PoseFeatures:
    """Descriptors of a motion's frames, all but gravity, which depends on the augmentation.

    Attributes:
        static: 6D local rotations of the joints in view but the root, shape (F, S).
        dynamic: first and second differences of those, the root's turning, and accelerations, shape (F, D).
        down: joint-to-world rotations transposed, to bring gravity into each joint's frame, shape (F, J', 3, 3).
    """

    static: Floats
    dynamic: Floats
    down: Floats


def descriptor_joints(skeleton: Skeleton, used: Floats) -> np.ndarray:
    """Return the sorted joints that can matter: those flagged in `used` (J,) and all their ancestors."""
    keep = np.array(used, dtype=bool)
    for joint in range(skeleton.joint_count - 1, -1, -1):
        if keep[joint] and skeleton.parents[joint] >= 0:
            keep[skeleton.parents[joint]] = True
    return np.flatnonzero(keep)


def pose_features(
    motion: Motion, skeleton: Skeleton, joints: np.ndarray, world: Floats | None = None
) -> PoseFeatures:
    """Return the descriptors of every frame of a motion; the first frame also stands for what was before it.

    `world` is `motion_transforms` of the motion where it is known already.
    """
    world = (motion_transforms(motion, skeleton.parents) if world is None else world)[:, joints]
    local = matrix_from_quaternion(motion.rotations[:, joints])
    inner = [i for i, joint in enumerate(joints) if skeleton.parents[joint] >= 0]
    static = six_d(local[:, inner]).reshape(len(local), -1)
    root = world[:, 0, :3, :3]
    rate, change = _differences(static, motion.fps)
    turn = [
        six_d(np.swapaxes(root, -1, -2) @ _past(root, steps) - np.eye(3)) * motion.fps * RATE_TIME for steps in (1, 2)
    ]
    acceleration = _differences(world[..., :3, 3], motion.fps)[1] / (RATE_TIME**2 * GRAVITY)
    acceleration = np.einsum("fba,fjb->fja", root, acceleration).reshape(len(local), -1)
    dynamic = np.concatenate([rate, change, *turn, acceleration], axis=1)
    return PoseFeatures(static, SATURATION * np.tanh(dynamic / SATURATION), np.swapaxes(world[..., :3, :3], -1, -2))


def six_d(rotations: Floats) -> Floats:
    """Return the first two columns of rotation matrices (..., 3, 3), flattened to (..., 6) [ZBL*19]."""
    return np.swapaxes(rotations[..., :2], -1, -2).reshape(*rotations.shape[:-2], 6)


def _past(values: Floats, steps: int) -> Floats:
    """Return the values `steps` frames earlier; before the first frame, the first holds."""
    return values[np.maximum(np.arange(len(values)) - steps, 0)]


def _differences(values: Floats, fps: float) -> tuple[Floats, Floats]:
    """Return first and second backward differences over time, scaled by RATE_TIME; zero where history lacks."""
    first = np.zeros_like(values)
    first[1:] = values[1:] - values[:-1]
    if len(values) > 1:
        first[0] = first[1]
    second = np.zeros_like(values)
    second[2:] = first[2:] - first[1:-1]
    return first * fps * RATE_TIME, second * (fps * RATE_TIME) ** 2
