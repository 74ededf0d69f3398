# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene's units and rate, objects that are looked up again later, and selecting what a finding is about.

An object may have been deleted, renamed or replaced by an undo in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import bmesh
import bpy
from ssilk_usd.units import StageUnits

from ..errors import SetupError


def found_again(uid: int, name: str) -> bpy.types.Object:
    """Return the object with this session_uid.

    Raises:
        SetupError: it was deleted, though others may still refer to it; the sentence calls it `name`.
    """
    thing = next((thing for thing in bpy.data.objects if thing.session_uid == uid and thing.users_scene), None)
    if not thing:
        raise SetupError(f"'{name}' was deleted meanwhile; nothing was changed.")
    return thing


def is_disabled(thing: bpy.types.Object) -> bool:
    """Return whether an object is disabled in viewports, itself or by collections: Blender does not evaluate it."""
    return thing.hide_viewport or all(group.hide_viewport for group in thing.users_collection)


def need_enabled(things: Sequence[bpy.types.Object]) -> None:
    """Raise `SetupError` if an object is disabled in viewports, so that it is not where its bones are."""
    disabled = next((thing.name for thing in things if is_disabled(thing)), None)
    if disabled:
        raise SetupError(
            f"'{disabled}' is disabled in viewports, and Blender does not move it; enable it to measure."
        )


@dataclass(frozen=True)
class Pair:
    """A garment and its armature, by session_uid, with the names that they had."""

    garment: tuple[int, str]
    armature: tuple[int, str]

    @classmethod
    def of(cls, garment: bpy.types.Object, armature: bpy.types.Object) -> Pair:
        """Remember both."""
        return cls((garment.session_uid, garment.name), (armature.session_uid, armature.name))

    @property
    def name(self) -> str:
        """The name that the garment had."""
        return self.garment[1]

    def objects(self) -> tuple[bpy.types.Object, bpy.types.Object]:
        """Return the garment and the armature; raise `SetupError` if one was deleted."""
        return found_again(*self.garment), found_again(*self.armature)


def scene_units() -> StageUnits:
    """Return the scene's unit of length and Blender's up axis."""
    return StageUnits(bpy.context.scene.unit_settings.scale_length, "Z")


def scene_rate() -> float:
    """Return the scene's frames per second [1/s]."""
    render = bpy.context.scene.render
    return render.fps / render.fps_base


def scene_step() -> float:
    """Return by how much animation goes on from frame to frame: other than 1 where the scene's time is stretched."""
    render = bpy.context.scene.render
    return render.frame_map_old / render.frame_map_new


def select_elements(thing: bpy.types.Object, elements: str, indices: Sequence[int]) -> None:
    """Be in edit mode of a mesh with these of its "vertices" or "polygons" selected, and nothing else."""
    select_object(thing)
    vertices = elements == "vertices"
    bpy.context.tool_settings.mesh_select_mode = (vertices, False, not vertices)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="DESELECT")
    mesh = bmesh.from_edit_mesh(thing.data)  # Blender 5.0 ends where edges of a script's mesh are deselected before
    items = mesh.verts if vertices else mesh.faces
    items.ensure_lookup_table()
    for index in indices:
        items[index].select_set(True)
    mesh.select_flush_mode()
    bmesh.update_edit_mesh(thing.data, loop_triangles=False, destructive=False)


def select_bones(armature: bpy.types.Object, names: Sequence[str]) -> None:
    """Be in pose mode of an armature with these bones selected, and no other."""
    select_object(armature)
    bpy.ops.object.mode_set(mode="POSE")
    for name in names:
        for collection in armature.data.bones[name].collections:  # proxies are put away by a bake
            collection.is_visible = True
    for bone in armature.pose.bones:
        # Since Blender 5 pose bones are selected, before it was their bones.
        (bone if "select" in bone.bl_rna.properties else bone.bone).select = bone.name in names


def select_object(thing: bpy.types.Object) -> None:
    """Make an object the active and only selected one, in object mode."""
    if bpy.context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    for other in bpy.context.selected_objects:
        other.select_set(False)
    thing.select_set(True)
    bpy.context.view_layer.objects.active = thing
