# SPDX-License-Identifier: GPL-3.0-or-later
"""The proxy rig."""

from __future__ import annotations

import bpy

from ..arrays.classes import counts
from ..errors import SetupError
from ..scene.armature import proxy_names
from ..scene.classes import current_classes
from ..scene.garment import armature_of
from .base import UsableGarmentPanel, draw_text, saying_errors


def rig_line(garment: bpy.types.Object) -> str:
    """Return one line about a garment's proxies, or why it can have none."""
    try:
        armature = armature_of(garment)
        if count := len(proxy_names(armature, garment)):
            return f"{count} proxies on '{armature.name}'"
        classes = current_classes(garment.data)
    except SetupError as error:
        return str(error)
    if classes is not None and not counts(classes)[2]:
        return "Nothing is loose: no proxies"
    return f"No proxies yet on '{armature.name}'"


class RigPanel(UsableGarmentPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_rig"
    bl_label = "Proxy Rig"
    section = "4-proxy-rig"

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        draw_text(self.layout, rig_line(context.object))
        self.layout.operator("ssilk.generate_rig", icon="BONE_DATA")
        self.layout.operator("ssilk.adopt_rig", icon="IMPORT")
