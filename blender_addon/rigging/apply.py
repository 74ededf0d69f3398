# SPDX-License-Identifier: GPL-3.0-or-later
"""Apply a rig of `ssilk rig` as bones, vertex groups and classes."""

from __future__ import annotations

import bpy
import numpy as np

from ssilk_core.scene.assets import ProxyRig

from ..arrays.edits import Edits
from ..arrays.joints import Joints
from ..errors import SetupError
from ..scene.armature import bring_back, need_editable, proxy_names
from ..scene.classes import write_classes, write_levels
from ..scene.garment import hang_on_armature, need_own_mesh
from ..scene.gather import own_weights
from ..scene.weights import PLAIN, discard_own_weights, keep_weights, own_groups, read_kept, write_groups
from .edit_tracking import find_edits, generated, remember_weights
from .proxies import replace_proxies


def apply_classes(garment: bpy.types.Object, classes: np.ndarray, levels: np.ndarray | None) -> None:
    """Write classes, shape (V,), to a garment, and the least tightness at which each vertex is tight, (V,).

    Raises:
        SetupError: it was edited meanwhile.
    """
    _need_same_vertices(garment, classes)
    write_classes(garment.data, classes)
    write_levels(garment.data, levels)


def apply_rig(
    garment: bpy.types.Object,
    armature: bpy.types.Object,
    joints: Joints,
    classes: np.ndarray,
    rig: ProxyRig,
    *,
    keep_edits: bool = True,
) -> Edits:
    """Give a garment the proxies and weights of a rig, and classes; return what was kept of the artist's.

    In object mode.

    Args:
        joints: the character's joints that the rig was made for.
        keep_edits: whether bones and weights stay that were changed by hand.

    Raises:
        SetupError: the garment or the armature was edited meanwhile, or the armature cannot be edited.
    """
    _need_same_vertices(garment, classes)
    need_own_mesh(garment)
    lost = [name for name in joints.names if name not in armature.data.bones]
    if lost:
        raise SetupError(f"'{armature.name}' lost {lost[:1]} while the rig was made; make it again.")
    old, names = proxy_names(armature, garment), joints.names
    if not old and read_kept(garment.data, PLAIN, names) is None:
        own = own_weights(armature, garment, joints)
        if own is not None:
            keep_weights(garment.data, PLAIN, own, names)
    old += generated(armature, garment)  # groups stay behind where their bones were deleted
    edits = find_edits(armature, garment) if keep_edits else Edits.none(len(classes))
    carriers = list(names)
    if old or rig.proxy_count:
        need_editable(armature)
        bring_back(armature, garment)
        carriers = replace_proxies(armature, garment, joints, rig, edits)
    weights = rig.skin.dense(len(names) + rig.proxy_count).astype(np.float32)
    _give_weights(garment, armature, weights, carriers, edits.repainted, old)
    write_classes(garment.data, classes)
    _bind(garment, armature)
    return edits


def _give_weights(
    garment: bpy.types.Object,
    armature: bpy.types.Object,
    weights: np.ndarray,
    carriers: list[str],
    repainted: np.ndarray,
    old: list[str],
) -> None:
    """Write a rig's weights (V, J + P) to the bones that carry them, except at repainted vertices."""
    names = list(dict.fromkeys([*carriers, *proxy_names(armature, garment)]))
    made = np.zeros((len(weights), len(names)), dtype=np.float32)
    np.add.at(made.T, [names.index(name) for name in carriers], weights.T)
    kept = made
    if repainted.any():
        painted = own_groups(armature, garment, names)
        total = painted.sum(axis=1, keepdims=True)
        painted = np.divide(painted, total, out=made.copy(), where=total > 0)
        kept = np.where(repainted[:, None], painted, made)
    discard_own_weights(garment)
    write_groups(garment, kept, names, old)
    remember_weights(armature, garment, made, names)


def _need_same_vertices(garment: bpy.types.Object, classes: np.ndarray) -> None:
    count = len(garment.data.vertices)
    if count != len(classes):
        raise SetupError(
            f"'{garment.name}' had {len(classes)} vertices when this began and has {count} now; start it again."
        )


def _bind(garment: bpy.types.Object, armature: bpy.types.Object) -> None:
    """Give a garment an Armature modifier, the first one, unless it has one; no bone carries it any more."""
    hang_on_armature(garment)
    if any(modifier.type == "ARMATURE" and modifier.object == armature for modifier in garment.modifiers):
        return
    modifier = garment.modifiers.new("Armature", "ARMATURE")
    modifier.object = armature
    garment.modifiers.move(len(garment.modifiers) - 1, 0)
