# SPDX-License-Identifier: GPL-3.0-or-later
"""The meshes that cloth meets besides its character, over the frames of a timeline.

They are those with Blender's own *Collision* physics, and those of the collection that the garment's settings name,
as they are evaluated in each frame. The garment, other garments, what hangs on these and the bodies of its character
are none.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import bpy
import numpy as np

from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import Collider

from ..errors import SetupError
from ..scene.garment import is_garment, is_own_body, no_mesh
from ..scene.meshes import triangles_of
from ..scene.modifiers import moves_by_itself
from ..scene.objects import found_again, is_disabled, scene_units
from .evaluating import evaluating
from .keys import changing_paths
from .own_shapes import own_shapes
from .sampling import SLICE

KIND, USE = "COLLISION", "collision.use"
NAMED = 3  # colliders, in a line
RIGID = 2e-6  # what axes may differ from turned ones; matrices in Blender are of single precision
SAME = 1e-5  # of the distance from the world's origin, and of 1 m, by which points differ that were moved
MOST_POINTS = 40_000_000  # of what changes its shape, over all frames: 1 GB


def colliders_of(garment: bpy.types.Object, armature: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the meshes that a garment of a character meets, by name; those that keys switch off for a while, too."""
    chosen = garment.ssilk.colliders
    found = [thing for thing in _layer().objects if _may_collide(thing) and not is_own_body(thing, garment, armature)]
    named = chosen.all_objects if chosen else ()
    found += [thing for thing in named if not is_own_body(thing, garment, armature, bound=False)]
    meshes = {thing for thing in found if thing.type == "MESH" and not _is_on_cloth(thing, garment)}
    return sorted((thing for thing in meshes if _may_be_enabled(thing)), key=lambda thing: thing.name)


def unmet(garment: bpy.types.Object) -> list[str]:
    """Return in words what in the collection of a garment's colliders is no mesh, and so is not met."""
    chosen = garment.ssilk.colliders
    return [said for thing in (chosen.all_objects if chosen else ()) if (said := no_mesh(thing))]


def unseen(garment: bpy.types.Object, armature: bpy.types.Object, who: str) -> str:
    """Return in words that something, as "The network", plays a garment without its colliders; empty without any."""
    names = [f"'{thing.name}'" for thing in colliders_of(garment, armature)]
    if not names:
        return ""
    listed = ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")
    return f"{who} does not see {len(names)} collider{'s' * (len(names) > 1)}, {listed}; a bake as Hero meets them"


def signature(garment: bpy.types.Object, armature: bpy.types.Object) -> tuple[object, ...]:
    """Return which objects a garment meets; where these are and what shape they have is compared as it is shown."""
    return tuple((thing.name, thing.session_uid) for thing in colliders_of(garment, armature))


def _layer() -> bpy.types.ViewLayer:
    return bpy.context.view_layer


def _may_collide(thing: bpy.types.Object) -> bool:
    """Return whether an object has Collision physics that is on, or that keys or drivers may switch on."""
    if thing.collision is None:  # it never had any
        return False
    modifier = next((each for each in thing.modifiers if each.type == KIND), None)
    if modifier is None:
        return False
    moved = changing_paths(thing.animation_data)
    shown = modifier.show_viewport or _shown_path(modifier) in moved
    return shown and (thing.collision.use or USE in moved)


def _is_on_cloth(thing: bpy.types.Object, garment: bpy.types.Object) -> bool:
    """Return whether an object is a garment, or hangs on one as riders do."""
    above: bpy.types.Object | None = thing
    while above is not None and above != garment and not is_garment(above):
        above = above.parent
    return above is not None


def _may_be_enabled(thing: bpy.types.Object) -> bool:
    return not is_disabled(thing) or "hide_viewport" in changing_paths(thing.animation_data)


def _shown_path(modifier: bpy.types.Modifier) -> str:
    return f'modifiers["{bpy.utils.escape_identifier(modifier.name)}"].show_viewport'


def _collides(thing: bpy.types.Object) -> bool:
    """Return whether an evaluated object has Collision physics that is on."""
    own = [each for each in thing.modifiers if each.type == KIND]
    return bool(thing.collision and thing.collision.use and own and own[0].show_viewport)


def _is_there(thing: bpy.types.Object, *, named: bool) -> bool:
    """Return whether cloth meets an evaluated object."""
    return not thing.hide_viewport and (named or _collides(thing))


@dataclass(eq=False)
class _Sampled:
    """A collider that is being sampled.

    Attributes:
        named: whether the collection of the garment has it, whatever its physics.
        faces: triangles in its first frame, shape (T, 3); corners: vertices of its polygons then, to be compared.
        points: in its own space, in Blender's units, (P, 3) each; the same array where nothing has changed.
        places: object to world, (4, 4) each.
        present: whether it is met, in each frame so far.
    """

    uid: int
    name: str
    named: bool
    faces: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.int32))
    corners: np.ndarray | None = None
    points: list[np.ndarray] = field(default_factory=list)
    places: list[np.ndarray] = field(default_factory=list)
    present: list[bool] = field(default_factory=list)

    def object(self) -> bpy.types.Object:
        """Return it, which may be in no scene; raise `SetupError` if it was deleted."""
        for thing in bpy.data.objects:
            if thing.session_uid == self.uid and thing.users_collection:
                return thing
        raise SetupError(f"'{self.name}' was deleted while it was read; play or bake again.")

    def take(self, depsgraph: bpy.types.Depsgraph, frame: int) -> int:
        """Take a frame as it is evaluated; return how many points were kept for it."""
        thing = self.object().evaluated_get(depsgraph)
        there = _is_there(thing, named=self.named)
        self.present.append(there)
        if not there:  # nor evaluated
            if self.points:
                self.points.append(self.points[-1])
                self.places.append(self.places[-1])
            return 0
        points, corners = own_points(thing), _corners(thing.data)
        if self.corners is None:
            self.corners, self.faces = corners, triangles_of(thing.data)
            if not len(self.faces):
                raise SetupError(f"'{self.name}' has no faces that cloth could meet; take it from the colliders.")
            missed = len(self.present) - 1
            self.points, self.places = [points] * missed, [np.array(thing.matrix_world)] * missed
        elif not np.array_equal(corners, self.corners):
            raise SetupError(
                f"Modifiers give '{self.name}' other faces at frame {frame} than before; cloth meets what keeps its "
                "faces: switch its Collision off, or the modifier."
            )
        same = bool(self.points) and np.array_equal(points, self.points[-1])
        self.points.append(self.points[-1] if same else points)
        self.places.append(np.array(thing.matrix_world))
        return 0 if same else len(points)

    def collider(self) -> Collider | None:
        """Return what was sampled, in the core's world [m]; None where it was never met."""
        if not any(self.present):
            return None
        places, present = np.array(self.places), np.array(self.present)
        faces = self.faces[:, ::-1] if np.linalg.det(places[0, :3, :3]) < 0 else self.faces
        still, moves = all(points is self.points[0] for points in self.points), _moves(places)
        if not still or moves is None:
            moved = [_placed(points, place) for points, place in zip(self.points, places)]
            return Collider(self.name, faces, np.array(moved), np.eye(4)[None], _least(present))
        units = scene_units()
        own = self.points[0] @ places[0, :3, :3].T * units.meters_per_unit
        return Collider(self.name, faces, own[None], _least(units.transforms_to_core(moves)), _least(present))


def own_points(thing: bpy.types.Object) -> np.ndarray:
    """Return the vertices of an evaluated object in its own space, shape (P, 3)."""
    points = np.empty(len(thing.data.vertices) * 3, dtype=np.float32)
    thing.data.vertices.foreach_get("co", points)
    return points.reshape(-1, 3)


def _corners(mesh: bpy.types.Mesh) -> np.ndarray:
    """Return what a mesh's triangles follow from: vertices of all polygons, where each begins, how many there are."""
    corners, starts = np.empty(len(mesh.loops), np.int32), np.empty(len(mesh.polygons), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    mesh.polygons.foreach_get("loop_start", starts)
    return np.concatenate([corners, -1 - starts, [len(mesh.vertices)]])


def _moves(places: np.ndarray) -> np.ndarray | None:
    """Return what turns the mesh of the first frame about its origin and moves it, (F, 4, 4); None if not rigid.

    Args:
        places: object to world, shape (F, 4, 4).
    """
    axes = places[:, :3, :3]
    if not abs(np.linalg.det(axes[0])) > 0:
        return None
    turns = axes @ np.linalg.inv(axes[0])
    left, _, right = np.linalg.svd(turns)
    rigid = left @ right
    if not (np.linalg.det(rigid) > 0).all() or np.abs(rigid - turns).max() > RIGID:
        return None
    moves = places.copy()
    moves[:, :3, :3] = rigid
    return moves


def _placed(points: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return points of an object in the core's world [m], shape (P, 3)."""
    return scene_units().points_to_core(points @ place[:3, :3].T + place[:3, 3])


def _least(values: np.ndarray) -> np.ndarray:
    """Return values (F, ...) of frames, once where they do not change."""
    return values[:1] if (values == values[:1]).all() else values


class MetColliders:
    """The colliders of a garment over frames of the timeline, to be sampled.

    Attributes:
        found: what cloth meets, once it was sampled.
        own: names of those with Collision physics that lie inside the character in all frames, as shapes of a ragdoll
            do: cloth does not meet them, unless the garment's collection has them.
    """

    def __init__(self, garment: bpy.types.Object, armature: bpy.types.Object, frames: range) -> None:
        """Choose them.

        Raises:
            SetupError: one is simulated, and not as a cache.
        """
        chosen = garment.ssilk.colliders
        named = set(chosen.all_objects) if chosen else set()
        things = colliders_of(garment, armature)
        for thing in things:
            _need_plain(thing)
        self.signature, self._frames = signature(garment, armature), frames
        self._waiting = [_Sampled(thing.session_uid, thing.name, thing in named) for thing in things]
        self.found: tuple[Collider, ...] = ()
        self.own: tuple[str, ...] = ()
        self._objects = [(thing.session_uid, thing.name) for thing in (garment, armature)]
        self._met: dict[int, tuple[_Sampled, Collider | None]] = {}
        self._told: dict[int, bytes] = {}  # shapes that differed from what was read, and were read again

    @property
    def count(self) -> int:
        return len(self._waiting)

    def sample(self) -> Iterator[float]:
        """Evaluate all frames, yielding the part that is done after each slice of time.

        Raises:
            SetupError: one was deleted meanwhile, its faces change, or too many points move.
        """
        done, kept, waiting = 0, 0, self._waiting
        while waiting and done < len(self._frames):
            until = time.monotonic() + SLICE
            with evaluating(*(each.object() for each in waiting)) as at:
                while done < len(self._frames):
                    depsgraph = at(self._frames[done])
                    kept += sum(each.take(depsgraph, self._frames[done]) for each in waiting)
                    done += 1
                    if kept > MOST_POINTS:
                        raise SetupError(
                            f"Colliders have {kept} points that change over {done} frames; choose simpler meshes, or "
                            "fewer frames."
                        )
                    if time.monotonic() > until:
                        break
            yield done / len(self._frames)
        self._met = {each.uid: (each, each.collider()) for each in waiting}
        yield from self._leave_out_own()

    def _leave_out_own(self) -> Iterator[float]:
        """Leave out the shapes that stand for the character's own body, which the artist did not choose."""
        found = {uid: collider for uid, (_, collider) in self._met.items() if collider}
        asked = [uid for uid in found if not self._met[uid][0].named]
        shapes = own_shapes(*(found_again(*each) for each in self._objects), self._frames) if asked else None
        own = []
        for uid in asked:
            try:
                own += [uid] if shapes and shapes.has(found[uid]) else []
            except SsilkError:  # a body whose faces change: nothing is known of it
                break
            yield 1.0
        self.own = tuple(found[uid].name for uid in own)
        self.found = tuple(collider for uid, collider in found.items() if uid not in own)

    def differ(self, things: Sequence[bpy.types.Object], depsgraph: bpy.types.Depsgraph, frame: int) -> bool:
        """Return whether one of some objects is evaluated otherwise in a frame than it was read there.

        What differs is told once: a place that keys take back, for one, differs again when it was read again.
        """
        if frame not in self._frames:
            return False
        known, index = [thing for thing in things if thing.session_uid in self._met], self._frames.index(frame)
        return bool([thing for thing in known if self._differs(thing, depsgraph, index)])

    def _differs(self, thing: bpy.types.Object, depsgraph: bpy.types.Depsgraph, index: int) -> bool:
        sampled, now = self._met[thing.session_uid][0], thing.evaluated_get(depsgraph)
        there, was = _is_there(now, named=sampled.named), sampled.present[index]
        points, place = own_points(now) if there else np.zeros((0, 3)), np.array(now.matrix_world)
        if there == was and (not there or _are_same(points, place, sampled.points[index], sampled.places[index])):
            self._told.pop(thing.session_uid, None)
            return False
        shape = points.tobytes() + place.tobytes() + bytes([there])
        told = self._told.get(thing.session_uid) == shape
        self._told[thing.session_uid] = shape
        return not told

    def remember(self, before: MetColliders) -> None:
        """Know what was told before these were read."""
        self._told = before._told

    def things(self) -> list[bpy.types.Object]:
        """Return those that are still there."""
        return [thing for thing in bpy.data.objects if thing.session_uid in self._met]


def left_out(met: MetColliders | None) -> str:
    """Return in words which shapes of the character's own body were left out; empty where none was."""
    own = met.own if met else ()
    names = ", ".join(f"'{name}'" for name in own[:NAMED]) + (f" and {len(own) - NAMED} more" * (len(own) > NAMED))
    return f"; cloth does not meet {names}, inside the body in each frame" if own else ""


def _are_same(points: np.ndarray, place: np.ndarray, other: np.ndarray, there: np.ndarray) -> bool:
    if points.shape != other.shape:
        return False
    near = np.allclose(place, there, rtol=SAME, atol=SAME)
    return near and (points is other or np.allclose(points, other, rtol=SAME, atol=SAME))


def _need_plain(thing: bpy.types.Object) -> None:
    """Raise `SetupError` if an object is simulated as its frames are played, so that none can be read by itself."""
    for modifier in thing.modifiers:
        cache = getattr(modifier, "point_cache", None)
        simulated = moves_by_itself(modifier) and modifier.type not in ("MESH_CACHE", "MESH_SEQUENCE_CACHE", "OCEAN")
        if modifier.show_viewport and simulated and not (cache is not None and cache.is_baked):
            todo = "put a mesh cache, as from Alembic, in its place" if cache is None else "bake it"
            raise SetupError(
                f"The modifier '{modifier.name}' simulates '{thing.name}', which cloth is to meet, as frames are "
                f"played; {todo}, or take it from the colliders."
            )
