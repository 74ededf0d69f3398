# SPDX-License-Identifier: GPL-3.0-or-later
"""Apply a bake as weights, shape keys and keys on a garment and its proxies."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np
from ssilk_usd.shots.skinned import BakedGarment, SkinnedGarment

from ssilk_core.scene.assets import GarmentPose
from ssilk_core.scene.kinematics import (
    local_transforms,
    matrix_from_quaternion,
    multiply_quaternions,
    quaternion_from_matrix,
)

from ..arrays.joints import Joints, joint_order
from ..errors import SetupError
from ..motions.keys import Channel, bake_keys, continuous, mute_inherited, remove_keys
from ..scene.armature import bring_back, proxy_names, put_away
from ..scene.garment import need_linear, need_linear_bodies, need_own_mesh, need_uncarried
from ..scene.linked import give_back_mesh, give_own_mesh, has_lent_mesh
from ..scene.meshes import need_relative, remove_shapes, write_shapes
from ..scene.modifiers import need_plain_modifiers
from ..scene.objects import scene_units
from ..scene.shapes import earlier_shapes
from ..scene.weights import put_trained_weights, restore_own_weights
from .laying import MOVED, Laid, away, lay, moved_back, need_same_count, size

LAID = "body"  # the shape key that lays a garment of a family on its body


def need_bakeable(
    garment: bpy.types.Object, armature: bpy.types.Object, joints: Joints, *, simulated: bool = False
) -> None:
    """Check that Blender will deform a garment as ssilk does, apart from what may simulate it.

    Raises:
        SetupError: an option of the modifier, of a bone or of shape keys is in the way.
    """
    need_relative(garment)
    need_uncarried(garment)
    need_plain_modifiers(garment, simulated=simulated)
    need_own_mesh(garment)
    if not need_linear(garment, armature):
        raise SetupError(f"'{garment.name}' has no Armature modifier for '{armature.name}'; generate its rig.")
    need_linear_bodies(garment, armature)
    names = joints.names
    for name, parent in list(zip(names, joints.parents))[joints.character_count :]:
        bone = armature.data.bones[name]
        above = bone.parent.name if bone.parent else ""
        if parent < 0 or above != names[parent]:
            raise SetupError(
                f"The proxy '{name}' hangs on '{above}', which does not deform; give it a parent that does."
            )
        if not bone.use_inherit_rotation:
            raise SetupError(f"The proxy '{name}' does not inherit rotation; switch that on.")
    bent = next((name for name in names if armature.data.bones[name].bbone_segments > 1), None)
    if bent:
        raise SetupError(f"The bone '{bent}' bends (B-Bone segments); a garment follows stiff bones only.")


def animated(garment: bpy.types.Object, armature: bpy.types.Object) -> list[object]:
    """Return what a bake animates: the armature, and the garment's shape keys where it has any."""
    keys = garment.data.shape_keys
    return [armature, keys] if keys else [armature]


def apply_bake(
    garment: bpy.types.Object,
    armature: bpy.types.Object,
    joints: Joints,
    baked: BakedGarment,
    base: np.ndarray | None = None,
) -> None:
    """Put a bake in place of what was baked for a garment before. In object mode.

    Proxies that it lacks stay at rest and move nothing.

    Args:
        joints: of the armature, as `read_joints` returns them.
        base: where the garment lies on the first body of its model's family [m], shape (V, 3); None without a family.

    Raises:
        SetupError: garment or bones are not those that it was trained with.
    """
    order = joint_order(joints, baked.garment.joint_names, fewer_proxies=True)
    proxies = order[joints.character_count :] - joints.character_count
    there = proxies >= 0
    laid = None if base is None else lay(garment, armature, joints, baked.garment, order, base)
    if baked.pose.translations is not None or (laid and laid.moves_proxies):  # before anything changes
        need_movable(armature, [joints.proxies[index] for index in np.flatnonzero(there)])
    shapes = apply_deformation(garment, armature, joints, baked.garment, order, laid)
    put_keys(garment, armature, joints, proxies, shapes, baked.pose, round(baked.start), laid=laid)


def put_keys(
    garment: bpy.types.Object,
    armature: bpy.types.Object,
    joints: Joints,
    proxies: np.ndarray,
    shapes: Sequence[str],
    pose: GarmentPose,
    start: int,
    *,
    live: bool = False,
    laid: Laid | None = None,
) -> None:
    """Put poses of a garment as keys onto its proxies and shape keys.

    Args:
        proxies: where each proxy stands among those of the poses, -1 for none, shape (P,).
        shapes: the shape keys, as the poses weigh them.
        start: the first frame.
        live: whether they stand for live playback.
        laid: as for `proxy_places`.
    """
    there = proxies >= 0
    rotations = np.tile(rest_rotations(joints), (pose.frame_count, 1, 1))
    rotations[:, there] = pose.rotations[:, proxies[there]]
    turns = continuous(turns_from_rest(joints, rotations))
    channels = _channels(joints.proxies, "rotation_quaternion", turns)
    places = proxy_places(joints, rotations, pose, proxies, laid)
    if places is not None:
        channels += _channels(joints.proxies, "location", shifts_from_rest(armature, joints, places))
    moved = [(armature, channels), (garment.data.shape_keys, _weight_channels(shapes, pose.weights))]
    bake_keys(garment, start, [(thing, channels) for thing, channels in moved if thing], live=live)


def proxy_places(
    joints: Joints, rotations: np.ndarray, pose: GarmentPose, proxies: np.ndarray, laid: Laid | None
) -> np.ndarray | None:
    """Return where proxies are in their parents' axes [m], shape (F, P, 3); None where they only turn.

    Args:
        rotations: of each proxy to its parent, shape (F, P, 4).
        proxies: where each stands among those of the pose, -1 for none, shape (P,).
        laid: how a garment of a family is brought to its body.
    """
    if laid and laid.moves_proxies:
        return laid.places(rotations, pose, proxies)
    if pose.translations is None:
        return None
    places, there = np.tile(_rest_places(joints), (pose.frame_count, 1, 1)), proxies >= 0
    places[:, there] = pose.translations[:, proxies[there]]
    return places


def apply_deformation(
    garment: bpy.types.Object,
    armature: bpy.types.Object,
    joints: Joints,
    skinned: SkinnedGarment,
    order: np.ndarray,
    laid: Laid | None = None,
) -> list[str]:
    """Give a garment trained shapes and weights, its proxies at rest; return the shape keys that move it.

    In object mode.

    Args:
        order: where each joint stands among the trained ones, -1 for none, shape (J,).
        laid: how a garment of a family is brought to its body.

    Raises:
        SetupError: as `apply_bake` does.
    """
    if laid:
        back = moved_back(armature, joints.character, skinned, order[: joints.character_count])
    else:
        back = moved_back(armature, joints, skinned, order)
    to_trained = back @ scene_units().matrix @ np.array(garment.matrix_world)
    if not laid:
        _need_same_points(garment, to_trained, skinned)
    give_own_mesh(garment)
    mute_inherited(garment, animated(garment, armature))
    offsets, names = skinned.shapes @ np.linalg.inv(to_trained[:3, :3]).T, list(skinned.shape_names)
    if laid and laid.offsets is not None:
        offsets, names = np.concatenate([offsets, laid.offsets[None]]), [*names, LAID]
    shapes = write_shapes(garment, offsets, names)
    if len(shapes) > len(skinned.shape_names):
        garment.data.shape_keys.key_blocks[shapes.pop()].value = 1.0
    weights = np.where(order >= 0, skinned.skin.dense(len(skinned.joint_names))[:, order], 0)
    put_trained_weights(armature, garment, weights.astype(np.float32), joints.names)
    _free(armature, joints.proxies)
    put_away(armature, garment)
    return shapes


def turns_from_rest(joints: Joints, rotations: np.ndarray) -> np.ndarray:
    """Return the proxies' turns from their rest rotations, which is what pose bones hold, shape (F, P, 4).

    Args:
        rotations: of each proxy to its parent, unit quaternions (w, x, y, z), shape (F, P, 4).
    """
    return multiply_quaternions(rest_rotations(joints) * [1, -1, -1, -1], rotations)


def shifts_from_rest(armature: bpy.types.Object, joints: Joints, places: np.ndarray) -> np.ndarray:
    """Return how far the proxies are from rest, in their own axes at rest and units of the armature, as pose bones
    hold it, shape (F, P, 3).

    Args:
        places: of each proxy in its parent's axes [m], shape (F, P, 3).
    """
    own = matrix_from_quaternion(rest_rotations(joints)).swapaxes(-1, -2)
    unit = scene_units().meters_per_unit * armature.matrix_world.median_scale
    return (own @ (places - _rest_places(joints))[..., None])[..., 0] / unit


def rest_rotations(joints: Joints) -> np.ndarray:
    """Return the rotations of the proxies to their parents at rest, unit quaternions (w, x, y, z), shape (P, 4)."""
    local = local_transforms(joints.binds, joints.parents)[joints.character_count :]
    return quaternion_from_matrix(local[:, :3, :3])


def _rest_places(joints: Joints) -> np.ndarray:
    """Return the places of the proxies in their parents' axes at rest [m], shape (P, 3)."""
    return local_transforms(joints.binds, joints.parents)[joints.character_count :, :3, 3]


def remove_bake(garment: bpy.types.Object, armature: bpy.types.Object) -> None:
    """Remove what was baked for a garment, and give it its own weights back. In object mode."""
    remove_keys(garment, animated(garment, armature))
    if has_lent_mesh(garment):
        give_back_mesh(garment)
        mute_inherited(garment, [armature], muted=False)
    else:
        remove_shapes(garment)
        restore_own_weights(armature, garment)
    _free(armature, proxy_names(armature, garment))
    bring_back(armature, garment)


def _need_same_points(garment: bpy.types.Object, to_trained: np.ndarray, skinned: SkinnedGarment) -> None:
    """Check a garment's points at rest, given its own space to where it was trained [m].

    Shape keys that were added since the training correct what was baked.
    """
    need_same_count(garment, skinned)
    off = min(
        away(points @ to_trained[:3, :3].T + to_trained[:3, 3], skinned.points) for points in earlier_shapes(garment)
    )
    if not off <= MOVED * size(skinned):
        raise SetupError(
            f"'{garment.name}' has another shape or place at rest than when it was trained; undo that, or train "
            "again."
        )


def _free(armature: bpy.types.Object, proxies: Sequence[str]) -> None:
    """Put proxies without keys at rest, with quaternion rotation."""
    for name in proxies:
        bone = armature.pose.bones[name]
        bone.rotation_mode = "QUATERNION"
        bone.location, bone.scale, bone.rotation_quaternion = (0, 0, 0), (1, 1, 1), (1, 0, 0, 0)


def need_movable(armature: bpy.types.Object, names: Sequence[str]) -> None:
    """Check that Blender moves proxies by their own locations, as most networks and all solver's shots do.

    Raises:
        SetupError: one cannot move.
    """
    for name in names:
        bone = armature.data.bones[name]
        if bone.use_connect or not bone.use_local_location:
            raise SetupError(
                f"The proxy '{name}' cannot move by itself; switch off Connected and switch on Local Location."
            )


def _channels(names: Sequence[str], what: str, values: np.ndarray) -> list[Channel]:
    """Return the channels of a property of pose bones, shape (F, P, components)."""
    return [
        Channel(f'pose.bones["{bpy.utils.escape_identifier(name)}"].{what}', index, name, each)
        for name, rows in zip(names, values.swapaxes(0, 1))
        for index, each in enumerate(rows.T)
    ]


def _weight_channels(names: Sequence[str], weights: np.ndarray) -> list[Channel]:
    return [
        Channel(f'key_blocks["{bpy.utils.escape_identifier(name)}"].value', 0, "SSILK", values)
        for name, values in zip(names, weights.T)
    ]
