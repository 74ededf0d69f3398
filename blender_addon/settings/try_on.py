# SPDX-License-Identifier: GPL-3.0-or-later
"""Which other body a garment is tried on, and how far towards it it is shown."""

from __future__ import annotations

import bpy
from bpy.props import CollectionProperty, EnumProperty, FloatProperty, StringProperty

from ..arrays.try_on import LEAST, MOST
from .training import RELATIVE

KEYS, STAGE = "KEYS", "STAGE"
BODIES = [
    (KEYS, "Shape Keys", "The character's own bodies with other values of their shape keys"),
    (STAGE, "USD Stage", "Another character with the same joints, and bodies with the same points and faces"),
]


def _found(item: bpy.types.PropertyGroup, _: bpy.types.Context, typed: str) -> list[str]:
    """Return the shape keys of the garment's bodies that what was typed may mean."""
    from ..scene.other_bodies import names_of_keys

    return [name for name in names_of_keys(item.id_data) if typed.lower() in name.lower()]


def _show(settings: bpy.types.PropertyGroup, _: bpy.types.Context) -> None:
    from ..quality import tried_on

    tried_on.wear(settings.id_data)


class BodyKey(bpy.types.PropertyGroup):
    """A shape key of the bodies, and its value on the body to try on."""

    key: StringProperty(name="Shape Key", description="Shape key of a body; all bodies that have it", search=_found)
    value: FloatProperty(
        name="Value",
        description="Value of the shape key on the body to try on",
        default=1.0,
        min=-10.0,
        max=10.0,
        soft_min=0.0,
        soft_max=1.0,
    )


class TryOnSettings(bpy.types.PropertyGroup):
    """The body, and how far towards it."""

    body: EnumProperty(name="Body", description="Where the body to try on comes from", items=BODIES)
    keys: CollectionProperty(type=BodyKey, description="Shape keys that make the body", options={"HIDDEN"})
    stage: StringProperty(
        name="Stage",
        subtype="FILE_PATH",
        options=RELATIVE,
        description="USD file of another character of the family; followed by :/Root where it holds several",
    )
    share: FloatProperty(
        name="Share",
        description="0 is the body that the garment was fitted to, 1 the other one",
        default=1.0,
        min=LEAST,
        max=MOST,
        precision=2,
        subtype="FACTOR",
        options=set(),
        update=_show,
    )


CLASSES = (BodyKey, TryOnSettings)
