# SPDX-License-Identifier: GPL-3.0-or-later
"""Garments that were rigged outside, as Blender's USD importer makes them: their proxies become proxies here too.

The importer brings bones, weights and classes, but not which bones are proxies, nor the weights beside the rig.
"""

from __future__ import annotations

import re

import bpy

from ..contract.arrays import Staged
from ..errors import need
from .armature import MADE, made_collection, proxy_names
from .garment import armature_of
from .handmade import remember_bones, remember_weights
from .proxies import PALETTE
from .weights import PLAIN, keep_weights, read_groups, read_kept


def adopt(staged: Staged) -> bpy.types.Object:
    """Mark the proxies of an imported garment, and keep the weights beside its rig; return the garment.

    Raises:
        SetupError: it was not imported, or its bones are not there.
    """
    garment = _imported(staged)
    armature = armature_of(garment)
    lost = [name for name in staged.proxies if name not in armature.data.bones]
    need(
        not lost, f"'{armature.name}' has no bone '{lost[0] if lost else ''}' of '{garment.name}'; import them again."
    )
    for name in staged.proxies:
        bone = armature.data.bones[name]
        made_collection(armature.data, garment).assign(bone)
        bone.color.palette = PALETTE
    _remember(armature, garment)
    if staged.plain is not None and read_kept(garment.data, PLAIN, staged.plain_joints) is None:
        keep_weights(garment.data, PLAIN, staged.plain, staged.plain_joints)
    return garment


def _imported(staged: Staged) -> bpy.types.Object:
    """Return the object that was made of a prim; the active one among several."""
    fitting = [thing for thing in bpy.context.scene.objects if _fits(thing, staged)]
    need(fitting, f"No mesh of this scene is '{staged.name}' of that file, with its vertices; import it first.")
    active = bpy.context.view_layer.objects.active
    return active if active in fitting else fitting[-1]


def _fits(thing: bpy.types.Object, staged: Staged) -> bool:
    named = re.sub(r"\.\d{3,}$", "", thing.name) == staged.name
    return named and thing.type == "MESH" and (staged.plain is None or len(thing.data.vertices) == len(staged.plain))


def _remember(armature: bpy.types.Object, garment: bpy.types.Object) -> None:
    """Take proxies and weights as they are for generated, so that edits are known from now on."""
    bones = [armature.data.bones[name] for name in proxy_names(armature, garment)]
    records = {}
    for bone in bones:
        bone[MADE] = bone.name
        matrix = [value for row in bone.matrix_local for value in row]
        records[bone.name] = {"matrix": matrix, "parent": bone.parent.name if bone.parent else ""}
    remember_bones(armature, garment, records)
    names = [group.name for group in garment.vertex_groups]
    remember_weights(armature, garment, read_groups(garment, garment.data, names), names)
