# SPDX-License-Identifier: Apache-2.0
"""Bodies of one stage by weights of its blendshapes: points as UsdSkel shows them, and joints that follow."""

from itertools import pairwise

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
from ssilk_usd.opening.shaped import body_parameters
from ssilk_usd.opening.stage import open_stage, stage_name, used_files
from ssilk_usd.reading.body_shapes import with_body_shapes
from ssilk_usd.reading.character import read_character
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.reading.shown import shown_otherwise
from ssilk_usd.writing.left_behind import left_behind
from ssilk_usd.writing.look import as_it_looks

from ssilk_core.errors import SsilkError
from ssilk_core.files import split_location
from ssilk_core.scene.assets import Garment
from ssilk_core.scene.family import with_joints

from .test_read import RECIPES, author

JOINTS = ["Hips", "Hips/Spine", "Hips/Spine/Head"]
HEIGHTS = np.array([80.0, 120.0, 150.0])  # [cm]
GEOM = Gf.Matrix4d().SetScale(2) * Gf.Matrix4d().SetTranslate(Gf.Vec3d(0, 10, 0))
TURNED = Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(0, 0, 1), 30))


def pillar() -> np.ndarray:
    """Points around an axis at eight heights (V, 3) [cm], in bind space."""
    angle, height = (each.reshape(-1) for each in np.meshgrid(np.arange(6) * np.pi / 3, np.linspace(60, 170, 8)))
    return np.stack([15 * np.sin(angle), height, 15 * np.cos(angle)], axis=1)


BODY = pillar()
EYES = np.array([[-3.0, 155, 14], [3, 155, 14], [0, 160, 14]])
TALL, WIDE = BODY * [0, 0.2, 0], BODY * [0.3, 0, 0.3]


def define_mesh(stage: Usd.Stage, name: str, points: np.ndarray, weights: np.ndarray) -> UsdSkel.BindingAPI:
    """Define a skinned mesh; points in bind space, weights (V, 3)."""
    mesh = UsdGeom.Mesh.Define(stage, f"/Hero/{name}")
    own = (points - [0, 10, 0]) / 2
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(own.astype("f4")))
    faces = np.array([[i, i + 1, i + 2] for i in range(len(points) - 2)])
    mesh.CreateFaceVertexCountsAttr([3] * len(faces))
    mesh.CreateFaceVertexIndicesAttr(faces.reshape(-1).tolist())
    mesh.CreateNormalsAttr([Gf.Vec3f(0, 1, 0)] * len(points))
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateGeomBindTransformAttr(GEOM)
    binding.CreateJointIndicesPrimvar(False, 3).Set([0, 1, 2] * len(points))
    binding.CreateJointWeightsPrimvar(False, 3).Set(weights.reshape(-1).tolist())
    return binding


def add_shape(stage: Usd.Stage, mesh: str, name: str, offsets: np.ndarray, half=None) -> Usd.Prim:
    """Add a blendshape with offsets in bind space, and an in-between at a half."""
    shape = UsdSkel.BlendShape.Define(stage, f"/Hero/{mesh}/{name}")
    shape.CreateOffsetsAttr(Vt.Vec3fArray.FromNumpy((offsets / 2).astype("f4")))
    if half is not None:
        between = shape.CreateInbetween("half")
        between.SetWeight(0.5)
        between.SetOffsets(Vt.Vec3fArray.FromNumpy((half / 2).astype("f4")))
    binding = UsdSkel.BindingAPI(stage.GetPrimAtPath(f"/Hero/{mesh}"))
    binding.CreateBlendShapesAttr([*(binding.GetBlendShapesAttr().Get() or ()), name])
    targets = binding.CreateBlendShapeTargetsRel().GetTargets()
    binding.CreateBlendShapeTargetsRel().SetTargets([*targets, shape.GetPath()])
    return shape.GetPrim()


def say(shape: Usd.Prim, name: str, kind: Sdf.ValueTypeName, value: object) -> None:
    shape.CreateAttribute(f"ssilk:{name}", kind, False, Sdf.VariabilityUniform).Set(value)


@pytest.fixture
def hero(tmp_path):
    """A pillar in centimetres with eyes, which have no shapes, and a clip that weighs one; the file."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "hero.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Y")
    stage.SetTimeCodesPerSecond(30)
    root = UsdSkel.Root.Define(stage, "/Hero")
    UsdGeom.Xformable(root).AddTranslateOp().Set(Gf.Vec3d(0, 0, 50))
    rig = UsdSkel.Skeleton.Define(stage, "/Hero/Rig")
    rig.CreateJointsAttr(JOINTS)
    binds = [TURNED * Gf.Matrix4d().SetTranslate(Gf.Vec3d(0, height, 0)) for height in HEIGHTS]
    rig.CreateBindTransformsAttr(binds)
    rig.CreateRestTransformsAttr([binds[0], *(own * above.GetInverse() for above, own in pairwise(binds))])
    UsdSkel.BindingAPI.Apply(root.GetPrim()).CreateSkeletonRel().SetTargets([rig.GetPath()])
    at = np.interp(BODY[:, 1], [95, 105, 130, 140], [0, 1, 1, 2])
    define_mesh(stage, "Body", BODY, np.stack([(1 - at).clip(0), 1 - abs(at - 1), (at - 1).clip(0)], axis=1))
    define_mesh(stage, "Eyes", EYES, np.array([[0.0, 0, 1]] * 3))
    say(add_shape(stage, "Body", "tall", TALL), "weightRange", Sdf.ValueTypeNames.Float2, (-0.5, 1))
    add_shape(stage, "Body", "wide", WIDE, half=0.1 * WIDE)
    animation = UsdSkel.Animation.Define(stage, "/Hero/Rig/Clip")
    animation.CreateJointsAttr(JOINTS)
    animation.CreateTranslationsAttr([Gf.Vec3f(0, 80, 0), Gf.Vec3f(0, 40, 0), Gf.Vec3f(0, 30, 0)])
    animation.CreateRotationsAttr([Gf.Quatf(1)] * 3)
    animation.CreateScalesAttr([Gf.Vec3h(1)] * 3)
    animation.CreateBlendShapesAttr(["tall", "wide"])
    for code, row in enumerate(([0.0, 0.0], [1.0, 0.5])):
        animation.CreateBlendShapeWeightsAttr().Set(row, code)
    stage.GetRootLayer().Save()
    return str(tmp_path / "hero.usda")


def moved(hero: str, shapes: str) -> tuple[np.ndarray, np.ndarray]:
    """How far a body's points and joints are from the stage's own [m]."""
    own, its = read_character(hero), read_character(f"{hero}:{shapes}")
    np.testing.assert_array_equal(its.skeleton.bind_transforms[:, :3, :3], own.skeleton.bind_transforms[:, :3, :3])
    points = np.concatenate([b.mesh.points - a.mesh.points for a, b in zip(own.bodies, its.bodies)])
    return points, (its.skeleton.bind_transforms - own.skeleton.bind_transforms)[:, :3, 3]


def test_a_body_has_its_shapes_and_joints_that_follow_them(hero):
    points, joints = moved(hero, "tall=1")
    np.testing.assert_allclose(points[: len(BODY)], TALL / 100, atol=1e-6)
    np.testing.assert_allclose(joints, np.outer(HEIGHTS, [0, 0.2, 0]) / 100, atol=1e-5)
    np.testing.assert_allclose(points[len(BODY) :], [[0, 0.3, 0]] * 3, atol=1e-5)  # the eyes, with the head


def test_weights_add_up_and_in_betweens_count(hero):
    points, joints = moved(hero, "tall=-0.5,wide=0.5")
    np.testing.assert_allclose(points[: len(BODY)], (0.1 * WIDE - 0.5 * TALL) / 100, atol=1e-6)
    np.testing.assert_allclose(joints, np.outer(HEIGHTS, [0, -0.1, 0]) / 100, atol=1e-5)


def test_the_rest_pose_goes_along(hero):
    own, its = (read_character(path).skeleton for path in (hero, f"{hero}:tall=1"))
    np.testing.assert_array_equal(its.rest_transforms[..., :3, :3], own.rest_transforms[..., :3, :3])
    stage, cache = open_stage(f"{hero}:tall=1"), UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(stage.GetPrimAtPath("/Hero")), Usd.PrimDefaultPredicate)
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Rig"))
    query = cache.GetSkelQuery(skeleton)
    rest = np.array(query.ComputeJointSkelTransforms(0.0, True))
    np.testing.assert_allclose(rest, np.array(skeleton.GetBindTransformsAttr().Get()), atol=1e-4)


def test_a_blendshape_says_how_joints_move(hero):
    stage = Usd.Stage.Open(hero)
    shape = stage.GetPrimAtPath("/Hero/Body/tall")
    say(shape, "offsetJoints", Sdf.ValueTypeNames.TokenArray, ["Hips/Spine"])
    say(shape, "jointOffsets", Sdf.ValueTypeNames.Vector3fArray, [(0, 7, 1)])
    stage.Save()
    _, joints = moved(hero, "tall=-0.5")
    np.testing.assert_allclose(joints, [[0, -0.08, 0], [0, -0.035, -0.005], [0, -0.15, 0]], atol=1e-5)
    shape.GetAttribute("ssilk:offsetJoints").Set(["Hips/Spin"])
    stage.Save()
    with pytest.raises(SsilkError, match=r"offsetJoints of 'tall' has 'Hips/Spin'; .* did you mean 'Hips/Spine'"):
        read_character(f"{hero}:tall=1")


def test_a_stage_says_which_body_it_is_and_its_file_stays(hero, tmp_path):
    before = (tmp_path / "hero.usda").read_bytes()
    stage = open_stage(f"{hero}:wide=0.50")
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Body"))
    assert stage_name(stage) == f"{hero}:wide=0.5" and used_files(stage) == used_files(hero)
    assert list(UsdSkel.BindingAPI(mesh).GetBlendShapesAttr().Get()) == ["tall"]
    assert not mesh.GetNormalsAttr().HasAuthoredValue()  # they would be those of another shape
    assert read_character(stage).path == f"{hero}:wide=0.5:/Hero"
    assert (tmp_path / "hero.usda").read_bytes() == before and stage_name(open_stage(hero)) == hero


def test_an_instance_is_shaped_too(hero, tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "crowd.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Y")
    prim = stage.DefinePrim("/Hero")
    prim.GetReferences().AddReference(hero, "/Hero")
    stage.DefinePrim("/Crowd", "Xform").GetReferences().AddInternalReference("/Hero")
    stage.GetPrimAtPath("/Hero").SetInstanceable(True)
    stage.GetRootLayer().Save()
    own, its = (read_character(path, root="/Hero") for path in (hero, f"{tmp_path}/crowd.usda:tall=1"))
    np.testing.assert_allclose(its.bodies[0].mesh.points - own.bodies[0].mesh.points, TALL / 100, atol=1e-6)


REFUSED = {
    "tall=1.5": "shape 'tall' weighs 1.5; -0.5 to 1 is allowed",
    "wide=-0.1": "shape 'wide' weighs -0.1; 0 to 1 is allowed; its ssilk:weightRange may say otherwise",
    "tal=1": "no body has the blendshape 'tal'; it is one of tall, wide; did you mean 'tall'?",
    "tall": "'tall' is no shape with a weight",
}


@pytest.mark.parametrize(("shapes", "told"), REFUSED.items())
def test_what_the_body_cannot_be_is_refused(hero, shapes, told):
    with pytest.raises(SsilkError) as refused:
        open_stage(f"{hero}:{shapes}")
    assert str(refused.value).startswith(f"{hero}:{shapes}: {told}")


def test_the_ends_of_a_range_are_allowed_as_they_were_written(hero):
    """A float2 stores 0.35 as 0.349999994, and -0.2 as -0.200000003."""
    stage = Usd.Stage.Open(hero)
    say(stage.GetPrimAtPath("/Hero/Body/wide"), "weightRange", Sdf.ValueTypeNames.Float2, (-0.2, 0.35))
    stage.Save()
    wide = body_parameters(open_stage(hero))["wide"]
    assert (wide.low, wide.high) == (-0.2, 0.35)
    for end in ("-0.2", "0.35"):
        assert open_stage(f"{hero}:wide={end}")


MALFORMED = (
    ("weightRange", Sdf.ValueTypeNames.Float2, (0.5, 1), r"weightRange is \(0.5, 1\); a range holds 0"),
    ("weightRange", Sdf.ValueTypeNames.Float, 2.0, "weightRange is 2.0; a float2 is needed"),
    ("jointOffsets", Sdf.ValueTypeNames.Vector3fArray, [(0, 1, 0)], "1 ssilk:jointOffsets.* for 0 ssilk:offset"),
)


@pytest.mark.parametrize(("name", "kind", "value", "told"), MALFORMED)
def test_malformed_marks_are_refused(hero, name, kind, value, told):
    stage = Usd.Stage.Open(hero)
    say(stage.GetPrimAtPath("/Hero/Body/wide"), name, kind, value)
    stage.Save()
    with pytest.raises(SsilkError, match=told):
        body_parameters(open_stage(hero))


def test_a_parameter_is_known_by_its_mark_on_any_of_its_meshes(hero):
    stage = Usd.Stage.Open(hero)
    shape = add_shape(stage, "Eyes", "wide", 0 * EYES)
    say(shape, "weightRange", Sdf.ValueTypeNames.Float2, (-1, 2))
    stage.Save()
    known = body_parameters(open_stage(hero))
    assert {name: (of.low, of.high, of.is_marked) for name, of in known.items()} == {
        "tall": (-0.5, 1, True), "wide": (-1, 2, True),
    }  # fmt: skip
    say(stage.GetPrimAtPath("/Hero/Body/wide"), "weightRange", Sdf.ValueTypeNames.Float2, (0, 2))
    stage.Save()
    with pytest.raises(SsilkError, match="another 'wide' has another range"):
        body_parameters(open_stage(hero))


def test_a_shot_does_not_shape_the_body_again_and_what_it_animates_is_told(hero):
    for shapes, followed in (("tall=1", {"wide", "wide_half"}), ("wide=1", {"tall"})):
        body = f"{hero}:{shapes}"
        character = read_character(body)
        motion = with_body_shapes(body, hero, read_motion(hero, character.skeleton), character)
        assert {shape.name for shape in motion.shapes} <= followed
        (told,) = shown_otherwise(body, hero)
        assert told.startswith(f"it animates {shapes[:4]}, by which the character's stage sets the body")
    assert not shown_otherwise(hero, hero)


@pytest.mark.parametrize("recipe", RECIPES.values(), ids=RECIPES)
def test_joints_follow_in_whichever_space_a_program_writes_its_bind_pose(tmp_path, recipe):
    path = str(tmp_path / "hero.usda")
    stage = author(Usd.Stage.CreateNew(path), recipe)
    stage.Save()
    own = read_character(path)
    local = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Body")).GetPointsAttr().Get(), dtype=float)
    to_core = np.linalg.lstsq(np.c_[local, np.ones(len(local))], own.bodies[0].mesh.points, rcond=None)[0]
    add_shape(stage, "Body", "big", 2 * 0.2 * own.bodies[0].mesh.points @ np.linalg.inv(to_core[:3]))
    stage.Save()
    its = read_character(f"{path}:big=1")
    grown = with_joints(own.skeleton, 1.2 * own.skeleton.bind_transforms[:, :3, 3])
    np.testing.assert_allclose(its.bodies[0].mesh.points, 1.2 * own.bodies[0].mesh.points, atol=1e-5)
    np.testing.assert_allclose(its.skeleton.bind_transforms, grown.bind_transforms, atol=1e-5)
    np.testing.assert_allclose(its.skeleton.rest_transforms[1:], grown.rest_transforms[1:], atol=1e-5)
    turned = [each.skeleton.rest_transforms[0, :3, :3] for each in (its, own)]
    np.testing.assert_allclose(*turned, atol=1e-6)


def test_looks_and_what_nobody_writes_are_found_on_a_body_by_shapes(hero):
    stage = Usd.Stage.Open(hero)
    UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Eyes")).CreateDisplayColorAttr([Gf.Vec3f(0.5, 0.25, 0)])
    stage.Save()
    character = read_character(f"{hero}:tall=1")
    eyes = next(body.mesh for body in character.bodies if body.mesh.path.endswith("Eyes"))
    assert as_it_looks(Garment(eyes), split_location(character.path)[0]).colour == pytest.approx((0.5, 0.25, 0))
    assert left_behind(character, [eyes]) == left_behind(read_character(hero), [eyes]) == ["the Mesh Body"]
