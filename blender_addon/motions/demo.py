# SPDX-License-Identifier: GPL-3.0-or-later
"""The demo's motions as actions of a two-legged armature that has none."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np

from ssilk_core.scene.assets import Motion
from ssilk_core.scene.kinematics import motion_transforms, quaternion_from_matrix

from ..arrays.joints import Joints
from ..scene.objects import scene_rate, scene_units
from .keys import Channel, continuous, new_action

PREFIX = "Demo "  # begins the names of the actions
FIRST = 1.0  # frame
STILL = 1e-5  # how far a bone is moved at least that gets keys of its place, as a share of the armature's size


def hand_over_joints(path: Path, joints: Joints) -> None:
    """Write joints for `outside/demo_motions.py`."""
    np.savez(path, paths=joints.paths, parents=joints.parents, binds=joints.binds)


def read_motions(path: Path) -> list[Motion]:
    """Return what that made of them."""
    with np.load(path) as made:
        names, rates = made["names"].tolist(), made["rates"].tolist()
        moved = [(made[f"rotations{number}"], made[f"translations{number}"]) for number in range(len(names))]
    return [
        Motion(name, rate, rotations, translations)
        for name, rate, (rotations, translations) in zip(names, rates, moved)
    ]


def channels_of(armature: bpy.types.Object, joints: Joints, motion: Motion) -> Iterator[tuple[float, list[Channel]]]:
    """Yield of each bone in turn the part that is done, and what moves it: turns, and shifts where it has any."""
    units = scene_units()
    binds, skeleton = units.transforms_from_core(joints.binds), joints.skeleton("/")
    moved = units.transforms_from_core(motion_transforms(motion, skeleton.parents)) @ np.linalg.inv(binds)
    place = np.array(armature.matrix_world)
    moved = np.linalg.inv(place) @ moved @ place  # of each joint since rest, in the armature's space, (F, J, 4, 4)
    size, index = max(armature.dimensions), {name: joint for joint, name in enumerate(joints.names)}
    shifted: dict[str, np.ndarray] = {}  # of every bone, likewise; those that are no joints follow their parents
    for done, bone in enumerate(armature.data.bones):  # parents before children
        above = shifted[bone.parent.name] if bone.parent else np.eye(4)
        own = moved[:, index[bone.name]] if bone.name in index else above
        shifted[bone.name] = own
        if bone.name in index:
            rest = np.array(bone.matrix_local)
            local = np.linalg.inv(rest) @ np.linalg.inv(above) @ own @ rest
            yield (done + 1) / len(armature.data.bones), _channels(bone.name, local, STILL * size)


def add_action(armature: bpy.types.Object, motion: Motion, channels: list[Channel]) -> bpy.types.Action:
    """Give an armature an action with the keys of a motion, in the scene's time."""
    name = PREFIX + motion.path.replace("_", " ")
    return new_action(name, armature, FIRST, scene_rate() / motion.fps, channels)


def _channels(name: str, local: np.ndarray, still: float) -> list[Channel]:
    """Return the turns of a bone from its transforms in its own space at rest, (F, 4, 4), and its shifts, if any."""
    turns = quaternion_from_matrix(local[:, :3, :3] / np.cbrt(np.linalg.det(local[:, :3, :3]))[:, None, None])
    turns = continuous(turns)
    base = f'pose.bones["{bpy.utils.escape_identifier(name)}"]'
    found = [Channel(f"{base}.rotation_quaternion", axis, name, turns[:, axis]) for axis in range(4)]
    shifts = local[:, :3, 3]
    if np.abs(shifts).max() > still:
        found += [Channel(f"{base}.location", axis, name, shifts[:, axis]) for axis in range(3)]
    return found
