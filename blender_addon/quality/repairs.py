# SPDX-License-Identifier: GPL-3.0-or-later
"""Repairs of a mesh that need no decision by an artist, and of an armature's scale."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import bmesh
import bpy
import numpy as np
from mathutils import Matrix

from ssilk_core.scene.mesh.topology import SAME_PLACE

from ..errors import SetupError
from ..scene.garment import rest_world
from ..scene.meshes import edited
from ..scene.shapes import mixed_points

DISPLACEMENT = "SSILK Displacement"  # mesh attribute: how far vertices moved, in the mesh's own space
MERGE = 2 * SAME_PLACE  # [m]; longer than the diagonal of a cell in which ssilk takes vertices for one
ROUNDING = 1e-5  # [m] of coordinates on their way through float32 in USD
Repair = Callable[[bmesh.types.BMesh, Sequence[int], float], None]


def repair_mesh(thing: bpy.types.Object, code: str, indices: Sequence[int]) -> None:
    """Repair a finding of a kind in `REPAIRS` on the vertices or polygons of a mesh. In object mode.

    Raises:
        SetupError: the mesh is linked.
    """
    if thing.data.library:
        raise SetupError(f"'{thing.name}' is linked from another file; repair it there.")
    scale = bpy.context.scene.unit_settings.scale_length * max(map(abs, thing.matrix_world.to_scale()))
    with edited(thing.data) as mesh:
        for sequence in (mesh.verts, mesh.faces):
            sequence.ensure_lookup_table()
        mesh.normal_update()
        REPAIRS[code](mesh, indices, MERGE / scale)


def apply_scale(armature: bpy.types.Object) -> None:
    """Give the bones of an armature that is scaled unequally its scale, and leave all that hangs from it in place.

    Raises:
        SetupError: it is linked, mirrored, animated, or shares its bones.
    """
    name, data = armature.name, armature.data
    if armature.library or data.library:
        raise SetupError(f"'{name}' is linked from another file; apply its scale there.")
    if not min(armature.scale) > 0:
        raise SetupError(f"'{name}' is mirrored; apply its scale by hand and look at its bones.")
    if armature.animation_data:
        raise SetupError(f"'{name}' is animated; its keys hold for bones of this scale: apply it by hand.")
    if data.users != 1:
        raise SetupError(f"'{name}' shares its bones with other objects; make them single-user first.")
    children = {child: child.matrix_world.copy() for child in armature.children}
    data.transform(Matrix.Diagonal(armature.scale).to_4x4())
    armature.scale = (1.0, 1.0, 1.0)
    bpy.context.view_layer.update()
    for child, place in children.items():
        child.matrix_world = place


def move_points(thing: bpy.types.Object, points: np.ndarray) -> np.ndarray:
    """Move the vertices of a mesh to places in the world at rest, shape (V, 3), its shape keys with them.

    Vertices that would not move stay exactly as they are. The mesh attribute `DISPLACEMENT` holds how they moved.

    Returns:
        How far each vertex moved [m], shape (V,).
    """
    mesh, inverse = thing.data, np.array(rest_world(thing).inverted())
    target = points @ inverse[:3, :3].T + inverse[:3, 3]
    old = mixed_points(thing, baked=False)
    moved = np.linalg.norm((target - old) @ _metres(thing).T, axis=1, keepdims=True) > ROUNDING
    offset = np.where(moved, target - old, 0.0)
    for items in [mesh.vertices, *(block.data for block in (mesh.shape_keys.key_blocks if mesh.shape_keys else ()))]:
        items.foreach_set("co", (_coordinates(items) + offset).astype(np.float32).reshape(-1))
    layer = mesh.attributes.get(DISPLACEMENT) or mesh.attributes.new(DISPLACEMENT, "FLOAT_VECTOR", "POINT")
    layer.data.foreach_set("vector", offset.astype(np.float32).reshape(-1))
    mesh.update()
    return displacements(thing)


def displacements(thing: bpy.types.Object) -> np.ndarray:
    """Return how far each vertex was moved by the last `move_points` [m], shape (V,).

    Raises:
        SetupError: none was.
    """
    layer = thing.data.attributes.get(DISPLACEMENT)
    if layer is None or layer.domain != "POINT" or layer.data_type != "FLOAT_VECTOR":
        raise SetupError(f"'{thing.name}' was not pushed out; there is nothing to show.")
    moved = np.empty(len(layer.data) * 3, dtype=np.float32)
    layer.data.foreach_get("vector", moved)
    return np.linalg.norm(moved.reshape(-1, 3) @ _metres(thing).T, axis=1)


def _metres(thing: bpy.types.Object) -> np.ndarray:
    """Return the matrix from displacements in the mesh's own space to metres in the world, shape (3, 3)."""
    return np.array(thing.matrix_world)[:3, :3] * bpy.context.scene.unit_settings.scale_length


def _coordinates(items: bpy.types.bpy_prop_collection) -> np.ndarray:
    points = np.empty(len(items) * 3, dtype=np.float32)
    items.foreach_get("co", points)
    return points.reshape(-1, 3)


def _delete_vertices(mesh: bmesh.types.BMesh, indices: Sequence[int], _: float) -> None:
    bmesh.ops.delete(mesh, geom=[mesh.verts[index] for index in indices], context="VERTS")


def _delete_faces(mesh: bmesh.types.BMesh, indices: Sequence[int], _: float) -> None:
    bmesh.ops.delete(mesh, geom=[mesh.faces[index] for index in indices], context="FACES_ONLY")


def _merge(mesh: bmesh.types.BMesh, indices: Sequence[int], distance: float) -> None:
    bmesh.ops.remove_doubles(mesh, verts=[mesh.verts[index] for index in indices], dist=distance)


def _dissolve(mesh: bmesh.types.BMesh, indices: Sequence[int], distance: float) -> None:
    around = {edge for index in indices for edge in mesh.faces[index].edges}
    bmesh.ops.dissolve_degenerate(mesh, dist=distance, edges=list(around))


def _flip(mesh: bmesh.types.BMesh, indices: Sequence[int], _: float) -> None:
    bmesh.ops.reverse_faces(mesh, faces=[mesh.faces[index] for index in indices])


REPAIRS: dict[str, Repair] = {
    "isolated-vertices": _delete_vertices,
    "duplicate-vertices": _merge,
    "duplicate-faces": _delete_faces,
    "degenerate-faces": _dissolve,
    "inconsistent-winding": _flip,
    "inside-out": _flip,
    "body-inside-out": _flip,
}
