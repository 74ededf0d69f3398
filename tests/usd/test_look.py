# SPDX-License-Identifier: Apache-2.0
"""What look development puts on meshes comes through rigs and shots, or is told by name."""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdSkel, UsdUtils
from ssilk_usd.checking.shot import check_shot
from ssilk_usd.reading.mesh import read_mesh
from ssilk_usd.reading.scene import read_scene
from ssilk_usd.shots.shot import ShotSummary, write_shot
from ssilk_usd.units import StageUnits
from ssilk_usd.writing.body_faces import BODY, COVERED_HIDDEN, FULL, HiddenPolygons
from ssilk_usd.writing.export import packaged
from ssilk_usd.writing.rig import write_rigged_stage

from ssilk_core.scene.assets import Character, Deformer, Garment, Motion, ProxyRig, Scene, SkinWeights
from ssilk_core.scene.kinematics import lbs_deformer, lbs_poses

METRES = StageUnits(1.0, "Y")
COLUMNS, ROWS = 4, 3
TINT = Sdf.ValueTypeNames


def material(stage: Usd.Stage, path: str, uv_set: str) -> UsdShade.Material:
    """A network: a texture, looked up by a UV set, that colours a surface."""
    found = UsdShade.Material.Define(stage, path)
    reader, texture, surface = (
        UsdShade.Shader.Define(stage, f"{path}/{name}") for name in ("Reader", "Texture", "Surface")
    )
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", TINT.String).Set(uv_set)
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", TINT.Asset).Set(Sdf.AssetPath("./textures/linen.png"))
    texture.CreateInput("st", TINT.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("diffuseColor", TINT.Color3f).ConnectToSource(texture.ConnectableAPI(), "rgb")
    found.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    return found


def dressed(stage: Usd.Stage, path: str, depth: float) -> UsdGeom.Mesh:
    """A grid of quads with all that look development knows."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    x, y = np.meshgrid(np.arange(COLUMNS + 1.0), np.arange(ROWS + 1.0))
    mesh.CreatePointsAttr([Gf.Vec3f(a, b, depth) for a, b in zip(x.ravel().tolist(), y.ravel().tolist())])
    corner = (np.arange(ROWS)[:, None] * (COLUMNS + 1) + np.arange(COLUMNS)).ravel()
    quads = corner[:, None] + [0, 1, COLUMNS + 2, COLUMNS + 1]
    mesh.CreateFaceVertexCountsAttr([4] * len(quads))
    mesh.CreateFaceVertexIndicesAttr(quads.ravel().tolist())
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateSubdivisionSchemeAttr("catmullClark")
    mesh.CreateInterpolateBoundaryAttr("edgeOnly")
    mesh.CreateCreaseIndicesAttr([0, 1])
    mesh.CreateCreaseLengthsAttr([2])
    mesh.CreateCreaseSharpnessesAttr([3.0])
    api = UsdGeom.PrimvarsAPI(mesh)
    for name, start in (("lightmap", 500), ("map1", 0)):
        values = [Gf.Vec2f(start + i, start - i) for i in range(4 * len(quads))]
        api.CreatePrimvar(name, TINT.TexCoord2fArray, "faceVarying").Set(values)
    dye = api.CreatePrimvar("dye", TINT.FloatArray, "uniform")
    dye.Set([0.25, 0.5, 0.75])
    dye.SetIndices([face % 3 for face in range(len(quads))])
    api.CreatePrimvar("wear", TINT.FloatArray, "vertex").Set([float(i) for i in range(x.size)])
    prim = mesh.GetPrim()
    prim.CreateAttribute("userProperties:asset_id", TINT.String).Set("cape_0042")
    prim.SetCustomDataByKey("department", "cloth")
    name = prim.GetName()
    cloth, trim = (material(stage, f"/Looks/{name}_{part}", "map1") for part in ("cloth", "trim"))
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(cloth)
    subset = UsdShade.MaterialBindingAPI(prim).CreateMaterialBindSubset("trim", [0, 5, 7])
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(trim)
    return mesh


@pytest.fixture
def hero(tmp_path: Path) -> Path:
    path = tmp_path / "assets" / "hero.usda"
    (path.parent / "textures").mkdir(parents=True)
    (path.parent / "textures" / "linen.png").write_bytes(b"linen")
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    root = UsdSkel.Root.Define(stage, "/Hero")
    rig = UsdSkel.Skeleton.Define(stage, "/Hero/Rig")
    rig.CreateJointsAttr(["Hips"])
    rig.CreateBindTransformsAttr([Gf.Matrix4d(1)])
    rig.CreateRestTransformsAttr([Gf.Matrix4d(1)])
    UsdSkel.BindingAPI.Apply(root.GetPrim()).CreateSkeletonRel().SetTargets([rig.GetPath()])
    for name, depth in (("Body", 0.0), ("Cape", 0.1)):
        binding = UsdSkel.BindingAPI.Apply(dressed(stage, f"/Hero/{name}", depth).GetPrim())
        binding.CreateJointIndicesPrimvar(True, 1).Set([0])
        binding.CreateJointWeightsPrimvar(True, 1).Set([1.0])
    stage.GetPrimAtPath("/Hero/Cape").CreateAttribute("ssilk:garment", TINT.Bool).Set(True)
    stage.Save()
    return path


def scene_of(character: Character, garment: Garment) -> Scene:
    count = garment.mesh.vertex_count
    skin = garment.skin or SkinWeights.rigid(garment.mesh.path, 0, count)
    rig = ProxyRig(garment.mesh.path, (), np.zeros(0, dtype=int), np.zeros((0, 4, 4)), skin)
    return Scene(character, replace(garment, skin=skin, classes=np.ones(count, dtype=int)), rig)


def worn(hero: Path) -> Deformer:
    character, garment, _ = read_scene(str(hero))
    return lbs_deformer(scene_of(character, garment))


def shoot(deformer: Deformer, path: Path, **more: object) -> ShotSummary:
    motion = Motion("still", 30.0, np.tile([1.0, 0, 0, 0], (2, 1, 1)), np.zeros((2, 1, 3)))
    return write_shot(path, deformer, motion, lbs_poses(2), units=METRES, **more)  # type: ignore[arg-type]


def look(stage: Usd.Stage, path: str) -> dict[str, object]:
    """All of the look as USD evaluates it: values at faces and corners, materials of all faces, textures."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
    prim, api = mesh.GetPrim(), UsdGeom.PrimvarsAPI(mesh)
    names = ("doubleSided", "subdivisionScheme", "interpolateBoundary", "creaseIndices", "creaseLengths",
             "creaseSharpnesses", "userProperties:asset_id")  # fmt: skip
    found: dict[str, object] = {name: prim.GetAttribute(name).Get() for name in names}
    for primvar in api.GetPrimvarsWithValues():
        if not primvar.GetPrimvarName().startswith(("skel:", "ssilk:")):
            values = np.array(primvar.ComputeFlattened()).tolist()
            found[primvar.GetPrimvarName()] = (str(primvar.GetInterpolation()), values)
    found["department"] = prim.GetCustomDataByKey("department")
    subsets = UsdShade.MaterialBindingAPI(mesh).GetMaterialBindSubsets()
    found["subsets"] = {subset.GetPrim().GetName(): list(subset.GetIndicesAttr().Get()) for subset in subsets}
    for holder in (prim, *(subset.GetPrim() for subset in subsets)):
        bound, _ = UsdShade.MaterialBindingAPI(holder).ComputeBoundMaterial()
        surface, _, _ = bound.ComputeSurfaceSource()
        texture = UsdShade.Shader(surface.GetInput("diffuseColor").GetConnectedSources()[0][0].source.GetPrim())
        file = texture.GetInput("file").Get()
        found[f"material of {holder.GetName()}"] = (bound.GetPrim().GetName(), Path(file.resolvedPath).name)
    return found


def test_a_shot_keeps_the_look_of_body_and_garment(hero, tmp_path):
    summary = shoot(worn(hero), tmp_path / "shots" / "shot.usdc")
    assert summary.left_out == ""
    before, after = Usd.Stage.Open(str(hero)), Usd.Stage.Open(str(tmp_path / "shots" / "shot.usdc"))
    for name in ("Cape", "Body"):
        assert look(after, f"/Hero/{name}") == look(before, f"/Hero/{name}")
    file = after.GetPrimAtPath("/Hero/Looks/Cape_trim/Texture").GetAttribute("inputs:file").Get()
    assert file.path == "../assets/textures/linen.png"


def test_faces_that_are_read_otherwise_keep_their_own_values(hero, tmp_path):
    """A hole is left out, and faces that wind the other way are turned, with all that belongs to them."""
    stage = Usd.Stage.Open(str(hero))
    cape = UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Cape"))
    cape.CreateHoleIndicesAttr([2, 6])
    cape.CreateOrientationAttr("leftHanded")
    stage.Save()
    shoot(worn(hero), tmp_path / "shot.usda")
    shot = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    after = UsdGeom.Mesh(shot.GetPrimAtPath("/Hero/Cape"))
    api = {prim: UsdGeom.PrimvarsAPI(prim) for prim in (cape, after)}
    kept = [face for face in range(COLUMNS * ROWS) if face not in (2, 6)]
    dye = {prim: np.array(api[prim].GetPrimvar("dye").ComputeFlattened()) for prim in api}
    np.testing.assert_array_equal(dye[after], dye[cape][kept])

    def pairs(prim: UsdGeom.Mesh, faces: list[int]) -> set[tuple[int, float]]:
        """Points and what `map1` says of them, face by face."""
        points = np.array(prim.GetFaceVertexIndicesAttr().Get()).reshape(-1, 4)[faces]
        values = np.array(api[prim].GetPrimvar("map1").ComputeFlattened())[:, 0].reshape(-1, 4)[faces]
        return set(zip(points.ravel().tolist(), values.ravel().tolist()))

    assert pairs(after, list(range(len(kept)))) == pairs(cape, kept)
    subset = UsdShade.MaterialBindingAPI(after).GetMaterialBindSubsets()[0]
    assert [kept[index] for index in subset.GetIndicesAttr().Get()] == [0, 5, 7]


@pytest.mark.parametrize("variants", [True, False])
def test_hidden_faces_take_what_belongs_to_them_along(hero, tmp_path, variants):
    mask = np.zeros(COLUMNS * ROWS, dtype=bool)
    mask[[0, 3]] = True
    shoot(worn(hero), tmp_path / "shot.usda", hidden_polygons=HiddenPolygons((mask,), variants))
    stage, before = Usd.Stage.Open(str(tmp_path / "shot.usda")), Usd.Stage.Open(str(hero))
    body = stage.GetPrimAtPath("/Hero/Body")
    whole = look(before, "/Hero/Body")
    if variants:
        stage.GetPrimAtPath("/Hero").GetVariantSet(BODY).SetVariantSelection(FULL)
        assert look(stage, "/Hero/Body") == whole
        stage.GetPrimAtPath("/Hero").GetVariantSet(BODY).SetVariantSelection(COVERED_HIDDEN)
    found = look(stage, "/Hero/Body")
    assert len(body.GetAttribute("faceVertexCounts").Get()) == COLUMNS * ROWS - 2
    corners = np.repeat(~mask, 4)
    for name, rows in (("map1", corners), ("lightmap", corners), ("dye", ~mask)):
        np.testing.assert_array_equal(found[name][1], np.array(whole[name][1])[rows])
    assert found["subsets"] == {"trim": [3, 5]}  # of 0, 5 and 7, without the first
    assert found["wear"] == whole["wear"]


def test_a_rig_of_a_garment_from_its_own_file_keeps_its_look(hero, tmp_path):
    garment = tmp_path / "assets" / "cape.usda"
    stage = Usd.Stage.CreateNew(str(garment))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    dressed(stage, "/Wardrobe/Cloak", 0.2)
    stage.Save()
    character, read, _ = read_scene(str(hero), garment=str(garment))
    write_rigged_stage(hero, scene_of(character, read), tmp_path / "rigged.usda")
    after = Usd.Stage.Open(str(tmp_path / "rigged.usda"))
    assert look(after, "/Hero/Cloak") == look(stage, "/Wardrobe/Cloak")


def test_what_a_mesh_has_from_above_and_what_is_said_in_words_is_kept(hero, tmp_path):
    stage = Usd.Stage.Open(str(hero))
    above = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Hero"))
    above.CreatePrimvar("season", TINT.String, "constant").Set("winter")
    codes = above.CreatePrimvar("codes", TINT.IntArray, "constant")
    codes.Set([7, 8])
    codes.SetIndices([1, 0])
    cape = UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Cape"))
    cape.CreateHoleIndicesAttr([2])
    words = UsdGeom.PrimvarsAPI(cape).CreatePrimvar("panel", TINT.StringArray, "uniform")
    words.Set([f"panel {face}" for face in range(COLUMNS * ROWS)])
    UsdGeom.MotionAPI.Apply(cape.GetPrim()).CreateMotionBlurScaleAttr(0.5)
    Usd.ModelAPI(cape.GetPrim()).SetKind("subcomponent")
    stage.Save()
    summary = shoot(worn(hero), tmp_path / "shot.usda")
    assert summary.left_out == ""
    shot = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    prim = next(each for each in shot.Traverse() if each.GetName() == "Cape")
    found = UsdGeom.PrimvarsAPI(prim)
    assert found.FindPrimvarWithInheritance("season").Get() == "winter"
    assert list(found.FindPrimvarWithInheritance("codes").ComputeFlattened()) == [8, 7]
    assert list(found.GetPrimvar("panel").Get()) == [f"panel {face}" for face in range(COLUMNS * ROWS) if face != 2]
    assert prim.HasAPI(UsdGeom.MotionAPI) and Usd.ModelAPI(prim).GetKind() == "subcomponent"


def beside_the_character(hero: Path, *, skin: bool) -> None:
    """Put the cape under an Xform that says its look; `skin` is bound to the character, more strongly."""
    stage = Usd.Stage.Open(str(hero))
    top = UsdGeom.Xform.Define(stage, "/Wardrobe").GetPrim()
    edit = Sdf.BatchNamespaceEdit()
    edit.Add("/Hero/Cape", "/Wardrobe/Cape")
    assert stage.GetRootLayer().Apply(edit)
    cape = stage.GetPrimAtPath("/Wardrobe/Cape")
    for name in ("skel:jointIndices", "skel:jointWeights"):
        cape.RemoveProperty(f"primvars:{name}")
    UsdShade.MaterialBindingAPI(cape).UnbindAllBindings()
    binding = UsdShade.MaterialBindingAPI.Apply(top)
    binding.Bind(material(stage, "/Looks/Wool", "map1"))
    collection = Usd.CollectionAPI.Apply(top, "trims")
    collection.CreateIncludesRel().SetTargets(["/Wardrobe/Cape/trim"])
    binding.Bind(collection, material(stage, "/Looks/Lace", "map1"), "trims", UsdShade.Tokens.strongerThanDescendants)
    UsdGeom.PrimvarsAPI(top).CreatePrimvar("season", TINT.String, "constant").Set("winter")
    UsdGeom.Imageable(top).CreatePurposeAttr("render")
    if skin:
        bound = UsdShade.MaterialBindingAPI.Apply(stage.GetPrimAtPath("/Hero"))
        bound.Bind(material(stage, "/Looks/Skin", "map1"), UsdShade.Tokens.strongerThanDescendants)
    lights = stage.DefinePrim("/Lights")
    Usd.CollectionAPI.Apply(lights, "lit").CreateIncludesRel().SetTargets(["/Wardrobe/Cape"])
    stage.Save()


@pytest.mark.parametrize("skin", [False, True])
def test_a_rig_keeps_the_look_of_a_garment_that_moves_beneath_its_character(hero, tmp_path, skin):
    beside_the_character(hero, skin=skin)
    left = write_rigged_stage(hero, worn(hero).scene, tmp_path / "rigged.usda")
    stage = Usd.Stage.Open(str(tmp_path / "rigged.usda"))
    cape = stage.GetPrimAtPath("/Hero/Cape")
    bound = [
        UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0].GetPrim().GetName()
        for prim in (cape, stage.GetPrimAtPath("/Hero/Cape/trim"))
    ]
    assert bound == (["Skin", "Skin"] if skin else ["Wool", "Lace"])
    told = "Cape has Wool, and takes on Skin from above; trim has Lace, and takes on Skin from above"
    assert left == (told if skin else "")
    assert UsdGeom.PrimvarsAPI(cape).FindPrimvarWithInheritance("season").Get() == "winter"
    assert UsdGeom.Imageable(cape).ComputePurpose() == "render"
    lit = Usd.CollectionAPI(stage.GetPrimAtPath("/Lights"), "lit").ComputeMembershipQuery()
    assert lit.IsPathIncluded(cape.GetPath())


def test_what_is_lost_is_told_by_name(hero, tmp_path):
    stage = Usd.Stage.Open(str(hero))
    cape = UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Cape"))
    cape.CreateNormalsAttr([Gf.Vec3f(0, 0, 1)] * 20)
    cape.GetPrim().GetAttribute("primvars:wear").Set([1.0] * 20, 5)
    stage.Save()
    assert shoot(worn(hero), tmp_path / "shot.usda").left_out == (
        "Cape loses normals, the animation of primvars:wear, which keeps its first value"
    )
    deformer = worn(hero)
    cut = replace(deformer.scene.garment.mesh, path="gone.usda:/Shawl", faces=deformer.scene.garment.mesh.faces[:-2],
                  polygon_counts=deformer.scene.garment.mesh.polygon_counts[:-1],
                  polygon_indices=deformer.scene.garment.mesh.indices_of_corners[:-4], uvs=None)  # fmt: skip
    garment = replace(deformer.scene.garment, mesh=cut)
    other = replace(deformer, scene=replace(deformer.scene, garment=garment))
    said = shoot(other, tmp_path / "other.usda").left_out
    assert "Shawl loses its look, if it had any: it is gone.usda:/Shawl of 20 points and 11 polygons, and " in said
    assert "comes near is /Hero/Cape (20 points and 12 polygons, marked as a garment), /Hero/Body (20 points" in said
    assert "name a stage with Shawl, or the model of the garment that is meant; train it anew if it has" in said


def test_variants_that_are_not_selected_are_told_by_name(hero, tmp_path):
    stage = Usd.Stage.Open(str(hero))
    for path, name in (("/Hero", "bodyType"), ("/Hero/Cape", "shadingVariant")):
        sets = stage.GetPrimAtPath(path).GetVariantSets().AddVariantSet(name)
        for each in ("a", "b"):
            sets.AddVariant(each)
        sets.SetVariantSelection("b")
    stage.Save()
    of_hero, of_cape = (
        f"the variant set {name}, in which its stage has 'b'" for name in ("bodyType", "shadingVariant")
    )
    left = write_rigged_stage(hero, worn(hero).scene, tmp_path / "rigged.usda")
    assert left == f"Hero loses {of_hero}; Cape loses {of_cape}"
    left = shoot(worn(hero), tmp_path / "shot.usda").left_out
    assert left == f"Cape loses {of_hero}, {of_cape}; Body loses {of_hero}"


def test_relationships_name_what_is_written_or_are_told(hero, tmp_path):
    stage = Usd.Stage.Open(str(hero))
    rivet = UsdGeom.Xform.Define(stage, "/Hero/Rivet").GetPath()
    cape = stage.GetPrimAtPath("/Hero/Cape")
    for name, targets in (("driver", ["/Hero/Body"]), ("both", [rivet, "/Hero/Body.points"]), ("rivets", [rivet])):
        cape.CreateRelationship(f"rigging:{name}").SetTargets(targets)
    stage.Save()
    summary = shoot(worn(hero), tmp_path / "shot.usda")
    shot = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    written = shot.GetPrimAtPath("/Hero/Cape")
    assert written.GetRelationship("rigging:driver").GetTargets() == [Sdf.Path("/Hero/Body")]
    assert written.GetRelationship("rigging:both").GetTargets() == [Sdf.Path("/Hero/Body.points")]
    assert not written.HasRelationship("rigging:rivets")
    assert summary.left_out == (
        "Cape loses rigging:both to /Hero/Rivet, which is not written with it, "
        "rigging:rivets to /Hero/Rivet, which is not written with it"
    )


def test_materials_of_renderers_and_subsets_that_are_only_looked_at_are_no_fault_of_a_shot(hero, tmp_path):
    """usd-core knows no shaders of MaterialX, Arnold or MDL, and a texture may lie where only a farm finds it."""
    stage = Usd.Stage.Open(str(hero))
    for name, code in (("Standard", "ND_standard_surface_surfaceshader"), ("Ai", "ArnoldStandardSurface")):
        UsdShade.Shader.Define(stage, f"/Looks/Cape_cloth/{name}").CreateIdAttr(code)
    mdl = UsdShade.Shader.Define(stage, "/Looks/Cape_cloth/Mdl")
    mdl.SetSourceAsset("OmniPBR.mdl", "mdl")
    UsdGeom.Subset.SetFamilyType(UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Cape")), "materialBind", "unrestricted")
    stage.Save()
    shoot(worn(hero), tmp_path / "shot.usda")
    found = check_shot(tmp_path / "shot.usda")
    assert {finding.severity for finding in found} == {"warning"}
    told = " ".join(finding.text for finding in found)
    assert "OmniPBR.mdl" in told and "invalid family type" in told and "sdrRegistry" not in told


def test_a_shader_whose_inputs_have_other_types_is_no_fault_of_a_shot(hero, tmp_path):
    stage = Usd.Stage.Open(str(hero))
    UsdShade.Shader(stage.GetPrimAtPath("/Looks/Cape_cloth/Surface")).CreateInput("roughness", TINT.Double).Set(0.5)
    stage.Save()
    shoot(worn(hero), tmp_path / "shot.usda")
    (found,) = check_shot(tmp_path / "shot.usda")
    assert (found.severity, found.prim) == ("warning", "/Hero/Looks/Cape_cloth/Surface.inputs:roughness")


def test_relationships_to_what_is_written_of_a_look_are_kept(hero, tmp_path):
    stage = Usd.Stage.Open(str(hero))
    cape = stage.GetPrimAtPath("/Hero/Cape")
    for name, target in (("part", "/Hero/Cape/trim"), ("cloth", "/Looks/Body_cloth/Surface.inputs:diffuseColor")):
        cape.CreateRelationship(f"rigging:{name}").SetTargets([target])
    stage.Save()
    assert not shoot(worn(hero), tmp_path / "shot.usda").left_out
    shot = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    written = shot.GetPrimAtPath("/Hero/Cape")
    assert written.GetRelationship("rigging:part").GetTargets() == [Sdf.Path("/Hero/Cape/trim")]
    kept = written.GetRelationship("rigging:cloth").GetTargets()
    assert kept == [Sdf.Path("/Hero/Looks/Body_cloth/Surface.inputs:diffuseColor")]


def test_a_variant_set_without_selection_is_told_so(hero, tmp_path):
    stage = Usd.Stage.Open(str(hero))
    stage.GetPrimAtPath("/Hero/Cape").GetVariantSets().AddVariantSet("shade").AddVariant("a")
    stage.Save()
    assert shoot(worn(hero), tmp_path / "shot.usda").left_out == (
        "Cape loses the variant set shade, in which its stage has none"
    )


def test_cloth_without_a_look_is_seen_from_both_sides(hero, tmp_path):
    stage = Usd.Stage.Open(str(hero))
    stage.GetPrimAtPath("/Hero/Cape").RemoveProperty("doubleSided")
    stage.Save()
    shoot(worn(hero), tmp_path / "shot.usda")
    assert (
        UsdGeom.Mesh(Usd.Stage.Open(str(tmp_path / "shot.usda")).GetPrimAtPath("/Hero/Cape"))
        .GetDoubleSidedAttr()
        .Get()
    )


@pytest.mark.parametrize(("read", "first"), [("lightmap", 500.0), ("map1", 0.0), (None, 0.0)])
def test_the_uv_set_is_the_one_that_the_material_reads(hero, read, first):
    stage = Usd.Stage.Open(str(hero))
    prim = stage.GetPrimAtPath("/Hero/Cape")
    for name in ("cloth", "trim"):
        varname = UsdShade.Shader(stage.GetPrimAtPath(f"/Looks/Cape_{name}/Reader")).GetInput("varname")
        varname.Set(read or "")
    uvs = read_mesh(prim, np.eye(4)).uvs
    assert uvs is not None and uvs[0, 0] == first


def shader(stage: Usd.Stage, path: str, kind: str, **inputs: object) -> UsdShade.Shader:
    """A shader whose inputs are words, or other shaders with one output each."""
    found = UsdShade.Shader.Define(stage, path)
    found.CreateIdAttr(kind)
    for name, given in inputs.items():
        if isinstance(given, UsdShade.Shader):
            found.CreateInput(name, TINT.Token).ConnectToSource(given.CreateOutput("out", TINT.Token))
        else:
            found.CreateInput(name, TINT.String).Set(given)
    return found


def of_plain_floats(stage: Usd.Stage, cape: Usd.Prim) -> None:
    values = cape.GetAttribute("primvars:b").Get()
    cape.RemoveProperty("primvars:b")
    UsdGeom.PrimvarsAPI(cape).CreatePrimvar("b", TINT.Float2Array, "faceVarying").Set(values)
    surface = shader(stage, "/Looks/New/S", "UsdPreviewSurface", diffuseColor=reads(stage, "b"))
    bind_new(stage, cape, surface)


def beside_a_light_map(stage: Usd.Stage, cape: Usd.Prim) -> None:
    inputs = {"aoMap": reads(stage, "a"), "diffuseColor": reads(stage, "b")}
    bind_new(stage, cape, shader(stage, "/Looks/New/S", "UsdPreviewSurface", **inputs))


def beside_a_reader_that_nothing_reads(stage: Usd.Stage, cape: Usd.Prim) -> None:
    reads(stage, "a")
    bind_new(stage, cape, shader(stage, "/Looks/New/S", "UsdPreviewSurface", diffuseColor=reads(stage, "b")))


def by_materialx(stage: Usd.Stage, cape: Usd.Prim) -> None:
    reader = shader(stage, "/Looks/New/Geom", "ND_geompropvalue_vector2", geomprop="b")
    image = shader(stage, "/Looks/New/Image", "ND_image_color3", texcoord=reader)
    bind_new(stage, cape, shader(stage, "/Looks/New/S", "ND_standard_surface_surfaceshader", base_color=image))


def for_final_renders_alone(stage: Usd.Stage, cape: Usd.Prim) -> None:
    surface = shader(stage, "/Looks/New/S", "UsdPreviewSurface", diffuseColor=reads(stage, "b"))
    bind_new(stage, cape, surface, "full")


def reads(stage: Usd.Stage, name: str) -> UsdShade.Shader:
    reader = shader(stage, f"/Looks/New/Read_{name}", "UsdPrimvarReader_float2", varname=name)
    return shader(stage, f"/Looks/New/Image_{name}", "UsdUVTexture", st=reader)


def bind_new(stage: Usd.Stage, cape: Usd.Prim, surface: UsdShade.Shader, purpose: str = "") -> None:
    made = UsdShade.Material.Define(stage, "/Looks/New")
    made.CreateSurfaceOutput("mtlx" if "ND_" in str(surface.GetShaderId()) else "").ConnectToSource(
        surface.CreateOutput("surface", TINT.Token)
    )
    for prim in (cape, cape.GetChild("trim")):
        prim.RemoveProperty("material:binding")
    UsdShade.MaterialBindingAPI(cape).Bind(made, materialPurpose=purpose)


READ = (
    of_plain_floats,
    beside_a_light_map,
    beside_a_reader_that_nothing_reads,
    by_materialx,
    for_final_renders_alone,
)


@pytest.mark.parametrize("change", READ)
def test_the_uv_set_is_the_one_that_colours_are_read_by(hero, change):
    stage = Usd.Stage.Open(str(hero))
    cape = stage.GetPrimAtPath("/Hero/Cape")
    for name, start in (("a", 700), ("b", 900)):
        values = [Gf.Vec2f(start + i, 0) for i in range(4 * COLUMNS * ROWS)]
        UsdGeom.PrimvarsAPI(cape).CreatePrimvar(name, TINT.TexCoord2fArray, "faceVarying").Set(values)
    change(stage, cape)
    assert read_mesh(cape, np.eye(4)).uvs[0, 0] == 900


@pytest.mark.parametrize(
    ("kind", "interpolation", "given"),
    [
        ("TexCoord3fArray", "faceVarying", [Gf.Vec3f(i, 2, 3) for i in range(48)]),
        ("FloatArray", "faceVarying", [1.0] * 48),
        ("String", "constant", "map1"),
        ("TexCoord2fArray", "constant", [Gf.Vec2f(0.5, 0.5)]),
    ],
)
def test_whatever_is_called_st_is_read_as_what_it_is(hero, kind, interpolation, given):
    """Two of three coordinates; what is no mapping is passed over for one that is."""
    stage = Usd.Stage.Open(str(hero))
    cape = stage.GetPrimAtPath("/Hero/Cape")
    for prim in (cape, cape.GetChild("trim")):
        prim.RemoveProperty("material:binding")
    UsdGeom.PrimvarsAPI(cape).CreatePrimvar("st", getattr(TINT, kind), interpolation).Set(given)
    expected = [1, 2] if kind == "TexCoord3fArray" else [1, -1]
    np.testing.assert_array_equal(read_mesh(cape, np.eye(4)).uvs[1], expected)


def test_a_primvar_that_is_blocked_stays_so(hero, tmp_path):
    stage = Usd.Stage.Open(str(hero))
    stage.GetPrimAtPath("/Hero/Cape").GetAttribute("primvars:lightmap").Block()
    stage.Save()
    shoot(worn(hero), tmp_path / "shot.usdc")
    shot = Usd.Stage.Open(str(tmp_path / "shot.usdc"))
    assert not UsdGeom.PrimvarsAPI(shot.GetPrimAtPath("/Hero/Cape")).GetPrimvar("lightmap").HasValue()
    assert shot.GetPrimAtPath("/Hero/Body").GetAttribute("primvars:lightmap").HasValue()


def test_a_package_holds_its_textures(hero, tmp_path):
    with packaged(tmp_path / "shot.usdz") as layer:
        shoot(worn(hero), layer)
    (tmp_path / "assets" / "textures" / "linen.png").unlink()
    stage = Usd.Stage.Open(str(tmp_path / "shot.usdz"))
    assert look(stage, "/Hero/Cape")["material of trim"] == ("Cape_trim", "linen.png]")
    assert not UsdUtils.ComputeAllDependencies(str(tmp_path / "shot.usdz"))[2]


def test_a_texture_that_is_not_found_is_told_and_what_only_metadata_names_is_not(hero, tmp_path):
    (tmp_path / "assets" / "textures" / "linen.png").unlink()
    said = []
    with packaged(tmp_path / "temporary.usdz", said.append, name="shot.usdz") as layer:
        shoot(worn(hero), layer)
        stage = Usd.Stage.Open(str(layer))
        Usd.ModelAPI(stage.GetDefaultPrim()).SetAssetIdentifier(Sdf.AssetPath("studio:/cape"))
        stage.Save()
        del stage
    (told,) = said
    assert told.level == "warning" and told.text.startswith("shot.usdz: the texture '")
    assert "textures/linen.png' is not found, and not in the package" in told.text


@pytest.mark.parametrize("tiles", [("linen.png",), ("linen.1001.png", "linen.1002.png")])
def test_a_package_holds_textures_that_came_in_another_package(hero, tmp_path, tiles):
    for tile in tiles:
        (hero.parent / "textures" / tile).write_bytes(tile.encode())
    if len(tiles) > 1:
        stage = Usd.Stage.Open(str(hero))
        for prim in [each for each in stage.Traverse() if each.GetName() == "Texture"]:
            UsdShade.Shader(prim).GetInput("file").Set(Sdf.AssetPath("./textures/linen.<UDIM>.png"))
        stage.Save()
        del stage
    source = tmp_path / "hero.usdz"
    assert UsdUtils.CreateNewUsdzPackage(str(hero), str(source))
    with packaged(tmp_path / "shot.usdz") as layer:
        shoot(worn(source), layer)
    source.unlink()
    with zipfile.ZipFile(tmp_path / "shot.usdz") as package:
        held = {Path(name).name: package.read(name) for name in package.namelist()[1:]}
    assert held == {tile: tile.encode() for tile in tiles}
    assert not UsdUtils.ComputeAllDependencies(str(tmp_path / "shot.usdz"))[2]


def test_a_rig_says_what_a_garment_from_its_own_file_loses(hero, tmp_path):
    garment = tmp_path / "assets" / "cape.usda"
    stage = Usd.Stage.CreateNew(str(garment))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    dressed(stage, "/Wardrobe/Cloak", 0.2).CreateNormalsAttr([Gf.Vec3f(0, 0, 1)] * 20)
    stage.Save()
    character, read, _ = read_scene(str(hero), garment=str(garment))
    assert write_rigged_stage(hero, scene_of(character, read), tmp_path / "rigged.usda") == "Cloak loses normals"
    assert write_rigged_stage(hero, worn(hero).scene, tmp_path / "other.usda") == ""


def varied(stage: Usd.Stage) -> None:
    sets = stage.GetPrimAtPath("/Looks/Cape_cloth").GetVariantSets().AddVariantSet("colour")
    for each in ("blue", "red"):
        sets.AddVariant(each)
    sets.SetVariantSelection("blue")


def connected(stage: Usd.Stage) -> None:
    rivet = UsdGeom.Xform.Define(stage, "/Hero/Rivet").GetPrim().CreateAttribute("worn", TINT.Float)
    stage.GetPrimAtPath("/Hero/Cape").CreateAttribute("rigging:worn", TINT.Float).AddConnection(rivet.GetPath())


def of_a_material(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/Looks/Cape_cloth").CreateRelationship("rigging:rig").SetTargets(["/Hero/Rig"])


def chosen_over_time(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/Hero/Cape/trim").GetAttribute("indices").Set([3], 2)


def left_out_of_a_collection(stage: Usd.Stage) -> None:
    for path in ("/Hero/Cape", "/Hero/Cape/trim"):
        UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(path)).UnbindAllBindings()
    hero = stage.GetPrimAtPath("/Hero")
    collection = Usd.CollectionAPI.Apply(hero, "cloth")
    collection.CreateIncludesRel().SetTargets(["/Hero/Cape"])
    collection.CreateExcludesRel().SetTargets(["/Hero/Cape/trim"])
    wool = material(stage, "/Looks/Wool", "map1")
    UsdShade.MaterialBindingAPI.Apply(hero).Bind(collection, wool, "cloth")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (varied, "Cape_cloth loses the variant set colour, in which its stage has 'blue'"),
        (connected, "Cape loses rigging:worn to /Hero/Rivet.worn, which is not written with it"),
        (of_a_material, "Cape_cloth loses rigging:rig to /Hero/Rig, which is not written with it"),
        (chosen_over_time, "Cape loses the animation of trim.indices, which keeps its first value"),
        (left_out_of_a_collection, "Cape loses the lack of a material of trim, which takes on Wool from above"),
    ],
)
def test_what_materials_connections_and_subsets_lose_is_told_by_name(hero, tmp_path, change, told):
    stage = Usd.Stage.Open(str(hero))
    change(stage)
    stage.Save()
    assert shoot(worn(hero), tmp_path / "shot.usda").left_out == told
    shot = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    for prim in shot.Traverse():
        for each in prim.GetAuthoredProperties():
            targets = each.GetTargets() if isinstance(each, Usd.Relationship) else each.GetConnections()
            assert all(shot.GetObjectAtPath(target) for target in targets), each


def test_what_connects_to_what_is_written_is_kept(hero, tmp_path):
    stage = Usd.Stage.Open(str(hero))
    cape = stage.GetPrimAtPath("/Hero/Cape")
    cape.CreateAttribute("rigging:colour", TINT.Color3f).AddConnection("/Looks/Body_cloth/Texture.outputs:rgb")
    stage.GetPrimAtPath("/Looks/Cape_cloth").CreateRelationship("rigging:like").SetTargets(["/Looks/Body_trim"])
    Usd.CollectionAPI.Apply(cape, "panels").CreateIncludesRel().SetTargets(["/Hero/Cape/trim"])
    stage.Save()
    assert not shoot(worn(hero), tmp_path / "shot.usda").left_out
    shot = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    cape, looks = shot.GetPrimAtPath("/Hero/Cape"), Sdf.Path("/Hero/Looks")
    colour = looks.AppendPath("Body_cloth/Texture.outputs:rgb")
    assert cape.GetAttribute("rigging:colour").GetConnections() == [colour]
    like = shot.GetPrimAtPath(looks.AppendPath("Cape_cloth")).GetRelationship("rigging:like")
    assert like.GetTargets() == [looks.AppendPath("Body_trim")]
    query = Usd.CollectionAPI(cape, "panels").ComputeMembershipQuery()
    assert query.IsPathIncluded(Sdf.Path("/Hero/Cape/trim"))


def test_a_material_plays_as_fast_in_a_shot_of_another_rate(hero, tmp_path):
    stage = Usd.Stage.Open(str(hero))
    stage.SetTimeCodesPerSecond(24)
    wet = UsdShade.Shader(stage.GetPrimAtPath("/Looks/Cape_cloth/Surface")).CreateInput("roughness", TINT.Float)
    wet.Set(0.0, 0)
    wet.Set(1.0, 24)
    stage.Save()
    shoot(worn(hero), tmp_path / "shot.usda")
    shot = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    written = UsdShade.Shader(shot.GetPrimAtPath("/Hero/Looks/Cape_cloth/Surface")).GetInput("roughness")
    assert shot.GetTimeCodesPerSecond() == 30
    assert written.Get(15) == pytest.approx(wet.Get(12)) == pytest.approx(0.5)


@pytest.mark.parametrize("variants", [True, False])
def test_words_of_hidden_faces_are_hidden_with_them(hero, tmp_path, variants):
    stage = Usd.Stage.Open(str(hero))
    api = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Hero/Body"))
    words = api.CreatePrimvar("panel", TINT.StringArray, "uniform")
    words.Set([f"panel {face}" for face in range(COLUMNS * ROWS)])
    stage.Save()
    mask = np.arange(COLUMNS * ROWS) == 3
    shoot(worn(hero), tmp_path / "shot.usda", hidden_polygons=HiddenPolygons((mask,), variants))
    shot = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    found = UsdGeom.PrimvarsAPI(shot.GetPrimAtPath("/Hero/Body"))
    assert list(found.GetPrimvar("panel").Get()) == [f"panel {face}" for face in range(COLUMNS * ROWS) if face != 3]


def name_tiles(hero: Path) -> None:
    """Give the cape of a stage a texture of one tile, named without a dot."""
    (hero.parent / "textures" / "linen.1001.png").write_bytes(b"linen")
    stage = Usd.Stage.Open(str(hero))
    texture = UsdShade.Shader(stage.GetPrimAtPath("/Looks/Cape_cloth/Texture")).GetInput("file")
    texture.Set(Sdf.AssetPath("textures/linen.<UDIM>.png"))
    stage.Save()


def test_tiles_that_are_named_without_a_dot_are_found_from_a_shot(hero, tmp_path):
    """USD looks up `<UDIM>` beside the layer that names it, as it does the other textures."""
    name_tiles(hero)
    shoot(worn(hero), tmp_path / "shots" / "shot.usda")
    shot = Usd.Stage.Open(str(tmp_path / "shots" / "shot.usda"))
    written = shot.GetPrimAtPath("/Hero/Looks/Cape_cloth/Texture").GetAttribute("inputs:file").Get()
    assert UsdShade.UdimUtils.ResolveUdimPath(written.path, shot.GetRootLayer())


def test_a_rig_in_another_folder_finds_textures_and_tiles_by_relative_paths(hero, tmp_path):
    name_tiles(hero)
    rigged = tmp_path / "rigs" / "rigged.usda"
    rigged.parent.mkdir()
    write_rigged_stage(hero, worn(hero).scene, rigged)
    after = Usd.Stage.Open(str(rigged))
    tiles, plain = (
        after.GetPrimAtPath(f"/Looks/{name}/Texture").GetAttribute("inputs:file").Get()
        for name in ("Cape_cloth", "Body_cloth")
    )
    assert UsdShade.UdimUtils.ResolveUdimPath(tiles.path, after.GetRootLayer())
    assert plain.resolvedPath and Path(plain.resolvedPath).samefile(hero.parent / "textures" / "linen.png")
    assert not Path(tiles.path).is_absolute() and not Path(plain.path).is_absolute()


def test_a_set_of_one_variant_that_is_selected_loses_nothing(hero, tmp_path):
    stage = Usd.Stage.Open(str(hero))
    only = stage.GetPrimAtPath("/Hero/Cape").GetVariantSets().AddVariantSet("model")
    only.AddVariant("base")
    only.SetVariantSelection("base")
    stage.Save()
    assert not write_rigged_stage(hero, worn(hero).scene, tmp_path / "rigged.usda")
    assert not shoot(worn(hero), tmp_path / "shot.usda").left_out


def test_a_rig_says_what_a_garment_without_a_material_takes_on(hero, tmp_path):
    character = Usd.Stage.Open(str(hero))
    skin = material(character, "/Looks/Skin", "map1")
    UsdShade.MaterialBindingAPI.Apply(character.GetPrimAtPath("/Hero")).Bind(skin)
    character.Save()
    stage = Usd.Stage.CreateNew(str(tmp_path / "cape.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    cloak = dressed(stage, "/Wardrobe/Cloak", 0.2).GetPrim()
    for prim in (cloak, cloak.GetChild("trim")):
        UsdShade.MaterialBindingAPI(prim).UnbindAllBindings()
    stage.Save()
    hero_of_ours, read, _ = read_scene(str(hero), garment=str(tmp_path / "cape.usda"))
    assert write_rigged_stage(hero, scene_of(hero_of_ours, read), tmp_path / "rigged.usda") == (
        "Cloak loses the lack of a material of Cloak, which takes on Skin from above, "
        "the lack of a material of trim, which takes on Skin from above"
    )
