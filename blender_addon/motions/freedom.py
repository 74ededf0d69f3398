# SPDX-License-Identifier: GPL-3.0-or-later
"""How freely a garment moves in each frame, and parts of it, as sliders are keyed or driven."""

from __future__ import annotations

import bpy
import numpy as np

from ..scene.armature import proxy_names
from ..scene.garment import armature_of
from ..scene.linked import local_copy
from .evaluating import evaluating
from .keys import SLOTS, curves_of, strips_in

PATH = "ssilk.free"
HELD = {"ssilk_free": 1.0, "ssilk_posed": 0.0}  # sliders of proxies, where nothing holds them


def _animated(thing: bpy.types.Object) -> set[str]:
    """Return the paths of what keys or drivers move."""
    animation = thing.animation_data
    if animation is None:
        return set()
    curves = list(animation.drivers)
    for player in (animation, *(strip for strip, _ in strips_in(animation.nla_tracks))):
        if player.action:
            curves += curves_of(player.action, player.action_slot if SLOTS else None)
    return {curve.data_path for curve in curves}


def is_keyed(garment: bpy.types.Object) -> bool:
    """Return whether keys or a driver say how freely a garment moves."""
    return PATH in _animated(garment)


def is_held(garment: bpy.types.Object) -> bool:
    """Return whether a garment, or a part of it, may be held in some frame."""
    return is_keyed(garment) or garment.ssilk.free < 1 or has_held_parts(garment)


def has_held_parts(garment: bpy.types.Object) -> bool:
    """Return whether proxies or the vertex group of a garment may be held in some frame."""
    settings, armature = garment.ssilk, armature_of(garment)
    if settings.part and (settings.part_free < 1 or "ssilk.part_free" in _animated(garment)):
        return True
    sliders = _sliders(armature, proxy_names(armature, garment))
    moved = _animated(armature)
    return any(value != HELD[what] or path in moved for (_, what), (path, value) in sliders.items())


def _sliders(armature: bpy.types.Object, proxies: list[str]) -> dict[tuple[str, str], tuple[str, float]]:
    """Return path and value of the sliders of proxies, by bone and name."""
    paths = {name: f'pose.bones["{bpy.utils.escape_identifier(name)}"]' for name in proxies}
    return {
        (name, what): (f"{path}.{what}", getattr(armature.pose.bones[name], what))
        for name, path in paths.items()
        for what in HELD
    }


def freedom(garment: bpy.types.Object, frames: range, name: str = "free") -> np.ndarray:
    """Return how freely a garment moves in each frame, from 0, as its bones carry it, to 1, shape (F,).

    Args:
        name: of the slider, which may be that of its vertex group.
    """
    if f"ssilk.{name}" not in _animated(garment):
        return np.full(len(frames), getattr(garment.ssilk, name))
    probe = local_copy(garment)
    try:
        probe.modifiers.clear()
        with evaluating(probe) as at:
            found = [getattr(probe.evaluated_get(at(frame)).ssilk, name) for frame in frames]
    finally:
        bpy.data.objects.remove(probe)
    return np.clip(np.array(found, dtype=float), 0.0, 1.0)


def held_proxies(garment: bpy.types.Object, frames: range) -> dict[tuple[str, str], np.ndarray]:
    """Return sliders of proxies in each frame, shape (F,), by bone and name, without those that never hold."""
    armature = armature_of(garment)
    sliders, moved = _sliders(armature, proxy_names(armature, garment)), _animated(armature)
    found = {each: np.full(len(frames), value) for each, (_, value) in sliders.items()}
    keyed = [each for each, (path, _) in sliders.items() if path in moved]
    if keyed:
        with evaluating(armature) as at:
            for row, frame in enumerate(frames):
                bones = armature.evaluated_get(at(frame)).pose.bones
                for bone, what in keyed:
                    found[bone, what][row] = getattr(bones[bone], what)
    return {each: np.clip(values, 0.0, 1.0) for each, values in found.items() if (values != HELD[each[1]]).any()}
