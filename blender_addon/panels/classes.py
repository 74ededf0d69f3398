# SPDX-License-Identifier: GPL-3.0-or-later
"""Vertex classes: how many there are, and what paints them."""

from __future__ import annotations

import bpy

from ..classes import counts
from ..errors import SetupError
from ..operators.classes import CHOICES
from ..overlay import shown
from ..scene.attributes import current_classes
from ..scene.garment import unusable
from .base import SidebarPanel, draw_text, saying_errors


def class_counts(thing: bpy.types.Object) -> tuple[int, int, int] | None:
    """Return how many vertices are pinned, tight and loose; None without classes.

    Raises:
        SetupError: what is stored are no classes.
    """
    values = current_classes(thing.data)
    return None if values is None else counts(values)


class ClassesPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_classes"
    bl_label = "Classes"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return not unusable(context.object)

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        layout, found = self.layout, None
        try:
            found = class_counts(context.object)
        except SetupError as error:
            draw_text(layout, str(error), icon="ERROR")
        settings = context.object.ssilk
        layout.operator("ssilk.classify")
        layout.prop(settings, "tightness", slider=True)
        layout.prop_search(settings, "pins", context.object, "vertex_groups")
        layout.operator("ssilk.paint_classes", icon="BRUSH_DATA")
        editing = context.mode == "EDIT_MESH"
        row = layout.row(align=True)
        for index, (name, label, _) in enumerate(CHOICES):
            column = row.column(align=True)
            column.operator("ssilk.fill_class" if editing else "ssilk.brush_class", text=label).value = name
            column.label(text=str(found[index]) if found else "-")
        layout.operator("ssilk.take_up_painting")
        layout.operator("ssilk.toggle_overlay", icon="OVERLAY", depress=shown())
        row = layout.row(align=True)
        row.operator("ssilk.show_classes")
        row.operator("ssilk.mirror_classes")
