# SPDX-License-Identifier: GPL-3.0-or-later
"""The motions of an armature, and playing one of them temporarily."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import bpy

from ..errors import SetupError
from .keys import SLOTS, curves_of, is_baked

TIMELINE, ACTION, STRIP, FILE = "TIMELINE", "ACTION", "STRIP", "FILE"
KINDS = [
    (TIMELINE, "Timeline", "All that the armature plays over the scene's frame range"),
    (ACTION, "Action", "One of the armature's actions by itself"),
    (STRIP, "Strip", "One strip of the armature's NLA tracks by itself"),
    (FILE, "File", "A USD file with an animation of this skeleton"),
]


@dataclass(frozen=True)
class Source:
    """A motion that an armature has.

    Attributes:
        kind: TIMELINE, ACTION or STRIP.
        name: of the action or of the strip; what people call it.
        track: name of the strip's track.
    """

    kind: str
    name: str
    track: str = ""


def sources(armature: bpy.types.Object) -> list[Source]:
    """Return all motions of an armature except baked ones; a strip that plays an action as it is counts as that."""
    if armature.library:  # of which nothing can be changed, not even for a moment
        return [Source(TIMELINE, "Timeline")]
    bones = set(armature.pose.bones.keys())
    actions = [action for action in bpy.data.actions if not is_baked(action) and _moves(action, bones)]
    tracks = armature.animation_data.nla_tracks if armature.animation_data else ()
    strips = [(track, strip) for track in tracks for strip in track.strips]
    own = [(track, strip) for track, strip in strips if not (strip.action and is_baked(strip.action))]
    own = [(track, strip) for track, strip in own if not (strip.action in actions and _plays_as_it_is(strip))]
    return [
        Source(TIMELINE, "Timeline"),
        *(Source(ACTION, action.name) for action in actions),
        *(Source(STRIP, strip.name, track.name) for track, strip in own),
    ]


def is_still(armature: bpy.types.Object) -> bool:
    """Return whether nothing moves an armature: neither animation, nor drivers, nor constraints."""
    if armature.library or any(bone.constraints for bone in armature.pose.bones):
        return False
    above: bpy.types.Object | None = armature
    while above:
        animation = above.animation_data
        tracks = animation.nla_tracks if animation else ()
        animated = animation and (animation.action or animation.drivers or any(track.strips for track in tracks))
        if animated or above.constraints:
            return False
        above = above.parent
    return True


def frames_of(armature: bpy.types.Object, source: Source) -> range:
    """Return the whole frames of a motion.

    Raises:
        SetupError: it is gone.
    """
    if source.kind == TIMELINE:
        return range(bpy.context.scene.frame_start, bpy.context.scene.frame_end + 1)
    if source.kind == ACTION:
        first, last = _action(source).frame_range
    else:
        strip = _strip(armature, source)
        first, last = strip.frame_start, strip.frame_end
    return range(round(first), round(last) + 1)


@contextmanager
def playing(armature: bpy.types.Object, source: Source) -> Iterator[None]:
    """Play one motion of an armature temporarily, and restore everything afterwards.

    Raises:
        SetupError: it is gone.
    """
    if source.kind == TIMELINE:
        yield
        return
    bare = armature.animation_data is None
    animation = armature.animation_data_create()
    names = ("action", "action_slot", "use_nla") if SLOTS else ("action", "use_nla")
    mutes = [(item, "mute") for track in animation.nla_tracks for item in (track, *track.strips)]
    kept = [(item, name, getattr(item, name)) for item, name in [*((animation, name) for name in names), *mutes]]
    try:
        if source.kind == ACTION:
            animation.use_nla = False
            assign(animation, _action(source))
        else:
            _play_alone(animation, _strip(armature, source))
        yield
    finally:
        for item, name, value in kept:
            if getattr(item, name) != value:
                setattr(item, name, value)
        if bare:
            armature.animation_data_clear()


def _moves(action: bpy.types.Action, bones: set[str]) -> bool:
    return any(_bone(curve.data_path) in bones for curve in curves_of(action))


def _plays_as_it_is(strip: bpy.types.NlaStrip) -> bool:
    """Return whether a strip plays the whole of its action, once, forwards, at its own speed, and in full."""
    whole = (strip.action_frame_start, strip.action_frame_end) == tuple(strip.action.frame_range)
    plain = (strip.scale, strip.repeat) == (1.0, 1.0) and strip.blend_type == "REPLACE"
    changed = strip.use_reverse or strip.use_animated_influence or strip.use_animated_time or strip.modifiers
    faded = strip.blend_in or strip.blend_out or strip.use_auto_blend
    return whole and plain and not (changed or faded)


def _bone(path: str) -> str:
    """Return the name of the bone that an F-curve moves; empty if it moves none."""
    return path.split('"')[1] if path.startswith('pose.bones["') else ""


def _action(source: Source) -> bpy.types.Action:
    action = bpy.data.actions.get(source.name)
    if not action:
        raise SetupError(f"The action '{source.name}' is gone; find the motions again.")
    return action


def _strip(armature: bpy.types.Object, source: Source) -> bpy.types.NlaStrip:
    try:
        return armature.animation_data.nla_tracks[source.track].strips[source.name]
    except (AttributeError, KeyError) as error:
        text = f"The strip '{source.name}' of '{armature.name}' is gone; find the motions again."
        raise SetupError(text) from error


def assign(animation: bpy.types.AnimData, action: bpy.types.Action) -> None:
    """Play an action, by the slot that suits."""
    animation.action = action
    if SLOTS and animation.action_slot is None and animation.action_suitable_slots:
        animation.action_slot = animation.action_suitable_slots[0]


def _play_alone(animation: bpy.types.AnimData, strip: bpy.types.NlaStrip) -> None:
    """Mute everything but one strip."""
    animation.action, animation.use_nla = None, True
    for track in animation.nla_tracks:
        track.mute = strip.name not in track.strips or track.strips[strip.name] != strip
        for other in track.strips:
            other.mute = other != strip
