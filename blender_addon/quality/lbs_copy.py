# SPDX-License-Identifier: GPL-3.0-or-later
"""A copy of a garment that linear blend skinning alone moves, shown beside it.

The copy hangs on the same armature; an empty shows it moved to the side, after bones have moved it.
"""

from __future__ import annotations

import bpy
import numpy as np
from ssilk_usd.shots.skinned import SkinnedGarment

from ..arrays.classes import COLOR_ATTRIBUTE
from ..playback.models import TrainedGarment, model_of
from ..scene.armature import read_joints
from ..scene.garment import armature_of
from ..scene.linked import local_copy, open_collection, own_copy
from ..scene.meshes import need_relative
from ..scene.shapes import worn_points
from ..scene.weights import write_groups
from .heat import ATTRIBUTE

OWNER = "ssilk_plain_of"  # custom property of the empty and the copy: the garment
GAP = 1.3  # distance in widths of the garment


def find_copy(garment: bpy.types.Object) -> bpy.types.Object | None:
    """Return the empty that shows a garment's LBS copy; None where there is none."""
    return next((thing for thing in bpy.data.objects if thing.type == "EMPTY" and thing.get(OWNER) == garment), None)


def show_copy(garment: bpy.types.Object) -> None:
    """Show a copy without proxies and shapes to the side. In object mode.

    Raises:
        SsilkError: there is no model, it cannot be read, or it is of other bones; shape keys are absolute.
    """
    need_relative(garment)
    armature = armature_of(garment)
    joints = read_joints(armature, garment)
    trained = TrainedGarment(model_of(garment), garment, armature, joints)
    laid = trained.lay(garment, armature, joints, SkinnedGarment.of(trained.player.deformer()))
    copy = _lbs_copy(garment, trained, laid.offsets if laid else None)
    collection = bpy.data.collections.new(f"{garment.name} LBS")
    collection.objects.link(copy)
    shown = bpy.data.objects.new(f"{garment.name} LBS, beside", None)
    shown[OWNER] = garment
    shown.instance_type, shown.instance_collection = "COLLECTION", collection
    shown.location.x = GAP * max(garment.dimensions.x, garment.dimensions.y)
    open_collection(garment).objects.link(shown)


def remove_copy(shown: bpy.types.Object) -> None:
    """Remove the copy and what shows it."""
    collection = shown.instance_collection
    for copy in list(collection.objects):
        bpy.data.meshes.remove(copy.data)
    bpy.data.collections.remove(collection)
    bpy.data.objects.remove(shown)


def _clear_colors(mesh: bpy.types.Mesh) -> None:
    """Remove the colours of heat, and of classes: beside a heat map they would be read as heat."""
    colors = mesh.color_attributes
    for name in (ATTRIBUTE, COLOR_ATTRIBUTE):
        if name in colors:
            colors.remove(colors[name])


def _clear_shapes(copy: bpy.types.Object) -> None:
    keys = copy.data.shape_keys
    if keys is None:
        return
    name, worn = keys.name, worn_points(copy)
    copy.shape_key_clear()
    copy.data.vertices.foreach_set("co", worn.reshape(-1))
    left = bpy.data.shape_keys.get(name)  # Blender frees them since 5.2; before, they stay unused in the file
    if left:
        bpy.data.batch_remove([left])


def _lbs_copy(garment: bpy.types.Object, trained: TrainedGarment, laid: np.ndarray | None) -> bpy.types.Object:
    copy = local_copy(garment)
    copy.data, copy.name = own_copy(garment.data), f"{garment.name} LBS"
    copy[OWNER] = garment
    copy.ssilk.live = False
    copy.ssilk.heat = ""  # the heat of the garment is not its own
    _clear_colors(copy.data)
    _clear_shapes(copy)
    copy.vertex_groups.clear()
    if laid is not None:
        copy.data.vertices.foreach_set("co", (worn_points(copy) + laid).astype(np.float32).reshape(-1))
    skin, names = trained.player.file.scene.lbs_skin, trained.joints.names
    write_groups(copy, skin.dense(len(names))[:, trained.order].astype(np.float32), names, ())
    return copy
