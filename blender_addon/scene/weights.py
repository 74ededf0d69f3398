# SPDX-License-Identifier: GPL-3.0-or-later
"""Vertex groups and weights that are kept beside them, as dense arrays over joints.

A bake or live playback writes trained weights to a garment. Its own weights are kept as point attributes, one for
each joint, and are restored later. One more attribute holds a signature of the trained weights. A vertex whose
signature differs was painted since, and keeps what was painted.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from itertools import islice

import bpy
import numpy as np

from .armature import keys_of
from .meshes import edited, opened

PLAIN = "ssilk:plain:"  # begins the attributes that keep weights over the character's bones, beside a rig
SAME_WEIGHTS = 1e-4  # difference of signatures


def read_groups(thing: bpy.types.Object, mesh: bpy.types.Mesh, names: Sequence[str]) -> np.ndarray:
    """Return the weights of vertex groups named like joints, shape (V, len(names)).

    Args:
        mesh: the object's, or its evaluated one.
    """
    joints = {name: joint for joint, name in enumerate(names)}
    of_group = np.array([joints.get(group.name, -1) for group in thing.vertex_groups] or [-1])
    counts, groups, weights = _elements(mesh)
    rows, columns = np.repeat(np.arange(len(counts)), counts), of_group[groups]
    matrix = np.zeros((len(counts), len(names)), dtype=np.float32)
    used = columns >= 0
    matrix[rows[used], columns[used]] = weights[used]
    return matrix


def has_weights(mesh: bpy.types.Mesh) -> bool:
    """Return whether a mesh holds weights of vertex groups at all, be they of no vertex."""
    with opened(mesh) as content:
        return content.verts.layers.deform.active is not None


def _elements(mesh: bpy.types.Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return of how many groups each vertex is, shape (V,), and one after another these and its weights."""
    counts: list[int] = []
    groups: list[int] = []
    weights: list[float] = []
    with opened(mesh) as content:
        layer = content.verts.layers.deform.active
        for vertex in content.verts if layer else ():
            element = vertex[layer]
            counts.append(len(element))
            groups += element.keys()
            weights += element.values()
    none = [0] * len(mesh.vertices)
    return np.array(counts or none, dtype=int), np.array(groups, dtype=int), np.array(weights, dtype=np.float32)


def write_groups(thing: bpy.types.Object, weights: np.ndarray, names: Sequence[str], gone: Sequence[str]) -> None:
    """Replace the weights of vertex groups named like joints.

    Args:
        weights: shape (V, len(names)).
        names: of the joints; those without weight get no group.
        gone: names of joints whose groups go.
    """
    for name in (*names, *gone):
        group = thing.vertex_groups.get(name)
        if group:
            thing.vertex_groups.remove(group)
    indices, values = _heaviest_first(weights)
    groups = np.zeros(len(names), dtype=int)
    for joint in np.unique(indices[values > 0]):
        groups[joint] = thing.vertex_groups.new(name=names[joint]).index
    used = values > 0
    elements = zip(groups[indices][used].tolist(), values[used].tolist())
    with edited(thing.data) as content:
        layer = content.verts.layers.deform.verify()
        for vertex, count in zip(content.verts, used.sum(axis=1).tolist()):
            element = vertex[layer]
            for group, share in islice(elements, count):
                element[group] = share


def _heaviest_first(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return joints and weights of each vertex, shape (V, I), of dense weights (V, J) whose rows may be empty."""
    width = max(int((weights > 0).sum(axis=1).max(initial=0)), 1)
    order = np.argsort(-weights, axis=1, kind="stable")[:, :width]
    return order, np.take_along_axis(weights, order, axis=1)


def read_kept(mesh: bpy.types.Mesh, prefix: str, names: Sequence[str]) -> np.ndarray | None:
    """Return weights that were kept as attributes, shape (V, len(names)); None where there are none."""
    matrix = np.zeros((len(mesh.vertices), len(names)), dtype=np.float32)
    kept = _kept(mesh, prefix)
    joints = {name: joint for joint, name in enumerate(names)}
    for attribute in kept:
        joint = joints.get(attribute.name.removeprefix(prefix))
        if joint is not None:
            column = np.empty(len(matrix), dtype=np.float32)
            attribute.data.foreach_get("value", column)
            matrix[:, joint] = column
    return matrix if kept else None


def keep_weights(mesh: bpy.types.Mesh, prefix: str, weights: np.ndarray, names: Sequence[str]) -> None:
    """Keep weights, shape (V, len(names)), as attributes: they then survive edits of the mesh."""
    for joint in np.flatnonzero(weights.any(axis=0)):
        attribute = mesh.attributes.new(f"{prefix}{names[joint]}", "FLOAT", "POINT")
        attribute.data.foreach_set("value", np.ascontiguousarray(weights[:, joint]))


def forget_kept(mesh: bpy.types.Mesh, prefix: str) -> None:
    """Remove weights that were kept."""
    for name in [attribute.name for attribute in _kept(mesh, prefix)]:
        mesh.attributes.remove(mesh.attributes[name])


def _kept(mesh: bpy.types.Mesh, prefix: str) -> list[bpy.types.Attribute]:
    return [attribute for attribute in mesh.attributes if attribute.name.startswith(prefix)]


def signature(weights: np.ndarray, keys: Sequence[str]) -> np.ndarray:
    """Return one number for each row of weights (V, J), of the joints that keys name.

    It is linear in the weights, so that it stays right where a mesh is subdivided.
    """
    return (weights @ np.array([zlib.crc32(key.encode()) / 2**32 for key in keys])).astype(np.float32)


OWN = "ssilk:own:"  # begins the attributes that keep a garment's own weights, one for each joint
SIGNATURE = "ssilk:worn"  # attribute of points: the signature of the trained weights
SAME = 1e-6  # difference of weights


def has_trained_weights(garment: bpy.types.Object) -> bool:
    """Return whether a garment has trained weights. Not in edit mode."""
    return SIGNATURE in garment.data.attributes


def put_trained_weights(
    armature: bpy.types.Object, garment: bpy.types.Object, weights: np.ndarray, names: Sequence[str]
) -> None:
    """Give a garment trained weights, shape (V, J), over joints with these names. In object mode."""
    if has_trained_weights(garment) and np.allclose(read_groups(garment, garment.data, names), weights, atol=SAME):
        return
    own = own_groups(armature, garment, names)
    keys = keys_of(armature, names)
    discard_own_weights(garment)
    keep_weights(garment.data, OWN, own, keys)
    write_groups(garment, weights, names, ())
    attribute = garment.data.attributes.new(SIGNATURE, "FLOAT", "POINT")
    attribute.data.foreach_set("value", signature(weights, keys))


def own_groups(armature: bpy.types.Object, garment: bpy.types.Object, names: Sequence[str]) -> np.ndarray:
    """Return a garment's own weights, without trained ones, shape (V, len(names)). Not in edit mode."""
    if not has_trained_weights(garment):
        return read_groups(garment, garment.data, names)
    every = list(dict.fromkeys([*names, *(bone.name for bone in armature.data.bones if bone.use_deform)]))
    keys, found = keys_of(armature, every), read_groups(garment, garment.data, every)
    worn = np.empty(len(found), dtype=np.float32)
    garment.data.attributes[SIGNATURE].data.foreach_get("value", worn)
    untouched = np.abs(signature(found, keys) - worn) <= SAME_WEIGHTS
    kept = read_kept(garment.data, OWN, keys)
    found[untouched] = 0.0 if kept is None else kept[untouched]  # none: it had no weights at all
    return found[:, : len(names)]


def restore_own_weights(armature: bpy.types.Object, garment: bpy.types.Object) -> None:
    """Give a garment its own weights back. In object mode."""
    if has_trained_weights(garment):
        names = [bone.name for bone in armature.data.bones if bone.use_deform]
        own = own_groups(armature, garment, names)
        discard_own_weights(garment)
        write_groups(garment, own, names, ())


def discard_own_weights(garment: bpy.types.Object) -> None:
    """Remove the record of a garment's own weights; its current ones become its own."""
    forget_kept(garment.data, OWN)
    if has_trained_weights(garment):
        garment.data.attributes.remove(garment.data.attributes[SIGNATURE])
