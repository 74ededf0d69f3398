# SPDX-License-Identifier: Apache-2.0
"""Read the meshes of a stage that cloth meets besides the body.

They are prims with UsdPhysics.CollisionAPI, and prims that are named; either stands for what lies beneath it. Whether
one is visible, or a guide, does not matter where the API says that it collides: collision shapes often are hidden.
`physics:collisionEnabled` says when cloth meets it. A named one is met as it is rendered.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom, UsdPhysics, UsdSkel

from ssilk_core.errors import fail
from ssilk_core.events import Message, Reporter
from ssilk_core.files import split_location
from ssilk_core.scene.assets import Character, Collider, Floats, Ints

from ..opening.stage import PRIMS, apply, column_matrix, listed, location, named, stage_name, value
from ..opening.times import change_times, xform_attributes
from ..units import StageUnits
from .mesh import is_drawn, is_garment, kept_faces, polygons, rendered
from .polygons import triangulate
from .posed import PlainMesh, Skinned, SkinnedMesh, posed_mesh, skinning_of
from .skeleton import bound_skeleton
from .solids import SIZES, solid

ENABLED = "physics:collisionEnabled"
RIGID = 1e-6  # what the columns of a rotation may differ from unit length and right angles
MOST_POINTS = 100_000_000  # of all colliders that deform, over all frames: 2.4 GB


def colliding_prims(
    stage: Usd.Stage,
    names: Sequence[str],
    own: Character,
    placed: Usd.Prim | None,
    garment: str | None,
    *,
    at_home: bool,
) -> list[Usd.Prim]:
    """Return the prims of a stage that collide, by the API and by name; some of the API may be none cloth can meet.

    Args:
        names: paths or names of prims; each must be in the stage.
        own: the character, whose body cloth meets anyway.
        placed: its Skeleton in the shot, or None.
        garment: path or name of the garment that is not marked as one.
        at_home: whether the stage is the character's own, in which its bodies have their paths.

    Raises:
        SsilkError: a named prim is the garment, the character's body, or cloth cannot meet it.
    """
    every = list(Usd.PrimRange(stage.GetPseudoRoot(), PRIMS))
    bodies = {split_location(each.mesh.path)[1] for each in (*own.bodies, *own.stand_ins)}
    leaves = {str(path).rsplit("/", 1)[-1] for path in bodies}

    def is_body(prim: Usd.Prim) -> bool:
        rig = bound_skeleton(prim)
        if not at_home and placed and rig and _character(rig) != _character(placed):
            return False  # another of a crowd, which may have the path that this one has at home
        return str(prim.GetPath()) in bodies or (placed is not None and rig == placed and prim.GetName() in leaves)

    cloth = named([prim for prim in every if prim.IsA(UsdGeom.Mesh)], garment) if garment else []
    found = []
    for top in every:
        if not top.HasAPI(UsdPhysics.CollisionAPI):
            continue
        beneath = [prim for prim in Usd.PrimRange(top, PRIMS) if prim.IsA(UsdGeom.Gprim)]
        found += [prim for prim in beneath if not (_is_cloth(prim, cloth) or is_body(prim))]
    for name in names:
        chosen = _named_prims(stage, every, name)
        for prim in chosen:
            if _is_cloth(prim, cloth):
                fail(f"--collider {name}", f"{prim.GetPath()} is a garment", "garments meet props, floors and bodies")
            if is_body(prim):
                what = f"{prim.GetPath()} is the character's own body"
                fail(f"--collider {name}", what, "the garment meets that anyway", "leave it out")
            if why := unmet(prim):
                allowed = f"colliders are of the types Mesh, {', '.join(SIZES)}, each at a place of its own"
                fail(f"--collider {name}", f"{prim.GetPath()} is {why}", allowed)
        found += chosen
    return list(dict.fromkeys(found))


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


def read_colliders(met: Sequence[tuple[Usd.Prim, NDArray[np.bool_]]], codes: Floats) -> list[Collider]:
    """Return prims of one stage that `met_prims` found as colliders, in the core's world [m], at its time codes (F,).

    Raises:
        SsilkError: the topology of a mesh changes, its data is malformed, or too many points move.
    """
    skinned = skinning_of(met[0][0].GetStage()) if met else {}
    found: list[Collider] = []
    for prim, present in met:
        left = MOST_POINTS - sum(each.points[..., 0].size for each in found if len(each.points) > 1)
        found.append(_read(prim, codes, present, skinned, left))
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


def _named_prims(stage: Usd.Stage, every: list[Usd.Prim], name: str) -> list[Usd.Prim]:
    gprims = [prim for prim in every if prim.IsA(UsdGeom.Gprim)]
    tops = [prim for prim in every if str(prim.GetPath()) == name] or named(gprims, name)
    if not tops:
        allowed = f"there are {listed(gprims)}" if len(gprims) < 20 else f"there are {len(gprims)} meshes and solids"
        fail(f"--collider {name}", f"{stage_name(stage)} has no such prim", allowed, "name one by its path")
    beneath = [prim for top in tops for prim in Usd.PrimRange(top, PRIMS) if prim.IsA(UsdGeom.Gprim)]
    if not beneath:
        fail(f"--collider {name}", "nothing with a surface lies there", "name a mesh, or a prim above meshes")
    return beneath if len(beneath) == 1 else rendered([prim for prim in beneath if is_drawn(prim)]) or beneath


def _character(rig: Usd.Prim) -> Usd.Prim:
    """Return the SkelRoot that a Skeleton is of."""
    return UsdSkel.Root.Find(rig).GetPrim()


def _is_cloth(prim: Usd.Prim, named_cloth: list[Usd.Prim]) -> bool:
    return is_garment(prim) or prim in named_cloth


def _world(prim: Usd.Prim, code: float) -> Floats:
    return column_matrix(UsdGeom.XformCache(Usd.TimeCode(float(code))).GetLocalToWorldTransform(prim))
