# SPDX-License-Identifier: Apache-2.0
"""Read the meshes of a stage that cloth meets besides the body.

They are prims with UsdPhysics.CollisionAPI, and prims that are named; either stands for what lies beneath it. Whether
one is visible, or a guide, does not matter where the API says that it collides: collision shapes often are hidden.
`physics:collisionEnabled` says when cloth meets it. A named one is met as it is rendered.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom, UsdPhysics, UsdSkel

from ssilk_core.errors import SsilkError, did_you_mean, fail
from ssilk_core.events import Message, Reporter
from ssilk_core.files import split_location
from ssilk_core.scene.assets import Character, Collider, Floats, Ints

from ..opening.stage import PRIMS, apply, column_matrix, location, named, stage_name, value
from ..opening.times import change_times, xform_attributes
from ..units import StageUnits
from .mesh import is_drawn, is_garment, kept_faces, polygons, rendered
from .polygons import triangulate
from .posed import PlainMesh, Skinned, SkinnedMesh, posed_mesh, skinning_of
from .skeleton import bound_skeleton
from .solids import SIZES, solid

ENABLED = "physics:collisionEnabled"
RIGID = 1e-6  # what the columns of a rotation may differ from unit length and right angles
LISTED = 12  # prims in a message
MOST_POINTS = 100_000_000  # of all colliders that deform, over all frames: 2.4 GB


@dataclass(frozen=True)
class Wearer:
    """Who wears the garment.

    Attributes:
        character: whose body cloth meets anyway.
        placed: its Skeleton in the shot, or None.
        garment: path or name of the garment that is not marked as one.
    """

    character: Character
    placed: Usd.Prim | None
    garment: str | None


class _Prims:
    """The prims of a stage, and which of them are cloth, or the body of who wears it: these are no colliders.

    Args:
        at_home: whether the stage is the character's own, in which its bodies have their paths.
    """

    def __init__(self, stage: Usd.Stage, wearer: Wearer, *, at_home: bool) -> None:
        self.every = list(Usd.PrimRange(stage.GetPseudoRoot(), PRIMS))
        self.solid = [prim for prim in self.every if prim.IsA(UsdGeom.Gprim)]
        self._placed, self._at_home = wearer.placed, at_home
        bodies = (*wearer.character.bodies, *wearer.character.stand_ins)
        self._bodies = {split_location(each.mesh.path)[1] for each in bodies}
        self._leaves = {str(path).rsplit("/", 1)[-1] for path in self._bodies}
        meshes = [prim for prim in self.every if prim.IsA(UsdGeom.Mesh)]
        self._cloth = named(meshes, wearer.garment) if wearer.garment else []

    def is_cloth(self, prim: Usd.Prim) -> bool:
        return is_garment(prim) or prim in self._cloth

    def is_body(self, prim: Usd.Prim) -> bool:
        rig, placed = bound_skeleton(prim), self._placed
        if not self._at_home and placed and rig and _character(rig) != _character(placed):
            return False  # another of a crowd, which may have the path that this one has at home
        by_name = placed is not None and rig == placed and prim.GetName() in self._leaves
        return str(prim.GetPath()) in self._bodies or by_name

    def named(self, name: str) -> list[Usd.Prim]:
        """Return the prims that a path or a name is of; none where it is of none."""
        return [prim for prim in self.every if str(prim.GetPath()) == name] or named(self.solid, name)


@dataclass(frozen=True)
class CollidingPrims:
    """Prims of a stage that collide, and those among them that were asked for by name."""

    stage: Usd.Stage
    prims: tuple[Usd.Prim, ...] = ()
    asked: frozenset[Usd.Prim] = frozenset()


def find_colliding(stages: Sequence[Usd.Stage], names: Sequence[str], wearer: Wearer) -> CollidingPrims:
    """Return the prims that collide, by the API and by name; some of the API may be none that cloth can meet.

    They are those of the first stage that has any, and all that are named.

    Args:
        stages: the shot's where it is another, and the character's own last.
        names: paths or names of prims.

    Raises:
        SsilkError: no stage has all named prims, or one is the garment, the character's body, or nothing that cloth
            can meet.
    """
    searched = {stage: _Prims(stage, wearer, at_home=stage == stages[-1]) for stage in stages}
    having = {stage: prims for stage, prims in searched.items() if all(prims.named(name) for name in names)}
    if not having:
        _fail_unknown(searched, names)
    found = CollidingPrims(stages[-1])
    for stage, prims in having.items():
        found = _colliding(stage, prims, names)
        if found.prims:
            break
    return found


def _colliding(stage: Usd.Stage, prims: _Prims, names: Sequence[str]) -> CollidingPrims:
    found: list[Usd.Prim] = []
    for top in prims.every:
        if not top.HasAPI(UsdPhysics.CollisionAPI):
            continue
        beneath = [prim for prim in Usd.PrimRange(top, PRIMS) if prim.IsA(UsdGeom.Gprim)]
        found += [prim for prim in beneath if not (prims.is_cloth(prim) or prims.is_body(prim))]
    asked: list[Usd.Prim] = []
    for name in names:
        chosen = _shown_beneath(prims.named(name), name)
        for prim in chosen:
            if prims.is_cloth(prim):
                fail(f"--collider {name}", f"{prim.GetPath()} is a garment", "garments meet props, floors and bodies")
            if prims.is_body(prim):
                what = f"{prim.GetPath()} is the character's own body"
                fail(f"--collider {name}", what, "the garment meets that anyway", "leave it out")
            if why := unmet(prim):
                allowed = f"colliders are of the types Mesh, {', '.join(SIZES)}, each at a place of its own"
                fail(f"--collider {name}", f"{prim.GetPath()} is {why}", allowed)
        asked += chosen
    return CollidingPrims(stage, tuple(dict.fromkeys([*found, *asked])), frozenset(asked))


def _shown_beneath(tops: Sequence[Usd.Prim], name: str) -> list[Usd.Prim]:
    """Return what is rendered of prims of a name and beneath them, or all that has a surface where nothing is."""
    beneath = [prim for top in tops for prim in Usd.PrimRange(top, PRIMS) if prim.IsA(UsdGeom.Gprim)]
    if not beneath:
        fail(f"--collider {name}", "nothing with a surface lies there", "name a mesh, or a prim above meshes")
    return beneath if len(beneath) == 1 else rendered([prim for prim in beneath if is_drawn(prim)]) or beneath


def _fail_unknown(searched: Mapping[Usd.Stage, _Prims], names: Sequence[str]) -> NoReturn:
    """Raise `SsilkError` for names that no stage has all of: which were searched, and what there is."""
    files = {stage_name(stage): prims for stage, prims in searched.items()}
    where = {name: [file for file, prims in files.items() if prims.named(name)] for name in names}
    name = next((name for name, own in where.items() if not own), None)
    if name is None:
        one, other = (next(name for name, own in where.items() if own == [file]) for file in files)
        found = f"{where[one][0]} alone has it, and {where[other][0]} alone has '{other}'"
        fail(f"--collider {one}", found, "the colliders of a shot are of one stage", "name those of one of the two")
    could = {
        str(prim.GetPath()): file
        for file, prims in files.items()
        for prim in prims.solid
        if not (prims.is_cloth(prim) or prims.is_body(prim))
    }
    few = [f"{path} in {file}" if len(files) > 1 else path for path, file in list(could.items())[:LISTED]]
    more = f", and {len(could) - LISTED} more meshes and solids" if len(could) > LISTED else ""
    found = "has no such prim" if len(files) == 1 else "have no such prim"
    paths = {path.rsplit("/", 1)[-1]: path for path in could} | {path: path for path in could}
    fail(
        f"--collider {name}",
        f"{' and '.join(files)} {found}",
        f"there are {', '.join(few) or 'none'}{more}",
        did_you_mean(name, paths) or "name one by its path",
    )


def unmet(prim: Usd.Prim) -> str:
    """Return in words what a prim is that cloth cannot meet; empty where it can."""
    if not (prim.IsA(UsdGeom.Mesh) or str(prim.GetTypeName()) in SIZES):
        return f"a {prim.GetTypeName()}"
    above = prim.GetParent()
    while above and not above.IsA(UsdGeom.PointInstancer):
        above = above.GetParent()
    # It stands where the instancer puts copies of it, not where it is itself.
    return f"scattered by the PointInstancer {above.GetPath()}" if above else ""


def met_prims(prims: Sequence[Usd.Prim], codes: Floats, report: Reporter) -> list[tuple[Usd.Prim, NDArray[np.bool_]]]:
    """Return those of some prims that cloth meets at any of some time codes (F,), and when: (F,) or (1,)."""
    found = []
    for prim in prims:
        if why := unmet(prim):
            allowed = "colliders are meshes and solids at a place of their own"
            report(Message(f"{location(prim)}: cloth does not meet it: it is {why}; {allowed}", "warning"))
        elif (present := _present(prim, codes)).any():
            found.append((prim, present))
    return found


def read_colliders(
    met: Sequence[tuple[Usd.Prim, NDArray[np.bool_]]], codes: Floats, lenient: Reporter | None = None
) -> list[Collider]:
    """Return prims of one stage that `met_prims` found as colliders, in the core's world [m], at its time codes (F,).

    Args:
        lenient: is told of colliders that cannot be read, and these are left out.

    Raises:
        SsilkError: the topology of a mesh changes, its data is malformed, or too many points move.
    """
    skinned = skinning_of(met[0][0].GetStage()) if met else {}
    found: list[Collider] = []
    for prim, present in met:
        left = MOST_POINTS - sum(each.points[..., 0].size for each in found if len(each.points) > 1)
        try:
            found.append(_with_area(_read(prim, codes, present, skinned, left)))
        except SsilkError as error:
            if lenient is None:
                raise
            lenient(Message(f"{error} Cloth does not meet it.", "warning"))
    return found


def _read(prim: Usd.Prim, codes: Floats, present: NDArray[np.bool_], skinned: Skinned, left: int) -> Collider:
    """Return a prim as a collider; `left` is how many points may still move, over all frames."""
    to_core, where = StageUnits.of(prim.GetStage()).matrix, location(prim)
    if not prim.IsA(UsdGeom.Mesh):
        points, faces = solid(prim)
    else:
        points, faces = _mesh(prim, codes, where)
        deforms = UsdGeom.Mesh(prim).GetPointsAttr().ValueMightBeTimeVarying()
        if prim in skinned or deforms:
            player = posed_mesh(prim, skinned)
            _need_room(where, points, codes, left)
            moved = [apply(to_core, _points_at(player, code, len(points), where)) for code in codes]
            return Collider(where, faces, np.stack(moved), np.eye(4)[None], present)
    changes = len(codes) > 1 and change_times(xform_attributes(prim))
    places = [_world(prim, code) for code in (codes if changes else codes[:1])]
    world = to_core @ np.stack(places)
    if not np.isfinite(world).all():
        fail(where, "it is placed at infinity or NaN", "colliders are somewhere", "repair the xforms above it")
    moves = _moves(world)
    if moves is None:  # its scale changes
        _need_room(where, points, world, left)
        return Collider(where, faces, np.stack([apply(each, points) for each in world]), np.eye(4)[None], present)
    return Collider(where, faces, apply(world[0], points)[None], moves, present)


def _with_area(collider: Collider) -> Collider:
    corners = collider.points[0][collider.faces]
    if not np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).any():
        fail(collider.path, "no triangle of it has an area", "cloth meets surfaces", "leave it out of the colliders")
    return collider


def _need_room(where: str, points: Floats, frames: Floats, left: int) -> None:
    if len(points) * len(frames) > left:
        what = f"{len(points)} points in {len(frames)} frames"
        allowed = f"at most {MOST_POINTS} of all colliders together change, of which {left} are left"
        fail(where, what, allowed, "name simpler meshes, or fewer frames")


def _moves(world: Floats) -> Floats | None:
    """Return the rigid moves (F, 4, 4) from the first of placements (F, 4, 4) to each; None where one is none."""
    if not abs(np.linalg.det(world[0, :3, :3])) > 0:
        return None
    moves = world @ np.linalg.inv(world[0])
    left, _, right = np.linalg.svd(moves[:, :3, :3])
    turns = left @ right
    if not (np.linalg.det(turns) > 0).all() or np.abs(turns - moves[:, :3, :3]).max() > RIGID:
        return None
    moves[:, :3, :3] = turns
    return moves


def _mesh(prim: Usd.Prim, codes: Floats, where: str) -> tuple[Floats, Ints]:
    """Return the points of a mesh in its own space at its first frame, and its triangles."""
    topology = [prim.GetAttribute(name) for name in ("faceVertexCounts", "faceVertexIndices")]
    if change_times(topology):
        allowed = "the topology of a collider stays, so that cloth can be on one side of it"
        fail(where, "its faces change over time", allowed, "name meshes that keep their faces")
    points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(float(codes[0])) or [], dtype=float).reshape(-1, 3)
    counts, indices = polygons(prim, len(points), where)
    corners, counts, _ = kept_faces(prim, counts)
    if not len(corners):
        fail(where, "the mesh has no faces", "cloth meets surfaces", "leave it out of the colliders")
    if not np.isfinite(points).all():
        fail(where, "points hold NaN or infinity", "all must be finite", "export the mesh again")
    return points, triangulate(points, counts, indices[corners])


def _points_at(player: SkinnedMesh | PlainMesh, code: float, count: int, where: str) -> Floats:
    time = Usd.TimeCode(float(code))
    points = player.points(time, UsdGeom.XformCache(time))
    if len(points) != count:
        found = f"{len(points)} points at time code {code:g}, and {count} before"
        fail(where, found, "the topology of a collider stays", "export the mesh again")
    return points


def _present(prim: Usd.Prim, codes: Floats) -> NDArray[np.bool_]:
    """Return when cloth meets a prim, (F,) or (1,): the nearest API above it says so."""
    at = prim
    while at and not at.HasAPI(UsdPhysics.CollisionAPI):
        at = at.GetParent()
    attribute = at.GetAttribute(ENABLED) if at else None
    if not (attribute and attribute.HasAuthoredValue()):
        return np.ones(1, dtype=bool)
    if not change_times([attribute]):
        return np.array([value(at, ENABLED) is not False])
    return np.array([attribute.Get(float(code)) is not False for code in codes])


def _character(rig: Usd.Prim) -> Usd.Prim:
    """Return the SkelRoot that a Skeleton is of."""
    return UsdSkel.Root.Find(rig).GetPrim()


def _world(prim: Usd.Prim, code: float) -> Floats:
    return column_matrix(UsdGeom.XformCache(Usd.TimeCode(float(code))).GetLocalToWorldTransform(prim))
