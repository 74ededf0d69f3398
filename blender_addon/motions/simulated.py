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
from ..scene.modifiers import HARMLESS, REFINING, is_refined, moves_by_itself, simulates_in_order
from ..scene.objects import found_again, scene_units
from .sampling import SLICE

STILL = 1e-6  # how far a vertex moves that does not [m]


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
        raise SetupError(
            f"No modifier simulates '{garment.name}'; add a simulation or a cache below its Armature modifier."
        )
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

    The scene's frame is put back after each slice of time. Where nodes simulate, all frames are played in order and
    it is put back at the end: a later frame that is shown in between would spoil those that follow.

    Raises:
        SetupError: the garment was deleted meanwhile, modifiers change the number of its vertices, or the frame was
            changed while nodes simulated.
    """
    ordered = any(map(simulates_in_order, simulating(garment)))
    for _ in (_in_order if ordered else _apart)(garment, frames, points):
        yield len(points) / len(frames)


def _apart(garment: bpy.types.Object, frames: range, points: list[np.ndarray]) -> Iterator[None]:
    uid, name, waiting = garment.session_uid, garment.name, list(frames)
    while waiting:
        before = _frame_now()
        try:
            _sample_slice(found_again(uid, name), waiting, frames, points)
        finally:
            _show_frame(before)
        yield


def _in_order(garment: bpy.types.Object, frames: range, points: list[np.ndarray]) -> Iterator[None]:
    uid, name, before = garment.session_uid, garment.name, _frame_now()
    waiting = list(range(min(_first_simulated(), frames.start), frames.stop))
    try:
        while waiting:
            _sample_slice(found_again(uid, name), waiting, frames, points)
            left = _frame_now()
            yield
            if _frame_now() != left:
                raise SetupError(
                    f"The frame was changed while '{name}' was simulated; leave the timeline and repeat."
                )
    finally:
        _show_frame(before)


def need_moved(garment: bpy.types.Object, frames: range, points: list[np.ndarray]) -> None:
    """Check that each simulation moved something; Blender passes over a cache that is gone or of another mesh.

    Args:
        points: vertices of each frame, as `sample_vertices` gives them.

    Raises:
        SetupError: without it the garment is the same in the first frame, in the middle and in the last one.
    """
    before, chosen = _frame_now(), sorted({0, len(frames) // 2, len(frames) - 1})
    for modifier in filter(moves_by_itself, simulating(garment)):
        modifier.show_viewport = False
        try:
            with _unrefined(garment):
                still = all(
                    np.allclose(_evaluated_at(garment, frames[index]), points[index], rtol=0, atol=STILL)
                    for index in chosen
                )
        finally:
            modifier.show_viewport = True
            _show_frame(before)
        if still:
            raise SetupError(
                f"The modifier '{modifier.name}' moves no vertex of '{garment.name}' in the frames "
                f"{', '.join(str(frames[index]) for index in chosen)}; see that its cache is there, of this mesh."
            )


def _frame_now() -> tuple[int, float]:
    scene = bpy.context.scene
    return scene.frame_current, scene.frame_subframe


def _show_frame(frame: tuple[int, float]) -> None:
    bpy.context.scene.frame_set(frame[0], subframe=frame[1])


def _first_simulated() -> int:
    """Return the frame in which nodes of the scene begin to simulate."""
    scene = bpy.context.scene
    return scene.simulation_frame_start if scene.use_custom_simulation_range else scene.frame_start


def _sample_slice(garment: bpy.types.Object, waiting: list[int], frames: range, points: list[np.ndarray]) -> None:
    """Play the first of the frames that wait, for a moment, and append the vertices of those that are asked for."""
    until = time.monotonic() + SLICE
    with _unrefined(garment):
        while waiting:
            bpy.context.scene.frame_set(frame := waiting.pop(0))
            if frame in frames:
                points.append(_evaluated(garment))
            if time.monotonic() > until:
                break


def _evaluated_at(garment: bpy.types.Object, frame: int) -> np.ndarray:
    bpy.context.scene.frame_set(frame)
    return _evaluated(garment)


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
