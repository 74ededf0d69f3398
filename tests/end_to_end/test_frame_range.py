# SPDX-License-Identifier: Apache-2.0
"""Which frames of a motion are baked: the stage's range or another, handles, and what comes before the shot."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd
from ssilk_usd.play import Shot

from ssilk_core.cli import main


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
