# SPDX-License-Identifier: GPL-3.0-or-later
"""A garment tried on another body of its character's family, shown beside it, at rest.

What is shown are copies: the garment, the bodies, and lines where proxies are. Each has a shape key for each share at
which the garment was carried, and the slider sets their values. All of it is data of the file: undo, saving and
loading keep slider and copies together.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np

from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import Mesh

from ..arrays import heat
from ..arrays.try_on import KNOTS, knot_values
from ..scene.beside import clear_shapes, find_beside, remove_beside, show_beside
from ..scene.garment import armature_of, bodies_of
from ..scene.gather import GatheredScene
from ..scene.linked import own_copy
from ..scene.meshes import rest_points, triangles_of
from ..scene.objects import found_again
from ..scene.shapes import mixed_points, shape_bytes
from .heat import depths_in
from .lbs_copy import clear_colors

OWNER = "ssilk_tried_on"  # custom property of the empty: the garment
ROLE = "ssilk_role"  # custom property of the copies
CLOTH, BODY, PROXIES = "cloth", "body", "proxies"
MARK = "ssilk_mark"  # custom property of the empty: of the shapes that garment and bodies had
NAME = "ssilk_body"  # custom property of the empty: the body, in words
LENGTH = 0.05  # [m] of the lines that show proxies
PATIENCE = 0.15  # seconds after a change of the slider before what is inside is measured
_told: tuple[object, str] = (None, "")  # what was measured last, and what was found
_wanted: tuple[int, str, float] | None = None  # a garment by session_uid and name, with the share to be measured


@dataclass(frozen=True, eq=False)
class TriedOn:
    """Where a garment lies on other bodies [m]; K are the shares `KNOTS`.

    Attributes:
        body: the body at share 1, in words.
        mark: `mark_of` the garment when this was begun.
        cloth: the garment's vertices, shape (K, V, 3).
        bodies: those of each body mesh at share 1, shape (V, 3).
        proxies: the proxies, shape (K, P, 3); none where the garment has no rig.
    """

    body: str
    mark: str
    cloth: np.ndarray
    bodies: Sequence[np.ndarray]
    proxies: np.ndarray


def find(garment: bpy.types.Object) -> bpy.types.Object | None:
    """Return the empty that shows a garment on another body; None where none does."""
    return find_beside(garment, OWNER)


def show(garment: bpy.types.Object, scene: GatheredScene, tried: TriedOn) -> None:
    """Show a garment on another body, in place of one before. In object mode.

    Args:
        scene: the garment as it was fitted.
    """
    before = find(garment)
    if before:
        stop(before)
    units, shares, made, widths = scene.units, np.array(KNOTS)[:, None, None], [], []
    bodies = zip(list(scene.meshes.values())[1:], tried.bodies)
    places = [tried.cloth, *(mesh.points + shares * (end - mesh.points) for mesh, end in bodies)]
    for (name, mesh), at, role in zip(scene.meshes.items(), places, (CLOTH, *[BODY] * len(scene.meshes))):
        rest = units.points_from_core(mesh.points)
        copy = bpy.data.objects.new(f"{name} on {tried.body}", _mesh_of(name, mesh))
        copy.data.vertices.foreach_set("co", rest.astype(np.float32).reshape(-1))
        _add_keys(copy, [units.points_from_core(each) for each in at])
        copy[ROLE] = role
        made.append(copy)
        widths.append((rest[:, 0].min(), rest[:, 0].max()))
    if scene.rig:
        made.append(_lines(scene, tried))
    shown = show_beside(
        garment, made, OWNER, name=f"{garment.name} tried on", empty=f"{garment.name} on {tried.body}, beside",
        width=float(np.max(widths) - np.min(widths)), into=bpy.context.scene.collection,
    )  # fmt: skip
    shown.hide_render = True
    shown[MARK], shown[NAME] = tried.mark, tried.body
    wear(garment)


def stop(shown: bpy.types.Object) -> None:
    """Show it no longer."""
    remove_beside(shown)


def wear(garment: bpy.types.Object) -> None:
    """Show a garment, where it is tried on, as far towards the other body as its slider says."""
    shown = find(garment)
    if shown is None or shown.instance_collection is None:
        return
    values = knot_values(garment.ssilk.try_on.share)
    for copy in shown.instance_collection.objects:
        if copy.data.shape_keys:  # unless the artist has cleared them
            for knot, value in zip(KNOTS, values):
                if block := copy.data.shape_keys.key_blocks.get(f"{knot:g}"):
                    block.value = value


def body_of(shown: bpy.types.Object) -> str:
    """Return the body that a garment is tried on, in words."""
    return str(shown.get(NAME, ""))


def changed(garment: bpy.types.Object) -> bool:
    """Return whether a garment that is tried on, or its bodies, have another shape than then."""
    shown = find(garment)
    try:
        return shown is not None and shown.get(MARK) != mark_of(garment)
    except SsilkError:  # it has lost its armature, or its bodies
        return True


def mark_of(garment: bpy.types.Object) -> str:
    """Return what differs once a garment or its bodies have another shape.

    Raises:
        SetupError: it has no armature, or no body.
    """
    mark = 0
    for thing in (garment, *bodies_of(garment, armature_of(garment))):
        for part in (rest_points(thing).tobytes(), shape_bytes(thing)):
            mark = zlib.crc32(part, mark)
    return f"{mark:08x}"


def inside(garment: bpy.types.Object) -> str:
    """Return in words how much of a garment that is tried on is inside the body where it is shown."""
    shown = find(garment)
    copies = list(shown.instance_collection.objects) if shown and shown.instance_collection else []
    cloth = next((copy for copy in copies if copy.get(ROLE) == CLOTH), None)
    bodies = [copy for copy in copies if copy.get(ROLE) == BODY]
    if cloth is None or not bodies:
        return ""
    points, deep = mixed_points(cloth), []
    for body in bodies:
        steps = depths_in(points, mixed_points(body), triangles_of(body.data))
        while True:
            try:
                next(steps)
            except StopIteration as end:
                deep.append(end.value)
                break
    depths = bpy.context.scene.unit_settings.scale_length * np.max(deep, axis=0)
    return heat.told_inside(depths)


def inside_line(garment: bpy.types.Object) -> str:
    """Return `inside` for panels, which are drawn many times a second: it is measured once the slider rests."""
    global _wanted
    shown = find(garment)
    key = shown and (shown.session_uid, garment.ssilk.try_on.share)
    if key == _told[0]:
        return _told[1]
    if bpy.app.background:
        return _measured(garment, key)
    _wanted = (garment.session_uid, garment.name, garment.ssilk.try_on.share)
    if not bpy.app.timers.is_registered(_measure):
        bpy.app.timers.register(_measure, first_interval=PATIENCE)
    return "What is inside the body is measured once the slider rests"


def forget() -> None:
    """Measure no more."""
    global _told, _wanted
    _told, _wanted = (None, ""), None
    if bpy.app.timers.is_registered(_measure):
        bpy.app.timers.unregister(_measure)


def _measured(garment: bpy.types.Object, key: object) -> str:
    global _told
    _told = key, inside(garment)
    return _told[1]


def _measure() -> float | None:
    """Measure what is wanted, unless the slider was moved since; return when to be called again."""
    global _wanted
    if _wanted is None:
        return None
    uid, name, share = _wanted
    try:
        garment = found_again(uid, name)
    except SsilkError:  # it was deleted
        _wanted = None
        return None
    now = garment.ssilk.try_on.share
    if now != share:
        _wanted = (uid, name, now)
        return PATIENCE
    _wanted, shown = None, find(garment)
    if shown:
        _measured(garment, (shown.session_uid, share))
        for window in bpy.context.window_manager.windows:
            for area in window.screen.areas:
                if area.type == "VIEW_3D":
                    area.tag_redraw()
    return None


def _mesh_of(name: str, mesh: Mesh) -> bpy.types.Mesh:
    """Return a mesh with the faces and the look of an object; without its look where modifiers change its faces."""
    thing = bpy.data.objects.get(name)
    if thing and thing.type == "MESH" and len(thing.data.vertices) == mesh.vertex_count:
        made = own_copy(thing.data)
        holder = bpy.data.objects.new(name, made)
        clear_shapes(holder)
        bpy.data.objects.remove(holder)
        clear_colors(made)
        if thing.matrix_world.determinant() < 0:  # mirrored, and so are its faces
            made.flip_normals()
        return made
    made = bpy.data.meshes.new(name)
    corners = np.split(mesh.polygon_indices, np.cumsum(mesh.polygon_counts)[:-1])
    made.from_pydata(mesh.points.tolist(), [], [each.tolist() for each in corners])
    made.shade_smooth()
    return made


def _add_keys(copy: bpy.types.Object, places: Sequence[np.ndarray]) -> None:
    """Give an object a shape key for each knot, with its points there (V, 3)."""
    copy.shape_key_add(name="Basis", from_mix=False)
    for knot, points in zip(KNOTS, places):
        key = copy.shape_key_add(name=f"{knot:g}", from_mix=False)
        key.slider_min, key.slider_max = 0.0, 1.0
        key.points.foreach_set("co", points.astype(np.float32).reshape(-1))


def _lines(scene: GatheredScene, tried: TriedOn) -> bpy.types.Object:
    """Return an object with a line for each proxy, along its bone's y axis as Blender draws bones."""
    units, binds = scene.units, scene.rig.bind_transforms
    heads, count = units.points_from_core(binds[:, :3, 3]), len(binds)
    along = LENGTH * (units.points_from_core(binds[:, :3, 3] + binds[:, :3, 1]) - heads)
    mesh = bpy.data.meshes.new("Proxies")
    pairs = [(row, row + count) for row in range(count)]
    mesh.from_pydata(np.concatenate([heads, heads + along]).tolist(), pairs, [])
    lines = bpy.data.objects.new(f"Proxies on {tried.body}", mesh)
    starts = [units.points_from_core(each) for each in tried.proxies]
    _add_keys(lines, [np.concatenate([start, start + along]) for start in starts])
    lines[ROLE], lines.show_in_front = PROXIES, True
    return lines
