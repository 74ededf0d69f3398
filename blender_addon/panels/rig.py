# SPDX-License-Identifier: GPL-3.0-or-later
"""The proxy rig."""

from __future__ import annotations

import bpy

from ..errors import SetupError
from ..scene.armature import proxy_names
from ..scene.garment import armature_of, unusable
from .base import Panel, draw_text


def rig_line(garment: bpy.types.Object) -> str:
    """Return one line about a garment's proxies, or why it can have none."""
    try:
        armature = armature_of(garment)
    except SetupError as error:
        return str(error)
    count = len(proxy_names(armature, garment))
    return f"{count} proxies on '{armature.name}'" if count else f"No proxies yet on '{armature.name}'"


class RigPanel(Panel, bpy.types.Panel):
    bl_idname = "SSILK_PT_rig"
    bl_label = "Proxy Rig"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return not unusable(context.object)

    def draw(self, context: bpy.types.Context) -> None:
        draw_text(self.layout, rig_line(context.object))
        self.layout.operator("ssilk.generate_rig", icon="BONE_DATA")
        self.layout.operator("ssilk.adopt_rig", icon="IMPORT")
