# SPDX-License-Identifier: GPL-3.0-or-later
"""Mask modifiers that hide the skin under garments, each on a vertex group of the same name.

A custom property of the body, of that name too, points to the garment, which may be renamed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import bpy
import numpy as np

from ..errors import SetupError

PREFIX = "SSILK Under "  # of the vertex group and the modifier, before the garment's name
LONGEST_NAME = 63  # bytes in UTF-8
WHOLE = 0.99  # weight above which a vertex is hidden, so that subdivision hides nothing between


def _name(garment: bpy.types.Object) -> str:
    """Return the name of the vertex group and of the modifier that are to hide the skin under a garment."""
    return f"{PREFIX}{garment.name}".encode()[:LONGEST_NAME].decode(errors="ignore")


def masked(garment: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the objects whose skin is hidden under a garment."""
    return [thing for thing in bpy.data.objects if thing.type == "MESH" and _masks_under(garment, thing)]


def _masks_under(garment: bpy.types.Object, thing: bpy.types.Object) -> list[str]:
    """Return the names of the modifiers that hide skin of an object under a garment."""
    names = [modifier.name for modifier in thing.modifiers if modifier.type == "MASK"]
    return [name for name in names if thing.get(name) == garment]


def show(garment: bpy.types.Object) -> int:
    """Show all skin under a garment again; return on how many bodies it was hidden."""
    things = masked(garment)
    for thing in things:
        for name in _masks_under(garment, thing):
            group = thing.vertex_groups.get(thing.modifiers[name].vertex_group)
            thing.modifiers.remove(thing.modifiers[name])
            if group:
                thing.vertex_groups.remove(group)
            if name in thing:
                del thing[name]
    return len(things)


@contextmanager
def unmasked() -> Iterator[None]:
    """Show the skin under all garments for as long as bodies are measured."""
    modifiers = [(thing, name) for thing in bpy.data.objects for name in _masks_of(thing)]
    for thing, name in modifiers:
        thing.modifiers[name].show_viewport = False
    try:
        yield
    finally:
        for thing, name in modifiers:
            if name in thing.modifiers:
                thing.modifiers[name].show_viewport = True


def need_unmasked(bodies: Sequence[bpy.types.Object]) -> None:
    """Raise `SetupError` if skin of a body is hidden under a garment, since cloth is measured against all of it."""
    hidden = next((body.name for body in bodies if _masks_of(body)), None)
    if hidden:
        raise SetupError(f"Skin of '{hidden}' is hidden under a garment; choose Show Covered Skin first.")


def _masks_of(thing: bpy.types.Object) -> list[str]:
    """Return the names of the modifiers that hide skin of an object in viewports."""
    return [
        modifier.name
        for modifier in thing.modifiers
        if modifier.type == "MASK" and modifier.name.startswith(PREFIX) and modifier.show_viewport
    ]


def mask(body: bpy.types.Object, garment: bpy.types.Object, vertices: np.ndarray) -> None:
    """Hide vertices of a body under a garment."""
    group, modifier = body.vertex_groups.new(name=_name(garment)), body.modifiers.new(_name(garment), "MASK")
    group.add(vertices.tolist(), 1.0, "REPLACE")
    modifier.vertex_group, modifier.invert_vertex_group, modifier.threshold = group.name, True, WHOLE
    body[modifier.name] = garment
