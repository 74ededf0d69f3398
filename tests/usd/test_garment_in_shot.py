# SPDX-License-Identifier: Apache-2.0
"""A garment that a shot shapes otherwise than its character's stage is told; one that was simulated there is not."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.reading.scene import read_scene
from ssilk_usd.reading.shown import shown_otherwise
from ssilk_usd.shots.shot import write_shot
from ssilk_usd.units import StageUnits
from ssilk_usd.writing.rig import write_rigged_stage

from ssilk_core.scene import kinematics
from ssilk_core.scene.assets import Deformer, Garment, GarmentPose, ProxyRig, Scene, SkinWeights

from .test_shapes import GEOM, dressed, exported, mm, over, seen, with_more_points

CAPE, LOOK = "/Hero/Cape", "/Hero/Rig/Look"
KEPT = "; what is written has the garment of the character's stage"
Change = Callable[[Usd.Stage], None]


def cape(stage: Usd.Stage) -> UsdGeom.Mesh:
    return UsdGeom.Mesh(stage.GetPrimAtPath(CAPE))


def turned(stage: Usd.Stage) -> None:
    """Bend the spine at time code 5."""
    look = UsdSkel.Animation(stage.GetPrimAtPath(LOOK))
    rest = look.GetRotationsAttr().Get()
    for code, turn in ((1, Gf.Quatf(1)), (5, Gf.Quatf(0.8, 0.6, 0, 0))):
        look.GetRotationsAttr().Set([rest[0], rest[1] * turn], code)


def sculpted(stage: Usd.Stage) -> None:
    cape(stage).GetPointsAttr().Set([point + Gf.Vec3f(0, 0, 5) for point in cape(stage).GetPointsAttr().Get()])


def reweighed(stage: Usd.Stage) -> None:
    UsdSkel.BindingAPI(cape(stage)).GetJointIndicesPrimvar().Set([1, 1, 0, 1])


def bound_elsewhere(stage: Usd.Stage) -> None:
    UsdSkel.BindingAPI(cape(stage)).GetGeomBindTransformAttr().Set(GEOM * Gf.Matrix4d().SetTranslate((0, 3, 0)))


def sculpted_shape(stage: Usd.Stage) -> None:
    UsdSkel.BlendShape.Get(stage, f"{CAPE}/Full").GetOffsetsAttr().Set([Gf.Vec3f(0, 0, 9)] * 4)


def corrected(stage: Usd.Stage) -> None:
    """A blendshape that the shot alone has, and that is on while the spine is bent."""
    fix = UsdSkel.BlendShape.Define(stage, f"{CAPE}/Fix")
    fix.CreateOffsetsAttr([Gf.Vec3f(0, 0, 4)] * 4)
    binding = UsdSkel.BindingAPI(cape(stage))
    binding.GetBlendShapesAttr().Set(["Full", "Fix"])
    binding.GetBlendShapeTargetsRel().SetTargets([f"{CAPE}/Full", fix.GetPath()])
    look = UsdSkel.Animation(stage.GetPrimAtPath(LOOK))
    look.GetBlendShapesAttr().Set(["Other", "Full", "Fix"])
    for code, weight in ((1, 0.0), (5, 1.0)):
        look.GetBlendShapeWeightsAttr().Set([0.0, 1.0, weight], code)


def unbound_beneath_another_transform(stage: Usd.Stage) -> None:
    UsdSkel.BindingAPI(cape(stage)).GetSkeletonRel().SetTargets([])
    UsdGeom.Xformable(cape(stage)).AddTranslateOp().Set((0, 10, 0))


def not_a_number(stage: Usd.Stage) -> None:
    cape(stage).GetPointsAttr().Set([Gf.Vec3f(float("nan"))] * 4)


CHANGES = [
    sculpted, reweighed, bound_elsewhere, sculpted_shape, corrected, unbound_beneath_another_transform,
]  # fmt: skip


def off_of(shot: str, change: Change, folder: Path, mesh: str = CAPE) -> float:
    """How far USD shows the garment of a shot from the character's own in the same motion [m], at most."""
    alone = Usd.Stage.CreateNew(str(folder / "alone.usda"))
    alone.GetRootLayer().subLayerPaths.append("./hero.usda")
    layer = Sdf.Layer.FindOrOpen(str(folder / "shot.usda"))
    Sdf.CreatePrimInLayer(alone.GetRootLayer(), "/Hero/Rig")
    Sdf.CopySpec(layer, LOOK, alone.GetRootLayer(), LOOK)
    alone.Save()
    return max(
        np.linalg.norm(seen(shot, mesh, code) - seen(str(folder / "alone.usda"), CAPE, code), axis=1).max()
        for code in (1, 5)
    )


@pytest.mark.parametrize("change", CHANGES)
def test_a_garment_that_a_shot_shapes_otherwise_is_told_with_how_far_it_is_off(tmp_path, change):
    hero, stage = over(tmp_path)
    turned(stage)
    change(stage)
    stage.Save()
    shot = str(tmp_path / "shot.usda")
    off = off_of(shot, change, tmp_path)
    (told,) = shown_otherwise(hero, shot, garment="Cape")
    assert off > 0.01 and told.startswith(
        f"it shapes the garment Cape otherwise, by up to {mm(off)} mm at time code "
    )
    assert told.endswith(KEPT)


def test_a_garment_that_a_shot_calls_otherwise_is_known_by_its_faces(tmp_path):
    hero, stage = over(tmp_path)
    turned(stage)
    sculpted(stage)
    stage.Save()
    shot = exported(stage, {"Body": "ann_Body", "Cape": "Cape_001"}, tmp_path)
    off = off_of(shot, sculpted, tmp_path, "/Hero/Cape_001")
    (told,) = shown_otherwise(hero, shot, garment="Cape")
    assert told.startswith(f"it shapes the garment Cape_001 otherwise, by up to {mm(off)} mm")


def test_other_points_faces_purposes_and_a_garment_that_is_off_are_told(tmp_path):
    hero = dressed(tmp_path, [0.0, 1.0])
    for change, words in (
        (lambda stage: with_more_points(stage, CAPE), "it shapes the garment Cape otherwise, with other points"),
        (
            lambda stage: cape(stage).GetPointsAttr().Block(),
            "it shapes the garment Cape otherwise, with other points",
        ),
        (not_a_number, "it shapes the garment Cape otherwise, with other points"),
        (lambda stage: cape(stage).CreateHoleIndicesAttr([0]), "it shows 1 faces of Cape instead of 2"),
        (lambda stage: UsdGeom.Imageable(cape(stage)).CreatePurposeAttr("guide"), "it gives Cape the purpose guide"),
        (lambda stage: cape(stage).GetPrim().SetActive(False), f"it deactivates {CAPE}, and with it the garment"),
    ):
        shot = Usd.Stage.CreateInMemory()
        shot.GetRootLayer().subLayerPaths.append(hero)
        UsdGeom.SetStageMetersPerUnit(shot, 0.01)
        UsdGeom.SetStageUpAxis(shot, "Y")
        change(shot)
        shot.GetRootLayer().Export(str(tmp_path / "shot.usda"))
        Sdf.Layer.FindOrOpen(str(tmp_path / "shot.usda")).Reload()
        assert shown_otherwise(hero, str(tmp_path / "shot.usda"), garment="Cape") == [words + KEPT]


def test_a_garment_that_no_joint_moves_is_compared_at_rest(tmp_path):
    hero = dressed(tmp_path, [0.0, 0.0])
    stage = Usd.Stage.Open(hero)
    for name in ("skel:skeleton", "primvars:skel:jointIndices", "primvars:skel:jointWeights"):
        stage.GetPrimAtPath(CAPE).RemoveProperty(name)
    stage.Save()
    shot = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    shot.GetRootLayer().subLayerPaths.append("./hero.usda")
    UsdGeom.SetStageMetersPerUnit(shot, 0.01)
    UsdGeom.SetStageUpAxis(shot, "Y")
    shot.Save()
    assert shown_otherwise(hero, str(tmp_path / "shot.usda"), garment="Cape") == []
    sculpted(shot)
    shot.Save()
    told = shown_otherwise(hero, str(tmp_path / "shot.usda"), garment="Cape")
    assert told == ["it shapes the garment Cape otherwise, by up to 50 mm" + KEPT]


def rigged(folder: Path) -> str:
    """Write a character whose garment has a proxy that hangs from the spine; return the path of its stage."""
    path, out = dressed(folder, [0.0, 0.0]), folder / "rigged.usda"
    character, garment, _ = read_scene(path, garment="Cape")
    bind = np.array(character.skeleton.bind_transforms[1])
    bind[:3, 3] += [0, 0.1, 0.1]
    skin = SkinWeights("Cape", np.array([[0], [2], [2], [1]]), np.ones((4, 1)))
    rig = ProxyRig("Cape", ("Hips/Spine/proxy",), np.array([1]), bind[None], skin)
    cloth = Garment(garment.mesh, garment.skin, np.array([0, 2, 2, 0]))
    write_rigged_stage(path, Scene(character, cloth, rig), out)
    return str(out)


@pytest.mark.parametrize("posed", ["still", "turned"])
@pytest.mark.parametrize("change", [None, sculpted])
def test_a_garment_with_proxies_is_compared_however_the_shot_poses_them(tmp_path, posed, change):
    hero = rigged(tmp_path)
    shot = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    shot.GetRootLayer().subLayerPaths.append("./rigged.usda")
    UsdGeom.SetStageMetersPerUnit(shot, 0.01)
    UsdGeom.SetStageUpAxis(shot, "Y")
    turned(shot)
    if posed == "turned":
        look = UsdSkel.Animation(shot.GetPrimAtPath(LOOK))
        look.GetJointsAttr().Set(["Hips", "Hips/Spine", "Hips/Spine/proxy"])
        look.GetScalesAttr().Set([Gf.Vec3h(1)] * 3)
        look.GetTranslationsAttr().Set([*look.GetTranslationsAttr().Get(), Gf.Vec3f(0, 20, 5)])
        for code in (1, 5):
            rest = look.GetRotationsAttr().Get(code)
            look.GetRotationsAttr().Set([*rest, Gf.Quatf(0.6, 0, 0, 0.8)], code)
    shot.Save()
    path = str(tmp_path / "shot.usda")
    before = [seen(path, CAPE, code) for code in (1, 5)]
    if change is None:
        assert shown_otherwise(hero, path) == []
        return
    change(shot)
    shot.Save()
    off = max(
        np.linalg.norm(seen(path, CAPE, code) - at, axis=1).max() for code, at in zip((1, 5), before, strict=True)
    )
    (told,) = shown_otherwise(hero, path)
    assert told.startswith(f"it shapes the garment Cape otherwise, by up to {mm(off)} mm")


def test_a_garment_that_was_baked_or_simulated_in_a_shot_is_not_told(tmp_path):
    hero, stage = over(tmp_path)
    turned(stage)
    stage.Save()
    character, garment, _ = read_scene(hero, garment="Cape")
    motion = read_motion(str(tmp_path / "shot.usda"), character.skeleton)
    cloth = Garment(garment.mesh, garment.skin, np.array([0, 2, 2, 0]))
    rig = ProxyRig("Cape", (), np.zeros(0, int), np.zeros((0, 4, 4)), garment.skin)
    scene = Scene(character, cloth, rig)
    shapes = np.zeros((1, 4, 3))
    shapes[0, 1:3] = 0.2
    pose = GarmentPose(0, np.zeros((motion.frame_count, 0, 4)), np.ones((motion.frame_count, 1)))
    baked = tmp_path / "baked.usda"
    deformer = Deformer(scene, garment.skin, shapes)
    write_shot(baked, deformer, motion, [pose], units=StageUnits(0.01, "Y"), start=motion.start)
    shown = kinematics.deform(deformer, motion, pose)
    alone = kinematics.deform(*_plain(scene, motion))
    assert np.abs(shown - alone).max() > 0.1
    assert shown_otherwise(hero, str(baked), garment="Cape") == []
    points = cape(stage).GetPointsAttr().Get()
    UsdSkel.BindingAPI(cape(stage)).GetSkeletonRel().SetTargets([])  # what another program simulated
    for code in (1, 3, 5):
        cape(stage).GetPointsAttr().Set([point + Gf.Vec3f(0, code, 0) for point in points], code)
    stage.Save()
    assert shown_otherwise(hero, str(tmp_path / "shot.usda"), garment="Cape") == []


def _plain(scene: Scene, motion):
    (pose,) = kinematics.lbs_poses(motion.frame_count)
    return kinematics.lbs_deformer(scene), motion, pose
