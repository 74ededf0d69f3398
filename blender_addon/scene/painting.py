# SPDX-License-Identifier: GPL-3.0-or-later
"""Brush colour and palette in vertex paint."""

from __future__ import annotations

from collections.abc import Sequence

import bpy

from ..classes import COLOR_ATTRIBUTE, COLORS


def offer_palette(context: bpy.types.Context) -> None:
    """Show the palette of classes in vertex paint, made if there is none, and brush with its last colour."""
    palette = bpy.data.palettes.get(COLOR_ATTRIBUTE) or bpy.data.palettes.new(COLOR_ATTRIBUTE)
    while palette.colors:
        palette.colors.remove(palette.colors[0])
    for color in COLORS:
        palette.colors.new().color = color
    context.tool_settings.vertex_paint.palette = palette
    if context.tool_settings.vertex_paint.brush:
        choose_color(context, COLORS[-1])


def choose_color(context: bpy.types.Context, color: Sequence[float]) -> None:
    """Make brushes of vertex paint brush with a colour, fully and without blending modes."""
    paint = context.tool_settings.vertex_paint
    brush = paint.brush
    brush.blend, brush.color = "MIX", color
    # Blender 5 keeps settings that brushes share in each mode, earlier versions in one place.
    unified = getattr(paint, "unified_paint_settings", None) or context.tool_settings.unified_paint_settings
    unified.color = color
