# SPDX-License-Identifier: Apache-2.0
"""Numbers, names and places beyond what makes sense: one sentence and a documented exit code."""

from __future__ import annotations

import argparse
import json
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
from pxr import Gf, Sdf, Usd, UsdSkel

from ssilk_core.cli import main
from ssilk_core.cli.main import parser
from ssilk_core.cli.options.numbers import NumberRange
from ssilk_core.delivery.farm.job import numbers
from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import load_model, save_model

BAKE = "bake model.safetensors --stage rigged.usda"


@pytest.fixture
def copy(toy, tmp_path, monkeypatch) -> Path:
    """A copy of the toy world, in which commands run."""
    monkeypatch.chdir(tmp_path)
    return toy.copy(tmp_path)


def run(command: str) -> int:
    return main(shlex.split(command))


def said(capsys: pytest.CaptureFixture[str], level: str = "warning") -> str:
    """Return what the events of a command with --json say, of one level, one line for each."""
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    return "\n".join(event.get("error") or event["text"] for event in events if event.get("level", "error") == level
                     and ("error" in event or "text" in event))  # fmt: skip


# Numbers


def numeric_options() -> list[tuple[str, str]]:
    """Return the verb and the name of every option that takes a number."""
    (verbs,) = (action for action in parser()._actions if isinstance(action, argparse._SubParsersAction))
    taken = [(name, action) for name, verb in verbs.choices.items() for action in verb._actions]
    assert not [action for _, action in taken if action.type in (int, float)], "these take any number"
    return [(verb, action.option_strings[-1]) for verb, action in taken if isinstance(action.type, NumberRange)]


@pytest.mark.parametrize(("verb", "option"), numeric_options())
def test_no_option_takes_a_number_without_bounds(verb, option, capsys):
    for value in ("-1e4", "nan", "inf", "-inf", "1e300", "1" + "0" * 30, "9" * 5000, "x", "", "1,5", "0x10"):
        assert main([verb, "--json", f"{option}={value}"]) == 2
        (event,) = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        assert event["event"] == "failed" and f"{option}: '" in event["error"] and len(event["error"]) < 250


@pytest.mark.parametrize("text", ["9" * 5000, "0-" + "9" * 5000, "-1", "1-", "nan", "", "0,,1"])
def test_any_numbers_of_tasks_are_read_or_refused(text):
    with pytest.raises(SsilkError, match="--tasks"):
        numbers(text, 3)


@pytest.mark.parametrize("seed", ["x", 10**30, None, 1.5])
def test_a_model_with_an_impossible_seed_is_refused(toy, tmp_path, seed):
    file = load_model(toy.folder / "model.safetensors")
    save_model(tmp_path / "m.safetensors", replace(file, provenance={**file.provenance, "seed": seed}))
    with pytest.raises(SsilkError, match=r"the seed .* is not a whole number of 64 bits"):
        load_model(tmp_path / "m.safetensors")


@pytest.mark.parametrize("rate", [1e-9, 1e300])
def test_a_motion_of_an_impossible_rate_is_refused(copy, toy, capsys, rate):
    toy.write_clip(copy / "slow.usda", frames=3, fps=rate)
    assert run(f"{BAKE} --motion slow.usda -o slow.usdc --json") == 2
    assert "it must be from 0.01" in said(capsys, "error")


# Places


def moved(toy, path: Path, away: float, joint: int = 0, from_frame: int = 0) -> Path:
    """Write a short clip with a joint moved along x from a frame on."""
    stage = Usd.Stage.Open(str(toy.write_clip(path, frames=8)))
    attribute = UsdSkel.Animation(stage.GetPrimAtPath("/Clip")).GetTranslationsAttr()
    for time in attribute.GetTimeSamples():
        values = list(attribute.Get(time))
        values[joint] += Gf.Vec3f(away if time >= from_frame else 0, 0, 0)
        attribute.Set(values, time)
    stage.GetRootLayer().Save()
    return path


@pytest.mark.parametrize(("away", "joint"), [(1e30, 0), (1e6, 0), (2e5, 1)])
def test_a_motion_beyond_any_world_is_refused(copy, toy, capsys, away, joint):
    moved(toy, copy / "far.usda", away, joint, from_frame=4)
    assert run(f"{BAKE} --motion far.usda -o far.usdc --json") == 2
    assert "at time code 4; at most 100000 m are allowed" in said(capsys, "error")
    assert not (copy / "far.usdc").exists()


def test_a_shot_that_is_millimetres_off_far_from_the_origin_is_not_kept(copy, toy, capsys):
    moved(toy, copy / "far.usda", 9e4)
    assert run(f"{BAKE} --motion far.usda -o far.usdc --json") == 3
    assert "at most 0.00478 m is allowed" in said(capsys, "error") and not (copy / "far.usdc").exists()


@pytest.mark.parametrize(("joint", "says"), [(0, "the root jumps, by up to 5e+02 m"), (1, "Spine moves 5e+02 m")])
def test_jumps_are_warned_of(copy, toy, capsys, joint, says):
    moved(toy, copy / "jump.usda", 500.0, joint, from_frame=4)
    assert run(f"{BAKE} --motion jump.usda -o jump.usdc --json") == 0
    assert says in said(capsys)


# Paths and names


def test_the_same_inputs_give_the_same_bytes_wherever_they_lie(toy, tmp_path, monkeypatch):
    """Given by absolute paths; no layer names a folder above."""
    for name in ("here", "a studio/elsewhere"):
        folder = tmp_path / name
        toy.copy(folder)
        toy.write_clip(folder / "walk.usda", frames=3)
        inputs = f"'{folder}/model.safetensors' --stage '{folder}/rigged.usda' --motion '{folder}/walk.usda'"
        assert run(f"bake {inputs} --points -o '{folder}/layers'") == 0
    one, other = tmp_path / "here/layers", tmp_path / "a studio/elsewhere/layers"
    files = sorted(path.relative_to(one) for path in one.rglob("*") if path.is_file())
    assert len(files) == 8
    for file in files:
        assert (one / file).read_bytes() == (other / file).read_bytes(), file
        if file.suffix == ".usdc":
            assert str(tmp_path) not in Sdf.Layer.FindOrOpen(str(one / file)).ExportToString()
    assert run(f"verify '{other}/shots/walk/model/anim.usdc'") == 0


def test_a_name_that_is_too_long_fails_its_task_alone(copy, capsys):
    assert run("farm model.safetensors --stage rigged.usda --motion clip.usda --bundle job") == 0
    job = json.loads(Path("job/job.json").read_text())
    job["tasks"] = [job["tasks"][0] | {"shot": "long" * 70}, *job["tasks"]]
    Path("job/job.json").write_text(json.dumps(job))
    capsys.readouterr()
    assert run("task job/job.json -o out --openjd") == 0  # a session would begin nothing behind it
    (failed,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("openjd_fail")]
    assert "a name of 280 characters" in failed
    assert run("task job/job.json -o out --check --json") == 3
    assert "1 of 2 tasks are not done" in said(capsys, "error") and Path("out/shots/clip/shot.usda").is_file()


@pytest.mark.parametrize("onward", ["--start-from", "--stepper-of"])
def test_settings_that_a_given_model_cannot_take_are_refused(copy, capsys, onward):
    """Nothing is trained with other settings than were asked for."""
    before = sorted(copy.iterdir())
    train = f"train rigged.usda --motions clip.usda --preset draft --device cpu -o more.safetensors {onward}"
    for setting, complaint in (
        ("latent=16", "--set latent=16: the given model has 8; it is trained on as large as it is"),
        ("static_fraction=0.5", "training that goes on from a model has no static part"),
    ):
        assert run(f"{train} model.safetensors --set {setting}") == 2
        assert complaint in capsys.readouterr().err
    alone, blind = onward == "--stepper-of", "the given model sees no colliders, and its stepper alone cannot learn"
    if alone:
        assert run(f"{train} model.safetensors --set collider_fraction=0.5") == 2
        assert blind in capsys.readouterr().err
    assert sorted(copy.iterdir()) == before
    words = "--set latent=8 --set static_fraction=0 --set iterations=2 --set batch=2 --set window=4"
    assert run(f"{train} model.safetensors {words} --set valid_frames=8") in (0, 5)
    assert load_model("more.safetensors").config.latent == 8
    assert "it sees no colliders" not in capsys.readouterr().err  # nor does the preset have any
    if alone:
        small = words.replace("latent=8", "widths=16").replace("--set static_fraction=0 ", "")
        train = train.replace("--preset draft", "--preset preview").replace("more.", "seen.")
        assert run(f"{train} model.safetensors {small} --set valid_frames=8 --set newton_weight=0") in (0, 5)
        assert "warning: model.safetensors: it sees no colliders" in capsys.readouterr().err
