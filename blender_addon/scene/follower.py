# SPDX-License-Identifier: GPL-3.0-or-later
"""An armature of a garment's own, for characters that are linked or overridden and so cannot take proxies.

Its bones are copies of the character's that follow them by constraints; what is linked stays untouched.
"""

from __future__ import annotations

import bpy

from .armature import editing

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
    garment.users_collection[0].objects.link(follower)
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
