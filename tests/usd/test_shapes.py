# SPDX-License-Identifier: Apache-2.0
"""Bodies and garments of a shape that is on: read as UsdSkel shows them. What shots change is told."""

from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt
from scipy.spatial.transform import Rotation
from ssilk_usd.reading.body_shapes import with_body_shapes
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.reading.scene import read_scene
from ssilk_usd.reading.shapes import AnimatedShape, animated_shapes, tell_animated_shapes
from ssilk_usd.reading.shown import shown_otherwise, tell_shown_otherwise

from ssilk_core.scene import kinematics
from ssilk_core.scene.assets import Motion
from ssilk_core.scene.assets.reshaped import reshaped

BIND = kinematics.rigid(Rotation.from_euler("z", [[10], [-20]], degrees=True).as_matrix(), [[0, 1, 0], [0, 1.4, 0]])
POINTS = np.array([[0, 1.0, 0.1], [0.1, 1, 0], [0, 1.5, 0], [0.1, 0.9, 0]])
OFFSETS = np.array([[0, 0, 0.05], [0.02, 0, 0], [0, 0.01, 0], [0.03, 0, 0.01]])
GEOM = Gf.Matrix4d().SetScale(2) * Gf.Matrix4d().SetTranslate(Gf.Vec3d(0, 0.1, 0))


def gf(matrix: np.ndarray) -> Gf.Matrix4d:
    return Gf.Matrix4d(np.asarray(matrix).T.tolist())


def dressed(folder, weights, *, inbetween=False, sparse=False, order=("Other", "Full")):
    """Write a body and a garment, each with the blendshape `Full`; `weights` are of `order`, constant or samples."""
    path = str(folder / "hero.usda")
    stage = Usd.Stage.CreateNew(path)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdSkel.Root.Define(stage, "/Hero")
    skeleton = UsdSkel.Skeleton.Define(stage, "/Hero/Rig")
    skeleton.CreateJointsAttr(["Hips", "Hips/Spine"])
    binds = kinematics.rigid(BIND[:, :3, :3], BIND[:, :3, 3] * 100)
    skeleton.CreateBindTransformsAttr([gf(matrix) for matrix in binds])
    rest = kinematics.local_transforms(binds, np.array([-1, 0]))
    skeleton.CreateRestTransformsAttr([gf(matrix) for matrix in rest])
    for name in ("Body", "Cape"):
        mesh = UsdGeom.Mesh.Define(stage, f"/Hero/{name}")
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy((POINTS * 100).astype("f4")))
        mesh.CreateFaceVertexCountsAttr([3, 3])
        mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 0, 3, 1])
        binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
        binding.CreateSkeletonRel().SetTargets(["/Hero/Rig"])
        binding.CreateJointIndicesPrimvar(False, 1).Set([0, 0, 1, 0])
        binding.CreateJointWeightsPrimvar(False, 1).Set([1.0] * 4)
        binding.CreateGeomBindTransformAttr(GEOM)
        shape = UsdSkel.BlendShape.Define(stage, f"/Hero/{name}/Full")
        rows = [1, 3] if sparse else [0, 1, 2, 3]
        shape.CreateOffsetsAttr(Vt.Vec3fArray.FromNumpy((OFFSETS[rows] * 100).astype("f4")))
        if sparse:
            shape.CreatePointIndicesAttr(rows)
        if inbetween:
            half = shape.CreateInbetween("half")
            half.SetWeight(0.5)
            half.SetOffsets(Vt.Vec3fArray.FromNumpy((OFFSETS[rows] * 30).astype("f4")))
        binding.CreateBlendShapesAttr(["Full"])
        binding.CreateBlendShapeTargetsRel().SetTargets([shape.GetPath()])
    animation = UsdSkel.Animation.Define(stage, "/Hero/Rig/Look")
    animation.CreateJointsAttr(["Hips", "Hips/Spine"])
    local = kinematics.local_transforms(binds, np.array([-1, 0]))
    quats = Rotation.from_matrix(local[:, :3, :3]).as_quat()
    animation.CreateRotationsAttr([Gf.Quatf(float(w), float(x), float(y), float(z)) for x, y, z, w in quats])
    animation.CreateTranslationsAttr([Gf.Vec3f(*map(float, place)) for place in local[:, :3, 3]])
    animation.CreateScalesAttr([Gf.Vec3h(1)] * 2)
    animation.CreateBlendShapesAttr(order)
    if isinstance(weights, dict):
        for code, row in weights.items():
            animation.CreateBlendShapeWeightsAttr().Set(row, code)
    else:
        animation.CreateBlendShapeWeightsAttr(weights)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets(["/Hero/Rig/Look"])
    stage.SetTimeCodesPerSecond(30)
    stage.Save()
    return path


def seen(path: str, mesh: str, code: float) -> np.ndarray:
    """World positions [m] that UsdSkel bakes into the points of a mesh."""
    stage = Usd.Stage.Open(Usd.Stage.Open(path).Flatten())
    root = UsdSkel.Root(stage.GetPrimAtPath("/Hero"))
    assert UsdSkel.BakeSkinning(root, Gf.Interval(code, code))
    prim = stage.GetPrimAtPath(mesh)
    place = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(prim))
    return (np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(code)) @ place[:3, :3] + place[3, :3]) * 0.01


CASES = {
    "on": ([0.0, 1.0], {}),
    "half on": ([0.3, 0.5], {}),
    "an in-between": ([0.0, 0.5], {"inbetween": True}),
    "over one": ([0.0, 1.5], {}),
    "sparse": ([0.0, 1.0], {"sparse": True}),
    "off": ([1.0, 0.0], {}),
    "animated": ({1: [0.0, 0.25], 5: [0.0, 1.0]}, {}),
}


@pytest.mark.parametrize(("weights", "options"), CASES.values(), ids=CASES)
def test_a_shape_that_is_on_is_the_one_that_is_read(tmp_path, weights, options):
    path = dressed(tmp_path, weights, **options)
    character, garment, _ = read_scene(path, garment="Cape")
    (body,) = character.bodies
    for mesh, name in ((body.mesh, "Body"), (garment.mesh, "Cape")):  # the animation holds the bind pose
        np.testing.assert_allclose(mesh.points, seen(path, f"/Hero/{name}", 1), atol=2e-6)


def test_what_a_motion_makes_of_shapes_is_told(tmp_path):
    path = dressed(tmp_path, [0.0, 1.0])
    assert animated_shapes(path, path) == []
    moving = tmp_path / "shot"
    moving.mkdir()
    shot = dressed(moving, {1: [0.0, 0.25], 5: [0.0, 1.0]})
    assert [str(found) for found in animated_shapes(path, shot, garment="Cape")] == [
        "'Full' of Cape, from 0.25 to 1 where the character's stage has 1"
    ]
    (tmp_path / "without").mkdir()
    without = dressed(tmp_path / "without", [0.0], order=("Other",))
    np.testing.assert_allclose(seen(without, "/Hero/Body", 1), (POINTS * 2 + [0, 0.001, 0]), atol=2e-6)
    assert [str(found) for found in animated_shapes(path, without, garment="Cape")] == [
        "'Full' of Cape, 0 where the character's stage has 1"
    ]
    alone = Usd.Stage.CreateNew(str(tmp_path / "clip.usda"))  # which leaves the shape as it is
    Sdf.CopySpec(Sdf.Layer.FindOrOpen(without), "/Hero/Rig/Look", alone.GetRootLayer(), "/Look")
    alone.Save()
    assert animated_shapes(path, str(tmp_path / "clip.usda"), garment="Cape") == []


def test_a_shape_of_a_body_that_a_joint_carries_is_read(tmp_path):
    """UsdSkel moves the points of a mesh without influences by the blendshapes that its skeleton has on."""
    path = dressed(tmp_path, [0.0, 1.0])
    stage = Usd.Stage.Open(path)
    body, look = stage.GetPrimAtPath("/Hero/Body"), UsdSkel.Animation(stage.GetPrimAtPath("/Hero/Rig/Look"))
    for name in ("Indices", "Weights"):
        body.RemoveProperty(f"primvars:skel:joint{name}")
    place, hips = UsdGeom.Xformable(body).AddTranslateOp(), list(look.GetTranslationsAttr().Get())
    for code in (1, 2, 3):
        moved = Gf.Vec3f(10 * (code - 1), 0, 0)
        place.Set(Gf.Vec3d(moved), code)
        look.GetTranslationsAttr().Set([hips[0] + moved, hips[1]], code)
        look.GetRotationsAttr().Set(look.GetRotationsAttr().Get(), code)
    stage.Save()
    (body,) = read_scene(path, garment="Cape")[0].bodies
    np.testing.assert_allclose(body.mesh.points, seen(path, "/Hero/Body", 1), atol=2e-6)


def mm(metres: float) -> str:
    return f"{1000 * metres:.3g}" if metres < 1 else f"{1000 * metres:.0f}"


def body(stage: Usd.Stage) -> UsdGeom.Mesh:
    return UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Body"))


def sculpted(stage: Usd.Stage) -> None:
    body(stage).GetPointsAttr().Set([point + Gf.Vec3f(0, 0, 5) for point in body(stage).GetPointsAttr().Get()])


def cached(stage: Usd.Stage) -> None:
    points = body(stage).GetPointsAttr().Get()
    for code in (1, 5):
        body(stage).GetPointsAttr().Set([point + Gf.Vec3f(0, 0, code - 1) for point in points], code)


def unbound_cache(stage: Usd.Stage) -> None:
    cached(stage)
    UsdSkel.BindingAPI(body(stage)).GetSkeletonRel().SetTargets([])


def breathing(stage: Usd.Stage) -> None:
    """A corrective that the shot alone has."""
    breath = UsdSkel.BlendShape.Define(stage, "/Hero/Body/Breath")
    breath.CreateOffsetsAttr([Gf.Vec3f(0, 0, 4)] * 4)
    binding = UsdSkel.BindingAPI(body(stage))
    binding.GetBlendShapesAttr().Set(["Full", "Breath"])
    binding.GetBlendShapeTargetsRel().SetTargets(["/Hero/Body/Full", breath.GetPath()])
    look = UsdSkel.Animation(stage.GetPrimAtPath("/Hero/Rig/Look"))
    look.GetBlendShapesAttr().Set(["Other", "Full", "Breath"])
    look.GetBlendShapeWeightsAttr().Set([0.0, 1.0, 0.0], 1)
    look.GetBlendShapeWeightsAttr().Set([0.0, 1.0, 1.0], 5)


def twitching(stage: Usd.Stage) -> None:
    """A corrective that is keyed at each of 300 frames and on at three of them; a joint bends at three others."""
    breathing(stage)
    look = UsdSkel.Animation(stage.GetPrimAtPath("/Hero/Rig/Look"))
    rest = look.GetRotationsAttr().Get()
    for code in range(1, 301):
        look.GetBlendShapeWeightsAttr().Set([0.0, 1.0, float(150 <= code <= 152)], code)
        look.GetRotationsAttr().Set(rest, code)


def twitching_joint(stage: Usd.Stage) -> None:
    """Other weights, which show while a joint is bent: at three of 300 frames."""
    UsdSkel.BindingAPI(body(stage)).GetJointIndicesPrimvar().Set([1, 1, 0, 1])
    look = UsdSkel.Animation(stage.GetPrimAtPath("/Hero/Rig/Look"))
    rest = look.GetRotationsAttr().Get()
    for code in range(1, 301):
        turn = Gf.Quatf(0.8, 0.6, 0, 0) if 150 <= code <= 152 else Gf.Quatf(1)
        look.GetRotationsAttr().Set([rest[0], rest[1] * turn], code)


def following_another(stage: Usd.Stage) -> None:
    """A second Skeleton, which nothing animates, holds the body at rest."""
    reweighed(stage)
    body(stage).GetPrim().RemoveProperty("primvars:skel:jointIndices")
    hero = Sdf.Layer.FindOrOpen(str(Path(stage.GetRootLayer().realPath).parent / "hero.usda"))
    Sdf.CopySpec(hero, "/Hero/Rig", stage.GetRootLayer(), "/Hero/Other")
    UsdSkel.BindingAPI(stage.GetPrimAtPath("/Hero/Other")).GetAnimationSourceRel().SetTargets([])
    UsdSkel.BindingAPI(body(stage)).GetSkeletonRel().SetTargets(["/Hero/Other"])


def sculpted_shape(stage: Usd.Stage) -> None:
    UsdSkel.BlendShape.Get(stage, "/Hero/Body/Full").GetOffsetsAttr().Set([Gf.Vec3f(0, 0, 9)] * 4)


def over(folder: Path) -> tuple[str, Usd.Stage]:
    hero = dressed(folder, [0.0, 1.0])
    stage = Usd.Stage.CreateNew(str(folder / "shot.usda"))
    stage.GetRootLayer().subLayerPaths.append("./hero.usda")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Y")
    return hero, stage


def test_a_body_of_other_points_in_a_shot_is_told_with_how_far_it_is_off(tmp_path):
    hero, stage = over(tmp_path)
    sculpted(stage)
    stage.Save()
    shot = str(tmp_path / "shot.usda")
    off = np.linalg.norm(seen(shot, "/Hero/Body", 1) - seen(hero, "/Hero/Body", 1), axis=1).max()
    (told,) = shown_otherwise(hero, shot, garment="Cape")
    assert told.startswith(f"it shapes Body otherwise, by up to {mm(off)} mm")


def met(hero: str, shot: str) -> tuple[Motion, dict[float, np.ndarray]]:
    """A shot's motion with the shapes of the body, and where cloth meets this [m], by time code."""
    character = read_scene(hero, garment="Cape")[0]
    motion = with_body_shapes(hero, shot, read_motion(shot, character.skeleton), character, garment="Cape")
    matrices = kinematics.skinning_matrices(
        kinematics.motion_transforms(motion, character.skeleton.parents), character.skeleton.bind_transforms
    )
    posed = kinematics.skin_points(kinematics.body_at_rest(character, motion), character.bodies[0].skin, matrices)
    return motion, {motion.start + frame: points for frame, points in enumerate(posed)}


FOLLOWED = [breathing, sculpted_shape, twitching]


@pytest.mark.parametrize("change", FOLLOWED)
def test_a_body_that_a_shot_shapes_is_met_as_it_is_seen(tmp_path, change):
    hero, stage = over(tmp_path)
    change(stage)
    stage.Save()
    shot = str(tmp_path / "shot.usda")
    motion, body = met(hero, shot)
    rest = seen(hero, "/Hero/Body", 1)
    off = 0.0
    for code in [code for code in (1, 5, 149, 151, 153) if code in body] or body:
        now = seen(shot, "/Hero/Body", code)
        np.testing.assert_allclose(body[code], now, atol=2e-6)
        off = max(off, float(np.linalg.norm(now - rest, axis=1).max()))
    (told,) = reshaped(read_scene(hero, garment="Cape")[0], motion)
    assert off > 0.01 and told.metres == pytest.approx(off, abs=2e-6)
    assert shown_otherwise(hero, shot, garment="Cape") == []


def reweighed(stage: Usd.Stage) -> None:
    """Other weights, which only a posed body shows."""
    UsdSkel.BindingAPI(body(stage)).GetJointIndicesPrimvar().Set([1, 1, 0, 1])
    look = UsdSkel.Animation(stage.GetPrimAtPath("/Hero/Rig/Look"))
    rest = look.GetRotationsAttr().Get()
    for code, turn in ((1, Gf.Quatf(1)), (5, Gf.Quatf(0.8, 0.6, 0, 0))):
        look.GetRotationsAttr().Set([rest[0], rest[1] * turn], code)


def moving_bind(stage: Usd.Stage) -> None:
    """A geomBindTransform that changes over time, while a joint moves."""
    reweighed(stage)
    binding = UsdSkel.BindingAPI(body(stage))
    binding.GetPrim().RemoveProperty("primvars:skel:jointIndices")
    for code in (1, 5):
        binding.GetGeomBindTransformAttr().Set(GEOM * Gf.Matrix4d().SetTranslate((0, 0, code - 1)), code)


def sculpted_in_another_bind_pose(stage: Usd.Stage) -> None:
    in_another_bind_pose(stage)
    sculpted(stage)


def bound_lower(stage: Usd.Stage) -> None:
    """Another bind pose of the skeleton alone, which takes the body with it."""
    rig = UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Rig"))
    moved = Gf.Matrix4d().SetTranslate(Gf.Vec3d(0, 30, 0))
    rig.GetBindTransformsAttr().Set([bind * moved for bind in rig.GetBindTransformsAttr().Get()])


def unbound(stage: Usd.Stage) -> None:
    """A body that no joint moves any more: it stands where its points are."""
    UsdSkel.BindingAPI(body(stage)).GetSkeletonRel().SetTargets([])


POSED = [
    twitching_joint,
    following_another,
    reweighed,
    moving_bind,
    sculpted_in_another_bind_pose,
    bound_lower,
    unbound,
]


@pytest.mark.parametrize("change", POSED)
def test_a_body_that_a_shot_moves_otherwise_is_told_with_how_far_it_is_off(tmp_path, change):
    """Posed by the shot's joints: by the weights, bind pose and placement of the shot, and by the character's."""
    hero, stage = over(tmp_path)
    change(stage)
    stage.Save()
    shot = str(tmp_path / "shot.usda")
    alone = Usd.Stage.CreateNew(str(tmp_path / "alone.usda"))  # the character's own body, in the shot's motion
    alone.GetRootLayer().subLayerPaths.append("./hero.usda")
    if look := stage.GetRootLayer().GetPrimAtPath("/Hero/Rig/Look"):
        Sdf.CreatePrimInLayer(alone.GetRootLayer(), "/Hero/Rig")
        Sdf.CopySpec(stage.GetRootLayer(), look.path, alone.GetRootLayer(), look.path)
    alone.Save()
    off = max(
        np.linalg.norm(
            seen(shot, "/Hero/Body", code) - seen(str(tmp_path / "alone.usda"), "/Hero/Body", code), axis=1
        ).max()
        for code in (1, 5, 151)
    )
    told = next(text for text in shown_otherwise(hero, shot, garment="Cape") if "the garment" not in text)
    another = change is following_another
    how = "Body follows another Skeleton, /Hero/Other; " if another else "it shapes Body otherwise, "
    assert off > 0.005 and told.startswith(how) and f" by up to {mm(off)} mm at time code " in told


def with_more_points(stage: Usd.Stage, path: str) -> None:
    """A body of another level of detail: one more point, a hand's breadth away."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
    points = [*mesh.GetPointsAttr().Get(), Gf.Vec3f(0, 90, 20)]
    mesh.GetPointsAttr().Set(points)
    mesh.GetFaceVertexCountsAttr().Set([3, 3, 3])
    mesh.GetFaceVertexIndicesAttr().Set([0, 1, 2, 0, 3, 1, 0, 3, 4])
    binding = UsdSkel.BindingAPI(mesh)
    binding.GetJointIndicesPrimvar().Set([0, 0, 1, 0, 0])
    binding.GetJointWeightsPrimvar().Set([1.0] * 5)


def deactivated(stage: Usd.Stage) -> None:
    body(stage).GetPrim().SetActive(False)


def made_a_guide(stage: Usd.Stage) -> None:
    UsdGeom.Imageable(body(stage)).CreatePurposeAttr("guide")


def made_a_proxy(stage: Usd.Stage) -> None:
    UsdGeom.Imageable(body(stage)).CreatePurposeAttr("proxy")


def cut(stage: Usd.Stage) -> None:
    body(stage).GetFaceVertexCountsAttr().Set([3])
    body(stage).GetFaceVertexIndicesAttr().Set([0, 1, 2])


def holed(stage: Usd.Stage) -> None:
    body(stage).CreateHoleIndicesAttr([1])


def swapped(stage: Usd.Stage) -> None:
    padded(stage)
    with_more_points(stage, "/Hero/Padding")
    deactivated(stage)


def padded(stage: Usd.Stage) -> None:
    layer = Sdf.Layer.FindOrOpen(str(Path(stage.GetRootLayer().realPath).parent / "hero.usda"))
    Sdf.CreatePrimInLayer(stage.GetRootLayer(), "/Hero")
    Sdf.CopySpec(layer, "/Hero/Body", stage.GetRootLayer(), "/Hero/Padding")


def retopologized(stage: Usd.Stage) -> None:
    with_more_points(stage, "/Hero/Body")


LACKS = "it shows no mesh Body that is the character's; cloth meets it, and it is seen in what is written"
ALONE = "Padding follows its skeleton and is not in the character's stage; "
OTHER = "it shapes Body otherwise, with other points; "


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (deactivated, [LACKS]),
        (made_a_guide, ["it gives Body the purpose guide; cloth meets it, and it is seen in what is written"]),
        (made_a_proxy, ["it gives Body the purpose proxy; cloth meets it, and it is seen in what is written"]),
        (cut, ["it shows 1 faces of Body instead of 2; "]),
        (holed, ["it shows 1 faces of Body instead of 2; "]),
        (swapped, [LACKS, ALONE]),
        (padded, [ALONE]),
        (retopologized, [OTHER]),
    ],
)
def test_a_body_that_a_shot_lacks_swaps_or_adds_is_told(tmp_path, change, words):
    hero, stage = over(tmp_path)
    change(stage)
    stage.Save()
    told = shown_otherwise(hero, str(tmp_path / "shot.usda"), garment="Cape")
    assert len(told) == len(words) and all(text.startswith(word) for text, word in zip(told, words))


def test_of_bodies_that_were_not_chosen_nothing_is_told(tmp_path):
    hero = dressed(tmp_path, [0.0, 1.0])
    stage = Usd.Stage.Open(hero)
    Sdf.CopySpec(stage.GetRootLayer(), "/Hero/Body", stage.GetRootLayer(), "/Hero/Hair")
    stage.Save()
    shot = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    shot.GetRootLayer().subLayerPaths.append("./hero.usda")
    shot.GetPrimAtPath("/Hero/Hair").SetActive(False)
    shot.Save()
    words = [*shown_otherwise(hero, str(tmp_path / "shot.usda"), garment="Cape", bodies=["Body"])]
    assert words == []
    assert len(shown_otherwise(hero, str(tmp_path / "shot.usda"), garment="Cape")) == 1


def test_a_shot_of_another_character_lacks_nothing(tmp_path):
    hero = dressed(tmp_path, [0.0, 1.0])
    (tmp_path / "other").mkdir()
    stage = Usd.Stage.Open(dressed(tmp_path / "other", [0.0, 1.0]))
    padded(stage)
    for name in ("Body", "Cape"):
        stage.RemovePrim(f"/Hero/{name}")
    UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Padding")).GetFaceVertexIndicesAttr().Set([0, 2, 1, 0, 1, 3])
    stage.Save()
    assert shown_otherwise(hero, str(tmp_path / "other/hero.usda"), garment="Cape") == []


def exported(stage: Usd.Stage, names: dict[str, str], folder: Path) -> str:
    """Write a shot as programs export it that give meshes other names; return its path."""
    layer = Sdf.Layer.CreateNew(str(folder / "exported.usda"))
    layer.TransferContent(stage.Flatten())
    edit = Sdf.BatchNamespaceEdit()
    for name, other in names.items():
        edit.Add(f"/Hero/{name}", f"/Hero/{other}")
    assert layer.Apply(edit)
    shot = Usd.Stage.Open(layer)
    for name, other in names.items():
        targets = UsdSkel.BindingAPI(shot.GetPrimAtPath(f"/Hero/{other}")).GetBlendShapeTargetsRel()
        targets.SetTargets([path.ReplacePrefix(f"/Hero/{name}", f"/Hero/{other}") for path in targets.GetTargets()])
    layer.Save()
    return layer.realPath


@pytest.mark.parametrize("change", [sculpted, *FOLLOWED, unbound_cache])
def test_a_body_that_a_shot_calls_otherwise_is_known_by_its_faces(tmp_path, change):
    hero, stage = over(tmp_path)
    change(stage)
    shot = exported(stage, {"Body": "ann_Body", "Cape": "Cape_001"}, tmp_path)
    if change in FOLLOWED:
        for code, points in list(met(hero, shot)[1].items())[::75]:
            np.testing.assert_allclose(points, seen(shot, "/Hero/ann_Body", code), atol=2e-6)
        assert shown_otherwise(hero, shot, garment="Cape") == []
        return
    (told,) = shown_otherwise(hero, shot, garment="Cape")
    if change is unbound_cache:
        assert told.startswith("ann_Body is a point cache, which is not followed; ")
        return
    rest = seen(hero, "/Hero/Body", 1)
    off = max(np.linalg.norm(seen(shot, "/Hero/ann_Body", code) - rest, axis=1).max() for code in (1, 5))
    assert told.startswith(f"it shapes ann_Body otherwise, by up to {mm(off)} mm")


def test_a_shape_that_is_told_by_its_name_is_told_once(tmp_path):
    hero, stage = over(tmp_path)
    UsdSkel.Animation(stage.GetPrimAtPath("/Hero/Rig/Look")).GetBlendShapeWeightsAttr().Set([0.0, 0.5])
    stage.Save()
    told: list[str] = []
    tell_shown_otherwise(hero, [str(tmp_path / "shot.usda")], lambda event: told.append(str(event)), garment="Cape")
    assert len(told) == 1 and "'Full' of Cape" in told[0]


@pytest.mark.parametrize("name", ["Body", "Cape"])
def test_a_part_that_a_shot_hides_is_told(tmp_path, name):
    hero, stage = over(tmp_path)
    visibility = UsdGeom.Imageable(stage.GetPrimAtPath(f"/Hero/{name}")).CreateVisibilityAttr()
    visibility.Set("inherited", 1)
    visibility.Set("invisible", 3)
    stage.Save()
    (told,) = shown_otherwise(hero, str(tmp_path / "shot.usda"), garment="Cape")
    assert told.startswith(f"{name} is hidden at time code 3; ")


def test_a_part_that_the_character_itself_hides_in_time_is_told_beside_any_clip(tmp_path):
    hero = dressed(tmp_path, [0.0, 1.0])
    stage = Usd.Stage.Open(hero)
    visibility = UsdGeom.Imageable(stage.GetPrimAtPath("/Hero/Body")).CreateVisibilityAttr()
    visibility.Set("invisible", 1)
    visibility.Set("inherited", 2)
    stage.Save()
    clip = Usd.Stage.CreateNew(str(tmp_path / "clip.usda"))
    Sdf.CopySpec(stage.GetRootLayer(), "/Hero/Rig/Look", clip.GetRootLayer(), "/Look")
    clip.Save()
    (told,) = shown_otherwise(hero, str(tmp_path / "clip.usda"), garment="Cape")
    assert told.startswith("Body is hidden at time code 1 of its own stage; ")


def in_another_bind_pose(stage: Usd.Stage) -> None:
    rig = UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Rig"))
    moved = Gf.Matrix4d().SetTranslate(Gf.Vec3d(0, 30, 0))
    rig.GetBindTransformsAttr().Set([bind * moved for bind in rig.GetBindTransformsAttr().Get()])
    for name in ("Body", "Cape"):
        binding = UsdSkel.BindingAPI(stage.GetPrimAtPath(f"/Hero/{name}"))
        binding.GetGeomBindTransformAttr().Set(binding.GetGeomBindTransformAttr().Get() * moved)


def hidden_as_a_whole(stage: Usd.Stage) -> None:
    UsdGeom.Imageable(stage.GetPrimAtPath("/Hero")).CreateVisibilityAttr().Set("invisible", 3)


@pytest.mark.parametrize("change", [lambda stage: None, in_another_bind_pose, hidden_as_a_whole])
def test_what_is_seen_as_the_character_has_it_is_not_told(tmp_path, change):
    hero, stage = over(tmp_path)
    change(stage)
    stage.Save()
    assert shown_otherwise(hero, str(tmp_path / "shot.usda"), garment="Cape") == []


def test_a_body_that_is_a_point_cache_in_a_shot_is_told(tmp_path):
    hero, stage = over(tmp_path)
    unbound_cache(stage)
    stage.Save()
    (told,) = shown_otherwise(hero, str(tmp_path / "shot.usda"), garment="Cape")
    assert told.startswith("Body is a point cache, which is not followed; ")


def test_later_points_of_a_skinned_mesh_are_not_shown_and_not_told(tmp_path):
    hero, stage = over(tmp_path)
    cached(stage)
    stage.Save()
    shot = str(tmp_path / "shot.usda")
    np.testing.assert_array_equal(seen(shot, "/Hero/Body", 5), seen(hero, "/Hero/Body", 1))
    assert shown_otherwise(hero, shot, garment="Cape") == []


def test_a_motion_on_a_skeleton_without_bind_pose_is_no_fault(tmp_path):
    hero, stage = over(tmp_path)
    stage.GetPrimAtPath("/Hero/Rig").GetAttribute("bindTransforms").Block()
    stage.Save()
    assert shown_otherwise(hero, str(tmp_path / "shot.usda"), garment="Cape") == []


def test_of_bodies_of_one_name_each_is_compared_with_its_own(tmp_path):
    hero = dressed(tmp_path, [0.0, 1.0])
    stage = Usd.Stage.Open(hero)
    UsdGeom.Scope.Define(stage, "/Hero/Shoes")
    Sdf.CopySpec(stage.GetRootLayer(), "/Hero/Body", stage.GetRootLayer(), "/Hero/Shoes/Body")
    twin = UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/Shoes/Body")).GetPointsAttr()
    twin.Set([point + Gf.Vec3f(0, 30, 0) for point in twin.Get()])
    stage.Save()
    shot = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    shot.GetRootLayer().subLayerPaths.append("./hero.usda")
    UsdGeom.SetStageMetersPerUnit(shot, 0.01)
    UsdGeom.SetStageUpAxis(shot, "Y")
    shot.Save()
    path = str(tmp_path / "shot.usda")
    assert shown_otherwise(hero, path, garment="Cape") == []
    sculpted(shot)
    shot.Save()
    off = np.linalg.norm(seen(path, "/Hero/Body", 1) - seen(hero, "/Hero/Body", 1), axis=1).max()
    (told,) = shown_otherwise(hero, path, garment="Cape")
    assert told.startswith(f"it shapes Body otherwise, by up to {mm(off)} mm")


def test_shapes_of_one_mesh_hide_those_of_no_other():
    found = [AnimatedShape(*each) for each in (
        ("Brow", "Body", 0, 0, 1), ("Heavy", "Body", 0, 1, 1), ("Heavy", "Skirt", 0, 0.3, 1),
    )]  # fmt: skip
    told: list[str] = []
    tell_animated_shapes("shot.usda", found, lambda event: told.append(event.text))
    assert len(told) == 1 and told[0].startswith(
        "shot.usda: it weighs blendshapes that are not followed: 'Brow' of Body, from 0 to 1 where the character's "
        "stage has 0; 'Heavy' of Skirt, from 0.3 to 1 where the character's stage has 0, and 1 more; "
    )
