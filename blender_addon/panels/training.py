# SPDX-License-Identifier: GPL-3.0-or-later
"""Training: its motions, its budget, and how far it is."""

from __future__ import annotations

import bpy

from ..arrays.curves import series
from ..errors import SetupError
from ..motions.sources import FILE
from ..outside.jobs import JobState
from ..outside.training_report import findings, progress
from ..playback.models import TrainingProgress, progress_of
from ..preferences import on_processor
from ..scene.armature import proxy_names
from ..scene.garment import armature_of
from .base import UsableGarmentPanel, draw_text, saying_errors
from .plot import plot, swatch

ICONS = {"TIMELINE": "TIME", "ACTION": "ACTION", "STRIP": "NLA", "FILE": "FILE"}
FEWEST_ROWS, MOST_ROWS = 3, 8  # of the list of motions
PLOT_SCALE = 8.0  # in heights of a line of text


def has_proxies(garment: bpy.types.Object) -> bool:
    """Return whether a garment has proxies; not where its armature is gone."""
    try:
        return bool(proxy_names(armature_of(garment), garment))
    except SetupError:  # a training is drawn nevertheless
        return False


class MotionList(bpy.types.UIList):
    bl_idname = "SSILK_UL_motions"

    def draw_item(self, _context, layout, _data, item, _icon, _active, _property, index=0) -> None:  # type: ignore[no-untyped-def]
        row = layout.row(align=True)
        row.prop(item, "use", text="")
        row.label(text=item.called, icon=ICONS[item.kind], translate=False)
        if item.kind == FILE:
            row.operator("ssilk.remove_motion", text="", icon="X").index = index

    def draw_filter(self, _context, _layout) -> None:  # type: ignore[no-untyped-def]
        """Draw nothing: the filter stands above the list, where it is seen."""

    def filter_items(self, _context, data, _property) -> tuple[list[int], list[int]]:  # type: ignore[no-untyped-def]
        return [self.bitflag_filter_item if listed else 0 for listed in data.listed()], []


def draw_motions(layout: bpy.types.UILayout, garment: bpy.types.Object) -> None:
    """Draw the list of motions, each to be chosen or left."""
    settings = garment.ssilk.training
    if count := len(settings.motions):
        layout.prop(settings, "search", text="", icon="VIEWZOOM")
        rows = min(max(count, FEWEST_ROWS), MOST_ROWS)
        layout.template_list(MotionList.bl_idname, "", settings, "motions", settings, "active", rows=rows)
        row = layout.row(align=True)
        row.operator("ssilk.choose_motions", text="All").value = "ALL"
        row.operator("ssilk.choose_motions", text="None").value = "NONE"
        row.label(text=f"{sum(item.use for item in settings.motions)} of {count}", translate=False)
    column = layout.column(align=True)  # side by side their German names would be cut
    column.operator("ssilk.find_motions", icon="FILE_REFRESH")
    column.operator("ssilk.add_motion_files", icon="FILE_FOLDER")


def draw_bar(layout: bpy.types.UILayout, state: JobState) -> None:
    """Draw how far a training is, with a button that ends it or lets it go on."""
    if state.alive:
        draw_text(layout, progress(state))
    row = layout.row(align=True)
    row.progress(factor=state.fraction, text=f"{state.fraction:.0%}" if state.total else "")
    if state.alive and state.round:
        layout.operator("ssilk.cancel_training", text="Finish", icon="CHECKMARK")
    elif state.alive:
        row.operator("ssilk.cancel_training", text="", icon="CANCEL")
    elif state.state != "done":
        row.operator("ssilk.resume_training", text="", icon="PLAY")


def draw_training(layout: bpy.types.UILayout, training: TrainingProgress, *, moves: bool) -> None:
    """Draw how far a training is, and what it found."""
    state = training.state
    draw_bar(layout, state)
    if not state.alive:
        draw_text(layout, progress(state), icon="NONE" if state.state == "done" else "INFO")
    for text, warns in findings(state, training.curve, moves=moves):
        draw_text(layout, text, icon="ERROR" if warns else "NONE")


def draw_energies(layout: bpy.types.UILayout, training: TrainingProgress) -> None:
    """Draw the energies of a training over its iterations."""
    lines = series(training.state.curve)
    if not lines:
        layout.label(text="Nothing was computed yet")
        return
    picture = plot(str(training.folder), training.written, list(lines.values()))
    layout.template_icon(icon_value=picture, scale=PLOT_SCALE)
    for index, (name, values) in enumerate(lines.items()):
        layout.label(text=f"{name.capitalize()}: {values[-1, 1]:.3g} J", icon_value=swatch(index), translate=False)


def slow_line(context: bpy.types.Context, garment: bpy.types.Object) -> str:
    """Return a warning where a preset for GPUs would run on a processor; empty where it is fine or has a budget."""
    settings = garment.ssilk.training
    chosen = settings.is_property_set("preset")  # else Train chooses what fits
    budget = settings.minutes or settings.iterations
    if not chosen or settings.preset == "draft" or budget or not on_processor(context):
        return ""
    return f"'{settings.preset.capitalize()}' is for a GPU: this processor takes days. Take Draft, or set Minutes"


class TrainingPanel(UsableGarmentPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_training"
    bl_label = "Training"
    section = "5-train"

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        layout, garment = self.layout, context.object
        settings, training = garment.ssilk.training, progress_of(garment)
        draw_motions(layout, garment)
        layout.prop(settings, "preset")
        if slow := slow_line(context, garment):
            draw_text(layout, slow, icon="ERROR")
        column = layout.column(align=True)
        column.prop(settings, "iterations")
        column.prop(settings, "minutes")
        layout.prop(settings, "fabrics")
        layout.operator("ssilk.train", icon="PLAY")
        if training and training.state:
            draw_training(layout, training, moves=has_proxies(garment))


class EnergiesPanel(UsableGarmentPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_energies"
    bl_label = "Energies"
    section = "5-train"
    bl_parent_id = "SSILK_PT_training"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        training = progress_of(context.object) if super().poll(context) else None
        return bool(training and training.state)

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        training = progress_of(context.object)
        if training and training.state:
            draw_energies(self.layout, training)
