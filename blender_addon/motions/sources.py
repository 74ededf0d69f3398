# SPDX-License-Identifier: GPL-3.0-or-later
"""The motions of an armature, and playing one of them temporarily."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from typing import Any

import bpy

from ..errors import SetupError
from ..scene.armature import leader_of
from .keys import SLOTS, changing_paths, curves_of, is_baked, need_no_tweaking, strips_in

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
    actions = [action for action in bpy.data.actions if not is_baked(action) and _is_for(armature, action)]
    tracks = armature.animation_data.nla_tracks if armature.animation_data else ()
    strips = [(track, strip) for track in tracks for strip in track.strips]
    own = [(track, strip) for track, strip in strips if not (strip.action and is_baked(strip.action))]
    own = [
        (track, strip) for track, strip in own if not (strip.action in actions and _plays_as_it_is(armature, strip))
    ]
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
        if moves_alone(above):
            return False
        above = above.parent
    return True


def moves_alone(thing: bpy.types.Object) -> bool:
    """Return whether an object may move by itself, besides its bones and what it hangs on."""
    animation = thing.animation_data
    tracks = animation.nla_tracks if animation else ()
    animated = animation and (animation.action or animation.drivers or any(track.strips for track in tracks))
    return bool(animated or thing.constraints)


def frames_of(armature: bpy.types.Object, source: Source) -> range:
    """Return the whole frames of a motion.

    Raises:
        SetupError: it is gone.
    """
    if source.kind == TIMELINE:
        return range(bpy.context.scene.frame_start, bpy.context.scene.frame_end + 1)
    if source.kind == ACTION:
        first, last = _range(_action(source), slot_of(armature, _action(source)))
    else:
        strip = _strip(armature, source)
        first, last = strip.frame_start, strip.frame_end
    return range(round(first), round(last) + 1)


@contextmanager
def playing(armature: bpy.types.Object, source: Source) -> Iterator[None]:
    """Play one motion of an armature temporarily, and restore everything afterwards.

    Raises:
        SetupError: it is gone, or a strip is being tweaked.
    """
    if source.kind == TIMELINE:
        yield
        return
    bare = armature.animation_data is None
    animation = armature.animation_data_create()
    need_no_tweaking(armature)
    names = ("action", "action_slot", "use_nla") if SLOTS else ("action", "use_nla")
    mutes = [(item, "mute") for track in animation.nla_tracks for item in (track, *track.strips)]
    solos = [(track, "is_solo") for track in animation.nla_tracks]
    played = [(animation, slot_of(armature, _action(source)))] if source.kind == ACTION else []
    played += [(thing.animation_data, slot) for thing, slot in _companions(armature, source)]
    players = {item.id_data: item for item in (animation, *(item for item, _ in played))}.values()
    properties = [*((item, name) for item in players for name in names), *mutes, *solos]
    kept = [(item, name, getattr(item, name)) for item, name in properties]
    try:
        for item, slot in played:
            item.use_nla = False
            assign(item, _action(source), slot)
        if source.kind == STRIP:
            _play_alone(animation, _strip(armature, source))
        yield
    finally:
        for item, name, value in kept:
            if getattr(item, name) != value:
                setattr(item, name, value)
        if bare:
            armature.animation_data_clear()


def _companions(armature: bpy.types.Object, source: Source) -> list[tuple[bpy.types.ID, Any]]:
    """Return what has a slot in the action of a motion besides an armature, as its controls have, each with its slot.

    Blender itself tells whose a slot is by the one that was played last, then by the name.
    """
    if source.kind != ACTION or not SLOTS:
        return []
    action, found = _action(source), []
    for thing in (*bpy.data.objects, *bpy.data.armatures, *bpy.data.shape_keys):
        animation = thing.animation_data
        if thing == armature or animation is None or thing.library:
            continue
        slots = [slot for slot in action.slots if slot.target_id_type == thing.id_type]
        for wanted in (animation.last_slot_identifier, f"{thing.id_type[:2]}{thing.name}"):
            own = next((slot for slot in slots if slot.identifier == wanted), None)
            if own:
                need_no_tweaking(thing)
                found.append((thing, own))
                break
    return found


def mixed_motions(armature: bpy.types.Object, motions: Iterable[Source]) -> str:
    """Return in words which motion is played while what else moves an armature plays another; empty if none is."""
    leader = leader_of(armature)
    leant = _leant_on(leader)
    for source in motions:
        if source.kind == TIMELINE:
            continue
        own = [thing for thing, _ in _companions(leader, source)]
        for thing in leant:
            animation = None if thing in own else _animation_of(thing)
            if changing_paths(animation) and (source.kind == ACTION or animation.action):
                return (
                    f"'{thing.name}' moves '{armature.name}', too: while '{source.name}' is sampled, it moves as on "
                    "the timeline. Where both belong together, choose the timeline or give both one action."
                )
        free = [thing for thing in leant if isinstance(thing, bpy.types.Object) and thing not in own]
        if free and (slot := _unplayed_slot(leader, source)):
            return (
                f"The slot '{slot}' of the action '{source.name}' is played by nothing, and '{armature.name}' leans "
                f"on '{free[0].name}'; give that object the action and its slot once, if it belongs to it."
            )
    return ""


def _unplayed_slot(armature: bpy.types.Object, source: Source) -> str:
    """Return the name of a slot for an object without bones that nothing plays here; empty without one."""
    if source.kind != ACTION or not SLOTS:
        return ""
    action, played = _action(source), [slot for _, slot in _companions(armature, source)]
    slots = [slot for slot in action.slots if slot.target_id_type == "OBJECT" and slot not in played]
    bare = [slot for slot in slots if not any(_bone(curve.data_path) for curve in curves_of(action, slot))]
    return next((slot.name_display for slot in bare if not slot.users()), "")


def _animation_of(thing: bpy.types.ID) -> bpy.types.AnimData | None:
    return getattr(thing, "animation_data", None)  # collections and images have none


def _leant_on(thing: bpy.types.Object) -> list[bpy.types.ID]:
    """Return what an object's place and pose depend on besides its own animation, and the data of all that."""
    found: list[bpy.types.ID] = []
    waiting: list[bpy.types.ID | None] = [thing.data, thing]
    while waiting:
        item = waiting.pop()
        if item is None or item in found:
            continue
        found.append(item)
        animation = _animation_of(item)
        for curve in animation.drivers if animation else ():
            waiting += [target.id for variable in curve.driver.variables for target in variable.targets]
        if isinstance(item, bpy.types.Object):
            waiting += [item.parent, item.data]
            bones = item.pose.bones if item.pose else ()
            constraints = chain(item.constraints, *(bone.constraints for bone in bones))
            for constraint in (each for each in constraints if not each.mute):
                waiting += [getattr(constraint, name, None) for name in ("target", "pole_target")]
                waiting += [target.target for target in getattr(constraint, "targets", ())]
    return [item for item in found if item != thing]


def slot_of(armature: bpy.types.Object, action: bpy.types.Action) -> Any:
    """Return the slot of an action that is an armature's own; None where actions have none, or none moves its bones.

    What the armature plays says it, then what of its strips do, those that are muted last: names of slots stay as
    they were where objects are renamed, appended or copied. A slot that other objects use alone is theirs.

    Raises:
        SetupError: several slots could be meant.
    """
    found = _own_slots(armature, action)
    if len(found) < 2:
        return found[0] if found else None
    names = ", ".join(f"'{slot.name_display}'" for slot in _slots_for(armature, action))
    raise SetupError(
        f"The action '{action.name}' has the slots {names}, and none is told to be of '{armature.name}'; give "
        f"'{armature.name}' this action and its slot once, or make it a strip."
    )


def _own_slots(armature: bpy.types.Object, action: bpy.types.Action) -> list[Any]:
    """Return the slot of an action that is an armature's own, or all that could be."""
    candidates, animation = _slots_for(armature, action), armature.animation_data
    if len(candidates) < 2:
        return candidates
    if animation and animation.action == action and animation.action_slot in candidates:
        return [animation.action_slot]
    used = _slots_of_strips(animation, action, candidates) if animation else []
    last = animation.last_slot_identifier if animation else ""
    free = [slot for slot in candidates if not {*slot.users()} - {armature}]
    if not any(slot in free for slot in used) and any(slot.identifier == last for slot in free):
        used = []  # its strips only borrow what others play
    own = used or [slot for slot in candidates if armature in slot.users() or not slot.users()]
    for wanted in (last, f"OB{armature.name}"):
        found = [slot for slot in own if slot.identifier == wanted]
        if found:
            return found
    if any(slot.identifier == last for slot in candidates):
        return candidates  # another object plays the slot that it had, as where a character was appended twice
    return own or candidates


def _slots_of_strips(animation: bpy.types.AnimData, action: bpy.types.Action, candidates: list[Any]) -> list[Any]:
    """Return those of some slots that strips play; of muted strips where no other plays any."""
    strips = list(strips_in(animation.nla_tracks))
    for is_muted in (False, True):
        played = [strip.action_slot for strip, muted in strips if muted == is_muted and strip.action == action]
        if found := [slot for slot in candidates if slot in played]:
            return found
    return []


def _slots_for(armature: bpy.types.Object, action: bpy.types.Action) -> list[Any]:
    """Return the slots of an action that move bones of an armature."""
    if not SLOTS:
        return []
    kinds = ("OBJECT", "UNSPECIFIED")
    return [slot for slot in action.slots if slot.target_id_type in kinds and _moves(action, armature, slot)]


def _is_for(armature: bpy.types.Object, action: bpy.types.Action) -> bool:
    """Return whether an action moves an armature; not where it is of several others, each with a slot of its own."""
    if not SLOTS:
        return _moves(action, armature, None)
    slots = _slots_for(armature, action)
    return len(slots) == 1 or any(armature in slot.users() or not slot.users() for slot in slots)


def _moves(action: bpy.types.Action, armature: bpy.types.Object, slot: Any) -> bool:
    bones = armature.pose.bones
    return any(_bone(curve.data_path) in bones for curve in curves_of(action, slot))


def _range(action: bpy.types.Action, slot: Any) -> tuple[float, float]:
    """Return the first and the last frame of an action, or of what one of its slots holds."""
    ends = [curve.range() for curve in curves_of(action, slot)] if slot and len(action.slots) > 1 else []
    if action.use_frame_range or not ends:
        return tuple(action.frame_range)
    return min(first for first, _ in ends), max(last for _, last in ends)


def _plays_as_it_is(armature: bpy.types.Object, strip: bpy.types.NlaStrip) -> bool:
    """Return whether a strip plays the whole of its action, once, forwards, at its own speed, and in full."""
    slots = _own_slots(armature, strip.action)
    if slots and [strip.action_slot] != slots:
        return False
    slot = slots[0] if slots else None
    whole = (strip.action_frame_start, strip.action_frame_end) == tuple(_range(strip.action, slot))
    plain = (strip.scale, strip.repeat) == (1.0, 1.0) and strip.blend_type == "REPLACE"
    changed = strip.use_reverse or strip.use_animated_influence or strip.use_animated_time or strip.modifiers
    faded = strip.blend_in or strip.blend_out or strip.use_auto_blend
    return whole and plain and not (changed or faded)


def _bone(path: str) -> str:
    """Return the name of the bone that an F-curve moves; empty if it moves none."""
    found = re.match(r'pose\.bones\["((?:[^"\\]|\\.)*)"\]', path)
    return bpy.utils.unescape_identifier(found[1]) if found else ""


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


def assign(animation: bpy.types.AnimData, action: bpy.types.Action, slot: Any = None) -> None:
    """Play an action by one of its slots, by one that suits where none is given."""
    animation.action = action
    if slot:
        animation.action_slot = slot
    elif SLOTS and animation.action_slot is None and animation.action_suitable_slots:
        animation.action_slot = animation.action_suitable_slots[0]


def _play_alone(animation: bpy.types.AnimData, strip: bpy.types.NlaStrip) -> None:
    """Mute everything but one strip, and but those that it leads from and to."""
    animation.action, animation.use_nla = None, True
    for track in animation.nla_tracks:
        track.is_solo = False
        track.mute = strip.name not in track.strips or track.strips[strip.name] != strip
        for other in track.strips:
            other.mute = other != strip and (track.mute or strip.type != "TRANSITION")
