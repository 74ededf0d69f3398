# SPDX-License-Identifier: GPL-3.0-or-later
"""A garment's surface as it is seen now, with the colours of its classes."""

from __future__ import annotations

import bmesh
import bpy
import numpy as np

from .. import classes as palette
from ..errors import SetupError
from .attributes import current_classes

Surface = tuple[np.ndarray, np.ndarray, np.ndarray]


def class_surface(thing: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> Surface | None:
    """Return points in the world (V, 3), sRGB colours (V, 4) and triangles (T, 3), in any mode.

    As modifiers shape it, but for edit mode; None without classes, or where what is stored are none.
    """
    try:
        found = _edited(thing.data) if thing.mode == "EDIT" else _evaluated(thing.evaluated_get(depsgraph).data)
    except SetupError:
        return None  # the panel says what is wrong
    if found is None or not palette.in_range(found[1]):
        return None
    points, classes, triangles = found
    world = np.array(thing.matrix_world)
    return points @ world[:3, :3].T + world[:3, 3], palette.colors_of(classes), triangles


def _edited(mesh: bpy.types.Mesh) -> Surface | None:
    edited = bmesh.from_edit_mesh(mesh)
    layer = edited.verts.layers.int.get(palette.ATTRIBUTE)
    if layer is None:
        return None
    edited.verts.index_update()
    points = np.array([vertex.co for vertex in edited.verts]).reshape(-1, 3)
    classes = np.array([vertex[layer] for vertex in edited.verts], dtype=np.int32)
    triangles = [[loop.vert.index for loop in corners] for corners in edited.calc_loop_triangles()]
    return points, classes, np.array(triangles, dtype=np.int32).reshape(-1, 3)


def _evaluated(mesh: bpy.types.Mesh) -> Surface | None:
    classes = current_classes(mesh)
    if classes is None:
        return None
    points = np.empty(len(mesh.vertices) * 3, dtype=np.float32)
    mesh.vertices.foreach_get("co", points)
    mesh.calc_loop_triangles()
    triangles = np.empty(len(mesh.loop_triangles) * 3, dtype=np.int32)
    mesh.loop_triangles.foreach_get("vertices", triangles)
    return points.reshape(-1, 3), classes, triangles.reshape(-1, 3)
