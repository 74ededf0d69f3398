# SPDX-License-Identifier: Apache-2.0
"""Smaller models and levels of quality, as users ask for them."""

from __future__ import annotations

import json
import shlex

import pytest

from ssilk_core.cli import main
from ssilk_core.network.checkpoint import load_model


def run(command: str) -> int:
    return main(shlex.split(command))


def last_result(capsys: pytest.CaptureFixture) -> dict:
    return json.loads(capsys.readouterr().out.splitlines()[-1])["detail"]


@pytest.fixture
def world(toy, tmp_path, monkeypatch):
    """A folder of its own with the toy's files, as the working folder."""
    monkeypatch.chdir(toy.copy(tmp_path))
    return tmp_path


def test_a_smaller_model_bakes_verifies_and_says_what_it_lost(world, capsys):
    whole = load_model("model.safetensors")
    assert run("reduce model.safetensors -o small.safetensors --shapes 2 --joints 1 --influences 2 --json") == 0
    told = last_result(capsys)
    small = load_model("small.safetensors")
    assert small.config.shapes == 2 and small.scene.rig.proxy_count == 1
    assert small.scene.rig.skin.indices.shape[1] == 2
    lost = small.provenance["reduced"]
    assert small.provenance["seed"] == whole.provenance["seed"] and lost["model"] == "model.safetensors"
    assert lost["blendshapes"] == told["blendshapes"] == "2 of 4" and lost["proxies"] == "1 of 4"
    assert 0 < lost["loses [mm RMS]"] < lost["loses at most [mm]"] and len(lost["motions"]) == 1
    assert told["bytes"] == (world / "small.safetensors").stat().st_size
    assert run("bake small.safetensors --stage rigged.usda --motion clip.usda -o small.usdc --json") == 0
    told = last_result(capsys)
    assert told["blendshapes"] == 3 and told["proxies"] == 1 and float(told["largest error [mm]"]) < 1e-2


def test_levels_and_numbers_may_be_mixed(world, capsys):
    assert run("reduce model.safetensors -o small.safetensors --quality crowd --shapes 1 --json") == 0
    told = last_result(capsys)
    assert (told["blendshapes"], told["proxies"]) == ("1 of 4", "4 of 4")


def test_a_budget_is_kept_and_what_it_bought_is_said(world, capsys):
    assert run("reduce model.safetensors -o whole.safetensors --json") == 0
    whole = last_result(capsys)["bytes"]
    budget = (whole - 3000) / 1000
    assert run(f"reduce model.safetensors -o small.safetensors --motions clip.usda --budget {budget}kB") == 0
    assert "blendshapes" in capsys.readouterr().err
    assert (world / "small.safetensors").stat().st_size < 1000 * budget + 2000  # what it says of itself comes on top


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--budget 1kB", "--budget: nothing fits 1 kB; this model needs at least"),
        ("--budget much", "not a budget"),
        ("--influences 0", "influences = 0"),
        ("--quality best", "--quality: 'best'; it is one of crowd, game, film, latent, hero"),
        ("--motions nowhere.usda", "nowhere.usda"),
        ("-o small.usdc", "it ends in .safetensors"),
        ("-o model.safetensors", "the output is also an input"),
    ],
)
def test_what_cannot_be_is_said_in_one_sentence(world, capsys, options, message):
    assert run(f"reduce model.safetensors -o small.safetensors {options}") == 2
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error and not (world / "small.safetensors").exists()


def test_motions_that_are_gone_must_be_named(world, capsys):
    (world / "clip.usda").rename("moved.usda")
    assert run("reduce model.safetensors -o small.safetensors --shapes 2") == 2
    assert "name motion files or folders with --motions" in capsys.readouterr().err
    assert run("reduce model.safetensors -o small.safetensors --shapes 2 --motions moved.usda") == 0


BAKE = "bake model.safetensors --stage rigged.usda --motion clip.usda -o small.usdc"


def test_a_level_bakes_what_it_keeps_and_is_verified_again(world, capsys):
    assert run(f"{BAKE} --quality crowd --json") == 0
    told = last_result(capsys)
    assert told["fps"] == 15 and told["frames"] == 20 and told["blendshapes"] == "4 of 4"
    assert told["loses at most [mm]"] < 0.1 and float(told["largest error [mm]"]) < 1e-2
    assert run(f"{BAKE} --quality crowd --fps 30 --json") == 0
    assert last_result(capsys)["frames"] == 40


def test_a_bake_keeps_to_its_budget_and_verifies_as_it_was_cut(world, capsys):
    assert run("bake model.safetensors --stage rigged.usda --motion clip.usda -o whole.usdc --json") == 0
    whole = last_result(capsys)["bytes"]
    assert run(f"{BAKE} --budget {0.9 * whole / 1000}kB --json") == 0
    told = last_result(capsys)
    assert told["bytes"] < 0.92 * whole and told["blendshapes"] != "4 of 4"
    assert float(told["largest error [mm]"]) < 1e-2
    assert run("verify small.usdc --json") == 0
    assert float(last_result(capsys)["largest error [mm]"]) < 1e-2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--quality game --lbs", "--lbs: linear blend skinning has no level of quality"),
        ("--budget 1kB", "nothing fits 1 kB"),
        ("--quality game -o layers", "bake models that 'ssilk reduce' made"),
    ],
)
def test_levels_that_cannot_be_baked_are_refused(world, capsys, options, message):
    assert run(f"{BAKE} {options}") == 2
    assert message in capsys.readouterr().err
