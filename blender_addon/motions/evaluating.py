# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames of some objects as Blender evaluates them: in a temporary scene, or in the artist's where that is read.

A temporary scene leaves the artist's frame and poses alone, and is fast. What drivers read of a scene, its frame, its
properties, its simulations, is the artist's scene's alone. There the frame is set, and put back at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain

import bpy

Frames = Callable[[int], bpy.types.Depsgraph]  # evaluates a frame
TRACKING = {"CAMERA_SOLVER", "FOLLOW_TRACK", "OBJECT_SOLVER"}  # constraints that look through the scene's camera


@contextmanager
def evaluating(*things: bpy.types.Object) -> Iterator[Frames]:
    """Yield what evaluates a frame of some objects with all that they depend on."""
    own = bpy.context.scene
    with _in_place(*things) if reads_scene(own) else _alone(own, *things) as frames:
        yield frames


def reads_scene(scene: bpy.types.Scene) -> bool:
    """Return whether anything in the file may move otherwise in this scene than in another one at the same frame."""
    world = scene.rigidbody_world
    simulated = bool(world and world.enabled and world.collection and world.collection.objects)
    return simulated or any(map(_driver_reads_scene, _drivers())) or any(map(_is_tracking, bpy.data.objects))


def _drivers() -> Iterator[bpy.types.Driver]:
    data = bpy.data
    owners = chain(
        data.objects, data.armatures, data.shape_keys, data.lattices, data.curves, data.node_groups, data.scenes,
        data.cameras, data.meshes, data.metaballs,
    )  # fmt: skip
    for owner in owners:
        for curve in owner.animation_data.drivers if owner.animation_data else ():
            yield curve.driver


def _driver_reads_scene(driver: bpy.types.Driver) -> bool:
    """Return whether a driver reads a scene; Python of which nobody knows what it reads counts."""
    if driver.type == "SCRIPTED" and not driver.is_simple_expression:
        return True
    return any(
        variable.type == "CONTEXT_PROP" or any(isinstance(target.id, bpy.types.Scene) for target in variable.targets)
        for variable in driver.variables
    )


def _is_tracking(thing: bpy.types.Object) -> bool:
    bones = thing.pose.bones if thing.pose else ()
    return any(item.type in TRACKING for item in chain(thing.constraints, *(bone.constraints for bone in bones)))


@contextmanager
def _alone(own: bpy.types.Scene, *things: bpy.types.Object) -> Iterator[Frames]:
    scene = bpy.data.scenes.new("SSILK")
    scene.render.frame_map_old, scene.render.frame_map_new = own.render.frame_map_old, own.render.frame_map_new

    def at(frame: int) -> bpy.types.Depsgraph:
        scene.frame_set(frame)
        return scene.view_layers[0].depsgraph

    try:
        for thing in things:
            scene.collection.objects.link(thing)
        yield at
    finally:
        bpy.data.scenes.remove(scene)


@contextmanager
def _in_place(*things: bpy.types.Object) -> Iterator[Frames]:
    scene, layer = bpy.context.scene, bpy.context.view_layer
    before = scene.frame_current, scene.frame_subframe
    lent = [
        thing for thing in things if thing.name not in layer.objects and thing.name not in scene.collection.objects
    ]

    def at(frame: int) -> bpy.types.Depsgraph:
        scene.frame_set(frame)
        return bpy.context.evaluated_depsgraph_get()

    try:
        for thing in lent:
            scene.collection.objects.link(thing)
        yield at
    finally:
        for thing in lent:
            scene.collection.objects.unlink(thing)
        scene.frame_set(before[0], subframe=before[1])
