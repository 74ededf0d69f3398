# SPDX-License-Identifier: GPL-3.0-or-later
"""The shot that `ssilk bake` wrote: bones and shapes of a garment, frame by frame."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from ..errors import need
from .arrays import Joints, Shot, dense, to_parents
from .names import joint_paths
from .write import CLASS, matrices


def read_shot(path: Path, joints: Joints) -> Shot:
    """Read a baked garment.

    Args:
        path: what was baked from a stage of `write_stage`.
        joints: of the armature now, proxies included.

    Raises:
        SetupError: the shot has other joints than the armature.
    """
    stage = Usd.Stage.Open(str(path))
    mesh = next(prim for prim in stage.Traverse() if prim.HasAttribute(CLASS))
    skeleton, skinning = _queries(mesh)
    order = [str(name) for name in skeleton.GetJointOrder()]
    own = joint_paths(joints.names, joints.parents)
    left_out = [name for name in own[joints.character_count :] if name not in order]
    _need_same_joints(order, [name for name in own if name not in left_out])
    times = np.arange(stage.GetStartTimeCode(), stage.GetEndTimeCode() + 1)
    binds = dict(zip(order, np.array(skeleton.GetJointWorldBindTransforms()).swapaxes(-1, -2)))
    shapes = tuple(str(name) for name in UsdSkel.BindingAPI(mesh).GetBlendShapesAttr().Get() or ())
    points = np.array(UsdGeom.Mesh(mesh).GetPointsAttr().Get())
    return Shot(
        start=int(times[0]),
        binds=_with_left_out(binds, own, joints),
        rotations=_rotations(skeleton.GetAnimQuery(), times, own, joints)[:, joints.character_count :],
        points=points,
        weights=_weights(skinning, order, own),
        shapes=shapes,
        offsets=_offsets(mesh, len(shapes), len(points)),
        activations=_activations(skeleton.GetAnimQuery(), shapes, times),
        left_out=len(left_out),
    )


def _queries(mesh: Usd.Prim) -> tuple[UsdSkel.SkeletonQuery, UsdSkel.SkinningQuery]:
    cache, root = UsdSkel.Cache(), UsdSkel.Root.Find(mesh)
    cache.Populate(root, Usd.PrimDefaultPredicate)
    skeleton = UsdSkel.BindingAPI(mesh).GetInheritedSkeleton()
    return cache.GetSkelQuery(skeleton), cache.GetSkinningQuery(mesh)


def _need_same_joints(order: list[str], own: list[str]) -> None:
    odd = [name for name in (*order, *own) if (name in order) != (name in own)]
    need(
        not odd,
        f"The bones are not those that it was trained with ('{odd[0].rpartition('/')[2] if odd else ''}' was added, "
        "removed, renamed or has another parent); undo that, or train again.",
    )


def _with_left_out(binds: Mapping[str, np.ndarray], own: list[str], joints: Joints) -> np.ndarray:
    """Return the bind transforms of all joints; those that were left out stand to their parents as they do now."""
    found: list[np.ndarray] = []
    for name, parent, local in zip(own, joints.parents, to_parents(joints.binds, joints.parents)):
        found.append(binds[name] if name in binds else found[parent] @ local)
    return np.array(found)


def _rotations(animation: UsdSkel.AnimQuery, times: np.ndarray, own: list[str], joints: Joints) -> np.ndarray:
    """Return the rotations of all joints to their parents, shape (F, J, 4), as (w, x, y, z); at rest if left out."""
    rest = UsdSkel.DecomposeTransforms(matrices(to_parents(joints.binds, joints.parents)))[1]
    turns = np.tile(np.array(rest, dtype=np.float64), (len(times), 1, 1))  # pxr gives (x, y, z, w)
    animated = [str(name) for name in animation.GetJointOrder()]
    columns = [animated.index(name) for name in own if name in animated]
    there = [name in animated for name in own]
    turns[:, there] = [np.array(animation.ComputeJointLocalTransformComponents(time)[1])[columns] for time in times]
    return np.roll(turns, 1, axis=-1)


def _weights(skinning: UsdSkel.SkinningQuery, order: list[str], own: list[str]) -> np.ndarray:
    """Return dense weights over all joints."""
    to_own = np.array([own.index(str(name)) for name in skinning.GetJointOrder() or order])
    width = skinning.GetNumInfluencesPerComponent()
    indices, weights = (np.array(values).reshape(-1, width) for values in skinning.ComputeJointInfluences())
    return dense(to_own[indices], weights, len(own))


def _offsets(mesh: Usd.Prim, shape_count: int, point_count: int) -> np.ndarray:
    offsets = np.zeros((shape_count, point_count, 3))
    for row, path in zip(offsets, UsdSkel.BindingAPI(mesh).GetBlendShapeTargetsRel().GetTargets()):
        shape = UsdSkel.BlendShape(mesh.GetStage().GetPrimAtPath(path))
        moved = shape.GetPointIndicesAttr().Get()
        row[np.array(moved) if moved else slice(None)] = np.array(shape.GetOffsetsAttr().Get())
    return offsets


def _activations(animation: UsdSkel.AnimQuery, shapes: tuple[str, ...], times: np.ndarray) -> np.ndarray:
    if not shapes:
        return np.zeros((len(times), 0))
    animated = [str(name) for name in animation.GetBlendShapeOrder()]
    columns = [animated.index(name) for name in shapes]
    return np.array([animation.ComputeBlendShapeWeights(time) for time in times])[:, columns]
