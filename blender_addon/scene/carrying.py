# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects that a bone carries: which one, where they are at rest, and how they come to hang on the armature itself.

Meshes parented to a bone follow it rigidly, as armour and capes of game characters do. An Armature modifier as well
would move them twice.
"""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from ..errors import SetupError
from ..joints import Joints

Carrier = tuple[bpy.types.Object, bpy.types.Bone]


def carrier_of(thing: bpy.types.Object) -> Carrier | None:
    """Return the armature and the bone that an object is parented to, through other objects perhaps; else None."""
    while thing.parent:
        above = thing.parent
        bone = above.data.bones.get(thing.parent_bone) if above.type == "ARMATURE" else None
        if thing.parent_type == "BONE" and bone:  # without the bone it hangs on the armature
            return above, bone
        thing = above
    return None


def is_carried(thing: bpy.types.Object, armatures: tuple[bpy.types.Object, ...]) -> bool:
    """Return whether a bone of one of some armatures carries an object, and no modifier deforms it."""
    carrier = carrier_of(thing)
    deformed = any(modifier.type == "ARMATURE" and modifier.object for modifier in thing.modifiers)
    return bool(carrier and carrier[0] in armatures and not deformed)


def carried_weights(thing: bpy.types.Object, joints: Joints, vertex_count: int) -> np.ndarray:
    """Return the weights of an object that is carried, shape (V, J): all on its bone.

    Raises:
        SetupError: the bone does not deform.
    """
    _, bone = carrier_of(thing)
    if bone.name not in joints.names:
        raise SetupError(
            f"'{thing.name}' hangs on the bone '{bone.name}', which does not deform; switch on Deform for that bone."
        )
    weights = np.zeros((vertex_count, len(joints.names)), dtype=np.float32)
    weights[:, joints.names.index(bone.name)] = 1.0
    return weights


def rest_world(thing: bpy.types.Object) -> Matrix:
    """Return an object's place in the world with the armature at rest, if a bone carries it."""
    carrier = carrier_of(thing)
    if carrier is None:
        return thing.matrix_world.copy()
    armature, bone = carrier
    place = armature.matrix_world
    turned = bone.matrix_local @ armature.pose.bones[bone.name].matrix.inverted_safe()
    return place @ turned @ place.inverted_safe() @ thing.matrix_world


def hang_on_armature(thing: bpy.types.Object) -> None:
    """Parent an object that a bone carries to the armature itself, in its place at rest: weights are to move it."""
    carrier = carrier_of(thing)
    if carrier is None:
        return
    armature, place = carrier[0], rest_world(thing)
    thing.parent, thing.parent_type, thing.parent_bone = armature, "OBJECT", ""
    thing.matrix_parent_inverse = armature.matrix_world.inverted_safe() @ place @ thing.matrix_basis.inverted_safe()
    bpy.context.view_layer.update()


def need_uncarried(thing: bpy.types.Object) -> None:
    """Raise `SetupError` if a bone carries an object that weights are to move."""
    if carrier := carrier_of(thing):
        raise SetupError(
            f"'{thing.name}' hangs on the bone '{carrier[1].name}', which moves it besides its weights; generate its "
            "rig, and it hangs on the armature itself."
        )
