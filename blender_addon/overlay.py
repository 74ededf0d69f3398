# SPDX-License-Identifier: GPL-3.0-or-later
"""Classes drawn over garments in 3D views, in any mode and shading, without touching the file."""

from __future__ import annotations

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from .classes import ATTRIBUTE
from .scene.surface import class_surface

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
