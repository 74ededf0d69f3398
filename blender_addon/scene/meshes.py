# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes opened as a BMesh, where Python reads and writes per-vertex lists many times faster; triangles, points."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bmesh
import bpy
import numpy as np


@contextmanager
def opened(mesh: bpy.types.Mesh) -> Iterator[bmesh.types.BMesh]:
    """Yield what a mesh holds, to be read. Not in edit mode."""
    content = bmesh.new()
    try:
        content.from_mesh(mesh, face_normals=False, vertex_normals=False)
        yield content
    finally:
        content.free()


@contextmanager
def edited(mesh: bpy.types.Mesh) -> Iterator[bmesh.types.BMesh]:
    """Yield what a mesh holds, and put back what became of it unless something fails. In object mode."""
    with opened(mesh) as content:
        yield content
        content.to_mesh(mesh)
    mesh.update()


def triangles_of(mesh: bpy.types.Mesh) -> np.ndarray:
    """Return the vertices of each triangle of a mesh's faces, shape (T, 3)."""
    mesh.calc_loop_triangles()
    triangles = np.empty(len(mesh.loop_triangles) * 3, dtype=np.int32)
    mesh.loop_triangles.foreach_get("vertices", triangles)
    return triangles.reshape(-1, 3)


def world_points(thing: bpy.types.Object) -> np.ndarray:
    """Return the vertices of an evaluated object in the world, shape (V, 3)."""
    points = np.empty(len(thing.data.vertices) * 3, dtype=np.float32)
    thing.data.vertices.foreach_get("co", points)
    world = np.array(thing.matrix_world)
    return points.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]
