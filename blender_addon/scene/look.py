# SPDX-License-Identifier: GPL-3.0-or-later
"""What a mesh looks like in Blender that USD does not get, which is handed over as shape, weights and one UV map."""

from __future__ import annotations

from collections.abc import Iterable

import bpy


def lost_looks(things: Iterable[bpy.types.Object]) -> list[str]:
    """Return in words what meshes lose in USD, one for each that loses something."""
    return [f"'{thing.name}' loses {', '.join(lost)}" for thing in things if (lost := _lost(thing))]


def _lost(thing: bpy.types.Object) -> list[str]:
    mesh = thing.data
    materials = {slot.material.name: None for slot in thing.material_slots if slot.material}
    maps = [layer.name for layer in mesh.uv_layers if layer != mesh.uv_layers.active]
    colours = [each.name for each in mesh.color_attributes if not each.name.startswith("SSILK")]  # heat
    kinds = (("material", list(materials)), ("UV map", maps), ("colours", colours))
    return [f"the {kind} '{name}'" for kind, names in kinds for name in names]
