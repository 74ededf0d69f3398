# SPDX-License-Identifier: GPL-3.0-or-later
"""Shapes that are not followed: shape keys that change over time, and what shapes a body after its bones."""

from __future__ import annotations

from typing import Any

import bpy

from ..scene.garment import armature_of, bodies_of
from ..scene.meshes import PREFIX
from ..scene.modifiers import unmet_modifiers
from .keys import SLOTS, curves_of

STEADY = 1e-6  # of a key's value: rounding


def changing_shapes(thing: bpy.types.Object) -> list[str]:
    """Return the names of an object's own shape keys that keys or drivers change; none where one is pinned."""
    keys = thing.data.shape_keys
    animation = keys.animation_data if keys else None
    if keys is None or animation is None or thing.show_only_shape_key:
        return []
    tracks = [track for track in animation.nla_tracks if animation.use_nla and not track.mute]
    players: list[Any] = [animation, *(strip for track in tracks for strip in track.strips if not strip.mute)]
    curves: list[Any] = list(animation.drivers)
    for player in players:
        if player.action and not (SLOTS and player.action_slot is None):
            played = curves_of(player.action, player.action_slot if SLOTS else None)
            curves += [curve for curve in played if not _is_constant(curve)]
    paths = {curve.data_path for curve in curves if not curve.mute}
    own = [key for key in keys.key_blocks if not key.name.startswith(PREFIX)]
    mutes = {key.name for key in own if key.path_from_id("mute") in paths}
    values = {key.name for key in own if key.path_from_id("value") in paths and not key.mute}
    return [key.name for key in own if key.name in mutes | values]


def _is_constant(curve: bpy.types.FCurve) -> bool:
    """Return whether a curve keeps one value, as where an artist keyed a shape once."""
    values = {value for key in curve.keyframe_points for value in (key.co.y, key.handle_left.y, key.handle_right.y)}
    return bool(values) and max(values) - min(values) < STEADY and not curve.modifiers


def tell_changing_shapes(operator: bpy.types.Operator, garment: bpy.types.Object) -> None:
    """Report which shapes of a garment and its bodies change, or come after bones, and are not followed."""
    bodies = bodies_of(garment, armature_of(garment))
    things = [*bodies, garment]
    for body in bodies:
        for name in unmet_modifiers(body):
            text = f"The modifier '{name}' of '{body.name}' comes after its bones; cloth meets the body without it"
            operator.report({"WARNING"}, f"{text}. Move it above the Armature modifier, or apply it.")
    names = [f"'{name}' of '{thing.name}'" for thing in things for name in changing_shapes(thing)]
    if names:
        more = f" and {len(names) - 1} more change" if len(names) > 1 else " changes"
        frame = bpy.context.scene.frame_current
        text = f"The shape key {names[0]}{more} over time, which is not followed; the shape of frame {frame} is met"
        operator.report({"WARNING"}, f"{text} throughout.")
