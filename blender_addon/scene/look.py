# SPDX-License-Identifier: GPL-3.0-or-later
"""What a character has in Blender that USD does not get, which is handed over as shape, weights and one UV map."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import bpy
import numpy as np

from .armature import leader_of
from .garment import FOLLOWING, is_garment
from .meshes import rendered_map
from .modifiers import HARMLESS, bones_place, reshapes

DRAWN = ("MESH", "CURVE", "CURVES", "SURFACE", "META", "FONT", "VOLUME")
NAMED = 3  # of a kind are named at most
# Attributes that Blender makes itself; those that hold a shading have words of their own.
OWN = {"position", "material_index", "sharp_face", "sharp_edge", "custom_normal", "crease_edge", "crease_vert",
       "bevel_weight_edge", "bevel_weight_vert", "seam", "uv_seam", "freestyle_edge", "freestyle_face"}  # fmt: skip


def lost_looks(things: Iterable[bpy.types.Object]) -> list[str]:
    """Return in words what meshes lose in USD, one for each that loses something."""
    return [f"'{thing.name}' loses {', '.join(lost)}" for thing in things if (lost := _lost(thing))]


def _lost(thing: bpy.types.Object) -> list[str]:
    mesh = thing.data
    materials = {slot.material.name: None for slot in thing.material_slots if slot.material}
    maps = [layer.name for layer in mesh.uv_layers if layer != rendered_map(mesh)]
    colours = [each.name for each in mesh.color_attributes if not each.name.startswith("SSILK")]  # heat
    known = {*OWN, *mesh.uv_layers.keys(), *mesh.color_attributes.keys()}
    others = [each.name for each in mesh.attributes if each.name not in known and not _is_ours(each.name)]
    own = [
        name
        for holder in (thing, mesh)
        for name, value in holder.items()
        if not _is_ours(name) and not hasattr(value, "keys")  # add-ons keep their settings in groups
    ]
    kinds = (
        ("material", list(materials)), ("UV map", maps), ("colours", colours), ("attribute", others),
        ("custom property", own), ("modifier", _on_top(thing)),
    )  # fmt: skip
    return [f"the {kind} '{name}'" for kind, names in kinds for name in names] + _shading(thing)


def _is_ours(name: str) -> bool:
    return name.startswith((".", "ssilk", "SSILK", "cycles", "_RNA_UI"))


def _on_top(thing: bpy.types.Object) -> list[str]:
    """Return the names of modifiers that are seen, and not in the mesh that is handed over."""
    place = bones_place(thing)
    after = thing.modifiers[place + 1 :] if place is not None else [] if reshapes(thing) else thing.modifiers
    unseen = HARMLESS - {"PARTICLE_SYSTEM"} | {"ARMATURE"}
    return [each.name for each in after if each.show_render and each.type not in unseen]


def _shading(thing: bpy.types.Object) -> list[str]:
    """Return in words which shading of a mesh USD does not get: it shows meshes as smooth subdivision surfaces.

    Modifiers such as Smooth by Angle make some of it, whichever stand above those that are handed over.
    """
    evaluated = thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    meshes = (thing.data, evaluated)
    sharp = any(_holds(mesh, name) for mesh in meshes for name in ("sharp_face", "sharp_edge"))
    creased = any(_holds(mesh, name) for mesh in meshes for name in ("crease_edge", "crease_vert"))
    turned = any(mesh.has_custom_normals for mesh in meshes)
    return ["its flat or sharp shading"] * (sharp or turned) + ["its creases"] * creased


def _holds(mesh: bpy.types.Mesh, name: str) -> bool:
    attribute = mesh.attributes.get(name)
    if attribute is None:
        return False
    values = np.zeros(len(attribute.data), dtype=np.float32 if attribute.data_type == "FLOAT" else bool)
    attribute.data.foreach_get("value", values)
    return bool(values.any())


def left_behind(armature: bpy.types.Object, written: Sequence[bpy.types.Object]) -> str:
    """Return in words what is drawn, and hangs on an armature or follows what is written, and is not itself written;
    garments are no loss."""
    wearers = (armature, leader_of(armature))
    names = sorted(
        f"'{thing.name}'"
        for thing in bpy.context.view_layer.objects
        if thing.type in DRAWN and thing not in written and not thing.hide_render and not is_garment(thing)
        and (_hangs_on(thing, wearers) or _follows(thing, written))
    )  # fmt: skip
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return f"{', '.join(names[:NAMED])}{more} of '{armature.name}'" if names else ""


def _follows(thing: bpy.types.Object, written: Sequence[bpy.types.Object]) -> bool:
    """Return whether a modifier lets an object follow the surface of another, as trims do a garment's."""
    return any(getattr(each, FOLLOWING.get(each.type, ""), None) in written for each in thing.modifiers)


def _hangs_on(thing: bpy.types.Object, wearers: Sequence[bpy.types.Object]) -> bool:
    if any(each.type == "ARMATURE" and each.object in wearers for each in thing.modifiers):
        return True
    above = thing.parent
    while above is not None and above not in wearers:
        above = above.parent
    return above is not None
