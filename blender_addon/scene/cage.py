# SPDX-License-Identifier: GPL-3.0-or-later
"""The vertices of a mesh as bones move them, beneath modifiers that make more of them, or fewer."""

from __future__ import annotations

import bpy
import numpy as np

from ..errors import SetupError
from .meshes import world_points
from .modifiers import BELOW, reshapes
from .shapes import mixed_points
from .weights import read_groups


def is_refined(thing: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> bool:
    """Return whether modifiers change how many vertices an object has."""
    return len(thing.evaluated_get(depsgraph).data.vertices) != len(thing.data.vertices)


def cage_points(thing: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
    """Return the vertices of an object's own mesh in the world as they are shown, shape (V, 3).

    Where modifiers change how many there are, these are the vertices that they begin with: shape keys, then bones.

    Raises:
        SetupError: modifiers do so before bones move the mesh.
    """
    if not is_refined(thing, depsgraph):
        return world_points(thing.evaluated_get(depsgraph))
    if reshapes(thing):
        shown, count = len(thing.evaluated_get(depsgraph).data.vertices), len(thing.data.vertices)
        raise SetupError(
            f"A modifier gives '{thing.name}' {shown} vertices where its mesh has {count}, before bones move it; "
            f"apply it, {BELOW}, or switch it off in viewports."
        )
    world = np.array(thing.matrix_world)
    points = mixed_points(thing) @ world[:3, :3].T + world[:3, 3]
    bones = next((item.object for item in thing.modifiers if item.type == "ARMATURE" and item.object), None)
    return _moved_by(bones.evaluated_get(depsgraph), thing, points) if bones else points


def _moved_by(armature: bpy.types.Object, thing: bpy.types.Object, points: np.ndarray) -> np.ndarray:
    """Return points in the world, shape (V, 3), as linear blend skinning moves them; those without weights stay."""
    bones = [bone for bone in armature.pose.bones if bone.bone.use_deform]
    weights = read_groups(thing, thing.data, [bone.name for bone in bones]).astype(np.float64)
    total = weights.sum(axis=1, keepdims=True)
    place = np.array(armature.matrix_world)
    back = np.linalg.inv(place)
    turns = [place @ np.array(bone.matrix @ bone.bone.matrix_local.inverted()) @ back for bone in bones]
    mixed = (weights @ np.array(turns).reshape(-1, 16)).reshape(-1, 4, 4) / np.where(total > 0, total, 1)[..., None]
    moved = np.einsum("vij,vj->vi", mixed[:, :3, :3], points) + mixed[:, :3, 3]
    return np.where(total > 0, moved, points)
