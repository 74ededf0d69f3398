# SPDX-License-Identifier: Apache-2.0
"""Garments that are bound to a Skeleton of their own: they are read, and rigged, where UsdSkel shows them."""

from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdSkel, Vt
from scipy.spatial.transform import Rotation
from ssilk_usd.reading.scene import read_scene
from ssilk_usd.writing.rig import write_rigged_stage

from ssilk_core.errors import SsilkError
from ssilk_core.scene import kinematics
from ssilk_core.scene.assets import Garment, ProxyRig, Scene

JOINTS = ("Hips", "Hips/Spine", "Hips/Leg")
PARENTS = np.array([-1, 0, 0])
BIND = kinematics.rigid(
    Rotation.from_euler("z", [[0], [20], [-75]], degrees=True).as_matrix(),
    np.array([[0, 1, 0], [0, 1.4, 0], [0.1, 0.9, 0]]),
)
BODY = np.array([[0, 1.0, 0.1], [0.1, 1, 0], [0, 1.5, 0], [0.1, 0.4, 0]])
CLOTH = np.array([[0, 1.1, 0.2], [0.2, 1.1, 0], [0, 1.6, 0.1], [0.2, 0.8, 0.1], [0.2, 0.6, 0.1], [0.1, 0.5, 0.2]])
FACES = [[0, 1, 2], [1, 3, 2], [3, 4, 5]]
OF_JOINTS = [0, 0, 1, 2, 2, 2]


def gf(matrix: np.ndarray) -> Gf.Matrix4d:
    return Gf.Matrix4d(np.asarray(matrix).T.tolist())


def xform(turn=(0.0, 0.0, 0.0), scale=1.0, at=(0.0, 0.0, 0.0)) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix() * scale, at
    return matrix


def moved(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def skeleton(stage, path, bind, rest=None, joints=JOINTS) -> UsdSkel.Skeleton:
    prim = UsdSkel.Skeleton.Define(stage, path)
    order = [JOINTS.index(name) for name in joints]
    prim.CreateJointsAttr(joints)
    prim.CreateBindTransformsAttr([gf(bind[joint]) for joint in order])
    local = kinematics.local_transforms(bind if rest is None else rest, PARENTS)
    prim.CreateRestTransformsAttr([gf(local[joint]) for joint in order])
    return prim


def mesh(stage, path, points, faces, of_joints, bound_to, geom=None) -> None:
    prim = UsdGeom.Mesh.Define(stage, path)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.asarray(points, np.float32)))
    prim.CreateFaceVertexCountsAttr([3] * len(faces))
    prim.CreateFaceVertexIndicesAttr([corner for face in faces for corner in face])
    binding = UsdSkel.BindingAPI.Apply(prim.GetPrim())
    binding.CreateSkeletonRel().SetTargets([bound_to])
    binding.CreateJointIndicesPrimvar(False, 1).Set(of_joints)
    binding.CreateJointWeightsPrimvar(False, 1).Set([1.0] * len(of_joints))
    binding.CreateGeomBindTransformAttr(gf(np.eye(4) if geom is None else geom))


def animate(stage, path, bind, turn, *skeletons) -> None:
    local = kinematics.local_transforms(bind, PARENTS)
    local[:, :3, :3] = local[:, :3, :3] @ Rotation.from_euler("x", np.array(turn)[:, None], degrees=True).as_matrix()
    animation = UsdSkel.Animation.Define(stage, path)
    animation.CreateJointsAttr(JOINTS)
    animation.CreateScalesAttr([Gf.Vec3h(1)] * len(JOINTS))
    quats = Rotation.from_matrix(local[:, :3, :3]).as_quat()
    animation.CreateRotationsAttr().Set([Gf.Quatf(float(w), float(x), float(y), float(z)) for x, y, z, w in quats], 0)
    animation.CreateTranslationsAttr().Set([Gf.Vec3f(*map(float, place)) for place in local[:, :3, 3]], 0)
    for prim in skeletons:
        UsdSkel.BindingAPI.Apply(prim.GetPrim()).CreateAnimationSourceRel().SetTargets([path])


def character(stage, root=None) -> UsdSkel.Skeleton:
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdSkel.Root.Define(stage, "/Hero").AddTransformOp().Set(gf(np.eye(4) if root is None else root))
    prim = skeleton(stage, "/Hero/Rig", BIND)
    mesh(stage, "/Hero/Body", BODY, [[0, 1, 2], [1, 3, 2]], [0, 0, 1, 2], "/Hero/Rig")
    stage.SetDefaultPrim(stage.GetPrimAtPath("/Hero"))
    return prim


def outfit(folder: Path, case: str) -> Path:
    """Write a character and a cape that is bound to a Skeleton of its own."""
    path = folder / "hero.usda"
    stage = Usd.Stage.CreateNew(str(path))
    theirs = character(stage, xform((0, 40, 0), at=(3, 0.5, -2)))
    top, place, bind, rest, geom, joints, raised = "/Hero/Outfit", np.eye(4), BIND, None, np.eye(4), JOINTS, np.eye(4)
    if case == "geomBindTransform":
        geom = xform(at=(0, 0.04, 0))
    elif case == "from centimetres":
        geom = xform((90, 0, 0), 0.01, (0, 0.3, 0))
    elif case == "higher bind pose":
        raised = xform((0, 10, 0), at=(0, 0.04, 0))
        bind, rest = raised @ BIND, BIND
    elif case == "another order":
        joints = ("Hips", "Hips/Leg", "Hips/Spine")
    elif case in ("another root", "in centimetres", "z up"):
        top, place = "/Outfit", xform((0, 40, 0), at=(3, 0.5, -2))
    if case == "in centimetres":
        place = place @ xform(scale=0.01)
        bind = rest = kinematics.rigid(BIND[:, :3, :3], BIND[:, :3, 3] * 100)
        raised = xform(scale=100)
    if case == "z up":
        place, raised = place @ xform((-90, 0, 0)), xform((90, 0, 0))
        bind = rest = raised @ BIND
    (UsdGeom.Xform if top.startswith("/Hero") else UsdSkel.Root).Define(stage, top).AddTransformOp().Set(gf(place))
    if case in ("another pose", "another pose, animated"):
        local = kinematics.local_transforms(BIND, PARENTS)
        local[2, :3, :3] = local[2, :3, :3] @ Rotation.from_euler("z", 50, degrees=True).as_matrix()
        bind = kinematics.world_transforms(local, PARENTS)
        rest = BIND if case == "another pose" else None
        carried = bind @ kinematics.invert_rigid(BIND)
        points = np.array([moved(carried[joint], point) for joint, point in zip(OF_JOINTS, CLOTH)])
    else:
        points = moved(np.linalg.inv(geom) @ raised, CLOTH)
    own = skeleton(stage, f"{top}/Rig", bind, rest, joints)
    indices = [joints.index(JOINTS[joint]) for joint in OF_JOINTS]
    mesh(stage, f"{top}/Cape", points, FACES, indices, f"{top}/Rig", geom)
    if case == "another pose, animated":
        animate(stage, "/Hero/Walk", BIND, [10, 20, -30], theirs, own)
    stage.Save()
    return path


CASES = (
    "geomBindTransform", "from centimetres", "higher bind pose", "another order", "another root", "in centimetres",
    "z up", "another pose", "another pose, animated",
)  # fmt: skip


def seen(stage: Usd.Stage, path: str, code=0) -> np.ndarray:
    """World positions of a mesh as UsdSkel alone computes them."""
    prim = stage.GetPrimAtPath(path)
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root.Find(prim), Usd.TraverseInstanceProxies())
    bound = UsdSkel.BindingAPI(prim).GetInheritedSkeleton()
    points = UsdGeom.Mesh(prim).GetPointsAttr().Get()
    transforms = cache.GetSkelQuery(bound).ComputeSkinningTransforms(code)
    assert cache.GetSkinningQuery(prim).ComputeSkinnedPoints(transforms, points, code)
    world = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(bound.GetPrim())).T
    return moved(world, np.array(points, dtype=np.float64))


def cape_of(path: Path) -> str:
    stage = Usd.Stage.Open(str(path))
    return next(str(prim.GetPath()) for prim in stage.Traverse() if prim.GetName() == "Cape")


@pytest.mark.parametrize("case", CASES)
def test_a_garment_is_read_where_its_own_skeleton_shows_it(tmp_path, case):
    path = outfit(tmp_path, case)
    stage = Usd.Stage.Open(str(path))
    found, garment, _ = read_scene(path, garment="Cape")
    assert found.skeleton.path.endswith(":/Hero/Rig")
    # In the character's bind pose, which its own binding shows in the world.
    expected = seen(stage, cape_of(path))
    world = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath("/Hero/Rig"))).T
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(stage.GetPrimAtPath("/Hero")), Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Rig")))
    posed = world @ np.swapaxes(np.array(query.ComputeSkinningTransforms(0)), -1, -2)
    ours = [moved(posed[joint], point) for joint, point in zip(OF_JOINTS, garment.mesh.points)]
    np.testing.assert_allclose(ours, expected, atol=2e-6)
    np.testing.assert_allclose(garment.mesh.points, CLOTH, atol=2e-6)


@pytest.mark.parametrize("case", CASES)
def test_a_rigged_garment_is_shown_where_its_own_skeleton_showed_it(tmp_path, case):
    path, out = outfit(tmp_path, case), tmp_path / "rigged.usda"
    found, garment, _ = read_scene(path, garment="Cape")
    none = ProxyRig(garment.mesh.path, (), np.zeros(0, int), np.zeros((0, 4, 4)), garment.skin)
    scene = Scene(found, Garment(garment.mesh, garment.skin, np.full(len(CLOTH), 1)), none)
    write_rigged_stage(path, scene, out)
    before, after = Usd.Stage.Open(str(path)), Usd.Stage.Open(str(out))
    np.testing.assert_allclose(seen(after, cape_of(out)), seen(before, cape_of(path)), atol=3e-6)
    bound = UsdSkel.BindingAPI(after.GetPrimAtPath(cape_of(out))).GetInheritedSkeleton()
    assert str(bound.GetPath()) == "/Hero/Rig"
    np.testing.assert_allclose(read_scene(out)[1].mesh.points, CLOTH, atol=2e-6)  # which finds the character again


@pytest.mark.parametrize("by", ["its own skeleton", "both skeletons"])
@pytest.mark.parametrize("case", ["geomBindTransform", "another pose"])
def test_a_shape_that_is_on_is_in_a_rigged_garment_once(tmp_path, case, by):
    path, out = outfit(tmp_path, case), tmp_path / "rigged.usda"
    stage = Usd.Stage.Open(str(path))
    cape, shape = cape_of(path), np.array([[0, 0, 0.05], [0.02, 0, 0], [0, 0.01, 0], [0.03, 0, 0.01]])
    target = UsdSkel.BlendShape.Define(stage, f"{cape}/Full")
    target.CreateOffsetsAttr(Vt.Vec3fArray.FromNumpy(shape.astype("f4")))
    target.CreatePointIndicesAttr([0, 1, 3, 5])
    binding = UsdSkel.BindingAPI(stage.GetPrimAtPath(cape))
    binding.CreateBlendShapesAttr(["Full"])
    binding.CreateBlendShapeTargetsRel().SetTargets([target.GetPath()])
    every = [UsdSkel.Skeleton(prim) for prim in stage.Traverse() if prim.IsA(UsdSkel.Skeleton)]
    for prim in every if by == "both skeletons" else [each for each in every if "Outfit" in str(each.GetPath())]:
        look = UsdSkel.Animation.Define(stage, prim.GetPath().AppendChild("Look"))
        look.CreateBlendShapesAttr(["Full"])
        look.CreateBlendShapeWeightsAttr([0.5])
        UsdSkel.BindingAPI.Apply(prim.GetPrim()).CreateAnimationSourceRel().SetTargets([look.GetPath()])
    stage.Save()
    del stage, target, binding, every, prim, look
    found, garment, _ = read_scene(path, garment="Cape")
    assert np.abs(garment.mesh.points - CLOTH).max() > 0.01
    none = ProxyRig(garment.mesh.path, (), np.zeros(0, int), np.zeros((0, 4, 4)), garment.skin)
    write_rigged_stage(path, Scene(found, Garment(garment.mesh, garment.skin, np.full(len(CLOTH), 1)), none), out)
    np.testing.assert_allclose(read_scene(out)[1].mesh.points, garment.mesh.points, atol=2e-6)


def test_a_garment_in_its_own_file_goes_from_its_bind_pose_to_the_characters(tmp_path):
    hero, own = tmp_path / "hero.usda", tmp_path / "cape.usda"
    stage = Usd.Stage.CreateNew(str(hero))
    character(stage, xform(at=(5, 0, 0)))
    stage.Save()
    stage = Usd.Stage.CreateNew(str(own))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdSkel.Root.Define(stage, "/Cape")
    raised = xform(at=(0, 0.04, 0))
    bind = raised @ BIND
    skeleton(stage, "/Cape/Rig", kinematics.rigid(bind[:, :3, :3], bind[:, :3, 3] * 100))
    mesh(stage, "/Cape/Cape", moved(raised, CLOTH) * 100, FACES, OF_JOINTS, "/Cape/Rig")
    stage.Save()
    garment = read_scene(hero, garment=f"{own}:/Cape/Cape")[1]
    np.testing.assert_allclose(garment.mesh.points, CLOTH, atol=2e-6)


@pytest.mark.parametrize(("other", "is_off"), [([5, 10, 0], False), ([5, 10, 3], True)])
def test_an_animation_of_its_own_moves_a_garment_as_the_characters_or_is_refused(tmp_path, other, is_off):
    path = outfit(tmp_path, "another pose, animated")
    stage = Usd.Stage.Open(str(path))
    animate(stage, "/Hero/Own", BIND, [10, 20, -30], UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Outfit/Rig")))
    for walk, turn in (("/Hero/Walk", [5, 10, 0]), ("/Hero/Own", other)):
        animation = UsdSkel.Animation(stage.GetPrimAtPath(walk))
        turned = Rotation.from_euler("x", np.array(turn)[:, None], degrees=True).as_matrix()
        quats = Rotation.from_matrix(kinematics.local_transforms(BIND, PARENTS)[:, :3, :3] @ turned).as_quat()
        animation.GetRotationsAttr().Set([Gf.Quatf(float(w), *map(float, v)) for *v, w in quats], 12)
    stage.Save()
    if is_off:
        with pytest.raises(SsilkError, match=r"/Hero/Own moves Hips/Leg otherwise than .* at time code 12"):
            read_scene(path, garment="Cape")
        return
    garment = read_scene(path, garment="Cape")[1]
    np.testing.assert_allclose(garment.mesh.points, CLOTH, atol=2e-6)


@pytest.mark.parametrize("name", ["A", "B"])
def test_one_of_two_instances_of_a_character_is_read_and_rigged_where_it_is(tmp_path, name):
    hero, path, out = (tmp_path / f"{each}.usda" for each in ("hero", "two", "rigged"))
    stage = Usd.Stage.CreateNew(str(hero))
    rig = character(stage)
    mesh(stage, "/Hero/Cape", CLOTH, FACES, OF_JOINTS, "/Hero/Rig")
    animate(stage, "/Hero/Walk", BIND, [10, 20, -30], rig)
    stage.Save()
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    UsdGeom.SetStageUpAxis(stage, "Y")
    for instance, place in (("A", xform()), ("B", xform((0, 70, 0), at=(3, 0, 1)))):
        prim = stage.DefinePrim(f"/{instance}", "SkelRoot")
        UsdGeom.Xformable(prim).AddTransformOp().Set(gf(place))
        prim.GetReferences().AddReference("hero.usda")
        prim.SetInstanceable(True)
    stage.Save()
    found, garment, _ = read_scene(path, root=f"/{name}", garment=f"/{name}/Cape")
    np.testing.assert_allclose(garment.mesh.points, CLOTH, atol=2e-6)
    none = ProxyRig(garment.mesh.path, (), np.zeros(0, int), np.zeros((0, 4, 4)), garment.skin)
    write_rigged_stage(path, Scene(found, Garment(garment.mesh, garment.skin, np.full(len(CLOTH), 1)), none), out)
    after = Usd.Stage.Open(str(out))
    for each in ("A", "B"):
        np.testing.assert_allclose(seen(after, f"/{each}/Cape"), seen(stage, f"/{each}/Cape"), atol=3e-6)


SKIN = ("points", "primvars:skel:jointIndices", "primvars:skel:jointWeights", "primvars:skel:geomBindTransform")


@pytest.mark.parametrize("name", SKIN)
@pytest.mark.parametrize("of", ["/Hero/Body", "/Hero/Outfit/Cape"])
def test_what_skinning_begins_with_may_be_a_time_sample_and_may_not_change(tmp_path, of, name):
    path = outfit(tmp_path, "geomBindTransform")
    stage = Usd.Stage.Open(str(path))
    attribute = stage.GetPrimAtPath(of).GetAttribute(name)
    value = attribute.Get()
    attribute.Clear()
    attribute.Set(value, 3)
    attribute.Set(value, 9)
    stage.Save()
    garment = read_scene(path, garment="Cape")[1]
    np.testing.assert_allclose(garment.mesh.points, CLOTH, atol=2e-6)
    found = np.array(value)
    attribute.Set(type(value)((found[::-1] if name.endswith("Indices") else found * 1.1).tolist()), 9)
    stage.Save()
    with pytest.raises(SsilkError, match=f"its {name} changes at time code 9"):
        read_scene(path, garment="Cape")


def test_rounding_of_a_large_value_is_no_change(tmp_path):
    """In centimetres a step of single precision is more than 1e-5."""
    path = outfit(tmp_path, "geomBindTransform")
    stage = Usd.Stage.Open(str(path))
    attribute = stage.GetPrimAtPath("/Hero/Outfit/Cape").GetAttribute("points")
    values = np.array(attribute.Get(), np.float32) + np.float32(170)
    for time, each in ((3, values), (9, np.nextafter(values, np.float32(200)))):
        attribute.Set(Vt.Vec3fArray.FromNumpy(each), time)
    stage.Save()
    read_scene(path, garment="Cape")


def test_a_garments_animation_is_not_compared_with_a_character_that_stands_still(tmp_path):
    """Its motion comes from another file; a clip that an export left on the garment's Skeleton is not played."""
    path = outfit(tmp_path, "another pose")
    stage = Usd.Stage.Open(str(path))
    animate(stage, "/Hero/Own", BIND, [10, 20, -30], UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Outfit/Rig")))
    stage.Save()
    read_scene(path, garment="Cape")


def test_other_axes_of_the_same_joints_move_no_garment_in_its_own_file(tmp_path):
    """Programs turn the axes of joints as they like; where the joints stand is the pose."""
    hero, own = tmp_path / "hero.usda", tmp_path / "cape.usda"
    stage = Usd.Stage.CreateNew(str(hero))
    character(stage)
    stage.Save()
    stage = Usd.Stage.CreateNew(str(own))
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdSkel.Root.Define(stage, "/Cape")
    turned = Rotation.from_euler("x", [[90], [0], [45]], degrees=True).as_matrix()
    skeleton(stage, "/Cape/Rig", kinematics.rigid(BIND[:, :3, :3] @ turned, BIND[:, :3, 3]))
    mesh(stage, "/Cape/Cape", CLOTH, FACES, OF_JOINTS, "/Cape/Rig")
    stage.Save()
    garment = read_scene(hero, garment=f"{own}:/Cape/Cape")[1]
    np.testing.assert_allclose(garment.mesh.points, CLOTH, atol=2e-6)


def test_a_joint_that_only_the_garments_skeleton_has_is_refused_by_name(tmp_path):
    path = outfit(tmp_path, "geomBindTransform")
    stage = Usd.Stage.Open(str(path))
    own = UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Outfit/Rig"))
    own.GetJointsAttr().Set(["Hips", "Hips/Spine", "Hips/Hem"])
    stage.Save()
    with pytest.raises(SsilkError, match=r"weighted to joint 'Hips/Hem', which the character's skeleton does not"):
        read_scene(path, garment="Cape")
