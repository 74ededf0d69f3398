# SPDX-License-Identifier: Apache-2.0
"""Figures on two legs under the joint names of several programs, bound in an A-pose or a T-pose."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from ssilk_core.scene.assets import Motion, Skeleton
from ssilk_core.scene.kinematics import local_transforms, motion_transforms, quaternion_from_matrix, rigid

# Where joints are on the left of a figure of 1.7 m that faces +z, arms apart, as (above, place).
TRUNK = {
    "hips": ("", (0, 0.95, 0)), "spine1": ("hips", (0, 1.05, -0.01)), "spine2": ("spine1", (0, 1.18, -0.02)),
    "spine3": ("spine2", (0, 1.3, -0.02)), "neck": ("spine3", (0, 1.46, 0)), "head": ("neck", (0, 1.56, 0.03)),
}  # fmt: skip
SIDE = {
    "collar": ("spine3", (0.03, 1.4, 0)), "upper arm": ("collar", (0.17, 1.4, -0.02)),
    "thigh": ("hips", (0.09, 0.9, 0)), "shin": ("thigh", (0.1, 0.5, 0.01)), "foot": ("shin", (0.11, 0.08, -0.02)),
    "toe": ("foot", (0.12, 0.02, 0.1)), "forearm": ("upper arm", (0.27, 0, 0)), "hand": ("forearm", (0.25, 0, 0.02)),
}  # fmt: skip
PARTS = (*TRUNK, *(f"{side} {part}" for side in ("left", "right") for part in SIDE))


def cmu(part: str) -> str:
    """The joint names of the CMU mocap skeletons."""
    side, _, name = part.rpartition(" ") if part in TRUNK else part.partition(" ")
    names = {"hips": "Hips", "spine1": "LowerBack", "spine2": "Spine", "spine3": "Spine1", "neck": "Neck",
             "head": "Head", "collar": "Shoulder", "upper arm": "Arm", "forearm": "ForeArm", "hand": "Hand",
             "thigh": "UpLeg", "shin": "Leg", "foot": "Foot", "toe": "ToeBase"}  # fmt: skip
    return f"{side.title()}{names[name if part not in TRUNK else part]}"


def _named(trunk: str, sided: str, pattern: str) -> dict[str, str]:
    """Names of all parts: of the trunk from the hips up, of a side from the collar on, as a pattern has them."""
    names = dict(zip(TRUNK, trunk.split()))
    order = ("collar", "upper arm", "forearm", "hand", "thigh", "shin", "foot", "toe")
    for side in ("left", "right"):
        for part, name in zip(order, sided.split()):
            names[f"{side} {part}"] = pattern.format(
                name=name, side=side, Side=side.title(), s=side[0], S=side[0].upper()
            )
    return names


SCHEMES = {
    "cmu": {part: cmu(part) for part in PARTS},
    "mixamo": _named("mixamorig_Hips mixamorig_Spine mixamorig_Spine1 mixamorig_Spine2 mixamorig_Neck mixamorig_Head",
                     "Shoulder Arm ForeArm Hand UpLeg Leg Foot ToeBase", "mixamorig_{Side}{name}"),
    "unreal": _named("pelvis spine_01 spine_02 spine_03 neck_01 head",
                     "clavicle upperarm lowerarm hand thigh calf foot ball", "{name}_{s}"),
    "smpl": _named("m_avg_Pelvis m_avg_Spine1 m_avg_Spine2 m_avg_Spine3 m_avg_Neck m_avg_Head",
                   "Collar Shoulder Elbow Wrist Hip Knee Ankle Foot", "m_avg_{S}_{name}"),
    "rigify": _named("DEF_spine DEF_spine_001 DEF_spine_002 DEF_spine_003 DEF_spine_004 DEF_spine_006",
                     "shoulder upper_arm forearm hand thigh shin foot toe", "DEF_{name}_{S}"),
    "bip": _named("Bip01_Pelvis Bip01_Spine Bip01_Spine1 Bip01_Spine2 Bip01_Neck Bip01_Head",
                  "Clavicle UpperArm Forearm Hand Thigh Calf Foot Toe0", "Bip01_{S}_{name}"),
    "vrm": _named("J_Bip_C_Hips J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest J_Bip_C_Neck J_Bip_C_Head",
                  "Shoulder UpperArm LowerArm Hand UpperLeg LowerLeg Foot ToeBase", "J_Bip_{S}_{name}"),
    "daz": _named("pelvis abdomenLower abdomenUpper chestLower neckLower head",
                  "Collar ShldrBend ForearmBend Hand ThighBend Shin Foot Toe", "{s}{name}"),
    "advanced": _named("Root_M Spine1_M Spine2_M Chest_M Neck_M Head_M",
                       "Scapula Shoulder Elbow Wrist Hip Knee Ankle Toes", "{name}_{S}"),
    "numbers": {part: f"J{number:02d}" for number, part in enumerate(PARTS)},
}  # fmt: skip


def humanoid(
    names: Mapping[str, str],
    *,
    arms: float = 45.0,
    size: float = 1.0,
    axes: int | None = None,
    without: tuple[str, ...] = (),
    turn: float = 0.0,
) -> Skeleton:
    """A figure under these names.

    Args:
        arms: by which they hang below the horizontal [degrees].
        axes: seed of the joints' axes; None for those of the world.
        without: parts that it lacks.
        turn: by which it faces another way [degrees].
    """
    down = np.radians(arms)
    places, above = dict[str, np.ndarray](), dict[str, str]()
    for part in PARTS:
        side, _, limb = part.partition(" ") if part not in TRUNK else ("", "", part)
        parent, place = (TRUNK | SIDE)[limb]
        above[part] = parent if not side or parent in TRUNK or not parent else f"{side} {parent}"
        at = np.array(place, float)
        if limb in ("forearm", "hand"):
            at = np.array([at[0] * np.cos(down), -at[0] * np.sin(down), at[2]])
            at = places[above[part]] * [1 if side == "left" else -1, 1, 1] + at
        places[part] = at * [-1 if side == "right" else 1, 1, 1]
    heading = Rotation.from_euler("y", turn, degrees=True).as_matrix()
    kept = [part for part in PARTS if part not in without]
    rotations = np.tile(np.eye(3), (len(kept), 1, 1))
    if axes is not None:
        rotations = Rotation.random(len(kept), random_state=axes).as_matrix()
    parents, paths = [], list[str]()
    for part in kept:
        parent = above[part]
        while parent in without:
            parent = above[parent]
        parents.append(kept.index(parent) if parent else -1)
        paths.append(f"{paths[parents[-1]]}/{names[part]}" if parent else names[part])
    binds = rigid(rotations, np.array([size * heading @ places[part] for part in kept]))
    return Skeleton("/figure", tuple(paths), parents, binds, local_transforms(binds, np.array(parents)))


def moved(skeleton: Skeleton, frames: int, seed: int = 0) -> Motion:
    """Every joint turns, and the hips wander."""
    dice, time = np.random.default_rng(seed), np.arange(frames) / 30
    count = skeleton.joint_count
    angles = 0.5 * np.sin(time[:, None, None] * dice.uniform(1, 5, (count, 3)) + dice.uniform(0, 6, (count, 3)))
    turns = Rotation.from_rotvec(angles.reshape(-1, 3)).as_matrix().reshape(frames, count, 3, 3)
    rest = skeleton.rest_transforms
    rotations = quaternion_from_matrix(rest[:, :3, :3] @ turns)
    translations = np.broadcast_to(rest[:, :3, 3], (frames, count, 3)).copy()
    translations[:, 0] += 0.3 * np.sin(time[:, None] * [2.0, 3.0, 4.0])
    return Motion("/moved", 30.0, rotations, translations)


def moved_alike(motion: Motion, own: Skeleton, other: Skeleton, alike: np.ndarray, images: np.ndarray) -> Motion:
    """A motion of one figure as another moves that has joints for all: turns since the pose in which both are alike.

    Args:
        alike: joints of the other one in the pose in which the own one is bound (J', 4, 4).
        images: the other's joint for each of the own ones, (J,).
    """
    world = motion_transforms(motion, own.parents)
    since = world[..., :3, :3] @ np.swapaxes(own.bind_transforms[:, :3, :3], -1, -2)
    order = np.argsort(images)
    turned = since[:, order] @ alike[:, :3, :3]
    places = np.zeros((len(world), other.joint_count, 3))
    local = local_transforms(alike, other.parents)
    for joint, parent in enumerate(other.parents.tolist()):
        if parent < 0:
            places[:, joint] = world[:, own.hub, :3, 3]
        else:
            places[:, joint] = places[:, parent] + turned[:, parent] @ local[joint, :3, 3]
    found = local_transforms(rigid(turned, places), other.parents)
    return Motion("/alike", motion.fps, quaternion_from_matrix(found[..., :3, :3]), found[..., :3, 3])
