# SPDX-License-Identifier: GPL-3.0-or-later
"""Selecting what a finding is about, in the mode in which it can be seen."""

from __future__ import annotations

from collections.abc import Sequence

import bmesh
import bpy


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
