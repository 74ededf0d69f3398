# SPDX-License-Identifier: GPL-3.0-or-later
"""What rides on a garment: objects that are parented to three of its vertices, which is Blender's own Vertex
(Triangle). Blender moves them with what the garment's modifiers and shape keys show.
"""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import Mesh
from ssilk_core.scene.riders import Attachment, triangle_beneath

from ..arrays.joints import identifiers
from ..errors import SetupError
from .garment import is_garment
from .gather import ROOT, read_mesh, rest_world
from .meshes import triangles_of
from .modifiers import cage_points
from .objects import scene_units

TRIANGLE = "VERTEX_3"  # the type of such a parent


def riders_of(garment: bpy.types.Object) -> list[bpy.types.Object]:
    """Return what rides on a garment and is rendered, itself or with what hangs on it, by name."""
    found = [each for each in garment.children if each.parent_type == TRIANGLE and _meshes(each)]
    return sorted(found, key=lambda thing: thing.name)


def with_parts(riders: list[bpy.types.Object]) -> list[bpy.types.Object]:
    """Return the meshes of riders: their own and of what hangs on them."""
    return [part for rider in riders for part in _meshes(rider)]


def vertices_beneath(thing: bpy.types.Object, garment: bpy.types.Object) -> list[int]:
    """Return the vertices of the triangle of a garment beneath an object, both as they are shown.

    Raises:
        SetupError: it has no mesh, is deformed or a garment itself, holds the garment, or is far from the cloth.
    """
    parts = _meshes(thing)
    _need_rigid(thing, parts)
    if garment in (thing, *thing.children_recursive):
        raise SetupError(f"'{garment.name}' hangs on '{thing.name}'; what rides on cloth is not above it.")
    depsgraph = bpy.context.evaluated_depsgraph_get()
    units, faces = scene_units(), triangles_of(garment.data)
    cloth = Mesh(f"'{garment.name}'", units.points_to_core(cage_points(garment, depsgraph)), faces)
    points = [_shown_points(part, depsgraph) for part in parts]
    shown = units.points_to_core(np.concatenate(points))
    try:
        return list(triangle_beneath(shown, cloth, f"'{thing.name}'").tolist())
    except SsilkError as error:
        todo = "move it onto the cloth, or parent it to three vertices (Object > Parent > Vertex (Triangle))"
        raise SetupError(f"'{thing.name}': {error.found}; {error.allowed}; {todo}.") from error


def attach(thing: bpy.types.Object, garment: bpy.types.Object, vertices: list[int]) -> None:
    """Parent an object to three vertices of a garment; it stays where it is."""
    place = thing.matrix_world.copy()
    thing.parent, thing.parent_type, thing.parent_vertices = garment, TRIANGLE, vertices
    thing.matrix_parent_inverse = Matrix()
    bpy.context.view_layer.update()
    carrier = thing.matrix_world @ thing.matrix_basis.inverted_safe()
    thing.matrix_parent_inverse = carrier.inverted_safe() @ place @ thing.matrix_basis.inverted_safe()
    bpy.context.view_layer.update()


def gather_riders(garment: bpy.types.Object, trained: Mesh) -> dict[Mesh, tuple[int, ...]]:
    """Return the meshes that ride on a garment [m], on the mesh that it was trained with, and what carries each.

    Raises:
        SetupError: one is deformed itself, or is a garment.
        SsilkError: its vertices lie in a line, or are not there.
    """
    depsgraph, found = bpy.context.evaluated_depsgraph_get(), {}
    riders = riders_of(garment)
    names = iter(identifiers(part.name for part in with_parts(riders)))
    units = scene_units()
    scale = garment.matrix_world.median_scale * units.meters_per_unit
    for rider in riders:
        _need_rigid(rider, _meshes(rider))
        vertices = tuple(rider.parent_vertices)
        carrier = Attachment.to_vertices(vertices, trained, f"'{rider.name}'")
        placed = np.array(rider.matrix_parent_inverse @ rider.matrix_basis @ rider.matrix_world.inverted_safe())
        placed = carrier.frame(trained.points[list(vertices)]) @ np.diag([scale, scale, scale, 1]) @ placed
        for part in _meshes(rider):
            evaluated = part.evaluated_get(depsgraph)
            mesh, back = evaluated.to_mesh(), np.linalg.inv(np.array(rest_world(part)))
            points = units.points_from_core(_moved(placed, _moved(np.array(part.matrix_world), _points(mesh))))
            found[read_mesh(part, mesh, f"{ROOT}/{next(names)}", _moved(back, points))] = vertices
            evaluated.to_mesh_clear()
    return found


def moving_riders(garment: bpy.types.Object) -> str:
    """Return the names of riders that move by themselves on their cloth; empty where none does."""
    moving = [
        each
        for each in riders_of(garment)
        if each.constraints or (each.animation_data and each.animation_data.action)
    ]
    return ", ".join(f"'{each.name}'" for each in moving)


def _meshes(rider: bpy.types.Object) -> list[bpy.types.Object]:
    return [each for each in (rider, *rider.children_recursive) if each.type == "MESH" and not each.hide_render]


def _need_rigid(rider: bpy.types.Object, parts: list[bpy.types.Object]) -> None:
    if not parts:
        raise SetupError(f"'{rider.name}' has no mesh that is rendered; what rides on cloth is a mesh.")
    for part in parts:
        if is_garment(part):
            raise SetupError(f"'{part.name}' is a garment; what rides on cloth is rigid.")
        if any(modifier.type == "ARMATURE" and modifier.object for modifier in part.modifiers):
            raise SetupError(
                f"'{part.name}' is moved by an Armature modifier; what rides on cloth is rigid: remove the modifier."
            )


def _shown_points(part: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
    """Return the vertices of an object in the world, as modifiers make them, shape (V, 3)."""
    evaluated = part.evaluated_get(depsgraph)
    points = _points(evaluated.to_mesh())
    evaluated.to_mesh_clear()
    return _moved(np.array(part.matrix_world), points)


def _points(mesh: bpy.types.Mesh) -> np.ndarray:
    points = np.empty(len(mesh.vertices) * 3, dtype=np.float32)
    mesh.vertices.foreach_get("co", points)
    return points.reshape(-1, 3)


def _moved(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]
