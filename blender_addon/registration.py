# SPDX-License-Identifier: GPL-3.0-or-later
"""Register and unregister every class and property."""

from __future__ import annotations

import bpy

from . import overlay, panels, preferences, preflight_properties, properties, translations
from .operators import (
    baking,
    classes,
    demo_motions,
    environment,
    fill,
    garments,
    gltf_export,
    help,
    hiding,
    make_it_move,
    playback,
    preflight,
    quality_view,
    rig,
    stages,
    tasks,
    to_bones,
    training,
)
from .operators import overlay as overlay_switch
from .panels import plot
from .scene import heat_updates, playing, saving

CLASSES = (
    *properties.CLASSES,
    *preflight_properties.CLASSES,
    *preferences.CLASSES,
    *tasks.CLASSES,
    *environment.CLASSES,
    *classes.CLASSES,
    *fill.CLASSES,
    *garments.CLASSES,
    *overlay_switch.CLASSES,
    *rig.CLASSES,
    *stages.CLASSES,
    *preflight.CLASSES,
    *training.CLASSES,
    *demo_motions.CLASSES,
    *make_it_move.CLASSES,
    *help.CLASSES,
    *baking.CLASSES,
    *to_bones.CLASSES,
    *gltf_export.CLASSES,
    *playback.CLASSES,
    *quality_view.CLASSES,
    *hiding.CLASSES,
    *panels.CLASSES,
)


def register() -> None:
    """Register all classes, then the properties that use them."""
    for kind in CLASSES:
        bpy.utils.register_class(kind)
    properties.attach()
    preflight_properties.attach()
    translations.register()
    training.start_watching()
    playing.start_listening()
    saving.start_listening()
    heat_updates.start_listening()
    quality_view.add_key()


def unregister() -> None:
    """Stop what runs outside, then remove properties and classes in reverse."""
    tasks.stop()
    make_it_move.stop()
    overlay.hide()
    quality_view.remove_key()
    heat_updates.stop_listening()
    saving.stop_listening()
    playing.stop_listening()
    training.stop_watching(bpy.context)
    plot.forget()
    translations.unregister()
    preflight_properties.detach()
    properties.detach()
    for kind in reversed(CLASSES):
        bpy.utils.unregister_class(kind)
