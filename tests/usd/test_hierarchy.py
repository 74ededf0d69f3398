# SPDX-License-Identifier: Apache-2.0
"""The same movement, shared otherwise between joints and transforms, is the same motion for any skeleton."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel
from scipy.spatial.transform import Rotation
from ssilk_usd.reading.character import read_character
from ssilk_usd.reading.motion import read_motion

from ssilk_core.scene.kinematics import motion_transforms

FRAMES = 8
BONES = {"Hips": (0, 1, 0), "Spine": (0, 0.2, 0), "Head": (0, 0.4, 0), "Arm": (0.3, 0.3, 0)}
ABOVE = {"Spine": "Hips", "Head": "Spine", "Arm": "Spine"}
Place = Callable[[int | None], Gf.Matrix4d]  # in a frame, or at rest


def at(degrees: tuple[float, ...], place: tuple[float, ...]) -> Gf.Matrix4d:
    x, y, z, w = Rotation.from_euler("xyz", degrees, degrees=True).as_quat().tolist()
    return Gf.Matrix4d().SetRotate(Gf.Quatd(w, x, y, z)) * Gf.Matrix4d().SetTranslate(Gf.Vec3d(*place))


def body(frame: int | None) -> dict[str, Gf.Matrix4d]:
    """Each joint in the world [m]: the body walks, turns and bends."""
    found: dict[str, Gf.Matrix4d] = {}
    for number, (name, offset) in enumerate(BONES.items()):
        bend = (5.0, 0, 0) if frame is None else (8 * np.sin(frame + number), 6 * np.cos(frame), 5 * np.sin(frame))
        local = at(bend, offset)
        if name == "Hips" and frame is not None:
            local = at((0, 9 * frame, 3), (0.11 * frame, 1 + 0.02 * np.sin(frame), 0.3 * frame))
        found[name] = local * found[ABOVE[name]] if name in ABOVE else local
    return found


def still(frame: int | None) -> Gf.Matrix4d:
    return Gf.Matrix4d(1)


def travels(frame: int | None) -> Gf.Matrix4d:
    return at((0, 9 * (frame or 0), 0), (0.11 * (frame or 0), 0, 0.3 * (frame or 0)))


def lies(frame: int | None) -> Gf.Matrix4d:
    return at((-90, 0, 0), (0, 0, 0))


def twist(frame: int | None) -> Gf.Matrix4d:
    return at((0, 20, 0), (0, 0.1, 0)) * body(frame)["Hips"]


def turns(frame: int | None) -> Gf.Matrix4d:
    return at((0, 7 * (frame or 0), 0), (0.2, 0, 0.3 * (frame or 0)))


def beneath(root: str) -> tuple[str, ...]:
    return (root, *(f"{root}/{path}" for path in PLAIN))


PLAIN = ("Hips", "Hips/Spine", "Hips/Spine/Head", "Hips/Spine/Arm")
TWISTED = ("Hips", "Hips/Twist", "Hips/Twist/Spine", "Hips/Twist/Spine/Head", "Hips/Twist/Spine/Arm")
SHARED: dict[str, tuple[tuple[str, ...], dict[str, Place], Place, float]] = {
    "plain": (PLAIN, {}, still, 1),
    "beneath a still root": (beneath("root"), {"root": still}, still, 1),
    "beneath a root that travels": (beneath("root"), {"root": travels}, still, 1),
    "beneath a root that lies": (beneath("root"), {"root": lies}, still, 1),
    "with a twist joint": (TWISTED, {"Twist": twist}, still, 1),
    "flat": (("Hips", "Spine", "Head", "Arm"), {}, still, 1),
    "several roots": (("Arm", "Hips", "Head", "Hips/Spine"), {}, still, 1),
    "on an xform": (PLAIN, {}, travels, 1),
    "on an xform that turns": (PLAIN, {}, turns, 1),
    "on a root and an xform, in centimetres": (beneath("root"), {"root": travels}, turns, 0.01),
}


def write(path: Path, joints: tuple[str, ...], extra: dict[str, Place], above: Place, unit: float) -> str:
    """Write a character that moves as `body` does, with its motion."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    UsdGeom.SetStageUpAxis(stage, "Y")
    stage.SetTimeCodesPerSecond(30)
    root, rig = UsdSkel.Root.Define(stage, "/Hero"), UsdSkel.Skeleton.Define(stage, "/Hero/Rig")
    leaves, parents = [joint.rpartition("/")[2] for joint in joints], UsdSkel.Topology(joints).GetParentIndices()

    def placed(frame: int | None) -> list[Gf.Matrix4d]:
        found = []
        for leaf in leaves:
            world = extra[leaf](frame) if leaf in extra else body(frame)[leaf]
            matrix = world * above(frame).GetInverse()
            found.append(matrix.SetTranslateOnly(matrix.ExtractTranslation() / unit))
        return found

    def local(frame: int | None) -> list[Gf.Matrix4d]:
        world = placed(frame)
        return [
            world[each] * world[over].GetInverse() if over >= 0 else world[each] for each, over in enumerate(parents)
        ]

    rig.CreateJointsAttr(joints)
    rig.CreateBindTransformsAttr(placed(None))
    rig.CreateRestTransformsAttr(local(None))
    animation = UsdSkel.Animation.Define(stage, "/Hero/Animation")
    animation.CreateJointsAttr(joints)
    animation.CreateScalesAttr([Gf.Vec3h(1)] * len(joints))
    UsdSkel.BindingAPI.Apply(rig.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    place = UsdGeom.Xformable(root).AddTransformOp()
    for frame in range(FRAMES):
        rows = local(frame)
        animation.CreateRotationsAttr().Set([Gf.Quatf(row.ExtractRotationQuat()) for row in rows], frame)
        animation.CreateTranslationsAttr().Set([Gf.Vec3f(row.ExtractTranslation()) for row in rows], frame)
        matrix = above(frame)
        place.Set(matrix.SetTranslateOnly(matrix.ExtractTranslation() / unit), frame)
    mesh = UsdGeom.Mesh.Define(stage, "/Hero/Body")
    mesh.CreatePointsAttr([Gf.Vec3f(placed(None)[leaves.index(name)].ExtractTranslation()) for name in BONES])
    mesh.CreateFaceVertexCountsAttr([3, 3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 0, 1, 3])
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([rig.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 1).Set([leaves.index(name) for name in BONES])
    binding.CreateJointWeightsPrimvar(False, 1).Set([1.0] * len(BONES))
    stage.Save()
    return str(path)


def seen(path: str) -> dict[str, np.ndarray]:
    """Each joint in the world as UsdSkel poses it [m], column vectors, shape (F, 4, 4)."""
    stage, cache = Usd.Stage.Open(path), UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(stage.GetPrimAtPath("/Hero")), Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Rig")))
    frames = [query.ComputeJointWorldTransforms(UsdGeom.XformCache(frame)) for frame in range(FRAMES)]
    found = np.swapaxes(np.array([[np.array(matrix) for matrix in row] for row in frames]), -1, -2)
    found[..., :3, 3] *= UsdGeom.GetStageMetersPerUnit(stage)
    return {str(name).rpartition("/")[2]: found[:, each] for each, name in enumerate(query.GetJointOrder())}


def played(character: str, motion: str) -> dict[str, np.ndarray]:
    skeleton = read_character(character).skeleton
    world = motion_transforms(read_motion(motion, skeleton), skeleton.parents)
    return {name.rpartition("/")[2]: world[:, each] for each, name in enumerate(skeleton.joint_names)}


@pytest.mark.parametrize("character", SHARED)
@pytest.mark.parametrize("motion", SHARED)
def test_a_shot_of_another_hierarchy_moves_the_body_as_usd_shows_it(tmp_path, character, motion):
    hero, shot = (write(tmp_path / f"{kind}.usda", *SHARED[each]) for kind, each in (("a", character), ("b", motion)))
    expected, found = seen(shot), played(hero, shot)
    for name in BONES:
        np.testing.assert_allclose(found[name][..., :3, 3], expected[name][..., :3, 3], atol=2e-6)
        turned = [
            each[name][..., :3, :3] / np.cbrt(np.linalg.det(each[name][0, :3, :3])) for each in (found, expected)
        ]
        np.testing.assert_allclose(*turned, atol=2e-6)


STANDING = [name for name in SHARED if "xform" not in name]


@pytest.mark.parametrize("character", STANDING)
@pytest.mark.parametrize("motion", STANDING)
def test_a_clip_of_another_hierarchy_moves_the_body_as_in_its_own_stage(tmp_path, character, motion):
    hero, shot = (write(tmp_path / f"{kind}.usda", *SHARED[each]) for kind, each in (("a", character), ("b", motion)))
    clip = Usd.Stage.CreateNew(str(tmp_path / "clip.usda"))
    UsdGeom.SetStageMetersPerUnit(clip, 1)
    UsdGeom.SetStageUpAxis(clip, "Y")
    clip.SetTimeCodesPerSecond(30)
    Sdf.CopySpec(Sdf.Layer.FindOrOpen(shot), "/Hero/Animation", clip.GetRootLayer(), "/Clip")
    clip.Save()
    expected, found = seen(shot), played(hero, str(tmp_path / "clip.usda"))
    for name in BONES:
        np.testing.assert_allclose(found[name], expected[name], atol=2e-6)
