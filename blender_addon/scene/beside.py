# SPDX-License-Identifier: GPL-3.0-or-later
"""Copies that are shown beside a garment: an empty instances their collection.

The view layer does not hold what is instanced, so that no other operator finds it.
"""

from __future__ import annotations

from collections.abc import Sequence

import bpy

GAP = 1.3  # distance in widths of what is shown


def show_beside(
    garment: bpy.types.Object,
    things: Sequence[bpy.types.Object],
    owner: str,
    *,
    name: str,
    empty: str,
    width: float,
    into: bpy.types.Collection,
) -> bpy.types.Object:
    """Show objects beside a garment, and return the empty that does.

    Args:
        owner: custom property of the empty that names the garment.
        name, empty: what the collection and the empty are called.
        width: of what is shown, in Blender's units.
        into: the collection that takes the empty.
    """
    collection = bpy.data.collections.new(name)
    for thing in things:
        collection.objects.link(thing)
    shown = bpy.data.objects.new(empty, None)
    shown[owner] = garment
    shown.instance_type, shown.instance_collection = "COLLECTION", collection
    shown.location.x = GAP * width
    into.objects.link(shown)
    return shown


def find_beside(garment: bpy.types.Object, owner: str) -> bpy.types.Object | None:
    """Return the empty that shows copies of a garment; None where there is none."""
    return next((thing for thing in bpy.data.objects if thing.type == "EMPTY" and thing.get(owner) == garment), None)


def remove_beside(shown: bpy.types.Object) -> None:
    """Remove copies and the empty that shows them."""
    collection = shown.instance_collection
    for copy in list(collection.objects) if collection else ():
        remove_mesh(copy.data)  # and the copy with it
    if collection:
        bpy.data.collections.remove(collection)
    bpy.data.objects.remove(shown)


def remove_mesh(mesh: bpy.types.Mesh) -> None:
    """Remove a mesh with its shape keys and the objects that have it."""
    keys = mesh.shape_keys.name if mesh.shape_keys else ""
    bpy.data.meshes.remove(mesh)
    _remove_keys(keys)


def clear_shapes(thing: bpy.types.Object) -> None:
    """Take all shape keys from an object; it has its shape without any."""
    if thing.data.shape_keys:
        name = thing.data.shape_keys.name
        thing.shape_key_clear()
        _remove_keys(name)


def _remove_keys(name: str) -> None:
    """Remove what is left of shape keys: Blender frees them since 5.2; before, they stay unused in the file."""
    left = bpy.data.shape_keys.get(name) if name else None
    if left:
        bpy.data.batch_remove([left])
