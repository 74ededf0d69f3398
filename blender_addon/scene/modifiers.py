# SPDX-License-Identifier: GPL-3.0-or-later
"""The rule about a garment's modifiers: bones move the mesh as it is, and what follows refines what they moved.

A coarse mesh may so drive a fine one: Subdivision Surface, Solidify and their kind go below the Armature modifier.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy

from ..errors import SetupError

# They leave points where they are, wherever they stand.
HARMLESS = {
    "COLLISION", "DATA_TRANSFER", "DYNAMIC_PAINT", "NORMAL_EDIT", "PARTICLE_SYSTEM", "SURFACE", "UV_PROJECT",
    "UV_WARP", "VERTEX_WEIGHT_EDIT", "VERTEX_WEIGHT_MIX", "VERTEX_WEIGHT_PROXIMITY", "WEIGHTED_NORMAL",
}  # fmt: skip
# They refine the mesh or leave parts out.
REFINING = {
    "BEVEL", "DECIMATE", "EDGE_SPLIT", "MASK", "MULTIRES", "REMESH", "SOLIDIFY", "SUBSURF", "TRIANGULATE", "WELD",
    "WIREFRAME",
}  # fmt: skip
# They make cloth of which the mesh itself holds a part only, or none.
COMPLETING = {
    "ARRAY", "BOOLEAN", "BUILD", "MESH_TO_VOLUME", "MIRROR", "PARTICLE_INSTANCE", "SCREW", "SKIN", "VOLUME_TO_MESH",
}  # fmt: skip
# They move points by themselves, whatever bones do.
MOVING = {"CLOTH", "EXPLODE", "FLUID", "MESH_CACHE", "MESH_SEQUENCE_CACHE", "OCEAN", "SOFT_BODY"}

BELOW = "move it below the Armature modifier"


@dataclass(frozen=True)
class Objection:
    """A modifier that a garment may not have where it stands, what it does, and what to do."""

    modifier: str
    does: str
    todo: str


def objections(garment: bpy.types.Object) -> list[Objection]:
    """Return what is wrong with a garment's modifiers that are switched on, in viewports or renders."""
    used = [modifier for modifier in garment.modifiers if modifier.show_viewport or modifier.show_render]
    deforms = [modifier.type == "ARMATURE" and modifier.object is not None for modifier in used]
    bones = deforms.index(True) if any(deforms) else -1
    judged = (
        (modifier, _objection(modifier, after=0 <= bones < place, bound=bones >= 0))
        for place, modifier in enumerate(used)
        if place != bones
    )
    return [Objection(modifier.name, *said) for modifier, said in judged if said]


def _objection(modifier: bpy.types.Modifier, *, after: bool, bound: bool) -> tuple[str, str] | None:
    """Return what a modifier does wrong and what to do, where it stands after bones or before; None if nothing."""
    kind = modifier.type
    if kind in HARMLESS:
        return None
    if kind == "ARMATURE":
        return ("moves it a second time", "remove one of both") if modifier.object else None
    if kind in MOVING:
        return "moves it in place of what is trained", "remove it, or switch it off"
    if kind in COMPLETING:
        return "gives it parts that its mesh does not have", "apply it"
    if after or (kind in REFINING and not bound):  # the Armature modifier comes first
        return None
    below = [BELOW] if bound else []
    todo = below if kind in REFINING else ["apply it", *below]
    return "shapes it before bones move it", ", or ".join(todo)


def need_plain_modifiers(garment: bpy.types.Object) -> None:
    """Check that bones move the vertices of a garment's mesh, and nothing else does.

    Raises:
        SetupError: a modifier is in the way.
    """
    for objection in objections(garment):
        raise SetupError(
            f"The modifier '{objection.modifier}' of '{garment.name}' {objection.does}; {objection.todo}."
        )


def reshapes(thing: bpy.types.Object) -> bool:
    """Return whether modifiers shape a body before its armature deforms it; it is then taken as they shape it."""
    kinds = [modifier.type for modifier in thing.modifiers]
    bound = "ARMATURE" in kinds
    before = thing.modifiers[: kinds.index("ARMATURE")] if bound else thing.modifiers[:]
    passed = HARMLESS if bound else HARMLESS | REFINING
    return any(modifier.show_viewport and modifier.type not in passed for modifier in before)
