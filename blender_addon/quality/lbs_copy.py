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
from ..scene.beside import clear_shapes, find_beside, remove_beside, show_beside
from ..scene.garment import armature_of
from ..scene.linked import local_copy, open_collection, own_copy
from ..scene.meshes import need_relative
from ..scene.shapes import worn_points
from ..scene.weights import write_groups
from .heat import ATTRIBUTE

OWNER = "ssilk_plain_of"  # custom property of the empty and the copy: the garment


def find_copy(garment: bpy.types.Object) -> bpy.types.Object | None:
    """Return the empty that shows a garment's LBS copy; None where there is none."""
    return find_beside(garment, OWNER)


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
    show_beside(
        garment, [copy], OWNER, name=f"{garment.name} LBS", empty=f"{garment.name} LBS, beside",
        width=max(garment.dimensions.x, garment.dimensions.y), into=open_collection(garment),
    )  # fmt: skip


def remove_copy(shown: bpy.types.Object) -> None:
    """Remove the copy and what shows it."""
    remove_beside(shown)


def clear_colors(mesh: bpy.types.Mesh) -> None:
    """Remove the colours of heat, and of classes: beside a heat map they would be read as heat."""
    colors = mesh.color_attributes
    for name in (ATTRIBUTE, COLOR_ATTRIBUTE):
        if name in colors:
            colors.remove(colors[name])


def _clear_shapes(copy: bpy.types.Object) -> None:
    if copy.data.shape_keys:
        worn = worn_points(copy)
        clear_shapes(copy)
        copy.data.vertices.foreach_set("co", worn.reshape(-1))


def _lbs_copy(garment: bpy.types.Object, trained: TrainedGarment, laid: np.ndarray | None) -> bpy.types.Object:
    copy = local_copy(garment)
    copy.data, copy.name = own_copy(garment.data), f"{garment.name} LBS"
    copy[OWNER] = garment
    copy.ssilk.live = False
    copy.ssilk.heat = ""  # the heat of the garment is not its own
    clear_colors(copy.data)
    _clear_shapes(copy)
    copy.vertex_groups.clear()
    if laid is not None:
        copy.data.vertices.foreach_set("co", (worn_points(copy) + laid).astype(np.float32).reshape(-1))
    skin, names = trained.player.file.scene.lbs_skin, trained.joints.names
    write_groups(copy, skin.dense(len(names))[:, trained.order].astype(np.float32), names, ())
    return copy
