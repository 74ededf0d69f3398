# SPDX-License-Identifier: GPL-3.0-or-later
"""What panels share."""

from __future__ import annotations

import bpy

from ..operators import tasks


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
