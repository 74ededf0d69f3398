# SPDX-License-Identifier: Apache-2.0
"""What USD composes is what is read: values over time, animations that play, materials that are bound, weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Ts, Usd, UsdGeom, UsdShade, UsdSkel, Vt
from ssilk_usd.reading.character import read_character
from ssilk_usd.reading.frame_range import read_frame_range
from ssilk_usd.reading.garment import read_garment
from ssilk_usd.reading.mesh import read_mesh
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.reading.scene import read_scene
from ssilk_usd.reading.surface import read_surface

from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import Motion, Skeleton
from ssilk_core.scene.kinematics import motion_transforms, skin_points, skinning_matrices

JOINTS = ("Hips", "Hips/Spine", "Hips/Spine/Head")
LAST = 12
Y = Gf.Vec3d(0, 1, 0)


def define_hero(stage: Usd.Stage, *, weight: float = 1.0, animated: tuple[str, ...] = JOINTS) -> Usd.Prim:
    """A square on three joints in /World/Hero, moved by /World/Pose; return the Skeleton."""
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    root = UsdSkel.Root.Define(stage, "/World/Hero").GetPrim()
    skeleton = UsdSkel.Skeleton.Define(stage, "/World/Hero/Rig")
    rest = [Gf.Matrix4d().SetTranslate(Gf.Vec3d(0, height, 0)) for height in (1.0, 0.3, 0.2)]
    skeleton.CreateJointsAttr(JOINTS)
    skeleton.CreateRestTransformsAttr(Vt.Matrix4dArray(rest))
    skeleton.CreateBindTransformsAttr(Vt.Matrix4dArray([rest[0], rest[1] * rest[0], rest[2] * rest[1] * rest[0]]))
    for prim in (root, skeleton.GetPrim()):
        UsdSkel.BindingAPI.Apply(prim)
    UsdSkel.BindingAPI(root).CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    mesh = UsdGeom.Mesh.Define(stage, "/World/Hero/Body")
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (1, 2, 0), (0, 2, 0)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateJointIndicesPrimvar(False, 1).Set([0, 0, 1, 1])
    binding.CreateJointWeightsPrimvar(False, 1).Set([1.0, 1.0, weight, weight])
    pose = UsdSkel.Animation.Define(stage, "/World/Pose")
    pose.CreateJointsAttr(animated)
    pose.CreateScalesAttr([Gf.Vec3h(1)] * len(animated))
    pose.CreateTranslationsAttr([Gf.Vec3f(rest[JOINTS.index(name)].ExtractTranslation()) for name in animated])
    turn = Gf.Quatf(Gf.Rotation(Gf.Vec3d(1, 0, 0), 20).GetQuat())
    pose.CreateRotationsAttr([turn] * len(animated))
    UsdSkel.BindingAPI(root).CreateAnimationSourceRel().SetTargets([pose.GetPath()])
    return skeleton.GetPrim()


def joints_of_usd(stage: Usd.Stage, codes: list[float]) -> np.ndarray:
    """Where UsdSkel puts the joints in the world, shape (F, J, 3)."""
    cache, root = UsdSkel.Cache(), UsdSkel.Root(stage.GetPrimAtPath("/World/Hero"))
    cache.Populate(root, Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/World/Hero/Rig")))
    worlds = [query.ComputeJointWorldTransforms(UsdGeom.XformCache(code)) for code in codes]
    return np.array([[matrix.ExtractTranslation() for matrix in world] for world in worlds])


def turning_spline(*, goes_on: bool = False) -> Ts.Spline:
    spline = Ts.Spline("float")
    for time, value in ((1, 0.0), (LAST, 90.0)):
        spline.SetKnot(Ts.Knot(typeName="float", time=time, value=value, nextInterp=Ts.InterpLinear))
    if goes_on:
        spline.SetPostExtrapolation(Ts.Extrapolation(Ts.ExtrapLinear))
        spline.SetPreExtrapolation(Ts.Extrapolation(Ts.ExtrapLinear))
    return spline


def places(motion: Motion, skeleton: Skeleton) -> np.ndarray:
    return motion_transforms(motion, skeleton.parents)[..., :3, 3]


@pytest.mark.parametrize("where", ["/World", "/World/Hero", "/World/Hero/Rig"])
def test_a_spline_above_the_skeleton_is_played(where):
    stage = Usd.Stage.CreateInMemory()
    define_hero(stage)
    prim = UsdGeom.Xformable(stage.GetPrimAtPath(where))
    prim.AddTranslateOp().Set(Gf.Vec3d(2, 0, 0))
    prim.AddRotateZOp().GetAttr().SetSpline(turning_spline())
    skeleton = read_character(stage).skeleton
    motion = read_motion(stage, skeleton)
    codes = [float(code) for code in range(1, LAST + 1)]
    assert motion.frame_count == LAST
    np.testing.assert_allclose(places(motion, skeleton), joints_of_usd(stage, codes), atol=1e-5)


def test_a_spline_that_goes_on_is_played_as_long_as_its_stage():
    stage = Usd.Stage.CreateInMemory()
    define_hero(stage)
    UsdGeom.Xformable(stage.GetPrimAtPath("/World")).AddRotateZOp().GetAttr().SetSpline(turning_spline(goes_on=True))
    stage.SetStartTimeCode(-3)
    stage.SetEndTimeCode(LAST + 5)
    skeleton = read_character(stage).skeleton
    motion, codes = read_motion(stage, skeleton), [float(code) for code in range(-3, LAST + 6)]
    assert (motion.start, motion.frame_count) == (-3, len(codes))
    np.testing.assert_allclose(places(motion, skeleton), joints_of_usd(stage, codes), atol=1e-5)


def test_a_spline_in_a_layer_with_an_offset_spans_what_usd_plays(tmp_path):
    layer = Sdf.Layer.CreateNew(str(tmp_path / "turn.usda"))
    stage = Usd.Stage.Open(layer)
    define_hero(stage)
    UsdGeom.Xformable(stage.GetPrimAtPath("/World")).AddRotateZOp().GetAttr().SetSpline(turning_spline())
    layer.Save()
    later = Sdf.Layer.CreateNew(str(tmp_path / "later.usda"))
    later.subLayerPaths.append("./turn.usda")
    later.subLayerOffsets[0] = Sdf.LayerOffset(100, 2)
    UsdGeom.SetStageMetersPerUnit(Usd.Stage.Open(later), 1.0)
    UsdGeom.SetStageUpAxis(Usd.Stage.Open(later), "Y")
    later.Save()
    found = read_frame_range(str(tmp_path / "later.usda"))
    assert found and (found.first, found.last) == (102, 100 + 2 * LAST)


def test_xforms_above_a_reset_of_the_stack_play_nothing():
    stage = Usd.Stage.CreateInMemory()
    define_hero(stage)
    turned = UsdGeom.Xformable(stage.GetPrimAtPath("/World")).AddRotateZOp()
    turned.Set(0.0, 0)
    turned.Set(90.0, 50)
    hero = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Hero"))
    hero.AddTranslateOp().GetAttr().Set(Gf.Vec3d(1, 0, 0), 3)
    hero.GetTranslateOp().Set(Gf.Vec3d(2, 0, 0), 7)
    hero.SetResetXformStack(True)
    skeleton = read_character(stage).skeleton
    motion, codes = read_motion(stage, skeleton), [3.0, 4.0, 5.0, 6.0, 7.0]
    assert motion.frame_count == len(codes)
    np.testing.assert_allclose(places(motion, skeleton), joints_of_usd(stage, codes), atol=1e-5)


def deactivated(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/World/Pose").SetActive(False)


def blocked(stage: Usd.Stage) -> None:
    UsdSkel.BindingAPI(stage.GetPrimAtPath("/World/Hero/Rig")).CreateAnimationSourceRel().SetTargets([])


def gone(stage: Usd.Stage) -> None:
    relationship = UsdSkel.BindingAPI(stage.GetPrimAtPath("/World/Hero")).GetAnimationSourceRel()
    relationship.SetTargets(["/World/Renamed"])


def beneath_what_is_off(stage: Usd.Stage) -> None:
    UsdSkel.BindingAPI(stage.GetPrimAtPath("/World/Hero")).GetAnimationSourceRel().SetTargets(["/World/Clips/Pose"])
    Sdf.CopySpec(stage.GetRootLayer(), "/World/Pose", stage.GetRootLayer(), "/World/Pose2")
    stage.DefinePrim("/World/Clips")
    Sdf.CopySpec(stage.GetRootLayer(), "/World/Pose", stage.GetRootLayer(), "/World/Clips/Pose")
    stage.GetPrimAtPath("/World/Clips").SetActive(False)


def another_kind(stage: Usd.Stage) -> None:
    UsdSkel.BindingAPI(stage.GetPrimAtPath("/World/Hero")).GetAnimationSourceRel().SetTargets(["/World"])


def without_the_schema(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/World/Hero").RemoveAppliedSchema("SkelBindingAPI")


def without_scales(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/World/Pose").RemoveProperty("scales")


@pytest.mark.parametrize(
    "off", [deactivated, blocked, gone, beneath_what_is_off, another_kind, without_the_schema, without_scales]
)
def test_an_animation_that_usd_does_not_play_is_refused_by_name(off):
    stage = Usd.Stage.CreateInMemory()
    define_hero(stage)
    skeleton = read_character(stage).skeleton
    assert not np.allclose(joints_of_usd(stage, [0.0])[0, 2], [0, 1.5, 0], atol=1e-2)
    off(stage)
    np.testing.assert_allclose(joints_of_usd(stage, [0.0])[0, 2], [0, 1.5, 0], atol=1e-6)  # USD shows the rest pose
    with pytest.raises(SsilkError, match="/World/Hero/Rig: USD plays no animation on it"):
        read_motion(stage, skeleton)


def test_an_animation_may_still_be_named_where_none_plays():
    stage = Usd.Stage.CreateInMemory()
    define_hero(stage)
    skeleton = read_character(stage).skeleton
    blocked(stage)
    assert read_motion(stage, skeleton, prim="Pose").frame_count == 1


@pytest.mark.parametrize("animated", [JOINTS[:2], JOINTS[1:], ("Hips", "Spine", "Hips/Spine/Head")])
def test_joints_that_the_animation_does_not_pose_rest_as_in_usd(animated):
    stage = Usd.Stage.CreateInMemory()
    names = tuple(name if name in JOINTS else f"Hips/{name}" for name in animated)
    define_hero(stage, animated=names)
    UsdSkel.Animation(stage.GetPrimAtPath("/World/Pose")).GetJointsAttr().Set(animated)
    skeleton = read_character(stage).skeleton
    rest = UsdSkel.Skeleton(stage.GetPrimAtPath("/World/Hero/Rig")).GetRestTransformsAttr()
    rest.Set([Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(0, 0, 1), 30)) * matrix for matrix in rest.Get()])
    found = places(read_motion(stage, skeleton), skeleton)
    np.testing.assert_allclose(found, joints_of_usd(stage, [0.0]), atol=1e-5)


def test_a_sample_without_a_value_is_named():
    stage = Usd.Stage.CreateInMemory()
    define_hero(stage)
    skeleton = read_character(stage).skeleton
    rotations = UsdSkel.Animation(stage.GetPrimAtPath("/World/Pose")).GetRotationsAttr()
    for code in (1, 2, 3):
        rotations.Set(Sdf.ValueBlock() if code == 2 else rotations.Get(), code)
    with pytest.raises(SsilkError, match="/World/Pose: the animation has no rotations at time code 2; 3 are needed"):
        read_motion(stage, skeleton)


def body_of_usd(stage: Usd.Stage, path: str = "/World/Hero/Body") -> np.ndarray:
    """Where UsdSkel bakes the points of the body in the world."""
    baked = Usd.Stage.Open(stage.Flatten())
    assert UsdSkel.BakeSkinning(UsdSkel.Root(baked.GetPrimAtPath("/World/Hero")), Gf.Interval(0, 1))
    mesh = UsdGeom.Mesh(baked.GetPrimAtPath(path))
    world = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(mesh.GetPrim()))
    points = np.array(mesh.GetPointsAttr().Get(0), dtype=np.float64)
    return points @ world[:3, :3] + world[3, :3]


def body_of_ours(stage: Usd.Stage) -> np.ndarray:
    character = read_character(stage)
    world = motion_transforms(read_motion(stage, character.skeleton), character.skeleton.parents)
    matrices = skinning_matrices(world, character.skeleton.bind_transforms)
    (body,) = character.bodies
    return skin_points(body.mesh.points, body.skin, matrices)[0]


def placed_by_samples(stage: Usd.Stage) -> None:
    """What places the points is a time sample, as some programs write all that they export."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Hero/Body"))
    mesh.GetPointsAttr().Set(Vt.Vec3fArray([100 * point for point in mesh.GetPointsAttr().Get()]))
    UsdSkel.BindingAPI(mesh).CreateGeomBindTransformAttr().Set(Gf.Matrix4d().SetScale(0.01), 0)


def seen_later(stage: Usd.Stage) -> None:
    visibility = UsdGeom.Imageable(stage.GetPrimAtPath("/World/Hero")).CreateVisibilityAttr()
    visibility.Set("invisible", 0)
    visibility.Set("inherited", 1)


def blocked_below_others(stage: Usd.Stage) -> None:
    above = UsdSkel.BindingAPI(stage.GetPrimAtPath("/World/Hero"))
    above.CreateJointIndicesPrimvar(True, 1).Set([1])
    above.CreateJointWeightsPrimvar(True, 1).Set([1.0])
    for name in ("Indices", "Weights"):
        stage.GetPrimAtPath("/World/Hero/Body").GetAttribute(f"primvars:skel:joint{name}").Block()


@pytest.mark.parametrize("change", [placed_by_samples, seen_later, blocked_below_others])
def test_a_body_is_where_usd_skins_it(change):
    stage = Usd.Stage.CreateInMemory()
    define_hero(stage)
    change(stage)
    np.testing.assert_allclose(body_of_ours(stage), body_of_usd(stage), atol=1e-6)


def unapplied_on_the_mesh(stage: Usd.Stage) -> str:
    stage.GetPrimAtPath("/World/Hero/Body").RemoveAppliedSchema("SkelBindingAPI")
    return "/World/Hero/Body says primvars:skel:jointIndices and does not apply SkelBindingAPI"


def unapplied_above(stage: Usd.Stage) -> str:
    without_the_schema(stage)
    return "/World/Hero says skel:skeleton and does not apply SkelBindingAPI"


def beneath_no_xform(stage: Usd.Stage) -> str:
    stage.DefinePrim("/World/Hero/Group")
    edit = Sdf.BatchNamespaceEdit()
    edit.Add("/World/Hero/Body", "/World/Hero/Group/Body")
    assert stage.GetRootLayer().Apply(edit)
    return "/World/Hero/Group above it is no Xform"


@pytest.mark.parametrize("change", [unapplied_on_the_mesh, unapplied_above, beneath_no_xform])
def test_a_mesh_that_usd_does_not_skin_is_refused_by_name(change):
    stage = Usd.Stage.CreateInMemory()
    define_hero(stage)
    body_of_ours(stage)
    found, path = change(stage), "/World/Hero/Body"
    path = path if stage.GetPrimAtPath(path) else "/World/Hero/Group/Body"
    np.testing.assert_allclose(body_of_usd(stage, path)[:, 2], 0, atol=1e-6)  # USD leaves it as it was modelled
    with pytest.raises(SsilkError, match=f"{path}: USD does not skin it: {found}"):
        read_character(stage)


def strong(stage: Usd.Stage, above: Usd.Prim, stiff: UsdShade.Material) -> None:
    UsdShade.MaterialBindingAPI.Apply(above).Bind(stiff, UsdShade.Tokens.strongerThanDescendants, "physics")


def collected(stage: Usd.Stage, above: Usd.Prim, stiff: UsdShade.Material) -> None:
    collection = Usd.CollectionAPI.Apply(above, "cloth")
    collection.CreateIncludesRel().SetTargets([above.GetPath().AppendChild("Cape")])
    UsdShade.MaterialBindingAPI.Apply(above).Bind(
        collection, stiff, "cloth", UsdShade.Tokens.strongerThanDescendants, "physics"
    )


def collected_for_all(stage: Usd.Stage, above: Usd.Prim, stiff: UsdShade.Material) -> None:
    UsdShade.MaterialBindingAPI(stage.GetPrimAtPath("/Dress/Cape")).UnbindAllBindings()
    collection = Usd.CollectionAPI.Apply(above, "cloth")
    collection.CreateIncludesRel().SetTargets([above.GetPath().AppendChild("Cape")])
    UsdShade.MaterialBindingAPI.Apply(above).Bind(collection, stiff, "cloth")


@pytest.mark.parametrize("bind", [strong, collected, collected_for_all])
def test_the_fabric_is_the_one_that_usd_binds(bind):
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    above = UsdGeom.Xform.Define(stage, "/Dress").GetPrim()
    mesh = UsdGeom.Mesh.Define(stage, "/Dress/Cape")
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    soft, stiff = (UsdShade.Material.Define(stage, f"/{name}") for name in ("Soft", "Stiff"))
    for material, modulus in ((soft, 1e4), (stiff, 5e5)):
        material.GetPrim().CreateAttribute("physics:youngsModulus", Sdf.ValueTypeNames.Float).Set(modulus)
        material.GetPrim().CreateAttribute("physics:surfaceBendStiffness", Sdf.ValueTypeNames.Float).Set(1e-6)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(soft, UsdShade.Tokens.fallbackStrength, "physics")
    bind(stage, above, stiff)
    bound, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial("physics")
    assert bound.GetPath() == "/Stiff"
    found = read_surface(mesh.GetPrim(), read_mesh(mesh.GetPrim(), np.eye(4)))
    assert found and found.youngs_modulus == pytest.approx(5e5)


def test_fabrics_of_parts_of_a_garment_are_told(tmp_path):
    """Panels may have physics materials of their own; a look of theirs says nothing of cloth."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "cape.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    mesh = UsdGeom.Mesh.Define(stage, "/Cape")
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)])
    mesh.CreateFaceVertexCountsAttr([3, 3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 2, 1, 3])
    soft, stiff, red = (UsdShade.Material.Define(stage, f"/{name}") for name in ("Soft", "Stiff", "Red"))
    for material, modulus in ((soft, 1e4), (stiff, 5e5)):
        material.GetPrim().CreateAttribute("physics:youngsModulus", Sdf.ValueTypeNames.Float).Set(modulus)
    api = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())
    api.Bind(soft, materialPurpose="physics")
    for name, material, face, purpose in (("belt", stiff, 0, "physics"), ("hem", red, 1, "")):
        subset = api.CreateMaterialBindSubset(name, [face]).GetPrim()
        UsdShade.MaterialBindingAPI.Apply(subset).Bind(material, materialPurpose=purpose)
    character = Usd.Stage.CreateInMemory()
    define_hero(character)
    messages: list[str] = []
    skeleton = read_character(character).skeleton
    read_garment(stage, skeleton, report=lambda event: messages.append(getattr(event, "text", "")))
    (told,) = messages
    assert "fabrics of parts of it are left out: Stiff of belt; a garment has one fabric" in told


@pytest.mark.parametrize(("weight", "told"), [(0.5, True), (1.3, True), (0.999, False)])
def test_weights_that_do_not_sum_to_one_are_told(weight, told, tmp_path: Path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "hero.usda"))
    define_hero(stage, weight=weight)
    cloth = Sdf.CopySpec(stage.GetRootLayer(), "/World/Hero/Body", stage.GetRootLayer(), "/World/Hero/Cape")
    assert cloth
    stage.GetPrimAtPath("/World/Hero/Cape").CreateAttribute("ssilk:garment", Sdf.ValueTypeNames.Bool).Set(True)
    stage.Save()
    messages: list[str] = []
    read_scene(str(tmp_path / "hero.usda"), report=lambda event: messages.append(getattr(event, "text", "")))
    about = [text for text in messages if f"the weights of 2 of 4 vertices sum to {weight:g}" in text]
    assert len(about) == (2 if told else 0)  # of the body and of the garment
