# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes as arrays: points, triangles, shape keys, and partners across the plane x = 0.

Python reads and writes per-vertex lists many times faster in a BMesh than in a mesh. Blendshapes are relative shape
keys beside the artist's own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import bmesh
import bpy
import numpy as np
from mathutils.kdtree import KDTree

from ..errors import SetupError


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


def rendered_map(mesh: bpy.types.Mesh) -> bpy.types.MeshUVLoopLayer | None:
    """Return the UV map that renders look up textures by; the active one is only what an artist edits."""
    return next((layer for layer in mesh.uv_layers if layer.active_render), mesh.uv_layers.active)


PREFIX = "SSILK "  # begins the names of shape keys that were baked
BASIS = "ssilk_basis"  # custom property of shape keys whose basis came with a bake


def need_relative(garment: bpy.types.Object) -> None:
    """Check that shape keys are relative, so that they add up.

    Raises:
        SetupError: those that are there are absolute.
    """
    keys = garment.data.shape_keys
    if keys and not keys.use_relative:
        raise SetupError(f"The shape keys of '{garment.name}' are absolute; make them Relative.")


def rest_points(garment: bpy.types.Object) -> np.ndarray:
    """Return the points without any shape key, in the object's own space, shape (V, 3)."""
    keys = garment.data.shape_keys
    points = np.empty(len(garment.data.vertices) * 3, dtype=np.float32)
    (keys.reference_key.points if keys else garment.data.vertices).foreach_get("co", points)
    return points.reshape(-1, 3)


def write_shapes(garment: bpy.types.Object, offsets: np.ndarray, names: Sequence[str]) -> list[str]:
    """Put shape keys in place of those that were baked before; return their names. In object mode.

    Args:
        offsets: from the reference key, in the object's own space, shape (K, V, 3).
    """
    names = [PREFIX + name for name in names]
    _remove(garment, keep=names)
    if not names:
        return names
    if not garment.data.shape_keys:
        garment.shape_key_add(name="Basis", from_mix=False)
        garment.data.shape_keys[BASIS] = True
    blocks = garment.data.shape_keys.key_blocks
    for name in names:
        if name not in blocks:
            garment.shape_key_add(name=name, from_mix=False)
    reference, rest = garment.data.shape_keys.reference_key, rest_points(garment)
    for name, offset in zip(names, offsets):
        block = blocks[name]
        block.relative_key, block.slider_min, block.slider_max, block.mute = reference, 0.0, 1.0, False
        block.points.foreach_set("co", (rest + offset).astype(np.float32).reshape(-1))
    return names


def remove_shapes(garment: bpy.types.Object) -> None:
    """Remove the shape keys that were baked, and the basis that came with them if nothing else is left."""
    _remove(garment, keep=())
    keys = garment.data.shape_keys
    if keys and BASIS in keys.keys() and len(keys.key_blocks) == 1:  # noqa: SIM118 (no dictionary)
        garment.shape_key_clear()


def _remove(garment: bpy.types.Object, *, keep: Sequence[str]) -> None:
    keys = garment.data.shape_keys
    for block in list(keys.key_blocks) if keys else ():
        if block.name.startswith(PREFIX) and block.name not in keep:
            garment.shape_key_remove(block)


def partners_across(mesh: bpy.types.Mesh, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (V, 3), and for each the nearest one at its mirrored place, -1 where none is near."""
    points = np.empty(len(mesh.vertices) * 3, dtype=np.float32)
    mesh.vertices.foreach_get("co", points)
    points = points.reshape(-1, 3)
    tree = KDTree(len(points))
    for index, point in enumerate(points.tolist()):
        tree.insert(point, index)
    tree.balance()
    found = (tree.find(point) for point in (points * [-1, 1, 1]).tolist())
    return points, np.array([index if away <= distance else -1 for _, index, away in found], dtype=np.int64)
