# SPDX-License-Identifier: GPL-3.0-or-later
"""Playing a trained garment while the artist works."""

from __future__ import annotations

import bpy

from ..errors import SetupError
from ..motions.colliders import left_out
from ..motions.shapes import tell_changing_shapes
from ..playback import playing
from ..playback.models import model_of, no_model
from ..playback.solving import no_solver
from ..scene.garment import unplayable, unplayable_here
from .reporting import ReportingOperator


class PlayLive(ReportingOperator, bpy.types.Operator):
    """Play the trained garment on the armature as it is, frame by frame, without a bake"""

    bl_idname = "ssilk.play_live"
    bl_label = "Play Live"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := unplayable_here(context):
            return reason
        if playing.live(context.object):
            return f"'{context.object.name}' is played already"
        return no_model(context.object) or no_solver(context.object.ssilk.live_quality)

    def apply(self, context: bpy.types.Context) -> str:
        tell_changing_shapes(self, context.object)
        playing.play(context.object)
        live = playing.live(context.object)
        if not live:
            raise SetupError(playing.reason(context.object))
        return f"'{context.object.name}' plays {model_of(context.object).name}{left_out(live.colliders)}."


class LiveOperator(ReportingOperator):
    """Base of operators on a garment that is played."""

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := unplayable(context.object):
            return reason
        return "" if playing.live(context.object) else f"'{context.object.name}' is not played"


class StopLive(LiveOperator, bpy.types.Operator):
    """Play the garment no longer; it stays as it is in this frame"""

    bl_idname = "ssilk.stop_live"
    bl_label = "Stop Playing"

    def apply(self, context: bpy.types.Context) -> str:
        playing.stop(context.object)
        return ""


class RefreshLive(LiveOperator, bpy.types.Operator):
    """Read what the armature does over the scene's frames again: after edits, or when the frame range changed"""

    bl_idname = "ssilk.refresh_live"
    bl_label = "Read Motion Again"

    def apply(self, context: bpy.types.Context) -> str:
        playing.refresh(context.object)
        return ""


CLASSES = (PlayLive, StopLive, RefreshLive)
