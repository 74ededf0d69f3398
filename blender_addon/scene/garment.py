# SPDX-License-Identifier: GPL-3.0-or-later
"""Which object is the garment, which armature and bodies go with it, and objects that a bone carries.

Meshes parented to a bone follow it rigidly, as armour and capes of game characters do. An Armature modifier as well
would move them twice.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import bpy
import numpy as np
from mathutils import Matrix

from ..arrays.classes import ATTRIBUTE
from ..arrays.joints import Joints
from ..errors import SetupError
from .armature import leader_of
from .linked import home, is_override


def unplayable(thing: bpy.types.Object | None) -> str:
    """Return why an object cannot be a garment that is played, baked and looked at; empty if it can."""
    group = thing.instance_collection if thing and thing.type == "EMPTY" else None
    if group and group.library:
        return f"'{thing.name}' is {_linked(group)}, then select the garment"
    if thing is None or thing.type != "MESH":
        return "Select the garment, a mesh, first"
    if thing.library:
        return f"'{thing.name}' is {_linked(thing)}, or open that file"
    if thing.data.library and not is_override(thing):
        return (
            f"The mesh of '{thing.name}' is linked from '{home(thing.data).name}'; make it local (Object > Relations "
            "> Make Single User > Object & Data), or open that file"
        )
    if not len(thing.data.polygons):
        return f"'{thing.name}' has no faces"
    return ""


def _linked(thing: bpy.types.ID) -> str:
    return f"linked from '{home(thing).name}'; override it (Object > Library Override > Make)"


def unusable(thing: bpy.types.Object | None) -> str:
    """Return why an object cannot be a garment that is changed; empty if it can."""
    if reason := unplayable(thing):
        return reason
    if is_override(thing):
        return (
            f"'{thing.name}' belongs to '{home(thing).name}'; open that file to change it. Here it can be played and "
            "baked"
        )
    return ""


def not_in_object_mode(context: bpy.types.Context) -> str:
    """Return what to do to be in object mode; empty there."""
    return "" if context.mode == "OBJECT" else "Go to Object Mode"


def unusable_here(context: bpy.types.Context) -> str:
    """Return why the active object cannot be worked on as a garment in object mode; empty if it can."""
    return unusable(context.object) or not_in_object_mode(context)


def unplayable_here(context: bpy.types.Context) -> str:
    """Return why the active object cannot be played, baked and looked at in object mode; empty if it can."""
    return unplayable(context.object) or not_in_object_mode(context)


def is_garment(thing: bpy.types.Object) -> bool:
    """Return whether an object has vertex classes, or an armature chosen for it."""
    return thing.type == "MESH" and (ATTRIBUTE in thing.data.attributes or thing.ssilk.armature is not None)


def armature_of(garment: bpy.types.Object) -> bpy.types.Object:
    """Return the armature that a garment was given, else that of its modifier, else of its parent, else the only one.

    Raises:
        SetupError: there is none, or there are several.
    """
    bound = _modifier_armature(garment)
    above = garment.parent if garment.parent and garment.parent.type == "ARMATURE" else None
    carrier = carrier_of(garment)
    chosen = garment.ssilk.armature or bound or above or (carrier and carrier[0])
    if chosen:
        return chosen
    found = [thing for thing in bpy.context.scene.objects if thing.type == "ARMATURE" and leader_of(thing) == thing]
    names = ", ".join(f"'{thing.name}'" for thing in found)
    if not found:
        raise SetupError(f"There is no armature for '{garment.name}'; a garment needs a character with bones.")
    if len(found) != 1:
        raise SetupError(f"'{garment.name}' could belong to {names}; choose its armature in the Garment panel.")
    return found[0]


def garments_of(armature: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the garments of the view layer that belong to an armature, from inner to outer ones.

    Those that nobody has put in order come last, by name.
    """
    found = [thing for thing in bpy.context.view_layer.objects if is_garment(thing)]
    bound = [thing for thing in found if (thing.ssilk.armature or _modifier_armature(thing)) == armature]
    return sorted(bound, key=lambda thing: (thing.ssilk.layer or len(bound) + 1, thing.name))


def put_in_order(garments: Sequence[bpy.types.Object]) -> None:
    """Let garments be worn in this order, from inner to outer ones."""
    for number, garment in enumerate(garments, start=1):
        garment.ssilk.layer = number


def beneath(garment: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the garments that a garment is worn over: those of its character that come before it in the order."""
    found = garments_of(armature_of(garment))
    return found[: found.index(garment)] if garment in found and garment.ssilk.layer else []


def bodies_of(garment: bpy.types.Object, armature: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the meshes that a garment collides with: those chosen, else all others bound to its armature.

    Hidden ones count; what the view layer excludes, such as a body of another level of detail, must be chosen.

    Raises:
        SetupError: there is none, or one that was chosen is not bound to the armature.
    """
    chosen, things, wearers = garment.ssilk.bodies, _around(garment), (armature, leader_of(armature))
    meshes = [thing for thing in things if thing.type == "MESH" and thing != garment]
    for thing in meshes:
        if chosen or (thing.parent in wearers and not is_garment(thing)):
            need_plain_parent(thing)
    bound = [thing for thing in meshes if _modifier_armature(thing) in wearers]
    carried = [thing for thing in meshes if is_carried(thing, wearers)]
    if chosen:
        bound = [thing for thing in meshes if thing in (*bound, *carried)]
    else:  # armour and weapons count where they are chosen, or where the whole character is made like them
        bound = [thing for thing in bound if not is_garment(thing)]
        bound = bound or [thing for thing in carried if not is_garment(thing)]
    loose = [thing.name for thing in meshes if thing not in bound] if chosen else []
    if loose:
        raise SetupError(f"'{loose[0]}' is not bound to '{armature.name}'; bind it, or take it from '{chosen.name}'.")
    if not bound:
        raise SetupError(f"No body is bound to '{armature.name}'; give the character's mesh an Armature modifier.")
    return bound


def _around(garment: bpy.types.Object) -> Iterable[bpy.types.Object]:
    """Return the objects of which some may be bodies of a garment."""
    return garment.ssilk.bodies.all_objects if garment.ssilk.bodies else bpy.context.view_layer.objects


def is_own_body(
    thing: bpy.types.Object, garment: bpy.types.Object, armature: bpy.types.Object, *, bound: bool = True
) -> bool:
    """Return whether an object is a body of a garment's character, as `bodies_of` has them.

    Args:
        bound: whether what is bound to the armature counts where bodies were chosen.
    """
    chosen, wearers = garment.ssilk.bodies, (armature, leader_of(armature))
    if chosen and any(thing == each for each in chosen.all_objects):
        return True
    if chosen or _modifier_armature(thing) in wearers:
        return (bound or not chosen) and _modifier_armature(thing) in wearers
    if not is_carried(thing, wearers):
        return False
    meshes = (each for each in bpy.context.view_layer.objects if each.type == "MESH" and each != garment)
    return not any(_modifier_armature(each) in wearers and not is_garment(each) for each in meshes)


def no_meshes(garment: bpy.types.Object, armature: bpy.types.Object) -> list[str]:
    """Return in words what looks like a body, and is none since it is no mesh: it was chosen, or bones move it."""
    said, wearers = [], (armature, leader_of(armature))
    for thing in _around(garment):
        is_meant = bool(garment.ssilk.bodies) or _modifier_armature(thing) in wearers
        if is_meant and (words := no_mesh(thing)):
            said.append(f"{words} and bind it" if thing.type not in SURFACES else words)
    return said


def no_mesh(thing: bpy.types.Object) -> str:
    """Return in words that an object with a surface is no mesh; empty where it is one, or has none."""
    if thing.type in SURFACES:
        return f"'{thing.name}' is no mesh, and cloth does not meet it; convert it (Object > Convert)"
    if thing.instance_type == "COLLECTION" and thing.instance_collection:
        text = f"'{thing.name}' is an instance of a collection, and cloth does not meet it; make it real"
        return f"{text} (Object > Apply > Make Instances Real)"
    return ""


def follow_bodies(garment: bpy.types.Object, bodies: Sequence[bpy.types.Object]) -> list[str]:
    """Return in words which meshes that are rendered follow a body by a modifier, as fine meshes do cages."""
    said = []
    for thing in bpy.context.view_layer.objects:
        if thing.type != "MESH" or thing.hide_render or thing == garment or thing in bodies or is_garment(thing):
            continue
        for modifier in thing.modifiers:
            target = getattr(modifier, FOLLOWING.get(modifier.type, ""), None)
            if target in bodies and modifier.is_bound and modifier.show_viewport:
                said.append(
                    f"'{thing.name}' follows '{target.name}' by its modifier '{modifier.name}', and cloth does not "
                    "meet it; if it is the body that is seen, bind it to the bones by an Armature modifier"
                )
    return said


def _modifier_armature(thing: bpy.types.Object) -> bpy.types.Object | None:
    bound = (modifier.object for modifier in thing.modifiers if modifier.type == "ARMATURE")
    return next(filter(None, bound), None)


FOLLOWING = {"SURFACE_DEFORM": "target", "MESH_DEFORM": "object"}  # modifiers, and which property names what leads
SURFACES = ("CURVE", "SURFACE", "FONT", "META")  # kinds of objects that have a surface, and no mesh of their own
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


def need_own_mesh(thing: bpy.types.Object) -> None:
    """Raise `SetupError` if other objects share the mesh of one whose weights and shape keys are to be written."""
    if is_override(thing) and (thing.data.library or thing.data.override_library):
        return  # which gets one of this file before anything is written
    others = [other.name for other in bpy.data.objects if other.data == thing.data and other != thing]
    if others:
        raise SetupError(
            f"'{thing.name}' shares its mesh with '{others[0]}', which would change with it; make it a single user "
            "(Object > Relations > Make Single User > Object & Data)."
        )


def need_left(thing: bpy.types.Object) -> None:
    """Raise `SetupError` if an object is being edited: its mesh is as it was before."""
    if thing.mode == "EDIT":
        raise SetupError(f"'{thing.name}' is in Edit Mode; leave it first (Tab), so that what you changed counts.")


def need_plain_parent(thing: bpy.types.Object) -> None:
    """Raise `SetupError` if an object's parent deforms it beside its modifiers, as armatures did in old files."""
    if thing.parent and thing.parent.type == "ARMATURE" and thing.parent_type == "ARMATURE":
        raise SetupError(
            f"'{thing.name}' is deformed by its parent '{thing.parent.name}' beside its modifiers; set Relations > "
            "Parent Type to Object in its object properties, and give it an Armature modifier if it has none."
        )


def need_linear(thing: bpy.types.Object, armature: bpy.types.Object) -> bool:
    """Return whether an Armature modifier lets an armature move an object, which it must do by linear blend skinning.

    Raises:
        SetupError: an option of the modifier is in the way, or its parent deforms the object as well.
    """
    need_plain_parent(thing)
    for modifier in thing.modifiers:
        if modifier.type != "ARMATURE" or modifier.object not in (armature, leader_of(armature)):
            continue
        options = {
            "Preserve Volume": modifier.use_deform_preserve_volume,
            "Bone Envelopes": modifier.use_bone_envelopes,
            "a vertex group": bool(modifier.vertex_group),
            "Multi Modifier": modifier.use_multi_modifier,
        }
        for label, on in options.items():
            if on:
                raise SetupError(f"The modifier '{modifier.name}' of '{thing.name}' uses {label}; switch that off.")
        if not modifier.use_vertex_groups:
            raise SetupError(f"The modifier '{modifier.name}' of '{thing.name}' ignores vertex groups.")
        return True
    return False


def need_linear_bodies(garment: bpy.types.Object, armature: bpy.types.Object) -> None:
    """Raise `SetupError` if Blender shows what a garment collides with elsewhere than linear blend skinning does."""
    chosen = garment.ssilk.bodies
    for thing in chosen.all_objects if chosen else bpy.context.view_layer.objects:
        if thing.type == "MESH" and thing != garment and (chosen or not is_garment(thing)):
            need_linear(thing, armature)


def need_uncarried(thing: bpy.types.Object) -> None:
    """Raise `SetupError` if a bone carries an object that weights are to move."""
    if carrier := carrier_of(thing):
        raise SetupError(
            f"'{thing.name}' hangs on the bone '{carrier[1].name}', which moves it besides its weights; generate its "
            "rig, and it hangs on the armature itself."
        )
