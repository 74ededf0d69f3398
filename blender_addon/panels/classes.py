# SPDX-License-Identifier: GPL-3.0-or-later
"""Vertex classes: how many there are, and what paints them."""

from __future__ import annotations

import bpy
import numpy as np

from ssilk_core.events import format_count
from ssilk_core.scene.mesh.topology import components

from ..arrays.classes import COLORS, LEVELS, adrift, counts
from ..errors import SetupError
from ..operators.classes import CHOICES
from ..scene.classes import current_classes, is_chosen
from ..scene.meshes import rest_points, triangles_of
from ..scene.overlay import shown
from ..scene.stitched import unstitched
from .base import UsableGarmentPanel, draw_text, saying_errors

_adrift: tuple[object, int] = (None, 0)  # what was looked at last, and what was found


def adrift_line(thing: bpy.types.Object) -> str:
    """Return how much of a garment may fall off, which neither classes nor stitches hold; empty where nothing does.

    Only what has changed is looked at again: panels are drawn many times a second.
    """
    global _adrift
    mesh, values = thing.data, current_classes(thing.data)
    if values is None or mesh.is_editmode:
        return ""
    scale = bpy.context.scene.unit_settings.scale_length * np.array(thing.matrix_world.to_scale()).round(6)
    points = rest_points(thing) * scale
    looked = (mesh.session_uid, len(mesh.edges), values.tobytes(), points.tobytes())
    if _adrift[0] != looked:
        _adrift = (looked, _falling(mesh, values, points))
    if not _adrift[1]:
        return ""
    falling = format_count(_adrift[1], "vertices")
    return f"{falling} would fall off: pieces that lie on no other cloth need pinned or tight ones"


def _falling(mesh: bpy.types.Mesh, values: np.ndarray, points: np.ndarray) -> int:
    """Return how many vertices are on pieces that neither classes (V,) nor stitches hold; points (V, 3) are in m."""
    pairs = np.empty(2 * len(mesh.edges), dtype=np.int32)
    mesh.edges.foreach_get("vertices", pairs)
    island = components(pairs.reshape(-1, 2), len(values))
    loose = adrift(values, island)
    if loose.any():
        loose = unstitched(points, triangles_of(mesh), island, loose)
    return int(np.count_nonzero(loose))


def class_counts(thing: bpy.types.Object) -> tuple[int, int, int] | None:
    """Return how many vertices are pinned, tight and loose; None without classes.

    Raises:
        SetupError: what is stored are no classes.
    """
    values = current_classes(thing.data)
    return None if values is None else counts(values)


class ClassesPanel(UsableGarmentPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_classes"
    bl_label = "Classes"
    section = "3-classes"

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        layout, found, falling = self.layout, None, ""
        try:
            found, falling = class_counts(context.object), adrift_line(context.object)
        except SetupError as error:
            draw_text(layout, str(error), icon="ERROR")
        settings = context.object.ssilk
        layout.operator("ssilk.classify")
        row = layout.row()
        row.enabled = LEVELS in context.object.data.attributes  # which Classify Automatically makes
        row.prop(settings, "tightness", slider=True)
        if falling:
            draw_text(layout, falling, icon="ERROR")
        layout.prop_search(settings, "pins", context.object, "vertex_groups")
        layout.operator("ssilk.paint_classes", icon="BRUSH_DATA")
        editing = context.mode == "EDIT_MESH"
        row = layout.row(align=True)
        for index, (name, label, _) in enumerate(CHOICES):
            column = row.column(align=True)
            choice = "ssilk.fill_class" if editing else "ssilk.brush_class"
            column.operator(choice, text=label, depress=is_chosen(context, COLORS[index])).value = name
            count = column.row()
            count.alignment = "CENTER"
            count.label(text=str(found[index]) if found else "-")
        layout.operator("ssilk.take_up_painting")
        layout.operator("ssilk.toggle_overlay", icon="OVERLAY", depress=shown())
        row = layout.row(align=True)
        row.operator("ssilk.show_classes")
        row.operator("ssilk.mirror_classes")
