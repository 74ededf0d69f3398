# SPDX-License-Identifier: GPL-3.0-or-later
"""Shape keys of the artist that change over time: cloth meets the shape of the frame that it was read in."""

from __future__ import annotations

from typing import Any

import bpy

from ..scene.garment import armature_of, bodies_of
from ..scene.meshes import PREFIX
from .keys import SLOTS, curves_of


def changing_shapes(thing: bpy.types.Object) -> list[str]:
    """Return the names of an object's own shape keys that keys or drivers change."""
    keys = thing.data.shape_keys
    animation = keys.animation_data if keys else None
    if keys is None or animation is None:
        return []
    players: list[Any] = [animation, *(strip for track in animation.nla_tracks for strip in track.strips)]
    curves = list(animation.drivers)
    for player in players:
        if player.action and not (SLOTS and player.action_slot is None):
            curves += curves_of(player.action, player.action_slot if SLOTS else None)
    paths = {curve.data_path for curve in curves}
    own = [key for key in keys.key_blocks if not key.name.startswith(PREFIX) and not key.mute]
    return [key.name for key in own if key.path_from_id("value") in paths]


def tell_changing_shapes(operator: bpy.types.Operator, garment: bpy.types.Object) -> None:
    """Report which shapes of a garment and its bodies change, and are not followed."""
    things = [*bodies_of(garment, armature_of(garment)), garment]
    names = [f"'{name}' of '{thing.name}'" for thing in things for name in changing_shapes(thing)]
    if names:
        more = f" and {len(names) - 1} more change" if len(names) > 1 else " changes"
        frame = bpy.context.scene.frame_current
        text = f"The shape key {names[0]}{more} over time, which is not followed; the shape of frame {frame} is met"
        operator.report({"WARNING"}, f"{text} throughout.")
