# SPDX-License-Identifier: Apache-2.0
"""Repaired copies: everything on a mesh follows its vertices and faces, and nothing else is lost."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, Vt
from ssilk_usd.reading.facts import animated, stage_facts
from ssilk_usd.reading.garment import read_garment
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.units import StageUnits
from ssilk_usd.writing.repair import repair_lock, write_repaired, write_with_units
from ssilk_usd.writing.repair_mesh import offset_points

from ssilk_core.authoring.preflight.repair import MeshRepair
from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import Skeleton

SKELETON = Skeleton("/Rig", ("Hips", "Hips/Spine"), [-1, 0], *[np.tile(np.eye(4), (2, 1, 1))] * 2)
# Two quads that meet at points 1, 2 and 4, 7 without being sewn, a lone point 8, and a second copy of the first quad.
CAPE = """#usda 1.0
( metersPerUnit = 0.01; upAxis = "Z"; customLayerData = { string maker = "tailor" } )
def Xform "Wardrobe" (customData = { string note = "keep" })
{
    double3 xformOp:rotateXYZ = (0, 0, 90)
    uniform token[] xformOpOrder = ["xformOp:rotateXYZ"]
    def Mesh "Cape" (prepend apiSchemas = ["SkelBindingAPI"])
    {
        uniform token orientation = "ORIENT"
        point3f[] points = [(0,0,0), (10,0,0), (10,10,0), (0,10,0), (10,0,0), (20,0,0), (20,10,0), (10,10,0), (5,5,5)]
        float3[] extent = [(0,0,0), (20,10,5)]
        int[] faceVertexCounts = [4, 4, 4]
        int[] faceVertexIndices = [0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3]
        normal3f[] normals = [(0,0,1), (0,0,1), (0,0,1), (0,0,1), (0,0,1), (0,0,1), (0,0,1), (0,0,1), (0,0,1)]
        texCoord2f[] primvars:st = [(0,0), (.5,0), (.5,1), (0,1), (.6,0), (1,0), (1,1), (.6,1), (9,9)] (
            interpolation = "vertex")
        color3f[] primvars:displayColor = [(1,0,0), (0,1,0), (0,0,1)] (interpolation = "uniform")
        float[] primvars:weave = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11] (interpolation = "faceVarying")
        string[] primvars:thread = ["silk", "wool"] (interpolation = "vertex")
        int[] primvars:thread:indices = [0, 0, 1, 0, 0, 0, 0, 1, 0]
        float primvars:age = 3 (interpolation = "constant")
        int[] primvars:ssilk:class = [0, 1, 2, 0, 1, 2, 2, 2, 2] (interpolation = "vertex")
        uniform token[] skel:joints = ["Hips", "Hips/Spine"]
        int[] primvars:skel:jointIndices = [0,1, 0,1, 0,1, 0,1, 0,1, 0,1, 0,1, 0,1, 0,1] (
            interpolation = "vertex"; elementSize = 2)
        float[] primvars:skel:jointWeights = [1,0, .5,.5, .2,.8, 1,0, .5,.5, 0,1, 0,1, .2,.8, 1,0] (
            interpolation = "vertex"; elementSize = 2)
        vector3f[] velocities.timeSamples = {
            1: [(0,0,0), (1,0,0), (2,0,0), (3,0,0), (4,0,0), (5,0,0), (6,0,0), (7,0,0), (8,0,0)] }
        def GeomSubset "Right"
        {
            uniform token elementType = "face"
            int[] indices = [1, 2]
        }
        def GeomSubset "Rim"
        {
            uniform token elementType = "point"
            int[] indices = [0, 4, 7, 8]
        }
    }
    def Mesh "Button" { point3f[] points = [(0,0,0), (1,0,0), (0,1,0)]
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
    }
}
"""
CORNERS = [0, 1, 2, 3, 4, 5, 6, 7]
ORIGINAL = np.array(
    [(0, 0, 0), (10, 0, 0), (10, 10, 0), (0, 10, 0), (10, 0, 0), (20, 0, 0), (20, 10, 0), (10, 10, 0), (5, 5, 5)]
)
NEW = np.array([0, 1, 2, 3, 1, 4, 5, 2, -1])  # which new point each old one becomes


def plan(*, flipped: tuple[bool, bool] = (False, False), offsets=0.0) -> MeshRepair:
    """Sew the seam, drop the lone point and the second copy."""
    corners = np.concatenate([np.arange(4 * n, 4 * n + 4)[:: -1 if flip else 1] for n, flip in enumerate(flipped)])
    return MeshRepair(
        kept=np.array([0, 1, 2, 3, 5, 6]), new_index=NEW, polygons=np.array([0, 1]), corners=corners,
        counts=np.array([4, 4]), flipped=np.array(flipped), offsets=np.zeros((6, 3)) + offsets, done=(),
    )  # fmt: skip


def cape(folder: Path, orientation: str = "rightHanded", more: str = "") -> Path:
    path = folder / "cape.usda"
    text = CAPE.replace("ORIENT", orientation)
    path.write_text(text.replace("float primvars:age", f"{more}\n        float primvars:age"))
    return path


def repaired(path: Path, repair: MeshRepair) -> Usd.Stage:
    out = path.parent / "repaired.usdc"
    write_repaired(path, out, repair, garment="Cape")
    return Usd.Stage.Open(str(out))


def primvar(mesh: Usd.Prim, name: str) -> tuple[str, list]:
    """Interpolation and flattened values."""
    chosen = UsdGeom.PrimvarsAPI(mesh).GetPrimvar(name)
    return chosen.GetInterpolation(), np.array(chosen.ComputeFlattened()).tolist()


def test_all_data_follows_the_points_and_faces_that_stay(tmp_path):
    stage = repaired(cape(tmp_path), plan())
    mesh = stage.GetPrimAtPath("/Wardrobe/Cape")
    geometry = UsdGeom.Mesh(mesh)
    assert list(geometry.GetFaceVertexIndicesAttr().Get()) == NEW[CORNERS].tolist()
    assert list(geometry.GetFaceVertexCountsAttr().Get()) == [4, 4]
    assert np.array(geometry.GetPointsAttr().Get())[:, 0].tolist() == [0, 10, 10, 0, 20, 20]
    assert primvar(mesh, "ssilk:class") == ("vertex", [0, 1, 2, 0, 2, 2])
    assert primvar(mesh, "skel:jointIndices") == ("vertex", [0, 1] * 6)
    weights = primvar(mesh, "skel:jointWeights")[1]
    assert np.allclose(weights, [1, 0, 0.5, 0.5, 0.2, 0.8, 1, 0, 0, 1, 0, 1])
    assert UsdGeom.PrimvarsAPI(mesh).GetPrimvar("skel:jointWeights").GetElementSize() == 2
    assert primvar(mesh, "displayColor") == ("uniform", [[1, 0, 0], [0, 1, 0]])
    assert primvar(mesh, "weave") == ("faceVarying", CORNERS)
    assert primvar(mesh, "thread") == ("vertex", ["silk", "silk", "wool", "silk", "silk", "silk"])
    assert primvar(mesh, "age") == ("constant", 3.0)
    assert np.array(geometry.GetVelocitiesAttr().Get(1))[:, 0].tolist() == [0, 1, 2, 3, 5, 6]
    assert list(UsdGeom.Subset(mesh.GetChild("Right")).GetIndicesAttr().Get()) == [1]
    assert list(UsdGeom.Subset(mesh.GetChild("Rim")).GetIndicesAttr().Get()) == [0, 1, 2]


def test_texture_coordinates_that_differ_across_a_seam_move_to_the_corners(tmp_path):
    path = cape(tmp_path)
    before = read_garment(path, SKELETON, garment="Cape").mesh.uvs[:8]
    stage = repaired(path, plan())
    kind, after = primvar(stage.GetPrimAtPath("/Wardrobe/Cape"), "st")
    assert kind == "faceVarying" and np.array_equal(np.array(after, dtype=np.float32), before)


def test_the_rest_of_the_file_is_kept(tmp_path):
    stage = repaired(cape(tmp_path), plan())
    assert stage.GetRootLayer().customLayerData["maker"] == "tailor"
    assert stage.GetPrimAtPath("/Wardrobe").GetCustomDataByKey("note") == "keep"
    assert len(UsdGeom.Mesh(stage.GetPrimAtPath("/Wardrobe/Button")).GetPointsAttr().Get()) == 3
    assert stage_facts(stage).units == StageUnits(0.01, "Z")


@pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
def test_faces_turn_over_with_their_normals_and_corners(tmp_path, orientation):
    path = cape(tmp_path, orientation)
    before = read_garment(path, SKELETON, garment="Cape").mesh
    stage = repaired(path, plan(flipped=(False, True)))
    after = read_garment(stage, SKELETON, garment="Cape").mesh
    kept = np.r_[0:4, 7, 6, 5, 4]
    assert np.array_equal(after.points[after.polygon_indices], before.points[before.polygon_indices[kept]])
    assert np.array_equal(after.uvs, before.uvs[kept])
    normals = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/Wardrobe/Cape")).GetNormalsAttr().Get())
    assert normals[:, 2].tolist() == [1, -1, -1, 1, -1, -1]


def test_points_move_by_metres_of_the_world(tmp_path):
    path = cape(tmp_path)
    before = read_garment(path, SKELETON, garment="Cape").mesh.points
    stage = repaired(path, plan(offsets=[0.01, 0.02, -0.03]))
    after = read_garment(stage, SKELETON, garment="Cape").mesh.points
    assert np.allclose(after, before[[0, 1, 2, 3, 5, 6]] + [0.01, 0.02, -0.03], atol=1e-7)
    extent = UsdGeom.Mesh(stage.GetPrimAtPath("/Wardrobe/Cape")).GetExtentAttr().Get()
    points = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/Wardrobe/Cape")).GetPointsAttr().Get())
    assert np.allclose(extent, [points.min(axis=0), points.max(axis=0)])


def test_a_mesh_that_keeps_its_shape_keeps_its_holes(tmp_path):
    path = cape(tmp_path, more="int[] holeIndices = [2]")
    assert repair_lock(path, "Cape") == "holes" and repair_lock(path, "Button") == ""
    every = np.arange(9)
    moved = replace(plan(), kept=every, new_index=every, offsets=np.full((9, 3), 0.01), reshapes=False)
    stage = repaired(path, moved)
    geometry = UsdGeom.Mesh(stage.GetPrimAtPath("/Wardrobe/Cape"))
    assert len(geometry.GetFaceVertexCountsAttr().Get()) == 3 and list(geometry.GetHoleIndicesAttr().Get()) == [2]
    points = np.array(geometry.GetPointsAttr().Get())
    assert not np.allclose(points[0], 0) and np.allclose(points - points[0], ORIGINAL, atol=1e-5)


def test_an_instanced_garment_is_repaired_in_the_copy(tmp_path):
    cape(tmp_path)
    shot = tmp_path / "set.usda"
    shot.write_text('#usda 1.0\n( metersPerUnit = 0.01; upAxis = "Z" )\n'
                    'def Xform "A" (instanceable = true; references = @cape.usda@</Wardrobe>) {}\n')  # fmt: skip
    stage = repaired(shot, plan())
    assert len(UsdGeom.Mesh(stage.GetPrimAtPath("/A/Cape")).GetPointsAttr().Get()) == 6


def test_a_primvar_that_does_not_match_is_named_and_nothing_is_written(tmp_path):
    path = cape(tmp_path, more='float[] primvars:odd = [1, 2] (interpolation = "vertex")')
    with pytest.raises(SsilkError, match=r"/Wardrobe/Cape: primvars:odd holds 2 values for 9 x 1"):
        write_repaired(path, tmp_path / "out.usda", plan(), garment="Cape")
    assert [file.name for file in tmp_path.iterdir()] == ["cape.usda"]


def test_units_are_stated(tmp_path):
    path = tmp_path / "bare.usda"
    path.write_text('#usda 1.0\ndef Mesh "M" {}\n')
    facts = stage_facts(path)
    assert not facts.meters_authored and not facts.axis_authored and facts.units == StageUnits(0.01, "Y")
    write_with_units(path, tmp_path / "out.usda", StageUnits(1.0, "Z"))
    after = stage_facts(tmp_path / "out.usda")
    assert after.meters_authored and after.axis_authored and after.units == StageUnits(1.0, "Z")
    with pytest.raises(SsilkError, match=r"out\.obj: the suffix is '\.obj'; it must be one of"):
        write_with_units(path, tmp_path / "out.obj", StageUnits())


def test_what_a_motion_file_animates_and_when(tmp_path):
    path = tmp_path / "walk.usda"
    path.write_text("""#usda 1.0
( metersPerUnit = 1; timeCodesPerSecond = 24 )
def SkelAnimation "Walk"
{
    uniform token[] joints = ["Spine"]
    quatf[] rotations.timeSamples = { 0: [(1,0,0,0)], 12: [(1,0,0,0)], 48: [(1,0,0,0)] }
    float3[] translations = [(0,0,0)]
    half3[] scales = [(1,1,1)]
}
""")
    joints, times = animated(read_motion(path, SKELETON), SKELETON)
    assert joints.tolist() == [1] and times.tolist() == [0, 0.5, 2]


@pytest.mark.parametrize("moves", [False, True])
def test_normals_of_another_shape_are_dropped_and_those_of_unmoved_points_kept(moves):
    stage = Usd.Stage.CreateInMemory()
    mesh = UsdGeom.Mesh.Define(stage, "/Cloth")
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    up = Vt.Vec3fArray([(0, 0, 1)])
    mesh.CreateNormalsAttr(up)
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, "vertex")
    primvar.Set(up)
    primvar.SetIndices(Vt.IntArray([0, 0, 0]))
    offset_points(mesh, np.array([[0, 0, moves], [0, 0, 0], [0, 0, 0]], dtype=float))
    assert (mesh.GetNormalsAttr().Get() is None) == moves == (primvar.ComputeFlattened() is None)
    assert mesh.GetPointsAttr().Get()[0][2] == moves
