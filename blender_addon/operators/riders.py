# SPDX-License-Identifier: GPL-3.0-or-later
"""Attaching rigid things to a garment."""

from __future__ import annotations

import bpy

from ..scene.garment import unplayable_here
from ..scene.riders import attach, vertices_beneath
from .reporting import ReportingOperator


class AttachToCloth(ReportingOperator, bpy.types.Operator):
    """Let the other selected objects ride on the garment: each is parented to the three vertices beneath it"""

    bl_idname = "ssilk.attach_to_cloth"
    bl_label = "Attach to Cloth"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := unplayable_here(context):
            return reason
        todo = f"select what is to ride on '{context.object.name}' too, and the garment last"
        return "" if _riders(context) else f"Nothing else is selected; {todo}"

    def apply(self, context: bpy.types.Context) -> str:
        riders, garment = _riders(context), context.object
        found = [vertices_beneath(rider, garment) for rider in riders]  # of all, before one is changed
        for rider, vertices in zip(riders, found):
            attach(rider, garment, vertices)
        names = ", ".join(f"'{rider.name}'" for rider in riders)
        return f"{names} {'rides' if len(riders) == 1 else 'ride'} on '{garment.name}'."


def _riders(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the selected objects that hang on no other selected one, without the active one."""
    chosen = [each for each in context.selected_objects if each != context.object]
    return [each for each in chosen if each.parent not in chosen]


CLASSES = (AttachToCloth,)
