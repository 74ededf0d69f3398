# SPDX-License-Identifier: GPL-3.0-or-later
"""Proxies of a rig as bones, beside those that an artist made or changed."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ..contract.arrays import Joints, Rig
from ..contract.edits import Edits, takers
from .armature import MADE, editing, made_collection, proxy_names
from .handmade import remember_bones

PALETTE = "THEME04"
ALONE = 0.05  # how long proxies are drawn that have none above


def replace_proxies(
    armature: bpy.types.Object, garment: bpy.types.Object, joints: Joints, rig: Rig, edits: Edits
) -> list[str]:
    """Put a rig's proxies in place of the garment's older ones, all but the artist's.

    Args:
        joints: the character's joints that the rig's parents count from.

    Returns:
        The bone that carries the weights of each joint of the rig, the character's first: for a proxy that an
        artist deleted its parent's.
    """
    carriers, standing = list(joints.names), takers(rig, edits)
    old = [name for name in proxy_names(armature, garment) if name not in edits.kept]
    with editing(armature):
        bones = armature.data.edit_bones
        hung = _hung(bones, edits.kept, old)
        for name in old:
            bones.remove(bones[name])
        for proxy, taker in enumerate(standing):
            above = carriers[rig.parents[proxy]]
            name = above if taker is None else taker or _new_bone(armature, garment, rig, proxy, above)
            carriers.append(name)
            if taker is not None:
                bones[name][MADE] = rig.names[proxy]
        for name in set(edits.kept) - set(carriers):
            bones[name].pop(MADE, None)
        fresh = [bones[name] for name, taker in zip(carriers[len(joints.names) :], standing) if taker == ""]
        _hang_again(bones, hung, fresh)
    remember_bones(armature, garment, _records(armature, joints, rig))
    return carriers


def _new_bone(armature: bpy.types.Object, garment: bpy.types.Object, rig: Rig, proxy: int, above: str) -> str:
    bones, length = armature.data.edit_bones, _length(rig)
    bone = bones.new(rig.names[proxy])
    bone.tail = (0.0, length, 0.0)  # a bone without length takes no matrix
    bone.parent = bones[above]
    bone.matrix = _in_armature(armature, rig.binds[proxy])
    bone.length = length / armature.matrix_world.median_scale
    bone.color.palette = PALETTE
    made_collection(armature.data, garment).assign(bone)
    return bone.name


def _hung(bones: bpy.types.ArmatureEditBones, kept: tuple[str, ...], old: list[str]) -> dict[str, Vector]:
    """Return where the parent stands of each kept bone whose parent goes."""
    parents = {name: bones[name].parent for name in kept}
    return {name: above.head.copy() for name, above in parents.items() if above and above.name in old}


def _hang_again(bones: bpy.types.ArmatureEditBones, hung: dict[str, Vector], fresh: list[bpy.types.EditBone]) -> None:
    """Hang bones from the new proxy nearest to the parent that they had."""
    for name, place in hung.items():
        above = min(fresh, key=lambda bone: (bone.head - place).length, default=None)
        if above and bones[name] not in above.parent_recursive:
            bones[name].parent = above


def _records(armature: bpy.types.Object, joints: Joints, rig: Rig) -> dict[str, dict[str, object]]:
    """Return a rig's proxies as they were generated, by key."""
    keys = [*joints.names, *rig.names]
    return {
        name: {"matrix": [value for row in _in_armature(armature, bind) for value in row], "parent": keys[parent]}
        for name, parent, bind in zip(rig.names, rig.parents, rig.binds)
    }


def _in_armature(armature: bpy.types.Object, bind: np.ndarray) -> Matrix:
    """Return a place in the world as one in the armature, without its scale."""
    place, turn, _ = (armature.matrix_world.inverted() @ Matrix(bind)).decompose()
    return Matrix.LocRotScale(place, turn, None)


def _length(rig: Rig) -> float:
    """Return how long proxies are drawn, in world units: half the mean way to the next one."""
    places, above = rig.binds[:, :3, 3], rig.parents - (rig.weights.shape[1] - len(rig.binds))
    chained = above >= 0
    steps = np.linalg.norm(places[chained] - places[above[chained]], axis=1)
    return float(steps.mean() / 2) if len(steps) else ALONE
