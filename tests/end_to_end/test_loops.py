# SPDX-License-Identifier: Apache-2.0
"""Loops: a cycle is baked so that its last frame flows into its first, as UsdSkel plays it."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel

from ssilk_core.cli import main
from ssilk_core.delivery.bake import BakeRequest, bake, verify
from ssilk_core.delivery.bake.load import load_rollout
from ssilk_core.delivery.bake.looped import seam_words
from ssilk_core.delivery.bake.refinement import refined

from .test_direction import direct, hold_parts, lively, points_of, proxies_of

ROUND, FPS = 12, 30.0
BAKE = ["bake", "lively.safetensors", "--stage", "rigged.usda", "--motion"]


@pytest.fixture(scope="module")
def world(toy, tmp_path_factory):
    """The toy with a lively model, and with cycle.usda and bakes of it: plain.usdc, and loop.usdc as a loop."""
    folder = toy.copy(tmp_path_factory.mktemp("loops"))
    lively(folder / "model.safetensors", folder / "lively.safetensors")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_cycle("cycle.usda")
        baked("plain.usdc"), baked("loop.usdc", "cycle.usda", "--loop")
    return folder


@pytest.fixture
def stage(copy):
    return copy


def write_cycle(path: str, frames: int = ROUND + 1, turn: float = 0.4, way: float = 0.5) -> None:
    """Hips that sway and go on an arc, by `turn` [rad] and `way` [m] in each round."""
    source = Usd.Stage.Open("clip.usda")
    toy = UsdSkel.Animation(source.GetPrimAtPath("/Clip"))
    joints, bones = toy.GetJointsAttr().Get(), toy.GetTranslationsAttr().Get(0)
    clip = Usd.Stage.CreateNew(path)
    UsdGeom.SetStageMetersPerUnit(clip, 1.0)
    UsdGeom.SetStageUpAxis(clip, "Y")
    clip.SetTimeCodesPerSecond(FPS)
    animation = UsdSkel.Animation.Define(clip, "/Clip")
    animation.CreateJointsAttr(joints)
    animation.CreateScalesAttr([Gf.Vec3h(1)] * len(joints))
    rotations, translations = animation.CreateRotationsAttr(), animation.CreateTranslationsAttr()
    place = np.zeros(3)
    for frame in range(frames):
        phase, heading = 2 * math.pi * frame / ROUND, turn * frame / ROUND
        about = Gf.Quatf(math.cos(heading / 2), 0, math.sin(heading / 2), 0)
        sway = 0.25 * math.sin(phase)
        rotations.Set([about * Gf.Quatf(math.cos(sway), 0, 0, math.sin(sway)), *[Gf.Quatf(1)] * (len(joints) - 1)],
                      frame)  # fmt: skip
        translations.Set([bones[0] + Gf.Vec3f(*map(float, place)), *bones[1:]], frame)
        place += way / ROUND * np.array([math.sin(heading), 0.0, math.cos(heading)])
    clip.GetRootLayer().Save()


def baked(name: str, motion: str = "cycle.usda", *more: str) -> np.ndarray:
    assert main([*BAKE, motion, "-o", name, *more]) == 0
    return points_of(name)


def about_hips(points: np.ndarray, motion: str, frames: list[int]) -> np.ndarray:
    """Return vertices in the heading and place of the hips of their frames, by USD's own values of the clip."""
    clip = Usd.Stage.Open(motion)
    animation, found = UsdSkel.Animation(clip.GetPrimAtPath("/Clip")), []
    for vertices, frame in zip(points, frames, strict=True):
        turn = Gf.Matrix3d(Gf.Quatd(animation.GetRotationsAttr().Get(frame)[0]))
        ahead = np.array(turn).T @ [0.0, 0.0, 1.0]  # Gf's matrices act on rows
        angle = math.atan2(ahead[0], ahead[2])
        inverse = np.array([[math.cos(angle), 0, -math.sin(angle)], [0, 1, 0], [math.sin(angle), 0, math.cos(angle)]])
        found.append((vertices - np.array(animation.GetTranslationsAttr().Get(frame)[0])) @ inverse.T)
    return np.array(found)


def seam_of(points: np.ndarray, motion: str = "cycle.usda") -> float:
    first, last = about_hips(points[[0, -1]], motion, [0, ROUND])
    return float(np.linalg.norm(last - first, axis=-1).max())


def said(path: str) -> dict:
    return Sdf.Layer.FindOrOpen(path).customLayerData["ssilk"]["loop"]


def test_the_last_frame_flows_into_the_first(stage):
    plain, found = points_of("plain.usdc"), points_of("loop.usdc")
    assert seam_of(plain) > 0.005 > 1e-5 > seam_of(found)
    told = said("loop.usdc")
    assert (
        told["samples"] == ROUND and told["state"] == "repeats" and told["last frame"] == "shows the first one's pose"
    )
    assert told["seam, at most [mm]"] < 0.01 and told["turns [degrees]"] == pytest.approx(np.degrees(0.4), abs=0.1)
    assert told["seam from rest, at most [mm]"] == pytest.approx(1000 * seam_of(plain), rel=0.01)


def test_a_loop_is_verified_with_its_seam(stage, capsys):
    assert verify("plain.usdc").seam_mm is None
    found = verify("loop.usdc")
    assert found.seam_mm == pytest.approx(1000 * seam_of(points_of("loop.usdc")), abs=1e-3) and found.seam_mm < 0.01
    capsys.readouterr()
    assert main(["verify", "loop.usdc"]) == 0
    assert "seam of the loop, at most [mm]" in capsys.readouterr().err


def test_a_round_is_what_many_rounds_come_to(stage):
    write_cycle("long.usda", 20 * ROUND + 1)
    long, found = baked("long.usdc", "long.usda"), points_of("loop.usdc")
    late = about_hips(long[19 * ROUND :], "long.usda", list(range(19 * ROUND, 20 * ROUND + 1)))
    own = about_hips(found, "cycle.usda", list(range(ROUND + 1)))
    np.testing.assert_allclose(own, late, atol=2e-3)
    early = about_hips(long[: ROUND + 1], "long.usda", list(range(ROUND + 1)))
    assert np.abs(early[0] - late[0]).max() > 0.005


def test_a_cycle_without_the_repeated_frame_is_found_and_told(stage):
    whole = points_of("loop.usdc")
    write_cycle("open.usda", ROUND)
    found = baked("open.usdc", "open.usda", "--loop")
    assert said("open.usdc")["last frame"] == "is one before the first" and len(found) == ROUND
    np.testing.assert_allclose(found, whole[:-1], atol=2e-3)


def test_an_open_round_that_lacks_frames_is_told(stage):
    write_cycle("open.usda", ROUND)
    found = bake(
        BakeRequest(model="lively.safetensors", stage="rigged.usda", motion="open.usda", loop=True), "o.usdc"
    )
    assert found.loop is not None and not found.loop.closed and not seam_words(found.loop)
    assert "20 mm past its beginning" in seam_words(replace(found.loop, body_mm=20.0))


def test_a_round_is_told_of_a_shot_with_more_shapes_than_the_network_has(stage):
    """As a certificate adds them."""
    request = BakeRequest(model="lively.safetensors", stage="rigged.usda", motion="cycle.usda", loop=True)
    rollout = load_rollout(request)
    more = np.concatenate([rollout.deformer.shapes, rollout.deformer.shapes[:1]])
    larger = replace(rollout, deformer=replace(rollout.deformer, shapes=more))
    assert larger.loop_summary == rollout.loop_summary


@pytest.mark.parametrize(
    "more",
    [["--hold", "2"], ["--fps", "60"], ["--fps", "27.5"], ["--samples-per-frame", "2"], ["--quality", "game"],
     ["--wind", "0,0,0"], ["--latent-iterations", "1"], pytest.param(["--refine", "2"], marks=pytest.mark.slow)],
    ids=["twos", "rate", "odd rate", "samples", "game", "air", "latents", "refined"],
)  # fmt: skip
def test_a_loop_goes_with_other_wishes(stage, more):
    found = baked("loop.usdc", "cycle.usda", "--loop", *more)
    assert main(["verify", "loop.usdc"]) == 0
    assert seam_of(found) < 1e-4
    assert said("loop.usdc")["seam from rest, at most [mm]"] > 100 * said("loop.usdc")["seam, at most [mm]"]


def test_a_held_span_within_the_round_stays_held(stage, capsys):
    direct("cycle.usda", free={0: 1.0, 2: 1.0, 4: 0.0, 6: 0.0, 9: 1.0})
    found, skinned = baked("loop.usdc", "cycle.usda", "--loop"), baked("lbs.usdc", "cycle.usda", "--lbs", "--loop")
    assert seam_of(found) < 1e-5
    off = np.sqrt(((found - skinned) ** 2).sum(axis=-1).mean(axis=-1))
    baked("plain.usdc")
    told = [int(number) for number in re.findall(r"(\d+) poses are held or let go", capsys.readouterr().err)]
    assert told == [6, 6]  # frames 3 to 8, of one round
    assert off[4:7].max() < 8e-3 < off[0]


def test_a_part_that_is_held_is_held_in_each_round(stage, capsys):
    name = f"ssilk:free:{proxies_of('rigged.usda')[0].rpartition('/')[2]}"
    free = points_of("loop.usdc")
    hold_parts("cycle.usda", {name: {0: 0.5, 5: 0.0, ROUND: 0.5}})
    found = baked("held.usdc", "cycle.usda", "--loop")
    assert seam_of(found) < 1e-5 < 1e-2 < np.abs(found - free).max()
    hold_parts("cycle.usda", {name: {ROUND: 0.75}})
    assert main([*BAKE, "cycle.usda", "-o", "refused.usdc", "--loop"]) == 2
    assert "ssilk:free of a part is 0.5 in the first frame and 0.75 in the last" in capsys.readouterr().err


def test_the_garment_may_say_it_and_layers_keep_it(stage):
    asked = points_of("loop.usdc")
    shot = Usd.Stage.Open("cycle.usda")
    shot.OverridePrim("/Hero/Skirt").CreateAttribute("ssilk:loop", Sdf.ValueTypeNames.Bool).Set(True)
    shot.GetRootLayer().Save()
    np.testing.assert_array_equal(baked("said.usdc"), asked)
    assert main([*BAKE, "cycle.usda", "-o", "layers"]) == 0
    layer = "layers/shots/cycle/lively/anim.usdc"
    assert main(["verify", layer]) == 0
    np.testing.assert_allclose(points_of(layer), asked, atol=1e-6)
    record = json.loads(Path("layers/shots/cycle/lively/bake.json").read_text())
    assert record["detail"]["loop"]["closed"] and record["detail"]["loop"]["seam_mm"] < 0.01
    assert main([*BAKE, "cycle.usda", "-o", "layers", "--loop"]) == 0  # another request: it is baked again
    asked_so = Path("layers/shots/cycle/lively/bake.json").read_text()
    assert json.loads(asked_so)["key"] != record["key"]
    written = Path(layer).stat().st_mtime_ns
    assert main([*BAKE, "cycle.usda", "-o", "layers", "--loop"]) == 0  # the same: it is done
    assert Path(layer).stat().st_mtime_ns == written
    assert main(["farm", "lively.safetensors", "--stage", "rigged.usda", "--motion", "cycle.usda", "--loop",
                 "--bundle", "job"]) == 0  # fmt: skip
    (task,) = json.loads(Path("job/job.json").read_text())["tasks"]
    assert task["request"]["loop"] is True


def test_python_gets_the_figures(stage):
    request = BakeRequest(model="lively.safetensors", stage="rigged.usda", motion="cycle.usda", loop=True)
    found = bake(request, "loop.usdc").loop
    assert found is not None and found.repeats and found.seam_mm < 0.01 < found.seam_at_rest_mm
    assert found.travel_m == pytest.approx(0.5, abs=0.1) and found.closed


@pytest.mark.slow
@pytest.mark.parametrize("output", ["joints", "points"])
def test_a_refined_round_is_told_by_its_own_frames_and_the_network_s_rounds(stage, output):
    hold_parts("cycle.usda", {f"ssilk:free:{proxies_of('rigged.usda')[0].rpartition('/')[2]}": {0: 0.5}})
    base = {"model": "lively.safetensors", "stage": "rigged.usda", "motion": "cycle.usda", "loop": True}
    plain = load_rollout(BakeRequest(**base)).loop_summary
    found = refined(load_rollout(BakeRequest(**base, refine=1, refined_output=output))).loop_summary
    for name in ("seam_at_rest_mm", "jump_at_rest", "blended_mm"):  # of the network
        assert getattr(found, name) == pytest.approx(getattr(plain, name), rel=1e-6)
    assert found.jump > 1.005 * plain.jump


def test_without_a_loop_a_shot_says_nothing_of_it(stage):
    assert "loop" not in Sdf.Layer.FindOrOpen("plain.usdc").customLayerData["ssilk"]


def stop_early() -> None:
    write_cycle("cycle.usda", ROUND // 2)


def jump() -> None:
    clip = Usd.Stage.Open("cycle.usda")
    places = UsdSkel.Animation(clip.GetPrimAtPath("/Clip")).GetTranslationsAttr()
    for frame in range(5, ROUND + 1):
        places.Set([each + Gf.Vec3f(9, 0, 0) * (not number) for number, each in enumerate(places.Get(frame))], frame)
    clip.GetRootLayer().Save()


def free_at_the_end() -> None:
    direct("cycle.usda", free={0: 1.0, ROUND: 0.5})


def say_often() -> None:
    shot = Usd.Stage.Open("cycle.usda")
    shot.OverridePrim("/Hero/Skirt").CreateAttribute("ssilk:loop", Sdf.ValueTypeNames.String).Set("yes")
    shot.GetRootLayer().Save()


@pytest.mark.parametrize(
    ("change", "more", "complaint"),
    [
        (stop_early, ["--loop"], "it is no cycle: its end is up to "),
        (jump, ["--loop"], "its root jumps; a loop has no cuts"),
        (None, ["--loop", "--range", "0-2"], "3 frames; a loop has at least 4"),
        (None, ["--loop", "--quality", "hero"], "a loop that the solver carries on"),
        (None, ["--loop", "--pre-roll", "1"], "a loop with a run-up"),
        (None, ["--loop", "--handles", "2"], "a loop with handles"),
        (None, ["--loop", "--hold", "5"], "poses that are held for 5 samples, in a round of 12"),
        (None, ["--loop", "--gusts", "2"], "gusts; in a loop each round feels the same"),
        (None, ["--loop", "--wind", "0,0,5"], "a round turns by 23 degrees in wind"),
        (
            None,
            ["--loop", "--fps", "29"],
            "12 frames of cycle.usda take 11.6 samples; a loop ends on a sample, where it "
            "begins again; give --fps 27.5 or 30, or leave it out",
        ),
        (free_at_the_end, ["--loop"], "ssilk:free is 1 in the first frame and 0.5 in the last"),
        (say_often, [], "ssilk:loop is yes; true or false is needed"),
    ],
)
def test_what_cannot_be_a_loop_is_refused_in_one_sentence(stage, capsys, change, more, complaint):
    if change:
        change()
    before = sorted(stage.iterdir())
    assert main([*BAKE, "cycle.usda", "-o", "refused.usdc", *more]) == 2
    assert complaint in capsys.readouterr().err
    assert sorted(stage.iterdir()) == before
