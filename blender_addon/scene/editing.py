# SPDX-License-Identifier: GPL-3.0-or-later
"""Classes of a mesh in edit mode, where its attributes live in a BMesh."""

from __future__ import annotations

import bmesh
import bpy
import numpy as np

from ssilk_core.scene.assets import TIGHT

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


def edited_classes(mesh: bpy.types.Mesh) -> np.ndarray | None:
    """Return the class attribute of each vertex, shape (V,); None without one, or where Python cannot read it."""
    edited = bmesh.from_edit_mesh(mesh)
    layer = edited.verts.layers.int.get(palette.ATTRIBUTE)  # 8 bits are no layer that Python knows
    return None if layer is None else np.array([vertex[layer] for vertex in edited.verts], dtype=np.int32)


def edited_colors(mesh: bpy.types.Mesh) -> np.ndarray | None:
    """Return the painted sRGB colour of each vertex, shape (V, 4); None without."""
    edited = bmesh.from_edit_mesh(mesh)
    layer = edited.verts.layers.color.get(palette.COLOR_ATTRIBUTE)
    return None if layer is None else np.array([vertex[layer] for vertex in edited.verts]).reshape(-1, 4)
