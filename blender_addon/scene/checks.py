# SPDX-License-Identifier: GPL-3.0-or-later
"""Findings of Blender's own data, in scenes that ssilk cannot read."""

from __future__ import annotations

import bpy

from ssilk_core.authoring.preflight.finding import Finding

from .armature import is_evenly_scaled
from .garment import armature_of
from .modifiers import objections

SCALE, MODIFIER = "unequal-scale", "shaping-modifier"


def scene_findings(garment: bpy.types.Object) -> list[Finding]:
    """Return what must be fixed before ssilk can inspect a garment, with names of objects in place of prims.

    Raises:
        SetupError: it has no armature, or several.
    """
    armature, found = armature_of(garment), []
    if not is_evenly_scaled(armature):
        found.append(Finding(
            severity="error", code=SCALE, prim=armature.name, found="its bones are scaled unequally or mirrored",
            why="joints turn and move, they have no scale", fix="apply its scale (Ctrl A)", fixable=True,
        ))  # fmt: skip
    found += [
        Finding(
            severity="error", code=MODIFIER, prim=garment.name,
            found=f"its modifier '{objection.modifier}' {objection.does}",
            why="what is trained are the vertices of its mesh, which bones move", fix=objection.todo,
        )
        for objection in objections(garment)
    ]  # fmt: skip
    return found
