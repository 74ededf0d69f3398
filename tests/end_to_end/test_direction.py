# SPDX-License-Identifier: Apache-2.0
"""A garment that is held to linear blend skinning and let go, and poses on twos: as UsdSkel plays them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel
from ssilk_usd.shots.play import Shot

from ssilk_core.cli import main
from ssilk_core.delivery.bake import BakeRequest, load_rollout
from ssilk_core.delivery.bake.direction import DirectedPoses
from ssilk_core.network.checkpoint import load_model, save_model
from ssilk_core.network.runtime import Player
from ssilk_core.quality import levels
from ssilk_core.scene.assets import GarmentPose
from ssilk_core.scene.kinematics import deform

FRAMES = 24
BAKE = ["bake", "lively.safetensors", "--stage", "rigged.usda", "--motion"]
HOLD_OFF = 8e-3  # [m] RMS, by which proxies may miss linear blend skinning in the toy


@pytest.fixture
def stage(toy, tmp_path, monkeypatch):
    toy.copy(tmp_path)
    monkeypatch.chdir(tmp_path)
    toy.write_clip(tmp_path / "clip.usda", frames=FRAMES)
    lively(tmp_path / "model.safetensors", tmp_path / "lively.safetensors")
    return tmp_path


def lively(model, path) -> None:
    """Write a model whose cloth moves far from linear blend skinning, with weights of its own."""
    file, rng = load_model(model), np.random.default_rng(1)
    own = {name: value.copy() for name, value in file.parameters.items()}
    own["output.2.weight"] *= 20
    own["output.2.bias"] += rng.normal(scale=0.3, size=own["output.2.bias"].shape).astype(np.float32)
    own["decoder.skin_offset"] += rng.normal(scale=0.3, size=own["decoder.skin_offset"].shape).astype(np.float32)
    save_model(path, replace(file, parameters=own))


def direct(path, free=None, hold=None, prim: str = "/Hero/Skirt") -> None:
    """Key a garment in a shot, by an over where the shot has none."""
    clip = Usd.Stage.Open(str(path))
    over = clip.OverridePrim(prim)
    if free is not None:
        attribute = over.CreateAttribute("ssilk:free", Sdf.ValueTypeNames.Float)
        for code, value in free.items():
            attribute.Set(value, code)
    if hold is not None:
        over.CreateAttribute("ssilk:hold", Sdf.ValueTypeNames.Int).Set(hold)
    clip.GetRootLayer().Save()


def points_of(path) -> np.ndarray:
    """Vertices of the garment in all frames, by UsdSkel's own queries, shape (F, V, 3) [m]."""
    shot = Shot(path)
    return np.stack([shot.garment_points(time) for time in shot.frame_times])


def baked(name: str, motion: str = "clip.usda", *more: str) -> np.ndarray:
    assert main([*BAKE, motion, "-o", name, *more]) == 0
    assert main(["verify", name]) == 0
    return points_of(name)


def test_a_garment_without_direction_has_the_bytes_that_it_had(stage):
    baked("plain.usdc")
    direct("clip.usda", free={0: 1.0, 10: 1.0}, hold=1)
    assert main([*BAKE, "clip.usda", "-o", "free.usdc"]) == 0
    plain, free = (Sdf.Layer.FindOrOpen(name).ExportToString().splitlines() for name in ("plain.usdc", "free.usdc"))
    differs = [line for line, other in zip(plain, free, strict=True) if line != other]
    assert all("motion_sha256" in line for line in differs), differs  # which says what it was baked from


def test_a_bake_warns_of_a_prim_that_directs_nothing(stage, capsys):
    direct("clip.usda", free={0: 0.0}, prim="/Hero/Skrit")
    assert main([*BAKE, "clip.usda", "-o", "shot.usdc", "--range", "0-2", "--no-verify"]) == 0
    assert "warning: clip.usda:/Hero/Skrit: ssilk:free directs nothing" in capsys.readouterr().err


def test_a_garment_of_another_name_than_in_its_training_is_directed_by_its_own(stage, capsys):
    """Its polygons tell which it is."""
    layer, edit = Sdf.Layer.FindOrOpen("rigged.usda"), Sdf.BatchNamespaceEdit()
    edit.Add("/Hero/Skirt", "/Hero/hero_skirt_GEO")
    assert layer.Apply(edit) and layer.Export("renamed.usda")
    layer.Reload(force=True)
    direct("clip.usda", free={0: 0.0}, prim="/Hero/hero_skirt_GEO")
    words = ["bake", "lively.safetensors", "--stage", "renamed.usda", "--motion", "clip.usda", "-o", "shot.usdc"]
    assert main([*words, "--range", "0-2", "--no-verify"]) == 0
    assert "clip.usda: 3 poses are held" in capsys.readouterr().err


def test_a_held_garment_is_where_skinning_has_it_and_is_let_go_without_a_jump(stage, capsys):
    plain, skinned = baked("plain.usdc"), baked("lbs.usdc", "clip.usda", "--lbs")
    direct("clip.usda", free={8: 0.0, 14: 1.0})
    capsys.readouterr()
    found = baked("held.usdc")
    assert "14 poses are held or let go" in capsys.readouterr().err
    off = np.sqrt(((found - skinned) ** 2).sum(axis=-1).mean(axis=-1))
    apart = np.sqrt(((plain - skinned) ** 2).sum(axis=-1).mean(axis=-1))
    assert off[:9].max() < HOLD_OFF < 3 * HOLD_OFF < apart[:9].max(), (off, apart)
    steps = np.linalg.norm(np.diff(found, axis=0), axis=-1).max(axis=1)
    usual = max(np.linalg.norm(np.diff(each, axis=0), axis=-1).max() for each in (plain, skinned))
    between = np.linalg.norm(plain - skinned, axis=-1).max()
    assert steps.max() < usual + between / 6 + HOLD_OFF


def poses_of(path) -> list[np.ndarray]:
    """Local transforms of the proxies, and weights of the blendshapes, in all frames, by UsdSkel's own queries."""
    stage = Usd.Stage.Open(str(path))
    cache = UsdSkel.Cache()
    rig = next(UsdSkel.Skeleton(prim) for prim in stage.Traverse() if prim.IsA(UsdSkel.Skeleton))
    cache.Populate(UsdSkel.Root.Find(rig.GetPrim()), Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(rig)
    first, last = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    codes = np.arange(first, last + 0.5)
    names = list(query.GetJointOrder())
    proxies = [number for number, name in enumerate(names) if name not in ("Hips", "Hips/Spine", "Hips/Spine/Head")]
    local = np.stack([np.array(query.ComputeJointLocalTransforms(code))[proxies] for code in codes])
    weights = np.stack([np.array(query.GetAnimQuery().ComputeBlendShapeWeights(code)) for code in codes])
    return [local.reshape(len(codes), -1), weights]


def test_on_twos_each_pose_is_held_and_the_cloth_does_not_feel_the_steps_of_its_character(stage):
    baked("ones.usdc")
    smooth = baked("twos.usdc", "clip.usda", "--hold", "2")
    for held, ones in zip(poses_of("twos.usdc"), poses_of("ones.usdc"), strict=True):
        np.testing.assert_array_equal(held[::2], held[1::2])
        assert (np.abs(np.diff(held[::2], axis=0)).max(axis=1) > 1e-5).all()
        assert (np.abs(np.diff(ones, axis=0)).max(axis=1) > 1e-5).all()
    clip = Usd.Stage.Open("clip.usda")
    animation = UsdSkel.Animation(clip.GetPrimAtPath("/Clip"))
    for attribute in (animation.GetRotationsAttr(), animation.GetTranslationsAttr()):
        for code in range(1, FRAMES, 2):
            attribute.Set(attribute.Get(code - 1), code)
    clip.GetRootLayer().Save()
    direct("clip.usda", hold=2)
    stepped = baked("stepped.usdc")
    np.testing.assert_allclose(stepped[::2], smooth[::2], atol=1e-6)
    np.testing.assert_array_equal(stepped[1::2], stepped[::2])  # the character stands still, too
    assert np.abs(baked("each.usdc", "clip.usda", "--hold", "1")[1::2] - stepped[1::2]).max() > 1e-4


def test_held_poses_are_counted_from_the_first_frame_of_the_range(stage):
    baked("some.usdc", "clip.usda", "--range", "5-16", "--handles", "2", "--hold", "3")
    weights = poses_of("some.usdc")[1]  # from frame 3 on
    assert len(weights) == 16
    changes = np.flatnonzero(np.abs(np.diff(weights, axis=0)).max(axis=1) > 0) + 1 + 3
    np.testing.assert_array_equal(changes, [5, 8, 11, 14, 17])


def test_samples_within_a_frame_and_another_rate_hold_as_frames_do(stage):
    direct("clip.usda", free={8: 0.0, 14: 1.0})
    skinned = baked("lbs.usdc", "clip.usda", "--lbs")
    ways = ["--samples-per-frame", "2"], ["--fps", "24"], ["--pre-roll", "0.5"], ["--quality", "game"]
    for more in ways:  # shapes that were cut down leave some millimetres
        found = baked("held.usdc", "clip.usda", *more)
        np.testing.assert_allclose(found[0], skinned[0], atol=5e-3 if "game" in more else 1e-6)
        assert np.abs(found[-1] - skinned[-1]).max() > 0.02


def test_what_happened_before_the_garment_was_held_is_forgotten(stage):
    """It begins anew at rest where it is let go."""
    direct("clip.usda", free={4: 1.0, 5: 0.0, 9: 0.0, 10: 1.0})
    whole = baked("whole.usdc")
    part = baked("part.usdc", "clip.usda", "--range", "9-23")
    clip = Usd.Stage.Open("clip.usda")
    clip.GetPrimAtPath("/Hero/Skirt").RemoveProperty("ssilk:free")
    clip.GetRootLayer().Save()
    direct("clip.usda", free={9: 0.0, 10: 1.0})
    np.testing.assert_allclose(whole[9:], baked("late.usdc")[9:], atol=1e-6)
    np.testing.assert_allclose(whole[9:], part, atol=1e-6)


@pytest.mark.parametrize(
    "more", [[], ["--refined-output", "points"], ["--feedback"]], ids=["joints", "points", "hero"]
)
@pytest.mark.slow
def test_a_refined_garment_is_held_where_skinning_has_it(stage, more):
    direct("clip.usda", free={8: 0.0, 14: 1.0})
    skinned = baked("lbs.usdc", "clip.usda", "--lbs")
    found = baked("held.usdc", "clip.usda", "--refine", "2", *more)
    assert np.abs(found[:9] - skinned[:9]).max() < 5.1e-3
    assert np.abs(found[-1] - skinned[-1]).max() > 0.02


def hold_parts(path, values: dict[str, dict[int, float]]) -> None:
    """Key parts of the garment in a shot, by the names of attributes."""
    clip = Usd.Stage.Open(str(path))
    over = clip.OverridePrim("/Hero/Skirt")
    for name, keys in values.items():
        attribute = over.CreateAttribute(name, Sdf.ValueTypeNames.Float)
        for code, value in keys.items():
            attribute.Set(value, code)
    clip.GetRootLayer().Save()


def proxies_of(path) -> list[str]:
    home = Usd.Stage.Open(str(path))
    return list(home.GetPrimAtPath("/Hero/Skirt").GetAttribute("ssilk:proxyJoints").Get())


def test_proxies_that_are_all_held_are_as_a_garment_that_is_held(stage):
    """They begin anew where the garment does, and mix in the world in place of their parents' axes."""
    leaves = [name.rpartition("/")[2] for name in proxies_of("rigged.usda")]
    hold_parts("clip.usda", {f"ssilk:free:{leaf}": {8: 0.0, 14: 1.0} for leaf in leaves})
    apart, plain = baked("apart.usdc"), "clip.usda"
    clip = Usd.Stage.Open(plain)
    for leaf in leaves:
        clip.GetPrimAtPath("/Hero/Skirt").RemoveProperty(f"ssilk:free:{leaf}")
    clip.GetRootLayer().Save()
    direct(plain, free={8: 0.0, 14: 1.0})
    whole = baked("whole.usdc")
    np.testing.assert_allclose(apart[:9], whole[:9], atol=1e-5)
    np.testing.assert_allclose(apart[14:], whole[14:], atol=1e-5)
    assert np.abs(apart - whole).max() < 0.02


def test_a_group_is_held_and_the_rest_of_the_garment_moves_as_before(stage):
    home = Usd.Stage.Open("rigged.usda")
    mesh = UsdGeom.Mesh(home.GetPrimAtPath("/Hero/Skirt"))
    side = np.array(mesh.GetPointsAttr().Get())[:, 0]
    subset = UsdGeom.Subset.Define(home, "/Hero/Skirt/right")
    subset.CreateElementTypeAttr("point")
    subset.CreateIndicesAttr(np.flatnonzero(side > 0).tolist())
    home.GetRootLayer().Save()
    plain, skinned = baked("plain.usdc"), baked("lbs.usdc", "clip.usda", "--lbs")
    hold_parts("clip.usda", {"ssilk:free:right": {8: 0.0, 18: 1.0}})
    found = baked("held.usdc")
    right, left = side > 0.2, side < -0.2
    first, then = slice(0, 9), slice(18, None)
    off = [np.linalg.norm(found[first] - each[first], axis=-1).mean(axis=0) for each in (skinned, plain)]
    # The toy's proxies are few: one of four is in the middle of both sides.
    assert off[0][right].mean() < 0.8 * off[1][right].mean() and off[1][left].mean() < 0.8 * off[0][left].mean()
    np.testing.assert_allclose(found[then], plain[then], atol=1e-5)  # the network went on as if nothing was held
    assert main([*BAKE, "clip.usda", "-o", "layers"]) == 0
    np.testing.assert_allclose(points_of("layers/shots/clip/shot.usda"), found, atol=1e-5)


def test_a_player_in_numpy_holds_parts_as_a_bake_does(stage):
    leaf = proxies_of("rigged.usda")[-1].rpartition("/")[2]
    hold_parts("clip.usda", {f"ssilk:free:{leaf}": {8: 0.0, 14: 1.0}})
    rollout = load_rollout(BakeRequest(model="lively.safetensors", stage="rigged.usda", motion="clip.usda"))
    player = Player.load("lively.safetensors")

    def rolled(first: int, stop: int, step: int):
        return player.play(rollout.motion.picked(slice(first, stop, step))).poses()

    directed = DirectedPoses(rollout.direction, player.deformer(), rolled).poses(0, FRAMES)
    found, wanted = (GarmentPose.joined(list(poses)) for poses in (directed, rollout.poses()))
    assert found.weights.shape[1] > len(player.deformer().shapes)
    points = [deform(rollout.deformer, rollout.motion, pose) for pose in (found, wanted)]
    np.testing.assert_allclose(*points, atol=1e-4)


def test_a_refined_garment_is_held_in_part(stage):
    """Where a vertex follows free proxies alone it is the solver's, where held ones the network's with these held."""
    leaves = [name.rpartition("/")[2] for name in proxies_of("rigged.usda")]
    some = ["clip.usda", "--range", "8-12"]
    refined = baked("refined.usdc", *some, "--refine", "1")
    hold_parts("clip.usda", {f"ssilk:free:{leaf}": {10: 0.0, 12: 1.0} for leaf in leaves[:3]})
    network, found = baked("network.usdc", *some), baked("held.usdc", *some, "--refine", "1")
    np.testing.assert_allclose(found[4], refined[4], atol=5.1e-3)
    off, free = (np.linalg.norm(found[:3] - each[:3], axis=-1).max(axis=0) for each in (network, refined))
    assert off.min() < 1e-3 < 0.01 < off.max() and free.max() > 0.02


def test_a_smaller_model_keeps_the_proxies_that_are_held_and_a_budget_counts_their_shapes(stage, capsys, monkeypatch):
    """What is refused names a size that is enough."""
    monkeypatch.setattr(levels, "SHAPES", (1.0, 0.0))
    monkeypatch.setattr(levels, "JOINTS", (1.0, 0.0))
    held, frames = proxies_of("rigged.usda")[0], ["clip.usda", "--range", "4-15", "-o", "small.usdc", "--budget"]
    hold_parts("clip.usda", {f"ssilk:free:{held.rpartition('/')[2]}": {8: 0.0, 14: 1.0}})
    assert main([*BAKE, *frames, "1kB"]) == 2
    least = float(re.search(r"this model needs at least ([\d.]+) kB", capsys.readouterr().err)[1])
    assert main([*BAKE, *frames, f"{least + 0.1:g}kB"]) == 0
    assert main(["verify", "small.usdc"]) == 0
    told, taken = capsys.readouterr().err, Path("small.usdc").stat().st_size / 1000
    assert "1 proxies" in told and 0.95 * least < taken < 1.02 * least
    shot = Usd.Stage.Open("small.usdc")
    rig = next(prim for prim in shot.Traverse() if prim.IsA(UsdSkel.Skeleton))
    assert [name for name in UsdSkel.Skeleton(rig).GetJointsAttr().Get() if "proxy" in name] == [held]


def test_a_proxy_is_where_it_was_posed_by_hand_and_yields_as_it_is_keyed(stage):
    first, *_ = proxies_of("rigged.usda")
    clip, leaf = Usd.Stage.Open("clip.usda"), first.rpartition("/")[2]
    animation = UsdSkel.Animation(clip.GetPrimAtPath("/Clip"))
    animation.GetJointsAttr().Set([*animation.GetJointsAttr().Get(), first])
    animation.GetScalesAttr().Set([Gf.Vec3h(1)] * 4)
    for attribute, own in (
        (animation.GetRotationsAttr(), Gf.Quatf(0.8, 0.6, 0, 0)),
        (animation.GetTranslationsAttr(), Gf.Vec3f(0.1, -0.2, 0.3)),
    ):
        for code in attribute.GetTimeSamples():
            attribute.Set([*attribute.Get(code), own], code)
    clip.GetRootLayer().Save()
    free = baked("free.usdc")
    hold_parts("clip.usda", {f"ssilk:posed:{leaf}": {4: 0.0, 10: 1.0, 14: 1.0, 20: 0.0}})
    found = baked("posed.usdc")
    np.testing.assert_allclose(found[[0, 4, 20, 23]], free[[0, 4, 20, 23]], atol=1e-5)
    assert np.abs(found[10:15] - free[10:15]).max() > 0.05
    local, _ = poses_of("posed.usdc")
    wanted = np.array(Gf.Matrix4d(Gf.Rotation(Gf.Quatf(0.8, 0.6, 0, 0)), Gf.Vec3d(0.1, -0.2, 0.3))).reshape(-1)
    np.testing.assert_allclose(local[10:15, :16], np.tile(wanted, (5, 1)), atol=1e-5)  # it hangs from a joint
    hold_parts("clip.usda", {f"ssilk:posed:{leaf}": {10: 0.4, 14: 0.4}})  # less than half
    rollout = load_rollout(BakeRequest(model="lively.safetensors", stage="rigged.usda", motion="clip.usda"))
    np.testing.assert_allclose(
        rollout.direction.parts.hand[:, 0], np.tile(wanted.reshape(4, 4).T, (FRAMES, 1, 1)), atol=1e-5
    )
    before = baked("before.usdc")
    for path in ("rigged.usda", "clip.usda"):  # clips that stand alone have the scales of the stage's joints
        scale_joints(path)
    np.testing.assert_allclose(baked("scaled.usdc"), before, atol=1e-5)


def scale_joints(path: str) -> None:
    """Mirror the space of the character's second joint and double that of its third: no point moves."""
    stage = Usd.Stage.Open(path)
    for prim in stage.Traverse():
        if not (prim.IsA(UsdSkel.Skeleton) or prim.IsA(UsdSkel.Animation)):
            continue
        names = list(prim.GetAttribute("joints").Get())
        above = [*UsdSkel.Topology(names).GetParentIndices()]
        totals = np.array([{1: -1.0, 2: 2.0}.get(joint, 1.0) for joint in range(len(names))])
        outer = np.array([totals[joint] if joint >= 0 else 1.0 for joint in above])
        if prim.IsA(UsdSkel.Animation):
            prim.GetAttribute("scales").Set([Gf.Vec3h(float(scale)) for scale in totals / outer])
            moved = prim.GetAttribute("translations")
            for code in moved.GetTimeSamples():
                moved.Set([Gf.Vec3f(each / scale) for each, scale in zip(moved.Get(code), outer.tolist())], code)
            continue
        rig = UsdSkel.Skeleton(prim)
        binds, rest = (np.array(each.Get()) for each in (rig.GetBindTransformsAttr(), rig.GetRestTransformsAttr()))
        binds[:, :3, :3] *= totals[:, None, None]
        rest[:, :3, :3] *= (totals / outer)[:, None, None]
        rest[:, 3, :3] /= outer[:, None]
        rig.GetBindTransformsAttr().Set([Gf.Matrix4d(each.tolist()) for each in binds])
        rig.GetRestTransformsAttr().Set([Gf.Matrix4d(each.tolist()) for each in rest])
    stage.GetRootLayer().Save()


@pytest.mark.parametrize(
    ("values", "more", "complaint"),
    [
        ({"ssilk:free:Sleeve": {0: 0.0}}, [], "ssilk:free:Sleeve names neither a proxy of the model nor a subset"),
        ({"ssilk:free:a:LEAF": {0: 0.0}}, [], "LEAF names neither a proxy of the model nor a subset"),
        ({"ssilk:posed:LEAF": {0: 1.5}}, [], "is 1.5 at time code 0; 0, the network's, to 1, posed by hand"),
        ({"ssilk:posed:LEAF": {0: 1.0}}, [], "and this animation has no such joint"),
        ({"ssilk:free:LEAF": {0: 0.0}}, ["--start-cloth", "shot.usda@0"], "a start and proxies that are held"),
    ],
)
def test_parts_that_cannot_be_held_are_refused_in_one_sentence(stage, capsys, values, more, complaint):
    leaf = proxies_of("rigged.usda")[0].rpartition("/")[2]
    hold_parts("clip.usda", {name.replace("LEAF", leaf): keys for name, keys in values.items()})
    assert main([*BAKE, "clip.usda", "-o", "refused.usdc", *more]) == 2
    assert complaint.replace("LEAF", leaf) in capsys.readouterr().err


def test_a_layer_on_the_garment_of_the_shot_comes_before_its_own_stage(stage):
    direct("rigged.usda", free={0: 0.0})
    skinned = baked("lbs.usdc", "clip.usda", "--lbs")
    np.testing.assert_allclose(baked("home.usdc"), skinned, atol=1e-4)
    direct("clip.usda", free={0: 0.5})
    half = baked("half.usdc")
    direct("clip.usda", free={0: 1.0})
    np.testing.assert_allclose(half, (skinned + baked("free.usdc")) / 2, atol=0.02)
    assert np.abs(half - skinned).max() > 0.02
    assert (
        main(["bake", "lively.safetensors", "--stage", "rigged.usda", "--motion", "clip.usda", "-o", "layers"]) == 0
    )


@pytest.mark.parametrize(
    ("free", "hold", "more", "complaint"),
    [
        ({3: 0.0, 5: 1.5}, None, [], "ssilk:free is 1.5 at time code 5; 0, held to linear blend skinning, to 1"),
        ({3: float("nan")}, None, [], "ssilk:free is nan at time code 3"),
        (None, 0, [], "ssilk:hold is 0; a whole number of frames from 1 to 100 is needed"),
        (None, 2, ["--refine", "2"], "poses that are held for 2 frames, and --refine"),
        ({0: 0.0}, None, ["--refine", "2"], "the garment is held in all frames"),
    ],
)
def test_direction_that_cannot_be_followed_is_refused_in_one_sentence(stage, capsys, free, hold, more, complaint):
    direct("clip.usda", free=free, hold=hold)
    before = sorted(stage.iterdir())
    assert main([*BAKE, "clip.usda", "-o", "refused.usdc", *more]) == 2
    assert complaint in capsys.readouterr().err
    assert sorted(stage.iterdir()) == before
