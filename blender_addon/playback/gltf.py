# SPDX-License-Identifier: GPL-3.0-or-later
"""A baked character as a glb of Blender's own exporter, set so that nothing of a bake is lost, and read back.

By its defaults that exporter makes an animation of each action, so that a bake, which lies beneath the artist's
action, plays without it; and it keeps four influences of each vertex. In Blender 5.0 it takes the scene's rate
as `fps * fps_base`, where Blender plays `fps / fps_base`, so that it is given the reciprocal of `fps_base`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils.kdtree import KDTree

from ssilk_core.delivery.gltf.skinned import SkinnedGlb

from ..errors import SetupError
from ..motions.simulated import sample_vertices
from ..scene.meshes import rest_points
from ..scene.objects import scene_rate, scene_units
from ..scene.riders import riders_of, with_parts

SETTINGS: dict[str, Any] = {
    "export_format": "GLB",
    "use_selection": True,
    "export_yup": True,
    "export_apply": False,
    "export_animations": True,
    "export_animation_mode": "SCENE",
    "export_anim_scene_split_object": False,
    "export_frame_range": True,
    "export_frame_step": 1,
    "export_force_sampling": True,
    "export_optimize_animation_size": False,
    "export_current_frame": False,
    "export_skins": True,
    "export_all_influences": True,
    "export_rest_position_armature": True,
    "export_morph": True,
    "export_morph_animation": True,
}
ADDON = "io_scene_gltf2"
REST_FRAME = 0  # which the exporter shows before it reads meshes, without `export_current_frame`
MOST_LOST = 1e-3  # [m] by which a vertex may differ from what Blender shows
MOMENTS = 8  # frames, about, in which two Blenders are compared
SAME = 1e-5  # of the garment's size: rest points that are one place


def exported(garment: bpy.types.Object, armature: bpy.types.Object, path: Path) -> tuple[float, int]:
    """Write a glb of a garment with its armature, shown though they may be hidden; return its largest loss [m] and
    the frame: of the garment or of what rides on it.

    Raises:
        SsilkError: as `export_glb`, `largest_loss` and `largest_loss_of_riders` do, or a collection hides one.
    """
    with visible([garment, armature]):
        export_glb(garment, armature, path)
        return max(largest_loss(garment, path), largest_loss_of_riders(garment, path))


def write_seen(garment: bpy.types.Object, armature: bpy.types.Object, path: Path) -> None:
    """Write the vertices of a garment in some frames of the scene (.npy), for `apart` in another Blender.

    Raises:
        SetupError: as `visible` and `sample_vertices` do.
    """
    np.save(path, _seen(garment, armature))


def apart(garment: bpy.types.Object, armature: bpy.types.Object, path: Path) -> tuple[float, int]:
    """Return how far a garment is from what `write_seen` saw, at most [m], and in which frame.

    Two Blenders show one file alike, unless only one of them has what drivers and handlers call.
    """
    losses = np.linalg.norm(np.load(path) - _seen(garment, armature), axis=2).max(axis=1)
    return float(losses.max()), _moments()[int(losses.argmax())]


def _seen(garment: bpy.types.Object, armature: bpy.types.Object) -> np.ndarray:
    """Return a garment's vertices in the world [m], y up, shape (F, V, 3)."""
    shown: list[np.ndarray] = []
    with visible([garment, armature]):
        for _ in sample_vertices(garment, _moments(), shown):
            pass
    return np.array(shown)


def _moments() -> range:
    """Return frames over the scene's range, always with its last one, since most drivers move with time."""
    scene = bpy.context.scene
    count = scene.frame_end - scene.frame_start
    return range(scene.frame_end, scene.frame_start - 1, -max(1, count // MOMENTS))[::-1]


def export_glb(garment: bpy.types.Object, armature: bpy.types.Object, path: Path) -> None:
    """Write an armature with everything that it moves over the scene's frames.

    Raises:
        SetupError: Blender's exporter is switched off, or fails.
    """
    if ADDON not in bpy.context.preferences.addons:
        raise SetupError("Blender's add-on for glTF 2.0 is switched off; switch it on in the preferences.")
    base = bpy.context.scene.render.fps_base
    with _selected([armature, *_moved(armature), garment, *with_parts(riders_of(garment))]):
        with _fps_base(1 / base):
            _export(path)
        if not _lasts_as_played(garment, path):
            _export(path)


def _export(path: Path) -> None:
    try:
        bpy.ops.export_scene.gltf(filepath=str(path), **SETTINGS)
    except RuntimeError as error:
        raise SetupError(f"'{path.name}' cannot be exported: {str(error).strip()}") from error


@contextmanager
def _fps_base(value: float) -> Iterator[None]:
    """Change by what a scene's rate is divided, and change it back."""
    render = bpy.context.scene.render
    before = render.fps_base
    render.fps_base = value
    try:
        yield
    finally:
        render.fps_base = before


def _lasts_as_played(garment: bpy.types.Object, path: Path) -> bool:
    """Return whether the exporter multiplied by the reciprocal of `fps_base` that it was given, in place of dividing.

    Raises:
        SsilkError: the file holds something else than one animation of the garment.
    """
    scene = bpy.context.scene
    render, played = scene.render, SkinnedGlb(path, garment.name)
    lasts = played.end - played.start
    right, wrong = (
        (scene.frame_end - scene.frame_start) / rate for rate in (scene_rate(), render.fps * render.fps_base)
    )
    return abs(lasts - right) <= abs(lasts - wrong)


def largest_loss(garment: bpy.types.Object, path: Path) -> tuple[float, int]:
    """Return how far a garment of a glb is from what Blender shows, at most [m], and in which frame.

    Raises:
        SetupError: modifiers change the number of its vertices.
        SsilkError: the file holds something else.
    """
    scene = bpy.context.scene
    shown: list[np.ndarray] = []
    frames = range(scene.frame_start, scene.frame_end + 1)
    for _ in sample_vertices(garment, frames, shown):
        pass
    units, played = scene_units(), SkinnedGlb(path, garment.name)
    here = _placed(garment)
    rest = (rest_points(garment) @ here[:3, :3].T + here[:3, 3]) @ units.rotation.T
    stored, own = _pairs(played.rest, rest)
    firsts = np.flatnonzero(np.diff(stored, prepend=-1))
    losses = []
    for number, points in enumerate(shown):
        there = played.vertices(played.start + number / scene_rate()) * units.meters_per_unit
        losses.append(np.minimum.reduceat(np.linalg.norm(there[stored] - points[own], axis=1), firsts).max())
    return float(max(losses)), frames[int(np.argmax(losses))]


def largest_loss_of_riders(garment: bpy.types.Object, path: Path) -> tuple[float, int]:
    """Return how far what rides on a garment is from where Blender shows it, at most [m], and in which frame.

    Raises:
        SsilkError: the file lacks one.
    """
    scene, units = bpy.context.scene, scene_units()
    parts, turn = [part for part in with_parts(riders_of(garment)) if part.visible_get()], np.eye(4)
    if not parts:
        return 0.0, scene.frame_start
    played, worst, before = SkinnedGlb(path, garment.name), (0.0, scene.frame_start), scene.frame_current
    turn[:3, :3] = units.rotation
    corners = [np.column_stack([np.array(part.bound_box), np.ones(8)]) @ turn.T for part in parts]
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        time = played.start + (frame - scene.frame_start) / scene_rate()
        for part, box in zip(parts, corners):
            there = played.place(part.name, time) - turn @ np.array(part.matrix_world) @ turn.T
            off = float(np.linalg.norm(box @ there[:3].T, axis=1).max()) * units.meters_per_unit
            worst = max(worst, (off, frame))
    scene.frame_set(before)
    return worst


def _placed(garment: bpy.types.Object) -> np.ndarray:
    """Return where a garment's object is in the frame in which the exporter reads meshes at rest, shape (4, 4)."""
    scene = bpy.context.scene
    before = scene.frame_current, scene.frame_subframe
    scene.frame_set(REST_FRAME)
    try:
        return np.array(garment.matrix_world)
    finally:
        scene.frame_set(before[0], subframe=before[1])


def _pairs(stored: np.ndarray, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each vertex of a file with the vertices of the garment that are in its place at rest, as two indices."""
    tree = KDTree(len(rest))
    for index, point in enumerate(rest):
        tree.insert(point, index)
    tree.balance()
    near = SAME * max(float(np.ptp(rest, axis=0).max()), 1e-9)
    found = [[index for _, index, _ in tree.find_range(point, near)] for point in stored]
    lost = sum(not each for each in found)
    if lost:
        raise SetupError(
            f"{lost} vertices of the exported garment are at no vertex of the mesh at rest; export again."
        )
    return np.repeat(np.arange(len(found)), [len(each) for each in found]), np.concatenate(found)


def _moved(armature: bpy.types.Object) -> list[bpy.types.Object]:
    """Return what an armature hangs on, and what it moves by modifiers or as a parent."""
    found, above = [], armature.parent
    while above:
        found.append(above)
        above = above.parent
    moved = [
        thing
        for thing in bpy.context.view_layer.objects
        if any(modifier.type == "ARMATURE" and modifier.object == armature for modifier in thing.modifiers)
    ]
    return [*found, *moved, *armature.children_recursive]


@contextmanager
def visible(things: list[bpy.types.Object]) -> Iterator[None]:
    """Show objects that are hidden, which Blender neither exports nor evaluates, and hide them again afterwards.

    Raises:
        SetupError: a collection hides one, or it is in none of the view layer.
    """
    layer = bpy.context.view_layer
    there = [thing for thing in things if thing.name in layer.objects]
    before = [(thing, thing.hide_get(), thing.hide_viewport) for thing in there]
    try:
        for thing in there:
            thing.hide_viewport = False
            thing.hide_set(False)
        layer.update()
        for thing in things:
            if thing not in there or not thing.visible_get():
                raise SetupError(f"'{thing.name}' is in a hidden collection; show that in the outliner.")
        yield
    finally:
        for thing, hidden, disabled in before:
            thing.hide_set(hidden)
            thing.hide_viewport = disabled


@contextmanager
def _selected(things: list[bpy.types.Object]) -> Iterator[None]:
    """Select visible objects and nothing else, and what was selected again afterwards."""
    layer = bpy.context.view_layer
    before = [thing for thing in layer.objects if thing.select_get()]
    chosen = {thing.name for thing in things}
    try:
        for thing in layer.objects:
            thing.select_set(thing.name in chosen and thing.visible_get())
        yield
    finally:
        for thing in layer.objects:
            thing.select_set(thing in before)
