# SPDX-License-Identifier: Apache-2.0
"""Descriptors: the features of a motion that the network receives (paper, Sections 3.1 and 3.2).

The state of a garment does not depend on the position, heading or constant velocity of its character. Rotating
character and gravity together only rotates the result. The descriptors have these symmetries by construction. Gravity
enters as its direction in the frame of each joint. The root, which is the skeleton's hub, enters through its angular
motion and through accelerations, not through a position, a heading or a velocity. Augmentation by a rotation of the
character is therefore equivalent to the inverse rotation of gravity, which costs nothing.

Those of the paper are "absolute": beside the static descriptor S sees those of the two poses before, and the root's
rotations and positions in the world. A garment then behaves differently where its character stands or faces
otherwise. The paper does not say of how many poses the root is seen; here it is of the same three. It takes static
descriptors from NCS, in which gravity stands for the root's rotation, as it does here.

Gravity also stands for wind. Drag is linear in the velocity of the air relative to the cloth, so that an even wind
pulls on each vertex with the same acceleration, whatever it does. `Motion.gravity` holds the sum of both. The network
sees it in units of the usual one, as `seen_gravity` compresses it. How near colliders are comes first
(`network.proximity`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..physics.constants import GRAVITY
from ..scene.assets import Floats, Motion, Scene, Skeleton
from ..scene.kinematics import local_transforms, matrix_from_quaternion, motion_transforms
from .proximity import proximity_vectors

RATE_TIME = 0.1  # [s] unit of time of rates, which gives features of order one for everyday motion
VECTORS = (
    9  # at the end of absolute descriptors, in the world: two axes and the position of the root, of three frames
)
SATURATION = 4.0  # limit of dynamic features, so that a teleport keeps the network within its trained range


@dataclass(frozen=True, eq=False)
class PoseFeatures:
    """Descriptors of a motion's frames, and apart from them gravity, which training varies.

    Attributes:
        static: 6D local rotations of the descriptor joints except the hub, shape (F, S); of joints above the hub,
            rotations relative to it.
        dynamic: first and second differences of these, the root's rotation, and accelerations, shape (F, D); absolute
            ones are those of the two frames before (2 S), and `VECTORS` in the world.
        down: world-to-joint rotations, which bring gravity into each joint's frame, shape (F, J', 3, 3).
        gravity: as the network sees it, shape (F, 3); None for the usual one, (0, -1, 0).
        earlier: likewise of the two frames before, shape (F, 2 J', 3, 3); none (F, 0, 3, 3) in relative ones.
        proximity: to colliders, in the root's frame, shape (F, 3 M); None where none are looked for.
    """

    static: Floats
    dynamic: Floats
    down: Floats
    earlier: Floats
    gravity: Floats | None = None
    proximity: Floats | None = None


def seen_gravity(gravity: Floats) -> Floats:
    """Return accelerations (F, 3) [m/s2] in units of the usual one, with the length l > 1 as 1 + ln(l).

    A storm then stays near the range that training has drawn from, and a weak pull as it is.
    """
    units = np.asarray(gravity) / GRAVITY
    length = np.linalg.norm(units, axis=-1, keepdims=True).clip(min=1.0)
    return units * ((1 + np.log(length)) / length)


def descriptor_joints(skeleton: Skeleton, used: Floats) -> np.ndarray:
    """Return the joints flagged in `used` (J,) and their ancestors up to the hub, sorted, shape (J',).

    The garment's state does not depend on what stands above the hub, unless something hangs there.
    """
    keep = np.array(used, dtype=bool)
    keep[skeleton.hub] |= skeleton.parents[skeleton.hub] >= 0
    for joint in range(skeleton.joint_count - 1, -1, -1):
        if keep[joint] and skeleton.parents[joint] >= 0 and joint != skeleton.hub:
            keep[skeleton.parents[joint]] = True
    return np.flatnonzero(keep)


def model_joints(scene: Scene, colliding: Floats) -> np.ndarray:
    """Return the joints for a garment's descriptors: those that it is skinned to, or that move body parts in reach.

    Args:
        scene: character, garment and rig.
        colliding: flag of each joint that moves a reachable body vertex, shape (J,).
    """
    skeleton = scene.character.skeleton
    used = np.array(colliding, dtype=bool)
    for skin in (scene.rig.skin, scene.lbs_skin):
        indices = skin.indices[skin.weights > 0]
        used[indices[indices < skeleton.joint_count]] = True
    for parent in scene.rig.parents:
        if parent < skeleton.joint_count:
            used[parent] = True
    return descriptor_joints(skeleton, used)


def inner_joints(skeleton: Skeleton, joints: np.ndarray) -> np.ndarray:
    """Return the places in `joints` (J',) of those whose rotations are features: all but the hub, and other roots."""
    skeleton = seen_skeleton(skeleton)
    above = np.isin(joints, skeleton.hub_path[:-1])
    return np.flatnonzero(above | ((joints != skeleton.hub) & (skeleton.parents[joints] >= 0)))


def pose_features(
    motion: Motion,
    skeleton: Skeleton,
    joints: np.ndarray,
    world: Floats | None = None,
    kind: str = "relative",
    moving: bool = True,
) -> PoseFeatures:
    """Return the descriptors of every frame of a motion; frames before the first repeat it.

    Args:
        world: `motion_transforms` of the motion, if it is already computed.
        kind: of `settings.DESCRIPTORS`.
        moving: false leaves out what looks back on earlier frames, which P does not see.
    """
    world = motion_transforms(motion, skeleton.parents) if world is None else world
    if skeleton.seen is None:
        local = matrix_from_quaternion(motion.rotations[:, joints])
    else:
        world, skeleton = skeleton.seen.world(world), skeleton.seen.skeleton
        local = local_transforms(world, skeleton.parents)[:, joints, :3, :3]
    world = world[:, joints]
    centre = place_of_hub(skeleton, joints)
    root, down = world[:, centre, :3, :3], np.swapaxes(world[..., :3, :3], -1, -2)
    above = np.flatnonzero(np.isin(joints, skeleton.hub_path[:-1]))
    local[:, above] = np.swapaxes(root, -1, -2)[:, None] @ world[:, above, :3, :3]
    static = six_d(local[:, inner_joints(skeleton, joints)]).reshape(len(local), -1)
    gravity = None if motion.gravity is None else seen_gravity(motion.gravity)
    near = None
    if motion.proximity is not None:
        near = (proximity_vectors(motion.proximity) @ root).reshape(len(local), -1)
    if not moving:
        return PoseFeatures(static, static[:, :0], down, down[:, :0], gravity, near)
    if kind == "absolute":
        axes, places = six_d(root), world[:, centre, :3, 3]
        past = [_past(static, steps) for steps in (1, 2)]
        seen = [_past(values, steps) for values in (axes, places) for steps in (0, 1, 2)]
        earlier = np.concatenate([_past(down, steps) for steps in (1, 2)], axis=1)
        return PoseFeatures(static, np.concatenate([*past, *seen], axis=1), down, earlier, gravity, near)
    rate, change = _differences(static, motion.fps)
    turn = [
        six_d(np.swapaxes(root, -1, -2) @ _past(root, steps) - np.eye(3)) * motion.fps * RATE_TIME for steps in (1, 2)
    ]
    dynamic = np.concatenate([rate, change, *turn, accelerations(world[..., :3, 3], root, motion.fps)], axis=1)
    return PoseFeatures(static, saturated(dynamic), down, down[:, :0], gravity, near)


def saturated(dynamic: Floats) -> Floats:
    """Limit dynamic features; in single precision, as networks see them, which takes a third of the time."""
    return SATURATION * np.tanh((dynamic / SATURATION).astype(np.float32)).astype(np.float64)


def accelerations(places: Floats, root: Floats, fps: float) -> Floats:
    """Return accelerations of joints in the root's frame [g], the last of relative features before these saturate.

    Args:
        places: of the descriptor joints in the world [m], shape (F, J', 3).
        root: rotations of the hub, shape (F, 3, 3).

    Returns:
        Shape (F, 3 J').
    """
    acceleration = _differences(places, fps)[1] / (RATE_TIME**2 * GRAVITY)
    return (acceleration @ root).reshape(len(places), -1)


def seen_skeleton(skeleton: Skeleton) -> Skeleton:
    """Return the skeleton that a network sees on a character."""
    return skeleton if skeleton.seen is None else skeleton.seen.skeleton


def place_of_hub(skeleton: Skeleton, joints: np.ndarray) -> int:
    """Return the place of the hub in `joints` (J',); the first one where nothing of the garment hangs below it."""
    found = np.flatnonzero(joints == skeleton.hub)
    return int(found[0]) if len(found) else 0


def six_d(rotations: Floats) -> Floats:
    """Return the first two columns of rotation matrices (..., 3, 3), flattened to (..., 6) [ZBL*19]."""
    return np.swapaxes(rotations[..., :2], -1, -2).reshape(*rotations.shape[:-2], 6)


def _past(values: Floats, steps: int) -> Floats:
    """Return the values `steps` frames earlier, and the first value before the first frame."""
    return values[np.maximum(np.arange(len(values)) - steps, 0)]


def _differences(values: Floats, fps: float) -> tuple[Floats, Floats]:
    """Return first and second backward differences per RATE_TIME.

    The first frame repeats the first difference of the next. The second difference is zero in the first two frames.
    """
    first = np.zeros_like(values)
    first[1:] = values[1:] - values[:-1]
    if len(values) > 1:
        first[0] = first[1]
    second = np.zeros_like(values)
    second[2:] = first[2:] - first[1:-1]
    return first * fps * RATE_TIME, second * (fps * RATE_TIME) ** 2
