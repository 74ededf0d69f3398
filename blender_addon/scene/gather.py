# SPDX-License-Identifier: GPL-3.0-or-later
"""A dressed character from Blender's data, at rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import bpy
import numpy as np

from ..contract.arrays import Dressed, Joints, Shape
from ..errors import need
from .armature import read_joints
from .attributes import current_classes
from .garment import armature_of, bodies_of, need_plain_shape, shaping_modifiers
from .weights import PLAIN, read_groups, read_kept
from .worn import own_groups


def gather(garment: bpy.types.Object, *, classes: bool = True, proxies: bool = True) -> Dressed:
    """Return a garment with its armature and bodies. In object mode.

    Args:
        classes: whether to take the painted classes along.
        proxies: whether to take the proxies and their weights along; without, the garment's own weights are.

    Raises:
        SetupError: something is missing or cannot be used; the sentence names the object.
    """
    armature = armature_of(garment)
    need_plain_shape(garment)
    joints = read_joints(armature, garment)
    own = joints if proxies else character_joints(joints)
    bodies = bodies_of(garment, armature)
    plain = own_weights(armature, garment, joints)
    weights = plain
    if proxies and joints.proxy_count:
        weights = own_groups(armature, garment, joints.names)
    return Dressed(
        meters_per_unit=bpy.context.scene.unit_settings.scale_length,
        joints=own,
        bodies=tuple(_body(thing, armature, own) for thing in bodies),
        garment=_shape(garment, garment.data, weights),
        classes=current_classes(garment.data) if classes else None,
        plain=plain if own.proxy_count else None,
    )


def character_joints(joints: Joints) -> Joints:
    """Return the joints without proxies."""
    count = joints.character_count
    return Joints(joints.names[:count], joints.parents[:count], joints.binds[:count])


def own_weights(armature: bpy.types.Object, garment: bpy.types.Object, joints: Joints) -> np.ndarray | None:
    """Return the weights that the artist gave a garment over the character's joints; None without.

    Those kept beside a rig go first; a rig's own weights are nobody's.
    """
    names = joints.names[: joints.character_count]
    kept = read_kept(garment.data, PLAIN, names)
    if kept is not None or joints.proxy_count:
        return kept
    weights = own_groups(armature, garment, names)
    bare = int(np.count_nonzero(~weights.any(axis=1)))
    if bare == len(weights):
        return None
    need(
        not bare,
        f"{bare} of {len(weights)} vertices of '{garment.name}' have no bone's weight; paint these, or remove the "
        "vertex groups so that all weights are taken from the body.",
    )
    return weights


def _body(thing: bpy.types.Object, armature: bpy.types.Object, joints: Joints) -> Shape:
    """Return a body at rest; evaluated where modifiers shape it before its armature does."""
    if not shaping_modifiers(thing):
        return _bound(thing, thing.data, joints.names)
    with _at_rest(armature) as depsgraph:
        evaluated = thing.evaluated_get(depsgraph)
        try:
            return _bound(thing, evaluated.to_mesh(), joints.names)
        finally:
            evaluated.to_mesh_clear()


def _bound(thing: bpy.types.Object, mesh: bpy.types.Mesh, names: Sequence[str]) -> Shape:
    weights = read_groups(thing, mesh, names)
    bare = int(np.count_nonzero(~weights.any(axis=1)))
    need(not bare, f"{bare} of {len(weights)} vertices of '{thing.name}' have no bone's weight; paint these.")
    return _shape(thing, mesh, weights)


@contextmanager
def _at_rest(armature: bpy.types.Object) -> Iterator[bpy.types.Depsgraph]:
    before = armature.data.pose_position
    armature.data.pose_position = "REST"
    try:
        yield bpy.context.evaluated_depsgraph_get()
    finally:
        armature.data.pose_position = before


def _shape(thing: bpy.types.Object, mesh: bpy.types.Mesh, weights: np.ndarray | None) -> Shape:
    world = np.array(thing.matrix_world)
    points = _values(mesh.vertices, "co", 3).reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]
    layer = mesh.uv_layers.active
    return Shape(
        name=thing.name,
        points=points,
        counts=_values(mesh.polygons, "loop_total", 1, np.int32),
        corners=_values(mesh.loops, "vertex_index", 1, np.int32),
        inside_out=bool(np.linalg.det(world[:3, :3]) < 0),
        uvs=_values(layer.uv, "vector", 2).reshape(-1, 2) if layer else None,
        weights=weights,
    )


def _values(items: bpy.types.bpy_prop_collection, name: str, width: int, kind: type = np.float32) -> np.ndarray:
    array = np.empty(len(items) * width, dtype=kind)
    items.foreach_get(name, array)
    return array
