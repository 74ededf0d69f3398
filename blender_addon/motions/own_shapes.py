# SPDX-License-Identifier: GPL-3.0-or-later
"""Colliders that stand for the character's own body, as the shapes of a ragdoll do: cloth meets the body itself.

The rule is that of bakes (`ssilk_core.physics.world.own_shapes`), of bodies as Blender evaluates them.
"""

from __future__ import annotations

import bpy
import numpy as np

from ssilk_core.errors import SsilkError
from ssilk_core.physics.world.colliders import voting_rows
from ssilk_core.physics.world.own_shapes import BodyInFrame, OwnShapes

from ..errors import SetupError
from ..scene.garment import bodies_of
from ..scene.meshes import triangles_of
from ..scene.objects import found_again, scene_units
from .evaluating import evaluating
from .nearest import tree_nearest


def own_shapes(garment: bpy.types.Object, armature: bpy.types.Object, frames: range) -> OwnShapes | None:
    """Return what tells the colliders over frames of the timeline that lie inside a garment's character.

    None where it has no body, or one whose faces change: then all are met.
    """
    try:
        bodies = bodies_of(garment, armature)
    except SetupError:
        return None
    known = [(thing.session_uid, thing.name) for thing in (garment, *bodies)]
    _, first = _evaluated(known, frames[0])
    starts = np.cumsum([0, *(len(points) for points, _ in first)])
    faces = np.concatenate([own + start for (_, own), start in zip(first, starts)])

    def posed(frame: int) -> BodyInFrame:
        cloth, found = _evaluated(known, frames[frame])
        if [len(points) for points, _ in found] != [len(points) for points, _ in first]:
            raise SsilkError("The faces of the body change.")
        return BodyInFrame(np.concatenate([points for points, _ in found]), cloth[voting_rows(len(cloth))])

    return OwnShapes(faces, len(frames), posed, tree_nearest)


def _evaluated(known: list[tuple[int, str]], frame: int) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    """Return the points of a garment in a frame, (V, 3), and points and triangles of bodies, in the core's world."""
    things = [found_again(uid, name) for uid, name in known]
    with evaluating(*things) as at:
        depsgraph = at(frame)
        cloth, *bodies = [_placed(thing.evaluated_get(depsgraph)) for thing in things]
        faces = [triangles_of(thing.evaluated_get(depsgraph).data) for thing in things[1:]]
    return cloth, list(zip(bodies, faces))


def _placed(thing: bpy.types.Object) -> np.ndarray:
    """Return the vertices of an evaluated object in the core's world [m], shape (P, 3)."""
    points = np.empty(len(thing.data.vertices) * 3, dtype=np.float32)
    thing.data.vertices.foreach_get("co", points)
    place = np.array(thing.matrix_world)
    return scene_units().points_to_core(points.reshape(-1, 3) @ place[:3, :3].T + place[:3, 3])
