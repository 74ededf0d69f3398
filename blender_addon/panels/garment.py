# SPDX-License-Identifier: GPL-3.0-or-later
"""The garment: what it belongs to, and whether it can be worked on."""

from __future__ import annotations

import bpy

from ..errors import SetupError
from ..outside.jobs import read_state
from ..preferences import unready
from ..scene.garment import armature_of, garments_of, unusable
from ..scene.models import orphans
from .base import SidebarPanel, draw_text, draw_work, saying_errors


def draw_garments(layout: bpy.types.UILayout, shown: bpy.types.Object) -> None:
    """Draw the garments of the character, where there are several, to go from one to another."""
    try:
        garments = garments_of(armature_of(shown))
    except SetupError:
        return  # other panels say what is wrong
    if len(garments) < 2:
        return
    column = layout.column(align=True)
    for garment in garments:
        chosen = column.operator("ssilk.choose_garment", text=garment.name, icon="MATCLOTH", depress=garment == shown)
        chosen.garment = garment.name


def draw_orphans(layout: bpy.types.UILayout) -> None:
    """Draw the trainings that go on for garments which are not in the file, each to be cancelled."""
    for job in orphans():
        state = read_state(job.folder)
        row = layout.row(align=True)
        row.progress(factor=state.fraction if state else 0.0, text=job.garment)
        row.operator("ssilk.cancel_orphan", text="", icon="CANCEL").folder = str(job.folder)
        where = "" if job.file == bpy.path.basename(bpy.data.filepath) else f", which is in {job.file}"
        draw_text(layout, f"This training goes on without its garment '{job.garment}'{where}", icon="INFO")


class GarmentPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_garment"
    bl_label = "Garment"

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        layout, reason = self.layout, unusable(context.object)
        if reason:
            draw_text(layout, reason, icon="INFO")
            layout.operator("ssilk.import_stage", icon="IMPORT")
        else:
            layout.use_property_split = True
            layout.prop(context.object.ssilk, "armature")
            layout.prop(context.object.ssilk, "bodies")
            draw_garments(layout, context.object)
        missing = unready(context)
        if missing:
            draw_text(layout, missing, icon="ERROR")
            layout.operator("ssilk.find_python")
        draw_work(layout)
        draw_orphans(layout)
