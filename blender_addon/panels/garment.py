# SPDX-License-Identifier: GPL-3.0-or-later
"""The garment: what it belongs to, what it is made of, and whether it can be worked on."""

from __future__ import annotations

import bpy

from ..errors import SetupError
from ..operators import make_it_move, outfit, tasks
from ..outside.training_report import improvement
from ..playback.models import orphans, progress_of
from ..preferences import ROOT, unready
from ..quality import tried_on
from ..scene.garment import armature_of, garments_of, unplayable, unusable
from ..settings.try_on import KEYS
from .base import SidebarPanel, UsableGarmentPanel, draw_text, draw_work, saying_errors
from .training import draw_bar


def draw_garments(layout: bpy.types.UILayout, shown: bpy.types.Object) -> None:
    """Draw the garments of the character, where there are several: their order, and what is done with all of them."""
    try:
        garments = garments_of(armature_of(shown))
    except SetupError:
        return  # other panels say what is wrong
    if len(garments) < 2:
        return
    draw_text(layout, "Worn from the skin outwards:")
    column = layout.column(align=True)
    for garment in garments:
        row = column.row(align=True)
        chosen = row.operator("ssilk.choose_garment", text=garment.name, icon="MATCLOTH", depress=garment == shown)
        chosen.garment = garment.name
        for where, icon in (("INNER", "TRIA_UP"), ("OUTER", "TRIA_DOWN")):
            moved = row.operator("ssilk.move_layer", text="", icon=icon)
            moved.garment, moved.where = garment.name, where
    column = layout.column(align=True)
    column.operator("ssilk.train_outfit", icon="PLAY")
    column.operator("ssilk.bake_outfit", icon="REC")
    column.operator("ssilk.hide_covered_outfit", icon="HIDE_ON")
    if waits := outfit.line():
        row = layout.row()
        draw_text(row, waits, icon="TIME")
        row.operator("ssilk.stop_outfit", text="", icon="X")


def draw_course(layout: bpy.types.UILayout, garment: bpy.types.Object) -> None:
    """Draw the button that does all at once, what it waits for, and how the training is."""
    layout.operator("ssilk.make_it_move", icon="PLAY")
    waits = make_it_move.line(garment)
    if waits:
        row = layout.row()
        draw_text(row, waits, icon="TIME")
        row.operator("ssilk.stop_course", text="", icon="X")
    training = progress_of(garment)
    if training and training.state and training.state.state == "failed":
        draw_text(layout, f"Training: {training.state.error}", icon="ERROR")
    elif training and training.alive:
        draw_bar(layout, training.state)
        for line in improvement(training.state, training.curve):
            draw_text(layout, line)


def draw_orphans(layout: bpy.types.UILayout) -> None:
    """Draw the file's trainings that go on for garments which are not in it any more, each to be cancelled."""
    for orphan in orphans():
        job = orphan.job
        draw_text(layout, f"This training goes on without its garment '{job.garment}'", icon="INFO")
        row = layout.row(align=True)
        row.progress(factor=orphan.fraction, text=job.garment)
        row.operator("ssilk.cancel_orphan", text="", icon="CANCEL").folder = str(job.folder)


class GarmentPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_garment"
    bl_label = "Garment"
    section = "2-garment"

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        layout, reason = self.layout, unusable(context.object)
        if reason:
            draw_text(layout, reason, icon="INFO")
            if unplayable(context.object):
                layout.operator("ssilk.import_stage", icon="IMPORT")
        else:
            layout.use_property_split = True
            layout.prop(context.object.ssilk, "armature")
            layout.prop(context.object.ssilk, "bodies")
            draw_course(layout, context.object)
            draw_garments(layout, context.object)
            layout.operator("ssilk.attach_to_cloth", icon="SNAP_FACE")
        missing = "" if tasks.current else unready(context)  # what runs may be finding it
        if missing:  # why the search for a Python failed is said in its place, not beside it
            draw_text(layout, tasks.failed or missing, icon="ERROR")
            row = layout.row(align=True)
            row.operator("ssilk.find_python")
            row.operator("ssilk.create_environment", text="Create", icon="ADD")
            layout.operator("preferences.addon_show", text="Preferences", icon="PREFERENCES").module = ROOT
        else:
            draw_work(layout)
        draw_orphans(layout)


MEMBRANE = {"stvk": ("lame_mu", "lame_lambda"), "baraff_witkin": ("stretch", "shear")}  # values of each model
CONTACT = {"surface": ("contact", "loose_contact"), "vertex": ("collision",)}  # likewise


class FabricPanel(UsableGarmentPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_fabric"
    bl_label = "Fabric"
    section = "2-garment"
    bl_parent_id = "SSILK_PT_garment"
    bl_options = {"DEFAULT_CLOSED"}

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        layout, fabric = self.layout, context.object.ssilk.fabric
        layout.use_property_split, layout.use_property_decorate = True, False  # a fabric is not animated
        for name in ("preset", "density", "stretch_model", *MEMBRANE[fabric.stretch_model]):
            layout.prop(fabric, name)
        own = context.object
        layout.prop_search(own.ssilk, "stiff", own, "vertex_groups")
        if own.ssilk.stiff:
            layout.prop(own.ssilk, "stiffness")
        contact = CONTACT[fabric.contact_model]
        for name in ("bending", "drag", "contact_model", *contact, "margin", "thickness", "tether", "stitch"):
            layout.prop(fabric, name)


def draw_body_keys(layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup) -> None:
    """Draw the shape keys that make a body, each with its value there."""
    column = layout.column(align=True)
    for number, item in enumerate(settings.keys):
        row = column.row(align=True)
        row.prop(item, "key", text="")
        row.prop(item, "value", text="")
        row.operator("ssilk.remove_body_key", text="", icon="X").index = number
    column.operator("ssilk.add_body_key", icon="ADD")


class TryOnPanel(UsableGarmentPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_try_on"
    bl_label = "Try On"
    section = "try-on"
    bl_parent_id = "SSILK_PT_garment"
    bl_options = {"DEFAULT_CLOSED"}

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        layout, garment, settings = self.layout, context.object, context.object.ssilk.try_on
        layout.prop(settings, "body")
        if settings.body == KEYS:
            draw_body_keys(layout, settings)
        else:
            layout.prop(settings, "stage")
        shown = tried_on.find(garment)
        row = layout.row(align=True)
        row.operator("ssilk.try_on", icon="MOD_CLOTH")
        if shown is None:
            return
        row.operator("ssilk.stop_trying_on", text="", icon="X")
        draw_text(layout, f"Beside the character, at rest; 1 is {tried_on.body_of(shown)}")
        layout.prop(settings, "share", slider=True)
        if line := tried_on.inside_line(garment):
            draw_text(layout, line)
        if tried_on.changed(garment):
            draw_text(layout, "The garment or a body has changed since; try it on again", icon="ERROR")
