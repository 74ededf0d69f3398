# SPDX-License-Identifier: Apache-2.0
"""Find and check a character's skeleton in a stage, and separate its own joints from proxies."""

from __future__ import annotations

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdSkel

from ssilk_core.errors import SsilkError, fail
from ssilk_core.scene.assets import Floats, Ints, Skeleton, carrying_joint, moved_by_joints

from ..names import PROXIES, SKEL
from ..opening.stage import (
    PRIMS,
    apply,
    column_matrix,
    has_value,
    inherited,
    inherited_target,
    location,
    named,
    stage_name,
    value,
    world_matrix,
)
from ..units import StageUnits
from .carried import carried_by
from .joint_scales import divided, total_scales, uniform_scales, without_scales
from .mesh import is_body, is_drawn, placement, rendered
from .skin import match_joints, need_unique, read_influences
from .spaces import SkelSource, joints_to_core, need_similarity

_CHOOSE = "choose one with --root, or as MODEL:/ROOT in a bake"


def find_skeleton(stage: Usd.Stage, *, root: str | None = None, garment: str | None = None) -> SkelSource:
    """Find the only skeleton of a stage, or the one named by `root` (path or name of its SkelRoot or Skeleton).

    Of several, the character's is the one that other meshes than garments are bound to: `garment` names one, by path
    or name, that is not marked.

    Raises:
        SsilkError: there is no skeleton or no unique one, or the skeleton is malformed.
    """
    where, found = stage_name(stage), skeletons(stage)
    if not found:
        lone, todo = _beneath_none(stage)
        fail(
            where,
            f"there is no SkelRoot with a Skeleton{lone}",
            "a character is a SkelRoot with a Skeleton and meshes bound to it",
            todo,
        )
    chosen = found if root is None else _pairs_named(found, root)
    chosen = of_bodies(stage, chosen, garment) if len(chosen) > 1 else chosen
    there_are = "there are " + ", ".join(f"{top.GetPath()} ({skeleton.GetName()})" for top, skeleton in found)
    if not chosen:
        fail(where, f"no SkelRoot or Skeleton is named '{root}'", there_are, _CHOOSE)
    if len(chosen) != 1:
        fail(
            where,
            f"{len(chosen)} skeletons could be the character's",
            there_are,
            f"{_CHOOSE}, by the path of its Skeleton if need be",
        )
    return skeleton_at(*chosen[0])


def _beneath_none(stage: Usd.Stage) -> tuple[str, str]:
    """Return in words why a Skeleton is no character's, where there is one, and what to do."""
    lone = next((prim for prim in Usd.PrimRange.Stage(stage, PRIMS) if prim.IsA(UsdSkel.Skeleton)), None)
    if lone is None:
        return "", "export the character with its armature"
    above = lone.GetParent()
    while not above.IsPseudoRoot():
        if above.GetPrimTypeInfo().GetTypeName() and any(
            spec.typeName == "SkelRoot" for spec in above.GetPrimStack()
        ):
            text = f"; {above.GetPath()} refers to one and is declared as '{above.GetTypeName()}' over it"
            return text, f'declare it without a type, as in: def "{above.GetName()}"'
        above = above.GetParent()
    return f"; {lone.GetPath()} lies beneath none", "make a prim above it and its meshes a SkelRoot"


def _pairs_named(pairs: list[tuple[Usd.Prim, Usd.Prim]], name: str) -> list[tuple[Usd.Prim, Usd.Prim]]:
    """Return the pairs whose SkelRoot has this path or name, or if there are none, whose Skeleton has it."""
    roots, skeletons_named = (named([pair[side] for pair in pairs], name) for side in (0, 1))
    return [pair for pair in pairs if pair[0] in roots] or [pair for pair in pairs if pair[1] in skeletons_named]


def of_bodies(
    stage: Usd.Stage, pairs: list[tuple[Usd.Prim, Usd.Prim]], garment: str | None = None
) -> list[tuple[Usd.Prim, Usd.Prim]]:
    """Return the pairs whose Skeleton moves a mesh that is no garment; all pairs where none does."""
    meshes = [prim for prim in Usd.PrimRange.Stage(stage, PRIMS) if prim.IsA(UsdGeom.Mesh)]
    garments = named(meshes, garment) if garment else []
    bodies = [mesh for mesh in meshes if is_body(mesh) and mesh not in garments]
    moved = {bound_skeleton(mesh) for mesh in bodies if inherited(mesh, SKEL[0]) is not None}
    return [pair for pair in pairs if pair[1] in moved] or pairs


def skeletons(stage: Usd.Stage) -> list[tuple[Usd.Prim, Usd.Prim]]:
    """Return each outermost SkelRoot with the skeletons that its meshes are bound to, or else that it contains."""
    pairs = []
    prims = iter(Usd.PrimRange.Stage(stage, PRIMS))
    for prim in prims:
        if prim.IsA(UsdSkel.Root):
            prims.PruneChildren()
            within = list(Usd.PrimRange(prim, PRIMS))
            bound = [bound_skeleton(mesh) for mesh in within if mesh.IsA(UsdGeom.Mesh)]
            held = [other for other in within if other.IsA(UsdSkel.Skeleton)]
            pairs += [(prim, skeleton) for skeleton in dict.fromkeys(filter(None, bound)) or held]
    return pairs


def bound_skeleton(prim: Usd.Prim) -> Usd.Prim | None:
    """Return the Skeleton that a prim or its nearest bound ancestor is bound to, or None."""
    target = inherited_target(prim, "skel:skeleton")
    return target if target and target.IsA(UsdSkel.Skeleton) else None


def character_skeleton(source: SkelSource) -> Skeleton:
    """Return the character's own joints, without proxies, as the core's skeleton.

    Rest transforms of root joints include the character's placement, as those of a motion do.
    """
    kept = source.character_joints
    position = np.full(len(source.joints) + 1, -1)
    position[kept] = np.arange(len(kept))
    parents = position[source.parents[kept]]
    rest = joints_to_core(source.rest[kept], parents, source.placement, source.units)
    names = tuple(source.joints[index] for index in kept)
    binds, world = source.binds_to_core(source.bind[kept]), source.skeleton_to_world
    hub = carrying_joint([moved[kept] for moved in _moved(source)], parents, binds[:, :3, 3])
    scales = None if (source.scales == 1).all() else source.scales[kept]
    return Skeleton(location(source.prim), names, parents, binds, rest, hub, world, scales=scales)


def _moved(source: SkelSource) -> list[Floats]:
    """Return how much of each body each joint of a skeleton moves, shapes (N,); of garments where no body is."""
    meshes = [prim for prim in Usd.PrimRange(source.root, PRIMS) if prim.IsA(UsdGeom.Mesh) and is_drawn(prim)]
    bodies = rendered([prim for prim in meshes if is_body(prim)])
    skinned = [_skinned(prim, source) for prim in bodies]
    if not any(each is not None for each in skinned):
        skinned = [_carried(prim, source) for prim in bodies]
    if not any(each is not None for each in skinned):
        skinned = [_skinned(prim, source) for prim in meshes]
    return [each for each in skinned if each is not None]


def _skinned(prim: Usd.Prim, source: SkelSource) -> Floats | None:
    """Return how much of a mesh each joint moves, shape (N,); None where it is not bound to this skeleton."""
    if bound_skeleton(prim) != source.prim:
        return None
    try:
        influences = read_influences(prim, source.joints)
    except SsilkError:  # told where the mesh is read as a body; others may be as they like
        return None
    if influences is None:
        return None
    at = np.array([*match_joints(influences.joints, source.joints), -1])[influences.indices]
    weights = np.zeros((len(at), len(source.joints) + 1))
    np.add.at(weights, (np.arange(len(at))[:, None], at), np.abs(influences.weights))
    return _of_mesh(prim, weights[:, :-1])


def _carried(prim: Usd.Prim, source: SkelSource) -> Floats | None:
    """Return how much of a mesh each joint moves, which one carries; None where none does."""
    carried = carried_by(prim, source)
    if carried is None:
        return None
    weights = np.zeros((len(value(prim, "points") or []), len(source.joints)))
    weights[:, carried.joint] = 1
    return _of_mesh(prim, weights)


def _of_mesh(prim: Usd.Prim, weights: Floats) -> Floats | None:
    points = np.array(value(prim, "points") or [], dtype=np.float64).reshape(-1, 3)
    return moved_by_joints(apply(placement(prim), points), weights) if len(points) else None


def skeleton_at(root: Usd.Prim, prim: Usd.Prim) -> SkelSource:
    """Read the Skeleton `prim` of a SkelRoot; raise `SsilkError` where it is malformed."""
    where, joints = location(prim), tuple(str(name) for name in value(prim, "joints") or ())
    if not joints:
        fail(where, "the skeleton has no joints", "at least one is needed", "export the armature again")
    parents = _parents(joints, where)
    bind = _matrices(prim, "bindTransforms", len(joints))
    if bind is None:
        fail(where, "the skeleton has no bindTransforms", "one for each joint is needed", "export the armature again")
    rest = _matrices(prim, "restTransforms", len(joints))
    totals = np.ones(len(joints))
    if rest is not None:
        totals = total_scales(uniform_scales(rest), parents)
        if not np.isfinite(totals).all() or (totals == 1).all():
            totals = np.ones(len(joints))  # what is no scale alone is told where it is no rotation either
        else:
            bind, rest = divided(bind, totals), without_scales(rest, totals, parents)
    placed = need_similarity(prim, world_matrix(prim))
    return SkelSource(
        stage=prim.GetStage(),
        root=root,
        prim=prim,
        units=StageUnits.of(prim.GetStage()),
        joints=joints,
        parents=parents,
        bind=bind,
        rest=_rest_from_bind(bind, parents) if rest is None else rest,
        placement=placed,
        owners=_owners(root, joints, parents),
        scales=totals,
    )


def _parents(joints: tuple[str, ...], where: str) -> Ints:
    """Return parent indices by UsdSkel's rule: the parent is the nearest ancestor path that is a joint."""
    need_unique(joints, where)
    broken = next((name for name in joints if not Sdf.Path.IsValidPathString(name)), None)
    if broken is not None:
        allowed = "joints are paths of letters, digits and _, like 'Hips/Spine'"
        fail(where, f"joint '{broken}' is not a path", allowed, "rename it")
    topology = UsdSkel.Topology(joints)
    valid, reason = topology.Validate()
    if not valid:
        fail(
            where,
            f"the joints are out of order ({reason.partition('.')[0]})",
            "parents must precede their children, and a joint must not be its own ancestor",
            "reorder the joints",
        )
    return np.array(topology.GetParentIndices(), dtype=np.int64)


def _matrices(prim: Usd.Prim, name: str, count: int) -> Floats | None:
    """Return a skeleton's matrices for column vectors, checked against its joints; None if not authored."""
    matrices = value(prim, name)
    if matrices is None or not len(matrices):
        return None
    if len(matrices) != count:
        fail(
            location(prim),
            f"{len(matrices)} {name} for {count} joints",
            "one for each joint is needed",
            "export the armature again",
        )
    result = column_matrix(matrices)
    if not np.isfinite(result).all():
        fail(location(prim), f"{name} hold NaN or infinity", "all must be finite", "repair it")
    singular = int(np.count_nonzero(np.abs(np.linalg.det(result)) < 1e-30))
    if singular:
        fail(location(prim), f"{singular} {name} cannot be inverted", "joints must not have zero scale")
    return result


def _rest_from_bind(bind: Floats, parents: Ints) -> Floats:
    children = np.flatnonzero(parents >= 0)
    rest = np.array(bind)
    rest[children] = np.linalg.inv(bind[parents[children]]) @ bind[children]
    return rest


def _owners(root: Usd.Prim, joints: tuple[str, ...], parents: Ints) -> tuple[str, ...]:
    """Return the garment that each joint is a proxy of: a listed joint or a descendant of one; empty for others."""
    listed_by: dict[int, str] = {}
    for prim in Usd.PrimRange(root, PRIMS):
        names = tuple(value(prim, PROXIES) or ()) if has_value(prim, PROXIES) else ()
        listed_by.update({index: str(prim.GetPath()) for index in match_joints(names, joints) if index >= 0})
    owners: list[str] = []
    for index, parent in enumerate(parents):
        owners.append(listed_by.get(index, owners[parent] if parent >= 0 else ""))
    return tuple(owners)
