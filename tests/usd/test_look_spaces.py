# SPDX-License-Identifier: Apache-2.0
"""Of a look: what is said in a mesh's own space, in the colour space of a prim above, and parts nobody writes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade
from ssilk_usd.reading.scene import read_scene
from ssilk_usd.writing.look_spaces import similarity
from ssilk_usd.writing.rig import write_rigged_stage

from .test_look import TINT, dressed, hero, scene_of, shoot, worn

__all__ = ["hero"]  # the fixture
FIRST = Usd.TimeCode.EarliestTime()


def with_places(stage: Usd.Stage, path: str) -> None:
    """Give a mesh a rest shape, directions and a pivot in its own space, by USD's roles, and numbers without one."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
    api, points = UsdGeom.PrimvarsAPI(mesh), mesh.GetPointsAttr().Get()
    api.CreatePrimvar("rest", TINT.Point3fArray, "vertex").Set(points)
    api.CreatePrimvar("groom", TINT.Vector3fArray, "vertex").Set([Gf.Vec3f(0, 0, 2)] * len(points))
    api.CreatePrimvar("facing", TINT.Normal3fArray, "vertex").Set([Gf.Vec3f(0, 0, 1)] * len(points))
    api.CreatePrimvar("pivot", TINT.Point3d, "constant").Set(Gf.Vec3d(points[6]))
    api.CreatePrimvar("tint", TINT.Color3f, "constant").Set(Gf.Vec3f(0.1, 0.2, 0.3))


def need_places(prim: Usd.Prim, up: list[float], scale: float) -> None:
    """Check that all of that is said in the space of the written points."""
    points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(FIRST))
    found = {
        name: prim.GetAttribute(f"primvars:{name}").Get() for name in ("rest", "groom", "facing", "pivot", "tint")
    }
    assert np.ptp(points, axis=0).max() == pytest.approx(4 * scale, rel=1e-5)
    np.testing.assert_allclose(found["rest"], points, atol=1e-6 * scale)
    np.testing.assert_allclose(found["pivot"], points[6], atol=1e-6 * scale)
    np.testing.assert_allclose(found["groom"][3], np.array(up) * 2 * scale, atol=1e-6 * scale)
    np.testing.assert_allclose(found["facing"][3], up, atol=1e-6)
    np.testing.assert_allclose(found["tint"], [0.1, 0.2, 0.3], atol=1e-6)


def test_places_and_directions_of_a_look_are_in_the_units_and_axes_of_the_shot(hero, tmp_path):
    stage = Usd.Stage.Open(str(hero))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Z")
    with_places(stage, "/Hero/Cape")
    stage.Save()
    summary = shoot(worn(hero), tmp_path / "shot.usda")
    assert summary.left_out == ""
    shot = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    need_places(shot.GetPrimAtPath("/Hero/Cape"), [0, 1, 0], 0.01)


def own_file(hero: Path, folder: Path) -> Path:
    """Put the cape into a file of its own, in centimetres."""
    path = folder / "cape.usda"
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Y")
    dressed(stage, "/Cape", 10.0)
    with_places(stage, "/Cape")
    stage.Save()
    character = Usd.Stage.Open(str(hero))
    character.RemovePrim("/Hero/Cape")
    character.Save()
    return path


def test_places_and_directions_of_a_garment_in_other_units_come_along_into_the_rig(hero, tmp_path):
    cape = own_file(hero, tmp_path)
    character, garment, _ = read_scene(str(hero), garment=f"{cape}:/Cape")
    out = tmp_path / "rigged.usda"
    assert write_rigged_stage(str(hero), scene_of(character, garment), out) == ""
    stage = Usd.Stage.Open(str(out))
    need_places(stage.GetPrimAtPath("/Hero/Cape"), [0, 0, 1], 0.01)


def test_places_of_a_garment_that_has_another_shape_now_are_told(hero, tmp_path):
    cape = own_file(hero, tmp_path)
    character, garment, _ = read_scene(str(hero), garment=f"{cape}:/Cape")
    points = garment.mesh.points * [1.0, 1.3, 1.0]
    garment = replace(garment, mesh=replace(garment.mesh, points=points))
    told = write_rigged_stage(str(hero), scene_of(character, garment), tmp_path / "rigged.usda")
    assert "the place of primvars:rest, which is of another shape" in told


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("flat", [False, True])
def test_what_moves_points_onto_others_is_found(flat, mirrored):
    rng = np.random.default_rng(4)
    points = rng.normal(size=(30, 3)) * [1, 1, not flat]
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn)) * (-1 if mirrored else 1)
    moved = points @ (0.01 * turn).T + [3.0, 2.0, 1.0]
    found = similarity(points, moved)
    np.testing.assert_allclose(points @ found[:3, :3].T + found[:3, 3], moved, atol=1e-9)
    if not flat:
        np.testing.assert_allclose(found[:3, :3], 0.01 * turn, atol=1e-9)
    assert flat <= (np.linalg.det(found[:3, :3]) > 0)
    assert similarity(points, moved * [1.0, 1.2, 1.0]) is None


@pytest.mark.skipif(not hasattr(Usd, "ColorSpaceAPI"), reason="this USD knows no colour spaces")
@pytest.mark.parametrize("above", ["/Looks", "/Hero"])
def test_colours_keep_the_colour_space_that_a_prim_above_says(hero, tmp_path, above):
    stage = Usd.Stage.Open(str(hero))
    Usd.ColorSpaceAPI.Apply(stage.GetPrimAtPath(above)).CreateColorSpaceNameAttr("lin_ap1_scene")
    stage.Save()
    shoot(worn(hero), tmp_path / "shot.usda")
    spaces = []
    for read in (Usd.Stage.Open(str(hero)), Usd.Stage.Open(str(tmp_path / "shot.usda"))):
        cape = read.GetPrimAtPath("/Hero/Cape")
        bound, _ = UsdShade.MaterialBindingAPI(cape).ComputeBoundMaterial()
        prims = (cape, bound.ComputeSurfaceSource()[0].GetPrim())
        spaces.append([Usd.ColorSpaceAPI.ComputeColorSpaceName(prim, None) for prim in prims])
    assert spaces[0] == spaces[1] and "lin_ap1_scene" in spaces[0]


def with_parts(stage: Usd.Stage) -> None:
    """Hair curves, an eye that no joint moves, buttons; a guide and another garment, which nobody misses."""
    UsdGeom.BasisCurves.Define(stage, "/Hero/Hair")
    dressed(stage, "/Hero/Eye", 0.4)
    UsdGeom.PointInstancer.Define(stage, "/Hero/Buttons")
    UsdGeom.Sphere.Define(stage, "/Hero/Buttons/Button")
    UsdGeom.Sphere.Define(stage, "/Hero/Handle").CreatePurposeAttr("guide")
    dressed(stage, "/Hero/Skirt", 0.2).GetPrim().CreateAttribute("ssilk:garment", TINT.Bool).Set(True)


def test_parts_of_a_character_that_a_shot_lacks_are_told(hero, tmp_path):
    stage = Usd.Stage.Open(str(hero))
    with_parts(stage)
    stage.Save()
    character, garment, _ = read_scene(str(hero), garment="/Hero/Cape")
    from ssilk_core.scene.kinematics import lbs_deformer

    deformer = lbs_deformer(scene_of(character, garment))
    told = shoot(deformer, tmp_path / "shot.usda").left_out
    assert told == "Hero loses the BasisCurves Hair, the Mesh Eye, the PointInstancer Buttons"
    assert shoot(deformer, tmp_path / "alone.usda", include_body=False).left_out == ""


@pytest.mark.parametrize("name", ["CapeRed", "Cape"])
def test_a_look_that_could_be_anothers_is_told(hero, tmp_path, name):
    """Two colours of one cape, of which neither is where the garment was when it was trained."""
    deformer, stage = worn(hero), Usd.Stage.Open(str(hero))
    for one in (name, "CapeBlue"):
        mesh = dressed(stage, f"/Hero/Colours/{one}", 0.1)
        mesh.GetPrim().CreateAttribute("ssilk:garment", TINT.Bool).Set(True)
    stage.RemovePrim("/Hero/Cape")
    stage.Save()
    told = shoot(deformer, tmp_path / "shot.usda").left_out
    twin = "/Hero/Colours/CapeBlue has the same polygons"
    assert told == (
        "" if name == "Cape" else f"Cape loses its look, unless it is that of /Hero/Colours/{name}: {twin}"
    )
    assert Sdf.Layer.FindOrOpen(str(tmp_path / "shot.usda")).GetPrimAtPath("/Hero/Looks")
