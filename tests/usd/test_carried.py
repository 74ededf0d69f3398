# SPDX-License-Identifier: Apache-2.0
"""Meshes that a joint carries, as other programs write what is parented to a bone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pxr import Usd, UsdGeom, Vt
from ssilk_usd.reading.character import read_character
from ssilk_usd.reading.scene import read_scene
from ssilk_usd.writing.rig import write_rigged_stage

from ssilk_core.errors import SsilkError
from ssilk_core.scene import kinematics
from ssilk_core.scene.assets import ProxyRig, Scene

from .test_read import FRAMES, PARENTS, RECIPES, TRUTH, author, gf, moved, turned, usdskel_points

OWN = turned("z", 33, 0.5, (0, 0.2, 0))  # a cape's own space to bind space


def stage_with_cape(name: str, follows: np.ndarray, path: str = "/Hero/Cape") -> Usd.Stage:
    """Return a recipe's stage in which an Xform holds a cape, moved by transforms of the core's world (F, 4, 4)."""
    recipe = RECIPES[name]
    placements = np.resize(recipe.placements, (len(follows), 4, 4))
    stage = author(Usd.Stage.CreateInMemory(), recipe)
    holder = UsdGeom.Xform.Define(stage, path)
    operation = holder.AddTransformOp()
    for frame, matrix in enumerate(follows):
        above = np.array(UsdGeom.XformCache(frame + 1).GetParentToWorldTransform(holder.GetPrim())).T
        world = placements[frame] @ np.linalg.inv(recipe.units @ placements[0]) @ matrix @ OWN
        operation.Set(gf(np.linalg.inv(above) @ world), frame + 1)
    mesh = UsdGeom.Mesh.Define(stage, f"{path}/Plane_004")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(moved(np.linalg.inv(OWN), TRUTH.points).astype("f4")))
    mesh.CreateFaceVertexCountsAttr([4] * 10)
    mesh.CreateFaceVertexIndicesAttr(TRUTH.quads.reshape(-1).tolist())
    return stage


def carried(joint: int) -> np.ndarray:
    """Return how a joint moves what it carries from the bind pose, shape (F, 4, 4)."""
    world = kinematics.world_transforms(TRUTH.local, PARENTS)
    return world[:, joint] @ np.linalg.inv(TRUTH.bind[joint])


@pytest.mark.parametrize("name", sorted(RECIPES))
@pytest.mark.parametrize("joint", [0, 2, 4])
def test_what_a_joint_carries_is_bound_to_it_at_its_bind_pose(name, joint):
    character, garment, _ = read_scene(stage_with_cape(name, carried(joint)), garment="Cape")
    assert garment.skin.only_joint == joint
    np.testing.assert_allclose(garment.mesh.points, character.bodies[0].mesh.points, atol=2e-5)


def test_what_moves_otherwise_has_no_joint():
    slides = np.tile(np.eye(4), (FRAMES, 1, 1))
    slides[:, 0, 3] = np.linspace(0, 1, FRAMES)
    for follows in (slides, np.tile(np.eye(4), (FRAMES, 1, 1)), slides @ carried(2)):
        assert read_scene(stage_with_cape("metres, y up", follows), garment="Cape")[1].skin is None


def test_what_a_joint_carries_is_a_body_where_it_is_named():
    stage = stage_with_cape("metres, y up", carried(3), "/Hero/Shield")
    assert [body.mesh.path.rpartition("/")[2] for body in read_character(stage).bodies] == ["Body"]
    (shield,) = read_character(stage, bodies=["Shield"]).bodies
    assert shield.skin.only_joint == 3
    np.testing.assert_allclose(shield.mesh.points, TRUTH.points, atol=2e-5)
    stage.RemovePrim("/Hero/Body")
    assert [body.skin.only_joint for body in read_character(stage).bodies] == [3]
    with pytest.raises(SsilkError, match="no mesh 'Hat' is bound to the skeleton"):
        read_character(stage, bodies=["Hat"])


@pytest.mark.parametrize("shared", [None, "Mesh", "Xform"])
def test_a_rigged_garment_follows_its_joint_by_weights_alone(shared, tmp_path):
    name = "moved and turned"
    stage = stage_with_cape(name, carried(2))
    if shared:  # the Xform that moves the cape moves a brooch as well
        brooch = stage.DefinePrim("/Hero/Cape/Brooch", shared)
        if shared == "Mesh":
            UsdGeom.Mesh(brooch).CreatePointsAttr([(0, 0, 0)] * 3)
    source, out = tmp_path / "hero.usda", tmp_path / "rigged.usda"
    stage.GetRootLayer().Export(str(source))
    character, garment, _ = read_scene(source, garment="Plane_004")
    path = garment.mesh.path
    rig = ProxyRig(path, (), np.zeros(0, int), np.zeros((0, 4, 4)), garment.skin)
    write_rigged_stage(source, Scene(character, replace(garment, classes=np.zeros(40, int)), rig), out)
    written = Usd.Stage.Open(str(out))
    prim = next(prim for prim in written.Traverse() if prim.GetName().startswith("Plane_004"))
    assert (str(prim.GetPath().GetParentPath()) == "/Hero") == bool(shared)
    if shared:  # it stays where it was
        places = [UsdGeom.XformCache(4).GetLocalToWorldTransform(each.GetPrimAtPath("/Hero/Cape/Brooch"))
                  for each in (stage, written)]  # fmt: skip
        np.testing.assert_allclose(*map(np.array, places), atol=1e-9)
    assert not UsdGeom.Xformable(prim).GetTimeSamples()
    assert not UsdGeom.Xformable(prim.GetParent()).GetTimeSamples()
    for code in (1, 4):
        cape = stage.GetPrimAtPath("/Hero/Cape/Plane_004")
        place = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(cape)).T
        there = moved(place, np.array(UsdGeom.Mesh(cape).GetPointsAttr().Get()))
        np.testing.assert_allclose(usdskel_points(written, str(prim.GetPath()), [code])[0], there, atol=2e-5)
