# SPDX-License-Identifier: GPL-3.0-or-later
"""Telling which bones of today are those of a garment's training, where their names and places do not say it."""

from __future__ import annotations

import bpy

from ssilk_core.network.checkpoint import load_model

from ..arrays.renamed import TrainedJoints, known_as, lost, renames
from ..playback.models import chosen_bones, model_of, no_model
from ..scene.armature import read_joints
from ..scene.garment import armature_of, unplayable_here
from .reporting import ReportingOperator


class MatchBones(ReportingOperator, bpy.types.Operator):
    """Find bones that were renamed since the training, and list those that only you can tell"""

    bl_idname = "ssilk.match_bones"
    bl_label = "Match Bones"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        return unplayable_here(context) or no_model(context.object)

    def apply(self, context: bpy.types.Context) -> str:
        garment = context.object
        scene = load_model(model_of(garment)).scene
        trained = TrainedJoints(scene.joint_names, scene.bind_transforms)
        joints, chosen = read_joints(armature_of(garment), garment), chosen_bones(garment)
        joints = known_as(joints, trained, chosen)
        open_ones = lost(joints, trained)
        garment.ssilk.bones.clear()
        for name, bone in (*((name, bone) for bone, name in chosen.items()), *((name, "") for name in open_ones)):
            if name not in garment.ssilk.bones:
                item = garment.ssilk.bones.add()
                item.name, item.bone = name, bone
        found = len(renames(joints))
        told = f"{found} renamed bone{'' if found == 1 else 's'} of '{garment.name}' found"
        if open_ones:
            more = "" if len(open_ones) == 1 else f" and {len(open_ones) - 1} more are"
            return f"{told}; choose in the Baking panel what '{open_ones[0]}'{more or ' is'} called now."
        return f"{told}; none is left to choose."


CLASSES = (MatchBones,)
