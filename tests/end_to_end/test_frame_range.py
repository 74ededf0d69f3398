# SPDX-License-Identifier: Apache-2.0
"""Which frames of a motion are baked: the stage's range or another, handles, and what comes before the shot."""

from __future__ import annotations

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd
from ssilk_usd.shots.play import Shot

from ssilk_core.cli import main
from ssilk_core.delivery.bake import origin
from ssilk_core.delivery.bake.load import load_rollout
from ssilk_core.delivery.bake.request import BakeRequest
from ssilk_core.delivery.bake.shot_samples import from_fraction


@pytest.fixture
def world(toy, tmp_path, monkeypatch):
    """A motion with samples from time code 0 to 19, whose stage says 8 to 13."""
    toy.copy(tmp_path)
    toy.write_clip(tmp_path / "walk.usda", frames=20)
    monkeypatch.chdir(tmp_path)
    says(8, 13)
    return tmp_path


def says(first: float, last: float) -> None:
    stage = Usd.Stage.Open("walk.usda")
    stage.SetStartTimeCode(first)
    stage.SetEndTimeCode(last)
    stage.Save()


def bake(words: str) -> int:
    return main(shlex.split(f"bake model.safetensors --stage rigged.usda {words}"))


def points(path: str, times: range) -> np.ndarray:
    shot = Shot(path)
    return np.stack([shot.garment_points(time) for time in times])


@pytest.mark.parametrize(("words", "span", "says"), [
    ("", (8, 13), "frames 8 to 13, as its stage says; samples run from 0 to 19"),
    ("--handles 2", (6, 15), "with handles of 2 frames before and 2 after"),
    ("--handles 7", (1, 19), "with handles of 7 frames before and 6 after"),
    ("--range 3-7", (3, 7), "frames 3 to 7, as asked"),
    ("--range=5-5 --handles 1", (4, 6), "frames 5 to 5, as asked, with handles"),
    ("--range all", (0, 19), ""),
    ("--fps 60", (16, 26), "frames 8 to 13"),
])  # fmt: skip
def test_the_range_of_a_shot_is_told_and_written_and_verified(world, capsys, words, span, says):
    assert bake(f"--motion walk.usda {words} -o out") == 0
    layer = Sdf.Layer.FindOrOpen("out/shots/walk/model/anim.usdc")
    stage = Sdf.Layer.FindOrOpen("out/shots/walk/shot.usda")
    times = layer.ListTimeSamplesForPath("/model/Animation.rotations")
    assert (times[0], times[-1], len(times)) == (*span, span[1] - span[0] + 1)
    assert span == (layer.startTimeCode, layer.endTimeCode) == (stage.startTimeCode, stage.endTimeCode)
    assert says in capsys.readouterr().err
    assert main(["verify", "out/shots/walk/model/anim.usdc"]) == 0


def test_a_shot_begins_as_its_frames_before_leave_the_garment(world):
    """Where less than a second comes before, the shot is a part of the bake of all samples."""
    for words in ("", "--samples-per-frame 2", "--lbs"):
        assert bake(f"--motion walk.usda --no-verify --no-body --range all {words} -o all.usdc") == 0
        assert bake(f"--motion walk.usda --no-verify --no-body {words} -o part.usdc") == 0
        np.testing.assert_allclose(points("part.usdc", range(8, 14)), points("all.usdc", range(8, 14)), atol=2e-6)


def test_frames_between_samples_begin_where_the_range_does(world):
    says(7.5, 12.5)
    assert bake("--motion walk.usda --no-verify -o shot.usdc") == 0
    times = Sdf.Layer.FindOrOpen("shot.usdc").ListTimeSamplesForPath("/Hero/Animation.rotations")
    assert times == [7.5, 8.5, 9.5, 10.5, 11.5, 12.5]


@pytest.mark.parametrize(("stage", "span", "text"), [
    ((10, 40), (10, 19), "its stage says 10 to 40, and samples run from 0 to 19; frames without samples are left"),
    ((100, 140), (0, 19), "its stage says 100 to 140, and samples run from 0 to 19; all samples are played"),
    ((9, 3), (0, 19), "all samples are played"),
])  # fmt: skip
def test_a_range_of_the_stage_that_is_not_sampled(world, capsys, stage, span, text):
    says(*stage)
    assert bake("--motion walk.usda --no-verify -o shot.usdc") == 0
    layer = Sdf.Layer.FindOrOpen("shot.usdc")
    assert (layer.startTimeCode, layer.endTimeCode) == span and text in capsys.readouterr().err


@pytest.mark.parametrize(("words", "text"), [
    ("--range 15-25", "--range 15-25: walk.usda has samples from time code 0 to 19; a range lies within them"),
    ("--range=-3-5", "--range -3-5: walk.usda has samples"), ("--range 9-3", "it ends before it begins"),
    ("--range 9", "'9'; first and last time code are needed"), ("--range a-b", "'a-b'"),
    ("--handles -1", "--handles: '-1' is not a whole number from 0 to 10000"),
])  # fmt: skip
def test_what_is_asked_for_and_does_not_exist_is_refused(world, capsys, words, text):
    assert bake(f"--motion walk.usda {words} -o shot.usdc") == 2
    assert text in capsys.readouterr().err and not Path("shot.usdc").exists()


def test_shots_of_a_list_have_ranges_of_their_own(world):
    shutil.copy("walk.usda", "take.usda")
    named = {
        "a": {"motion": "take.usda", "range": "0-4"},
        "b": {"motion": "take.usda", "range": "5-9"},
        "c": "take.usda",
    }
    Path("shots.json").write_text(json.dumps(named))
    assert bake("--shots shots.json --no-verify -o out") == 0
    layers = [Sdf.Layer.FindOrOpen(f"out/shots/{name}/shot.usda") for name in "abc"]
    assert [(layer.startTimeCode, layer.endTimeCode) for layer in layers] == [(0, 4), (5, 9), (8, 13)]


@pytest.mark.parametrize("span", ["9", "9-3", "a-b"])
def test_a_bad_range_of_a_list_is_told_with_its_shot(world, capsys, span):
    Path("shots.json").write_text(json.dumps({"a": "walk.usda", "b": {"motion": "walk.usda", "range": span}}))
    assert bake("--shots shots.json -o out") == 2
    told = capsys.readouterr().err
    assert f"shots.json: the shot 'b' has '{span}' for a range" in told and "such as 1001-1100" in told


def at_sixty(toy, first: float, last: float) -> None:
    toy.write_clip(Path("walk.usda"), frames=120, fps=60)
    says(first, last)


@pytest.mark.parametrize("fps", [23.976, 24000 / 1001, 29.97, 59.94])
def test_a_shot_of_any_rate_has_a_run_up(world, toy, fps):
    """Its first pose is close to that of the bake of all samples, and its frames are those of the motion."""
    at_sixty(toy, 70, 100)
    request = BakeRequest(model="model.safetensors", stage="rigged.usda", motion="walk.usda", fps=fps)
    shot, whole = load_rollout(request), load_rollout(replace(request, fps=None, range="all"))
    without = replace(shot, source=shot.source.clip(shot.source.frame_count - 31, shot.source.frame_count), lead=0)
    expected, run_up, at_rest = (
        list(rollout.vertices())[at] for rollout, at in ((whole, 70), (shot, 0), (without, 0))
    )
    assert shot.lead == round(fps) and shot.start == 70 * fps / 60
    np.testing.assert_allclose(shot.motion.translations[0], whole.motion.translations[70], atol=1e-9)
    assert np.abs(run_up - expected).max() < 0.25 * np.abs(at_rest - expected).max()
    assert [pose.start for pose in shot.poses()] == [0] and shot.motion.frame_count == int(30 * fps / 60) + 1


def test_nothing_is_interpolated_across_a_cut_where_the_grids_of_motion_and_shot_differ(world, toy):
    at_sixty(toy, 70, 100)
    request = BakeRequest(model="model.safetensors", stage="rigged.usda", motion="walk.usda", fps=23.976)
    rollout = load_rollout(request)
    source, skeleton = rollout.source, rollout.deformer.scene.character.skeleton
    moved = source.translations.copy()
    moved[:, 0, 0] = 0.9 * np.arange(len(moved)) + 100 * (np.arange(len(moved)) > 40)  # at 54 m/s
    felt = np.where(np.arange(len(moved)) > 40, 1.0, -1.0)  # gravity and colliders of either side alone
    given = {"gravity": felt[:, None] * [0, 9.81, 0], "proximity": felt[:, None, None] * np.ones((2, 5))}
    found = from_fraction(replace(source, translations=moved, **given), skeleton, 0.25)
    later = np.arange(len(moved)) + 0.25
    np.testing.assert_allclose(found.translations[:, 0, 0], 0.9 * later + 100 * (later > 40), atol=1e-9)
    for values in (found.gravity[:, 1] / 9.81, found.proximity[:, 1, 2]):
        np.testing.assert_allclose(values, np.where(later > 40, 1, -1), atol=1e-12)


@pytest.mark.parametrize(("words", "span"), [("", (28, 38)), ("--handles 8", (20, 46)), ("--handles 40", (0, 47))])
def test_handles_are_frames_of_the_shot_on_its_grid(world, toy, words, span):
    at_sixty(toy, 70, 95)
    assert bake(f"--motion walk.usda --fps 24 --no-body {words} -o shot.usdc") == 0
    times = Sdf.Layer.FindOrOpen("shot.usdc").ListTimeSamplesForPath("/Hero/Animation.rotations")
    assert times == list(range(span[0], span[1] + 1))


@pytest.mark.parametrize(("jump", "told"), [(20, ""), (50, "(first to time code 25)"), (80, "")])
def test_jumps_within_the_shot_are_told_by_its_time_codes(world, toy, capsys, jump, told):
    at_sixty(toy, 40, 60)
    layer = Sdf.Layer.FindOrOpen("walk.usda")
    for time in range(jump, 120):
        moved = layer.QueryTimeSample("/Clip.translations", time)
        moved[0] += Gf.Vec3f(9, 0, 0)
        layer.SetTimeSample("/Clip.translations", time, moved)
    layer.Save()
    assert bake("--motion walk.usda --fps 30 --lbs --no-verify --no-body -o shot.usdc") == 0
    text = capsys.readouterr().err
    assert ("the root jumps" in text) == bool(told) and told in text and "first to frame" not in text


def test_a_shot_and_files_of_other_contents_are_not_taken_for_the_motion(world, monkeypatch, capsys):
    """Inputs on another root are known by their names alone, and this motion has the name of the shot's own layer."""
    monkeypatch.setattr(origin, "_from_folder", lambda path, folder: Path(path).name)
    Sdf.Layer.FindOrOpen("walk.usda").Export("anim.usdc")
    assert bake("--motion anim.usdc --shot-name s010 --no-verify -o far/layers") == 0
    Sdf.Layer.FindOrOpen("clip.usda").Export("far/anim.usdc")
    (world / "elsewhere").mkdir()
    monkeypatch.chdir(world / "elsewhere")
    shot = "../far/layers/shots/s010/model/anim.usdc"
    assert main(["verify", shot]) == 0 and "has changed" not in capsys.readouterr().err
    for name in ("anim.usdc", "far/anim.usdc"):
        (world / name).unlink()
    assert main(["verify", shot]) == 2 and "--motion gives its present path" in capsys.readouterr().err
