# SPDX-License-Identifier: GPL-3.0-or-later
"""Live playback."""

from __future__ import annotations

import bpy

from ..scene import playing
from ..scene.garment import unusable
from .base import SidebarPanel, saying_errors


def live_line(garment: bpy.types.Object) -> str:
    """Return what live playback is at; empty where there is nothing to say."""
    played = playing.live(garment)
    if played is None:
        return playing.reason(garment)
    if played.done is not None:
        return f"{'Taking up a better model' if played.model_only else 'Reading the motion'}: {played.done:.0%}"
    return "The motion changed since it was read" if played.stale else "Follows the armature"


class PlaybackPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_playback"
    bl_label = "Live Playback"
    section = "7-look"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return not unusable(context.object)

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        layout, line = self.layout, live_line(context.object)
        if playing.live(context.object):
            row = layout.row(align=True)
            row.operator("ssilk.stop_live", icon="PAUSE")
            row.operator("ssilk.refresh_live", text="", icon="FILE_REFRESH")
        else:
            layout.operator("ssilk.play_live", icon="PLAY")
        if line:
            layout.label(text=line)
