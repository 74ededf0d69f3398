# SPDX-License-Identifier: GPL-3.0-or-later
"""Register and unregister every class and property."""

from __future__ import annotations

import bpy

from . import panels, preferences, translations
from .operators import (
    baking,
    classes,
    demo_motions,
    environment,
    garments,
    gltf_export,
    help,
    make_it_move,
    match_bones,
    outfit,
    playback,
    preflight,
    quality,
    riders,
    rig,
    tasks,
    to_bones,
    training,
    try_on,
)
from .panels import plot
from .playback import playing, saving
from .quality import heat_updates, tried_on
from .scene import overlay
from .settings import garment as garment_settings
from .settings import preflight as preflight_settings

CLASSES = (
    *garment_settings.CLASSES,
    *preflight_settings.CLASSES,
    *preferences.CLASSES,
    *tasks.CLASSES,
    *environment.CLASSES,
    *classes.CLASSES,
    *garments.CLASSES,
    *riders.CLASSES,
    *rig.CLASSES,
    *preflight.CLASSES,
    *training.CLASSES,
    *demo_motions.CLASSES,
    *make_it_move.CLASSES,
    *help.CLASSES,
    *baking.CLASSES,
    *match_bones.CLASSES,
    *to_bones.CLASSES,
    *gltf_export.CLASSES,
    *playback.CLASSES,
    *quality.CLASSES,
    *try_on.CLASSES,
    *outfit.CLASSES,
    *panels.CLASSES,
)


def register() -> None:
    """Register all classes, then the properties that use them."""
    for kind in CLASSES:
        bpy.utils.register_class(kind)
    garment_settings.attach()
    preflight_settings.attach()
    translations.register()
    training.start_watching()
    playing.start_listening()
    saving.start_listening()
    heat_updates.start_listening()
    quality.add_key()


def unregister() -> None:
    """Stop what runs outside, then remove properties and classes in reverse."""
    tasks.stop()
    outfit.stop()
    make_it_move.stop()
    overlay.hide()
    quality.remove_key()
    heat_updates.stop_listening()
    tried_on.forget()
    saving.stop_listening()
    playing.stop_listening()
    training.stop_watching(bpy.context)
    plot.forget()
    translations.unregister()
    preflight_settings.detach()
    garment_settings.detach()
    for kind in reversed(CLASSES):
        bpy.utils.unregister_class(kind)
