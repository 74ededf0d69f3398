# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters and garments from other files: what is linked, what overrides it, where their paths begin.

A shot links a character and overrides it (*Library Override > Make*). Blender then lets the shot key bones, add
tracks and give an object another mesh. It does not let it change a linked mesh, and drops what a script writes there.
So a garment that is played or baked in a shot gets a copy of its mesh, which the shot owns; all else stays linked.
"""

from __future__ import annotations

import os
from pathlib import Path

import bpy

from ..errors import SetupError

LENT = "ssilk_shot"  # of a mesh that this file owns for an overridden object: the mesh override that it had, or True


def origin(thing: bpy.types.ID) -> bpy.types.ID:
    """Return the linked data that something overrides; itself where it overrides nothing."""
    return thing.override_library.reference if thing.override_library else thing


def home(thing: bpy.types.ID) -> Path:
    """Return the blend file that something comes from: this one, or the one that it is linked from."""
    library = origin(thing).library
    path = bpy.path.abspath(library.filepath) if library else bpy.data.filepath
    return Path(os.path.normpath(path))


def is_override(thing: bpy.types.Object) -> bool:
    """Return whether an object is another file's, overridden here."""
    return thing.override_library is not None


def is_owner(owner: object, garment: bpy.types.Object) -> bool:
    """Return whether a custom property names a garment, or what it overrides: linked data knows no override."""
    return owner is not None and owner in (garment, origin(garment))


def absolute(thing: bpy.types.Object, path: str, inherited: str) -> Path:
    """Return a path that an object remembers, which may begin with "//".

    Args:
        inherited: the same path of what the object overrides; relative to that file where both are equal.
    """
    library = origin(thing).library if path == inherited else None
    return Path(os.path.normpath(bpy.path.abspath(path, library=library)))


def give_own_mesh(thing: bpy.types.Object) -> None:
    """Give an overridden object a mesh that this file owns, unless it has one. In object mode.

    Drivers of its shape keys follow the overriding objects from then on.
    """
    if not is_override(thing) or not (thing.data.library or thing.data.override_library):
        return
    own = own_copy(thing.data)
    own.name, own[LENT] = f"{thing.name} shot", thing.data if thing.data.override_library else True
    thing.data = own
    animation = own.shape_keys.animation_data if own.shape_keys else None
    here = overriding(thing)
    for curve in animation.drivers if animation else ():
        for variable in curve.driver.variables:
            for target in variable.targets:
                if target.id in here:
                    target.id = here[target.id]


def own_copy(mesh: bpy.types.Mesh) -> bpy.types.Mesh:
    """Return a copy of a mesh that this file owns, and that overrides nothing."""
    copy = mesh.copy()
    return copy.make_local() if copy.override_library else copy


def has_lent_mesh(thing: bpy.types.Object) -> bool:
    """Return whether an object has a mesh that `give_own_mesh` made."""
    return is_override(thing) and LENT in thing.data.keys()  # noqa: SIM118 (no dictionary)


def give_back_mesh(thing: bpy.types.Object) -> None:
    """Let an overridden object show the mesh again that it had: the shot's override of one, or the linked one.

    The copy that it had here goes.
    """
    own, before = thing.data, thing.data[LENT]
    thing.data = before if isinstance(before, bpy.types.Mesh) else origin(thing).data
    if not own.users:
        bpy.data.meshes.remove(own)


def overriding(thing: bpy.types.Object) -> dict[bpy.types.Object, bpy.types.Object]:
    """Return by what they override the objects that were overridden together with one."""
    root = thing.override_library.hierarchy_root
    others = [other for other in bpy.data.objects if is_override(other)]
    return {origin(other): other for other in others if other.override_library.hierarchy_root == root}


def open_collection(thing: bpy.types.Object) -> bpy.types.Collection:
    """Return a collection of an object that takes other objects too; the scene's where all belong to other files."""
    own = (group for group in thing.users_collection if not (group.library or group.override_library))
    return next(own, bpy.context.scene.collection)


def local_copy(thing: bpy.types.Object) -> bpy.types.Object:
    """Return a copy of an object that overrides nothing, so that its modifiers can be removed."""
    copy = thing.copy()
    return copy.make_local() if is_override(copy) else copy


def need_local(thing: bpy.types.Object) -> None:
    """Raise `SetupError` if an object's mesh belongs to another file, so that nothing written to it would stay."""
    if thing.data.library or thing.data.override_library:
        raise SetupError(
            f"The mesh of '{thing.name}' belongs to '{home(thing.data).name}', and nothing written to it here would "
            "stay; do this in that file."
        )
