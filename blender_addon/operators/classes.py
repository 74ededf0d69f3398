# SPDX-License-Identifier: GPL-3.0-or-later
"""Painting vertex classes, filling a selection with one, and showing them over the garment."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty, FloatProperty

from ssilk_core.scene.assets import CLASS_NAMES

from ..arrays import classes as palette
from ..errors import SetupError
from ..scene import classes as stored
from ..scene import overlay
from ..scene.classes import choose_color, fill_selected, offer_palette
from ..scene.garment import unusable
from ..scene.meshes import partners_across
from .reporting import RefusingOperator, ReportingOperator
from .tasks import redraw

ABOUT = {
    "pinned": "Rigidly follows the skeleton, black: belts, collars, what is sewn on",
    "tight": "Follows the body closely, red",
    "loose": "Moves freely, green: moved by proxy joints and the network",
}
CHOICES = [(name.upper(), name.capitalize(), ABOUT[name]) for name in CLASS_NAMES]  # in the order of their numbers
VALUES = {name: value for value, (name, *_) in enumerate(CHOICES)}


class ClassOperator(ReportingOperator):
    """Base of operators on the garment's classes, outside edit mode."""

    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        there = context.mode in {"OBJECT", "PAINT_VERTEX"}
        return unusable(context.object) or ("" if there else "Go to Object Mode or Vertex Paint")


class PaintClasses(ClassOperator, bpy.types.Operator):
    """Paint vertex classes with Blender's vertex-paint brushes: pinned black, tight red, loose green"""

    bl_idname = "ssilk.paint_classes"
    bl_label = "Paint Classes"

    def apply(self, context: bpy.types.Context) -> str:
        mesh = context.object.data
        stored.take_up_painting(mesh)
        stored.show_classes(mesh)
        if context.mode != "PAINT_VERTEX":
            bpy.ops.object.mode_set(mode="VERTEX_PAINT")
        offer_palette(context)
        return ""


class ClassifiedOperator(ClassOperator):
    """Base of operators on classes that are there already."""

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := super().refusal(context):
            return reason
        there = {palette.ATTRIBUTE, palette.COLOR_ATTRIBUTE} & set(context.object.data.attributes.keys())
        return "" if there else f"'{context.object.name}' has no classes; classify or paint it first"


class TakeUpPainting(ClassOperator, bpy.types.Operator):
    """Turn painted colours into classes, each into the nearest one, and make the colours pure again"""

    bl_idname = "ssilk.take_up_painting"
    bl_label = "Take Up Painting"

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := super().refusal(context):
            return reason
        painted = palette.COLOR_ATTRIBUTE in context.object.data.attributes
        return "" if painted else f"'{context.object.name}' has no painted classes; choose Paint Classes first"

    def apply(self, context: bpy.types.Context) -> str:
        thing = context.object
        return f"{stored.take_up_painting(thing.data)} vertices of '{thing.name}' changed class."


class ShowClasses(ClassifiedOperator, bpy.types.Operator):
    """Show classes as colours, made again from the stored ones; in Solid shading, in this view"""

    bl_idname = "ssilk.show_classes"
    bl_label = "Show Classes"

    def apply(self, context: bpy.types.Context) -> str:
        stored.show_classes(context.object.data)
        if context.space_data and context.space_data.type == "VIEW_3D":
            context.space_data.shading.color_type = "VERTEX"
        return ""


class BrushClass(ReportingOperator, bpy.types.Operator):
    """Paint this class from now on"""

    bl_idname = "ssilk.brush_class"
    bl_label = "Paint This Class"

    value: EnumProperty(name="Class", items=CHOICES)

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if context.mode != "PAINT_VERTEX":
            return "Choose Paint Classes first"
        return "" if context.tool_settings.vertex_paint.brush else "Choose a brush first"

    def apply(self, context: bpy.types.Context) -> str:
        choose_color(context, palette.COLORS[VALUES[self.value]])
        return ""


class MirrorClasses(ClassifiedOperator, bpy.types.Operator):
    """Give one side the classes of the other, by the places of vertices along the garment's own x axis"""

    bl_idname = "ssilk.mirror_classes"
    bl_label = "Mirror Classes"

    source: EnumProperty(
        name="From",
        items=[("LEFT", "Left (+x)", "From the character's left"), ("RIGHT", "Right (-x)", "From its right")],
    )
    distance: FloatProperty(
        name="Tolerance",
        description="How far from the mirrored place a vertex may lie",
        default=0.01,
        min=0.0,
        subtype="DISTANCE",
    )

    def apply(self, context: bpy.types.Context) -> str:
        thing = context.object
        values = stored.current_classes(thing.data)
        if values is None:
            raise SetupError(f"'{thing.name}' has no classes; paint it first.")
        points, partners = partners_across(thing.data, self.distance)
        mirrored = palette.mirrored(values, points, partners, from_left=self.source == "LEFT")
        stored.write_classes(thing.data, mirrored)
        alone = int((partners < 0).sum())
        told = f"; {alone} have none across and stay as they are" if alone else ""
        return f"{int((mirrored != values).sum())} vertices of '{thing.name}' changed class{told}."


class FillClass(ReportingOperator, bpy.types.Operator):
    """Give the selected vertices this class"""

    bl_idname = "ssilk.fill_class"
    bl_label = "Fill Selection"
    bl_options = {"REGISTER", "UNDO"}

    value: EnumProperty(name="Class", items=CHOICES)

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        return unusable(context.object) or ("" if context.mode == "EDIT_MESH" else "Select vertices in Edit Mode")

    def apply(self, context: bpy.types.Context) -> str:
        thing = context.object
        filled = fill_selected(thing.data, VALUES[self.value])
        if not filled:
            raise SetupError(f"No vertex of '{thing.name}' is selected.")
        return f"{filled} vertices of '{thing.name}' are {self.value.lower()}."


class ToggleOverlay(RefusingOperator, bpy.types.Operator):
    """Show the classes of all garments over them in 3D views, in any mode; the file is not touched"""

    bl_idname = "ssilk.toggle_overlay"
    bl_label = "Class Overlay"

    @classmethod
    def refusal(cls, _: bpy.types.Context) -> str:
        return "There is no window to draw in" if bpy.app.background else ""

    def execute(self, context: bpy.types.Context) -> set[str]:
        if overlay.shown():
            overlay.hide()
        else:
            overlay.show()
        redraw(context, views=True)
        return {"FINISHED"}


CLASSES = (PaintClasses, TakeUpPainting, ShowClasses, BrushClass, MirrorClasses, FillClass, ToggleOverlay)
