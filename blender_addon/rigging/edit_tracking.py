# SPDX-License-Identifier: GPL-3.0-or-later
"""Proxies and weights as they were generated, and the changes that an artist made since.

The bone collection stores each proxy under a key, which its bone keeps when it is renamed. Each vertex stores the
signature of its weights.
"""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np

from ..arrays.edits import Edits
from ..scene.armature import MADE, collection_of, keys_of, made_collection, proxy_names
from ..scene.weights import SAME_WEIGHTS, own_groups, signature

SIGNATURE = "ssilk:made"  # attribute of points
SAME_PLACE = 1e-3  # of a bone's length


def remember_bones(
    armature: bpy.types.Object, garment: bpy.types.Object, records: dict[str, dict[str, object]]
) -> None:
    """Remember proxies as they were generated: the matrix in the armature, and the key or name of the parent."""
    made_collection(armature.data, garment)[MADE] = records


def remember_weights(
    armature: bpy.types.Object, garment: bpy.types.Object, weights: np.ndarray, names: Sequence[str]
) -> None:
    """Remember generated weights, shape (V, J), over joints with these names."""
    attributes = garment.data.attributes
    attribute = attributes.get(SIGNATURE) or attributes.new(SIGNATURE, "FLOAT", "POINT")
    attribute.data.foreach_set("value", signature(weights, keys_of(armature, names)))


def moving_groups(armature: bpy.types.Object, garment: bpy.types.Object) -> list[str]:
    """Return the vertex groups of a garment that bones move or moved; others, as of pins, are no weights of a rig."""
    bones = {*armature.data.bones.keys(), *generated(armature, garment)}
    return [group.name for group in garment.vertex_groups if group.name in bones]


def generated(armature: bpy.types.Object, garment: bpy.types.Object) -> dict[str, dict[str, object]]:
    """Return the proxies as `remember_bones` was given them; empty where none were generated."""
    collection = collection_of(armature.data, garment)
    return collection[MADE].to_dict() if collection and MADE in collection.keys() else {}  # noqa: SIM118 (no dictionary)


def find_edits(armature: bpy.types.Object, garment: bpy.types.Object) -> Edits:
    """Return what was changed by hand since the proxies of a garment were generated. In object mode."""
    names = proxy_names(armature, garment)
    if not names:
        return Edits.none(len(garment.data.vertices))
    records = generated(armature, garment)
    bones = [armature.data.bones[name] for name in names]
    keys = _distinct_keys(bones, records)
    present = {key for key in keys if key}
    changed = {
        bone.name: _place(armature, records[key])
        for bone, key in zip(bones, keys)
        if key and not (_same_place(bone, records[key]) and _same_parent(bone, records, key, present))
    }
    return Edits(
        changed=changed,
        added=tuple(bone.name for bone, key in zip(bones, keys) if not key),
        deleted=np.array([_place(armature, records[key]) for key in records if key not in present]).reshape(-1, 3),
        repainted=_repainted(armature, garment, {bone.name: key for bone, key in zip(bones, keys) if key}),
    )


def _distinct_keys(bones: list[bpy.types.Bone], records: dict[str, object]) -> list[str]:
    """Return each bone's key; empty for those that were added, copies of generated ones among them."""
    keys: list[str] = []
    for bone in bones:
        key = bone.get(MADE, "")
        keys.append(key if key in records and key not in keys else "")
    return keys


def _place(armature: bpy.types.Object, record: dict[str, object]) -> np.ndarray:
    """Return where a proxy was generated, in the world."""
    matrix = np.array(armature.matrix_world) @ np.array(record["matrix"]).reshape(4, 4)
    return matrix[:3, 3]


def _same_place(bone: bpy.types.Bone, record: dict[str, object]) -> bool:
    difference = np.abs(np.array(bone.matrix_local) - np.array(record["matrix"]).reshape(4, 4))
    return bool(difference[:3, 3].max() <= SAME_PLACE * bone.length and difference[:3, :3].max() <= SAME_PLACE)


def _same_parent(bone: bpy.types.Bone, records: dict[str, object], key: str, present: set[str]) -> bool:
    """Return whether a bone hangs where it was generated; from the next one above where that was deleted."""
    wanted = records[key]["parent"]
    while wanted in records and wanted not in present:
        wanted = records[wanted]["parent"]
    return bone.parent is not None and wanted == bone.parent.get(MADE, bone.parent.name)


def _repainted(armature: bpy.types.Object, garment: bpy.types.Object, keys: dict[str, str]) -> np.ndarray:
    attribute = garment.data.attributes.get(SIGNATURE)
    now = np.zeros(len(garment.data.vertices), dtype=np.float32)
    if attribute is None:
        return now > 0
    attribute.data.foreach_get("value", now)
    names = moving_groups(armature, garment)
    weights = own_groups(armature, garment, names)
    return np.abs(signature(weights, [keys.get(name, name) for name in names]) - now) > SAME_WEIGHTS
