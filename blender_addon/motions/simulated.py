# SPDX-License-Identifier: GPL-3.0-or-later
"""A garment that Blender simulates: its modifiers, and its vertices as they are evaluated, a little at a time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import bpy
import numpy as np

from ..errors import SetupError
from ..scene.meshes import world_points
from ..scene.modifiers import HARMLESS, REFINING, is_refined
from ..scene.objects import found_again, scene_units
from .sampling import SLICE


def simulating(garment: bpy.types.Object) -> list[bpy.types.Modifier]:
    """Return the modifiers that move a garment besides its armature, where they are switched on."""
    still = {"ARMATURE", *HARMLESS, *REFINING}
    return [modifier for modifier in garment.modifiers if modifier.show_viewport and modifier.type not in still]


def need_simulated(garment: bpy.types.Object) -> None:
    """Check that a garment is simulated, and that each of its frames can be shown by itself.

    Raises:
        SetupError: no modifier moves it, or a simulation is not baked.
    """
    moving = simulating(garment)
    if not moving:
        raise SetupError(f"No modifier simulates '{garment.name}'; give it a Cloth modifier, and bake that.")
    for modifier in moving:
        cache = getattr(modifier, "point_cache", None)
        if cache is not None and not cache.is_baked:
            raise SetupError(f"The modifier '{modifier.name}' of '{garment.name}' is not baked; bake it first.")


def switch_off(garment: bpy.types.Object) -> list[str]:
    """Switch off what simulates a garment; return the modifiers' names."""
    moving = simulating(garment)
    for modifier in moving:
        modifier.show_viewport = modifier.show_render = False
    return [modifier.name for modifier in moving]


def sample_vertices(garment: bpy.types.Object, frames: range, points: list[np.ndarray]) -> Iterator[float]:
    """Append the vertices of each frame in the world [m], y up, (V, 3), yielding the part that is done.

    The scene's frame is put back after each slice of time.

    Raises:
        SetupError: the garment was deleted meanwhile, or modifiers change the number of its vertices.
    """
    uid, name = garment.session_uid, garment.name
    while len(points) < len(frames):
        _sample_slice(found_again(uid, name), frames, points)
        yield len(points) / len(frames)


def _sample_slice(garment: bpy.types.Object, frames: range, points: list[np.ndarray]) -> None:
    scene, until = bpy.context.scene, time.monotonic() + SLICE
    before = scene.frame_current, scene.frame_subframe
    with _unrefined(garment):
        try:
            while len(points) < len(frames):
                scene.frame_set(frames[len(points)])
                points.append(_evaluated(garment))
                if time.monotonic() > until:
                    break
        finally:
            scene.frame_set(before[0], subframe=before[1])


def _evaluated(garment: bpy.types.Object) -> np.ndarray:
    depsgraph = bpy.context.evaluated_depsgraph_get()
    evaluated = garment.evaluated_get(depsgraph)
    if is_refined(garment, depsgraph):  # `cage_points` would leave out the simulation
        raise SetupError(
            f"Modifiers give '{garment.name}' {len(evaluated.data.vertices)} vertices, and the mesh has "
            f"{len(garment.data.vertices)}; switch off those that add or remove any."
        )
    return scene_units().points_to_core(world_points(evaluated))


@contextmanager
def _unrefined(garment: bpy.types.Object) -> Iterator[None]:
    """Switch off what only refines the surface, which is done to the bones' result as well."""
    shown = [modifier for modifier in garment.modifiers if modifier.type in REFINING and modifier.show_viewport]
    for modifier in shown:
        modifier.show_viewport = False
    try:
        yield
    finally:
        for modifier in shown:
            modifier.show_viewport = True
