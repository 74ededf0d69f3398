# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects that are looked up again later, when they may have been deleted, renamed or replaced by an undo."""

from __future__ import annotations

from dataclasses import dataclass

import bpy

from ..errors import SetupError


def found_again(uid: int, name: str) -> bpy.types.Object:
    """Return the object with this session_uid.

    Raises:
        SetupError: it was deleted, though others may still refer to it; the sentence calls it `name`.
    """
    thing = next((thing for thing in bpy.data.objects if thing.session_uid == uid and thing.users_scene), None)
    if not thing:
        raise SetupError(f"'{name}' was deleted meanwhile; nothing was changed.")
    return thing


@dataclass(frozen=True)
class Pair:
    """A garment and its armature, by session_uid, with the names that they had."""

    garment: tuple[int, str]
    armature: tuple[int, str]

    @classmethod
    def of(cls, garment: bpy.types.Object, armature: bpy.types.Object) -> Pair:
        """Remember both."""
        return cls((garment.session_uid, garment.name), (armature.session_uid, armature.name))

    @property
    def name(self) -> str:
        """The name that the garment had."""
        return self.garment[1]

    def objects(self) -> tuple[bpy.types.Object, bpy.types.Object]:
        """Return the garment and the armature; raise `SetupError` if one was deleted."""
        return found_again(*self.garment), found_again(*self.armature)
