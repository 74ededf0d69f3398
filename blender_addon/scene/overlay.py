# SPDX-License-Identifier: GPL-3.0-or-later
"""Classes drawn over garments in 3D views, in any mode and shading, without touching the file."""

from __future__ import annotations

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from ..arrays import classes as palette
from ..arrays.classes import ATTRIBUTE
from ..errors import SetupError
from .classes import current_classes
from .meshes import triangles_of

OPACITY = 0.6
NEARER = 2e-5  # of the depth range, so that the overlay wins against the surface that it lies on

_handle: object | None = None


def shown() -> bool:
    """Return whether the overlay is on."""
    return _handle is not None


def show() -> None:
    """Start drawing the overlay; do nothing without windows."""
    global _handle
    if _handle is None and not bpy.app.background:
        _handle = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")


def hide() -> None:
    """Stop drawing the overlay."""
    global _handle
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
        _handle = None


def _draw() -> None:
    context = bpy.context
    depsgraph = context.evaluated_depsgraph_get()
    gpu.state.blend_set("ALPHA")
    gpu.state.depth_test_set("LESS_EQUAL")
    with gpu.matrix.push_pop_projection():
        gpu.matrix.load_projection_matrix(_nearer(gpu.matrix.get_projection_matrix()))
        for thing in context.visible_objects:
            if thing.type == "MESH" and ATTRIBUTE in thing.data.attributes:
                _draw_surface(class_surface(thing, depsgraph))
    gpu.state.depth_test_set("NONE")
    gpu.state.blend_set("NONE")


def _draw_surface(surface: tuple[np.ndarray, np.ndarray, np.ndarray] | None) -> None:
    if surface is None:
        return
    points, colors, triangles = surface
    shader = gpu.shader.from_builtin("SMOOTH_COLOR")
    content = {"pos": points.astype(np.float32), "color": (colors * [1, 1, 1, OPACITY]).astype(np.float32)}
    batch_for_shader(shader, "TRIS", content, indices=triangles).draw(shader)


def _nearer(projection: Matrix) -> Matrix:
    """Return a projection that moves everything towards the viewer by a small depth."""
    moved = projection.copy()
    moved[2] = projection[2] - NEARER * projection[3]
    return moved


Surface = tuple[np.ndarray, np.ndarray, np.ndarray]


def class_surface(thing: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> Surface | None:
    """Return points in the world (V, 3), sRGB colours (V, 4) and triangles (T, 3), in any mode.

    None without classes, or where what is stored are none: the panel says what is wrong.
    """
    evaluated = thing.evaluated_get(depsgraph)
    mesh = evaluated.to_mesh()  # in edit mode this is what is being edited, and far faster to read
    try:
        classes = current_classes(mesh)
        if classes is None:
            return None
        points, triangles = _placed(mesh, np.array(thing.matrix_world))
        return points, palette.colors_of(classes), triangles
    except SetupError:
        return None
    finally:
        evaluated.to_mesh_clear()


def _placed(mesh: bpy.types.Mesh, world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    points = np.empty(len(mesh.vertices) * 3, dtype=np.float32)
    mesh.vertices.foreach_get("co", points)
    return points.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3], triangles_of(mesh)
