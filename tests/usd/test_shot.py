# SPDX-License-Identifier: Apache-2.0
"""A written shot, re-skinned by UsdSkel alone, is what the decoder computes."""

import re
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import ssilk_usd.shots.shot as shot_module
from pxr import Sdf, Usd, UsdGeom, UsdSkel
from ssilk_usd.checking.shot import allowed_error, check_shot, compare_points
from ssilk_usd.reading.character import read_character
from ssilk_usd.reading.garment import read_garment
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.reading.polygons import triangulate
from ssilk_usd.reading.scene import read_scene
from ssilk_usd.shots.layers import Layout
from ssilk_usd.shots.layers_animation import write_points
from ssilk_usd.shots.layers_asset import write_asset
from ssilk_usd.shots.play import Shot
from ssilk_usd.shots.points import point_cache
from ssilk_usd.shots.read import read_baked
from ssilk_usd.shots.shot import write_shot
from ssilk_usd.shots.skinned import SkinnedGarment
from ssilk_usd.shots.velocities import with_velocities
from ssilk_usd.units import StageUnits
from ssilk_usd.writing.author import prim_names
from ssilk_usd.writing.files import write_scene

from ssilk_core.errors import SsilkError, VerificationError
from ssilk_core.scene.assets import (
    Body,
    Character,
    Deformer,
    Garment,
    GarmentPose,
    Mesh,
    Motion,
    ProxyRig,
    Scene,
    Skeleton,
    SkinWeights,
)
from ssilk_core.scene.kinematics import (
    deform,
    local_transforms,
    matrix_from_quaternion,
    motion_transforms,
    rigid,
    skin_points,
    skinning_matrices,
    sorted_influences,
)

SHARED = Path(__file__).parents[2] / ".." / "shared"
METRES_Y, CENTIMETRES_Z = StageUnits(1.0, "Y"), StageUnits(0.01, "Z")
FRAMES = 20


def quaternions(rng: np.random.Generator, *shape: int) -> np.ndarray:
    q = rng.normal(size=(*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def strip(name: str, rows: int = 9, columns: int = 4) -> Mesh:
    """A hanging strip of quads, the first two merged to a hexagon, the last split into triangles."""
    u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    points = np.stack([0.4 * u - 0.2, 1.5 - v, 0.1 * np.sin(3 * u)], axis=-1).reshape(-1, 3)
    corner = np.arange(rows * columns).reshape(rows, columns)
    quads = np.stack([corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]], axis=-1).reshape(-1, 4)
    a, b = quads[:2]
    polygons = [
        [a[0], a[1], a[2], b[2], b[3], a[3]],
        *quads[2:-1].tolist(),
        quads[-1][:3].tolist(),
        quads[-1][[0, 2, 3]].tolist(),
    ]
    counts, indices = np.array([len(p) for p in polygons]), np.concatenate(polygons)
    uvs = np.stack([u, v], axis=-1).reshape(-1, 2)[indices]
    return Mesh(name, points, triangulate(points, counts, indices), counts, indices, uvs)


def random_skin(rng: np.random.Generator, vertices: int, joints: int) -> SkinWeights:
    weights = rng.random((vertices, 4)) * (rng.random((vertices, 4)) > 0.4)
    weights[:, 0] += 0.1
    return SkinWeights("strip", rng.integers(0, joints, (vertices, 4)), weights)


def make_scene(rng: np.random.Generator, proxies: int) -> Scene:
    parents = np.array([-1, 0, 1])
    bind = rigid(matrix_from_quaternion(quaternions(rng, 3)), np.array([[0, 1.0, 0], [0, 1.3, 0], [0.1, 1.5, 0]]))
    rest = local_transforms(bind, parents)
    skeleton = Skeleton("hero.usda:/Hero/Rig", ("Hips", "Hips/Spine", "Hips/Spine/Head"), parents, bind, rest)
    body = strip("hero.usda:/Hero/Body")
    character = Character("hero.usda:/Hero", skeleton, (Body(body, random_skin(rng, body.vertex_count, 3)),))
    mesh = strip("cape.usda:/Cape/cape")
    garment = Garment(mesh, random_skin(rng, mesh.vertex_count, 3), rng.integers(0, 3, mesh.vertex_count))
    names = ("Hips/Spine/proxy_0", "Hips/Spine/proxy_0/proxy_1")[:proxies]
    proxy_bind = rigid(matrix_from_quaternion(quaternions(rng, proxies)), rng.normal(size=(proxies, 3)))
    skin = random_skin(rng, mesh.vertex_count, 3 + proxies)
    return Scene(
        character, garment, ProxyRig("cape.usda:/Cape", names, np.array([1, 3][:proxies], int), proxy_bind, skin)
    )


def make_deformer(rng: np.random.Generator, *, proxies: int = 2, shapes: int = 3) -> Deformer:
    scene = make_scene(rng, proxies)
    offsets = 0.05 * rng.normal(size=(shapes, scene.garment.mesh.vertex_count, 3))
    offsets[:, scene.classes == 0] = 0
    return Deformer(scene, scene.rig.skin, offsets)


def make_motion(rng: np.random.Generator, *, fps: float = 30.0, away: float = 0.0) -> Motion:
    translations = np.tile(np.array([[0, 1.0, 0], [0, 0.3, 0], [0.1, 0.2, 0]]), (FRAMES, 1, 1))
    translations[:, 0] += rng.normal(size=(FRAMES, 3)) + away * np.array([0.6, 0, 0.8])
    return Motion("walk.usda:/Walk", fps, quaternions(rng, FRAMES, 3), translations)


def make_poses(
    rng: np.random.Generator, deformer: Deformer, chunks: tuple[int, ...] = (7, 8, 5)
) -> list[GarmentPose]:
    starts = np.cumsum((0, *chunks[:-1]))
    proxies, shapes = deformer.scene.rig.proxy_count, deformer.shape_count
    return [
        GarmentPose(int(start), quaternions(rng, count, proxies), rng.random((count, shapes)))
        for start, count in zip(starts, chunks)
    ]


def write(
    path: Path, *, seed: int = 3, units: StageUnits = METRES_Y, away: float = 0.0, start: float = 1.0, **counts
):
    """Write a random shot; return what the decoder makes of it, shape (F, V, 3)."""
    rng = np.random.default_rng(3)
    deformer, motion = make_deformer(rng, **counts), make_motion(rng, away=away)
    poses = make_poses(rng, deformer)
    write_shot(path, deformer, motion, poses, units=units, start=start)
    return np.concatenate([deform(deformer, motion, pose) for pose in poses])


@pytest.mark.parametrize("units", [METRES_Y, CENTIMETRES_Z], ids=["metres_y", "centimetres_z"])
@pytest.mark.parametrize("proxies, shapes", [(2, 3), (0, 3), (2, 0), (0, 0)])
@pytest.mark.parametrize("fps, start", [(30.0, 0.0), (24.0, 1001.0), (60.0, -3.5)])
def test_usdskel_reproduces_the_decoder(tmp_path, units, proxies, shapes, fps, start):
    rng = np.random.default_rng(3)
    deformer, motion = make_deformer(rng, proxies=proxies, shapes=shapes), make_motion(rng, fps=fps)
    poses, path = make_poses(rng, deformer), tmp_path / "shot.usdc"
    summary = write_shot(path, deformer, motion, poses, units=units, start=start)
    assert (summary.frame_count, summary.start, summary.end, summary.fps) == (FRAMES, start, start + FRAMES - 1, fps)
    shot = Shot(path)
    assert shot.fps == fps
    comparison = compare_points(shot, (frame for pose in poses for frame in deform(deformer, motion, pose)))
    assert comparison.worst < 2e-6
    assert check_shot(path) == []


def test_a_garment_keeps_its_colour(tmp_path):
    rng = np.random.default_rng(4)
    plain, motion = make_deformer(rng), make_motion(rng)
    garment = replace(plain.scene.garment, colour=(0.25, 0.5, 1.0))
    deformer = replace(plain, scene=replace(plain.scene, garment=garment))
    write_shot(tmp_path / "shot.usdc", deformer, motion, make_poses(rng, deformer), units=CENTIMETRES_Z)
    skeleton = read_character(tmp_path / "shot.usdc", garment="cape").skeleton
    assert read_garment(tmp_path / "shot.usdc", skeleton).colour == (0.25, 0.5, 1.0)


def test_body_meshes_follow_the_character(tmp_path):
    rng = np.random.default_rng(4)
    deformer, motion = make_deformer(rng), make_motion(rng)
    path = tmp_path / "shot.usdc"
    write_shot(path, deformer, motion, make_poses(rng, deformer), units=CENTIMETRES_Z)
    skeleton, body = deformer.scene.character.skeleton, deformer.scene.character.bodies[0]
    matrices = skinning_matrices(motion_transforms(motion, skeleton.parents), skeleton.bind_transforms)
    shot = Shot(path)
    assert [(mesh.name, mesh.is_garment) for mesh in shot.meshes] == [("cape", True), ("Body", False)]
    assert shot.meshes[0].colour is None
    dyed = Usd.Stage.Open(str(path))
    cloth = UsdGeom.PrimvarsAPI(dyed.GetPrimAtPath(shot.meshes[0].path))
    cloth.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, "constant").Set([(0.2140411, 0.0, 1.0)])
    assert Shot(dyed).meshes[0].colour == pytest.approx((0.5, 0.0, 1.0), abs=1e-5)  # linear light as sRGB
    played = np.stack([shot.points(time)[1] for time in shot.frame_times])
    np.testing.assert_allclose(played, skin_points(body.mesh.points, body.skin, matrices), atol=2e-6)


@pytest.mark.parametrize("units", [METRES_Y, CENTIMETRES_Z], ids=["metres_y", "centimetres_z"])
def test_a_character_far_away_loses_only_float32_precision(tmp_path, units):
    expected = write(tmp_path / "shot.usdc", units=units, away=100.0)
    comparison = compare_points(Shot(tmp_path / "shot.usdc"), expected)
    assert np.abs(expected).max() > 80
    assert comparison.bound == pytest.approx(1e-5 + 4 * 2**-23 * np.abs(expected).max(), rel=0.1)
    assert comparison.passed


@pytest.mark.parametrize("away", [1e5, 1e9, 1e30])
def test_no_distance_allows_more_than_some_millimetres(away):
    assert allowed_error(np.full((4, 3), away)) == allowed_error(np.full((4, 3), 10_000.0)) < 5e-3


def test_usd_bakes_the_same_points(tmp_path):
    expected = write(tmp_path / "shot.usdc", units=METRES_Y)
    stage = Usd.Stage.Open(str(tmp_path / "shot.usdc"))
    assert UsdSkel.BakeSkinning(Usd.PrimRange(stage.GetPseudoRoot()))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Hero/cape"))
    space = np.array(mesh.ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
    for frame, points in enumerate(expected):
        baked = np.array(mesh.GetPointsAttr().Get(1.0 + frame)) @ space[:3, :3] + space[3, :3]
        np.testing.assert_allclose(baked, points, atol=2e-6)


def test_polygons_and_texture_coordinates_are_the_authored_ones(tmp_path):
    write(tmp_path / "shot.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "shot.usdc"))
    prim = stage.GetPrimAtPath("/Hero/cape")
    mesh, source = UsdGeom.Mesh(prim), strip("strip")
    np.testing.assert_array_equal(mesh.GetFaceVertexCountsAttr().Get(), source.polygon_counts)
    np.testing.assert_array_equal(mesh.GetFaceVertexIndicesAttr().Get(), source.polygon_indices)
    np.testing.assert_array_equal(UsdGeom.PrimvarsAPI(prim).GetPrimvar("st").Get(), source.uvs)


def test_nothing_is_written_that_a_plain_skinned_garment_does_not_need(tmp_path):
    write(tmp_path / "shot.usdc", proxies=0, shapes=0)
    stage = Usd.Stage.Open(str(tmp_path / "shot.usdc"))
    assert [str(prim.GetPath()) for prim in stage.Traverse()] == [
        "/Hero",
        "/Hero/Skeleton",
        "/Hero/Animation",
        "/Hero/cape",
        "/Hero/Body",
    ]
    names = [attribute.GetName() for prim in stage.Traverse() for attribute in prim.GetAuthoredProperties()]
    assert not [name for name in names if "lendShape" in name or "proxy" in name]


def test_blendshapes_keep_moving_rows_only_and_still_shapes_are_left_out(tmp_path):
    rng = np.random.default_rng(5)
    deformer, motion = make_deformer(rng), make_motion(rng)
    shapes = np.array(deformer.shapes)
    shapes[1] = 0
    deformer = replace(deformer, shapes=shapes)
    poses, path = make_poses(rng, deformer), tmp_path / "shot.usdc"
    assert write_shot(path, deformer, motion, poses, units=METRES_Y).shape_count == 2
    stage = Usd.Stage.Open(str(path))
    rows = UsdSkel.BlendShape(stage.GetPrimAtPath("/Hero/cape/shape_002")).GetPointIndicesAttr().Get()
    np.testing.assert_array_equal(rows, np.flatnonzero(deformer.scene.classes != 0))
    assert not stage.GetPrimAtPath("/Hero/cape/shape_001")
    assert compare_points(Shot(path), np.concatenate([deform(deformer, motion, pose) for pose in poses])).worst < 2e-6


def test_a_joint_named_twice_is_stored_once_heaviest_first():
    skin = SkinWeights("strip", np.array([[2, 1, 2], [0, 0, 0]]), np.array([[0.3, 0.4, 0.3], [0.2, 0.3, 0.5]]))
    indices, weights = sorted_influences(skin)
    np.testing.assert_array_equal(indices, [[2, 1], [0, 0]])
    np.testing.assert_allclose(weights, [[0.6, 0.4], [1, 0]], atol=1e-7)


def test_joints_that_stay_put_cost_one_sample(tmp_path):
    rng = np.random.default_rng(6)
    deformer, motion = make_deformer(rng), make_motion(rng)
    still = replace(motion, translations=np.repeat(motion.translations[:1], FRAMES, axis=0))
    poses, path = make_poses(rng, deformer), tmp_path / "shot.usdc"
    write_shot(path, deformer, still, poses, units=CENTIMETRES_Z)
    stage = Usd.Stage.Open(str(path))
    animation = UsdSkel.Animation(stage.GetPrimAtPath("/Hero/Animation"))
    assert animation.GetTranslationsAttr().GetNumTimeSamples() == 1
    assert animation.GetRotationsAttr().GetNumTimeSamples() == FRAMES
    assert check_shot(path) == []
    assert compare_points(Shot(path), np.concatenate([deform(deformer, still, pose) for pose in poses])).worst < 2e-6


def test_quaternions_never_flip_sign_between_frames(tmp_path):
    rng = np.random.default_rng(7)
    deformer, motion = make_deformer(rng), make_motion(rng)
    turn = np.linspace(0, 4 * np.pi, FRAMES)
    spin = np.stack([np.cos(turn / 2), 0 * turn, np.sin(turn / 2), 0 * turn], axis=-1)
    rotations = np.array(motion.rotations)
    rotations[:, 0] = spin
    path = tmp_path / "shot.usdc"
    write_shot(path, deformer, replace(motion, rotations=rotations), make_poses(rng, deformer), units=METRES_Y)
    stage = Usd.Stage.Open(str(path))
    rotations = stage.GetAttributeAtPath("/Hero/Animation.rotations")
    stored = np.stack([rotations.Get(time) for time in rotations.GetTimeSamples()])
    assert (np.sum(stored[1:] * stored[:-1], axis=-1) >= 0).all()
    np.testing.assert_allclose(np.abs(np.sum(stored[:, 0] * spin[:, [1, 2, 3, 0]], axis=-1)), 1, atol=1e-6)


def test_saving_often_changes_nothing_but_the_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(shot_module, "FRAMES_PER_SAVE", 5)
    expected = write(tmp_path / "shot.usdc")
    assert check_shot(tmp_path / "shot.usdc") == []
    assert compare_points(Shot(tmp_path / "shot.usdc"), expected).worst < 2e-6


def test_the_same_shot_has_the_same_bytes(tmp_path):
    write(tmp_path / "a.usdc")
    write(tmp_path / "b.usdc")
    assert (tmp_path / "a.usdc").read_bytes() == (tmp_path / "b.usdc").read_bytes()


def test_provenance_is_kept_in_the_layer(tmp_path):
    rng = np.random.default_rng(8)
    deformer = make_deformer(rng)
    provenance = {
        "model": "cape.safetensors",
        "inputs": {"stage": "0f3a"},
        "motions": ["a", "b"],
        "seed": 3,
        "no": None,
    }
    path = tmp_path / "shot.usda"
    poses = make_poses(rng, deformer)
    write_shot(path, deformer, make_motion(rng), poses, units=METRES_Y, provenance=provenance)
    kept = Sdf.Layer.FindOrOpen(str(path)).customLayerData["ssilk"]
    assert kept["model"] == "cape.safetensors" and kept["inputs"] == {"stage": "0f3a"} and kept["seed"] == 3
    assert list(kept["motions"]) == ["a", "b"] and "no" not in kept


def test_readers_take_a_shot_as_a_stage(tmp_path):
    rng = np.random.default_rng(9)
    deformer, motion = make_deformer(rng), make_motion(rng)
    path = tmp_path / "shot.usdc"
    write_shot(path, deformer, motion, make_poses(rng, deformer), units=CENTIMETRES_Z)
    character = read_character(path)
    assert character.skeleton.joint_names == deformer.scene.character.skeleton.joint_names
    back = read_motion(path, character.skeleton)
    ours, theirs = (motion_transforms(each, character.skeleton.parents) for each in (motion, back))
    np.testing.assert_allclose(theirs, ours, atol=2e-6)


@pytest.mark.parametrize("units", [METRES_Y, CENTIMETRES_Z], ids=["metres_y", "centimetres_z"])
@pytest.mark.parametrize("proxies, shapes", [(2, 3), (0, 3), (2, 0)])
def test_a_baked_garment_is_read_as_it_was_written(tmp_path, units, proxies, shapes):
    rng = np.random.default_rng(3)
    deformer, motion = make_deformer(rng, proxies=proxies, shapes=shapes), make_motion(rng)
    poses = make_poses(rng, deformer)
    write_shot(tmp_path / "shot.usdc", deformer, motion, poses, units=units, start=1001)
    found, wanted = read_baked(tmp_path / "shot.usdc"), SkinnedGarment.of(deformer)
    own = found.garment
    assert (own.joint_names, own.shape_names, found.start) == (wanted.joint_names, wanted.shape_names, 1001)
    np.testing.assert_allclose(own.bind_transforms, wanted.bind_transforms, atol=1e-9)
    np.testing.assert_allclose(own.points, wanted.points, atol=1e-6)
    np.testing.assert_allclose(own.shapes, wanted.shapes, atol=1e-6)
    np.testing.assert_allclose(own.skin.dense(3 + proxies), wanted.skin.dense(3 + proxies), atol=1e-6)
    weights, rotations = (
        np.concatenate([getattr(pose, name) for pose in poses]) for name in ("weights", "rotations")
    )
    np.testing.assert_allclose(found.pose.weights, weights, atol=1e-7)
    cosines = np.abs((found.pose.rotations * rotations).sum(axis=-1))
    np.testing.assert_allclose(cosines, 1, atol=1e-6)
    assert found.pose.translations is None


@pytest.mark.parametrize("units", [METRES_Y, CENTIMETRES_Z], ids=["metres_y", "centimetres_z"])
def test_proxies_that_move_are_read_as_they_were_written(tmp_path, units):
    """Also where no joint of the character leaves its place."""
    rng = np.random.default_rng(4)
    deformer, motion = make_deformer(rng), make_motion(rng)
    motion = replace(motion, translations=np.tile(motion.translations[:1], (FRAMES, 1, 1)))
    poses = [
        replace(pose, translations=rng.normal(size=(pose.frame_count, 2, 3))) for pose in make_poses(rng, deformer)
    ]
    write_shot(tmp_path / "shot.usdc", deformer, motion, poses, units=units)
    expected = np.concatenate([deform(deformer, motion, pose) for pose in poses])
    assert compare_points(Shot(tmp_path / "shot.usdc"), expected).worst < 2e-6
    found = read_baked(tmp_path / "shot.usdc").pose
    np.testing.assert_allclose(found.translations, GarmentPose.joined(poses).translations, atol=1e-6)


def test_proxies_that_move_to_nowhere_are_refused(tmp_path):
    rng = np.random.default_rng(4)
    deformer, motion = make_deformer(rng), make_motion(rng)
    (pose,) = make_poses(rng, deformer, (FRAMES,))
    for moved in (np.full((FRAMES, 2, 3), np.nan), np.zeros((FRAMES, 1, 3))):
        with pytest.raises(SsilkError, match="proxy translations of shape"):
            poses = [replace(pose, translations=moved)]
            write_shot(tmp_path / "shot.usdc", deformer, motion, poses, units=METRES_Y)


@pytest.mark.parametrize("later", [False, True])
def test_proxies_that_move_in_some_chunks_only_are_refused(tmp_path, later):
    """USD would hold the first sample over all frames before it."""
    rng = np.random.default_rng(4)
    deformer, motion = make_deformer(rng), make_motion(rng)
    poses = [
        replace(pose, translations=rng.normal(size=(pose.frame_count, 2, 3))) if (number > 0) == later else pose
        for number, pose in enumerate(make_poses(rng, deformer))
    ]
    with pytest.raises(SsilkError, match="proxies that move in some chunks"):
        write_shot(tmp_path / "shot.usdc", deformer, motion, poses, units=METRES_Y)
    with pytest.raises(ValueError, match="some poses have translations"):
        GarmentPose.joined(poses)


def unskin(stage: Usd.Stage) -> None:
    for name in ("jointIndices", "jointWeights"):
        stage.GetPrimAtPath("/Hero/cape").RemoveProperty(f"primvars:skel:{name}")


def still(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/Hero/Animation").GetAttribute("blendShapes").Set(["shape_000"])


@pytest.mark.parametrize(
    "change, sentence",
    [(unskin, "the garment has proxies but no weights"), (still, "it does not animate 'shape_001'")],
)
def test_a_garment_that_was_not_baked_to_joints_is_refused(tmp_path, change, sentence):
    write(tmp_path / "shot.usda")
    stage = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    change(stage)
    stage.Save()
    with pytest.raises(SsilkError, match=sentence):
        read_baked(tmp_path / "shot.usda")


@pytest.mark.parametrize("units", [METRES_Y, CENTIMETRES_Z], ids=["metres_y", "centimetres_z"])
@pytest.mark.parametrize("proxies", [2, 0])
def test_a_written_scene_reads_back(tmp_path, units, proxies):
    scene = make_scene(np.random.default_rng(5), proxies)
    write_scene(tmp_path / "scene.usdc", scene.character, scene.garment, scene.rig, units=units)
    assert StageUnits.of(Usd.Stage.Open(str(tmp_path / "scene.usdc"))) == units
    character, garment, rig = read_scene(tmp_path / "scene.usdc")
    skeleton, mesh = character.skeleton, scene.garment.mesh
    assert (skeleton.joint_names, rig.joint_names) == (scene.character.skeleton.joint_names, scene.rig.joint_names)
    assert garment.mesh.path == f"{tmp_path / 'scene.usdc'}:/Hero/cape"
    np.testing.assert_allclose(skeleton.bind_transforms, scene.character.skeleton.bind_transforms, atol=1e-9)
    np.testing.assert_allclose(skeleton.rest_transforms, scene.character.skeleton.rest_transforms, atol=1e-9)
    np.testing.assert_allclose(rig.bind_transforms, scene.rig.bind_transforms, atol=1e-9)
    assert rig.parents.tolist() == scene.rig.parents.tolist()
    np.testing.assert_allclose(garment.mesh.points, mesh.points, atol=1e-6)
    np.testing.assert_array_equal(garment.mesh.polygon_indices, mesh.polygon_indices)
    np.testing.assert_allclose(garment.mesh.uvs, mesh.uvs, atol=1e-6)
    np.testing.assert_array_equal(garment.classes, scene.classes)
    for own, wanted in ((garment.skin, scene.lbs_skin), (rig.skin, scene.rig.skin)):
        np.testing.assert_allclose(own.dense(3 + proxies), wanted.dense(3 + proxies), atol=1e-6)
    for own, wanted in zip(character.bodies, scene.character.bodies, strict=True):
        np.testing.assert_allclose(own.mesh.points, wanted.mesh.points, atol=1e-6)
        np.testing.assert_allclose(own.skin.dense(3), wanted.skin.dense(3), atol=1e-6)


def test_what_a_garment_lacks_is_left_out(tmp_path):
    scene = make_scene(np.random.default_rng(5), 0)
    mesh = replace(scene.garment.mesh, uvs=None)
    write_scene(tmp_path / "scene.usdc", scene.character, Garment(mesh), units=METRES_Y)
    _, garment, rig = read_scene(tmp_path / "scene.usdc")
    assert (garment.skin, garment.classes, garment.mesh.uvs, rig) == (None, None, None, None)


def with_weights(poses, value):
    weights = np.array(poses[1].weights)
    weights[2, 1] = value
    return [poses[0], replace(poses[1], weights=weights), *poses[2:]]


REFUSED = {
    "weight above one": (lambda poses: with_weights(poses, 1.01), "blendshape 1 weighs 1.01 at frame 9"),
    "negative weight": (lambda poses: with_weights(poses, -0.1), "blendshape 1 weighs -0.1 at frame 9"),
    "weight not a number": (lambda poses: with_weights(poses, np.nan), "blendshape 1 weighs nan at frame 9"),
    "chunk left out": (lambda poses: poses[::2], "a chunk that starts at frame 15; frame 7 comes next"),
    "last chunk left out": (lambda poses: poses[:-1], "15 garment frames for the 20 of walk.usda"),
    "frames past the motion": (lambda poses: [*poses, replace(poses[0], start=20)], "27 garment frames for the 20"),
    "another proxy count": (lambda poses: [replace(poses[0], rotations=poses[0].rotations[:, :1])], "(7, 2, 4) and"),
    "rotations not finite": (lambda poses: [replace(poses[0], rotations=poses[0].rotations * np.nan)], "NaN"),
}


@pytest.mark.parametrize("damage, message", REFUSED.values(), ids=REFUSED)
def test_bad_frames_are_refused_and_leave_no_file(tmp_path, damage, message):
    rng = np.random.default_rng(10)
    deformer = make_deformer(rng)
    poses = damage(make_poses(rng, deformer))
    with pytest.raises(SsilkError, match=re.escape(message)):
        write_shot(tmp_path / "shot.usdc", deformer, make_motion(rng), poses, units=METRES_Y)
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_bake_leaves_the_old_file(tmp_path):
    rng, path = np.random.default_rng(10), tmp_path / "shot.usdc"
    write(path)
    before, deformer = path.read_bytes(), make_deformer(rng)

    def poses():
        yield make_poses(rng, deformer)[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_shot(path, deformer, make_motion(rng), poses(), units=METRES_Y)
    assert list(tmp_path.iterdir()) == [path] and path.read_bytes() == before


def test_a_motion_of_another_skeleton_is_refused(tmp_path):
    rng = np.random.default_rng(10)
    deformer, motion = make_deformer(rng), make_motion(rng)
    other = replace(motion, rotations=motion.rotations[:, :2], translations=motion.translations[:, :2])
    with pytest.raises(SsilkError, match=r"walk\.usda:/Walk: 2 animated joints, where hero\.usda:/Hero/Rig has 3"):
        write_shot(tmp_path / "shot.usdc", deformer, other, make_poses(rng, deformer), units=METRES_Y)


def test_prim_names_are_valid_and_unique():
    paths = ["a.usda:/Set/Hero", "b.usdc", "b.usda:/Hero", "c.usda:/Hero", "/01_shot", ""]
    names = prim_names(paths)
    assert names == ["Hero", "b", "Hero_2", "Hero_3", "_01_shot", "_"]
    assert all(Sdf.Path.IsValidIdentifier(name) for name in names)


def test_names_that_do_not_spell_the_hierarchy_are_refused(tmp_path):
    rng = np.random.default_rng(11)
    deformer = make_deformer(rng)
    rig = replace(deformer.scene.rig, joint_names=("proxy_0", "proxy_1"))
    deformer = replace(deformer, scene=replace(deformer.scene, rig=rig))
    with pytest.raises(SsilkError, match="path of joint 'proxy_0' does not spell its parent"):
        write_shot(tmp_path / "shot.usdc", deformer, make_motion(rng), make_poses(rng, deformer), units=METRES_Y)


@pytest.mark.parametrize("name", ["shot.abc", "shot"])
def test_other_file_formats_are_refused(tmp_path, name):
    with pytest.raises(SsilkError, match=r"one of \.usdc, \.usd, \.usda"):
        write(tmp_path / name)


def test_a_full_disk_is_one_sentence(tmp_path, monkeypatch):
    """A limit on the size of files stands in for the disk."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limit[1]))
    try:
        with pytest.raises(SsilkError, match=r"shot\.usdc: writing failed \(.*File too large\)"):
            write(tmp_path / "shot.usdc")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert list(tmp_path.iterdir()) == []


def test_point_caches_play_too(tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "cache.usda"))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.Xform.Define(stage, "/Set").AddTranslateOp().Set((100, 0, 0))
    mesh = UsdGeom.Mesh.Define(stage, "/Set/Cloth")
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    UsdGeom.Mesh.Define(stage, "/Set/Hidden").CreateVisibilityAttr("invisible")
    for time, height in ((10.0, 0.0), (12.0, 200.0)):
        mesh.CreatePointsAttr().Set([(0, 0, height), (100, 0, height), (0, 100, height)], time)
    stage.Save()
    shot = Shot(tmp_path / "cache.usda")
    assert shot.frame_times == (10.0, 11.0, 12.0)
    assert [mesh.name for mesh in shot.meshes] == ["Cloth"]
    np.testing.assert_allclose(shot.points(11.0)[0], [[1, 1, 0], [2, 1, 0], [1, 1, -1]], atol=1e-6)


def attribute(stage: Usd.Stage, path: str) -> Usd.Attribute:
    return stage.GetAttributeAtPath(path)


def set_sample(path: str, index: object, value: object, time: float | None = 8.0):
    """Return a function that overwrites one element of an array at a time, or for all time."""

    def damage(stage: Usd.Stage) -> None:
        code = Usd.TimeCode.Default() if time is None else time
        array = np.array(attribute(stage, path).Get(code))
        array[index] = value
        attribute(stage, path).Set(type(attribute(stage, path).Get(code)).FromNumpy(array), code)

    return damage


def shorten(path: str, time: float | None = 8.0):
    def damage(stage: Usd.Stage) -> None:
        code = Usd.TimeCode.Default() if time is None else time
        value = attribute(stage, path).Get(code)
        attribute(stage, path).Set(type(value)(list(value)[:-1]), code)

    return damage


def set_layer(**fields: object):
    def damage(stage: Usd.Stage) -> None:
        for name, value in fields.items():
            setattr(stage.GetRootLayer(), name, value)

    return damage


def clear_layer(name: str):
    return lambda stage: stage.GetRootLayer().pseudoRoot.ClearInfo(name)


def move_joints(stage: Usd.Stage) -> None:
    joints = attribute(stage, "/Hero/Animation.joints")
    names = list(joints.Get())
    joints.Set([names[1], names[0], *names[2:]])


def child_before_parent(stage: Usd.Stage) -> None:
    for path in ("/Hero/Skeleton.joints", "/Hero/Animation.joints"):
        names = list(attribute(stage, path).Get())
        attribute(stage, path).Set([names[1], names[0], *names[2:]])


def wrap_in_typeless_prim(stage: Usd.Stage) -> None:
    layer = stage.GetRootLayer()
    Sdf.CreatePrimInLayer(layer, "/Shot").specifier = Sdf.SpecifierDef
    Sdf.CopySpec(layer, "/Hero", layer, "/Shot/Hero")
    stage.RemovePrim("/Hero")
    stage.SetDefaultPrim(stage.GetPrimAtPath("/Shot"))
    Usd.ModelAPI(stage.GetPrimAtPath("/Shot")).SetKind("component")


CAPE, MOVES = "/Hero/cape", "/Hero/Animation"
WEIGHTS, INDICES = f"{CAPE}.primvars:skel:jointWeights", f"{CAPE}.primvars:skel:jointIndices"
TAMPERED = {
    "no default prim": (lambda stage: stage.ClearDefaultPrim(), "no default prim"),
    "no kind": (lambda stage: stage.GetPrimAtPath("/Hero").ClearMetadata("kind"), "no kind"),
    "no frames per second": (clear_layer("framesPerSecond"), "framesPerSecond is not authored"),
    "no time codes per second": (clear_layer("timeCodesPerSecond"), "timeCodesPerSecond is not authored"),
    "no frame range": (clear_layer("startTimeCode"), "startTimeCode is not authored"),
    "rates differ": (set_layer(framesPerSecond=24.0), "timeCodesPerSecond and framesPerSecond differ"),
    "no up axis": (clear_layer("upAxis"), "upAxis"),
    "longer range": (set_layer(endTimeCode=25.0), "rotations has no sample at 5 of 25 frames"),
    "second root": (lambda stage: UsdSkel.Root.Define(stage, "/Other"), "2 SkelRoots"),
    "typeless ancestor": (wrap_in_typeless_prim, "it has no type"),
    "instanceable": (lambda stage: stage.GetPrimAtPath("/Hero").SetInstanceable(True), "instanceable"),
    "joint order": (move_joints, "joints differ from the Skeleton's"),
    "parents last": (child_before_parent, "parents must come before"),
    "bind transforms": (shorten("/Hero/Skeleton.bindTransforms", None), "4 bindTransforms for 5 joints"),
    "rest transforms": (shorten("/Hero/Skeleton.restTransforms", None), "4 restTransforms for 5 joints"),
    "singular bind": (set_sample("/Hero/Skeleton.bindTransforms", 0, 0.0, None), "cannot be inverted"),
    "no animation": (
        lambda stage: stage.GetPrimAtPath("/Hero").RemoveProperty("skel:animationSource"),
        "no animation is bound",
    ),
    "rotation count": (shorten(f"{MOVES}.rotations"), "rotations has another length than 5 at 1 samples"),
    "scale count": (shorten(f"{MOVES}.scales", None), "scales has another length than 5"),
    "no translations": (lambda stage: attribute(stage, f"{MOVES}.translations").Clear(), "translations has no value"),
    "frame missing": (
        lambda stage: attribute(stage, f"{MOVES}.translations").ClearAtTime(8.0),
        "translations has no sample at 1 of 20 frames",
    ),
    "quaternion length": (set_sample(f"{MOVES}.rotations", 1, 0.9), "no unit quaternions at time 8"),
    "weight over one": (set_sample(f"{MOVES}.blendShapeWeights", 0, 1.5), "leave [0, 1] at time 8"),
    "weight below zero": (set_sample(f"{MOVES}.blendShapeWeights", 2, -0.5), "leave [0, 1] at time 8"),
    "weight count": (shorten(f"{MOVES}.blendShapeWeights"), "blendShapeWeights has another length than 3"),
    "shape names repeat": (
        lambda stage: attribute(stage, f"{MOVES}.blendShapes").Set(["shape_000"] * 3),
        "blendshape names repeat",
    ),
    "shape unknown": (
        lambda stage: attribute(stage, f"{CAPE}.skel:blendShapes").Set(["shape_000", "shape_001", "other"]),
        "no animation knows 1",
    ),
    "target count": (shorten(f"{CAPE}.skel:blendShapes", None), "2 blendShapes and 3 blendShapeTargets"),
    "target missing": (lambda stage: stage.RemovePrim(f"{CAPE}/shape_001"), "shape_001 is no BlendShape"),
    "offset count": (shorten(f"{CAPE}/shape_001.offsets", None), "offsets for"),
    "offsets not finite": (set_sample(f"{CAPE}/shape_001.offsets", 0, np.nan, None), "offsets are not finite"),
    "rows out of range": (set_sample(f"{CAPE}/shape_001.pointIndices", 0, 99, None), "lie outside 0 to 35"),
    "in-between": (
        lambda stage: UsdSkel.BlendShape(stage.GetPrimAtPath(f"{CAPE}/shape_001")).CreateInbetween("half"),
        "in-between",
    ),
    "joint index out of range": (set_sample(INDICES, 0, 5, None), "1 jointIndices lie outside 0 to 4"),
    "weights not normalised": (set_sample(WEIGHTS, 0, 0.9, None), "Weights of 1 vertices do not add up"),
    "negative joint weight": (set_sample(WEIGHTS, 3, -0.1, None), "1 jointWeights are negative"),
    "influence count": (shorten(INDICES, None), "jointIndices and"),
    "unsorted": (set_sample(WEIGHTS, slice(0, 4), [0.1, 0.2, 0.3, 0.4], None), "1 vertices are not sorted"),
    "joint twice": (set_sample(INDICES, slice(0, 2), [1, 1], None), "1 vertices name a joint twice"),
    "no geomBindTransform": (
        lambda stage: stage.GetPrimAtPath(CAPE).RemoveProperty("primvars:skel:geomBindTransform"),
        "geomBindTransform is not authored",
    ),
    "deforms twice": (
        lambda stage: [attribute(stage, f"{CAPE}.points").Set(strip("x").points, time) for time in (1.0, 2.0)],
        "deforms twice",
    ),
    "unbound": (
        lambda stage: [stage.GetPrimAtPath(path).RemoveProperty("skel:skeleton") for path in ("/Hero", CAPE)],
        "bound to no skeleton",
    ),
    "class count": (shorten(f"{CAPE}.primvars:ssilk:class", None), "holds 35 values, where 36"),
    "face index": (set_sample(f"{CAPE}.faceVertexIndices", 0, 36, None), "1 faceVertexIndices name no point"),
    "face count": (shorten(f"{CAPE}.faceVertexCounts", None), "do not add up to faceVertexIndices"),
    "point not finite": (set_sample(f"{CAPE}.points", 0, np.inf, None), "not finite ones"),
    "extent missing": (lambda stage: attribute(stage, "/Hero.extent").Clear(), "extent has no sample at 20"),
    "extent too small": (set_sample("/Hero.extent", 1, 0.0), "does not hold the skinned points at time 8"),
}


@pytest.mark.parametrize("damage, message", TAMPERED.values(), ids=TAMPERED)
def test_each_check_fires(tmp_path, damage, message):
    path = tmp_path / "shot.usdc"
    write(path)
    stage = Usd.Stage.Open(str(path))
    damage(stage)
    stage.Save()
    findings = check_shot(path)
    assert any(message in finding.text and finding.severity == "error" for finding in findings), findings


def test_a_moved_vertex_is_named(tmp_path):
    expected = write(tmp_path / "shot.usdc", start=101.0)
    expected[12, 5] += [0, 2e-5, 0]
    comparison = compare_points(Shot(tmp_path / "shot.usdc"), expected)
    assert not comparison.passed
    assert (comparison.time, comparison.vertex) == (113.0, 5)
    assert comparison.worst == pytest.approx(2e-5, abs=2e-6)


def test_points_that_are_not_numbers_never_pass(tmp_path):
    expected = write(tmp_path / "shot.usdc")
    expected[3, 4] = np.nan
    assert not compare_points(Shot(tmp_path / "shot.usdc"), expected).passed


@pytest.mark.parametrize("frames", [slice(0, 19), np.r_[0:20, 0]], ids=["one short", "one more"])
def test_other_frame_counts_fail_verification(tmp_path, frames):
    expected = write(tmp_path / "shot.usdc")[frames]
    with pytest.raises(VerificationError, match="another number of frames"):
        compare_points(Shot(tmp_path / "shot.usdc"), expected)


def test_other_vertex_counts_fail_verification(tmp_path):
    expected = write(tmp_path / "shot.usdc")[:, :-1]
    with pytest.raises(VerificationError, match="36 vertices, but 35"):
        compare_points(Shot(tmp_path / "shot.usdc"), expected)


@pytest.mark.skipif(not (SHARED / "data").is_dir(), reason="the shared data are not here")
@pytest.mark.parametrize("units", [METRES_Y, CENTIMETRES_Z], ids=["metres_y", "centimetres_z"])
def test_a_captured_motion_on_a_real_character(tmp_path, units):
    rng, path = np.random.default_rng(12), tmp_path / "shot.usdc"
    character = read_character(SHARED / "data/character.usdc")
    motion = read_motion(SHARED / "data/motions/01_01.usdc", character.skeleton).clip(600, 630)
    garment = read_garment(SHARED / "data/garments/tshirt.usdc", character.skeleton)
    count = garment.mesh.vertex_count
    skin = random_skin(rng, count, character.skeleton.joint_count)
    garment = Garment(garment.mesh, skin, np.full(count, 2))
    rig = ProxyRig("none", (), np.zeros(0, int), np.zeros((0, 4, 4)), skin)
    deformer = Deformer(Scene(character, garment, rig), skin, 0.01 * rng.normal(size=(16, count, 3)))
    pose = GarmentPose(0, np.zeros((30, 0, 4)), rng.random((30, 16)))
    write_shot(path, deformer, motion, [pose], units=units, start=1.0)
    assert check_shot(path) == []
    assert compare_points(Shot(path), deform(deformer, motion, pose)).worst < 3e-6


# Velocities of point caches


def course(mesh: Mesh, seconds: np.ndarray, jump: int | None = None) -> np.ndarray:
    """Points in free fall, each at a speed of its own, shape (F, V, 3); from frame `jump` on 90 m further."""
    t = seconds[:, None, None]
    path = mesh.points + t * np.sin(mesh.points[:, [1, 2, 0]] * 5) + 0.5 * t**2 * np.array([0.0, -9.81, 0.0])
    if jump is not None:
        path[jump:] += [90.0, 0, 0]
    return path


def steady(fps: float, jump: int | None = None) -> Motion:
    motion = make_motion(np.random.default_rng(1), fps=fps)
    translations = np.tile(motion.translations.mean(axis=0), (FRAMES, 1, 1))
    translations[:, 0] += np.arange(FRAMES)[:, None] / fps * [1.3, 0, 0]
    if jump is not None:
        translations[jump:, 0] += [90.0, 0, 0]
    return replace(motion, translations=translations)


@pytest.mark.parametrize("samples", [1, 2])
@pytest.mark.parametrize("units", [METRES_Y, CENTIMETRES_Z])
def test_velocities_of_a_cache_carry_its_points_to_the_shutter(tmp_path, units, samples):
    """`points + velocities * dt / timeCodesPerSecond`, by UsdGeom itself; the error is what acceleration leaves."""
    scene, path, fps = make_scene(np.random.default_rng(3), 2), tmp_path / "cache.usdc", 30.0 * samples
    motion, seconds = steady(fps), np.arange(FRAMES) / fps
    exact = course(scene.garment.mesh, seconds)
    with point_cache(path, scene, motion, units=units, start=7.0, samples_per_frame=samples) as cache:
        for frame in np.random.default_rng(0).permutation(FRAMES).tolist():
            cache.write(frame, exact[frame])
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(next(prim for prim in stage.Traverse() if prim.HasAttribute("primvars:ssilk:class")))
    assert mesh.GetVelocitiesAttr().GetTimeSamples() == mesh.GetPointsAttr().GetTimeSamples()
    assert stage.GetTimeCodesPerSecond() == 30.0
    for frame in (1, 6, FRAMES - 2):
        time = 7.0 + frame / samples
        found = np.array(mesh.GetVelocitiesAttr().Get(time)) * units.meters_per_unit
        central = (exact[frame + 1] - exact[frame - 1]) / 2 * fps
        np.testing.assert_allclose(found, units.points_from_core(central) * units.meters_per_unit, atol=1e-3)
        for part in (0.25, 0.4):  # of the way to the next sample, which falls by half of g t^2 more
            away = part / fps
            shutter = np.array(mesh.ComputePointsAtTime(time + part / samples, time))
            moved = course(scene.garment.mesh, seconds + away)[frame]
            off = np.abs(shutter - units.points_from_core(moved)).max() * units.meters_per_unit
            assert off < 0.51 * 9.81 * away**2
    ends = [np.array(mesh.GetVelocitiesAttr().Get(7.0 + frame / samples)) for frame in (0, FRAMES - 1)]
    for found, (a, b) in zip(ends, ((0, 1), (-2, -1))):
        expected = units.points_from_core((exact[b] - exact[a]) * fps)
        np.testing.assert_allclose(found, expected, atol=2e-3 / units.meters_per_unit)


def test_no_velocity_leads_across_a_cut(tmp_path):
    rng = np.random.default_rng(3)
    deformer, motion, layout = make_deformer(rng), steady(30.0, jump=8), Layout(tmp_path, "cape", "walk")
    exact = course(deformer.scene.garment.mesh, np.arange(FRAMES) / 30, jump=8)
    asset = write_asset(layout, deformer, CENTIMETRES_Z).asset
    write_points(layout, asset, exact, deformer, motion, units=CENTIMETRES_Z)
    stage = Usd.Stage.Open(str(layout.points))
    read = [np.array(stage.GetAttributeAtPath(f"{asset.garment}.velocities").Get(frame)) for frame in range(FRAMES)]
    local = exact - (motion.translations[:, :1] - motion.translations[:1, :1])  # a path is a transform of its own
    for frame, (a, b) in {6: (5, 7), 7: (6, 7), 8: (8, 9), 9: (8, 10), 0: (0, 1), 19: (18, 19)}.items():
        expected = CENTIMETRES_Z.points_from_core(local[b] - local[a]) * 30 / (b - a)
        np.testing.assert_allclose(read[frame], expected, atol=0.5)  # of some 600 cm/s
    single = list(with_velocities([exact[0], exact[1]], 30.0, {1}))
    np.testing.assert_array_equal([moving for _, moving in single], 0)
