# SPDX-License-Identifier: Apache-2.0
"""Rigs keep what their garment is made of, wherever its physics material was said and wherever the mesh ends."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdShade
from ssilk_usd.reading.scene import read_scene
from ssilk_usd.writing.rig import write_rigged_stage

from ssilk_core.scene.assets import Garment, ProxyRig, Scene, SkinWeights
from ssilk_core.scene.fabrics import fabric_of_surface

HEADER = '#usda 1.0\n( metersPerUnit = 1; upAxis = "Y" )\n'
HERO = """
def SkelRoot "Hero" (prepend apiSchemas = ["SkelBindingAPI", "MaterialBindingAPI", "PhysicsDeformableBodyAPI"])
{
    rel skel:skeleton = </Hero/Rig>
    rel material:binding:physics = </Skin>
    float physics:mass = 80
    def Skeleton "Rig"
    {
        uniform token[] joints = ["Hips"]
        uniform matrix4d[] bindTransforms = [((1,0,0,0), (0,1,0,0), (0,0,1,0), (0,1,0,1))]
        uniform matrix4d[] restTransforms = [((1,0,0,0), (0,1,0,0), (0,0,1,0), (0,1,0,1))]
    }
    def Mesh "Body" (prepend apiSchemas = ["SkelBindingAPI"])
    {
        point3f[] points = [(0,0,0), (1,0,0), (1,2,0), (0,2,0)]
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        int[] primvars:skel:jointIndices = [0, 0, 0, 0] (interpolation = "vertex"; elementSize = 1)
        float[] primvars:skel:jointWeights = [1, 1, 1, 1] (interpolation = "vertex"; elementSize = 1)
    }
}
def Material "Skin"
{
    float physics:youngsModulus = 5e4
}
"""
LINEN = """
def Material "Linen"
{
    float physics:youngsModulus = 2e5
    float physics:surfaceBendStiffness = 3e-6
}
"""
BOUND, THIN = "rel material:binding:physics = </Linen>\n", "float[] physics:thicknesses = [0.0006]\n"
MASS = "float physics:mass = 0.3\n"
CAPE = """
def Xform "Set" (prepend apiSchemas = ["PhysicsDeformableBodyAPI"])
{
    ABOVE
    def Mesh "Cape"
    {
        bool ssilk:garment = 1
        ON_MESH
        point3f[] points = [(0,0,0.1), (1,0,0.1), (1,1,0.1), (0,1,0.1)]
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
    }
}
"""


def write(folder: Path, above: str, on_mesh: str, *, own_file: bool) -> tuple[Path, str]:
    """Write a character whose SkelRoot is a body of skin, and a cape beside it or in its own file."""
    cape, stage = LINEN + CAPE.replace("ABOVE", above).replace("ON_MESH", on_mesh), folder / "hero.usda"
    (folder / "cape.usda").write_text(HEADER + cape)
    stage.write_text(HEADER + HERO + ("" if own_file else cape))
    return stage, str(folder / "cape.usda") if own_file else "Cape"


def rig(source: Path, garment: str | None, out: Path, moved: np.ndarray | None = None) -> Garment:
    """Rig the cape to the hips and a proxy, moved as settling does; return the garment as it was read."""
    character, read, _ = read_scene(source, garment=garment)
    mesh, path = read.mesh, read.mesh.path
    skin, bind = SkinWeights.from_dense(path, np.ones((4, 1))), np.eye(4)[None]
    proxies = ProxyRig(path, ("cape_0",), np.array([0]), bind, SkinWeights.from_dense(path, np.eye(2)[[0, 1, 1, 0]]))
    if moved is not None:
        mesh = replace(mesh, points=mesh.points + moved)
    scene = Scene(character, replace(read, mesh=mesh, skin=skin, classes=np.array([0, 2, 2, 0])), proxies)
    write_rigged_stage(source, scene, out, moved=moved)
    return read


def materials(file: Path) -> list[str]:
    stage = Usd.Stage.Open(str(file))
    return [prim.GetName() for prim in stage.TraverseAll() if prim.IsA(UsdShade.Material)]


@pytest.mark.parametrize("own_file", [False, True])
@pytest.mark.parametrize(("above", "on_mesh"), [(BOUND, THIN), (MASS, BOUND), (MASS, BOUND + THIN), ("", THIN)])
def test_a_rig_is_made_of_what_was_announced(above, on_mesh, own_file, tmp_path):
    source, garment = write(tmp_path, above, on_mesh, own_file=own_file)
    told = fabric_of_surface(rig(source, garment, tmp_path / "out.usda").surface)
    read = fabric_of_surface(read_scene(tmp_path / "out.usda")[1].surface)
    for name in ("density", "thickness", "lame_mu", "lame_lambda", "bending"):
        assert getattr(read, name) == pytest.approx(getattr(told, name), rel=1e-6), name
    rig(tmp_path / "out.usda", None, tmp_path / "again.usda")
    assert materials(tmp_path / "again.usda") == materials(tmp_path / "out.usda")


@pytest.mark.parametrize("own_file", [False, True])
def test_a_garment_without_a_physics_material_takes_none_from_the_body(own_file, tmp_path):
    source, garment = write(tmp_path, "", "", own_file=own_file)
    assert rig(source, garment, tmp_path / "out.usda").surface is None
    read = read_scene(tmp_path / "out.usda")[1]
    assert read.surface is None
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    mesh = stage.GetPrimAtPath(read.mesh.path.rpartition(":")[2])
    bound, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial("physics")
    assert bound and not bound.GetPrim().GetAuthoredAttributes()
    rig(tmp_path / "out.usda", None, tmp_path / "again.usda")
    assert materials(tmp_path / "again.usda") == materials(tmp_path / "out.usda")


def test_a_mass_of_the_mesh_stays_its_mass_where_settling_changes_its_area(tmp_path):
    source, garment = write(tmp_path, "", THIN + "float[] physics:masses = [0.3]", own_file=False)
    text = source.read_text().replace("rel material:binding:physics = </Skin>", "")
    source.write_text(text)
    moved = np.array([[0, 0, 0], [0.5, 0, 0], [0.5, 0, 0], [0, 0, 0]])
    assert rig(source, garment, tmp_path / "out.usda", moved).surface.area_density == pytest.approx(0.3)
    assert read_scene(tmp_path / "out.usda")[1].surface.area_density == pytest.approx(0.3 / 1.5)
    assert materials(tmp_path / "out.usda") == materials(source)
