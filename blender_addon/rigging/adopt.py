# SPDX-License-Identifier: GPL-3.0-or-later
"""Garments that were rigged outside, as Blender's USD importer makes them: their proxies become proxies here too.

The importer brings bones, weights and classes, but not which bones are proxies, nor the weights beside the rig.
"""

from __future__ import annotations

import re

import bpy
import numpy as np

from ssilk_core.scene.assets import Garment, ProxyRig, Skeleton

from ..errors import SetupError
from ..scene.armature import MADE, made_collection, proxy_names
from ..scene.garment import armature_of
from ..scene.weights import PLAIN, keep_weights, read_groups, read_kept
from .edit_tracking import moving_groups, remember_bones, remember_weights
from .proxies import PALETTE


def adopt(skeleton: Skeleton, staged: Garment, rig: ProxyRig) -> bpy.types.Object:
    """Mark the proxies of an imported garment, and keep the weights beside its rig; return the garment.

    Raises:
        SetupError: it was not imported, or its bones are not there.
    """
    garment = _imported(staged)
    armature = armature_of(garment)
    proxies, joints = ([path.rpartition("/")[2] for path in of.joint_names] for of in (rig, skeleton))
    lost = [name for name in proxies if name not in armature.data.bones]
    if lost:
        raise SetupError(f"'{armature.name}' has no bone '{lost[0]}' of '{garment.name}'; import them again.")
    for name in proxies:
        bone = armature.data.bones[name]
        made_collection(armature.data, garment).assign(bone)
        bone.color.palette = PALETTE
    _remember(armature, garment)
    if staged.skin is not None and read_kept(garment.data, PLAIN, joints) is None:
        keep_weights(garment.data, PLAIN, staged.skin.dense(len(joints)).astype(np.float32), joints)
    return garment


def _imported(staged: Garment) -> bpy.types.Object:
    """Return the object that was made of a prim; the active one among several."""
    prim = staged.mesh.path.rpartition("/")[2]
    fitting = [
        thing
        for thing in bpy.context.scene.objects
        if thing.type == "MESH"
        and re.sub(r"\.\d{3,}$", "", thing.name) == prim
        and len(thing.data.vertices) == staged.mesh.vertex_count
    ]
    if not fitting:
        raise SetupError(f"No mesh of this scene is '{prim}' of that file, with its vertices; import it first.")
    active = bpy.context.view_layer.objects.active
    return active if active in fitting else fitting[-1]


def _remember(armature: bpy.types.Object, garment: bpy.types.Object) -> None:
    """Take proxies and weights as they are for generated, so that edits are known from now on."""
    bones = [armature.data.bones[name] for name in proxy_names(armature, garment)]
    records = {}
    for bone in bones:
        bone[MADE] = bone.name
        matrix = [value for row in bone.matrix_local for value in row]
        records[bone.name] = {"matrix": matrix, "parent": bone.parent.name if bone.parent else ""}
    remember_bones(armature, garment, records)
    names = moving_groups(armature, garment)
    remember_weights(armature, garment, read_groups(garment, garment.data, names), names)
