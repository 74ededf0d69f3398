# SPDX-License-Identifier: GPL-3.0-or-later
"""Proxies of a rig as bones, beside those that an artist made or changed."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ssilk_core.scene.assets import ProxyRig

from ..arrays.edits import Edits, match_proxies
from ..arrays.joints import Joints
from ..scene.armature import MADE, editing, made_collection, proxy_names
from ..scene.objects import scene_units
from .edit_tracking import remember_bones

PALETTE = "THEME04"
ALONE = 0.05  # how long proxies are drawn that have none above


def replace_proxies(
    armature: bpy.types.Object, garment: bpy.types.Object, joints: Joints, rig: ProxyRig, edits: Edits
) -> list[str]:
    """Replace the garment's older proxies by a rig's, except those that the artist made or changed.

    Args:
        joints: the character's joints that the rig's parents count from.

    Returns:
        The bone that carries the weights of each joint of the rig, the character's first: for a proxy that an
        artist deleted its parent's.
    """
    names = [path.rpartition("/")[2] for path in rig.joint_names]
    binds = scene_units().transforms_from_core(rig.bind_transforms)
    carriers, length = list(joints.names), _length(binds, rig, joints)
    standing = match_proxies(binds[:, :3, 3], edits)
    old = [name for name in proxy_names(armature, garment) if name not in edits.kept]
    with editing(armature):
        bones = armature.data.edit_bones
        hung = _hung(bones, edits.kept, old)
        for name in old:
            bones.remove(bones[name])
        for proxy, taker in enumerate(standing):
            above = carriers[rig.parents[proxy]]
            name = above if taker is None else taker
            if taker == "":
                name = _new_bone(armature, garment, names[proxy], above, binds[proxy], length)
            carriers.append(name)
            if taker is not None:
                bones[name][MADE] = names[proxy]
        for name in set(edits.kept) - set(carriers):
            bones[name].pop(MADE, None)
        fresh = [bones[name] for name, taker in zip(carriers[len(joints.names) :], standing) if taker == ""]
        _hang_again(bones, hung, fresh)
    keys = [*joints.names, *names]
    remember_bones(
        armature,
        garment,
        {
            name: {"matrix": [value for row in _in_armature(armature, bind) for value in row], "parent": keys[parent]}
            for name, parent, bind in zip(names, rig.parents, binds)
        },
    )
    return carriers


def _new_bone(
    armature: bpy.types.Object, garment: bpy.types.Object, name: str, above: str, bind: np.ndarray, length: float
) -> str:
    """Make a bone at a bind transform in Blender's world; return its name, which differs if `name` is taken."""
    bones = armature.data.edit_bones
    bone = bones.new(name)
    bone.tail = (0.0, length, 0.0)  # a bone without length takes no matrix
    bone.parent = bones[above]
    bone.matrix = _in_armature(armature, bind)
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


def _in_armature(armature: bpy.types.Object, bind: np.ndarray) -> Matrix:
    """Return a place in the world as one in the armature, without its scale."""
    place, turn, _ = (armature.matrix_world.inverted() @ Matrix(bind)).decompose()
    return Matrix.LocRotScale(place, turn, None)


def _length(binds: np.ndarray, rig: ProxyRig, joints: Joints) -> float:
    """Return how long proxies are drawn, in world units: half the mean way to the next one."""
    places, above = binds[:, :3, 3], rig.parents - len(joints.names)
    chained = above >= 0
    steps = np.linalg.norm(places[chained] - places[above[chained]], axis=1)
    return float(steps.mean() / 2) if len(steps) else ALONE
