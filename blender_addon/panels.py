# SPDX-License-Identifier: GPL-3.0-or-later
"""What is drawn in the sidebar of 3D views; what it says is found elsewhere."""

from __future__ import annotations

import bpy

from .classes import counts
from .errors import SetupError
from .operators import tasks
from .operators.classes import CHOICES
from .preferences import unready
from .scene.armature import proxy_names
from .scene.attributes import current_classes
from .scene.editing import edited_counts
from .scene.garment import armature_of, unusable


def class_counts(thing: bpy.types.Object) -> tuple[int, int, int] | None:
    """Return how many vertices are pinned, tight and loose, in any mode; None without classes.

    Raises:
        SetupError: what is stored are no classes.
    """
    if thing.mode == "EDIT":
        return edited_counts(thing.data)
    values = current_classes(thing.data)
    return None if values is None else counts(values)


def rig_line(garment: bpy.types.Object) -> str:
    """Return one line about a garment's proxies, or why it can have none."""
    try:
        armature = armature_of(garment)
    except SetupError as error:
        return str(error)
    count = len(proxy_names(armature, garment))
    return f"{count} proxies on '{armature.name}'" if count else f"No proxies yet on '{armature.name}'"


def draw_work(layout: bpy.types.UILayout) -> None:
    """Draw what runs outside, with a button that stops it."""
    work = tasks.current
    if work is None:
        return
    row = layout.row(align=True)
    row.progress(factor=work.fraction or 0.0, text=work.title)
    row.operator("ssilk.cancel", text="", icon="CANCEL")
    if work.text:
        layout.label(text=work.text)


class Panel:
    """Base of all panels."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "SSILK"


class GarmentPanel(Panel, bpy.types.Panel):
    bl_idname = "SSILK_PT_garment"
    bl_label = "Garment"

    def draw(self, context: bpy.types.Context) -> None:
        layout, reason = self.layout, unusable(context.object)
        if reason:
            layout.label(text=reason, icon="INFO")
        else:
            layout.use_property_split = True
            layout.prop(context.object.ssilk, "armature")
            layout.prop(context.object.ssilk, "bodies")
        missing = unready(context)
        if missing:
            layout.label(text=missing, icon="ERROR")
            layout.operator("ssilk.find_python")
        draw_work(layout)


class ClassesPanel(Panel, bpy.types.Panel):
    bl_idname = "SSILK_PT_classes"
    bl_label = "Classes"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return not unusable(context.object)

    def draw(self, context: bpy.types.Context) -> None:
        layout, found = self.layout, None
        try:
            found = class_counts(context.object)
        except SetupError as error:
            layout.label(text=str(error), icon="ERROR")
        layout.operator("ssilk.classify")
        layout.operator("ssilk.paint_classes", icon="BRUSH_DATA")
        editing = context.mode == "EDIT_MESH"
        row = layout.row(align=True)
        for index, (name, label, _) in enumerate(CHOICES):
            column = row.column(align=True)
            column.operator("ssilk.fill_class" if editing else "ssilk.brush_class", text=label).value = name
            column.label(text=str(found[index]) if found else "-")
        layout.operator("ssilk.take_up_painting")
        row = layout.row(align=True)
        row.operator("ssilk.show_classes")
        row.operator("ssilk.mirror_classes")


class RigPanel(Panel, bpy.types.Panel):
    bl_idname = "SSILK_PT_rig"
    bl_label = "Proxy Rig"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return not unusable(context.object)

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.label(text=rig_line(context.object))
        self.layout.operator("ssilk.generate_rig", icon="BONE_DATA")


CLASSES = (GarmentPanel, ClassesPanel, RigPanel)
