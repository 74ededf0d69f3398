# SPDX-License-Identifier: GPL-3.0-or-later
"""SSILK in Blender: paint vertex classes, rig, train, bake and play garments.

`scene` reads and changes Blender's data. `operators` and `panels` are what artists see. `outside` runs ssilk in
another Python. `ssilk_core` and `ssilk_usd`, which come as a wheel, hold scenes and models and know the layout of
stages. Nothing imports `bpy` before Blender registers the extension.
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
