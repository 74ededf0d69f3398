# SPDX-License-Identifier: GPL-3.0-or-later
"""How good a garment is: heat maps, worst frames and the LBS copy."""

from __future__ import annotations

import bpy

from ..quality.heat import INTERSECTIONS, PENETRATION, PUSHED_OUT, SKIN, STRETCH
from ..quality.lbs_copy import find_copy
from ..quality.repairs import DISPLACEMENT
from .base import PlayableGarmentPanel, draw_text, saying_errors


def draw_kind(layout: bpy.types.UILayout, kind: str, text: str) -> None:
    """Draw the buttons of one kind of heat."""
    row = layout.row(align=True)
    row.operator("ssilk.show_heat", text=text, icon="SHADING_RENDERED").kind = kind
    row.operator("ssilk.find_worst", text="", icon="MARKER_HLT").kind = kind


class QualityPanel(PlayableGarmentPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_quality"
    bl_label = "Quality"
    section = "7-look"
    bl_options = {"DEFAULT_CLOSED"}

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        draw_kind(layout, PENETRATION, text="Show Penetration")
        draw_kind(layout, SKIN, text="Show Skin")
        draw_kind(layout, STRETCH, text="Show Stretch")
        draw_kind(layout, INTERSECTIONS, text="Show Intersections")
        if DISPLACEMENT in context.object.data.attributes:
            layout.operator("ssilk.show_heat", text="Show Pushed Out", icon="SHADING_RENDERED").kind = PUSHED_OUT
        if context.object.ssilk.heat_told:
            draw_text(layout, context.object.ssilk.heat_told, icon="INFO")
        row = layout.row(align=True)
        if context.object.ssilk.heat:
            row.operator("ssilk.hide_heat")
        row.operator("ssilk.clear_worst")
        shown = find_copy(context.object) is not None
        layout.operator("ssilk.toggle_lbs", depress=shown)
