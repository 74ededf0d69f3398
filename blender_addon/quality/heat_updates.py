# SPDX-License-Identifier: GPL-3.0-or-later
"""Heat maps that follow the timeline: they are updated after each frame change, a little at a time.

While a large garment plays, its colours lag behind by as many frames as measuring takes.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import bpy
from bpy.app.handlers import persistent

from .heat import showing

SLICE = 0.04  # seconds that Blender waits for us at a time
BETWEEN = 0.01  # seconds between two slices, for the artist
_steps: Iterator[float] = iter(())
_outdated = False  # whether the frame changed since these steps began


def start_listening() -> None:
    """Register the handler."""
    bpy.app.handlers.frame_change_post.append(_frame_changed)


def stop_listening() -> None:
    """Remove handler and timer."""
    global _steps, _outdated
    _steps, _outdated = iter(()), False
    if _frame_changed in bpy.app.handlers.frame_change_post:
        bpy.app.handlers.frame_change_post.remove(_frame_changed)
    if bpy.app.timers.is_registered(go_on):
        bpy.app.timers.unregister(go_on)


def go_on() -> float | None:
    """Measure and colour for a moment; return when to be called again, None once all is up to date."""
    global _steps, _outdated
    until = time.monotonic() + SLICE
    for _ in _steps:
        if time.monotonic() >= until:
            return BETWEEN
    if not _outdated:
        return None
    _steps, _outdated = _all_shown(), False
    return BETWEEN


def _all_shown() -> Iterator[float]:
    """Colour all garments of the scene that show heat."""
    warm = [thing.name for thing in bpy.context.scene.objects if thing.ssilk.heat and thing.mode == "OBJECT"]
    for name in warm:
        garment = bpy.context.scene.objects.get(name)
        if garment:
            yield from showing(garment, bpy.context.evaluated_depsgraph_get())


@persistent
def _frame_changed(scene: bpy.types.Scene, _: bpy.types.Depsgraph) -> None:
    """Colour when the frame stands: what is played live is written in this very moment."""
    global _outdated
    if not any(thing.ssilk.heat for thing in scene.objects):
        return
    _outdated = True
    if not bpy.app.background and not bpy.app.timers.is_registered(go_on):
        bpy.app.timers.register(go_on, first_interval=0.0)
