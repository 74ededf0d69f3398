# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects that are needed again after a while, in which they may be deleted, renamed or read anew by an undo."""

from __future__ import annotations

import bpy

from ..errors import need


def found_again(uid: int, name: str) -> bpy.types.Object:
    """Return the object with this session_uid.

    Raises:
        SetupError: it was deleted; the sentence calls it `name`.
    """
    thing = next((thing for thing in bpy.data.objects if thing.session_uid == uid), None)
    need(thing, f"'{name}' was deleted meanwhile; nothing was changed.")
    return thing
