# SPDX-License-Identifier: GPL-3.0-or-later
"""Baking: the model, and putting it on the timeline."""

from __future__ import annotations

import bpy

from ..scene.garment import unusable
from ..scene.progress import no_model
from .base import SidebarPanel, draw_text, saying_errors


def model_line(garment: bpy.types.Object) -> str:
    """Return which model is baked, or why there is none."""
    own = "Bakes the chosen model" if garment.ssilk.model else "Bakes the best model of its training"
    return no_model(garment) or own


class BakingPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_baking"
    bl_label = "Baking"
    section = "6-bake"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return not unusable(context.object)

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.prop(context.object.ssilk, "model")
        draw_text(layout, model_line(context.object))
        layout.operator("ssilk.bake", icon="REC")
        layout.operator("ssilk.to_bones", icon="BONE_DATA")
        layout.operator("ssilk.export_gltf", icon="EXPORT")
        layout.operator("ssilk.remove_bake", icon="TRASH")
        layout.operator("ssilk.hide_covered", icon="HIDE_ON")
        layout.operator("ssilk.show_covered", icon="HIDE_OFF")
