# SPDX-License-Identifier: GPL-3.0-or-later
"""Baking the model onto the timeline, and live playback."""

from __future__ import annotations

import bpy
import numpy as np

from ssilk_core.errors import SsilkError
from ssilk_core.scene.fabric_range import FACTORS

from ..motions.colliders import unmet, unseen
from ..motions.freedom import has_held_parts
from ..motions.keys import has_keys
from ..playback import playing
from ..playback.fabrics import SAME, played_factors
from ..playback.live import Live
from ..playback.models import fabrics_of, no_model, sees_colliders
from ..playback.overrides import overriding
from ..playback.solving import SOLVED
from ..preferences import no_certificates
from ..scene.armature import owners_of
from ..scene.garment import armature_of
from ..settings.played import OWN
from .base import PlayableGarmentPanel, SidebarPanel, draw_text, saying_errors


def solved_line(played: Live) -> str:
    """Return how far frames are solved; empty where the network alone is played."""
    if played.wrong:
        return f"The network is played: {played.wrong}"
    solving = played.solving
    if solving is None:
        return ""
    if not solving.started:
        return "The solver starts; the network is played"
    last = played.first + solving.total - 1
    if solving.waits:
        if not played.solved:
            return f"Solves frame {played.first} to {last}; the network is played"
        return f"Solved up to frame {played.first + played.solved - 1} of {last}; then the network is played"
    lost = f"; {len(solving.lost)} frames were lost and put to rest" if solving.lost else ""
    failed = f"; at {solving.failed} steps nothing lowered the energy" if solving.failed else ""
    return f"Follows the armature, solved up to frame {last}{failed}{lost}"


def live_line(garment: bpy.types.Object) -> str:
    """Return what live playback is at; empty where there is nothing to say."""
    played = playing.live(garment)
    if played is None:
        return playing.reason(garment)
    if played.done is not None:
        what = "Taking up a better model" if played.model_only else "Reading the motion"
        return f"{'Changing the fabric' if played.fabric_only else what}: {played.done:.0%}"
    if played.behind:
        return "The frames, Free, Hold Frames, a body or what surrounds it changed since the motion was read"
    if played.unkeyed:
        return f"Renders lack it: {played.unkeyed}"
    solved = solved_line(played)
    if played.stale:
        return f"The motion changed since it was read{solved and '. '}{solved}"
    line = playing.warning(garment) or solved or "Follows the armature"
    return f"{line}. {played.told}" if played.told else line


def unseen_line(garment: bpy.types.Object) -> str:
    """Return that a garment's network sees none of the colliders that are there; empty where it does, or none are."""
    if no_model(garment):
        return ""
    line = unseen(garment, armature_of(garment), "The network")
    try:
        return "" if not line or sees_colliders(garment) else line
    except SsilkError:  # a damaged model, of which playing and baking tell
        return ""


def unsolved_line(garment: bpy.types.Object) -> str:
    """Return that the chosen solver meets none of the colliders that are there; empty where none is chosen."""
    if garment.ssilk.live_quality not in SOLVED or no_model(garment):
        return ""
    return unseen(garment, armature_of(garment), "The solver in latents")


class PlaybackPanel(PlayableGarmentPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_playback"
    bl_label = "Live Playback"
    section = "7-look"

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        layout, line = self.layout, live_line(context.object)
        if playing.live(context.object):
            row = layout.row(align=True)
            row.operator("ssilk.stop_live", icon="PAUSE")
            row.operator("ssilk.refresh_live", text="", icon="FILE_REFRESH")
        else:
            layout.operator("ssilk.play_live", icon="PLAY")
        layout.prop(context.object.ssilk, "live_quality")
        if unsolved := unsolved_line(context.object):
            draw_text(layout, unsolved, icon="INFO")
        if has_held_parts(context.object):
            draw_text(layout, "Parts that are held by themselves are free here; a bake holds them", icon="INFO")
        if line:
            draw_text(layout, line)


def fabric_line(garment: bpy.types.Object) -> str:
    """Return what a garment's model does not know of the fabric that is chosen; empty where it knows it."""
    factors = played_factors(garment)
    known = fabrics_of(garment)
    if known is None:
        return "The model knows one fabric: train it with Range of Fabrics"
    (own, fabrics), chosen = known, garment.ssilk.played.preset
    if beyond := fabrics.beyond(factors):
        return f"The network sees the nearest fabric of its training: {beyond} is beyond"
    if chosen == OWN or not np.allclose(factors, fabrics.factors_of(own, chosen), rtol=SAME):
        return ""
    other = fabrics.other_words(own, chosen)
    return f"'{chosen}' is the fabric that its training called so; the preset has now: {other}" if other else ""


class PlayedFabricPanel(PlayableGarmentPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_played_fabric"
    bl_label = "Fabric"
    section = "7-look"
    bl_parent_id = "SSILK_PT_playback"
    bl_options = {"DEFAULT_CLOSED"}

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        layout, garment = self.layout, context.object
        layout.use_property_split, layout.use_property_decorate = True, False  # a shot is of one fabric
        if line := no_model(garment):
            draw_text(layout, line)
            return
        column = layout.column()
        column.active = fabrics_of(garment) is not None
        for name in ("preset", *FACTORS):
            column.prop(garment.ssilk.played, name)
        layout.prop(garment.ssilk.played, "friction")
        if line := fabric_line(garment):
            draw_text(layout, line, icon="INFO")


def model_line(garment: bpy.types.Object) -> str:
    """Return which model is baked, or why there is none."""
    own = "Bakes the chosen model" if garment.ssilk.model else "Bakes the best model of its training"
    return no_model(garment) or own


def overridden_line(garment: bpy.types.Object) -> str:
    """Return what has priority over keys that were baked or are played live; empty where nothing has, or none are."""
    keyed = has_keys(garment) or playing.live(garment)
    found = overriding(garment, armature_of(garment)) if keyed else []
    return f"Blender does not show what was baked or is played: {'; '.join(found)}" if found else ""


def draw_bones(layout: bpy.types.UILayout, garment: bpy.types.Object) -> None:
    """Draw the bones of the training that only the artist can tell, each with what it is called now."""
    layout.operator("ssilk.match_bones", icon="BONE_DATA")
    column = layout.column(align=True)
    for item in garment.ssilk.bones:
        column.prop_search(item, "bone", armature_of(garment).data, "bones", text=item.name)


class BakingPanel(PlayableGarmentPanel, bpy.types.Panel):
    bl_idname = "SSILK_PT_baking"
    bl_label = "Baking"
    section = "6-bake"

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.prop(context.object.ssilk, "model")
        draw_text(layout, model_line(context.object))
        layout.prop(context.object.ssilk, "free")
        layout.prop_search(context.object.ssilk, "part", context.object, "vertex_groups")
        if context.object.ssilk.part:
            layout.prop(context.object.ssilk, "part_free")
        layout.prop(context.object.ssilk, "hand_pose")
        layout.prop(context.object.ssilk, "hold")
        layout.prop(context.object.ssilk, "loop")
        layout.prop(context.object.ssilk, "colliders")
        for line in filter(None, (unseen_line(context.object), *unmet(context.object))):
            draw_text(layout, line, icon="INFO")
        if line := no_certificates(context):
            draw_text(layout, line, icon="INFO")
        else:
            layout.prop(context.object.ssilk, "certify")
        layout.operator("ssilk.bake", icon="REC")
        draw_bones(layout, context.object)
        layout.operator("ssilk.to_bones", icon="BONE_DATA")
        layout.operator("ssilk.export_gltf", icon="EXPORT")
        layout.operator("ssilk.remove_bake", icon="TRASH")
        layout.operator("ssilk.hide_covered", icon="HIDE_ON")
        layout.operator("ssilk.show_covered", icon="HIDE_OFF")
        if line := overridden_line(context.object):
            draw_text(layout, line, icon="ERROR")


class HeldProxyPanel(SidebarPanel, bpy.types.Panel):
    """Of the armature: the sliders of the proxy that is chosen in Pose Mode."""

    bl_idname = "SSILK_PT_held_proxy"
    bl_label = "Held Proxy"
    section = "6-bake"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        bone = context.active_pose_bone
        return bone is not None and bone.name in owners_of(bone.id_data.data)

    @saying_errors
    def draw(self, context: bpy.types.Context) -> None:
        self.layout.prop(context.active_pose_bone, "ssilk_free")
        self.layout.prop(context.active_pose_bone, "ssilk_posed")
