# SPDX-License-Identifier: GPL-3.0-or-later
"""The rule about a garment's modifiers: bones move the mesh as it is, and what follows refines what they moved.

A coarse mesh may so drive a fine one: Subdivision Surface, Solidify and their kind go below the Armature modifier.
`cage_points` are the vertices as bones move them, beneath modifiers that make more of them, or fewer.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np

from ..errors import SetupError
from .meshes import world_points
from .shapes import mixed_points
from .weights import read_groups

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
# They move points by themselves, whatever bones do; so do nodes that simulate.
MOVING = {"CLOTH", "EXPLODE", "FLUID", "MESH_CACHE", "MESH_SEQUENCE_CACHE", "OCEAN", "SOFT_BODY"}

BELOW = "move it below the Armature modifier"


@dataclass(frozen=True)
class Objection:
    """A modifier that a garment may not have where it stands, what it does, and what to do."""

    modifier: str
    does: str
    todo: str


def reweighs(modifier: bpy.types.Modifier) -> bool:
    """Return whether a modifier may change the weights by which bones move a mesh, if it stands before them."""
    if modifier.type == "DATA_TRANSFER":
        return modifier.use_vert_data and "VGROUP_WEIGHTS" in modifier.data_types_verts
    if modifier.type == "VERTEX_WEIGHT_MIX":
        return bool(modifier.vertex_group_a)
    return modifier.type in ("VERTEX_WEIGHT_EDIT", "VERTEX_WEIGHT_PROXIMITY") and bool(modifier.vertex_group)


def _reweighs_bones(modifier: bpy.types.Modifier, armature: bpy.types.Object) -> bool:
    """Return whether a modifier changes weights of an armature's bones; else its group only masks something."""
    group = getattr(modifier, "vertex_group_a", "") or getattr(modifier, "vertex_group", "")
    return reweighs(modifier) and (modifier.type == "DATA_TRANSFER" or group in armature.data.bones)


def objections(garment: bpy.types.Object, *, simulated: bool = False) -> list[Objection]:
    """Return what is wrong with a garment's modifiers that are switched on, in viewports or renders.

    Args:
        simulated: whether modifiers that are seen to move what bones have moved may do so.
    """
    used = [modifier for modifier in garment.modifiers if modifier.show_viewport or modifier.show_render]
    deforms = [modifier.type == "ARMATURE" and modifier.object is not None for modifier in used]
    bones = deforms.index(True) if any(deforms) else -1
    judged = [
        (modifier, _objection(modifier, after=0 <= bones < place, bound=bones >= 0, simulated=simulated))
        for place, modifier in enumerate(used)
        if place != bones
    ]
    judged += [
        (modifier, ("changes its weights before bones use them", f"apply it, or {BELOW}"))
        for modifier in used[: max(bones, 0)]
        if _reweighs_bones(modifier, used[bones].object)
    ]
    return [Objection(modifier.name, *said) for modifier, said in judged if said]


def moves_by_itself(modifier: bpy.types.Modifier) -> bool:
    """Return whether a modifier moves points whatever bones do: a simulation, or a cache of one."""
    return modifier.type in MOVING or simulates_in_order(modifier)


def simulates_in_order(modifier: bpy.types.Modifier) -> bool:
    """Return whether a modifier's nodes simulate, so that each frame begins where the one before it was left."""
    return modifier.type == "NODES" and any(
        bake.node and bake.node.bl_idname == "GeometryNodeSimulationOutput" for bake in modifier.bakes
    )


def _objection(modifier: bpy.types.Modifier, *, after: bool, bound: bool, simulated: bool) -> tuple[str, str] | None:
    """Return what a modifier does wrong and what to do, where it stands after bones or before; None if nothing."""
    kind = modifier.type
    if kind in HARMLESS:
        return None
    if kind == "ARMATURE":
        return ("moves it a second time", "remove one of both") if modifier.object else None
    if moves_by_itself(modifier):
        if simulated and bound and modifier.show_viewport:
            return None if after else ("moves it before bones do", BELOW)
        return "moves it in place of what is trained", "remove it, or switch it off"
    if kind in COMPLETING:
        return "gives it parts that its mesh does not have", "apply it"
    if after or (kind in REFINING and not bound):  # the Armature modifier comes first
        return None
    below = [BELOW] if bound else []
    todo = below if kind in REFINING else ["apply it", *below]
    return "shapes it before bones move it", ", or ".join(todo)


def need_plain_modifiers(garment: bpy.types.Object, *, simulated: bool = False) -> None:
    """Check that bones move the vertices of a garment's mesh, and nothing else does but what may simulate it.

    Raises:
        SetupError: a modifier is in the way.
    """
    for objection in objections(garment, simulated=simulated):
        raise SetupError(
            f"The modifier '{objection.modifier}' of '{garment.name}' {objection.does}; {objection.todo}."
        )


def reshapes(thing: bpy.types.Object) -> bool:
    """Return whether modifiers shape or weigh a body before its armature deforms it; it is then taken as they do."""
    place = bones_place(thing)
    passed = HARMLESS | {"ARMATURE"} | (REFINING if place is None else set())
    return any(
        modifier.show_viewport and (modifier.type not in passed or reweighs(modifier))
        for modifier in thing.modifiers[:place]
    )


def bones_place(thing: bpy.types.Object) -> int | None:
    """Return the place of the modifier by which bones move an object; None without one that has an armature."""
    places = (place for place, each in enumerate(thing.modifiers) if each.type == "ARMATURE" and each.object)
    return next(places, None)


def unmet_modifiers(body: bpy.types.Object) -> list[str]:
    """Return the names of modifiers that shape a body after bones, or add parts to it: cloth does not meet that."""
    place = bones_place(body)
    after = [] if place is None else body.modifiers[place + 1 :]
    passed = HARMLESS | REFINING | {"ARMATURE"}  # a second Armature is refused
    return [modifier.name for modifier in after if modifier.show_viewport and modifier.type not in passed]


def rendered_refining(body: bpy.types.Object) -> list[bpy.types.Modifier]:
    """Return the modifiers that refine a body where it is rendered, and may bring its skin out, as sculpting does."""
    return [each for each in body.modifiers if each.type in REFINING - {"MASK"} and each.show_render]


def shown_or_rendered_alone(body: bpy.types.Object) -> list[str]:
    """Return the names of modifiers that shape a body in viewports alone, or in renders alone."""
    passed = HARMLESS | REFINING
    return [
        each.name
        for each in body.modifiers
        if each.show_viewport != each.show_render
        and (each.type not in passed or reweighs(each))
        and not (each.type == "ARMATURE" and each.show_render)  # by which cloth meets the body all the same
    ]


def is_refined(thing: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> bool:
    """Return whether modifiers change how many vertices an object has."""
    return len(thing.evaluated_get(depsgraph).data.vertices) != len(thing.data.vertices)


def cage_points(thing: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
    """Return the vertices of an object's own mesh in the world as they are shown, shape (V, 3).

    Where modifiers change how many there are, these are the vertices that they begin with: shape keys, then bones.

    Raises:
        SetupError: modifiers do so before bones move the mesh.
    """
    if not is_refined(thing, depsgraph):
        return world_points(thing.evaluated_get(depsgraph))
    if reshapes(thing):
        shown, count = len(thing.evaluated_get(depsgraph).data.vertices), len(thing.data.vertices)
        raise SetupError(
            f"A modifier gives '{thing.name}' {shown} vertices where its mesh has {count}, before bones move it; "
            f"apply it, {BELOW}, or switch it off in viewports."
        )
    world = np.array(thing.matrix_world)
    points = mixed_points(thing) @ world[:3, :3].T + world[:3, 3]
    bones = next((item.object for item in thing.modifiers if item.type == "ARMATURE" and item.object), None)
    return _moved_by(bones.evaluated_get(depsgraph), thing, points) if bones else points


def _moved_by(armature: bpy.types.Object, thing: bpy.types.Object, points: np.ndarray) -> np.ndarray:
    """Return points in the world, shape (V, 3), as linear blend skinning moves them; those without weights stay."""
    bones = [bone for bone in armature.pose.bones if bone.bone.use_deform]
    weights = read_groups(thing, thing.data, [bone.name for bone in bones]).astype(np.float64)
    total = weights.sum(axis=1, keepdims=True)
    place = np.array(armature.matrix_world)
    back = np.linalg.inv(place)
    turns = [place @ np.array(bone.matrix @ bone.bone.matrix_local.inverted()) @ back for bone in bones]
    mixed = (weights @ np.array(turns).reshape(-1, 16)).reshape(-1, 4, 4) / np.where(total > 0, total, 1)[..., None]
    moved = np.einsum("vij,vj->vi", mixed[:, :3, :3], points) + mixed[:, :3, 3]
    return np.where(total > 0, moved, points)
