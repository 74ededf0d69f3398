# SPDX-License-Identifier: GPL-3.0-or-later
"""Bodies that have another shape than when a garment was trained on them, as where a shot sets other shape keys."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import bpy
import numpy as np

from ssilk_core.scene.assets import Character, Mesh

from ..arrays.joints import Joints, identifiers
from ..scene.garment import armature_of, bodies_of, rest_world
from ..scene.gather import SKELETON, evaluated, read_body
from ..scene.meshes import rest_points
from ..scene.modifiers import reshapes
from ..scene.objects import scene_units
from ..scene.shapes import mixed_points

SAME = 1e-3  # [m] that nobody sees


def corrected(garment: bpy.types.Object, joints: Joints, stage: Path) -> str:
    """Return in words how far shape keys move a garment at rest from its shape in training; empty if they do not.

    Args:
        joints, stage: as for `reshaped`.
    """
    from ssilk_usd.reading.garment import read_garment

    trained, back = _trained(garment, joints, stage)
    if back is None or not garment.data.shape_keys:
        return ""
    mesh = read_garment(str(stage), trained.skeleton).mesh
    points = _at_rest_now(garment)
    if len(points) != mesh.vertex_count:
        return ""
    away = np.linalg.norm(points @ back[:3, :3].T + back[:3, 3] - mesh.points, axis=1).max()
    if away <= SAME:
        return ""
    return f" (shape keys that correct '{garment.name}' by up to {1000 * away:.0f} mm in Blender are not in the shot)"


def trained_meshes(
    garment: bpy.types.Object, joints: Joints, stage: Path
) -> tuple[dict[str, Mesh], np.ndarray | None]:
    """Return the bodies of a stage by the names of their prims, and what moves the scene to where it was then.

    Args:
        joints, stage: as for `reshaped`.
    """
    trained, back = _trained(garment, joints, stage)
    return {body.mesh.path.rpartition("/")[2]: body.mesh for body in trained.bodies}, back


def at_rest_without_keys(thing: bpy.types.Object, back: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the points of an object are at rest without shape keys [m], (V, 3), and what turns offsets in its
    own space into such ones, (3, 3); both moved by `back`, as `trained_meshes` returns it."""
    world, units = np.array(rest_world(thing)), scene_units()
    linear = back[:3, :3] @ units.points_to_core(np.eye(3)).T @ world[:3, :3]
    placed = units.points_to_core(rest_points(thing) @ world[:3, :3].T + world[:3, 3])
    return placed @ back[:3, :3].T + back[:3, 3], linear


def reshaped(
    garment: bpy.types.Object, joints: Joints, stage: Path, followed: Sequence[bpy.types.Object] = ()
) -> str:
    """Return in words which body has another shape now than in the stage that was trained; empty if none has.

    Bodies that the stage lacks are not compared. In a Blender that has read USD.

    Args:
        joints: the character's, by the paths that the garment knows.
        stage: what was handed over for the training.
        followed: bodies whose shape is followed, which are not compared.
    """
    meshes, back = trained_meshes(garment, joints, stage)
    if back is None:
        return ""
    armature = armature_of(garment)
    things = [garment, *bodies_of(garment, armature)]
    with evaluated(things):
        return _first_off(things, armature, joints, meshes, back, followed)


def _trained(garment: bpy.types.Object, joints: Joints, stage: Path) -> tuple[Character, np.ndarray | None]:
    """Return the character of a stage, and what moves the scene to where it was then, (4, 4), or None."""
    from ssilk_usd.reading.character import read_character

    trained = read_character(str(stage), garment=identifiers([garment.name], taken=(SKELETON,))[0])
    order = {path: index for index, path in enumerate(trained.skeleton.joint_names)}
    shared = next((joint for joint, path in enumerate(joints.paths) if path in order), None)
    if shared is None:
        return trained, None
    now = np.linalg.inv(joints.binds[shared])
    return trained, trained.skeleton.bind_transforms[order[joints.paths[shared]]] @ now


def _at_rest_now(thing: bpy.types.Object) -> np.ndarray:
    """Return where the artist's keys have the points of an object at rest [m], shape (V, 3)."""
    world = np.array(rest_world(thing))
    return scene_units().points_to_core(mixed_points(thing, baked=False) @ world[:3, :3].T + world[:3, 3])


def _first_off(
    things: Sequence[bpy.types.Object],
    armature: bpy.types.Object,
    joints: Joints,
    meshes: Mapping[str, Mesh],
    back: np.ndarray,
    followed: Sequence[bpy.types.Object],
) -> str:
    for thing, name in list(zip(things, identifiers((each.name for each in things), taken=(SKELETON,))))[1:]:
        mesh = meshes.get(name)
        if mesh is None or thing in followed:
            continue
        if reshapes(thing):
            points = read_body(thing, armature, joints, thing.name).mesh.points
        else:
            points = _at_rest_now(thing)
        if len(points) != mesh.vertex_count:
            continue
        away = np.linalg.norm(points @ back[:3, :3].T + back[:3, 3] - mesh.points, axis=1).max()
        if away > SAME:
            return f" ('{thing.name}' is up to {1000 * away:.0f} mm off its shape in training, which the cloth met)"
    return ""
