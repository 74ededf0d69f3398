# SPDX-License-Identifier: Apache-2.0
"""Bodies of one stage: its meshes in the shape that weights of their blendshapes give them, its joints with them.

The stage becomes that body in its session layer, and its files stay as they are. Shapes that a body sets are
parameters of it: they go into its points, and are no blendshapes of it any more, whatever a shot weighs. Joints
follow the skin about them (`scene.following_joints`), or move as the blendshape says. Meshes without a shape go along
with the joints that move them. A blendshape may say which weights a body may have, and how joints move:

    uniform float2 ssilk:weightRange = (-0.5, 1)          # 0 to 1 where it says nothing; marks a body parameter
    uniform token[] ssilk:offsetJoints = ["Hips/LeftUpLeg"]
    uniform vector3f[] ssilk:jointOffsets = [(0, -4, 0)]  # at a weight of one, in the space of bindTransforms
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from ssilk_core.errors import fail, fail_unknown
from ssilk_core.scene.assets import Floats, Ints
from ssilk_core.scene.following_joints import following_moves, skinned_moves
from ssilk_core.scene.shape_weights import parse_shapes, shapes_text

from ..names import CLASS, GARMENT, JOINT_OFFSETS, OFFSET_JOINTS, PROXIES, SHAPES_SET, WEIGHT_RANGE
from .times import EARLIEST

KEY = "ssilkShapes"  # of the session layer's custom data: the body that a stage is
USUAL_RANGE = (0.0, 1.0)
NORMALS = ("normals", "primvars:normals", "primvars:normals:indices")
_PRIMS = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)


@dataclass(frozen=True)
class BodyParameter:
    """A blendshape by its name: which weights a body may have of it, and whether the stage says so.

    Attributes:
        joints: how joints move at a weight of one, in the space of the bind transforms, where the stage says so.
    """

    low: float
    high: float
    is_marked: bool
    joints: Mapping[str, tuple[float, float, float]]


UNSAID = BodyParameter(*USUAL_RANGE, is_marked=False, joints={})


@dataclass(frozen=True, eq=False)
class _Skin:
    """A mesh and what moves it.

    Attributes:
        to_bind: from its own space to bind space, row vectors, shape (4, 4).
        indices, weights: of the skeleton's joints, shape (V, N).
        offsets: of the shapes that are set, by name, in bind space, shape (V, 3).
    """

    mesh: UsdGeom.Mesh
    points: Floats
    to_bind: Floats
    indices: Ints
    weights: Floats
    offsets: Mapping[str, Floats]


def shaped_as(stage: Usd.Stage) -> str:
    """Return the weights that make the body which a stage was opened as, "tall=1,heavy=0.5"; "" for its own."""
    session = stage.GetSessionLayer()
    return str(session.customLayerData.get(KEY, "")) if session else ""


def weighed_offsets(prim: Usd.Prim, weights: Sequence[float]) -> Floats | None:
    """Return how far the blendshapes of a mesh, with a weight each, move its points in its own space, (V, 3).

    None where they move none, or UsdSkel refuses them.
    """
    shapes = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(prim))
    points = Vt.Vec3fArray(len(UsdGeom.Mesh(prim).GetPointsAttr().Get(EARLIEST) or []))
    given = shapes.ComputeSubShapeWeights(Vt.FloatArray(list(weights)))
    indices, offsets = shapes.ComputeBlendShapePointIndices(), shapes.ComputeSubShapePointOffsets()
    if not given or not shapes.ComputeDeformedPoints(*given, indices, offsets, points):
        return None
    return np.array(points, dtype=np.float64).reshape(-1, 3)


def body_parameters(stage: Usd.Stage) -> dict[str, BodyParameter]:
    """Return the blendshapes of a stage's bodies by name.

    Raises:
        SsilkError: what a blendshape says of its weights or joints is malformed, or two of one name differ in it.
    """
    found: dict[str, BodyParameter] = {}
    for root in _roots(stage):
        for mesh in _body_meshes(root):
            for name, shape in _shapes_of(mesh):
                said, before = _said(shape), found.get(name, UNSAID)
                if UNSAID not in (said, before) and said != before:
                    told = f"another '{name}' has another range or other joint offsets"
                    fail(_where(shape), told, "blendshapes of one name are one body parameter", "mend one")
                found[name] = before if said == UNSAID else said
    return found


def shape_body(stage: Usd.Stage, shapes: str, where: str) -> None:
    """Give the bodies of a stage the shape that weights such as "tall=1,heavy=0.5" say, in its session layer.

    Raises:
        SsilkError: no body has such a shape, or a weight is out of its range; `where` names the body.
    """
    weights, known = parse_shapes(where, shapes), body_parameters(stage)
    for name, weight in weights.items():
        if name not in known:
            if not known:
                fail(where, "its bodies have no blendshapes", "a body is made of some", "name a stage for it")
            fail_unknown(where, f"no body has the blendshape '{name}'", name, known)
        low, high = known[name].low, known[name].high
        if not low <= weight <= high:
            todo = "" if known[name].is_marked else f"its {WEIGHT_RANGE} may say otherwise"
            fail(where, f"shape '{name}' weighs {weight:g}", f"{low:g} to {high:g} is allowed", todo)
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        for root in _roots(stage):
            _expand(root)
        for root in _roots(stage):
            _shape_character(root, weights, known, where)
    stage.GetSessionLayer().customLayerData = {KEY: shapes_text(weights)}


def _shape_character(
    root: Usd.Prim, weights: Mapping[str, float], known: Mapping[str, BodyParameter], where: str
) -> None:
    """Shape the meshes of a SkelRoot and move the joints that they are bound to."""
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(root), _PRIMS)
    shaped = {mesh: _offsets(mesh, weights, where) for mesh in _body_meshes(root)}
    for binding in cache.ComputeSkelBindings(UsdSkel.Root(root), _PRIMS):
        skeleton, joints = binding.GetSkeleton(), cache.GetSkelQuery(binding.GetSkeleton()).GetJointOrder()
        queries = [query for query in binding.GetSkinningTargets() if query.GetPrim() in shaped]
        skins = [found for query in queries if (found := _skin(query, joints, shaped[query.GetPrim()]))]
        binds = np.array(skeleton.GetBindTransformsAttr().Get(EARLIEST) or [], dtype=np.float64)
        if binds.shape != (len(joints), 4, 4) or not any(skin.offsets for skin in skins):
            continue  # readers of the skeleton tell what is malformed
        moves = {}
        for name in sorted({name for skin in skins for name in skin.offsets}):
            _need_joints(known[name], name, joints, where)
            moves[name] = _joint_moves(name, weights[name], known[name], skins, joints, binds)
        _move_joints(skeleton, binds, np.sum([*moves.values()], axis=0))
        for skin in skins:
            shaped.pop(skin.mesh.GetPrim())
            _reshape(skin, moves)
    for mesh, offsets in shaped.items():  # a joint carries them, or none
        if offsets:
            _move_points(UsdGeom.Mesh(mesh), np.sum([*offsets.values()], axis=0), list(offsets))


def _need_joints(parameter: BodyParameter, name: str, joints: Sequence[str], where: str) -> None:
    for joint in parameter.joints:
        if joint not in map(str, joints):
            fail_unknown(where, f"{OFFSET_JOINTS} of '{name}' has '{joint}'", joint, map(str, joints))


def _joint_moves(
    name: str, weight: float, parameter: BodyParameter, skins: Sequence[_Skin], joints: Sequence[str], binds: Floats
) -> Floats:
    """Return how far a shape moves the joints in bind space, (J, 3)."""
    parents = np.array(UsdSkel.Topology(joints).GetParentIndices(), dtype=np.int64)
    own = [skin for skin in skins if name in skin.offsets]
    moves = np.zeros((len(joints), 3))
    if own:
        width = max(skin.indices.shape[1] for skin in own)
        widened = [((0, 0), (0, width - skin.indices.shape[1])) for skin in own]
        moves = following_moves(
            binds[:, 3, :3], parents,
            np.concatenate([skin.points @ skin.to_bind[:3, :3] + skin.to_bind[3, :3] for skin in own]),
            np.concatenate([skin.offsets[name] for skin in own]),
            np.concatenate([np.pad(skin.indices, by) for skin, by in zip(own, widened)]),
            np.concatenate([np.pad(skin.weights, by) for skin, by in zip(own, widened)]),
        )  # fmt: skip
    for row, joint in enumerate(joints):
        if str(joint) in parameter.joints:
            moves[row] = weight * np.array(parameter.joints[str(joint)])
    return moves


def _reshape(skin: _Skin, moves: Mapping[str, Floats]) -> None:
    """Move the points of a mesh by its shapes, and by those of others as its joints move."""
    total = np.zeros_like(skin.points)
    for name, joints in moves.items():
        own = skin.offsets.get(name)
        total += skinned_moves(joints, skin.indices, skin.weights) if own is None else own
    offsets = total @ np.linalg.inv(skin.to_bind[:3, :3])
    _move_points(skin.mesh, np.asarray(offsets, dtype=np.float64), list(skin.offsets))


def _move_points(mesh: UsdGeom.Mesh, offsets: Floats, names: Sequence[str]) -> None:
    """Move points by offsets in the mesh's own space, (V, 3), and take away the blendshapes that this sets."""
    prim, binding = mesh.GetPrim(), UsdSkel.BindingAPI(mesh)
    if offsets.any():
        points = np.array(mesh.GetPointsAttr().Get(EARLIEST), dtype=np.float64) + offsets
        moved = Vt.Vec3fArray.FromNumpy(points.astype(np.float32))
        mesh.GetPointsAttr().Set(moved)
        mesh.GetExtentAttr().Set(UsdGeom.PointBased.ComputeExtent(moved))
        for name in NORMALS:  # those of another shape: readers compute their own
            if prim.GetAttribute(name).HasAuthoredValue():
                prim.GetAttribute(name).Block()
    if not names:
        return
    kept = [(name, target) for name, target in zip(*_listed(prim)) if name not in names]
    binding.GetBlendShapesAttr().Set(Vt.TokenArray([name for name, _ in kept]))
    binding.GetBlendShapeTargetsRel().SetTargets([target for _, target in kept])
    told = prim.CreateAttribute(SHAPES_SET, Sdf.ValueTypeNames.TokenArray, False, Sdf.VariabilityUniform)
    told.Set(Vt.TokenArray([*(told.Get() or ()), *names]))


def _move_joints(skeleton: UsdSkel.Skeleton, binds: Floats, moves: Floats) -> None:
    """Bind joints elsewhere, moved by (J, 3) in bind space; the rest pose goes along. Matrices are of row vectors."""
    moved = np.array(binds)
    moved[:, 3, :3] += moves
    skeleton.GetBindTransformsAttr().Set(_matrices(moved))
    rest = np.array(skeleton.GetRestTransformsAttr().Get(EARLIEST) or [], dtype=np.float64)
    if rest.shape != binds.shape:
        return
    for joint, parent in enumerate(UsdSkel.Topology(skeleton.GetJointsAttr().Get()).GetParentIndices()):
        if parent >= 0:
            before, after = (each[joint] @ np.linalg.inv(each[parent]) for each in (binds, moved))
            rest[joint, 3, :3] += after[3, :3] - before[3, :3]
        else:  # bind space may be the world's, and the rest pose is the skeleton's
            to_bind = np.linalg.inv(rest[joint]) @ binds[joint]
            rest[joint, 3, :3] += moves[joint] @ np.linalg.inv(to_bind[:3, :3])
    skeleton.GetRestTransformsAttr().Set(_matrices(rest))


def _matrices(values: Floats) -> Vt.Matrix4dArray:
    return Vt.Matrix4dArray([Gf.Matrix4d(value.tolist()) for value in values])


def _skin(query: UsdSkel.SkinningQuery, joints: Sequence[str], offsets: Mapping[str, Floats]) -> _Skin | None:
    """Return a mesh with what moves it; None where no joint does, or that is malformed, which readers of it tell."""
    if not query.HasJointInfluences():
        return None
    mesh = UsdGeom.Mesh(query.GetPrim())
    points = np.array(mesh.GetPointsAttr().Get(EARLIEST) or [], dtype=np.float64).reshape(-1, 3)
    given = query.ComputeVaryingJointInfluences(len(points), EARLIEST)
    order = query.GetJointOrder() or joints
    if not (len(points) and given and len(given[0]) == len(given[1]) and len(given[0]) % len(points) == 0):
        return None
    indices, weights = (np.array(each).reshape(len(points), -1) for each in given)
    numbers = {str(joint): number for number, joint in enumerate(joints)}
    place = np.array([numbers.get(str(joint), -1) for joint in order])
    if indices.size == 0 or indices.min() < 0 or indices.max() >= len(place):
        return None
    indices, weights = place[indices], weights.astype(np.float64)
    weights[indices < 0] = 0
    to_bind = np.array(query.GetGeomBindTransform(EARLIEST), dtype=np.float64)
    turned = {name: moves @ to_bind[:3, :3] for name, moves in offsets.items()}
    return _Skin(mesh, points, to_bind, indices.clip(min=0), weights, turned)


def _offsets(mesh: Usd.Prim, weights: Mapping[str, float], where: str) -> dict[str, Floats]:
    """Return how far the shapes that are set move the points of a mesh in its own space, by name, (V, 3)."""
    own, found = [name for name, _ in _shapes_of(mesh)], {}
    for name, weight in weights.items():
        if name not in own:
            continue
        offsets = weighed_offsets(mesh, [weight if each == name else 0.0 for each in own])
        if offsets is None or not np.isfinite(offsets).all():
            fail(where, f"the blendshape '{name}' of {mesh.GetPath()} does not fit its points",
                 "UsdSkel plays shapes with finite offsets of points that are there", "repair it")  # fmt: skip
        found[name] = offsets
    return found


def _shapes_of(mesh: Usd.Prim) -> list[tuple[str, Usd.Prim]]:
    """Return the blendshapes of a mesh by their names in animations, in its order."""
    stage = mesh.GetStage()
    return [(name, stage.GetPrimAtPath(target)) for name, target in zip(*_listed(mesh))]


def _listed(mesh: Usd.Prim) -> tuple[list[str], list[Sdf.Path]]:
    binding = UsdSkel.BindingAPI(mesh)
    names = [str(name) for name in binding.GetBlendShapesAttr().Get() or ()]
    return names, binding.GetBlendShapeTargetsRel().GetForwardedTargets()


def _said(shape: Usd.Prim) -> BodyParameter:
    """Return what a blendshape says of its weights and of joints."""
    given, joints, offsets = (
        attribute.Get() if shape and (attribute := shape.GetAttribute(name)) else None
        for name in (WEIGHT_RANGE, OFFSET_JOINTS, JOINT_OFFSETS)
    )
    bounds = USUAL_RANGE if given is None else given
    if np.shape(bounds) != (2,):
        allowed = "a float2 is needed, the least weight and the most"
        fail(_where(shape), f"{WEIGHT_RANGE} is {bounds}", allowed, "mend it")
    # As they were written: 0.35, and not the 0.349999994 that a float2 stores.
    low, high = (float(str(np.float32(bound))) for bound in bounds)
    if not (np.isfinite([low, high]).all() and low <= 0 <= high and low < high):
        allowed = "a range holds 0, the body without the shape"
        fail(_where(shape), f"{WEIGHT_RANGE} is ({low:g}, {high:g})", allowed, "mend it")
    named, moved = [str(name) for name in joints or ()], np.array(offsets or [], dtype=np.float64).reshape(-1, 3)
    if len(named) != len(moved) or not np.isfinite(moved).all():
        found = f"{len(moved)} {JOINT_OFFSETS}, or not finite ones, for {len(named)} {OFFSET_JOINTS}"
        fail(_where(shape), found, "one for each joint is needed", "mend them")
    said = {name: (float(x), float(y), float(z)) for name, (x, y, z) in zip(named, moved)}
    return BodyParameter(low, high, given is not None, said)


def _where(prim: Usd.Prim) -> str:
    return f"{prim.GetStage().GetRootLayer().identifier}:{prim.GetPath()}"


def _roots(stage: Usd.Stage) -> Iterator[Usd.Prim]:
    """Yield the outermost SkelRoots."""
    prims = iter(Usd.PrimRange.Stage(stage, _PRIMS))
    for prim in prims:
        if prim.IsA(UsdSkel.Root):
            prims.PruneChildren()
            yield prim


def _body_meshes(root: Usd.Prim) -> list[Usd.Prim]:
    """Return the meshes beneath a SkelRoot that are no garments: these are put on a body in other ways."""
    meshes = [prim for prim in Usd.PrimRange(root, _PRIMS) if prim.IsA(UsdGeom.Mesh)]
    marks = (CLASS, PROXIES)
    return [
        mesh for mesh in meshes
        if not any(mesh.GetAttribute(mark).HasAuthoredValue() for mark in marks)
        and not (mesh.GetAttribute(GARMENT) and mesh.GetAttribute(GARMENT).Get() is True)
    ]  # fmt: skip


def _expand(root: Usd.Prim) -> None:
    """Make what is above and beneath a SkelRoot no instances: their prims cannot be changed."""
    for prefix in root.GetPath().GetPrefixes():
        if (prim := root.GetStage().GetPrimAtPath(prefix)) and prim.IsInstance():
            prim.SetInstanceable(False)
    top = root.GetStage().GetPrimAtPath(root.GetPath())
    while instances := [prim for prim in Usd.PrimRange(top) if prim.IsInstance()]:
        for prim in instances:
            prim.SetInstanceable(False)
