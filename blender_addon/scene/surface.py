# SPDX-License-Identifier: GPL-3.0-or-later
"""A garment's evaluated surface with the colours of its classes."""

from __future__ import annotations

import bpy
import numpy as np

from .. import classes as palette
from ..errors import SetupError
from .attributes import current_classes
from .meshes import triangles_of

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
