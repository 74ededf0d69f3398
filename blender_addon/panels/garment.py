# SPDX-License-Identifier: GPL-3.0-or-later
"""The garment: what it belongs to, and whether it can be worked on."""

from __future__ import annotations

import bpy

from ..preferences import unready
from ..scene.garment import unusable
from .base import Panel, draw_text, draw_work


class GarmentPanel(Panel, bpy.types.Panel):
    bl_idname = "SSILK_PT_garment"
    bl_label = "Garment"

    def draw(self, context: bpy.types.Context) -> None:
        layout, reason = self.layout, unusable(context.object)
        if reason:
            draw_text(layout, reason, icon="INFO")
            layout.operator("ssilk.import_stage", icon="IMPORT")
        else:
            layout.use_property_split = True
            layout.prop(context.object.ssilk, "armature")
            layout.prop(context.object.ssilk, "bodies")
        missing = unready(context)
        if missing:
            draw_text(layout, missing, icon="ERROR")
            layout.operator("ssilk.find_python")
        draw_work(layout)
