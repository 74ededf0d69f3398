# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether this Blender runs the scripts of its file, so that a Blender beside it runs them as well, or neither.

Blender tells what it refused to run (`bpy.app.autoexec_fail`), and what its preferences say of files in general, but
not what the artist allowed for this file. A driver tells: it is evaluated by Python, or not at all.
"""

from __future__ import annotations

import bpy

NEEDS_PYTHON = "[1].count(1)"  # a method is what Blender allows in no driver of a file that it does not trust


def run_here() -> bool:
    """Return whether Python drivers and registered texts of the file run; False for a file without any."""
    return _any() and _is_run()


def _any() -> bool:
    """Return whether the file has scripts. Without any nothing is tried, since Blender warns of what it refused."""
    owners = (owner.animation_data for owner in bpy.data.user_map() if hasattr(owner, "animation_data"))
    drivers = (curve.driver for animation in owners if animation for curve in animation.drivers)
    return any(text.use_module for text in bpy.data.texts) or any(
        driver.type == "SCRIPTED" and not driver.is_simple_expression for driver in drivers
    )


def _is_run() -> bool:
    """Return whether Blender evaluates a driver by Python, in a scene that is removed again."""
    scene = bpy.data.scenes.new("SSILK")
    try:
        scene["evaluated"] = 0.0
        scene.driver_add('["evaluated"]').driver.expression = NEEDS_PYTHON
        scene.view_layers[0].update()
        return scene["evaluated"] == 1.0
    finally:
        bpy.data.scenes.remove(scene)
