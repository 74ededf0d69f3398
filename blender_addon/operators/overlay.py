# SPDX-License-Identifier: GPL-3.0-or-later
"""Switching the overlay of classes."""

from __future__ import annotations

import bpy

from .. import overlay
from .reporting import RefusingOperator
from .tasks import redraw


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


CLASSES = (ToggleOverlay,)
