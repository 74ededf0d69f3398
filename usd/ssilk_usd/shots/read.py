# SPDX-License-Identifier: Apache-2.0
"""Read the meshes of a shot at rest, and a baked garment as joints and blendshapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from ssilk_core.errors import fail
from ssilk_core.scene.assets import Floats, GarmentPose, Mesh, ProxyRig, Skeleton
from ssilk_core.scene.kinematics import local_transforms

from ..names import RIDER_JOINTS
from ..opening.garment_api import GarmentRecord, read_garment_record
from ..opening.stage import StageLike, apply, location, needs_whole_files, open_stage, value
from ..reading.garment import find_garment, fitted_skeleton, garment_place, read_garment
from ..reading.mesh import read_mesh
from ..reading.motion import find_animation, read_samples
from ..reading.rig import read_proxy_rig
from ..reading.skeleton import character_skeleton
from ..reading.skin import match_joints
from .play import Shot, frame_times
from .skinned import BakedGarment, SkinnedGarment

AT_REST = 1e-6  # [m] from the bind pose, of places within a metre, that count as rounded


@dataclass(frozen=True, eq=False)
class ShotPart:
    """A mesh of a shot at rest [m] and the provenance of its model (None if absent, as for bodies)."""

    mesh: Mesh
    record: GarmentRecord | None


def read_parts(shot: Shot) -> list[ShotPart]:
    """Return the meshes of a shot at rest, in order: default points, or else those of the earliest time."""
    return [_part(shot, shot.stage.GetPrimAtPath(mesh.path)) for mesh in shot.meshes]


def _part(shot: Shot, prim: Usd.Prim) -> ShotPart:
    mesh = read_mesh(prim, shot.units.matrix)
    timeless = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(Usd.TimeCode.Default()) or [], dtype=np.float64)
    if len(timeless) == mesh.vertex_count:
        mesh = replace(mesh, points=apply(shot.units.matrix, timeless))
    return ShotPart(mesh, read_garment_record(prim))


@needs_whole_files
def read_baked(source: StageLike) -> BakedGarment:
    """Read the garment of a shot that `write_shot` wrote.

    Raises:
        SsilkError: there is no garment or several, it is not bound to joints, or the data is malformed.
    """
    stage = open_stage(source)
    prim = find_garment(stage)
    skel = fitted_skeleton(prim)
    if skel is None:
        fail(location(prim), "its stage has no skeleton", "a baked garment needs joints", "choose a shot with joints")
    skeleton = character_skeleton(skel)
    garment, rig = read_garment(stage, skeleton, shaped=False), read_proxy_rig(stage, skeleton)
    rig = rig and _without_riders(rig, value(prim, RIDER_JOINTS) or ())
    joints, binds, skin = skeleton.joint_names, skeleton.bind_transforms, garment.skin
    if rig is not None:
        joints, binds, skin = (*joints, *rig.joint_names), np.concatenate([binds, rig.bind_transforms]), rig.skin
    if skin is None:
        fail(location(prim), "no joint moves it", "a baked garment needs weights", "bake to joints, not to points")
    linear = garment_place(prim, skel, skeleton).to_core[:3, :3]
    names, shapes = _read_blendshapes(prim, linear, garment.mesh.vertex_count)
    times = frame_times(stage)
    proxies = joints[skeleton.joint_count :]
    pose = _read_pose(find_animation(stage, None, None)[0], proxies, names, times, skel.joint_scale)
    pose = replace(pose, translations=None) if rig is None else _without_rest(pose, skeleton, rig)
    return BakedGarment(SkinnedGarment(joints, binds, garment.mesh.points, skin, names, shapes), pose, times[0])


def _without_riders(rig: ProxyRig, riders: Sequence[str]) -> ProxyRig:
    """Return a rig without the joints that carry riders, which move nothing of the garment and stand last."""
    kept = [index for index, name in enumerate(rig.joint_names) if name not in riders]
    names = tuple(rig.joint_names[index] for index in kept)
    return replace(rig, joint_names=names, parents=rig.parents[kept], bind_transforms=rig.bind_transforms[kept])


def _read_blendshapes(prim: Usd.Prim, to_core: Floats, point_count: int) -> tuple[tuple[str, ...], Floats]:
    """Return names and offsets [m] of a mesh's blendshapes, shape (K, V, 3)."""
    binding = UsdSkel.BindingAPI(prim)
    names = tuple(str(name) for name in binding.GetBlendShapesAttr().Get() or ())
    offsets = np.zeros((len(names), point_count, 3))
    for row, path in zip(offsets, binding.GetBlendShapeTargetsRel().GetTargets()):
        shape = UsdSkel.BlendShape(prim.GetStage().GetPrimAtPath(path))
        moved = shape.GetPointIndicesAttr().Get()
        row[np.array(moved) if moved else slice(None)] = np.array(shape.GetOffsetsAttr().Get()) @ to_core.T
    return names, offsets


def _read_pose(
    prim: Usd.Prim, proxies: tuple[str, ...], shapes: tuple[str, ...], times: tuple[float, ...], scale: float
) -> GarmentPose:
    """Return rotations and translations of the proxies and weights of the blendshapes at time codes.

    Args:
        scale: of the animation's unit of length [m].
    """
    animation, where = UsdSkel.Animation(prim), location(prim)
    joints = tuple(str(name) for name in animation.GetJointsAttr().Get() or ())
    found = match_joints(proxies, joints)
    lost = [name for name, index in zip(proxies, found) if index < 0]
    names = [str(name) for name in animation.GetBlendShapesAttr().Get() or ()]
    lost += [name for name in shapes if name not in names]
    if lost:
        fail(where, f"it does not animate '{lost[0]}'", "proxies and blendshapes are animated", "bake the shot again")
    rotations, translations = read_samples(prim, np.array(times), len(joints), where)
    weights = animation.GetBlendShapeWeightsAttr()
    columns = [names.index(name) for name in shapes]
    rows = [np.array(weights.Get(time))[columns] for time in times] if shapes else np.zeros((len(times), 0))
    return GarmentPose(0, rotations[:, found], np.array(rows), scale * translations[:, found])


def _without_rest(pose: GarmentPose, skeleton: Skeleton, rig: ProxyRig) -> GarmentPose:
    """Return a pose without translations where the proxies have those of the bind pose, as those of networks do."""
    binds, parents = (
        np.concatenate([getattr(of, name) for of in (skeleton, rig)]) for name in ("bind_transforms", "parents")
    )
    places = local_transforms(binds, parents)[skeleton.joint_count :, :3, 3]
    assert pose.translations is not None
    moves = np.abs(pose.translations - places).max(initial=0) > AT_REST * max(np.abs(places).max(initial=0), 1.0)
    return pose if moves else replace(pose, translations=None)
