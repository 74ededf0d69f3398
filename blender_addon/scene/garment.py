# SPDX-License-Identifier: GPL-3.0-or-later
"""Which object is the garment, and which armature and bodies go with it."""

from __future__ import annotations

import bpy

from ..classes import ATTRIBUTE
from ..errors import SetupError
from .carrying import carrier_of, is_carried
from .follower import leader_of


def unusable(thing: bpy.types.Object | None) -> str:
    """Return why an object cannot be a garment; empty if it can."""
    if thing is None or thing.type != "MESH":
        return "Select the garment, a mesh, first"
    if thing.library or thing.data.library:
        return f"'{thing.name}' is linked from another file; make it local or open that file"
    if not len(thing.data.polygons):
        return f"'{thing.name}' has no faces"
    return ""


def not_in_object_mode(context: bpy.types.Context) -> str:
    """Return what to do to be in object mode; empty there."""
    return "" if context.mode == "OBJECT" else "Go to Object Mode"


def unusable_here(context: bpy.types.Context) -> str:
    """Return why the active object cannot be worked on as a garment in object mode; empty if it can."""
    return unusable(context.object) or not_in_object_mode(context)


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
    """Return the garments of the view layer that belong to an armature, by name."""
    found = [thing for thing in bpy.context.view_layer.objects if is_garment(thing)]
    bound = [thing for thing in found if (thing.ssilk.armature or _modifier_armature(thing)) == armature]
    return sorted(bound, key=lambda thing: thing.name)


def bodies_of(garment: bpy.types.Object, armature: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the meshes that a garment collides with: those chosen, else all others bound to its armature.

    Hidden ones count; what the view layer excludes, such as a body of another level of detail, must be chosen.

    Raises:
        SetupError: there is none, or one that was chosen is not bound to the armature.
    """
    chosen = garment.ssilk.bodies
    things = chosen.all_objects if chosen else bpy.context.view_layer.objects
    meshes = [thing for thing in things if thing.type == "MESH" and thing != garment]
    wearers = (armature, leader_of(armature))
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


def _modifier_armature(thing: bpy.types.Object) -> bpy.types.Object | None:
    return next((modifier.object for modifier in thing.modifiers if modifier.type == "ARMATURE"), None)
