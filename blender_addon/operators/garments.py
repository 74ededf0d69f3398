# SPDX-License-Identifier: GPL-3.0-or-later
"""Going from one garment of a character to another."""

from __future__ import annotations

import bpy
from bpy.props import StringProperty

from ..errors import SetupError
from ..scene.objects import select_object
from .reporting import ReportingOperator


class ChooseGarment(ReportingOperator, bpy.types.Operator):
    """Work on this garment"""

    bl_idname = "ssilk.choose_garment"
    bl_label = "Choose Garment"
    bl_options = {"REGISTER", "UNDO"}

    garment: StringProperty(name="Garment", description="Name of the object to work on")

    def apply(self, context: bpy.types.Context) -> str:
        garment = context.view_layer.objects.get(self.garment)
        if not garment:
            raise SetupError(f"'{self.garment}' is not in this view layer; show its collection.")
        if not garment.visible_get():
            raise SetupError(f"'{self.garment}' is hidden; show it.")
        select_object(garment)
        return ""


CLASSES = (ChooseGarment,)
