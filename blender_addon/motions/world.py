# SPDX-License-Identifier: GPL-3.0-or-later
"""The gravity of a scene, and the wind of its force fields, over the frames of its timeline.

The scene's gravity counts in m/s2, whatever its unit of length: what Blender sets by default is the usual one. Fields
of the type *Wind* blow along their own Z axis with their strength in m/s, all over the scene, and add up. Fields of
the type *Turbulence* add gusts of their strength, with eddies of their size. Other fields are left out.
"""

from __future__ import annotations

import bpy
import numpy as np
from ssilk_usd.units import StageUnits

from ssilk_core.physics.constants import GRAVITY
from ssilk_core.scene.assets import UP, Air, Collider, ShotWorld
from ssilk_core.scene.assets.world import FASTEST

from ..errors import SetupError
from ..scene.objects import is_disabled, scene_step
from .evaluating import evaluating
from .keys import changing_paths, curves_of

WIND, TURBULENCE = "WIND", "TURBULENCE"
STRENGTH = "field.strength"
EDDIES = 2.0  # [m] of the largest, where a field of turbulence names no size
TO_CORE = StageUnits(1.0, "Z").rotation  # Blender's axes


def fields_in(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Return the objects whose wind or turbulence is on in a scene, by name; Blender leaves out excluded ones."""
    layer = bpy.context.view_layer if scene == bpy.context.scene else scene.view_layers[0]
    found = [thing for thing in layer.objects if thing.field and thing.field.type in (WIND, TURBULENCE)]
    return sorted((thing for thing in found if not is_disabled(thing)), key=lambda thing: thing.name)


def world_over(
    scene: bpy.types.Scene, frames: range, fps: float, colliders: tuple[Collider, ...] = ()
) -> ShotWorld | None:
    """Return what surrounds a character over frames of a timeline; None where nothing but the usual gravity does.

    Args:
        colliders: that were sampled over these frames.

    Raises:
        SetupError: gravity cannot be read, or fields blow too fast.
    """
    gravity, air = _gravity(scene, frames), _air(fields_in(scene), frames, fps)
    usual = gravity is None and air is None and not colliders
    return None if usual else ShotWorld(fps, colliders, gravity, air)


def signature(scene: bpy.types.Scene) -> tuple[object, ...]:
    """Return what decides gravity and wind but for what moves with time; it changes when the artist changes them."""
    blown = []
    for thing in fields_in(scene):
        moves = thing.animation_data or thing.parent or thing.constraints
        place = () if moves else [round(value, 6) for row in thing.matrix_world for value in row]
        strength = () if STRENGTH in changing_paths(thing.animation_data) else (thing.field.strength,)
        blown.append((thing.name, thing.field.type, thing.field.size, thing.field.seed, *strength, *place))
    pull = () if "gravity" in changing_paths(scene.animation_data) else tuple(scene.gravity)
    return scene.use_gravity, *pull, *blown


def _gravity_curves(scene: bpy.types.Scene) -> list[bpy.types.FCurve]:
    data = scene.animation_data
    if not data or not data.action:
        return []
    curves = curves_of(data.action, getattr(data, "action_slot", None))
    return [curve for curve in curves if curve.data_path == "gravity" and not curve.mute]


def _gravity(scene: bpy.types.Scene, frames: range) -> np.ndarray | None:
    """Return the scene's gravity [m/s2], shape (F or 1, 3), in the core's axes; None for the usual one.

    Raises:
        SetupError: it is driven, or keyed on NLA tracks.
    """
    found, curves = np.array(scene.gravity)[None], _gravity_curves(scene)
    if scene.use_gravity and not curves and "gravity" in changing_paths(scene.animation_data):
        where = f"The gravity of '{scene.name}' is driven or on NLA tracks"
        raise SetupError(f"{where}; key it in the scene's own action.")
    if curves:
        found = np.repeat(found, len(frames), axis=0)
        for curve in curves:
            found[:, curve.array_index] = [curve.evaluate(frame * scene_step()) for frame in frames]
    if not scene.use_gravity:
        found = np.zeros((1, 3))
    found = found @ TO_CORE.T
    return None if np.abs(found + GRAVITY * UP).max() < 1e-4 else found


def _air(fields: list[bpy.types.Object], frames: range, fps: float) -> Air | None:
    if not fields:
        return None
    velocity, gusts = np.zeros((len(frames), 3)), np.zeros(len(frames))
    names = [thing.name for thing in fields]
    with evaluating(*fields) as at:
        for row, frame in enumerate(frames):
            depsgraph = at(frame)
            for name in names:
                thing = bpy.data.objects[name].evaluated_get(depsgraph)
                if thing.field.type == WIND:
                    axis = np.array(thing.matrix_world)[:3, 2]
                    length = float(np.linalg.norm(axis))
                    if length > 0:  # where it is scaled flat, nothing blows
                        velocity[row] += thing.field.strength * TO_CORE @ (axis / length)
                else:
                    gusts[row] = np.hypot(gusts[row], thing.field.strength)
    fastest = max(float(np.linalg.norm(velocity, axis=1).max()), float(gusts.max()))
    if not fastest <= FASTEST:
        blown = ", ".join(f"'{name}'" for name in names)
        raise SetupError(f"{blown} blow with up to {fastest:.4g} m/s; lower the strength, {FASTEST:g} m/s at most.")
    eddies = [thing.field for thing in fields if thing.field.type == TURBULENCE]
    size = max((field.size for field in eddies), default=0.0) or EDDIES
    seed = eddies[0].seed if eddies else 0
    if not velocity.any() and not gusts.any():
        return None
    return Air(_least(velocity), _least(gusts), length=size, seed=seed, begins=frames.start / fps)


def _least(values: np.ndarray) -> np.ndarray:
    """Return values (F, ...) of frames, once where they do not change."""
    return values[:1] if len(values) and not np.ptp(values, axis=0).any() else values
