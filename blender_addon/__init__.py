# SPDX-License-Identifier: GPL-3.0-or-later
"""SSILK in Blender: paint vertex classes, rig, train, bake and play garments.

Artists press a button of `panels`; it calls one of `operators`. To train, open `operators/training.py`: it writes
stages (`scene/handover.py`) and begins a job (`outside/jobs.py`). To bake, open `operators/baking.py`; the keys are
put in place by `playback/bake.py`. Live playback runs in `playback/live.py`. `ssilk_core` and `ssilk_usd`, which come
as a wheel, hold scenes and models and know the layout of stages. Nothing imports `bpy` before Blender registers the
extension.
"""

from __future__ import annotations


def register() -> None:
    """Register classes and properties, as Blender asks when it enables the extension."""
    from . import registration

    registration.register()


def unregister() -> None:
    """Undo `register`, and stop what still runs outside."""
    from . import registration

    registration.unregister()
