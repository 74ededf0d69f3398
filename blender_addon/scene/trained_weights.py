# SPDX-License-Identifier: GPL-3.0-or-later
"""Trained weights, which a bake or live playback writes to a garment, and its own weights, which are restored later.

The garment's own weights are kept as point attributes, one for each joint. One more attribute holds a signature of
the trained weights. A vertex whose signature differs was painted since, and keeps what was painted.
"""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np

from .armature import keys_of
from .weights import SAME_WEIGHTS, forget_kept, keep_weights, read_groups, read_kept, signature, write_groups

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
