# SPDX-License-Identifier: GPL-3.0-or-later
"""Filling the selection with a class, in edit mode."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty

from ..errors import SetupError
from ..scene.editing import fill_selected
from ..scene.garment import unusable
from .classes import CHOICES, VALUES
from .reporting import ReportingOperator


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


CLASSES = (FillClass,)
