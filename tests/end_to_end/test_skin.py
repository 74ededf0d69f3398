# SPDX-License-Identifier: Apache-2.0
"""`ssilk skin` on the toy world: caches of any kind become joints and blendshapes, and verify against the cache."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, Vt
from ssilk_usd.reading.facts import read_provenance
from ssilk_usd.shots.play import Shot

from ssilk_core.cli import main
from ssilk_core.delivery.bake import motion_at
from ssilk_core.delivery.gltf.play import GlbShot
from ssilk_core.scene.assets import Motion, Skeleton

FRAMES = 16
BAKE = ["bake", "model.safetensors", "--stage", "rigged.usda", "--motion", "brief.usda"]
SKIN = ["skin", "cache.usda", "--stage", "rigged.usda", "--motion", "brief.usda"]


def write_cache(path, points, faces, *, first=0, fps=30.0, scale=1.0, names=("Cloth",)) -> None:
    """Meshes of a foreign program: in centimetres, say, beneath a transform, marked as nothing."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, scale)
    UsdGeom.SetStageUpAxis(stage, "Y")
    stage.SetTimeCodesPerSecond(fps)
    UsdGeom.Xform.Define(stage, "/sim").AddTranslateOp().Set(Gf.Vec3d(1 / scale, 0, 0))
    for name in names:
        mesh = UsdGeom.Mesh.Define(stage, f"/sim/{name}")
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(faces), 3))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1).astype(np.int32)))
        for frame, each in enumerate(points):
            placed = (each - [1, 0, 0]) / scale
            mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(placed.astype(np.float32)), first + frame)
    stage.GetRootLayer().Save()


@pytest.fixture(scope="module")
def world(toy, tmp_path_factory):
    """The trained skirt with waves on it, as a cache in centimetres."""
    folder = toy.copy(tmp_path_factory.mktemp("skin"))
    toy.write_clip(folder / "brief.usda", frames=FRAMES)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main([*BAKE, "-o", "baked.usda"]) == 0
        shot = Shot("baked.usda")
        points = np.stack([shot.garment_points(time) for time in shot.frame_times])
        waves = 0.02 * np.sin(3 * points[:, :, :1] + 0.4 * np.arange(FRAMES)[:, None, None])
        points += waves * np.array([0.3, 0, 1])
        np.save("points.npy", points)
        faces = next(mesh.faces for mesh in shot.meshes if mesh.is_garment)
        np.save("faces.npy", faces)
        write_cache("cache.usda", points, faces, scale=0.01)
    return folder


def test_a_cache_becomes_a_glb_within_the_tolerance(world, copy):
    assert main([*SKIN, "--target", "glb", "-o", "shot.glb"]) == 0 and main(["verify", "shot.glb"]) == 0
    shot, points = GlbShot("shot.glb"), np.load("points.npy")
    away = np.stack([shot.garment_points(time) for time in shot.frame_times]) - points
    assert len(away) == FRAMES and np.sqrt((away**2).sum(axis=-1).mean()) < 1.02e-3
    assert "cache" in shot.provenance["skinned"]


@pytest.mark.parametrize("more", [[], ["--model", "model.safetensors"], ["--target", "game4"]])
def test_a_cache_becomes_joints_and_shapes_within_the_tolerance(world, copy, more, capsys):
    assert main([*SKIN, "-o", "shot.usda", *more]) == 0
    shot, points = Shot("shot.usda"), np.load("points.npy")
    away = np.stack([shot.garment_points(time) for time in shot.frame_times]) - points
    distance = np.linalg.norm(away, axis=-1)
    assert shot.is_skinned and distance.max() <= 5.01e-3 and np.sqrt((distance**2).mean()) <= 1.01e-3
    stated = read_provenance("shot.usda")["skinned"]
    assert stated["joints lose, at most [mm]"] == pytest.approx(1000 * distance.max(), rel=0.01)
    assert stated["shapes of the shot"] > 0 and stated["bytes of the points alone"] == points.size * 4
    assert main(["verify", "shot.usda"]) == 0
    assert "RMS error [mm]" in capsys.readouterr().err


def test_a_tighter_tolerance_is_kept_and_verified(world, copy, capsys):
    assert main([*SKIN, "-o", "fine.usda", "--tolerance", "0.05"]) == 0
    shot, points = Shot("fine.usda"), np.load("points.npy")
    distance = np.linalg.norm([shot.garment_points(time) for time in shot.frame_times] - points, axis=-1)
    assert np.sqrt((distance**2).mean()) <= 5.5e-5 and distance.max() <= 2.6e-4
    write_cache("cache.usda", points + [0, 2e-4, 0], np.load("faces.npy"), scale=0.01)
    assert main(["verify", "fine.usda"]) == 3
    said = capsys.readouterr().err
    assert "the cache has changed" in said and "from the points that they stand for" in said


def test_a_part_of_the_motion_at_another_rate_is_found_by_its_time(world, copy):
    points = np.load("points.npy")
    write_cache("part.usda", points[4:13:2], np.load("faces.npy"), first=2, fps=15.0)
    assert main(["skin", "part.usda", *SKIN[2:], "-o", "part_shot.usda", "--no-body"]) == 0
    shot = Shot("part_shot.usda")
    assert shot.fps == 15 and shot.frame_times == (2, 3, 4, 5, 6)
    away = np.stack([shot.garment_points(time) for time in shot.frame_times]) - points[4:13:2]
    assert np.linalg.norm(away, axis=-1).max() < 5e-3


def test_a_shot_with_a_skeleton_is_its_own_motion(world, copy):
    assert main([*BAKE, "-o", "baked.usda"]) == 0  # joints are trajectories too
    assert main(["skin", "baked.usda", "--stage", "rigged.usda", "-o", "shot.usda", "--no-body"]) == 0


def test_transforms_above_the_mesh_move_it_and_may_name_it(world, copy):
    """The top of the cache sways; its points are what is left, and its mesh is beside another one."""
    points, faces = np.load("points.npy"), np.load("faces.npy")
    swaying = np.stack([0.1 * np.arange(FRAMES), np.zeros(FRAMES), np.sin(np.arange(FRAMES))], axis=-1)
    write_cache("swaying.usda", points - swaying[:, None], faces, names=("Cloth", "Other"))
    stage = Usd.Stage.Open("swaying.usda")
    edit = Sdf.BatchNamespaceEdit()
    for mesh in ("Cloth", "Other"):
        UsdGeom.Xform.Define(stage, f"/sim/{mesh}Top")
        edit.Add(Sdf.NamespaceEdit(f"/sim/{mesh}", f"/sim/{mesh}Top/Shape", Sdf.NamespaceEdit.atEnd))
    assert stage.GetRootLayer().Apply(edit)
    sway = UsdGeom.Xform(stage.GetPrimAtPath("/sim/ClothTop")).AddTranslateOp()
    for frame, each in enumerate(swaying):
        sway.Set(Gf.Vec3d(*each.tolist()), frame)
    stage.GetRootLayer().Save()
    for mesh in ("/sim/ClothTop", "/sim/ClothTop/Shape"):
        assert main(["skin", f"swaying.usda:{mesh}", *SKIN[2:], "-o", "shot.usda", "--no-body"]) == 0
        shot = Shot("shot.usda")
        away = np.stack([shot.garment_points(time) for time in shot.frame_times]) - points
        assert np.linalg.norm(away, axis=-1).max() < 5e-3


THREE_JOINTS = Skeleton("/Rig", ("Hips", "Hips/Spine", "Hips/Leg"), [-1, 0, 0], *[np.tile(np.eye(4), (3, 1, 1))] * 2)


@pytest.mark.parametrize("rate", [24.0, 60.0])
def test_a_cut_is_held_where_the_cache_has_another_rate(rate):
    """A character that jumps by 10 m between frames 7 and 8 is never between both places."""
    at = np.zeros((16, 3, 3))
    at[8:, 0, 0] = 10.0
    turned = np.tile([1.0, 0, 0, 0], (16, 3, 1))
    motion = Motion("clip", 30.0, turned, at + 0.01 * np.arange(16)[:, None, None])
    cache = SimpleNamespace(fps=rate, seconds=np.arange(int(rate * 0.4)) / rate)
    placed = motion_at(motion, THREE_JOINTS, cache, "cache").translations[:, 0, 0]
    code = cache.seconds * 30
    between = (code > 7) & (code < 8)
    assert between.any() and np.allclose(placed[between], 0.07)
    expected = np.where(code < 8, 0, 10) + 0.01 * code
    np.testing.assert_allclose(placed[~between], expected[~between], atol=1e-9)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("two.usda:/sim --stage rigged.usda --motion brief.usda -o x.usda", "2 meshes of 312 points in '/sim'"),
        ("cache.abc --stage rigged.usda --motion brief.usda -o x.usda", "an Alembic cache"),
        ("cache.mdd --stage rigged.usda --motion brief.usda -o x.usda", "an MDD cache, which tells no unit, axis"),
        ("two.usda --stage rigged.usda --motion brief.usda -o x.usda", "2 meshes of 312 points"),
        ("cache.usda:/sim/Shirt --stage rigged.usda --motion brief.usda -o x.usda", "no visible mesh '/sim/Shirt'"),
        ("less.usda:/sim/Cloth --stage rigged.usda --motion brief.usda -o x.usda", "311 points; the garment has 312"),
        ("cache.usda --stage rigged.usda -o x.usda", "SkelAnimation"),
        ("late.usda --stage rigged.usda --motion brief.usda -o x.usda", "late.usda lasts from 1 s to 1.5 s"),
        ("cache.usda --stage rigged.usda --motion brief.usda -o cache.usda", "output is also an input"),
        ("cache.usda --stage rigged.usda --motion brief.usda -o x.txt", "usd takes .usdc"),
        ("nowhere.usda --stage rigged.usda --motion brief.usda -o x.usda", "there is no such file"),
    ],
)
def test_what_does_not_fit_is_refused(world, copy, words, complaint, capsys):
    (copy / "cache.abc").write_bytes(b"Ogawa")
    (copy / "cache.mdd").write_bytes(bytes(8))
    points, faces = np.load("points.npy"), np.load("faces.npy")
    write_cache("two.usda", points[:1], faces, names=("Left", "Right"))
    write_cache("less.usda", points[:1, :-1], faces[(faces < points.shape[1] - 1).all(axis=1)])
    write_cache("late.usda", points, faces, first=30)
    assert main(["skin", *words.split()]) == 2
    assert complaint in capsys.readouterr().err and not list(copy.glob("x.*"))
