# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's world as ssilk knows it: its units, z up."""

from __future__ import annotations

import bpy
from ssilk_usd.units import StageUnits


def scene_units() -> StageUnits:
    """Return the scene's unit of length and Blender's up axis."""
    return StageUnits(bpy.context.scene.unit_settings.scale_length, "Z")


def scene_rate() -> float:
    """Return the scene's frames per second [1/s]."""
    render = bpy.context.scene.render
    return render.fps / render.fps_base
