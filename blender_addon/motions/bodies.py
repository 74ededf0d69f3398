# SPDX-License-Identifier: GPL-3.0-or-later
"""Bodies looked at in a few frames: which change their shape, and which Blender shows elsewhere than bones have them.

Whatever the cause may be: Blender evaluates copies of a body, one without its bones and one with them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import bpy
import numpy as np
from mathutils.bvhtree import BVHTree

from ..scene.armature import leader_of
from ..scene.garment import carrier_of, is_carried, rest_world
from ..scene.linked import local_copy
from ..scene.meshes import world_points
from ..scene.modifiers import REFINING, bones_place, rendered_refining, reshapes
from ..scene.weights import read_groups
from .evaluating import evaluating
from .sources import Source, frames_of, playing

LOOKS = 8  # frames that are looked at, of all motions together
STILL = 1e-4  # of a body's size, by which it may be off unseen
NEAR = 0.2  # of a body's size, within which refined skin is that of the place beneath it
FINEST = 2  # levels of subdivision that viewports do not show and that are looked at: they have sculpted shapes
MOST = 200_000  # vertices, to which these levels are limited
LOOKED_AT = 20_000  # vertices of refined skin, spread over it


@dataclass
class LookedAt:
    """What was seen of a body.

    Attributes:
        changes: whether modifiers change its shape before its bones move it.
        away: how far a vertex is from where bones move it at most, in Blender's units; zero where nobody sees it.
        frame, motion: where that was.
        outside: how far renders show its skin at most outside of what cloth meets, in Blender's units, in the first
            look: where modifiers that refine it thicken it or are sculpted.
    """

    changes: bool = False
    away: float = 0.0
    frame: int = 0
    motion: str = ""
    outside: float = 0.0


def look_at(
    armature: bpy.types.Object, bodies: Sequence[bpy.types.Object], motions: Sequence[Source]
) -> list[LookedAt]:
    """Return what is seen of each body in some frames of these motions."""
    probes: list[_Probe] = []
    try:
        for body in bodies:
            probes.append(_Probe(armature, body))
        copies = [copy for probe in probes for copy in probe.copies]
        for source, frames in _looks(armature, motions):
            with playing(leader_of(armature), source), evaluating(armature, *copies) as at:
                for frame in frames:
                    depsgraph = at(frame)
                    turns = _turns(armature.evaluated_get(depsgraph), armature)
                    for probe in probes:
                        probe.look(depsgraph, turns, frame, source.name)
    finally:
        for probe in probes:
            probe.remove()
    return [probe.found for probe in probes]


def _looks(armature: bpy.types.Object, motions: Sequence[Source]) -> Iterator[tuple[Source, list[int]]]:
    """Yield motions with frames of each, spread evenly over all of them."""
    frames = [(source, frame) for source in motions for frame in frames_of(leader_of(armature), source)]
    places = np.unique(np.linspace(0, len(frames) - 1, LOOKS).round().astype(int)) if frames else ()
    for source, looks in groupby((frames[place] for place in places), key=lambda look: look[0]):
        yield source, [frame for _, frame in looks]


def _turns(shown: bpy.types.Object, armature: bpy.types.Object) -> dict[str, np.ndarray]:
    """Return by bone what moves points in the world at rest to where an evaluated armature has them, (4, 4) each."""
    place, back = np.array(shown.matrix_world), np.linalg.inv(np.array(armature.matrix_world))
    return {
        bone.name: place @ np.array(bone.matrix @ bone.bone.matrix_local.inverted()) @ back
        for bone in shown.pose.bones
    }


class _Probe:
    """Copies of a body to be evaluated: its shape alone, and moved; neither with what refines it after its bones."""

    def __init__(self, armature: bpy.types.Object, body: bpy.types.Object) -> None:
        self.found, self.body = LookedAt(), body
        self.carrier = is_carried(body, (armature, leader_of(armature))) and carrier_of(body)
        self.rest = np.array(rest_world(body))
        self.bones = [bone.name for bone in armature.data.bones if bone.use_deform]
        self.reshaped, place = reshapes(body), bones_place(body)
        self.first: np.ndarray | None = None
        self.shape, self.moved = (local_copy(body) for _ in range(2))
        for copy, kept in ((self.shape, ()), (self.moved, ("ARMATURE",))):
            copy.hide_viewport = False  # Blender does not evaluate what is hidden
            for index, modifier in reversed(list(enumerate(copy.modifiers))):
                before = self.reshaped and (place is None or index < place)
                if not before and modifier.type not in kept:
                    copy.modifiers.remove(modifier)
        self.refined = _as_rendered(body) if rendered_refining(body) else None

    @property
    def copies(self) -> tuple[bpy.types.Object, ...]:
        return (self.shape, self.moved, *((self.refined,) if self.refined else ()))

    def remove(self) -> None:
        for copy in self.copies:
            bpy.data.objects.remove(copy)

    def look(self, depsgraph: bpy.types.Depsgraph, turns: dict[str, np.ndarray], frame: int, motion: str) -> None:
        """Compare what is evaluated now with the first look, and with where bones have it."""
        shape, moved = (copy.evaluated_get(depsgraph) for copy in (self.shape, self.moved))
        if moved.hide_viewport:  # by keys
            return
        points = np.empty(len(shape.data.vertices) * 3, dtype=np.float32)
        shape.data.vertices.foreach_get("co", points)
        points = points.reshape(-1, 3)
        if self.first is None:
            self.first = points
            self.still = STILL * np.ptp(points @ self.rest[:3, :3].T, axis=0).max(initial=0)
            weights = read_groups(self.shape, shape.data, self.bones).astype(np.float64)
            self.total = weights.sum(axis=1, keepdims=True)
            self.weights = weights / np.where(self.total > 0, self.total, 1)
            if self.refined:
                self.found.outside = _outside(moved, self.refined.evaluated_get(depsgraph))
                self.refined.hide_viewport = True  # from now on it is not evaluated
        if len(points) != len(self.first):
            self.found.changes = True
            return
        scale = np.linalg.norm(self.rest[:3, :3], 2)
        self.found.changes |= self.reshaped and bool(np.abs(points - self.first).max(initial=0) * scale > self.still)
        placed, shown = points @ self.rest[:3, :3].T + self.rest[:3, 3], world_points(moved)
        if self.carrier:
            turn = turns[self.carrier[1].name]
            wanted = placed @ turn[:3, :3].T + turn[:3, 3]
        else:
            mixed = np.tensordot(self.weights, np.array([turns[name] for name in self.bones]), 1)
            wanted = np.einsum("vij,vj->vi", mixed[:, :3, :3], placed) + mixed[:, :3, 3]
            wanted = np.where(self.total > 0, wanted, shown)  # these are refused elsewhere
        away = float(np.abs(shown - wanted).max(initial=0)) if len(shown) == len(wanted) else np.inf
        if away > max(self.still, self.found.away):
            self.found.away, self.found.frame, self.found.motion = away, frame, motion


def _as_rendered(body: bpy.types.Object) -> bpy.types.Object:
    """Return a copy of a body with what refines it as renders have it, but no finer than its shape can be seen."""
    copy, coarse = local_copy(body), len(body.data.vertices)
    copy.hide_viewport = False
    for modifier in copy.modifiers:
        if modifier.type in REFINING:
            modifier.show_viewport = modifier.show_render
        if modifier.type in ("MULTIRES", "SUBSURF") and modifier.levels != modifier.render_levels:
            levels = min(modifier.render_levels, max(modifier.levels, FINEST))
            modifier.levels = next(each for each in range(levels, -1, -1) if each < 2 or coarse * 4**each < MOST)
    return copy


def _outside(met: bpy.types.Object, refined: bpy.types.Object) -> float:
    """Return how far a refined body lies outside of the surface that cloth meets at most; both are evaluated."""
    points, faces = world_points(met), [tuple(face.vertices) for face in met.data.polygons]
    surface, near = BVHTree.FromPolygons(points.tolist(), faces), NEAR * float(np.ptp(points, axis=0).max(initial=0))
    outward, farthest = np.sign(np.linalg.det(np.array(met.matrix_world)[:3, :3])), 0.0
    shown = world_points(refined)
    for point in shown[:: len(shown) // LOOKED_AT + 1]:
        place, normal, _, _ = surface.find_nearest(point, near)
        if place is not None:
            farthest = max(farthest, float(outward * np.dot(point - place, normal)))
    return farthest
