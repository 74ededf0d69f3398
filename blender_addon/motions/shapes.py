# SPDX-License-Identifier: GPL-3.0-or-later
"""What cloth does not meet, in words: shapes that change over time, and what else than bones moves a body."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import bpy

from ..scene.armature import leader_of
from ..scene.garment import armature_of, bodies_of, follow_bodies, need_left, no_meshes
from ..scene.meshes import PREFIX
from ..scene.modifiers import (
    bones_place,
    rendered_refining,
    reshapes,
    shown_or_rendered_alone,
    unmet_modifiers,
)
from .bodies import look_at
from .keys import changing_paths
from .sources import TIMELINE, Source, playing

THICK = 0.002  # [m] by which renders may show skin outside of what cloth meets, untold


def changing_shapes(thing: bpy.types.Object) -> list[str]:
    """Return the names of an object's own shape keys that keys or drivers change; none where one is pinned."""
    keys = thing.data.shape_keys
    if keys is None or thing.show_only_shape_key:
        return []
    paths = changing_paths(keys.animation_data)
    own = [key for key in keys.key_blocks if not key.name.startswith(PREFIX)]
    mutes = {key.name for key in own if key.path_from_id("mute") in paths}
    values = {key.name for key in own if key.path_from_id("value") in paths and not key.mute}
    return [key.name for key in own if key.name in mutes | values]


def _changing_modifiers(body: bpy.types.Object) -> bool:
    """Return whether keys or drivers change modifiers that shape a body before its bones move it."""
    if not reshapes(body):
        return False
    paths = changing_paths(body.animation_data)
    before = [each.path_from_id() for each in body.modifiers[: bones_place(body)] if each.show_viewport]
    return any(path.startswith(tuple(before)) for path in paths)


def tell_changing_shapes(
    operator: bpy.types.Operator,
    garment: bpy.types.Object,
    motions: Sequence[Source] = (),
    followed: Sequence[bpy.types.Object] = (),
) -> None:
    """Report what cloth does not meet of a garment's bodies, and shapes that change and are not followed.

    Args:
        followed: bodies whose shape keys a bake follows, where it is one.
        motions: those in which bodies are looked at; the timeline without any.

    Raises:
        SetupError: a body is being edited.
    """
    for text in _unmet(garment, motions or [Source(TIMELINE, "Timeline")], followed):
        operator.report({"WARNING"}, text)


def _changing_in(
    motions: Sequence[Source], armature: bpy.types.Object, things: Sequence[bpy.types.Object]
) -> Iterator[str]:
    """Yield the shape keys that change now, or in actions that have slots for them, with whose they are."""
    for source in (Source(TIMELINE, "Timeline"), *motions):
        with playing(leader_of(armature), source):
            yield from (f"'{name}' of '{thing.name}'" for thing in things for name in changing_shapes(thing))


def _unmet(
    garment: bpy.types.Object, motions: Sequence[Source], followed: Sequence[bpy.types.Object]
) -> Iterator[str]:
    armature = armature_of(garment)
    bodies = bodies_of(garment, armature)
    frame, scale = bpy.context.scene.frame_current, bpy.context.scene.unit_settings.scale_length
    yield from (f"{text}." for text in no_meshes(garment, armature))
    for body in bodies:
        for name in unmet_modifiers(body):
            text = f"The modifier '{name}' of '{body.name}' comes after its bones; cloth meets the body without it"
            yield f"{text}. Move it above the Armature modifier, or apply it."
        for name in shown_or_rendered_alone(body):
            text = f"The modifier '{name}' of '{body.name}' is switched on in viewports or in renders alone"
            yield f"{text}; cloth meets the body as viewports show it."
    chosen = garment.ssilk.bodies is not None
    yield from (f"{text}." for text in (() if chosen else follow_bodies(garment, bodies)))
    for body in () if chosen else bodies:
        if body.hide_render:
            text = f"'{body.name}' is not rendered, and cloth meets it all the same"
            yield f"{text}; to leave it out, put the other bodies in a collection, and choose that as Bodies."
    for body in bodies:
        need_left(body)
    looked = look_at(armature, bodies, motions)
    for body, found in zip(bodies, looked):
        if not changing_shapes(body) and (found.changes or _changing_modifiers(body)):
            text = f"Modifiers change the shape of '{body.name}' over time, which is not followed"
            yield f"{text}; the shape of frame {frame} is met throughout."
        if found.away:
            where, size = f"frame {found.frame} of '{found.motion}'", 1000 * scale * found.away
            yield (
                f"Blender shows '{body.name}' up to {size:.1f} mm from where the bones of '{armature.name}' move it "
                f"({where}); cloth meets it where these have it. Look at its modifiers, its parent, keys of its own, "
                "and envelopes of bones."
            )
        elif scale * found.outside > THICK and not unmet_modifiers(body) + shown_or_rendered_alone(body):
            first, *more = (f"'{each.name}'" for each in rendered_refining(body))
            text = (
                f"Renders show '{body.name}' up to {1000 * scale * found.outside:.1f} mm outside of what cloth meets"
            )
            yield (
                f"{text}, by its modifier{'s' if more else ''} {', '.join([first, *more])}. Move what thickens or is "
                "sculpted above the Armature modifier, with the same levels in viewports as in renders, or apply it."
            )
    left = [thing for thing in (*bodies, garment) if thing not in followed]
    names = list(dict.fromkeys(_changing_in(motions, armature, left)))
    if names:
        more = f" and {len(names) - 1} more change" if len(names) > 1 else " changes"
        text = f"The shape key {names[0]}{more} over time, which is not followed; the shape of frame {frame} is met"
        yield f"{text} throughout."
