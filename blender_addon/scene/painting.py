# SPDX-License-Identifier: GPL-3.0-or-later
"""Brush colour and palette in vertex paint."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np

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
    _shared(context).color = color


def is_chosen(context: bpy.types.Context, color: Sequence[float]) -> bool:
    """Return whether the brush of vertex paint brushes with a colour; not in other modes."""
    brush = context.tool_settings.vertex_paint.brush if context.mode == "PAINT_VERTEX" else None
    if brush is None:
        return False
    shared = _shared(context)
    return np.allclose(shared.color if shared.use_unified_color else brush.color, color, atol=1e-3)


def _shared(context: bpy.types.Context) -> bpy.types.UnifiedPaintSettings:
    """Return the settings that brushes share: Blender 5 has them in each mode, earlier versions in one place."""
    settings = context.tool_settings
    return getattr(settings.vertex_paint, "unified_paint_settings", None) or settings.unified_paint_settings
