# SPDX-License-Identifier: Apache-2.0
"""Who draws a mesh: cloth meets what is rendered, and bodies, cages and garments keep their purpose in shots."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel
from ssilk_usd.reading.character import read_character
from ssilk_usd.reading.garment import find_garment
from ssilk_usd.reading.scene import read_scene
from ssilk_usd.shots.play import Shot
from ssilk_usd.shots.shot import write_shot
from ssilk_usd.units import StageUnits

from ssilk_core.delivery.targets import TARGETS, fit
from ssilk_core.scene.assets import Garment, Motion, ProxyRig, Scene
from ssilk_core.scene.kinematics import lbs_deformer, lbs_poses


def square(stage: Usd.Stage, path: str, size: float, purpose: str = "") -> Usd.Prim:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([(-size, 0, 0), (size, 0, 0), (size, 1, 0), (-size, 1, 0)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateJointIndicesPrimvar(True, 1).Set([0])
    binding.CreateJointWeightsPrimvar(True, 1).Set([1.0])
    if purpose:
        mesh.CreatePurposeAttr(purpose)
    return mesh.GetPrim()


@pytest.fixture
def stage(tmp_path):
    """A body that is rendered, by a purpose of its parent, and a cage of purpose proxy."""
    found = Usd.Stage.CreateNew(str(tmp_path / "hero.usda"))
    UsdGeom.SetStageMetersPerUnit(found, 1.0)
    UsdGeom.SetStageUpAxis(found, "Y")
    root = UsdSkel.Root.Define(found, "/Hero")
    rig = UsdSkel.Skeleton.Define(found, "/Hero/Rig")
    rig.CreateJointsAttr(["Hips"])
    rig.CreateBindTransformsAttr([Gf.Matrix4d().SetTranslate((0, 1, 0))])
    rig.CreateRestTransformsAttr([Gf.Matrix4d().SetTranslate((0, 1, 0))])
    UsdSkel.BindingAPI.Apply(root.GetPrim()).CreateSkeletonRel().SetTargets([rig.GetPath()])
    square(found, "/Hero/Cage", 0.5, "proxy")
    UsdGeom.Xform.Define(found, "/Hero/Geo").CreatePurposeAttr("render")
    square(found, "/Hero/Geo/Body", 0.3)
    square(found, "/Hero/Cape", 0.4).CreateAttribute("ssilk:garment", Sdf.ValueTypeNames.Bool).Set(True)
    found.Save()
    return found


def names(bodies) -> list[str]:
    return [body.mesh.path.rpartition("/")[2] for body in bodies]


def test_cloth_meets_what_is_rendered_and_not_the_cage(stage):
    character = read_character(stage)
    assert (names(character.bodies), names(character.stand_ins)) == (["Body"], ["Cage"])
    assert character.bodies[0].purpose == UsdGeom.Imageable(stage.GetPrimAtPath("/Hero/Geo/Body")).ComputePurpose()


def test_a_cage_is_met_where_it_is_named_or_there_is_nothing_else(stage):
    assert names(read_character(stage, bodies=["Cage"]).bodies) == ["Cage"]
    stage.GetPrimAtPath("/Hero/Geo").SetActive(False)
    assert names(read_character(stage).bodies) == ["Cage"]


def test_a_garment_is_the_one_that_is_rendered(stage):
    square(stage, "/Hero/CapeProxy", 0.4, "proxy").CreateAttribute("ssilk:garment", Sdf.ValueTypeNames.Bool).Set(True)
    assert find_garment(stage).GetName() == "Cape"


@pytest.mark.parametrize("target", ["usd", "game4"])
def test_a_shot_has_body_and_cage_with_their_purposes(stage, tmp_path, target):
    UsdGeom.Imageable(stage.GetPrimAtPath("/Hero/Geo")).CreateProxyPrimRel().SetTargets(["/Hero/Cage"])
    stage.Save()
    character, garment, _ = read_scene(str(tmp_path / "hero.usda"))
    assert garment.skin is not None
    worn = Garment(garment.mesh, garment.skin, np.ones(4, dtype=int))
    rig = ProxyRig(garment.mesh.path, (), np.zeros(0, dtype=int), np.zeros((0, 4, 4)), garment.skin)
    deformer = fit(lbs_deformer(Scene(character, worn, rig)), TARGETS[target])
    rotations, translations = np.tile([1.0, 0, 0, 0], (2, 1, 1)), np.tile([0.0, 1, 0], (2, 1, 1))
    motion = Motion("walk", 30.0, rotations, translations)
    path = str(tmp_path / "shot.usda")
    write_shot(path, deformer, motion, lbs_poses(2), units=StageUnits(1.0, "Y"))
    shot = Usd.Stage.Open(path)
    found = {prim.GetName(): str(UsdGeom.Imageable(prim).ComputePurpose()) for prim in shot.Traverse()
             if prim.IsA(UsdGeom.Mesh)}  # fmt: skip
    assert found == {"Cape": "default", "Body": "render", "Cage": "proxy"}
    assert [mesh.name for mesh in Shot(path).meshes] == ["Cape", "Body"]
    stand_in, rendered = UsdGeom.Imageable(shot.GetPrimAtPath("/Hero/Body")).ComputeProxyPrim()
    assert (stand_in.GetName(), rendered.GetName()) == ("Cage", "Body")
    assert not UsdGeom.Imageable(shot.GetPrimAtPath("/Hero/Cape")).ComputeProxyPrim()
