# SPDX-License-Identifier: GPL-3.0-or-later
"""A baked shot becomes weights, shape keys and keys on a garment and its proxies."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np
from mathutils import Matrix

from ..contract.arrays import Joints, Shot, to_parents
from ..errors import need
from .armature import proxy_names
from .keys import Channel, bake_keys, remove_keys
from .shapes import need_relative, remove_shapes, rest_points, write_shapes
from .worn import put_on, take_off

MOVED = 1e-4  # how far rest points may be from those that were trained on, as a share of the garment's size
TURNED = 1e-3  # how far the axes and places of bones may be


def need_bakeable(garment: bpy.types.Object, armature: bpy.types.Object, joints: Joints) -> None:
    """Check that Blender will deform a garment as ssilk does.

    Raises:
        SetupError: an option of the modifier, of a bone or of shape keys is in the way.
    """
    need_relative(garment)
    _need_linear(garment, armature)
    names = joints.names
    for name, parent in list(zip(names, joints.parents))[joints.character_count :]:
        bone = armature.data.bones[name]
        above = bone.parent.name if bone.parent else ""
        need(
            parent >= 0 and above == names[parent],
            f"The proxy '{name}' hangs on '{above}', which does not deform; give it a parent that does.",
        )
        need(bone.use_inherit_rotation, f"The proxy '{name}' does not inherit rotation; switch that on.")
    bent = next((name for name in names if armature.data.bones[name].bbone_segments > 1), None)
    need(not bent, f"The bone '{bent}' bends (B-Bone segments); a garment follows stiff bones only.")


def animated(garment: bpy.types.Object, armature: bpy.types.Object) -> list[object]:
    """Return what a bake animates: the armature, and the garment's shape keys where it has any."""
    keys = garment.data.shape_keys
    return [armature, keys] if keys else [armature]


def apply_shot(garment: bpy.types.Object, armature: bpy.types.Object, joints: Joints, shot: Shot) -> None:
    """Put a shot in place of what was baked for a garment before. In object mode.

    Args:
        joints: of the armature, as `read_joints` returns them.

    Raises:
        SetupError: garment or bones are not those that it was trained with.
    """
    shapes = wear(garment, armature, joints, shot)
    keys = garment.data.shape_keys
    moved = [(armature, _turns(joints, shot)), (keys, _activations(shapes, shot))]
    bake_keys(garment, shot.start, [(thing, channels) for thing, channels in moved if thing])


def wear(garment: bpy.types.Object, armature: bpy.types.Object, joints: Joints, shot: Shot) -> list[str]:
    """Give a garment the shapes and weights of a shot, its proxies at rest; return its shape keys. In object mode.

    Raises:
        SetupError: as `apply_shot` does.
    """
    world = _moved_back(armature, joints, shot) @ np.array(garment.matrix_world)
    _need_same_points(garment, world, shot)
    shapes = write_shapes(garment, shot.offsets @ np.linalg.inv(world[:3, :3]).T, shot.shapes)
    put_on(armature, garment, shot.weights, joints.names)
    _free(armature, joints.names[joints.character_count :])
    return shapes


def turns_from_rest(joints: Joints, rotations: np.ndarray) -> np.ndarray:
    """Return the proxies' turns from their rest rotations, which is what pose bones hold, shape (F, P, 4).

    Args:
        rotations: of each proxy to its parent, unit quaternions (w, x, y, z), shape (F, P, 4).
    """
    rest = _quaternions(to_parents(joints.binds, joints.parents)[joints.character_count :, :3, :3])
    return _product(rest * [1, -1, -1, -1], rotations)


def remove_bake(garment: bpy.types.Object, armature: bpy.types.Object) -> None:
    """Remove what was baked for a garment, and give it its own weights back. In object mode."""
    remove_keys(garment, animated(garment, armature))
    remove_shapes(garment)
    take_off(armature, garment)
    _free(armature, proxy_names(armature, garment))


def _need_linear(garment: bpy.types.Object, armature: bpy.types.Object) -> None:
    for modifier in garment.modifiers:
        if modifier.type != "ARMATURE" or modifier.object != armature:
            continue
        options = {
            "Preserve Volume": modifier.use_deform_preserve_volume,
            "Bone Envelopes": modifier.use_bone_envelopes,
            "a vertex group": bool(modifier.vertex_group),
            "Multi Modifier": modifier.use_multi_modifier,
        }
        for label, on in options.items():
            need(not on, f"The modifier '{modifier.name}' of '{garment.name}' uses {label}; switch that off.")
        need(modifier.use_vertex_groups, f"The modifier '{modifier.name}' of '{garment.name}' ignores vertex groups.")
        return
    need(False, f"'{garment.name}' has no Armature modifier for '{armature.name}'; generate its rig.")


def _moved_back(armature: bpy.types.Object, joints: Joints, shot: Shot) -> np.ndarray:
    """Return how the armature has moved as an object, back to where it was when the garment was trained, (4, 4).

    Raises:
        SetupError: bones have moved.
    """
    back = shot.binds[0] @ np.linalg.inv(joints.binds[0])
    away = np.abs(back @ joints.binds - shot.binds)
    away[:, :3, 3] /= _size(shot)
    worst = int(away.max(axis=(1, 2)).argmax())
    need(
        away[worst].max() <= TURNED,
        f"The bone '{joints.names[worst]}' of '{armature.name}' was moved since the garment was trained; undo that, "
        "or train again.",
    )
    return back


def _need_same_points(garment: bpy.types.Object, world: np.ndarray, shot: Shot) -> None:
    """Check a garment's points at rest, given its object to world at the time of the training."""
    count = len(garment.data.vertices)
    need(
        count == len(shot.points),
        f"'{garment.name}' had {len(shot.points)} vertices when it was trained and has {count} now; train it again.",
    )
    away = np.abs(rest_points(garment) @ world[:3, :3].T + world[:3, 3] - shot.points).max()
    need(
        away <= MOVED * _size(shot),
        f"'{garment.name}' has another shape or place at rest than when it was trained; undo that, or train again.",
    )


def _size(shot: Shot) -> float:
    return max(float(np.ptp(shot.points, axis=0).max()), 1e-9)


def _free(armature: bpy.types.Object, proxies: Sequence[str]) -> None:
    """Put proxies at rest where no key says otherwise, to be turned by quaternions."""
    for name in proxies:
        bone = armature.pose.bones[name]
        bone.rotation_mode = "QUATERNION"
        bone.location, bone.scale, bone.rotation_quaternion = (0, 0, 0), (1, 1, 1), (1, 0, 0, 0)


def _turns(joints: Joints, shot: Shot) -> list[Channel]:
    names = joints.names[joints.character_count :]
    return [
        Channel(f'pose.bones["{bpy.utils.escape_identifier(name)}"].rotation_quaternion', index, name, values)
        for name, turn in zip(names, turns_from_rest(joints, shot.rotations).swapaxes(0, 1))
        for index, values in enumerate(turn.T)
    ]


def _activations(names: Sequence[str], shot: Shot) -> list[Channel]:
    return [
        Channel(f'key_blocks["{bpy.utils.escape_identifier(name)}"].value', 0, "SSILK", values)
        for name, values in zip(names, shot.activations.T)
    ]


def _quaternions(axes: np.ndarray) -> np.ndarray:
    """Return unit quaternions (w, x, y, z), shape (N, 4), of rotation matrices (N, 3, 3)."""
    return np.array([Matrix(matrix).to_quaternion() for matrix in axes]).reshape(-1, 4)


def _product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return quaternion products (first after second), shape (..., 4)."""
    w, v, x, u = first[..., :1], first[..., 1:], second[..., :1], second[..., 1:]
    scalar = w * x - (v * u).sum(axis=-1, keepdims=True)
    return np.concatenate([scalar, w * u + x * v + np.cross(v, u)], axis=-1)
