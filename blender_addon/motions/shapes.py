# SPDX-License-Identifier: GPL-3.0-or-later
"""Shapes that are not followed: shape keys that change over time, and what shapes a body after its bones."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from ..scene.garment import armature_of, bodies_of
from ..scene.linked import local_copy
from ..scene.meshes import PREFIX
from ..scene.modifiers import bones_place, reshapes, unmet_modifiers
from .evaluating import evaluating
from .keys import SLOTS, curves_of, strips_in

STEADY = 1e-6  # of a key's value: rounding
STILL = 1e-4  # of a body's size, by which its shape may change unseen
LOOKS = 8  # frames of the scene in which a body's shape is looked at


def changing_shapes(thing: bpy.types.Object) -> list[str]:
    """Return the names of an object's own shape keys that keys or drivers change; none where one is pinned."""
    keys = thing.data.shape_keys
    animation = keys.animation_data if keys else None
    if keys is None or animation is None or thing.show_only_shape_key:
        return []
    strips = strips_in(animation.nla_tracks if animation.use_nla else ())
    players: list[Any] = [animation, *(strip for strip, muted in strips if not muted)]
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


def changes_by_modifiers(body: bpy.types.Object) -> bool:
    """Return whether the shape changes over the scene's frames that modifiers give a body before its bones move it.

    Blender evaluates a copy without what comes after: keys, drivers, other objects and nodes may be the cause.
    """
    if not reshapes(body):
        return False
    scene, probe = bpy.context.scene, local_copy(body)
    try:
        for modifier in probe.modifiers[bones_place(probe) :] if bones_place(probe) is not None else ():
            probe.modifiers.remove(modifier)
        looks = np.unique(np.linspace(scene.frame_start, scene.frame_end, LOOKS).round().astype(int))
        first = None
        with evaluating(probe) as frames:
            for frame in looks.tolist():
                shown = _points(probe.evaluated_get(frames(frame)))
                first = shown if first is None else first
                if len(shown) != len(first) or np.abs(shown - first).max(initial=0) > STILL * max(body.dimensions):
                    return True
    finally:
        bpy.data.objects.remove(probe)
    return False


def _points(shown: bpy.types.Object) -> np.ndarray:
    points = np.empty(len(shown.data.vertices) * 3, dtype=np.float32)
    shown.data.vertices.foreach_get("co", points)
    return points


def tell_changing_shapes(operator: bpy.types.Operator, garment: bpy.types.Object) -> None:
    """Report which shapes of a garment and its bodies change, or come after bones, and are not followed."""
    bodies = bodies_of(garment, armature_of(garment))
    things = [*bodies, garment]
    for body in bodies:
        for name in unmet_modifiers(body):
            text = f"The modifier '{name}' of '{body.name}' comes after its bones; cloth meets the body without it"
            operator.report({"WARNING"}, f"{text}. Move it above the Armature modifier, or apply it.")
    frame = bpy.context.scene.frame_current
    for body in bodies:
        if not changing_shapes(body) and changes_by_modifiers(body):
            text = f"Modifiers change the shape of '{body.name}' over time, which is not followed"
            operator.report({"WARNING"}, f"{text}; the shape of frame {frame} is met throughout.")
    names = [f"'{name}' of '{thing.name}'" for thing in things for name in changing_shapes(thing)]
    if names:
        more = f" and {len(names) - 1} more change" if len(names) > 1 else " changes"
        text = f"The shape key {names[0]}{more} over time, which is not followed; the shape of frame {frame} is met"
        operator.report({"WARNING"}, f"{text} throughout.")
