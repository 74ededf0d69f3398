# SPDX-License-Identifier: GPL-3.0-or-later
"""How freely a garment moves in each frame, as its slider is keyed or driven."""

from __future__ import annotations

import bpy
import numpy as np

from ..scene.linked import local_copy
from .evaluating import evaluating
from .keys import SLOTS, curves_of, strips_in

PATH = "ssilk.free"


def is_keyed(garment: bpy.types.Object) -> bool:
    """Return whether keys or a driver say how freely a garment moves."""
    animation = garment.animation_data
    if animation is None:
        return False
    curves = list(animation.drivers)
    for player in (animation, *(strip for strip, _ in strips_in(animation.nla_tracks))):
        if player.action:
            curves += curves_of(player.action, player.action_slot if SLOTS else None)
    return any(curve.data_path == PATH for curve in curves)


def is_held(garment: bpy.types.Object) -> bool:
    """Return whether a garment may be held in some frame."""
    return is_keyed(garment) or garment.ssilk.free < 1


def freedom(garment: bpy.types.Object, frames: range) -> np.ndarray:
    """Return how freely a garment moves in each frame, from 0, as its bones carry it, to 1, shape (F,)."""
    if not is_keyed(garment):
        return np.full(len(frames), garment.ssilk.free)
    probe = local_copy(garment)
    try:
        probe.modifiers.clear()
        with evaluating(probe) as at:
            found = [probe.evaluated_get(at(frame)).ssilk.free for frame in frames]
    finally:
        bpy.data.objects.remove(probe)
    return np.clip(np.array(found, dtype=float), 0.0, 1.0)
