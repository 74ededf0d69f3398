# SPDX-License-Identifier: Apache-2.0
"""Colliders, gravity and wind from stages, with USD's own transforms and skinning as the reference."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdSkel, Vt
from ssilk_usd.reading import colliders
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.reading.posed import SkinnedMesh, skinning_of
from ssilk_usd.reading.world import AskedWorld, find_world
from ssilk_usd.writing.files import write_motion

from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import Air, Body, Character, Collider, Mesh, Motion, ShotWorld, Skeleton, SkinWeights

FPS, FRAMES, FIRST = 25.0, 5, 10
TO_CORE = {"Y": np.eye(3), "Z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])}


def character() -> Character:
    skeleton = Skeleton("/Hero", ("Hips",), [-1], np.eye(4)[None], np.eye(4)[None])
    mesh = Mesh("shot.usda:/Hero/Body", np.eye(3), np.array([[0, 1, 2]]))
    return Character("/Hero", skeleton, (Body(mesh, SkinWeights.rigid("/Hero/Body", 0, 3)),))


def motion() -> Motion:
    return Motion("shot", FPS, np.tile([1.0, 0, 0, 0], (FRAMES, 1, 1)), np.zeros((FRAMES, 1, 3)), FIRST)


def clip(stage: Usd.Stage) -> None:
    animation = UsdSkel.Animation.Define(stage, "/Clip")
    animation.CreateJointsAttr(["Hips"])
    animation.CreateRotationsAttr().Set([Gf.Quatf(1)], FIRST)
    animation.CreateTranslationsAttr().Set([Gf.Vec3f(0)], FIRST)
    animation.CreateScalesAttr([Gf.Vec3h(1)])


@pytest.fixture
def stage(tmp_path) -> Usd.Stage:
    """A shot in centimetres, z up, two time codes a frame; a test adds what surrounds the character."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Z")
    stage.SetTimeCodesPerSecond(2 * FPS)
    clip(stage)
    return stage


def codes() -> np.ndarray:
    return 2.0 * (FIRST + np.arange(FRAMES))


def read(
    stage: Usd.Stage, *, garment: str | None = None, report=lambda event: None, lenient=None, **asked
) -> ShotWorld | None:
    stage.GetRootLayer().Save()
    path = stage.GetRootLayer().realPath
    found = find_world(path, path, character(), motion(), AskedWorld(**asked), garment=garment, report=report)
    return found.read(lenient=lenient)


def quad(stage: Usd.Stage, path: str, size: float = 100.0) -> UsdGeom.Mesh:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([(-size, -size, 0), (size, -size, 0), (size, size, 0), (-size, size, 0)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    return mesh


def colliding(prim: Usd.Prim) -> UsdPhysics.CollisionAPI:
    return UsdPhysics.CollisionAPI.Apply(prim)


def placed(world: ShotWorld, frame: int, index: int = 0) -> np.ndarray:
    """Points of a collider in the core's world [m] at a frame."""
    own = world.colliders[index]
    points, place = (each[min(frame, len(each) - 1)] for each in (own.points, own.placements))
    return points @ place[:3, :3].T + place[:3, 3]


def evaluated(mesh: UsdGeom.Mesh, code: float) -> np.ndarray:
    """Points of a mesh in metres, y up, by USD's own transform."""
    matrix = np.array(mesh.ComputeLocalToWorldTransform(Usd.TimeCode(code)))
    points = np.array(mesh.GetPointsAttr().Get(code), dtype=float) @ matrix[:3, :3] + matrix[3, :3]
    return points @ TO_CORE["Z"].T * 0.01


def test_a_stage_without_any_of_it_says_nothing(stage):
    quad(stage, "/Set/Floor")
    UsdPhysics.Scene.Define(stage, "/Physics")  # with the usual gravity
    assert read(stage) is None


def test_a_collider_is_where_usd_has_it_at_each_frame_of_the_motion(stage):
    parent = UsdGeom.Xform.Define(stage, "/Set")
    parent.AddRotateXYZOp().Set((10, 20, 30))
    parent.AddScaleOp().Set((2, 0.5, -1))
    floor = quad(stage, "/Set/Floor")
    turn = floor.AddRotateYOp()
    turn.Set(0.0, 0)
    turn.Set(90.0, 60)
    colliding(floor.GetPrim())
    still = quad(stage, "/Still")
    still.AddTranslateOp().Set((1, 2, 3))
    colliding(still.GetPrim())
    world = read(stage)
    assert world is not None and world.fps == FPS and len(world.colliders) == 2
    for frame, code in enumerate(codes()):
        np.testing.assert_allclose(placed(world, frame, 0), evaluated(floor, code), atol=1e-9)
        np.testing.assert_allclose(placed(world, frame, 1), evaluated(still, code), atol=1e-9)
    assert len(world.colliders[1].points) == len(world.colliders[1].placements) == 1


def test_a_collider_that_turns_under_a_constant_scale_keeps_its_points(stage):
    floor = quad(stage, "/Floor")
    turn = floor.AddRotateZOp()
    turn.Set(0.0, 0)
    turn.Set(90.0, 60)
    floor.AddScaleOp().Set((2, 3, 1))
    colliding(floor.GetPrim())
    own = read(stage).colliders[0]
    assert len(own.points) == 1 and len(own.placements) == FRAMES


def test_points_that_change_are_read_at_each_frame(stage):
    floor = quad(stage, "/Floor")
    points = np.array(floor.GetPointsAttr().Get())
    for code in (0, 100):
        floor.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points + [0, 0, code]), code)
    colliding(floor.GetPrim())
    world = read(stage)
    for frame, code in enumerate(codes()):
        np.testing.assert_allclose(placed(world, frame), evaluated(floor, code), atol=1e-7)
    assert np.ptp([placed(world, frame)[0, 1] for frame in range(FRAMES)]) > 0.07


def test_a_skinned_collider_is_posed_by_usdskel(stage):
    UsdSkel.Root.Define(stage, "/Horse").AddTranslateOp().Set((0, 300, 0))
    rig = UsdSkel.Skeleton.Define(stage, "/Horse/Rig")
    rig.CreateJointsAttr(["Back"])
    rig.CreateBindTransformsAttr([Gf.Matrix4d(1)])
    rig.CreateRestTransformsAttr([Gf.Matrix4d(1)])
    animation = UsdSkel.Animation.Define(stage, "/Horse/Gait")
    animation.CreateJointsAttr(["Back"])
    animation.CreateRotationsAttr([Gf.Quatf(1)])
    animation.CreateScalesAttr([Gf.Vec3h(1)])
    for code in (0, 60):
        animation.CreateTranslationsAttr().Set([Gf.Vec3f(0, 0, code)], code)
    UsdSkel.BindingAPI.Apply(rig.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    body = quad(stage, "/Horse/Body")
    binding = UsdSkel.BindingAPI.Apply(body.GetPrim())
    binding.CreateSkeletonRel().SetTargets([rig.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 1).Set([0] * 4)
    binding.CreateJointWeightsPrimvar(False, 1).Set([1.0] * 4)
    colliding(body.GetPrim())
    stage.GetRootLayer().Save()
    path = f"{stage.GetRootLayer().realPath}:/Clip"
    world = find_world(path, stage.GetRootLayer().realPath, character(), motion()).read()
    player = SkinnedMesh(body.GetPrim(), *skinning_of(stage)[body.GetPrim()])
    for frame, code in enumerate(codes()):
        expected = player.points(Usd.TimeCode(code), UsdGeom.XformCache(code)) @ TO_CORE["Z"].T * 0.01
        np.testing.assert_allclose(placed(world, frame), expected, atol=1e-9)
        assert placed(world, frame)[0, 1] == pytest.approx(0.01 * code, abs=1e-6)


def test_instances_are_met_at_their_places(stage, tmp_path):
    quad(stage, "/_Chair/Seat", 20)
    colliding(stage.GetPrimAtPath("/_Chair/Seat"))
    stage.GetPrimAtPath("/_Chair").SetSpecifier(Sdf.SpecifierClass)
    for name, x in ("A", 50.0), ("B", -70.0):
        chair = UsdGeom.Xform.Define(stage, f"/{name}")
        chair.AddTranslateOp().Set((x, 0, 0))
        chair.GetPrim().GetReferences().AddInternalReference("/_Chair")
        chair.GetPrim().SetInstanceable(True)
    world = read(stage)
    assert sorted(placed(world, 0, index)[:, 0].mean() for index in range(2)) == pytest.approx([-0.7, 0.5])


def test_hidden_shapes_collide_where_the_api_says_so_and_when_it_is_enabled(stage):
    floor = quad(stage, "/Floor")
    UsdGeom.Imageable(floor).MakeInvisible()
    floor.CreatePurposeAttr(UsdGeom.Tokens.guide)
    enabled = colliding(floor.GetPrim()).CreateCollisionEnabledAttr()
    enabled.Set(False)
    assert read(stage) is None
    enabled.Clear()
    for frame, code in enumerate(codes()):
        enabled.Set(frame >= 2, code)
    np.testing.assert_array_equal(read(stage).colliders[0].present, [False, False, True, True, True])


def test_prims_are_named_by_path_or_name_and_stand_for_what_is_rendered_below_them(stage):
    for name, purpose in ("Render", "render"), ("Stand", "proxy"), ("Helper", "guide"):
        quad(stage, f"/Set/Chair/{name}").CreatePurposeAttr(purpose)
    quad(stage, "/Set/Other")
    for name in "Chair", "/Set/Chair", "Render":
        world = read(stage, colliders=(name,))
        assert [own.path.rsplit("/", 1)[1] for own in world.colliders] == ["Render"]


def test_the_garment_and_the_body_of_the_character_are_no_colliders(stage):
    for path in "/Hero/Body", "/Hero/Cape", "/Hero/Skirt":
        colliding(quad(stage, path).GetPrim())
    stage.GetPrimAtPath("/Hero/Cape").CreateAttribute("ssilk:garment", Sdf.ValueTypeNames.Bool).Set(True)
    assert read(stage, garment="/Hero/Skirt") is None
    for name, what in ("/Hero/Body", "own body"), ("Cape", "is a garment"), ("Skirt", "is a garment"):
        with pytest.raises(SsilkError, match=what):
            read(stage, garment="/Hero/Skirt", colliders=(name,))


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
def test_solids_have_the_extents_and_the_volume_that_usd_says(stage, axis):
    solids = {
        "Cube": (UsdGeom.Cube, {"size": 30.0}, 27000.0),
        "Sphere": (UsdGeom.Sphere, {"radius": 30.0}, 4 / 3 * np.pi * 27000),
        "Capsule": (UsdGeom.Capsule, {"radius": 10.0, "height": 50.0}, np.pi * 5000 + 4 / 3 * np.pi * 1000),
        "Cylinder": (UsdGeom.Cylinder, {"radius": 10.0, "height": 50.0}, np.pi * 5000),
        "Cone": (UsdGeom.Cone, {"radius": 10.0, "height": 50.0}, np.pi * 5000 / 3),
        "Plane": (UsdGeom.Plane, {"width": 30.0, "length": 70.0}, 0.0),
    }
    for name, (schema, sizes, _) in solids.items():
        prim = schema.Define(stage, f"/{name}").GetPrim()
        for size, length in sizes.items():
            prim.GetAttribute(size).Set(length)
        if prim.HasAttribute("axis"):
            prim.GetAttribute("axis").Set(axis)
        colliding(prim)
    world = read(stage)
    assert len(world.colliders) == len(solids)
    for index, (name, (_, _, volume)) in enumerate(solids.items()):
        points = placed(world, 0, index) @ TO_CORE["Z"] * 100
        extent = UsdGeom.Boundable.ComputeExtentFromPlugins(UsdGeom.Boundable(stage.GetPrimAtPath(f"/{name}")), 0)
        np.testing.assert_allclose([points.min(axis=0), points.max(axis=0)], extent, atol=1e-4, err_msg=name)
        a, b, c = points[world.colliders[index].faces].transpose(1, 0, 2)
        assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(volume, rel=0.005, abs=1e-6), name
    told = []
    UsdGeom.Points.Define(stage, "/Dust")
    colliding(stage.GetPrimAtPath("/Dust"))
    read(stage, report=told.append)
    assert any("cloth does not meet it: it is a Points" in str(event) for event in told)
    with pytest.raises(SsilkError, match="/Dust is a Points; colliders are of the types Mesh, Plane, Cube"):
        read(stage, colliders=("Dust",))


def test_gravity_is_that_of_the_physics_scene_in_its_units_and_over_time(stage):
    scene = UsdPhysics.Scene.Define(stage, "/Physics")
    scene.CreateGravityMagnitudeAttr(162.0)
    np.testing.assert_allclose(read(stage).gravity, [[0, -1.62, 0]], atol=1e-6)
    scene.CreateGravityDirectionAttr().Set(Gf.Vec3f(0, 0, -2), 20)
    scene.GetGravityDirectionAttr().Set(Gf.Vec3f(3, 0, 0), 28)
    found = read(stage).gravity
    assert found.shape == (FRAMES, 3)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.62, rtol=1e-6)
    np.testing.assert_allclose(found[[0, -1]], [[0, -1.62, 0], [1.62, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(read(stage, gravity=(0.0, 0.0, 5.0)).gravity, [[0, 5, 0]])
    UsdPhysics.Scene.Define(stage, "/Other")
    with pytest.raises(SsilkError, match="2 PhysicsScenes: /Physics, /Other"):
        read(stage)


def test_wind_is_an_attribute_of_the_physics_scene_over_time(stage):
    prim = UsdPhysics.Scene.Define(stage, "/Physics").GetPrim()
    wind = prim.CreateAttribute("ssilk:wind", Sdf.ValueTypeNames.Vector3f)
    wind.Set(Gf.Vec3f(0, -500, 0))
    air = read(stage).air
    np.testing.assert_allclose(air.velocity, [[0, 0, 5]], atol=1e-9)
    assert air.gusts == 0
    wind.Set(Gf.Vec3f(0), 20)
    wind.Set(Gf.Vec3f(800, 0, 0), 28)
    for name, number in ("gusts", 150.0), ("gustLength", 80.0):
        prim.CreateAttribute(f"ssilk:{name}", Sdf.ValueTypeNames.Float).Set(number)
    prim.CreateAttribute("ssilk:gustSeed", Sdf.ValueTypeNames.Int).Set(4)
    air = read(stage).air
    np.testing.assert_allclose(air.velocity[:, 0], [0, 2, 4, 6, 8], atol=1e-6)
    assert (air.gusts.max(), air.length, air.seed) == (pytest.approx(1.5), pytest.approx(0.8), 4)
    asked = read(stage, wind=(0.0, -1.0, 0.0), gusts=(2.0, 3.0, 9)).air
    np.testing.assert_allclose(asked.velocity, [[0, 0, 1]])
    assert (asked.gusts, asked.length, asked.seed) == (2, 3, 9)


@pytest.mark.parametrize("keyed", [False, True])
def test_a_motion_is_written_with_its_gravity_and_wind(tmp_path, keyed):
    many = FRAMES if keyed else 1
    rng = np.random.default_rng(1)
    pull, blown = rng.normal(size=(many, 3)) * 10, rng.normal(size=(many, 3)) * 5
    world = ShotWorld(motion().fps, gravity=pull, air=Air(blown, np.abs(blown[:, 0]), length=1.25, seed=3))
    path, skeleton = tmp_path / "clip.usdc", character().skeleton
    write_motion(path, motion(), skeleton, world)
    again = read_motion(str(path), skeleton)
    found = find_world(str(path), str(path), character(), again).read()
    np.testing.assert_allclose(found.gravity, pull, atol=1e-5)
    np.testing.assert_allclose(found.air.velocity, blown, atol=1e-5)
    np.testing.assert_allclose(found.air.gusts, np.abs(blown[:, 0]), atol=1e-5)
    assert (found.air.length, found.air.seed) == (1.25, 3)


def test_colliders_are_read_as_they_were_written(tmp_path):
    """One that moves and is absent for a while, one that changes its shape, and one that stands still."""
    rng, faces = np.random.default_rng(2), np.array([[0, 1, 2], [2, 1, 3]])
    turns = np.tile(np.eye(4), (FRAMES, 1, 1))
    for place in turns:
        place[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        place[:3, :3] *= np.linalg.det(place[:3, :3])
        place[:3, 3] = rng.normal(size=3)
    always, points = np.ones(1, bool), rng.normal(size=(FRAMES, 4, 3))
    written = (
        Collider("Böx.001", faces, points[:1], turns, np.arange(FRAMES) != 2),
        Collider("Böx.002", faces, points, np.eye(4)[None], always),
        Collider("2", faces, points[:1], np.eye(4)[None], always),
    )
    path, skeleton = tmp_path / "clip.usdc", character().skeleton
    write_motion(path, motion(), skeleton, ShotWorld(FPS, written))
    again = read_motion(str(path), skeleton)
    world = find_world(str(path), str(path), character(), again).read()
    assert (world.gravity, world.air, len(world.colliders)) == (None, None, 3)
    for before, after in zip(written, world.colliders):
        np.testing.assert_array_equal(after.faces, faces)
        np.testing.assert_array_equal(after.present, before.present)
        for frame in range(FRAMES):
            np.testing.assert_allclose(placed_of(after, frame), placed_of(before, frame), atol=1e-6)
    assert [len(each.points) for each in world.colliders] == [1, FRAMES, 1]


def placed_of(collider: Collider, frame: int) -> np.ndarray:
    """Return the points of a collider in the world, shape (P, 3)."""
    points, place = (part[frame % len(part)] for part in (collider.points, collider.placements))
    return points @ place[:3, :3].T + place[:3, 3]


def test_the_stage_of_the_character_gives_what_the_shot_lacks(stage, tmp_path):
    home = Usd.Stage.CreateNew(str(tmp_path / "hero.usda"))
    UsdGeom.SetStageMetersPerUnit(home, 1.0)
    UsdGeom.SetStageUpAxis(home, "Y")
    colliding(quad(home, "/Ground", 1.0).GetPrim())
    home.GetRootLayer().Save()
    stage.GetRootLayer().Save()
    paths = stage.GetRootLayer().realPath, home.GetRootLayer().realPath
    world = find_world(*paths, character(), motion()).read()
    np.testing.assert_allclose(np.ptp(placed(world, 0), axis=0), [2, 2, 0])
    colliding(quad(stage, "/Floor", 50.0).GetPrim())
    stage.GetRootLayer().Save()
    own = find_world(*paths, character(), motion()).read()
    assert [each.path.rsplit("/", 1)[1] for each in own.colliders] == ["Floor"]


def broken(stage: Usd.Stage, what: str) -> dict:
    floor = quad(stage, "/Floor")
    colliding(floor.GetPrim())
    if what == "faces":
        floor.GetFaceVertexIndicesAttr().Set([0, 1, 2, 3], 1)
        floor.GetFaceVertexIndicesAttr().Set([3, 2, 1, 0], 2)
    if what == "points":
        floor.GetPointsAttr().Set([(0, 0, 0)] * 4, 20)
        floor.GetPointsAttr().Set([(0, 0, 0)] * 5, 24)
    if what == "nan":
        floor.GetPointsAttr().Set([(0, 0, np.nan)] * 4)
    if what == "empty":
        floor.GetHoleIndicesAttr().Set([0])
    if what == "size":
        cube = UsdGeom.Cube.Define(stage, "/Box")
        colliding(cube.GetPrim())
        for code in (1, 2):
            cube.CreateSizeAttr().Set(float(code), code)
    if what == "vector":
        prim = UsdPhysics.Scene.Define(stage, "/Physics").GetPrim()
        prim.CreateAttribute("ssilk:wind", Sdf.ValueTypeNames.String).Set("north")
    asked = {"unknown": {"colliders": ("Chair",)}, "storm": {"wind": (500.0, 0.0, 0.0)}}
    return asked.get(what, {})


@pytest.mark.parametrize(
    ("what", "complaint"),
    [
        ("faces", "its faces change over time; the topology of a collider stays"),
        ("points", "5 points at time code 24, and 4 before"),
        ("nan", "NaN or infinity"),
        ("empty", "the mesh has no faces"),
        ("size", "the size of this Cube changes"),
        ("vector", "ssilk:wind is north; a vector of three numbers is needed"),
        ("unknown", "--collider Chair: .*has no such prim; there are /Floor"),
        ("storm", "at most 100 m/s"),
    ],
)
def test_what_cannot_surround_a_character_is_refused_in_one_sentence(stage, what, complaint):
    with pytest.raises(SsilkError, match=complaint):
        read(stage, **broken(stage, what))


def test_what_an_instancer_scatters_is_not_met_where_its_prototype_lies(stage):
    stone = quad(stage, "/Set/Stones/Prototypes/Stone", 10)
    colliding(stone.GetPrim())
    stones = UsdGeom.PointInstancer.Define(stage, "/Set/Stones")
    stones.CreatePrototypesRel().SetTargets([stone.GetPath()])
    stones.CreateProtoIndicesAttr([0, 0])
    stones.CreatePositionsAttr([(500, 0, 0), (0, 500, 0)])
    told = []
    assert read(stage, report=lambda event: told.append(event.text)) is None
    assert "it is scattered by the PointInstancer /Set/Stones" in told[0] and len(told) == 1
    with pytest.raises(SsilkError, match="/Stone is scattered by the PointInstancer /Set/Stones"):
        read(stage, colliders=("Stone",))


def test_the_body_of_another_character_of_a_crowd_is_met_by_each(stage, tmp_path):
    """Also of the one that is at the path which the character has in its own stage."""
    home = Usd.Stage.CreateNew(str(tmp_path / "hero.usda"))
    UsdSkel.Root.Define(home, "/Hero")
    rig = UsdSkel.Skeleton.Define(home, "/Hero/Rig")
    rig.CreateJointsAttr(["Hips"])
    for attribute in (rig.CreateBindTransformsAttr(), rig.CreateRestTransformsAttr()):
        attribute.Set([Gf.Matrix4d(1)])
    animation = UsdSkel.Animation.Define(home, "/Hero/Walk")
    UsdSkel.BindingAPI.Apply(rig.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    body = quad(home, "/Hero/Body").GetPrim()
    binding = UsdSkel.BindingAPI.Apply(body)
    binding.CreateSkeletonRel().SetTargets([rig.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 1).Set([0] * 4)
    binding.CreateJointWeightsPrimvar(False, 1).Set([1.0] * 4)
    colliding(body)
    home.GetRootLayer().Save()
    for name in ("Hero", "Twin"):
        stage.DefinePrim(f"/{name}").GetReferences().AddReference("./hero.usda", "/Hero")
    stage.GetRootLayer().Save()
    shot, own = stage.GetRootLayer().realPath, home.GetRootLayer().realPath
    for name, other in ("Hero", "Twin"), ("Twin", "Hero"):
        world = find_world(f"{shot}:/{name}/Walk", own, character(), motion()).read()
        assert [each.path for each in world.colliders] == [f"{shot}:/{other}/Body"]


def test_all_colliders_together_have_room_for_so_many_points(stage, monkeypatch):
    monkeypatch.setattr(colliders, "MOST_POINTS", 4 * FRAMES + 1)
    for name in "AB":
        points = quad(stage, f"/{name}").GetPointsAttr()
        for code in (0, 100):
            points.Set(Vt.Vec3fArray.FromNumpy(np.array(points.Get(0.0)) + [0, 0, 1]), code)
    colliding(stage.GetPrimAtPath("/A"))
    assert len(read(stage).colliders) == 1
    colliding(stage.GetPrimAtPath("/B"))
    with pytest.raises(SsilkError, match="4 points in 5 frames; at most 21 of all colliders together change, of"):
        read(stage)
    stage.RemovePrim("/B")
    scale = quad(stage, "/C", 2).AddScaleOp()
    scale.Set((1, 1, 1), 0)
    scale.Set((1, 1, 2), 100)
    colliding(stage.GetPrimAtPath("/C"))
    with pytest.raises(SsilkError, match="of which 1 are left"):
        read(stage)


def test_what_surrounds_a_character_is_found_without_reading_shapes(stage):
    mesh = quad(stage, "/Floor")
    mesh.GetFaceVertexCountsAttr().Set([3], 5)  # which no collider may do
    colliding(mesh.GetPrim())
    UsdPhysics.Scene.Define(stage, "/Physics").CreateGravityMagnitudeAttr(100.0)
    stage.GetRootLayer().Save()
    path = stage.GetRootLayer().realPath
    found = find_world(path, path, character(), motion())
    assert found.parts == ("colliders", "its gravity")
    with pytest.raises(SsilkError, match="its faces change over time"):
        found.read()
