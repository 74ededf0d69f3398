# SPDX-License-Identifier: GPL-3.0-or-later
"""Training: its motions, its budget, and how far it is."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..curves import series
from ..errors import SetupError
from ..outside.jobs import JobState, read_curve, read_state, stamp
from ..outside.report import findings, progress
from ..scene.armature import proxy_names
from ..scene.garment import armature_of, unusable
from ..scene.models import job_of
from ..scene.motions import FILE
from .base import SidebarPanel, draw_text, saying_errors
from .plot import plot, swatch

ICONS = {"TIMELINE": "TIME", "ACTION": "ACTION", "STRIP": "NLA", "FILE": "FILE"}
PLOT_SCALE = 8.0  # in heights of a line of text
_stamps: dict[Path, float] = {}


def changed(folder: Path) -> bool:
    """Return whether a training has written something since this was asked last."""
    before, now = _stamps.get(folder, 0.0), stamp(folder)
    _stamps[folder] = now
    return before != now


def has_proxies(garment: bpy.types.Object) -> bool:
    """Return whether a garment has proxies; not where its armature is gone."""
    try:
        return bool(proxy_names(armature_of(garment), garment))
    except SetupError:  # a training is drawn nevertheless
        return False


def draw_motions(layout: bpy.types.UILayout, garment: bpy.types.Object) -> None:
    """Draw the list of motions, each to be chosen or left."""
    column = layout.column(align=True)
    for index, item in enumerate(garment.ssilk.training.motions):
        row = column.row(align=True)
        name = bpy.path.basename(item.name) if item.kind == FILE else item.name
        row.prop(item, "use", text=name, icon=ICONS[item.kind])
        if item.kind == FILE:
            row.operator("ssilk.remove_motion", text="", icon="X").index = index
    column = layout.column(align=True)  # side by side their German names would be cut
    column.operator("ssilk.find_motions", icon="FILE_REFRESH")
    column.operator("ssilk.add_motion_files", icon="FILE_FOLDER")


def draw_state(layout: bpy.types.UILayout, folder: Path, state: JobState, *, moves: bool) -> None:
    """Draw how far a training is, what it found, and its energies."""
    row = layout.row(align=True)
    row.progress(factor=state.fraction, text=f"{state.done} of {state.total}" if state.total else "")
    if state.alive:
        row.operator("ssilk.cancel_training", text="", icon="CANCEL")
    elif state.state != "done":
        row.operator("ssilk.resume_training", text="", icon="PLAY")
    draw_text(layout, progress(state), icon="NONE" if state.alive or state.state == "done" else "INFO")
    for text, warns in findings(state, read_curve(folder), moves=moves):
        draw_text(layout, text, icon="ERROR" if warns else "NONE")
    lines = series(state.curve)
    if not lines:
        return
    layout.template_icon(icon_value=plot(str(folder), stamp(folder), list(lines.values())), scale=PLOT_SCALE)
    for index, (name, values) in enumerate(lines.items()):
        layout.label(text=f"{name}: {values[-1, 1]:.3g} J", icon_value=swatch(index))


class TrainingPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_training"
    bl_label = "Training"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return not unusable(context.object)

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        layout, garment = self.layout, context.object
        settings, folder = garment.ssilk.training, job_of(garment)
        draw_motions(layout, garment)
        layout.prop(settings, "preset")
        column = layout.column(align=True)
        column.prop(settings, "iterations")
        column.prop(settings, "minutes")
        layout.operator("ssilk.train", icon="PLAY")
        state = folder and read_state(folder)
        if state:
            draw_state(layout, folder, state, moves=has_proxies(garment))
