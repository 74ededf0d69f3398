# SPDX-License-Identifier: GPL-3.0-or-later
"""Classes of a mesh in edit mode, where its attributes live in a BMesh."""

from __future__ import annotations

from collections import Counter

import bmesh
import bpy

from ssilk_core.assets import LOOSE, PINNED, TIGHT

from .. import classes as palette


def fill_selected(mesh: bpy.types.Mesh, value: int) -> int:
    """Give the selected vertices a class, and its colour where there are colours; return how many there are.

    All others are tight if the mesh had no classes.
    """
    edited = bmesh.from_edit_mesh(mesh)
    layer = edited.verts.layers.int.get(palette.ATTRIBUTE)
    selected = [vertex.index for vertex in edited.verts if vertex.select]
    if not selected:
        return 0
    if layer is None:
        layer = edited.verts.layers.int.new(palette.ATTRIBUTE)
        for vertex in edited.verts:
            vertex[layer] = TIGHT
    colors = edited.verts.layers.color.get(palette.COLOR_ATTRIBUTE)
    edited.verts.ensure_lookup_table()
    for index in selected:
        edited.verts[index][layer] = value
        if colors:
            edited.verts[index][colors] = (*palette.COLORS[value], 1.0)
    bmesh.update_edit_mesh(mesh, loop_triangles=False, destructive=False)
    return len(selected)


def edited_counts(mesh: bpy.types.Mesh) -> tuple[int, int, int] | None:
    """Return how many vertices are pinned, tight and loose; None without classes."""
    edited = bmesh.from_edit_mesh(mesh)
    layer = edited.verts.layers.int.get(palette.ATTRIBUTE)
    if layer is None:
        return None
    found = Counter(vertex[layer] for vertex in edited.verts)
    return found[PINNED], found[TIGHT], found[LOOSE]
