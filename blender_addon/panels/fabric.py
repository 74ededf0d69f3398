# SPDX-License-Identifier: GPL-3.0-or-later
"""What the garment is made of."""

from __future__ import annotations

import bpy

from ..scene.garment import unusable
from .base import SidebarPanel, saying_errors

MEMBRANE = {"stvk": ("lame_mu", "lame_lambda"), "baraff_witkin": ("stretch", "shear")}  # values of each model
CONTACT = {"surface": ("contact", "loose_contact"), "vertex": ("collision",)}  # likewise


class FabricPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_fabric"
    bl_label = "Fabric"
    section = "2-garment"
    bl_parent_id = "SSILK_PT_garment"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return not unusable(context.object)

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        layout, fabric = self.layout, context.object.ssilk.fabric
        layout.use_property_split, layout.use_property_decorate = True, False  # a fabric is not animated
        for name in ("preset", "density", "stretch_model", *MEMBRANE[fabric.stretch_model]):
            layout.prop(fabric, name)
        contact = CONTACT[fabric.contact_model]
        for name in ("bending", "drag", "contact_model", *contact, "margin", "thickness", "tether", "stitch"):
            layout.prop(fabric, name)
