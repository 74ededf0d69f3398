# SPDX-License-Identifier: GPL-3.0-or-later
"""Findings of Blender's own data, and findings that artists mend by hand.

What can be looked at in a moment is looked at again, without ssilk. All else is marked as older than the mesh.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace

import bpy
import numpy as np

from ssilk_core.authoring.preflight import mesh as checks
from ssilk_core.authoring.preflight.finding import Finding, index_tuple
from ssilk_core.authoring.preflight.fit import open_border
from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import Mesh

from ..arrays.findings import HOLES, on_polygons, open_edges
from ..scene.armature import is_evenly_scaled
from ..scene.garment import armature_of, bodies_of
from ..scene.gather import read_mesh
from ..scene.modifiers import objections, unmet_modifiers
from ..scene.shapes import mixed_points, shape_bytes

SCALE, MODIFIER, UNMET = "unequal-scale", "shaping-modifier", "unmet-modifier"


def scene_findings(garment: bpy.types.Object) -> list[Finding]:
    """Return what must be fixed before ssilk can inspect a garment, with names of objects in place of prims.

    Raises:
        SetupError: it has no armature, or several.
    """
    armature, found = armature_of(garment), []
    if not is_evenly_scaled(armature):
        found.append(Finding(
            severity="error", code=SCALE, prim=armature.name, found="its bones are scaled unequally or mirrored",
            why="joints turn and move, they have no scale", fix="apply its scale (Ctrl A)", fixable=True,
        ))  # fmt: skip
    found += [
        Finding(
            severity="error", code=MODIFIER, prim=garment.name,
            found=f"its modifier '{objection.modifier}' {objection.does}",
            why="what is trained are the vertices of its mesh, which bones move", fix=objection.todo,
        )
        for objection in objections(garment)
    ]  # fmt: skip
    return found


def body_findings(garment: bpy.types.Object) -> list[Finding]:
    """Return what of a garment's bodies cloth does not meet, with names of objects in place of prims.

    Raises:
        SetupError: it has no armature, or several; or no body.
    """
    return [
        Finding(
            severity="warning", code=UNMET, prim=body.name, found=f"its modifier '{name}' comes after its bones",
            why="cloth meets the body without it", fix="move it above the Armature modifier, or apply it",
        )
        for body in bodies_of(garment, armature_of(garment))
        for name in unmet_modifiers(body)
    ]  # fmt: skip


def _holes(mesh: Mesh) -> Iterator[Finding]:
    rim, _ = open_border(mesh)
    if len(rim):
        yield Finding(
            severity="warning", code=HOLES, prim=mesh.path, found=open_edges(mesh), elements="vertices",
            indices=index_tuple(rim),
        )  # fmt: skip


CHECKS: dict[str, Callable[[Mesh], Iterator[Finding]]] = {
    "isolated-vertices": checks.isolated_vertices,
    "duplicate-vertices": lambda mesh: checks.duplicate_vertices(mesh, np.arange(mesh.vertex_count)),
    "duplicate-faces": checks.duplicate_faces,
    "non-manifold-edges": checks.non_manifold_edges,
    "degenerate-faces": lambda mesh: checks.degenerate_faces(mesh, 0),
    "two-layers": checks.two_layers,
    "sliver-faces": lambda mesh: checks.degenerate_faces(mesh, 0),
    HOLES: _holes,
}  # by code


def mark_of(name: str) -> str:
    """Return what differs once an object's mesh, shape or place has changed; empty where there is no such mesh."""
    thing = bpy.data.objects.get(name)
    if not thing or thing.type != "MESH":
        return ""
    mesh = thing.data
    points, corners = np.empty(3 * len(mesh.vertices), np.float32), np.empty(len(mesh.loops), np.int32)
    mesh.vertices.foreach_get("co", points)
    mesh.loops.foreach_get("vertex_index", corners)
    place = np.array(thing.matrix_world, np.float32)
    mark = 0
    for part in (points.tobytes(), shape_bytes(thing), corners.tobytes(), place.tobytes()):
        mark = zlib.crc32(part, mark)
    return f"{mark:08x}"


def look_again(preflight: bpy.types.PropertyGroup) -> bool:
    """Take mended findings from the list, and mark those that are older than their mesh; return whether any changed.

    In object mode.
    """
    garment = bpy.data.objects.get(preflight.garment)
    if garment is None or not preflight.findings:
        return False
    left_out = {item.called for item in garment.ssilk.training.motions if not item.use}
    left_out -= {item.called for item in garment.ssilk.training.motions if item.use}
    marks: dict[str, str] = {}
    changed = False
    for index in reversed(range(len(preflight.findings))):
        item = preflight.findings[index]
        if item.mark and item.target not in marks:
            marks[item.target] = mark_of(item.target)
        if _mended(item, garment, left_out, marks.get(item.target, "")):
            preflight.findings.remove(index)
            preflight.active -= preflight.active > 0 and preflight.active >= index
            changed = True
        elif item.mark and item.mark != marks[item.target] and not item.old:
            item.old = changed = True
    return changed


def _mended(item: bpy.types.PropertyGroup, garment: bpy.types.Object, left_out: set[str], mark: str) -> bool:
    """Return whether a finding holds no more; where it still does, bring it up to date if that takes a moment."""
    if item.code in {SCALE, MODIFIER, UNMET}:
        try:
            found = body_findings(garment) if item.code == UNMET else scene_findings(garment)
            return (item.target, item.found) not in {(each.prim, each.found) for each in found}
        except SsilkError:  # it has no armature any more, or no body
            return True
    if item.target in left_out and item.target not in bpy.data.objects:
        return True
    if item.mark == mark or item.code not in CHECKS or not mark:
        return False
    thing = bpy.data.objects[item.target]
    mesh = read_mesh(thing, thing.data, thing.name, mixed_points(thing, baked=False))
    found = [each for each in CHECKS[item.code](mesh) if each.code == item.code]
    if found:
        item.take(on_polygons(replace(found[0], prim=item.target, fixable=item.fixable), mesh), mark)
    return not found
