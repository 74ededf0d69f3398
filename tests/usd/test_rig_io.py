# SPDX-License-Identifier: Apache-2.0
"""Proxy rigs written into stages, and read back as written or as edited by hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
from scipy.spatial.transform import Rotation
from ssilk_usd.reading.facts import playback_rate
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.reading.rig import read_proxy_rig
from ssilk_usd.reading.scene import read_rigged, read_scene
from ssilk_usd.writing.rig import write_rigged_stage

from ssilk_core.errors import SsilkError
from ssilk_core.scene import kinematics
from ssilk_core.scene.assets import Garment, ProxyRig, Scene, SkinWeights, classes_at

JOINTS = ("Hips", "Hips/Spine", "Hips/Spine/Head")
PROXIES = ("Hips/Spine/cape_0", "Hips/Spine/cape_0/cape_1", "Hips/Spine/cape_0/cape_2")
HERO = """#usda 1.0
( metersPerUnit = {meters}; upAxis = "{up}"; defaultPrim = "Hero"
  timeCodesPerSecond = 30; framesPerSecond = 30; startTimeCode = 1; endTimeCode = 3 )
def SkelRoot "Hero" (prepend apiSchemas = ["SkelBindingAPI"])
{{
    rel skel:skeleton = </Hero/Rig>
    double xformOp:rotateY = 35
    double3 xformOp:translate = (1, 2, 3)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateY"]
    def Skeleton "Rig" (prepend apiSchemas = ["SkelBindingAPI"])
    {{
        uniform token[] joints = ["Hips", "Hips/Spine", "Hips/Spine/Head"]
        uniform token[] jointNames = ["hips", "spine", "head"]
        uniform matrix4d[] bindTransforms = [
            ((1,0,0,0), (0,1,0,0), (0,0,1,0), (0,1,0,1)),
            ((0,1,0,0), (-1,0,0,0), (0,0,1,0), (0,1.4,0,1)),
            ((1,0,0,0), (0,0,1,0), (0,-1,0,0), (0,1.8,0,1)) ]
        rel skel:animationSource = </Hero/Rig/Nod>
        def SkelAnimation "Nod"
        {{
            uniform token[] joints = ["Hips/Spine", "Hips", "Hips/Spine/Head"]
            float3[] translations = [(0,0.4,0), (0,1,0), (0.4,0,0)]
            half3[] scales = [(1,1,1), (1,1,1), (1,1,1)]
            quatf[] rotations.timeSamples = {{
                1: [(0.6,0,0,0.8), (1,0,0,0), (1,0,0,0)],
                3: [(0.8,0,0.6,0), (0.8,0.6,0,0), (0.6,0,0.8,0)] }}
        }}
    }}
    def Mesh "Body" (prepend apiSchemas = ["SkelBindingAPI"])
    {{
        point3f[] points = [(0,0,0), (1,0,0), (1,2,0), (0,2,0)]
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        int[] primvars:skel:jointIndices = [0, 1, 2, 1] (interpolation = "vertex"; elementSize = 1)
        float[] primvars:skel:jointWeights = [1, 1, 1, 1] (interpolation = "vertex"; elementSize = 1)
    }}
}}
"""
CAPE = """
    {
        bool ssilk:garment = 1
        point3f[] points = [(0,0,0.1), (1,0,0.1), (1,1,0.1), (0,1,0.1), (1,2,0.2), (0,2,0.2)]
        int[] faceVertexCounts = [4, 4]
        int[] faceVertexIndices = [0, 1, 2, 3, 3, 2, 4, 5]
        texCoord2f[] primvars:st = [(0,0), (1,0), (1,1), (0,1), (1,2), (0,2)] (interpolation = "vertex")
        double3 xformOp:translate = (0.1, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
"""
LBS_SKIN = np.array([[1.0, 0, 0], [0, 1, 0], [0.5, 0.5, 0], [0, 0, 1], [0.2, 0.3, 0.5], [0, 1, 0]])
WEIGHTS = np.array(
    [
        [1.0, 0, 0, 0, 0, 0],
        [0, 0, 0, 0.5, 0.5, 0],
        [0, 0, 0, 0, 0, 1],
        [0, 0.5, 0, 0.5, 0, 0],
        [0, 0, 0, 0.25, 0.25, 0.5],
        [0, 0, 0, 0, 1, 0],
    ]
)


def hero(folder: Path, where: str, *, meters: float = 1.0, up: str = "Y") -> tuple[Path, str]:
    """Write a character and its cape, in the SkelRoot, beside it or in its own file; return stage and garment."""
    text, stage = HERO.format(meters=meters, up=up), folder / "hero.usda"
    cape = 'def Mesh "Cape"' + CAPE
    if where == "skelroot":
        text = text.rstrip()[:-1] + cape + "}\n"
    elif where == "beside":
        text += 'def Xform "Set" {' + cape + "}\n"
    else:
        (folder / "wardrobe.usda").write_text('#usda 1.0\n(metersPerUnit = 0.01; upAxis = "Z")\n' + cape)
    stage.write_text(text)
    return stage, str(folder / "wardrobe.usda:/Cape") if where == "own file" else "Cape"


def dress(source: Path, garment: str, names: tuple[str, ...] = PROXIES) -> Scene:
    """Give the garment weights, classes and three proxies."""
    character, read, _ = read_scene(source, garment=garment)
    path, turns = read.mesh.path, Rotation.random(3, random_state=1).as_matrix()
    bind = kinematics.rigid(turns, np.array([[0.1, 1, -0.2], [0.1, 0.7, -0.2], [0.3, 0.7, -0.2]]))
    skin = SkinWeights.from_dense(path, LBS_SKIN)
    rig = ProxyRig(path, names, np.array([1, 3, 3]), bind, SkinWeights.from_dense(path, WEIGHTS))
    return Scene(character, Garment(read.mesh, skin, np.array([0, 2, 2, 1, 2, 2])), rig)


def rigged(tmp_path: Path, where: str = "skelroot", **units) -> tuple[Scene, Path, Path]:
    source, garment = hero(tmp_path, where, **units)
    scene, out = dress(source, garment), tmp_path / "rigged.usda"
    write_rigged_stage(source, scene, out)
    return scene, source, out


def skinned_in_world(path: Path, mesh: str, code: float) -> np.ndarray:
    """World positions in stage units as UsdSkel alone computes them."""
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath(mesh)
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root.Find(prim), Usd.PrimDefaultPredicate)
    skeleton = UsdSkel.BindingAPI(prim).GetInheritedSkeleton()
    points = UsdGeom.Mesh(prim).GetPointsAttr().Get()
    transforms = cache.GetSkelQuery(skeleton).ComputeSkinningTransforms(code)
    assert cache.GetSkinningQuery(prim).ComputeSkinnedPoints(transforms, points, code)
    world = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(skeleton.GetPrim()))
    return np.array(points) @ world[:3, :3] + world[3, :3]


def edited(path: Path, change) -> Path:
    stage = Usd.Stage.Open(str(path))
    change(stage.GetPrimAtPath("/Hero/Rig"), stage.GetPrimAtPath("/Hero/Cape"))
    stage.Save()
    return path


def keep_joints(rig: Usd.Prim, order: list[int], names: tuple[str, ...]) -> None:
    for matrices in ("bindTransforms", "restTransforms"):
        attribute = rig.GetAttribute(matrices)
        value = attribute.Get()
        attribute.Set([value[index] for index in order])
    rig.GetAttribute("joints").Set(names)


@pytest.mark.parametrize("where", ["skelroot", "beside", "own file"])
@pytest.mark.parametrize(("meters", "up"), [(1.0, "Y"), (0.1, "Z")])
def test_a_written_rig_reads_back(where, meters, up, tmp_path):
    scene, _, out = rigged(tmp_path, where, meters=meters, up=up)
    character, garment, rig = read_scene(out)
    np.testing.assert_allclose(
        character.skeleton.bind_transforms, scene.character.skeleton.bind_transforms, atol=1e-12
    )
    assert character.skeleton.joint_names == JOINTS and [b.mesh.path for b in character.bodies] == [
        f"{out}:/Hero/Body"
    ]
    assert garment.mesh.path == f"{out}:/Hero/Cape"
    np.testing.assert_allclose(garment.mesh.points, scene.garment.mesh.points, atol=1e-6)
    np.testing.assert_array_equal(garment.mesh.polygon_indices, scene.garment.mesh.polygon_indices)
    np.testing.assert_array_equal(garment.mesh.uvs, scene.garment.mesh.uvs)
    np.testing.assert_array_equal(garment.classes, scene.classes)
    np.testing.assert_allclose(garment.skin.dense(3), LBS_SKIN, atol=1e-7)
    assert rig.joint_names == PROXIES and rig.parents.tolist() == [1, 3, 3]
    np.testing.assert_allclose(rig.bind_transforms, scene.rig.bind_transforms, atol=1e-9)
    np.testing.assert_allclose(rig.skin.dense(6), WEIGHTS, atol=1e-7)


@pytest.mark.parametrize("where", ["skelroot", "beside", "own file"])
def test_a_settled_garment_is_written_where_it_was_moved(where, tmp_path):
    source, name = hero(tmp_path, where, meters=0.1, up="Z")
    scene, moved = dress(source, name), np.random.default_rng(0).normal(0, 0.01, (6, 3))
    mesh = replace(scene.garment.mesh, points=scene.garment.mesh.points + moved)
    settled = replace(scene, garment=replace(scene.garment, mesh=mesh))
    write_rigged_stage(source, settled, tmp_path / "out.usdc", moved=moved)
    found = read_scene(tmp_path / "out.usdc")[1]
    np.testing.assert_allclose(found.mesh.points, mesh.points, atol=1e-6)
    np.testing.assert_array_equal(found.mesh.uvs, mesh.uvs)


def test_garments_with_proxies_are_found(tmp_path):
    _, source, out = rigged(tmp_path)
    ((skeleton, garment, rig),) = read_rigged(out)
    assert (skeleton.joint_names, rig.joint_names) == (JOINTS, PROXIES)
    np.testing.assert_allclose(garment.skin.dense(3), LBS_SKIN, atol=1e-7)
    np.testing.assert_allclose(rig.skin.dense(6), WEIGHTS, atol=1e-7)
    assert (read_rigged(source), playback_rate(out)) == ([], 30)


def mirrored(rig: Usd.Prim, _: Usd.Prim) -> None:
    """Mirror the spine, and make what the head carries twice as large in its space: no point moves."""
    binds = np.array(rig.GetAttribute("bindTransforms").Get())
    binds[1:, :3, :3] *= np.array([-1, -2])[:, None, None]
    rig.GetAttribute("bindTransforms").Set([Gf.Matrix4d(each.tolist()) for each in binds])
    rest = [binds[0], *(binds[joint] @ np.linalg.inv(binds[joint - 1]) for joint in (1, 2))]
    values = Vt.Matrix4dArray([Gf.Matrix4d(each.tolist()) for each in rest])
    rig.CreateAttribute("restTransforms", Sdf.ValueTypeNames.Matrix4dArray).Set(values)
    nod = UsdSkel.Animation(rig.GetChild("Nod"))
    nod.GetScalesAttr().Set([Gf.Vec3h(-1), Gf.Vec3h(1), Gf.Vec3h(2)])
    nod.GetTranslationsAttr().Set([(0, 0.4, 0), (0, 1, 0), (-0.4, 0, 0)])


@pytest.mark.parametrize("where", ["skelroot", "beside", "own file", "scaled joints"])
def test_usdskel_deforms_the_written_garment_as_the_core_does(where, tmp_path):
    if where == "scaled joints":
        source, garment = hero(tmp_path, "beside", meters=0.1, up="Z")
        edited(source, mirrored)
        scene, out = dress(source, garment), tmp_path / "rigged.usda"
        write_rigged_stage(source, scene, out)
        np.testing.assert_allclose(
            read_proxy_rig(out, scene.character.skeleton).bind_transforms, scene.rig.bind_transforms, atol=1e-9
        )
    else:
        scene, _, out = rigged(tmp_path, where, meters=0.1, up="Z")
    motion = read_motion(out, scene.character.skeleton)
    assert motion.frame_count == 3
    local = kinematics.rigid(kinematics.matrix_from_quaternion(motion.rotations), motion.translations)
    still = kinematics.local_transforms(scene.bind_transforms, scene.parents)[3:]
    joints = np.concatenate([local, np.broadcast_to(still, (3, 3, 4, 4))], axis=1)
    world = kinematics.world_transforms(joints, scene.parents)
    matrices = kinematics.skinning_matrices(world, scene.bind_transforms)
    expected = kinematics.skin_points(scene.garment.mesh.points, scene.rig.skin, matrices)
    for frame in range(3):
        x, y, z = skinned_in_world(out, "/Hero/Cape", frame + 1).T * 0.1
        np.testing.assert_allclose(np.stack([x, z, -y], axis=-1), expected[frame], atol=1e-6)


def test_the_stage_keeps_its_units_joints_body_and_animation(tmp_path):
    _, source, out = rigged(tmp_path, "beside", meters=0.1, up="Z")
    before, after = Usd.Stage.Open(str(source)), Usd.Stage.Open(str(out))
    for key in ("metersPerUnit", "upAxis", "timeCodesPerSecond", "startTimeCode", "endTimeCode", "defaultPrim"):
        assert after.GetMetadata(key) == before.GetMetadata(key)
    rig = after.GetPrimAtPath("/Hero/Rig")
    assert tuple(rig.GetAttribute("joints").Get()) == (*JOINTS, *PROXIES)
    assert tuple(rig.GetAttribute("jointNames").Get()) == ("hips", "spine", "head", "cape_0", "cape_1", "cape_2")
    old = before.GetPrimAtPath("/Hero/Rig").GetAttribute("bindTransforms").Get()
    assert list(rig.GetAttribute("bindTransforms").Get())[:3] == list(old)
    assert not after.GetPrimAtPath("/Set/Cape") and not after.GetRootLayer().GetExternalReferences()
    np.testing.assert_allclose(
        skinned_in_world(out, "/Hero/Body", 2),
        # the source has no rest transforms; its animation drives every joint
        skinned_in_world(edited(source, _author_rest), "/Hero/Body", 2),
        atol=1e-6,
    )


def _author_rest(rig: Usd.Prim, _: Usd.Prim) -> None:
    rig.CreateAttribute("restTransforms", Sdf.ValueTypeNames.Matrix4dArray).Set([Gf.Matrix4d(1)] * 3)


def test_a_moved_proxy_is_where_it_was_put(tmp_path):
    scene, _, out = rigged(tmp_path)

    def move(rig, _):
        matrices = list(rig.GetAttribute("bindTransforms").Get())
        matrices[4] = matrices[4] * Gf.Matrix4d().SetTranslate((0, 0, 0.5))
        rig.GetAttribute("bindTransforms").Set(matrices)

    rig = read_proxy_rig(edited(out, move), scene.character.skeleton)
    moved = rig.bind_transforms[:, :3, 3] - scene.rig.bind_transforms[:, :3, 3]
    np.testing.assert_allclose(moved, [[0, 0, 0], [0, 0, 0.5], [0, 0, 0]], atol=1e-9)


def test_a_removed_proxy_takes_its_weights_along(tmp_path):
    scene, _, out = rigged(tmp_path)
    said = []
    edited(out, lambda rig, cape: keep_joints(rig, [0, 1, 2, 3, 5], (*JOINTS, PROXIES[0], PROXIES[2])))
    rig = read_proxy_rig(out, scene.character.skeleton, report=said.append)
    assert rig.joint_names == (PROXIES[0], PROXIES[2]) and rig.parents.tolist() == [1, 3]
    expected = WEIGHTS[:, [0, 1, 2, 3, 5]]
    expected[5, :3] = LBS_SKIN[5]  # it hung from the removed proxy alone
    np.testing.assert_allclose(rig.skin.dense(5), expected / expected.sum(axis=1, keepdims=True), atol=1e-7)
    assert ["1 of its proxy joints are gone" in said[0].text, "1 vertices lost" in said[1].text] == [True, True]


def test_vertices_without_any_weight_left_are_an_error(tmp_path):
    scene, _, out = rigged(tmp_path)

    def remove(rig, cape):
        keep_joints(rig, [0, 1, 2, 3, 5], (*JOINTS, PROXIES[0], PROXIES[2]))
        for name in ("Indices", "Weights"):
            cape.RemoveProperty(f"primvars:ssilk:plainJoint{name}")

    with pytest.raises(SsilkError, match="1 vertices are weighted to joints that are gone"):
        read_proxy_rig(edited(out, remove), scene.character.skeleton)


def test_a_joint_added_beneath_a_proxy_is_a_proxy_and_takes_painted_weights(tmp_path):
    scene, _, out = rigged(tmp_path)
    tip = f"{PROXIES[1]}/tip"

    def add(rig, cape):
        keep_joints(rig, [0, 1, 2, 3, 4, 5, 4], (*JOINTS, *PROXIES, tip))
        UsdSkel.BindingAPI(cape).GetJointsAttr().Set((tip, "Hips/Spine"))
        binding = UsdSkel.BindingAPI(cape)
        for primvar, value in (
            (binding.GetJointIndicesPrimvar(), [0, 1] * 6),
            (binding.GetJointWeightsPrimvar(), [0.75, 0.25] * 6),
        ):
            primvar.SetElementSize(2)
            primvar.Set(value)

    character, garment, rig = read_scene(edited(out, add))
    np.testing.assert_allclose(garment.skin.dense(3), LBS_SKIN, atol=1e-7)
    assert character.skeleton.joint_names == JOINTS
    assert rig.joint_names == (*PROXIES, tip) and rig.parents.tolist() == [1, 3, 3, 4]
    np.testing.assert_allclose(rig.skin.dense(7), np.tile([0, 0.25, 0, 0, 0, 0, 0.75], (6, 1)))
    assert scene.rig.proxy_count == 3


def test_a_reparented_proxy_is_found_by_its_leaf_name(tmp_path):
    scene, _, out = rigged(tmp_path)
    # cape_1 now hangs from the head, and stands before cape_0
    names = (*JOINTS, "Hips/Spine/Head/cape_1", PROXIES[0], PROXIES[2])
    edited(out, lambda rig, cape: keep_joints(rig, [0, 1, 2, 4, 3, 5], names))
    rig = read_proxy_rig(out, scene.character.skeleton)
    assert rig.joint_names == names[3:] and rig.parents.tolist() == [2, 1, 4]
    np.testing.assert_allclose(rig.bind_transforms, scene.rig.bind_transforms[[1, 0, 2]], atol=1e-9)
    np.testing.assert_allclose(rig.skin.dense(6), WEIGHTS[:, [0, 1, 2, 4, 3, 5]], atol=1e-7)


def test_each_garment_has_its_own_proxies(tmp_path):
    _, _, first = rigged(tmp_path)
    (tmp_path / "skirt.usda").write_text('#usda 1.0\n(metersPerUnit = 1)\ndef Mesh "Skirt"' + CAPE)
    skirt, both = dress(first, f"{tmp_path}/skirt.usda", PROXIES), tmp_path / "both.usda"
    write_rigged_stage(first, skirt, both)
    renamed = ("Hips/Spine/cape_0_2", "Hips/Spine/cape_0_2/cape_1_2", "Hips/Spine/cape_0_2/cape_2_2")

    def names(file: Path) -> list:
        return [read_scene(file, garment=name)[2].joint_names for name in ("Cape", "Skirt")]

    assert names(both) == [PROXIES, renamed]
    # Rigged again, the cape's proxies go to the end and the skirt's weights still mean the same joints.
    again, cape = tmp_path / "again.usda", ("Hips/Spine/new", "Hips/Spine/new/a", "Hips/Spine/new/b")
    write_rigged_stage(both, dress(both, "Cape", cape), again)
    assert names(again) == [cape, renamed]
    stage = Usd.Stage.Open(str(again))
    assert tuple(stage.GetPrimAtPath("/Hero/Rig").GetAttribute("joints").Get()) == (*JOINTS, *renamed, *cape)
    for mesh, file in (("/Hero/Skirt", both), ("/Hero/Body", first), ("/Hero/Cape", first)):
        np.testing.assert_allclose(skinned_in_world(again, mesh, 3), skinned_in_world(file, mesh, 3), atol=1e-6)
    with pytest.raises(SsilkError, match="several garments: /Hero/Cape, /Hero/Skirt"):
        read_scene(again)


def test_a_proxy_may_not_hang_from_another_garments_proxy(tmp_path):
    scene, _, out = rigged(tmp_path)

    def steal(rig, cape):
        stage = cape.GetStage()
        Sdf.CopySpec(stage.GetRootLayer(), cape.GetPath(), stage.GetRootLayer(), "/Hero/Other")
        stage.GetPrimAtPath("/Hero/Other").GetAttribute("ssilk:proxyJoints").Set([PROXIES[0]])
        cape.GetAttribute("ssilk:proxyJoints").Set(PROXIES[1:])

    with pytest.raises(SsilkError, match="'Hips/Spine/cape_0/cape_1' hangs from 'Hips/Spine/cape_0'"):
        read_proxy_rig(edited(out, steal), scene.character.skeleton, garment="Cape")


def test_pins_and_levels_are_kept_with_the_classes(tmp_path):
    source, garment = hero(tmp_path, "skelroot")
    scene = dress(source, garment)
    levels = np.array([0, 0.35, 1, 0.5, 0.05, 0.95])
    kept = replace(scene.garment, pins=np.array([1, 0, 0, 0, 0, 0]), levels=levels)
    write_rigged_stage(source, replace(scene, garment=kept), tmp_path / "out.usdc")
    read = read_scene(tmp_path / "out.usdc")[1]
    assert read.pins.tolist() == [1, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(read.levels, levels, atol=1e-7)
    assert classes_at(read.levels, 0.35).tolist() == [0, 1, 2, 2, 1, 2]
    plain = read_scene(source, garment=garment)[1]
    assert plain.pins is None and plain.levels is None


def test_a_rig_without_proxies_is_still_a_rig(tmp_path):
    source, garment = hero(tmp_path, "skelroot")
    scene = dress(source, garment)
    path = scene.rig.path
    empty = ProxyRig(path, (), np.zeros(0, int), np.zeros((0, 4, 4)), SkinWeights.from_dense(path, LBS_SKIN))
    write_rigged_stage(source, replace(scene, rig=empty), tmp_path / "out.usdc")
    rig = read_scene(tmp_path / "out.usdc")[2]
    assert rig is not None and rig.proxy_count == 0
    assert read_scene(source)[2] is None


def test_an_instanced_character_is_opened_up(tmp_path):
    source, _ = hero(tmp_path, "skelroot")
    shot = tmp_path / "shot.usda"
    shot.write_text(
        '#usda 1.0\n(metersPerUnit = 1)\ndef Xform "World"\n{\n'
        'def "Actor" (\n instanceable = true\n prepend payload = @./hero.usda@\n)\n{\n}\n}\n'
    )
    scene = dress(shot, "Cape")
    write_rigged_stage(shot, scene, tmp_path / "out.usdc")
    character, _, rig = read_scene(tmp_path / "out.usdc")
    assert rig.joint_names == PROXIES and character.path.endswith(":/World/Actor")
    assert source.exists()


def test_classes_painted_as_floats_are_replaced(tmp_path):
    source, _ = hero(tmp_path, "skelroot")
    stage = Usd.Stage.Open(str(source))
    primvars = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Hero/Cape"))
    painted = primvars.CreatePrimvar("ssilk:class", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex)
    painted.Set(Vt.FloatArray([1.0]))
    painted.SetIndices(Vt.IntArray([0] * 6))
    stage.Save()
    scene = dress(source, "Cape")
    write_rigged_stage(source, scene, tmp_path / "out.usda")
    np.testing.assert_array_equal(read_scene(tmp_path / "out.usda")[1].classes, scene.classes)


@pytest.mark.parametrize(
    ("name", "message"), [("out.obj", "suffix is '.obj'"), ("file/out.usda", "cannot be written")]
)
def test_an_output_that_cannot_be_gives_one_sentence(name, message, tmp_path):
    source, garment = hero(tmp_path, "skelroot")
    (tmp_path / "file").write_text("")
    scene, before = dress(source, garment), sorted(tmp_path.iterdir())
    with pytest.raises(SsilkError, match=message):
        write_rigged_stage(source, scene, tmp_path / name)
    assert sorted(tmp_path.iterdir()) == before


def test_a_garment_that_leaves_a_mirrored_xform_keeps_its_outside(tmp_path):
    source, garment = hero(tmp_path, "beside")
    stage = Usd.Stage.Open(str(source))
    UsdGeom.Xformable(stage.GetPrimAtPath("/Set")).AddScaleOp().Set(Gf.Vec3f(-1, 1, 1))
    stage.Save()
    scene, out = dress(source, garment), tmp_path / "rigged.usda"
    write_rigged_stage(source, scene, out)
    found = read_scene(out, garment="Cape")[1].mesh
    np.testing.assert_allclose(found.points, scene.garment.mesh.points, atol=1e-6)
    np.testing.assert_array_equal(found.polygon_indices, scene.garment.mesh.polygon_indices)
