# SPDX-License-Identifier: Apache-2.0
"""From a character in a stage to a verified shot and its picture, as users run it."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pxr import Gf, Sdf, Usd, UsdSkel, Vt
from ssilk_usd.reading.facts import read_provenance

from ssilk_core.cli import main
from ssilk_core.delivery.bake import BakeRollout, bake_layers
from ssilk_core.errors import EXIT_OK, EXIT_WORSE
from ssilk_core.network.checkpoint import load_model, save_model
from ssilk_core.physics import samples

EVENTS = {"started", "progress", "message", "checkpoint", "result", "failed"}
SHOT = "bake model.safetensors --stage rigged.usda --motion clip.usda"


def run(command: str, *more: str) -> int:
    return main([*shlex.split(command), *more])


def events(capsys: pytest.CaptureFixture) -> list[dict]:
    """All events printed so far; each line must be one."""
    found = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert found and {event["event"] for event in found} <= EVENTS
    return found


def animation(stage: Usd.Stage) -> UsdSkel.Animation:
    return UsdSkel.Animation(stage.GetPrimAtPath("/Hero/Animation"))


@pytest.fixture
def world(toy, tmp_path, monkeypatch):
    """A folder of its own with the toy's files, as the working folder."""
    monkeypatch.chdir(toy.copy(tmp_path))
    return toy


def test_from_character_to_picture(toy, tmp_path, monkeypatch, capsys):
    for file in ("hero.usda", "clip.usda"):
        shutil.copy(toy.folder / file, tmp_path)
    monkeypatch.chdir(tmp_path)
    assert run("rig hero.usda --garment Skirt --proxies 4 -o rigged.usda") == 0
    moved = move_first_proxy(Path("rigged.usda"))
    capsys.readouterr()
    wild = [*toy.training, "--set", "static_learning_rate=0.5"]
    assert run("train rigged.usda --motions clip.usda -o model.safetensors --json", *wild) == EXIT_WORSE
    told = events(capsys)
    assert any("worse than none" in event["text"] for event in told if event.get("level") == "warning")
    names = [event["event"] for event in told]
    assert set(names) == {"started", "progress", "message", "checkpoint", "result"}
    assert names.count("result") == names.count("started") == 1 and names[-1] == "result"
    np.testing.assert_allclose(load_model("model.safetensors").scene.rig.bind_transforms[0, :3, 3], moved, atol=1e-5)
    assert run(f"{SHOT} -o shot.usdc --json") == 0
    assert events(capsys)[-1]["detail"]["frames"] == 40
    assert run("verify shot.usdc --json") == 0
    assert float(events(capsys)[-1]["detail"]["largest error [mm]"]) < 1e-2
    assert run("view shot.usdc -o sheet.png --columns 2 --size 48x64 --json") == 0
    assert events(capsys)[-1] == {"event": "result", "task": "view", "detail": {"picture": "sheet.png", "frames": 2}}
    assert {path.name for path in tmp_path.iterdir()} == {
        *("hero.usda", "clip.usda", "rigged.usda", "model.safetensors", "model.resume.safetensors"),
        *("model.curve.json", "shot.usdc", "sheet.png"),
    }


def move_first_proxy(path: Path) -> np.ndarray:
    """Move the first proxy of a rigged stage by hand, 2 cm up and 1 cm out; return where it stands then [m]."""
    stage = Usd.Stage.Open(str(path))
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath("/Hero/Rig"))
    binds = list(skeleton.GetBindTransformsAttr().Get())
    binds[3] = binds[3] * Gf.Matrix4d().SetTranslate((0, 0.02, 0.01))
    skeleton.GetBindTransformsAttr().Set(binds)
    stage.GetRootLayer().Save()
    return np.array(binds[3].ExtractTranslation())


@pytest.mark.parametrize(("fps", "frames"), [(24, 32), (30, 40), (60, 79)])
def test_shots_of_any_rate_are_verified(world, fps, frames, capsys):
    capsys.readouterr()
    assert run(f"{SHOT} --fps {fps} -o shot.usdc --json") == 0
    detail = events(capsys)[-1]["detail"]
    assert (detail["frames"], detail["fps"]) == (frames, fps)
    stage = Usd.Stage.Open("shot.usdc")
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == fps
    weights = animation(stage).GetBlendShapeWeightsAttr()
    values = np.array([weights.Get(time) for time in weights.GetTimeSamples()])
    assert len(values) == frames and values.min() >= 0 and values.max() <= 1 and np.ptp(values) > 0


LATE = """#usda 1.0
(
    framesPerSecond = 30
    metersPerUnit = 1
    subLayers = [@./clip.usda@ (offset = 120)]
    timeCodesPerSecond = 60
    upAxis = "Y"
)
"""


@pytest.mark.parametrize(("rate", "fps"), [("", 30), ("--fps 24", 24)])
def test_a_shot_starts_at_the_time_of_its_motion(world, rate, fps):
    """At 60 time codes and 30 frames a second, time code 120 is 2 s."""
    Path("late.usda").write_text(LATE)
    assert run(f"{SHOT.replace('clip', 'late')} {rate} --lbs --no-verify -o shot.usdc") == 0
    stage = Usd.Stage.Open("shot.usdc")
    assert stage.GetStartTimeCode() / stage.GetTimeCodesPerSecond() == 2
    assert stage.GetTimeCodesPerSecond() == fps


def test_the_same_bake_gives_the_same_bytes(world):
    assert run(f"{SHOT} -o shot.usdc --no-verify") == 0
    first = Path("shot.usdc").read_bytes()
    assert run(f"{SHOT} -o shot.usdc --no-verify") == 0
    assert Path("shot.usdc").read_bytes() == first


def test_a_pre_roll_changes_poses_and_no_times(world):
    assert run(f"{SHOT} -o shot.usdc --no-verify") == 0
    assert run(f"{SHOT} -o settled.usdc --pre-roll 0.5") == 0
    direct, settled = Usd.Stage.Open("shot.usdc"), Usd.Stage.Open("settled.usdc")
    for read in (Usd.Stage.GetStartTimeCode, Usd.Stage.GetEndTimeCode):
        assert read(direct) == read(settled)
    first = [np.array(animation(shot).GetRotationsAttr().Get(shot.GetStartTimeCode())) for shot in (direct, settled)]
    np.testing.assert_array_equal(first[0][:3], first[1][:3])
    assert np.abs(first[0][3:] - first[1][3:]).max() > 1e-4
    assert run("verify settled.usdc") == 0


@pytest.mark.parametrize("seconds", ["-1", "nan", "601"])
def test_a_pre_roll_out_of_range_is_refused(world, capsys, seconds):
    assert run(f"{SHOT} -o shot.usdc --pre-roll={seconds}") == 2
    assert "is not a number from 0 to 600" in capsys.readouterr().err


def test_linear_blend_skinning_moves_with_the_body_alone(world):
    assert run(f"{SHOT} -o lbs.usdc --lbs") == 0
    stage = Usd.Stage.Open("lbs.usdc")
    assert len(animation(stage).GetJointsAttr().Get()) == 3
    assert not animation(stage).GetBlendShapesAttr().Get()
    assert run("verify lbs.usdc") == 0


def test_a_tampered_rotation_fails_verification(world, capsys):
    assert run("verify shot.usda") == 0
    stage = Usd.Stage.Open("shot.usda")
    rotations = animation(stage).GetRotationsAttr()
    turned = list(rotations.Get(12))
    turned[1] = Gf.Quatf(0.9999, 0.0141, 0, 0).GetNormalized()
    rotations.Set(Vt.QuatfArray(turned), 12)
    stage.GetPrimAtPath("/Hero").GetAttribute("extent").Set([(-9, -9, -9), (9, 9, 9)], 12)
    stage.GetRootLayer().Save()
    capsys.readouterr()
    assert run("verify shot.usda") == 3
    assert "at time code 12" in capsys.readouterr().err


def test_a_model_written_anew_since_the_bake_is_mentioned(world, capsys):
    assert run("verify shot.usda") == 0 and "has changed" not in capsys.readouterr().err
    model = read_provenance("shot.usda")["request"]["model"]
    before = load_model(model)
    save_model(model, replace(before, provenance={**before.provenance, "seed": 1}))
    assert run("verify shot.usda") == 0
    assert "warning: " in (said := capsys.readouterr().err) and "the model has changed since" in said


def test_of_several_animations_one_is_named(world, tmp_path):
    """It is verified where its folder goes too, and its file is never overwritten."""
    layer = Sdf.Layer.FindOrOpen("clip.usda")
    Sdf.CopySpec(layer, "/Clip", layer, "/Other")
    layer.Export("clips.usda")
    Path("shots").mkdir()
    named = SHOT.replace("clip.usda", f"{tmp_path}/clips.usda:/Other")
    assert run(SHOT.replace("clip", "clips") + " -o shots/shot.usdc") == 2
    assert run(f"{named} -o clips.usda") == 2
    assert run(f"{named} -o shots/shot.usdc") == 0
    Path("moved").mkdir()
    for name in ("clips.usda", "shots"):
        Path(name).rename(f"moved/{name}")
    assert run("verify moved/shots/shot.usdc") == 0
    assert run("inspect rigged.usda --motion moved/clips.usda:/Clip") == 0


def test_a_shot_that_fails_its_proof_is_not_kept(world, monkeypatch, capsys):
    """The decoder is moved by 1 cm, so that no written file agrees with it."""
    honest = BakeRollout.decode
    monkeypatch.setattr(BakeRollout, "decode", lambda rollout, pose: honest(rollout, pose) + 0.01)
    Path("shots").mkdir()
    Path("shots/shot.usdc").write_text("older")
    capsys.readouterr()
    assert run(f"{SHOT} -o shots/shot.usdc") == 3
    assert "error: shots/shot.usdc: vertex" in capsys.readouterr().err
    assert Path("shots/shot.usdc").read_text() == "older"
    assert [path.name for path in Path("shots").iterdir()] == ["shot.usdc"]


def test_a_shot_is_verified_wherever_its_folder_goes(world, tmp_path, monkeypatch):
    Path("shots").mkdir()
    absolute = SHOT.replace("model.", f"{tmp_path}/model.").replace("clip.", f"{tmp_path}/clip.")
    assert run(f"{absolute} -o shots/shot.usdc --no-verify") == 0
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for name in ("model.safetensors", "rigged.usda", "clip.usda", "shots"):
        Path(name).rename(moved / name)
    monkeypatch.chdir(tmp_path.parent)
    assert run(f"verify {moved}/shots/shot.usdc") == 0
    (moved / "model.safetensors").rename(moved / "cape.safetensors")
    assert run(f"verify {moved}/shots/shot.usdc") == 2
    assert run(f"verify {moved}/shots/shot.usdc --model {moved}/cape.safetensors") == 0


@pytest.mark.slow
def test_an_interrupted_training_goes_on_to_the_same_model(world):
    """Interrupted by SIGINT, resumed, and compared with one that was left alone.

    Steps are so large that the model is best where it was interrupted, between two validations: a run that was
    left alone never looks at it there.
    """
    settings = (
        "--set iterations=120 --set validate_every=60 --set static_fraction=0.4 --set static_learning_rate=1e-6 "
        "--set learning_rate=0.1"
    )
    train = [*shlex.split("train rigged.usda --motions clip.usda"), *world.training, *shlex.split(settings)]
    # Contacts are as few as in this process: both have the same loss.
    code = "import sys; from ssilk_core.cli import main; from ssilk_core.physics import samples;"
    code += f"samples.MAX_SPACING = {samples.MAX_SPACING}; sys.exit(main())"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *train, "-o", "halved.safetensors", "--json"],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    for line in process.stdout:
        if json.loads(line)["event"] == "progress":
            process.send_signal(signal.SIGINT)
            break
    told = [json.loads(line) for line in process.stdout]
    assert process.wait() == 130 and "--resume" in told[-1]["text"]
    assert load_model("halved.safetensors").provenance["iteration"] < 120
    torch.set_num_threads(1)
    assert main([*train, "-o", "halved.safetensors", "--resume"]) in (EXIT_OK, EXIT_WORSE)
    assert main([*train, "-o", "whole.safetensors"]) in (EXIT_OK, EXIT_WORSE)
    assert Path("halved.safetensors").read_bytes() == Path("whole.safetensors").read_bytes()


DOCUMENT = Path(__file__).parents[2] / "docs" / "pipeline.md"


def test_the_python_example_runs_as_it_is_written(world, capsys):
    code, *_ = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), flags=re.DOTALL)
    Path("model.safetensors").rename("cape.safetensors")
    for name, frames in (("walk", 8), ("run", 6)):
        world.write_clip(Path(f"{name}.usdc"), frames=frames)
    Sdf.Layer.FindOrOpen("rigged.usda").Export("hero.usdc")
    capsys.readouterr()
    names: dict = {}
    exec(compile(code, str(DOCUMENT), "exec"), names)
    printed, reported = capsys.readouterr()
    result, layers = names["result"], names["layers"]
    assert (result.frames, result.fps, result.size_bytes) == (8, 30, Path("shot.usdc").stat().st_size)
    assert result.verification.largest_error_m < result.verification.allowed_error_m
    assert [layer.frames for layer in layers] == [8, 6] and all(layer.path.is_file() for layer in layers)
    assert Path("layers/shots/run/shot.usda").is_file()
    assert "8 frames at 30.0 fps" in printed and "shot.usdc" in reported
    again = bake_layers([names["walk"]], "layers")[0]
    assert again.current and replace(again, current=False) == layers[0]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"plain": True}, "'plain' is no field"),
        ({"samples_per_frame": "many"}, "'samples_per_frame' is 'many'"),
        ({"keep": "1,2"}, "not enough values"),
    ],
)
def test_a_shot_of_other_settings_is_refused_and_not_misread(world, capsys, change, says):
    layer = Sdf.Layer.FindOrOpen("shot.usda")
    data = layer.customLayerData
    data["ssilk"]["request"] = {**data["ssilk"]["request"], **change}
    layer.customLayerData = data
    layer.Save()
    assert run("verify shot.usda") == 2
    said = capsys.readouterr().err
    assert "does not say how it was baked" in said and says in said and "bake it again" in said
