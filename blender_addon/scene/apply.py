# SPDX-License-Identifier: GPL-3.0-or-later
"""A rig from outside becomes bones, vertex groups and classes."""

from __future__ import annotations

import bpy

from ..contract.arrays import Joints, Rig
from ..errors import need
from .armature import need_editable, proxy_names, replace_proxies
from .attributes import write_classes
from .gather import own_weights
from .weights import keep_plain, read_plain, write_groups


def apply_classes(garment: bpy.types.Object, rig: Rig) -> None:
    """Give a garment the classes of a rig.

    Raises:
        SetupError: it was edited meanwhile.
    """
    _need_same(garment, rig)
    write_classes(garment.data, rig.classes)


def apply_rig(garment: bpy.types.Object, armature: bpy.types.Object, joints: Joints, rig: Rig) -> None:
    """Give a garment the proxies, weights and classes of a rig. In object mode.

    Args:
        joints: the character's joints that the rig was made for.

    Raises:
        SetupError: the garment or the armature was edited meanwhile, or the armature cannot be edited.
    """
    _need_same(garment, rig)
    need_editable(armature)
    lost = [name for name in joints.names if name not in armature.data.bones]
    need(not lost, f"'{armature.name}' lost {lost[:1]} while the rig was made; make it again.")
    old, names = proxy_names(armature, garment), joints.names
    if not old and read_plain(garment.data, names) is None:
        own = own_weights(garment, joints)
        if own is not None:
            keep_plain(garment.data, own, names)
    proxies = replace_proxies(armature, garment, joints, rig)
    write_groups(garment, rig.weights, [*names, *proxies], old)
    write_classes(garment.data, rig.classes)
    _bind(garment, armature)


def _need_same(garment: bpy.types.Object, rig: Rig) -> None:
    count = len(garment.data.vertices)
    need(
        count == len(rig.classes),
        f"'{garment.name}' had {len(rig.classes)} vertices when this began and has {count} now; start it again.",
    )


def _bind(garment: bpy.types.Object, armature: bpy.types.Object) -> None:
    """Give a garment an Armature modifier, the first one, unless it has one for this armature."""
    if any(modifier.type == "ARMATURE" and modifier.object == armature for modifier in garment.modifiers):
        return
    modifier = garment.modifiers.new("Armature", "ARMATURE")
    modifier.object = armature
    garment.modifiers.move(len(garment.modifiers) - 1, 0)
