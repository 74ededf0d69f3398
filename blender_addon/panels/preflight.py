# SPDX-License-Identifier: GPL-3.0-or-later
"""The preflight's findings, with buttons that select and repair."""

from __future__ import annotations

import bpy

from ssilk_core.events import format_count

from ..operators.preflight import fixer
from ..quality.heat import PUSHED_OUT
from ..quality.repairs import DISPLACEMENT
from ..settings.preflight import shown_finding
from .base import UsableGarmentPanel, draw_text, saying_errors

ICONS = {"error": "CANCEL", "warning": "ERROR", "info": "INFO"}


class FindingList(bpy.types.UIList):
    bl_idname = "SSILK_UL_findings"

    def draw_item(self, _context, layout, _data, item, _icon, _active, _property) -> None:  # type: ignore[no-untyped-def]
        garment = bpy.context.window_manager.ssilk_preflight.garment
        layout.label(text=named_line(item, garment), icon=ICONS.get(item.severity, "INFO"), translate=False)


class PreflightPanel(UsableGarmentPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_preflight"
    bl_label = "Preflight"
    section = "2-garment"
    bl_options = {"DEFAULT_CLOSED"}

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        layout, preflight = self.layout, context.window_manager.ssilk_preflight
        layout.operator("ssilk.inspect", icon="VIEWZOOM")
        if DISPLACEMENT in context.object.data.attributes:
            layout.operator("ssilk.show_heat", text="Show Pushed Out", icon="SHADING_RENDERED").kind = PUSHED_OUT
        item = shown_finding(context)
        if item is None:
            return
        layout.template_list(FindingList.bl_idname, "", preflight, "findings", preflight, "active", rows=4)
        for text in (item.target, *map(sentence, (item.found, item.why, item.fix))):
            draw_text(layout, text)
        if item.old:
            draw_text(layout, "It has changed since; inspect again", icon="FILE_REFRESH")
        row = layout.row(align=True)
        row.operator("ssilk.select_finding")
        row.operator(fixer(item) or "ssilk.fix_finding")


def sentence(text: str) -> str:
    """Return text that begins with a capital letter."""
    return text[:1].upper() + text[1:]


def named_line(item: bpy.types.PropertyGroup, garment: str) -> str:
    """Return a finding in a few words, after the name of its object where that is not the garment."""
    return f"{item.target}: {line(item)}" if item.target not in ("", garment) else sentence(line(item))


def line(item: bpy.types.PropertyGroup) -> str:
    """Return a finding in a few words."""
    words, noun = item.code.replace("-", " "), {"polygons": "faces"}.get(item.elements, item.elements)
    if not item.indices:
        return words
    number, counted = format_count(len(item.indices), noun).rsplit(" ", 1)
    kind = words.removesuffix(noun)
    return f"{words}: {number} {counted}" if kind == words else f"{number} {kind}{counted}"
