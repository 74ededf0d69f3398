# SPDX-License-Identifier: GPL-3.0-or-later
"""Bones as joints, proxies as bones in a collection of their own, and armatures that follow a linked one.

The collection names its garment by a custom property, so that both may be renamed. A bone is a proxy of the garment
if it is in the collection or descends from one that is; artists add, move, reparent and delete them like any other.
A linked or overridden character cannot take proxies. Its garment gets an armature of its own, whose bones are copies
of the character's and follow them by constraints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import bpy
import numpy as np
from mathutils import Matrix

from ..arrays.joints import Joints
from ..errors import SetupError
from .linked import is_owner, open_collection
from .objects import scene_units

OWNER = "ssilk_garment"  # custom property of a bone collection: the garment object
MADE = "ssilk_made"  # custom property of a generated bone: its key; of the collection: the proxies by key
AWAY = "ssilk_away"  # custom property of the collection: whether its proxies were put away since they were made
UNEQUAL = 1e-3  # relative difference of scales that still counts as uniform


def read_joints(armature: bpy.types.Object, garment: bpy.types.Object) -> Joints:
    """Return the deforming bones at rest: the character's, then the garment's proxies; other garments' are left out.

    Raises:
        SetupError: no bone deforms, or the armature is scaled unequally or mirrored.
    """
    owners = owners_of(armature.data)
    bones = [bone for bone in armature.data.bones if bone.use_deform]  # Blender keeps parents before children
    own = [bone for bone in bones if bone.name not in owners]
    proxies = [bone for bone in bones if is_owner(owners.get(bone.name), garment)]
    if not own:
        raise SetupError(
            f"No bone of '{armature.name}' deforms; switch on Deform for the bones that move the character."
        )
    ordered = [*own, *proxies]
    index = {bone.name: joint for joint, bone in enumerate(ordered)}
    return Joints(
        names=tuple(index),
        parents=np.array([_parent(bone, index) for bone in ordered], dtype=np.int64),
        binds=scene_units().transforms_to_core(
            _orthonormal([_rigid(armature) @ bone.matrix_local @ _shrunk(armature) for bone in ordered])
        ),
        proxy_count=len(proxies),
    )


def proxy_names(armature: bpy.types.Object, garment: bpy.types.Object) -> list[str]:
    """Return the names of a garment's proxies."""
    return [name for name, owner in owners_of(armature.data).items() if is_owner(owner, garment)]


def keys_of(armature: bpy.types.Object, names: Sequence[str]) -> list[str]:
    """Return the keys of bones, which generated ones carry along when they are renamed; else their names."""
    bones = armature.data.bones
    return [bones[name].get(MADE, name) if name in bones else name for name in names]


def need_editable(armature: bpy.types.Object) -> None:
    """Check that bones can be added.

    Raises:
        SetupError: the armature cannot be reached in this view layer.
    """
    visible = armature.name in bpy.context.view_layer.objects and armature.visible_get()
    if not visible:
        raise SetupError(
            f"'{armature.name}' is hidden or excluded from the view layer; show it, so that it can be edited."
        )


def owners_of(armature: bpy.types.Armature) -> dict[str, object]:
    """Return the garment of each proxy by the bone's name, parents first; None where the garment is gone."""
    listed = {
        bone.name: collection.get(OWNER)
        for collection in armature.collections_all
        if OWNER in collection.keys()  # noqa: SIM118 (no dictionary)
        for bone in collection.bones
    }
    owners: dict[str, object] = {}
    for bone in armature.bones:
        if bone.name in listed:
            owners[bone.name] = listed[bone.name]
        elif bone.parent and bone.parent.name in owners:
            owners[bone.name] = owners[bone.parent.name]
    return owners


def collection_of(armature: bpy.types.Armature, garment: bpy.types.Object) -> bpy.types.BoneCollection | None:
    """Return the bone collection of a garment's proxies; None where it has none."""
    return next((group for group in armature.collections_all if is_owner(group.get(OWNER), garment)), None)


def made_collection(armature: bpy.types.Armature, garment: bpy.types.Object) -> bpy.types.BoneCollection:
    """Return the bone collection of a garment's proxies, made if there is none."""
    collection = collection_of(armature, garment)
    if collection is None:
        collection = armature.collections.new(f"{garment.name} proxies")
        collection[OWNER] = garment
    return collection


def put_away(armature: bpy.types.Object, garment: bpy.types.Object) -> None:
    """Hide and lock the proxies of a garment once, so that *Select All* and *Insert Keys* pass them by.

    Whoever shows their bone collection again wants them, and they stay. Collections of a linked armature cannot be
    changed here, only the bones of what overrides it: since Blender 5 these are hidden one by one.
    """
    if armature.data.library:
        _hide(armature, garment, True)
        _lock(armature, garment, True)
        return
    collection = collection_of(armature.data, garment)
    if collection is None or AWAY in collection.keys():  # noqa: SIM118 (no dictionary)
        return
    collection[AWAY], collection.is_visible = True, False
    _lock(armature, garment, True)


def bring_back(armature: bpy.types.Object, garment: bpy.types.Object) -> None:
    """Show and unlock the proxies of a garment."""
    if armature.data.library:
        _hide(armature, garment, False)
        _lock(armature, garment, False)
        return
    collection = collection_of(armature.data, garment)
    if collection is None or AWAY not in collection.keys():  # noqa: SIM118 (no dictionary)
        return
    del collection[AWAY]
    collection.is_visible = True
    _lock(armature, garment, False)


def _hide(armature: bpy.types.Object, garment: bpy.types.Object, hidden: bool) -> None:
    for name in proxy_names(armature, garment):
        bone = armature.pose.bones[name]
        if "hide" in bone.bl_rna.properties:
            bone.hide = hidden


def _lock(armature: bpy.types.Object, garment: bpy.types.Object, locked: bool) -> None:
    for name in proxy_names(armature, garment):
        bone = armature.pose.bones[name]
        bone.lock_location = bone.lock_rotation = bone.lock_scale = (locked,) * 3
        bone.lock_rotation_w = locked
        if locked:
            (bone if "select" in bone.bl_rna.properties else bone.bone).select = False


def _parent(bone: bpy.types.Bone, index: dict[str, int]) -> int:
    """Return the joint that is a bone's nearest ancestor; -1 without."""
    return next((index[above.name] for above in bone.parent_recursive if above.name in index), -1)


def is_evenly_scaled(armature: bpy.types.Object) -> bool:
    """Return whether an armature is scaled alike in all directions, and not mirrored."""
    scale = armature.matrix_world.to_scale()
    return max(scale) - min(scale) <= UNEQUAL * abs(max(scale)) and armature.matrix_world.determinant() > 0


def _orthonormal(transforms: list[Matrix]) -> np.ndarray:
    """Return nearly rigid transforms, shape (J, 4, 4), with the rotations that are nearest to their axes.

    Blender's axes are orthonormal to 1e-5 only. Far from a bone that is more than vertices may be off.
    """
    rigid = np.array(transforms, dtype=np.float64)
    left, _, right = np.linalg.svd(rigid[:, :3, :3])
    rigid[:, :3, :3] = left @ right
    return rigid


def _rigid(armature: bpy.types.Object) -> Matrix:
    """Return the armature's placement; its scale must be uniform."""
    if not is_evenly_scaled(armature):
        raise SetupError(f"'{armature.name}' is scaled unequally or mirrored; apply its scale (Ctrl A).")
    return armature.matrix_world


def _shrunk(armature: bpy.types.Object) -> Matrix:
    return Matrix.Scale(1 / armature.matrix_world.median_scale, 4)


@contextmanager
def editing(armature: bpy.types.Object) -> Iterator[None]:
    """Switch from object mode to edit mode of an armature, and restore mode and active object afterwards."""
    layer = bpy.context.view_layer
    before, selected = layer.objects.active, armature.select_get()
    layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        yield
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")
        armature.select_set(selected)
        layer.objects.active = before


LEADER = "ssilk_follows"  # custom property of such an armature: the character's


def leader_of(armature: bpy.types.Object) -> bpy.types.Object:
    """Return the armature that an armature follows, itself where it follows none."""
    return armature.get(LEADER) or armature


def is_linked(armature: bpy.types.Object) -> bool:
    """Return whether an armature comes from another file, overridden or not."""
    return bool(
        armature.library or armature.data.library or armature.override_library or armature.data.override_library
    )


def make_follower(garment: bpy.types.Object, leader: bpy.types.Object) -> bpy.types.Object:
    """Give a garment an armature of its own that follows a linked one. In object mode."""
    follower = bpy.data.objects.new(f"{garment.name} rig", bpy.data.armatures.new(f"{garment.name} rig"))
    open_collection(garment).objects.link(follower)
    follower.parent = leader  # the same place and scale, also where the character's object is animated
    follower[LEADER] = leader
    bpy.context.view_layer.update()
    _copy_bones(follower, leader)
    for bone in follower.pose.bones:
        _follow(bone, leader)
    for modifier in garment.modifiers:
        if modifier.type == "ARMATURE" and modifier.object == leader:
            modifier.object = follower
    garment.ssilk.armature = follower
    return follower


def _copy_bones(follower: bpy.types.Object, leader: bpy.types.Object) -> None:
    with editing(follower):
        bones = follower.data.edit_bones
        for source in leader.data.bones:
            bone = bones.new(source.name)
            bone.tail = (0.0, source.length, 0.0)  # a bone without length takes no matrix
            bone.matrix, bone.length = source.matrix_local, source.length
            bone.use_deform = source.use_deform
            bone.parent = bones[source.parent.name] if source.parent else None


def _follow(bone: bpy.types.PoseBone, leader: bpy.types.Object) -> None:
    constraint = bone.constraints.new("COPY_TRANSFORMS")
    constraint.target, constraint.subtarget = leader, bone.name
    constraint.owner_space = constraint.target_space = "POSE"
