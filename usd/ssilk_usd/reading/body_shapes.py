# SPDX-License-Identifier: Apache-2.0
"""How a shot shapes a character's meshes by blendshapes, in each frame: breathing, correctives, another body type.

Meshes are read with the blendshapes that are on in the character's stage (`shapes`). Here is what a shot adds to
that, or takes away, as UsdSkel shows it there. In-betweens are shapes of their own, whatever weighs more than one is
a larger shape, and what weighs less than none a turned one: weights from 0 to 1 add up to the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pxr import Usd, UsdSkel

from ssilk_core.errors import fail
from ssilk_core.files import split_location
from ssilk_core.scene.assets import BodyShape, Character, Floats, Ints, Mesh, Motion
from ssilk_core.scene.assets.body_shape import OFF

from ..names import SHAPES_SET
from ..opening.stage import StageLike, explains_damage, location, open_stage, value
from ..opening.times import samples_about
from .carried import carried_by
from .character import geom_to_core, is_skinned
from .mesh import is_drawn
from .motion import find_animation
from .posed import Skinned, skinning_of
from .same_meshes import same_meshes, skinned_meshes
from .shapes import shape_weights
from .skeleton import bound_skeleton, find_skeleton
from .skin import match_joints
from .spaces import SkelSource

UNSEEN = 1e-6  # [m] by which a shape may move a point and still count as none
SAME = 1e-3  # of a mesh's size, by which its points may differ; also of the axes of a joint


@explains_damage
def with_body_shapes(
    source: StageLike,
    at: str,
    motion: Motion,
    character: Character,
    *,
    root: str | None = None,
    garment: str | None = None,
) -> Motion:
    """Return a motion with the blendshapes of its character's meshes that it weighs otherwise than their stage does.

    A shape that a shot's animation does not name is off in that shot. So it is where a motion shows no such mesh and
    names others of its shapes. Where it names none, the mesh is left as it is.

    Args:
        source: the character's stage.
        at: where the motion was read, "file[:/Prim/Path]".
        motion: gives the frames.
        character: as it was read from its stage.
        root: the character, if there are several.
        garment: its mesh, whose skeleton is not the character's.

    Raises:
        SsilkError: weights that are not finite; also as `read_motion` and `find_skeleton`.
    """
    file, prim = split_location(at)
    of_motion = open_stage(file)
    animation, placed = find_animation(of_motion, prim or split_location(motion.path)[1], root)
    named = UsdSkel.Animation(animation).GetBlendShapesAttr().Get()
    if not character.bodies or (placed is None and not named):
        return motion
    stage = open_stage(source)
    skel = find_skeleton(stage, root=root, garment=garment)
    codes = (motion.start + np.arange(motion.frame_count)) / motion.fps * of_motion.GetTimeCodesPerSecond()
    shot = _Shot.of(of_motion, animation, placed, skel, codes)
    found: list[tuple[BodyShape, Floats]] = []
    for number, body in enumerate((*character.bodies, *character.stand_ins)):
        own = stage.GetPrimAtPath("/" + body.mesh.path.rpartition(":/")[2])
        if own:
            found += _shapes(own, body.mesh, number, skel, shot)
    if not found:
        return motion
    shapes, courses = zip(*found)
    return replace(motion, shapes=shapes, shape_weights=np.stack(courses, axis=1))


@dataclass(frozen=True, eq=False)
class _Shot:
    """A motion's stage.

    Attributes:
        skel: its skeleton; None where the motion stands alone.
        meshes: by the path of a mesh of the character, the mesh that shows it here.
        is_bound_alike: whether the joints have the axes of the character's in the bind pose.
        codes: time codes of the frames, shape (F,).
        skinned: what skins the meshes.
    """

    stage: Usd.Stage
    animation: Usd.Prim
    skel: SkelSource | None
    meshes: dict[str, Usd.Prim]
    is_bound_alike: bool
    codes: Floats
    skinned: Skinned

    @classmethod
    def of(
        cls, stage: Usd.Stage, animation: Usd.Prim, placed: Usd.Prim | None, skel: SkelSource, codes: Floats
    ) -> _Shot:
        there = None if placed is None else _skeleton(stage, placed)
        if there is None:
            return cls(stage, animation, None, {}, True, codes, {})
        drawn = [mesh for mesh in skinned_meshes(skel) if is_drawn(mesh)]
        pairs = same_meshes(there, skel, drawn, None)
        meshes = {str(own.GetPath()): mesh for mesh, own in pairs.items()}
        return cls(stage, animation, there, meshes, _bound_alike(there, skel), codes, skinning_of(stage))

    def weights(self, mesh: Usd.Prim) -> Floats:
        """Return the weights of a mesh's own blendshapes in each frame, as UsdSkel has them, shape (F, K)."""
        count = len(UsdSkel.BindingAPI(mesh).GetBlendShapesAttr().Get() or ())
        _, skeleton, skinning = self.skinned.get(mesh, (None, None, None))
        query = skeleton and skeleton.GetAnimQuery()
        mapper = skinning and skinning.HasBlendShapes() and skinning.GetBlendShapeMapper()
        if not (query and mapper and not mapper.IsNull()):
            return np.zeros((len(self.codes), count))
        rows = [_remapped(mapper, query.ComputeBlendShapeWeights(code), count) for code in self._times(query)]
        return self._finite(np.array(rows), mesh)

    def named_weights(self, names: list[str], unnamed: Floats) -> Floats:
        """Return the weights of blendshapes by name in each frame, as `unnamed` (K,) where none is named, (F, K)."""
        animation = UsdSkel.Animation(self.animation)
        every = [str(name) for name in animation.GetBlendShapesAttr().Get() or ()]
        rows = np.tile(unnamed, (len(self.codes), 1))
        own = [index for index, name in enumerate(names) if name in every]
        if own:
            rows[:] = 0  # UsdSkel gives those of a mesh no weight that an animation does not name
            columns = [every.index(names[index]) for index in own]
            for row, code in zip(rows, self.codes.tolist()):
                given = animation.GetBlendShapeWeightsAttr().Get(code)
                if given is not None and len(given) == len(every):  # UsdSkel takes no others
                    row[own] = np.array(given)[columns]
        return self._finite(rows, self.animation)

    def _times(self, query: UsdSkel.AnimQuery) -> list[Usd.TimeCode]:
        codes = [Usd.TimeCode(code) for code in self.codes.tolist()]
        return codes if query.BlendShapeWeightsMightBeTimeVarying() else codes[:1]

    def _finite(self, rows: Floats, prim: Usd.Prim) -> Floats:
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if len(bad):
            code, attribute = float(self.codes[bad[0]]), UsdSkel.Animation(self.animation).GetBlendShapeWeightsAttr()
            keys = (key for key in samples_about(attribute, code) if not np.isfinite(attribute.Get(key)).all())
            found = f"blendShapeWeights hold NaN or infinity, first at time code {next(keys, code):g}"
            fail(location(prim), found, "all must be finite", "repair the animation")
        return rows if len(rows) == len(self.codes) else np.repeat(rows, len(self.codes), axis=0)


@dataclass(frozen=True, eq=False)
class _SubShape:
    """A blendshape or one of its in-betweens: rows (R,) and their offsets where it weighs one [m], shape (R, 3)."""

    name: str
    rows: Ints
    offsets: Floats
    blendshape: str = ""  # that it is of, in an animation

    @property
    def reach(self) -> float:
        return float(np.linalg.norm(self.offsets, axis=1).max(initial=0))

    def is_same(self, other: _SubShape) -> bool:
        """Return whether another one moves the same points as far."""
        return bool(
            self.name == other.name
            and np.array_equal(self.rows, other.rows)
            and np.abs(self.offsets - other.offsets).max(initial=0) <= UNSEEN
        )


class _SubShapes:
    """The blendshapes of a mesh with their in-betweens, of which UsdSkel makes a linear sum."""

    def __init__(self, mesh: Usd.Prim, linear: Floats) -> None:
        self.mesh, self.names = mesh, [str(n) for n in UsdSkel.BindingAPI(mesh).GetBlendShapesAttr().Get() or ()]
        self.query = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(mesh)) if self.names else None
        self.parts: list[_SubShape] = []
        count = len(value(mesh, "points") or [])
        rows = self.query.ComputeBlendShapePointIndices() if self.query else []
        offsets = self.query.ComputeSubShapePointOffsets() if self.query else []
        for at, moved in enumerate(offsets):
            assert self.query
            index, between = self.query.GetBlendShapeIndex(at), self.query.GetInbetween(at)
            name = self.names[index] + (f"_{_last(between)}" if between else "")
            own = np.array(rows[index], dtype=np.int32) if rows[index] else np.arange(count, dtype=np.int32)
            vectors = np.array(moved, dtype=np.float64).reshape(-1, 3)
            vectors = vectors if len(vectors) == len(own) else np.zeros((len(own), 3))  # UsdSkel refuses it
            moved_rows, place = np.unique(own, return_inverse=True)
            summed = np.zeros((len(moved_rows), 3))
            np.add.at(summed, place.reshape(-1), vectors)
            kept = summed.any(axis=1) & (moved_rows >= 0) & (moved_rows < count)
            self.parts.append(_SubShape(name, moved_rows[kept], summed[kept] @ linear.T, self.names[index]))

    def weights(self, rows: Floats) -> Floats:
        """Return the weights of `parts` (F, S) where blendshapes have weights (F, K)."""
        found, known = np.zeros((len(rows), len(self.parts))), dict[bytes, Floats]()
        for place, row in zip(found, np.ascontiguousarray(rows, dtype=np.float32)):
            if self.query and row.any():
                key = row.tobytes()
                if key not in known:
                    known[key] = self._sub_weights(row)
                place[:] = known[key]
        return found

    def _sub_weights(self, row: Floats) -> Floats:
        assert self.query
        found = np.zeros(len(self.parts))
        given = self.query.ComputeSubShapeWeights(row.tolist())
        if given:
            weights, _, parts = given
            np.add.at(found, np.array(parts, dtype=np.int64), np.array(weights, dtype=np.float64))
        return found


def _shapes(own: Usd.Prim, mesh: Mesh, number: int, skel: SkelSource, shot: _Shot) -> list[tuple[BodyShape, Floats]]:
    """Return the shapes by which a shot changes a mesh of the character, with their weights (F,)."""
    home = _SubShapes(own, _to_core(own, skel)[:3, :3])
    given = shape_weights(own, skel)
    weights = np.zeros(len(home.names)) if given is None else np.array(given)
    on = home.weights(weights[None])[0]
    shown = shot.meshes.get(str(own.GetPath()))
    if shown is not None and not (shot.skel and bound_skeleton(shown) == shot.skel.prim):
        return []  # it follows something else, or nothing, which is told elsewhere
    if shown is not None and len(value(shown, "points") or []) != mesh.vertex_count:
        return []
    if shown is None or shot.skel is None:
        there, courses = home, home.weights(shot.named_weights(home.names, weights))
    else:
        of = (shown, shot.skel) if is_skinned(shown, shot.skel) else (own, skel)  # a joint carries it
        there = _SubShapes(shown, _to_core(*of)[:3, :3])
        courses = there.weights(shot.weights(shown))
        if _has_shape_in_points(shown, shot.skel, mesh, home, on):
            on = np.zeros_like(on)
        if not shot.is_bound_alike:  # then its offsets are vectors of another pose
            kept = [at for at, part in enumerate(there.parts) if part.name in {each.name for each in home.parts}]
            by_name = {part.name: part for part in home.parts}
            there.parts, courses = [by_name[there.parts[at].name] for at in kept], courses[:, kept]
    found: list[tuple[BodyShape, Floats]] = []
    left, taken = list(range(len(home.parts))), set(map(str, value(own, SHAPES_SET) or ()))
    for part, course in zip(there.parts, courses.T):
        if part.blendshape in taken:  # a parameter of the body, which has it whatever the shot weighs
            continue
        same = next((at for at in left if home.parts[at].is_same(part)), None)
        if same is not None:
            left.remove(same)
            course = course - on[same]
        found += _parts(part, number, course)
    for at in left:
        found += _parts(home.parts[at], number, np.full(len(shot.codes), -on[at]))
    return found


def _parts(part: _SubShape, number: int, course: Floats) -> list[tuple[BodyShape, Floats]]:
    """Return what a shape with any weights (F,) adds and takes away, each with weights from 0 to 1."""
    found = []
    for sign, word in ((1.0, ""), (-1.0, OFF)):
        own = np.maximum(sign * course, 0)
        most = float(own.max(initial=0))
        if most * part.reach > UNSEEN:
            shape = BodyShape(part.name + word, number, part.rows, sign * most * part.offsets)
            found.append((shape, own / most))
    return found


def _has_shape_in_points(shown: Usd.Prim, there: SkelSource, mesh: Mesh, home: _SubShapes, on: Floats) -> bool:
    """Return whether the points of a shot's mesh have the shape already that the character's stage gives them, as
    shots that were baked here do."""
    moved = np.zeros((mesh.vertex_count, 3))
    for part, weight in zip(home.parts, on):
        moved[part.rows] += weight * part.offsets
    matrix = _to_core(shown, there)
    points = np.array(value(shown, "points"), dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    unseen = SAME * float(np.ptp(mesh.points, axis=0).max(initial=0))
    away = (np.linalg.norm(points - each, axis=1).max(initial=0) for each in (mesh.points, mesh.points - moved))
    shaped, plain = away
    return bool(shaped <= unseen and shaped < plain)


def _to_core(mesh: Usd.Prim, skel: SkelSource) -> Floats:
    """Return the transform from a mesh's local space to the core's bind space [m], shape (4, 4)."""
    carried = None if is_skinned(mesh, skel) else carried_by(mesh, skel)
    return skel.bind_to_core @ carried.to_bind if carried else geom_to_core(mesh, skel)


def _remapped(mapper: UsdSkel.AnimMapper, found: object, count: int) -> Floats:
    """Return the weights of a mesh's own blendshapes, shape (K,); none is on where UsdSkel cannot tell."""
    own = None if found is None else mapper.Remap(found)
    return np.zeros(count) if own is None or len(own) != count else np.array(own, dtype=np.float64)


def _skeleton(stage: Usd.Stage, placed: Usd.Prim) -> SkelSource | None:
    """Return the skeleton of a shot; None where nothing can be bound to it, without bind pose."""
    from ssilk_core.errors import SsilkError

    try:
        return find_skeleton(stage, root=str(placed.GetPath()))
    except SsilkError:
        return None


def _bound_alike(there: SkelSource, skel: SkelSource) -> bool:
    match = np.array(match_joints(skel.joints, there.joints))
    own, other = (each.binds_to_core(each.bind)[:, :3, :3] for each in (skel, there))
    kept = match >= 0
    return bool(np.abs(own[kept] - other[match[kept]]).max(initial=0) <= SAME)


def _last(between: UsdSkel.InbetweenShape) -> str:
    return str(between.GetAttr().GetName()).rpartition(":")[2]
