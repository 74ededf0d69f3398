# SPDX-License-Identifier: GPL-3.0-or-later
"""SSILK in Blender: paint vertex classes, make proxy rigs; what is heavy runs in a Python of its own.

`outside` and `contract` (and `classes`) know nothing of Blender; `scene` reads and changes Blender's data;
`operators` and `panels` are what artists see. Nothing here imports `bpy` before Blender registers the extension.
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
