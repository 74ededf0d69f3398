# SPDX-License-Identifier: GPL-3.0-or-later
"""Keys written in bulk: an action with a slot for each thing that it animates, on tracks beneath the artist's own.

Before Blender 4.4 an action animates one kind of thing; each then gets an action of its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np

from ..errors import SetupError
from ..scene.linked import origin
from ..scene.objects import scene_step

OWNER = "ssilk_garment"  # custom property of an action that was baked: the garment object
LIVE = "ssilk_live"  # custom property of one that stands for live playback, until that ends
SLOTS = hasattr(bpy.types, "ActionSlot")  # since Blender 4.4
STEADY = 1e-6  # of a key's value: rounding
LINEAR = bpy.types.Keyframe.bl_rna.properties["interpolation"].enum_items["LINEAR"].value


@dataclass(frozen=True, eq=False)
class Channel:
    """Values of one property, one for each frame.

    Attributes:
        path, index: the property, as F-curves name it.
        group: that the curve is listed under.
        values: shape (F,).
    """

    path: str
    index: int
    group: str
    values: np.ndarray


def is_baked(action: bpy.types.Action, garment: bpy.types.Object | None = None) -> bool:
    """Return whether an action was baked, for this garment if one is given."""
    baked = OWNER in action.keys()  # noqa: SIM118 (no dictionary)
    return baked and (garment is None or action[OWNER] == garment)


def is_live(action: bpy.types.Action) -> bool:
    """Return whether an action stands for live playback."""
    return LIVE in action.keys()  # noqa: SIM118 (no dictionary)


def has_keys(garment: bpy.types.Object) -> bool:
    """Return whether anything was baked for a garment."""
    return any(is_baked(action, garment) and not is_live(action) for action in bpy.data.actions)


def has_live_keys(garment: bpy.types.Object, things: Sequence[Any]) -> bool:
    """Return whether keys of live playback are on tracks of each of these objects and shape keys."""
    return all(_tracks(thing, garment, live=True) for thing in things)


def curves_of(action: bpy.types.Action, slot: Any = None) -> Iterator[bpy.types.FCurve]:
    """Yield the F-curves of all slots, or of one."""
    if not SLOTS:
        yield from action.fcurves
        return
    for layer in action.layers:
        for strip in layer.strips:
            for bag in strip.channelbags:
                if slot is None or bag.slot_handle == slot.handle:
                    yield from bag.fcurves


def changing_paths(animation: bpy.types.AnimData | None) -> set[str]:
    """Return which properties drivers move now, or keys whose values differ."""
    if animation is None:
        return set()
    strips = strips_in(animation.nla_tracks if animation.use_nla else ())
    players: list[Any] = [animation, *(strip for strip, muted in strips if not muted)]
    curves: list[Any] = list(animation.drivers)
    for player in players:
        if player.action and not (SLOTS and player.action_slot is None):
            played = curves_of(player.action, player.action_slot if SLOTS else None)
            curves += [curve for curve in played if not _is_constant(curve)]
    return {curve.data_path for curve in curves if not curve.mute}


def _is_constant(curve: bpy.types.FCurve) -> bool:
    """Return whether a curve keeps one value, as where an artist keyed a shape once."""
    values = {value for key in curve.keyframe_points for value in (key.co.y, key.handle_left.y, key.handle_right.y)}
    return bool(values) and max(values) - min(values) < STEADY and not curve.modifiers


def strips_in(tracks: Iterable[bpy.types.NlaTrack]) -> Iterator[tuple[bpy.types.NlaStrip, bool]]:
    """Yield all strips of tracks, those inside meta strips too, and whether each is muted or in what is."""
    for track in tracks:
        yield from _strips_within(track.strips, track.mute)


def _strips_within(strips: Iterable[bpy.types.NlaStrip], muted: bool) -> Iterator[tuple[bpy.types.NlaStrip, bool]]:
    for strip in strips:
        yield strip, muted or strip.mute
        yield from _strips_within(strip.strips, muted or strip.mute)


def need_tracks(things: Sequence[Any]) -> None:
    """Check that tracks can be added to the animation of objects and shape keys.

    Raises:
        SetupError: one is in tweak mode, a track is solo, or all are switched off.
    """
    for thing in things:
        animation = thing.animation_data
        if animation:
            name = f"'{thing.name}'"
            need_no_tweaking(thing)
            off = len(animation.nla_tracks) and not animation.use_nla
            if off:
                raise SetupError(f"The NLA tracks of {name} are switched off; switch them on in the NLA editor.")
            solo = next((track for track in animation.nla_tracks if track.is_solo), None)
            if solo:
                raise SetupError(
                    f"The NLA track '{solo.name}' of {name} is solo, so that baked keys would not show; "
                    "switch its star off in the NLA editor."
                )


def need_no_tweaking(thing: Any) -> None:
    """Raise `SetupError` if a strip of an object or of shape keys is being tweaked: its action cannot be set then."""
    if thing.animation_data and thing.animation_data.use_tweak_mode:
        raise SetupError(f"A strip of '{thing.name}' is being tweaked; leave tweak mode (Tab) first.")


def bake_keys(
    garment: bpy.types.Object, start: int, moved: Sequence[tuple[Any, Sequence[Channel]]], *, live: bool = False
) -> None:
    """Put keys in place of those that were baked for a garment before.

    They lie on tracks of their own, beneath the action in which the artist animates; older ones keep their place.

    Args:
        start: the first frame.
        moved: objects or shape keys, each with what moves on it, which may be nothing.
        live: whether they stand for live playback; those of a bake stay beneath them.
    """
    for thing, channels in moved:
        if not channels:
            _remove_tracks(thing, garment, live)
    moving = [(thing, channels) for thing, channels in moved if channels]
    tracks = [_cleared_track(thing, garment, live) for thing, _ in moving]
    _remove_actions(garment, live)
    action, step = None, scene_step()
    for track, (thing, channels) in zip(tracks, moving):
        if action is None or not SLOTS:
            action = bpy.data.actions.new(track.name)
            action[OWNER] = garment
            if live:
                action[LIVE] = True
        bag = _Bag(action, thing)
        for channel in channels:
            _write(bag.new_curve(channel), start * step, channel.values, step)
        bag.play_on(track, start * step, (start + len(channels[0].values) - 1) * step)


def new_action(name: str, thing: Any, start: float, step: float, channels: Sequence[Channel]) -> bpy.types.Action:
    """Return a new action that moves a thing, and stays in the file though nothing plays it.

    Args:
        start, step: the frame of the first key, and how many frames lie between two.
    """
    action = bpy.data.actions.new(name)
    action.use_fake_user = True
    bag = _Bag(action, thing)
    for channel in channels:
        _write(bag.new_curve(channel), start, channel.values, step)
    return action


def remove_keys(garment: bpy.types.Object, things: Sequence[Any], *, live: bool | None = None) -> None:
    """Remove what was baked for a garment from the animation of objects and shape keys.

    Args:
        live: whether to remove what stands for live playback, or all but that; None for everything.
    """
    for thing in things:
        _remove_tracks(thing, garment, live)
    _remove_actions(garment, live)


def _is_of(action: bpy.types.Action | None, garment: bpy.types.Object, live: bool | None) -> bool:
    return bool(action and is_baked(action, garment)) and live in (None, is_live(action))


def _remove_tracks(thing: Any, garment: bpy.types.Object, live: bool | None) -> None:
    for track in _tracks(thing, garment, live):
        thing.animation_data.nla_tracks.remove(track)


def _tracks(thing: Any, garment: bpy.types.Object, live: bool | None) -> list[bpy.types.NlaTrack]:
    """Return the tracks on which something plays that was baked for a garment."""
    tracks = thing.animation_data.nla_tracks if thing.animation_data else ()
    return [track for track in tracks if any(_is_of(strip.action, garment, live) for strip in track.strips)]


def mute_inherited(garment: bpy.types.Object, things: Sequence[Any], muted: bool = True) -> None:
    """Mute what the file that a garment is linked from has baked for it, or let it play; what was copied goes."""
    linked = origin(garment)
    for thing in things if linked != garment else ():
        for track in _tracks(thing, linked, None):
            if track.is_override_data:
                track.mute = muted
            else:
                thing.animation_data.nla_tracks.remove(track)


def _cleared_track(thing: Any, garment: bpy.types.Object, live: bool) -> bpy.types.NlaTrack:
    """Return the garment's track of a thing, made if there is none, without what was baked."""
    found = _tracks(thing, garment, live)
    if not found:
        track = thing.animation_data_create().nla_tracks.new()
        track.name = f"SSILK {garment.name}{' live' if live else ''}"
        return track
    for strip in list(found[0].strips):
        if _is_of(strip.action, garment, live):
            found[0].strips.remove(strip)
    return found[0]


def _remove_actions(garment: bpy.types.Object, live: bool | None) -> None:
    for action in [action for action in bpy.data.actions if _is_of(action, garment, live)]:
        bpy.data.actions.remove(action)


def continuous(turns: np.ndarray) -> np.ndarray:
    """Return rotations with signs that are nearest from frame to frame: Blender interpolates numbers between keys.

    Args:
        turns: unit quaternions (w, x, y, z), shape (F, ..., 4).
    """
    flips = np.where((turns[1:] * turns[:-1]).sum(-1) < 0, -1.0, 1.0)
    return np.concatenate([turns[:1], turns[1:] * np.cumprod(flips, axis=0)[..., None]])


class _Bag:
    """The curves of one thing in an action."""

    def __init__(self, action: bpy.types.Action, thing: Any) -> None:
        self.action = action
        if SLOTS:
            self.slot = action.slots.new(id_type=thing.id_type, name=thing.name)
            layer = action.layers[0] if action.layers else action.layers.new("Baked")
            strip = layer.strips[0] if layer.strips else layer.strips.new(type="KEYFRAME")
            self.bag = strip.channelbag(self.slot, ensure=True)

    def new_curve(self, channel: Channel) -> bpy.types.FCurve:
        if not SLOTS:
            return self.action.fcurves.new(channel.path, index=channel.index, action_group=channel.group)
        curve = self.bag.fcurves.new(channel.path, index=channel.index)
        curve.group = self.bag.groups.get(channel.group) or self.bag.groups.new(channel.group)
        return curve

    def play_on(self, track: bpy.types.NlaTrack, start: float, end: float) -> None:
        """Play the curves on a track, frame by frame where their keys are."""
        strip = track.strips.new(self.action.name, round(start), self.action)
        strip.action_frame_start, strip.action_frame_end = start, end
        strip.frame_start, strip.frame_end = start, max(end, start + 1)
        if SLOTS:
            strip.action_slot = self.slot


def _write(curve: bpy.types.FCurve, start: float, values: np.ndarray, step: float = 1.0) -> None:
    points = np.stack([start + step * np.arange(len(values)), values], axis=1).astype(np.float32)
    curve.keyframe_points.add(len(values))
    curve.keyframe_points.foreach_set("co", points.reshape(-1))
    curve.keyframe_points.foreach_set("interpolation", np.full(len(values), LINEAR, dtype=np.int32))
    curve.update()
