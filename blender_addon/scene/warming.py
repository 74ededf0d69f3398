# SPDX-License-Identifier: GPL-3.0-or-later
"""Heat maps that follow the timeline: coloured anew as soon as Blender has evaluated a frame."""

from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from .heat import show_again


def start_listening() -> None:
    """Have Blender call what is here."""
    bpy.app.handlers.frame_change_post.append(_frame_changed)


def stop_listening() -> None:
    """Leave nothing behind."""
    if _frame_changed in bpy.app.handlers.frame_change_post:
        bpy.app.handlers.frame_change_post.remove(_frame_changed)
    if bpy.app.timers.is_registered(show_all):
        bpy.app.timers.unregister(show_all)


def show_all() -> None:
    """Colour all garments of the scene that show heat."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    for garment in bpy.context.scene.objects:
        if garment.ssilk.heat and garment.mode == "OBJECT":
            show_again(garment, depsgraph)


@persistent
def _frame_changed(scene: bpy.types.Scene, _: bpy.types.Depsgraph) -> None:
    """Colour when the frame stands: what is played live is written in this very moment."""
    warm = any(thing.ssilk.heat for thing in scene.objects)
    if warm and not bpy.app.background and not bpy.app.timers.is_registered(show_all):
        bpy.app.timers.register(show_all, first_interval=0.0)
